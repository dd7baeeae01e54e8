"""CanBus against scripted Damiao motors on a fake wire and a fake clock: connecting, refusing, counting, stopping."""

from __future__ import annotations

import random
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scripted_can import ScriptedMotors, leg

from drivers.bus import BusError, MotorCommand, MotorSpec, MotorState
from drivers.can_bus import ANSWER_TIME, QUEUE_FULL_TIME, TRIES, CanBus, CanBuses, joined
from drivers.codecs import damiao
from drivers.codecs.damiao import Kind, Operation
from drivers.open import open_bus
from drivers.wire import ERROR, WireError, WireFull


class FakeClock:
    def __init__(self) -> None:
        self.time = 100.0

    def now(self) -> float:
        return self.time

    def sleep_until(self, time: float) -> None:
        self.time = max(self.time, time)


def made(n: int = 3, connect: bool = True, **changes) -> tuple[CanBus, ScriptedMotors, FakeClock]:
    spec = leg(n, **changes)
    wire, clock = ScriptedMotors(spec), FakeClock()
    bus = open_bus(spec, wire)
    assert isinstance(bus, CanBus)
    if connect:
        bus.connect(clock)
        wire.sent.clear()
    return bus, wire, clock


def command(n: int = 3, **changes) -> MotorCommand:
    zero = {name: np.zeros(n) for name in MotorCommand.__slots__}
    return MotorCommand(**(zero | changes))


def kinds(wire: ScriptedMotors) -> list[int]:
    return [int(k) for frames in wire.sent for k in wire.codec.classify(frames)[1]]


def refuse(error: Exception):
    def send(frames: np.ndarray) -> None:
        raise error

    return send


# Connecting


def test_connect_disables_checks_and_programs_the_watchdog():
    bus, wire, clock = made(connect=False, watchdog=0.12)
    wire.status[:] = 1  # left enabled by whoever was here before
    bus.connect(clock)
    assert kinds(wire)[:3] == [Kind.DISABLE] * 3
    assert Kind.ENABLE not in kinds(wire) and Kind.COMMAND not in kinds(wire)
    assert [r["TIMEOUT"] for r in wire.registers] == [2400] * 3  # 0.12 s in 50 us ticks
    state = bus.read(clock.now())
    assert not state.enabled.any() and np.isfinite(state.position).all()
    assert clock.now() - 100 < 0.02
    assert bus.counters.rejected == 0


def test_connect_is_refused_naming_every_register_that_differs():
    bus, wire, clock = made(connect=False)
    wire.registers[0]["VMAX"] = 30.0
    wire.registers[2]["VMAX"] = 20.0
    with pytest.raises(BusError) as refused:
        bus.connect(clock)
    lines = str(refused.value).splitlines()
    assert lines[0] == "bus leg, motor of joint_1 (id 0x1, DM8009): register VMAX is 30, expected 45"
    assert lines[1] == "bus leg, motor of joint_3 (id 0x3, DM8009): register VMAX is 20, expected 45"
    assert "velocities would be scaled wrongly" in lines[2]
    assert Kind.ENABLE not in kinds(wire)


@pytest.mark.parametrize(
    ("register", "value", "message"),
    [
        ("PMAX", 12.566371, "PMAX is 12.5664, expected 12.5"),
        ("TMAX", 54.01, "TMAX is 54.01, expected 54"),
        ("CTRL_MODE", 2, r"CTRL_MODE is 2, expected 1\n  set it to 1 \(MIT\)"),
        ("VMAX", float("nan"), "VMAX is nan, expected 45"),
    ],
)
def test_each_register_is_compared(register, value, message):
    bus, wire, clock = made(connect=False)
    wire.registers[1][register] = value
    wire.codec.pack_register = lambda row, *rest, pack=wire.codec.pack_register: _with_nan(pack, row, *rest)
    with pytest.raises(BusError, match=message):
        bus.connect(clock)


def _with_nan(pack, row, operation, register, value):
    if np.isnan(value):
        frame = pack(row, operation, register, 0.0)
        frame["data"][0, 4:] = np.array([value], "<f4").view(np.uint8)
        return frame
    return pack(row, operation, register, value)


def test_a_range_within_the_rounding_of_a_float_is_accepted():
    bus, wire, clock = made(connect=False)
    wire.registers[1]["PMAX"] = float(np.float32(12.5) * np.float32(1.00001))
    bus.connect(clock)


def test_a_watchdog_that_does_not_keep_its_value_is_refused():
    """The answer to the write repeats what was written; only reading it back shows what the motor kept."""
    bus, wire, clock = made(connect=False)

    class Deaf(dict):
        def __setitem__(self, name, value):
            pass

    wire.registers[2] = Deaf(wire.registers[2])
    answer = wire.codec.pack_register
    wire.codec.pack_register = lambda row, op, register, value: answer(row, op, register, 1600 if op == 0x55 else value)
    with pytest.raises(BusError, match=r"joint_3 .*TIMEOUT is 0, expected 1600\n  the motor would not stop by itself"):
        bus.connect(clock)


def test_every_silent_motor_is_named_within_its_time():
    bus, wire, clock = made(connect=False)
    wire.silent = {0, 2}
    with pytest.raises(BusError) as refused:
        bus.connect(clock)
    lines = str(refused.value).splitlines()
    assert "motor of joint_1 (id 0x1): no answer on 0x11 to a request for register PMAX, tried 7 times" in lines[0]
    assert "joint_3" in lines[1]
    assert "socketcan can7: Frames from other identifiers: none. Check power" in lines[2]
    assert clock.now() - 100 <= TRIES * ANSWER_TIME + 1e-6 <= 0.3


def test_a_motor_that_answers_elsewhere_is_hinted_at():
    bus, wire, clock = made(connect=False)
    wire.codec.feedback_ids[1] = 0x2A
    with pytest.raises(BusError, match=r"joint_2 .*no answer on 0x12(.|\n)*from other identifiers: 0x2a"):
        bus.connect(clock)


def test_lost_frames_are_asked_again_and_a_connection_stays_below_a_second():
    bus, wire, clock = made(connect=False)
    lost, draw = [], random.Random(1)

    def lose(row: int, kind: int) -> bool:
        lost.append(draw.random() < 0.4)
        return lost[-1]

    wire.lose = lose
    bus.connect(clock)
    assert clock.now() - 100 < 1.0
    assert sum(lost) > 10


def test_a_motor_that_stays_enabled_is_refused():
    bus, wire, clock = made(connect=False)
    wire.status[1], wire.obey_disable = 1, False
    with pytest.raises(BusError, match=r"joint_2 \(id 0x2\): enabled, expected disabled"):
        bus.connect(clock)


def test_what_waited_on_the_wire_is_no_answer():
    bus, wire, clock = made(connect=False)
    wire.arrive(wire.codec.pack_register(0, Operation.READ, "PMAX", 12.5))
    wire.silent = {0}
    with pytest.raises(BusError, match="joint_1 .*no answer on 0x11 to a request for register PMAX"):
        bus.connect(clock)


def test_a_late_echo_of_a_write_does_not_pass_for_reading_back():
    bus, wire, clock = made(connect=False)
    asked: list[int] = []  # operations on TIMEOUT of joint_1

    def lose(row: int, kind: int) -> bool:
        """Every request to read TIMEOUT of joint_1 is lost, and the echo of the write before it arrives."""
        requests = [damiao.unpack_register(data) for data in wire.sent[-1]["data"]]
        if row or kind != Kind.REGISTER or requests[0].register != "TIMEOUT":
            return False
        asked.append(requests[len(asked) % 2].operation)
        return asked[-1] == Operation.READ

    wire.lose = lose
    with pytest.raises(BusError, match="joint_1 .*no answer on 0x11 to a request for register TIMEOUT"):
        bus.connect(clock)
    assert asked == [Operation.WRITE, Operation.READ] * TRIES


def test_connecting_again_does_not_take_an_old_state_for_an_answer():
    bus, wire, clock = made()
    bus.poll()
    bus.read(clock.now())
    clock.time += 1.0
    refresh = damiao.RegisterFrame(2, Operation.REFRESH, "", 0)
    wire.lose = lambda row, kind: (
        kind == Kind.REGISTER
        and (
            row == 1 and damiao.unpack_register(wire.sent[-1]["data"][row if len(wire.sent[-1]) == 3 else 0]) == refresh
        )
    )
    with pytest.raises(BusError, match=r"joint_2 .*no answer on 0x12 to a request for its state") as refused:
        bus.connect(clock)
    assert "joint_1" not in str(refused.value)


def test_other_traffic_while_connecting_does_no_harm():
    bus, wire, clock = made(connect=False)
    send = wire.send

    def send_among_others(frames: np.ndarray) -> None:
        send(frames)
        others = wire.feedback()
        others["id"] += 0x100
        wire.arrive(others)
        wire.arrive(wire.codec.pack_register(1, Operation.READ, "SN", 99))  # another program asks too

    wire.send = send_among_others
    bus.connect(clock)
    assert bus.counters.rejected == 3


def test_nothing_is_sent_before_connecting():
    bus, wire, _ = made(connect=False)
    for act in (bus.poll, bus.enable, lambda: bus.write(command(kp=np.ones(3)))):
        with pytest.raises(BusError, match="bus leg: not connected; call connect"):
            act()
    assert wire.sent == []


def test_damping_needs_no_connecting():
    """It is what a process sends to motors that another one, now dead, had connected."""
    bus, wire, _ = made(connect=False)
    bus.write(command(kd=np.ones(3)))
    assert len(np.concatenate(wire.sent)) == 3


# One tick


def test_poll_asks_without_commanding():
    bus, wire, clock = made()
    wire.position[:] = [0.1, -0.2, 0.3]
    bus.poll()
    assert kinds(wire) == [Kind.REGISTER] * 3
    state = bus.read(5.0)
    np.testing.assert_allclose(state.position, [0.1, -0.2, 0.3], atol=4e-4)
    assert state.time.tolist() == [5.0] * 3


def test_enable_write_and_disable():
    bus, wire, clock = made()
    bus.enable()
    assert kinds(wire) == [Kind.ENABLE] * 3 and wire.status.tolist() == [1, 1, 1]
    bus.write(command(position=np.array([0.5, 0.0, -0.5])))
    assert bus.read(clock.now()).enabled.all()
    bus.disable()
    assert kinds(wire)[-3:] == [Kind.DISABLE] * 3 and wire.status.tolist() == [0, 0, 0]
    bus.poll()
    assert not bus.read(clock.now()).enabled.any()


def test_state_is_kept_with_the_time_of_each_motor():
    bus, wire, clock = made()
    bus.poll()
    bus.read(1.0)
    wire.silent = {1}
    bus.poll()
    state = bus.read(2.0)
    assert state.time.tolist() == [2.0, 1.0, 2.0]
    assert bus.read(3.0) is state
    assert state.time.tolist() == [2.0, 1.0, 2.0]


def test_errors_are_named_and_lost_communication_is_cleared_by_polling():
    bus, wire, clock = made()
    wire.status[:] = [0xD, 0xB, 0]
    bus.poll()
    state = bus.read(1.0)
    assert [bus.error_name(int(e)) for e in state.error] == ["lost communication", "driver over-temperature", "none"]
    wire.sent.clear()
    bus.poll()
    assert kinds(wire) == [Kind.CLEAR_ERROR, Kind.REGISTER, Kind.REGISTER]
    bus.poll()
    assert bus.read(2.0).error.tolist() == [0, 0xB, 0]


def test_enabling_clears_what_is_left_of_an_error():
    bus, wire, clock = made()
    wire.status[:] = [0, 0xB, 0]
    bus.poll()
    bus.read(1.0)
    wire.sent.clear()
    bus.enable()
    assert kinds(wire) == [Kind.CLEAR_ERROR] + [Kind.ENABLE] * 3
    assert wire.status.tolist() == [1, 1, 1]


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("quantity", MotorCommand.__slots__)
def test_a_command_that_is_not_finite_sends_nothing(quantity, value):
    bus, wire, _ = made()
    with pytest.raises(ValueError, match=f"{quantity} {value}"):
        bus.write(command(**{quantity: np.array([0.0, value, 0.0])}))
    assert wire.sent == []


@given(st.lists(st.floats(allow_nan=False, allow_infinity=False), min_size=15, max_size=15))
def test_no_write_enables_disables_zeroes_or_clears(values):
    bus, wire, _ = BUS
    wire.sent.clear()
    bus.write(MotorCommand(*np.array(values).reshape(5, 3)))
    assert kinds(wire) == [Kind.COMMAND] * 3
    assert wire.sent[0]["id"].tolist() == [1, 2, 3]


BUS = made()


def test_strangers_and_error_frames_are_counted():
    bus, wire, _ = made()
    stranger = wire.feedback()[:1]
    stranger["id"] = 0x77
    error = stranger.copy()
    error["id"] = ERROR | 0x40
    wire.arrive(np.concatenate([stranger, error, wire.feedback()]))
    before = bus.counters.received
    bus.read(7.0)
    assert bus.counters.received - before == 4
    assert bus.counters.rejected == 1
    assert bus.counters.extra["bus_errors"] == 1


# A wire in trouble


def test_a_full_queue_drops_ticks_and_is_an_error_after_a_second():
    bus, wire, clock = made()
    wire.refuse = refuse(WireFull("sent 1 of 3 frames: No buffer space available"))
    clock.time += 0.5
    bus.write(command())
    assert bus.counters.lost == 1
    clock.time += QUEUE_FULL_TIME - 0.51
    bus.write(command())
    clock.time += 0.02
    with pytest.raises(BusError, match=r"leg \(socketcan can7\): the transmit queue is full(.|\n)*Check motor power"):
        bus.write(command())
    wire.refuse = lambda frames: None
    bus.write(command())  # the bus is back
    wire.refuse = refuse(WireFull("again"))
    clock.time += 0.5
    bus.poll()
    assert bus.counters.lost == 4


def test_enabling_half_a_bus_is_an_error():
    bus, wire, _ = made()
    wire.refuse = refuse(WireFull("sent 1 of 3 frames"))
    with pytest.raises(BusError, match="transmit queue is full"):
        bus.enable()


def test_a_wire_that_is_gone_is_a_bus_error():
    bus, wire, _ = made()
    wire.refuse = refuse(WireError("Network is down"))
    for act in (bus.poll, bus.enable, lambda: bus.write(command(kp=np.ones(3)))):
        with pytest.raises(BusError, match=r"bus leg \(socketcan can7\): Network is down"):
            act()
    wire.recv = refuse_recv
    with pytest.raises(BusError, match="Network is down"):
        bus.read(1.0)


def refuse_recv() -> np.ndarray:
    raise WireError("Network is down")


@pytest.mark.parametrize("error", [WireFull("full"), WireError("gone"), OSError(19, "No such device")])
def test_disable_never_raises(error):
    bus, wire, _ = made()
    wire.refuse = refuse(error)
    bus.disable()
    assert bus.counters.extra["disable_failed"] == 1


def test_close_closes_the_wire():
    bus, wire, _ = made()
    bus.close()
    assert wire.closed


def test_two_motors_of_different_models_are_scaled_each_by_its_own():
    spec = leg(2)
    spec = replace(spec, motors=(replace(spec.motors[0], model="DM10010L"), spec.motors[1]))
    wire = ScriptedMotors(spec)
    bus = open_bus(spec, wire)
    bus.connect(FakeClock())
    wire.torque[:] = [150.0, 30.0]
    bus.poll()
    np.testing.assert_allclose(bus.read(1.0).torque, [150, 30], atol=0.1)


# Several buses in one call


def pair() -> tuple[list[CanBus], list[ScriptedMotors], FakeClock]:
    """Two connected buses with the same identifiers on both."""
    (one, left, clock), (two, right, _) = made(3), made(2, name="arm")
    left.position[:], right.position[:] = [0.1, 0.2, 0.3], [0.4, 0.5]
    return [one, two], [left, right], clock


def whole(buses: list[CanBus]) -> CanBuses:
    ((all_of_them, motors),) = joined(buses)
    assert isinstance(all_of_them, CanBuses) and motors == 5
    return all_of_them


def test_buses_in_one_call_send_and_hear_what_each_would_alone():
    rng = np.random.default_rng(0)
    asked = command(5, position=rng.normal(size=5), kp=np.full(5, 20.0), kd=np.ones(5), torque=rng.normal(size=5))
    alone, wires, clock = pair()
    for bus, rows in zip(alone, (slice(0, 3), slice(3, 5)), strict=True):
        bus.write(MotorCommand(*(getattr(asked, name)[rows] for name in MotorCommand.__slots__)))
    together, others, _ = pair()
    buses = whole(together)
    buses.write(asked)
    for wire, other in zip(wires, others, strict=True):
        assert [f.tobytes() for f in wire.sent] == [f.tobytes() for f in other.sent]
    state = buses.read(clock.now())
    for name in MotorState.__slots__:
        expected = np.concatenate([getattr(bus.read(clock.now()), name) for bus in alone])
        np.testing.assert_array_equal(getattr(state, name), expected)
        np.testing.assert_array_equal(np.concatenate([getattr(bus.read(0.0), name) for bus in together]), expected)
    assert [bus.counters for bus in together] == [bus.counters for bus in alone]


@pytest.mark.parametrize("spoil", ["lost", "stranger", "error frame"])
def test_buses_in_one_call_take_a_tick_that_is_not_whole_apart(spoil):
    together, (left, right), clock = pair()
    buses = whole(together)
    buses.write(command(5))
    rejected = [bus.counters.rejected for bus in together]
    if spoil == "lost":
        right._waiting.pop(0)
    else:
        frame = right._waiting[0].copy()
        frame["id"] = ERROR if spoil == "error frame" else 0x123
        right._waiting.insert(0, frame)
    clock.time += 1.0
    state = buses.read(clock.now())
    fresh = state.time == clock.now()
    assert fresh.tolist() == [True, True, True, spoil != "lost", True]
    heard = [0.1, 0.2, 0.3, 0.0 if spoil == "lost" else 0.4, 0.5]  # 0: while connecting
    np.testing.assert_allclose(state.position, heard, atol=1e-3)
    assert together[1].counters.rejected - rejected[1] == (spoil == "stranger")
    assert together[1].counters.extra["bus_errors"] == (spoil == "error frame")
    assert together[0].counters.rejected == rejected[0] and together[0].counters.extra["bus_errors"] == 0


@pytest.mark.parametrize("dead", [0, 1])
def test_buses_in_one_call_drive_and_hear_the_others_of_a_dead_one(dead):
    together, wires, clock = pair()
    buses = whole(together)

    def gone(*frames: np.ndarray) -> np.ndarray:
        raise WireError("no such device")

    wires[dead].refuse = gone
    with pytest.raises(BusError, match=together[dead].spec.name):
        buses.write(command(5))
    assert len(wires[1 - dead].sent) == 1
    wires[dead].recv = gone  # type: ignore[method-assign]
    clock.time += 1.0
    with pytest.raises(BusError, match=together[dead].spec.name):
        buses.read(clock.now())
    assert [(bus._state.time == clock.now()).all() for bus in together] == [dead == 1, dead == 0]


def test_buses_in_one_call_refuse_what_each_would():
    together, wires, _ = pair()
    buses = whole(together)
    with pytest.raises(ValueError, match="finite"):
        buses.write(command(5, position=np.array([0, 0, 0, 0, np.nan])))
    assert not any(wire.sent for wire in wires)
    strangers = whole([made(3, connect=False)[0], made(2, connect=False)[0]])
    with pytest.raises(BusError, match="not connected"):
        strangers.write(command(5, kp=np.ones(5)))
    strangers.write(command(5, kd=np.ones(5)))  # damping is what may always be sent


def test_only_neighbours_of_one_plain_protocol_are_joined():
    one, _, _ = made(3, connect=False)
    other = open_bus(replace(leg(2), protocol="mini_cheetah", watchdog=0.0, name="arm",
                             motors=tuple(MotorSpec(f"j{i}", "mini-cheetah", i) for i in (1, 2))), ScriptedMotors(leg(2)))  # fmt: skip
    assert joined([one, other, other]) == [(one, 3), (other, 2), (other, 2)]
