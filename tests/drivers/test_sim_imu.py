"""The simulated IMU: what it says, how fast it says it, and its faults."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from sim_robots import BOX, IMU, make_world

from drivers.bus import BusError
from drivers.codecs import hipnuc
from drivers.sim.imu import ImuNoise, matrix, multiply

QUIET = ImuNoise(0.0, 0.0, 0.0)


def packets(world, seconds: float = 0.1) -> list[hipnuc.Hi91]:
    world.advance(world.time + seconds)
    return hipnuc.Parser().feed(world.imu_wire.read())


def test_at_rest(tmp_path):
    out = packets(make_world(tmp_path, imu_noise=QUIET))
    assert len(out) == 49  # of 50: the last is on the line
    assert [p.timestamp for p in out] == pytest.approx(0.002 * np.arange(1, 50), abs=1e-9)
    for p in out:
        assert p.acceleration == pytest.approx([0, 0, 9.81], abs=1e-5)
        assert p.angular_velocity == pytest.approx([0, 0, 0], abs=1e-6)
        assert p.orientation == pytest.approx([1, 0, 0, 0], abs=1e-6)


def test_a_body_in_flight(tmp_path):
    """Free fall weighs nothing at the centre of mass; spin about x, seen in the body."""
    world = make_world(tmp_path, BOX, imu_noise=QUIET)
    world.plant.data.qpos[2] = 50.0
    world.plant.data.qvel[3:6] = (2.0, 0.0, 0.0)
    last = packets(world, 0.2)[-1]
    angle = 2.0 * last.timestamp
    assert last.angular_velocity == pytest.approx([2, 0, 0], abs=0.02)
    assert last.orientation == pytest.approx([math.cos(angle / 2), math.sin(angle / 2), 0, 0], abs=2e-3)
    # The site is 0.1 m above the base, the centre of mass 0.05 m below it: centripetal, towards the axis.
    assert last.acceleration[2] == pytest.approx(-(2.0**2) * 0.15, abs=0.02)


def test_the_chip_may_be_mounted_turned(tmp_path):
    """Mounted upside down (half a turn about x), it sees gravity pull the other way."""
    mount = (0.0, 1.0, 0.0, 0.0)
    out = packets(make_world(tmp_path, imu=replace(IMU, orientation_imu_in_base=mount), imu_noise=QUIET))
    assert out[-1].acceleration == pytest.approx([0, 0, -9.81], abs=1e-5)
    assert out[-1].orientation == pytest.approx(mount, abs=1e-6)


def test_noise_has_its_deviation(tmp_path):
    noise = ImuNoise(0.002, 0.01, 0.1, angular_velocity_bias=(0.05, 0.0, 0.0))
    out = packets(make_world(tmp_path, imu_noise=noise), 4.0)
    spin = np.array([p.angular_velocity for p in out])
    assert spin.std(axis=0) == pytest.approx([0.01] * 3, rel=0.1)
    assert spin.mean(axis=0) == pytest.approx([0.05, 0, 0], abs=0.002)
    assert np.std([p.acceleration for p in out], axis=0) == pytest.approx([0.1] * 3, rel=0.1)
    assert 2 * np.std([p.orientation[1:] for p in out], axis=0) == pytest.approx([0.002] * 3, rel=0.1)


@pytest.mark.parametrize("rate", [100.0, 200.0, 500.0])
def test_rate(tmp_path, rate):
    assert len(packets(make_world(tmp_path, imu=replace(IMU, rate=rate)), 1.0)) == pytest.approx(rate, abs=1)


def test_bytes_come_at_the_line_rate(tmp_path):
    world = make_world(tmp_path, imu=replace(IMU, baud=115_200, rate=100.0))
    arrived = []
    for _ in range(400):
        world.advance(world.time + 0.0001)
        arrived.append(len(world.imu_wire.read()))
    # The first packet is sampled at 10 ms and the adapter adds 0.25 ms; 82 bytes of 10 bits take 7.12 ms.
    assert sum(arrived[:103]) == 0
    assert sum(arrived[:150]) == pytest.approx((0.015 - 0.01025) * 11520, abs=1.5)
    assert sum(arrived[:173]) < 82 <= sum(arrived[:175])


def test_a_line_that_is_too_slow_falls_behind(tmp_path):
    """82 bytes at 115200 bit/s take 7 ms: at 500 Hz the packets queue up, as they would."""
    out = packets(make_world(tmp_path, imu=replace(IMU, baud=115_200)), 1.0)
    assert len(out) == 140
    assert out[-1].timestamp < 0.3


@pytest.mark.parametrize(
    ("fault", "good", "rejected"),
    [
        ("drop:imu", 0, 0),
        ("off:imu", 0, 0),
        ("corrupt:imu", 0, 49),
        ("duplicate:imu", 98, 0),
        ("delay:imu=0.05", 24, 0),
    ],
)
def test_faults(tmp_path, fault, good, rejected):
    world = make_world(tmp_path, imu=replace(IMU, baud=4_000_000), faults=[fault])
    world.advance(0.1)
    parser = hipnuc.Parser()
    assert len(parser.feed(world.imu_wire.read())) == good
    assert parser.rejected == rejected


def test_stuck_and_lies(tmp_path):
    def spins(*faults: str) -> set:
        return {tuple(p.angular_velocity) for p in packets(make_world(tmp_path, faults=faults))}

    assert len(spins()) > 40
    assert len(spins("stuck:imu")) == 1
    honest = packets(make_world(tmp_path))
    wrong = packets(make_world(tmp_path, faults=["wrong:imu"]))
    assert len(wrong) == len(honest)
    flat = lambda p: np.concatenate([p.acceleration, p.angular_velocity, p.orientation, [p.timestamp]])  # noqa: E731
    changed = [np.count_nonzero(flat(a) != flat(b)) for a, b in zip(honest, wrong, strict=True)]
    assert set(changed) == {0, 1}  # one bit of the payload, which may be in a field nobody reads
    garbage = packets(make_world(tmp_path, faults=["garbage:imu"]))
    assert len(garbage) == len(honest)  # the CRC fits: only plausibility can tell
    assert np.abs([np.linalg.norm(p.orientation) - 1 for p in garbage]).min() > 0.01


def test_what_does_not_exist(tmp_path):
    with pytest.raises(BusError, match="'xsens'.*hipnuc"):
        make_world(tmp_path, imu=replace(IMU, protocol="xsens"))
    with pytest.raises(BusError, match="no site 'chest'.*imu"):
        make_world(tmp_path, imu=replace(IMU, site="chest"))


def test_quaternions():
    quarter = (math.sqrt(0.5), 0.0, 0.0, math.sqrt(0.5))  # about z
    assert matrix(quarter) @ [1, 0, 0] == pytest.approx([0, 1, 0])
    assert multiply(quarter, quarter) == pytest.approx((0, 0, 0, 1))
    assert matrix(multiply(quarter, (0, 1, 0, 0))) == pytest.approx(matrix(quarter) @ matrix((0, 1, 0, 0)))
