"""Write the policy of a training run to one file that this and other runtimes can load."""

from __future__ import annotations

import importlib
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from sim2real.options import NewFile
from sim2real.types import Sim2realError


@dataclass(frozen=True)
class Args:
    """Write the policy of a training run to one file: graph, contract and golden sequences, proved before it replaces
    what was there. Needs `pip install 'sim2real[train]'`."""

    checkpoint: tyro.conf.Positional[Path]  # folder of the run (its best.pt), or one of its .pt files
    output: Annotated[NewFile, tyro.conf.arg(aliases=["-o"])]  # policy file to write (.onnx)


def main(argv: list[str]) -> int:
    args = tyro.cli(Args, args=argv, prog="sim2real export")
    given = args.checkpoint
    run, name = (given.parent, given.name) if given.is_file() else (given, "best.pt")
    if not (run / name).is_file() or not (run / "config.json").is_file():
        raise Sim2realError(
            f"{given}: got no {name} with a config.json beside it, expected the folder of a run or a"
            " checkpoint in it; train one first: sim2real train g1-basics"
        )
    try:
        # The runtime does not import the packages above it: this command hands over to one.
        release = importlib.import_module("policies.release").release
    except ModuleNotFoundError as error:
        raise Sim2realError(
            f"export: got no module '{error.name}', expected the training extra: pip install 'sim2real[train]'"
        ) from None
    policy = release(run, args.output, name)
    contract = policy.contract
    print(
        f"{args.output}: '{contract.name}' for {contract.robot}: {', '.join(contract.skill_labels)};"
        f" golden error {policy.golden_error:.1e}\n  sha256 {policy.sha256}\n"
        f"  next: sim2real check {args.output} --robot {contract.robot}"
    )
    return 0
