"""Every rule and every clamp, on every joint of every robot: just inside passes, just outside does not."""

from __future__ import annotations

import inspect
import math

import numpy as np
import pytest
from bench import DT, FIELDS, Bench, G, predicted

from sim2real.safety import RULES
from sim2real.safety.rules import CLAMPS, When
from sim2real.types import Mode

NEAR = 1e-9  # where a limit is met through rounding arithmetic, this stands for the next float
LARGEST = np.finfo(float).max


def edge(limit: float, outside: bool, sign: int = 1) -> float:
    """``sign * limit``, or the next float beyond it."""
    return sign * (math.nextafter(limit, math.inf) if outside else limit)


def near(limit: float, outside: bool) -> float:
    return limit + NEAR if outside else limit - NEAR


def quaternion(tilt: float, sign: int) -> np.ndarray:
    """A lean by ``tilt`` about a horizontal axis, after a turn of 0.7 rad that must not matter."""
    lean = np.array([np.cos(tilt / 2), 0.6 * sign * np.sin(tilt / 2), 0.8 * np.sin(tilt / 2), 0.0])
    c, s = np.cos(0.35), np.sin(0.35)
    w, x, y, z = lean
    return np.array([c * w - s * z, c * x - s * y, c * y + s * x, c * z + s * w])


def up_in_base(q: np.ndarray) -> np.ndarray:
    w, x, y, z = q
    return np.array([2 * (x * z - w * y), 2 * (w * x + y * z), 1 - 2 * (x * x + y * y)])


class FaultCases:
    """One case a rule, by its name: drive ``bench`` to the tick in question, its value at the limit or just outside.

    ``bench`` is armed (for rules asked to arm: ticking, disarmed). ``sign`` -1 asks for the other end of a range.
    """

    def position_finite(self, b: Bench, j: int, outside: bool, sign: int):
        b.tick(joint_pos={j: edge(LARGEST, outside, sign)})

    def velocity_finite(self, b: Bench, j: int, outside: bool, sign: int):
        b.tick(joint_vel={j: edge(LARGEST, outside, sign)})

    def imu_finite(self, b: Bench, j: int, outside: bool, sign: int):
        value = edge(LARGEST, outside, sign)
        if j % 10 < 4:
            b.tick(orientation_base_in_world={j % 10: value})
        elif j % 10 < 7:
            b.tick(angular_velocity_base_in_base={j % 10 - 4: value})
        else:
            b.tick(acceleration_base_in_base={j % 10 - 7: value})

    def joint_age(self, b: Bench, j: int, outside: bool, sign: int):
        b.tick(joint_age={j: edge(b.robot.safety.joint_age, outside, sign)})

    def imu_age(self, b: Bench, j: int, outside: bool, sign: int):
        b.tick(imu_age=edge(b.robot.safety.imu_age, outside, sign))

    def imu_frozen(self, b: Bench, j: int, outside: bool, sign: int):
        for _ in range(int(b.robot.safety.imu_frozen) + outside):
            b.tick(angular_velocity_base_in_base=np.array([0.1, 0.2 * sign, 0.3]))

    def orientation_norm(self, b: Bench, j: int, outside: bool, sign: int):
        norm = 1 + sign * near(b.robot.safety.orientation_norm, outside)
        b.tick(orientation_base_in_world=norm * quaternion(0.1, sign))

    def position_overrun(self, b: Bench, j: int, outside: bool, sign: int):
        end = (b.robot.position_max if sign > 0 else b.robot.position_min)[j]
        b.pose[j] = end + sign * near(b.robot.safety.position_overrun, outside)
        for _ in range(5):  # from home it jumps there: wait until that is believed
            b.tick(DT if b.safety.mode == Mode.RUN else 1.0)
            if "position_overrun" in b.began():
                break

    def joint_velocity(self, b: Bench, j: int, outside: bool, sign: int):
        limit = b.robot.velocity_max[j] * b.robot.safety.velocity_max_ratio
        b.tick(joint_vel={j: edge(limit, outside, sign)})

    def encoder_jump(self, b: Bench, j: int, outside: bool, sign: int):
        far = b.pose[j] + sign * 2.5 * b.robot.safety.jump_ratio * b.robot.velocity_max[j] * DT
        b.tick(joint_pos={j: far})
        if outside:
            b.tick(joint_pos={j: far})
        else:
            b.tick()
            b.tick(joint_pos={j: far})

    def tilt(self, b: Bench, j: int, outside: bool, sign: int):
        b.tick(orientation_base_in_world=quaternion(near(b.robot.safety.tilt, outside), sign))

    def angular_velocity(self, b: Bench, j: int, outside: bool, sign: int):
        value = edge(b.robot.safety.angular_velocity, outside, sign)
        b.tick(angular_velocity_base_in_base=np.roll([value, 0.0, 0.0], j))

    def temperature(self, b: Bench, j: int, outside: bool, sign: int):
        b.tick(joint_temperature={j: edge(b.robot.safety.temperature, outside)})

    def temperature_warn(self, b: Bench, j: int, outside: bool, sign: int):
        b.tick(joint_temperature={j: edge(b.robot.safety.temperature_warn, outside)})

    def motor_error(self, b: Bench, j: int, outside: bool, sign: int):
        b.tick(joint_error={j: sign * int(outside)})

    def command_finite(self, b: Bench, j: int, outside: bool, sign: int):
        b.tick(command={FIELDS[j % 5]: {j: edge(LARGEST, outside, sign)}})

    def command_age_hold(self, b: Bench, j: int, outside: bool, sign: int):
        b.command_time = b.time + DT - sign * near(b.robot.safety.command_age_hold, outside)
        b.tick()

    def command_age(self, b: Bench, j: int, outside: bool, sign: int):
        b.command_time = b.time + DT - sign * near(b.robot.safety.command_age, outside)
        b.tick()

    def object_age(self, b: Bench, j: int, outside: bool, sign: int):
        b.tick(command={"object_time": b.time + DT - sign * near(b.robot.safety.object_age, outside)})

    def hold_time(self, b: Bench, j: int, outside: bool, sign: int):
        b.tick(command={"kp": {j: np.nan}})
        b.tick(near(b.robot.safety.hold_time, outside), command={"kp": {j: np.nan}})

    def motor_enabled(self, b: Bench, j: int, outside: bool, sign: int):
        for _ in range(4):
            b.tick(near(b.robot.safety.enable_time, outside) / 4, joint_enabled={j: False})

    def tick_gap(self, b: Bench, j: int, outside: bool, sign: int):
        b.tick(near(b.robot.safety.tick_gap, outside))

    def time_backwards(self, b: Bench, j: int, outside: bool, sign: int):
        b.tick(-(b.time - np.nextafter(b.time, -np.inf)) if outside else 0.0)

    def arm_tilt(self, b: Bench, j: int, outside: bool, sign: int):
        q = quaternion(near(b.robot.safety.arm_tilt, outside), sign)
        return b.arm(orientation_base_in_world=q, acceleration_base_in_base=G * up_in_base(q))

    def arm_velocity(self, b: Bench, j: int, outside: bool, sign: int):
        return b.arm(joint_vel={j: edge(b.robot.safety.arm_velocity, outside, sign)})

    def arm_angular_velocity(self, b: Bench, j: int, outside: bool, sign: int):
        value = edge(b.robot.safety.arm_velocity, outside, sign)
        return b.arm(angular_velocity_base_in_base=np.roll([value, 0.0, 0.0], j))

    def arm_gravity(self, b: Bench, j: int, outside: bool, sign: int):
        q = quaternion(0.3, sign)
        off = np.roll([sign * near(b.robot.safety.arm_gravity, outside), 0.0, 0.0], j)
        return b.arm(orientation_base_in_world=q, acceleration_base_in_base=G * up_in_base(q) + off)

    def arm_encoder(self, b: Bench, j: int, outside: bool, sign: int):
        reach = b.robot.safety.jump_ratio * b.robot.velocity_max[j] * DT
        return b.arm(joint_pos={j: b.pose[j] + sign * near(reach, outside)})


class ClampCases:
    """One case a clamp, by its name. Returns the field, what was asked for and what must come out, of joint ``j``."""

    def not_armed(self, b: Bench, j: int, outside: bool, sign: int):
        b.safety.stop(b.time)
        b.tick()
        assert b.arm() is None
        armed = b.time
        b.command_time = np.nextafter(armed, -np.inf) if outside else armed
        asked = b.robot.kp_max[j] / 2
        return "kp", asked, 0.0 if outside else asked, b.tick()

    def gains(self, b: Bench, j: int, outside: bool, sign: int):
        field = ("kp", "kd")[j % 2]
        limit = getattr(b.robot, f"{field}_max")[j] if sign > 0 else 0.0
        asked = np.nextafter(limit, sign * np.inf) if outside else limit
        return field, asked, limit, b.tick(command={field: {j: asked}})

    def target_rate(self, b: Bench, j: int, outside: bool, sign: int):
        field = ("joint_vel", "joint_torque")[j % 2]
        limit = b.robot.velocity_max[j] if j % 2 == 0 else b.robot.torque_max[j] * b.robot.safety.torque_ratio
        asked = edge(limit, outside, sign)
        return field, asked, sign * limit, b.tick(command={field: {j: asked}, "kd": {j: 0.0}, "kp": {j: 0.0}})

    def slew(self, b: Bench, j: int, outside: bool, sign: int):
        ratio = b.robot.safety.target_velocity_ratio
        dt = 2 * DT / ratio  # short enough not to reach the end of any joint's range
        limit = b.pose[j] + sign * (b.robot.velocity_max[j] * ratio * dt)
        asked = np.nextafter(limit, sign * np.inf) if outside else limit
        return "joint_pos", asked, limit, b.tick(dt, command={"joint_pos": {j: asked}, "kp": {j: 1.0}})

    def torque_band(self, b: Bench, j: int, outside: bool, sign: int):
        kp, kd = b.robot.kp_max[j], b.robot.kd_max[j] / 2
        torque = b.robot.torque_max[j] * b.robot.safety.torque_ratio
        tau, wanted, measured = 0.5 * sign * torque, 0.01 * sign * torque / kd, -0.02 * sign * torque / kd
        # tau + kd (wanted - measured) is 0.53 of the torque; the walk is short, so the slew is no matter
        limit = b.pose[j] + sign * 0.47 * torque / kp
        asked = limit + sign * NEAR if outside else limit - sign * NEAR
        changes = {"joint_torque": {j: tau}, "joint_vel": {j: wanted}, "kp": {j: kp}, "kd": {j: kd}}
        b.tick(0.05, command={"joint_pos": {j: limit - sign * 0.01}, "kp": {j: 1.0}}, joint_vel={j: measured})
        out = b.tick(0.05, command={"joint_pos": {j: asked}, **changes}, joint_vel={j: measured})
        if outside:
            assert predicted(out, b.pose, np.eye(b.n)[j] * measured)[j] == pytest.approx(sign * torque, rel=1e-12)
            return "joint_pos", asked, pytest.approx(limit, abs=NEAR / 100), out
        return "joint_pos", asked, asked, out

    def soft_range(self, b: Bench, j: int, outside: bool, sign: int):
        margin = b.robot.safety.position_margin
        limit = b.robot.position_max[j] - margin if sign > 0 else b.robot.position_min[j] + margin
        b.safety.stop(b.time)
        b.pose[j] = limit
        b.tick(1.0)  # long enough for the joint to have been brought there
        assert b.arm() is None
        asked = np.nextafter(limit, sign * np.inf) if outside else limit
        return "joint_pos", asked, limit, b.tick(command={"joint_pos": {j: asked}})

    def torque_scale(self, b: Bench, j: int, outside: bool, sign: int):
        robot = b.robot
        torque = robot.torque_max[j] * robot.safety.torque_ratio
        limit = robot.position_max[j] - robot.safety.position_margin
        limit = limit if sign > 0 else robot.position_min[j] + robot.safety.position_margin
        beyond = robot.safety.position_overrun * int(outside)
        b.safety.stop(b.time)
        b.pose[j] = limit + sign * beyond  # the soft range pulls it back, and so does all of the feed-forward
        b.tick(1.0)
        assert b.arm() is None
        kp = robot.kp_max[j]
        out = b.tick(command={"joint_pos": {j: limit}, "joint_torque": {j: -sign * torque}, "kp": {j: kp}})
        assert predicted(out, b.pose, np.zeros(b.n))[j] == pytest.approx(-sign * torque, rel=1e-12)
        scaled = kp * torque / (torque + kp * beyond)
        return "kp", kp, pytest.approx(scaled, rel=1e-12) if outside else kp, out


def names(cases: type) -> list[str]:
    return [name for name, _ in inspect.getmembers(cases, inspect.isfunction)]


def test_every_rule_and_every_clamp_has_its_case():
    assert sorted(names(FaultCases)) == sorted(rule.name for rule in RULES)
    assert sorted(names(ClampCases)) == sorted(clamp.name for clamp in CLAMPS)


@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize("rule", RULES, ids=lambda rule: rule.name)
def test_fault(robot, joints, rule, sign):
    case = getattr(FaultCases(), rule.name)
    for joint in joints:
        for outside in (False, True):
            bench = Bench(robot)
            if rule.when is When.ARM:
                bench.tick()
                refusal = case(bench, joint, outside, sign)
                assert (refusal is not None) == outside, (joint, refusal)
                assert bench.safety.mode == (Mode.OFF if outside else Mode.RUN)
                assert not outside or refusal.startswith(f"{rule.id} {rule.name}: ")
                continue
            case(bench.armed(), joint, outside, sign)
            assert (rule.name in bench.began()) == outside, (joint, bench.safety.events)
            if outside:
                assert bench.safety.mode >= rule.reaction
                fault = bench.began()[rule.name]
                assert fault.value > fault.limit or not np.isfinite(fault.value)
                assert fault.joint in (-1, joint)
                assert fault.time == bench.time


@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize("clamp", CLAMPS, ids=lambda clamp: clamp.name)
def test_clamp(robot, joints, clamp, sign):
    case = getattr(ClampCases(), clamp.name)
    for joint in joints:
        for outside in (False, True):
            bench = Bench(robot).armed()
            field, asked, expected, command = case(bench, joint, outside, sign)
            assert bench.safety.mode == Mode.RUN, bench.safety.fault
            got = getattr(command, field)[joint]
            assert got == expected, (joint, outside)
            assert (got != asked) == outside, (joint, outside)
            bench.assert_inside(command)
            if clamp.name != "not_armed":
                assert bench.safety.limited == int(outside)
