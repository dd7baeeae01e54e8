"""Robot: joints on one side, motors on buses on the other. The only place that knows signs, offsets and order.

Real and simulated robots are this same class; only the wires under the buses differ.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from drivers.budget import check
from drivers.bus import Clock, Imu, ImuState, MotorBus, MotorCommand, MotorState
from drivers.can_bus import joined
from drivers.open import open_bus, open_imu
from sim2real.config import RobotConfig, Wiring
from sim2real.quaternion import matrix_of, multiply
from sim2real.types import JointCommand, RobotState


class Robot:
    """All buses and the IMU of one wiring. ``read``, ``write``, ``poll``, ``enable``, ``disable`` never block."""

    def __init__(self, config: RobotConfig, buses: Sequence[MotorBus], imu: Imu):
        self.config = config
        self.buses = list(buses)
        self.imu = imu
        motors = [m for bus in self.buses for m in bus.spec.motors]
        joint_of_motor = config.indices([m.joint for m in motors])
        self._motor_of_joint = np.argsort(joint_of_motor)
        self._sign = np.array([m.sign for m in motors], float)[self._motor_of_joint]
        self._offset = np.array([m.offset for m in motors], float)[self._motor_of_joint]
        self._joint_of_motor = joint_of_motor
        # Motors in the order of the joints need no sorting: a slice is a view where indices make a copy.
        ordered = bool((joint_of_motor == np.arange(len(motors))).all())
        self._to_joints = slice(None) if ordered else self._motor_of_joint
        self._to_motors = slice(None) if ordered else joint_of_motor
        self._motor_sign = np.array([m.sign for m in motors], float)
        self._motor_offset = np.array([m.offset for m in motors], float)
        self._parts, sizes = zip(*joined(self.buses), strict=True)  # each read and written in one call
        stops = np.cumsum([0, *sizes])
        self._command = np.zeros((5, len(motors)))  # position, velocity, kp, kd, torque of every motor
        self._commands = [
            MotorCommand(*(self._command[row, start:stop] for row in range(5)))
            for start, stop in zip(stops[:-1], stops[1:], strict=True)
        ]
        self._states = [MotorState.empty(size) for size in sizes]
        self._imu_state = ImuState.empty()
        mount = np.array(imu.spec.orientation_imu_in_base, float)
        self._mount = mount / np.linalg.norm(mount)
        self._mounted_straight = bool(np.allclose(np.abs(self._mount), (1, 0, 0, 0)))
        self._mount_matrix = matrix_of(self._mount)

    def connect(self, clock: Clock) -> None:
        """Find and check every motor, program and read back every watchdog. Raises BusError naming the first misfit."""
        for bus in self.buses:
            bus.connect(clock)

    def shift(self, joint_pos: np.ndarray) -> None:
        """From now on every joint is ``joint_pos`` (n,) rad further than it said so far: turns that its motor lost."""
        self._offset = self._offset - self._sign * joint_pos
        self._motor_offset = self._motor_offset - self._motor_sign * joint_pos[self._joint_of_motor]

    def read(self, now: float, state: RobotState) -> None:
        """Take in everything that arrived and fill ``state`` in place.

        A bus that cannot be read keeps its last state, whose ages grow; the first such BusError is raised at the end.
        """
        states = self._states
        failure = _each(self._parts, lambda bus, i: states.__setitem__(i, bus.read(now)))
        order = self._to_joints
        state.time = now
        motors = states[0] if len(states) == 1 else MotorState.concatenate(states)
        np.subtract(motors.position[order], self._offset, out=state.joint_pos)
        state.joint_pos *= self._sign
        np.multiply(motors.velocity[order], self._sign, out=state.joint_vel)
        np.multiply(motors.torque[order], self._sign, out=state.joint_torque)
        state.joint_temperature[:] = motors.temperature[order]
        state.joint_error[:] = motors.error[order]
        state.joint_enabled[:] = motors.enabled[order]
        np.subtract(now, motors.time[order], out=state.joint_age)
        try:
            imu = self._imu_state = self.imu.read(now)
        except Exception as error:  # noqa: BLE001 - raised below
            imu, failure = self._imu_state, failure or error
        if self._mounted_straight:
            state.orientation_base_in_world[:] = imu.orientation_imu_in_world
            state.angular_velocity_base_in_base[:] = imu.angular_velocity_imu_in_imu
            state.acceleration_base_in_base[:] = imu.acceleration_imu_in_imu
        else:
            state.orientation_base_in_world[:] = multiply(imu.orientation_imu_in_world, self._mount * (1, -1, -1, -1))
            state.angular_velocity_base_in_base[:] = self._mount_matrix @ imu.angular_velocity_imu_in_imu
            state.acceleration_base_in_base[:] = self._mount_matrix @ imu.acceleration_imu_in_imu
        state.imu_age = now - imu.time
        if failure is not None:
            raise failure

    def write(self, command: JointCommand) -> None:
        """Send one tick of joint targets. Raises BusError when a wire is gone (the other buses are still written)."""
        of = self._to_motors
        sign = self._motor_sign
        c = self._command
        np.add(command.joint_pos[of] * sign, self._motor_offset, out=c[0])
        np.multiply(command.joint_vel[of], sign, out=c[1])
        c[2] = command.kp[of]
        c[3] = command.kd[of]
        np.multiply(command.joint_torque[of], sign, out=c[4])
        self._act(self._parts, lambda bus, i: bus.write(self._commands[i]))

    def poll(self) -> None:
        """Ask every motor for its state, commanding nothing."""
        self._act(self.buses, lambda bus, i: bus.poll())

    def enable(self) -> None:
        self._act(self.buses, lambda bus, i: bus.enable())

    def disable(self) -> None:
        """Take torque off every motor. Never raises."""
        for bus in self.buses:
            bus.disable()

    def error_name(self, joint: int, code: int) -> str:
        """The motor protocol's name for a joint's error code."""
        motor = int(self._motor_of_joint[joint])
        for bus in self.buses:
            if motor < len(bus.spec.motors):
                return bus.error_name(code)
            motor -= len(bus.spec.motors)
        raise IndexError(joint)

    def close(self) -> None:
        for bus in self.buses:
            bus.close()
        self.imu.close()

    def _act(self, parts: Sequence[Any], act: Callable[[Any, int], None]) -> None:
        if (failure := _each(parts, act)) is not None:
            raise failure


def _each(parts: Sequence[Any], act: Callable[[Any, int], None]) -> Exception | None:
    """Do it on every bus even if one fails, for one dead bus must not silence four. Returns the first failure."""
    first: Exception | None = None
    for i, part in enumerate(parts):
        try:
            act(part, i)
        except Exception as error:  # noqa: BLE001 - returned
            first = first or error
    return first


def open_robot(
    config: RobotConfig, wiring: Wiring, wires: Mapping[str, object] | None = None, simulated_in: str | None = None
) -> Robot:
    """Open the buses and the IMU of ``wiring``.

    ``wires`` (bus name or "imu" -> wire) replaces the real ones; ``simulated_in`` is the directory of a simulated world's
    sockets, one per bus. Raises BusError for a wiring that cannot make its rate.
    """
    wires = wires or {}
    for spec in wiring.bus_specs():
        check(spec, wiring.rate)
    buses, imu = wiring.bus_specs(), wiring.imu_spec()
    if simulated_in is not None:
        buses = [replace(b, interface="sim", channel=f"{simulated_in}/{b.name}.sock") for b in buses]
        imu = replace(imu, interface="sim", channel=f"{simulated_in}/imu.sock")
    return Robot(config, [open_bus(b, wires.get(b.name)) for b in buses], open_imu(imu, wires.get("imu")))
