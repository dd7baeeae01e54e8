"""The nouns of the runtime. Arrays are (n,) over ``RobotConfig.joint_names``, SI units, quaternions (w, x, y, z)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import IntEnum

import numpy as np


class Sim2realError(Exception):
    """Something the user can act on: what, where, got, expected, next step. Printed without a traceback."""


class Mode(IntEnum):
    """Severity ladder: a fault only ever moves it up, ``Safety.arm`` is the only way down (to RUN)."""

    RUN = 0  # commands pass, limited
    HOLD = 1  # the last validated command is repeated
    DAMP = 2  # kp = 0, kd > 0 on every joint
    OFF = 3  # motors disabled; only questions are asked


@dataclass(slots=True)
class RobotState:
    """What the robot last said."""

    time: float  # s, clock time of this reading
    joint_pos: np.ndarray  # (n,) rad; NaN: never heard
    joint_vel: np.ndarray  # (n,) rad/s
    joint_torque: np.ndarray  # (n,) N m
    joint_temperature: np.ndarray  # (n,) deg C
    joint_error: np.ndarray  # (n,) int64, 0 healthy
    joint_enabled: np.ndarray  # (n,) bool
    joint_age: np.ndarray  # (n,) s since the reading was received; inf: never
    orientation_base_in_world: np.ndarray  # (4,)
    angular_velocity_base_in_base: np.ndarray  # (3,) rad/s
    acceleration_base_in_base: np.ndarray  # (3,) m/s^2, +g upwards at rest
    imu_age: float  # s; inf: never


@dataclass(slots=True)
class JointCommand:
    """PD targets for every joint, evaluated in the motor:
    ``torque = kp (joint_pos - q) + kd (joint_vel - dq) + joint_torque``."""

    time: float  # s, clock time at which it was decided
    joint_pos: np.ndarray  # (n,) rad
    joint_vel: np.ndarray  # (n,) rad/s
    joint_torque: np.ndarray  # (n,) N m, feed-forward
    kp: np.ndarray  # (n,) N m/rad
    kd: np.ndarray  # (n,) N m s/rad
    object_time: float = math.inf  # s, when the object it rests on was last seen; inf: it rests on none, -inf: never


@dataclass(frozen=True, slots=True)
class OperatorInput:
    """The operator's latest wish. ``skill`` None: keep the current one."""

    time: float  # s, when it was last renewed
    skill: str | None = None
    velocity: tuple[float, float, float] = (0.0, 0.0, 0.0)  # forward m/s, left m/s, turn rad/s
    arm: bool = False  # a held request to be armed
    stop: bool = False  # damp now; never gated
    quit: bool = False  # damp, then end the run
