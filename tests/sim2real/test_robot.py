"""Robot: joints are where the motors say, whatever their order, sign and zero; one dead bus silences no other."""

from __future__ import annotations

import numpy as np
import pytest

from drivers.bus import BusError
from drivers.open import open_world
from drivers.sim.world import World
from sim2real.clock import SimClock
from sim2real.config import load_robot
from sim2real.quaternion import matrix_of, multiply
from sim2real.records import command_view, state_view, tick_layout
from sim2real.robot import open_robot


@pytest.fixture
def connected(robot):
    """(world, robot, its state, its command): every joint a little off home, motors enabled."""
    wiring = robot.wiring()
    pose = dict(zip(robot.joint_names, robot.home_pos + 0.02, strict=True))
    world = open_world(robot.model_path, robot.base, wiring.bus_specs(), wiring.imu_spec(), joint_pos=pose)
    body = open_robot(robot, wiring, {**world.wires, "imu": world.imu_wire})
    body.connect(SimClock(world.advance, lambda: world.time))
    record = tick_layout(robot.joint_names, [b.name for b in wiring.buses]).new()
    state, command = state_view(record), command_view(record, "command")
    command.joint_pos[:] = robot.home_pos
    return world, body, state, command


def exchange(world, body, state, command=None, ticks=2):
    """Ticks at the rate of the wiring."""
    for _ in range(ticks):
        body.poll() if command is None else body.write(command)
        world.advance(world.time + 1 / body.config.wiring().rate)
        body.read(world.time, state)


def of_plant(world, robot, values):
    """Values in the plant's joint order, in the robot's."""
    return np.array([values[world.plant.joints.index(name)] for name in robot.joint_names])


def test_joint_positions_are_the_bodys_own(connected, robot):
    world, body, state, _ = connected
    exchange(world, body, state)
    error = np.abs(state.joint_pos - of_plant(world, robot, world.plant.joint_pos))
    period = 1 / robot.wiring().rate
    speed = np.abs(of_plant(world, robot, world.plant.joint_vel))  # limbs hang limp
    moved = speed * (period + 0.002)  # since it was measured
    assert (error <= moved + 2 * np.pi / 4096).all()  # and one step of the coarsest wire
    assert (state.joint_age < period).all() and (state.joint_enabled == 0).all() and (state.joint_error == 0).all()


def test_a_torque_pulls_the_joint_it_names_in_the_direction_it_names(connected, robot):
    world, body, state, command = connected
    body.enable()
    protocol = robot.wiring().buses[0].protocol
    command.kp[:] = protocol in ("recoil", "dynamixel")  # these know positions only: a torque is a shifted one
    braking = robot.damping * (protocol == "dynamixel")  # back-EMF, whatever the kd
    for joint in range(len(robot.joint_names)):
        command.joint_torque[:] = 0.0
        command.joint_torque[joint] = 0.4 * robot.torque_max[joint]
        exchange(world, body, state, ticks=2)
        command.joint_pos[:] = state.joint_pos
        exchange(world, body, state, command, ticks=2)
        torque = of_plant(world, robot, world.plant.joint_torque)
        torque += braking * of_plant(world, robot, world.plant.joint_vel)
        assert torque[joint] == pytest.approx(command.joint_torque[joint], rel=0.02, abs=0.15)
        assert np.abs(np.delete(torque, joint)).max() < 0.15  # half a step of the coarsest range


def test_gains_pull_every_joint_home(connected, robot):
    world, body, state, command = connected
    command.kp[:], command.kd[:] = robot.home_kp, np.minimum(robot.home_kd, 5.0)
    body.enable()
    exchange(world, body, state, command, ticks=250)
    assert np.abs(state.joint_pos - robot.home_pos).max() < 0.15
    assert state.joint_enabled.all()


def test_disable_leaves_no_torque(connected):
    world, body, state, command = connected
    body.enable()
    command.kp[:] = 10.0
    exchange(world, body, state, command)
    body.disable()
    world.advance(world.time + 0.004)
    assert not world.motors.enabled.any()


class Gone:
    """A wire whose adapter was unplugged."""

    def __init__(self, wire):
        self.wire = wire

    def __getattr__(self, name):
        from drivers.wire import WireError

        if name in ("send", "recv"):
            raise WireError("can9: no such device")
        return getattr(self.wire, name)


def test_a_bus_that_is_gone_is_told_and_the_others_are_still_driven():
    config = load_robot("g1")
    wiring = config.wiring()
    world = World(config.model_path, config.base, wiring.bus_specs(), wiring.imu_spec())
    body = open_robot(config, wiring, {**world.wires, "imu": world.imu_wire})
    body.connect(SimClock(world.advance, lambda: world.time))
    record = tick_layout(config.joint_names, [b.name for b in wiring.buses]).new()
    state, command = state_view(record), command_view(record, "command")
    exchange(world, body, state)
    body.buses[0]._wire = Gone(body.buses[0]._wire)
    with pytest.raises(BusError, match="left_leg"):
        body.write(command)
    world.advance(world.time + 0.02)
    with pytest.raises(BusError, match="left_leg"):
        body.read(world.time, state)
    dead = config.indices([m.joint for m in body.buses[0].spec.motors])
    assert (state.joint_age[dead] > 0.02).all()
    assert (np.delete(state.joint_age, dead) < 0.02).all()
    body.disable()  # never raises


def test_quaternions_turn_as_rotations_do():
    rng = np.random.default_rng(0)
    for _ in range(20):
        a, b = (q / np.linalg.norm(q) for q in rng.standard_normal((2, 4)))
        np.testing.assert_allclose(matrix_of(multiply(a, b)), matrix_of(a) @ matrix_of(b), atol=1e-12)
