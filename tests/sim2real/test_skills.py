"""Skills: the soft start, guarded switches, blends, and what a policy is fed."""

from __future__ import annotations

import numpy as np
import pytest
import tiny_policy

from sim2real.policy import Policy, load_policy
from sim2real.records import state_view, tick_layout
from sim2real.skills import SkillPlayer, Stage
from sim2real.types import Mode, OperatorInput, RobotState, Sim2realError

TICK = 0.02


@pytest.fixture
def policy_of(tmp_path, robot):
    """A policy file with the contract changed as asked."""

    def make(name: str = "tiny", shift: float = 0.0, **changes) -> Policy:
        document = tiny_policy.document(robot) | {"name": name} | changes
        graph = tiny_policy.model(robot)
        return load_policy(tiny_policy.write(tmp_path / f"{name}.onnx", graph, document), trial=0)

    return make


def standing(robot, **values) -> RobotState:
    state = state_view(tick_layout(robot.joint_names, ["b"]).new())
    state.joint_pos[:] = robot.home_pos
    state.orientation_base_in_world[:] = (1, 0, 0, 0)
    for name, value in values.items():
        getattr(state, name)[:] = value
    return state


def wish(now, skill=None, velocity=(0.0, 0.0, 0.0)):
    return OperatorInput(now, skill, velocity)


def to_run(player, state, now=0.0):
    """Through the soft start. Returns the time."""
    while player.stage != Stage.RUN:
        player.step(state, Mode.RUN, wish(now), now)
        now += TICK
    return now


def test_until_armed_nothing_pulls(robot, policy_of):
    player = SkillPlayer(robot, [policy_of()])
    for mode in (Mode.OFF, Mode.DAMP):
        command = player.step(standing(robot), mode, wish(0.0), 0.0)
        assert player.stage == Stage.STANDBY
        assert (command.kp == 0).all()
        assert (command.kd == robot.damping).all()


def test_a_soft_start_begins_where_the_robot_is_and_ends_where_the_policy_starts(robot, policy_of):
    player = SkillPlayer(robot, [policy_of()])
    state = standing(robot, joint_pos=robot.home_pos + 0.3)
    first = player.step(state, Mode.RUN, wish(0.0), 0.0)
    np.testing.assert_allclose(first.joint_pos, robot.home_pos + 0.3)
    assert (first.kp == 0).all()
    now, before, gain = TICK, first.joint_pos.copy(), first.kp.copy()
    while player.stage == Stage.ENGAGE:
        command = player.step(state, Mode.RUN, wish(now), now)
        if player.stage == Stage.ENGAGE:
            assert (np.abs(command.joint_pos - before) < 0.3 * 1.6 * TICK / player.move_time).all()
            assert (command.kp >= gain - 1e-9).all()
            before, gain = command.joint_pos.copy(), command.kp.copy()
        now += TICK
    assert now == pytest.approx(player.engage_time, abs=2 * TICK)
    np.testing.assert_allclose(before, robot.home_pos, atol=1e-3)
    np.testing.assert_allclose(gain, robot.home_kp)


def test_a_stop_goes_back_to_standby_and_the_next_start_is_soft_again(robot, policy_of):
    player, state = SkillPlayer(robot, [policy_of()]), standing(robot)
    now = to_run(player, state)
    player.step(state, Mode.DAMP, wish(now), now)
    assert player.stage == Stage.STANDBY
    command = player.step(state, Mode.RUN, wish(now + TICK), now + TICK)
    assert player.stage == Stage.ENGAGE
    assert (command.kp == 0).all()


def skills(*rows):
    return {"skills": [{"label": r[0], **r[1]} for r in rows], "default_skill": rows[0][0]}


def test_switches_obey_transitions_and_dwell(robot, policy_of):
    rows = skills(("a", {"next": ["b"], "dwell": 0.5}), ("b", {"next": ["a"], "dwell": 0.5}), ("c", {}))
    player, state = SkillPlayer(robot, [policy_of(**rows)]), standing(robot)
    now = to_run(player, state)
    player.step(state, Mode.RUN, wish(now, "b"), now)  # nobody chose what it began with
    assert player.labels[player.skill] == "b" and not player.refusals
    for _ in range(5):  # asked five times, refused and told once
        player.step(state, Mode.RUN, wish(now, "a"), now)
        now += TICK
    assert player.labels[player.skill] == "b"
    assert [r.skill for r in player.refusals] == ["a"] and "0.5 s" in player.refusals[0].reason
    now += 0.5
    player.step(state, Mode.RUN, wish(now, "c"), now)
    assert "may only be followed by a" in player.refusals[-1].reason
    player.step(state, Mode.RUN, wish(now, "a"), now)
    assert player.labels[player.skill] == "a"
    player.step(state, Mode.RUN, wish(now, "nonsense"), now)
    assert "unknown label" in player.refusals[-1].reason and player.labels[player.skill] == "a"


VALUED = tiny_policy.TEXT.replace("carry_count_next) {{", "carry_count_next, float[1,2] skill_value) {{").replace(
    "    carry_count_next =", "    two = Constant <value = float[2] {{1.0, 1.0}}> ()\n"
    "    hip = ReduceMean <axes = [1], keepdims = 1> (joint_pos)\n    skill_value = Mul (hip, two)\n    carry_count_next ="
)  # fmt: skip


def test_a_switch_the_policy_does_not_trust_is_refused(tmp_path, robot):
    document = tiny_policy.document(robot) | skills(("a", {"dwell": 0.0}), ("b", {"value_min": 0.5}))
    document["outputs"]["skill_value"] = [2]
    file = tiny_policy.write(tmp_path / "valued.onnx", tiny_policy.model(robot, VALUED), document)
    player, state = SkillPlayer(robot, [load_policy(file, trial=0)]), standing(robot)
    now = to_run(player, state)
    for mean, granted in ((0.49, False), (0.51, True)):  # its value is the mean joint position
        state.joint_pos[:] = mean
        player.step(state, Mode.RUN, wish(now), now)
        player.step(state, Mode.RUN, wish(now, "b"), now)
        assert (player.labels[player.skill] == "b") is granted
    assert "expects 0.49" in player.refusals[0].reason


def test_between_two_policies_targets_blend_but_legs_are_the_new_one_s_at_once(robot, policy_of):
    here = policy_of("here", **skills(("a", {"dwell": 0.0})))
    there = policy_of("there", **skills(("b", {})), default_joint_pos=(robot.home_pos + 0.0).tolist())
    player, state = SkillPlayer(robot, [here, there]), standing(robot)
    legs = np.array([joint.group == "leg" for joint in robot.joints])
    now = to_run(player, state)
    for _ in range(100):  # the count in `here` has drifted 0.1 rad by now
        before = player.step(state, Mode.RUN, wish(now), now).joint_pos.copy()
        now += TICK
    after = player.step(state, Mode.RUN, wish(now, "b"), now).joint_pos.copy()
    np.testing.assert_allclose(after[~legs], before[~legs], atol=1e-6)
    assert (np.abs(after - before)[legs] > 0.05).all()
    for _ in range(20):
        now += TICK
        command = player.step(state, Mode.RUN, wish(now, "b"), now)
        assert (np.abs(command.joint_pos - after) < 0.12 * TICK / player.blend_time)[~legs].all()
        after = command.joint_pos.copy()
    assert np.abs(after - before).max() > 0.05


def test_a_state_that_is_not_finite_reaches_no_policy_and_the_command_grows_old(robot, policy_of):
    player, state = SkillPlayer(robot, [policy_of()]), standing(robot)
    now = to_run(player, state)
    before = player.step(state, Mode.RUN, wish(now), now).joint_pos.copy()
    state.joint_pos[0] = np.nan
    command = player.step(state, Mode.RUN, wish(now + TICK), now + TICK)
    np.testing.assert_array_equal(command.joint_pos, before)
    assert command.time == now
    state.joint_pos[0] = robot.home_pos[0]
    command = player.step(state, Mode.RUN, wish(now + 2 * TICK), now + 2 * TICK)
    assert np.isfinite(command.joint_pos).all() and command.time == now + 2 * TICK


def test_two_policies_with_one_label_are_refused(robot, policy_of):
    with pytest.raises(Sim2realError, match="skill 'stand': two policies perform it"):
        SkillPlayer(robot, [policy_of("one"), policy_of("two")])


def test_no_policy_is_refused(robot):
    with pytest.raises(Sim2realError, match="no policy to run"):
        SkillPlayer(robot, [])
