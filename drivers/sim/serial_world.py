"""A World whose motors are servos on serial lines instead of motors on CAN.

Every bus is a line of its own (serial_line.py) with its servos (servo.py), all of them on the joints of one plant. How a
line is served to other processes: SerialPort. For other programs, servos without a robot: serial_pty.py.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from drivers.bus import BusError, BusSpec, ImuSpec
from drivers.open import PROTOCOLS, load
from drivers.sim.faults import IMU, Fault, parse_fault
from drivers.sim.imu import ImuNoise, SimImu, SimSerialWire
from drivers.sim.motor import MotorEvent
from drivers.sim.plant import Plant
from drivers.sim.serial_line import GAP, SerialLine, SerialLineWire
from drivers.sim.servo_table import TableServos
from drivers.sim.world import World
from drivers.wire import WireError


class SerialWorld(World):
    """A robot in MuJoCo behind simulated serial lines. Arguments as for World; ``gap``: see serial_line.py; ``fast`` and
    ``patient``: see SimServos."""

    def __init__(
        self,
        model_path: str | Path,
        base: str,
        buses: Sequence[BusSpec],
        imu: ImuSpec,
        *,
        timestep: float = 0.002,
        seed: int = 0,
        faults: Sequence[Fault | str] = (),
        prepare: Callable[[Any], None] | None = None,
        joint_pos: Mapping[str, float] | None = None,
        hang: float | None = 0.01,
        noise: float = 0.0,
        registers: Mapping[str, Mapping[str, int]] | None = None,
        imu_noise: ImuNoise | None = None,
        latency: float = 250e-6,
        gap: float = GAP,
        fast: bool = True,
        patient: bool = False,
    ):
        known = [name for name, p in PROTOCOLS.items() if p.wire == "serial" and p.motors]
        if strangers := sorted({b.protocol for b in buses} - set(known)):
            raise BusError(
                f"no emulated servos for {', '.join(strangers)} on a serial line; expected {' or '.join(known)} on every bus"
            )
        joints = [m.joint for b in buses for m in b.motors]
        if unknown := sorted(set(registers or {}) - set(joints)):
            raise BusError(f"registers: got joints {unknown}, expected some of {', '.join(joints)}")
        self.time = 0.0
        self.plant = Plant(model_path, joints, base, timestep, prepare, imu.site)
        self.plant.reset(joint_pos, hang=hang, noise=noise, seed=seed)
        self.motors = AllServos(buses, self.plant, registers or {}, fast, patient)  # type: ignore[assignment]
        self.lines = [
            SerialLine(servos.spec, servos, seed=seed, latency=latency, gap=gap) for servos in self.motors.buses
        ]
        self.buses = []
        self.imu = SimImu(imu, self.plant, seed=seed, noise=imu_noise, latency=latency)
        now = lambda: self.time  # noqa: E731
        self.wires = {line.spec.name: SerialLineWire(line, now) for line in self.lines}  # type: ignore[assignment]
        self.ports = {line.spec.name: SerialPort(line) for line in self.lines}
        self.imu_wire = SimSerialWire(self.imu, now)
        self._timestep = timestep
        self._substeps = 0
        self._sha = hashlib.sha256()
        self._power = []  # the lines switch power themselves
        for fault in faults:
            self.inject(fault)

    def _carry(self, until: float) -> None:
        for line in self.lines:
            line.carry(until)
            line.digest(self._sha)
        if self.imu.carried:
            self._sha.update(b"imu:" + b"".join(self.imu.carried))
            self.imu.carried.clear()

    @property
    def busy(self) -> bool:
        return any(line.busy for line in self.lines)

    def inject(self, fault: Fault | str) -> None:
        """Make something go wrong. Raises BusError for a fault that befalls nothing here."""
        fault = parse_fault(fault) if isinstance(fault, str) else fault
        if fault.bus == IMU:
            self.imu.inject(fault)
            return
        struck = [li for li in self.lines if any(fault.befalls(li.spec.name, j) for j in li.servos.joints)]
        if not struck:
            names = ", ".join([*(line.spec.name for line in self.lines), IMU])
            raise BusError(
                f"fault '{fault.kind}': nothing here is '{fault.bus}/{fault.motor}', expected one of the buses {names} "
                "and, after a slash, one of its joints"
            )
        for line in struck:
            line.inject(fault)

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
