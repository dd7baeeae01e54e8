"""The policy graph's fixed parts: reflexes, clipping, and that targets never leave the joints' ranges."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from policies.basics import MOTIONS, Basics
from policies.graph import PolicyGraph, one_hot
from policies.observations import Signals
from sim2real.config import load_robot

GRAPH = PolicyGraph(Basics())
JOINTS = len(GRAPH.joint_names)


def standing(pitch: float = 0.0, pitch_rate: float = 0.0, label: str = "stand", phase: float = 0.0) -> Signals:
    """One robot at its reference, leaning by ``pitch`` rad and ``pitch_rate`` rad/s."""
    skill = one_hot([list(MOTIONS).index(label)], len(MOTIONS))
    reference = GRAPH.references.goal(skill, torch.tensor([[phase]]))
    orientation = torch.tensor([[np.cos(pitch / 2), 0.0, np.sin(pitch / 2), 0.0]], dtype=torch.float32)
    return Signals(reference, torch.zeros(1, JOINTS), orientation, torch.tensor([[0.0, pitch_rate, 0.0]]), skill,
                   GRAPH.home, torch.tensor([[phase]]), reference, torch.zeros(1, len(GRAPH.driven)))  # fmt: skip


def reflex(joint: str, **lean: float | str) -> float:
    return GRAPH.balance(standing(**lean))[0, GRAPH.joint_names.index(joint)].item()  # type: ignore[arg-type]


def test_upright_only_the_ankles_know_of_balance():
    offsets = GRAPH.balance(standing())[0]
    ankles = [k for k, name in enumerate(GRAPH.joint_names) if "ankle_pitch" in name]
    assert set(torch.nonzero(offsets).flatten().tolist()) == set(ankles)
    torch.testing.assert_close(offsets[ankles], torch.full((2,), GRAPH.config.balance_offset))


def test_ankles_push_against_pitch_and_pitch_rate():
    assert reflex("left_ankle_pitch_joint", pitch=0.05) > reflex("left_ankle_pitch_joint") + 0.1
    assert reflex("left_ankle_pitch_joint", pitch=-0.05) < reflex("left_ankle_pitch_joint") - 0.1
    assert reflex("left_ankle_pitch_joint", pitch_rate=0.5) > reflex("left_ankle_pitch_joint") + 0.1


@pytest.mark.parametrize("side", ["left", "right"])
def test_arms_swing_once_the_capture_point_is_far_out(side):
    shoulder = f"{side}_shoulder_pitch_joint"
    config = GRAPH.config
    assert reflex(shoulder, pitch_rate=0.9 * config.swing_from * config.pendulum) == 0.0
    out = reflex(shoulder, pitch_rate=config.pendulum * (config.swing_from + 0.1))
    assert out == pytest.approx(0.1 * config.swing_gain, rel=0.01)
    assert reflex(shoulder, pitch_rate=-config.pendulum * (config.swing_from + 0.1)) == pytest.approx(-out, rel=0.01)


def test_raised_arms_do_not_swing():
    assert reflex("left_shoulder_pitch_joint", label="raise_arms", phase=0.5, pitch_rate=2.0) == 0.0


def test_a_tracking_error_of_the_legs_is_a_lean():
    signals = standing()
    error = torch.zeros(1, JOINTS)
    for side in ("left", "right"):
        error[0, GRAPH.joint_names.index(f"{side}_hip_pitch_joint")] = 0.2
    leaning = signals._replace(joint_pos=signals.joint_pos + error)
    arm = GRAPH.joint_names.index("left_shoulder_pitch_joint")
    expected = GRAPH.config.swing_gain * (0.2 - GRAPH.config.swing_from)
    assert GRAPH.balance(leaning)[0, arm].item() == pytest.approx(expected, rel=0.01)


@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_targets_stay_inside_the_gate_s_limits_whatever_the_action(sign):
    robot = load_robot("g1")
    margin = robot.safety.position_margin
    action = GRAPH.clip(torch.full((1, len(GRAPH.driven)), sign * 1e6))
    assert action.abs().max() == GRAPH.config.action_max
    target = GRAPH.target(standing(pitch=sign), action)[0].numpy()
    assert np.all(target >= robot.position_min + margin) and np.all(target <= robot.position_max - margin)


def test_gains_are_those_a_motor_can_be_told():
    robot = load_robot("g1")
    assert np.all(GRAPH.kp <= robot.kp_max) and np.all(GRAPH.kd <= np.minimum(robot.kd_max, 5.0))


def test_a_nan_in_goes_through_to_be_seen_by_the_gate():
    """Clipping must not turn a broken sensor into a plausible target."""
    signals = standing()
    broken = signals._replace(orientation_base_in_world=torch.full((1, 4), torch.nan))
    assert torch.isnan(GRAPH.target(broken, torch.zeros(1, len(GRAPH.driven)))).any()
