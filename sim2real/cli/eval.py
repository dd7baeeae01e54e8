"""Measure how often a policy stays up: per skill, pushed, switching, and through the bytes."""

from __future__ import annotations

import os
from dataclasses import asdict, dataclass, field
from pathlib import Path

import tyro

from sim2real.cli.train import training_side
from sim2real.options import Count, MaybeNewFile, MaybeNewFolder


@dataclass(frozen=True)
class Args:
    """Measure how often a policy stays up: per skill, pushed, over every switch, and through the deployed loop.

    Exit status 0: at least 95 % of the undisturbed episodes survive, per skill, per switch and deployed; of ball skills, each
    meets its own target, and loses at most 5 points on its way through the bytes. 1: fewer.
    """

    file: tyro.conf.Positional[Path] = Path("policies/g1/basics.onnx")
    """policy file"""
    episodes: Count = 100
    """per skill; a fifth of it per switch, and per cell of --tables, there 25 at most"""
    deployed: Count = 40
    """runs through the bytes, undisturbed, and as many pushed; of ball skills, per skill, with the ball known and seen"""
    report: MaybeNewFile = None
    """write every number to this JSON file"""
    card: MaybeNewFile = None
    """write the policy's card to this Markdown file"""
    tables: bool = False
    """of ball skills: other balls and every switch too (the paper's Tables 2 and 3)"""
    capture: bool = False
    """of ball skills: through the bytes seen by motion capture too, and filmed so"""
    runs: tyro.conf.UseAppendAction[list[Path]] = field(default_factory=list)
    """of ball skills: the training runs that led to the file, in their order; what they learned when is in the card"""
    videos: MaybeNewFolder = None
    """of ball skills: film each into this folder, as the deployed loop performs it"""


def main(argv: list[str]) -> int:
    args = tyro.cli(Args, args=argv, prog="sim2real eval")
    if args.videos and not os.environ.get("DISPLAY"):
        os.environ.setdefault("MUJOCO_GL", "egl")  # MuJoCo looks at this once, when it is first imported
    given = asdict(args)
    good = training_side("policies.card").eval_command(card_file=given.pop("card"), **given)
    return 0 if good else 1
