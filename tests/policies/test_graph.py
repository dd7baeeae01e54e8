"""The policy graph's fixed parts: reflexes, clipping, and that targets never leave the joints' ranges."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from policies.basics import MOTIONS, Basics, down
from policies.graph import PolicyGraph, one_hot
from policies.observations import Signals, gravity_in_base, pitched
from sim2real.config import load_robot

GRAPH = PolicyGraph(Basics())
JOINTS = len(GRAPH.joint_names)


def standing(pitch: float = 0.0, pitch_rate: float = 0.0, label: str = "stand", phase: float = 0.0) -> Signals:
    """One robot at its reference, leaning by ``pitch`` rad and ``pitch_rate`` rad/s."""
    skill = one_hot([list(MOTIONS).index(label)], len(MOTIONS))
    pose = GRAPH.references.goal(skill, torch.tensor([[phase]]))
    gravity = torch.tensor([[np.sin(pitch), 0.0, -np.cos(pitch)]], dtype=torch.float32)
    return Signals(pose, torch.zeros(1, JOINTS), gravity, torch.tensor([[0.0, pitch_rate, 0.0]]), skill, GRAPH.home,
                   torch.tensor([[phase]]), pose, torch.zeros(1, 3), torch.zeros(1, 1), torch.zeros(1, 2), pose,
                   torch.zeros(1, len(GRAPH.driven)))  # fmt: skip


def reflex(joint: str, **lean: float | str) -> float:
    return GRAPH.balance(standing(**lean))[0, GRAPH.joint_names.index(joint)].item()  # type: ignore[arg-type]


def test_upright_only_the_ankles_know_of_balance():
    offsets = GRAPH.balance(standing())[0]
    ankles = [k for k, name in enumerate(GRAPH.joint_names) if "ankle_pitch" in name]
    assert set(torch.nonzero(offsets).flatten().tolist()) == set(ankles)
    torch.testing.assert_close(offsets[ankles], torch.full((2,), GRAPH.config.balance_offset))


def test_a_pitch_that_the_pose_asks_for_is_none_to_balance_against():
    pose = torch.tensor(down(GRAPH.joint_names, np.ones(1)), dtype=torch.float32)
    pitch = float(GRAPH.gait.pitch(pose))
    assert 0.5 < pitch < 0.7
    turned = torch.tensor([[np.cos(pitch / 2), 0.0, np.sin(pitch / 2), 0.0]])
    np.testing.assert_allclose(pitched(gravity_in_base(turned), torch.tensor([[pitch]])), [[0.0, 0.0, -1.0]], atol=1e-6)


def test_only_who_goes_down_to_the_floor_bows():
    """Joints that go into a squat or rise from it at one rate each pass no level pose on the way, and that is meant as none."""
    goes_down = PolicyGraph(Basics(down=0.5))
    squat = GRAPH.references.goal(standing(label="squat").skill, torch.tensor([[0.5]]))
    sinking, rising = (a + torch.clamp(b - a, -0.6, 0.6) for a, b in ((GRAPH.home, squat), (squat, GRAPH.home)))
    assert goes_down.pitch(sinking) > 0.3 > -0.3 > goes_down.pitch(rising)
    assert GRAPH.pitch(sinking) == GRAPH.pitch(rising) == 0
    at_rest = standing()._replace(posture=sinking)
    torch.testing.assert_close(GRAPH.balance(at_rest), GRAPH.balance(standing()))
    assert (goes_down.balance(at_rest) - GRAPH.balance(at_rest)).abs().max() > 0.01


def test_ankles_push_against_pitch_and_pitch_rate():
    assert reflex("left_ankle_pitch_joint", pitch=0.05) > reflex("left_ankle_pitch_joint") + 0.1
    assert reflex("left_ankle_pitch_joint", pitch=-0.05) < reflex("left_ankle_pitch_joint") - 0.1
    assert reflex("left_ankle_pitch_joint", pitch_rate=0.5) > reflex("left_ankle_pitch_joint") + 0.1


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
    broken = signals._replace(gravity_in_base=torch.full((1, 3), torch.nan))
    assert torch.isnan(GRAPH.target(broken, torch.zeros(1, len(GRAPH.driven)))).any()
