"""The table of rules. ``python -m sim2real.safety`` prints it as it stands in SAFETY.md.

A fault rule is a row: a value from the evidence, and the limit that it must not exceed. NaN exceeds every limit.
To add one, add a row; the tests fail until it has its boundary cases.
"""

from __future__ import annotations

from collections.abc import Callable
from enum import Enum
from typing import NamedTuple

import numpy as np

from sim2real.safety.evidence import FINITE, Evidence
from sim2real.safety.limits import Limits
from sim2real.types import Mode


class When(Enum):
    """When a rule is asked."""

    ALWAYS = "always"  # about the state: a fault while armed, a refusal to arm
    COMMAND = (
        "armed, to re-arm"  # about the command: where it was what stopped the robot, it must be over before arming
    )
    ARMED = "armed"  # about the run: gone by arming again
    ARM = "to arm"  # stricter, of a robot that does not move yet


class Rule(NamedTuple):
    """``value`` of the evidence must be at most ``limit`` of the limits: floats, or (n,) where it is of each joint."""

    number: int
    name: str
    reaction: Mode  # RUN: report only
    when: When
    bound: float  # s, at most, from the cause to the first corrected command, at the default thresholds and 250 Hz
    source: str
    value: Callable[[Evidence], float | np.ndarray]
    limit: Callable[[Limits], float | np.ndarray]
    unit: str
    description: str
    remedy: str

    @property
    def id(self) -> str:
        return f"S2R-{self.number:03d}"


class Clamp(NamedTuple):
    """A row of what is done to every command in RUN and HOLD. It is no fault: the command is changed and counted."""

    number: int
    name: str
    source: str
    description: str

    @property
    def id(self) -> str:
        return f"S2R-{self.number:03d}"


RUN, HOLD, DAMP = Mode.RUN, Mode.HOLD, Mode.DAMP
ALWAYS, COMMAND, ARMED, ARM = When.ALWAYS, When.COMMAND, When.ARMED, When.ARM

# fmt: off
RULES = (
    Rule(1, "position_finite", DAMP, ALWAYS, 0.004, "F4",
         lambda e: np.abs(e.measured), lambda _: FINITE, "rad",
         "a joint's position is not a number", "see whether its motor answers"),
    Rule(2, "velocity_finite", DAMP, ALWAYS, 0.004, "F4",
         lambda e: np.abs(e.joint_vel), lambda _: FINITE, "rad/s",
         "a joint's velocity is not a number", "see whether its motor answers"),
    Rule(3, "imu_finite", DAMP, ALWAYS, 0.004, "F4",
         lambda e: np.maximum.reduce(np.abs(e.imu)), lambda _: FINITE, "",
         "an orientation, angular velocity or acceleration is not a number", "check the IMU's cable and protocol"),
    Rule(4, "joint_age", DAMP, ALWAYS, 0.044, "F1, F2, F3, F34",
         lambda e: e.joint_age, lambda m: m.joint_age, "s",
         "a joint has not been heard", "check power, connector and termination of its bus"),
    Rule(5, "imu_age", DAMP, ALWAYS, 0.044, "F3",
         lambda e: e.imu_age, lambda m: m.imu_age, "s",
         "the IMU has not been heard", "check its cable and rate"),
    Rule(6, "imu_frozen", DAMP, ALWAYS, 0.016, "F9; PX4 failure 'gyro stuck'",
         lambda e: e.gyro_repeats, lambda m: m.imu_frozen, "equal samples",
         "fresh IMU samples repeat the gyro bit by bit", "restart the IMU"),
    Rule(7, "orientation_norm", DAMP, ALWAYS, 0.004, "F10",
         lambda e: e.norm_error(), lambda m: m.orientation_norm, "from 1",
         "the base's quaternion is not a unit one", "check the IMU's protocol and its quaternion order"),
    Rule(8, "position_overrun", DAMP, ALWAYS, 0.004, "F15, F16",
         lambda e: e.position_overrun(), lambda m: m.position_overrun, "rad beyond its range",
         "a joint is measured outside its mechanical range", "bring it back by hand, or correct its sign and offset"),
    Rule(9, "joint_velocity", DAMP, ALWAYS, 0.004, "F14; libfranka joint_velocity_violation",
         lambda e: e.speed(), lambda m: m.velocity_max, "rad/s",
         "a joint is measured faster than it may be", "wait until it stands still; then look for what drove it"),
    Rule(10, "encoder_jump", DAMP, ALWAYS, 0.008, "F14",
         lambda e: e.jump_ticks, lambda _: 1, "ticks in a row",
         "a joint's position moved faster than it can; the first such reading is not believed", "check its encoder"),
    Rule(11, "tilt", DAMP, ALWAYS, 0.004, "F18; PX4 FD_FAIL_R, FD_FAIL_P",
         lambda e: e.tilt(), lambda m: m.tilt, "rad",
         "the base leans: the robot is falling", "set it upright"),
    Rule(12, "angular_velocity", DAMP, ALWAYS, 0.004, "F18",
         lambda e: e.turn_rate(), lambda m: m.angular_velocity, "rad/s",
         "the base turns too fast", "steady it"),
    Rule(13, "temperature", DAMP, ALWAYS, 0.004, "F11; moteus fault temperature",
         lambda e: e.heat(), lambda m: m.temperature, "deg C",
         "a motor is too hot", "let it cool; nan: it reports none, see `thermometer` in sim2real/config.py"),
    Rule(14, "temperature_warn", RUN, ALWAYS, 0.004, "F11; moteus derate temperature",
         lambda e: e.heat(), lambda m: m.temperature_warn, "deg C",
         "a motor is getting hot; only reported", "rest it soon"),
    Rule(15, "motor_error", DAMP, ALWAYS, 0.004, "F11, F12",
         lambda e: np.abs(e.error), lambda _: 0, "(the motor's own code)",
         "a motor reports an error", "look the code up in its manual, clear it at the motor"),
    Rule(28, "object_age", HOLD, ALWAYS, 0.004, "F3",
         lambda e: e.object_age(), lambda m: m.object_age, "s",
         "the object of the skill has been out of sight for longer than its estimate is good for",
         "bring it into sight, and see whether its camera sends"),
    Rule(16, "command_finite", HOLD, COMMAND, 0.004, "F5; libfranka checkFinite",
         lambda e: np.maximum.reduce(np.abs(e.request)), lambda _: FINITE, "in the command",
         "a command holds something that is not a number, or not one number per joint", "fix or change the policy"),
    Rule(17, "command_age_hold", HOLD, COMMAND, 0.044, "F7",
         lambda e: e.command_age(), lambda m: m.command_age_hold, "s",
         "no fresh command", "see whether the pilot runs and keeps its rate"),
    Rule(18, "command_age", DAMP, COMMAND, 0.064, "F7, F23; betaflight stage 2",
         lambda e: e.command_age(), lambda m: m.command_age, "s",
         "no fresh command for long", "see whether the pilot runs and keeps its rate"),
    Rule(19, "hold_time", DAMP, ARMED, 0.048, "F3, F5, F7",
         lambda e: e.held_for(), lambda m: m.hold_time, "s held",
         "the cause of a hold did not end", "see the fault that began the hold"),
    Rule(20, "motor_enabled", DAMP, ARMED, 0.064, "F2; IEC 60204-1 loss of an actuator",
         lambda e: e.disabled_for(), lambda m: m.enable_time, "s without enable",
         "a motor does not say that it is enabled", "see its error and its watchdog, then arm again"),
    Rule(21, "tick_gap", DAMP, ARMED, 0.0, "F8, F25",
         lambda e: e.gap, lambda m: m.tick_gap, "s since the last tick",
         "the gate itself was not run, as in a suspended process", "find what stopped it"),
    Rule(22, "time_backwards", DAMP, ARMED, 0.004, "F30",
         lambda e: -e.gap, lambda _: 0, "s backwards",
         "time went backwards", "use a monotonic clock"),
    Rule(23, "arm_tilt", DAMP, ARM, 0.0, "F10, F18",
         lambda e: e.tilt(), lambda m: m.arm_tilt, "rad",
         "the base is not upright", "set it upright"),
    Rule(24, "arm_velocity", DAMP, ARM, 0.0, "F35; libfranka start_pose_invalid",
         lambda e: e.speed(), lambda m: m.arm_velocity, "rad/s",
         "a joint moves", "wait until it stands still"),
    Rule(25, "arm_angular_velocity", DAMP, ARM, 0.0, "F10",
         lambda e: e.turn_rate(), lambda m: m.arm_velocity, "rad/s",
         "the base turns", "wait until it hangs or stands still"),
    Rule(26, "arm_gravity", DAMP, ARM, 0.0, "F10",
         lambda e: e.gravity_error(), lambda m: m.arm_gravity, "m/s^2 off gravity",
         "acceleration and orientation disagree", "check how the IMU is mounted and its quaternion order"),
    Rule(27, "arm_encoder", DAMP, ARM, 0.0, "F15",
         lambda e: e.jump_ticks, lambda _: 0, "ticks in a row",
         "a joint's position is not where it just was", "keep it still; check its encoder"),
)

CLAMPS = (
    Clamp(30, "not_armed", "F35; opendbc controls_allowed",
          "a command is obeyed only in RUN, and only if it was decided after arming"),
    Clamp(31, "gains", "instinct_onboard gain clip", "kp in [0, kp_max], kd in [0, kd_max]"),
    Clamp(32, "target_rate", "F6; libfranka rate limiting",
          "target velocity and feed-forward torque within the joint's velocity and torque"),
    Clamp(33, "slew", "F6, F35; libfranka rate limiting",
          "a target moves at most target_velocity_ratio x velocity from where it was last commanded"),
    Clamp(34, "torque_band", "F17; instinct_onboard torque-limit clip",
          "the target moves until |kp (q* - q) + kd (dq* - dq) + tau| <= torque; faster than the slew if need be"),
    Clamp(35, "soft_range", "F16",
          "the target stays position_margin inside the mechanical range, wherever the joint is measured; this has the "
          "last word"),
    Clamp(36, "torque_scale", "F17", "where the soft range leaves too much torque, kp, kd and tau shrink in proportion"),
)
# fmt: on


def markdown() -> str:
    """Both tables as SAFETY.md shows them."""
    lines = [
        "| id | rule | reaction | asked | bound | the fault | source |",
        "|---|---|---|---|---|---|---|",
    ]
    for r in RULES:
        reaction = "refuse" if r.when is ARM else "report" if r.reaction is RUN else r.reaction.name
        bound = "-" if r.when is ARM else f"{r.bound:g} s"
        lines.append(f"| {r.id} | `{r.name}` | {reaction} | {r.when.value} | {bound} | {r.description} | {r.source} |")
    lines += ["", "| id | limit | what is done to every command | source |", "|---|---|---|---|"]
    lines += [f"| {c.id} | `{c.name}` | {c.description} | {c.source} |" for c in CLAMPS]
    return "\n".join(lines)
