"""Feetech STS and SMS servos: bytes to SI and back, on the host's side.

    FF FF | id | length | instruction or error | parameters ... | checksum      checksum: ~sum of all behind FF FF

Little-endian; signed values are sign and magnitude (bit 15, for the load bit 10). 4096 counts a turn, 2048 is 0 rad. The
present position is the shaft's less the homing offset (register 31), which is the servo's own and left alone.
Source: Feetech, "STS series memory table", as implemented by lerobot (feetech tables) and the maker's SCServo library.

**What a PD target becomes.** Gains are EEPROM bytes without published units and are left alone: a command is the goal
position, with the torque limit (48) at 100 % where kp > 0 and at 0 where it is 0, which is the nearest to damping that
there is (the geared motor resists by itself). Velocity, kd and feed-forward torque have no counterpart and are ignored.

**There is no watchdog** in these servos: whatever stops the host leaves them holding their last goal. That breaks the
promise that every motor stops by itself, so that the wiring has to say so: a bus of this protocol is refused unless its
``watchdog`` is NO_WATCHDOG (a day), which nobody writes by accident.
"""

from __future__ import annotations

import difflib
from collections.abc import Sequence
from enum import IntEnum
from typing import NamedTuple

import numpy as np

from drivers.bus import BusError, BusSpec, MotorCommand, MotorState
from drivers.serial_bus import RegisterCheck

HEADER = b"\xff\xff"
BROADCAST = 0xFE
ID_MAX = 253
LENGTH_MAX = 250
NO_WATCHDOG = 86_400.0  # s

TICKS = 4096
TICK = 2 * np.pi / TICKS  # rad; also rad/s of velocity
ZERO = 2048
LOAD_UNIT = 0.001  # of the stall torque
TORQUE_FULL = 1000  # TORQUE_LIMIT of 100 %


class Instruction(IntEnum):
    """Fifth byte of a packet from the host."""

    PING = 0x01
    READ = 0x02
    WRITE = 0x03
    REG_WRITE = 0x04
    ACTION = 0x05
    RESET = 0x06
    SYNC_READ = 0x82
    SYNC_WRITE = 0x83


class Model(NamedTuple):
    """Model number, and stall torque (N m) at the nominal voltage."""

    number: int
    stall_torque: float


MODELS = {"STS3215-7V4": Model(777, 1.91), "STS3215-12V": Model(777, 2.94)}  # 19.5 and 30 kg cm, maker's data sheets

REGISTERS: dict[str, tuple[int, int]] = {  # address, size
    "FIRMWARE": (0, 2),  # major, minor
    "MODEL": (3, 2),
    "ID": (5, 1),
    "BAUD": (6, 1),
    "RETURN_DELAY": (7, 1),
    "RESPONSE_LEVEL": (8, 1),
    "POSITION_MIN": (9, 2),
    "POSITION_MAX": (11, 2),
    "TEMPERATURE_LIMIT": (13, 1),
    "TORQUE_MAX": (16, 2),
    "PHASE": (18, 1),
    "UNLOADING": (19, 1),
    "P_GAIN": (21, 1),
    "D_GAIN": (22, 1),
    "HOMING_OFFSET": (31, 2),
    "MODE": (33, 1),
    "PROTECTIVE_TORQUE": (34, 1),  # %
    "PROTECTION_TIME": (35, 1),  # 10 ms
    "OVERLOAD_TORQUE": (36, 1),  # %
    "TORQUE_ENABLE": (40, 1),
    "ACCELERATION": (41, 1),
    "GOAL_POSITION": (42, 2),
    "GOAL_TIME": (44, 2),
    "GOAL_VELOCITY": (46, 2),
    "TORQUE_LIMIT": (48, 2),
    "LOCK": (55, 1),
    "PRESENT_POSITION": (56, 2),
    "PRESENT_VELOCITY": (58, 2),
    "PRESENT_LOAD": (60, 2),
    "PRESENT_VOLTAGE": (62, 1),
    "PRESENT_TEMPERATURE": (63, 1),
    "STATUS": (65, 1),
    "MOVING": (66, 1),
}
GOAL_AT, GOAL = (
    42,
    np.dtype([("id", "u1"), ("position", "<u2"), ("time", "<u2"), ("velocity", "<u2"), ("limit", "<u2")]),
)
# One read from TORQUE_ENABLE on: whether the servo obeys, what it was told, and what it measures.
STATE_AT = 40
STATE = np.dtype(
    {
        "names": ["torque_enable", "position", "velocity", "load", "voltage", "temperature", "status"],
        "formats": ["u1", "<u2", "<u2", "<u2", "u1", "u1", "u1"],
        "offsets": [0, 16, 18, 20, 22, 23, 25],
        "itemsize": 26,
    }
)
BAUD_RATES = {0: 1_000_000, 1: 500_000, 2: 250_000, 3: 128_000, 4: 115_200, 5: 76_800, 6: 57_600, 7: 38_400}
ERRORS = {0x01: "voltage", 0x02: "encoder", 0x04: "overheating", 0x08: "current", 0x20: "overload"}


def checksum(body: bytes) -> int:
    """Of everything between header and checksum."""
    return ~sum(body) & 0xFF


def pack(id: int, instruction: int, parameters: bytes = b"") -> bytes:
    """One packet; of a servo with its error byte for the instruction. Raises ValueError if it is too long."""
    if len(parameters) + 2 > LENGTH_MAX:
        raise ValueError(f"packet to {id}: got {len(parameters)} parameters, expected at most {LENGTH_MAX - 2}")
    body = bytes([id, len(parameters) + 2, instruction]) + parameters
    return HEADER + body + bytes([checksum(body)])


def to_sign_magnitude(value: np.ndarray, bit: int = 15) -> np.ndarray:
    """Integers as the servo writes them; saturates."""
    most = (1 << bit) - 1
    return np.minimum(np.abs(value), most) | (np.asarray(value) < 0).astype(np.int64) << bit


def from_sign_magnitude(raw: np.ndarray, bit: int = 15) -> np.ndarray:
    """The inverse."""
    raw = np.asarray(raw, np.int64)
    magnitude = raw & (1 << bit) - 1
    return np.where(raw >> bit & 1, -magnitude, magnitude)


class Packet(NamedTuple):
    """A packet whose checksum is right. ``instruction``: of a servo its error byte. ``end``: how many bytes of the last
    ``feed`` it took."""

    id: int
    instruction: int
    parameters: bytes
    end: int = 0


class Parser:
    """Finds packets in a byte stream: split, joined, damaged or between other bytes. Keeps at most one packet back.

    One byte of checksum lets one damaged packet in 256 pass: sizes and ids are checked by who asked.
    """

    def __init__(self) -> None:
        self._bytes = bytearray()
        self.rejected = 0

    def feed(self, data: bytes) -> list[Packet]:
        """Every packet completed by ``data``, oldest first."""
        buffer = self._bytes
        old = len(buffer)
        buffer += data
        packets, at = [], 0
        while (start := buffer.find(HEADER, at)) >= 0:
            at = start
            if len(buffer) < at + 4:
                break
            id, length = buffer[at + 2], buffer[at + 3]
            if id == 0xFF:  # the header begins later
                at += 1
                continue
            end = at + 4 + length
            if 2 <= length <= LENGTH_MAX:
                if len(buffer) < end:
                    break
                body = bytes(buffer[at + 2 : end])
                if checksum(body[:-1]) == body[-1]:
                    packets.append(Packet(id, body[2], body[3:-1], end - old))
                    at = end
                    continue
            self.rejected += 1
            at += len(HEADER)
        else:
            at = len(buffer) - buffer.endswith(HEADER[:1])
        del buffer[:at]
        return packets

    def clear(self) -> None:
        """Forget what is not complete yet."""
        self._bytes.clear()


def models_of(spec: BusSpec) -> list[Model]:
    """The rows of MODELS of the motors of ``spec``. Raises BusError listing those that there are."""
    for m in spec.motors:
        if m.model not in MODELS:
            close = difflib.get_close_matches(m.model, MODELS, n=1)
            hint = f" (did you mean '{close[0]}'?)" if close else ""
            raise BusError(
                f"bus {spec.name}, motor of {m.joint} (id {m.id}): no Feetech model '{m.model}'{hint}; known: "
                f"{', '.join(MODELS)}.\n  Add its row to MODELS in drivers/codecs/feetech.py"
            )
    return [MODELS[m.model] for m in spec.motors]


class FeetechCodec:
    """Packets for the servos of one bus, and what their answers say (a ``serial_bus.SerialCodec``)."""

    _ANSWER = 6 + STATE.itemsize  # bytes
    TICK_BITS = (10.0 * (GOAL.itemsize + 1 + _ANSWER),) * 2
    TICK_OVERHEAD_BITS = 10.0 * 2 * 8
    IDENTITY = ("MODEL",)  # there is no serial number
    TURN = 2 * np.pi
    ERROR_REGISTER = ""  # errors last as long as their cause
    HAS_FAST_READ = False

    def __init__(self, spec: BusSpec) -> None:
        """Raises BusError for an unknown model, an id that cannot be, or a watchdog that the wiring counts on."""
        self._spec = spec
        models = models_of(spec)
        for m in spec.motors:
            if not 0 <= m.id <= ID_MAX:
                raise BusError(f"bus {spec.name}, motor of {m.joint}: got id {m.id}, expected 0 to {ID_MAX}")
        if len({m.id for m in spec.motors}) < len(spec.motors):
            raise BusError(f"bus {spec.name}: two motors share an id, expected one for each")
        if spec.watchdog != NO_WATCHDOG:
            raise BusError(
                f"bus {spec.name}: got a watchdog of {spec.watchdog:g} s, expected {NO_WATCHDOG:g}: Feetech servos have "
                "none.\n  They hold their last goal for ever when the host stops. Say that you know with "
                f"'watchdog: {NO_WATCHDOG:g}'"
            )
        n = len(spec.motors)
        self.rejected = 0
        self.ids = np.array([m.id for m in spec.motors], np.uint8)
        self._row_of = np.full(256, -1, np.intp)
        self._row_of[self.ids] = np.arange(n)
        self._torque = np.array([m.stall_torque * LOAD_UNIT for m in models])
        self._low, self._high = np.zeros(n), np.full(n, TICKS - 1.0)
        self._parser = Parser()
        numbers, tool = [m.number for m in models], "set it with the maker's tool while torque is off"
        self.checks = [
            RegisterCheck("TORQUE_ENABLE", 0, 0, "does another program command it? Stop that, and connect again", True),
            RegisterCheck("MODEL", numbers, numbers, "put the servo's model into the wiring"),
            RegisterCheck("RETURN_DELAY", 0, 0, f"each answer would come units of 2 us late: {tool}"),
            RegisterCheck("MODE", 0, 0, f"position mode: {tool}"),
            RegisterCheck("POSITION_MIN", 0, TICKS - 1, "outside a turn"),
            RegisterCheck("POSITION_MAX", 1, TICKS - 1, "outside a turn"),
            RegisterCheck("LOCK", 1, 1, "the EEPROM would wear out", True),
            RegisterCheck("ACCELERATION", 0, 0, "targets would be smoothed", True),
        ]

    def pack_wake(self) -> bytes:
        return self.pack_disable()

    def pack_command(self, command: MotorCommand) -> bytes:
        """Goal positions and torque limits in one sync write. Saturates; raises ValueError for a value not finite."""
        c = command
        if not np.isfinite([c.position, c.velocity, c.kp, c.kd, c.torque]).all():
            raise ValueError(
                f"bus {self._spec.name}: got a command that is not finite, expected numbers; nothing was sent"
            )
        goals = np.zeros(len(self.ids), GOAL)
        goals["id"] = self.ids
        goals["position"] = np.clip(np.rint(c.position / TICK + ZERO), self._low, self._high)
        goals["limit"] = np.where(c.kp > 0, TORQUE_FULL, 0)
        return pack(BROADCAST, Instruction.SYNC_WRITE, bytes([GOAL_AT, GOAL.itemsize - 1]) + goals.tobytes())

    def pack_request(self, rows: np.ndarray, fast: bool = False) -> bytes:
        return self._sync_read(STATE_AT, STATE.itemsize, rows)

    def reply_size(self, n: int, fast: bool = False) -> int:
        return n * self._ANSWER

    def pack_enable(self, state: MotorState) -> bytes:
        """Goals where the servos stand, then torque on."""
        zero = np.zeros(len(self.ids))
        hold = self.pack_command(MotorCommand(np.nan_to_num(state.position), zero, zero, zero, zero))
        return hold + self.pack_write("TORQUE_ENABLE", [1] * len(self.ids))

    def pack_disable(self) -> bytes:
        return self.pack_write("TORQUE_ENABLE", [0] * len(self.ids))

    def pack_recover(self, state: MotorState) -> bytes:
        return b""

    def pack_reboot(self, row: int) -> bytes:
        return b""

    def _sync_read(self, address: int, size: int, rows: np.ndarray) -> bytes:
        return pack(BROADCAST, Instruction.SYNC_READ, bytes([address, size]) + self.ids[rows].tobytes())

    def pack_read(self, register: str, rows: np.ndarray) -> bytes:
        """Ask the servos ``rows`` for a register."""
        return self._sync_read(*REGISTERS[register], rows)

    def pack_write(self, register: str, values: Sequence[int], rows: np.ndarray | None = None) -> bytes:
        """Write ``values`` to a register of the servos ``rows`` (None: all). Nobody answers."""
        address, size = REGISTERS[register]
        ids = self.ids if rows is None else self.ids[rows]
        items = [bytes([i]) + v.to_bytes(size, "little") for i, v in zip(ids.tolist(), values, strict=True)]
        return pack(BROADCAST, Instruction.SYNC_WRITE, bytes([address, size]) + b"".join(items))

    def unpack(self, data: bytes, state: MotorState, now: float) -> int:
        """Put the states among ``data`` into ``state``. Returns how many servos answered."""
        bad, heard = self._parser.rejected, 0
        for p in self._parser.feed(data):
            row = int(self._row_of[p.id])
            if p.id == BROADCAST:
                continue  # an adapter's echo of what was sent
            if row < 0 or len(p.parameters) != STATE.itemsize:
                self.rejected += 1
                continue
            s = np.frombuffer(p.parameters, STATE)[0]
            state.position[row] = (float(from_sign_magnitude(s["position"])) - ZERO) * TICK
            state.velocity[row] = float(from_sign_magnitude(s["velocity"])) * TICK
            state.torque[row] = float(from_sign_magnitude(s["load"], 10)) * self._torque[row]
            state.temperature[row] = s["temperature"]
            state.error[row] = int(s["status"]) | p.instruction
            state.enabled[row] = s["torque_enable"] == 1
            state.time[row] = now
            heard += 1
        self.rejected += self._parser.rejected - bad
        return heard

    def pack_looks(self) -> list[bytes]:
        """The question that asks every servo for its state, whether or not it is connected; nothing is written."""
        return [self.pack_request(np.arange(len(self.ids)))]

    def unpack_look(self, data: bytes, state: MotorState, now: float) -> int:
        """``unpack``. Returns how many answers were of nobody here, or damaged."""
        before = self.rejected
        self.unpack(data, state, now)
        return self.rejected - before

    def unpack_register(self, register: str, data: bytes) -> list[tuple[int, int]]:
        """Answers (row, value) to ``pack_read`` of that register among ``data``."""
        size = REGISTERS[register][1]
        answers = [(int(self._row_of[p.id]), p.parameters) for p in self._parser.feed(data)]
        return [(row, int.from_bytes(raw, "little")) for row, raw in answers if row >= 0 and len(raw) == size]

    def finish(self, state: MotorState, now: float) -> int:
        """No more answers will come to the last request: forget what is left of them."""
        self._parser.clear()
        return 0

    def configure(self, values: dict[str, list[int]]) -> None:
        """Take over the servos' position limits: goals saturate there."""
        self._low, self._high = np.array(values["POSITION_MIN"], float), np.array(values["POSITION_MAX"], float)

    def error_name(self, code: int) -> str:
        names = [name for bit, name in ERRORS.items() if code & bit]
        rest = code & ~sum(ERRORS)
        return ", ".join(names + [f"unknown error {rest:#x}"] * bool(rest)) or "none"
