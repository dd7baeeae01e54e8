"""Other balls, one skill after another, what learning took, and the card that says all of it."""

from __future__ import annotations

import dataclasses
import json
from xml.etree import ElementTree

import numpy as np
import pytest
import torch

from policies.evaluate import Rate
from policies.skillmimic import tables
from policies.skillmimic.card import Evaluation, card, rule
from policies.skillmimic.config import TASKS
from policies.skillmimic.curves import learned, read, svg
from policies.skillmimic.evaluate import Result, performed
from policies.skillmimic.graph import PolicyGraph
from policies.skillmimic.tables import CELLS, fixed, pairs, sweep, switched
from sim2real.cli.eval import main
from sim2real.contract import Contract
from sim2real.policy import read_contract
from sim2real.types import Sim2realError

CONFIG = dataclasses.replace(
    TASKS["g1-ball"], skills=("hold", "carry", "catch"), clips=("hold_05", "carry_01", "catch_05"), threads=1
)

pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.fixture(scope="module")
def graph():
    return PolicyGraph(CONFIG).eval()


def still(env) -> torch.Tensor:
    return torch.zeros(env.num_envs, env.num_actions)


# Tables 2 and 3


def test_a_larger_ball_of_the_same_density_is_heavier():
    assert fixed("radius", 2.0) == {"ball_radius": 2.0, "ball_mass": 8.0}
    assert fixed("density", 3.0) == {"ball_mass": 3.0}
    assert fixed("restitution", 1.2)["ball_restitution"] == pytest.approx(0.96)
    assert max(tables.SWEEPS["restitution"]) * 0.8 < 1


def alike(what: str, factor: float) -> dict[str, np.ndarray]:
    return {name: np.full(3, x) for name, x in fixed(what, factor).items()}


def test_every_cell_has_its_own_balls_and_draws_the_rest(graph):
    seen = []

    def look(env):
        seen.append({n: env.random.drawn[n][:, 0].reshape(len(CELLS), 2).copy() for n in ("ball_radius", "ball_mass")})
        return still(env)

    found = sweep(graph, "hold", 2, 0.04, look)
    assert list(found) == [f"{what} x {factor:g}" for what, factor in CELLS]
    assert all(r.episodes == 2 and 0 <= r.survived <= 2 for r in found.values())
    radius, mass = (seen[0][n] for n in ("ball_radius", "ball_mass"))
    assert (radius[CELLS.index(("radius", 1.5))] == 1.5).all() and (mass[CELLS.index(("radius", 1.5))] == 1.5**3).all()
    heavy, dead = CELLS.index(("density", 4.0)), CELLS.index(("restitution", 0.6))
    assert (mass[heavy] == 4.0).all() and len(set(radius[heavy])) == 2
    assert len(set(mass[dead])) == 2 and (np.abs(mass[dead] - 1) < 0.2).all()


def test_a_swept_ball_is_the_same_in_every_robot_and_the_rest_differs(graph):
    seen = []

    def look(env):
        ball = env.model.geom("ball").id
        seen.append((env.random._fields["geom_size"][:, ball, 0].copy(), env.random.drawn["ball_mass"].copy()))
        return still(env)

    performed(graph, "hold", 3, 0.04, act=look, fixed=alike("density", 2.0))
    radius, mass = seen[0]
    assert (mass == 2.0).all() and len(np.unique(radius)) == 3
    performed(graph, "hold", 3, 0.04, act=look, fixed=alike("radius", 1.3))
    np.testing.assert_allclose(seen[-1][0], 1.3 * 0.09)


def test_pairs_hand_the_ball_from_both_hands_to_both_hands(graph):
    assert pairs(graph) == [("hold", "carry"), ("carry", "hold"), ("catch", "hold"), ("catch", "carry")]


def test_a_ball_that_is_bounced_comes_back_to_the_hands():
    bounce = dataclasses.replace(CONFIG, skills=("hold", "bounce"), clips=("hold_05", "bounce_01"))
    assert pairs(PolicyGraph(bounce)) == [("hold", "bounce"), ("bounce", "hold")]


def test_a_switch_is_told_once_and_judged_by_the_second_skill(graph, monkeypatch):
    monkeypatch.setattr(tables, "FIRST", 0.1)
    monkeypatch.setattr(tables, "SECOND", 0.3)
    told = []

    def look(env):
        walks = graph.walking(env.inputs["command_velocity"])[:, 0].tolist()
        told.append((env.inputs["skill"].argmax(dim=1).tolist(), env.row.tolist(), walks))
        return still(env)

    shares = switched(graph, "hold", "carry", 4, look)
    assert [skills for skills, _, _ in told] == [[0] * 4] * 5 + [[1] * 4] * 15
    assert told[5][1] == [0] * 4 and told[6][1] == [4] * 4
    assert not any(told[4][2]) and any(told[5][2]), "who is to carry is told where to"
    assert told[5][2] == told[-1][2]
    assert len(shares) == 4 and set(shares) <= {0.0, 1.0} and shares.mean() >= 0.5


def test_a_robot_that_failed_before_the_switch_is_not_counted(graph, monkeypatch):
    monkeypatch.setattr(tables, "FIRST", 0.1)
    monkeypatch.setattr(tables, "SECOND", 0.1)

    def steal(env):
        if env.skill[0, 0] and env.episode_length_buf[1] == 2:
            env._qpos[1, -7] += 2.0  # the ball
        return still(env)

    assert len(switched(graph, "hold", "carry", 3, steal)) == 2


# curves


def run(folder, rows):
    folder.mkdir()
    (folder / "curve.jsonl").write_text("".join(json.dumps(r) + "\n" for r in rows))
    return folder


def test_runs_one_after_another_are_one_curve(tmp_path):
    one = run(tmp_path / "one", [
        {"samples": 1e6, "cpu": 1800.0}, {"samples": 2e6, "cpu": 1800.0, "success_hold": 0.5, "success_pass": 0.1},
    ])  # fmt: skip
    two = run(tmp_path / "two", [{"samples": 3e6, "cpu": 3600.0, "success_hold": 0.96, "success_pass": 0.2}])
    curve = read([one, two])
    assert curve.samples.tolist() == [2e6, 5e6] and curve.hours.tolist() == [1.0, 2.0]
    text = learned(curve, {"hold": 0.95, "pass": 0.85})
    assert "| `hold` | 5 M samples (1/130 of the paper's), 2.00 CPU-hours | 96%" in text
    assert "| `pass` | not yet | 20% after" in text
    drawing = ElementTree.fromstring(svg(curve))
    lines = [e for e in drawing.iter("{http://www.w3.org/2000/svg}path") if e.get("class", "").startswith("s")]
    assert len(lines) == 2 and "pass" in "".join(drawing.itertext())


def test_a_run_that_did_not_count_its_seconds_says_nothing_of_hours(tmp_path):
    old = run(tmp_path / "old", [{"samples": 1e6, "success_hold": 1.0}])
    assert "hours" not in learned(read([old]), {})


def test_a_folder_without_a_curve_is_named(tmp_path):
    with pytest.raises(Sim2realError, match="no curve.jsonl"):
        read([tmp_path])
    with pytest.raises(Sim2realError, match="no evaluation yet"):
        read([run(tmp_path / "new", [{"samples": 1.0}])])


# the card


def contract() -> Contract:
    from sim2real.contract import Object, Skill

    found = read_contract("policies/g1/basics.onnx")
    return found.model_copy(update={"name": "ball", "skills": [Skill(label=n) for n in ("hold", "pass")],
                                    "default_skill": "hold", "object": Object(radius=0.09, mass=0.62, restitution=0.8)})  # fmt: skip


def results(hold: int, passed: int) -> dict[str, Result]:
    return {
        "hold": Result(Rate(hold, 100), 0.9, 0.02, 0.03, 0.01),
        "pass": Result(Rate(passed, 100), 0.5, 0.1, 0.2, 0.3),
    }


def test_the_card_says_what_a_success_is_and_which_target_is_met(tmp_path):
    e = Evaluation("abc", {"training": results(97, 90), "truth": results(96, 85), "camera": results(95, 84)})
    text = card(contract(), e)
    assert "`hold`: Nothing failed: the robot stands" in text and "1.5 m/s" in rule("pass")
    assert "Target 95% through the bytes with a camera, and at most 5 points lost on the way there: met (+2.0" in text
    assert "**missed** (+6.0 points)" in text
    assert "95.0% (88.8% to 97.8%, 100 episodes)" in text
    assert "Table" not in text and "What it took" not in text and "capture" not in text
    captured = Evaluation("abc", {**e.results, "capture": results(94, 80)})
    assert "| `hold` | bytes, by motion capture | 94.0%" in card(contract(), captured)


def test_the_card_has_tables_curve_and_films_if_they_were_made(tmp_path):
    ways = {way: results(97, 90) for way in ("training", "truth", "camera")}
    sweeps = {label: {"radius x 0.5": Rate(1, 4), "density x 4": Rate(3, 4)} for label in ("hold", "pass")}
    e = Evaluation("abc", ways, sweeps, {"hold > pass": Rate(2, 4)})
    curve = read([run(tmp_path / "run", [{"samples": 1e6, "success_hold": 0.5, "success_pass": 0.1}])])
    text = card(contract(), e, curve, {"hold": "../hold.gif", "curve": "ball.svg"})
    assert "| `hold` | 25% | 75% |" in text and "| `hold > pass` | 50.0%" in text
    assert "![hold](../hold.gif)" in text and "![pass]" not in text and "(ball.svg)" in text
    document = json.loads(json.dumps(e.as_dict()))
    assert document["switches"]["hold > pass"]["survived"] == 2 and len(document["sweeps"]["pass"]) == 2


def test_tables_of_a_policy_without_a_ball_are_refused():
    with pytest.raises(Sim2realError, match="--tables: belongs to ball skills"):
        main(["policies/g1/basics.onnx", "--tables"])
