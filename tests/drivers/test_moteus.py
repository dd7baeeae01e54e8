"""moteus payloads: golden bytes, round trips, and the maker's own library where it is installed."""

from __future__ import annotations

from importlib import import_module

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.bus import MotorCommand
from drivers.codecs import moteus
from drivers.codecs.moteus import TURN, Answers, Gains, Mode, Register

GAINS = Gains(np.array([40.0, 20.0]), np.array([2.0, 1.0]), np.array([2.0, 3.0]))
COMMAND = MotorCommand(
    *(np.array([a, 0.0]) for a in (0.5 * TURN, -0.25 * TURN, 20 / TURN, 0.5 / TURN, 0.25))
)  # half of kp, a quarter of kd


# By hand from the reference: 01 00 0A writes mode 10; 0C 06 20 six floats from register 020; 0D 27 one float to 027; 11 00,
# 1F 01 and 12 0E ask for mode, three floats from 001, and two bytes from 00E. 0.08f = 3DA3D70A.
def test_command_bytes():
    assert moteus.pack_command(COMMAND, GAINS, 0.08)[0].tobytes().hex(" ") == (
        "01 00 0a 0c 06 20 00 00 00 3f 00 00 80 be 00 00 80 3e 00 00 00 3f 00 00 80 3e 00 00 00 40 "
        "0d 27 0a d7 a3 3d 11 00 1f 01 12 0e 50 50 50 50 50 50"
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
    assert moteus.fault_name(38) == "over-temperature" and moteus.fault_name(0) == "none"
    assert moteus.fault_name(98) == "limited" and moteus.fault_name(77) == "unknown fault 77"


def test_identifiers():
    assert moteus.identifier(0, 1, reply=True) == 0x8001
    assert moteus.identifier(1, 0) == 0x100


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
    found = moteus.registers_of(moteus.pack_command(COMMAND, GAINS, 0.08)[0].tobytes())
    assert found[Register.MODE] is None  # asked for, after it was written
    assert found[Register.COMMAND_POSITION] == 0.5 and found[Register.COMMAND_TIMEOUT] == pytest.approx(0.08)
    for payload, message in (
        ("0c06200000", "expected 4 more"),
        ("31", "0x31 at byte 0"),
        ("14ffffffffff01", "more than 5"),
    ):
        with pytest.raises(ValueError, match=message):
            moteus.registers_of(bytes.fromhex(payload))


@given(st.binary(max_size=64))
def test_any_payload_is_parsed_or_refused(payload):
    try:
        moteus.registers_of(payload)
    except ValueError:
        pass
    data = np.frombuffer(payload.ljust(64, b"\0")[:24], np.uint8)[None]
    answers, sound = moteus.unpack_answer(data)
    assert not sound[0] or np.isfinite(answers.position[0])


def test_the_makers_library_packs_and_reads_the_same():
    library = pytest.importorskip("moteus", reason="the maker's library (pip install moteus) is not installed")
    resolution = library.PositionResolution()
    for name in vars(library.PositionResolution):
        if not name.startswith("_"):
            setattr(resolution, name, library.F32)
    query = library.QueryResolution()
    for name in ("mode", "temperature", "fault"):
        setattr(query, name, library.INT8)
    for name in ("position", "velocity", "torque"):
        setattr(query, name, library.F32)
    query.voltage = library.IGNORE
    controller = library.Controller(id=1, query_resolution=query, position_resolution=resolution)
    theirs = controller.make_position(
        position=0.5, velocity=-0.25, feedforward_torque=0.25, kp_scale=0.5, kd_scale=0.25, maximum_torque=2.0,
        watchdog_timeout=0.08, query=True,
    )  # fmt: skip
    ours = moteus.pack_command(COMMAND, GAINS, 0.08)[0].tobytes()
    assert moteus.registers_of(theirs.data) == moteus.registers_of(ours)
    answer = moteus.pack_answer(Answers(*(np.array([x]) for x in (10, 0.5 * TURN, -0.25 * TURN, 0.25, 41.0, 38))))
    values = import_module("moteus.protocol").parse_reply(answer[0].tobytes())
    assert values[library.Register.MODE] == Mode.POSITION and values[library.Register.POSITION] == 0.5
    assert values[library.Register.TORQUE] == 0.25 and values[library.Register.FAULT] == 38
