"""What every CAN protocol must do, on its own emulated motors: connect, hold, damp, stop, trip, and survive a bad wire."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from can_bench import FORGETFUL, RATE, RIGS, SET_BEFORE, Bench, rig
from hypothesis import given, settings
from hypothesis import strategies as st
from sim_robots import ARM_INERTIA

from drivers.budget import budget
from drivers.bus import BusError, MotorState
from drivers.open import PROTOCOLS, open_codec
from drivers.wire import EXTENDED, frame_type

CAN = [name for name, protocol in PROTOCOLS.items() if protocol.wire == "can"]
pytestmark = pytest.mark.parametrize("protocol", CAN)


def test_there_is_a_rig(protocol):
    assert protocol in RIGS


def test_connecting_leaves_every_motor_disabled_and_heard(tmp_path, protocol):
    bench = Bench(tmp_path, protocol, joint_pos={"left": 0.5, "right": -0.25})
    state = bench.poll(0.1)
    assert not state.enabled.any() and not state.error.any()
    assert state.position == pytest.approx([0.5, -0.25], abs=1e-3)
    assert np.abs(state.velocity).max() < 0.05
    assert (bench.torque == 0.0).all()
    assert (bench.world.time - state.time < 0.02).all()


def test_a_target_is_reached_and_reported(tmp_path, protocol):
    bench = Bench(tmp_path, protocol)
    bench.enable()
    state = bench.run(0.6, position=[0.4, -0.6], kp=10.0, kd=0.6)
    assert bench.world.plant.joint_pos == pytest.approx([0.4, -0.6], abs=5e-3)
    assert state.position == pytest.approx(bench.world.plant.joint_pos, abs=1e-3)
    assert state.enabled.all() and not state.error.any()


def test_the_law_is_the_one_that_was_asked_for(tmp_path, protocol):
    """Started off target, the joint moves as kp (q* - q) + kd (v* - v) + tau says, integrated by hand."""
    bench = Bench(tmp_path, protocol)
    bench.enable()
    bench.run(0.1, kp=8.0, kd=0.5)
    bench.world.plant.data.qpos[:] = [0.3, -0.2]
    bench.world.plant.data.qvel[:] = 0.0
    bench.run(0.1, position=0.1, velocity=0.4, kp=8.0, kd=0.5, torque=0.3)
    q, v, dt = np.array([0.3, -0.2]), np.zeros(2), 1e-5
    for _ in range(round(0.1 / dt)):
        v += dt * (8.0 * (0.1 - q) + 0.5 * (0.4 - v) + 0.3) / ARM_INERTIA
        q += dt * v
    # The first command arrives half a millisecond late, and the plant's substep is 2 ms.
    assert bench.world.plant.joint_pos == pytest.approx(q, abs=0.02)
    assert np.abs(q - [0.3, -0.2]).min() > 0.1


def test_damping_brakes_and_lets_move(tmp_path, protocol):
    bench = Bench(tmp_path, protocol)
    bench.enable()
    bench.run(0.1, kd=0.3)
    bench.world.plant.data.qvel[:] = 4.0
    bench.run(0.02, kd=0.3)
    assert (bench.world.plant.joint_vel > 0.1).all()
    bench.run(0.6, kd=0.3)
    assert np.abs(bench.world.plant.joint_vel).max() < 0.05


def test_disable_takes_the_torque_away(tmp_path, protocol):
    bench = Bench(tmp_path, protocol)
    bench.enable()
    bench.run(0.04, position=1.0, kp=5.0, kd=0.1)
    assert (bench.torque > 0.5).all()
    bench.bus.disable()
    bench.tick()
    assert (bench.torque == 0.0).all()
    assert not bench.poll(0.1).enabled.any()
    bench.run(0.1, position=1.0, kp=5.0, kd=0.1)  # what a disabled motor is told does not count
    assert (bench.torque == 0.0).all()


def test_enabling_does_not_bring_an_old_command_back(tmp_path, protocol):
    bench = Bench(tmp_path, protocol)
    bench.enable()
    bench.run(0.1, position=2.0, kp=5.0, kd=0.1, torque=1.0)
    bench.bus.disable()
    bench.poll(0.1)
    bench.bus.enable()
    for _ in range(5):
        bench.tick()
        assert np.abs(bench.torque).max() < 1e-6


def test_a_silent_host_takes_the_drive_away(tmp_path, protocol):
    """The watchdog, programmed by connecting or before. What is left (nothing, or damping) is the device's: see there."""
    bench = Bench(tmp_path, protocol, registers=SET_BEFORE.get(protocol))
    bench.enable()
    bench.run(0.1, position=2.0, kp=0.5, kd=0.02)
    last = max(bench.world.last_command_times().values())
    while bench.world.time < last + 0.045:
        bench.tick()
    assert (bench.torque > 0.3).all()
    while bench.world.time < last + 0.055:
        bench.tick()
    moving = bench.world.plant.joint_vel.copy()
    bench.tick()
    assert (bench.torque * moving <= 0.0).all()  # nothing pulls towards the target any more
    tripped = [e.time for e in bench.world.motor_log if e.event == "watchdog"]
    assert len(tripped) == 2 and all(0.05 <= t - last < 0.055 for t in tripped)
    if protocol in FORGETFUL:
        return
    bench.run(0.1, position=2.0, kp=2.0, kd=0.1)  # a command alone does not bring it back
    assert (bench.torque * bench.world.plant.joint_vel <= 0.0).all()
    assert not bench.poll(0.1).enabled.any()
    bench.world.plant.data.qvel[:] = 0.0
    bench.enable()
    bench.run(0.04, position=bench.world.plant.joint_pos + 1.0, kp=2.0, kd=0.05)
    assert (bench.torque > 0.5).all()


def test_a_tenth_of_the_frames_lost(tmp_path, protocol):
    bench = Bench(tmp_path, protocol, faults=["drop:0.1"], seed=3)
    bench.enable(40)
    bench.run(0.6, position=[0.4, -0.6], kp=10.0, kd=0.6)
    assert bench.world.plant.joint_pos == pytest.approx([0.4, -0.6], abs=2e-2)
    assert bench.world.counters()["arm"]["dropped"] > 10


def test_a_motor_that_loses_power_comes_back_disabled(tmp_path, protocol):
    bench = Bench(tmp_path, protocol, faults=["reboot:arm/left=0.1@1.0"])
    bench.enable()
    while bench.world.time < 0.99:
        bench.run(1 / RATE, kd=0.2)
    while bench.world.time < 1.08:
        state = bench.run(1 / RATE, kd=0.2)
    assert bench.world.time - state.time[0] > 0.07 and bench.world.time - state.time[1] < 0.02
    state = bench.run(0.3, position=1.0, kp=2.0, kd=0.05)
    assert bench.torque[0] == 0.0 and bench.torque[1] != 0.0
    assert [e.event for e in bench.world.motor_log if e.joint == "left"][-1] == "powered on"


def test_the_budget_is_what_goes_over_the_wire(tmp_path, protocol):
    bench, rng, ticks = Bench(tmp_path, protocol), np.random.default_rng(5), 60
    bench.enable()
    gains = {"kp": [20.0, 35.0], "kd": [1.0, 2.3]}
    bench.run(3 / RATE, **gains)
    before = bench.world.counters()["arm"]
    for _ in range(ticks):
        bench.run(1 / RATE, position=rng.uniform(-1, 1, 2), torque=rng.uniform(-1, 1, 2), **gains)
    after = bench.world.counters()["arm"]
    expected = budget(bench.spec, RATE)
    bits = (after["busy"] - before["busy"]) * bench.spec.bitrate / ticks
    assert bits == pytest.approx(expected.bits, rel=0.08) and bits < expected.bits_worst
    if expected.frames == 4:  # a command and an answer for each motor, and nothing else
        assert (after["frames"] - before["frames"]) / ticks == pytest.approx(expected.frames, rel=0.08)


def test_same_seed_same_bytes(tmp_path, protocol):
    def digest(seed: int) -> str:
        bench = Bench(tmp_path, protocol, faults=["drop:0.05"], seed=seed)
        bench.enable(40)
        bench.run(0.2, position=0.2, kp=10.0, kd=0.5)
        return bench.world.digest

    assert digest(1) == digest(1) != digest(2)


def test_a_silent_motor_is_named(tmp_path, protocol):
    bench = Bench(tmp_path, protocol, connect=False, faults=["off:arm/right@0"])
    bench.world.advance(0.01)
    with pytest.raises(BusError, match=r"bus arm, motor of right \(id 0x[0-9a-f]+\): no answer") as refused:
        bench.bus.connect(bench.clock)
    assert "motor of left" not in str(refused.value)


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_a_command_that_is_not_finite_sends_nothing(tmp_path, protocol, value):
    bench = Bench(tmp_path, protocol)
    sent = bench.bus.counters.sent
    for quantity in ("position", "velocity", "kp", "kd", "torque"):
        with pytest.raises(ValueError, match=quantity):
            bench.bus.write(bench.command(**{quantity: [0.0, value]}))
    assert bench.bus.counters.sent == sent


def test_a_watchdog_is_what_the_protocol_has(protocol):
    spec = rig(protocol)
    open_codec(spec)
    with pytest.raises(BusError, match=f"bus arm: got watchdog .*'{protocol}'"):
        open_codec(replace(spec, watchdog=0.08 if not spec.watchdog else 0.0))


def test_unknown_models_are_refused_with_what_there_is(protocol):
    spec = rig(protocol)
    name = spec.motors[1].model
    strange = replace(spec, motors=(spec.motors[0], replace(spec.motors[1], model=name + "x")))
    with pytest.raises(BusError, match=f"motor of right .*'{name}x' .*did you mean '.*'.*known: "):
        open_codec(strange)


raw_frames = st.lists(
    st.tuples(
        st.integers(0, 0x1FFF_FFFF) | st.integers(0, 0x7FF) | st.integers(1, 0x20),
        st.booleans(),
        st.integers(0, 8),
        st.binary(min_size=8, max_size=8),
    ),
    max_size=8,
)


@settings(max_examples=150)
@given(raw_frames, st.integers(0, 3))
def test_any_frames_leave_a_finite_state(protocol, frames, variation):
    made = np.zeros(len(frames), frame_type(rig(protocol).data_bitrate))
    for row, (id, extended, length, data) in zip(made, frames, strict=True):
        row["id"] = id | EXTENDED if extended else id & 0x7FF
        row["length"], row["data"][:8] = length, list(data)
    codec, state = open_codec(rig(protocol)), MotorState.empty(2)
    codec.pack_poll(state)
    codec.owners(made)
    codec.unpack_registers(made)
    assert 0 <= codec.unpack(made, state, 1.0) <= len(made)
    heard = state.time > 0
    for quantity in (state.position, state.velocity):
        assert np.isfinite(quantity[heard]).all()
    for code in state.error.tolist():
        assert isinstance(codec.error_name(code), str)
    codec.pack_enable(state)
    codec.pack_poll(state)
