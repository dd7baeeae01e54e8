"""A World whose motors are servos on serial lines instead of motors on CAN.

Every bus is a line of its own (serial_line.py) with its servos (servo.py), all of them on the joints of one plant. How a
line is served to other processes: SerialPort. For other programs, servos without a robot: serial_pty.py.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict

import numpy as np

from drivers.bus import BusError, BusSpec, ImuSpec
from drivers.open import PROTOCOLS, load
from drivers.sim.faults import Fault
from drivers.sim.imu import ImuNoise
from drivers.sim.motor import MotorEvent
from drivers.sim.plant import Plant
from drivers.sim.serial_line import GAP, SerialLine, SerialLineWire
from drivers.sim.servo_table import TableServos
from drivers.sim.world import World
from drivers.wire import WireError


class SerialWorld(World):
    """A robot in MuJoCo behind simulated serial lines. Arguments as for World."""

    def _check(self, buses: Sequence[BusSpec]) -> None:
        known = [name for name, p in PROTOCOLS.items() if p.wire == "serial" and p.motors]
        if strangers := sorted({b.protocol for b in buses} - set(known)):
            raise BusError(
                f"no emulated servos for {', '.join(strangers)} on a serial line; expected {' or '.join(known)} on every bus"
            )

    def _wire(
        self,
        buses: Sequence[BusSpec],
        imu: ImuSpec,
        seed: int,
        *,
        registers: Mapping[str, Mapping[str, int]] | None = None,
        imu_noise: ImuNoise | None = None,
        latency: float = 250e-6,
        gap: float = GAP,
        fast: bool = True,
        patient: bool = False,
    ) -> None:
        """``gap``: see serial_line.py; ``fast`` and ``patient``: see SimServos."""
        self.motors = AllServos(buses, self.plant, registers or {}, fast, patient)
        self.lines = [
            SerialLine(servos.spec, servos, seed=seed, latency=latency, gap=gap) for servos in self.motors.buses
        ]
        self.wires = {line.spec.name: SerialLineWire(line, self.now) for line in self.lines}
        self.ports = {line.spec.name: SerialPort(line) for line in self.lines}
        self._wire_imu(imu, seed, imu_noise, latency)

    def _carry(self, until: float) -> None:
        for line in self.lines:
            line.carry(until)
            line.digest(self._sha)
        self.imu.digest(self._sha)

    @property
    def busy(self) -> bool:
        return any(line.busy for line in self.lines)

    def _befall(self, fault: Fault, rows: list[int]) -> None:
        """Every line lets it befall its own; it also switches their power, at the very time."""
        for bus in dict.fromkeys(self.motors.bus_names[row] for row in rows):
            next(line for line in self.lines if line.spec.name == bus).inject(fault)

    def counters(self) -> dict[str, dict[str, float]]:
        """By bus: see serial_line.Traffic, and ``load``, the share of all time so far that the line was taken."""
        return {
            li.spec.name: asdict(li.traffic) | {"load": li.traffic.busy / self.time if self.time else 0.0}
            for li in self.lines
        }


class AllServos:
    """The servos of all buses, each bus on its share of the joints of ``body``."""

    speaks = False  # without being asked

    def __init__(
        self,
        buses: Sequence[BusSpec],
        body: Plant,
        registers: Mapping[str, Mapping[str, int]],
        fast: bool,
        patient: bool,
    ):
        self.joints = [m.joint for b in buses for m in b.motors]
        self.bus_names = [b.name for b in buses for _ in b.motors]
        if unknown := sorted(set(registers) - set(self.joints)):
            raise BusError(f"registers: got joints {unknown}, expected some of {', '.join(self.joints)}")
        self.log: list[MotorEvent] = []
        self.buses: list[TableServos] = []
        shared = np.zeros((4, len(self.joints)))
        first = 0
        for spec in buses:
            own = {m.joint: registers[m.joint] for m in spec.motors if m.joint in registers}
            part = BodyPart(body, slice(first, first + len(spec.motors)), shared)
            servos = load(PROTOCOLS[spec.protocol].motors)
            self.buses.append(servos(spec, part, registers=own, fast=fast, patient=patient, log=self.log))
            first += len(spec.motors)

    def act(self, start: float, end: float) -> None:
        for servos in self.buses:
            servos.act(start, end)

    @property
    def enabled(self) -> np.ndarray:
        """(n,) bool: torque is on."""
        return np.concatenate([servos.enabled for servos in self.buses])

    @property
    def last_command_time(self) -> np.ndarray:
        """(n,) s, when a goal was last written; -inf: never."""
        return np.concatenate([servos.last_command_time for servos in self.buses])


class BodyPart:
    """Some joints of a body (a motor.Body). ``shared`` (4, all joints): the laws and limits of all parts."""

    def __init__(self, body: Plant, rows: slice, shared: np.ndarray):
        self._body, self._rows, self._shared = body, rows, shared

    @property
    def joint_pos(self) -> np.ndarray:
        return self._body.joint_pos[self._rows]

    @property
    def joint_vel(self) -> np.ndarray:
        return self._body.joint_vel[self._rows]

    @property
    def joint_torque(self) -> np.ndarray:
        return self._body.joint_torque[self._rows]

    def drive(self, bias: np.ndarray, kp: np.ndarray, kd: np.ndarray) -> None:
        self._shared[:3, self._rows] = bias, kp, kd
        self._body.drive(*self._shared[:3])

    def limit(self, torque: np.ndarray) -> None:
        self._shared[3, self._rows] = torque
        self._body.limit(self._shared[3])


class SerialPort:
    """A line as ``serve.Server`` offers it to other processes (a serve.Port): bytes either way."""

    def __init__(self, line: SerialLine):
        self._line = line

    def hear(self, data: bytes, now: float) -> bytes:
        try:
            self._line.write(data, now)
        except WireError:
            pass  # an adapter that is gone takes nothing
        return b""

    def give(self, now: float) -> bytes:
        try:
            return self._line.read(now)
        except WireError:
            return b""
