"""HiPNUC HI91 packets (tag 0x91, floats), as sent by HI13/HI14 and CH0x0 IMUs: bytes to SI and back.

    5A A5 | length u16 | crc u16 | payload (76 bytes)        little-endian

The CRC-16 (polynomial 0x1021, initial value 0, most significant bit first, no final xor) runs over the first four bytes
and then the payload. Source: HiPNUC "Command and Programming Manual", chapter on the serial binary protocol.
The sensor says g, deg/s and deg; everything here is SI.
"""

from __future__ import annotations

import binascii
import math
import struct
from collections.abc import Callable, Sequence
from typing import NamedTuple, TypeAlias

GRAVITY = 9.80665  # m/s^2 in the maker's "1 g"
HEAD = b"\x5a\xa5"
HEAD_SIZE = 6
LENGTH_MAX = 512  # bytes of payload; the sensor's largest packet is well below
TAG = 0x91

# tag u8, status u16, temperature i8 (deg C), pressure f32 (Pa), timestamp u32 (ms since power-on), then f32 vectors:
# acceleration (g), angular velocity (deg/s), magnetic field (uT), roll, pitch, yaw (deg), orientation (w, x, y, z)
PAYLOAD = struct.Struct("<BHbfI3f3f3f3f4f")  # 76 bytes


Vector: TypeAlias = Sequence[float]


class Hi91(NamedTuple):
    """One packet, in the sensor's own frame."""

    timestamp: float  # s since the sensor's power-on
    temperature: float  # deg C
    acceleration: Vector  # (3,) m/s^2, +g upwards at rest
    angular_velocity: Vector  # (3,) rad/s
    orientation: Vector  # (4,) w, x, y, z
    status: int


def crc16(data: bytes | bytearray, crc: int = 0) -> int:
    """CRC-16/XMODEM of ``data``, continuing from ``crc``."""
    return binascii.crc_hqx(data, crc)


def pack(packet: Hi91) -> bytes:
    """The packet as the sensor sends it (82 bytes)."""
    w, x, y, z = packet.orientation
    payload = PAYLOAD.pack(
        TAG,
        packet.status,
        round(packet.temperature),
        0.0,
        round(packet.timestamp * 1e3) & 0xFFFF_FFFF,
        *[a / GRAVITY for a in packet.acceleration],
        *map(math.degrees, packet.angular_velocity),
        *(0.0, 0.0, 0.0),
        math.degrees(math.atan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))),
        math.degrees(math.asin(max(-1.0, min(1.0, 2 * (w * y - z * x))))),
        math.degrees(math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))),
        *(w, x, y, z),
    )
    return frame(payload)


def frame(payload: bytes) -> bytes:
    """``payload`` with its header: sync bytes, length and CRC."""
    start = HEAD + len(payload).to_bytes(2, "little")
    return start + crc16(payload, crc16(start)).to_bytes(2, "little") + payload


def unpack(payload: bytes | bytearray) -> Hi91:
    """A checked payload whose first byte is TAG, in SI units. Raises ValueError if it is shorter than PAYLOAD."""
    if len(payload) < PAYLOAD.size:
        raise ValueError(f"payload: got {len(payload)} bytes, expected {PAYLOAD.size}")
    _, status, temperature, _, timestamp, *v = PAYLOAD.unpack_from(payload)
    return Hi91(
        timestamp=timestamp * 1e-3,
        temperature=float(temperature),
        acceleration=[GRAVITY * a for a in v[0:3]],
        angular_velocity=[*map(math.radians, v[3:6])],
        orientation=v[12:16],
        status=status,
    )


class Parser:
    """Finds packets in a byte stream: split, joined, damaged or between other bytes. Keeps at most one packet back."""

    def __init__(self) -> None:
        self._bytes = bytearray()
        self.rejected = 0  # packets whose CRC or length was wrong

    def feed(self, data: bytes) -> list[Hi91]:
        """Every HI91 packet completed by ``data``, oldest first. Packets of other tags are skipped."""
        buffer = self._bytes
        buffer += data
        packets = []
        at = 0
        while (start := buffer.find(HEAD, at)) >= 0:
            at = start
            if len(buffer) < at + HEAD_SIZE:
                break
            length = int.from_bytes(buffer[at + 2 : at + 4], "little")
            end = at + HEAD_SIZE + length
            if not 0 < length <= LENGTH_MAX:
                self.rejected += 1
                at += len(HEAD)
                continue
            if len(buffer) < end:
                break
            payload = buffer[at + HEAD_SIZE : end]
            if crc16(payload, crc16(buffer[at : at + 4])) != int.from_bytes(buffer[at + 4 : at + 6], "little"):
                self.rejected += 1
                at += len(HEAD)  # what looked like a header may hide a real one: search on right behind it
                continue
            if payload[0] == TAG and length >= PAYLOAD.size:
                packets.append(unpack(payload))
            at = end
        else:
            at = len(buffer) - (buffer[-1:] == HEAD[:1])  # nothing begins in the rest, but its last byte may
        del buffer[:at]
        return packets


class Sensor:
    """The sensor's side (a ``drivers.sim.imu.Sensor``)."""

    RATE_MAX = 1000.0  # Hz

    def pack(
        self, time: float, orientation: Sequence[float], spin: Sequence[float], acceleration: Sequence[float]
    ) -> bytes:
        return pack(Hi91(time, 40.0, acceleration, spin, orientation, 0))

    def retell(self, packet: bytes, change: Callable[[bytearray], None]) -> bytes:
        payload = bytearray(packet[HEAD_SIZE:])
        change(payload)
        return frame(bytes(payload))
