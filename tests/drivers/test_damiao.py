"""Damiao codec: golden bytes of every message, both ways, telling frames and answers apart, identifiers refused."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scripted_can import leg

from drivers.bus import BusError, MotorCommand, MotorSpec, MotorState
from drivers.codecs import damiao
from drivers.codecs.damiao import DamiaoCodec, DamiaoMotors, Kind, Operation, RegisterFrame
from drivers.codecs.mit import Ranges
from drivers.wire import EXTENDED, make_frames


def payload(text: str) -> np.ndarray:
    return np.frombuffer(bytes.fromhex(text), np.uint8)


def hexes(frames: np.ndarray) -> list[tuple[int, str]]:
    return [(int(f["id"]), f["data"].tobytes().hex(" ")) for f in frames]


# From "DM-J4310-2EC V1.1 motor driver user manual", register read, write and store frames, and the register list
# (numbers and types); values by hand: 12.5f = 41480000, 1600 = 640h ticks of 50 us = 80 ms.
REGISTER_BYTES = [
    (RegisterFrame(1, Operation.READ, "PMAX", 0), "01 00 33 15 00 00 00 00"),
    (RegisterFrame(1, Operation.READ, "PMAX", 12.5), "01 00 33 15 00 00 48 41"),
    (RegisterFrame(2, Operation.READ, "VMAX", 45.0), "02 00 33 16 00 00 34 42"),
    (RegisterFrame(2, Operation.READ, "TMAX", 54.0), "02 00 33 17 00 00 58 42"),
    (RegisterFrame(0x105, Operation.WRITE, "CTRL_MODE", 1), "05 01 55 0a 01 00 00 00"),
    (RegisterFrame(7, Operation.WRITE, "TIMEOUT", 1600), "07 00 55 09 40 06 00 00"),
    (RegisterFrame(7, Operation.WRITE, "MST_ID", 0x17), "07 00 55 07 17 00 00 00"),
    (RegisterFrame(7, Operation.STORE, "", 0), "07 00 aa 00 00 00 00 00"),
    (RegisterFrame(3, Operation.REFRESH, "", 0), "03 00 cc 00 00 00 00 00"),
]


@pytest.mark.parametrize(("frame", "expected"), REGISTER_BYTES)
def test_register_bytes(frame, expected):
    assert damiao.pack_register(*frame).tobytes().hex(" ") == expected
    assert damiao.unpack_register(payload(expected)) == frame


@pytest.mark.parametrize("register", damiao.REGISTERS)
def test_every_register_keeps_its_value(register):
    kind = damiao.REGISTERS[register][1]
    value = 0xDEADBEEF if kind == "<u4" else -1.5e-3
    got = damiao.unpack_register(damiao.pack_register(1, Operation.WRITE, register, value))
    assert got.register == register
    assert got.value == pytest.approx(value, rel=1e-7)


def test_register_types_are_those_of_the_manual():
    integers = {number for number, kind, _ in damiao.REGISTERS.values() if kind == "<u4"}
    assert integers == {7, 8, 9, 10, 13, 14, 15, 16, 35}


@pytest.mark.parametrize(("value", "error"), [(np.nan, ValueError), (np.inf, ValueError)])
def test_a_float_register_is_never_sent_what_is_not_finite(value, error):
    with pytest.raises(error, match="PMAX of motor 1"):
        damiao.pack_register(1, Operation.WRITE, "PMAX", value)


@pytest.mark.parametrize(
    ("kind", "expected"),
    [  # manual, "special frames" of the MIT mode
        (Kind.ENABLE, "ff ff ff ff ff ff ff fc"),
        (Kind.DISABLE, "ff ff ff ff ff ff ff fd"),
        (Kind.SET_ZERO, "ff ff ff ff ff ff ff fe"),
        (Kind.CLEAR_ERROR, "ff ff ff ff ff ff ff fb"),
    ],
)
def test_special_bytes(kind, expected):
    assert damiao.special_payload(kind).tobytes().hex(" ") == expected
    rows, kinds = DamiaoMotors(leg()).classify(make_frames(np.array([2]), payload(expected)[None]))
    assert (rows[0], kinds[0]) == (1, kind)


def test_command_and_feedback_frames_of_a_bus():
    codec, motors = DamiaoCodec(leg(2)), DamiaoMotors(leg(2))
    column = lambda a, b: np.array([a, b], float)  # noqa: E731
    command = MotorCommand(column(1.25, 0), column(-9, 0), column(100, 0), column(2.5, 0), column(5.4, 0))
    frames = codec.pack_command(command)
    # The arithmetic of the first row is in test_mit.py.
    assert hexes(frames) == [(1, "8c cc 66 63 33 7f f8 cc"), (2, "7f ff 7f f0 00 00 07 ff")]
    rows, kinds = motors.classify(frames)
    assert rows.tolist() == [0, 1] and kinds.tolist() == [Kind.COMMAND] * 2
    assert motors.unpack_command(frames["data"], rows).kp.tolist() == pytest.approx([100, 0], abs=0.13)

    answer = motors.pack_feedback(column(1.25, 0), column(-9, 0), column(5.4, 0), np.array([1, 0xD]), 40, 60)
    # Manual, feedback frame: status << 4 | id, position, velocity and torque packed, T_MOS 40, T_rotor 60.
    assert hexes(answer) == [(0x11, "11 8c cc 66 68 cc 28 3c"), (0x12, "d2 7f ff 7f f7 ff 28 3c")]
    state = MotorState.empty(2)
    assert codec.unpack(answer, state, 3.0) == 0
    np.testing.assert_allclose(state.position, [1.25, 0], atol=4e-4)
    np.testing.assert_allclose(state.velocity, [-9, 0], atol=0.022)
    np.testing.assert_allclose(state.torque, [5.4, 0], atol=0.027)
    assert state.temperature.tolist() == [60, 60]
    assert state.enabled.tolist() == [True, False]
    assert state.error.tolist() == [0, 0xD]
    assert state.time.tolist() == [3.0, 3.0]


@pytest.mark.parametrize("status", range(16))
def test_status_nibble(status):
    codec, state = DamiaoCodec(leg(1)), MotorState.empty(1)
    codec.unpack(DamiaoMotors(leg(1)).pack_feedback(*np.zeros((3, 1)), np.array([status]), 25, 25), state, 0.0)
    assert state.enabled[0] == (status == 1)
    assert state.error[0] == (status if status > 1 else 0)
    assert codec.error_name(int(state.error[0])) == (
        "none" if status < 2 else damiao.ERRORS.get(status, f"unknown status {status:#x}")
    )


def test_strangers_are_counted_and_change_nothing():
    codec, state = DamiaoCodec(leg()), MotorState.empty(3)
    frame = DamiaoMotors(leg()).pack_feedback(*np.ones((3, 3)), np.zeros(3, int), 25, 25)[:1]
    strangers = np.concatenate([frame] * 5)
    strangers["id"][0] = 0x1F  # nobody's
    strangers["id"][1] |= EXTENDED
    strangers["id"][2] = 0x12  # joint_1's payload on joint_2's identifier
    strangers["length"][3] = 7
    strangers["id"][4] = damiao.BROADCAST_ID  # another host's request
    assert codec.unpack(strangers, state, 1.0) == 5
    assert np.isneginf(state.time).all() and np.isnan(state.position).all()
    assert codec.unpack(strangers[:0], state, 1.0) == 0


@pytest.mark.parametrize("operation", [Operation.READ, Operation.WRITE])
def test_register_answers_are_told_from_feedback_on_the_same_identifier(operation):
    """The payload of an answer read as feedback would be a position of -12.48 rad."""
    codec, motors, state = DamiaoCodec(leg()), DamiaoMotors(leg()), MotorState.empty(3)
    for register in damiao.REGISTERS:
        frames = np.concatenate(
            [
                motors.pack_feedback(*np.zeros((3, 3)), np.ones(3, int), 25, 25),
                motors.pack_register(1, operation, register, 7),
            ]
        )
        assert codec.unpack(frames, state, 1.0) == 0
        assert np.abs(state.position).max() < 1e-3
        (answer,) = codec.unpack_registers(frames)
        assert answer == (1, register, 7, operation == Operation.WRITE)


def swap(frames: np.ndarray) -> None:
    frames[[0, 1]] = frames[[1, 0]]


def damage(field: str, row: int, value: object):
    def change(frames: np.ndarray) -> None:
        frames[field][row] = value

    return change


@pytest.mark.parametrize(
    ("change", "rejected", "position"),
    [
        (lambda frames: None, 0, [1, 2, 3]),
        (swap, 0, [1, 2, 3]),
        (damage("id", 1, 0x77), 1, [1, np.nan, 3]),
        (damage("id", 1, 0x13), 1, [1, np.nan, 3]),  # joint_2's payload with joint_3's identifier
        (damage("length", 1, 7), 1, [1, np.nan, 3]),
        (damage("data", 1, payload("13 7f ff 7f f7 ff 19 19")), 1, [1, np.nan, 3]),  # says that it is motor 3
        (damage("data", 1, damiao.pack_register(2, Operation.READ, "SN")), 0, [1, np.nan, 3]),
        (damage("data", 1, payload("02 00 00 7f f7 ff 19 19")), 0, [1, -12.5, 3]),
    ],
)
def test_as_many_frames_as_motors(change, rejected, position):
    """The usual tick takes a short way; what only looks like one must not."""
    zero = np.zeros(3)
    frames = DamiaoMotors(leg()).pack_feedback(np.array([1.0, 2, 3]), zero, zero, np.ones(3, int), 25, 25)
    change(frames)
    state = MotorState.empty(3)
    assert DamiaoCodec(leg()).unpack(frames, state, 1.0) == rejected
    np.testing.assert_allclose(state.position, position, atol=1e-3)


@pytest.mark.parametrize(
    "text",
    [
        "02 00 00 15 f7 ff 19 19",  # as an answer, byte 2 would be an operation
        "02 00 33 7f f7 ff 19 19",  # and byte 3 a register: 7f is none, and what a motor at rest says
        "02 00 34 15 f7 ff 19 19",
    ],
)
def test_feedback_at_the_negative_end_is_no_register_answer(text):
    codec, state = DamiaoCodec(leg()), MotorState.empty(3)
    frames = make_frames(np.array([0x12]), payload(text)[None])
    assert codec.unpack(frames, state, 1.0) == 0
    assert state.position[1] == pytest.approx(-12.5, abs=0.03)
    assert codec.unpack_registers(frames) == []


def test_a_register_answer_from_nobody_is_none():
    """Its payload names joint_3, its identifier nobody: another motor was left on a foreign feedback id."""
    frames = make_frames(np.array([0x77]), damiao.pack_register(3, Operation.READ, "PMAX", 12.5)[None])
    assert DamiaoCodec(leg()).unpack_registers(frames) == []


def test_the_later_of_two_frames_counts():
    codec, motors, state = DamiaoCodec(leg()), DamiaoMotors(leg()), MotorState.empty(3)
    frames = [
        motors.pack_feedback(np.full(3, x), np.zeros(3), np.zeros(3), np.ones(3, int), 25, 25) for x in (1.0, 2.0)
    ]
    codec.unpack(np.concatenate(frames)[::-1][[3, 0]], state, 1.0)  # joint_3: 1.0, then 2.0
    assert state.position[2] == pytest.approx(2.0, abs=1e-3)
    assert np.isnan(state.position[:2]).all()


def test_what_frames_are_for_a_motor():
    frames = make_frames(
        np.array([1, 0x101, 0x203, 9, 0x7FF, 0x7FF, 2 | EXTENDED, 3], np.uint32), np.zeros((8, 8), np.uint8)
    )
    frames["data"][4] = damiao.pack_register(3, Operation.READ, "SN")
    frames["data"][5] = damiao.pack_register(9, Operation.READ, "SN")
    frames["length"][7] = 4
    rows, kinds = DamiaoMotors(leg()).classify(frames)
    assert rows.tolist() == [0, 0, 2, -1, 2, -1, -1, -1]
    other, register = Kind.OTHER_MODE, Kind.REGISTER
    assert kinds.tolist()[:6] == [Kind.COMMAND, other, other, other, register, register]


def test_seven_ff_and_another_byte_is_a_command():
    frames = make_frames(np.array([1]), np.full((1, 8), 0xFF, np.uint8))
    assert DamiaoMotors(leg()).classify(frames)[1].tolist() == [Kind.COMMAND]


@given(st.lists(st.floats(allow_nan=False, allow_infinity=False, width=32), min_size=5, max_size=5))
def test_a_command_is_a_command_for_the_motor(values):
    command = MotorCommand(*(np.full(3, x) for x in values))
    rows, kinds = DamiaoMotors(leg()).classify(DamiaoCodec(leg()).pack_command(command))
    assert rows.tolist() == [0, 1, 2]
    assert kinds.tolist() == [Kind.COMMAND] * 3


@given(
    st.lists(st.tuples(st.integers(0, 0xFFFF_FFFF), st.integers(0, 8), st.binary(min_size=8, max_size=8)), max_size=8)
)
def test_any_frames_leave_a_finite_state(frames):
    made = make_frames(np.zeros(len(frames), np.uint32), np.zeros((len(frames), 8), np.uint8))
    for row, (id, length, data) in zip(made, frames, strict=True):
        row["id"], row["length"], row["data"] = id % 0x18, length, list(data)
    codec, state = DamiaoCodec(leg()), MotorState.empty(3)
    rejected = codec.unpack(made, state, 1.0)
    codec.unpack_registers(made)
    DamiaoMotors(leg()).classify(made)
    assert 0 <= rejected <= len(frames)
    heard = state.time > 0
    assert np.isfinite(state.position[heard]).all() and (np.abs(state.position[heard]) <= 12.5).all()


def test_timeout_ticks():
    assert damiao.timeout_ticks(0.08) == 1600
    assert damiao.timeout_ticks(1e-9) == 1  # 0 would switch the watchdog off


def test_other_ranges_than_the_models():
    ranges = Ranges(*(np.full(3, x) for x in (6.25, 45.0, 54.0, 500.0, 5.0)))
    frames = DamiaoMotors(leg(), ranges).pack_feedback(
        np.full(3, 3.125), np.zeros(3), np.zeros(3), np.zeros(3, int), 25, 25
    )
    state = MotorState.empty(3)
    DamiaoCodec(leg()).unpack(frames, state, 0.0)
    np.testing.assert_allclose(state.position, 6.25, atol=1e-3)  # half of full scale on both sides


def motor(id: int, feedback_id: int, model: str = "DM8009") -> MotorSpec:
    return MotorSpec(f"joint_{id}", model, id, feedback_id)


@pytest.mark.parametrize(
    ("motors", "message"),
    [
        ([motor(1, 0)], r"joint_1 \(id 0x1\): got feedback_id 0x0, expected 0x1 to 0x7fe: write its MST_ID, .*0x11"),
        ([motor(1, 0x7FF)], "got feedback_id 0x7ff, expected"),
        (
            [motor(1, 0x20), motor(0x11, 0x20)],
            r"joint_17 \(id 0x11\): got feedback_id 0x20, which the motor of joint_1",
        ),
        ([motor(1, 2), motor(2, 0x12)], "got feedback_id 0x2, on which the motor of joint_2 listens"),
        ([motor(1, 0x101)], "got feedback_id 0x101, on which the motor of joint_1 listens"),
        ([motor(0, 0x10)], "got id 0x0, expected 0x1 to 0xff"),
        ([motor(0x100, 0x10)], "got id 0x100, expected"),
        ([motor(1, 0x11, "DM8O09")], r"no Damiao model 'DM8O09' \(did you mean 'DM8009'\?\); known: DM3507, .*DMH3510"),
    ],
)
def test_refused_identifiers_and_models(motors, message):
    with pytest.raises(BusError, match=message):
        DamiaoCodec(replace(leg(), motors=tuple(motors)))


def test_ids_that_alias_in_the_payload_are_told_apart_by_feedback_id():
    spec = replace(leg(), motors=(motor(1, 0x21), motor(0x11, 0x31)))
    codec, state = DamiaoCodec(spec), MotorState.empty(2)
    codec.unpack(
        DamiaoMotors(spec).pack_feedback(np.array([1.0, -1.0]), *np.zeros((2, 2)), np.ones(2, int), 25, 25), state, 0
    )
    np.testing.assert_allclose(state.position, [1, -1], atol=1e-3)


def test_models_of_every_robot_are_known(robot):
    for wiring in robot.wirings.values():
        for spec in wiring.bus_specs():
            if spec.protocol == "damiao":
                DamiaoCodec(spec)
