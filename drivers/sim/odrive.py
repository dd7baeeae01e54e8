"""Emulated ODrive axes with CANSimple, firmware 0.5.x; with another FIRMWARE, such that tells its version and address.

An axis starts at idle, takes its own position for its target when it enters closed loop, and says by heartbeats, unasked,
what state it is in. Every frame to its node feeds the watchdog, questions too; on expiry it goes idle, free of torque, with an
error that forbids closed loop until CLEAR_ERRORS. Its flash holds what an axis that was set up holds: heartbeats every
10 ms (factory: 100), and no watchdog, as from the factory.

Not modelled: calibration, the velocity integrator (the host sets it to 0), the clipping of the inner velocity target and the
over-speed error, control modes other than position, an expiry at idle, two axes of a board that clear errors together.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from drivers.bus import BusSpec, MotorCommand
from drivers.codecs import odrive
from drivers.codecs.odrive import AxisState, Command, Law, OdriveMotors
from drivers.sim.motor import RATED_SHARE, Answer, Body, SimMotors
from drivers.wire import ERROR, EXTENDED, FRAME, REMOTE

FACTORY = {
    "WATCHDOG_TIMEOUT": 0.0,  # s; 0: off
    "HEARTBEAT_RATE_MS": 10.0,
    "FIRMWARE": 0x000506,  # a byte each of major, minor, revision
    "VEL_LIMIT": 2.0,  # rev/s
    "CURRENT_LIMIT": 10.0,  # A
    "CONTROL_MODE": float(odrive.POSITION_CONTROL),
    "INPUT_MODE": float(odrive.PASSTHROUGH),
    "POS_GAIN": 20.0,  # 1/s
    "VEL_GAIN": 1 / 6,  # N m s/rev
}


FIRST_SERIAL = 0x3943_3254_3230  # of the first axis; then they count up


class SimOdrive(SimMotors):
    """ODrive axes; ``registers``: see FACTORY."""

    speaks = True

    def __init__(
        self, buses: Sequence[BusSpec], body: Body, frame_bits: Callable[[np.ndarray], np.ndarray], **options: Any
    ) -> None:
        self._codec = OdriveMotors(BusSpec("all", "odrive", tuple(m for b in buses for m in b.motors)))
        self._inputs = np.zeros((3, len(self._codec.nodes)))  # rev, rev/s, N m
        super().__init__(buses, body, frame_bits, **options)
        # The axes were not switched on at the same instant.
        self._beat_due = [0.001 * (row + 1) for row in range(len(self.specs))]
        self._address_due = [np.inf] * len(self.specs)

    def factory(self) -> list[dict[str, float]]:
        return [dict(FACTORY) for _ in self.specs]

    def addressee(self, bus: int, id: int, raw: bytes) -> int:
        return -1 if id & (EXTENDED | ERROR) else self._rows[bus].get((id & ~REMOTE) >> odrive.COMMAND_BITS, -1)

    def receive(self, bus: int, id: int, raw: bytes, time: float) -> Answer | None:
        if id == REMOTE | odrive.identifier(odrive.BROADCAST, Command.ADDRESS):
            for other in range(len(self.specs)):  # one after the other, lest they collide
                if self._bus_of[other] == bus and self._modern(other):
                    self._address_due[other] = time + 0.001 * (other + 1)
            return None
        row = self.addressee(bus, id, raw)
        if row < 0 or not self.powered[row]:
            return None
        self._fed[row] = time
        self._set_deadline()
        command = id & (1 << odrive.COMMAND_BITS) - 1
        if id & REMOTE or raw[4] == 0:
            return self._ask(row, command)
        if command == Command.SET_INPUT_POS and raw[4] == 8:
            if self.enabled[row]:
                self._arrived.append((row, raw, time))
            return None
        self._take_commands()  # what came before counts before
        first, second = odrive.unpack_pairs(np.frombuffer(raw, FRAME)["data"])[0].tolist()
        if command == Command.SET_AXIS_STATE:
            self._set_state(row, int.from_bytes(raw[8:12], "little"), time)
        elif command == Command.CLEAR_ERRORS:
            if self.error[row]:
                self.error[row] = 0
                self._note(time, row, "cleared")
        elif command == Command.ESTOP:
            self._fail(row, 1 << 14, time, "disabled")
        elif command == Command.SET_CONTROLLER_MODE:
            control, mode = np.frombuffer(raw, "<u4", 2, 8).tolist()
            self._set(row, CONTROL_MODE=control, INPUT_MODE=mode)
        elif command == Command.SET_LIMITS:
            self._set(row, VEL_LIMIT=first, CURRENT_LIMIT=second)
        elif command == Command.SET_POS_GAIN:
            self._set(row, POS_GAIN=first)
        elif command == Command.SET_VEL_GAINS:
            self._set(row, VEL_GAIN=first)
        return None

    def _ask(self, row: int, command: int) -> Answer | None:
        sign = self._sign[row]
        if command == Command.GET_ENCODER_ESTIMATES:
            answer = self._codec.pack_estimates(row, self.position[row], sign * self._body.joint_vel[row])
        elif command == Command.GET_IQ:
            answer = self._codec.pack_current(row, sign * self._body.joint_torque[row])
        elif command == Command.GET_VERSION and self._modern(row):
            answer = self._codec.pack_version(row, int(self._registers[row]["FIRMWARE"]))
        else:
            return None
        return self._say(row, answer)

    def unasked(self, start: float, end: float) -> list[tuple[int, float, Answer]]:
        beats = []
        for row, due in enumerate(self._address_due):
            if due < end:
                self._address_due[row] = np.inf
                if self.powered[row]:
                    frame = self._codec.pack_address(row, FIRST_SERIAL + row)
                    beats.append((int(self._bus_of[row]), max(start, due), self._say(row, frame)))
        for row, due in enumerate(self._beat_due):
            if due < end:
                period = self._registers[row]["HEARTBEAT_RATE_MS"] * 1e-3
                self._beat_due[row] = due + period if period > 0 else np.inf
                if self.powered[row] and period > 0:
                    state = AxisState.CLOSED_LOOP if self.enabled[row] else AxisState.IDLE
                    beat = self._codec.pack_heartbeat(row, int(self.error[row]), state)
                    beats.append((int(self._bus_of[row]), max(start, due), self._say(row, beat)))
        return beats

    def _modern(self, row: int) -> bool:
        return int(self._registers[row]["FIRMWARE"]) >> 8 >= odrive.MODERN[0] << 8 | odrive.MODERN[1]

    def _set(self, row: int, **values: float) -> None:
        if np.isfinite(list(values.values())).all():
            self._registers[row].update(values)
            self._configure()

    def _set_state(self, row: int, state: int, time: float) -> None:
        on = state == AxisState.CLOSED_LOOP
        if on and not self.enabled[row] and not self.error[row]:
            self._inputs[:, row] = self.position[row] * self._codec.gear[row] / odrive.TURN, 0.0, 0.0
            self.last_command_time[row] = time
            self._set_enabled(row, True, time, "enabled")
            self._commanded[row] = True  # to stay here, with the gains that it has
            self._changed = True
        elif state == AxisState.IDLE and self.enabled[row]:
            self._set_enabled(row, False, time, "disabled")

    def refresh(self, raw: bytes = b"") -> list[int]:
        return self._frame_bits(np.frombuffer(raw, FRAME)).tolist() if raw else []

    def _obey(self, rows: np.ndarray, frames: np.ndarray) -> bool:
        inputs = np.ascontiguousarray(frames["data"]).view(odrive.INPUT_POS)[:, 0]
        sound = np.isfinite(inputs["position"])
        mine = rows[sound]
        self._inputs[0, mine] = inputs["position"][sound]
        self._inputs[1, mine] = inputs["velocity"][sound] * odrive.THOUSANDTH
        self._inputs[2, mine] = inputs["torque"][sound] * odrive.THOUSANDTH
        return True

    def _targets(self) -> MotorCommand:
        column = lambda name: np.array([r[name] for r in self._registers])  # noqa: E731
        usual = (column("CONTROL_MODE") == odrive.POSITION_CONTROL) & (column("INPUT_MODE") == odrive.PASSTHROUGH)
        position, velocity, torque = self._inputs
        law = Law(position, velocity, torque, column("POS_GAIN") * usual, column("VEL_GAIN") * usual)
        return odrive.command_of(law, self._codec.gear)

    def _fail(self, row: int, error: int, now: float, event: str) -> None:
        self.error[row] |= error
        if self.enabled[row]:
            self._set_enabled(row, False, now, event)

    def _trip(self, row: int, now: float) -> None:
        self._fail(row, odrive.WATCHDOG_ERROR, now, "watchdog")

    def _overheat(self, row: int, now: float) -> None:
        self._fail(row, odrive.MOTOR_ERROR, now, "over-temperature")

    def _configure(self) -> None:
        timeout = np.array([r["WATCHDOG_TIMEOUT"] for r in self._registers])
        self._timeout = np.where(timeout > 0, timeout, np.inf)
        current = np.array([r["CURRENT_LIMIT"] for r in self._registers])
        torque = np.maximum(current, 0.0) * self._codec.torque_constant * self._codec.gear
        self._rated = RATED_SHARE * np.maximum(torque, 1e-3)
        self._body.limit(torque)
        self._changed = True
        self._set_deadline()
