"""Train a policy in simulation. Resumes by itself; needs `pip install 'sim2real[train]'`."""

from __future__ import annotations

from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Literal

import tyro

from sim2real.types import Sim2realError


@dataclass(frozen=True)
class Args:
    """Train a policy in simulation: config, curve and checkpoints go to a folder, from which a second call resumes."""

    task: tyro.conf.Positional[Literal["g1-basics"]]
    """what to train"""
    folder: Path | None = None
    """where the run lives; default: runs/<task>"""
    samples: float | None = None
    """policy ticks to learn from, over all robots; default: the task's own"""
    envs: int | None = None
    """robots simulated at once"""
    threads: int | None = None
    """threads of the physics"""
    seed: int | None = None
    """of everything random"""
    start: Path | None = None
    """begin from the networks of this checkpoint (policies/g1/basics.pt, say) instead of from nothing"""
    export: Path | None = None
    """train no further: write the best checkpoint so far to this policy file (.onnx)"""


def main(argv: list[str]) -> int:
    args = tyro.cli(Args, args=argv, prog="sim2real train")
    folder = args.folder or Path("runs") / args.task
    if args.export:
        policy = training_side("policies.release").release(folder, args.export)
        print(
            f"{args.export}: {', '.join(policy.contract.skill_labels)}; golden error {policy.golden_error:.1e}\n"
            f"  sha256 {policy.sha256}\n  next: sim2real eval {args.export}"
        )
        return 0
    training_side("policies.train").train_command(
        folder=folder,
        start=args.start,
        **{k: getattr(args, k) for k in ("samples", "envs", "threads", "seed") if getattr(args, k) is not None},
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
