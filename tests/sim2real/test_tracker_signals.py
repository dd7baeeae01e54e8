"""From sightings to what a policy is fed."""

from __future__ import annotations

import numpy as np
import pytest

from sim2real.contract import Contract
from sim2real.object.camera import CameraModel, SimCamera
from sim2real.records import state_view, tick_layout
from sim2real.skills import SkillPlayer, Stage
from sim2real.tracker import ObjectTracker
from sim2real.types import Mode, OperatorInput, Sim2realError

TICK = 0.02
BALL, BASE, UPRIGHT = np.array([0.3, 0.1, 0.9]), np.array([0.0, 0.0, 0.78]), np.array([1.0, 0, 0, 0])


class Juggler:
    """A policy that wants to know where the ball is and stands still; ``seen`` is all it was fed."""

    path, sha256 = "juggler", ""

    def __init__(self, robot):
        n = len(robot.joint_names)
        self.seen: list[np.ndarray] = []
        self.target = robot.home_pos.astype(np.float32)
        row = {"object_position_in_base": [[0.0] * 3], "object_velocity_in_base": [[0.0] * 3]}
        names = list(robot.joint_names)
        self.contract = Contract.model_validate(
            {
                "name": "juggler",
                "robot": robot.name,
                "period": TICK,
                "joint_names": names,
                "target_joint_names": names,
                "default_joint_pos": robot.home_pos.tolist(),
                "kp": robot.home_kp.tolist(),
                "kd": robot.home_kd.tolist(),
                "inputs": {name: [3] for name in row},
                "outputs": {"joint_pos_target": [n]},
                "skills": [{"label": "juggle"}],
                "default_skill": "juggle",
                "golden": [{"steps": 1, "inputs": row, "outputs": {"joint_pos_target": [[0.0] * n]}}],
                "provenance": {"source": "test", "licence": "Apache-2.0"},
            }
        )

    def reset(self) -> None: ...

    def step(self, inputs):
        self.seen.append(np.concatenate([inputs["object_position_in_base"], inputs["object_velocity_in_base"]]))
        return {"joint_pos_target": self.target}


def standing(robot):
    state = state_view(tick_layout(robot.joint_names, ["b"]).new())
    state.joint_pos[:] = robot.home_pos
    state.orientation_base_in_world[:] = UPRIGHT
    return state


def test_a_policy_is_fed_what_the_tracker_knows(robot):
    policy, tracker = Juggler(robot), ObjectTracker(0.09)
    player, state, camera = SkillPlayer(robot, [policy], tracker), standing(robot), SimCamera(CameraModel(noise=0.0))
    for k in range(200):
        now = k * TICK
        camera.expose(now, BALL, BASE, UPRIGHT)
        for sample in camera.read(now):
            tracker.measure(sample)
        player.step(state, Mode.RUN, OperatorInput(now), now)
    assert player.stage == Stage.RUN and len(policy.seen) > 50
    np.testing.assert_allclose(policy.seen[-1][:3], BALL - BASE, atol=0.005)
    np.testing.assert_allclose(policy.seen[-1][3:], 0.0, atol=0.05)


def test_before_the_ball_was_seen_the_policy_is_not_asked(robot):
    policy, tracker = Juggler(robot), ObjectTracker(0.09)
    player, state = SkillPlayer(robot, [policy], tracker), standing(robot)
    for k in range(150):
        command = player.step(state, Mode.RUN, OperatorInput(k * TICK), k * TICK)
    assert player.stage == Stage.RUN and not policy.seen
    np.testing.assert_array_equal(command.joint_pos, robot.home_pos)


def test_without_a_tracker_the_policy_is_refused(robot):
    with pytest.raises(Sim2realError, match="juggler: needs object_position_in_base and object_velocity_in_base"):
        SkillPlayer(robot, [Juggler(robot)])
