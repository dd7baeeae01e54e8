"""Look at this computer: what would keep a robot from running well, why, and the command that fixes it."""

from __future__ import annotations

import json
from collections import Counter
from dataclasses import asdict, dataclass
from pathlib import Path

import tyro
from rich.console import Console
from rich.text import Text

from sim2real.bringup.checks import CHECKS, Finding, Level, Question
from sim2real.bringup.machine import Machine
from sim2real.config import load_robot
from sim2real.types import Sim2realError

STYLES = {Level.OK: "green", Level.WARN: "yellow", Level.FAIL: "bold red"}


@dataclass
class Args:
    """What the computer is wanted for. Exit code 1: something fails."""

    robot: str = ""
    """a robot of configs/robots, or the path of a YAML: look at its buses, ports and policies too"""
    wiring: str = ""
    """which of the robot's wirings; default: its default"""
    hardware: bool = False
    """for the real robot: what is not there fails, where it otherwise warns"""
    records: Path = Path("runs")
    """where records will go"""
    json: bool = False
    """print JSON instead of lines"""


def examine(question: Question) -> list[Finding]:
    """Every finding of every check, in order."""
    return [finding for check in CHECKS for finding in check(question)]


def main(argv: list[str]) -> int:
    args = tyro.cli(Args, args=argv, prog="sim2real doctor", description=__doc__)
    if (args.wiring or args.hardware) and not args.robot:
        raise Sim2realError("--wiring and --hardware: whose? Add --robot NAME (`sim2real robots` lists them)")
    robot = load_robot(args.robot) if args.robot else None
    wiring = robot.wiring(args.wiring) if robot else None
    found = examine(Question(Machine(), args.records, robot, wiring, args.hardware))
    if args.json:
        print(json.dumps([asdict(f) | {"level": f.level.name} for f in found], indent=1))
    else:
        _print(Console(), found)
    return int(max(f.level for f in found) == Level.FAIL)


def _print(console: Console, found: list[Finding]) -> None:
    width = max(len(f.what) for f in found)
    for f in found:
        line = Text.assemble((f"{f.level.name:4} ", STYLES[f.level]), (f"{f.what:{width}}  ", "bold"), f.said)
        console.print(line, soft_wrap=True)
        if f.level != Level.OK:
            console.print(Text(f"{'':5}{f.why}"), soft_wrap=True)
            console.print(Text.assemble(f"{'':5}fix: ", (f.fix, "cyan")), soft_wrap=True)
    count = Counter(f.level for f in found)
    console.print(f"{count[Level.OK]} OK, {count[Level.WARN]} WARN, {count[Level.FAIL]} FAIL", highlight=False)
