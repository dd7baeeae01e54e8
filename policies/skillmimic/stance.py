"""Clips for robots whose legs somebody else moves: what arms and ball do, put on a robot that stands.

The base policy keeps the robot up and the trunk level, so the trunk is what a clip's arms and ball are seen from: the
recorded person leans back at the hip and forward at the waist, and the trunk between them is level too. How deep the
knees bend is taken from the height of the clip's base.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import mujoco
import numpy as np

from policies.clips.format import Clip
from policies.clips.kinematics import conjugate, multiply, rate, rotate
from policies.clips.robot import POINT_NAMES, RobotBody
from policies.physics import standing_height
from policies.skillmimic.rewards import Motion

LEVEL = np.array([1.0, 0.0, 0.0, 0.0])
Place = tuple[np.ndarray, np.ndarray]  # positions (N, 3) m and orientations (N, 4), in the world
ARM_POINTS = np.array([k for k, name in enumerate(POINT_NAMES) if name.endswith(("shoulder", "elbow", "palm"))])


def crouched(body: RobotBody, home: np.ndarray, crouch: np.ndarray, height: float) -> tuple[np.ndarray, float]:
    """The pose (n,) rad, ``home`` + a share of ``crouch`` (n,), whose base is at ``height`` m; and that height, or the
    nearest to it that there is."""
    shares = np.linspace(0.0, 1.0, 41)
    poses = home + shares[:, None] * crouch
    heights = standing_height(body.model, poses)
    best = int(np.abs(heights - height).argmin())
    return poses[best], float(heights[best])


def trunks(body: RobotBody, clip: Clip) -> tuple[np.ndarray, np.ndarray]:
    """Position (T, 3) m and orientation (T, 4) of the trunk in a robot's clip."""
    data = mujoco.MjData(body.model)
    rows = zip(clip.base_position_in_world, clip.base_orientation_in_world, clip.joint_pos, strict=True)
    places, turns = zip(*[_place(data, body, *row) for row in rows], strict=True)
    return np.array(places), np.array(turns)


def stand(clip: Clip, body: RobotBody, pose: np.ndarray, height: float) -> Clip:
    """The clip's arms and ball on a robot whose other joints are at ``pose`` (n,) rad, base level at ``height`` m."""
    arms = np.array([j.group == "arm" for j in body.robot.joints])
    data = mujoco.MjData(body.model)
    there, turned = trunks(body, clip)
    base = np.array([0, 0, height])
    here, facing = _place(data, body, base, LEVEL, pose)
    turn = multiply(np.tile(facing, (len(clip), 1)), conjugate(turned))
    joint_pos = np.where(arms, clip.joint_pos, pose)
    points = np.zeros((len(clip), len(POINT_NAMES), 3))
    for t, joints in enumerate(joint_pos):
        _place(data, body, base, LEVEL, joints)
        points[t] = body.points(data)
    return replace(
        clip,
        base_position_in_world=np.tile(base, (len(clip), 1)),
        base_orientation_in_world=np.tile(LEVEL, (len(clip), 1)),
        joint_pos=joint_pos,
        points_in_world=points,
        ball_position_in_world=here + rotate(turn, clip.ball_position_in_world - there),
        ball_velocity_in_world=rotate(turn, clip.ball_velocity_in_world - rate(there, clip.fps)),
        contact=np.column_stack([clip.contact[:, :2], np.ones((len(clip), 2), bool)]),
    )


def arms(m: Motion, acting: Sequence[int]) -> Motion:
    """All of ``m`` that arms can help, the joints ``acting``, by index."""
    points, level = m.points[:, 1 + ARM_POINTS], np.tile(LEVEL, (len(m.points), 1))
    return Motion(points, np.zeros_like(points), level, m.joint_pos[:, acting], m.joint_vel[:, acting],
                  m.object_position, m.object_velocity, m.contact)  # fmt: skip


def moved(m: Motion, qvel: np.ndarray, trunk: Place, there: Place) -> Motion:
    """Points and object of ``m``, whose base has velocities ``qvel`` (N, >= 6) as MuJoCo has them, moved to where its
    ``trunk`` is ``there``: that of the skill's stance, in which its clips are. The object's velocity is then relative to a
    trunk that does not turn."""
    (position, orientation), (here, facing) = trunk, there
    turn = multiply(facing, conjugate(orientation))
    base, spin = m.points[:, 0], rotate(m.orientation_base_in_world, qvel[:, 3:6])
    drift = qvel[:, :3] + np.cross(spin, position - base)
    return m._replace(
        points=here[:, None] + rotate(turn[:, None], m.points - position[:, None]),
        object_position=here + rotate(turn, m.object_position - position),
        object_velocity=rotate(turn, m.object_velocity - drift),
    )


def _place(
    data: mujoco.MjData, body: RobotBody, position: np.ndarray, orientation: np.ndarray, joint_pos: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Where the trunk then is; kinematics of ``data`` are up to date after it."""
    data.qpos[:3], data.qpos[3:7], data.qpos[body.qpos_at] = position, orientation, joint_pos
    mujoco.mj_kinematics(body.model, data)
    link = body.model.body(body.trunk).id
    return data.xpos[link].copy(), data.xquat[link].copy()
