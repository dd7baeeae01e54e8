"""The shipped policy: fits its robot, is what the training code makes, and its card is about this very file."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from policies.basics import MOTIONS, Basics
from policies.card import steps
from policies.evaluate import FileActor, random_script, run_episodes
from policies.through_bytes import deploy_episode, stayed_up
from sim2real.config import load_robot
from sim2real.policy import load_policy

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


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1000, 1001])
def test_random_skills_through_the_bytes(seed):
    row = random_script(Basics(), len(MOTIONS), 1, 10.0, seed=seed)[0]
    summary = deploy_episode(FILE, Basics(), steps(row, list(MOTIONS), Basics().period), seed=seed)
    assert stayed_up(summary, 10.0), summary
