"""The live status of a run in a terminal: mode, skill, tick rate, late ticks, bus load, hottest joint, faults."""

from __future__ import annotations

from typing import Any

import numpy as np
from rich.console import Console, Group
from rich.live import Live
from rich.panel import Panel
from rich.table import Table
from rich.text import Text

from sim2real.types import Mode

STYLE = {Mode.RUN: "bold green", Mode.HOLD: "bold yellow", Mode.DAMP: "bold red", Mode.OFF: "dim"}


class Status:
    """``show(run)`` redraws from anything with the public face of ``launch.Launch``. Without a terminal it prints a line
    whenever mode, stage or skill changes, and every message once."""

    def __init__(self, console: Console, keys: str = ""):
        self._console, self._keys = console, keys
        self._live = Live(console=console, refresh_per_second=10, transient=True) if console.is_terminal else None
        self._printed = 0
        self._line = ""
        self._last = (0, 0.0)
        self._rate = np.nan

    def __enter__(self) -> Status:
        if self._live:
            self._live.start()
        return self

    def __exit__(self, *_: Any) -> None:
        if self._live:
            self._live.stop()

    def show(self, run: Any) -> None:
        r = run.states.record
        tick, now = int(r["tick"][0]), float(r["now"][0])
        if now - self._last[1] > 0.5:
            self._rate = (tick - self._last[0]) / (now - self._last[1]) if self._last[1] else np.nan
            self._last = (tick, now)
        for message in run.messages[self._printed :]:
            self._console.print(Text(f"  {message}", style="yellow"))
        self._printed = len(run.messages)
        if self._live:
            self._live.update(self._panel(run))
        else:
            line = f"{run.mode.name:4}  {run.stage.name.lower():8} {run.skill}"
            if line != self._line:
                self._console.print(f"  {max(run.since, 0):6.1f} s  {line}")
                self._line = line

    def _panel(self, run: Any) -> Panel:
        r = run.states.record
        names = run.config.joint_names
        temperature = r["state.joint_temperature"][0]
        share = np.abs(r["state.joint_torque"][0]) / run.config.torque_max
        hot, strained = int(np.nanargmax(np.append(temperature, -1))), int(np.nanargmax(np.append(share, -1)))
        table = Table.grid(padding=(0, 2))
        table.add_row("mode", Text(run.mode.name, style=STYLE[run.mode]), "skill", Text(run.skill, style="bold"))
        table.add_row("stage", run.stage.name.lower(), "time", f"{max(run.since, 0.0):.1f} s")
        table.add_row(
            "ticks", f"{int(r['tick'][0])} at {self._rate:.0f} Hz, {int(r['late'][0])} late",
            "policy", f"{int(run.pilot_states.record['late'][0])} late",
        )  # fmt: skip
        loads = " ".join(f"{100 * x:.0f}%" for x in r["bus.load"][0])
        lost = int(r["bus.lost"].sum() + r["bus.rejected"].sum())
        table.add_row("bus load", loads, "frames lost", str(lost))
        if strained < len(names):
            warm = f"{names[hot]} {temperature[hot]:.0f} C" if hot < len(names) else "not measured"
            table.add_row("hottest", warm, "most torque", f"{names[strained]} {100 * share[strained]:.0f}%")
        fault = int(r["fault"][0])
        table.add_row("fault", Text(f"S2R-{fault:03d}", style="bold red") if fault else "none")
        rows: list[Any] = [table]
        if self._keys:
            rows.append(Text(self._keys, style="dim"))
            rows.append(Text("   ".join(f"{i} {label}" for i, label in enumerate(run.player.labels, 1)), style="dim"))
        return Panel(Group(*rows), title=f"sim2real {run.config.name}", border_style=STYLE[run.mode])


def print_summary(console: Console, summary: Any) -> None:
    """The outcome of a run, a line per fact."""
    table = Table.grid(padding=(0, 2))
    table.add_column(no_wrap=True)
    table.add_column(overflow="fold")

    def row(name: str, value: str, style: str = "") -> None:
        table.add_row(Text(name, style="dim"), Text(value, style=style))

    if summary.fell is not None:
        row(
            "fell",
            "no" if not summary.fell else f"yes, {summary.fell_at:.1f} s in",
            "green" if not summary.fell else "red",
        )
    row("performed", f"{summary.duration:.1f} s")
    if summary.mean_velocity is not None:
        v = summary.mean_velocity
        row("moved", f"{summary.distance:.2f} m forward, {summary.lateral:.2f} m left; mean {v[0]:.3f} m/s")
    row(
        "ticks",
        f"{summary.ticks}, {summary.late_ticks} late; policy {summary.policy_ticks}, {summary.late_policy_ticks} late",
    )
    if summary.real_time_factor:
        row("speed", f"{summary.real_time_factor:.1f} x real time")
    row("closest to a stop", f"{summary.joint_margin_of} {summary.joint_margin:.3f} rad")
    row("most torque", f"{summary.torque_max_of} {summary.torque_max:.1f} N m ({100 * summary.torque_share:.0f}%)")
    if summary.temperature_max is not None:
        row("hottest", f"{summary.temperature_max_of} {summary.temperature_max:.0f} C")
    row("bus load", f"{100 * summary.bus_load_max:.0f}% at most, {summary.frames_lost} frames lost")
    row("faults", ", ".join(summary.faults) or "none", "red" if summary.faults else "green")
    for refused in summary.refused_skills:
        row("refused", refused)
    console.print(table)
    for name, value in (("wire sha256", summary.wire_sha256), ("record", summary.record)):
        if value:  # never cut or wrapped: it is there to be copied
            console.print(Text.assemble((f"{name:19}", "dim"), value), soft_wrap=True)
