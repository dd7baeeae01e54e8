"""Say what a policy file is, and whether it fits a robot."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import tyro

if TYPE_CHECKING:
    from rich.console import Console

    from sim2real.config import RobotConfig
    from sim2real.contract import Contract
    from sim2real.policy import Mismatch


@dataclass(frozen=True)
class Args:
    """Say what a policy file is, and whether it fits a robot. Exit status 0: it loads and fits; 1: it does not fit;
    2: it is no policy, or damaged."""

    file: tyro.conf.Positional[Path]  # policy file (.onnx)
    robot: str | None = None  # name of a robot, or its YAML; none: the one the policy names
    sha256: str | None = None  # refuse any other file
    json: bool = False  # print one JSON document instead of tables


def main(argv: list[str]) -> int:
    args = tyro.cli(Args, args=argv, prog="sim2real check")
    from rich.console import Console

    from sim2real.config import load_robot
    from sim2real.policy import load_policy, mismatches, read_contract

    contract = read_contract(args.file)
    robot = load_robot(args.robot or contract.robot)
    policy = load_policy(args.file, sha256=args.sha256)  # not for a robot yet: every mismatch is worth a line
    found = mismatches(contract, robot)
    if args.json:
        document = {
            "file": str(args.file),
            "sha256": policy.sha256,
            "robot": robot.name,
            "golden_error": policy.golden_error,
            "mismatches": [m._asdict() for m in found],
            "contract": contract.model_dump(mode="json", exclude={"golden"}),
        }
        print(json.dumps(document, indent=1))
        return 1 if found else 0
    console = Console(highlight=False)
    _about(console, contract, policy.sha256, policy.golden_error)
    _joints(console, contract, robot)
    _signals(console, contract)
    _skills(console, contract)
    _verdict(console, contract, robot, found)
    return 1 if found else 0


def _table(console: Console, title: str, columns: list[str], rows: list[list[Any]]) -> None:
    """Text is shown as it is: a policy file comes from elsewhere, so markup in it is not obeyed."""
    from rich.table import Table
    from rich.text import Text

    table = Table(title=title, title_justify="left", header_style="bold", title_style="bold", box=None, pad_edge=False)
    for k, column in enumerate(columns):
        numeric = bool(rows) and all(isinstance(row[k], int | float) or row[k] == "" for row in rows)
        table.add_column(column, justify="right" if numeric else "left")
    for row in rows:
        table.add_row(*(Text(f"{cell:g}" if isinstance(cell, int | float) else str(cell)) for cell in row))
    console.print(table, "")


def _about(console: Console, contract: Contract, sha256: str, error: float) -> None:
    provenance = contract.provenance
    low, high = contract.command_velocity_min, contract.command_velocity_max
    steps = sum(g.steps for g in contract.golden)
    variants = f", variants {contract.variants}" if contract.variants else ""
    rows = [
        ["robot", f"{contract.robot}{variants}"],
        ["period", f"{contract.period:g} s ({1 / contract.period:g} Hz)"],
        ["source", provenance.source],
        ["revision", provenance.revision or "not stated"],
        ["licence", provenance.licence],
        ["created", provenance.created or "not stated"],
        ["tools", ", ".join(f"{k} {v}" for k, v in provenance.tools.items()) or "not stated"],
        ["training", ", ".join(f"{k} {v}" for k, v in provenance.training.items()) or "not stated"],
        ["sha256", sha256],
        [
            "golden",
            f"{len(contract.golden)} sequences, {steps} steps: error {error:.1e} of {contract.golden_tolerance:g}",
        ],
    ]
    if "command_velocity" in contract.inputs:
        ranges = ", ".join(f"{a:g} to {b:g}" for a, b in zip(low, high, strict=True))
        rows.append(["command", f"forward, left (m/s), turn (rad/s): {ranges}"])
    _table(console, f"policy {contract.name}", ["", ""], rows)


def _joints(console: Console, contract: Contract, robot: RobotConfig) -> None:
    default = dict(zip(contract.joint_names, contract.default_joint_pos, strict=True))
    gains = dict(zip(contract.target_joint_names, zip(contract.kp, contract.kd, strict=True), strict=True))
    names = [*dict.fromkeys([*contract.target_joint_names, *contract.joint_names, *contract.hold])]
    limits = {j.name: j for j in robot.joints}
    rows = []
    for name in names:
        joint, hold = limits.get(name), contract.hold.get(name)
        kp, kd = gains.get(name) or ((hold.kp, hold.kd) if hold else ("", ""))
        rows.append(
            [
                name,
                "driven" if name in gains else "held" if hold else "observed",
                default.get(name, hold.position if hold else ""),
                f"{joint.position[0]:.3f} to {joint.position[1]:.3f}" if joint else "no such joint",
                kp,
                kd,
                joint.kp_max if joint else "",
                joint.kd_max if joint else "",
            ]
        )
    columns = ["joint", "role", "at, rad", f"range in {robot.name}", "kp", "kd", "kp max", "kd max"]
    _table(console, "joints, in the order of its targets", columns, rows)


def _signals(console: Console, contract: Contract) -> None:
    from sim2real.contract import CARRY, INPUTS, OUTPUTS

    rows = []
    for side, shapes, vocabulary in (("in", contract.inputs, INPUTS), ("out", contract.outputs, OUTPUTS)):
        for name, shape in shapes.items():
            signal = vocabulary.get(name)
            seen = contract.envelope.get(name)
            rows.append(
                [
                    side,
                    name,
                    math.prod(shape),
                    signal.unit if signal else "-",
                    signal.meaning if signal else "fed back" if name.startswith(CARRY) else "",
                    f"{min(seen.min):.3g} to {max(seen.max):.3g}" if seen else "",
                ]
            )
    _table(console, "signals", ["", "name", "size", "unit", "meaning", "seen in training"], rows)


def _skills(console: Console, contract: Contract) -> None:
    rows = [
        [
            s.label + (" (default)" if s.label == contract.default_skill else ""),
            s.description,
            "any" if s.next is None else ", ".join(s.next) or "none",
            f"{s.dwell:g} s",
            "" if s.value_min is None else s.value_min,
        ]
        for s in contract.skills
    ]
    _table(console, "skills", ["label", "what it does", "may be followed by", "stays at least", "value at least"], rows)


def _verdict(console: Console, contract: Contract, robot: RobotConfig, found: list[Mismatch]) -> None:
    if found:
        _table(
            console,
            f"does not fit {robot.name}: {len(found)} mismatch{'es' if len(found) > 1 else ''}",
            ["what", "got", "expected", "how to fix"],
            [list(m) for m in found],
        )
    else:
        console.print(f"'{contract.name}' fits {robot.name}", style="green", markup=False)
