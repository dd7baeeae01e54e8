"""The paper's Table 1: equal samples, one reward each, and honest intervals."""

from __future__ import annotations

import sys

import pytest

from policies.evaluate import Rate
from policies.skillmimic import ablation
from policies.skillmimic.config import TASKS
from policies.skillmimic.evaluate import Result
from policies.skillmimic.rewards import VARIANTS


def result(survived: int) -> Result:
    return Result(Rate(survived, 10), 0.5, 0.01, 0.1, 0.02)


@pytest.mark.parametrize("variant", list(VARIANTS))
def test_variants_differ_in_their_reward_alone(variant):
    config = ablation.config_of("g1-ball", "catch", variant, 2, 1e5)
    assert config.clips == ("catch_06",) and config.corrections is None and config.grip == 0 and config.samples == 1e5
    assert config.variant == variant and config.seed == 2
    assert config.sensitivity == ("deepmimic" if variant == "deepmimic" else TASKS["g1-ball"].sensitivity)


def test_the_interval_is_that_of_the_seeds_and_not_of_their_episodes():
    """0.2, 0.4, 0.6: mean 0.4, standard deviation 0.2, times 4.30 over the root of three."""
    mean, half = ablation.between([result(k) for k in (2, 4, 6)])
    assert mean == pytest.approx(0.4) and half == pytest.approx(4.30 * 0.2 / 3**0.5)
    assert "40% +- 50% (20%, 40%, 60%)" in ablation.table({"no_cgr": [result(k) for k in (2, 4, 6)]})


@pytest.mark.slow
def test_what_is_trained_is_evaluated_and_not_trained_again(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(ablation, "FOLDER", tmp_path)
    monkeypatch.setattr(ablation, "SECONDS", 0.2)
    words = ["ablation", "g1-ball", "hold", "--samples", "1e4", "--seeds", "2", "--episodes", "4", "--variants"]
    monkeypatch.setattr(sys, "argv", [*words, "skillmimic", "no_cgr"])
    ablation.main()
    first = capsys.readouterr().out
    assert first.count("seed") >= 4 and "| `no_cgr` | 17 |" in first
    curves = sorted(tmp_path.glob("*/curve.jsonl"))
    before = [c.read_text() for c in curves]
    assert [len(text.splitlines()) for text in before] == [1] * 4
    ablation.main()
    assert [c.read_text() for c in curves] == before and capsys.readouterr().out == first
