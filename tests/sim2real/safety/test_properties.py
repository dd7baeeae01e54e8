"""Whatever goes in, what comes out is finite and inside. All floats: NaN, infinities, denormals, the largest."""

from __future__ import annotations

import warnings

import numpy as np
from bench import DT, FIELDS, Bench, predicted
from hypothesis import given
from hypothesis import strategies as st

from sim2real.config import load_robot, robot_names
from sim2real.types import Mode

ROBOTS = {name: load_robot(name) for name in robot_names()}
ANY = st.one_of(st.floats(), st.floats(-4, 4), st.sampled_from([0.0, 1e-320, 1e308, -1e308]))
INDEX = st.integers(0, 63)  # taken modulo the size of the field
STATE = {
    "joint_pos": ANY, "joint_vel": ANY, "joint_torque": ANY, "joint_temperature": ANY, "joint_age": ANY,
    "joint_error": st.integers(-(2**63), 2**63 - 1), "joint_enabled": st.booleans(),
    "orientation_base_in_world": ANY, "angular_velocity_base_in_base": ANY, "acceleration_base_in_base": ANY,
}  # fmt: skip


@st.composite
def wounds(draw, fields: dict, scalars: tuple[str, ...]) -> dict:
    """A few values of a few fields, or all values of one, replaced by anything."""
    found: dict = {}
    for field in draw(st.lists(st.sampled_from(sorted(fields)), max_size=3, unique=True)):
        found[field] = draw(st.dictionaries(INDEX, fields[field], min_size=1, max_size=3))
    for scalar in scalars:
        if draw(st.integers(0, 9)) == 0:
            found[scalar] = draw(ANY)
    return found


def sized(changes: dict, record) -> dict:
    return {
        field: {i % len(getattr(record, field)): v for i, v in change.items()} if isinstance(change, dict) else change
        for field, change in changes.items()
    }


MODERATE = st.dictionaries(INDEX, st.floats(-0.2, 0.2), max_size=6)  # rad and rad/s that no rule minds
TICK = st.tuples(
    wounds(STATE, ("imu_age", "time")),
    wounds(dict.fromkeys(FIELDS, ANY), ("time", "object_time")),
    MODERATE,
    st.sampled_from([DT] * 8 + [0.0, -DT, 0.1, 1e-9]),
    st.sampled_from([None] * 8 + ["arm", "stop", "off"]),
)


@given(st.sampled_from(sorted(ROBOTS)), st.booleans(), st.lists(TICK, min_size=1, max_size=6))
def test_every_command_is_finite_and_inside_and_the_ladder_never_goes_down(name, healthy, ticks):
    bench = Bench(ROBOTS[name]).armed()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for state_wounds, command_wounds, moves, dt, event in ticks:
            mode = bench.safety.mode
            bench.time += dt
            state = bench.state(**sized({} if healthy else state_wounds, bench.state()))
            for i, move in moves.items():
                state.joint_pos[i % bench.n] += move
                state.joint_vel[i % bench.n] += move
            if event == "arm" and bench.safety.arm(state, bench.time) is None:
                mode = Mode.RUN
            elif event in ("stop", "off"):
                getattr(bench.safety, event)(*([bench.time] if event == "stop" else []))
            command = bench.command(**sized(command_wounds, bench.command()))
            out = bench.safety.step(state, command, bench.time)

            bench.assert_inside(out)
            now = bench.safety.mode
            assert now >= mode or mode == Mode.HOLD
            if now == Mode.OFF:
                assert not out.kp.any() and not out.kd.any() and not out.joint_torque.any()
            elif now == Mode.DAMP:
                assert not out.kp.any() and not out.joint_torque.any() and (out.kd == bench.robot.damping).all()
            elif bench.safety._evidence.jump_ticks.max() == 0:
                torque = np.abs(predicted(out, state.joint_pos, state.joint_vel))
                assert (torque <= bench.limits.torque * (1 + 1e-9)).all()
            assert now <= Mode.RUN or bench.safety.fault or event in ("stop", "off") or mode >= Mode.DAMP


@given(st.lists(st.tuples(st.lists(st.floats(-10, 10), min_size=3, max_size=3), st.floats(0, 0.05)), max_size=8))
def test_targets_never_move_faster_than_allowed_while_no_torque_is_in_the_way(ticks):
    bench = Bench(ROBOTS["g1"]).armed()
    last = bench.pose
    for (a, b, c), dt in ticks:
        target = bench.pose + np.resize([a, b, c], bench.n)
        out = bench.tick(dt, command={"joint_pos": target, "kp": np.full(bench.n, 0.1), "kd": np.zeros(bench.n)})
        assert bench.safety.mode == Mode.RUN
        assert (np.abs(out.joint_pos - last) <= bench.robot.velocity_max * dt + 1e-12).all()
        towards = (out.joint_pos - last) * (np.clip(target, bench.limits.target_min, bench.limits.target_max) - last)
        assert (towards >= 0).all()
        last = out.joint_pos.copy()
