"""SerialImu over real pseudo-terminals and a fake wire: states, damage, implausible packets, an unplugged port."""

from __future__ import annotations

import os
import pty
from dataclasses import replace

import numpy as np
import pytest

from drivers.bus import BusError, ImuSpec
from drivers.codecs.hipnuc import Hi91, frame, pack
from drivers.imu.serial import SerialImu
from drivers.open import open_imu
from drivers.wire import WireError

SPEC = ImuSpec("hipnuc", channel="/dev/ttyUSB0")


class FakeWire:
    """A SerialWire that gives what is put into ``chunks``, one a read."""

    def __init__(self, *chunks: bytes) -> None:
        self.chunks = list(chunks)
        self.closed = False

    def write(self, data: bytes) -> None:
        raise AssertionError("an IMU is only read")

    def read(self) -> bytes:
        return self.chunks.pop(0) if self.chunks else b""

    def fileno(self) -> int:
        return -1

    def close(self) -> None:
        self.closed = True


def packet(**changes) -> Hi91:
    still = Hi91(1.0, 30.0, np.array([0.0, 0.0, 9.8]), np.array([0.1, -0.2, 0.3]), np.array([1.0, 0.0, 0.0, 0.0]), 0)
    return still._replace(**changes)


def test_the_state_of_the_latest_packet():
    turned = packet(orientation=np.array([0.0, 1.0, 0.0, 0.0]), acceleration=np.array([0.0, 0.0, -9.8]))
    first, second = pack(packet()), pack(turned)
    wire = FakeWire(first[:50], first[50:], b"", second + first + second)
    imu = open_imu(SPEC, wire)
    assert np.isneginf(imu.read(1.0).time)  # half a packet
    state = imu.read(2.0)
    assert state.time == 2.0
    np.testing.assert_allclose(state.orientation_imu_in_world, [1, 0, 0, 0])
    np.testing.assert_allclose(state.angular_velocity_imu_in_imu, [0.1, -0.2, 0.3], rtol=1e-6)
    np.testing.assert_allclose(state.acceleration_imu_in_imu, [0, 0, 9.8], rtol=1e-6)
    assert imu.read(3.0).time == 2.0  # nothing new: it grows old
    assert imu.read(4.0) is state
    np.testing.assert_allclose(state.orientation_imu_in_world, [0, 1, 0, 0])
    assert (imu.counters.received, imu.counters.rejected) == (4, 0)


def test_damaged_packets_are_counted_and_leave_the_state_old():
    good = pack(packet())
    damaged = bytearray(good)
    damaged[40] ^= 1
    imu = open_imu(SPEC, FakeWire(good, bytes(damaged) + good[:3]))
    imu.read(1.0)
    assert imu.read(2.0).time == 1.0
    assert (imu.counters.received, imu.counters.rejected) == (1, 1)


@pytest.mark.parametrize(
    "changes",
    [
        {"orientation": np.zeros(4)},
        {"orientation": np.array([1.0, 0.2, 0.0, 0.0])},
        {"orientation": np.array([np.nan, 0.0, 0.0, 0.0])},
        {"angular_velocity": np.array([0.0, np.nan, 0.0])},
        {"acceleration": np.array([0.0, 0.0, np.inf])},
    ],
)
def test_implausible_packets_are_rejected(changes):
    imu = open_imu(SPEC, FakeWire(pack(packet(**changes))))
    assert np.isneginf(imu.read(1.0).time)
    assert (imu.counters.received, imu.counters.rejected) == (1, 1)


def test_other_packets_do_not_make_it_younger():
    imu = open_imu(SPEC, FakeWire(frame(b"\x81" + bytes(80))))
    assert np.isneginf(imu.read(1.0).time)


def test_close_closes_the_wire():
    wire = FakeWire()
    imu = open_imu(SPEC, wire)
    imu.close()
    assert isinstance(imu, SerialImu) and wire.closed


@pytest.fixture
def port():
    """The two ends of a pseudo-terminal: ours to write as the sensor does, and a device name to open."""
    sensor, device = pty.openpty()
    os.set_blocking(sensor, False)
    yield sensor, os.ttyname(device)
    for fd in (sensor, device):
        try:
            os.close(fd)
        except OSError:
            pass  # the test closed it


def test_through_a_real_serial_port(port):
    sensor, device = port
    imu = open_imu(replace(SPEC, channel=device))
    assert np.isneginf(imu.read(0.5).time)  # returns at once though nothing came
    os.write(sensor, pack(packet()))
    assert imu.read(1.0).time == 1.0
    imu.close()


def test_an_unplugged_port_is_a_bus_error(port):
    sensor, device = port
    imu = open_imu(replace(SPEC, channel=device))
    os.close(sensor)
    with pytest.raises(BusError, match=rf"imu hipnuc \({device}\): serial {device} at 921600 baud: reading: "):
        imu.read(1.0)
    imu.close()


def test_serial_wire_writes_and_reads_bytes(port):
    from drivers.serial_wire import PySerialWire

    sensor, device = port
    wire = PySerialWire(device, 115200)
    wire.write(b"\x00\x11\x13\xff\n\r")  # not one is special: no flow control, no translation
    assert os.read(sensor, 100) == b"\x00\x11\x13\xff\n\r"
    os.write(sensor, b"\x00\x11\x13\xff\n\r")
    assert wire.read() == b"\x00\x11\x13\xff\n\r"
    assert wire.read() == b""
    assert wire.fileno() >= 0
    wire.close()


def test_a_port_that_is_busy_or_absent(port):
    from drivers.serial_wire import PySerialWire

    _, device = port
    wire = PySerialWire(device, 115200)
    with pytest.raises(WireError, match=rf"serial {device} at 115200 baud: .*\n.*free"):
        PySerialWire(device, 115200)
    wire.close()
    with pytest.raises(BusError, match=r"imu: serial /dev/nothing at 921600 baud: .*\n  Is it plugged in"):
        open_imu(replace(SPEC, channel="/dev/nothing"))
