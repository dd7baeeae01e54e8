"""A bench for the gate: a healthy robot, a sensible command, and a clock that moves when told to."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from sim2real.config import RobotConfig
from sim2real.safety import Fault, Limits, Safety
from sim2real.types import JointCommand, Mode, RobotState

DT = 1 / 256  # s: a binary fraction, so that the times of ticks are exact
G = 9.80665
MANY = 10_000  # ticks: no test needs as many
FIELDS = ("joint_pos", "joint_vel", "joint_torque", "kp", "kd")


class Bench:
    """One gate and what stands before it. ``tick`` and ``arm`` take changes to the healthy state by field name.

    A change is a whole value, or ``{index: value}``; of the command the same under ``command=``.
    """

    def __init__(self, robot: RobotConfig, start: float = 1.0):
        self.robot, self.limits = robot, Limits.of(robot)
        self.n = len(robot.joint_names)
        self.safety = Safety(self.limits)
        self.time = start
        self.pose = robot.home_pos.copy()
        self.command_time: float | None = None  # None: fresh at every tick
        self.ticks = 0

    def state(self, **changes) -> RobotState:
        n = self.n
        state = RobotState(
            time=self.time,
            joint_pos=self.pose.copy(),
            joint_vel=np.zeros(n),
            joint_torque=np.zeros(n),
            joint_temperature=np.full(n, 40.0),
            joint_error=np.zeros(n, np.int64),
            joint_enabled=np.ones(n, bool),
            joint_age=np.zeros(n),
            orientation_base_in_world=np.array([1.0, 0.0, 0.0, 0.0]),
            angular_velocity_base_in_base=np.array([1e-4 * self.time, 0.0, 0.0]),  # a live gyro never repeats itself
            acceleration_base_in_base=np.array([0.0, 0.0, G]),
            imu_age=0.0,
        )
        return _changed(state, changes)

    def command(self, **changes) -> JointCommand:
        """A target at the pose, with half of the gains that the robot may have."""
        time = self.time if self.command_time is None else self.command_time
        command = JointCommand(
            time, self.pose.copy(), np.zeros(self.n), np.zeros(self.n), self.limits.kp_max / 2, self.limits.kd_max / 2
        )
        return _changed(command, changes)

    def tick(self, dt: float = DT, command: Mapping | None = None, **changes) -> JointCommand:
        """Advance the clock and step the gate."""
        self.ticks += 1
        assert self.ticks < MANY, "a gate that was to answer never did"
        self.time += dt
        return self.safety.step(self.state(**changes), self.command(**command or {}), self.time)

    def arm(self, dt: float = DT, **changes) -> str | None:
        self.time += dt
        return self.safety.arm(self.state(**changes), self.time)

    def armed(self) -> Bench:
        """Armed, and obeying for long enough that no grace of arming is left."""
        self.tick()
        assert self.arm() is None
        for _ in range(2):
            self.tick(12 * DT)
        assert self.safety.mode == Mode.RUN
        return self

    def began(self) -> dict[str, Fault]:
        """Faults that began in the last step, by the name of their rule."""
        return {fault.rule.name: fault for fault in self.safety.events if not fault.over}

    def assert_inside(self, command: JointCommand) -> None:
        """The first sentence of SAFETY.md, from the robot's own numbers."""
        robot, margin = self.robot, self.robot.safety.position_margin
        for field in FIELDS:
            assert np.isfinite(getattr(command, field)).all(), field
        assert (command.joint_pos >= robot.position_min + margin).all()
        assert (command.joint_pos <= robot.position_max - margin).all()
        assert (np.abs(command.joint_vel) <= robot.velocity_max).all()
        assert (np.abs(command.joint_torque) <= robot.torque_max * robot.safety.torque_ratio).all()
        assert (command.kp >= 0).all() and (command.kp <= robot.kp_max).all()
        assert (command.kd >= 0).all() and (command.kd <= robot.kd_max).all()


def predicted(command: JointCommand, joint_pos: np.ndarray, joint_vel: np.ndarray) -> np.ndarray:
    """The torque that motors obeying ``command`` would make, N m (n,)."""
    return (
        command.kp * (command.joint_pos - joint_pos)
        + command.kd * (command.joint_vel - joint_vel)
        + (command.joint_torque)
    )


def copy(command: JointCommand) -> JointCommand:
    """The gate reuses what it returns."""
    return JointCommand(command.time, *(getattr(command, field).copy() for field in FIELDS))


def _changed(record, changes: Mapping):
    for field, change in changes.items():
        if isinstance(change, Mapping):
            for index, value in change.items():
                getattr(record, field)[index] = value
        else:
            setattr(record, field, change)
    return record
