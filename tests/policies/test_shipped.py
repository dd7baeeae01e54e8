"""The shipped policy: fits its robot, is what the training code makes, and its card is about this very file."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from policies.basics import MOTIONS, Basics
from policies.card import steps
from policies.evaluate import FileActor, random_script, run_episodes
from policies.through_bytes import deploy_episode, stayed_up
from sim2real.config import load_robot
from sim2real.operators.script import ScriptOperator, Step
from sim2real.policy import load_policy
from sim2real.simulation import Scene, Simulation

ROBOT = load_robot("g1")
FILE = Path(__file__).resolve().parents[2] / ROBOT.policies["basics"].file


def test_fits_its_robot_and_performs_the_motions():
    policy = load_policy(FILE, ROBOT)
    assert policy.contract.skill_labels == tuple(MOTIONS)
    assert list(policy.contract.kp) == ROBOT.home_kp.tolist() and list(policy.contract.kd) == ROBOT.home_kd.tolist()


def test_was_made_with_the_settings_in_the_repository():
    """FileActor refuses a file whose targets are not those of policies/basics.py; and for a second nobody falls."""
    script = random_script(Basics(), len(MOTIONS), 4, 1.0, every=0.3)
    assert run_episodes(Basics(), FileActor(FILE, 4), script).survived.all()


def test_the_card_is_about_this_file():
    digest = load_policy(FILE, trial=0).sha256
    report = json.loads(FILE.with_suffix(".json").read_text())
    assert digest in FILE.with_suffix(".md").read_text() and report["sha256"] == digest
    assert set(report["calm"]) == set(MOTIONS) and len(report["switches"]) == len(MOTIONS) * (len(MOTIONS) - 1)


@pytest.mark.parametrize("name", ["ball", "dribble", "pickup"])
def test_the_cards_of_ball_skills_are_about_their_files(name):
    file = FILE.with_name(f"{name}.onnx")
    policy, report = load_policy(file, trial=0), json.loads(file.with_suffix(".json").read_text())
    assert policy.sha256 in file.with_suffix(".md").read_text() and report["sha256"] == policy.sha256
    assert set(report["camera"]) == set(report["training"]) == set(policy.contract.skill_labels)


@pytest.mark.slow
def test_a_ball_is_thrown_another_is_picked_up_and_held_through_the_bytes():
    policies = [load_policy(FILE.with_name(f"{name}.onnx"), ROBOT, trial=0) for name in ("ball", "pickup")]
    (pickup,) = policies[1].contract.skills
    dwell = pickup.dwell
    assert pickup.description == "pickup, by formula" and dwell > 7  # no other skill begins from down there
    seen = []
    script = [Step("hold", 2.0), Step("pass", 4.0), Step("pickup", 1.0), Step("hold", dwell + 1.0)]
    run = Simulation(
        ROBOT, policies, ScriptOperator(script), Scene(), each_tick=lambda s: seen.append((s.since, s.world.truth()))
    )
    summary = run.run()
    height = np.array([t.position_object_in_world[2] for _, t in seen])
    base = np.array([t.position_base_in_world[2] for _, t in seen])
    assert not summary.fell and not summary.faults, summary
    going = [k for k, (since, _) in enumerate(seen) if since < sum(step.duration for step in script) - 0.1]
    lowest = base[going].argmin()
    assert base[lowest] < 0.4 and height[lowest] < 0.12
    held = seen[going[-1]][1]
    assert np.linalg.norm(held.position_object_in_world - held.position_base_in_world) < 0.4


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1000, 1001])
def test_random_skills_through_the_bytes(seed):
    row = random_script(Basics(), len(MOTIONS), 1, 10.0, seed=seed)[0]
    summary = deploy_episode(FILE, Basics(), steps(row, list(MOTIONS), Basics().period), seed=seed)
    assert stayed_up(summary, 10.0), summary
