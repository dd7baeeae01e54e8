"""The simulated IMU: packets of its protocol at a fixed rate, byte by byte down a serial line.

Samples are white noise and constant biases on the truth at a site of the plant; a packet becomes readable as its bytes
arrive at the line's speed plus ``latency``. Not modelled: the sensor's own fusion filter (its lag and yaw drift),
scale errors, vibration, saturation, temperature.
"""

from __future__ import annotations

import hashlib
import math
import random
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from operator import add
from typing import Protocol

import numpy as np

from drivers.bus import BusError, ImuSpec
from drivers.open import IMUS, load
from drivers.sim.faults import IMU, Fault
from drivers.wire import WireError

BITS_PER_BYTE = 10  # 8N1
BLOCK = 256  # samples of noise drawn at once


class Sensor(Protocol):
    """A sensor's side of its protocol. One that listens to its host has ``hear(data: bytes) -> bytes``: what it answers."""

    RATE_MAX: float  # Hz

    def pack(
        self, time: float, orientation: Sequence[float], spin: Sequence[float], acceleration: Sequence[float]
    ) -> bytes:
        """A sample as it is sent: s, (4,) w, x, y, z, (3,) rad/s and (3,) m/s^2 in the sensor's own frame. b"": nothing is."""
        ...

    def retell(self, packet: bytes, change: Callable[[bytearray], None]) -> bytes:
        """``packet`` with ``change(payload)`` done to it, and a check that fits."""
        ...


@dataclass(frozen=True)
class ImuNoise:
    """Standard deviation of a sample, and constant bias (each axis). Default: a good MEMS unit."""

    orientation: float = 0.001  # rad
    angular_velocity: float = 0.003  # rad/s
    acceleration: float = 0.03  # m/s^2
    angular_velocity_bias: tuple[float, float, float] = (0.0, 0.0, 0.0)  # rad/s
    acceleration_bias: tuple[float, float, float] = (0.0, 0.0, 0.0)  # m/s^2


class SimImu:
    """Samples ``body`` (a drivers.sim.plant.Plant) every 1/rate s."""

    def __init__(self, spec: ImuSpec, body, *, seed: int = 0, noise: ImuNoise | None = None, latency: float = 250e-6):
        known = [name for name, p in IMUS.items() if p.sensor]
        if spec.protocol not in known:
            raise BusError(f"IMU: no emulation of '{spec.protocol}', expected {', '.join(known)}")
        self._sensor: Sensor = load(IMUS[spec.protocol].sensor)()
        if spec.rate > (most := self._sensor.RATE_MAX):
            raise BusError(
                f"imu: got a rate of {spec.rate:g} Hz, expected at most {most:g}: '{spec.protocol}' has no more"
            )
        self.spec, self.noise = spec, noise or ImuNoise()
        self._body, self._latency = body, latency
        self._byte_time = BITS_PER_BYTE / spec.baud
        self._packets: deque[list] = deque()  # [start, bytes, how many of them were read]
        self._free = 0.0
        self._samples = 0
        self._faults: list[Fault] = []
        self._stuck: dict[int, bytes] = {}
        self._random = random.Random(f"{seed}/{IMU}")
        self._generator = np.random.default_rng([seed, 0x1A])
        self._scale = np.repeat([self.noise.orientation / 2, self.noise.angular_velocity, self.noise.acceleration], 3)
        self._mean = np.concatenate([np.zeros(3), self.noise.angular_velocity_bias, self.noise.acceleration_bias])
        mount = spec.orientation_imu_in_base
        norm = math.hypot(*mount)
        self._mount = None if mount == (1, 0, 0, 0) else tuple(m / norm for m in mount)
        self._axes = matrix(self._mount or (1, 0, 0, 0))
        self.carried: list[bytes] = []  # packets since the last digest

    def sample(self, now: float) -> None:
        """Send what is due by ``now``: a packet of the body's present state."""
        if now + 1e-9 < (self._samples + 1) / self.spec.rate:
            return
        self._samples += 1
        at = self._samples % BLOCK
        if at == 1 or self._samples == 1:
            self._block = (self._generator.standard_normal((BLOCK, 9)) * self._scale + self._mean).tolist()
        body, noise = self._body, self._block[at]
        orientation = body.orientation_imu_in_world.tolist()
        spin, acceleration = body.angular_velocity_imu_in_imu, body.acceleration_imu_in_imu
        if self._mount is not None:
            orientation = multiply(orientation, self._mount)
            spin, acceleration = self._axes.T @ spin, self._axes.T @ acceleration
        w, x, y, z = multiply(orientation, (1.0, *noise[:3]))
        norm = math.sqrt(w * w + x * x + y * y + z * z)
        packet = self._sensor.pack(
            now,
            [w / norm, x / norm, y / norm, z / norm],
            [*map(add, spin.tolist(), noise[3:6])],
            [*map(add, acceleration.tolist(), noise[6:9])],
        )
        self._send(packet, now)

    def hear(self, data: bytes, now: float) -> None:
        """What the host writes."""
        if (hear := getattr(self._sensor, "hear", None)) is not None:
            self._send(hear(data), now)

    def _send(self, packet: bytes, now: float) -> None:
        if not packet:
            return
        copies, start = 1, now
        for fault in self._faults:
            if not fault.start <= now < fault.end or self._random.random() >= fault.probability:
                continue
            if fault.kind in ("drop", "off"):
                return
            if fault.kind == "delay":
                start += fault.value
            elif fault.kind == "duplicate":
                copies = 2
            elif fault.kind == "stuck":
                packet = self._stuck.setdefault(id(fault), packet)
            else:
                packet = self._lie(fault.kind, packet)
        for _ in range(copies):
            start = max(start, self._free)
            self._packets.append([start, packet, 0])
            self._free = start + len(packet) * self._byte_time
            self.carried.append(packet)

    def _lie(self, kind: str, packet: bytes) -> bytes:
        def change(payload: bytearray) -> None:
            if kind == "garbage":
                payload[1:] = self._random.randbytes(len(payload) - 1)
            else:
                at = self._random.randrange(8, 8 * len(payload))
                payload[at // 8] ^= 1 << at % 8

        if kind != "corrupt":
            return self._sensor.retell(packet, change)
        spoiled = bytearray(packet)
        at = self._random.randrange(min(64, 4 * len(packet)), 8 * len(packet))
        spoiled[at // 8] ^= 1 << at % 8  # the check no longer fits
        return bytes(spoiled)

    def inject(self, fault: Fault) -> None:
        self._faults.append(fault)

    def digest(self, sha: hashlib._Hash) -> None:
        """Add the packets carried since the last call."""
        if self.carried:
            sha.update(b"imu:" + b"".join(self.carried))
            self.carried.clear()

    def read(self, now: float) -> bytes:
        """The bytes that have arrived by ``now``."""
        out = b""
        while self._packets:
            entry = self._packets[0]
            start, packet, taken = entry
            there = min(len(packet), math.floor((now - self._latency - start) / self._byte_time + 1e-6))
            if there <= taken:
                break
            out += packet[taken:there]
            if there == len(packet):
                self._packets.popleft()
            else:
                entry[2] = there
                break
        return out


class SimSerialWire:
    """The host's end of the IMU's line: a drivers.wire.SerialWire. Most sensors ignore what the host writes."""

    def __init__(self, imu: SimImu, now: Callable[[], float]):
        self._imu, self._now, self._open = imu, now, True

    def write(self, data: bytes) -> None:
        self._check()
        self._imu.hear(data, self._now())

    def read(self) -> bytes:
        self._check()
        return self._imu.read(self._now())

    def _check(self) -> None:
        if not self._open:
            raise WireError("imu: used after close; open the wire again")

    def fileno(self) -> int:
        return -1

    def close(self) -> None:
        self._open = False


Quaternion = tuple[float, float, float, float]


def multiply(a: Sequence[float], b: Sequence[float]) -> Quaternion:
    """Product of two quaternions (w, x, y, z)."""
    aw, ax, ay, az = a
    bw, bx, by, bz = b
    return (
        aw * bw - ax * bx - ay * by - az * bz,
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
    )


def matrix(q: Sequence[float]) -> np.ndarray:
    """Rotation matrix (3, 3) of a unit quaternion."""
    w, x, y, z = q
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
