"""Emulated Damiao motors: what is behind the connector, decoded with the same codec as the host's side.

All motors of all buses are rows of the same arrays, so that a tick costs one decode and one encode. Each is a state
machine with enable state, error, registers, watchdog and temperature; its PD law runs inside the plant's integrator in
every substep, from the moment its command arrived on (within a substep the law is the time-weighted mean of old and
new, which gives the exact impulse).

A frame is answered with the motor's state of the current substep and only then obeyed (reply before apply).
On expiry of TIMEOUT the motor disables itself with error D and stays so until clear and enable; it does not damp.
What counts as life for the watchdog is not documented: here commands and enable frames, not questions.

Not modelled: current loop and its bandwidth, cogging, torque that falls with speed or voltage, over-voltage,
under-voltage and over-current errors, control modes other than MIT (their frames are ignored, as by a motor in MIT
mode), re-addressing by writing MST_ID or ESC_ID (remembered, without effect), answers while zeroing.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple, Protocol

import numpy as np

from drivers.bus import BusError, BusSpec
from drivers.codecs import damiao
from drivers.codecs.damiao import Kind, Operation
from drivers.codecs.mit import Ranges
from drivers.sim.wire import priority
from drivers.wire import FRAME, make_frames

PROTOCOL = "damiao"
MAGIC_PREFIX = b"\xff" * 7

# A plain two-node thermal model; its constants are of the right size for a motor of this class, not measured.
AMBIENT = 25.0  # deg C
ROTOR_RISE = 60.0  # K above ambient that the rotor settles at under a third of TMAX
ROTOR_TIME = 120.0  # s
DRIVER_RISE = 30.0  # K
DRIVER_TIME = 20.0  # s
RATED_SHARE = 1 / 3  # of TMAX
DRIVER_LIMIT = 120.0  # deg C: error B
ROTOR_LIMIT = 100.0  # deg C: OT_VALUE, error C
THERMAL_PERIOD = 0.02  # s

OFF, LIMP, DAMPING, DRIVING = range(4)
EFFECTS = ("disabled", "limp", "damping", "driving")


class MotorEvent(NamedTuple):
    """Something that changed in a motor. ``event``: enabled, disabled, driving (kp > 0), damping (kp = 0, kd > 0), limp
    (both 0), watchdog, over-temperature, cleared, zeroed, powered off, powered on."""

    time: float
    bus: str
    joint: str
    event: str


class Body(Protocol):
    """What motors drive: see drivers.sim.plant.Plant."""

    @property
    def joint_pos(self) -> np.ndarray: ...

    @property
    def joint_vel(self) -> np.ndarray: ...

    @property
    def joint_torque(self) -> np.ndarray: ...

    def drive(self, bias: np.ndarray, kp: np.ndarray, kd: np.ndarray) -> None: ...

    def limit(self, torque: np.ndarray) -> None: ...


class SimMotors:
    """The motors of ``buses``, in their order, on the joints of ``body`` (which has the same order).

    ``registers``: by joint, registers that differ from the factory's. ``wrap``: a position beyond PMAX comes back in
    from the other end instead of saturating. ``frame_bits``: length of frames on the wire (drivers.budget).
    """

    def __init__(
        self,
        buses: Sequence[BusSpec],
        body: Body,
        frame_bits: Callable[[np.ndarray], np.ndarray],
        *,
        registers: Mapping[str, Mapping[str, float]] | None = None,
        wrap: bool = False,
    ):
        for spec in buses:
            if spec.protocol != PROTOCOL:
                raise BusError(f"bus {spec.name}: no emulated motors for '{spec.protocol}', expected {PROTOCOL}")
        self.specs = tuple(m for b in buses for m in b.motors)
        self.joints = [m.joint for m in self.specs]
        self.bus_names = [b.name for b in buses for _ in b.motors]
        n = len(self.specs)
        self._body, self._frame_bits, self._wrap = body, frame_bits, wrap
        self._decoders = [damiao.DamiaoMotors(b) for b in buses]  # one for each bus: whom a frame is for
        self._bus_of = np.repeat(np.arange(len(buses)), [len(b.motors) for b in buses])
        self._first = [int(np.flatnonzero(self._bus_of == i)[0]) for i in range(len(buses))]
        self._all = replace(buses[0], name="all", motors=self.specs)
        self._rows = [{m.id: self._first[i] + k for k, m in enumerate(b.motors)} for i, b in enumerate(buses)]
        self._sign = np.array([m.sign for m in self.specs], float)
        self._offset = np.array([m.offset for m in self.specs])
        self._keys = [priority(m.feedback_id) for m in self.specs]

        factory = damiao.ranges_of(self.specs)
        self._flash = [_factory_registers(m, factory, i) for i, m in enumerate(self.specs)]
        for joint, changes in (registers or {}).items():
            if joint not in self.joints:
                raise BusError(f"registers: got joint '{joint}', expected one of {', '.join(self.joints)}")
            self._flash[self.joints.index(joint)].update(changes)

        self.log: list[MotorEvent] = []
        self.enabled = np.zeros(n, bool)
        self.error = np.zeros(n, np.int64)
        self.last_command_time = np.full(n, -np.inf)
        self.rotor_temperature = np.full(n, AMBIENT)
        self.driver_temperature = np.full(n, AMBIENT)
        self.zero = np.zeros(n)  # rad that the motor takes off its shaft angle
        self.powered = [True] * n
        self._effect = np.zeros(n, np.int64)
        self._data = np.zeros((n, 8), np.uint8)  # the last command of each
        self._commanded = np.zeros(n, bool)  # since it was enabled
        self._law = np.zeros((3, n))  # bias, kp, kd at the joints
        self._changed = False  # the law is no longer what commands and states make of it
        self._settle = False  # the body still has the mean of two laws
        self._taken: list[tuple[int, float]] = []  # commands (row, time) of this substep
        self._arrived: list[tuple[int, bytes, float]] = []  # commands not yet taken over
        self._deadline = np.inf
        self._thermal_due = THERMAL_PERIOD
        self._stale = True
        self._feedback = b""
        self._bits: list[int] = []
        self._registers = [dict(r) for r in self._flash]
        self._configure()

    # -- frames ------------------------------------------------------------------------------------------------------

    def receive(self, bus: int, id: int, raw: bytes, time: float) -> tuple[int, int, bytes, int] | None:
        """A frame that ended at ``time`` on a bus: the answer (row, arbitration key, raw frame, bits), or None."""
        row = self._rows[bus].get(id)
        if row is None or raw[8:15] == MAGIC_PREFIX or raw[4] != 8:
            return self._receive_rare(bus, raw, time)
        if not (self.powered[row] and self._obeys_mit[row]):
            return None
        answer = self._answer(row)
        if self._accepts[row]:
            self._arrived.append((row, raw, time))
        return answer

    def _receive_rare(self, bus: int, raw: bytes, time: float) -> tuple[int, int, bytes, int] | None:
        """Everything but a command."""
        frame = np.frombuffer(raw, FRAME)
        rows, kinds = self._decoders[bus].classify(frame)
        row, kind = int(rows[0]) + self._first[bus], int(kinds[0])
        if rows[0] < 0 or not self.powered[row] or kind in (Kind.COMMAND, Kind.OTHER_MODE):
            return None
        self._take_commands()  # what came before counts before
        if kind == Kind.REGISTER:
            return self._register(bus, row, frame["data"][0])
        answer = self._answer(row)
        if kind == Kind.ENABLE:
            if not self.error[row]:
                self.last_command_time[row] = time
                self._set_deadline()
                if not self.enabled[row]:
                    self._set_enabled(row, True, time, "enabled")
        elif kind == Kind.DISABLE:
            if self.enabled[row]:
                self._set_enabled(row, False, time, "disabled")
        elif kind == Kind.CLEAR_ERROR:
            if self.error[row]:
                self.error[row] = 0
                self._stale = True
                self._note(time, row, "cleared")
        elif kind == Kind.SET_ZERO:
            self.zero[row] += self.position[row]
            self._stale = self._changed = True
            self._note(time, row, "zeroed")
        return answer

    def _register(self, bus: int, row: int, data: np.ndarray) -> tuple[int, int, bytes, int] | None:
        request = damiao.unpack_register(data)
        if request.operation == Operation.REFRESH:
            return self._answer(row)
        registers = self._registers[row]
        if request.operation == Operation.STORE:
            if self.enabled[row]:
                return None
            self._flash[row] = dict(registers)
            value = 0
        elif not request.register:
            return None
        elif request.operation == Operation.WRITE and damiao.REGISTERS[request.register][2]:
            registers[request.register] = request.value
            self._configure()
        value = registers[request.register] if request.register else 0
        frame = make_frames(
            np.array([self.specs[row].feedback_id], np.uint32),
            damiao.pack_register(self.specs[row].id, request.operation, request.register, value)[None],
        )
        return row, self._keys[row], frame.tobytes(), int(self._frame_bits(frame)[0])

    def _answer(self, row: int) -> tuple[int, int, bytes, int]:
        if self._stale:
            self.refresh()
        return row, self._keys[row], self._feedback[16 * row : 16 * row + 16], self._bits[row]

    def refresh(self, raw: bytes = b"") -> list[int]:
        """Bits of the host's frames ``raw``, and, in the same pass, every motor's feedback of this substep."""
        if not self._stale:
            return self._frame_bits(np.frombuffer(raw, FRAME)).tolist() if raw else []
        self._stale = False
        feedback = self._codec.pack_feedback(
            self.position,
            self._sign * self._body.joint_vel,
            self._sign * self._body.joint_torque,
            np.where(self.error, self.error, self.enabled),
            self.driver_temperature,
            self.rotor_temperature,
            self._wrap,
        )
        self._feedback = feedback.tobytes()
        bits = self._frame_bits(np.frombuffer(raw + self._feedback, FRAME)).tolist()
        self._bits = bits[-len(self.specs) :]
        return bits[: -len(self.specs)]

    @property
    def position(self) -> np.ndarray:
        """(n,) rad as the motors count it."""
        return self._sign * self._body.joint_pos + self._offset - self.zero

    # -- time --------------------------------------------------------------------------------------------------------

    def act(self, start: float, end: float) -> None:
        """Set the body's drive for the substep from ``start`` to ``end``."""
        if start >= self._deadline:
            self._expire(start)
        if start >= self._thermal_due:
            self._warm(start)
        self._stale = True
        self._take_commands()
        if self._changed:
            old, new = self._law, self._decide()
            share = np.ones(len(self.specs))
            if self._taken:
                rows, times = zip(*self._taken, strict=True)
                share[list(rows)] = np.clip((end - np.array(times)) / (end - start), 0.0, 1.0)
                self._taken.clear()
            self._body.drive(*(old + share * (new - old)))
            self._law, self._changed, self._settle = new, False, True
        elif self._settle:
            self._body.drive(*self._law)
            self._settle = False

    def _take_commands(self) -> None:
        """The commands that arrived become the motors' targets."""
        if not self._arrived:
            return
        rows, raws, times = map(list, zip(*self._arrived, strict=True))
        self._arrived.clear()
        self._data[rows] = np.frombuffer(b"".join(raws), FRAME)["data"]
        self.last_command_time[rows] = times
        self._commanded[rows] = True
        self._taken += zip(rows, times, strict=True)
        self._changed = True
        self._set_deadline()

    def _decide(self) -> np.ndarray:
        """The law (3, n) that the motors' targets and states make: bias, kp, kd at the joints."""
        c = self._codec.unpack_command(self._data)
        on = self.enabled & self._commanded
        bias = c.kp * (c.position - self._offset + self.zero) + c.kd * c.velocity + c.torque
        law = np.array([self._sign * bias, c.kp, c.kd]) * on
        effect = np.where(law[1] > 0, DRIVING, np.where(law[2] > 0, DAMPING, LIMP)) * on
        if (effect != self._effect).any():
            for row in np.flatnonzero(effect != self._effect):
                if effect[row] != OFF:
                    self._note(float(self.last_command_time[row]), int(row), EFFECTS[effect[row]])
            self._effect = effect
        return law

    def _expire(self, now: float) -> None:
        """Watchdogs whose time is up disable their motors."""
        late = self.enabled & (now - self.last_command_time >= self._timeout)
        for row in np.flatnonzero(late):
            self.error[row] = damiao.LOST_COMMUNICATION
            self._set_enabled(int(row), False, now, "watchdog")
        self._set_deadline()

    def _warm(self, now: float) -> None:
        self._thermal_due = now + THERMAL_PERIOD
        heat = (self._body.joint_torque / self._rated) ** 2
        for temperature, rise, tau in (
            (self.rotor_temperature, ROTOR_RISE, ROTOR_TIME),
            (self.driver_temperature, DRIVER_RISE, DRIVER_TIME),
        ):
            temperature += (AMBIENT + rise * heat - temperature) * (THERMAL_PERIOD / tau)
        hot = (self.rotor_temperature > self._rotor_limit) | (self.driver_temperature > DRIVER_LIMIT)
        for row in np.flatnonzero(hot & self.enabled):
            self.error[row] = 0xC if self.rotor_temperature[row] > self._rotor_limit[row] else 0xB
            self._set_enabled(int(row), False, now, "over-temperature")

    # -- state -------------------------------------------------------------------------------------------------------

    def power(self, row: int, on: bool, time: float) -> None:
        """Take a motor's supply away, or give it back: it then starts from its flash, disabled, and has lost its count
        of turns (single-turn encoder: it finds itself within half a turn of zero)."""
        if self.powered[row] == on:
            return
        self._take_commands()
        self.powered[row] = on
        self._set_enabled(row, False, time, "powered on" if on else "powered off")
        if on:
            self.error[row] = 0
            self._registers[row] = dict(self._flash[row])
            self.zero[row] += 2 * np.pi * np.round(self.position[row] / (2 * np.pi))
            self._configure()

    def register(self, joint: str, name: str) -> float:
        """What a motor's register holds."""
        return self._registers[self.joints.index(joint)][name]

    def _set_enabled(self, row: int, on: bool, time: float, event: str) -> None:
        self.enabled[row] = on
        self._stale = True
        self._commanded[row] = False
        if not on:
            self._arrived = [a for a in self._arrived if a[0] != row]
            self._effect[row] = OFF
            self._changed = True
        self._accepts[row] = on
        self._note(time, row, event)
        self._set_deadline()

    def _note(self, time: float, row: int, event: str) -> None:
        self.log.append(MotorEvent(time, self.bus_names[row], self.joints[row], event))

    def _set_deadline(self) -> None:
        due = self.last_command_time[self.enabled] + self._timeout[self.enabled]
        self._deadline = float(due.min()) if len(due) else np.inf

    def _configure(self) -> None:
        """Take over what the registers hold."""
        column = lambda name: np.array([r[name] for r in self._registers], float)  # noqa: E731
        n = len(self.specs)
        ranges = Ranges(
            column("PMAX"), column("VMAX"), column("TMAX"), np.full(n, damiao.KP_MAX), np.full(n, damiao.KD_MAX)
        )
        self._codec = damiao.DamiaoMotors(self._all, ranges)
        self._rated = RATED_SHARE * ranges.torque
        self._rotor_limit = column("OT_VALUE")
        ticks = column("TIMEOUT")
        self._timeout = np.where(ticks > 0, ticks * damiao.TIMEOUT_TICK, np.inf)
        self._obeys_mit = (column("CTRL_MODE") == damiao.MIT_MODE).tolist()
        self._accepts = self.enabled.tolist()
        self._body.limit(ranges.torque)
        self._stale = True
        self._changed = True
        self._set_deadline()


def _factory_registers(spec, ranges: Ranges, row: int) -> dict[str, float | int]:
    registers: dict[str, float | int] = {name: 0 for name in damiao.REGISTERS}
    registers |= {
        "ESC_ID": spec.id,
        "MST_ID": spec.feedback_id,
        "CTRL_MODE": damiao.MIT_MODE,
        "TIMEOUT": 0,
        "CAN_BR": 4,
        "OT_VALUE": ROTOR_LIMIT,
        "PMAX": float(ranges.position[row]),
        "VMAX": float(ranges.velocity[row]),
        "TMAX": float(ranges.torque[row]),
    }
    return registers
