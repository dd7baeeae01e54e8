"""The paper's Table 3: the same samples of every skill, alone and mixed, and what is trained is not trained again."""

from __future__ import annotations

import json
import sys

import pytest

from policies.evaluate import Rate
from policies.skillmimic import mixture
from policies.skillmimic.config import TASKS
from policies.skillmimic.evaluate import Result

SKILLS = len(TASKS["g1-ball"].skills)


def result(survived: int) -> Result:
    return Result(Rate(survived, 10), 0.5, 0.01, 0.1, 0.02)


def test_a_row_pools_the_episodes_of_all_seeds():
    text = mixture.table({"hold": {"alone": [result(2), result(4)], "all": [result(9), result(9)]}})
    assert "| `hold` | 30.0% (" in text and ", 20 episodes), Acc. 0.500, E_o 0.100 m | 90.0% (" in text


@pytest.mark.slow
def test_every_skill_sees_as_many_samples_alone_as_mixed(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(mixture, "FOLDER", tmp_path)
    monkeypatch.setattr(mixture, "SECONDS", 0.2)
    words = [
        "mixture",
        "g1-ball",
        "--samples",
        "1e4",
        "--seeds",
        "1",
        "--episodes",
        "2",
        "--report",
        str(tmp_path / "m.md"),
    ]
    monkeypatch.setattr(sys, "argv", words)
    mixture.main()
    out = capsys.readouterr().out
    assert out.count(", alone, seed 1:") == out.count(", all in one policy, seed 1:") == SKILLS
    assert "| `catch` |" in (tmp_path / "m.md").read_text()
    configs = {p.parent.name: json.loads(p.read_text())["config"] for p in tmp_path.glob("*/config.json")}
    assert configs["g1-ball-all-1"]["samples"] == SKILLS * configs["g1-ball-hold-1"]["samples"]
    assert configs["g1-ball-hold-1"]["practise"] == ["hold"] and not configs["g1-ball-all-1"]["practise"]
    before = {p: p.read_text() for p in tmp_path.glob("*/curve.jsonl")}
    mixture.main()
    assert {p: p.read_text() for p in tmp_path.glob("*/curve.jsonl")} == before and len(before) == SKILLS + 1
