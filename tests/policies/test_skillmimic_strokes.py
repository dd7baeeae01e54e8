"""Where a dribble loses its ball: bounces are found where they are, and a held base stays."""

from __future__ import annotations

import sys

import numpy as np
import pytest
from source import ROOT

from policies import ball
from policies.skillmimic import strokes
from policies.skillmimic.plan import GRAVITY
from policies.skillmimic.strokes import Bounces, bounces, table
from sim2real.simulation import Scene

TICK = 0.02  # s


def flown(speeds: list[float], ticks: int = 120) -> tuple[np.ndarray, np.ndarray]:
    """(ticks,) m and m/s of a ball that leaves the floor with ``speeds`` m/s, one after the other, and then lies."""
    lifted, rising = [0.5], [-1.0]
    for speed in speeds:
        t = np.arange(1, int(2 * speed / GRAVITY / TICK)) * TICK
        lifted += [ball.RADIUS, *(ball.RADIUS + speed * t - GRAVITY * t**2 / 2)]
        rising += [-0.1, *(speed - GRAVITY * t)]
    rest = ticks - len(lifted)
    return np.array(lifted + [ball.RADIUS] * rest), np.array(rising + [0.0] * rest)


def test_a_bounce_has_the_speed_with_which_the_ball_left_the_floor():
    lifted, rising = (x[:, None] for x in flown([4.0, 3.0]))
    off = np.linspace(0.0, 0.3, len(lifted))[:, None]
    found = bounces(lifted, rising, off, np.full(lifted.shape, True))
    assert found.speed[:2, 0] == pytest.approx([4.0, 3.0])
    assert np.isnan(found.speed[2:]).all()
    assert 0.0 < found.off[0, 0] < found.off[1, 0] < 0.3


def test_what_comes_after_a_failure_does_not_count():
    lifted, rising = (x[:, None] for x in flown([4.0, 3.0]))
    up = np.arange(len(lifted))[:, None] < 20
    assert np.isfinite(bounces(lifted, rising, 0 * lifted, up).speed).sum() == 1


def test_a_ball_that_turns_in_a_hand_has_not_bounced():
    lifted, rising = (x[:, None] for x in flown([4.0]))
    assert np.isnan(bounces(lifted + 0.5, rising, 0 * lifted, np.full(lifted.shape, True)).speed).all()


def test_a_row_says_how_many_got_there_and_how():
    speed, off = np.full((strokes.SHOWN, 4), np.nan), np.full((strokes.SHOWN, 4), np.nan)
    speed[0], off[0] = 3.5, 0.1
    speed[1, 0], off[1, 0] = 3.0, 0.2
    text = table({"here": Bounces(speed, off)}, 4.0)
    assert "| here | 1 | 100% | -0.50 +- 0.00 | +0.10 +- 0.00 |" in text
    assert "| here | 2 | 25% | -1.00 +- 0.00 | +0.20 +- 0.00 |" in text
    assert "| here | 3 |" not in text


def test_a_skill_that_the_policy_has_not_is_named(monkeypatch):
    words = ["strokes", str(ROOT / "policies/g1/pickup.onnx"), "--skill", "juggle"]
    monkeypatch.setattr(sys, "argv", words)
    with pytest.raises(SystemExit, match="skill: got 'juggle', expected one of pickup"):
        strokes.main()


@pytest.mark.slow
def test_the_shipped_dribble_is_told_bounce_by_bounce(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(strokes, "SECONDS", 0.6)
    monkeypatch.setattr(
        strokes, "CASES", {n: strokes.CASES[n] for n in ("base held still", "nothing random, finer steps")}
    )
    report = tmp_path / "strokes.md"
    words = ["strokes", str(ROOT / "policies/g1/ball.onnx"), "--robots", "2", "--report", str(report)]
    monkeypatch.setattr(sys, "argv", words)
    strokes.main()
    out = capsys.readouterr().out
    assert "base held still: 1.0 bounces a robot" in out and "finer steps: 1.0 bounces a robot" in out
    assert report.read_text().count("| 1 | 100% |") == 2


def test_physics_in_finer_steps_are_those_of_the_deployed_worlds():
    assert strokes.FINE == Scene().timestep
    assert all(case.timestep in (0.0, strokes.FINE) for case in strokes.CASES.values())
