"""The ladder: default denied, latched, first cause kept, arming from where the robot stands."""

from __future__ import annotations

import dataclasses
import math
import warnings

import numpy as np
import pytest
from bench import DT, FIELDS, Bench, G, copy, predicted

from sim2real.safety import RULES, Limits, Safety
from sim2real.safety.evidence import Evidence
from sim2real.safety.rules import When
from sim2real.types import Mode, Sim2realError

NAN = {"joint_pos": {0: math.nan}}
TILTED = {"orientation_base_in_world": np.array([0.0, 1.0, 0.0, 0.0])}
BY_NAME = {rule.name: rule for rule in RULES}


@pytest.fixture
def bench(robot) -> Bench:
    return Bench(robot)


def assert_damping(bench: Bench, command) -> None:
    assert bench.safety.mode == Mode.DAMP
    assert not command.kp.any() and not command.joint_vel.any() and not command.joint_torque.any()
    assert (command.kd == bench.robot.damping).all()
    bench.assert_inside(command)


# ---- default denied


def test_begins_off_without_a_fault(bench):
    safety = bench.safety
    assert (safety.mode, safety.fault, safety.limited, safety.events) == (Mode.OFF, None, 0, ())


def test_never_moves_before_arm(bench):
    for _ in range(20):
        command = bench.tick()
        assert bench.safety.mode == Mode.OFF
        assert all(not getattr(command, field).any() for field in FIELDS[1:])
        bench.assert_inside(command)
    assert command.time == bench.time


def test_off_command_is_zero_or_the_nearest_that_is_inside(robot):
    limits = Limits.of(robot)
    away = dataclasses.replace(limits, target_min=limits.target_max - 0.01)
    bench = Bench(robot)
    bench.safety = Safety(away)
    assert (bench.tick().joint_pos == np.clip(0, away.target_min, away.target_max)).all()


def test_faults_before_arm_are_told_but_not_latched(bench):
    bench.tick(**TILTED)
    assert "tilt" in bench.began() and "command_age" not in bench.began()
    assert (bench.safety.mode, bench.safety.fault) == (Mode.OFF, None)


# ---- arming


def test_arm_starts_from_where_the_robot_stands(bench):
    bench.pose += 0.05
    bench.tick()
    assert bench.arm() is None
    assert bench.safety.mode == Mode.RUN
    bench.command_time = 0.0  # the pilot has not noticed yet
    command = bench.tick()
    assert (command.joint_pos == bench.pose).all()
    assert not command.kp.any() and not command.joint_torque.any() and not command.joint_vel.any()
    assert (command.kd == bench.robot.damping).all()
    bench.command_time = None
    target = bench.pose + np.sign(bench.pose - 1) * 1.0
    command = bench.tick(command={"joint_pos": target, "kp": np.full(bench.n, 1.0)})
    moved = np.abs(command.joint_pos - bench.pose)
    assert (moved <= bench.limits.target_velocity * DT * (1 + 1e-9)).all() and moved.all()


def test_arm_works_on_the_very_first_state(bench):
    assert bench.arm() is None


def test_arm_while_armed_changes_nothing(bench):
    bench.armed()
    bench.tick(command={"joint_pos": bench.pose + 0.01})
    before = copy(bench.safety.step(bench.state(), bench.command(joint_pos=bench.pose + 0.01), bench.time))
    assert bench.arm(0.0) is None
    after = bench.safety.step(bench.state(), bench.command(joint_pos=bench.pose + 0.01), bench.time)
    assert all((getattr(before, f) == getattr(after, f)).all() for f in FIELDS)
    bench.tick(command=NAN)
    assert bench.safety.mode == Mode.HOLD
    assert bench.arm(**TILTED) is None
    assert bench.safety.mode == Mode.HOLD and bench.safety.fault.rule.name == "command_finite"


@pytest.mark.parametrize(
    ("rule", "changes"),
    [
        ("position_finite", {"joint_pos": {0: math.nan}}),
        ("velocity_finite", {"joint_vel": {0: -math.inf}}),
        ("imu_finite", {"acceleration_base_in_base": {2: math.nan}}),
        ("joint_age", {"joint_age": {0: math.inf}}),
        ("joint_age", {"time": 0.5}),
        ("joint_age", {"time": 1e9}),
        ("imu_age", {"imu_age": math.inf}),
        ("imu_age", {"imu_age": math.nan}),
        ("orientation_norm", {"orientation_base_in_world": np.zeros(4)}),
        ("position_finite", {"joint_pos": np.zeros(1)}),
        ("joint_velocity", {"joint_vel": {0: 1e3}}),
        ("tilt", TILTED),
        ("angular_velocity", {"angular_velocity_base_in_base": {1: 100.0}}),
        ("temperature", {"joint_temperature": {0: 200.0}}),
        ("motor_error", {"joint_error": {0: 8}}),
        ("arm_gravity", {"acceleration_base_in_base": np.array([0, 0, -9.81])}),
        ("arm_encoder", {"joint_pos": {0: 1e5}}),
    ],
)
def test_arm_refuses(bench, rule, changes):
    refusal = bench.arm(**changes)
    assert refusal is not None and f" {rule}: " in refusal
    assert bench.safety.mode == Mode.OFF
    assert bench.arm() is None or rule == "arm_encoder"


def test_an_old_state_is_old_in_all_its_parts(bench):
    for off in (-1, 1):
        for ages in ({}, {"joint_age": np.full(bench.n, -1.0), "imu_age": -1.0}):
            bench.tick()
            bench.tick(time=bench.time + DT + off, **ages)
            assert {"joint_age", "imu_age"} <= set(bench.began())


def test_wrong_quaternion_order_shows_on_a_robot_that_leans(bench):
    """(x, y, z, w) is the commonest mistake. Of an upright robot it makes another upright one; not of one that leans."""
    lean = 0.25
    q, g = np.array([np.cos(lean / 2), 0, np.sin(lean / 2), 0]), G * np.array([-np.sin(lean), 0, np.cos(lean)])
    assert "arm_gravity" in bench.arm(orientation_base_in_world=np.roll(q, -1), acceleration_base_in_base=g)
    assert bench.arm(orientation_base_in_world=q, acceleration_base_in_base=g) is None


def test_a_warning_does_not_refuse(bench):
    warm = bench.robot.safety.temperature_warn + 1
    assert bench.arm(joint_temperature={0: warm}) is None
    bench.tick(joint_temperature={0: warm})
    assert bench.began()["temperature_warn"].joint == 0
    assert (bench.safety.mode, bench.safety.fault) == (Mode.RUN, None)


def test_only_a_motor_without_thermometer_may_say_nothing_of_its_temperature(bench, joints):
    for j in joints:
        refusal = bench.arm(joint_temperature={j: math.nan})
        assert (refusal is None) != bench.robot.joints[j].thermometer
        assert refusal is None or refusal.startswith(f"S2R-013 temperature: {bench.robot.joint_names[j]}: ")
        bench.safety.off()


def test_refusal_says_what_where_got_expected_next(bench):
    name, limit = bench.robot.joint_names[1], bench.robot.safety.temperature
    assert bench.arm(joint_temperature={1: 123.4}) == (
        f"S2R-013 temperature: {name}: a motor is too hot: got 123.4 deg C, expected at most {limit:g}; let it cool; nan: it "
        "reports none, see `thermometer` in sim2real/config.py"
    )
    assert bench.arm(imu_age=0.5) == (
        f"S2R-005 imu_age: the IMU has not been heard: got 0.5 s, expected at most {bench.robot.safety.imu_age:g}; "
        "check its cable and rate"
    )
    name = bench.robot.joint_names[0]
    assert bench.arm(joint_temperature={0: 123.4}).startswith(f"S2R-013 temperature: {name}: ")
    assert "number: got nan, expected at most 1.798e+308; check" in bench.arm(acceleration_base_in_base={0: math.nan})


@pytest.mark.parametrize("wound", [{"joint_pos": {0: 500.0}}, {"joint_age": {0: math.nan}}, {"joint_pos": {0: 1e300}}])
def test_a_garbled_first_reading_heals(bench, wound):
    bench.tick(**wound)
    bench.tick()
    bench.tick(100.0)  # long enough for the slowest joint to have come back from there
    bench.tick()
    assert bench.arm() is None
    bench.command_time = 0.0
    assert (bench.tick().joint_pos == bench.pose).all()


# ---- the latch


def test_a_fault_latches_and_its_first_cause_is_kept(bench):
    bench.armed()
    assert_damping(bench, bench.tick(joint_temperature={1: 200.0}))
    first = bench.safety.fault
    assert (first.rule.name, first.joint, first.value, first.time) == ("temperature", 1, 200.0, bench.time)
    assert first.limit == bench.robot.safety.temperature and not first.over
    for _ in range(100):
        assert_damping(bench, bench.tick())
    assert_damping(bench, bench.tick(**TILTED))
    assert bench.safety.fault is first
    assert bench.arm() is None
    bench.tick()
    assert (bench.safety.mode, bench.safety.fault) == (Mode.RUN, None)


def test_the_gravest_of_one_tick_is_the_cause(bench):
    bench.armed()
    bench.tick(joint_temperature={0: bench.robot.safety.temperature_warn + 1}, command=NAN, imu_age=1.0, **TILTED)
    assert bench.safety.fault.rule.name == "imu_age"
    assert {"imu_age", "tilt", "temperature_warn", "command_finite"} == set(bench.began())


def test_a_hold_that_ends_in_damp_keeps_the_cause_of_the_hold(bench):
    bench.armed()
    while bench.safety.mode <= Mode.HOLD:
        bench.tick(command=NAN)
    assert "hold_time" in bench.began()
    assert bench.safety.fault.rule.name == "command_finite"
    assert bench.safety.fault.time < bench.time


def test_a_fault_cannot_be_cleared_while_its_cause_persists(bench):
    bench.armed()
    bench.tick(**TILTED)
    assert "tilt" in bench.arm(**TILTED)
    assert bench.safety.mode == Mode.DAMP and bench.safety.fault.rule.name == "tilt"
    assert bench.arm() is None


def test_a_dead_pilot_cannot_be_armed_away(bench):
    bench.armed()
    bench.command_time = bench.time
    while bench.safety.mode != Mode.DAMP:
        bench.tick()
    assert bench.safety.fault.rule.name == "command_age_hold"
    assert "S2R-017" in bench.arm()
    bench.command_time = None
    bench.tick()
    assert bench.arm() is None


def test_a_policy_of_nan_cannot_be_armed_away(bench):
    bench.armed()
    while bench.safety.mode != Mode.DAMP:
        bench.tick(command=NAN)
    assert "S2R-016" in bench.arm()
    bench.tick()
    assert bench.arm() is None


@pytest.mark.parametrize("never", [-math.inf, math.nan])
def test_an_object_out_of_sight_holds_damps_and_cannot_be_armed_away(bench, never):
    limit = bench.robot.safety.object_age
    bench.armed()
    lost = bench.time
    while bench.safety.mode == Mode.RUN:
        bench.tick(command={"object_time": lost})
    assert bench.safety.mode == Mode.HOLD and limit < bench.time - lost <= limit + DT
    while bench.safety.mode == Mode.HOLD:
        bench.tick(command={"object_time": lost})
    assert bench.time - lost <= limit + bench.robot.safety.hold_time + 2 * DT
    assert bench.safety.fault.rule.name == "object_age"
    for unseen in (lost, never):
        bench.tick(command={"object_time": unseen})
        assert "S2R-028 object_age: the object" in bench.arm()
    bench.tick(command={"object_time": bench.time})
    assert bench.arm() is None


def test_an_object_that_comes_back_into_sight_in_time_ends_the_hold(bench):
    bench.armed()
    bench.tick(command={"object_time": bench.time - 1})
    assert bench.safety.mode == Mode.HOLD
    bench.tick(command={"object_time": bench.time})
    assert (bench.safety.mode, bench.safety.fault) == (Mode.RUN, None)


def test_a_command_that_rests_on_no_object_needs_none_in_sight(bench):
    bench.tick(command={"object_time": math.inf})
    assert bench.arm() is None
    assert bench.safety.mode == Mode.RUN


def test_another_fault_of_the_command_does_not_forbid_arming(bench):
    """Only what stopped the robot must be over: a pilot may fall silent while its robot lies on the floor."""
    bench.armed()
    bench.command_time = bench.time
    bench.tick(**TILTED)
    for _ in range(100):
        bench.tick()
    assert bench.arm() is None


def test_what_arming_itself_ends_does_not_forbid_it(bench):
    bench.armed()
    for _ in range(60):
        bench.tick(joint_enabled={0: 0})
    assert bench.safety.fault.rule.name == "motor_enabled"
    assert bench.arm(joint_enabled={0: 0}) is None
    bench.tick(joint_enabled={0: 0})
    assert bench.safety.mode == Mode.RUN  # its time to say that it is enabled begins anew


def test_a_motor_that_never_says_enabled_damps(bench):
    bench.arm(joint_enabled=np.zeros(bench.n, bool))
    while bench.time < 1 + bench.robot.safety.enable_time - DT:
        bench.tick(joint_enabled=np.zeros(bench.n, bool))
        assert bench.safety.mode == Mode.RUN
    for _ in range(4):
        bench.tick(joint_enabled=np.zeros(bench.n, bool))
    assert bench.safety.fault.rule.name == "motor_enabled"


def test_the_gap_before_arming_is_no_matter(bench):
    bench.tick()
    assert bench.arm(dt=100.0) is None
    bench.tick()
    assert bench.safety.mode == Mode.RUN


# ---- the operator


@pytest.mark.parametrize("name", ["stop", "disarm"])
def test_stop_damps_at_once_from_run_and_hold(bench, name):
    for command in ({}, NAN):
        bench.armed()
        bench.tick(command=command)
        getattr(bench.safety, name)(bench.time)
        assert bench.safety.mode == Mode.DAMP
        assert_damping(bench, bench.tick())
        bench.safety.off()


def test_stop_is_no_fault_and_needs_arming(bench):
    bench.armed().safety.stop(bench.time)
    for _ in range(10):
        bench.tick()
    assert (bench.safety.mode, bench.safety.fault) == (Mode.DAMP, None)
    assert bench.arm() is None


def test_stop_leaves_off_off(bench):
    bench.safety.stop(1.0)
    assert bench.safety.mode == Mode.OFF


def test_off_is_final_until_arm(bench):
    bench.armed().safety.off()
    for changes in ({}, TILTED, {}):
        command = bench.tick(**changes)
        assert bench.safety.mode == Mode.OFF
        assert not command.kp.any() and not command.kd.any()
    bench.safety.stop(bench.time)
    assert bench.safety.mode == Mode.OFF
    assert bench.arm() is None


# ---- hold


def test_hold_repeats_the_last_validated_command_and_recovers(bench):
    bench.armed()
    last = copy(bench.tick(command={"joint_pos": bench.pose + 0.02, "joint_torque": {0: 0.5}}))
    for bad in ({"kp": {0: math.inf}}, {"joint_pos": np.zeros(1)}, {"kd": None}):
        held = bench.tick(command=bad)
        assert bench.safety.mode == Mode.HOLD
        assert all((getattr(held, f) == getattr(last, f)).all() for f in FIELDS)
    assert bench.safety.limited == 0
    assert bench.safety.fault.rule.name == "command_finite"
    bench.tick(command={"joint_pos": bench.pose + 0.02, "joint_torque": {0: 0.5}})
    assert (bench.safety.mode, bench.safety.fault) == (Mode.RUN, None)
    assert [(e.rule.name, e.over, e.time) for e in bench.safety.events] == [("command_finite", True, bench.time)]
    bench.tick()
    assert bench.safety.events == ()


def test_hold_still_limits_torque(bench):
    bench.armed()
    bench.pose[0] += 0.02
    pushed = 0.9 * bench.robot.torque_max[0] / bench.robot.kp_max[0]
    bench.tick(command={"kp": {0: bench.robot.kp_max[0]}, "joint_torque": {0: 0.95 * bench.robot.torque_max[0]}})
    believed = bench.robot.safety.jump_ratio * bench.robot.velocity_max[0] * DT  # more in a tick would be a jump
    bench.pose[0] -= min(pushed, 0.1, 0.9 * believed)
    held = bench.tick(command=NAN)
    assert bench.safety.mode == Mode.HOLD and bench.safety.limited == 1
    assert predicted(held, bench.pose, np.zeros(bench.n))[0] <= bench.robot.torque_max[0] * (1 + 1e-12)


def test_each_hold_has_its_own_time(bench):
    bench.armed()
    for _ in range(20):
        bench.tick(8 * DT, command=NAN)
        assert bench.safety.mode == Mode.HOLD
        bench.tick()
        assert bench.safety.mode == Mode.RUN


def test_a_change_of_cause_does_not_restart_the_hold(bench):
    bench.armed()
    bench.command_time = bench.time
    bench.tick(11 * DT)
    assert bench.safety.fault.rule.name == "command_age_hold"
    bench.command_time = None
    ticks = 0
    while bench.safety.mode == Mode.HOLD:
        bench.tick(command=NAN)
        ticks += 1
    assert ticks == math.floor(bench.robot.safety.hold_time / DT) + 1
    assert bench.safety.fault.rule.name == "command_age_hold"


def test_no_command_at_all_is_a_late_one(bench):
    bench.armed()
    last = copy(bench.tick())
    modes = []
    for _ in range(20):
        bench.time += DT
        out = bench.safety.step(bench.state(), None, bench.time)
        modes.append(bench.safety.mode)
        if modes[-1] <= Mode.HOLD:
            assert (out.joint_pos == last.joint_pos).all() and (out.kp == last.kp).all()
    assert modes == sorted(modes) and set(modes) == {Mode.RUN, Mode.HOLD, Mode.DAMP}


def test_a_silent_pilot_after_arming_damps(bench):
    bench.arm()
    for _ in range(20):
        bench.time += DT
        command = bench.safety.step(bench.state(), None, bench.time)
        assert not command.kp.any()
    assert bench.safety.mode == Mode.DAMP and bench.safety.fault.rule.name == "command_age_hold"


# ---- damping


def test_damping_follows_the_joint_and_survives_nan(bench):
    bench.armed().safety.stop(bench.time)
    bench.pose += 0.01
    assert (bench.tick().joint_pos == bench.pose).all()
    wild = {"joint_pos": np.full(bench.n, math.nan), "joint_vel": np.full(bench.n, math.inf)}
    command = bench.tick(**wild)
    assert_damping(bench, command)
    assert (command.joint_pos == bench.pose).all()


def test_only_what_is_limited_now_is_counted(bench):
    bench.armed().tick(command={"kp": {0: 1e6}})
    assert bench.safety.limited == 1
    bench.safety.stop(bench.time)
    bench.tick(command={"kp": {0: 1e6}})
    assert bench.safety.limited == 0


def test_damping_outside_the_soft_range_stays_inside_it(bench):
    bench.armed().safety.stop(bench.time)
    bench.pose = bench.robot.position_max + 1.0
    bench.tick(1.0)
    assert_damping(bench, bench.tick())


# ---- the first unbelievable reading is not believed


def test_one_encoder_glitch_changes_nothing(bench):
    bench.armed()
    last = copy(bench.tick())
    out = bench.tick(joint_pos={0: bench.robot.position_max[0] + 2.0})
    assert bench.safety.mode == Mode.RUN and bench.safety.events == ()
    assert all((getattr(out, f) == getattr(last, f)).all() for f in FIELDS)


def test_a_joint_that_was_silent_may_have_moved(bench):
    """Lost frames are no jump: the reach grows with the age of the last reading, and not with that of the next."""
    bench.armed()
    speed = 2.9 * bench.robot.velocity_max[0]
    for age in (DT, 2 * DT, 3 * DT):
        bench.tick(joint_age={0: age})
    bench.tick(joint_pos={0: bench.pose[0] + 4 * DT * speed})
    bench.tick(joint_pos={0: bench.pose[0] + 5 * DT * speed})
    assert "encoder_jump" not in bench.began()
    for _ in range(2):
        bench.tick(joint_pos={0: bench.pose[0] - DT * speed})
    assert "encoder_jump" in bench.began()


def test_the_gyro_may_repeat_while_no_sample_is_fresh(bench):
    bench.armed()
    gyro = np.array([0.1, 0.2, 0.3])
    for tick in range(10):
        bench.tick(angular_velocity_base_in_base=gyro, imu_age=tick * DT)
        assert bench.safety.mode == Mode.RUN
    gyros = [gyro, gyro, gyro, gyro + 1e-9] * 5
    for g in gyros:
        bench.tick(angular_velocity_base_in_base=g)
    assert bench.safety.mode == Mode.RUN


@pytest.mark.parametrize(("later", "fresh"), [(1e-6, False), (np.nextafter(1e-6, 1), True)])
def test_samples_a_microsecond_apart_are_one(robot, later, fresh):
    bench = Bench(robot, start=0.0)
    evidence = Evidence(bench.limits)
    for bench.time in (0.0, later):
        evidence.see(bench.state(angular_velocity_base_in_base=np.ones(3)), bench.time)
    assert evidence.gyro_repeats == 1 + fresh


def test_never_heard_imu_is_no_crash(bench):
    for _ in range(3):
        bench.tick(imu_age=math.inf, angular_velocity_base_in_base=np.full(3, math.nan))
    assert {"imu_age", "imu_finite"} <= {f.rule.name for f in bench.safety._present.values()}


@pytest.mark.parametrize(("first", "believed"), [(1000.0, True), (np.nextafter(-1000.0, -np.inf), False)])
def test_a_first_reading_may_be_anywhere_within_reason(bench, first, believed):
    evidence = Evidence(bench.limits)
    evidence.see(bench.state(joint_pos={0: first}), bench.time)
    assert evidence.joint_pos[0] == (first if believed else 0.0)


# ---- time


def test_a_suspended_gate_damps_in_its_first_tick(bench):
    bench.armed()
    assert_damping(bench, bench.tick(dt=1.0))
    assert bench.safety.fault.rule.name == "tick_gap"


def test_time_is_an_argument(robot):
    """A gate run a year later, bit for bit."""
    outputs = []
    for _ in range(2):
        bench, frames = Bench(robot).armed(), []
        for k in range(50):
            out = bench.tick(command={"joint_pos": bench.pose + 0.3 * np.sin(k), **(NAN if k % 7 == 0 else {})})
            frames.append(b"".join(getattr(out, f).tobytes() for f in FIELDS) + bytes([bench.safety.mode]))
        outputs.append(b"".join(frames))
    assert outputs[0] == outputs[1]


def test_what_it_returns_and_what_it_is_given_are_separate(bench):
    bench.armed()
    state, command = bench.state(), bench.command()
    before = copy(bench.safety.step(state, command, bench.time))
    state.joint_pos[:] = math.nan
    command.joint_pos[:] = math.nan
    out = bench.safety.step(bench.state(), None, bench.time)
    assert (out.joint_pos == before.joint_pos).all()


# ---- events


def test_events_tell_when_a_fault_begins_and_ends(bench):
    bench.armed()
    bench.tick(**TILTED)
    assert list(bench.began()) == ["tilt"] and len(bench.safety.events) == 1
    bench.tick(**TILTED)
    assert bench.safety.events == ()
    bench.tick()
    assert [(e.rule.name, e.over) for e in bench.safety.events] == [("tilt", True)]


def test_what_is_no_longer_asked_is_not_over(bench):
    bench.armed()
    bench.command_time = bench.time
    while bench.safety.mode != Mode.DAMP:
        bench.tick()
    bench.tick()
    assert bench.safety.events == ()


# ---- how soon


WOUNDS = {
    "position_finite": lambda b, since: {"joint_pos": {0: math.nan}},
    "velocity_finite": lambda b, since: {"joint_vel": {0: math.nan}},
    "imu_finite": lambda b, since: {"angular_velocity_base_in_base": {0: math.nan}},
    "joint_age": lambda b, since: {"joint_age": {0: b.time + DT - since}},
    "imu_age": lambda b, since: {"imu_age": b.time + DT - since},
    "imu_frozen": lambda b, since: {"angular_velocity_base_in_base": np.array([1e-4 * since, 0.0, 0.0])},
    "orientation_norm": lambda b, since: {"orientation_base_in_world": np.ones(4)},
    "position_overrun": lambda b, since: {"joint_pos": {0: b.pose[0] + 0.03}},
    "joint_velocity": lambda b, since: {"joint_vel": {0: 1e3}},
    "encoder_jump": lambda b, since: {"joint_pos": {0: b.pose[0] - 2.0}},
    "tilt": lambda b, since: TILTED,
    "angular_velocity": lambda b, since: {"angular_velocity_base_in_base": {0: 1e3}},
    "temperature": lambda b, since: {"joint_temperature": {0: 1e3}},
    "temperature_warn": lambda b, since: {"joint_temperature": {0: b.robot.safety.temperature_warn + 1}},
    "motor_error": lambda b, since: {"joint_error": {0: 1}},
    "command_finite": lambda b, since: {"command": NAN},
    "command_age_hold": lambda b, since: {"command": {"time": since}},
    "command_age": lambda b, since: {"command": {"time": since}},
    "object_age": lambda b, since: {"command": {"object_time": since - b.robot.safety.object_age}},
    "hold_time": lambda b, since: {"command": NAN},
    "motor_enabled": lambda b, since: {"joint_enabled": {0: 0}},
    "tick_gap": lambda b, since: {"dt": 1.0},
    "time_backwards": lambda b, since: {"dt": -DT},
}


@pytest.mark.parametrize("rule", [r for r in RULES if r.when is not When.ARM], ids=lambda r: r.name)
def test_the_reaction_comes_within_its_bound(robot, rule):
    """The cause begins right after a tick (a suspension: ends with one); ticks come at 256 Hz."""
    bench = Bench(robot)
    bench.pose[0] = robot.position_max[0] + robot.safety.position_overrun - 0.02
    begin = bench.armed().time
    while rule.name not in bench.began():
        bench.tick(**WOUNDS[rule.name](bench, begin))
        assert bench.time < begin + 2
    took = abs(bench.time - begin) - (1.0 if rule.name == "tick_gap" else 0.0)
    assert bench.safety.mode >= rule.reaction
    assert rule.bound - 2 * DT < took <= rule.bound


# ---- limits


def test_limits_refuse_numbers_that_contradict_each_other(robot):
    limits, name = Limits.of(robot), robot.joint_names[-1]
    narrow = limits.target_max.copy()
    narrow[-1] = limits.target_min[-1]
    low = limits.target_min[-1]
    with pytest.raises(Sim2realError) as error:
        dataclasses.replace(limits, target_max=narrow)
    assert str(error.value) == (
        f"{name}: the soft range is [{low:g}, {low:g}] rad, expected lower < upper; "
        "reduce safety.position_margin or correct the joint's position range"
    )
    strong = limits.kd_max.copy()
    strong[-1] = np.nextafter(strong[-1], np.inf)
    with pytest.raises(Sim2realError) as error:
        dataclasses.replace(limits, damping=strong)
    assert str(error.value) == (
        f"{name}: damping is {strong[-1]:g} N m s/rad, expected at most kd_max {limits.kd_max[-1]:g}; "
        "lower damping or raise kd_max if the motor allows it"
    )
    dataclasses.replace(limits, damping=limits.kd_max)  # as strong as allowed
    for field in ("target_min", "kd_max"):
        with pytest.raises(ValueError, match="shorter"):
            dataclasses.replace(limits, **{field: getattr(limits, field)[:-1]})


def test_limits_are_the_robots_numbers(robot):
    limits, safety = Limits.of(robot), robot.safety
    assert (limits.target_min == robot.position_min + safety.position_margin).all()
    assert (limits.target_max == robot.position_max - safety.position_margin).all()
    for field in dataclasses.fields(limits):
        if hasattr(safety, field.name):
            assert getattr(limits, field.name) == getattr(safety, field.name)
    with pytest.raises(dataclasses.FrozenInstanceError):
        limits.tilt = 3.0


def test_ratios_scale_what_they_name(robot):
    safety = robot.safety.model_copy(
        update={"velocity_max_ratio": 1.5, "target_velocity_ratio": 0.5, "torque_ratio": 0.25, "position_margin": 0.03}
    )
    limits = Limits.of(robot.model_copy(update={"safety": safety}))
    assert (limits.velocity_max == 1.5 * robot.velocity_max).all()
    assert (limits.target_velocity == 0.5 * robot.velocity_max).all()
    assert (limits.torque == 0.25 * robot.torque_max).all()
    assert (limits.target_min == robot.position_min + 0.03).all()


def test_soft_springs_are_not_held_back_by_the_torque_band(bench):
    """At kp far below 1 N m/rad hardly a target makes a torque; at kp 0 none does."""
    bench.armed()
    for kp in (0.0, 5e-7, 1e-3):
        target = bench.pose + 1e-3
        out = bench.tick(command={"joint_pos": target, "kp": np.full(bench.n, kp)})
        assert (out.joint_pos == target).all() and (out.kp == kp).all()


def test_the_torque_band_holds_for_a_spring_of_half_a_newton_metre(bench):
    bench.armed()
    torque, kp = bench.limits.torque, np.full(bench.n, 0.5)
    tau = torque - 0.5e-3  # leaves 1 mrad
    out = bench.tick(command={"joint_pos": bench.pose + 0.01, "kp": kp, "kd": np.zeros(bench.n), "joint_torque": tau})
    assert np.allclose(out.joint_pos - bench.pose, 1e-3, rtol=1e-6, atol=0)
    assert (out.kp == kp).all()


def test_fast_joint_without_spring_is_damped_within_its_torque(bench):
    bench.armed()
    vel = bench.limits.velocity_max
    gains = {"kp": np.zeros(bench.n), "kd": bench.limits.kd_max}
    out = bench.tick(command=gains, joint_vel=vel)
    assert bench.safety.mode == Mode.RUN
    torque = predicted(out, bench.pose, vel)
    wanted = bench.limits.kd_max * vel
    assert np.allclose(-torque, np.minimum(wanted, bench.limits.torque), rtol=1e-12)


def test_nothing_warns_and_nothing_raises(bench):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        bench.armed()
        for field in ("joint_pos", "joint_vel", "joint_age", "joint_temperature"):
            for value in (math.nan, math.inf, -math.inf, 1e308, -1e308, 5e-324):
                bench.tick(**{field: np.full(bench.n, value)})
                bench.arm(**{field: np.full(bench.n, value)})
                bench.arm()
        for field in FIELDS:
            for value in (math.nan, math.inf, -math.inf, 1e308, -1e308, 5e-324):
                bench.safety.off()
                bench.tick(1.0)
                bench.arm()
                bench.assert_inside(bench.tick(command={field: np.full(bench.n, value)}))
        for wrong in (None, 3.0, "x", [0.0], np.zeros((bench.n, 1)), np.full(bench.n, "x"), np.zeros(bench.n, complex)):
            bench.arm()
            bench.assert_inside(bench.tick(command={"joint_pos": wrong}))
            assert bench.safety.mode != Mode.RUN
            bench.assert_inside(bench.tick(joint_pos=wrong, orientation_base_in_world=wrong, joint_enabled=wrong))
            bench.safety.off()


@pytest.mark.parametrize("dtype", [np.float32, np.int64, np.uint8])
def test_any_real_number_will_do(bench, dtype):
    bench.armed()
    out = bench.tick(command={"kp": np.full(bench.n, 3, dtype)}, joint_enabled=np.ones(bench.n, dtype))
    assert (out.kp == 3).all() and bench.safety.mode == Mode.RUN
