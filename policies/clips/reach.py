"""Clips by formula: arms bring palms where it has them, by inverse kinematics; what else moves is the formula's."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import NamedTuple

import mink
import mujoco
import numpy as np

from policies import ball
from policies.clips.format import Clip, Header
from policies.clips.robot import POINT_NAMES, RobotBody

SOLVER = "daqp"


class Frame(NamedTuple):
    """One instant of a formula."""

    base: np.ndarray  # (7,) m in the world, and quaternion
    pose: np.ndarray  # (n,) rad; of the arms at work it says where they would rather be
    palms: Mapping[str, mink.SE3]  # by side, in the world: a palm looks along its z axis, fingers along x


def follow(body: RobotBody, frames: Iterable[Frame], turned: float) -> np.ndarray:
    """(T, n) rad: the poses of ``frames`` with arms whose palms are where those say, as near as joints allow.

    ``turned`` m/rad: what a hand turned otherwise counts beside one that is elsewhere.
    """
    model = body.model
    configuration = mink.Configuration(model)
    posture, limits = mink.PostureTask(model, 3e-2), [mink.ConfigurationLimit(model)]
    reach: dict[str, mink.FrameTask] = {}
    rows: list[np.ndarray] = []
    for frame in frames:
        if not rows:
            reach = {s: mink.FrameTask(f"{s}_palm", "site", 1.0, turned) for s in frame.palms}
            mine = np.array([j.group == "arm" and any(s in j.name for s in reach) for j in body.robot.joints])
            still = np.ones(model.nv, bool)
            still[body.qvel_at[mine]] = False
            freeze = mink.DofFreezingTask(model, np.flatnonzero(still).tolist())
        q = model.qpos0.copy()
        q[:7], q[body.qpos_at] = frame.base, frame.pose
        posture.set_target(q)
        q[body.qpos_at] = np.where(mine, rows[-1], frame.pose) if rows else frame.pose
        configuration.update(q)
        for side, task in reach.items():
            task.set_target(frame.palms[side])
        for _ in range(12):
            speed = mink.solve_ik(
                configuration,
                [*reach.values(), posture],
                0.1,
                SOLVER,
                damping=1e-3,
                limits=limits,
                constraints=[freeze],
            )
            configuration.integrate_inplace(speed, 0.1)
        rows.append(configuration.q[body.qpos_at].copy())
    return np.array(rows)


def clip_of(
    body: RobotBody,
    name: str,
    source: str,
    fps: float,
    base: np.ndarray,
    joint_pos: np.ndarray,
    ball_position: np.ndarray,
    ball_velocity: np.ndarray,
    hands: np.ndarray,
) -> Clip:
    """A robot's clip by formula, with both feet on the floor: bases (T, 7), joints (T, n) rad, the ball's positions (T, 3) m
    and velocities (T, 3) m/s in the world, and which ``hands`` (T, 2) touch it."""
    header = Header(
        name=name, skill=name.rsplit("_", 1)[0], body=body.robot.name, fps=fps, joint_names=body.robot.joint_names,
        point_names=POINT_NAMES, ball_radius=ball.RADIUS, source=source, licence="Apache-2.0",
    )  # fmt: skip
    return Clip(
        header,
        base_position_in_world=base[:, :3],
        base_orientation_in_world=base[:, 3:],
        joint_pos=joint_pos,
        points_in_world=points(body, base, joint_pos),
        ball_position_in_world=ball_position,
        ball_velocity_in_world=ball_velocity,
        contact=np.column_stack([hands, np.ones((len(base), 2), bool)]),
    )


def points(body: RobotBody, base: np.ndarray, joint_pos: np.ndarray) -> np.ndarray:
    """(T, 14, 3) m in the world, as a clip has them, of bases (T, 7) and joints (T, n)."""
    data = mujoco.MjData(body.model)
    found = []
    for place, joints in zip(base, joint_pos, strict=True):
        data.qpos[:7], data.qpos[body.qpos_at] = place, joints
        mujoco.mj_kinematics(body.model, data)
        found.append(body.points(data))
    return np.array(found)
