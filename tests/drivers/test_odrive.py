"""ODrive's CANSimple: golden bytes of every message, the law by device-side gains, and the axis' own ways in its emulation."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from can_bench import Bench, rig
from hypothesis import given
from hypothesis import strategies as st

from drivers.bus import BusError, BusSpec, MotorCommand, MotorSpec, MotorState
from drivers.codecs import odrive
from drivers.codecs.odrive import TURN, AxisState, Command, Law, OdriveCodec, OdriveMotors
from drivers.wire import EXTENDED, REMOTE, make_frames

GEAR = 8.0


def hexes(frames: np.ndarray) -> list[str]:
    """As candump has them: identifier#payload, R for a remote frame."""
    return [
        f"{int(f['id']) & 0x7FF:03X}#" + ("R" if f["id"] & REMOTE else f["data"][: f["length"]].tobytes().hex().upper())
        for f in frames
    ]


def frame(text: str) -> np.ndarray:
    id, _, payload = text.partition("#")
    raw = b"" if payload == "R" else bytes.fromhex(payload)
    frames = make_frames(np.array([int(id, 16)]), np.frombuffer(raw.ljust(8, b"\0"), np.uint8)[None], len(raw))
    frames["id"] |= np.uint32(REMOTE * (payload == "R"))
    return frames


def codec() -> OdriveCodec:
    return OdriveCodec(rig("odrive"))


# By the manual of firmware 0.6 and its can_enumerate.py: version 0.6.10; everybody (node 3F) asked for an address, told by
# node 1 with the serial number 394D35523230 in little-endian.
def test_version_and_address_in_bytes():
    spec = modern()
    host = OdriveCodec(spec)
    assert hexes(host.pack_register(0, "VERSION")) == ["020#R"]
    assert len(host.pack_register(0, "SERIAL")) == 0  # 0.5 would take it for a new node id
    assert host.unpack_registers(frame("020#020404 3A 00060A 00")) == [(0, "VERSION", 0x00060A, False)]
    assert len(host.pack_register(0, "SERIAL")) == 0  # the other may still have 0.5
    assert host.unpack_registers(frame("040#020404 3A 000506 00")) == [(1, "VERSION", 0x000506, False)]
    assert len(host.pack_register(0, "SERIAL")) == 0
    host.unpack_registers(frame("040#020404 3A 00060A 00"))
    assert hexes(host.pack_register(0, "SERIAL")) == ["7E6#R"]
    for raw in ("026#01 303252354D39", "026#01 303252354D39 00"):
        assert host.unpack_registers(frame(raw)) == [(0, "SERIAL", 0x394D35523230, False)]
    assert host.unpack_registers(frame("026#02 303252354D39")) == []  # of another node than its identifier says
    with pytest.raises(KeyError):
        host.pack_register(0, "VERSION", 1)
    motors = OdriveMotors(spec)
    assert hexes(motors.pack_address(0, 0x394D35523230)) == ["026#01303252354D3900"]
    assert hexes(motors.pack_version(1, 0x00060A)) == ["040#0204043A00060A00"]


def modern() -> BusSpec:
    """Nodes 1 and 2: newer firmware keeps 3F for everybody."""
    spec = rig("odrive")
    return replace(spec, motors=tuple(replace(m, id=i + 1) for i, m in enumerate(spec.motors)))


@pytest.mark.parametrize(
    ("versions", "told"),
    [
        ((0x000506, 0x000506), ["", ""]),
        ((0x00060A, 0x000506), ["VERSION 1546", ""]),
        ((0x00060A, 0x00060B), ["VERSION 1546, SERIAL 62960769970736", "VERSION 1547, SERIAL 62960769970737"]),
    ],
)
def test_an_axis_is_known_by_its_serial_number_where_its_firmware_tells_it(tmp_path, versions, told):
    registers = {m.joint: {"FIRMWARE": v} for m, v in zip(modern().motors, versions, strict=True)}
    bench = Bench(tmp_path, "odrive", spec=modern(), registers=registers)
    assert bench.bus.fingerprints() == told
    assert bench.world.motors.specs == modern().motors  # nobody has another node id now
    assert bench.enable().enabled.all()


def command(**changes) -> MotorCommand:
    zero = {name: np.zeros(2) for name in MotorCommand.__slots__}
    return MotorCommand(**(zero | {k: np.broadcast_to(np.asarray(v, float), 2) for k, v in changes.items()}))


# By hand from the DBC's signals (tools/odrive-cansimple.dbc): node << 5 | command, little-endian; nodes 0 and 63.
# 1.5f = 3FC00000; -2.5 rev/s = -2500 = F63C; 0.25 N m = 250 = 00FA; 8 turns of the shaft for one of the joint.
def test_command_bytes():
    turns = TURN / GEAR
    packed = codec().pack_command(
        command(
            position=1.5 * turns, velocity=-2.5 * turns, torque=0.25 * GEAR, kd=GEAR**2 / TURN, kp=20 * GEAR**2 / TURN
        )
    )
    assert hexes(packed) == [
        "01A#0000A04100000000",  # position gain 20
        "7FA#0000A04100000000",
        "01B#0000803F00000000",  # velocity gain 1, integrator 0
        "7FB#0000803F00000000",
        "00C#0000C03F3CF6FA00",
        "7EC#0000C03F3CF6FA00",
        "009#R",
        "7E9#R",
    ]


def test_enable_disable_and_poll_bytes():
    host, state = codec(), MotorState.empty(2)
    state.enabled[0] = True
    state.error[1] = 0x800
    assert hexes(host.pack_enable(state)) == [
        "7F8#0000000000000000",  # clear errors
        "7EF#0000F04200008C42",  # 120 rev/s, 70 A
        "7EB#0300000001000000",  # position control, passthrough
        "7FA#0000000000000000",
        "7FB#0000000000000000",
        "7E7#0800000000000000",  # closed loop
    ]
    assert hexes(host.pack_disable()) == ["007#0100000000000000", "7E7#0100000000000000"]
    assert hexes(host.pack_poll(state))[:2] == ["009#R", "7E9#R"]
    assert {text for _ in range(3) for text in hexes(host.pack_poll(state))[2:]} == {"014#R", "7F4#R"}


def test_answer_bytes():
    motors, host, state = OdriveMotors(rig("odrive")), codec(), MotorState.empty(2)
    torque = 2 * 8.27 / 150 * GEAR  # 2 A
    frames = np.concatenate(
        [
            motors.pack_heartbeat(1, 0x840, AxisState.IDLE),
            motors.pack_heartbeat(0, 0, AxisState.CLOSED_LOOP),
            motors.pack_estimates(1, 1.5 * TURN / GEAR, -0.25 * TURN / GEAR),
            motors.pack_current(1, torque),
        ]
    )
    assert hexes(frames) == [
        "7E1#4008000001000000",
        "001#0000000008000000",
        "7E9#0000C03F000080BE",
        "7F4#0000004000000040",
    ]
    assert host.unpack(frames, state, 5.0) == 0
    assert state.enabled.tolist() == [True, False]
    assert [host.error_name(int(e)) for e in state.error] == ["none", "motor failed, watchdog timer expired"]
    assert state.position[1] == pytest.approx(1.5 * TURN / GEAR)
    assert state.velocity[1] == pytest.approx(-0.25 * TURN / GEAR)
    assert state.torque[1] == pytest.approx(torque)
    assert state.time.tolist() == [-np.inf, 5.0]


def test_without_a_heartbeat_nobody_is_heard():
    host, state = codec(), MotorState.empty(2)
    host.unpack(frame("009#0000C03F000080BE"), state, 1.0)
    assert np.isneginf(state.time).all()


@pytest.mark.parametrize("text", ["029#0000C03F000080BE", "009#R", "00C#0000C03F000080BE", "009#0000C03F"])
def test_strangers_are_counted_and_change_nothing(text):
    host, state = codec(), MotorState.empty(2)
    host.unpack(frame("001#0000000008000000"), state, 0.5)
    assert host.unpack(frame(text), state, 1.0) == 1
    extended = frame("009#0000C03F000080BE")
    extended["id"] |= EXTENDED
    assert host.unpack(extended, state, 1.0) == 1
    assert np.isneginf(state.time).all() and np.isnan(state.position).all()


@given(
    *[st.floats(-5, 5)] * 2, st.floats(0, 300), st.floats(0.5, 20), st.floats(-9, 9), st.floats(-3, 3), st.floats(-9, 9)
)
def test_the_axis_computes_what_was_asked_for(p, v, kp, kd, t, q, dq):
    """torque = vel_gain (v* + pos_gain (p* - p) - v) + t, times the gear."""
    gear = np.array([GEAR])
    one = lambda x: np.array([x])  # noqa: E731
    law = odrive.law_of(MotorCommand(one(p), one(v), one(kp), one(kd), one(t)), gear)
    shaft = (
        law.vel_gain * (law.velocity + law.pos_gain * (law.position - q * GEAR / TURN) - dq * GEAR / TURN) + law.torque
    )
    assert shaft * GEAR == pytest.approx([kp * (p - q) + kd * (v - dq) + t], abs=1e-6)
    again = odrive.command_of(Law(*law), gear)
    assert [again.position[0], again.kp[0], again.kd[0], again.torque[0]] == pytest.approx([p, kp, kd, t])


def test_a_spring_without_damping_gets_a_little():
    law = odrive.law_of(command(kp=50.0), np.array([GEAR, GEAR]))
    again = odrive.command_of(law, np.array([GEAR, GEAR]))
    assert again.kp == pytest.approx([50.0, 50.0]) and again.kd == pytest.approx([0.05, 0.05])


@pytest.mark.parametrize(
    ("motor", "message"),
    [
        (MotorSpec("left", "D6374", 64), "got id 0x40, expected 0x0 to 0x3f"),
        (MotorSpec("left", "D6374", 1, 2), "got feedback_id 0x2, expected none"),
    ],
)
def test_refused_identifiers(motor, message):
    with pytest.raises(BusError, match=message):
        OdriveCodec(replace(rig("odrive"), motors=(motor,)))


def test_every_command_is_in_five_bits():
    assert all(0 <= c < 32 for c in Command)


# Emulated axes


class Raw:
    """A host that sends what it likes."""

    def __init__(self, bench: Bench):
        self.bench, self.wire = bench, bench.world.wires["arm"]

    def ask(self, *texts: str, seconds: float = 0.004) -> list[str]:
        self.wire.send(np.concatenate([frame(t) for t in texts]))
        return self.listen(seconds)

    def listen(self, seconds: float) -> list[str]:
        self.bench.world.advance(self.bench.world.time + seconds)
        return hexes(self.wire.recv())


QUIET = {joint: {"HEARTBEAT_RATE_MS": 0} for joint in ("left", "right")}


def test_heartbeats_come_unasked(tmp_path):
    raw = Raw(Bench(tmp_path, "odrive", connect=False, registers={"left": {"HEARTBEAT_RATE_MS": 100}}))
    heard = raw.listen(1.0)
    assert heard.count("001#0000000001000000") == 10
    assert heard.count("7E1#0000000001000000") == 100


def test_an_axis_holds_where_it_enters_closed_loop(tmp_path):
    """With the gains of the factory, and no target yet."""
    bench = Bench(tmp_path, "odrive", connect=False, joint_pos={"left": 0.7}, registers=QUIET)
    raw = Raw(bench)
    raw.ask("00C#0000000000000000")  # a target while idle does not count
    raw.ask("007#0800000000000000")
    assert bench.torque[0] == 0.0
    bench.world.plant.data.qpos[0] = 0.6
    raw.listen(0.004)
    assert bench.torque[0] > 0.5
    raw.ask("007#0100000000000000")
    assert bench.torque[0] == 0.0


def test_questions_feed_the_watchdog_and_its_error_latches(tmp_path):
    registers = {joint: {"WATCHDOG_TIMEOUT": 0.05, **QUIET[joint]} for joint in ("left", "right")}
    raw = Raw(Bench(tmp_path, "odrive", connect=False, registers=registers))
    raw.ask("007#0800000000000000", "7E7#0800000000000000")
    for _ in range(20):
        raw.ask("009#R", seconds=0.01)
    axes = raw.bench.world.motors
    assert axes.enabled.tolist() == [True, False] and axes.error.tolist() == [0, 0x800]
    raw.ask("7E7#0800000000000000")
    assert not axes.enabled[1]
    raw.ask("7F8#0000000000000000", "7E7#0800000000000000")
    assert axes.enabled[1] and axes.error[1] == 0


def test_a_zero_length_frame_is_a_question_too(tmp_path):
    raw = Raw(Bench(tmp_path, "odrive", connect=False, joint_pos={"right": TURN / GEAR}, registers=QUIET))
    assert raw.ask("7E9#") == ["7E9#0000803F00000000"]
    assert raw.ask("7F0#R", "009#0000C03F000080BE", "7EC#00") == []


def test_the_current_limit_limits_the_torque(tmp_path):
    bench = Bench(tmp_path, "odrive")
    bench.enable()
    bench.run(0.02, position=9.0, kp=500.0, kd=5.0)
    assert bench.torque == pytest.approx([30.0, 30.0])  # 30.9 N m at 70 A; 30 is the joint's own
    Raw(bench).ask("00F#0000F0420000A041")  # 20 A
    assert bench.torque[0] == pytest.approx(20 * 8.27 / 150 * GEAR)


def test_connecting_without_heartbeats_is_refused(tmp_path):
    bench = Bench(tmp_path, "odrive", connect=False, registers={"right": {"HEARTBEAT_RATE_MS": 0}})
    with pytest.raises(BusError, match="motor of right .*no answer to a request for its state"):
        bench.bus.connect(bench.clock)
