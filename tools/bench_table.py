"""What the benchmarks share: a row of the table, and timing in interleaved blocks."""

from __future__ import annotations

import gc
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterable
from pathlib import Path
from time import perf_counter
from typing import Any, NamedTuple

import numpy as np
from rich.table import Table

from sim2real.types import Sim2realError

ROOT = Path(__file__).resolve().parents[1]
QUANTILES = (50, 99, 99.9)  # per cent


class Row(NamedTuple):
    """One line: our figure, that of the floor or the incumbent measured in the same run, and the target."""

    what: str
    ours: str
    beside: str = ""  # the floor or the incumbent, with its name
    ratio: str = ""
    target: str = ""
    met: bool | None = None  # None: no target, or not measured
    figures: dict[str, Any] = {}  # the numbers behind the words, for bench.json


def interleaved(
    functions: dict[str, Callable[[], object]], blocks: int = 101, length: float = 4e-3
) -> dict[str, float]:
    """Least seconds per call of each function, of many turns of ``length`` seconds: others only ever make it slower."""
    calls = {}
    for name, function in functions.items():
        function()  # warm
        start = perf_counter()
        function()
        calls[name] = max(1, int(length / max(perf_counter() - start, 1e-9)))
    times: dict[str, list[float]] = {name: [] for name in functions}
    gc.disable()
    try:
        for block in range(blocks):
            for name in sorted(functions, reverse=bool(block % 2)):
                function, n = functions[name], calls[name]
                start = perf_counter()
                for _ in range(n):
                    function()
                times[name].append((perf_counter() - start) / n)
    finally:
        gc.enable()
    return {name: min(t) for name, t in times.items()}


def quantiles(seconds: np.ndarray) -> list[float]:
    """p50, p99 and p99.9 in microseconds."""
    return [float(q) for q in np.percentile(seconds * 1e6, QUANTILES)]


def slashed(numbers: Iterable[float], form: str = ".0f") -> str:
    """``36 / 84 / 203``."""
    return " / ".join(format(n, form) for n in numbers)


def sim2real(*argv: object) -> subprocess.CompletedProcess[str]:
    """Run the program as a user would. Raises Sim2realError with its last words where it refuses or breaks."""
    program = "import sys; from sim2real.cli import main; sys.exit(main())"
    command = [sys.executable, "-c", program, *map(str, argv)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, env={**os.environ, "NO_COLOR": "1"})
    if done.returncode not in (0, 1) or "Traceback" in done.stderr:
        raise Sim2realError(f"sim2real {argv[0]}: {' '.join((done.stderr or done.stdout).split())[-400:]}")
    return done


def deploy(*argv: object, robot: str = "g1", record: Path | None = None) -> dict[str, Any]:
    """Run ``sim2real deploy`` and return its summary. The record is kept only where ``record`` says."""
    with tempfile.TemporaryDirectory() as directory:
        summary = Path(directory) / "summary.json"
        record = record or Path(directory) / "run.mcap"
        sim2real("deploy", "--robot", robot, "--json", summary, "--record", record, *argv)
        return json.loads(summary.read_text())


def table(rows: list[Row], title: str) -> Table:
    """The rows as a rich table."""
    out = Table("what", "ours", "floor or incumbent", "ratio", "target", "met", title=title, title_justify="left")
    words = {True: "[green]yes[/]", False: "[red]no[/]", None: "-"}
    for row in rows:
        out.add_row(row.what, row.ours, row.beside, row.ratio, row.target, words[row.met])
    return out
