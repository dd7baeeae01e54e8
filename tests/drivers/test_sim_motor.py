"""Emulated motors: golden answers, the state machine, the watchdog, and torque between commands."""

from __future__ import annotations

import struct

import numpy as np
import pytest
from sim_robots import ARM_INERTIA, BUS, CLEAR, DISABLE, ENABLE, REFRESH, SET_ZERO, Host, answers, make_world, mit

from drivers.bus import BusError, BusSpec, MotorSpec

# At rest at zero: error << 4 | id, position 7FFF, velocity 7FF, torque 7FF (zero is the code below the middle), 25 C twice.
REST = "{:x}{:x} 7f ff 7f f7 ff 19 19"
REGISTER = 0x7FF


@pytest.fixture
def host(tmp_path) -> Host:
    return Host(make_world(tmp_path))


def error_of(host: Host, id: int = 1) -> int:
    """The error nibble that the motor answers a question with."""
    (_, data) = host.ask(REGISTER, bytes([id]) + REFRESH[1:])[0]
    return int(data[0], 16)


def set_register(host: Host, number: int, value: bytes, id: int = 1) -> None:
    assert host.ask(REGISTER, bytes([id, 0, 0x55, number]) + value) == [
        (0x10 + id, bytes([id, 0, 0x55, number]).hex(" ") + " " + value.hex(" "))
    ]


def events(host: Host, joint: str = "left") -> list[str]:
    return [e.event for e in host.world.motor_log if e.joint == joint]


def test_special_frames_are_answered_and_then_obeyed(host):
    assert host.ask(1, ENABLE) == [(0x11, REST.format(0, 1))]
    assert host.ask(2, ENABLE) == [(0x12, REST.format(0, 2))]
    assert host.ask(1, DISABLE) == [(0x11, REST.format(1, 1))]
    assert host.ask(1, CLEAR) == [(0x11, REST.format(0, 1))]
    assert events(host) == ["enabled", "disabled"]


def test_refresh_answers_with_the_state(host):
    assert host.ask(REGISTER, REFRESH) == [(0x11, REST.format(0, 1))]


@pytest.mark.parametrize(
    ("request_", "answer"),
    [
        # PMAX (21 = 0x15): 12.5 = 0x41480000, little-endian.
        ("01 00 33 15 00 00 00 00", "01 00 33 15 00 00 48 41"),
        # CTRL_MODE (10): MIT.
        ("01 00 33 0a 00 00 00 00", "01 00 33 0a 01 00 00 00"),
        # MST_ID (7).
        ("01 00 33 07 00 00 00 00", "01 00 33 07 11 00 00 00"),
        # TIMEOUT (9) := 1600 ticks = 80 ms.
        ("01 00 55 09 40 06 00 00", "01 00 55 09 40 06 00 00"),
        # Hardware version (13) cannot be written.
        ("01 00 55 0d 40 06 00 00", "01 00 55 0d 00 00 00 00"),
    ],
)
def test_registers(host, request_, answer):
    assert host.ask(REGISTER, bytes.fromhex(request_)) == [(0x11, answer)]


def test_silence_for_strangers(host):
    assert host.ask(3, ENABLE) == []
    assert host.ask(REGISTER, bytes([3]) + REFRESH[1:]) == []
    assert host.ask(0x101, bytes(8)) == []  # a position-velocity command, to a motor in MIT mode
    set_register(host, 10, struct.pack("<I", 2))
    assert host.ask(1, mit(0, 0, 0, 0, 0)) == []  # and the other way round


def test_a_disabled_motor_answers_but_gives_no_torque(host):
    host.command(position=1.0, kp=10.0)
    assert len(host.wait(0.004)) == 2
    host.wait(0.1)
    assert np.all(host.world.plant.joint_torque == 0.0)
    host.ask(1, ENABLE)
    host.wait(0.02)
    assert host.world.plant.joint_torque[0] == 0.0  # what it was told while disabled does not count


def test_law_runs_between_commands(host):
    """One command, then silence: the joint swings as the spring that it then is."""
    kp = 5.0
    host.send((1, ENABLE))
    host.wait(0.004)
    host.command(position=0.5, kp=kp, ids=(1,))
    positions = []
    for _ in range(1000):
        host.wait(0.002)
        positions.append(host.world.plant.joint_pos[0])
    peaks = [i for i in range(1, 999) if positions[i - 1] < positions[i] >= positions[i + 1]]
    # The wire has kp in steps of 500 / 4095.
    sent = round(kp / 500 * 4095) * 500 / 4095
    period = 2 * np.pi * np.sqrt(ARM_INERTIA / sent)
    assert np.mean(np.diff(peaks)) * 0.002 == pytest.approx(period, rel=0.01)


def test_damping_stops_a_joint_as_fast_as_the_formula(host):
    world = host.world
    host.send((1, ENABLE))
    host.wait(0.002)
    world.plant.data.qvel[:] = 5.0
    kd = 1.0
    host.command(kd=kd, ids=(1,))
    host.wait(0.002)
    before = world.plant.joint_vel[0]
    host.wait(0.02)
    assert world.plant.joint_vel[1] == pytest.approx(5.0)  # the other, disabled, coasts
    # Implicit in velocity: every substep divides by 1 + kd dt / I.
    assert world.plant.joint_vel[0] == pytest.approx(before / (1 + kd * 0.002 / ARM_INERTIA) ** 10, rel=1e-2)
    assert events(host) == ["enabled", "damping"]


def test_command_acts_from_its_arrival_on(host):
    """Within a substep, the impulse is the torque times what was left of it when the command arrived."""
    world = host.world
    host.send((1, ENABLE))
    host.wait(0.01)
    host.command(torque=4.0, ids=(1,))
    sent = world.time
    host.wait(0.002)
    arrival = world.motors.last_command_time[0] - sent
    torque = 8.0 * round((4.0 + 40) / 80 * 4095) / 4095 * 10 - 40
    assert 0.0003 < arrival < 0.0004  # 250 us of adapter and about 0.12 ms of wire
    assert world.plant.joint_vel[0] == pytest.approx(torque * (0.002 - arrival) / ARM_INERTIA, rel=1e-6)


def test_torque_is_limited_by_motor_and_joint(tmp_path):
    weak = BusSpec("arm", "damiao", (MotorSpec("left", "DM4310", 1, 0x11), MotorSpec("right", "DM8009", 2, 0x12)))
    host = Host(make_world(tmp_path, bus=weak))
    host.send((1, ENABLE), (2, ENABLE))
    host.wait(0.004)
    host.send((1, mit(3, 0, 500, 0, 0, (12.5, 30, 10))), (2, mit(3, 0, 500, 0, 0, (12.5, 45, 54))))
    host.wait(0.004)
    assert host.world.plant.joint_torque.tolist() == [10.0, 30.0]  # TMAX of a DM4310; the joint's own 30 N m


def test_feedback_is_the_truth_to_half_a_code_and_a_bit(tmp_path):
    host = Host(make_world(tmp_path, joint_pos={"left": 1.234, "right": -0.4321}))
    host.send((REGISTER, REFRESH), (REGISTER, bytes([2]) + REFRESH[1:]))
    frames = host.wait(0.004)
    codes = frames["data"][:, 1].astype(int) << 8 | frames["data"][:, 2]
    assert codes * 25 / 65535 - 12.5 == pytest.approx([1.234, -0.4321], abs=25 / 65535)


def test_sign_and_offset_place_the_joint(tmp_path):
    """joint = sign (motor - offset): a turned motor pulls the other way, towards the same place."""
    motors = (MotorSpec("left", "DM8006", 1, 0x11, sign=-1, offset=0.5), MotorSpec("right", "DM8006", 2, 0x12))
    host = Host(make_world(tmp_path, bus=BusSpec("arm", "damiao", motors), joint_pos={"left": 0.3}))
    (_, data) = host.ask(REGISTER, REFRESH)[0]
    assert int(data[3:8].replace(" ", ""), 16) * 25 / 65535 - 12.5 == pytest.approx(0.2, abs=1e-3)  # 0.5 - 0.3
    host.send((1, ENABLE))
    host.wait(0.002)
    for _ in range(500):
        host.command(position=-0.1, kp=20.0, kd=1.0, ids=(1,))
        host.wait(0.004)
    assert host.world.plant.joint_pos[0] == pytest.approx(0.6, abs=1e-3)  # -(-0.1 - 0.5)


@pytest.mark.parametrize(("wrap", "expected"), [(False, 0.5), (True, -0.2)])
def test_position_out_of_range(tmp_path, wrap, expected):
    host = Host(make_world(tmp_path, joint_pos={"left": 0.8}, wrap=wrap))
    set_register(host, 21, struct.pack("<f", 0.5))
    (_, data) = host.ask(REGISTER, REFRESH)[0]
    assert int(data[3:8].replace(" ", ""), 16) / 65535 - 0.5 == pytest.approx(expected, abs=1e-4)


def test_watchdog_trips_on_time_and_latches(host):
    set_register(host, 9, struct.pack("<I", 1600))  # 80 ms
    host.ask(1, ENABLE)
    for _ in range(50):
        host.command(kd=1.0, ids=(1,))
        host.wait(0.004)
    assert error_of(host) == 1
    while error_of(host) == 1:  # questions do not feed it
        assert host.world.time < 1.0
    tripped = next(e.time for e in host.world.motor_log if e.event == "watchdog")
    assert 0.080 <= tripped - host.world.last_command_times()["left"] < 0.082
    assert error_of(host) == 0xD
    host.ask(1, ENABLE)
    assert error_of(host) == 0xD  # not before it is cleared
    host.ask(1, CLEAR)
    assert error_of(host) == 0
    host.ask(1, ENABLE)
    assert error_of(host) == 1
    assert events(host) == ["enabled", "damping", "watchdog", "cleared", "enabled"]


def test_watchdog_takes_the_torque_away(host):
    set_register(host, 9, struct.pack("<I", 400))  # 20 ms
    host.ask(1, ENABLE)
    host.command(torque=2.0, ids=(1,))
    host.wait(0.01)
    assert host.world.plant.joint_torque[0] == pytest.approx(2.0, abs=0.02)
    host.wait(0.02)
    assert host.world.plant.joint_torque[0] == 0.0


def test_no_timeout_means_no_watchdog(host):
    host.ask(1, ENABLE)
    host.command(kd=1.0, ids=(1,))
    host.wait(2.0)
    assert error_of(host) == 1


def test_command_and_special_in_one_burst_keep_their_order(host):
    host.send((1, ENABLE), (1, mit(0, 0, 0, 0, 2.0)), (2, ENABLE), (2, mit(0, 0, 0, 0, 2.0)), (2, DISABLE))
    host.wait(0.01)
    assert host.world.plant.joint_torque == pytest.approx([2.0, 0.0], abs=0.02)
    host.send((1, mit(0, 0, 0, 0, 3.0)), (2, ENABLE))
    host.wait(0.01)
    assert host.world.plant.joint_torque == pytest.approx([3.0, 0.0], abs=0.02)


def test_an_old_command_does_not_survive_a_stop(host):
    host.ask(1, ENABLE)
    host.command(torque=2.0, ids=(1,))
    host.wait(0.004)
    host.ask(1, DISABLE)
    host.ask(1, ENABLE)
    host.wait(0.02)
    assert host.world.plant.joint_torque[0] == 0.0
    host.command(torque=2.0, ids=(1,))
    host.wait(0.004)
    assert host.world.plant.joint_torque[0] == pytest.approx(2.0, abs=0.02)  # told again, it obeys again


def test_a_command_too_late_for_the_watchdog_does_nothing(host):
    """It arrives in the very substep in which the watchdog trips, whatever the phase between the two."""
    set_register(host, 9, struct.pack("<I", 400))  # 20 ms, looked at in every substep of 2 ms
    outcomes = set()
    for gap in np.arange(0.019, 0.025, 0.0005):
        host.ask(1, CLEAR)
        host.ask(1, ENABLE)
        host.command(torque=1.0, ids=(1,))
        sent = host.world.time
        host.wait(gap)
        host.command(torque=2.0, ids=(1,))
        host.wait(0.004)
        kept = error_of(host) == 1
        outcomes.add(kept)
        assert host.world.plant.joint_torque[0] == pytest.approx(2.0 if kept else 0.0, abs=0.02)
        assert (host.world.last_command_times()["left"] > sent + 0.01) == kept
        host.ask(1, CLEAR)
        host.ask(1, ENABLE)
        host.wait(0.01)
        assert kept or host.world.plant.joint_torque[0] == 0.0
        host.ask(1, DISABLE)
    assert outcomes == {True, False}


def test_set_zero(tmp_path):
    host = Host(make_world(tmp_path, joint_pos={"left": 0.7}))
    host.ask(1, SET_ZERO)
    assert host.ask(REGISTER, REFRESH) == [(0x11, REST.format(0, 1))]
    host.ask(1, ENABLE)
    host.command(position=1.0, kp=20.0, kd=1.0, ids=(1,))
    host.wait(2.0)
    assert host.world.plant.joint_pos[0] == pytest.approx(1.7, abs=2e-3)  # zero velocity and torque are half a code off
    host.ask(1, SET_ZERO)  # here is 0 now, so the same target is 1 rad further on, without a new command
    host.wait(2.0)
    assert host.world.plant.joint_pos[0] == pytest.approx(2.7, abs=4e-3)


def test_power_cycle_loses_turns_and_unsaved_registers(tmp_path):
    host = Host(make_world(tmp_path, joint_pos={"left": 4.0}, faults=["reboot:arm/left=0.1@0.1"]))
    set_register(host, 9, struct.pack("<I", 1600))
    host.ask(REGISTER, bytes([1, 0, 0xAA, 0, 0, 0, 0, 0]))  # store
    set_register(host, 9, struct.pack("<I", 4000))
    host.ask(1, ENABLE)
    host.wait(0.15 - host.world.time)
    assert host.ask(REGISTER, REFRESH) == []
    host.wait(0.1)
    (_, data) = host.ask(REGISTER, REFRESH)[0]
    assert data[0] == "0"
    assert int(data[3:8].replace(" ", ""), 16) * 25 / 65535 - 12.5 == pytest.approx(4.0 - 2 * np.pi, abs=1e-3)
    assert host.ask(REGISTER, bytes([1, 0, 0x33, 9, 0, 0, 0, 0])) == [(0x11, "01 00 33 09 40 06 00 00")]
    assert events(host) == ["enabled", "powered off", "powered on"]


def test_a_hot_rotor_disables_itself(host):
    set_register(host, 2, struct.pack("<f", 26.0))  # OT_VALUE
    host.ask(1, ENABLE)
    host.command(position=0.0, kp=500.0, torque=30.0, ids=(1,))
    host.wait(3.0)
    assert error_of(host) == 0xC
    assert events(host) == ["enabled", "driving", "over-temperature"]
    assert host.world.motors.rotor_temperature[1] == 25.0  # the other did nothing


def test_unknown_protocol_is_refused_by_name(tmp_path):
    with pytest.raises(BusError, match="arm.*'dynamixel'.*damiao"):
        make_world(tmp_path, bus=BusSpec("arm", "dynamixel", BUS.motors))


def test_extended_and_short_frames_are_ignored(host):
    from drivers.wire import EXTENDED, make_frames

    frames = make_frames(np.array([1 | EXTENDED, 1], np.uint32), np.full((2, 8), 0xFF, np.uint8))
    frames["length"][1] = 7
    host.wire.send(frames)
    assert answers(host.wait(0.01)) == []
