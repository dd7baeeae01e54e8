"""Packets of Dynamixel Protocol 2.0: framing, stuffing, CRC, and finding them in a byte stream.

    FF FF FD 00 | id | length | instruction | parameters ... | CRC-16        length: bytes behind it, little-endian
    a status packet has the instruction 55 and an error byte before its parameters

Within instruction and parameters every FF FF FD is followed by a further FD ("stuffing"), so that no header can appear
there. The CRC-16 (polynomial 0x8005, initial value 0, most significant bit first) runs over everything before it, stuffed.
Source: ROBOTIS e-manual, "Protocol 2.0".
"""

from __future__ import annotations

from enum import IntEnum
from functools import cache
from typing import NamedTuple

import numpy as np

HEADER = b"\xff\xff\xfd\x00"
BROADCAST = 0xFE
ID_MAX = 252
STUFFED = b"\xff\xff\xfd"
LENGTH_MAX = 1024  # bytes behind the length field; the longest packet of 60 servos is well below
OVERHEAD = 10  # bytes of a packet without parameters


class Instruction(IntEnum):
    """Eighth byte of a packet."""

    PING = 0x01
    READ = 0x02
    WRITE = 0x03
    REG_WRITE = 0x04
    ACTION = 0x05
    FACTORY_RESET = 0x06
    REBOOT = 0x08
    CLEAR = 0x10
    STATUS = 0x55
    SYNC_READ = 0x82
    SYNC_WRITE = 0x83
    FAST_SYNC_READ = 0x8A
    BULK_READ = 0x92
    BULK_WRITE = 0x93
    FAST_BULK_READ = 0x9A


@cache
def crc_table() -> np.ndarray:
    """(LENGTH_MAX + 8, 256) uint16: what a byte adds to the CRC, by its place; the last row is the last byte.

    With an initial value of 0 the CRC is linear over GF(2): that of a packet is the exclusive or of those of its bytes.
    """
    last = np.arange(256, dtype=np.uint16) << 8
    for _ in range(8):
        last = last << 1 ^ np.where(last & 0x8000, 0x8005, 0).astype(np.uint16)
    rows = [last]
    while len(rows) < LENGTH_MAX + 8:  # one place further from the end: eight steps more
        rows.append(rows[-1] << 8 ^ last[rows[-1] >> 8])
    return np.ascontiguousarray(rows[::-1]).reshape(-1)


@cache
def places(length: int) -> np.ndarray:
    """Where the rows of ``length`` bytes begin in the flat table."""
    return (np.arange(length) + LENGTH_MAX + 8 - length) * 256


def crc16(data: bytes | np.ndarray) -> int:
    """CRC-16 of ``data``, at most LENGTH_MAX + 8 bytes."""
    values = np.frombuffer(data, np.uint8)
    return int(np.bitwise_xor.reduce(crc_table()[values + places(len(values))]))


def stuff(body: bytes) -> bytes:
    """Instruction and parameters as they go onto the wire."""
    return body.replace(STUFFED, STUFFED + b"\xfd")


def unstuff(body: bytes) -> bytes:
    """The inverse of ``stuff``."""
    return body.replace(STUFFED + b"\xfd", STUFFED)


def pack(id: int, instruction: int, parameters: bytes = b"") -> bytes:
    """One packet. Raises ValueError if it is longer than LENGTH_MAX."""
    body = stuff(bytes([instruction]) + parameters)
    length = len(body) + 2
    if length > LENGTH_MAX:
        raise ValueError(f"packet to {id}: got a length of {length}, expected at most {LENGTH_MAX}")
    packet = HEADER + bytes([id]) + length.to_bytes(2, "little") + body
    return packet + crc16(packet).to_bytes(2, "little")


def pack_status(id: int, error: int, parameters: bytes = b"") -> bytes:
    """A servo's answer."""
    return pack(id, Instruction.STATUS, bytes([error]) + parameters)


def pack_read(id: int, address: int, size: int) -> bytes:
    """Ask one servo for ``size`` bytes."""
    return pack(id, Instruction.READ, np.array([address, size], "<u2").tobytes())


def pack_write(id: int, address: int, data: bytes) -> bytes:
    """Write ``data`` to one servo, which answers."""
    return pack(id, Instruction.WRITE, address.to_bytes(2, "little") + data)


def pack_sync_read(ids: bytes, address: int, size: int, fast: bool = False) -> bytes:
    """Ask ``ids`` for the same ``size`` bytes; they answer in this order. ``fast``: all in one status packet."""
    instruction = Instruction.FAST_SYNC_READ if fast else Instruction.SYNC_READ
    return pack(BROADCAST, instruction, np.array([address, size], "<u2").tobytes() + ids)


def pack_sync_write(address: int, items: np.ndarray | bytes, size: int) -> bytes:
    """``items``: for each servo its id and ``size`` bytes. Nobody answers."""
    return pack(BROADCAST, Instruction.SYNC_WRITE, np.array([address, size], "<u2").tobytes() + bytes(items))


def pack_bulk_read(requests: list[tuple[int, int, int]], fast: bool = False) -> bytes:
    """Ask each (id, address, size) for something else; they answer in this order."""
    item = np.dtype([("id", "u1"), ("address", "<u2"), ("size", "<u2")])
    instruction = Instruction.FAST_BULK_READ if fast else Instruction.BULK_READ
    return pack(BROADCAST, instruction, np.array(requests, item).tobytes())


def pack_bulk_write(writes: list[tuple[int, int, bytes]]) -> bytes:
    """Write each (id, address, data). Nobody answers."""
    parts = [bytes([i]) + np.array([a, len(d)], "<u2").tobytes() + d for i, a, d in writes]
    return pack(BROADCAST, Instruction.BULK_WRITE, b"".join(parts))


class Packet(NamedTuple):
    """A packet whose CRC is right, without stuffing. ``end``: how many bytes of the last ``feed`` it took."""

    id: int
    instruction: int
    parameters: bytes  # of a status packet: the error byte first
    end: int = 0
    raw: bytes = b""  # as it was on the wire


class Parser:
    """Finds packets in a byte stream: split, joined, damaged or between other bytes. Keeps at most one packet back."""

    def __init__(self) -> None:
        self._bytes = bytearray()
        self.rejected = 0  # packets cut short, or whose CRC or length was wrong

    def feed(self, data: bytes) -> list[Packet]:
        """Every packet completed by ``data``, oldest first."""
        buffer = self._bytes
        old = len(buffer)
        buffer += data
        packets = []
        at = 0
        while (start := buffer.find(HEADER, at)) >= 0:
            at = start
            if len(buffer) < at + 7:
                break
            length = buffer[at + 5] | buffer[at + 6] << 8
            end = at + 7 + length
            if 3 <= length <= LENGTH_MAX:
                if len(buffer) < end:
                    # Stuffing keeps headers out of packets: another one means that this packet was cut short.
                    if (start := buffer.find(HEADER, at + 7)) < 0:
                        break
                    self.rejected += 1
                    at = start
                    continue
                raw = bytes(buffer[at:end])
                if crc16(raw[:-2]) == raw[-2] | raw[-1] << 8:
                    body = raw[7:-2]
                    if raw[4] != BROADCAST or body[0] != Instruction.STATUS:  # not a fast read's answer, see below
                        body = unstuff(body)
                    packets.append(Packet(raw[4], body[0], body[1:], end - old, raw))
                    at = end
                    continue
            self.rejected += 1
            at += len(HEADER)  # what looked like a header may hide a real one: search on right behind it
        else:
            # Nothing begins in the rest, but a header may in its last three bytes.
            at = next((len(buffer) - k for k in (3, 2, 1) if buffer.endswith(HEADER[:k])), len(buffer))
        del buffer[:at]
        return packets

    @property
    def pending(self) -> bytes:
        """Bytes of a packet that is not complete yet."""
        return bytes(self._bytes)

    def clear(self) -> None:
        """Forget what is not complete yet."""
        self._bytes.clear()
