"""Serve a robot's simulated twin to other programs: CAN over python-can, serial lines as terminals, DDS on loopback."""

from __future__ import annotations

import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro
from rich.console import Console
from rich.markup import escape

from drivers.bus import BusSpec
from drivers.open import PROTOCOLS
from sim2real.config import load_robot
from sim2real.options import NotNegative, Seed
from sim2real.simulation import SETTLE

# How a program that knows nothing of this one connects, by protocol and else by the kind of wire. {where}: as it is served;
# {interface}, {channel}: its two parts on python-can.
HOW = {
    "dynamixel": 'dynamixel_sdk.PortHandler("{where}"), baud rate {bitrate}, protocol 2.0',
    "feetech": 'scservo_sdk.PortHandler("{where}"), baud rate {bitrate}',
    "moteus": 'moteus.PythonCanDevice(interface="{interface}", channel="{channel}"), or python-can with fd=True',
    "can": 'can.Bus(interface="{interface}", channel="{channel}"); python -m can.viewer -i {interface} -c {channel}',
    "dds": 'ChannelFactoryInitialize({domain}, "lo"), then rt/lowcmd and rt/lowstate as on the robot',
    "imu": 'serial.Serial("{where}"): {protocol} packets at {rate:g} Hz',
}


@dataclass
class Args:
    """Which robot. It hangs from its gantry, limp, until something drives it; Ctrl-C ends it."""

    robot: str
    """a robot of configs/robots, or the path of a YAML"""
    wiring: str = ""
    """which of the robot's wirings; default: its default"""
    serve: bool = False
    """serve it; without it, only say what would be served where"""
    can: str = "udp_multicast:239.74.163.{n}"
    """where its CAN buses go, as python-can's interface:channel; {n} is 2, 3, ... and {bus} the bus's name, as in
    socketcan:vcan{n}"""
    dds: str = "lo"
    """where its topics go: lo, or lo:1 for DDS domain 1"""
    directory: Path | None = None
    """where its terminals and sockets are; default: a folder made for it"""
    duration: NotNegative = 0.0
    """s; default: until Ctrl-C"""
    fault: tuple[str, ...] = ()
    """what goes wrong, as in drop:left_leg:0.1 or off:arm/left_elbow@5"""
    seed: Seed = 0


def plan(buses: list[BusSpec], directory: Path, can: str, dds: str) -> dict[str, str]:
    """By bus, where it is served: interface:channel of python-can, a path, or a DDS interface."""
    from drivers.sim.bridge import FIRST

    places = {"can": can, "dds": dds, "serial": str(directory / "{bus}.tty")}
    return {b.name: places[PROTOCOLS[b.protocol].wire].format(n=n, bus=b.name) for n, b in enumerate(buses, FIRST)}


def instructions(buses: list[BusSpec], imu: Any, where: dict[str, str]) -> list[tuple[str, str, str]]:
    """(bus, how other programs connect, what a wiring of sim2real says) of everything that is served."""
    rows = []
    for b in buses:
        kind, place = PROTOCOLS[b.protocol].wire, where[b.name]
        interface, _, channel = place.partition(":")
        how = HOW.get(b.protocol, HOW.get(kind, "")).format(
            where=place, interface=interface, channel=channel, bitrate=b.bitrate, domain=channel or 0
        )
        wiring = (
            f"interface: {kind}, channel: {place}" if kind != "can" else f"interface: {interface}, channel: {channel}"
        )
        rows.append((f"{b.name} ({len(b.motors)} {b.protocol})", how, wiring))
    if "imu" in where:
        how = HOW["imu"].format(where=where["imu"], protocol=imu.protocol, rate=imu.rate)
        rows.append(("imu", how, f"interface: serial, channel: {where['imu']}"))
    return rows


def main(argv: list[str]) -> int:
    args = tyro.cli(Args, args=argv, prog="sim2real sim", description=__doc__)
    config = load_robot(args.robot)
    wiring = config.wiring(args.wiring)
    buses, imu = wiring.bus_specs(), wiring.imu_spec()
    console = Console()
    title = f"{config.name}, {args.wiring or config.default_wiring}"
    if not args.serve:
        where = plan(buses, args.directory or Path("DIRECTORY"), args.can, args.dds)
        _print(console, f"{title}: would be served as follows (add --serve)", instructions(buses, imu, where))
        return 0

    from drivers.open import open_world
    from drivers.sim.bridge import bridges
    from drivers.sim.serve import serve

    home = dict(zip(config.joint_names, config.home_pos, strict=True))
    world = open_world(config.model_path, config.base, buses, imu, joint_pos=home, faults=args.fault, seed=args.seed)
    world.advance(SETTLE)
    directory = args.directory or Path(tempfile.mkdtemp(prefix="sim2real-"))
    made = bridges(world, buses, directory, args.can, args.dds)
    end = time.monotonic() + args.duration if args.duration else float("inf")

    def ready() -> None:
        _print(console, f"{title}: serving", instructions(buses, imu, {name: b.where for name, b in made.items()}))
        console.print(
            f'gantry, pushes, faults: WorldRemote("{directory / "world.sock"}")  (drivers/sim/socket_wire.py)'
        )
        sys.stdout.flush()

    try:
        pace = serve(world, directory, bridges=made, ready=ready, goes_on=lambda: time.monotonic() < end)
    except KeyboardInterrupt:
        return 0
    console.print(f"served {pace.elapsed:.1f} s at {pace.factor:.0%} of real time")
    return 0


def _print(console: Console, title: str, rows: list[tuple[str, str, str]]) -> None:
    console.print(f"[bold]{escape(title)}[/]")
    for name, how, wiring in rows:
        console.print(f"  [bold]{escape(name)}[/]", soft_wrap=True)
        console.print(f"    {escape(how)}", soft_wrap=True, highlight=False)
        console.print(f"    in a wiring: {escape(wiring)}", soft_wrap=True, highlight=False)
