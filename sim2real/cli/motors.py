"""A live table of every motor: position, velocity, torque, temperature, error, age. Only asks, never commands."""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import Any

import tyro
from rich.console import Console
from rich.live import Live
from rich.table import Table

from sim2real.bringup.observe import Observer, observers, rows
from sim2real.clock import MonotonicClock, SimClock
from sim2real.config import RobotConfig, Wiring, load_robot
from sim2real.options import NotNegative

ASK_PERIOD = 0.02  # s between two questions to every motor
SHOW_PERIOD = 0.1  # s between two tables
STALE = 0.2  # s, from where an age is shown in red
FIRST_LOOK = 1.5  # s until --json prints: DDS takes about one to find the robot


@dataclass
class Args:
    """Whose motors. Exit code 1: a motor is silent or reports an error at the end."""

    robot: str
    """a robot of configs/robots, or the path of a YAML"""
    wiring: str = ""
    """which of the robot's wirings; default: its default"""
    sim: bool = False
    """simulated motors, of a robot that hangs limp from its gantry"""
    duration: NotNegative = 0.0
    """s; default: until Ctrl-C"""
    fault: tuple[str, ...] = ()
    """with --sim: faults of the simulated wire, as in off:left_leg/left_knee_joint"""
    json: bool = False
    """look once and print JSON instead"""


class Watch:
    """The motors of a wiring under observation, on the real clock or, of a simulated robot, on its own."""

    def __init__(self, config: RobotConfig, wiring: Wiring, sim: bool, faults: tuple[str, ...] = ()) -> None:
        """Raises BusError."""
        self.clock: MonotonicClock | SimClock = MonotonicClock()
        self.world: Any = None
        if sim:
            from drivers.open import open_world

            home = dict(zip(config.joint_names, config.home_pos, strict=True))
            self.world = world = open_world(
                config.model_path, config.base, wiring.bus_specs(), wiring.imu_spec(), joint_pos=home, faults=faults
            )
            self.clock = SimClock(world.advance, lambda: world.time)
        self.observers: list[Observer] = observers(wiring.bus_specs(), self.world.wires if sim else None)

    def look(self, seconds: float) -> list[dict[str, Any]]:
        """Ask and listen for a while; what every motor last said. Raises WireError."""
        start = self.clock.now()
        for n in range(round(seconds / ASK_PERIOD)):
            for observer in self.observers:
                observer.ask()
            self.clock.sleep_until(start + (n + 1) * ASK_PERIOD)
            for observer in self.observers:
                observer.look(self.clock.now())
        return rows(self.observers, self.clock.now())


def main(argv: list[str]) -> int:
    args = tyro.cli(Args, args=argv, prog="sim2real motors", description=__doc__)
    config = load_robot(args.robot)
    wiring = config.wiring(args.wiring)
    watch = Watch(config, wiring, args.sim, args.fault)
    if args.json:
        seen = watch.look(FIRST_LOOK)
        print(json.dumps(seen, indent=1))
    else:
        title = f"{config.name}, {args.wiring or config.default_wiring}{', simulated' * args.sim}"
        seen = _show(watch, title, args.duration)
    return int(any(row["error"] != "none" for row in seen))


def _show(watch: Watch, title: str, duration: float) -> list[dict[str, Any]]:
    real = MonotonicClock()
    end = real.now() + duration if duration else float("inf")
    seen: list[dict[str, Any]] = []
    with Live(console=Console(), auto_refresh=False) as live:
        try:
            while (now := real.now()) < end:
                seen = watch.look(SHOW_PERIOD)
                live.update(_table(title, seen, [o.remark() for o in watch.observers]), refresh=True)
                real.sleep_until(now + SHOW_PERIOD)
        except KeyboardInterrupt:
            pass
    return seen


def _table(title: str, seen: list[dict[str, Any]], remarks: list[str]) -> Table:
    table = Table(title=title, caption="; ".join(filter(None, remarks)) or None, box=None, header_style="bold")
    table.add_column("joint", no_wrap=True)
    for name in ("rad", "rad/s", "N m", "deg C", "age ms"):
        table.add_column(name, justify="right")
    table.add_column("state", no_wrap=True)
    for r in seen:
        numbers = [f"{v:.2f}" if (v := r[k]) is not None else "-" for k in ("position", "velocity", "torque")]
        temperature = "-" if r["temperature"] is None else f"{r['temperature']:.0f}"
        age = "-" if r["age"] is None else f"{1e3 * r['age']:.0f}"
        if r["age"] is not None and r["age"] > STALE:
            age = f"[red]{age}[/]"
        state = ("enabled" if r["enabled"] else "disabled") if r["error"] == "none" else f"[red]{r['error']}[/]"
        table.add_row(r["joint"], *numbers, temperature, age, state)
    return table
