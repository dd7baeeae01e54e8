"""Damiao DM-J and DM-H motors in MIT mode on classic CAN: bytes to SI and back, host side and motor side.

A motor listens on its ESC_ID (``MotorSpec.id``) and on 0x7FF, and answers every frame on its MST_ID (``feedback_id``):

    to ESC_ID       an MIT command, or FF x 7 and FC enable, FD disable, FE set zero, FB clear error
    to 0x7FF        [id low, id high, operation, register, value (4 bytes, little-endian)]
    from MST_ID     [error << 4 | id & 15, position 16, velocity 12, torque 12, T_MOS, T_ROTOR], or
                    [id low, id high, operation, register, value] with the operation 33 or 55

Both answers share one identifier, and the first only four bits of the motor's: an MST_ID of its own for every motor is
what tells motors apart, and the payload what tells the answers apart.

Sources: the maker's "DM-J4310-2EC V1.1 motor driver user manual" (CAN protocol and register list), as implemented alike
by four independent libraries (cmjang/DM_Control_Python, enactic/openarm_can, jia-xie/python-damiao-driver, lerobot).
"""

from __future__ import annotations

import difflib
from collections.abc import Sequence
from enum import IntEnum
from typing import NamedTuple

import numpy as np

from drivers.bus import BusError, BusSpec, MotorCommand, MotorSpec, MotorState
from drivers.can_bus import RegisterAnswer, RegisterCheck
from drivers.codecs.mit import MitCodec, Ranges, words_of
from drivers.wire import make_frames

KP_MAX, KD_MAX = 500.0, 5.0  # N m/rad, N m s/rad: fixed in the firmware
TIMEOUT_TICK = 50e-6  # s, unit of the TIMEOUT register
BROADCAST_ID = 0x7FF  # register requests
MODE_STRIDE = 0x100  # a command for CTRL_MODE m goes to ESC_ID + (m - 1) * 0x100
MIT_MODE = 1


class Model(NamedTuple):
    """Factory PMAX, VMAX and TMAX: full scale of position (rad), velocity (rad/s) and torque (N m) on the wire."""

    position: float
    velocity: float
    torque: float


# Registers 21 to 23 can be rewritten, and published tables disagree (DM4340: VMAX 8 or 10; DM3507: three versions), so
# that connecting compares them with what the motor says.
MODELS: dict[str, Model] = {
    "DM3507": Model(12.566, 50, 5),
    "DM4310": Model(12.5, 30, 10),
    "DM4310-48V": Model(12.5, 50, 10),
    "DM4340": Model(12.5, 8, 28),
    "DM4340-48V": Model(12.5, 10, 28),
    "DM6006": Model(12.5, 45, 20),
    "DM8006": Model(12.5, 45, 40),
    "DM8009": Model(12.5, 45, 54),
    "DM10010": Model(12.5, 20, 200),
    "DM10010L": Model(12.5, 25, 200),
    "DMH3510": Model(12.5, 280, 1),
}

# Register name: (number, numpy type of its value, writable)
REGISTERS: dict[str, tuple[int, str, bool]] = {
    "UV_VALUE": (0, "<f4", True),  # under-voltage, V
    "KT_VALUE": (1, "<f4", True),  # torque constant, N m/A
    "OT_VALUE": (2, "<f4", True),  # over-temperature, deg C
    "OC_VALUE": (3, "<f4", True),  # over-current, share of full scale
    "ACC": (4, "<f4", True),
    "DEC": (5, "<f4", True),
    "MAX_SPD": (6, "<f4", True),
    "MST_ID": (7, "<u4", True),
    "ESC_ID": (8, "<u4", True),
    "TIMEOUT": (9, "<u4", True),  # 50 us ticks without a command, then disabled with error D
    "CTRL_MODE": (10, "<u4", True),  # 1 MIT, 2 position-velocity, 3 velocity, 4 position-force
    "HW_VER": (13, "<u4", False),
    "SW_VER": (14, "<u4", False),
    "SN": (15, "<u4", False),
    "NPP": (16, "<u4", False),
    "GR": (20, "<f4", False),  # gear ratio
    "PMAX": (21, "<f4", True),
    "VMAX": (22, "<f4", True),
    "TMAX": (23, "<f4", True),
    "I_BW": (24, "<f4", True),
    "KP_ASR": (25, "<f4", True),
    "KI_ASR": (26, "<f4", True),
    "KP_APR": (27, "<f4", True),
    "KI_APR": (28, "<f4", True),
    "OV_VALUE": (29, "<f4", True),  # over-voltage, V
    "CAN_BR": (35, "<u4", True),  # 4: 1 Mbit/s
    "U_OFF": (50, "<f4", False),
    "V_OFF": (51, "<f4", False),
    "M_OFF": (54, "<f4", False),
    "DIR": (55, "<f4", False),
    "P_M": (80, "<f4", False),
    "XOUT": (81, "<f4", False),
}
BIT_RATES = {0: 125_000, 1: 200_000, 2: 250_000, 3: 500_000, 4: 1_000_000, 5: 2_000_000, 6: 2_500_000, 7: 3_200_000,
             8: 4_000_000, 9: 5_000_000}  # of CAN_BR; from 5 on CAN FD  # fmt: skip
REGISTER_NAMES = {number: name for name, (number, _, _) in REGISTERS.items()}


class Operation(IntEnum):
    """Third byte on the register channel."""

    READ = 0x33
    WRITE = 0x55  # until power-off
    STORE = 0xAA  # all registers to flash; the motor must be disabled
    REFRESH = 0xCC  # answered with feedback


# By the third and fourth byte: may this be an answer on the register channel?
IS_ANSWER, IS_REGISTER = np.zeros((2, 256), bool)
IS_ANSWER[[Operation.READ, Operation.WRITE]] = True
IS_REGISTER[list(REGISTER_NAMES)] = True


class Kind(IntEnum):
    """What a frame from the host is, for a motor."""

    COMMAND = 0
    CLEAR_ERROR = 0xFB
    ENABLE = 0xFC
    DISABLE = 0xFD
    SET_ZERO = 0xFE
    REGISTER = 0x100  # see unpack_register
    OTHER_MODE = 0x101  # a command for another CTRL_MODE: a motor in MIT mode ignores it without a word


ERRORS: dict[int, str] = {
    0x0: "disabled",
    0x1: "enabled",
    0x8: "over-voltage",
    0x9: "under-voltage",
    0xA: "over-current",
    0xB: "driver over-temperature",
    0xC: "rotor over-temperature",
    0xD: "lost communication",
    0xE: "overload",
}
LOST_COMMUNICATION = 0xD


class RegisterFrame(NamedTuple):
    """A frame of the register channel, either way."""

    id: int  # ESC_ID of the motor
    operation: int  # an Operation, or what was sent instead
    register: str  # a name of REGISTERS, or "" (STORE, REFRESH, unknown number)
    value: float | int


def special_payload(kind: Kind) -> np.ndarray:
    """The payload (8,) uint8 of FF x 7 and the kind."""
    return np.array([0xFF] * 7 + [kind], np.uint8)


def pack_register(id: int, operation: int, register: str = "", value: float | int = 0) -> np.ndarray:
    """Payload (8,) uint8 of a request or, with the motor's own id, of its answer. Raises KeyError, ValueError."""
    number, kind, _ = REGISTERS[register] if register else (0, "<u4", False)
    if kind == "<f4" and not np.isfinite(value):
        raise ValueError(f"register {register} of motor {id}: got {value}, expected a finite value")
    head = np.array([id & 0xFF, id >> 8, operation, number], np.uint8)
    return np.concatenate([head, np.array([value], kind).view(np.uint8)])


def unpack_register(data: np.ndarray) -> RegisterFrame:
    """A payload (8,) uint8 of the register channel."""
    data = np.ascontiguousarray(data)
    register = REGISTER_NAMES.get(int(data[3]), "") if data[2] in (Operation.READ, Operation.WRITE) else ""
    kind = REGISTERS[register][1] if register else "<u4"
    return RegisterFrame(int(data[0]) | int(data[1]) << 8, int(data[2]), register, data[4:].view(kind)[0].item())


def timeout_ticks(seconds: float) -> int:
    """Value of TIMEOUT for a watchdog of ``seconds``; at least one tick, for 0 would switch it off."""
    return max(1, round(seconds / TIMEOUT_TICK))


def ranges_of(motors: Sequence[MotorSpec]) -> Ranges:
    """Full scales of ``motors`` by their model. Raises BusError for a model that is not in MODELS."""
    for m in motors:
        if m.model not in MODELS:
            close = difflib.get_close_matches(m.model, MODELS, n=1)
            hint = f" (did you mean '{close[0]}'?)" if close else ""
            raise BusError(
                f"motor of {m.joint} (id {m.id}): no Damiao model '{m.model}'{hint}; known: {', '.join(MODELS)}.\n"
                "  Add its PMAX, VMAX and TMAX to MODELS in drivers/codecs/damiao.py"
            )
    position, velocity, torque = np.array([MODELS[m.model] for m in motors], float).T
    return Ranges(position, velocity, torque, np.full(len(motors), KP_MAX), np.full(len(motors), KD_MAX))


def _row_of(ids: np.ndarray) -> np.ndarray:
    """A table (0x801,) from 11-bit identifier to row of ``ids``; -1 for the others, and its last entry."""
    table = np.full(0x801, -1, np.intp)
    table[ids] = np.arange(len(ids))
    return table


class DamiaoTick:
    """The host's side of a tick, for motors on one or more buses (a ``can_bus.TickCodec``)."""

    def __init__(self, motors: Sequence[MotorSpec]) -> None:
        """Raises BusError for an unknown model."""
        self.mit = MitCodec(ranges_of(motors))
        self._ids = np.array([m.id for m in motors], np.uint32)
        self._commands = make_frames(self._ids, np.zeros((len(motors), 8), np.uint8))
        self._nibbles = (self._ids & 0xF).astype(np.uint8)
        self._feedback_ids = np.array([m.feedback_id for m in motors], np.uint32)

    def pack_command(self, command: MotorCommand) -> np.ndarray:
        """One MIT command for each motor (FRAME, (n,)). Saturates; raises ValueError for a value not finite."""
        c, frames = command, self._commands.copy()
        frames["data"] = self.mit.pack_command(c.position, c.velocity, c.kp, c.kd, c.torque)
        return frames

    def unpack_whole(self, frames: np.ndarray, state: MotorState, now: float) -> bool:
        """Put ``frames`` into ``state`` if they are feedback of every motor in turn, as in nearly every tick."""
        if len(frames) != len(self._ids):
            return False
        data = frames["data"]
        fits = (frames["id"] == self._feedback_ids) & (frames["length"] == 8) & (data[:, 0] & 0xF == self._nibbles)
        fits &= data[:, 1] != 0  # else it may be an answer on the register channel: ids are below 0x100
        if np.count_nonzero(fits) < len(frames):
            return False
        self._take(data, slice(None), None, state, now)
        return True

    def _take(
        self, data: np.ndarray, rows: np.ndarray | slice, index: np.ndarray | None, state: MotorState, now: float
    ) -> None:
        """Put feedback (m, 8) of motors ``rows`` into ``state``; ``index``: as of MitCodec."""
        f = self.mit.unpack_feedback(data, index)
        status = data[:, 0] >> 4
        state.position[rows] = f.position
        state.velocity[rows] = f.velocity
        state.torque[rows] = f.torque
        state.temperature[rows] = np.maximum(f.byte6, f.byte7)
        state.enabled[rows] = status == 1
        state.error[rows] = status * (status > 1)
        state.time[rows] = now


class DamiaoCodec(DamiaoTick):
    """The host's side of one bus: frames for its motors, and what their answers say (a ``can_bus.CanCodec``)."""

    TICK = DamiaoTick
    # Bits of one command and its answer on the wire, inter-frame space included: the mean of MIT traffic, and the most
    # that bit stuffing makes of twice 8 bytes with an 11-bit identifier.
    TICK_BITS = (117.6 + 115.0, 135.0 + 135.0)
    IDENTITY = ("SN",)
    TURN = 2 * np.pi  # single-turn absolute encoder at the output

    def __init__(self, spec: BusSpec) -> None:
        """Raises BusError for an unknown model, or identifiers by which the motors could not be told apart."""
        _check_ids(spec)
        super().__init__(spec.motors)
        n = len(spec.motors)
        self.checks = _checks(spec, ranges_of(spec.motors))
        self._spec = spec
        self._row_of = _row_of(self._feedback_ids)
        refresh = np.array([pack_register(m.id, Operation.REFRESH) for m in spec.motors])
        self._refresh = make_frames(np.full(n, BROADCAST_ID), refresh)
        self._special = {
            kind: make_frames(self._ids, np.tile(special_payload(kind), (n, 1)))
            for kind in (Kind.CLEAR_ERROR, Kind.ENABLE, Kind.DISABLE)
        }

    def pack_enable(self, state: MotorState) -> np.ndarray:
        """Enable frames, each behind a "clear error" where ``state`` shows one: a motor with an error stays off."""
        return np.concatenate([self._special[Kind.CLEAR_ERROR][state.error != 0], self._special[Kind.ENABLE]])

    def pack_disable(self) -> np.ndarray:
        return self._special[Kind.DISABLE]

    def pack_poll(self, state: MotorState) -> np.ndarray:
        """A request for feedback to each motor; to one that reports lost communication "clear error" instead, which it
        answers alike: what it complains of is over once it is polled, and no other error is cleared without enabling.
        """
        lost = (state.error == LOST_COMMUNICATION)[:, None]
        if not lost.any():
            return self._refresh
        return np.where(lost[:, 0], self._special[Kind.CLEAR_ERROR], self._refresh)

    def pack_register(self, row: int, register: str, value: float | int | None = None) -> np.ndarray:
        """One request (FRAME, (1,)) to read a register of motor ``row``, or to write ``value`` to it."""
        operation, value = (Operation.READ, 0) if value is None else (Operation.WRITE, value)
        data = pack_register(self._spec.motors[row].id, operation, register, value)
        return make_frames(np.array([BROADCAST_ID]), data[None])

    def unpack_registers(self, frames: np.ndarray) -> list[RegisterAnswer]:
        """Every answer on the register channel among ``frames``."""
        rows, answers, _ = self._sort(frames)
        found = zip(rows[answers].tolist(), map(unpack_register, frames["data"][answers]), strict=True)
        return [RegisterAnswer(row, r.register, r.value, r.operation == Operation.WRITE) for row, r in found]

    def unpack(self, frames: np.ndarray, state: MotorState, now: float) -> int:
        """Put the feedback among ``frames`` into ``state``, the latest of each motor last. Returns how many frames came
        from nobody on this bus or were malformed; answers on the register channel are neither."""
        if self.unpack_whole(frames, state, now):
            return 0
        owners, answers, strangers = self._sort(frames)
        feedback = ~(answers | strangers)
        rows = owners[feedback]
        self._take(frames["data"][feedback], rows, rows, state, now)
        return int(np.count_nonzero(strangers))

    def owners(self, frames: np.ndarray) -> np.ndarray:
        """Whose each of ``frames`` is, by its identifier: (m,) rows of the motors, -1 for nobody on this bus."""
        return self._row_of[np.minimum(frames["id"], 0x800)]

    def _sort(self, frames: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Whose each frame is (m,), which are answers on the register channel (m,), and which nobody's (m,).

        The identifier says whose; then the payload which kind. [id low, id high, 33 or 55, register] read as feedback
        is a position within a thousandth of the negative end and a velocity below -36 % of full scale.
        """
        data = frames["data"]
        rows = self.owners(frames)
        ids = self._ids[rows]
        answers = (
            (data[:, 1] == ids >> 8) & (data[:, 0] == ids & 0xFF) & IS_ANSWER[data[:, 2]] & IS_REGISTER[data[:, 3]]
        )
        strangers = (rows < 0) | (data[:, 0] & 0xF != ids & 0xF) | (frames["length"] != 8)
        return rows, answers & ~strangers, strangers

    def error_name(self, code: int) -> str:
        return ERRORS.get(code, f"unknown status {code:#x}") if code else "none"


def _checks(spec: BusSpec, ranges: Ranges) -> list[RegisterCheck]:
    """What connecting reads, writes and compares, in this order."""
    fix = "put the motor's model into the wiring, or write the register back with the maker's tool"
    ticks = np.full(len(spec.motors), timeout_ticks(spec.watchdog))
    return [
        RegisterCheck("PMAX", ranges.position, f"positions would be scaled wrongly: {fix}"),
        RegisterCheck("VMAX", ranges.velocity, f"velocities would be scaled wrongly: {fix}"),
        RegisterCheck("TMAX", ranges.torque, f"torques would be scaled wrongly: {fix}"),
        RegisterCheck(
            "CTRL_MODE", np.full(len(ticks), MIT_MODE), "set it to 1 (MIT) with the maker's tool and store it"
        ),
        RegisterCheck("TIMEOUT", ticks, "the motor would not stop by itself: update its firmware", write=True),
    ]


def _check_ids(spec: BusSpec) -> None:
    taken: dict[int, str] = {}  # identifiers on which a motor listens, in any CTRL_MODE
    for m in spec.motors:
        if not 0 < m.id < MODE_STRIDE:
            raise BusError(f"bus {spec.name}, motor of {m.joint}: got id {m.id:#x}, expected 0x1 to 0xff (ESC_ID)")
        taken |= {m.id + mode * MODE_STRIDE: m.joint for mode in range(4)}
    answered: dict[int, str] = {}
    for m in spec.motors:
        where = f"bus {spec.name}, motor of {m.joint} (id {m.id:#x}): got feedback_id {m.feedback_id:#x}"
        fix = f"write its MST_ID, by convention id + 0x10 = {m.id + 0x10:#x}, and put it into the wiring"
        if not 0 < m.feedback_id < BROADCAST_ID:
            raise BusError(f"{where}, expected 0x1 to 0x7fe: {fix}")
        if m.feedback_id in answered:
            other = answered[m.feedback_id]
            raise BusError(f"{where}, which the motor of {other} has too; feedback holds 4 bits of the id: {fix}")
        if m.feedback_id in taken:
            listener = taken[m.feedback_id]
            raise BusError(f"{where}, on which the motor of {listener} listens for commands: {fix}")
        answered[m.feedback_id] = m.joint


class DamiaoMotors:
    """The motors' side: what emulated motors do with the frames of a host, and the frames that they answer with."""

    def __init__(self, spec: BusSpec, ranges: Ranges | None = None, hears: Sequence[bool] | None = None) -> None:
        """``ranges``: what registers 21 to 23 hold, where they are not the models' own. ``hears``: which motors do."""
        self.mit = MitCodec(ranges or ranges_of(spec.motors))
        self.ids = np.array([m.id for m in spec.motors], np.uint32)
        self.feedback_ids = np.array([m.feedback_id for m in spec.motors], np.uint32)
        self._feedback = make_frames(self.feedback_ids, np.zeros((len(self.ids), 8), np.uint8))
        self._nibbles = self.ids.astype(np.int64) & 0xF
        self._row_of = _row_of(self.ids)
        if hears is not None:
            self._row_of[self.ids] = -1
            listening = np.flatnonzero(hears)
            self._row_of[self.ids[listening]] = listening

    def classify(self, frames: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Whom each of ``frames`` (FRAME, (m,)) is for, and its Kind: (m,) int64 rows of the motors, -1 for none of
        them, and (m,) int64."""
        ids = np.minimum(frames["id"], 0x800)
        words = words_of(frames["data"])
        kind = np.where(words >> np.uint64(8) == (1 << 56) - 1, words & np.uint64(0xFF), 0).astype(np.int64)
        kind[(kind < Kind.CLEAR_ERROR) | (kind > Kind.SET_ZERO)] = Kind.COMMAND
        row = self._row_of[ids]

        other = (row < 0) & (ids < BROADCAST_ID)
        kind[other] = Kind.OTHER_MODE
        row[other] = self._row_of[ids[other] % MODE_STRIDE]

        register = ids == BROADCAST_ID
        kind[register] = Kind.REGISTER
        addressed = frames["data"][register, :2].astype(np.intp)
        row[register] = self._row_of[np.minimum(addressed[:, 0] | addressed[:, 1] << 8, 0x800)]
        row[frames["length"] != 8] = -1
        return row, kind

    def unpack_command(self, data: np.ndarray, row: np.ndarray | None = None) -> MotorCommand:
        """Commands of payloads (m, 8) uint8 in SI units; ``row`` (m,): whose each one is."""
        return self.mit.unpack_command(data, row)

    def pack_feedback(
        self,
        position: np.ndarray,
        velocity: np.ndarray,
        torque: np.ndarray,
        error: np.ndarray,
        driver_temperature: np.ndarray,
        rotor_temperature: np.ndarray,
        wrap: bool = False,
    ) -> np.ndarray:
        """Feedback frames (FRAME, (n,)) of every motor: rad, rad/s, N m, a key of ERRORS, deg C. ``wrap``: what a
        position out of range does (MitCodec.pack_feedback; which of the two a Damiao does is not verified)."""
        byte0, frames = np.asarray(error) << 4 | self._nibbles, self._feedback.copy()
        frames["data"] = self.mit.pack_feedback(
            position, velocity, torque, byte0, driver_temperature, rotor_temperature, wrap
        )
        return frames

    def pack_register(self, row: int, operation: int, register: str, value: float | int) -> np.ndarray:
        """One motor's answer on the register channel: one FRAME, shape (1,)."""
        data = pack_register(int(self.ids[row]), operation, register, value)
        return make_frames(self.feedback_ids[row : row + 1], data[None])
