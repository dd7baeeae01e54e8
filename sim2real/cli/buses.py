"""The budget of a robot's buses: frames, load, best rate, and what would fix an overload."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from typing import Any

import tyro
from rich.console import Console
from rich.table import Table

from drivers.budget import LOAD_MAX, budget
from drivers.bus import BusSpec
from drivers.open import open_codec
from sim2real.config import load_robot
from sim2real.options import NotNegative


@dataclass
class Args:
    """Which wiring to look at. Exit code 1: a bus is loaded beyond what is sensible."""

    robot: str
    """a robot of configs/robots, or the path of a YAML"""
    wiring: str = ""
    """which of the robot's wirings; default: its default"""
    rate: NotNegative = 0.0
    """Hz; default: the wiring's"""
    json: bool = False
    """print JSON instead of a table"""


def remedies(spec: BusSpec, rate: float) -> list[str]:
    """What would bring a bus to LOAD_MAX or below at ``rate`` (Hz), the cheapest first; empty: it is."""
    b = budget(spec, rate)
    if b.load <= LOAD_MAX:
        return []
    fixes = [f"a rate of {math.floor(b.rate_max)} Hz"]
    n = len(spec.motors)
    fit = next((k for k in range(n - 1, 0, -1) if _load(spec, k, rate) <= LOAD_MAX), 0)
    if fit:
        fixes.append(f"at most {fit} of its {n} motors on it ({math.ceil(n / fit)} buses in all)")
    else:
        fixes.append("no number of buses: one motor alone is too much")
    fixes.append(f"a bit rate of {b.bits * rate / LOAD_MAX / 1e6:.2g} Mbit/s, where protocol and wiring carry it")
    return fixes


def _load(spec: BusSpec, motors: int, rate: float) -> float:
    return budget(BusSpec(spec.name, spec.protocol, spec.motors[:motors], bitrate=spec.bitrate), rate).load


def rows(specs: list[BusSpec], rate: float) -> list[dict[str, Any]]:
    """A plain object for each bus. Raises BusError for a bus that its protocol cannot carry."""
    out = []
    for spec in specs:
        open_codec(spec)
        b = budget(spec, rate)
        out.append(
            {"bus": spec.name, "protocol": spec.protocol, "motors": len(spec.motors), "bitrate": spec.bitrate}
            | {k: v for k, v in b._asdict().items() if k != "bus"}
            | {"fixes": remedies(spec, rate)}
        )
    return out


def main(argv: list[str]) -> int:
    args = tyro.cli(Args, args=argv, prog="sim2real buses", description=__doc__)
    config = load_robot(args.robot)
    wiring = config.wiring(args.wiring)
    rate = args.rate or wiring.rate
    found = rows(wiring.bus_specs(), rate)
    if args.json:
        print(json.dumps({"robot": config.name, "rate": rate, "load_max": LOAD_MAX, "buses": found}, indent=1))
    else:
        _print(Console(), f"{config.name}, {args.wiring or config.default_wiring} at {rate:g} Hz", found)
    return 1 if any(row["fixes"] for row in found) else 0


def _print(console: Console, title: str, found: list[dict[str, Any]]) -> None:
    table = Table(title=title)
    table.add_column("bus", no_wrap=True)
    for name in ("motors", "Mbit/s", "frames", "bits", "load", "worst", "best Hz"):
        table.add_column(name, justify="right")
    for r in found:
        table.add_row(
            r["bus"], str(r["motors"]), f"{r['bitrate'] / 1e6:g}", str(r["frames"]), f"{r['bits']:.0f}",
            f"[{'red' if r['fixes'] else 'green'}]{r['load']:.0%}[/]", f"{r['load_worst']:.0%}", f"{r['rate_max']:.0f}",
        )  # fmt: skip
    console.print(table)
    console.print(
        f"Frames and bits are those of one tick. Load: typical; more than {LOAD_MAX:.0%} leaves no room to repeat."
    )
    for r in found:
        if r["fixes"]:
            console.print(f"[red]{r['bus']}[/] is overloaded; any of these would do:")
            for fix in r["fixes"]:
                console.print(f"  - {fix}")
