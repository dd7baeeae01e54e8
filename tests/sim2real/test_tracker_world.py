"""The tracker on a ball that MuJoCo drops in front of a robot, seen by the simulated camera."""

from __future__ import annotations

import numpy as np

from drivers.sim.ball import RADIUS
from drivers.sim.world import World
from sim2real.config import load_robot
from sim2real.contract import Object
from sim2real.object.camera import SimCamera
from sim2real.object.scene import prepare_for
from sim2real.quaternion import rotate
from sim2real.tracker import ObjectTracker


def test_a_dropped_ball_is_followed_through_its_bounces():
    robot = load_robot("g1")
    wiring = robot.wiring()
    world = World(
        robot.model_path,
        robot.base,
        wiring.bus_specs(),
        wiring.imu_spec(),
        prepare=prepare_for(Object(radius=RADIUS, mass=0.62, restitution=0.8), 0.002),
        joint_pos=dict(zip(robot.joint_names, robot.home_pos, strict=True)),
    )
    world.throw_ball((0.6, 0.1, 1.2), (0.0, 0.0, 0.0))
    camera, tracker = SimCamera(seed=1), ObjectTracker(RADIUS, height=float(world.truth().position_base_in_world[2]))
    errors, late = [], []
    for k in range(1, 376):
        world.advance(k * 0.004)
        camera.watch(world)
        if k % 5:
            continue
        for sample in camera.read(world.time):
            tracker.measure(sample)
        truth = world.truth()
        e = tracker.estimate(world.time, truth.orientation_base_in_world)
        back = truth.orientation_base_in_world * [1, -1, -1, -1]
        here = rotate(back, world.plant.data.body("ball").xpos - truth.position_base_in_world)
        if world.time > 0.3:
            errors.append(np.linalg.norm(e.position_in_base - here))
            late.append(e.age)
    assert tracker.counters.used > 60 and tracker.counters.restarts == 1
    assert np.mean(errors) < 0.03  # a ball at 4 m/s, 50 ms ago, was 0.2 m elsewhere
    assert max(late) < 0.12
