"""What the robot's own parts do to an object that meets them, against MuJoCo's distances and against courses that are known."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from drivers.sim.ball import RADIUS, add_ball
from sim2real.config import load_robot
from sim2real.limbs import Kinematics
from sim2real.solids import DEEP, UNKNOWN, Solids, Touch, stopped, touches

TURNED = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])  # x looks left


def solid(place=(0.0, 0.0, 0.0), turn=None, half=(0.1, 0.05, 0.02), rounded=0.0) -> Solids:
    turn = np.eye(3) if turn is None else turn
    return Solids(np.array([place]), turn[None], np.array([half]), np.array([rounded]))


@pytest.mark.parametrize("seed", range(5))
def test_what_a_ball_touches_is_what_mujoco_says(seed):
    """In any posture, every geom of the robot that a ball can touch: as deep, and out of the same side."""
    robot, rng = load_robot("g1"), np.random.default_rng(seed)
    spec = mujoco.MjSpec.from_file(str(robot.model_path))
    add_ball(0.002)(spec)
    model = spec.compile()
    data, ball = mujoco.MjData(model), model.geom("ball").id
    q = robot.home_pos + rng.uniform(-0.5, 0.5, len(robot.home_pos))
    data.qpos[[model.joint(name).qposadr[0] for name in robot.joint_names]] = q
    data.qpos[3:7] = 1.0, 0.0, 0.0, 0.0
    limbs = Kinematics(robot)(q, 0 * q, np.array([1.0, 0, 0, 0]), np.zeros(3))
    bits = lambda g: (model.geom_contype[g] | model.geom_conaffinity[g]) & 1  # noqa: E731
    geoms = [g for g in range(model.ngeom) if bits(g) and model.geom_bodyid[g] and g != ball]
    assert len(geoms) == len(limbs.solids.places)
    met = 0
    for k, geom in enumerate(geoms):
        one = Solids(*(column[[k]] for column in limbs.solids))
        for _ in range(20):
            place = one.places[0] + rng.uniform(-0.15, 0.15, 3)
            data.qpos[-7:-4] = data.qpos[:3] + place
            mujoco.mj_kinematics(model, data)
            way = np.zeros(6)
            apart = mujoco.mj_geomDistance(model, data, geom, ball, 1.0, way)
            found = touches(one, one, 1.0, np.inf, place, RADIUS)
            if apart < -RADIUS:  # its middle is inside: nobody asks which side is near
                continue
            assert len(found) == (apart < 0)
            for touch in found:
                met += 1
                assert touch.depth == pytest.approx(-apart, abs=1e-6)
                np.testing.assert_allclose(touch.normal, (way[:3] - way[3:]) / -apart, atol=1e-3)
    assert met > 50


def test_a_solid_moves_where_it_is_touched_as_it_does_there():
    """It goes up by 2 cm and turns by 0.1 rad about the vertical in 20 ms; its end goes sideways."""
    turn = np.array([[1.0, -0.1, 0.0], [0.1, 1.0, 0.0], [0.0, 0.0, 1.0]])
    before, after = solid(), solid((0.0, 0.0, 0.02), turn)
    (touch,) = touches(before, after, 0.5, 0.02, np.array([0.1, 0.0, 0.11]), 0.09)
    np.testing.assert_allclose(touch.velocity, [0.0, 0.5, 1.0], atol=0.05)
    np.testing.assert_allclose(touch.normal, [0.0, 0.0, 1.0], atol=1e-6)
    assert touch.depth == pytest.approx(0.09 - (0.11 - 0.01 - 0.02))


def test_edges_push_where_they_look():
    (touch,) = touches(solid(), solid(), 1.0, np.inf, np.array([0.0, 0.05 + 0.03, 0.02 + 0.04]), 0.09)
    np.testing.assert_allclose(touch.normal, [0.0, 0.6, 0.8], atol=1e-9)
    assert touch.depth == pytest.approx(0.04)
    assert not touches(solid(), solid(), 1.0, np.inf, np.array([0.0, 0.05 + 0.06, 0.02 + 0.08]), 0.09)
    assert not touches(solid(), solid(), 1.0, np.inf, np.zeros(3), 0.09)  # inside, no side is near


def test_solids_are_seen_from_elsewhere():
    seen = solid((0.3, 0.0, 0.0)).seen_from(np.array([1.0, 1.0, 1.0]), TURNED)
    np.testing.assert_allclose(seen.places, [[1.0, 1.3, 1.0]])
    np.testing.assert_allclose(seen.turns, TURNED[None])


@pytest.mark.parametrize(("falls", "after"), [(-2.0, -0.5), (-0.5, -0.5), (1.0, 1.0)])
def test_nothing_goes_into_a_solid_and_what_flies_off_is_not_held(falls, after):
    """A palm that goes down at 0.5 m/s under a ball that falls faster, as fast, or rises; sideways the ball goes on."""
    touch = Touch(np.array([0.0, 0.0, 1.0]), 0.01, np.array([0.0, 0.0, -0.5]))
    covariance = np.tile([[1.0, 0.2], [0.2, 4.0]], (3, 1, 1))
    place, speed, unsure = stopped(touch, np.zeros(3), np.array([0.3, 0.0, falls]), covariance, 0.01)
    np.testing.assert_allclose(place, [0.0, 0.0, 0.01])
    np.testing.assert_allclose(speed, [0.3, 0.0, after])
    np.testing.assert_allclose(unsure[2], [[DEEP**2, 0.0], [0.0, UNKNOWN**2]])
    np.testing.assert_allclose(unsure[0], [[1.0, 0.2], [0.2, 4.0 + 0.1 * UNKNOWN**2]])
    assert covariance[2, 1, 1] == 4.0  # what was given is left as it was
