"""Long work in parts: watched, and after an interruption nothing that was done is done again."""

from __future__ import annotations

import io
import math
import os
from typing import NamedTuple

import numpy as np
import pytest
from rich.console import Console

from policies import parts as module
from policies.evaluate import Rate
from policies.parts import Array, Parts, kept, unseen

CALLS: list[float] = []


class Found(NamedTuple):
    rate: Rate
    values: Array
    name: str = ""


def half(x: float) -> float:
    CALLS.append(x)
    if x < 0:
        raise KeyboardInterrupt
    return x / 2


def found(rate: float, over: module.Over = unseen) -> Found:
    CALLS.append(rate)
    return Found(Rate(3, 4), np.array([sum(over(range(3), 3)), math.nan, 0.1 + 0.2]), "x")


@pytest.fixture(autouse=True)
def here(tmp_path, monkeypatch):
    """One core, so that calls are seen; in a folder of its own."""
    CALLS.clear()
    monkeypatch.setattr(os, "sched_getaffinity", lambda pid: {0})
    monkeypatch.chdir(tmp_path)
    return tmp_path


def console() -> Console:
    return Console(file=io.StringIO(), force_terminal=True, color_system=None, width=120)


def interrupted(*of: object) -> str:
    shown = console()
    with pytest.raises(KeyboardInterrupt), kept(shown, "policy", *of) as parts:
        parts.once("first", found, 1.0)
        parts.each("second", half, [(2.0,), (4.0,), (-1.0,), (6.0,)])
    return shown.file.getvalue()


def finished(*of: object) -> tuple[Found, list[float], str]:
    shown = console()
    with kept(shown, "policy", *of) as parts:
        first = parts.once("first", found, 1.0)
        second = parts.each("second", half, [(2.0,), (4.0,), (5.0,), (6.0,)])
    return first, second, shown.file.getvalue()


def test_who_was_interrupted_goes_on_and_comes_to_the_same(here):
    assert "interrupted; the same command goes on from here" in interrupted("a")
    assert CALLS == [1.0, 2.0, 4.0, -1.0]
    CALLS.clear()
    first, second, shown = finished("a")
    assert CALLS == [5.0, 6.0] and second == [1.0, 2.0, 2.5, 3.0]
    assert "3 results of an evaluation that was interrupted; it goes on from there" in shown
    assert first.rate == Rate(3, 4) and isinstance(first.rate, Rate) and first.name == "x"
    assert first.values[0] == 3 and math.isnan(first.values[1]) and first.values[2] == 0.1 + 0.2


def test_nothing_is_kept_of_what_is_done(here):
    interrupted("a")
    assert len(list(here.rglob("*.jsonl"))) == 1
    finished("a")
    assert not list(here.rglob("*.jsonl"))


def test_what_raises_leaves_what_was_done(here):
    with pytest.raises(ValueError, match="math domain"), kept(console(), "policy") as parts:
        parts.each("logarithms", _log, [(1.0,), (0.0,)])
    assert len(next(here.rglob("*.jsonl")).read_text().splitlines()) == 1


def _log(x: float) -> float:
    return math.log(x)


def test_other_work_and_other_code_begin_anew(here, monkeypatch):
    interrupted("a", 100)
    CALLS.clear()
    interrupted("a", 200)
    assert CALLS == [1.0, 2.0, 4.0, -1.0]
    CALLS.clear()
    monkeypatch.setattr(module, "_code", lambda: b"other")
    interrupted("a", 100)
    assert CALLS == [1.0, 2.0, 4.0, -1.0]


def test_every_file_that_decides_a_result_is_in_the_fingerprint(here, monkeypatch):
    monkeypatch.setattr(module, "ROOT", here)
    (here / "policies/g1").mkdir(parents=True)
    seen = {module._code()}
    for change in ("policies/a.py", "policies/g1/plan.yaml"):
        for text in ("1", "2"):
            (here / change).write_text(text)
            seen.add(module._code())
    assert len(seen) == 5
    (here / "policies/g1/card.md").write_text("words")
    assert module._code() in seen


def test_a_torn_line_is_done_again(here):
    interrupted("a")
    file = next(here.rglob("*.jsonl"))
    file.write_text(file.read_text()[:-4])
    CALLS.clear()
    interrupted("a")
    assert CALLS == [4.0, -1.0]
    CALLS.clear()
    assert finished("a")[1] == [1.0, 2.0, 2.5, 3.0]
    assert CALLS == [5.0, 6.0]


def test_long_work_is_named_and_shows_how_far_it_is_and_how_long_it_takes():
    shown = console()
    parts = Parts(shown)
    assert parts.each("ten halves", half, [(float(k),) for k in range(10)]) == [k / 2 for k in range(10)]
    assert parts.once("a sum", found, 1.0).values[0] == 3
    text = shown.file.getvalue()
    assert text.startswith("ten halves ...") and text.count("  0%") >= 2 and text.count("100%") >= 2
    assert "0:00:00" in text and "a sum" in text


def test_nothing_is_shown_or_kept_unless_asked_for(here):
    assert Parts().each("halves", half, [(2.0,)]) == [1.0]
    assert not list(here.iterdir())
