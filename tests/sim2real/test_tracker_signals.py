"""From sightings to what a policy is fed."""

from __future__ import annotations

import numpy as np
import pytest

from sim2real.contract import OBJECT, Contract
from sim2real.object.camera import CameraModel, SimCamera
from sim2real.records import state_view, tick_layout
from sim2real.skills import SkillPlayer, Stage
from sim2real.tracker import ObjectSample, ObjectTracker
from sim2real.types import Mode, OperatorInput, Sim2realError

TICK = 0.02
BALL, BASE, UPRIGHT = np.array([0.3, 0.1, 0.9]), np.array([0.0, 0.0, 0.78]), np.array([1.0, 0, 0, 0])


class Juggler:
    """A policy that wants to know where the ball is and stands still; ``seen`` is all it was fed."""

    path, sha256 = "juggler", ""

    def __init__(self, robot, sees=True, label="juggle", radius=0.09):
        n = len(robot.joint_names)
        self.seen: list[np.ndarray] = []
        self.target = robot.home_pos.astype(np.float32)
        row = {name: [[0.0] * 3] for name in (OBJECT if sees else ("angular_velocity_base_in_base",))}
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
                "object": {"radius": radius, "mass": 0.62, "restitution": 0.8} if sees else None,
                "skills": [{"label": label}],
                "default_skill": label,
                "golden": [{"steps": 1, "inputs": row, "outputs": {"joint_pos_target": [[0.0] * n]}}],
                "provenance": {"source": "test", "licence": "Apache-2.0"},
            }
        )

    def reset(self) -> None: ...

    def step(self, inputs):
        self.seen.append(np.concatenate(list(inputs.values())))
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


def test_a_player_makes_the_tracker_that_its_policies_need(robot):
    player = SkillPlayer(robot, [Juggler(robot)])
    assert player.tracker is not None and player.tracker.radius == 0.09
    assert SkillPlayer(robot, [Juggler(robot, sees=False)]).tracker is None


def test_two_objects_in_a_run_are_refused(robot):
    one, other = Juggler(robot), Juggler(robot, label="spin", radius=0.12)
    with pytest.raises(Sim2realError, match="radius=0.09.*radius=0.12.*expected one object"):
        SkillPlayer(robot, [one, other])


def test_a_policy_that_sees_an_object_says_which(robot):
    document = Juggler(robot).contract.model_dump()
    with pytest.raises(ValueError, match="object: missing, expected what object_position_in_base and"):
        Contract.model_validate(document | {"object": None})


def test_commands_tell_when_their_object_was_seen(robot):
    policy, tracker = Juggler(robot), ObjectTracker(0.09)
    player, state = SkillPlayer(robot, [policy], tracker), standing(robot)
    assert player.step(state, Mode.OFF, OperatorInput(0.0), 0.0).object_time == -np.inf
    tracker.measure(ObjectSample(0.0, BALL - BASE))
    for now in (0.1, 0.4):
        assert player.step(state, Mode.OFF, OperatorInput(now), now).object_time == pytest.approx(0.0)
    blind = SkillPlayer(robot, [Juggler(robot, sees=False)])
    assert blind.step(state, Mode.OFF, OperatorInput(0.0), 0.0).object_time == np.inf


def lose_the_ball(robot, policies):
    """Perform with a ball that is seen for the first 3 s; returns the player, and its label at every tick from there."""
    tracker = ObjectTracker(0.09)
    player, state, labels = SkillPlayer(robot, policies, tracker), standing(robot), []
    for k in range(180):
        now = k * TICK
        player.step(state, Mode.RUN, OperatorInput(now, "juggle"), now)
        if now < 3.0:
            tracker.measure(ObjectSample(now - 0.007, BALL - BASE))
        else:
            labels.append(player.labels[player.skill])
    return player, labels


def test_a_skill_gives_way_when_its_object_is_out_of_sight(robot):
    player, labels = lose_the_ball(robot, [Juggler(robot), Juggler(robot, sees=False, label="stand")])
    blind = 9  # ticks, with ages of 0.027 to 0.187 s: one more is beyond its patience
    assert labels == ["juggle"] * blind + ["stand"] * (len(labels) - blind)
    assert player.refusals == [("juggle", "its object is out of sight; 'stand' takes over")]
    assert player.command.object_time == np.inf


def test_a_skill_whose_object_is_out_of_sight_is_not_begun(robot):
    player, state = SkillPlayer(robot, [Juggler(robot, sees=False, label="stand"), Juggler(robot)]), standing(robot)
    for k in range(150):
        player.step(state, Mode.RUN, OperatorInput(k * TICK, "juggle" if k > 130 else None), k * TICK)
    assert player.labels[player.skill] == "stand"
    assert player.refusals[-1] == ("juggle", "its object is out of sight")


def test_without_anything_to_give_way_to_the_command_tells_the_gate(robot):
    player, labels = lose_the_ball(robot, [Juggler(robot)])
    assert set(labels) == {"juggle"}
    assert player.command.time - player.command.object_time > robot.safety.object_age
