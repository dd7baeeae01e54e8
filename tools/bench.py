"""``make bench``: one table of our figures, each beside the floor or the incumbent of the same run. Fails on none."""

from __future__ import annotations

import importlib
import json
import os
import platform
from dataclasses import dataclass, field
from pathlib import Path

import tyro
from bench_table import Row, table
from rich.console import Console

from drivers.bus import BusError
from drivers.wire import WireError
from sim2real.types import Sim2realError

BENCHES = (
    "codec",
    "unitree",
    "dynamixel",
    "policy",
    "rate",
    "lockstep",
    "env",
    "walk",
    "loop",
)  # tools/bench_<name>.py, each with rows()


@dataclass
class Args:
    """Which benchmarks to run, and where to write the figures."""

    only: tyro.conf.Positional[tuple[str, ...]] = field(default=BENCHES)
    """Benchmarks to run: codec unitree dynamixel policy rate lockstep env walk loop."""
    json: Path = Path("runs/bench.json")
    """The same figures for a program to read."""


def main(args: Args) -> None:
    console = Console()
    console.width = max(console.width, 120)
    if strangers := set(args.only) - set(BENCHES):
        raise SystemExit(f"no benchmark {', '.join(sorted(strangers))}; there are {', '.join(BENCHES)}")
    rows: list[Row] = []
    for name in args.only:
        with console.status(f"measuring {name}"):
            rows += measured(name)
    machine = {"machine": platform.machine(), "cores": os.cpu_count(), "system": platform.system(),
               "kernel": platform.release(), "python": platform.python_version()}  # fmt: skip
    console.print(table(rows, f"bench: {', '.join(f'{k} {v}' for k, v in machine.items())}"))
    args.json.parent.mkdir(parents=True, exist_ok=True)
    args.json.write_text(json.dumps({**machine, "rows": [row._asdict() for row in rows]}, indent=2) + "\n")
    console.print(f"figures in {args.json}")


def measured(name: str) -> list[Row]:
    """The rows of one benchmark; what cannot be measured here is a row that says why."""
    rows = []
    try:
        for row in importlib.import_module(f"bench_{name}").rows():
            rows.append(row)
    except (Sim2realError, BusError, WireError, OSError) as error:
        rows.append(Row(name, f"not measured: {str(error).splitlines()[0]}"))
    return rows


if __name__ == "__main__":
    main(tyro.cli(Args, description=__doc__))
