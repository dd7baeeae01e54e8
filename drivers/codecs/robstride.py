"""RobStride and CyberGear motors in their private protocol (29-bit identifiers): bytes to SI and back, both sides.

    identifier = type (5 bits) << 24 | data (16 bits) << 8 | destination (8 bits)

A host asks with ``data`` = its own id (for OPERATION: the torque) and ``destination`` = the motor; a motor answers with its
own id in the low byte of ``data`` and the host as ``destination``. Motion (types 1, 2 and 24) is big-endian, everything
else little-endian.

Feedback (type 2) answers OPERATION, ENABLE, STOP, SET_ZERO and WRITE. There is no question for the state alone: polling
repeats the write of canTimeout that connecting did, which changes nothing. Motors with the active report switched on send
the same as type 24 without being asked.

Position feedback comes back in from the other end beyond full scale. After power-on the motor counts from 0 to 2 pi
(zero_sta 0, the factory's choice) or from -pi to pi (zero_sta 1): connecting demands the latter, because with the former a
joint that rests just below its zero wakes up a whole turn away.

canTimeout (units of 50 us, factory: 0 = off) is the watchdog. What the motor does on expiry, the manual does not say.

Sources: the maker's manuals of RS00 to RS06 and EL05 (edition of 2026-04-28: communication types, parameter list, ranges
by model, and the example of reading loc_kp), and of the CyberGear.
"""

from __future__ import annotations

import difflib
from collections.abc import Mapping
from enum import IntEnum
from typing import NamedTuple, TypeVar

import numpy as np

from drivers.bus import BusError, BusSpec, MotorCommand, MotorSpec, MotorState
from drivers.can_bus import RegisterAnswer, RegisterCheck
from drivers.codecs.mit import QUANTITIES, ROUNDING
from drivers.wire import EXTENDED, make_frames

HOST_ID = 0xFD
ID_MAX = 0x7F
TIMEOUT_TICK = 50e-6  # s, unit of canTimeout: 20000 are 1 s
TEMPERATURE_UNIT = 0.1  # deg C
FULL_TURNS = 4 * np.pi  # rad: full scale of position, every model
CODE_MAX = 0xFFFF
Row = TypeVar("Row")  # of a table of models


class Model(NamedTuple):
    """Full scale of velocity (rad/s), torque (N m), kp (N m/rad) and kd (N m s/rad) in types 1 and 2."""

    velocity: float
    torque: float
    kp: float
    kd: float


# The MIT mode of the same motors has other ranges: see robstride_mit.py.
MODELS: dict[str, Model] = {
    "CyberGear": Model(30, 12, 500, 5),
    "RS00": Model(33, 14, 500, 5),
    "RS01": Model(44, 17, 500, 5),
    "RS02": Model(44, 17, 500, 5),
    "RS03": Model(20, 60, 5000, 100),
    "RS04": Model(15, 120, 5000, 100),
    "RS05": Model(50, 5.5, 500, 5),
    "RS06": Model(50, 36, 5000, 100),
    "EL05": Model(50, 6, 500, 5),
}


class Type(IntEnum):
    """Communication type: the top five bits of an identifier."""

    GET_ID = 0  # answered with the 64-bit serial of the chip
    OPERATION = 1  # an MIT command
    FEEDBACK = 2
    ENABLE = 3
    STOP = 4  # byte 0 = 1: clear faults too
    SET_ZERO = 6  # byte 0 = 1
    SET_ID = 7  # data = new id << 8 | host; at once
    READ = 17
    WRITE = 18  # until power-off; answered with feedback
    FAULT = 21  # u32 faults, u32 warnings
    SAVE = 22  # CyberGear: baud rate
    BAUD = 23  # from the next power-on
    REPORT = 24  # switches the active report; its frames have this type too
    PROTOCOL = 25  # 0 private, 1 CANopen, 2 MIT; from the next power-on


class Mode(IntEnum):
    """Bits 22 and 23 of a feedback identifier."""

    RESET = 0
    CALIBRATION = 1
    RUN = 2


# Parameter name: (index, numpy type of its value)
PARAMETERS: dict[str, tuple[int, str]] = {
    "run_mode": (0x7005, "u1"),  # 0 operation (MIT), 1 PP, 2 velocity, 3 current, 5 CSP
    "iq_ref": (0x7006, "<f4"),
    "spd_ref": (0x700A, "<f4"),
    "limit_torque": (0x700B, "<f4"),  # N m
    "cur_kp": (0x7010, "<f4"),
    "cur_ki": (0x7011, "<f4"),
    "cur_filt_gain": (0x7014, "<f4"),
    "loc_ref": (0x7016, "<f4"),
    "limit_spd": (0x7017, "<f4"),
    "limit_cur": (0x7018, "<f4"),
    "mechPos": (0x7019, "<f4"),
    "iqf": (0x701A, "<f4"),
    "mechVel": (0x701B, "<f4"),
    "VBUS": (0x701C, "<f4"),
    "loc_kp": (0x701E, "<f4"),
    "spd_kp": (0x701F, "<f4"),
    "spd_ki": (0x7020, "<f4"),
    "acc_rad": (0x7022, "<f4"),
    "vel_max": (0x7024, "<f4"),
    "acc_set": (0x7025, "<f4"),
    "EPScan_time": (0x7026, "<u2"),  # 1: an active report every 10 ms, each one more: 5 ms later
    "canTimeout": (0x7028, "<u4"),  # 50 us; 0: off
    "zero_sta": (0x7029, "u1"),  # position at power-on in 0: 0..2 pi, 1: -pi..pi
    "damper": (0x702A, "u1"),
    "add_offset": (0x702B, "<f4"),
}
PARAMETER_NAMES = {index: name for name, (index, _) in PARAMETERS.items()}
BIT_RATES = {1: 1_000_000, 2: 500_000, 3: 250_000, 4: 125_000}  # of BAUD
UID = "MCU_UID"  # no parameter: the answer to GET_ID, 64 bits
BROADCAST_ID = 0xFE  # to which GET_ID is answered
SEQUENCE = bytes(range(1, 9))  # payload by which SAVE, BAUD, REPORT and PROTOCOL are meant

# Bits of MotorState.error: the six of a feedback identifier, and behind them the 32 of a fault frame.
FAULTS: dict[int, str] = {
    0: "under-voltage",
    1: "over-current",
    2: "over-temperature",
    3: "magnetic encoder",
    4: "stall or overload",  # CyberGear: Hall encoder
    5: "not calibrated",
    8: "motor over-temperature",
    9: "driver fault",
    10: "under-voltage",
    11: "over-voltage",
    12: "phase B over-current",
    13: "phase C over-current",
    15: "encoder not calibrated",
    16: "hardware identification",
    17: "position initialisation",
    22: "stall (I2t)",
    24: "phase A over-current",
}
DETAIL_SHIFT = 8


class Parameter(NamedTuple):
    """A payload of READ or WRITE, or of the answer to READ."""

    name: str  # of PARAMETERS, or "" for another index
    value: float | int


def identifier(kind: int, data: int, destination: int) -> int:
    """The identifier with EXTENDED set."""
    return EXTENDED | kind << 24 | data << 8 | destination


def pack_parameter(name: str, value: float | int = 0) -> np.ndarray:
    """Payload (8,) uint8 of READ and WRITE, and of the answer to READ. Raises KeyError, ValueError."""
    index, kind = PARAMETERS[name]
    if kind == "<f4" and not np.isfinite(value):
        raise ValueError(f"parameter {name}: got {value}, expected a finite value")
    data = np.zeros(8, np.uint8)
    data[:2] = np.array([index], "<u2").view(np.uint8)
    encoded = np.array([value], kind).view(np.uint8)
    data[4 : 4 + len(encoded)] = encoded
    return data


def unpack_parameter(data: np.ndarray) -> Parameter:
    """A payload (8,) uint8 of READ, WRITE or the answer to READ."""
    raw = data.tobytes()
    name = PARAMETER_NAMES.get(int.from_bytes(raw[:2], "little"), "")
    kind = PARAMETERS[name][1] if name else "<u4"
    return Parameter(name, np.frombuffer(raw, kind, 1, 4)[0].item())


def timeout_ticks(seconds: float) -> int:
    """Value of canTimeout for a watchdog of ``seconds``; at least one tick, for 0 would switch it off."""
    return max(1, round(seconds / TIMEOUT_TICK))


def model_of(motor: MotorSpec, models: Mapping[str, Row], file: str) -> Row:
    """The row of ``models`` (in codec ``file``) for this motor. Raises BusError listing those that there are."""
    if motor.model not in models:
        close = difflib.get_close_matches(motor.model, models, n=1)
        hint = f" (did you mean '{close[0]}'?)" if close else ""
        raise BusError(
            f"motor of {motor.joint} (id {motor.id}): no model '{motor.model}'{hint}; known: {', '.join(models)}.\n"
            f"  Add its ranges to MODELS in drivers/codecs/{file}"
        )
    return models[motor.model]


class Scales:
    """Linear 16-bit codes of the five quantities of n motors: code = trunc((x - low) 65535 / (high - low))."""

    def __init__(self, motors: tuple[MotorSpec, ...]) -> None:
        """Raises BusError for a model that is not in MODELS."""
        full = np.array([(FULL_TURNS, *model_of(m, MODELS, "robstride.py")) for m in motors], float).T
        position, velocity, torque, kp, kd = full
        self.torque = torque
        self.high = np.array([position, velocity, kp, kd, torque])
        self.low = np.array([-position, -velocity, 0 * kp, 0 * kd, -torque])
        self.lsb = (self.high - self.low) / CODE_MAX

    def codes(self, values: np.ndarray) -> np.ndarray:
        """(5, n) int64 of (5, n) SI values, saturated. Raises ValueError naming the first value that is not finite."""
        finite = np.isfinite(values)
        if not finite.all():
            quantity, motor = np.argwhere(~finite)[0]
            raise ValueError(
                f"command of motor {motor} (counted from 0): got {QUANTITIES[quantity]} {values[quantity, motor]}, "
                "expected a finite value; nothing was packed"
            )
        x = np.clip(values, self.low, self.high)
        return ((x - self.low) / self.lsb + ROUNDING).astype(np.int64)

    def values(self, codes: np.ndarray, quantities: list[int], rows: np.ndarray) -> np.ndarray:
        """(len(quantities), m) SI values of codes of motors ``rows`` (m,)."""
        at = np.array(quantities)[:, None], rows
        return self.low[at] + codes * self.lsb[at]


def _big_endian(codes: np.ndarray) -> np.ndarray:
    """Payloads (m, 8) uint8 of four 16-bit codes (4, m)."""
    return np.ascontiguousarray(codes.T.astype(">u2")).view(np.uint8)


def _from_big_endian(data: np.ndarray) -> np.ndarray:
    """Four 16-bit codes (4, m) of payloads (m, 8) uint8."""
    return np.ascontiguousarray(data).view(">u2").astype(np.int64).T


class RobstrideCodec:
    """The host's side of one bus (a ``can_bus.CanCodec``)."""

    # Bits of OPERATION and its answer: the mean of random traffic, and the most that stuffing makes of 2 x 131 bits.
    TICK_BITS = (140.3 + 140.3, 160.0 + 160.0)
    IDENTITY = (UID,)
    TURN = 2 * np.pi  # from power-on it counts from -pi to pi

    def __init__(self, spec: BusSpec) -> None:
        """Raises BusError for an unknown model or identifiers that the protocol does not have."""
        check_ids(spec)
        n = len(spec.motors)
        self._spec = spec
        self._scales = Scales(spec.motors)
        self._ids = np.array([m.id for m in spec.motors], np.uint32)
        self._row_of = np.full(0x100, -1, np.intp)
        self._row_of[self._ids] = np.arange(n)
        self._details = np.zeros(n, np.int64)  # of the last fault frame, shifted
        ticks = timeout_ticks(spec.watchdog)
        self.checks = _checks(spec, self._scales.torque, ticks)
        self._enable = self._ask(Type.ENABLE)
        self._stop = self._ask(Type.STOP)
        self._clear = self._ask(Type.STOP, np.array([1, 0, 0, 0, 0, 0, 0, 0], np.uint8))
        self._poll = self._ask(Type.WRITE, pack_parameter("canTimeout", ticks))

    def _ask(self, kind: Type, data: np.ndarray | None = None) -> np.ndarray:
        """The same request to every motor (FRAME, (n,))."""
        payload = np.zeros(8, np.uint8) if data is None else data
        return make_frames(identifier(kind, HOST_ID, 0) | self._ids, np.tile(payload, (len(self._ids), 1)))

    def pack_command(self, command: MotorCommand) -> np.ndarray:
        """One OPERATION for each motor (FRAME, (n,)). Saturates; raises ValueError for a value not finite."""
        c = command
        codes = self._scales.codes(np.array([c.position, c.velocity, c.kp, c.kd, c.torque], float))
        torque = codes[4].astype(np.uint32) << 8
        return make_frames(identifier(Type.OPERATION, 0, 0) | torque | self._ids, _big_endian(codes[:4]))

    def pack_enable(self, state: MotorState) -> np.ndarray:
        """Enable frames, each behind a "clear faults" where ``state`` shows one (which stops: not repeated while
        running)."""
        faulty = state.error != 0
        self._details[faulty] = 0
        return np.concatenate([self._clear[faulty], self._enable])

    def pack_disable(self) -> np.ndarray:
        return self._stop

    def pack_poll(self, state: MotorState) -> np.ndarray:
        """The watchdog's own value once more: the one request that is answered with feedback and changes nothing."""
        return self._poll

    def pack_register(self, row: int, register: str, value: float | int | None = None) -> np.ndarray:
        """One request (FRAME, (1,)) to read a parameter of motor ``row``, or to write ``value`` to it."""
        if register == UID:
            return self._ask(Type.GET_ID)[row : row + 1]
        kind = Type.READ if value is None else Type.WRITE
        data = pack_parameter(register, value or 0)
        return make_frames(np.array([identifier(kind, HOST_ID, self._spec.motors[row].id)]), data[None])

    def unpack_registers(self, frames: np.ndarray) -> list[RegisterAnswer]:
        """Every answer to READ and GET_ID among ``frames``; NaN where the motor says that it failed."""
        rows, types = self._sort(frames)
        found = []
        for i in np.flatnonzero((rows >= 0) & (types == Type.GET_ID)):
            uid = int.from_bytes(frames["data"][i].tobytes(), "little")
            found.append(RegisterAnswer(int(rows[i]), UID, uid, False))
        for i in np.flatnonzero((rows >= 0) & (types == Type.READ)):
            parameter = unpack_parameter(frames["data"][i])
            failed = int(frames["id"][i]) >> 16 & 0xFF
            found.append(RegisterAnswer(int(rows[i]), parameter.name, np.nan if failed else parameter.value, False))
        return found

    def unpack(self, frames: np.ndarray, state: MotorState, now: float) -> int:
        """Put feedback, reports and fault frames into ``state``, the latest of each motor last. Returns how many frames
        came from nobody on this bus or were malformed."""
        rows, types = self._sort(frames)
        known = (rows >= 0) & ((types == Type.FEEDBACK) | (types == Type.REPORT))
        for i in np.flatnonzero((rows >= 0) & (types == Type.FAULT)):
            faults = int.from_bytes(frames["data"][i, :4].tobytes(), "little")
            self._details[rows[i]] = faults << DETAIL_SHIFT
            state.error[rows[i]] = state.error[rows[i]] & (1 << DETAIL_SHIFT) - 1 | faults << DETAIL_SHIFT
        mine, ids = rows[known], frames["id"][known].astype(np.int64)
        codes = _from_big_endian(frames["data"][known])
        motion = self._scales.values(codes[:3], [0, 1, 4], mine)
        state.position[mine], state.velocity[mine], state.torque[mine] = motion
        state.temperature[mine] = codes[3].astype(np.int16) * TEMPERATURE_UNIT
        state.error[mine] = ids >> 16 & 0x3F | self._details[mine]
        state.enabled[mine] = ids >> 22 & 3 == Mode.RUN
        state.time[mine] = now
        return int(np.count_nonzero(rows < 0))

    def owners(self, frames: np.ndarray) -> np.ndarray:
        """Whose each of ``frames`` is: (m,) rows of the motors, -1 for nobody on this bus."""
        return self._sort(frames)[0]

    def _sort(self, frames: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Whose each frame is (m,), -1 for nobody's or malformed, and its type (m,)."""
        ids = frames["id"].astype(np.int64)
        types = ids >> 24 & 0x1F
        rows = self._row_of[ids >> 8 & 0xFF].copy()
        listener = np.where(types == Type.GET_ID, BROADCAST_ID, HOST_ID)
        answers = np.isin(types, ANSWERS) & (ids & 0xFF == listener) & (ids >> 29 == EXTENDED >> 29)
        rows[~answers | (frames["length"] != 8)] = -1
        return rows, types

    def error_name(self, code: int) -> str:
        named = [FAULTS.get(bit, f"bit {bit}") for bit in range(40) if code >> bit & 1]
        return ", ".join(named) or "none"


ANSWERS = [Type.GET_ID, Type.FEEDBACK, Type.READ, Type.FAULT, Type.REPORT]


def _checks(spec: BusSpec, torque: np.ndarray, ticks: int) -> list[RegisterCheck]:
    """What connecting reads, writes and compares, in this order."""
    n = len(spec.motors)
    return [
        RegisterCheck(
            "limit_torque",
            torque,
            "ranges cannot be read from these motors, and limit_torque is all that tells the model: put the motor's model "
            "into the wiring; or, if the limit was changed on purpose, back with the maker's tool",
        ),
        RegisterCheck(
            "zero_sta",
            np.ones(n),
            "a joint below its zero would wake up a turn away: set zero_sta to 1 with the maker's tool and save it",
        ),
        RegisterCheck("run_mode", np.zeros(n), "the motor does not take operation control (run_mode 0)", write=True),
        RegisterCheck(
            "canTimeout", np.full(n, ticks), "the motor would not stop by itself: update its firmware", write=True
        ),
    ]


def check_ids(spec: BusSpec) -> None:
    """Raises BusError for ids that RobStride motors cannot have, or a feedback_id, of which they have none."""
    for m in spec.motors:
        where = f"bus {spec.name}, motor of {m.joint}"
        if not 0 < m.id <= ID_MAX:
            raise BusError(f"{where}: got id {m.id:#x}, expected 0x1 to {ID_MAX:#x} (CAN_ID)")
        if m.feedback_id not in (0, HOST_ID):
            raise BusError(
                f"{where} (id {m.id:#x}): got feedback_id {m.feedback_id:#x}, expected none: it answers the host, {HOST_ID:#x}"
            )


class RobstrideMotors:
    """The motors' side: what emulated motors do with the frames of a host, and the frames that they answer with."""

    def __init__(self, spec: BusSpec) -> None:
        self.scales = Scales(spec.motors)
        self.ids = np.array([m.id for m in spec.motors], np.uint32)
        self._row_of = np.full(0x100, -1, np.intp)
        self._row_of[self.ids] = np.arange(len(self.ids))

    def classify(self, frames: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Whom each of ``frames`` (FRAME, (m,)) is for, -1 for none of them, and its Type: (m,) int64 each."""
        ids = frames["id"].astype(np.int64)
        rows = self._row_of[ids & 0xFF].copy()
        rows[(ids >> 29 != EXTENDED >> 29) | (frames["length"] != 8)] = -1
        return rows, ids >> 24 & 0x1F

    def unpack_command(self, frames: np.ndarray, rows: np.ndarray) -> MotorCommand:
        """What OPERATION frames (m,) to motors ``rows`` (m,) ask for, in SI units."""
        torque = frames["id"].astype(np.int64)[None] >> 8 & CODE_MAX
        codes = np.vstack([_from_big_endian(frames["data"]), torque])
        return MotorCommand(*self.scales.values(codes, [0, 1, 2, 3, 4], rows))

    def pack_feedback(
        self,
        position: np.ndarray,
        velocity: np.ndarray,
        torque: np.ndarray,
        temperature: np.ndarray,
        faults: np.ndarray,
        mode: np.ndarray,
        kind: Type = Type.FEEDBACK,
    ) -> np.ndarray:
        """Feedback (FRAME, (n,)) of every motor: rad (comes back in from the other end beyond 4 pi), rad/s, N m, deg C,
        six fault bits, a Mode."""
        turned = np.mod(np.asarray(position, float) + FULL_TURNS, 2 * FULL_TURNS) - FULL_TURNS
        zero = np.zeros(len(self.ids))
        codes = self.scales.codes(np.array([turned, velocity, zero, zero, torque], float))
        tenths = np.round(np.asarray(temperature) / TEMPERATURE_UNIT).astype(np.int64) & CODE_MAX
        data = _big_endian(np.array([codes[0], codes[1], codes[4], np.broadcast_to(tenths, len(self.ids))]))
        state = (np.asarray(mode) << 22 | np.asarray(faults) << 16).astype(np.uint32)
        return make_frames(identifier(kind, 0, HOST_ID) | state | self.ids << np.uint32(8), data)

    def pack_parameter(self, row: int, data: np.ndarray, failed: bool = False) -> np.ndarray:
        """One motor's answer to READ (FRAME, (1,)): ``data`` (8,) as from ``pack_parameter``."""
        id = identifier(Type.READ, int(failed) << 8 | int(self.ids[row]), HOST_ID)
        return make_frames(np.array([id]), data[None])

    def pack_uid(self, row: int, uid: int) -> np.ndarray:
        """One motor's answer to GET_ID (FRAME, (1,)): the 64-bit serial of its chip."""
        id = identifier(Type.GET_ID, int(self.ids[row]), BROADCAST_ID)
        return make_frames(np.array([id]), np.array([uid], "<u8").view(np.uint8)[None])

    def pack_fault(self, row: int, faults: int, warnings: int = 0) -> np.ndarray:
        """One motor's fault frame (FRAME, (1,))."""
        data = np.array([faults, warnings], "<u4").view(np.uint8)
        return make_frames(np.array([identifier(Type.FAULT, int(self.ids[row]), HOST_ID)]), data[None])
