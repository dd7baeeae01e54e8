"""Other people's libraries read what our twins of IMUs say: adafruit-circuitpython-bno08x, which also sets one up, and
witmotion (``pip install 'sim2real[oracles]'``)."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from sim_robots import IMU, make_world

from drivers.codecs import witmotion
from drivers.sim.imu import ImuNoise


class Uart:
    """A serial port of CircuitPython on the twin's line, in lockstep with it."""

    def __init__(self, world) -> None:
        self._world, self._bytes = world, b""

    def write(self, data: bytes) -> None:
        self._world.imu_wire.write(bytes(data))

    def read(self, count: int) -> bytes:
        for _ in range(1000):
            if self.in_waiting >= count:
                break
        data, self._bytes = self._bytes[:count], self._bytes[count:]
        return data

    @property
    def in_waiting(self) -> int:
        self._world.advance(self._world.time + 0.0005)  # which it asks in a loop
        self._bytes += self._world.imu_wire.read()
        return len(self._bytes)


def test_the_library_sets_the_twin_up_and_reads_it(tmp_path, monkeypatch):
    theirs = pytest.importorskip("adafruit_bno08x.uart", reason="not installed")
    library = pytest.importorskip("adafruit_bno08x")
    imu = replace(IMU, protocol="bno085_shtp", rate=100.0, baud=3_000_000)
    world = make_world(tmp_path, imu=imu, imu_noise=ImuNoise(0.0, 0.0, 0.0, (0.25, 0.0, -0.5)))
    for module in (theirs, library):
        monkeypatch.setattr(module.time, "sleep", lambda seconds: world.advance(world.time + seconds))
        monkeypatch.setattr(module.time, "monotonic", lambda: world.time)
    sensor = theirs.BNO08X_UART(Uart(world))
    for report in ("ACCELEROMETER", "GYROSCOPE", "GAME_ROTATION_VECTOR"):
        sensor.enable_feature(getattr(library, f"BNO_REPORT_{report}"))
    world.advance(world.time + 0.2)
    assert sensor.acceleration == pytest.approx((0, 0, 9.81), abs=0.01)
    assert sensor.gyro == pytest.approx((0.25, 0, -0.5), abs=2e-3)
    np.testing.assert_allclose(np.abs(sensor.game_quaternion), (0, 0, 0, 1), atol=1e-3)


def test_the_library_reads_our_witmotion_frames():
    theirs = pytest.importorskip("witmotion.protocol", reason="not installed")
    sample = witmotion.Sample(
        np.array([0.0, -0.5, 1.0]) * theirs.G, np.deg2rad([500.0, 0.0, -1000.0]), np.array([0.5, 0.5, -0.5, 0.5]), 25.0
    )
    raw, said = witmotion.pack(sample), []
    kinds = {0x51: theirs.AccelerationMessage, 0x52: theirs.AngularVelocityMessage, 0x59: theirs.QuaternionMessage}
    for at in range(0, len(raw), witmotion.SIZE):
        head, code, *body, check = raw[at : at + witmotion.SIZE]
        assert head == 0x55 and kinds[code].compute_checksum(body) == check
        said.append(kinds[code].parse(bytes(body)))
    acceleration, spin, orientation = said
    assert acceleration.a == pytest.approx(sample.acceleration, abs=0.01)  # whose g is 9.8
    assert acceleration.temp_celsius == spin.temp_celsius == 25.0
    assert spin.w == pytest.approx((500.0, 0.0, -1000.0))  # deg/s
    assert orientation.q == pytest.approx(sample.orientation)
