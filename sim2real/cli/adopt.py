"""Wrap a policy of another stack into the policy contract."""

from __future__ import annotations

import importlib
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from sim2real.options import NewFile


@dataclass(frozen=True)
class Args:
    """Wrap a policy of another stack into the policy contract.

    The observation is rebuilt inside the graph from named signals in SI units, and the file is written only if it agrees
    with an independent account of the other stack's deploy script.
    """

    source: tyro.conf.Positional[Path]  # folder, or network file, of the foreign policy
    dialect: str  # the other stack: booster_gym, holosoma, playground or unitree_rl_gym
    output: Annotated[NewFile, tyro.conf.arg(aliases=["-o"])]  # policy file to write (.onnx)
    robot: str = "g1"  # name of a robot, or its YAML
    config: tuple[Path, ...] = ()  # configuration files of the other stack; none: those beside the network


def main(argv: list[str]) -> int:
    args = tyro.cli(Args, args=argv, prog="sim2real adopt")
    from sim2real.config import load_robot

    # The runtime does not import the packages above it: this command hands over to one.
    adopt = importlib.import_module("policies.adopt").adopt
    policy = adopt(args.source, args.dialect, load_robot(args.robot), args.output, args.config)
    contract = policy.contract
    print(
        f"{args.output}: '{contract.name}' for {contract.robot}: drives {len(contract.target_joint_names)} joints, holds"
        f" {len(contract.hold)}; skills {', '.join(contract.skill_labels)}; golden error {policy.golden_error:.1e}\n"
        f"  sha256 {policy.sha256}\n  next: sim2real check {args.output} --robot {args.robot}"
    )
    return 0
