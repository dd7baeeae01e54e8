"""The programs around a skill refuse what cannot be meant by name, before anything is done."""

from __future__ import annotations

import sys
import typing

import pytest

from policies.skillmimic import ablation, config, mixture, optimise, rewards, strokes

REFUSED = [
    (optimise, "g1-ball catch --each 0", "--each: got 0, expected a whole number, at least 1"),
    (optimise, "g1-ball catch --seconds nan", "--seconds: got nan, expected a number above 0"),
    (optimise, "g1-basics walk", "invalid choice 'g1-basics'"),
    (strokes, "policies/g1/ball.onnx --robots 0", "--robots: got 0, expected a whole number, at least 1"),
    (strokes, "policies/g1/ball.onnx --report .", "--report: got ., a folder, expected a file to write"),
    (ablation, "g1-ball hold --samples -1", "--samples: got -1, expected a number above 0"),
    (ablation, "g1-ball hold --seeds 1", "invalid choice '1'"),
    (mixture, "g1-ball --episodes 0", "--episodes: got 0, expected a whole number, at least 1"),
]


@pytest.mark.parametrize("program, line, message", REFUSED)
def test_what_cannot_be_meant_is_refused_by_name(program, line, message, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["program", *line.split()])
    with pytest.raises(SystemExit) as stopped:
        program.main()
    assert stopped.value.code == 2
    assert message in " ".join(capsys.readouterr().err.replace("│", " ").split())


@pytest.mark.parametrize("program, line", [(optimise, "g1-ball juggle"), (ablation, "g1-ball juggle")])
def test_a_skill_that_a_task_has_not_is_named(program, line, monkeypatch):
    monkeypatch.setattr(sys, "argv", ["program", *line.split()])
    with pytest.raises(SystemExit, match="skill: got 'juggle', expected one of hold, carry"):
        program.main()


def test_every_task_and_every_reward_of_the_paper_can_be_named():
    assert set(typing.get_args(config.Task)) == set(config.TASKS)
    (of_one, _) = typing.get_args(typing.get_type_hints(ablation.Args)["variants"])
    assert set(typing.get_args(of_one)) == set(rewards.VARIANTS) - {"bounces"}  # which is not the paper's
