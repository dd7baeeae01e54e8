"""The codecs of IMUs on serial lines: golden bytes, round trips, damaged streams, and what their twins say of a body."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from sim_robots import BOX, IMU, make_world

from drivers.bus import BusError, ImuSpec, ImuState
from drivers.codecs import bno085, bno085_shtp, witmotion
from drivers.codecs.bno085_shtp import Channel, Report
from drivers.open import IMUS, load, open_imu
from drivers.sim.imu import ImuNoise, matrix

SENSORS = [name for name, protocol in IMUS.items() if protocol.sensor]
STEP = {
    "hipnuc": 1e-6,
    "witmotion": 2e-4,
    "bno085": 2e-4,
    "bno085_shtp": 2e-4,
}  # of a quaternion's parts, by quantisation


UNCHECKED = ("bno085_shtp",)  # nothing on the line tells a damaged value


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


def listen(world, driver, seconds: float) -> ImuState:
    """As a host does, every 2 ms."""
    for _ in range(round(seconds / 0.002)):
        world.advance(world.time + 0.002)
        state = driver.read(world.time)
    return state


def opened(world, imu: ImuSpec):
    """Its driver, once it has set the sensor up."""
    driver = open_imu(imu, world.imu_wire)
    if hasattr(load(IMUS[imu.protocol].parser), "ask"):
        listen(world, driver, 0.5)
    driver.counters.received = 0
    return driver


def test_a_turning_body_through_the_driver(tmp_path, imu):
    world = make_world(tmp_path, BOX, imu=imu, imu_noise=ImuNoise(0.0, 0.0, 0.0))
    driver = opened(world, imu)
    world.plant.data.qpos[2], world.plant.data.qvel[3:6] = 50.0, (0.0, 0.0, 1.5)
    state = listen(world, driver, 0.2)
    told = state.orientation_imu_in_world * np.sign(state.orientation_imu_in_world[0])
    late = 1.5 * (1 / imu.rate + 0.005)  # rad: a sample and its time on the line old, at most
    truth = world.plant.orientation_imu_in_world
    np.testing.assert_allclose(told, truth, atol=late / 2 + 10 * STEP[imu.protocol])
    np.testing.assert_allclose(state.angular_velocity_imu_in_imu, [0, 0, 1.5], atol=0.03)
    assert driver.counters.received > 0.15 * imu.rate and driver.counters.rejected == 0


def test_at_rest_gravity_is_up(tmp_path, imu):
    world = make_world(tmp_path, imu=imu, imu_noise=ImuNoise(0.0, 0.0, 0.0))
    state = listen(world, opened(world, imu), 0.1)
    assert state.acceleration_imu_in_imu == pytest.approx([0, 0, 9.81], abs=0.01)


@pytest.mark.parametrize(("kind", "rejected"), [("corrupt", True), ("wrong", False), ("garbage", False)])
def test_faults_of_its_line(tmp_path, imu, kind, rejected):
    world = make_world(tmp_path, imu=imu, faults=[f"{kind}:imu:0.3"], seed=2)
    driver = opened(world, imu)
    state = listen(world, driver, 1.0)
    assert driver.counters.received > 0.3 * imu.rate and np.isfinite(state.orientation_imu_in_world).all()
    assert abs(np.linalg.norm(state.orientation_imu_in_world) - 1) < 0.01
    if rejected and imu.protocol not in UNCHECKED:
        assert driver.counters.rejected > 0.1 * imu.rate


def test_a_rate_that_the_sensor_does_not_have(tmp_path):
    with pytest.raises(BusError, match="rate of 500 Hz, expected at most 100: 'bno085' has no more"):
        make_world(tmp_path, imu=replace(IMU, protocol="bno085"))


def awake(protocol: str):
    """A sensor that sends samples."""
    sensor = load(IMUS[protocol].sensor)()
    if hasattr(sensor, "hear"):
        sensor.pack(0.0, (1, 0, 0, 0), (0, 0, 0), (0, 0, 0))  # its greeting
        for report in bno085_shtp.WANTED:
            sensor.hear(bno085_shtp.pack(Channel.CONTROL, 0, bno085_shtp.pack_feature(report, 0.0025)))
    return sensor


# BNO08X data sheet, figure 5-1: "set feature report (accelerometer)" with a period of 60 ms, on the control channel; figure
# 1-28: the question for the product; figure 5-2: time base and accelerometer report; and in each 7E 01 ... 7E around it.
def test_shtp_in_bytes():
    feature = bno085_shtp.pack_feature(Report.ACCELERATION, 0.06)
    assert bno085_shtp.pack(Channel.CONTROL, 0, feature).hex(" ") == (
        "7e 01 15 00 02 00 fd 01 00 00 00 60 ea 00 00 00 00 00 00 00 00 00 00 7e"
    )
    assert bno085_shtp.pack(Channel.CONTROL, 1, b"\xf9\x00").hex(" ") == "7e 01 06 00 02 01 f9 00 7e"
    assert bno085_shtp.ROOM.hex(" ") == "7e 00 7e"  # ceva-dsp's uart_hal.c: flag, control, flag
    sample = bno085_shtp.Sample(
        np.array([1.0, -0.5, 9.8125]), np.array([0.5, 0, -2.0]), np.array([0.5, 0.5, -0.5, 0.5])
    )
    raw = bytes.fromhex(
        "7E 01 29 00 03 07  FB 00 00 00 00  01 05 03 00 00 01 80 FF D0 09  02 05 03 00 00 01 00 00 00 FC"
        "08 05 03 00 00 20 00 E0 00 20 00 20  7E"
    )
    assert bno085_shtp.pack(Channel.REPORTS, 7, bno085_shtp.pack_reports(sample, 5)) == raw
    (heard,) = bno085_shtp.Parser().feed(raw)
    for got, expected in zip(heard, sample, strict=True):
        np.testing.assert_allclose(got, expected, atol=1e-12)


def test_shtp_escapes_its_flags():
    raw = bno085_shtp.pack(Channel.CONTROL, 0x7E, bytes([0x7D, 1, 0x7E, 0x5E]))
    assert raw.hex(" ") == "7e 01 08 00 02 7d 5e 7d 5d 01 7d 5e 5e 7e"
    framer = bno085_shtp.Framer()
    assert list(framer.feed(raw)) == [(Channel.CONTROL, bytes([0x7D, 1, 0x7E, 0x5E]))] and framer.rejected == 0


@pytest.mark.parametrize(
    "raw",
    ["7E 01 06 80 02 00 F9 00 7E", "7E 01 07 00 02 00 F9 00 7E", "7E 01 04 00 02 00 7E", "7E 02 06 00 02 00 F9 00 7E",
     "7E 01 06 00 02 00 F9 7D 7E", "7E 00 01 7E"],
)  # fmt: skip
def test_shtp_refuses_what_is_no_packet(raw):
    framer = bno085_shtp.Framer()
    assert list(framer.feed(bytes.fromhex(raw))) == [] and framer.rejected == 1
    assert len(list(framer.feed(bytes.fromhex("7E 01 06 00 02 00 F9 00 7E")))) == 1


def test_shtp_loses_no_more_than_what_is_damaged():
    sensor, parser = awake("bno085_shtp"), bno085_shtp.Parser()
    said = [sensor.pack(0.01 * k, (1, 0, 0, 0), (0, 0, 0), (0, 0, 9.8)) for k in range(1, 5)]
    unknown = bno085_shtp.pack(Channel.REPORTS, 0, bytes([0x99, 0, 0, 0]))
    heard = parser.feed(said[0] + said[1][:20] + said[2] + unknown + b"\x00" * 2000 + said[3])
    assert len(heard) == 3 and parser.rejected == 3
    assert len(parser.feed(b"\x7e" + b"\x01" * 2000)) == 0 and parser.rejected == 4


SHTP = replace(IMU, protocol="bno085_shtp", rate=200.0, baud=3_000_000)


def test_shtp_sets_its_sensor_up_a_byte_at_a_time_and_again_after_a_reset(tmp_path):
    world = make_world(tmp_path, imu=SHTP, imu_noise=ImuNoise(0.0, 0.0, 0.0))
    written: list[tuple[float, bytes]] = []
    write = world.imu_wire.write
    world.imu_wire.write = lambda data: (written.append((world.time, data)), write(data))[1]
    driver = open_imu(SHTP, world.imu_wire)
    assert np.isneginf(listen(world, driver, 0.1).time)
    assert listen(world, driver, 0.4).time > 0.49
    assert {len(data) for _, data in written} == {1} and min(np.diff([t for t, _ in written])) >= 100e-6
    packets = list(bno085_shtp.Framer().feed(b"".join(data for _, data in written)))
    asked = [np.frombuffer(p.cargo, bno085_shtp.FEATURE)[0] for p in packets if p.channel == Channel.CONTROL]
    assert [(f["feature"], f["interval"]) for f in asked] == [(r, 5000) for r in bno085_shtp.WANTED]
    assert sum(p == (-1, b"") for p in packets) == 3  # before each, whether there is room
    count, driver.counters.received = len(written), 0
    listen(world, driver, 0.5)
    assert driver.counters.received == pytest.approx(100, abs=2) and len(written) == count
    world.imu._sensor._intervals.clear()  # it was without power
    world.imu._sensor._greeting = True
    heard = listen(world, driver, 0.5).time
    assert world.time - heard < 0.01 and len(written) > count


def test_shtp_leaves_its_sensor_time_between_bytes():
    parser, said = bno085_shtp.Parser(), []
    for k in range(2000):  # asked every 10 us
        if parser.ask(1.0 + 1e-5 * k, 100.0):
            said.append(k)
    assert said and min(np.diff(said)) >= 10


def test_shtp_asks_again_whom_it_does_not_hear(tmp_path):
    """A reset that it did not hear of: the greeting was lost."""
    world = make_world(tmp_path, imu=SHTP)
    driver = opened(world, SHTP)
    world.imu._sensor._intervals.clear()
    heard = listen(world, driver, 0.5).time
    assert world.time - heard > 0.4
    heard = listen(world, driver, 1.5).time
    assert world.time - heard < 0.01


@given(st.data(), st.sampled_from(SENSORS))
def test_any_stream_in_any_pieces(data, protocol):
    """Cut anywhere and with other bytes in front, packets are found; the same ones, whatever the pieces."""
    sensor = awake(protocol)
    noise = data.draw(st.binary(max_size=40))
    said = b"".join(sensor.pack(0.01 * i, np.array([1.0, 0, 0, 0]), np.zeros(3), np.zeros(3)) for i in range(4))
    stream, cuts = noise + said, sorted(data.draw(st.lists(st.integers(0, len(noise) + len(said)), max_size=6)))
    whole, pieces = load(IMUS[protocol].parser)(), load(IMUS[protocol].parser)()
    together = whole.feed(stream)
    apart = [p for a, b in zip([0, *cuts], [*cuts, len(stream)], strict=True) for p in pieces.feed(stream[a:b])]
    assert len(together) == len(apart) and whole.rejected == pieces.rejected
