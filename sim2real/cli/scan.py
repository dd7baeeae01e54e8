"""Find the motors on a bus: every id is asked, duplicates and strangers are told. Only asks, never commands."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro
from rich.console import Console
from rich.markup import escape
from rich.progress import track
from rich.table import Table

from drivers.bus import BusSpec, Clock
from drivers.open import PROTOCOLS
from sim2real.bringup.retune import opened
from sim2real.bringup.sweep import verdicts
from sim2real.bringup.sweeps import SWEEPS, sweep
from sim2real.calibration import FOLDER
from sim2real.clock import MonotonicClock, SimClock
from sim2real.config import did_you_mean, load_robot
from sim2real.options import Count, MaybeNewFile
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
    """with --channel: socketcan, any interface of python-can, or serial"""
    bitrate: Count = 1_000_000
    """with --channel: bit/s"""
    protocol: str = "damiao"
    """with --channel: what to ask in"""
    all_bitrates: bool = False
    """look at every bit rate that such motors have, not only at the bus's own (a socketcan interface has one)"""
    out: MaybeNewFile = None
    """what was found, as JSON, bus after bus; default: with --robot, bringup/ROBOT-WIRING.scan.json"""
    go_on: bool = False
    """keep the buses that are in that file already"""
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
    specs, world, clock = _buses(args)
    for spec in specs:
        if spec.protocol not in SWEEPS:
            raise Sim2realError(
                f"bus {spec.name}: no sweep for '{spec.protocol}'{did_you_mean(spec.protocol, SWEEPS)}, expected "
                f"{' or '.join(SWEEPS)}"
            )
    path = args.out or (_path(args) if args.robot else None)
    done: list[dict[str, Any]] = json.loads(path.read_text()) if args.go_on and path and path.exists() else []
    found = {bus["bus"]: bus for bus in done if bus["bus"] in {s.name for s in specs}}
    for spec in track([s for s in specs if s.name not in found], "buses", console=Console(stderr=True), transient=True):
        found[spec.name] = _sweep(spec, args.all_bitrates, world, clock)
        if path:
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(json.dumps(list(found.values()), indent=1) + "\n")
    if args.json:
        print(json.dumps(list(found.values()), indent=1))
    else:
        for bus in found.values():
            _print(Console(), bus["bus"], bus["motors"], bus["error_frames"], bus.get("controller", ""))
        if path:
            Console().print(f"written to {path}", soft_wrap=True)
    bad = sum(len(row["problems"]) for bus in found.values() for row in bus["motors"])
    bad += sum(bus["error_frames"] for bus in found.values())
    return int(bool(bad) or not any(bus["motors"] for bus in found.values()))


def _path(args: Args) -> Path:
    config = load_robot(args.robot)
    return FOLDER / f"{config.name}-{args.wiring or config.default_wiring}{'-sim' * args.sim}.scan.json"


def _sweep(spec: BusSpec, all_bitrates: bool, world: Any, clock: Clock) -> dict[str, Any]:
    """Who is on a bus, as a plain object. At another bit rate than the bus's, whoever answers is a problem."""
    others = [r for r in SWEEPS[spec.protocol].bitrates if r != spec.bitrate]
    if spec.interface == "socketcan" and world is None:
        others = []  # it is the interface's, and setting it is root's
    strangers, garbled = [], 0
    for bitrate in others if all_bitrates else []:
        with opened(spec, world, bitrate) as wire:
            swept = sweep(spec.protocol, wire, clock, bitrate)
        for row in verdicts(swept):
            row["problems"].insert(0, f"listens at {bitrate} bit/s, the bus runs at {spec.bitrate}: `sim2real setup`")
            strangers.append(row)
    with opened(spec, world, spec.bitrate) as wire:
        swept = sweep(spec.protocol, wire, clock, spec.bitrate)
    garbled += swept.error_frames
    return {"bus": spec.name, "error_frames": garbled, "controller": swept.controller,
            "motors": strangers + verdicts(swept, spec if spec.motors else None)}  # fmt: skip


def _buses(args: Args) -> tuple[list[BusSpec], Any, Clock]:
    """The buses to sweep, the simulated world that they are in or None, and the clock to sweep by."""
    if args.channel:
        if args.protocol not in PROTOCOLS:
            close = did_you_mean(args.protocol, PROTOCOLS)
            raise Sim2realError(f"--protocol: got '{args.protocol}'{close}, expected one of {', '.join(SWEEPS)}")
        fd = SWEEPS[args.protocol].data_bitrate if args.protocol in SWEEPS else 0
        spec = BusSpec(args.channel, args.protocol, (), args.interface, args.channel, args.bitrate, data_bitrate=fd)
        return [spec], None, MonotonicClock()
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
    return wanted, world, SimClock(world.advance, lambda: world.time)


def _print(console: Console, bus: str, rows: list[dict[str, Any]], garbled: int, controller: str) -> None:
    table = Table(title=f"{bus}: {sum(bool(r['registers']) for r in rows)} motors", title_justify="left")
    for name in ("id", "answers on", "model", "firmware", "joint"):
        table.add_column(name, no_wrap=True)
    table.add_column("problems", justify="right")
    for r in rows:
        table.add_row(
            f"{r['id']:#04x}",
            ", ".join(f"{i:#04x}" for i in r["feedback_ids"]) or "-",
            " or ".join(r["models"]) or "-",
            escape(r["firmware"]) or "-",
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
    if controller:
        console.print(
            f"[red]the controller went {controller}[/]: frames were broken off, or nobody acknowledged them. A motor at another "
            "bit rate does that: `--all-bitrates` asks at all of them (a real interface must be set to each first: `ip link`)",
            soft_wrap=True,
        )
    if not rows:
        console.print("[red]nobody answers[/]: check power, wiring, termination and the bit rate")
