"""Bounces by formula: the ball obeys physics, and the palms are where and as they should be."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from policies import ball
from policies.clips.bounce import GRAVITY, STRETCHED, Drop, Flight, Stroke
from policies.clips.library import library_path, load_clip
from policies.clips.robot import SIDES, RobotBody
from sim2real.config import load_robot

R = ball.RADIUS
MOTIONS = [Stroke(), Drop()]
FLIGHTS = [m.flight(R) for m in MOTIONS]


@pytest.mark.parametrize("k", FLIGHTS, ids=["stroke", "drop"])
def test_a_ball_is_pushed_falls_bounces_and_is_at_rest_at_its_peak(k: Flight):
    z, v = k.at(np.array([0.0, k.push, k.push + k.fall - 1e-9, k.push + k.fall + 1e-9, k.period]))
    np.testing.assert_allclose(z, [k.top, k.leave, R, R, k.peak], atol=1e-6)
    np.testing.assert_allclose(v[[0, 1, 4]], [0.0, -k.release, 0.0], atol=1e-9)
    assert v[3] == pytest.approx(-ball.RESTITUTION * v[2])


@pytest.mark.parametrize("motion", MOTIONS, ids=["stroke", "drop"])
def test_a_path_moves_as_it_says_and_falls_where_nobody_touches_the_ball(motion):
    period = motion.period(R)
    t = np.linspace(0, period, 20001)[:-1]
    path = motion.path(R, t)
    rate = np.gradient(path.ball, t)
    smooth = np.abs(np.gradient(path.velocity, t)) < 100  # not at the floor
    np.testing.assert_allclose(rate[smooth], path.velocity[smooth], atol=0.02)
    flies = ~path.on & (path.ball > R + 0.01)
    np.testing.assert_allclose(np.gradient(path.velocity, t)[flies][2:-2], -GRAVITY, rtol=1e-3)
    np.testing.assert_allclose(path.palm[path.on], path.ball[path.on])
    assert (path.apart[path.on] == 0).all()
    np.testing.assert_allclose(motion.path(R, t + period).ball, path.ball, atol=1e-9)


def test_a_stroke_may_be_made_for_another_floor_and_begin_on_it():
    k = STRETCHED.flight(R)
    _, v = k.at(np.array([k.push + k.fall - 1e-9, k.push + k.fall + 1e-9]))
    assert v[1] == pytest.approx(-STRETCHED.restitution * v[0])
    path = STRETCHED.path(R, np.array([0.0, k.rise, k.period]))
    np.testing.assert_allclose(path.ball, [R, STRETCHED.peak, R], atol=1e-6)
    np.testing.assert_allclose(path.velocity, [v[1], 0.0, v[1]], atol=1e-6)
    assert list(path.on) == [False, True, False]


def test_a_palm_from_above_is_never_in_the_ball():
    path = Stroke().path(R, np.linspace(0, 2.0, 4001))
    assert (path.palm >= path.ball - 1e-9).all()


def test_palms_from_the_sides_are_open_while_the_ball_passes_between_them():
    motion = Drop()
    k = motion.flight(R)
    t = np.linspace(0, k.period, 2001)
    path = motion.path(R, t - k.period)  # it begins with the peak
    passes = (t > k.push + motion.opening) & (t < k.period - motion.closing)
    np.testing.assert_allclose(path.apart[passes], motion.open)
    assert (np.diff(path.apart[t < k.push + motion.opening]) >= 0).all()


@pytest.mark.parametrize("motion", MOTIONS, ids=["stroke", "drop"])
def test_a_bounce_lasts_as_long_as_it_is_told(motion):
    longer = motion.period(R) + 0.013
    assert motion.lasting(R, longer).period(R) == pytest.approx(longer, abs=1e-6)


def test_the_palms_of_the_shipped_bounce_hold_the_ball_between_them():
    body = RobotBody.of(load_robot("g1"))
    clip = load_clip(library_path("g1").parent / "bounce_01.npz")
    data, touch = mujoco.MjData(body.model), body.palm_height(R)
    held = clip.contact[:, :2].all(axis=1)
    assert (held == clip.contact[:, :2].any(axis=1)).all() and 0.4 < held.mean() < 0.7
    gaps = []
    for t in range(len(clip)):
        data.qpos[:3], data.qpos[3:7] = clip.base_position_in_world[t], clip.base_orientation_in_world[t]
        data.qpos[body.qpos_at] = clip.joint_pos[t]
        mujoco.mj_kinematics(body.model, data)
        frames = [data.site_xmat[palm].reshape(3, 3) for palm in body.palms]
        away = clip.ball_position_in_world[t] - data.site_xpos[body.palms]
        gaps.append([np.dot(offset, frame[:, 2]) - touch for offset, frame in zip(away, frames, strict=True)])
        if held[t]:
            for k in range(len(SIDES)):
                np.testing.assert_allclose(frames[k][:, 2], [0.0, -1.0 if k == 0 else 1.0, 0.0], atol=0.2)
                across = away[k] - np.dot(away[k], frames[k][:, 2]) * frames[k][:, 2]
                assert np.linalg.norm(across) < 0.02  # in the middle of the palm
    np.testing.assert_allclose(np.array(gaps)[held], 0.0, atol=0.003)
    assert np.array(gaps).max() > 0.05
