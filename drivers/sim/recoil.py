"""Emulated Recoil motor controllers of the Berkeley Humanoid Lite.

What they copy from the firmware: gains, limits and the last target are the device's own and outlive a stop, so that a motor
switched to position mode pulls to its old target at once; position mode ignores the velocity target and the torque; only
IDLE, DAMPING and driving modes lead to a driving mode, anything else ends in IDLE with an error; on expiry of the watchdog a
driving motor goes to DAMPING with an error. A power cycle loses the turns of the motor's shaft: the joint is only known
within a turn divided by the gear ratio.

DAMPING shorts the phases: here viscous, SHORTED_DAMPING. How an error is cleared is not documented: here by IDLE.

Not modelled: the torque filter (50 Hz), SYNC_EMCY, TPDO4, calibration, velocity, current and open-loop modes (accepted,
without torque), writes beyond the known parameters (ignored; in the device they hit its memory), and numbers that are not
finite (ignored too).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from drivers.bus import BusSpec, MotorCommand
from drivers.codecs import recoil
from drivers.codecs.recoil import Function, Mode, RecoilMotors
from drivers.sim.motor import RATED_SHARE, Answer, Body, SimMotors
from drivers.sim.wire import priority
from drivers.wire import EXTENDED, FRAME

GEAR_RATIO = 15.0
SHORTED_DAMPING = 0.5  # N m s/rad at the joint, of the right size, not measured
BUS_VOLTAGE = 24.0
OVER_TEMPERATURE = 1 << 9
DRIVING_MODES = frozenset(range(Mode.CURRENT, Mode.POSITION + 1)) | frozenset(
    range(Mode.VABC_OVERRIDE, Mode.VQD_OVERRIDE + 1)
)
FED_BY = (Function.RPDO1, Function.RPDO2, Function.RPDO3, Function.HEARTBEAT)


class SimRecoil(SimMotors):
    """Recoil controllers; ``registers`` are the parameters of drivers.codecs.recoil."""

    def __init__(
        self, buses: Sequence[BusSpec], body: Body, frame_bits: Callable[[np.ndarray], np.ndarray], **options: Any
    ) -> None:
        motors = tuple(m for b in buses for m in b.motors)
        n = len(motors)
        self._codec = RecoilMotors(BusSpec("all", "recoil", motors))
        self.mode = [Mode.IDLE] * n
        self._target = np.zeros((2, n))  # position, torque: of the last RPDO
        super().__init__(buses, body, frame_bits, **options)
        self._keys = [priority(recoil.identifier(Function.TPDO2, m.id)) for m in motors]

    def factory(self) -> list[dict[str, float]]:
        return [
            dict.fromkeys(recoil.PARAMETERS, 0.0)
            | {
                "DEVICE_ID": m.id,
                "FIRMWARE_VERSION": 0x010101,
                "WATCHDOG_TIMEOUT": 1000,
                "GEAR_RATIO": GEAR_RATIO,
                "POSITION_KP": 1.0,
                "VELOCITY_KP": 0.1,
                "TORQUE_LIMIT": 0.2,
                "VELOCITY_LIMIT": 20.0,
                "POSITION_LIMIT_LOWER": -np.inf,
                "POSITION_LIMIT_UPPER": np.inf,
                "TORQUE_FILTER_ALPHA": 0.145,
                "FLUX_OFFSET": round(2.399 * row % 6.283 + 0.1, 3),
            }
            for row, m in enumerate(self.specs)
        ]

    def addressee(self, bus: int, id: int, raw: bytes) -> int:
        if id & EXTENDED:
            return -1
        device = raw[9] if id >> recoil.FUNCTION_SHIFT == Function.NMT else id & recoil.DEVICE_MASK
        return self._rows[bus].get(device, -1)

    def receive(self, bus: int, id: int, raw: bytes, time: float) -> Answer | None:
        row = self.addressee(bus, id, raw)
        if row < 0 or not self.powered[row]:
            return None
        function, frame = id >> recoil.FUNCTION_SHIFT, np.frombuffer(raw, FRAME)[0]
        if function in FED_BY and np.isfinite(self._fed[row]):
            self._fed[row] = time
            self._set_deadline()
        if function in (Function.RPDO2, Function.RPDO3) and frame["length"] == 8:
            answer = self._answer(row) if function == Function.RPDO2 else self._measure(row)
            if self.mode[row] in DRIVING_MODES:
                self._arrived.append((row, raw, time))
            else:
                self._obey(np.array([row]), frame[None])
            return answer
        self._take_commands()  # what came before counts before
        if function == Function.RPDO1:
            return self._say(row, self._codec.pack_echo(row, frame["data"]))
        if function == Function.RSDO:
            return self._parameter(row, recoil.unpack_sdo(frame))
        if function == Function.NMT and frame["length"] == 2:
            self._set_mode(row, raw[8], time)
        elif function == Function.FLASH and raw[8] == 1:
            self._flash[row] = dict(self._registers[row])
        elif function == Function.FLASH and raw[8] == 2:
            self._registers[row] = dict(self._flash[row])
            self._configure()
        return None

    def _measure(self, row: int) -> Answer:
        """The answer to an RPDO3."""
        torque = self._sign[row] * self._body.joint_torque[row]
        return self._say(row, self._codec.pack_motion(row, Function.TPDO3, self.position[row], torque))

    def _pack_feedback(self) -> np.ndarray:
        """The answers to an RPDO2."""
        return self._codec.pack_motions(self.position, self._sign * self._body.joint_vel)

    def _parameter(self, row: int, request: recoil.Sdo | None) -> Answer | None:
        if request is None or not request.name:
            return None
        name, value = request
        if value is not None:
            if recoil.PARAMETERS[name][2] and np.isfinite(value):
                self._registers[row][name] = value
                self._changed = True  # gains and limits are looked up when the law is made
                if name in ("TORQUE_LIMIT", "WATCHDOG_TIMEOUT"):
                    self._configure()
            return None
        live = {
            "MODE": self.mode[row],
            "ERROR": self.error[row],
            "POSITION_MEASURED": self.position[row],
            "VELOCITY_MEASURED": self._sign[row] * self._body.joint_vel[row],
            "TORQUE_MEASURED": self._sign[row] * self._body.joint_torque[row],
            "BUS_VOLTAGE": BUS_VOLTAGE,
        }
        held = np.array([live.get(name, self._registers[row][name])], recoil.PARAMETERS[name][1])
        return self._say(row, self._codec.pack_answer(row, held.tobytes()))

    def _set_mode(self, row: int, mode: int, time: float) -> None:
        old = self.mode[row]
        if mode == old:
            return
        allowed = old == Mode.IDLE or old == Mode.DAMPING or old in DRIVING_MODES
        if mode not in tuple(Mode) or (mode in DRIVING_MODES or mode == Mode.DAMPING) and not allowed:
            self.error[row] |= recoil.INVALID_MODE
            mode = Mode.IDLE
        elif mode == Mode.IDLE:
            self.error[row] = 0
        self.mode[row] = Mode(mode)
        on = mode in DRIVING_MODES or mode == Mode.DAMPING
        if on or self.enabled[row]:
            self._set_enabled(row, on, time, "enabled" if on else "disabled")
        self._commanded[row] = on  # by what it was told before
        if on:
            self.last_command_time[row] = time
        self._fed[row] = time if mode in DRIVING_MODES else np.inf
        self._changed = True
        self._set_deadline()

    def _obey(self, rows: np.ndarray, frames: np.ndarray) -> bool:
        for row, frame in zip(rows, frames, strict=True):
            first, second = self._codec.unpack_targets(frame)
            if not np.isfinite([first, second]).all():
                continue  # a device would go wild; a simulation would only end
            self._target[0, row] = first
            if int(frame["id"]) >> recoil.FUNCTION_SHIFT == Function.RPDO3:
                self._target[1, row] = second
        return True

    def _targets(self) -> MotorCommand:
        column = lambda name: np.array([r[name] for r in self._registers])  # noqa: E731
        zero = np.zeros(len(self.specs))
        mode = np.array(self.mode)
        in_position, shorted = mode == Mode.POSITION, mode == Mode.DAMPING
        target = np.clip(self._target[0], column("POSITION_LIMIT_LOWER"), column("POSITION_LIMIT_UPPER"))
        kd = np.where(in_position, column("VELOCITY_KP"), np.where(shorted, SHORTED_DAMPING, 0.0))
        torque = np.where(mode == Mode.TORQUE, self._target[1], 0.0)
        return MotorCommand(target, zero, np.where(in_position, column("POSITION_KP"), 0.0), kd, torque)

    def _trip(self, row: int, now: float) -> None:
        self.error[row] |= recoil.WATCHDOG_ERROR
        self.mode[row] = Mode.DAMPING
        self._fed[row] = np.inf
        self._note(now, row, "watchdog")
        self._changed = True

    def _overheat(self, row: int, now: float) -> None:
        self.error[row] |= OVER_TEMPERATURE
        self.mode[row] = Mode.IDLE
        self._fed[row] = np.inf
        self._set_enabled(row, False, now, "over-temperature")

    def power(self, row: int, on: bool, time: float) -> None:
        if self.powered[row] != on:
            self.mode[row] = Mode.IDLE
            self._fed[row] = np.inf
            self._target[:, row] = 0.0
        super().power(row, on, time)

    def _boot(self, row: int) -> None:
        turn = 2 * np.pi / self._registers[row]["GEAR_RATIO"]
        self.zero[row] += turn * np.round(self.position[row] / turn)

    def _configure(self) -> None:
        limit = np.array([r["TORQUE_LIMIT"] for r in self._registers])
        self._timeout = np.array([r["WATCHDOG_TIMEOUT"] for r in self._registers]) * 1e-3
        self._rated = RATED_SHARE * np.maximum(limit, 1e-3)
        self._body.limit(limit)
        self._changed = True
        self._set_deadline()
