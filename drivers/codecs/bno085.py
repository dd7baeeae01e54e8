"""BNO080, BNO085 and BNO086 in UART-RVC mode (PS0 high, PS1 low): bytes to SI and back.

    AA AA | index | yaw, pitch, roll (i16, 0.01 deg) | acceleration x, y, z (i16, mg) | 00 00 00 | checksum      19 bytes

100 packets a second at 115200 baud, without any setup; the checksum is the sum of index to the last reserved byte. The
orientation is yaw about z, then pitch about y, then roll about x.

**There is no gyroscope in these packets.** The angular velocity here is that between two packets, from their orientations: half
a period old, with a step of 0.02 rad/s, and absent after a lost packet. That holds a robot's orientation; it does not
balance one. For that, a sensor that sends its gyroscope (see drivers/open.py) is the right part.

Source: CEVA, "BNO08X Data Sheet" (1000-3927), 1.3.5.2 UART-RVC protocol, with the example that the tests have.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

GRAVITY = 9.80665  # m/s^2 in the maker's "1 g"
HEAD = b"\xaa\xaa"
SIZE = 19
PERIOD = 0.01  # s between two packets
DEGREE, MILLI_G = 0.01, 1e-3 * GRAVITY  # of one bit
PAYLOAD = np.dtype([("index", "u1"), ("angles", "<i2", (3,)), ("acceleration", "<i2", (3,)), ("reserved", "u1", (3,))])


class Rvc(NamedTuple):
    """One packet, in the sensor's own frame."""

    index: int
    orientation: np.ndarray  # (4,) w, x, y, z
    angular_velocity: np.ndarray  # (3,) rad/s, between the packet before and this one
    acceleration: np.ndarray  # (3,) m/s^2, +g upwards at rest


def orientation_of(yaw: float, pitch: float, roll: float) -> np.ndarray:
    """(4,) w, x, y, z of angles in rad: about z, then y, then x."""
    (cz, sz), (cy, sy), (cx, sx) = ((math.cos(a / 2), math.sin(a / 2)) for a in (yaw, pitch, roll))
    return np.array(
        [
            cz * cy * cx + sz * sy * sx,
            cz * cy * sx - sz * sy * cx,
            cz * sy * cx + sz * cy * sx,
            sz * cy * cx - cz * sy * sx,
        ]
    )


def angles_of(orientation: np.ndarray) -> tuple[float, float, float]:
    """The inverse: yaw, pitch, roll in rad."""
    w, x, y, z = orientation
    return (
        math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)),
        math.asin(max(-1.0, min(1.0, 2 * (w * y - z * x)))),
        math.atan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y)),
    )


def rotation_between(before: np.ndarray, after: np.ndarray) -> np.ndarray:
    """(3,) rad: the rotation vector, in the body, that takes the orientation ``before`` to ``after``."""
    w0, v0, w1, v1 = before[0], before[1:], after[0], after[1:]
    vector = w0 * v1 - w1 * v0 - np.cross(v0, v1)
    scalar = float(w0 * w1 + v0 @ v1)
    sine = float(np.linalg.norm(vector))
    if sine < 1e-12:
        return np.zeros(3)
    return vector / sine * (2 * math.atan2(sine * math.copysign(1.0, scalar), abs(scalar)))


def pack(index: int, orientation: np.ndarray, acceleration: np.ndarray) -> bytes:
    """The packet as the sensor sends it (19 bytes). Saturates."""
    payload = np.zeros(1, PAYLOAD)
    payload["index"] = index
    payload["angles"] = np.rint(np.rad2deg(angles_of(orientation)) / DEGREE)
    payload["acceleration"] = np.clip(np.rint(np.asarray(acceleration) / MILLI_G), -32768, 32767)
    return frame(payload.tobytes())


def frame(payload: bytes) -> bytes:
    """16 bytes of ``payload`` with header and checksum."""
    return HEAD + payload + bytes([sum(payload) & 0xFF])


class Parser:
    """Finds packets in a byte stream: split, joined, damaged or between other bytes. Keeps at most one packet back.

    One byte of checksum lets one damaged packet in 256 pass; the three reserved bytes must be 0 as well.
    """

    def __init__(self) -> None:
        self._bytes = bytearray()
        self._before: tuple[int, np.ndarray] | None = None  # index and orientation of the packet before
        self.rejected = 0  # packets whose checksum was wrong

    def feed(self, data: bytes) -> list[Rvc]:
        """Every packet completed by ``data`` whose predecessor was there too, oldest first."""
        buffer = self._bytes
        buffer += data
        packets, at = [], 0
        while (start := buffer.find(HEAD, at)) >= 0:
            at = start
            if len(buffer) < at + SIZE:
                break
            payload = bytes(buffer[at + 2 : at + SIZE - 1])
            if sum(payload) & 0xFF != buffer[at + SIZE - 1] or any(payload[-3:]):
                self.rejected += 1
                at += 1  # the header may begin with the next byte
                continue
            at += SIZE
            packets += self._unpack(payload)
        else:
            at = len(buffer) - (buffer[-1:] == HEAD[:1])
        del buffer[:at]
        return packets

    def _unpack(self, payload: bytes) -> list[Rvc]:
        p = np.frombuffer(payload, PAYLOAD)[0]
        index, orientation = int(p["index"]), orientation_of(*np.deg2rad(p["angles"] * DEGREE))
        before, self._before = self._before, (index, orientation)
        if before is None or before[0] != (index - 1) & 0xFF:
            return []
        spin = rotation_between(before[1], orientation) / PERIOD
        return [Rvc(index, orientation, spin, p["acceleration"] * MILLI_G)]


class Sensor:
    """The sensor's side (a ``drivers.sim.imu.Sensor``)."""

    RATE_MAX = 1 / PERIOD

    def __init__(self) -> None:
        self._index = 0

    def pack(
        self, time: float, orientation: Sequence[float], spin: Sequence[float], acceleration: Sequence[float]
    ) -> bytes:
        self._index = self._index + 1 & 0xFF
        return pack(self._index, np.asarray(orientation), np.asarray(acceleration))

    def retell(self, packet: bytes, change: Callable[[bytearray], None]) -> bytes:
        payload = bytearray(packet[2:-4])  # not the reserved bytes
        change(payload)
        return frame(bytes(payload) + bytes(3))
