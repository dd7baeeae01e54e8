"""Runs on every core come back in order, and so does what they raise."""

from __future__ import annotations

import math
import os

import pytest

from policies.spread import spread


def test_results_are_in_the_order_of_the_runs():
    assert list(spread(math.pow, [(2.0, k) for k in range(20)])) == [2.0**k for k in range(20)]


def test_runs_leave_this_process_where_there_is_more_than_one_core(monkeypatch):
    monkeypatch.setattr(os, "sched_getaffinity", lambda pid: {0, 1})
    assert os.getpid() not in list(spread(os.getpid, [(), ()]))
    monkeypatch.setattr(os, "sched_getaffinity", lambda pid: {0})
    assert list(spread(os.getpid, [(), ()])) == [os.getpid()] * 2


def test_what_a_run_raises_is_raised():
    with pytest.raises(ValueError, match="math domain"):
        list(spread(math.sqrt, [(1.0,), (-1.0,)]))
