"""Find the motors on a bus: every id is asked, duplicates and strangers are told. Only asks, never commands."""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import Any

import tyro
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from drivers.bus import BusSpec, Clock
from drivers.open import PROTOCOLS, open_wire
from sim2real.bringup.sweep import SWEEPS, verdicts
from sim2real.clock import MonotonicClock, SimClock
from sim2real.config import did_you_mean, load_robot
from sim2real.types import Sim2realError


@dataclass
class Args:
    """Either a robot, whose wiring is compared with what answers, or one bus. Exit code 1: something is not right."""

    robot: str = ""
    """a robot of configs/robots, or the path of a YAML"""
    wiring: str = ""
    """which of the robot's wirings; default: its default"""
    bus: str = ""
    """with --robot: only this bus"""
    sim: bool = False
    """with --robot: its simulated motors"""
    fault: tuple[str, ...] = ()
    """with --sim: faults of the simulated wire, as in off:left_leg/left_knee_joint"""
    channel: str = ""
    """without --robot: the bus, as can0"""
    interface: str = "socketcan"
    """with --channel: socketcan, or any interface of python-can"""
    bitrate: int = 1_000_000
    """with --channel: bit/s"""
    protocol: str = "damiao"
    """with --channel: what to ask in"""
    json: bool = False
    """print JSON instead of tables"""


def main(argv: list[str]) -> int:
    args = tyro.cli(Args, args=argv, prog="sim2real scan", description=__doc__)
    if bool(args.robot) == bool(args.channel):
        raise Sim2realError("got neither or both of --robot and --channel, expected one: a robot's buses, or one bus")
    if (args.sim or args.bus or args.wiring) and not args.robot:
        raise Sim2realError("--sim, --bus and --wiring belong to a robot: add --robot, or drop --channel's company")
    if args.fault and not args.sim:
        raise Sim2realError("--fault without --sim: a real bus has its own; add --sim")
    specs, wires, clock = _buses(args)
    found: dict[str, list[dict[str, Any]]] = {}
    garbled: dict[str, int] = {}
    for spec in specs:
        if spec.protocol not in SWEEPS:
            raise Sim2realError(
                f"bus {spec.name}: no sweep for '{spec.protocol}'{did_you_mean(spec.protocol, SWEEPS)}, expected "
                f"{' or '.join(SWEEPS)}"
            )
        swept = SWEEPS[spec.protocol](wires[spec.name] if wires else open_wire(spec), clock)
        found[spec.name] = verdicts(swept, spec if spec.motors else None)
        garbled[spec.name] = swept.error_frames
    if args.json:
        print(
            json.dumps([{"bus": b, "error_frames": garbled[b], "motors": rows} for b, rows in found.items()], indent=1)
        )
    else:
        for bus, rows in found.items():
            _print(Console(), bus, rows, garbled[bus])
    bad = sum(len(row["problems"]) for rows in found.values() for row in rows) + sum(garbled.values())
    return int(bool(bad) or not any(found.values()))


def _buses(args: Args) -> tuple[list[BusSpec], Any, Clock]:
    """The buses to sweep, their simulated wires or None, and the clock to sweep by."""
    if args.channel:
        if args.protocol not in PROTOCOLS:
            close = did_you_mean(args.protocol, PROTOCOLS)
            raise Sim2realError(f"--protocol: got '{args.protocol}'{close}, expected one of {', '.join(SWEEPS)}")
        return (
            [BusSpec(args.channel, args.protocol, (), args.interface, args.channel, args.bitrate)],
            None,
            MonotonicClock(),
        )
    config = load_robot(args.robot)
    wiring = config.wiring(args.wiring)
    specs = wiring.bus_specs()
    names = [s.name for s in specs]
    if args.bus and args.bus not in names:
        raise Sim2realError(
            f"--bus: got '{args.bus}'{did_you_mean(args.bus, names)}, expected one of {', '.join(names)}"
        )
    wanted = [s for s in specs if args.bus in ("", s.name)]
    if not args.sim:
        return wanted, None, MonotonicClock()
    from drivers.open import open_world

    world = open_world(config.model_path, config.base, specs, wiring.imu_spec(), faults=args.fault)
    world.advance(0.1)  # it has been on for a while
    return wanted, world.wires, SimClock(world.advance, lambda: world.time)


def _print(console: Console, bus: str, rows: list[dict[str, Any]], garbled: int) -> None:
    table = Table(title=f"{bus}: {sum(bool(r['registers']) for r in rows)} motors", title_justify="left")
    for name in ("id", "answers on", "model", "firmware", "joint"):
        table.add_column(name, no_wrap=True)
    table.add_column("problems", justify="right")
    for r in rows:
        table.add_row(
            f"{r['id']:#04x}",
            ", ".join(f"{i:#04x}" for i in r["feedback_ids"]) or "-",
            " or ".join(r["models"]) or "-",
            f"{r['registers'].get('SW_VER', 0):g}" if r["registers"] else "-",
            escape(r["joint"]),
            f"[red]{len(r['problems'])}[/]" if r["problems"] else "[green]none[/]",
        )
    console.print(table)
    for r in rows:
        for problem in r["problems"]:
            console.print(
                f"  [red]{r['id']:#04x}[/] {escape(r['joint'])}: {escape(problem)}", highlight=False, soft_wrap=True
            )
    if garbled:
        console.print(f"[red]{garbled} error frames[/]: two motors with one id, a wrong bit rate, or a bad cable")
    if not rows:
        console.print("[red]nobody answers[/]: check power, wiring, termination and the bit rate")
