"""Mini-cheetah motors and their kin (CubeMars AK, RobStride in MIT mode): golden bytes, who is enabled, and the emulation."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from can_bench import SET_BEFORE, Bench, rig
from hypothesis import given
from hypothesis import strategies as st

from drivers.bus import BusError, MotorCommand, MotorState
from drivers.codecs.cubemars import ERRORS, CubemarsCodec, CubemarsMotors
from drivers.codecs.mini_cheetah import PATIENCE, Kind, MiniCheetahCodec, MiniCheetahMotors
from drivers.codecs.robstride_mit import RobstrideMitCodec, RobstrideMitMotors
from drivers.wire import EXTENDED, make_frames

KIN = {
    "mini_cheetah": (MiniCheetahCodec, MiniCheetahMotors),
    "cubemars": (CubemarsCodec, CubemarsMotors),
    "robstride_mit": (RobstrideMitCodec, RobstrideMitMotors),
}
kin = pytest.mark.parametrize("protocol", KIN)


def hexes(frames: np.ndarray) -> list[str]:
    """As candump has them: identifier#payload."""
    return [f"{int(f['id']):03X}#{f['data'][: f['length']].tobytes().hex().upper()}" for f in frames]


def column(a: float, b: float = 0.0) -> np.ndarray:
    return np.array([a, b], float)


@kin
def test_special_and_zero_frames(protocol):
    """Firmware: enter FC, exit FD; the all-zero command of any symmetric ranges is 7FFF7FF0000007FF."""
    codec, state = KIN[protocol][0](rig(protocol)), MotorState.empty(2)
    ids = [f"{m.id:03X}" for m in rig(protocol).motors]
    assert hexes(codec.pack_enable(state)) == [f"{id}#FFFFFFFFFFFFFFFC" for id in ids]
    assert hexes(codec.pack_disable()) == [f"{id}#FFFFFFFFFFFFFFFD" for id in ids]
    assert hexes(codec.pack_poll(state)) == hexes(codec.pack_disable())
    zero = MotorCommand(*np.zeros((5, 2)))
    assert hexes(codec.pack_command(zero)) == [f"{id}#7FFF7FF0000007FF" for id in ids]


def test_command_bytes_of_an_ak80_9():
    """P 12.5, V 50, T 18: half of full scale is 3/4 of the codes, trunc(0.75 * 65535) = BFFF and trunc(0.75 * 4095) = BFF; kp
    100 and kd 1 are a fifth: 819 = 333."""
    codec, motors = CubemarsCodec(rig("cubemars")), CubemarsMotors(rig("cubemars"))
    frames = codec.pack_command(MotorCommand(column(6.25), column(-25), column(100), column(1), column(9)))
    assert hexes(frames)[0] == "001#BFFF3FF333333BFF"
    rows, kinds = motors.classify(frames)
    assert rows.tolist() == [0, 1] and kinds.tolist() == [Kind.COMMAND] * 2
    heard = motors.unpack_command(frames["data"])
    assert [heard.position[0], heard.velocity[0], heard.kp[0]] == pytest.approx([6.25, -25, 100], abs=0.13)


@pytest.mark.parametrize(
    ("protocol", "position", "temperature", "error", "expected"),
    [
        # id, 3/4, 1/4, 3/4 of the codes; then nothing, [deg C, error], or tenths of deg C: 45.6 = 456 = 01C8.
        ("mini_cheetah", 6.25, 45.6, 0, "000#01BFFF3FFBFF"),
        ("cubemars", 6.25, 45.0, 2, "000#01BFFF3FFBFF2D02"),
        ("cubemars", 6.25, -5.0, 0, "000#01BFFF3FFBFFFB00"),
        ("robstride_mit", 6.285, 45.6, 0, "0FD#01BFFF3FFBFF01C8"),
    ],
)
def test_answer_bytes(protocol, position, temperature, error, expected):
    host, motors = (side(rig(protocol)) for side in KIN[protocol])
    v, t = motors.ranges.velocity[0], motors.ranges.torque[0]
    frames = motors.pack_feedback(
        column(position), column(-v / 2), column(t / 2), column(temperature), np.array([error, 0])
    )
    assert hexes(frames)[0] == expected
    state = MotorState.empty(2)
    assert host.unpack(frames, state, 4.0) == 0
    assert state.position[0] == pytest.approx(position, abs=4e-4)
    assert state.velocity[0] == pytest.approx(-v / 2, abs=v / 2000)
    assert state.torque[0] == pytest.approx(t / 2, abs=t / 2000)
    assert state.error[0] == error
    assert state.time.tolist() == [4.0, 4.0]
    if protocol == "mini_cheetah":
        assert np.isnan(state.temperature).all()
    else:
        assert state.temperature[0] == pytest.approx(temperature)


def test_error_names():
    codec = CubemarsCodec(rig("cubemars"))
    assert [codec.error_name(code) for code in (0, 1, 6, 9)] == [
        "none",
        ERRORS[1],
        "phase unbalance",
        "unknown error 9",
    ]


@kin
def test_a_motor_is_enabled_once_it_answered_everything(protocol):
    """Neither an answer to the command nor one to the enable frame alone tells that the latter arrived."""
    host, motors = (side(rig(protocol)) for side in KIN[protocol])
    state, answers = MotorState.empty(2), motors.pack_feedback(*np.zeros((3, 2)))
    zero = MotorCommand(*np.zeros((5, 2)))
    host.unpack(answers, state, 0.0)
    assert not state.enabled.any()
    for _ in range(2):
        host.pack_enable(state)
        host.pack_command(zero)
        host.unpack(answers[[0, 1, 1]], state, 0.0)  # one of the two frames to the first motor was lost
        assert state.enabled.tolist() == [False, True]
    host.pack_disable()
    host.unpack(answers, state, 0.0)
    assert not state.enabled.any()


@kin
def test_a_motor_that_falls_silent_counts_as_disabled_when_it_comes_back(protocol):
    host, motors = (side(rig(protocol)) for side in KIN[protocol])
    state, answers = MotorState.empty(2), motors.pack_feedback(*np.zeros((3, 2)))
    zero = MotorCommand(*np.zeros((5, 2)))
    host.pack_enable(state)
    host.unpack(answers, state, 0.0)
    for k in range(PATIENCE + 1):
        host.pack_command(zero)
        host.unpack(answers[1:], state, k)
        assert state.enabled.tolist() == [k < PATIENCE, True]
    host.unpack(answers, state, 9.0)
    assert state.enabled.tolist() == [False, True]


@pytest.mark.parametrize(
    ("id", "first", "length"),
    [(0x001, 1, 8), (0x000, 9, 8), (0x000, 1, 5), (EXTENDED, 1, 8)],
)
def test_strangers_are_counted_and_change_nothing(id, first, length):
    host, state = CubemarsCodec(rig("cubemars")), MotorState.empty(2)
    frame = make_frames(np.array([id], np.uint32), np.full((1, 8), first, np.uint8), length)
    assert host.unpack(frame, state, 1.0) == 1
    assert np.isneginf(state.time).all()


@kin
@given(values=st.lists(st.floats(allow_nan=False, allow_infinity=False, width=32), min_size=5, max_size=5))
def test_a_command_is_a_command_for_the_motor(protocol, values):
    host, motors = (side(rig(protocol)) for side in KIN[protocol])
    frames = host.pack_command(MotorCommand(*(np.full(2, x) for x in values)))
    assert motors.classify(frames)[1].tolist() == [Kind.COMMAND] * 2
    again = host.pack_command(motors.unpack_command(frames["data"]))
    assert hexes(again) == hexes(frames)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"id": 0x100}, "got id 0x100, expected 0x1 to 0xff"),
        ({"feedback_id": 2}, "answers on 0x2, where the motor of right listens for commands"),
        ({"feedback_id": 1}, "answers on 0x1, where the motor of left listens for commands"),
    ],
)
def test_refused_identifiers(change, message):
    spec = rig("cubemars")
    with pytest.raises(BusError, match=message):
        CubemarsCodec(replace(spec, motors=(replace(spec.motors[0], **change), spec.motors[1])))


def test_a_robstride_has_other_ranges_in_each_protocol():
    """An RS03 commanded with the private protocol's 20 rad/s would be scaled wrongly by 65 %."""
    from drivers.codecs import robstride

    mit = RobstrideMitCodec.MODELS
    assert (robstride.MODELS["RS03"].velocity, mit["RS03"].velocity) == (20, 33)
    assert (robstride.MODELS["RS03"].kp, mit["RS03"].kp) == (5000, 500)


# Emulated motors


def test_expiry_is_limp_and_the_next_command_takes_it_up(tmp_path):
    bench = Bench(tmp_path, "cubemars", registers=SET_BEFORE["cubemars"])
    bench.enable()
    bench.run(0.02, position=1.0, kp=5.0, kd=0.1)
    while bench.world.time < 0.2:
        bench.tick()
    assert (bench.torque == 0.0).all()
    assert [e.event for e in bench.world.motor_log if e.joint == "left"][-1] == "watchdog"
    bench.run(0.02, position=bench.world.plant.joint_pos + 1, kp=5.0)
    assert (bench.torque > 1.0).all()


def test_position_comes_back_in_from_the_other_end(tmp_path):
    bench = Bench(tmp_path, "cubemars")
    bench.world.plant.data.qpos[0] = 13.0
    assert bench.poll(0.02).position[0] == pytest.approx(13.0 - 25.0, abs=1e-3)


def test_a_hot_ak_motor_stops_and_says_so(tmp_path):
    bench = Bench(tmp_path, "cubemars")
    bench.enable()
    bench.world.motors.driver_temperature[1] = 125.0
    state = bench.run(0.1, kd=0.5)
    assert bench.bus.error_name(int(state.error[1])) == "over-temperature"
    assert state.enabled.tolist() == [True, False]
