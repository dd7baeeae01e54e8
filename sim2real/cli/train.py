"""Train a policy in simulation. Resumes by itself; needs `pip install 'sim2real[train]'`."""

from __future__ import annotations

from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Literal

import tyro

from sim2real.options import MaybeCount, MaybeNewFolder, MaybePositive, MaybeSeed
from sim2real.types import Sim2realError


@dataclass(frozen=True)
class Args:
    """Train a policy in simulation: config, curve and checkpoints go to a folder, from which a second call resumes."""

    task: tyro.conf.Positional[str]
    """what to train: g1-basics, g1-down, g1-ball, g1-dribble or g1-pickup"""
    folder: MaybeNewFolder = None
    """where the run lives; default: runs/<task>"""
    samples: MaybePositive = None
    """policy ticks to learn from, over all robots; default: the task's own"""
    envs: MaybeCount = None
    """robots simulated at once"""
    threads: MaybeCount = None
    """threads of the physics; default: one a core"""
    device: Literal["cpu", "cuda"] | None = None
    """of the learner; the physics are the CPU's"""
    seed: MaybeSeed = None
    """of everything random"""
    start: Path | None = None
    """begin from the networks of this checkpoint (policies/g1/basics.pt, say) instead of from nothing"""
    practise: str | None = None
    """of a policy for ball skills, only this one: dribble_in_place, say"""
    variant: Literal["skillmimic", "no_cgr", "no_multiplication", "deepmimic", "amp"] | None = None
    """of the reward for ball skills"""


def main(argv: list[str]) -> int:
    args = tyro.cli(Args, args=argv, prog="sim2real train")
    folder = args.folder or Path("runs") / args.task
    given = {k: getattr(args, k) for k in ("samples", "envs", "threads", "device", "seed", "variant")}
    if args.practise:
        given["practise"] = (args.practise,)
    training_side("policies.train").train_command(
        args.task, folder, args.start, **{k: v for k, v in given.items() if v is not None}
    )
    return 0


def training_side(module: str):
    """A module of the training side. Raises Sim2realError where its dependencies are not installed."""
    try:
        return import_module(module)
    except ModuleNotFoundError as error:
        raise Sim2realError(
            f"{module}: needs '{error.name}', which is not installed; pip install 'sim2real[train]'"
        ) from None
