"""Measure how often a policy stays up: per skill, pushed, switching, and through the bytes."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import tyro

from sim2real.cli.train import training_side


@dataclass(frozen=True)
class Args:
    """Measure how often a policy stays up: per skill, pushed, over every switch, and through the deployed loop.

    Exit status 0: at least 95 % of the undisturbed episodes survive, per skill, per switch and deployed; 1: fewer.
    """

    file: tyro.conf.Positional[Path] = Path("policies/g1/basics.onnx")
    """policy file"""
    episodes: int = 100
    """per skill; a fifth of it per switch"""
    deployed: int = 40
    """runs through the bytes, undisturbed, and as many pushed"""
    report: Path | None = None
    """write every number to this JSON file"""
    card: Path | None = None
    """write the policy's card to this Markdown file"""


def main(argv: list[str]) -> int:
    args = tyro.cli(Args, args=argv, prog="sim2real eval")
    good = training_side("policies.card").eval_command(args.file, args.episodes, args.deployed, args.report, args.card)
    return 0 if good else 1
