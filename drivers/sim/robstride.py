"""Emulated RobStride and CyberGear motors, in their private protocol.

Position is counted from power-on within 0..2 pi (zero_sta 0) or -pi..pi (zero_sta 1), and comes back in from the other
end beyond 4 pi. Flash holds what a motor that was set up holds: zero_sta 1, and canTimeout 0 (off) as from the factory.

What counts as life for the watchdog and what happens on expiry is not documented. Here: OPERATION and ENABLE count, and
the motor goes to reset mode, free of torque (it does not damp), without a fault bit.

A new id is heard at once, a new bit rate from the next power-on; both are kept without SAVE.

Not modelled: control modes other than operation (run_mode is remembered; anything but 0 makes OPERATION frames
answered and not obeyed), active reports and PROTOCOL (ignored), two motors with one id (one of them answers).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from drivers.bus import BusSpec, MotorCommand
from drivers.codecs import robstride
from drivers.codecs.robstride import Mode, RobstrideMotors, Type
from drivers.sim.motor import RATED_SHARE, Answer, Body, SimMotors
from drivers.sim.wire import priority
from drivers.wire import FRAME

BUS_VOLTAGE = 48.0
CAN_ID, CAN_BITRATE = "CAN_ID", "CAN_BITRATE"  # no parameters of the protocol: see SET_ID and BAUD
FIRST_UID = 0x5253_0000_0000_0001
OVER_TEMPERATURE = 1 << 2  # bit of a feedback identifier
FAULT_CLEAR = 1  # byte 0 of STOP


class SimRobstride(SimMotors):
    """RobStride motors; ``registers`` are the parameters of drivers.codecs.robstride."""

    def __init__(
        self, buses: Sequence[BusSpec], body: Body, frame_bits: Callable[[np.ndarray], np.ndarray], **options: Any
    ) -> None:
        self._codec = RobstrideMotors(BusSpec("all", "robstride", tuple(m for b in buses for m in b.motors)))
        self._tuned: list[int] = []  # bit rates, since power-on
        super().__init__(buses, body, frame_bits, **options)
        for row in range(len(self.specs)):
            self._boot(row)

    def factory(self) -> list[dict[str, float]]:
        torque = self._codec.scales.torque
        rates = [b.bitrate for b in self._bus_specs for _ in b.motors]
        return [
            dict.fromkeys(robstride.PARAMETERS, 0.0)
            | {"limit_torque": t, "zero_sta": 1.0, "EPScan_time": 1.0, robstride.UID: FIRST_UID + row}
            | {CAN_ID: self.specs[row].id, CAN_BITRATE: rates[row]}
            for row, t in enumerate(torque.tolist())
        ]

    def addressee(self, bus: int, id: int, raw: bytes) -> int:
        return self._rows[bus].get(id & 0xFF, -1)

    def receive(self, bus: int, id: int, raw: bytes, time: float) -> Answer | None:
        row = self.addressee(bus, id, raw)
        frame = np.frombuffer(raw, FRAME)
        if row < 0 or not self.powered[row] or self._codec.classify(frame)[0][0] < 0:
            return None
        kind = id >> 24 & 0x1F
        if kind == Type.OPERATION:
            answer = self._answer(row)
            if self.enabled[row] and self._registers[row]["run_mode"] == 0:
                self._arrived.append((row, raw, time))
            return answer
        self._take_commands()  # what came before counts before
        if kind == Type.SET_ID:
            return self._set_id(row, id >> 16 & 0xFF)
        if kind == Type.BAUD and raw[8:14] == robstride.SEQUENCE[:6]:
            self._flash[row][CAN_BITRATE] = robstride.BIT_RATES.get(raw[14], self._flash[row][CAN_BITRATE])
            return self._answer(row)
        if kind == Type.GET_ID:
            return self._say(row, self._codec.pack_uid(row, int(self._registers[row][robstride.UID])))
        if kind == Type.READ:
            return self._read(row, frame["data"][0])
        if kind not in (Type.ENABLE, Type.STOP, Type.SET_ZERO, Type.WRITE, Type.SAVE):
            return None
        answer = self._answer(row)
        if kind == Type.ENABLE:
            if not self.error[row]:
                self._fed[row] = self.last_command_time[row] = time
                self._set_deadline()
                if not self.enabled[row]:
                    self._set_enabled(row, True, time, "enabled")
        elif kind == Type.STOP:
            if self.enabled[row]:
                self._set_enabled(row, False, time, "disabled")
            if raw[8] == FAULT_CLEAR and self.error[row]:
                self.error[row] = 0
                self._stale = True
                self._note(time, row, "cleared")
        elif kind == Type.SET_ZERO and raw[8] == 1:
            self.zero[row] += self.position[row]
            self._stale = self._changed = True
            self._note(time, row, "zeroed")
        elif kind == Type.WRITE:
            parameter = robstride.unpack_parameter(frame["data"][0])
            if parameter.name and np.isfinite(parameter.value):
                self._registers[row][parameter.name] = parameter.value
                self._configure()
        elif kind == Type.SAVE:
            self._flash[row] = dict(self._registers[row])
        return answer

    def _read(self, row: int, data: np.ndarray) -> Answer:
        name = robstride.unpack_parameter(data).name
        live = {
            "mechPos": self.position[row],
            "mechVel": self._sign[row] * self._body.joint_vel[row],
            "VBUS": BUS_VOLTAGE,
        }
        answer = robstride.pack_parameter(name, live.get(name, self._registers[row][name])) if name else data
        return self._say(row, self._codec.pack_parameter(row, answer, failed=not name))

    def _set_id(self, row: int, id: int) -> Answer:
        """It answers to GET_ID by its new name."""
        self._registers[row][CAN_ID] = self._flash[row][CAN_ID] = id
        self._configure()
        return self._say(row, self._codec.pack_uid(row, int(self._registers[row][robstride.UID])))

    def _pack_feedback(self) -> np.ndarray:
        frames = self._codec.pack_feedback(
            self.position,
            self._sign * self._body.joint_vel,
            self._sign * self._body.joint_torque,
            np.maximum(self.rotor_temperature, self.driver_temperature),
            self.error,
            np.where(self.enabled, Mode.RUN, Mode.RESET),
        )
        self._keys = [priority(id) for id in frames["id"].tolist()]
        return frames

    def _targets(self) -> MotorCommand:
        return self._codec.unpack_command(self._last, np.arange(len(self.specs)))

    def _trip(self, row: int, now: float) -> None:
        self._set_enabled(row, False, now, "watchdog")

    def _overheat(self, row: int, now: float) -> None:
        self.error[row] |= OVER_TEMPERATURE
        self._set_enabled(row, False, now, "over-temperature")

    def _boot(self, row: int) -> None:
        self._tuned[row] = int(self._registers[row][CAN_BITRATE])
        turn = 2 * np.pi
        low = -np.pi if self._registers[row]["zero_sta"] else 0.0
        self.zero[row] += turn * np.floor((self.position[row] - low) / turn)
        self._stale = True

    def _configure(self) -> None:
        self._tuned = self._tuned or [int(r[CAN_BITRATE]) for r in self._registers]
        self._listen([(int(r[CAN_ID]), 0) for r in self._registers], self._tuned)
        self._codec = RobstrideMotors(self._all)
        ticks = np.array([r["canTimeout"] for r in self._registers])
        self._timeout = np.where(ticks > 0, ticks * robstride.TIMEOUT_TICK, np.inf)
        torque = self._codec.scales.torque
        self._rated = RATED_SHARE * torque
        self._body.limit(np.minimum(torque, [r["limit_torque"] for r in self._registers]))
        self._stale = self._changed = True
        self._set_deadline()
