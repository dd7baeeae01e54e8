"""LowCmd the straightforward way: a class a message, packed field by field, and the CRC from its definition.

An oracle for the codec and the incumbent of its benchmark; written from the layout in the codec's docstring.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass, field

SLOTS = 35


@dataclass
class MotorCmd:
    mode: int = 0
    q: float = 0.0
    dq: float = 0.0
    tau: float = 0.0
    kp: float = 0.0
    kd: float = 0.0
    reserve: int = 0


@dataclass
class LowCmd:
    mode_pr: int = 0
    mode_machine: int = 0
    motor_cmd: list[MotorCmd] = field(default_factory=lambda: [MotorCmd() for _ in range(SLOTS)])
    reserve: list[int] = field(default_factory=lambda: [0] * 4)
    crc: int = 0


def pack_struct(m: LowCmd) -> bytes:
    """The C struct, 1004 bytes."""
    fields: list[float] = [m.mode_pr, m.mode_machine]
    for c in m.motor_cmd:
        fields += [c.mode, c.q, c.dq, c.tau, c.kp, c.kd, c.reserve]
    return struct.pack("<2B2x" + "B3x5fI" * SLOTS + "5I", *fields, *m.reserve, m.crc)


def pack_cdr(m: LowCmd) -> bytes:
    """The payload on the wire, 1004 bytes with its header: every field aligned to its own size."""
    out = bytearray(struct.pack("<2B", m.mode_pr, m.mode_machine))
    for c in m.motor_cmd:
        out += struct.pack("<B", c.mode)
        out += b"\0" * (-len(out) % 4)
        out += struct.pack("<5fI", c.q, c.dq, c.tau, c.kp, c.kd, c.reserve)
    out += struct.pack("<5I", *m.reserve, m.crc)
    return b"\0\1\0\0" + bytes(out)


def crc32_bitwise(data: bytes) -> int:
    """Bit by bit, over little-endian words, high bit first: polynomial 0x04C11DB7, start all ones, nothing reflected."""
    crc = 0xFFFF_FFFF
    for (word,) in struct.iter_unpack("<I", data):
        for bit in range(31, -1, -1):
            carry = crc >> 31 ^ word >> bit & 1
            crc = crc << 1 & 0xFFFF_FFFF
            if carry:
                crc ^= 0x04C1_1DB7
    return crc


def _table() -> list[int]:
    table = []
    for byte in range(256):
        crc = byte << 24
        for _ in range(8):
            crc = (crc << 1 ^ 0x04C1_1DB7 if crc >> 31 else crc << 1) & 0xFFFF_FFFF
        table.append(crc)
    return table


TABLE = _table()


def crc32_by_table(data: bytes) -> int:
    """The same, a byte at a time."""
    crc = 0xFFFF_FFFF
    for (word,) in struct.iter_unpack("<I", data):
        for byte in word.to_bytes(4, "big"):
            crc = (crc << 8 & 0xFFFF_FFFF) ^ TABLE[crc >> 24 ^ byte]
    return crc
