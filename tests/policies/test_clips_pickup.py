"""A pickup by formula: feet that stay, palms on the ball, and a ball that is lifted with the robot."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from policies import ball
from policies.clips.library import library_path, load_clip
from policies.clips.pickup import Pickup, pickup
from policies.clips.robot import RobotBody
from sim2real.config import load_robot

BODY = RobotBody.of(load_robot("g1"))
CLIP = load_clip(library_path("g1").parent / "pickup_09.npz")


@pytest.fixture(scope="module")
def frames() -> list[dict[str, np.ndarray]]:
    data, found = mujoco.MjData(BODY.model), []
    for t in range(0, len(CLIP), 5):
        data.qpos[:3], data.qpos[3:7] = CLIP.base_position_in_world[t], CLIP.base_orientation_in_world[t]
        data.qpos[BODY.qpos_at] = CLIP.joint_pos[t]
        mujoco.mj_forward(BODY.model, data)
        found.append({"feet": data.site_xpos[BODY.feet].copy(), "palms": data.site_xpos[BODY.palms].copy(),
                      "looks": data.site_xmat[BODY.palms].reshape(2, 3, 3)[:, :, 2].copy(), "com": data.subtree_com[1].copy(),
                      "floor": np.array([c.dist for c in data.contact if c.dist < -2e-3])})  # fmt: skip
    return found


def test_the_path_goes_down_closes_presses_and_comes_up():
    motion = Pickup()
    path = motion.path(np.array([0.0, motion.down, motion.down + motion.close, motion.seconds]))
    np.testing.assert_allclose(path.down, [0, 1, 1, 0], atol=1e-9)
    np.testing.assert_allclose(path.apart, [motion.open, motion.open, 0, 0], atol=1e-9)
    assert path.on.tolist() == [False, False, True, True]


def test_the_shipped_clip_is_what_the_formula_makes():
    made = pickup(BODY, "pickup_09")
    np.testing.assert_allclose(made.joint_pos, CLIP.joint_pos, atol=1e-4)
    np.testing.assert_allclose(made.ball_position_in_world, CLIP.ball_position_in_world, atol=1e-5)


def test_feet_stay_under_the_centre_of_mass(frames):
    feet = np.array([f["feet"] for f in frames])
    assert np.ptp(feet, axis=0).max() < 2e-3
    ahead = np.array([f["com"][0] - f["feet"][:, 0].mean() for f in frames])
    assert np.abs(ahead).max() < 0.03
    assert not any(f["floor"].size for f in frames)  # nothing is in anything


def test_palms_face_each_other_and_hold_the_ball(frames):
    touch = BODY.palm_height(ball.RADIUS)
    for t, frame in zip(range(0, len(CLIP), 5), frames, strict=True):
        gap = np.einsum("ij,ij->i", CLIP.ball_position_in_world[t] - frame["palms"], frame["looks"]) - touch
        np.testing.assert_allclose(frame["looks"][:, 1], [-1.0, 1.0], atol=0.05)
        if CLIP.contact[t, 0]:
            np.testing.assert_allclose(gap, 0.0, atol=3e-3)


def test_the_ball_waits_on_the_floor_and_is_held_at_the_end():
    place, on = CLIP.ball_position_in_world, CLIP.contact[:, :2].all(axis=1)
    assert (on == CLIP.contact[:, :2].any(axis=1)).all()
    np.testing.assert_allclose(place[~on], np.tile([place[0, 0], 0.0, ball.RADIUS], (int((~on).sum()), 1)), atol=1e-6)
    assert (np.diff(place[:, 2]) > -1e-6).all() and place[-1, 2] > 0.8
    assert np.linalg.norm(np.diff(place, axis=0), axis=1).max() * CLIP.fps < 1.0  # m/s
