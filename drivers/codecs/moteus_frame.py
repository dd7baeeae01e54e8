"""moteus payloads: subframes that read, write and answer registers, and the diagnostic channel, both sides.

    payload  = subframes, filled up to a length of CAN-FD with 50
    subframe = type | count (0: a varuint count follows), first register (varuint), values ...
    varuint  = seven bits a byte, the lowest first; all but the last have bit 7

A value is one of four resolutions: int8, int16, int32 (each with a scale by the kind of quantity; the lowest stands for "not
a number") or float. The diagnostic channel is a console: text to the controller, and a question for what it has to say.

Source: mjbots/moteus, docs/protocol/can.md and registers.md (mappings, registers); the library moteus 1.1.1 packs the same.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from enum import IntEnum
from typing import NamedTuple

import numpy as np

from drivers.wire import FD_LENGTHS

NOP = 0x50
WRITE, READ, REPLY = 0x00, 0x10, 0x20  # type of a subframe; + 4 * Resolution, + count
WRITE_ERROR, READ_ERROR = 0x30, 0x31  # register, error
CONSOLE_WRITE, CONSOLE_SAYS, CONSOLE_READ = 0x40, 0x41, 0x42  # channel, length, text; CONSOLE_READ: channel, most bytes
CONSOLE = 1  # the channel
CONSOLE_MAX = 61  # bytes of text in a frame
REGISTERS_MAX = 512  # that a question is taken to ask for, whatever it says
UNKNOWN_REGISTER = 1  # error of a READ_ERROR or WRITE_ERROR


class Resolution(IntEnum):
    """How a value is written."""

    INT8 = 0
    INT16 = 1
    INT32 = 2
    FLOAT = 3


VALUES = tuple(np.dtype(kind) for kind in ("i1", "<i2", "<i4", "<f4"))  # by resolution

# What one bit of int8, int16 and int32 is, by kind of quantity.
SCALES: dict[str, tuple[float, float, float]] = {
    "int": (1, 1, 1),
    "rev": (0.01, 1e-4, 1e-5),
    "rev/s": (0.1, 2.5e-4, 1e-5),
    "rev/s^2": (0.05, 1e-3, 1e-5),
    "N m": (0.5, 0.01, 1e-3),
    "A": (1, 0.1, 1e-3),
    "V": (0.5, 0.1, 1e-3),
    "deg C": (1, 0.1, 1e-3),
    "s": (0.01, 1e-3, 1e-6),
    "W": (10, 0.05, 1e-4),
    "scale": (1 / 127, 1 / 32767, 1 / 2147483647),
}


class Register(IntEnum):
    """Registers that either side knows."""

    MODE = 0x000
    POSITION = 0x001
    VELOCITY = 0x002
    TORQUE = 0x003
    Q_CURRENT = 0x004
    D_CURRENT = 0x005
    ABS_POSITION = 0x006
    POWER = 0x007
    MOTOR_TEMPERATURE = 0x00A
    TRAJECTORY_COMPLETE = 0x00B
    HOME_STATE = 0x00C
    VOLTAGE = 0x00D
    TEMPERATURE = 0x00E
    FAULT = 0x00F
    COMMAND_POSITION = 0x020
    COMMAND_VELOCITY = 0x021
    COMMAND_TORQUE = 0x022
    COMMAND_KP_SCALE = 0x023
    COMMAND_KD_SCALE = 0x024
    COMMAND_MAX_TORQUE = 0x025
    COMMAND_STOP_POSITION = 0x026
    COMMAND_TIMEOUT = 0x027
    COMMAND_VELOCITY_LIMIT = 0x028
    COMMAND_ACCELERATION_LIMIT = 0x029
    FIRMWARE = 0x101  # a byte each of major, minor, micro
    SERIAL_NUMBER = 0x120  # 96 bits in three registers, least significant first
    SET_OUTPUT_NEAREST = 0x130  # written: the position is this, up to a whole number of turns of the rotor
    SET_OUTPUT_EXACT = 0x131  # written: the position is this


R = Register
KINDS: dict[int, str] = {
    R.MODE: "int",
    R.POSITION: "rev",
    R.VELOCITY: "rev/s",
    R.TORQUE: "N m",
    R.Q_CURRENT: "A",
    R.D_CURRENT: "A",
    R.ABS_POSITION: "rev",
    R.POWER: "W",
    R.MOTOR_TEMPERATURE: "deg C",
    R.TRAJECTORY_COMPLETE: "int",
    R.HOME_STATE: "int",
    R.VOLTAGE: "V",
    R.TEMPERATURE: "deg C",
    R.FAULT: "int",
    R.COMMAND_POSITION: "rev",
    R.COMMAND_VELOCITY: "rev/s",
    R.COMMAND_TORQUE: "N m",
    R.COMMAND_KP_SCALE: "scale",
    R.COMMAND_KD_SCALE: "scale",
    R.COMMAND_MAX_TORQUE: "N m",
    R.COMMAND_STOP_POSITION: "rev",
    R.COMMAND_TIMEOUT: "s",
    R.COMMAND_VELOCITY_LIMIT: "rev/s",
    R.COMMAND_ACCELERATION_LIMIT: "rev/s^2",
    R.SET_OUTPUT_NEAREST: "rev",
    R.SET_OUTPUT_EXACT: "rev",
}


class Subframe(NamedTuple):
    """``type`` WRITE, READ or REPLY: ``values`` of registers from ``first`` on, as written (READ: none).
    CONSOLE_WRITE, CONSOLE_SAYS: ``text`` on channel ``first``. CONSOLE_READ: at most ``count`` bytes of it.
    WRITE_ERROR, READ_ERROR: error ``count`` of register ``first``."""

    type: int
    first: int
    count: int
    resolution: Resolution = Resolution.INT8
    values: tuple[float | int, ...] = ()
    text: bytes = b""


def pad(payload: bytes) -> bytes:
    """``payload`` filled up to the next length of CAN-FD. Raises ValueError beyond 64 bytes."""
    if len(payload) > FD_LENGTHS[-1]:
        raise ValueError(f"payload: got {len(payload)} bytes, expected at most {FD_LENGTHS[-1]}")
    return payload.ljust(int(FD_LENGTHS[np.searchsorted(FD_LENGTHS, len(payload))]), bytes([NOP]))


def varuint(value: int) -> bytes:
    """``value`` in as many bytes as it needs."""
    out = bytearray()
    while value > 0x7F:
        out.append(value & 0x7F | 0x80)
        value >>= 7
    return bytes([*out, value])


def pack_values(type: int, first: int, resolution: Resolution, values: Sequence[float]) -> bytes:
    """A WRITE or REPLY subframe of SI-like values (in the units of KINDS). What an integer cannot hold saturates, and NaN
    is its lowest."""
    head = type | resolution << 2
    out = bytes([head | len(values)]) if len(values) < 4 else bytes([head]) + varuint(len(values))
    out += varuint(first)
    for i, value in enumerate(values):
        out += VALUES[resolution].type(to_raw(value, KINDS.get(first + i, "int"), resolution)).tobytes()
    return out


def to_raw(value: float, kind: str, resolution: Resolution) -> float | int:
    """A value of SCALES' ``kind`` as it is written."""
    if resolution == Resolution.FLOAT:
        return value
    limits = np.iinfo(VALUES[resolution])
    if math.isnan(value):
        return int(limits.min)
    return int(max(limits.min + 1, min(limits.max, round(value / SCALES[kind][resolution]))))


def from_raw(raw: float | int, kind: str, resolution: Resolution) -> float:
    """The inverse of ``to_raw``."""
    if resolution == Resolution.FLOAT:
        return float(raw)
    return math.nan if raw == np.iinfo(VALUES[resolution]).min else raw * SCALES[kind][resolution]


def subframes(payload: bytes) -> Iterator[Subframe]:
    """What is in ``payload``, in its order. Raises ValueError where it is not whole or of no known type."""
    at = 0

    def take(n: int) -> bytes:
        nonlocal at
        if at + n > len(payload):
            raise ValueError(f"payload {payload.hex()}: ends at byte {len(payload)}, expected {n} more from byte {at}")
        at += n
        return payload[at - n : at]

    def number() -> int:
        value = 0
        for shift in range(0, 35, 7):
            byte = take(1)[0]
            value |= (byte & 0x7F) << shift
            if byte < 0x80:
                return value
        raise ValueError(f"payload {payload.hex()}: a number of more than 5 bytes before byte {at}")

    while at < len(payload):
        head = take(1)[0]
        if head == NOP:
            continue
        if head < WRITE_ERROR:
            count, resolution = head & 3 or number(), Resolution(head >> 2 & 3)
            first, kind = number(), VALUES[resolution]
            data = b"" if head & 0x30 == READ else take(count * kind.itemsize)
            values = tuple(np.frombuffer(data, kind).tolist())
            yield Subframe(head & 0x30, first, count, resolution, values)
        elif head in (WRITE_ERROR, READ_ERROR):
            yield Subframe(head, number(), number())
        elif head in (CONSOLE_WRITE, CONSOLE_SAYS, CONSOLE_READ):
            channel, count = number(), number()
            yield Subframe(head, channel, count, text=b"" if head == CONSOLE_READ else take(count))
        else:
            raise ValueError(f"payload {payload.hex()}: got subframe {head:#x} at byte {at - 1}, expected a known one")


def registers_of(payload: bytes) -> dict[int, float | None]:
    """Every register that a payload writes, answers, or (None) asks for. Raises ValueError as ``subframes``."""
    found: dict[int, float | None] = {}
    for s in subframes(payload):
        for i in range(min(s.count, REGISTERS_MAX) if s.type in (WRITE, READ, REPLY) else 0):
            kind = KINDS.get(s.first + i, "int")
            found[s.first + i] = None if s.type == READ else from_raw(s.values[i], kind, s.resolution)
    return found


def serial_number(payload: bytes) -> int | None:
    """The 96 bits of a serial number that a payload answers; None: it answers none. Raises ValueError as ``subframes``."""
    for s in subframes(payload):
        if (s.type, s.first, s.count, s.resolution) == (REPLY, Register.SERIAL_NUMBER, 3, Resolution.INT32):
            return sum((int(word) & 0xFFFF_FFFF) << 32 * i for i, word in enumerate(s.values))
    return None


def console(type: int, text: bytes) -> bytes:
    """A payload with ``text`` (at most CONSOLE_MAX bytes) to the console (CONSOLE_WRITE) or from it (CONSOLE_SAYS)."""
    return bytes([type, CONSOLE, len(text)]) + text
