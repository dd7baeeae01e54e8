"""The codecs of IMUs on serial lines: golden bytes, round trips, damaged streams, and what their twins say of a body."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from sim_robots import BOX, IMU, make_world

from drivers.bus import BusError, ImuSpec
from drivers.codecs import bno085, witmotion
from drivers.open import IMUS, load, open_imu
from drivers.sim.imu import ImuNoise, matrix

SENSORS = [name for name, protocol in IMUS.items() if protocol.sensor]
STEP = {"hipnuc": 1e-6, "witmotion": 2e-4, "bno085": 2e-4}  # of a quaternion's parts, by quantisation


# By the manual's formulas: 1 g = 2048 = 0800, -1000 deg/s = -16384 = C000, 25 deg C = 2500 = 09C4, 0.5 = 16384 = 4000.
def test_witmotion_in_bytes():
    sample = witmotion.Sample(
        np.array([0.0, -0.5, 1.0]) * witmotion.GRAVITY,
        np.deg2rad([500.0, 0.0, -1000.0]),
        np.array([0.5, 0.5, -0.5, 0.5]),
        25.0,
    )
    raw = bytes.fromhex(
        "55 51 00 00 00 FC 00 08 C4 09 77  55 52 00 20 00 00 00 C0 C4 09 54  55 59 00 40 00 40 00 C0 00 40 2E"
    )
    assert witmotion.pack(sample) == raw
    (heard,) = witmotion.Parser().feed(raw)
    for got, expected in zip(heard, sample, strict=True):
        np.testing.assert_allclose(got, expected, atol=1e-12)


def test_witmotion_wants_a_whole_sample():
    raw = witmotion.pack(witmotion.Sample(np.ones(3), np.ones(3), np.array([1.0, 0, 0, 0]), 20.0))
    other = witmotion.frame(0x53, bytes(8))  # angles, which are not read
    parser = witmotion.Parser()
    assert parser.feed(raw[:11] + raw[22:]) == []  # without its angular velocity
    assert len(parser.feed(raw[:11] + other + raw[11:])) == 1 and parser.rejected == 0
    assert parser.feed(raw[22:]) == []


# BNO08X data sheet, 1.3.5.2: "An example complete message and checksum calculation".
EXAMPLE = bytes.fromhex("AA AA DE 01 00 92 FF 25 08 8D FE EC FF D1 03 00 00 00 E7")


def test_the_example_of_the_bno_data_sheet():
    parser = bno085.Parser()
    assert parser.feed(EXAMPLE) == []  # the first: no angular velocity yet
    following = bytearray(EXAMPLE)
    following[2], following[-1] = 0xDF, 0xE8
    (packet,) = parser.feed(bytes(following))
    assert packet.index == 0xDF
    assert np.rad2deg(bno085.angles_of(packet.orientation)) == pytest.approx([0.01, -1.10, 20.85])
    assert packet.acceleration == pytest.approx([-3.638, -0.196, 9.581], abs=1e-3)
    assert packet.angular_velocity == pytest.approx([0.0, 0.0, 0.0])
    acceleration = np.array([-0.371, -0.020, 0.977]) * bno085.GRAVITY
    assert bno085.pack(0xDE, packet.orientation, acceleration) == EXAMPLE


def test_the_bno_has_no_rate_after_a_lost_packet():
    still = np.array([1.0, 0.0, 0.0, 0.0])
    said = [bno085.pack(i, still, np.zeros(3)) for i in (254, 255, 0, 2, 3)]
    assert [p.index for p in bno085.Parser().feed(b"".join(said))] == [255, 0, 3]


angles = st.floats(-3.1, 3.1)


@given(angles, st.floats(-1.5, 1.5), angles)
def test_yaw_pitch_roll_there_and_back(yaw, pitch, roll):
    q = bno085.orientation_of(yaw, pitch, roll)
    assert bno085.angles_of(q) == pytest.approx([yaw, pitch, roll], abs=1e-6)
    c, s = math.cos, math.sin
    z = np.array([[c(yaw), -s(yaw), 0], [s(yaw), c(yaw), 0], [0, 0, 1]])
    y = np.array([[c(pitch), 0, s(pitch)], [0, 1, 0], [-s(pitch), 0, c(pitch)]])
    x = np.array([[1, 0, 0], [0, c(roll), -s(roll)], [0, s(roll), c(roll)]])
    np.testing.assert_allclose(matrix(q), z @ y @ x, atol=1e-9)


@given(angles, st.floats(-1.5, 1.5), angles, st.lists(st.floats(-1, 1), min_size=3, max_size=3))
def test_the_rotation_between_two_orientations(yaw, pitch, roll, turn):
    from drivers.sim.imu import multiply

    before, angle = bno085.orientation_of(yaw, pitch, roll), float(np.linalg.norm(turn))
    axis = np.array(turn) / angle if angle > 1e-6 else np.zeros(3)
    step = (math.cos(angle / 2), *(math.sin(angle / 2) * axis))
    after = np.array(multiply(before.tolist(), step))
    expected = axis * angle
    for sign in (1, -1):  # the same orientation
        np.testing.assert_allclose(bno085.rotation_between(before, sign * after), expected, atol=1e-6)


@pytest.fixture(params=SENSORS)
def imu(request) -> ImuSpec:
    """Of each protocol, as fast as it goes on 921600 baud."""
    return replace(IMU, protocol=request.param, rate=min(500.0, load(IMUS[request.param].sensor).RATE_MAX))


def test_a_turning_body_through_the_driver(tmp_path, imu):
    world = make_world(tmp_path, BOX, imu=imu, imu_noise=ImuNoise(0.0, 0.0, 0.0))
    driver = open_imu(imu, world.imu_wire)
    world.plant.data.qpos[2], world.plant.data.qvel[3:6] = 50.0, (0.0, 0.0, 1.5)
    world.advance(0.2)
    state = driver.read(world.time)
    told = state.orientation_imu_in_world * np.sign(state.orientation_imu_in_world[0])
    late = 1.5 * (1 / imu.rate + 0.005)  # rad: a sample and its time on the line old, at most
    truth = world.plant.orientation_imu_in_world
    np.testing.assert_allclose(told, truth, atol=late / 2 + 10 * STEP[imu.protocol])
    np.testing.assert_allclose(state.angular_velocity_imu_in_imu, [0, 0, 1.5], atol=0.03)
    assert driver.counters.received > 0.15 * imu.rate and driver.counters.rejected == 0


def test_at_rest_gravity_is_up(tmp_path, imu):
    world = make_world(tmp_path, imu=imu, imu_noise=ImuNoise(0.0, 0.0, 0.0))
    world.advance(0.1)
    state = open_imu(imu, world.imu_wire).read(world.time)
    assert state.acceleration_imu_in_imu == pytest.approx([0, 0, 9.81], abs=0.01)


@pytest.mark.parametrize(("kind", "rejected"), [("corrupt", True), ("wrong", False), ("garbage", False)])
def test_faults_of_its_line(tmp_path, imu, kind, rejected):
    world = make_world(tmp_path, imu=imu, faults=[f"{kind}:imu:0.3"], seed=2)
    driver = open_imu(imu, world.imu_wire)
    world.advance(1.0)
    state = driver.read(world.time)
    assert driver.counters.received > 0.3 * imu.rate and np.isfinite(state.orientation_imu_in_world).all()
    assert abs(np.linalg.norm(state.orientation_imu_in_world) - 1) < 0.01
    if rejected:
        assert driver.counters.rejected > 0.1 * imu.rate


def test_a_rate_that_the_sensor_does_not_have(tmp_path):
    with pytest.raises(BusError, match="rate of 500 Hz, expected at most 100: 'bno085' has no more"):
        make_world(tmp_path, imu=replace(IMU, protocol="bno085"))


@given(st.data(), st.sampled_from(SENSORS))
def test_any_stream_in_any_pieces(data, protocol):
    """Cut anywhere and with other bytes in front, packets are found; the same ones, whatever the pieces."""
    sensor = load(IMUS[protocol].sensor)()
    noise = data.draw(st.binary(max_size=40))
    said = b"".join(sensor.pack(0.01 * i, np.array([1.0, 0, 0, 0]), np.zeros(3), np.zeros(3)) for i in range(4))
    stream, cuts = noise + said, sorted(data.draw(st.lists(st.integers(0, len(noise) + len(said)), max_size=6)))
    whole, pieces = load(IMUS[protocol].parser)(), load(IMUS[protocol].parser)()
    together = whole.feed(stream)
    apart = [p for a, b in zip([0, *cuts], [*cuts, len(stream)], strict=True) for p in pieces.feed(stream[a:b])]
    assert len(together) == len(apart) and whole.rejected == pieces.rejected
