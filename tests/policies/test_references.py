"""References: continuous over any switch, inside the joint limits, and what the formulas say."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
import torch

from policies.basics import MOTIONS, Basics
from policies.graph import PolicyGraph, one_hot
from policies.references import Motion, References
from sim2real.config import load_robot

GRAPH = PolicyGraph(Basics())
LABELS = range(len(MOTIONS))


def poses(label: int, phases: np.ndarray) -> torch.Tensor:
    skill = one_hot([label] * len(phases), len(MOTIONS))
    return GRAPH.references.goal(skill, torch.tensor(phases, dtype=torch.float32)[:, None])


@pytest.mark.parametrize("label", LABELS)
def test_formulas_stay_inside_the_joint_limits_with_room_for_the_gate(label):
    robot = load_robot("g1")
    pose = poses(label, np.linspace(0, 1, 101)).numpy()
    margin = robot.safety.position_margin
    assert np.all(pose >= robot.position_min + margin) and np.all(pose <= robot.position_max - margin)


@pytest.mark.parametrize("label", LABELS)
def test_formulas_are_periodic(label):
    first, last = poses(label, np.array([0.0, 1.0]))
    torch.testing.assert_close(first, last)


def test_squat_keeps_the_feet_flat_and_the_pelvis_level():
    names = GRAPH.joint_names
    legs = [names.index(f"left_{j}_joint") for j in ("hip_pitch", "knee", "ankle_pitch")]
    total = poses(list(MOTIONS).index("squat"), np.linspace(0, 1, 21))[:, legs].sum(-1)
    torch.testing.assert_close(total, torch.zeros(21), atol=1e-6, rtol=0)


@pytest.mark.parametrize(("before", "after"), list(itertools.product(LABELS, LABELS)))
def test_a_switch_at_any_time_never_moves_the_reference_faster_than_its_rate(before, after):
    references, config = GRAPH.references, GRAPH.config
    phase, reference, last = torch.zeros(1, 1), GRAPH.home[None].clone(), torch.zeros(1, len(MOTIONS))
    switch = 37 + 13 * before  # somewhere inside the first motion
    for t in range(200):
        skill = one_hot([before if t < switch else after], len(MOTIONS))
        phase, moved = references.advance(skill, last, phase, reference)
        assert 0.0 <= phase.item() < 1.0
        assert (moved - reference).abs().max() <= config.reference_rate * config.period + 1e-6
        reference, last = moved, skill


def test_a_new_label_starts_at_phase_zero_and_an_old_one_goes_on():
    references = GRAPH.references
    squat, stand = one_hot([1], len(MOTIONS)), one_hot([0], len(MOTIONS))
    half, pose = torch.full((1, 1), 0.5), GRAPH.home[None]
    assert references.advance(squat, stand, half, pose)[0].item() == 0.0
    step = GRAPH.config.period / MOTIONS["squat"].period
    assert references.advance(squat, squat, half, pose)[0].item() == pytest.approx(0.5 + step, abs=1e-6)
    assert references.advance(squat, torch.zeros(1, len(MOTIONS)), half, pose)[0].item() == 0.0


def test_a_motion_that_names_a_stranger_is_refused():
    with pytest.raises(KeyError, match="elbow"):
        References(["knee"], [0.0], {"bend": Motion("", 1.0, lift={"elbow": 1.0})}, 0.02, 1.0, 1.0)
