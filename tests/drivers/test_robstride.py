"""RobStride's private protocol: golden bytes of every message, identifiers, and what its emulated motors do by themselves."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from can_bench import Bench, rig
from hypothesis import given
from hypothesis import strategies as st

from drivers.bus import BusError, MotorCommand, MotorSpec, MotorState
from drivers.codecs import robstride
from drivers.codecs.robstride import MODELS, RobstrideCodec, RobstrideMotors, Type
from drivers.wire import EXTENDED, make_frames


def payload(text: str) -> np.ndarray:
    return np.frombuffer(bytes.fromhex(text), np.uint8)


def hexes(frames: np.ndarray) -> list[tuple[str, str]]:
    assert (frames["id"] & EXTENDED).all() and (frames["length"] == 8).all()
    return [(f"{int(f['id']) & ~EXTENDED:08X}", f["data"].tobytes().hex(" ")) for f in frames]


def column(a: float, b: float = 0.0) -> np.ndarray:
    return np.array([a, b], float)


# The first line and its answer are the example of the makers' manuals (RS00 to RS06, "read parameter"); the others are
# put together by hand from its tables: type << 24 | 0xFD << 8 | motor, index and value little-endian.
def test_read_and_write_of_parameters():
    codec = RobstrideCodec(rig("robstride"))
    assert hexes(codec.pack_register(1, "loc_kp")) == [("1100FD7F", "1e 70 00 00 00 00 00 00")]
    answer = make_frames(np.array([EXTENDED | 0x11007FFD]), payload("1e 70 00 00 00 00 f0 41")[None])
    assert codec.unpack_registers(answer) == [(1, "loc_kp", 30.0, False)]
    assert hexes(RobstrideMotors(rig("robstride")).pack_parameter(1, robstride.pack_parameter("loc_kp", 30.0))) == [
        ("11007FFD", "1e 70 00 00 00 00 f0 41")
    ]
    assert hexes(codec.pack_register(0, "canTimeout", 1600)) == [("1200FD01", "28 70 00 00 40 06 00 00")]
    assert hexes(codec.pack_register(0, "zero_sta", 1)) == [("1200FD01", "29 70 00 00 01 00 00 00")]
    assert hexes(codec.pack_register(0, "run_mode", 0)) == [("1200FD01", "05 70 00 00 00 00 00 00")]
    assert hexes(codec.pack_register(0, "limit_torque", 12.0)) == [("1200FD01", "0b 70 00 00 00 00 40 41")]


def test_a_read_that_failed_is_not_a_value():
    failed = make_frames(np.array([EXTENDED | 0x11017FFD]), payload("28 70 00 00 40 06 00 00")[None])
    (answer,) = RobstrideCodec(rig("robstride")).unpack_registers(failed)
    assert answer[:2] == (1, "canTimeout") and np.isnan(answer.value)


def test_enable_stop_and_clear():
    codec, state = RobstrideCodec(rig("robstride")), MotorState.empty(2)
    enable = [("0300FD01", "00 00 00 00 00 00 00 00"), ("0300FD7F", "00 00 00 00 00 00 00 00")]
    assert hexes(codec.pack_enable(state)) == enable
    assert hexes(codec.pack_disable()) == [(id.replace("03", "04", 1), data) for id, data in enable]
    state.error[1] = 1 << 20
    assert hexes(codec.pack_enable(state)) == [("0400FD7F", "01 00 00 00 00 00 00 00"), *enable]


def test_operation_bytes():
    """RS03: position +-4 pi, velocity +-20, torque +-60, kp 5000, kd 100. A quarter of full scale is 3/4 of the code
    range: trunc(0.75 * 65535) = 49151 = BFFF; kp 1250 and kd 25 are a quarter: 16383 = 3FFF; zero: 32767 = 7FFF."""
    codec, motors = RobstrideCodec(rig("robstride")), RobstrideMotors(rig("robstride"))
    command = MotorCommand(column(2 * np.pi), column(-10), column(1250), column(25), column(30))
    frames = codec.pack_command(command)
    assert hexes(frames) == [
        ("01BFFF01", "bf ff 3f ff 3f ff 3f ff"),  # 16 bits of the identifier are the torque
        ("017FFF7F", "7f ff 7f ff 00 00 00 00"),
    ]
    rows, types = motors.classify(frames)
    assert rows.tolist() == [0, 1] and types.tolist() == [Type.OPERATION] * 2
    heard = motors.unpack_command(frames, rows)
    for name, lsb in zip(MotorCommand.__slots__, (8 * np.pi, 40, 5000, 100, 120), strict=True):
        np.testing.assert_allclose(getattr(heard, name), getattr(command, name), atol=lsb / 65535)


def test_feedback_bytes():
    """Mode 2 (run) in bits 22 and 23, fault bits in 16 to 21, 25.6 deg C = 256 tenths = 0100."""
    codec, motors, state = RobstrideCodec(rig("robstride")), RobstrideMotors(rig("robstride")), MotorState.empty(2)
    frames = motors.pack_feedback(
        column(2 * np.pi), column(-10), column(30), column(25.6, 40.0), np.array([0, 0b000101]), np.array([2, 0])
    )
    assert hexes(frames) == [("028001FD", "bf ff 3f ff bf ff 01 00"), ("02057FFD", "7f ff 7f ff 7f ff 01 90")]
    assert codec.unpack(frames, state, 7.0) == 0
    np.testing.assert_allclose(state.position, [2 * np.pi, 0], atol=4e-4)
    np.testing.assert_allclose(state.velocity, [-10, 0], atol=1e-3)
    np.testing.assert_allclose(state.torque, [30, 0], atol=2e-3)
    assert state.temperature.tolist() == [25.6, 40.0]
    assert state.enabled.tolist() == [True, False]
    assert [codec.error_name(int(e)) for e in state.error] == ["none", "under-voltage, over-temperature"]
    assert state.time.tolist() == [7.0, 7.0]


def test_active_reports_count_as_feedback():
    """Type 24 with the payload of type 2: drivers that take only the latter lose them."""
    codec, motors, state = RobstrideCodec(rig("robstride")), RobstrideMotors(rig("robstride")), MotorState.empty(2)
    zero = np.zeros(2)
    frames = motors.pack_feedback(column(1, 2), zero, zero, zero, np.zeros(2, int), np.array([2, 2]), Type.REPORT)
    assert hexes(frames)[0][0] == "188001FD"
    assert codec.unpack(frames, state, 1.0) == 0
    np.testing.assert_allclose(state.position, [1, 2], atol=4e-4)


def test_fault_frames_stay_until_enabling_clears_them():
    codec, motors, state = RobstrideCodec(rig("robstride")), RobstrideMotors(rig("robstride")), MotorState.empty(2)
    fault = motors.pack_fault(1, 1 << 14 | 1 << 3)
    assert hexes(fault) == [("15007FFD", "08 40 00 00 00 00 00 00")]
    zero = np.zeros(2)
    healthy = motors.pack_feedback(zero, zero, zero, zero, np.zeros(2, int), np.zeros(2, int))
    codec.unpack(fault, state, 1.0)
    assert np.isneginf(state.time).all()  # it says nothing of the motion
    codec.unpack(healthy, state, 1.0)
    assert [codec.error_name(int(e)) for e in state.error] == ["none", "over-voltage, stall (I2t)"]
    codec.pack_enable(state)
    codec.unpack(healthy, state, 2.0)
    assert state.error.tolist() == [0, 0]


def test_the_serial_of_a_chip_is_the_answer_to_get_id():
    """Type 0 with the host in data, answered as type 0 to 0xFE with the 64 bits (the maker's manual, "Obtain device ID")."""
    codec = RobstrideCodec(rig("robstride"))
    assert hexes(codec.pack_register(0, robstride.UID)) == [("0000FD01", "00 00 00 00 00 00 00 00")]
    answer = RobstrideMotors(rig("robstride")).pack_uid(1, 0x1122334455667788)
    assert hexes(answer) == [("00007FFE", "88 77 66 55 44 33 22 11")]
    assert codec.unpack_registers(answer) == [(1, robstride.UID, 0x1122334455667788, False)]


@pytest.mark.parametrize(
    ("change", "id", "length"),
    [
        ("another motor", EXTENDED | 0x028002FD, 8),
        ("another host", EXTENDED | 0x028001FE, 8),
        ("another host's command", EXTENDED | 0x01800101, 8),
        ("an id request", EXTENDED | 0x0000FD01, 8),
        ("a standard frame", 0x0FD, 8),
        ("too short", EXTENDED | 0x028001FD, 7),
    ],
)
def test_strangers_are_counted_and_change_nothing(change, id, length):
    codec, state = RobstrideCodec(rig("robstride")), MotorState.empty(2)
    frame = make_frames(np.array([id], np.uint32), np.full((1, 8), 0x55, np.uint8), length)
    assert codec.unpack(frame, state, 1.0) == 1
    assert codec.owners(frame).tolist() == [-1]
    assert codec.unpack_registers(frame) == []
    assert np.isneginf(state.time).all()


@pytest.mark.parametrize("model", MODELS)
@given(st.lists(st.floats(-1, 1), min_size=5, max_size=5))
def test_round_trip_of_commands(model, values):
    spec = replace(rig("robstride"), motors=(MotorSpec("left", model, 1), MotorSpec("right", model, 2)))
    m = MODELS[model]
    full = np.array([robstride.FULL_TURNS, m.velocity, m.kp, m.kd, m.torque])
    asked = np.array(values) * full
    asked[2:4] = abs(asked[2:4])
    frames = RobstrideCodec(spec).pack_command(MotorCommand(*(np.full(2, x) for x in asked)))
    heard = RobstrideMotors(spec).unpack_command(frames, np.array([0, 1]))
    got = np.array([getattr(heard, name)[1] for name in MotorCommand.__slots__])
    assert (abs(got - asked) <= 2 * full / 65535 * 1.001).all()
    again = RobstrideCodec(spec).pack_command(heard)
    assert hexes(again) == hexes(frames)


def test_out_of_range_saturates():
    frames = RobstrideCodec(rig("robstride")).pack_command(
        MotorCommand(column(99, -99), column(99, -99), column(1e9, -1), column(1e9, -1), column(1e9, -1e9))
    )
    assert hexes(frames) == [("01FFFF01", "ff " * 7 + "ff"), ("0100007F", "00 " * 7 + "00")]


@pytest.mark.parametrize(
    ("motor", "message"),
    [
        (MotorSpec("left", "RS03", 0), "got id 0x0, expected 0x1 to 0x7f"),
        (MotorSpec("left", "RS03", 0x80), "got id 0x80, expected"),
        (MotorSpec("left", "RS03", 1, 0x11), "got feedback_id 0x11, expected none: it answers the host, 0xfd"),
    ],
)
def test_refused_identifiers(motor, message):
    with pytest.raises(BusError, match=message):
        RobstrideCodec(replace(rig("robstride"), motors=(motor,)))


# Emulated motors


def test_power_on_within_0_and_two_pi_is_refused(tmp_path):
    """Factory setting: a joint at -0.2 says 6.08."""
    bench = Bench(tmp_path, "robstride", connect=False, joint_pos={"left": -0.2}, registers={"left": {"zero_sta": 0}})
    with pytest.raises(BusError, match=r"motor of left .*zero_sta is 0, expected 1\n.*a turn away"):
        bench.bus.connect(bench.clock)
    assert bench.poll(0.02).position[0] == pytest.approx(2 * np.pi - 0.2, abs=1e-3)


def test_another_model_is_refused_by_its_torque(tmp_path):
    bench = Bench(tmp_path, "robstride", connect=False, registers={"right": {"limit_torque": 17.0}})
    with pytest.raises(BusError, match="motor of right .*limit_torque is 17, expected 60"):
        bench.bus.connect(bench.clock)


def test_connecting_programs_the_watchdog_and_reads_it_back(tmp_path):
    bench = Bench(tmp_path, "robstride", spec=rig("robstride", watchdog=0.08))
    assert [bench.world.motors.register(joint, "canTimeout") for joint in ("left", "right")] == [1600, 1600]


def test_position_comes_back_in_from_the_other_end(tmp_path):
    bench = Bench(tmp_path, "robstride")
    bench.world.plant.data.qpos[0] = 4 * np.pi + 0.5
    assert bench.poll(0.02).position[0] == pytest.approx(-4 * np.pi + 0.5, abs=1e-3)


def test_a_power_cycle_loses_turns(tmp_path):
    bench = Bench(tmp_path, "robstride", faults=["reboot:arm/left=0.1@0.5"])
    bench.world.plant.data.qpos[0] = 3.3
    assert bench.poll(0.2).position[0] == pytest.approx(3.3, abs=1e-3)
    bench.poll(0.5)
    assert bench.poll(0.1).position[0] == pytest.approx(3.3 - 2 * np.pi, abs=1e-3)
    # And its watchdog is back at what the flash holds; polling writes it anew.
    assert bench.world.motors.register("left", "canTimeout") == 1000


def test_parameters_of_the_moment(tmp_path):
    bench = Bench(tmp_path, "robstride", joint_pos={"right": 0.75})
    codec = RobstrideCodec(bench.spec)
    wire = bench.world.wires["arm"]
    wire.send(np.concatenate([codec.pack_register(1, "mechPos"), codec.pack_register(1, "VBUS")]))
    bench.world.advance(bench.world.time + 0.01)
    position, voltage = codec.unpack_registers(wire.recv())
    assert position.value == pytest.approx(0.75, abs=1e-6) and voltage.value == 48.0


def test_a_hot_motor_stops_and_says_so(tmp_path):
    bench = Bench(tmp_path, "robstride")
    bench.enable()
    bench.world.motors.rotor_temperature[0] = 150.0
    state = bench.run(0.1, kd=0.5)
    assert state.enabled.tolist() == [False, True]
    assert bench.bus.error_name(int(state.error[0])) == "over-temperature"
    assert state.temperature[0] > 100.0
