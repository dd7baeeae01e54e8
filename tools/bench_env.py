"""Benchmark: what the ball skills' training environment costs beyond stepping the physics of the same robots."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from time import perf_counter
from typing import Any

import numpy as np
from bench_table import Row

BEYOND = 0.25
TICKS, WARM = 100, 20


class Timed:
    """A batch whose physics is timed."""

    def __init__(self, batch: Any) -> None:
        self._batch, self.took = batch, 0.0

    def rollout(self, *args: Any, **settings: Any) -> Any:
        start = perf_counter()
        result = self._batch.rollout(*args, **settings)
        self.took += perf_counter() - start
        return result

    def __getattr__(self, name: str) -> Any:
        return getattr(self._batch, name)


def rows() -> Iterator[Row]:
    """Every tick of the environment, with the base policy in it and no actor's network, and the physics inside it."""
    try:
        import torch

        from policies.skillmimic.config import TASKS
        from policies.skillmimic.env import Env
    except ModuleNotFoundError as error:
        yield Row("training environment", f"not measured: needs '{error.name}'; pip install 'sim2real[train]'")
        return
    torch.set_num_threads(1)
    env = Env(dataclasses.replace(TASKS["g1-ball"], threads=1), 1)
    idle = torch.zeros(env.num_envs, env.num_actions)
    env.batch = physics = Timed(env.batch)
    whole, raw = np.zeros((2, TICKS))
    for tick in range(-WARM, TICKS):
        physics.took, start = 0.0, perf_counter()
        env.step(idle)
        whole[tick], raw[tick] = perf_counter() - start, physics.took  # warming goes to the end, and is written over
    beyond = float(whole.sum() / raw.sum() - 1)
    yield Row(
        f"training environment, {env.num_envs} robots with a ball, one thread",
        f"{env.num_envs * TICKS / whole.sum():.0f} samples/s",
        f"{env.num_envs * TICKS / raw.sum():.0f} samples/s of physics alone",
        f"{beyond:+.0%}",
        f"<= {BEYOND:+.0%}",
        beyond <= BEYOND,
        {"whole": float(whole.sum()), "physics": float(raw.sum())},
    )
