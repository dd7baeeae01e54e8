"""Feetech STS codec: bytes of the protocol, sign and magnitude, units, damaged streams, wirings refused."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from test_dynamixel import command

from drivers.bus import BusError, BusSpec, MotorSpec, MotorState
from drivers.codecs import feetech
from drivers.codecs.feetech import BROADCAST, FeetechCodec, Instruction, Parser

BUS = BusSpec(
    "arm", "feetech", tuple(MotorSpec(f"joint_{i}", "STS3215-12V", i) for i in (1, 2, 3)), watchdog=feetech.NO_WATCHDOG
)


def answer(id: int, torque=1, position=2048, velocity=0, load=0, temperature=30, status=0, error=0) -> bytes:
    """One servo's block from TORQUE_ENABLE (40) to STATUS (65), byte by byte."""
    block = bytearray(26)
    block[0] = torque
    for at, value in ((56, position), (58, velocity), (60, load)):
        block[at - 40 : at - 38] = value.to_bytes(2, "little")
    block[63 - 40], block[65 - 40] = temperature, status
    body = bytes([id, 28, error]) + bytes(block)
    return b"\xff\xff" + body + bytes([~sum(body) & 0xFF])


def test_bytes_of_the_protocol():
    """Examples in Dynamixel 1.0 framing, checksums by hand: FF - (01 + 02 + 01) = FB."""
    assert feetech.pack(1, Instruction.PING).hex() == "ffff010201fb"
    assert feetech.pack(1, Instruction.READ, bytes([56, 2])).hex() == "ffff0104023802be"
    codec = FeetechCodec(BUS)
    assert codec.pack_read("MODEL", np.array([0, 2])).hex() == "fffffe06820302010370"
    assert codec.pack_disable().hex() == "fffffe0a832801010002000300" + "45"


def test_goals_and_torque_limits():
    codec = FeetechCodec(BUS)
    c = command(3, kp=1.0)
    c.position[:] = [0.0, np.pi / 2, -np.pi / 2]
    c.kp[2] = 0.0
    (packet,) = Parser().feed(codec.pack_command(c))
    assert packet.id == BROADCAST and packet.parameters[:2] == bytes([42, 8])
    goals = np.frombuffer(packet.parameters[2:], feetech.GOAL)
    assert goals["position"].tolist() == [2048, 3072, 1024] and goals["limit"].tolist() == [1000, 1000, 0]
    codec.configure({"POSITION_MIN": [0, 0, 1500], "POSITION_MAX": [4095, 3000, 4095]})
    (packet,) = Parser().feed(codec.pack_command(c))
    assert np.frombuffer(packet.parameters[2:], feetech.GOAL)["position"].tolist() == [2048, 3000, 1500]


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_what_is_not_finite_is_refused(value):
    with pytest.raises(ValueError, match="not finite"):
        FeetechCodec(BUS).pack_command(command(3, position=value))


@given(st.integers(-32767, 32767))
def test_sign_and_magnitude(value):
    raw = feetech.to_sign_magnitude(np.array(value))
    assert raw == (abs(value) | 0x8000 if value < 0 else value)
    assert feetech.from_sign_magnitude(raw) == value
    assert feetech.to_sign_magnitude(np.array(-40000)) == 0xFFFF


def test_states_in_si_units():
    codec, state = FeetechCodec(BUS), MotorState.empty(3)
    raw = answer(1, position=3072, velocity=0x8000 | 4096, load=500) + answer(
        3, torque=0, load=0x400 | 250, status=0x24
    )
    assert codec.unpack(raw[:40], state, 1.0) + codec.unpack(raw[40:], state, 2.0) == 2
    assert state.position[0] == pytest.approx(np.pi / 2) and state.velocity[0] == pytest.approx(-2 * np.pi)
    assert state.torque[0] == pytest.approx(0.5 * 2.94) and state.torque[2] == pytest.approx(-0.25 * 2.94)
    assert state.enabled.tolist() == [True, False, False] and state.time[1] == -np.inf
    assert codec.error_name(int(state.error[2])) == "overheating, overload"


@pytest.mark.parametrize("at", range(32))
def test_a_damaged_answer_does_not_lose_the_one_behind_it(at):
    raw = bytearray(answer(1))
    raw[at] ^= 0x10
    codec, state = FeetechCodec(BUS), MotorState.empty(3)
    codec.unpack(bytes(raw) + answer(2) + answer(3) + answer(3), state, 1.0)
    assert state.time[0] == -np.inf and state.time[2] == 1.0


@given(
    st.lists(
        st.one_of(st.binary(max_size=40), st.sampled_from([answer(1), answer(2), b"\xff\xff", b"\xff"])), max_size=6
    )
)
def test_any_stream_leaves_nothing_that_is_not_finite(parts):
    codec, state = FeetechCodec(BUS), MotorState.empty(3)
    for part in parts:
        codec.unpack(part, state, 1.0)
    known = state.time > -np.inf
    for values in (state.position, state.velocity, state.torque, state.temperature):
        assert np.isfinite(values[known]).all() and np.isnan(values[~known]).all()


@pytest.mark.parametrize(
    "changes, said",
    [
        ({"watchdog": 0.08}, "Feetech servos have none"),
        ({"motors": (MotorSpec("hip", "STS3215", 1),)}, "no Feetech model 'STS3215'.*did you mean 'STS3215-"),
        ({"motors": (MotorSpec("hip", "STS3215-12V", 254),)}, "got id 254, expected 0 to 253"),
        ({"motors": (MotorSpec("a", "STS3215-12V", 1), MotorSpec("b", "STS3215-12V", 1))}, "two motors share an id"),
    ],
)
def test_wirings_that_cannot_be_are_refused(changes, said):
    with pytest.raises(BusError, match=said):
        FeetechCodec(replace(BUS, **changes))


class ScriptedServos:
    """A SerialWire with STS servos behind it that answer at once: tables of bytes, no motion."""

    def __init__(self, n: int, **registers: int) -> None:
        values = {"MODEL": 777, "POSITION_MAX": 4095} | registers
        self.tables = {id: bytearray(128) for id in range(1, n + 1)}
        for name, value in values.items():
            address, size = feetech.REGISTERS[name]
            for table in self.tables.values():
                table[address : address + size] = value.to_bytes(size, "little")
        self.silent: set[int] = set()
        self._parser, self._out = Parser(), b""

    def write(self, data: bytes) -> None:
        for p in self._parser.feed(data):
            address, size, rest = p.parameters[0], p.parameters[1], p.parameters[2:]
            if p.instruction == Instruction.SYNC_READ:
                for id in rest:
                    if id not in self.silent:
                        self._out += feetech.pack(id, 0, bytes(self.tables[id][address : address + size]))
            elif p.instruction == Instruction.SYNC_WRITE:
                for at in range(0, len(rest), size + 1):
                    table = self.tables[rest[at]]
                    table[address : address + size] = rest[at + 1 : at + 1 + size]
                    table[56:58] = table[42:44]  # it is where it was told to be

    def read(self) -> bytes:
        out, self._out = self._out, b""
        return out

    def fileno(self) -> int:
        return -1

    def close(self) -> None: ...


class Clock:
    time = 0.0

    def now(self) -> float:
        return self.time

    def sleep_until(self, time: float) -> None:
        self.time = max(self.time, time)


def test_the_serial_bus_speaks_it():
    from drivers.open import open_bus

    wire, clock = ScriptedServos(3), Clock()
    bus = open_bus(BUS, wire)
    bus.connect(clock)
    assert not bus.read(clock.now()).enabled.any()
    bus.enable()
    wire.silent = {2}
    for _ in range(2):
        bus.write(command(3, position=0.5, kp=1.0))
        clock.time += 0.02
        state = bus.read(clock.now())
    assert state.enabled.tolist() == [True, False, True]
    np.testing.assert_allclose(state.position[[0, 2]], 0.5, atol=feetech.TICK)
    bus.disable()
    wire.silent = set()
    bus.poll()
    clock.time += 0.02
    assert not bus.read(clock.now()).enabled.any()


def test_a_servo_in_another_mode_is_refused():
    from drivers.open import open_bus

    with pytest.raises(BusError, match="register MODE is 1, expected 0"):
        open_bus(BUS, ScriptedServos(3, MODE=1)).connect(Clock())


def test_who_only_looks_asks_for_the_state_that_a_tick_reads():
    codec, state = FeetechCodec(BUS), MotorState.empty(3)
    assert codec.pack_looks() == [codec.pack_request(np.arange(3))]
    torn = bytearray(answer(1))
    torn[-1] ^= 1
    assert codec.unpack_look(answer(2, torque=0, position=3072) + bytes(torn) + answer(9), state, 2.0) == 2
    assert state.time.tolist() == [-np.inf, 2.0, -np.inf]
    assert state.position[1] == pytest.approx(np.pi / 2) and not state.enabled[1]
