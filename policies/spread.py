"""Independent runs on every core: a deployed run is one core's work, and a card needs hundreds."""

from __future__ import annotations

import itertools
import os
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from typing import Any, TypeVar

Result = TypeVar("Result")


def spread(call: Callable[..., Result], runs: Iterable[tuple[Any, ...]]) -> Iterator[Result]:
    """``call(*run)`` of every run, in their order, each in one of as many processes as there are cores.

    ``call`` is a function of a module. What one raises is raised here.
    """
    runs = list(runs)
    workers = min(len(os.sched_getaffinity(0)), len(runs))
    if workers <= 1:
        yield from itertools.starmap(call, runs)
        return
    with ProcessPoolExecutor(workers, get_context("spawn"), _one_thread) as pool:
        yield from pool.map(_called, itertools.repeat(call), runs)


def _called(call: Callable[..., Result], run: tuple[Any, ...]) -> Result:
    return call(*run)


def _one_thread() -> None:
    import torch

    torch.set_num_threads(1)  # small networks: more threads only wait for each other
