"""Emulated motors: what is behind the connector, decoded with the same codec as the host's side.

All motors of one protocol, on all its buses, are rows of the same arrays, so that a tick costs one decode and one encode.
Each is a state machine with enable state, error, registers, watchdog and temperature; its PD law runs inside the plant's
integrator in every substep, from the moment its command arrived on (within a substep the law is the time-weighted mean
of old and new, which gives the exact impulse). A frame is answered with the motor's state of the current substep and
only then obeyed (reply before apply).

SimMotors is what all protocols share. A protocol is one class derived from it, in a file of its own, named in
``drivers/open.py``; what it does on the wire, and what its devices do when their watchdog expires, is said there.

Not modelled by any: current loop and its bandwidth, cogging, torque that falls with speed or voltage, over-voltage,
under-voltage and over-current errors, answers while zeroing.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple, Protocol

import numpy as np

from drivers.bus import BusError, BusSpec, MotorCommand
from drivers.sim.wire import priority
from drivers.wire import frame_type

# A plain two-node thermal model; its constants are of the right size for a motor of this class, not measured.
AMBIENT = 25.0  # deg C
ROTOR_RISE = 60.0  # K above ambient that the rotor settles at under a third of its torque
ROTOR_TIME = 120.0  # s
DRIVER_RISE = 30.0  # K
DRIVER_TIME = 20.0  # s
RATED_SHARE = 1 / 3  # of full torque
DRIVER_LIMIT = 120.0  # deg C
ROTOR_LIMIT = 100.0  # deg C
THERMAL_PERIOD = 0.02  # s

OFF, LIMP, DAMPING, DRIVING = range(4)
EFFECTS = ("disabled", "limp", "damping", "driving")

Answer = tuple[int, int, bytes, int]  # row, arbitration key, raw frame, bits on the wire


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

    ``registers``: by joint, registers that differ from the factory's. ``wrap``: a position out of range comes back in
    from the other end instead of saturating. ``frame_bits``: length of frames on the wire (drivers.budget).

    A protocol says what its ``factory`` registers are, and how to ``receive`` frames, to ``_pack_feedback``, to make
    ``_targets`` of what it was told (``_obey``), to ``_configure`` itself by its registers and to ``_trip``.
    """

    speaks = False  # without being asked: see ``unasked``

    def __init__(
        self,
        buses: Sequence[BusSpec],
        body: Body,
        frame_bits: Callable[[np.ndarray], np.ndarray],
        *,
        registers: Mapping[str, Mapping[str, float]] | None = None,
        wrap: bool = False,
    ):
        self.specs = tuple(m for b in buses for m in b.motors)
        self.joints = [m.joint for m in self.specs]
        self.bus_names = [b.name for b in buses for _ in b.motors]
        self._bus_specs = list(buses)
        self._bitrates = [b.bitrate for b in buses]  # at which the hosts talk now
        self.deaf: list[dict[int, int]] = [
            {} for _ in buses
        ]  # by bus, who has power and another bit rate: {row: bit/s}
        n = len(self.specs)
        self._body, self._frame_bits, self._wrap = body, frame_bits, wrap
        self._bus_of = np.repeat(np.arange(len(buses)), [len(b.motors) for b in buses])
        self._first = [int(np.flatnonzero(self._bus_of == i)[0]) for i in range(len(buses))]
        self._all = replace(buses[0], name="all", motors=self.specs)
        self._rows = [{m.id: self._first[i] + k for k, m in enumerate(b.motors)} for i, b in enumerate(buses)]
        self._sign = np.array([m.sign for m in self.specs], float)
        self._offset = np.array([m.offset for m in self.specs])

        self._flash = self.factory()
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
        self._fed = np.full(n, -np.inf)  # s, when the watchdog last heard what it counts as life
        self._timeout = np.full(n, np.inf)  # s, of the watchdog
        self._rated = np.ones(n)  # N m
        self._rotor_limit = np.full(n, ROTOR_LIMIT)
        self._effect = np.zeros(n, np.int64)
        self._signs = b""  # of the law, that it follows from; empty: it has changed since
        self.frame = frame_type(buses[0].data_bitrate)
        self._last = np.zeros(n, self.frame)  # the last command of each
        self._commanded = np.zeros(n, bool)  # since it was enabled
        self._law = np.zeros((3, n))  # bias, kp, kd at the joints
        self._changed = False  # the law is no longer what commands and states make of it
        self._settle = False  # the body still has the mean of two laws
        self._since = np.full(n, -np.inf)  # s, when each took its last command over
        self._arrived: list[tuple[int, bytes, float]] = []  # commands not yet taken over
        self._deadline = np.inf  # s, before which no watchdog trips
        self._shortest = np.inf  # s, of all watchdogs
        self._thermal_due = THERMAL_PERIOD
        self._stale = True
        self._answers: list[Answer] = []  # the feedback of each in this substep
        self._keys: list[int] = []
        self._registers = [dict(r) for r in self._flash]
        self._configure()

    # -- what a protocol adds ----------------------------------------------------------------------------------------

    def factory(self) -> list[dict[str, float]]:
        """What the registers of each motor hold when it leaves the factory."""
        raise NotImplementedError

    def addressee(self, bus: int, id: int, raw: bytes) -> int:
        """Row of the motor that a frame of the host is for; -1: none."""
        return self._rows[bus].get(id, -1)

    def receive(self, bus: int, id: int, raw: bytes, time: float) -> Answer | None:
        """A frame that ended at ``time`` on a bus: the answer (row, arbitration key, raw frame, bits), or None."""
        raise NotImplementedError

    def unasked(self, start: float, end: float) -> list[tuple[int, float, Answer]]:
        """What motors say from ``start`` to ``end`` by themselves: (bus, time, frame)."""
        return []

    def _pack_feedback(self) -> np.ndarray:
        """The feedback (FRAME, (n,)) of every motor."""
        raise NotImplementedError

    def _obey(self, rows: np.ndarray, frames: np.ndarray) -> bool:
        """Take over the commands ``frames`` (FRAME, (m,)) to motors ``rows`` (m,), in their order. Returns whether they may
        ask for something else than those before: a policy is slower than its bus, so most commands are repeated."""
        before = self._last[rows].tobytes()
        self._last[rows] = frames
        return frames.tobytes() != before

    def _targets(self) -> MotorCommand:
        """What each motor is told to do, in its own sign and zero."""
        raise NotImplementedError

    def _configure(self) -> None:
        """Take over what the registers hold."""
        raise NotImplementedError

    def _trip(self, row: int, now: float) -> None:
        """The watchdog of a motor has expired."""
        raise NotImplementedError

    def _overheat(self, row: int, now: float) -> None:
        """A motor is too hot."""
        raise NotImplementedError

    def _boot(self, row: int) -> None:
        """A motor has power again. Single-turn encoder: it finds itself within half a turn of zero."""
        self.zero[row] += 2 * np.pi * np.round(self.position[row] / (2 * np.pi))

    # -- frames ------------------------------------------------------------------------------------------------------

    def _answer(self, row: int) -> Answer:
        """The feedback of one motor."""
        if self._stale:
            self.refresh()
        return self._answers[row]

    def _say(self, row: int, frame: np.ndarray) -> Answer:
        """Any other answer (FRAME, (1,)) of one motor."""
        return row, priority(int(frame["id"][0])), frame.tobytes(), int(self._frame_bits(frame)[0])

    def refresh(self, raw: bytes = b"") -> list[int]:
        """Bits of the host's frames ``raw``, and, in the same pass, every motor's feedback of this substep."""
        if not self._stale:
            return self._frame_bits(np.frombuffer(raw, self.frame)).tolist() if raw else []
        self._stale = False
        feedback, size, n = self._pack_feedback().tobytes(), self.frame.itemsize, len(self.specs)
        bits = self._frame_bits(np.frombuffer(raw + feedback, self.frame)).tolist()
        raws = [feedback[at : at + size] for at in range(0, size * n, size)]
        self._answers = list(zip(range(n), self._keys, raws, bits[-n:], strict=True))
        return bits[:-n]

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
            share = np.minimum((end - self._since) / (end - start), 1.0)  # of the substep, under the new law
            self._body.drive(*(old + share * (new - old)))
            self._law, self._changed, self._settle = new, False, True
        elif self._settle:
            self._body.drive(*self._law)
            self._settle = False

    def _take_commands(self) -> None:
        """The commands that arrived become the motors' targets."""
        if not self._arrived:
            return
        told, raws, when = zip(*self._arrived, strict=True)
        self._arrived.clear()
        rows, times = np.array(told), np.array(when)
        differ = self._obey(rows, np.frombuffer(b"".join(raws), self.frame))
        self._changed |= differ or not self._commanded[rows].all()
        self.last_command_time[rows] = times
        self._fed[rows] = times
        self._commanded[rows] = True
        self._since[rows] = times
        self._deadline = min(self._deadline, min(when) + self._shortest)

    def _decide(self) -> np.ndarray:
        """The law (3, n) that the motors' targets and states make: bias, kp, kd at the joints."""
        c = self._targets()
        on = self.enabled & self._commanded
        bias = c.kp * (c.position - self._offset + self.zero) + c.kd * c.velocity + c.torque
        law = np.array([self._sign * bias, c.kp, c.kd]) * on
        signs = on.tobytes() + (law[1:] > 0).tobytes()
        if signs != self._signs:
            self._signs = signs
            self._tell_effects(law, on)
        return law

    def _tell_effects(self, law: np.ndarray, on: np.ndarray) -> None:
        """Note whose command has another effect than the one before."""
        effect = np.where(law[1] > 0, DRIVING, np.where(law[2] > 0, DAMPING, LIMP)) * on
        for row in np.flatnonzero(effect != self._effect):
            if effect[row] != OFF:
                self._note(float(self.last_command_time[row]), int(row), EFFECTS[effect[row]])
        self._effect = effect

    def _expire(self, now: float) -> None:
        """Watchdogs whose time is up trip."""
        late = self.enabled & (now - self._fed >= self._timeout)
        for row in np.flatnonzero(late):
            self._trip(int(row), now)
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
            self._overheat(int(row), now)

    # -- state -------------------------------------------------------------------------------------------------------

    def power(self, row: int, on: bool, time: float) -> None:
        """Take a motor's supply away, or give it back: it then starts from its flash, disabled, and has lost its count
        of turns."""
        if self.powered[row] == on:
            return
        self._take_commands()
        self.powered[row] = on
        self._set_enabled(row, False, time, "powered on" if on else "powered off")
        if on:
            self.error[row] = 0
            self._registers[row] = dict(self._flash[row])
            self._boot(row)
        self._configure()

    def retune(self, bus: int, bitrate: int) -> None:
        """The host of a bus now talks at ``bitrate``: who listens at another hears nothing."""
        self._bitrates[bus] = bitrate
        self._configure()

    def _listen(self, addresses: Sequence[tuple[int, int]], bitrates: Sequence[int]) -> None:
        """From now on motors listen to these identifiers and answer on those, at their bit rates. One that is without power
        or at another bit rate than its bus hears nothing; of two with one identifier, one."""
        self.specs = tuple(
            replace(m, id=id, feedback_id=feedback) for m, (id, feedback) in zip(self.specs, addresses, strict=True)
        )
        self._all = replace(self._all, motors=self.specs)
        hears = [self.powered[row] and rate == self._bitrates[bus]
                 for row, (bus, rate) in enumerate(zip(self._bus_of.tolist(), bitrates, strict=True))]  # fmt: skip
        self.deaf = [{} for _ in self._bus_specs]
        for row, (bus, rate) in enumerate(zip(self._bus_of.tolist(), bitrates, strict=True)):
            if self.powered[row] and not hears[row]:
                self.deaf[bus][row] = rate
        self._rows = [
            {self.specs[row].id: row for row in range(first, first + len(b.motors)) if hears[row]}
            for first, b in zip(self._first, self._bus_specs, strict=True)
        ]

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
            self._signs = b""
            self._changed = True
        self._note(time, row, event)
        self._set_deadline()

    def _note(self, time: float, row: int, event: str) -> None:
        self.log.append(MotorEvent(time, self.bus_names[row], self.joints[row], event))

    def _set_deadline(self) -> None:
        due = self._fed[self.enabled] + self._timeout[self.enabled]
        self._deadline = float(due.min()) if len(due) else np.inf
        self._shortest = float(self._timeout.min())
