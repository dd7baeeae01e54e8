"""WitMotion IMUs on a serial line (JY901, WT901, HWT905, ...; standard protocol): bytes to SI and back.

    55 | type | four i16 | checksum: the sum of the ten bytes before        11 bytes, little-endian

One sample comes as several such frames, in the order of their types. Of these are read: 51 acceleration (16 g full scale) and
temperature (0.01 deg C), 52 angular velocity (2000 deg/s), 59 quaternion (1); a sample is complete with its quaternion, where
both others came since the one before. So the sensor must send all three: output content (register 02) 0206, at a rate and
bit rate that the line can carry (33 bytes a sample: 200 Hz need 115200), set with the maker's tool.

Full scale is 32768. One byte of checksum lets one damaged frame in 256 pass.
Source: docs.wit-motion.com, HWT905-TTL "Protocol": output data format, and register 02 (RSW).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

GRAVITY = 9.80665  # m/s^2 in the maker's "1 g"
HEAD = 0x55
SIZE = 11
ACCELERATION, ANGULAR_VELOCITY, QUATERNION = 0x51, 0x52, 0x59
TYPES = range(0x50, 0x60)
SCALE = {  # of one bit, in SI
    ACCELERATION: 16 * GRAVITY / 32768,
    ANGULAR_VELOCITY: np.deg2rad(2000) / 32768,
    QUATERNION: 1 / 32768,
}
TEMPERATURE = 0.01  # deg C


class Sample(NamedTuple):
    """What the frames of one sample say, in the sensor's own frame."""

    acceleration: np.ndarray  # (3,) m/s^2, +g upwards at rest
    angular_velocity: np.ndarray  # (3,) rad/s
    orientation: np.ndarray  # (4,) w, x, y, z
    temperature: float  # deg C


def frame(type: int, data: bytes) -> bytes:
    """Eight bytes of ``data`` as one frame."""
    body = bytes([HEAD, type]) + data
    return body + bytes([sum(body) & 0xFF])


def pack(sample: Sample) -> bytes:
    """The frames of a sample (33 bytes). Saturates."""
    heat = sample.temperature / TEMPERATURE
    rows = (
        (ACCELERATION, [*np.asarray(sample.acceleration) / SCALE[ACCELERATION], heat]),
        (ANGULAR_VELOCITY, [*np.asarray(sample.angular_velocity) / SCALE[ANGULAR_VELOCITY], heat]),
        (QUATERNION, [*np.asarray(sample.orientation) / SCALE[QUATERNION]]),
    )
    return b"".join(frame(t, np.clip(np.rint(values), -32768, 32767).astype("<i2").tobytes()) for t, values in rows)


class Parser:
    """Finds samples in a byte stream: split, joined, damaged or between other bytes. Keeps at most one frame back."""

    def __init__(self) -> None:
        self._bytes = bytearray()
        self._heard: dict[int, np.ndarray] = {}
        self.rejected = 0  # frames whose checksum was wrong

    def feed(self, data: bytes) -> list[Sample]:
        """Every sample completed by ``data``, oldest first."""
        buffer = self._bytes
        buffer += data
        samples, at = [], 0
        while (start := buffer.find(HEAD, at)) >= 0:
            at = start
            if len(buffer) < at + SIZE:
                break
            body = bytes(buffer[at : at + SIZE])
            if body[1] not in TYPES:
                at += 1  # a byte that only looks like a header
            elif sum(body[:-1]) & 0xFF != body[-1]:
                self.rejected += 1
                at += 1
            else:
                at += SIZE
                self._heard[body[1]] = np.frombuffer(body, "<i2", 4, 2)
                if body[1] == QUATERNION:
                    samples += self._complete()
        else:
            at = len(buffer)
        del buffer[:at]
        return samples

    def _complete(self) -> list[Sample]:
        heard, self._heard = self._heard, {}
        if not {ACCELERATION, ANGULAR_VELOCITY} <= heard.keys():
            return []  # one of them was lost
        acceleration, spin = (heard[t][:3] * SCALE[t] for t in (ACCELERATION, ANGULAR_VELOCITY))
        return [Sample(acceleration, spin, heard[QUATERNION] / 32768, float(heard[ACCELERATION][3]) * TEMPERATURE)]


class Sensor:
    """The sensor's side (a ``drivers.sim.imu.Sensor``)."""

    RATE_MAX = 200.0  # Hz

    def pack(
        self, time: float, orientation: Sequence[float], spin: Sequence[float], acceleration: Sequence[float]
    ) -> bytes:
        return pack(Sample(np.asarray(acceleration), np.asarray(spin), np.asarray(orientation), 40.0))

    def retell(self, packet: bytes, change: Callable[[bytearray], None]) -> bytes:
        frames = [packet[at : at + SIZE] for at in range(0, len(packet), SIZE)]
        payload = bytearray(b"".join(f[2:-1] for f in frames))
        change(payload)
        return b"".join(frame(f[1], bytes(payload[8 * i : 8 * i + 8])) for i, f in enumerate(frames))
