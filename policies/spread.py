"""Independent runs on every core, watched: a deployed run is one core's work, and a card needs hundreds."""

from __future__ import annotations

import itertools
import os
from collections.abc import Callable, Iterable
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from typing import TYPE_CHECKING, Any, TypeVar

if TYPE_CHECKING:  # every worker imports this file, and none of them shows anything
    from rich.console import Console

Result = TypeVar("Result")
# Hands on things, of which there are so many, as they come; and says of what is done next, by a text, how to watch it.
Over = Callable[[Iterable[Any], int], Iterable[Any]]
Tell = Callable[[str], Over]


def unseen(things: Iterable[Any], total: int) -> Iterable[Any]:
    """Nobody watches."""
    return things


def telling(console: Console) -> Tell:
    """Prints what is done next, and shows how far that is and how long it will still take."""
    from rich.progress import track

    def tell(text: str) -> Over:
        console.print(f"[dim]{text} ...[/]")
        return lambda things, total: track(things, "", total, console=console, transient=True)

    return tell


def spread(call: Callable[..., Result], runs: Iterable[tuple[Any, ...]], over: Over = unseen) -> list[Result]:
    """``call(*run)`` of every run, in their order, each in one of as many processes as there are cores.

    ``call`` is a function of a module. What one raises is raised here.
    """
    runs = list(runs)
    workers = min(len(os.sched_getaffinity(0)), len(runs))
    if workers <= 1:
        return [call(*run) for run in over(runs, len(runs))]
    with ProcessPoolExecutor(workers, get_context("spawn"), _one_thread) as pool:
        return list(over(pool.map(_called, itertools.repeat(call), runs), len(runs)))


def _called(call: Callable[..., Result], run: tuple[Any, ...]) -> Result:
    return call(*run)


def _one_thread() -> None:
    import torch

    torch.set_num_threads(1)  # small networks: more threads only wait for each other
