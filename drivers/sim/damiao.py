"""Emulated Damiao motors, in MIT mode.

On expiry of TIMEOUT the motor disables itself with error D and stays so until clear and enable; it does not damp.
What counts as life for the watchdog is not documented: here commands and enable frames, not questions.

A new ESC_ID or MST_ID is heard at once, a new CAN_BR from the next power-on; each is lost then unless it was stored.

Not modelled: control modes other than MIT (their frames are ignored, as by a motor in MIT mode), two motors with one
ESC_ID (one of them answers), error frames by a motor at another bit rate (it hears nothing).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from drivers.bus import BusSpec, MotorCommand
from drivers.codecs import damiao
from drivers.codecs.damiao import Kind, Operation
from drivers.codecs.mit import Ranges
from drivers.sim.motor import RATED_SHARE, ROTOR_LIMIT, Answer, Body, SimMotors
from drivers.sim.wire import priority
from drivers.wire import FRAME, make_frames

MAGIC_PREFIX = b"\xff" * 7
FIRST_SERIAL = 1001


class SimDamiao(SimMotors):
    """Damiao motors; ``registers`` and what they hold are those of drivers.codecs.damiao."""

    def __init__(
        self, buses: Sequence[BusSpec], body: Body, frame_bits: Callable[[np.ndarray], np.ndarray], **options: Any
    ) -> None:
        self._decoders: list[damiao.DamiaoMotors] = []  # one for each bus: whom a frame is for
        self._tuned: list[int] = []  # bit rates, since power-on
        super().__init__(buses, body, frame_bits, **options)

    def factory(self) -> list[dict[str, float]]:
        ranges = damiao.ranges_of(self.specs)
        rates = [b.bitrate for b in self._bus_specs for _ in b.motors]
        return [_factory_registers(m, ranges, i, rates[i]) for i, m in enumerate(self.specs)]

    def addressee(self, bus: int, id: int, raw: bytes) -> int:
        return self._rows[bus].get(raw[8] | raw[9] << 8 if id == damiao.BROADCAST_ID else id, -1)

    def receive(self, bus: int, id: int, raw: bytes, time: float) -> Answer | None:
        row = self._rows[bus].get(id)
        if row is None or (raw[8] == 0xFF and raw[8:15] == MAGIC_PREFIX) or raw[4] != 8:
            return self._receive_rare(bus, raw, time)
        if not self._obeys_mit[row]:
            return None
        answer = self._answer(row)
        if self._accepts[row]:
            self._arrived.append((row, raw, time))
        return answer

    def _receive_rare(self, bus: int, raw: bytes, time: float) -> Answer | None:
        """Everything but a command."""
        frame = np.frombuffer(raw, FRAME)
        rows, kinds = self._decoders[bus].classify(frame)
        row, kind = int(rows[0]) + self._first[bus], int(kinds[0])
        if rows[0] < 0 or not self._hears(bus, row) or kind in (Kind.COMMAND, Kind.OTHER_MODE):
            return None
        self._take_commands()  # what came before counts before
        if kind == Kind.REGISTER:
            return self._register(bus, row, frame["data"][0])
        answer = self._answer(row)
        if kind == Kind.ENABLE:
            if not self.error[row]:
                self.last_command_time[row] = self._fed[row] = time
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

    def _register(self, bus: int, row: int, data: np.ndarray) -> Answer | None:
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
        return self._say(row, frame)

    def _hears(self, bus: int, row: int) -> bool:
        return self._rows[bus].get(self.specs[row].id) == row

    def _boot(self, row: int) -> None:
        super()._boot(row)
        self._tuned[row] = damiao.BIT_RATES.get(int(self._registers[row]["CAN_BR"]), 0)

    def _pack_feedback(self) -> np.ndarray:
        return self._codec.pack_feedback(
            self.position,
            self._sign * self._body.joint_vel,
            self._sign * self._body.joint_torque,
            np.where(self.error, self.error, self.enabled),
            self.driver_temperature,
            self.rotor_temperature,
            self._wrap,
        )

    def _targets(self) -> MotorCommand:
        return self._codec.unpack_command(self._last["data"])

    def _trip(self, row: int, now: float) -> None:
        self.error[row] = damiao.LOST_COMMUNICATION
        self._set_enabled(row, False, now, "watchdog")

    def _overheat(self, row: int, now: float) -> None:
        self.error[row] = 0xC if self.rotor_temperature[row] > self._rotor_limit[row] else 0xB
        self._set_enabled(row, False, now, "over-temperature")

    def _set_enabled(self, row: int, on: bool, time: float, event: str) -> None:
        super()._set_enabled(row, on, time, event)
        self._accepts[row] = on

    def _configure(self) -> None:
        column = lambda name: np.array([r[name] for r in self._registers], float)  # noqa: E731
        n = len(self.specs)
        ranges = Ranges(
            column("PMAX"), column("VMAX"), column("TMAX"), np.full(n, damiao.KP_MAX), np.full(n, damiao.KD_MAX)
        )
        self._tuned = self._tuned or [damiao.BIT_RATES.get(int(rate), 0) for rate in column("CAN_BR")]
        ids = (
            column(name).astype(np.int64) & 0x7FF for name in ("ESC_ID", "MST_ID")
        )  # an id has 11 bits, whatever is written
        self._listen(list(zip(*ids, strict=True)), self._tuned)
        self._keys = [priority(m.feedback_id) for m in self.specs]
        self._decoders = []
        for bus, (first, b) in enumerate(zip(self._first, self._bus_specs, strict=True)):
            own = self.specs[first : first + len(b.motors)]
            self._decoders.append(
                damiao.DamiaoMotors(
                    replace(b, motors=own), hears=[self._hears(bus, first + k) for k in range(len(own))]
                )
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


def _factory_registers(spec, ranges: Ranges, row: int, bitrate: int) -> dict[str, float | int]:
    registers: dict[str, float | int] = {name: 0 for name in damiao.REGISTERS}
    registers |= {
        "ESC_ID": spec.id,
        "MST_ID": spec.feedback_id,
        "CTRL_MODE": damiao.MIT_MODE,
        "TIMEOUT": 0,
        "CAN_BR": next((code for code, rate in damiao.BIT_RATES.items() if rate == bitrate), 4),
        "SN": FIRST_SERIAL + row,
        "OT_VALUE": ROTOR_LIMIT,
        "PMAX": float(ranges.position[row]),
        "VMAX": float(ranges.velocity[row]),
        "TMAX": float(ranges.torque[row]),
    }
    return registers
