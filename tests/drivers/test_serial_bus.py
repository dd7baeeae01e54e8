"""SerialBus on emulated servos in lockstep: connecting, turns on a shared line, lost answers, watchdog, stop path."""

from __future__ import annotations

import numpy as np
import pytest
from sim_servos import PERIOD, Bench, tick
from test_dynamixel import command

from drivers.bus import BusError, MotorSpec
from drivers.codecs import dynamixel
from drivers.codecs.dynamixel import DynamixelCodec
from drivers.codecs.dynamixel_packet import pack_write
from drivers.serial_bus import FAST_FAILURES, REPLY_MARGIN, SerialBus
from drivers.sim.serial_pty import bus_of
from drivers.wire import WireError, WireFull


def events(bench: Bench, joint: str = "servo_1") -> list[str]:
    return [e.event for e in bench.servos.log if e.joint == joint]


def enabled(bench: Bench, bus: SerialBus) -> SerialBus:
    tick(bus, bench)
    bus.enable()
    state = tick(bus, bench, command(len(bench.spec.motors)))
    assert state.enabled.all()
    return bus


# -- connecting ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("fast", [True, False])
def test_connects_and_leaves_everything_programmed_and_off(fast):
    bench = Bench(4, fast=fast)
    bus = bench.connected()
    state = bus.read(bench.time)
    assert not state.enabled.any() and (state.error == 0).all() and np.isfinite(state.position).all()
    assert bench.time < 0.3
    for joint in bench.servos.joints:
        assert bench.servos.register(joint, "BUS_WATCHDOG") == 4  # 0.08 s
        assert bench.servos.register(joint, "INDIRECT") == dynamixel.INDIRECT_VALUE
        assert bench.servos.register(joint, "POSITION_D_GAIN") == 0


MISFITS = {
    "RETURN_DELAY": (250, "servo_2 .id 2, XM430-W350.: register RETURN_DELAY is 250, expected 0\n"),
    "OPERATING_MODE": (5, "register OPERATING_MODE is 5, expected 3 to 4"),
    "DRIVE_MODE": (1, "register DRIVE_MODE is 1, expected 0"),
    "MODEL": (1030, "register MODEL is 1030, expected 1020"),
    "FIRMWARE": (37, "register FIRMWARE is 37, expected 38 to 255"),
}


@pytest.mark.parametrize("register, value, said", [(k, *v) for k, v in MISFITS.items()], ids=MISFITS)
def test_a_servo_that_is_not_what_the_wiring_says_is_refused_by_name(register, value, said):
    bench = Bench(3, registers={"servo_2": {register: value}})
    with pytest.raises(BusError, match=said) as refusal:
        bench.connected()
    assert "servo_1" not in str(refusal.value) and "servo_3" not in str(refusal.value)


def test_a_servo_at_another_bit_rate_is_silent_and_named():
    with pytest.raises(BusError, match="motor of servo_3 .id 3.: no answer"):
        Bench(3, registers={"servo_3": {"BAUD": 3}}).connected()


def test_a_servo_that_would_not_answer_is_told_to():
    bench = Bench(2, registers={"servo_2": {"STATUS_RETURN_LEVEL": 0}})
    bench.connected()
    assert bench.servos.register("servo_2", "STATUS_RETURN_LEVEL") == 2


def test_a_silent_servo_is_named():
    bench = Bench(3, faults=("off:servos/servo_3",))
    with pytest.raises(BusError, match="motor of servo_3 .id 3.: no answer") as refusal:
        bench.connected()
    assert "servo_1" not in str(refusal.value)


def test_connects_although_a_tenth_of_all_answers_is_lost():
    bus = Bench(3, faults=("drop:0.1",), seed=3).connected()
    assert np.isfinite(bus.read(1.0).position).all()


def test_an_error_is_rebooted_away_before_anything_is_programmed():
    bench = Bench(2)
    bench.servos.fail("servo_2", 0x20, 0.0)
    bench.connected()
    assert "rebooted" in events(bench, "servo_2") and "rebooted" not in events(bench)
    assert bench.servos.register("servo_2", "BUS_WATCHDOG") == 4


def test_an_error_that_comes_back_is_refused():
    bench = Bench(2)
    fail = bench.servos.fail
    bench.servos._factory[1, dynamixel.REGISTERS["HARDWARE_ERROR"].address] = 0x01
    fail("servo_2", 0x01, 0.0)
    with pytest.raises(BusError, match="servo_2.*input voltage, also after a reboot"):
        bench.connected()


def test_nothing_goes_out_before_connecting():
    bench = Bench(1)
    bus = SerialBus(bench.spec, DynamixelCodec(bench.spec), bench.wire)
    for act in (bus.poll, bus.enable, lambda: bus.write(command(1))):
        with pytest.raises(BusError, match="not connected"):
            act()


def test_a_servo_that_was_enabled_by_somebody_else_is_off_after_connecting():
    bench = Bench(2)
    bench.ask(pack_write(1, 64, b"\1"))
    assert bench.servos.register("servo_1", "TORQUE_ENABLE") == 1
    assert not bench.connected().read(bench.time).enabled.any()


# -- the law ---------------------------------------------------------------------------------------------------------


def test_a_target_gives_the_torque_of_the_pd_law():
    """Against a wall: the torque is kp times the error, within the P gain's step and one tick."""
    bench = Bench(1)
    bus = enabled(bench, bench.connected())
    bench.body.step = lambda timestep: setattr(
        bench.body, "joint_torque", bench.body._law[0] - bench.body._law[1] * bench.body.joint_pos
    )
    state = tick(bus, bench, command(1, position=0.1, kp=10.0, torque=0.5), ticks=4)
    assert state.torque[0] == pytest.approx(10.0 * 0.1 + 0.5, rel=0.02)


def test_follows_a_target_and_damps_by_back_emf():
    bench = Bench(2)
    bus = enabled(bench, bench.connected())
    state = tick(bus, bench, command(2, position=0.5, kp=15.0), ticks=300)
    np.testing.assert_allclose(state.position, 0.5, atol=0.01)
    bench.body.joint_vel[:] = 3.0
    state = tick(bus, bench, command(2, kd=1.0), ticks=20)
    assert (np.abs(state.velocity) < 0.05).all(), "windings are shorted"


def test_sign_and_offset_of_a_wiring_are_the_joints():
    motors = (MotorSpec("servo_1", "XM430-W350", 1, sign=-1, offset=0.3),)
    bench = Bench(spec=bus_of("XM430-W350", 1, motors=motors))
    bus = enabled(bench, bench.connected())
    state = tick(bus, bench, command(1, position=0.5, kp=15.0), ticks=300)
    assert state.position[0] == pytest.approx(0.5, abs=0.01)
    assert bench.body.joint_pos[0] == pytest.approx(-(0.5 - 0.3), abs=0.01)


# -- turns on the line -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("fast", [True, False])
def test_every_tick_brings_every_state(fast):
    bench = Bench(20, fast=fast)
    bus = enabled(bench, bench.connected())
    received = bus.counters.received
    for _ in range(20):
        state = tick(bus, bench, command(20))
        assert (state.time == bench.time).all()
    assert bus.counters.received == received + 400
    assert (bus.counters.rejected, bus.counters.lost, bench.line.traffic.collisions) == (0, 0, 0)


def test_a_lost_answer_leaves_the_others_alone_and_costs_less_than_two_milliseconds():
    bench = Bench(20, faults=("drop:servos/servo_7@0.5",), fast=False)
    bus = enabled(bench, bench.connected())
    bench.sleep_until(0.5)
    others = np.arange(20) != 6
    for _ in range(40):
        state = tick(bus, bench, command(20))
        assert (state.time[others] == bench.time).all()
    assert bus.counters.lost == 0, "every tick was sent"
    assert bench.time - state.time[6] > 39 * PERIOD
    cost = bus._due - bus._asked - (20 * DynamixelCodec.TICK_BITS[0] + DynamixelCodec.TICK_OVERHEAD_BITS) / 4e6
    assert 0 < cost < 0.002


def test_servos_behind_a_dead_one_are_asked_before_it():
    """Servos wait for their predecessor in the list: the dead one goes to its end."""
    bench = Bench(5, faults=("off:servos/servo_2@0.5",), fast=False)
    bus = enabled(bench, bench.connected())
    bench.sleep_until(0.5)
    tick(bus, bench, command(5), ticks=3)
    state = tick(bus, bench, command(5))
    np.testing.assert_array_equal(state.time == bench.time, [True, False, True, True, True])


def test_a_tick_that_comes_while_servos_answer_is_dropped_and_not_queued():
    bench = Bench(20)
    bus = enabled(bench, bench.connected())
    bus.write(command(20, position=0.1, kp=1.0))
    bench.wait(0.0005)
    bus.read(bench.time)
    bus.write(command(20, position=0.9, kp=1.0))
    assert bus.counters.extra["line_busy"] == 1 and bus.counters.lost == 1
    bench.wait(0.004)
    state = bus.read(bench.time)
    assert (state.time == bench.time).all() and bench.line.traffic.collisions == 0
    tick(bus, bench, command(20, position=0.2, kp=1.0))
    expected = 2048 + round(0.2 * 4096 / (2 * np.pi))
    assert bench.servos.register("servo_1", "GOAL_POSITION") == expected


def test_fast_reads_are_given_up_after_ten_failures():
    bench = Bench(5, fast=True)
    bus = enabled(bench, bench.connected())
    bench.servos.fast = False
    tick(bus, bench, command(5), ticks=FAST_FAILURES)
    assert bus.counters.extra["fast_fallbacks"] == 0
    state = tick(bus, bench, command(5), ticks=2)
    assert bus.counters.extra["fast_fallbacks"] == 1
    assert (state.time == bench.time).all()


def test_a_dead_servo_in_a_fast_answer_silences_only_those_behind_it():
    bench = Bench(5, faults=("off:servos/servo_3@0.5",), fast=True)
    bus = enabled(bench, bench.connected())
    bench.sleep_until(0.5)
    tick(bus, bench, command(5), ticks=2)
    state = tick(bus, bench, command(5))
    assert bus._fast and (bench.time - state.time[[0, 1, 3, 4]] < 2 * PERIOD + 1e-9).all()


def test_a_noisy_line_never_says_what_was_not_said():
    bench = Bench(5, faults=("corrupt:0.3@0.3",), fast=False, seed=1)
    bus = enabled(bench, bench.connected())
    bench.sleep_until(0.3)
    for _ in range(60):
        state = tick(bus, bench, command(5))
        assert (np.abs(state.position) < 0.01).all() and (state.temperature == 25).all()
    assert bus.counters.rejected > 20 and bus.counters.received > 100


# -- watchdog and stop -----------------------------------------------------------------------------------------------


def test_the_watchdog_trips_is_told_and_is_recovered_only_when_off():
    bench = Bench(2)
    bus = enabled(bench, bench.connected())
    tick(bus, bench, command(2, kp=5.0))
    bench.wait(0.1)
    assert events(bench)[-1] == "watchdog"
    state = tick(bus, bench, command(2, kp=5.0), ticks=2)
    assert not state.enabled.any() and bus.error_name(int(state.error[0])) == "bus watchdog tripped"
    bus.disable()
    state = tick(bus, bench, ticks=3)
    assert (state.error == 0).all() and not state.enabled.any()
    enabled(bench, bus)


def test_enabling_does_not_move_anything():
    bench = Bench(2)
    bus = bench.connected()
    bench.body.joint_pos[:] = 0.7
    enabled(bench, bus)
    np.testing.assert_allclose(bench.body.joint_pos, 0.7, atol=1e-6)


def test_disable_does_not_wait_for_its_turn_and_is_repeated_until_it_was_heard():
    bench = Bench(20)
    bus = enabled(bench, bench.connected())
    bus.write(command(20))
    bench.wait(0.0012)  # in the middle of the answers
    bus.disable()
    bench.wait(PERIOD)
    assert bench.line.traffic.collisions > 0
    for _ in range(3):
        state = tick(bus, bench)
    assert not state.enabled.any() and not any(bench.servos.register(j, "TORQUE_ENABLE") for j in bench.servos.joints)


def test_polling_alone_enables_nothing_and_disables_nothing():
    bench = Bench(2)
    bus = enabled(bench, bench.connected())
    state = tick(bus, bench, ticks=5)
    assert state.enabled.all()


def test_disable_never_raises():
    bench = Bench(1)
    bus = bench.connected()
    bench.wire.close()
    bus.disable()
    assert bus.counters.extra["disable_failed"] == 1


@pytest.mark.parametrize("fault, error", [("bus_off@0.3", WireError), ("no_buffer@0.3", WireFull)])
def test_a_dead_adapter_is_a_bus_error(fault, error):
    bench = Bench(1, faults=(fault,))
    bus = enabled(bench, bench.connected())
    while bench.time < 0.3 - PERIOD:
        tick(bus, bench, command(1))
    last = bench.time - PERIOD
    with pytest.raises(BusError) as refusal:
        for _ in range(400):
            bus.write(command(1))
            bench.wait(PERIOD)
    assert isinstance(refusal.value.__cause__, error)
    if error is WireFull:
        assert 1.0 <= bench.time - last < 1.01


def test_a_value_that_is_not_finite_sends_nothing():
    bench = Bench(1)
    bus = enabled(bench, bench.connected())
    sent = bus.counters.sent
    with pytest.raises(ValueError, match="not finite"):
        bus.write(command(1, position=np.nan))
    assert bus.counters.sent == sent


def test_shut_down_by_overload_is_told_and_stays_off():
    bench = Bench(2)
    bus = enabled(bench, bench.connected())
    bench.servos.fail("servo_2", 0x20, bench.time)
    state = tick(bus, bench, command(2), ticks=2)
    np.testing.assert_array_equal(state.enabled, [True, False])
    assert bus.error_name(int(state.error[1])) == "overload"
    bus.enable()
    state = tick(bus, bench, command(2), ticks=2)
    np.testing.assert_array_equal(state.enabled, [True, False])


def test_the_same_seed_carries_the_same_bytes():
    import hashlib

    def run() -> str:
        bench = Bench(4, faults=("drop:0.05", "corrupt:0.05", "wrong:0.02@0.5"), seed=5, fast=False)
        bus = bench.connected()
        tick(bus, bench, ticks=150)
        sha = hashlib.sha256()
        bench.line.digest(sha)
        return sha.hexdigest()

    assert run() == run()


def test_the_line_is_used_to_nine_tenths_of_what_it_can_carry():
    """Servos without gaps, no adapter: ticks as fast as the line allows, 20 servos at 4 Mbit/s."""
    bench = Bench(20, fast=False, latency=0.0, gap=0.0)
    bus = enabled(bench, bench.connected())
    typical = 20 * DynamixelCodec.TICK_BITS[0] + DynamixelCodec.TICK_OVERHEAD_BITS
    best = 4_000_000 / typical  # Hz
    period, ticks = 1.02 / best, 200
    received = bus.counters.received
    tick(bus, bench, command(20), ticks=ticks, period=period)
    rate = (bus.counters.received - received) / 20 / (ticks * period)
    assert rate >= 0.9 * best
    assert bus.counters.lost == 0 and REPLY_MARGIN < 0.002
