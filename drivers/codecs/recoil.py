"""Recoil motor controllers of the Berkeley Humanoid Lite: bytes to SI and back, host side and motor side.

    identifier = function (4 bits) << 7 | device (7 bits); a device answers function f + 1 of a PDO on f, an SDO on B

The position law runs in the device, on gains that are its own state (parameters POSITION_KP and VELOCITY_KP), not part
of a command: ``torque = kp (position - q) - kd dq``. A velocity target and a feed-forward torque are ignored in
position mode. So a command (kp, kd, p, v, t) is sent as the position ``p + (kd v + t) / kp``, which makes the same
torque; with kp = 0 there is no such position, and v and t are lost; and the device keeps the sum within its position
limits. Gains go out when they change, and one of the 2 n in each tick again, so that a lost frame lasts 2 n ticks at
most.

Feedback of a command is position and velocity only. Mode, error and torque are asked by SDO, whose answers do not say what
they answer: each motor is asked for one parameter at a time, and again only when it has answered or had time to.

The watchdog is the device's WATCHDOG_TIMEOUT (ms); PDO1 to 3 and HEARTBEAT feed it. On expiry it sets an error bit and goes
from any driving mode to DAMPING (phases shorted), of which only another mode set by NMT takes it out.

An SDO parameter is a byte offset into the firmware's memory, with an upper bound as the only check: a wrong one writes over
what the motor runs on. No offset leaves here but those in PARAMETERS.

Sources: firmware T-K-233/Recoil-Motor-Controller-BESC (function codes, parameters, modes, errors, position controller) and
the host's side HybridRobotics/Berkeley-Humanoid-Lite-Lowlevel (lengths of the frames, FLUX_OFFSET), whose error enumeration
disagrees with the firmware's from bit 10 on; the firmware's is used.
"""

from __future__ import annotations

from enum import IntEnum
from typing import NamedTuple

import numpy as np

from drivers.bus import BusError, BusSpec, MotorCommand, MotorState
from drivers.can_bus import RegisterAnswer, RegisterCheck
from drivers.codecs.mit import QUANTITIES
from drivers.codecs.robstride import model_of
from drivers.wire import make_frames

FUNCTION_SHIFT = 7
DEVICE_MASK = 0x7F
ID_MAX = 63  # of a device
KP_FLOOR = 1e-3  # N m/rad: below it kp is sent as 0, for no position would make a torque
SDO_PATIENCE = 5  # ticks after which an SDO answer no longer comes


class Model(NamedTuple):
    """``torque``: N m that the device is told to stay below (TORQUE_LIMIT)."""

    torque: float


# Torque limits of the makers' own training and deployment configuration (legs 6 N m, arms 4 N m), by actuator size.
MODELS: dict[str, Model] = {
    "6512": Model(6.0),
    "5010": Model(4.0),
}


class Function(IntEnum):
    """Top four bits of an identifier. "R" as the device sees it: received from the host."""

    NMT = 0x0  # [mode, device]; no answer
    SYNC_EMCY = 0x1
    TPDO1 = 0x3
    RPDO1 = 0x4  # echoed
    TPDO2 = 0x5  # [position f4, velocity f4]
    RPDO2 = 0x6  # [position target f4, velocity target f4]
    TPDO3 = 0x7  # [position f4, torque f4]
    RPDO3 = 0x8  # [position target f4, torque target f4]
    TPDO4 = 0x9  # as TPDO2, unasked, at FAST_FRAME_FREQUENCY
    TSDO = 0xB  # [value, 4 bytes]
    RSDO = 0xC  # [READ, offset u16] or [WRITE, offset u16, 0, value, 4 bytes]
    FLASH = 0xD  # [1 store, 2 load]
    HEARTBEAT = 0xE  # no payload, no answer


class Mode(IntEnum):
    """What a device does."""

    DISABLED = 0x00
    IDLE = 0x01
    DAMPING = 0x02
    CALIBRATION = 0x05
    CURRENT = 0x10
    TORQUE = 0x11
    VELOCITY = 0x12
    POSITION = 0x13
    VABC_OVERRIDE = 0x20
    VALPHABETA_OVERRIDE = 0x21
    VQD_OVERRIDE = 0x22
    DEBUG = 0x80


READ, WRITE = 2 << 5, 1 << 5  # first byte of an RSDO

# The only offsets that are ever sent: (byte offset, numpy type, writable).
PARAMETERS: dict[str, tuple[int, str, bool]] = {
    "DEVICE_ID": (0x000, "<u4", False),
    "FIRMWARE_VERSION": (0x004, "<u4", False),
    "WATCHDOG_TIMEOUT": (0x008, "<u4", True),  # ms
    "FAST_FRAME_FREQUENCY": (0x00C, "<u4", True),  # Hz; 0: no TPDO4
    "MODE": (0x010, "<u4", False),
    "ERROR": (0x014, "<u4", False),
    "GEAR_RATIO": (0x01C, "<f4", False),
    "POSITION_KP": (0x020, "<f4", True),  # N m/rad
    "POSITION_KI": (0x024, "<f4", True),
    "VELOCITY_KP": (0x028, "<f4", True),  # N m s/rad: kd of the position law
    "VELOCITY_KI": (0x02C, "<f4", True),
    "TORQUE_LIMIT": (0x030, "<f4", True),  # N m
    "VELOCITY_LIMIT": (0x034, "<f4", True),  # rad/s
    "POSITION_LIMIT_LOWER": (0x038, "<f4", True),  # rad
    "POSITION_LIMIT_UPPER": (0x03C, "<f4", True),  # rad
    "POSITION_OFFSET": (0x040, "<f4", False),  # rad
    "TORQUE_MEASURED": (0x048, "<f4", False),  # N m
    "VELOCITY_MEASURED": (0x054, "<f4", False),  # rad/s
    "POSITION_MEASURED": (0x060, "<f4", False),  # rad
    "TORQUE_FILTER_ALPHA": (0x070, "<f4", True),
    "CURRENT_LIMIT": (0x074, "<f4", True),  # A
    "BUS_VOLTAGE": (0x100, "<f4", False),  # V
    "ENCODER_CPR": (0x120, "<i4", False),
    "FLUX_OFFSET": (0x13C, "<f4", False),  # rad, as its own calibration measured it: no two motors have the same
}
PARAMETER_NAMES = {offset: name for name, (offset, _, _) in PARAMETERS.items()}
MONITORED = ("MODE", "ERROR", "MODE", "TORQUE_MEASURED")  # asked in turn

ERRORS: dict[int, str] = {
    0: "general",
    1: "emergency stop",
    2: "initialisation",
    3: "calibration",
    4: "power stage",
    5: "invalid mode",
    6: "watchdog timeout",
    7: "over-voltage",
    8: "over-current",
    9: "over-temperature",
    10: "CAN reception",
    11: "CAN transmission",
    12: "I2C",
    13: "encoder",
}
WATCHDOG_ERROR = 1 << 6
INVALID_MODE = 1 << 5


class Sdo(NamedTuple):
    """A request for a parameter. ``value`` None: to read it."""

    name: str  # of PARAMETERS, or "" for any other offset
    value: float | int | None


def identifier(function: int, device: int) -> int:
    """11-bit identifier."""
    return function << FUNCTION_SHIFT | device


def pack_value(name: str, value: float | int) -> bytes:
    """The four bytes of a parameter's value. Raises ValueError for a float that is not finite."""
    kind = PARAMETERS[name][1]
    if kind == "<f4" and not np.isfinite(value):
        raise ValueError(f"parameter {name}: got {value}, expected a finite value")
    return np.array([value], kind).tobytes()


def pack_sdo(device: int, name: str, value: float | int | None = None) -> np.ndarray:
    """One RSDO (FRAME, (1,)). Raises KeyError, and ValueError for a parameter that is only read."""
    offset, _, writable = PARAMETERS[name]
    if value is not None and not writable:
        raise ValueError(
            f"parameter {name} of device {device}: got a value to write, expected a question: it is read-only"
        )
    head = bytes([READ if value is None else WRITE]) + offset.to_bytes(2, "little")
    raw = head if value is None else head + b"\0" + pack_value(name, value)
    return _frame(identifier(Function.RSDO, device), raw)


def unpack_sdo(frame: np.ndarray) -> Sdo | None:
    """What an RSDO (one FRAME) asks; None if it is malformed."""
    raw = frame["data"].tobytes()
    name = PARAMETER_NAMES.get(int.from_bytes(raw[1:3], "little"), "")
    if raw[0] == READ and frame["length"] >= 3:
        return Sdo(name, None)
    if raw[0] == WRITE and frame["length"] == 8:
        return Sdo(name, np.frombuffer(raw, PARAMETERS[name][1] if name else "<u4", 1, 4)[0].item())
    return None


def _frame(id: int, raw: bytes) -> np.ndarray:
    return make_frames(np.array([id]), np.frombuffer(raw.ljust(8, b"\0"), np.uint8)[None], len(raw))


def _floats(data: np.ndarray) -> np.ndarray:
    """(m, 2) float64 of payloads (m, 8) uint8."""
    with np.errstate(invalid="ignore"):  # a signalling NaN is a NaN
        return np.ascontiguousarray(data).view("<f4").astype(float)


def _bytes(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Payloads (n, 8) uint8 of two floats each."""
    return np.stack([first, second], axis=1).astype("<f4").view(np.uint8)


class RecoilCodec:
    """The host's side of one bus (a ``can_bus.CanCodec``). It remembers which gains each device has, and what it was asked."""

    # Bits of RPDO2 and TPDO2 and, every third tick, of an SDO question (3 bytes) and its answer (4 bytes): means of random
    # targets and states. For the whole bus, one gain a tick; worst, while gains move (soft start, scaled torque), both
    # gains of every motor in each.
    TICK_BITS = (120.5 + 115.1 + (77.0 + 84.0) / 3, 135.0 + 135.0 + (85.0 + 95.0) / 3 + 2 * 135.0)
    TICK_OVERHEAD_BITS = 120.0
    IDENTITY = ("FIRMWARE_VERSION", "FLUX_OFFSET")  # there is no serial number
    TURN = 0.0  # the count of the motor's own turns is lost, and with it the joint's zero
    MOTOR_FRAMES = 2 + 2 / 3

    def __init__(self, spec: BusSpec) -> None:
        """Raises BusError for an unknown model or ids that a device cannot have."""
        _check_ids(spec)
        n = len(spec.motors)
        self._spec = spec
        self._ids = np.array([m.id for m in spec.motors], np.uint32)
        self._row_of = np.full(0x800 + 1, -1, np.intp)
        for function in (Function.TPDO1, Function.TPDO2, Function.TPDO3, Function.TPDO4, Function.TSDO):
            self._row_of[identifier(function, 0) | self._ids] = np.arange(n)
        self._torque = np.array([model_of(m, MODELS, "recoil.py").torque for m in spec.motors])
        self.checks = _checks(spec, self._torque)
        self._gains = np.full((2, n), np.nan)  # kp, kd that each device was last told
        self._turn = 0
        self._asked: list[str] = [""] * n  # parameter that each device owes an answer to
        self._waited = np.zeros(n, int)  # ticks since
        self._next = [0] * n  # of MONITORED
        self._mode = np.full(n, -1)

    # -- to the motors -----------------------------------------------------------------------------------------------

    def pack_command(self, command: MotorCommand) -> np.ndarray:
        """Gains where they are not known to be in place, and a target for each motor; and questions. Raises ValueError
        for a value not finite."""
        values = np.array([command.position, command.velocity, command.kp, command.kd, command.torque], float)
        finite = np.isfinite(values)
        if not finite.all():
            quantity, motor = np.argwhere(~finite)[0]
            raise ValueError(
                f"command of motor {motor} (counted from 0): got {QUANTITIES[quantity]} {values[quantity, motor]}, "
                "expected a finite value; nothing was packed"
            )
        values = np.clip(values, -1e30, 1e30)
        position, velocity, kp, kd, torque = values
        kp = np.where(kp < KP_FLOOR, 0.0, kp).astype(np.float32).astype(float)
        kd = np.maximum(kd, 0.0).astype(np.float32).astype(float)
        shift = np.divide(kd * velocity + torque, kp, out=np.zeros_like(kp), where=kp > 0)
        return np.concatenate(
            [
                *self._pack_gains(kp, kd),
                self._pack_targets(np.clip(position + shift, -1e30, 1e30), velocity),
                *self._pack_questions(),
            ]
        )

    def _pack_targets(self, position: np.ndarray, velocity: np.ndarray) -> np.ndarray:
        return make_frames(identifier(Function.RPDO2, 0) | self._ids, _bytes(position, velocity))

    def _pack_gains(self, kp: np.ndarray, kd: np.ndarray) -> list[np.ndarray]:
        wanted = np.array([kp, kd])
        due = wanted != self._gains
        due.flat[self._turn % due.size] = True
        self._turn += 1
        self._gains = wanted
        frames = []
        for quantity, row in np.argwhere(due):
            name = ("POSITION_KP", "VELOCITY_KP")[quantity]
            frames.append(pack_sdo(int(self._ids[row]), name, float(wanted[quantity, row])))
        return frames

    def _pack_questions(self) -> list[np.ndarray]:
        """The next question to every third motor that owes no answer."""
        frames = []
        self._waited += 1
        for row, asked in enumerate(self._asked):
            if asked and self._waited[row] < SDO_PATIENCE or (row + self._turn) % 3:
                continue
            name = MONITORED[self._next[row] % len(MONITORED)]
            self._next[row] += 1
            self._ask(row, name)
            frames.append(pack_sdo(int(self._ids[row]), name))
        return frames

    def _ask(self, row: int, name: str) -> None:
        self._asked[row], self._waited[row] = name, 0

    def pack_enable(self, state: MotorState) -> np.ndarray:
        """To each motor that does not drive: gains of zero, so that no old target pulls, and position mode; one with an
        error goes through IDLE, which the device demands of one that was disabled or damps."""
        rows = np.flatnonzero(~state.enabled)
        frames = [np.zeros(0, self.pack_disable().dtype)]
        for row in rows.tolist():
            device = int(self._ids[row])
            self._gains[:, row] = 0.0
            frames += [pack_sdo(device, "POSITION_KP", 0.0), pack_sdo(device, "VELOCITY_KP", 0.0)]
            frames += [pack_mode(device, Mode.IDLE), pack_mode(device, Mode.POSITION)]
        return np.concatenate(frames)

    def pack_disable(self) -> np.ndarray:
        return np.concatenate([pack_mode(m.id, Mode.IDLE) for m in self._spec.motors])

    def pack_poll(self, state: MotorState) -> np.ndarray:
        """The last known position as target, which is answered with the state and, in a motor that drives, holds."""
        here = np.where(np.isfinite(state.position), state.position, 0.0)
        self._turn += 1
        return np.concatenate([self._pack_targets(here, np.zeros_like(here)), *self._pack_questions()])

    def pack_register(self, row: int, register: str, value: float | int | None = None) -> np.ndarray:
        """One request (FRAME, (1,)) to read a parameter of motor ``row``, or to write ``value`` to it."""
        if value is None:
            self._ask(row, register)
        elif PARAMETERS[register][1] != "<f4":
            value = int(value)
        return pack_sdo(self._spec.motors[row].id, register, value)

    # -- from the motors ---------------------------------------------------------------------------------------------

    def unpack_registers(self, frames: np.ndarray) -> list[RegisterAnswer]:
        """Every SDO answer among ``frames``, as what the motor was last asked for."""
        rows, functions = self._sort(frames)
        answers = []
        for i in np.flatnonzero((rows >= 0) & (functions == Function.TSDO)).tolist():
            row = int(rows[i])
            if name := self._asked[row]:
                value = np.frombuffer(frames["data"][i].tobytes(), PARAMETERS[name][1], 1)[0].item()
                self._asked[row] = ""
                answers.append(RegisterAnswer(row, name, value, False))
        return answers

    def unpack(self, frames: np.ndarray, state: MotorState, now: float) -> int:
        """Put positions, velocities and answers into ``state``, the latest of each motor last. Returns how many frames
        came from nobody on this bus or were malformed."""
        rows, functions = self._sort(frames)
        values = _floats(frames["data"])
        motion = (rows >= 0) & np.isin(functions, (Function.TPDO2, Function.TPDO4)) & np.isfinite(values).all(axis=1)
        mine = rows[motion]
        state.position[mine], state.velocity[mine] = values[motion].T
        state.time[mine] = now
        force = (rows >= 0) & (functions == Function.TPDO3) & np.isfinite(values).all(axis=1)
        state.torque[rows[force]] = values[force, 1]
        for answer in self.unpack_registers(frames):
            if answer.register == "MODE":
                self._mode[answer.row] = answer.value
            elif answer.register == "ERROR":
                state.error[answer.row] = answer.value
            elif answer.register == "TORQUE_MEASURED":
                state.torque[answer.row] = answer.value
        state.enabled[:] = self._mode == Mode.POSITION
        return int(np.count_nonzero(rows < 0))

    def owners(self, frames: np.ndarray) -> np.ndarray:
        """Whose each of ``frames`` is: (m,) rows of the motors, -1 for nobody on this bus."""
        return self._sort(frames)[0]

    def _sort(self, frames: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Whose each frame is (m,), -1 for nobody's or malformed, and its Function (m,)."""
        rows = self._row_of[np.minimum(frames["id"], 0x800)].copy()
        functions = frames["id"] >> FUNCTION_SHIFT
        expected = np.where(functions == Function.TSDO, 4, 8)
        rows[frames["length"] != expected] = -1
        return rows, functions

    def error_name(self, code: int) -> str:
        return ", ".join(ERRORS.get(bit, f"bit {bit}") for bit in range(32) if code >> bit & 1) or "none"


def pack_mode(device: int, mode: int) -> np.ndarray:
    """One NMT frame (FRAME, (1,)). It names the device twice: even on identifier 0 only the named one obeys."""
    return _frame(identifier(Function.NMT, device), bytes([mode, device]))


def _checks(spec: BusSpec, torque: np.ndarray) -> list[RegisterCheck]:
    n = len(spec.motors)
    milliseconds = max(1, round(spec.watchdog * 1e3))
    keep = "the device does not keep it: is its firmware 1.1.1 or later?"
    return [
        RegisterCheck(
            "MODE", np.full(n, Mode.IDLE), "the device does not let itself be stopped: does another host drive it?"
        ),
        RegisterCheck(
            "POSITION_KI", np.zeros(n), f"the integrator would wind up against the policy; {keep}", write=True
        ),
        RegisterCheck("FAST_FRAME_FREQUENCY", np.zeros(n), f"unasked frames would fill the bus; {keep}", write=True),
        RegisterCheck("TORQUE_LIMIT", torque.astype(np.float32).astype(float), keep, write=True),
        RegisterCheck(
            "WATCHDOG_TIMEOUT", np.full(n, milliseconds), f"the motor would not damp by itself; {keep}", write=True
        ),
    ]


def _check_ids(spec: BusSpec) -> None:
    for m in spec.motors:
        where = f"bus {spec.name}, motor of {m.joint}"
        if not 0 < m.id <= ID_MAX:
            raise BusError(f"{where}: got id {m.id:#x}, expected 0x1 to {ID_MAX:#x} (device id)")
        if m.feedback_id:
            raise BusError(
                f"{where} (id {m.id:#x}): got feedback_id {m.feedback_id:#x}, expected none: it answers on its own id"
            )


class RecoilMotors:
    """The motors' side: whom a frame is for, and the frames that emulated motors answer with."""

    def __init__(self, spec: BusSpec) -> None:
        self.ids = np.array([m.id for m in spec.motors], np.uint32)

    def unpack_targets(self, frame: np.ndarray) -> tuple[float, float]:
        """The two numbers of an RPDO2 (position, velocity) or RPDO3 (position, torque), one FRAME."""
        first, second = np.frombuffer(frame["data"].tobytes(), "<f4").tolist()
        return first, second

    def pack_motion(self, row: int, function: Function, position: float, second: float) -> np.ndarray:
        """A TPDO2 or TPDO4 (rad, rad/s), or TPDO3 (rad, N m), FRAME (1,)."""
        return _frame(identifier(function, int(self.ids[row])), np.array([position, second], "<f4").tobytes())

    def pack_motions(self, position: np.ndarray, velocity: np.ndarray) -> np.ndarray:
        """The TPDO2 (FRAME, (n,)) of every motor: rad, rad/s."""
        return make_frames(identifier(Function.TPDO2, 0) | self.ids, _bytes(position, velocity))

    def pack_echo(self, row: int, data: np.ndarray) -> np.ndarray:
        """A TPDO1 (FRAME, (1,)): the eight bytes of the RPDO1."""
        return _frame(identifier(Function.TPDO1, int(self.ids[row])), data.tobytes())

    def pack_answer(self, row: int, value: bytes) -> np.ndarray:
        """A TSDO (FRAME, (1,)) of four bytes."""
        return _frame(identifier(Function.TSDO, int(self.ids[row])), value)
