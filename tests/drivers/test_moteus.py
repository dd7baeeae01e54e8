"""moteus frames: golden bytes, round trips, the console, and who is commanded."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from can_bench import Bench, rig
from hypothesis import given
from hypothesis import strategies as st

from drivers.bus import BusError, MotorCommand, MotorState
from drivers.codecs import moteus, moteus_frame
from drivers.codecs.moteus import TURN, Answers, Gains, Mode, MoteusCodec, Register
from drivers.codecs.moteus_frame import (
    CONSOLE_SAYS,
    READ,
    REPLY,
    Resolution,
    Subframe,
    console,
    subframes,
)
from drivers.wire import EXTENDED, make_fd_frames
from sim2real.bringup.observe import observers

GAINS = Gains(np.array([40.0, 20.0]), np.array([2.0, 1.0]), np.array([2.0, 3.0]))
COMMAND = MotorCommand(
    *(np.array([a, 0.0]) for a in (0.5 * TURN, -0.25 * TURN, 20 / TURN, 0.5 / TURN, 0.25))
)  # half of kp, a quarter of kd


# By hand from the reference: 01 00 0A writes mode 10; 0C 06 20 six floats from register 020; 0D 27 one float to 027; 02 28 two
# bytes of -1 from 028; 11 00, 1F 01 and 12 0E ask for mode, three floats from 001, and two bytes from 00E. 0.08f = 3DA3D70A.
def test_command_bytes():
    assert moteus.pack_command(COMMAND, GAINS, 0.08)[0].tobytes().hex(" ") == (
        "01 00 0a 0c 06 20 00 00 00 3f 00 00 80 be 00 00 80 3e 00 00 00 3f 00 00 80 3e 00 00 00 40 "
        "0d 27 0a d7 a3 3d 02 28 ff ff 11 00 1f 01 12 0e 50 50"
    )
    assert moteus.pad(moteus.STOP).hex(" ") == "01 00 00 11 00 1f 01 12 0e 50 50 50"


def test_answer_bytes():
    one = lambda x: np.array([x])  # noqa: E731
    answers = Answers(one(10), one(0.5 * TURN), one(-0.25 * TURN), one(0.25), one(41.0), one(38))
    data = moteus.pack_answer(answers)
    assert data.tobytes().hex(" ") == "21 00 0a 2f 01 00 00 00 3f 00 00 80 be 00 00 80 3e 22 0e 29 26 50 50 50"
    heard, sound = moteus.unpack_answer(data)
    assert sound.tolist() == [True]
    for got, expected in zip(heard, answers, strict=True):
        assert got == pytest.approx(expected)
    name = MoteusCodec(rig("moteus")).error_name
    assert [name(code) for code in (38, 0, 98, 77)] == ["over-temperature", "none", "limited", "unknown fault 77"]


# 1B: three int32 are asked for, from register 120 (A0 02); 2B answers them, the low word first.
def test_serial_number_bytes():
    codec = MoteusCodec(rig("moteus"))
    (frame,) = codec.pack_register(0, moteus.SERIAL)
    assert frame["data"][: frame["length"]].tobytes().hex(" ") == "1b a0 02"
    said = bytes.fromhex("2b a0 02 04 03 02 01 08 07 06 05 0c 0b 0a 09")
    answer = moteus.MoteusMotors(rig("moteus")).pack(0, moteus.HOST, said)
    (told,) = codec.unpack_registers(answer)
    assert told == (0, "serial_number", 0x090A0B0C_05060708_01020304, False)
    assert moteus_frame.serial_number(b"\x21\x00\x0a") is None


def test_after_power_on_a_turn_of_the_rotor_is_unknown():
    assert all(MoteusCodec.TURN == pytest.approx(model.ratio * TURN) for model in moteus.MODELS.values())


def test_identifiers():
    assert moteus.identifier(0, 1, reply=True) == 0x8001 | EXTENDED
    assert moteus.identifier(1, 0) == 0x100 and moteus.identifier(8, 0) == 0x800 | EXTENDED


@given(st.lists(st.floats(-1, 1), min_size=5, max_size=5))
def test_round_trip_of_commands(values):
    full = np.array([50.0, 100.0, 20 / TURN, 1 / TURN, 2.0])
    p, v, kp, kd, t = np.array(values) * full
    asked = MotorCommand(*(np.full(2, x) for x in (p, v, abs(kp), abs(kd), t)))
    heard, most, timeout = moteus.unpack_command(moteus.pack_command(asked, GAINS, 0.05), GAINS)
    for name, scale in zip(MotorCommand.__slots__, full, strict=True):
        np.testing.assert_allclose(getattr(heard, name), getattr(asked, name), atol=1e-6 * scale)
    assert most.tolist() == [2.0, 3.0] and timeout == pytest.approx([0.05, 0.05])


def test_out_of_range_saturates_and_nothing_is_left_out():
    wild = MotorCommand(*(np.array([x, -x]) for x in (1e9, 1e9, 1e9, 1e9, 1e9)))
    heard, _, _ = moteus.unpack_command(moteus.pack_command(wild, GAINS, 0.05), GAINS)
    assert heard.kp == pytest.approx([40 / TURN, 0.0]) and heard.torque.tolist() == [2.0, -3.0]
    for quantity in MotorCommand.__slots__:
        broken = MotorCommand(*np.zeros((5, 2)))
        setattr(broken, quantity, np.array([0.0, np.nan]))  # on the wire it would mean "not commanded"
        with pytest.raises(ValueError, match=f"motor 1 .*{quantity} nan"):
            moteus.pack_command(broken, GAINS, 0.05)
    with pytest.raises(ValueError, match="timeout nan"):
        moteus.pack_command(COMMAND, GAINS, float("nan"))


@pytest.mark.parametrize("at", [0, 1, 3, 4, 17, 18])
def test_an_answer_to_something_else_is_not_taken(at):
    data = moteus.pack_answer(Answers(*np.zeros((6, 2))))
    data[1, at] ^= 1
    assert moteus.unpack_answer(data)[1].tolist() == [True, False]


def test_registers_of_a_payload():
    found = moteus_frame.registers_of(moteus.pack_command(COMMAND, GAINS, 0.08)[0].tobytes())
    assert found[Register.MODE] is None  # asked for, after it was written
    assert found[Register.COMMAND_POSITION] == 0.5 and found[Register.COMMAND_TIMEOUT] == pytest.approx(0.08)
    for payload, message in (
        ("0c06200000", "expected 24 more"),
        ("32", "0x32 at byte 0"),
        ("14ffffffffff01", "more than 5"),
    ):
        with pytest.raises(ValueError, match=message):
            moteus_frame.registers_of(bytes.fromhex(payload))


@given(st.binary(max_size=64))
def test_any_payload_is_parsed_or_refused(payload):
    try:
        moteus_frame.registers_of(payload)
    except ValueError as error:
        assert payload.hex() in str(error)
    data = np.frombuffer(payload.ljust(64, b"\0")[:24], np.uint8)[None]
    answers, sound = moteus.unpack_answer(data)
    assert not sound[0] or np.isfinite(answers.position[0])


# docs/protocol/can.md, "Example": a command and its answer, with what they mean.
def test_the_examples_of_the_reference():
    asked = list(subframes(bytes.fromhex("01000a07206000200150ff140400130d")))
    assert [s.values for s in asked[:2]] == [(10,), (96, 288, -176)]
    assert asked[2:] == [Subframe(READ, 0, 4, Resolution.INT16), Subframe(READ, 0xD, 3)]
    found = moteus_frame.registers_of(bytes.fromhex("01000a07206000200150ff140400130d"))
    assert found[Register.COMMAND_POSITION] == pytest.approx(0.0096)  # 3.456 degrees
    assert found[Register.COMMAND_VELOCITY] == pytest.approx(25.92 / 360)
    assert found[Register.COMMAND_TORQUE] == pytest.approx(-1.76)
    answer = bytes.fromhex("2404000a005000000170ff230d181400")
    found = moteus_frame.registers_of(answer)
    assert found[Register.MODE] == 10 and found[Register.POSITION] == pytest.approx(2.88 / 360)
    assert found[Register.TORQUE] == pytest.approx(-1.44) and found[Register.VOLTAGE] == 12.0
    packed = moteus_frame.pack_values(REPLY, 0, Resolution.INT16, [10, 0.008, 0.064, -1.44])
    assert packed + moteus_frame.pack_values(REPLY, 0xD, Resolution.INT8, [12.0, 20.0, 0]) == answer


@given(
    st.sampled_from(Resolution), st.sampled_from(sorted(moteus_frame.SCALES)), st.floats(-1e6, 1e6) | st.just(np.nan)
)
def test_values_of_every_resolution(resolution, kind, value):
    raw = moteus_frame.to_raw(value, kind, resolution)
    heard = moteus_frame.from_raw(raw, kind, resolution)
    if np.isnan(value):
        assert np.isnan(heard)
    elif resolution == Resolution.FLOAT:
        assert heard == value
    else:
        bit = moteus_frame.SCALES[kind][resolution]
        most = np.iinfo(moteus_frame.VALUES[resolution]).max * bit
        assert abs(heard - np.clip(value, -most, most)) <= 0.5000001 * bit


def test_the_console_in_bytes():
    codec = MoteusCodec(rig("moteus"))
    typed, fetch = codec.pack_register(0, "id.id")
    assert typed["id"] == 1 and typed["data"][: typed["length"]].tobytes() == b"\x40\x01\x0fconf get id.id\n\x50\x50"
    assert fetch["id"] == 0x8001 | EXTENDED and fetch["data"][:3].tobytes().hex() == "42013d"
    assert moteus_frame.pad(console(CONSOLE_SAYS, b"1\r\n")).hex(" ") == "41 01 03 31 0d 0a"


def said(text: bytes, id: int = 1) -> np.ndarray:
    payload = np.frombuffer(moteus_frame.pad(console(CONSOLE_SAYS, text)), np.uint8)
    return make_fd_frames(np.array([moteus.identifier(id, 0)], np.uint32), payload[None], len(payload))


def test_an_answer_of_the_console_is_taken_once_and_in_parts():
    codec = MoteusCodec(rig("moteus"))
    codec.pack_register(0, "servo.pid_position.kp", 400.0)
    assert codec.unpack_registers(said(b"OK\r\n5\r\n")) == []  # nobody asked
    codec.pack_register(0, "servo.pid_position.kp")
    assert codec.unpack_registers(said(b"OK\r\n40")) == []
    assert codec.unpack_registers(said(b"0.0\r\n7\r\n")) == [(0, "servo.pid_position.kp", 400.0, False)]
    assert len(codec.pack_register(0, "servo.none")) == 2
    assert len(codec.pack_register(0, "servo.none")) == 1  # asked already: what does it say?
    assert len(codec.pack_register(0, "servo.none")) == 2  # lost: once more
    ((row, register, value, written),) = codec.unpack_registers(said(b"ERR unknown group\r\n"))
    assert (row, register, written) == (0, "servo.none", False) and np.isnan(value)
    assert codec.unpack_registers(said(b"1\r\n", id=9)) == []


def answer(mode: int, ids=(1, 0x7E), fault: int = 0) -> np.ndarray:
    data = moteus.pack_answer(Answers(*(np.full(len(ids), x) for x in (mode, 0.1, 0.2, 0.3, 30.0, fault))))
    return make_fd_frames(np.array([moteus.identifier(id, 0) for id in ids], np.uint32), data, 24)


def commanded(codec: MoteusCodec) -> list[bool]:
    return (codec.pack_command(MotorCommand(*np.ones((5, 2))))["length"] == 48).tolist()


def test_only_who_was_enabled_and_obeys_is_commanded():
    codec, state = MoteusCodec(rig("moteus")), MotorState.empty(2)
    assert commanded(codec) == [False, False]
    codec.unpack(answer(Mode.STOPPED), state, 1.0)
    codec.pack_enable(state)
    codec.unpack(answer(Mode.POSITION), state, 1.0)
    assert state.enabled.all() and commanded(codec) == [True, True]
    codec.unpack(answer(Mode.STOPPED, ids=(1,)), state, 2.0)  # it was without power: another command would start it
    assert commanded(codec) == [False, True]
    for _ in range(moteus.UNANSWERED_MAX):
        commanded(codec)
    assert commanded(codec) == [False, False]  # the other is silent
    codec.unpack(answer(Mode.POSITION), state, 3.0)
    assert commanded(codec) == [False, True]  # it has been obeying all the time
    codec.pack_disable()
    assert commanded(codec) == [False, False]


def test_errors():
    codec, state = MoteusCodec(rig("moteus")), MotorState.empty(2)
    codec.unpack(np.concatenate([answer(Mode.FAULT, (1,), 38), answer(Mode.TIMEOUT, (0x7E,), 0)]), state, 1.0)
    assert [codec.error_name(code) for code in state.error] == ["over-temperature", "time-out: no command in time"]
    lengths = codec.pack_enable(state)["length"].tolist()
    assert lengths == [12, 12, 48, 48]  # a stop clears them
    codec.unpack(answer(Mode.POSITION, fault=98), state, 2.0)  # limited, which is no error
    assert not state.error.any() and state.enabled.all()


def test_home_state_in_bytes():
    """registers.md: 00C, one int8. Read by 11 0C, answered by 21 0C."""
    codec = MoteusCodec(rig("moteus"))
    asked = codec.pack_register(0, moteus.HOME)
    assert asked["data"][0, : asked["length"][0]].tobytes() == bytes.fromhex("11 0C")
    said = make_fd_frames(np.array([0x100], np.uint32), np.array([[0x21, 0x0C, 2]], np.uint8), 3)
    assert codec.unpack_registers(said) == [(0, moteus.HOME, 2, False)]
    assert codec.unpack_registers(answer(Mode.STOPPED)) == []


OUTPUT = {"motor_position.output.source": 1.0, "motor_position.sources.1.reference": 1.0}


def test_a_bus_tells_what_its_positions_are_worth(tmp_path):
    bench = Bench(tmp_path, "moteus", registers={"right": OUTPUT})
    assert bench.bus.turns() == pytest.approx([np.pi / 3, 2 * np.pi])


@pytest.mark.parametrize(("known", "lost"), [(False, 3 * np.pi / 3), (True, 0.0)])
def test_a_power_cycle_loses_what_no_encoder_knows(tmp_path, known, lost):
    bench = Bench(tmp_path, "moteus", registers={"left": OUTPUT} if known else None, joint_pos={"left": 2.9})
    told = bench.poll(0.02).position[0]
    assert told == pytest.approx(2.9, abs=0.01)
    for on in (False, True):
        bench.world.motors.power(0, on, bench.world.time)
    assert told - bench.poll(0.02).position[0] == pytest.approx(lost, abs=0.01)


def test_wirings_that_cannot_be():
    spec = rig("moteus")
    with pytest.raises(BusError, match="data_bitrate 0, expected 5000000: moteus speaks CAN-FD"):
        MoteusCodec(replace(spec, data_bitrate=0))
    for motor, message in (
        (replace(spec.motors[0], id=0x7F), "id 0x7f"),
        (replace(spec.motors[0], feedback_id=3), "0x3"),
    ):
        with pytest.raises(BusError, match=message):
            MoteusCodec(replace(spec, motors=(motor,)))


def test_who_only_looks_is_answered_by_motors_that_go_on_as_they_were(tmp_path):
    bench = Bench(tmp_path, "moteus", connect=False, joint_pos={"left": 0.4, "right": -0.2})
    (observer,) = observers([bench.spec], bench.world.wires)
    for _ in range(10):
        observer.ask()
        bench.world.advance(bench.world.time + 0.02)
        observer.look(bench.world.time)
    state, plant = observer.state, bench.world.plant
    assert (bench.world.time - state.time < 0.03).all() and not state.enabled.any() and observer.remark() == ""
    assert state.position == pytest.approx(plant.joint_pos, abs=0.02) and (state.error == 0).all()
