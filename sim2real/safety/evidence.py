"""Evidence: everything the rules look at, taken from the state and the command of this tick and the few before."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from sim2real.safety.limits import Limits
from sim2real.types import JointCommand, RobotState

GRAVITY = 9.80665  # m/s^2
FARTHEST = 1e3  # rad: no joint is this far from where it was
FINITE = float(np.finfo(float).max)  # the greatest number that is one
SAME_SAMPLE = 1e-6  # s: receive times nearer than this are one and the same IMU sample


class Evidence:
    """Filled by ``see`` and ``hear``; arrays are copies, so nobody changes them while they are judged.

    Whatever does not have one number per joint is taken as NaN, and NaN passes no rule. An age below zero is as suspect
    as one above: a reading from the future would stay fresh for ever.
    """

    def __init__(self, limits: Limits):
        n = len(limits.joint_names)
        self.limits = limits
        self.now = math.nan  # s, clock time of this tick
        self.armed_since = math.nan  # s
        self.holding_since = math.inf  # s; inf: not holding
        self._joints = np.full((6, n), np.nan)
        self.measured, self.joint_vel, self.temperature, self.error, self.enabled, self.joint_age = self._joints
        self.joint_pos = np.zeros(n)  # rad, the last measured that was no jump
        self.jump_ticks = np.zeros(n)  # ticks in a row in which ``measured`` had jumped away from ``joint_pos``
        self._fastest = limits.velocity * limits.jump_ratio  # rad/s
        self._sampled = np.full(n, -math.inf)  # s, when ``joint_pos`` was received
        self.enabled_at = np.full(n, -math.inf)  # s, when each motor last said that it is enabled
        self.imu = np.full(10, np.nan)
        self._imu_parts = self.imu[:4], self.imu[4:7], self.imu[7:]
        self._imu_sampled = math.inf  # s
        self._gyro = b""
        self.gyro_repeats = math.nan  # fresh samples in a row with the same bits
        self.request = np.zeros((5, n))  # the newest command: position, velocity, torque, kp, kd
        self.command_time = -math.inf  # s, when it was decided
        self.object_time = math.inf  # s, when the object it rests on was last seen; inf: it rests on none

    def see(self, state: RobotState, now: float) -> None:
        """Take in a state. One that is not of this moment makes every reading in it that much older."""
        self.gap, self.now = now - self.now, now  # s since the tick before
        late = abs(now - state.time)
        _fill(
            self._joints,
            (state.joint_pos, state.joint_vel, state.joint_temperature, state.joint_error, state.joint_enabled,
             state.joint_age),
        )  # fmt: skip
        np.add(np.abs(self.joint_age), late, out=self.joint_age)
        self._track_jumps(now)
        np.copyto(self.enabled_at, now, where=self.enabled > 0)
        _fill(
            self._imu_parts,
            (state.orientation_base_in_world, state.angular_velocity_base_in_base, state.acceleration_base_in_base),
        )
        self.imu_age = abs(state.imu_age) + late
        self._track_gyro(state.time - state.imu_age)

    def hear(self, command: JointCommand | None) -> None:
        """Take in the newest command; None: there is none that is newer."""
        if command is not None:
            self.command_time, self.object_time = command.time, command.object_time
            _fill(self.request, (command.joint_pos, command.joint_vel, command.joint_torque, command.kp, command.kd))

    def _track_jumps(self, now: float) -> None:
        reach = np.fmin(self._fastest * (now - self._sampled), FARTHEST)  # NaN: after an age that was none
        real = np.abs(self.measured - self.joint_pos) <= reach
        self.jump_ticks += 1
        np.copyto(self.jump_ticks, 0, where=real)
        np.copyto(self.joint_pos, self.measured, where=real)
        np.subtract(now, self.joint_age, out=self._sampled, where=real)

    def _track_gyro(self, sampled: float) -> None:
        if abs(sampled - self._imu_sampled) > SAME_SAMPLE:
            gyro = self._imu_parts[1].tobytes()
            self.gyro_repeats = self.gyro_repeats + 1 if gyro == self._gyro else 1
            self._gyro, self._imu_sampled = gyro, sampled

    # What the rules compare with a limit.

    def position_overrun(self) -> np.ndarray:
        """How far each joint is beyond its mechanical range, rad; negative: inside."""
        return np.maximum(self.joint_pos - self.limits.position_max, self.limits.position_min - self.joint_pos)

    def speed(self) -> np.ndarray:
        return np.abs(self.joint_vel)

    def heat(self) -> np.ndarray:
        """deg C; of a motor without a thermometer that says nothing -inf, of any other that says nothing NaN."""
        return np.fmax(self.temperature, self.limits.unread)

    def disabled_for(self) -> np.ndarray:
        """For how long each motor has not said that it is enabled, not counting the time before arming, s."""
        return self.now - np.maximum(self.enabled_at, self.armed_since)

    def norm_error(self) -> float:
        return abs(math.hypot(*self.imu[:4].tolist()) - 1)

    def tilt(self) -> float:
        """Angle between the base's up and the world's, rad; exact for any norm, 0 / 0 included."""
        w, x, y, z = self.imu[:4].tolist()
        return 2 * math.atan2(math.hypot(x, y), math.hypot(w, z))

    def turn_rate(self) -> float:
        return math.hypot(*self._imu_parts[1].tolist())

    def gravity_error(self) -> float:
        """Between the measured acceleration and the one that the measured orientation predicts at rest, m/s^2.

        A wrong quaternion order, a flipped or a badly mounted IMU shows here.
        """
        w, x, y, z, _, _, _, *acceleration = self.imu.tolist()
        up_world_in_base = 2 * (x * z - w * y), 2 * (y * z + w * x), w * w - x * x - y * y + z * z
        return math.dist(acceleration, [GRAVITY * u for u in up_world_in_base])

    def command_age(self) -> float:
        """s; a command from the future is as suspect as one from the past. Counts from arming at the earliest."""
        return abs(self.now - max(self.command_time, self.armed_since))

    def object_age(self) -> float:
        """s since the object that the newest command rests on was seen; one from the future is as suspect."""
        return 0.0 if self.object_time == math.inf else abs(self.now - self.object_time)

    def held_for(self) -> float:
        return self.now - self.holding_since


def _fill(rows: Sequence[np.ndarray] | np.ndarray, arrays: tuple[np.ndarray, ...]) -> None:
    for i, array in enumerate(arrays):
        row = rows[i]
        fits = getattr(array, "shape", None) == row.shape and array.dtype.kind in "fiub"
        row[:] = array if fits else np.nan
