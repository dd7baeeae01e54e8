"""List the robots shipped: joints, wirings, policies."""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import Any

import tyro
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from sim2real.config import CONFIG_DIR, RobotConfig, load_robot, robot_names


@dataclass
class Args:
    """What to print."""

    json: bool = False
    """Print JSON instead of a table."""


def describe(robot: RobotConfig) -> dict[str, Any]:
    """A robot as plain data: name, description, joint count, wirings and policies."""
    return {
        "name": robot.name,
        "description": robot.description,
        "joints": len(robot.joints),
        "wirings": {
            name: {
                "default": name == robot.default_wiring,
                "description": wiring.description,
                "rate": wiring.rate,
                "motors": {bus.name: len(bus.motors) for bus in wiring.buses},
            }
            for name, wiring in robot.wirings.items()
        },
        "skills": robot.skills,
        "policies": {name: entry.description for name, entry in robot.policies.items()},
    }


def main(argv: list[str]) -> int:
    args = tyro.cli(Args, args=argv, prog="sim2real robots", description=__doc__)
    robots = [describe(load_robot(name)) for name in robot_names()]
    if args.json:
        print(json.dumps(robots, indent=2))
        return 0
    table = Table("robot", "joints", "wirings", "policies", title=f"robots in {CONFIG_DIR}", show_lines=True)
    for robot in robots:
        wirings = [f"{name}: {w['description']}, {w['rate']:g} Hz" for name, w in robot["wirings"].items()]
        policies = [f"{name}: {text}" for name, text in robot["policies"].items()]
        table.add_row(
            f"[bold]{escape(robot['name'])}[/]\n{escape(robot['description'])}",
            str(robot["joints"]),
            escape("\n".join(wirings)),
            escape("\n".join(policies)) or "none yet",
        )
    Console().print(table)
    return 0
