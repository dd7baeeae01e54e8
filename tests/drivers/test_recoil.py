"""Recoil: golden bytes of every message, gains and questions by SDO, and the device's own ways in its emulation."""

from __future__ import annotations

import re
import struct
from dataclasses import replace

import numpy as np
import pytest
from can_bench import RATE, Bench, rig
from hypothesis import given
from hypothesis import strategies as st

from drivers.bus import BusError, MotorCommand, MotorSpec, MotorState
from drivers.codecs import recoil
from drivers.codecs.recoil import Function, Mode, RecoilCodec, RecoilMotors, Sdo
from drivers.wire import FRAME, make_frames


def hexes(frames: np.ndarray) -> list[str]:
    """As candump has them: identifier#payload."""
    return [f"{int(f['id']):03X}#{f['data'][: f['length']].tobytes().hex().upper()}" for f in frames]


def frame(text: str) -> np.ndarray:
    id, _, payload = text.partition("#")
    raw = bytes.fromhex(payload)
    return make_frames(np.array([int(id, 16)]), np.frombuffer(raw.ljust(8, b"\0"), np.uint8)[None], len(raw))


def codec() -> RecoilCodec:
    return RecoilCodec(rig("recoil"))


def command(**changes) -> MotorCommand:
    zero = {name: np.zeros(2) for name in MotorCommand.__slots__}
    return MotorCommand(**(zero | {k: np.broadcast_to(np.asarray(v, float), 2) for k, v in changes.items()}))


# By hand from the firmware's function codes and parameter offsets: function << 7 | device (1, or 63 = 3F), little-endian;
# lengths as the maker's host sends them. 1.5f = 3FC00000, 20.0f = 41A00000, 2.0f = 40000000, -0.25f = BE800000.
GOLDEN_SDO = [
    (("POSITION_KP", None), "601#402000"),
    (("POSITION_KP", 20.0), "601#202000000000A041"),
    (("VELOCITY_KP", 2.0), "601#2028000000000040"),
    (("WATCHDOG_TIMEOUT", 80), "601#2008000050000000"),
    (("BUS_VOLTAGE", None), "601#400001"),
]


@pytest.mark.parametrize(("request_", "expected"), GOLDEN_SDO)
def test_sdo_bytes(request_, expected):
    packed = recoil.pack_sdo(1, *request_)
    assert hexes(packed) == [expected]
    assert recoil.unpack_sdo(packed[0]) == Sdo(*request_)


def test_mode_target_and_answer_bytes():
    motors = RecoilMotors(rig("recoil"))
    assert hexes(codec().pack_disable()) == ["001#0101", "03F#013F"]
    assert hexes(recoil.pack_mode(63, Mode.POSITION)) == ["03F#133F"]
    packed = codec().pack_command(command(position=[1.5, -0.25]))
    targets = packed[packed["id"] >> 7 == Function.RPDO2]
    assert hexes(targets) == ["301#0000C03F00000000", "33F#000080BE00000000"]
    assert motors.unpack_targets(targets[0]) == (1.5, 0.0)
    assert hexes(motors.pack_motion(0, Function.TPDO2, 1.5, -0.25)) == ["281#0000C03F000080BE"]
    assert hexes(motors.pack_motion(1, Function.TPDO3, 1.5, -0.25)) == ["3BF#0000C03F000080BE"]
    assert hexes(motors.pack_motion(1, Function.TPDO4, 1.5, -0.25)) == ["4BF#0000C03F000080BE"]
    assert hexes(motors.pack_answer(0, struct.pack("<f", 20.0))) == ["581#0000A041"]
    assert hexes(motors.pack_echo(0, np.arange(8, dtype=np.uint8))) == ["181#0001020304050607"]


def test_enabling_zeroes_the_gains_of_those_that_do_not_drive():
    state = MotorState.empty(2)
    state.enabled[1] = True
    assert hexes(codec().pack_enable(state)) == [
        "601#2020000000000000",
        "601#2028000000000000",
        "001#0101",  # IDLE
        "001#1301",  # POSITION
    ]


def test_only_known_parameters_and_only_writable_ones_are_sent():
    """A device checks no offset: a wrong write would change its memory."""
    with pytest.raises(KeyError):
        recoil.pack_sdo(1, "MOTOR_PHASE_ORDER", 1)
    with pytest.raises(ValueError, match="MODE of device 1: got a value to write, .*read-only"):
        recoil.pack_sdo(1, "MODE", 2)
    with pytest.raises(ValueError, match="POSITION_KP: got nan"):
        recoil.pack_sdo(1, "POSITION_KP", float("nan"))
    offsets = {recoil.PARAMETERS[name][0] for name in recoil.PARAMETERS}
    host, state = codec(), MotorState.empty(2)
    for k in range(40):
        frames = np.concatenate([host.pack_enable(state), host.pack_poll(state), host.pack_command(command(kp=k % 3))])
        for f in frames[frames["id"] >> 7 == Function.RSDO]:
            assert int.from_bytes(f["data"][1:3].tobytes(), "little") in offsets


@given(*[st.floats(-10, 10)] * 3, st.floats(0.1, 300), st.floats(0, 20), st.floats(-3, 3), st.floats(-9, 9))
def test_velocity_and_feed_forward_are_in_the_position(p, v, t, kp, kd, q, dq):
    """What the device computes, kp (p' - q) - kd dq, is what was asked for."""
    frames = codec().pack_command(command(position=p, velocity=v, kp=kp, kd=kd, torque=t))
    gains = [recoil.unpack_sdo(f) for f in frames[frames["id"] == recoil.identifier(Function.RSDO, 1)]]
    sent = {g.name: g.value for g in gains if g.value is not None}
    target, _ = RecoilMotors(rig("recoil")).unpack_targets(frames[frames["id"] == 0x301][0])
    device = sent["POSITION_KP"] * (target - q) - sent["VELOCITY_KP"] * dq
    assert device == pytest.approx(kp * (p - q) + kd * (v - dq) + t, abs=1e-5 * (1 + abs(kp * target) + kd * 20))


def test_gains_go_out_when_they_change_and_in_turn():
    host = codec()

    def told(kp: float) -> list[str]:
        frames = host.pack_command(command(kp=[kp, 5.0]))
        sdos = [recoil.unpack_sdo(f) for f in frames[frames["id"] >> 7 == Function.RSDO]]
        devices = frames["id"][frames["id"] >> 7 == Function.RSDO] & 0x7F
        return [f"{d}:{s.name}={s.value:g}" for d, s in zip(devices, sdos, strict=True) if s.value is not None]

    assert len(told(1.0)) == 4
    assert [told(1.0) for _ in range(4)] == [
        ["63:POSITION_KP=5"], ["1:VELOCITY_KP=0"], ["63:VELOCITY_KP=0"], ["1:POSITION_KP=1"]
    ]  # fmt: skip
    assert told(2.0) == ["1:POSITION_KP=2", "63:POSITION_KP=5"]


def test_one_question_at_a_time():
    """Answers do not say what they answer."""
    host, state = codec(), MotorState.empty(2)
    open_questions = {1: 0, 63: 0}
    for _ in range(recoil.SDO_PATIENCE):
        frames = host.pack_poll(state)
        for f in frames[frames["id"] >> 7 == Function.RSDO]:
            open_questions[int(f["id"]) & 0x7F] += 1
    assert open_questions == {1: 1, 63: 1}
    assert host.unpack(frame("581#13000000"), state, 1.0) == 0
    assert host.unpack(frame("581#40000000"), state, 1.0) == 0  # one too many answers nothing
    assert state.enabled.tolist() == [True, False] and state.error.tolist() == [0, 0]
    assert np.isneginf(state.time).all()


def test_feedback():
    host, state = codec(), MotorState.empty(2)
    frames = np.concatenate(
        [frame("281#0000C03F000080BE"), frame("4BF#000080BE0000A041"), frame("381#0000C03F00000040")]
    )
    assert host.unpack(frames, state, 2.0) == 0
    assert state.position.tolist() == [1.5, -0.25] and state.velocity.tolist() == [-0.25, 20.0]
    assert state.torque[0] == 2.0
    assert state.time.tolist() == [2.0, 2.0]


@pytest.mark.parametrize(
    "text", ["282#0000C03F000080BE", "281#0000C03F", "581#0000C03F000080BE", "301#0000C03F000080BE"]
)
def test_strangers_are_counted_and_change_nothing(text):
    host, state = codec(), MotorState.empty(2)
    assert host.unpack(frame(text), state, 1.0) == 1
    assert np.isneginf(state.time).all() and host.owners(frame(text)).tolist() == [-1]


def test_what_is_not_finite_is_not_a_state():
    host, state = codec(), MotorState.empty(2)
    host.unpack(frame("281#0000C07F0000803E"), state, 1.0)
    assert np.isneginf(state.time).all()


def test_error_names():
    """Bits 10 and 11 as the firmware has them; the maker's host calls them CAN transmission and I2C."""
    assert codec().error_name(0) == "none"
    assert codec().error_name(1 << 6 | 1 << 10 | 1 << 13) == "watchdog timeout, CAN reception, encoder"


@pytest.mark.parametrize(
    ("motor", "message"),
    [
        (MotorSpec("left", "6512", 64), "got id 0x40, expected 0x1 to 0x3f"),
        (MotorSpec("left", "6512", 0), "got id 0x0, expected"),
        (MotorSpec("left", "6512", 1, 2), "got feedback_id 0x2, expected none"),
    ],
)
def test_refused_identifiers(motor, message):
    with pytest.raises(BusError, match=message):
        RecoilCodec(replace(rig("recoil"), motors=(motor,)))


# Emulated controllers


class Raw:
    """A host that sends what it likes."""

    def __init__(self, bench: Bench):
        self.bench, self.wire = bench, bench.world.wires["arm"]

    def ask(self, *texts: str) -> list[str]:
        self.wire.send(np.concatenate([frame(t) for t in texts]))
        self.bench.world.advance(self.bench.world.time + 0.004)
        return hexes(self.wire.recv())


@pytest.fixture
def raw(tmp_path) -> Raw:
    return Raw(Bench(tmp_path, "recoil", connect=False, joint_pos={"left": 1.5}))


def test_answers_of_a_device(raw):
    assert raw.ask("201#CA00000000000000") == ["181#CA00000000000000"]
    assert raw.ask("301#0000000000000000") == ["281#0000C03F00000000"]
    assert raw.ask("401#0000000000000000") == ["381#0000C03F00000000"]
    assert raw.ask("601#406000") == ["581#0000C03F"]
    assert raw.ask("601#400800") == ["581#E8030000"]  # 1000 ms
    assert raw.ask("601#402100") == []  # no parameter starts there
    assert raw.ask("601#2008000050000000") == []  # a write is not confirmed
    assert raw.ask("601#400800") == ["581#50000000"]
    assert raw.ask("701#", "302#0000000000000000", "001#1301") == []


def test_position_mode_pulls_to_the_old_target_at_once(raw):
    """Gains and target are the device's own: switching it on without setting them moves it."""
    raw.ask("601#203000000000A041", "601#202000000000A041")  # torque limit and kp 20
    raw.ask("301#0000000000000000")  # target 0, while idle at 1.5
    assert raw.bench.torque[0] == 0.0
    raw.ask("001#1301")
    assert raw.bench.torque[0] < -5.0


def test_only_some_modes_lead_to_driving(raw):
    raw.ask("001#0001", "001#1301")  # DISABLED, then POSITION
    assert raw.ask("601#401000") == ["581#01000000"]
    assert raw.ask("601#401400") == ["581#20000000"]  # bit 5: invalid mode


def test_a_mode_for_another_device_is_ignored_on_any_identifier(raw):
    raw.ask("000#1301")
    assert raw.ask("601#401000") == ["581#13000000"]
    raw.ask("001#013F")
    assert raw.ask("601#401000") == ["581#13000000"]


def test_expiry_is_damping_with_an_error(tmp_path):
    bench = Bench(tmp_path, "recoil")
    bench.enable()
    bench.run(0.1, position=1.0, kp=2.0, kd=0.1)
    while not any(e.event == "watchdog" for e in bench.world.motor_log):
        bench.tick()
    bench.world.plant.data.qvel[:] = 2.0
    bench.tick()
    assert (bench.torque < -0.2).all()  # it brakes
    state = bench.poll(0.2)
    assert not state.enabled.any()
    assert [bench.bus.error_name(int(e)) for e in state.error] == ["watchdog timeout"] * 2
    assert [e.event for e in bench.world.motor_log if e.joint == "left"][-2:] == ["watchdog", "damping"]


def test_an_idle_device_does_not_trip(tmp_path):
    bench = Bench(tmp_path, "recoil")
    for _ in range(round(0.3 * RATE)):
        bench.tick()
    assert not bench.poll(0.1).error.any()


def test_the_device_keeps_its_limits(tmp_path):
    bench = Bench(tmp_path, "recoil", registers={"left": {"POSITION_LIMIT_UPPER": 0.2}})
    bench.enable()
    bench.run(0.8, position=0.5, kp=10.0, kd=0.6)
    assert bench.world.plant.joint_pos == pytest.approx([0.2, 0.5], abs=0.01)
    bench.run(0.004, position=9.0, kp=100.0, kd=0.5)
    assert bench.torque[1] == 6.0  # TORQUE_LIMIT


def test_a_power_cycle_loses_turns_of_the_shaft(tmp_path):
    bench = Bench(tmp_path, "recoil", faults=["reboot:arm/left=0.1@0.5"])
    bench.world.plant.data.qpos[0] = 0.5
    bench.poll(0.7)
    turn = 2 * np.pi / 15
    assert bench.poll(0.1).position[0] == pytest.approx(0.5 - turn, abs=1e-4)


def test_a_device_that_cannot_be_stopped_is_refused(tmp_path):
    bench = Bench(tmp_path, "recoil", connect=False)
    bench.bus._codec.pack_disable = lambda: np.zeros(0, FRAME)
    Raw(bench).ask("001#0201")  # somebody left it damping
    with pytest.raises(BusError, match=r"motor of left .*MODE is 2, expected 1"):
        bench.bus.connect(bench.clock)


def test_docstring_offsets_are_multiples_of_four():
    """A parameter is a field of a C struct of 4-byte fields."""
    assert all(offset % 4 == 0 and offset <= 0x13C for offset, _, _ in recoil.PARAMETERS.values())
    assert all(re.fullmatch("<[fui]4", kind) for _, kind, _ in recoil.PARAMETERS.values())
