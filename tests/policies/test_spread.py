"""Runs on every core come back in order, and so does what they raise."""

from __future__ import annotations

import io
import math
import os

import pytest
from rich.console import Console

from policies.spread import spread, telling


def test_results_are_in_the_order_of_the_runs():
    assert spread(math.pow, [(2.0, k) for k in range(20)]) == [2.0**k for k in range(20)]


def test_runs_leave_this_process_where_there_is_more_than_one_core(monkeypatch):
    monkeypatch.setattr(os, "sched_getaffinity", lambda pid: {0, 1})
    assert os.getpid() not in spread(os.getpid, [(), ()])
    monkeypatch.setattr(os, "sched_getaffinity", lambda pid: {0})
    assert spread(os.getpid, [(), ()]) == [os.getpid()] * 2


def test_what_a_run_raises_is_raised():
    with pytest.raises(ValueError, match="math domain"):
        spread(math.sqrt, [(1.0,), (-1.0,)])


@pytest.mark.parametrize("cores", [{0}, {0, 1}])
def test_whoever_watches_sees_each_result_or_run_as_it_comes(cores, monkeypatch):
    monkeypatch.setattr(os, "sched_getaffinity", lambda pid: cores)
    seen = []

    def over(things, total):
        for k, thing in enumerate(things):
            seen.append((k, total))
            yield thing

    assert spread(math.pow, [(2.0, 1), (2.0, 2), (2.0, 3)], over) == [2.0, 4.0, 8.0]
    assert seen == [(0, 3), (1, 3), (2, 3)]


def test_long_work_is_named_and_shows_how_far_it_is_and_how_long_it_takes():
    console = Console(file=io.StringIO(), force_terminal=True, width=80)
    over = telling(console)("ten things")
    assert list(over(range(10), 10)) == list(range(10))
    shown = console.file.getvalue()
    assert shown.startswith("\x1b[2mten things ") and "  0%" in shown and "100%" in shown and "0:00:00" in shown
