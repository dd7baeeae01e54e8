"""Dynamixel codec: golden bytes of the e-manual, a bit-by-bit reference, units, damaged streams."""

from __future__ import annotations

import numpy as np
import pytest
import reference_dynamixel as reference
from hypothesis import given
from hypothesis import strategies as st

from drivers.bus import BusError, BusSpec, MotorCommand, MotorSpec, MotorState
from drivers.codecs import dynamixel
from drivers.codecs.dynamixel import DynamixelCodec
from drivers.codecs.dynamixel_look import DynamixelLook
from drivers.codecs.dynamixel_packet import (
    BROADCAST,
    LENGTH_MAX,
    Instruction,
    Parser,
    crc16,
    pack,
    pack_bulk_read,
    pack_bulk_write,
    pack_read,
    pack_status,
    pack_sync_read,
    pack_sync_write,
    pack_write,
    stuff,
    unstuff,
)

# Bytes among which headers and stuffing are frequent.
AWKWARD = st.lists(st.sampled_from([0xFF, 0xFD, 0x00, 0x01, 0x55]), max_size=60).map(bytes)
TURN = 2 * np.pi


def bus(n: int = 3, model: str = "XM430-W350", **changes) -> BusSpec:
    motors = tuple(MotorSpec(f"joint_{i}", model, i) for i in range(1, n + 1))
    return BusSpec(**{"name": "leg", "protocol": "dynamixel", "motors": motors, "bitrate": 4_000_000} | changes)


def command(n: int, **values) -> MotorCommand:
    names = ("position", "velocity", "kp", "kd", "torque")
    return MotorCommand(*(np.full(n, values.get(name, 0.0), float) for name in names))


def status(id: int, *fields: int, alert: int = 0) -> bytes:
    return reference.pack(id, 0x55, bytes([alert]) + reference.state(*fields))


GOLDEN = {
    "ping": (pack(1, Instruction.PING), "FF FF FD 00 01 03 00 01 19 4E"),
    "ping status": (pack_status(1, 0, bytes([6, 4, 0x26])), "FF FF FD 00 01 07 00 55 00 06 04 26 65 5D"),
    "sync read": (
        pack_sync_read(bytes([1, 2]), 132, 4),
        "FF FF FD 00 FE 09 00 82 84 00 04 00 01 02 CE FA",
    ),
    "sync write": (
        pack_sync_write(116, bytes([1, 150, 0, 0, 0, 2, 170, 0, 0, 0]), 4),
        "FF FF FD 00 FE 11 00 83 74 00 04 00 01 96 00 00 00 02 AA 00 00 00 82 87",
    ),
    "bulk read": (
        pack_bulk_read([(1, 144, 2), (2, 146, 1)]),
        "FF FF FD 00 FE 0D 00 92 01 90 00 02 00 02 92 00 01 00 1A 05",
    ),
    "reboot": (pack(1, Instruction.REBOOT), "FF FF FD 00 01 03 00 08 2F 4E"),
    "clear": (
        pack(1, Instruction.CLEAR, bytes([0x01, 0x44, 0x58, 0x4C, 0x22])),
        "FF FF FD 00 01 08 00 10 01 44 58 4C 22 B1 DC",
    ),
    "stuffed sync write": (
        pack_sync_write(102, b"\x01" + np.int16(-1).tobytes() + np.int32(-3).tobytes(), 6),
        "FF FF FD 00 FE 0F 00 83 66 00 06 00 01 FF FF FD FD FF FF FF 67 DC",
    ),
}


@pytest.mark.parametrize("packed, expected", GOLDEN.values(), ids=GOLDEN)
def test_golden_bytes(packed, expected):
    assert packed.hex(" ").upper() == expected
    (packet,) = Parser().feed(packed)
    assert pack(packet.id, packet.instruction, packet.parameters) == packed


@given(st.one_of(st.binary(max_size=120), AWKWARD))
def test_crc_and_stuffing_are_the_reference(data):
    assert crc16(data) == reference.crc16(data)
    assert stuff(data) == reference.stuff(data)
    assert unstuff(stuff(data)) == data


@given(st.integers(0, 252), st.sampled_from([0x01, 0x03, 0x55, 0x83]), st.one_of(st.binary(max_size=80), AWKWARD))
def test_every_packet_comes_back(id, instruction, parameters):
    raw = pack(id, instruction, parameters)
    assert raw == reference.pack(id, instruction, parameters)
    (packet,) = Parser().feed(raw)
    assert (packet.id, packet.instruction, packet.parameters, packet.end) == (id, instruction, parameters, len(raw))


def test_longest_packet_is_refused():
    pack(1, 3, bytes(LENGTH_MAX - 3))
    with pytest.raises(ValueError, match="at most 1024"):
        pack(1, 3, bytes(LENGTH_MAX - 2))


def test_read_write_and_bulk_write_name_address_and_size():
    assert pack_read(7, 132, 4) == reference.pack(7, 2, bytes([132, 0, 4, 0]))
    assert pack_write(7, 0x0274, b"ab") == reference.pack(7, 3, bytes([0x74, 2]) + b"ab")
    assert pack_bulk_write([(1, 116, b"abcd"), (2, 64, b"\1")]) == reference.pack(
        BROADCAST, 0x93, bytes([1, 116, 0, 4, 0]) + b"abcd" + bytes([2, 64, 0, 1, 0, 1])
    )


# -- streams ---------------------------------------------------------------------------------------------------------


@given(st.lists(AWKWARD, min_size=1, max_size=5), AWKWARD, st.data())
def test_packets_are_found_however_the_stream_is_cut(payloads, noise, data):
    packets = [pack(k + 1, Instruction.STATUS, b"\0" + p) for k, p in enumerate(payloads)]
    stream = noise.replace(b"\xff", b"\xfe") + b"".join(packets)
    parser, found, at = Parser(), [], 0
    while at < len(stream):
        step = data.draw(st.integers(1, len(stream)))
        found += parser.feed(stream[at : at + step])
        at += step
    assert [p.raw for p in found] == packets
    assert parser.pending == b""


@pytest.mark.parametrize("cut", range(1, 25))
def test_a_packet_cut_short_does_not_take_the_next_one_with_it(cut):
    whole = status(2, 1, 0, 4, 0, 0, 2048, 30)
    parser = Parser()
    assert [p.id for p in parser.feed(status(1, 1, 0, 4, 0, 0, 2048, 30)[:cut] + whole)] == [2]


@given(st.data())
def test_mutated_streams_never_yield_what_has_no_crc(data):
    stream = bytearray(b"".join(status(i, 1, 0, 4, i, -i, 2048 + i, 30) for i in (1, 2, 3)))
    for _ in range(data.draw(st.integers(1, 6))):
        at = data.draw(st.integers(0, len(stream) - 1))
        kind = data.draw(st.sampled_from(["flip", "cut", "insert"]))
        if kind == "flip":
            stream[at] ^= 1 << data.draw(st.integers(0, 7))
        elif kind == "cut":
            del stream[at : at + data.draw(st.integers(1, 20))]
        else:
            stream[at:at] = data.draw(AWKWARD)
        if not stream:
            return
    check_stream(bytes(stream))


@given(st.one_of(st.binary(max_size=200), st.lists(AWKWARD, max_size=6).map(b"\xff\xff\xfd\x00".join)))
def test_random_streams_never_yield_what_has_no_crc(stream):
    check_stream(stream)


def check_stream(stream: bytes) -> None:
    assert all(reference.is_packet(p.raw) for p in Parser().feed(stream))
    codec, state = DynamixelCodec(bus()), MotorState.empty(3)
    for fast in (False, True):
        codec.pack_request(np.arange(3), fast)
        before = state.time.copy()
        heard = codec.unpack(stream, state, 1.0)
        heard += codec.finish(state, 1.0)
        assert heard >= np.count_nonzero(state.time != before)
        known = state.time > -np.inf
        for values in (state.position, state.velocity, state.torque, state.temperature):
            assert np.isfinite(values[known]).all() and np.isnan(values[~known]).all()


# -- commands --------------------------------------------------------------------------------------------------------


def goals_of(raw: bytes) -> list[tuple[int, int, int]]:
    """(id, P gain, position) of each servo in a sync write to the mapped goals."""
    (packet,) = Parser().feed(raw)
    assert packet.instruction == Instruction.SYNC_WRITE
    assert packet.parameters[:4] == bytes([dynamixel.GOAL_AT, 0, dynamixel.GOAL_SIZE, 0])
    items = [packet.parameters[at : at + 7] for at in range(4, len(packet.parameters), 7)]
    return [(i[0], int.from_bytes(i[1:3], "little"), int.from_bytes(i[3:], "little", signed=True)) for i in items]


def test_position_is_ticks_around_2048():
    codec = DynamixelCodec(bus(3))
    c = command(3)
    c.position[:] = [0.0, np.pi / 2, -np.pi / 4]
    assert [g[2] for g in goals_of(codec.pack_command(c))] == [2048, 3072, 1536]


def test_p_gain_gives_kp_at_the_shaft():
    """100 % of PWM is the stall torque: an error of 885 * 128 / P ticks gives 4.1 N m on an XM430-W350."""
    codec = DynamixelCodec(bus(1))
    for kp in (0.5, 5.0, 20.0):
        ((_, gain, _),) = goals_of(codec.pack_command(command(1, kp=kp)))
        error = 885 * 128 / gain * TURN / 4096
        assert 4.1 / error == pytest.approx(kp, rel=0.02)


def test_velocity_and_torque_move_the_goal_by_what_gives_the_same_torque():
    codec = DynamixelCodec(bus(1))
    ((_, _, goal),) = goals_of(codec.pack_command(command(1, position=0.1, kp=5.0, kd=0.5, velocity=1.0, torque=-1.0)))
    assert (goal - 2048) * TURN / 4096 == pytest.approx(0.1 + (0.5 * 1.0 - 1.0) / 5.0, abs=TURN / 4096)


def test_without_kp_nothing_pulls():
    assert goals_of(DynamixelCodec(bus(1)).pack_command(command(1, position=1.0, kd=3.0, torque=2.0)))[0][1] == 0


def test_targets_saturate_at_the_limits_that_the_servos_have():
    codec = DynamixelCodec(bus(3))
    codec.configure({"OPERATING_MODE": [3, 3, 4], "POSITION_MIN": [0, 1000, 0], "POSITION_MAX": [4095, 3000, 4095]})
    assert [g[2] for g in goals_of(codec.pack_command(command(3, position=1e9, kp=1e9)))] == [4095, 3000, 1_048_575]
    assert [g[2] for g in goals_of(codec.pack_command(command(3, position=-1e9)))] == [0, 1000, -1_048_575]
    assert {g[1] for g in goals_of(codec.pack_command(command(3, kp=1e300, torque=1e300)))} == {16383}


@pytest.mark.parametrize("name", ["position", "velocity", "kp", "kd", "torque"])
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_what_is_not_finite_is_refused(name, value):
    with pytest.raises(ValueError, match="not finite"):
        DynamixelCodec(bus(3)).pack_command(command(3, **{name: value}))


@given(st.lists(st.tuples(st.floats(-3, 3), st.floats(0, 30)), min_size=3, max_size=3))
def test_commands_are_the_reference(targets):
    codec = DynamixelCodec(bus(3))
    position, kp = np.array(targets).T
    zero = np.zeros(3)
    scale = 128 * 885 * TURN / 4096 / 4.1
    body = bytes([dynamixel.GOAL_AT, 0, 6, 0])
    for k, (q, gain) in enumerate(targets):
        ticks = min(4095, max(0, round(float(np.rint(q / (TURN / 4096) + 2048)))))
        body += bytes([k + 1]) + reference.goal(round(float(np.rint(gain * scale))), ticks)
    packed = codec.pack_command(MotorCommand(position, zero, kp, zero, zero))
    assert packed == reference.pack(0xFE, 0x83, body)


def test_a_goal_that_looks_like_a_header_is_stuffed():
    codec = DynamixelCodec(bus(1))
    codec.configure({"OPERATING_MODE": [4], "POSITION_MIN": [0], "POSITION_MAX": [4095]})
    raw = codec.pack_command(command(1, position=(-131_073 - 2048) * TURN / 4096))  # FF FF FD FF
    assert goals_of(raw) == [(1, 0, -131_073)]
    assert reference.is_packet(raw) and b"\xff\xff\xfd\xfd\xff" in raw


# -- states ----------------------------------------------------------------------------------------------------------


def heard(codec: DynamixelCodec, raw: bytes, n: int) -> MotorState:
    state = MotorState.empty(n)
    codec.unpack(raw, state, 5.0)
    return state


def test_states_in_si_units():
    codec = DynamixelCodec(bus(2))
    state = heard(codec, status(1, 1, 0, 4, 100, 10, 3072, 41) + status(2, 0, 0, 4, -100, -10, 1024, 42), 2)
    np.testing.assert_allclose(state.position, [np.pi / 2, -np.pi / 2])
    np.testing.assert_allclose(state.velocity, [0.239691227, -0.239691227])
    np.testing.assert_allclose(state.torque, np.array([0.269, -0.269]) * 4.1 / 2.3)
    np.testing.assert_array_equal(state.temperature, [41, 42])
    np.testing.assert_array_equal(state.enabled, [True, False])
    np.testing.assert_array_equal(state.time, [5.0, 5.0])


def test_load_is_a_thousandth_of_the_stall_torque_without_a_current_sensor():
    assert heard(DynamixelCodec(bus(1, "XL430-W250")), status(1, 1, 0, 4, 500, 0, 0, 0), 1).torque[0] == 0.75


def test_an_alert_is_no_reason_to_throw_data_away():
    codec = DynamixelCodec(bus(1))
    state = heard(codec, status(1, 0, 0x24, 4, 0, 0, 2048, 90, alert=0x80), 1)
    assert state.time[0] == 5.0 and state.error[0] == 0x24
    assert codec.error_name(0x24) == "overheating, overload"
    assert codec.error_name(0) == "none" and codec.error_name(0x42) == "unknown error 0x42"


def test_a_tripped_watchdog_is_an_error_and_not_enabled():
    codec = DynamixelCodec(bus(1))
    state = heard(codec, status(1, 1, 0, -1, 0, 0, 2048, 30), 1)
    assert not state.enabled[0] and codec.error_name(int(state.error[0])) == "bus watchdog tripped"


def test_current_minus_one_before_a_velocity_ending_in_fd_is_stuffed_and_read():
    """rustypot#121: without destuffing, a few per cent of all reads at standstill are lost."""
    raw = status(1, 1, 0, 4, -1, -3, 2048, 30)
    assert len(raw) == dynamixel.STATUS.itemsize + 1
    state = heard(DynamixelCodec(bus(2)), raw + status(2, 1, 0, 4, 0, 0, 2049, 30), 2)
    np.testing.assert_array_equal(state.time, [5.0, 5.0])
    assert state.velocity[0] == pytest.approx(-3 * 0.0239691227)


@pytest.mark.parametrize("damage", range(dynamixel.STATUS.itemsize))
def test_one_damaged_answer_does_not_lose_the_others(damage):
    answers = [bytearray(status(i, 1, 0, 4, 0, 0, 2048 + i, 30)) for i in (1, 2, 3)]
    answers[1][damage] ^= 0x10
    codec, state = DynamixelCodec(bus(3)), MotorState.empty(3)
    codec.unpack(b"".join(answers), state, 5.0)
    codec.unpack(b"", state, 6.0)
    assert state.time[0] == 5.0 and state.time[1] == -np.inf
    if damage not in (5, 6):  # a wrong length swallows what follows, until something else comes
        assert state.time[2] == 5.0


def test_strangers_and_short_answers_are_rejected():
    codec, state = DynamixelCodec(bus(2)), MotorState.empty(2)
    assert codec.unpack(status(9, 1, 0, 4, 0, 0, 0, 0) + pack_status(1, 0, b"abc"), state, 1.0) == 0
    assert codec.rejected == 2 and (state.time == -np.inf).all()


def test_an_adapters_echo_is_neither_answer_nor_error():
    codec, state = DynamixelCodec(bus(2)), MotorState.empty(2)
    assert codec.unpack(codec.pack_command(command(2)) + status(1, 1, 0, 4, 0, 0, 0, 0), state, 1.0) == 1
    assert codec.rejected == 0


def fast_answer(*states: tuple[int, bytes]) -> bytes:
    raw = b"\xff\xff\xfd\x00\xfe" + (1 + 18 * len(states)).to_bytes(2, "little") + b"\x55"
    for id, block in states:
        raw += bytes([0, id]) + block
        raw += reference.crc16(raw).to_bytes(2, "little")
    return raw


FAST = fast_answer(*((i, reference.state(1, 0, 4, 0, 0, 2048 + i, 30)) for i in (2, 1, 3)))


def test_a_fast_answer_holds_everybody():
    codec, state = DynamixelCodec(bus(3)), MotorState.empty(3)
    request = codec.pack_request(np.array([1, 0, 2]), fast=True)
    assert request == reference.pack(0xFE, 0x8A, bytes([dynamixel.STATE_AT, 0, 14, 0, 2, 1, 3]))
    assert codec.reply_size(3, fast=True) == len(FAST)
    assert codec.unpack(FAST[:20], state, 1.0) + codec.unpack(FAST[20:], state, 2.0) == 3
    np.testing.assert_allclose(state.position, np.array([1, 2, 3]) * TURN / 4096)


def test_a_fast_answer_that_breaks_off_says_what_it_said():
    codec, state = DynamixelCodec(bus(3)), MotorState.empty(3)
    codec.pack_request(np.array([1, 0, 2]), fast=True)
    assert codec.unpack(FAST[: 8 + 18 + 5], state, 1.0) == 0
    assert codec.finish(state, 1.5) == 1
    np.testing.assert_array_equal(state.time, [-np.inf, 1.5, -np.inf])
    assert codec.finish(state, 2.5) == 0, "told once"


def test_a_fast_answer_that_nobody_asked_for_is_rejected():
    codec, state = DynamixelCodec(bus(3)), MotorState.empty(3)
    codec.pack_request(np.arange(3), fast=True)  # another order
    assert codec.unpack(FAST, state, 1.0) == 0 and codec.rejected == 1


# -- wiring ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "spec, said",
    [
        (bus(1, "XM430-W351"), "no Dynamixel model 'XM430-W351'.*did you mean 'XM430-W350'"),
        (bus(motors=(MotorSpec("knee", "XM430-W350", 253),)), "knee: got id 253, expected 0 to 252"),
        (bus(motors=(MotorSpec("hip", "MX-28", 1), MotorSpec("knee", "MX-28", 1))), "knee: got id 1.*hip has too"),
        (bus(bitrate=1_500_000), "got 1500000 bit/s, expected a rate"),
        (bus(watchdog=0.01), "watchdog of 0.01 s, expected at least 0.02"),
    ],
)
def test_wirings_that_cannot_be_are_refused(spec, said):
    with pytest.raises(BusError, match=said):
        DynamixelCodec(spec)


def test_watchdogs_are_never_longer_than_asked_for():
    assert [dynamixel.watchdog_ticks(s) for s in (0.02, 0.039, 0.08, 0.1, 100.0)] == [1, 1, 4, 5, 127]


def test_models_differ_in_number():
    assert len({m.number for m in dynamixel.MODELS.values()}) == len(dynamixel.MODELS)
    assert dynamixel.damping_of(dynamixel.MODELS["XM430-W350"]) == pytest.approx(4.1 / (46 / 60 * TURN))


def test_who_only_looks_reads_registers_where_they_are():
    codec, state = DynamixelLook(bus(2)), MotorState.empty(2)
    motion, health = codec.pack_looks()
    assert motion == pack_sync_read(bytes([1, 2]), 126, 21) and health == pack_sync_read(bytes([1, 2]), 64, 35)
    table = bytearray(147)
    table[64], table[70] = 1, 0x04
    for at, value, size in ((126, -100, 2), (128, 10, 4), (132, 3072, 4), (146, 41, 1)):
        table[at : at + size] = value.to_bytes(size, "little", signed=value < 0)
    answers = pack_status(2, 0, bytes(table[126:147])) + pack_status(2, 0x80, bytes(table[64:99]))
    assert codec.unpack_look(motion + answers, state, 3.0) == 0
    assert state.position[1] == pytest.approx(TURN / 4) and state.velocity[1] == pytest.approx(0.2397, abs=1e-4)
    assert state.torque[1] == pytest.approx(-100 * 0.00269 * 4.1 / 2.3)
    assert (state.temperature[1], state.time[1], state.time[0]) == (41, 3.0, -np.inf)
    assert state.enabled[1] and codec.error_name(int(state.error[1])) == "overheating"
    table[98] = 0xFF
    codec.unpack_look(pack_status(2, 0, bytes(table[64:99])), state, 3.1)
    assert not state.enabled[1] and codec.error_name(int(state.error[1])) == "overheating, bus watchdog tripped"


def test_who_only_looks_counts_strangers_and_damage():
    codec, state = DynamixelLook(bus(2)), MotorState.empty(2)
    stranger, torn = pack_status(9, 0, bytes(21)), bytearray(pack_status(1, 0, bytes(21)))
    torn[12] ^= 1
    assert codec.unpack_look(stranger + bytes(torn) + pack_status(1, 0, bytes(4)), state, 1.0) == 3
    assert (state.time == -np.inf).all()
