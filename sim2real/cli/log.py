"""Look into the record of a run: summary, plot, replay, repair, export."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro
from rich.console import Console
from rich.table import Table
from rich.text import Text

from sim2real.options import Count, MaybeNewFile, NewFile, NotNegative

Record = tyro.conf.Positional[Path]
Output = Annotated[MaybeNewFile, tyro.conf.arg(aliases=["-o"])]


@dataclass
class SummaryArgs:
    """What happened: modes, faults, skills, lateness, buses, and how far each joint was stretched."""

    record: Record
    """the .mcap of a run"""
    json: bool = False
    """print JSON instead of tables"""

    def run(self) -> int:
        from sim2real.recorder.run import Run
        from sim2real.recorder.summary import summarise

        summary = summarise(Run(self.record))
        if self.json:
            print(json.dumps(summary.as_dict(), indent=2))
        else:
            _print_summary(Console(), summary)
        return 0


@dataclass
class PlotArgs:
    """The run as one HTML file: timeline, joints, torque, temperature, lateness, bus load."""

    record: Record
    """the .mcap of a run"""
    output: Output = None
    """default: beside the record"""

    def run(self) -> int:
        from sim2real.recorder.plot import write_plot
        from sim2real.recorder.run import Run

        print(write_plot(Run(self.record), self.output))
        return 0


@dataclass
class ReplayArgs:
    """Push the recorded states through today's safety gate and policy. Exit code 1: something is decided otherwise."""

    record: Record
    """the .mcap of a run"""
    policy: tuple[Path, ...] = ()
    """policy files to run instead of the recorded ones, in their order"""
    robot: str = ""
    """robot to judge by instead of the recorded file: a name, or a YAML"""
    tolerance: NotNegative = 1e-6
    """largest difference of a motor command that counts as equal, in SI units"""
    policy_tolerance: NotNegative = 1e-4
    """largest difference of a joint target (rad) or skill value that counts as equal"""
    show: Count = 20
    """how many changes to print"""

    def run(self) -> int:
        from sim2real.config import load_robot
        from sim2real.recorder.replay import replay
        from sim2real.recorder.run import Run

        result = replay(
            Run(self.record),
            load_robot(self.robot) if self.robot else None,
            self.policy,
            tolerance=self.tolerance,
            policy_tolerance=self.policy_tolerance,
            keep=self.show,
        )
        console = Console()
        for note in result.notes:
            console.print(_plain(f"note: {note}", "yellow"))
        for c in result.first:
            console.print(_plain(f"{c.time:9.3f} s  {c.what} {c.where}: was {c.was}, is now {c.now}"), soft_wrap=True)
        for what, count in result.changed.items():
            largest = f", by up to {result.largest[what]:.3g}" if what in result.largest else ""
            console.print(_plain(f"{what}: changed in {count} ticks{largest}", "red"))
        verdict = "identical" if result.identical else "CHANGED"
        console.print(_plain(f"{verdict}: {result.ticks} ticks of the gate, {result.policy_steps} steps of the policy"))
        return 0 if result.identical else 1


@dataclass
class RepairArgs:
    """Save what is left of a record whose run, or disk, did not end properly."""

    record: Record
    """a damaged .mcap, or an .mcap.part"""
    output: Output = None
    """default: <name>-repaired.mcap beside it"""

    def run(self) -> int:
        from sim2real.recorder.repair import repair

        done = repair(self.record, self.output)
        console = Console()
        for sentence in done.damage or ["nothing was wrong with it"]:
            console.print(_plain(f"{done.source}: {sentence}", "yellow"))
        saved = ", ".join(f"{count} of {topic}" for topic, count in done.recovered.items())
        console.print(_plain(f"saved {saved} ({done.duration:.2f} s) to {done.output}"))
        return 0


@dataclass
class ExportArgs:
    """The record as arrays (.npz) or tables (.csv, one file a topic)."""

    record: Record
    """the .mcap of a run"""
    output: Annotated[NewFile, tyro.conf.arg(aliases=["-o"])]
    """file to write; its ending decides the format"""

    def run(self) -> int:
        from sim2real.recorder.export import export
        from sim2real.recorder.reader import Reader

        for path in export(Reader(self.record), self.output):
            print(path)
        return 0


Args = (
    Annotated[SummaryArgs, tyro.conf.subcommand("summary")]
    | Annotated[PlotArgs, tyro.conf.subcommand("plot")]
    | Annotated[ReplayArgs, tyro.conf.subcommand("replay")]
    | Annotated[RepairArgs, tyro.conf.subcommand("repair")]
    | Annotated[ExportArgs, tyro.conf.subcommand("export")]
)


def main(argv: list[str]) -> int:
    args = tyro.cli(Args, args=argv, prog="sim2real log", description=__doc__)  # type: ignore[call-overload]
    return args.run()


def _plain(text: str, style: str = "") -> Text:
    """Text that is shown as it is: no markup, and no control characters that a name from a file may hold."""
    from sim2real.cli import printable

    return Text(printable(text), style)


def _table(title: str, columns: tuple[str, ...], rows: list[tuple[str, ...]]) -> Table:
    table = Table(title=title, title_justify="left", box=None, pad_edge=False)
    for i, name in enumerate(columns):
        table.add_column(name, justify="left" if i == 0 else "right", overflow="fold")
    for row in rows:
        table.add_row(*(_plain(cell) for cell in row))
    return table


def _print_summary(console: Console, s) -> None:
    about = s.run
    words = [about.get(k, "") for k in ("robot", "wiring", "clock", "started", "revision")]
    console.print(_plain(" · ".join(filter(None, words)) or s.record, "bold"))
    console.print(
        _plain(
            f"{s.duration:.2f} s, {s.ticks} ticks ({s.ticks_late} late), {s.policy_ticks} policy ticks"
            f" ({s.policy_ticks_late} late), {s.limited_ticks} ticks limited by the gate,"
            f" {s.refused_switches} refused switches"
        )
    )
    for fault in s.faults or ["no faults"]:
        console.print(_plain(fault, "bold red" if s.faults else "green"))
    for note in filter(None, [*s.notes, s.recording_stopped]):
        console.print(_plain(f"note: {note}", "yellow"))
    for title, periods in (("mode", s.modes), ("skill", s.skills)):
        rows = [(p.name, f"{p.start:.3f}", f"{p.end:.3f}", f"{p.fault} {p.joint}".strip()) for p in periods]
        console.print(_table("", (title, "from s", "to s", "fault"), rows))
    rows = [(stage, *(f"{1e6 * value:.0f}" for value in q.values())) for stage, q in s.timing.items()]
    console.print(_table("", ("µs", "p50", "p99", "p99.9", "max"), rows))
    rows = [
        (b.name, f"{b.load_mean:.0%}", f"{b.load_max:.0%}", *map(str, (b.sent, b.received, b.rejected, b.lost)))
        for b in s.buses
    ]
    console.print(_table("", ("bus", "load", "max", "sent", "received", "rejected", "lost"), rows))
    if s.object is not None:
        row = (f"{s.object.used} of {s.object.sightings}", *(f"{1e3 * value:.0f}" for value in s.object.age.values()))
        console.print(_table("", ("sightings used", "age p50 ms", "p99", "p99.9", "max"), [row]))
    rows = [
        (
            j.name,
            "" if j.tracking_rmse is None else f"{j.tracking_rmse:.4f}",
            "" if j.margin is None else f"{j.margin:.3f}",
            f"{j.torque_max:.1f}",
            "" if j.torque_share is None else f"{j.torque_share:.0%}",
            f"{j.temperature_max:.0f}" if math.isfinite(j.temperature_max) else "-",
        )
        for j in s.joints
    ]
    head = ("joint", "rmse rad", "margin rad", "N m", "of limit", "deg C")
    console.print(_table("", head, rows))
