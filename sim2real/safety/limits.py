"""Limits: what each joint may be asked, and how a request is brought inside."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from sim2real.types import Sim2realError

POSITION, VELOCITY, TORQUE, KP, KD = range(5)  # rows of every (5, n) block of targets
KP_FLOOR = 1e-6  # N m/rad: below it no reachable target makes a torque; the final scaling bounds what is left

THRESHOLDS = (
    "position_overrun", "jump_ratio", "tilt", "angular_velocity", "temperature_warn", "temperature", "joint_age",
    "imu_age", "imu_frozen", "orientation_norm", "enable_time", "command_age_hold", "command_age", "object_age",
    "hold_time", "arm_tilt", "arm_velocity", "arm_gravity", "tick_gap",
)  # fmt: skip


@dataclass(frozen=True)
class Limits:
    """What one robot allows. Arrays are (n,) in joint order; scalars are the fields of ``safety:`` in the robot's YAML."""

    joint_names: tuple[str, ...]
    position_min: np.ndarray  # rad, the mechanical range
    position_max: np.ndarray
    target_min: np.ndarray  # rad, the soft range: no target ever leaves it
    target_max: np.ndarray
    velocity: np.ndarray  # rad/s, of the joint
    velocity_max: np.ndarray  # rad/s, measured above this is a fault
    target_velocity: np.ndarray  # rad/s, how fast a target may move
    torque: np.ndarray  # N m, the torque that a command may predict
    kp_max: np.ndarray  # N m/rad
    kd_max: np.ndarray  # N m s/rad
    damping: np.ndarray  # N m s/rad, kd while damping
    unread: np.ndarray  # deg C, what no temperature counts as: NaN where a motor has a thermometer, else -inf
    position_overrun: float  # rad
    jump_ratio: float
    tilt: float  # rad
    angular_velocity: float  # rad/s
    temperature_warn: float  # deg C
    temperature: float  # deg C
    joint_age: float  # s
    imu_age: float  # s
    imu_frozen: float  # samples
    orientation_norm: float
    enable_time: float  # s
    command_age_hold: float  # s
    command_age: float  # s
    object_age: float  # s
    hold_time: float  # s
    arm_tilt: float  # rad
    arm_velocity: float  # rad/s
    arm_gravity: float  # m/s^2
    tick_gap: float  # s

    @classmethod
    def of(cls, config: Any) -> Limits:
        """The limits of a ``RobotConfig``. Raises Sim2realError naming a joint whose numbers contradict each other."""
        safety = config.safety
        return cls(
            joint_names=tuple(config.joint_names),
            position_min=config.position_min,
            position_max=config.position_max,
            target_min=config.position_min + safety.position_margin,
            target_max=config.position_max - safety.position_margin,
            velocity=config.velocity_max,
            velocity_max=config.velocity_max * safety.velocity_max_ratio,
            target_velocity=config.velocity_max * safety.target_velocity_ratio,
            torque=config.torque_max * safety.torque_ratio,
            kp_max=config.kp_max,
            kd_max=config.kd_max,
            damping=config.damping,
            unread=np.where(config.thermometer, np.nan, -np.inf),
            **{name: getattr(safety, name) for name in THRESHOLDS},
        )

    def __post_init__(self) -> None:
        for name, low, high in zip(self.joint_names, self.target_min, self.target_max, strict=True):
            if not low < high:
                raise Sim2realError(
                    f"{name}: the soft range is [{low:g}, {high:g}] rad, expected lower < upper; "
                    "reduce safety.position_margin or correct the joint's position range"
                )
        for name, damping, kd_max in zip(self.joint_names, self.damping, self.kd_max, strict=True):
            if not damping <= kd_max:
                raise Sim2realError(
                    f"{name}: damping is {damping:g} N m s/rad, expected at most kd_max {kd_max:g}; "
                    "lower damping or raise kd_max if the motor allows it"
                )

    def low(self) -> np.ndarray:
        """The least value of every row of a block of targets (5, n)."""
        zero = np.zeros_like(self.torque)
        return np.stack([self.target_min, -self.velocity, -self.torque, zero, zero])

    def high(self) -> np.ndarray:
        """The greatest value of every row of a block of targets (5, n)."""
        return np.stack([self.target_max, self.velocity, self.torque, self.kp_max, self.kd_max])


class Limiter:
    """Brings a request inside the limits. ``targets`` (5, n) holds the last result: what was last commanded."""

    def __init__(self, limits: Limits):
        self.limits = limits
        self.low, self.high = limits.low(), limits.high()
        self.targets = np.zeros_like(self.low)

    def rest(self) -> None:
        """All zero, or the nearest to it that the soft range allows: motors that obey this make no torque."""
        self.targets[:] = 0.0
        self._inside(slice(None))

    def damp(self, position: np.ndarray) -> None:
        """kp 0, kd the joint's damping, at rest at ``position`` (n,) as far as it is inside the soft range."""
        self.rest()
        self.targets[POSITION] = position
        self.targets[KD] = self.limits.damping
        self._inside(POSITION)

    def limit(self, request: np.ndarray, position: np.ndarray, velocity: np.ndarray, elapsed: float) -> int:
        """Replace ``targets`` by the nearest allowed to ``request`` (5, n). Returns how many joints' request was changed.

        ``position`` (n,) rad and ``velocity`` (n,) rad/s are measured, ``elapsed`` s since the last call. In this order:
        velocity, torque and gains into their range; the target no faster than ``target_velocity`` from where it was last
        *commanded* (as libfranka does: the measured position lags and would let it creep); the target to where the
        predicted torque ``kp (q* - q) + kd (dq* - dq) + tau`` is within the joint's torque; the target into the soft
        range, which has the last word on it. Where that leaves too much torque, kp, kd and tau shrink in one proportion.
        """
        limits, targets, torque = self.limits, self.targets, self.limits.torque
        last = targets[POSITION].copy()
        targets[:] = request
        self._inside(slice(VELOCITY, None))
        target, kp = targets[POSITION], targets[KP]
        step = limits.target_velocity * elapsed
        _clip(target, last - step, last + step)
        offset = targets[KD] * (targets[VELOCITY] - velocity) + targets[TORQUE]
        stiffness = np.maximum(kp, KP_FLOOR)
        _clip(target, position + (-torque - offset) / stiffness, position + (torque - offset) / stiffness)
        self._inside(POSITION)
        predicted = np.abs(kp * (target - position) + offset)
        targets[TORQUE:] *= torque / np.maximum(predicted, torque)
        return int(np.count_nonzero(np.logical_or.reduce(targets != request)))

    def _inside(self, rows: int | slice) -> None:
        _clip(self.targets[rows], self.low[rows], self.high[rows])


def _clip(values: np.ndarray, low: np.ndarray, high: np.ndarray) -> None:
    """In place; a third of the time of np.clip on arrays as small as these."""
    np.maximum(values, low, out=values)
    np.minimum(values, high, out=values)
