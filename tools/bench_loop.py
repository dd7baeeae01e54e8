"""Benchmark: wake-up lateness and late ticks of a whole run in real time, against a program that only sleeps.

Ours and the floor take turns, so that both meet the same machine: 60 s each, quiet and with every core kept busy by other
programs, with the tuning that the kernel permits and without any.
"""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterator
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import numpy as np
from bench_floor import Sleeper, hogs
from bench_table import Row, deploy, quantiles, slashed
from bench_walk import standing

from sim2real.recorder.reader import Reader
from sim2real.skills import Stage
from sim2real.types import Mode, Sim2realError

SECONDS, TURNS = 20, 3
FACTOR = 1.5
CPUS = sorted(os.sched_getaffinity(0))
# Topic: what, Hz, SCHED_FIFO priority, and the CPU it is pinned to, as sim2real/guardian.py and sim2real/pilot.py have it.
LOOPS = {"/tick": ("bus", 250.0, 80, CPUS[-1]), "/pilot": ("policy", 50.0, 70, CPUS[0])}


def rows() -> Iterator[Row]:
    """Every combination of load and tuning."""
    for load in ("quiet", "all cores busy"):
        for tuned in (True, False):
            try:
                yield from measure(load, tuned)
            except Sim2realError as error:
                yield Row(f"loops, {load}, {'tuned' if tuned else 'untuned'}", f"not measured: {error}")


def measure(load: str, tuned: bool) -> Iterator[Row]:
    """Ours and the floor in turns, under one load."""
    ours: dict[str, list[np.ndarray]] = {topic: [] for topic in LOOPS}
    floor: dict[str, list[np.ndarray]] = {topic: [] for topic in LOOPS}
    summaries = []
    with hogs(os.cpu_count() or 1) if load != "quiet" else nullcontext():
        for _ in range(TURNS):
            sleepers = {
                t: Sleeper(rate, SECONDS, priority if tuned else 0, cpu)
                for t, (_, rate, priority, cpu) in LOOPS.items()
            }
            for topic, sleeper in sleepers.items():
                floor[topic].append(sleeper.lateness())
            summary, lateness = run(tuned)
            summaries.append(summary)
            for topic in LOOPS:
                ours[topic].append(lateness[topic])
    words = f"{load}, {'tuned' if tuned else 'untuned'}"
    for topic, (name, rate, *_) in LOOPS.items():
        q, least = quantiles(np.concatenate(ours[topic])), quantiles(np.concatenate(floor[topic]))
        ratios = [a / b for a, b in zip(q, least, strict=True)]
        yield Row(
            f"{name} loop wake-up, {rate:g} Hz, {words}: p50 / p99 / p99.9",
            f"{slashed(q)} us",
            f"{slashed(least)} us {Sleeper.name}",
            f"{slashed(ratios, '.2f')}x",
            f"<= {FACTOR:g}x" if tuned else "",
            max(ratios) <= FACTOR if tuned else None,
            {"ours_us": q, "floor_us": least},
        )
    late, ticks = (sum(s[key] for s in summaries) for key in ("late_policy_ticks", "policy_ticks"))
    faults = [f for s in summaries for f in s["faults"]]
    yield Row(
        f"late policy ticks in {SECONDS * TURNS} s, {words}",
        f"{late} of {ticks}{', the gate answered with ' + ', '.join(faults) if faults else ''}",
        target="0" if tuned else "",
        met=late == 0 and not faults if tuned else None,
        figures={"late": late, "ticks": ticks, "bus_late": sum(s["late_ticks"] for s in summaries), "faults": faults},
    )


def run(tuned: bool) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """One run in real time: its summary, and the lateness (s) of each loop's ticks while it moved the robot."""
    with tempfile.TemporaryDirectory() as directory:
        path = Path(directory) / "run.mcap"
        summary = deploy(*standing(SECONDS), *([] if tuned else ["--untuned"]), record=path)
        tick, pilot = Reader(path)["/tick"], Reader(path)["/pilot"]
        if not len(pilot) or not (pilot["stage"] == Stage.RUN).any():
            raise Sim2realError(f"the robot never performed: {' '.join(summary['messages'][-1:])}")
        armed, performing = tick["mode"] == Mode.RUN, pilot["stage"] == Stage.RUN
        return summary, {"/tick": tick["timing.lateness"][armed], "/pilot": pilot["timing.lateness"][performing]}
