"""Benchmark: how much faster than real time ``sim2real deploy --clock lockstep`` runs, record and all."""

from __future__ import annotations

from collections.abc import Iterator
from time import perf_counter

from bench_table import Row, deploy
from bench_walk import standing

FACTOR = 5.0
SHORT, LONG = 5, 35  # s; the difference leaves out what starting costs
TURNS = 3


def rows() -> Iterator[Row]:
    """The best of a few turns: other programs only ever make it slower."""
    took = {SHORT: float("inf"), LONG: float("inf")}
    for _ in range(TURNS):
        for duration in took:
            start = perf_counter()
            deploy(*standing(duration), "--clock", "lockstep")
            took[duration] = min(took[duration], perf_counter() - start)
    speed = (LONG - SHORT) / (took[LONG] - took[SHORT])
    yield Row(
        "lockstep deploy: G1, 29 motors on 5 CAN buses, gate, policy, record",
        f"{speed:.1f} s simulated per second",
        "1 s per second in real time",
        f"{speed:.1f}x",
        f">= {FACTOR:g}x",
        speed >= FACTOR,
        {"seconds": took},
    )
