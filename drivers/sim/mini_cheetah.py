"""Emulated mini-cheetah motors: MIT mode and nothing else.

A motor answers every frame once, with what it was before it obeys. On expiry of TIMEOUT (cycles of 25 us; factory: 0 = off;
no frame can set it) kp, kd and torque are zero until the next command: limp, not disabled and not damping. An enable frame
does not count as life for it, as in the firmware.

Not modelled: the serial line, calibration, the silence while zeroing.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, ClassVar

import numpy as np

from drivers.bus import BusSpec, MotorCommand
from drivers.codecs import mini_cheetah
from drivers.codecs.mini_cheetah import Kind, MiniCheetahMotors
from drivers.sim.motor import RATED_SHARE, Answer, Body, SimMotors
from drivers.sim.wire import priority
from drivers.wire import FRAME


class SimMiniCheetah(SimMotors):
    """Mini-cheetah motors; ``registers``: TIMEOUT."""

    MOTORS: ClassVar[type[MiniCheetahMotors]] = MiniCheetahMotors
    OVER_TEMPERATURE: ClassVar[int] = 0  # error code; 0: the firmware has none

    def __init__(
        self, buses: Sequence[BusSpec], body: Body, frame_bits: Callable[[np.ndarray], np.ndarray], **options: Any
    ) -> None:
        self._codec = self.MOTORS(BusSpec("all", "", tuple(m for b in buses for m in b.motors)))
        self._buses = [self.MOTORS(b) for b in buses]
        super().__init__(buses, body, frame_bits, **options)
        self._keys = [priority(id) for id in self._codec.masters.tolist()]

    def factory(self) -> list[dict[str, float]]:
        return [{"TIMEOUT": 0.0} for _ in self.specs]

    def receive(self, bus: int, id: int, raw: bytes, time: float) -> Answer | None:
        frame = np.frombuffer(raw, FRAME)
        rows, kinds = self._buses[bus].classify(frame)
        row, kind = int(rows[0]) + self._first[bus], int(kinds[0])
        if rows[0] < 0 or not self.powered[row]:
            return None
        answer = self._answer(row)
        if kind == Kind.COMMAND:
            if self.enabled[row]:
                self._arrived.append((row, raw, time))
            return answer
        self._take_commands()  # what came before counts before
        if kind == Kind.ENABLE and not self.enabled[row] and not self.error[row]:
            self._fed[row] = np.inf  # nothing to time out before the first command
            self._set_enabled(row, True, time, "enabled")
        elif kind == Kind.DISABLE and self.enabled[row]:
            self._set_enabled(row, False, time, "disabled")
        elif kind == Kind.SET_ZERO:
            self.zero[row] += self.position[row]
            self._stale = self._changed = True
            self._note(time, row, "zeroed")
        return answer

    def _pack_feedback(self) -> np.ndarray:
        return self._codec.pack_feedback(
            self.position,
            self._sign * self._body.joint_vel,
            self._sign * self._body.joint_torque,
            np.maximum(self.rotor_temperature, self.driver_temperature),
            self.error,
        )

    def _targets(self) -> MotorCommand:
        return self._codec.unpack_command(self._last["data"])

    def _trip(self, row: int, now: float) -> None:
        self._fed[row] = np.inf
        self._commanded[row] = False
        self._changed = True
        self._note(now, row, "watchdog")

    def _overheat(self, row: int, now: float) -> None:
        self.error[row] = self.OVER_TEMPERATURE
        self._set_enabled(row, False, now, "over-temperature")

    def _configure(self) -> None:
        cycles = np.array([r["TIMEOUT"] for r in self._registers])
        self._timeout = np.where(cycles > 0, cycles * mini_cheetah.CYCLE, np.inf)
        self._rated = RATED_SHARE * self._codec.ranges.torque
        self._body.limit(self._codec.ranges.torque)
        self._stale = self._changed = True
        self._set_deadline()
