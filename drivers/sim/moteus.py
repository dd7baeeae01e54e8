"""Emulated moteus controllers.

What they copy from the firmware: a frame is answered with the state before it is obeyed; only a write of the mode (register
000) makes a command of the registers behind it, and what it leaves out has its default; any command makes a stopped
controller obey; faults and the time-out stay until a stop; the target moves on with its velocity until the next command;
kp and kd scale separately; a start outside servopos.position_min and max is a fault; configuration lives in RAM, from where
``conf write`` takes it to flash. After a time-out the controller does what servo.timeout_mode says, here 0 (limp), 10 and 12
(damping with its kd) or 15 (phases shorted: SHORTED_DAMPING). A power cycle loses the turns of the rotor, or of the output
where an encoder is configured there.

Not modelled: the 8 ms that it takes to get ready (modes 2 to 4), trajectories (velocity and acceleration limits), integral
gain, stop position, other modes than 0, 10, 12 and 15, flow control of the console, telemetry, slip and error faults.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from drivers.bus import BusSpec, MotorCommand
from drivers.codecs import moteus
from drivers.codecs.moteus import TURN, HomeState, Mode, MoteusMotors
from drivers.codecs.moteus_frame import (
    CONSOLE,
    CONSOLE_READ,
    CONSOLE_SAYS,
    CONSOLE_WRITE,
    KINDS,
    READ,
    READ_ERROR,
    REGISTERS_MAX,
    REPLY,
    UNKNOWN_REGISTER,
    WRITE,
    Register,
    Subframe,
    console,
    from_raw,
    pack_values,
    subframes,
    varuint,
)
from drivers.sim.motor import RATED_SHARE, Answer, Body, SimMotors
from drivers.wire import ERROR, EXTENDED, REMOTE

SHORTED_DAMPING = 0.5  # N m s/rad at the output, of the right size, not measured
BUS_VOLTAGE = 24.0
FIRST_SERIAL = 0x0000_4D54, 0x2034_5005, 0x002A_0000  # of the first motor, low word first; then they count up
FIRMWARE = 0x01_03_04
PAYLOAD = 8  # where it begins in a raw frame
PAYLOAD_MAX = 64
OVER_TEMPERATURE, OUTSIDE_LIMIT = 38, 39  # register 00F
MODES = (Mode.STOPPED, Mode.POSITION, Mode.ZERO_VELOCITY, Mode.BRAKE)  # that can be asked for
FACTORY = {  # fw/bldc_servo_structs.h; the ratio and max_current's N m are the model's
    "servo.pid_position.kp": 4.0,
    "servo.pid_position.ki": 1.0,
    "servo.pid_position.kd": 0.05,
    "servo.default_timeout_s": 0.1,
    "servo.timeout_max_torque_Nm": 5.0,
    "servo.timeout_mode": float(Mode.ZERO_VELOCITY),
    "servo.default_velocity_limit": np.nan,
    "servo.default_accel_limit": np.nan,
    "motor_position.output.source": 0.0,
    "motor_position.output.reference_source": -1.0,  # that only says in which turn of the rotor it starts; -1: none
    **{f"motor_position.sources.{i}.reference": 0.0 for i in range(3)},  # 1: this encoder measures the output
    "servopos.position_min": np.nan,
    "servopos.position_max": np.nan,
}
# What a command is that leaves registers out.
DEFAULTS: dict[int, float] = {
    Register.COMMAND_KP_SCALE: 1.0,
    Register.COMMAND_KD_SCALE: 1.0,
    Register.COMMAND_MAX_TORQUE: np.nan,
}
P, V, T, KP, KD, MOST = range(6)  # rows of the commands in force: rev, rev/s, N m, scales, N m


class SimMoteus(SimMotors):
    """moteus controllers; ``registers``: configuration by its name on the console, see FACTORY."""

    def __init__(
        self, buses: Sequence[BusSpec], body: Body, frame_bits: Callable[[np.ndarray], np.ndarray], **options: Any
    ) -> None:
        motors = tuple(m for b in buses for m in b.motors)
        n = len(motors)
        self._codec = MoteusMotors(BusSpec("all", "moteus", motors))
        self.mode = [Mode.STOPPED] * n
        self._command = np.zeros((6, n))
        self._came = np.zeros(n)  # s, when it did
        self._set = [False] * n  # its position was set since power-on
        self._now = 0.0
        self._typed, self._says = [b""] * n, [b""] * n  # consoles: a line not yet whole, what is not yet fetched
        super().__init__(buses, body, frame_bits, **options)

    def factory(self) -> list[dict[str, float]]:
        ratio = "motor_position.rotor_to_output_ratio"
        return [
            FACTORY | {"id.id": float(m.id), ratio: model.ratio}
            for m, model in zip(self.specs, self._codec.models, strict=True)
        ]

    # -- frames ------------------------------------------------------------------------------------------------------

    def addressee(self, bus: int, id: int, raw: bytes) -> int:
        if id & (REMOTE | ERROR) or id & ~EXTENDED > 0xFFFF:
            return -1
        return self._rows[bus].get(id & 0xFF, -1)

    def receive(self, bus: int, id: int, raw: bytes, time: float) -> Answer | None:
        row = self.addressee(bus, id, raw)
        if row < 0 or not self.powered[row]:
            return None
        reply, written = b"", {}
        try:
            for s in subframes(raw[PAYLOAD : PAYLOAD + raw[4]]):
                if s.type == WRITE:
                    written |= {s.first + i: from_raw(v, KINDS.get(s.first + i, "int"), s.resolution)
                                for i, v in enumerate(s.values)}  # fmt: skip
                else:
                    reply += self._reply(row, s, time)
        except ValueError:
            pass  # what was whole counts
        answer = None
        if id & moteus.REPLY_WANTED and reply:
            answer = self._say(row, self._codec.pack(row, id >> 8 & 0x7F, reply[:PAYLOAD_MAX]))
        if Register.MODE in written:
            self._act_on(row, written, time)
        for register, unit in ((Register.SET_OUTPUT_NEAREST, self._rotor_turn(row)), (Register.SET_OUTPUT_EXACT, 0.0)):
            if np.isfinite(wanted := written.get(register, np.nan)):
                self._set_output(row, wanted * TURN, unit)
        return answer

    def _reply(self, row: int, s: Subframe, time: float) -> bytes:
        """The answer to what a subframe asks."""
        if s.type == READ:
            known = self._measure(row)
            values = []
            for register in range(s.first, s.first + min(s.count, REGISTERS_MAX)):
                if register not in known:
                    return bytes([READ_ERROR]) + varuint(register) + varuint(UNKNOWN_REGISTER)
                values.append(known[register])
            return pack_values(REPLY, s.first, s.resolution, values)
        if s.type == CONSOLE_WRITE and s.first == CONSOLE:
            self._hear(row, s.text, time)
        elif s.type == CONSOLE_READ and s.first == CONSOLE:
            said = self._says[row][: min(s.count, PAYLOAD_MAX - 3)]
            self._says[row] = self._says[row][len(said) :]
            return console(CONSOLE_SAYS, said)
        return b""

    def _measure(self, row: int) -> dict[int, float]:
        """What the registers that can be read hold."""
        sign = float(self._sign[row])
        torque = sign * float(self._body.joint_torque[row])
        command = self._command[:, row].tolist()
        return {
            Register.MODE: self.mode[row],
            Register.POSITION: float(self.position[row]) / TURN,
            Register.VELOCITY: sign * float(self._body.joint_vel[row]) / TURN,
            Register.TORQUE: torque,
            Register.Q_CURRENT: torque,  # of a motor of 1 N m/A
            Register.D_CURRENT: 0.0,
            Register.ABS_POSITION: 0.0,
            Register.POWER: torque * float(self._body.joint_vel[row]),
            Register.MOTOR_TEMPERATURE: float(self.rotor_temperature[row]),
            Register.TRAJECTORY_COMPLETE: 1,
            Register.HOME_STATE: self._home_state(row),
            Register.VOLTAGE: BUS_VOLTAGE,
            Register.TEMPERATURE: float(self.driver_temperature[row]),
            Register.FAULT: int(self.error[row]),
            Register.COMMAND_POSITION: command[P],
            Register.COMMAND_VELOCITY: command[V],
            Register.COMMAND_TORQUE: command[T],
            Register.COMMAND_KP_SCALE: command[KP],
            Register.COMMAND_KD_SCALE: command[KD],
            Register.COMMAND_MAX_TORQUE: command[MOST],
            Register.FIRMWARE: FIRMWARE,
            **{Register.SERIAL_NUMBER + i: word + row * (not i) for i, word in enumerate(FIRST_SERIAL)},
        }

    # -- commands ----------------------------------------------------------------------------------------------------

    def _act_on(self, row: int, written: dict[int, float], time: float) -> None:
        """Obey a command: a mode, and what was written with it."""
        mode = written[Register.MODE]
        if mode == Mode.STOPPED:
            self.error[row] = 0
            self._set_mode(row, Mode.STOPPED, time, "disabled")
        elif mode in MODES and self.mode[row] not in (Mode.FAULT, Mode.TIMEOUT):
            here = float(self.position[row]) / TURN
            if self._outside(row, here) and self.mode[row] == Mode.STOPPED:
                self._fail(row, OUTSIDE_LIMIT, time, "outside limit")
                return
            asked = [written.get(r, DEFAULTS.get(r, 0.0)) for r in range(Register.COMMAND_POSITION, 0x26)]
            asked[P] = here if np.isnan(asked[P]) else asked[P]
            asked[V] = np.nan_to_num(asked[V])
            if not np.isfinite(asked[:MOST]).all():
                return  # a device would go wild; a simulation would only end
            self._command[:, row] = asked
            self._came[row] = self._since[row] = self.last_command_time[row] = self._fed[row] = time
            timeout = written.get(Register.COMMAND_TIMEOUT, 0.0)
            timeout = self._registers[row]["servo.default_timeout_s"] if timeout == 0.0 else timeout
            self._timeout[row] = np.inf if np.isnan(timeout) else timeout
            self._set_mode(row, Mode(int(mode)), time, "enabled")
            self._commanded[row] = self._changed = True
            self._set_deadline()

    def _outside(self, row: int, position: float) -> bool:
        held = self._registers[row]
        return position < held["servopos.position_min"] or position > held["servopos.position_max"]

    def _set_mode(self, row: int, mode: Mode, time: float, event: str) -> None:
        self.mode[row] = mode
        on = mode not in (Mode.STOPPED, Mode.FAULT)
        if on != self.enabled[row]:
            self._set_enabled(row, on, time, event)
        self._stale = self._changed = True

    def _targets(self) -> MotorCommand:
        mode = np.array(self.mode)
        held = lambda name: np.array([r[name] for r in self._registers])  # noqa: E731
        in_position, timed_out = mode == Mode.POSITION, mode == Mode.TIMEOUT
        does = np.where(timed_out, held("servo.timeout_mode"), mode)
        damps = (does == Mode.ZERO_VELOCITY) | timed_out & (does == Mode.POSITION)
        kp, kd = held("servo.pid_position.kp") / TURN, held("servo.pid_position.kd") / TURN
        c = self._command
        most = np.where(timed_out, held("servo.timeout_max_torque_Nm"), c[MOST])
        self._body.limit(np.fmin(self._peak(), np.maximum(most, 0.0)))
        scale = np.where(timed_out, 1.0, c[KD])
        return MotorCommand(
            (c[P] + c[V] * np.maximum(self._now - self._came, 0.0)) * TURN,
            c[V] * TURN * in_position,
            kp * c[KP] * in_position,
            kd * scale * (in_position | damps) + SHORTED_DAMPING * (does == Mode.BRAKE),
            c[T] * in_position,
        )

    def act(self, start: float, end: float) -> None:
        self._now = start
        if (self._command[V] * self.enabled).any():
            self._changed = True  # targets move
        super().act(start, end)

    # -- console -----------------------------------------------------------------------------------------------------

    def _hear(self, row: int, text: bytes, time: float) -> None:
        *lines, self._typed[row] = (self._typed[row] + text).replace(b"\r", b"\n").split(b"\n")
        for line in filter(None, lines):
            self._says[row] += (self._execute(row, line.decode(errors="replace").split(), time) + "\r\n").encode()

    def _execute(self, row: int, words: list[str], time: float) -> str:
        """What the console says to a line."""
        held = self._registers[row]
        match words:
            case ["conf", "get", name] if name in held:
                return f"{held[name]:.6f}"
            case ["conf", "set", name, value] if name in held:
                try:
                    held[name] = float(value)
                except ValueError:
                    return "ERR error setting"
                self._configure()
                return "OK"
            case ["conf", "write"]:
                self._flash[row] = dict(held)
                return "OK"
            case ["conf", "load"]:
                self._registers[row] = dict(self._flash[row])
                self._configure()
                return "OK"
            case ["d", "stop"]:
                self._act_on(row, {Register.MODE: Mode.STOPPED}, time)
                return "OK"
            case ["conf", *_]:
                return "ERR unknown group"
        return "ERR unknown command"

    # -- state -------------------------------------------------------------------------------------------------------

    def refresh(self, raw: bytes = b"") -> list[float]:  # type: ignore[override]
        return self._frame_bits(np.frombuffer(raw, self.frame)).tolist() if raw else []

    def _fail(self, row: int, fault: int, now: float, event: str) -> None:
        self.error[row] = fault
        self._set_mode(row, Mode.FAULT, now, event)

    def _trip(self, row: int, now: float) -> None:
        self._fed[row] = np.inf
        self.mode[row] = Mode.TIMEOUT
        self._note(now, row, "watchdog")
        self._stale = self._changed = True

    def _overheat(self, row: int, now: float) -> None:
        self._fail(row, OVER_TEMPERATURE, now, "over-temperature")

    def power(self, row: int, on: bool, time: float) -> None:
        if self.powered[row] != on:
            self.mode[row] = Mode.STOPPED
            self._typed[row] = self._says[row] = b""
            self._command[:, row] = 0.0
        super().power(row, on, time)

    def _boot(self, row: int) -> None:
        self._set[row] = False
        turn = TURN if self._home_state(row) == HomeState.OUTPUT else self._rotor_turn(row)
        self.zero[row] += turn * np.round(self.position[row] / turn)

    def _rotor_turn(self, row: int) -> float:
        """rad of the output."""
        return TURN * self._registers[row]["motor_position.rotor_to_output_ratio"]

    def _home_state(self, row: int) -> HomeState:
        held = self._registers[row]
        sources = held["motor_position.output.source"], held["motor_position.output.reference_source"]
        encoder = any(held.get(f"motor_position.sources.{s:.0f}.reference") == 1.0 for s in sources)
        return HomeState.OUTPUT if encoder or self._set[row] else HomeState.ROTOR

    def _set_output(self, row: int, wanted: float, unit: float) -> None:
        """The position (rad) is what is ``wanted``, up to multiples of ``unit``; 0: just so."""
        shift = float(self.position[row]) - wanted
        self.zero[row] += unit * np.round(shift / unit) if unit else shift
        self._set[row] = self._stale = self._changed = True

    def _peak(self) -> np.ndarray:
        return np.array([m.torque for m in self._codec.models])

    def _configure(self) -> None:
        self._rated = RATED_SHARE * self._peak()
        self._body.limit(self._peak())
        self._changed = True
