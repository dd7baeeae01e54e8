"""What emulated servos with a control table share: rows of one table, and a law inside the plant's integrator.

All servos of a bus are rows of one table of bytes. Their law runs in every substep, from the moment a goal arrived on (within
a substep it is the time-weighted mean of old and new); answers tell the state at the start of the substep in which the servo
was asked. A protocol is one class derived from this one: what packets do, what the registers make of a goal, and what
becomes of a servo that is too hot.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from drivers.bus import BusSpec
from drivers.sim.motor import AMBIENT, RATED_SHARE, ROTOR_RISE, ROTOR_TIME, THERMAL_PERIOD, Body, MotorEvent

BROADCAST = 0xFE
Answer = tuple[int, float, bytes]  # row, delay behind the one before in s, bytes


class TableServos:
    """The servos of one bus, on the joints of ``body`` (which has the same order). ``stall``: N m (n,)."""

    BOOT_TIME = 0.3  # s
    BAUD_RATES: dict[int, int]  # bit/s, by what BAUD holds

    def __init__(self, spec: BusSpec, body: Body, stall: np.ndarray, size: int, log: list[MotorEvent] | None = None):
        self.spec = spec
        self.joints = [m.joint for m in spec.motors]
        self.log: list[MotorEvent] = [] if log is None else log
        n = len(spec.motors)
        self._body, self._stall = body, stall
        self._sign = np.array([m.sign for m in spec.motors], float)
        self._offset = np.array([m.offset for m in spec.motors])
        self._bitrate = spec.bitrate  # at which the host talks now
        self._row_of: dict[int, int] = {}  # see _readdress, which a protocol calls when its tables are filled
        self._table = np.zeros((n, size), np.uint8)
        self.powered = [True] * n
        self.temperature = np.full(n, AMBIENT)
        self.last_command_time = np.full(n, -np.inf)  # s, when a goal was last written
        self._booting = np.full(n, -np.inf)  # s, until when
        self._registered: dict[int, tuple[int, bytes]] = {}  # by row, what ACTION will write
        self._thermal_due = THERMAL_PERIOD
        self._law = np.zeros((3, n))  # bias, kp, kd at the joints
        self._since = np.full(n, -np.inf)  # s, when what makes the law last changed
        self._changed = True  # the law is no longer what goals and modes make of it
        self._settle = False  # the body still has the mean of two laws
        self._stale = True  # what is measured is not in the table
        self._body.limit(stall)

    # -- what a protocol adds ----------------------------------------------------------------------------------------

    def parser(self) -> Any:
        """What finds this protocol's packets in bytes: ``feed(data)``; a packet has ``id`` and ``end``."""
        raise NotImplementedError

    def receive(self, packet: Any, time: float) -> list[Answer]:
        """An instruction that ended at ``time``: the answers, in their order on the line."""
        raise NotImplementedError

    def retell(self, answer: bytes, change: Any) -> bytes:
        """``answer`` with ``change(payload)`` (bytearray: error, then parameters) done to it, and a check that fits."""
        raise NotImplementedError

    def _get(self, row: int, name: str) -> int:
        raise NotImplementedError

    @property
    def enabled(self) -> np.ndarray:
        """(n,) bool: torque is on."""
        raise NotImplementedError

    def _decide(self) -> np.ndarray:
        """The law (3, n) that goals and modes make: bias, kp, kd at the joints."""
        raise NotImplementedError

    def _refresh(self) -> None:
        """Put what the servos measure now into their tables."""
        raise NotImplementedError

    def _watch(self, now: float) -> None:
        """Watchdogs, and other things that happen by themselves."""

    def _overheat(self, row: int, now: float) -> None:
        """A servo is hotter than TEMPERATURE_LIMIT."""
        raise NotImplementedError

    def _restart(self, row: int, time: float, event: str) -> None:
        """A servo starts anew."""
        raise NotImplementedError

    # -- shared ------------------------------------------------------------------------------------------------------

    def register(self, joint: str, name: str) -> int:
        """What a servo's register holds."""
        self._refresh()
        return self._get(self.joints.index(joint), name)

    def _addressed(self, id: int, time: float) -> list[int]:
        """Rows that listen to ``id``, by their ids as they are now."""
        rows = self._row_of.values() if id == BROADCAST else [self._row_of[id]] if id in self._row_of else []
        return [row for row in rows if time >= self._booting[row]]

    def retune(self, bitrate: int) -> None:
        """The host now talks at ``bitrate``: who listens at another hears nothing."""
        self._bitrate = bitrate
        self._readdress()

    def _readdress(self) -> None:
        """Whom an id means: of those that have power and listen at the host's bit rate. Of two with one id, one."""
        known = self._bitrate in self.BAUD_RATES.values()  # else a line without any time on it
        self._row_of = {
            self._get(row, "ID"): row
            for row in range(len(self.joints))
            if self.powered[row] and not (known and self.BAUD_RATES.get(self._get(row, "BAUD")) != self._bitrate)
        }

    def _baud(self, otherwise: int) -> int:
        """What BAUD holds in servos of the wiring's bit rate; ``otherwise``: where it has no code."""
        return next((code for code, rate in self.BAUD_RATES.items() if rate == self.spec.bitrate), otherwise)

    def act(self, start: float, end: float) -> None:
        """Set the body's drive for the substep from ``start`` to ``end``."""
        self._watch(start)
        if start >= self._thermal_due:
            self._warm(start)
        self._stale = True
        if self._changed:
            old, new = self._law, self._decide()
            share = np.clip((end - self._since) / (end - start), 0.0, 1.0)
            self._body.drive(*(old + share * (new - old)))
            self._law, self._changed, self._settle = new, False, True
        elif self._settle:
            self._body.drive(*self._law)
            self._settle = False

    def _warm(self, now: float) -> None:
        self._thermal_due = now + THERMAL_PERIOD
        heat = (self._body.joint_torque / (RATED_SHARE * self._stall)) ** 2
        self.temperature += (AMBIENT + ROTOR_RISE * heat - self.temperature) * (THERMAL_PERIOD / ROTOR_TIME)
        for row in range(len(self.joints)):
            if self.temperature[row] > self._get(row, "TEMPERATURE_LIMIT"):
                self._overheat(row, now)

    def power(self, row: int, on: bool, time: float) -> None:
        """Take a servo's supply away, or give it back."""
        if self.powered[row] == on:
            return
        self.powered[row] = on
        self._restart(row, time, "powered on" if on else "powered off")
        self._readdress()

    def _note(self, time: float, row: int, event: str) -> None:
        self.log.append(MotorEvent(time, self.spec.name, self.joints[row], event))


def to_bytes(values: np.ndarray, kind: str) -> np.ndarray:
    """(n, size) uint8 of numbers, rounded and saturated."""
    limits = np.iinfo(kind)
    return np.clip(np.rint(values), limits.min, limits.max).astype(kind).reshape(-1, 1).view(np.uint8)
