"""How well a robot could do a robot clip: contact gaps, skating, penetration, limits, and the torques it would take."""

from __future__ import annotations

from dataclasses import asdict, dataclass

import mujoco
import numpy as np

from policies.ball import MASS, NAME, ball
from policies.clips.contact import spans
from policies.clips.format import Clip
from policies.clips.kinematics import rate, rotate, smooth
from policies.clips.robot import RobotBody, solid

GRAVITY = np.array([0.0, 0.0, -9.81])
ROBOT_FRICTION = 0.6  # of a sole on the floor
HAND_FRICTION = 0.8  # of a palm on the ball
NEAR_FLOOR = 0.01  # m: a sole's sphere this near may push
SMOOTHING = 1.5  # frames, of accelerations


@dataclass(frozen=True)
class Residuals:
    """One row of the retargeting table. Gaps and penetrations are the largest of any frame unless they say otherwise."""

    hand_gap_median: float  # m from palm to ball surface, frames with contact; negative: inside
    hand_gap_worst: float  # m, of largest magnitude
    ball_penetration: float  # m, of robot parts other than the touching hand into the ball
    foot_skate: float  # m a standing foot moves from where it landed
    foot_height: float  # m between a standing sole and the floor
    floor_penetration: float  # m
    self_penetration: float  # m
    limit_violations: int  # joints x frames outside the robot's position limits
    limit_margin: float  # rad, the smallest distance to one
    velocity_share: float  # of the velocity limit, largest
    torque_share: float  # of the torque limit, 99th percentile of the worst joint in each frame
    missing_force: float  # share of body weight that feet and hands cannot give, 95th percentile of frames
    missing_torque: float  # N m at the base that they cannot give, 95th percentile of frames

    def as_dict(self) -> dict[str, float]:
        """By name."""
        return asdict(self)


def residuals(clip: Clip, body: RobotBody) -> Residuals:
    """Measure a robot ``clip`` on the robot's own model, with the ball in it."""
    model, data = _with_ball(clip, body)
    gaps: list[float] = []
    worst = {"ball": 0.0, "floor": 0.0, "self": 0.0, "sole": 0.0}
    ours = model.geom(NAME).id
    hands = [set(g.tolist()) for g in body.hand_geoms]
    robot_geoms = set(solid(model, np.flatnonzero(model.geom_bodyid)).tolist()) - {ours}
    for t in range(len(clip)):
        place(model, data, clip, body, t)
        touching = set().union(*(hands[k] for k in range(2) if clip.contact[t, k]))
        for k in range(2):
            if clip.contact[t, k] and hands[k]:
                gaps.append(min(mujoco.mj_geomDistance(model, data, g, ours, 1.0, None) for g in hands[k]))
        if clip.header.has_ball:
            worst["ball"] = max(
                worst["ball"],
                *(-mujoco.mj_geomDistance(model, data, g, ours, 0.2, None) for g in robot_geoms - touching),
            )
        for k in range(2):
            if clip.contact[t, 2 + k]:
                soles = body.foot_geoms[k]
                low = (data.geom_xpos[soles, 2] - model.geom_size[soles, 0]).min()
                worst["sole"] = max(worst["sole"], abs(float(low)))
        mujoco.mj_collision(model, data)
        for c in data.contact[: data.ncon]:
            if ours in c.geom:
                continue
            kind = "floor" if model.geom_bodyid[c.geom].min() == 0 else "self"
            worst[kind] = max(worst[kind], -float(c.dist))
    low, high = body.robot.position_min, body.robot.position_max
    outside = (clip.joint_pos < low) | (clip.joint_pos > high)
    torque, force, moment = efforts(clip, body)
    return Residuals(
        hand_gap_median=float(np.median(gaps)) if gaps else 0.0,
        hand_gap_worst=float(max(gaps, key=abs)) if gaps else 0.0,
        ball_penetration=worst["ball"],
        foot_skate=_skate(clip),
        foot_height=worst["sole"],
        floor_penetration=worst["floor"],
        self_penetration=worst["self"],
        limit_violations=int(outside.sum()),
        limit_margin=float(np.minimum(clip.joint_pos - low, high - clip.joint_pos).min()),
        velocity_share=float((abs(clip.joint_vel) / body.robot.velocity_max).max()),
        torque_share=float(np.percentile((abs(torque) / body.robot.torque_max).max(axis=1), 99)),
        missing_force=float(np.percentile(force, 95) / (body.model.body_mass.sum() * 9.81)),
        missing_torque=float(np.percentile(moment, 95)),
    )


def _with_ball(clip: Clip, body: RobotBody) -> tuple[mujoco.MjModel, mujoco.MjData]:
    spec = mujoco.MjSpec.from_file(str(body.robot.model_path))
    ball(0.002, radius=clip.header.ball_radius)(spec)
    model = spec.compile()
    return model, mujoco.MjData(model)


def place(model: mujoco.MjModel, data: mujoco.MjData, clip: Clip, body: RobotBody, t: int) -> None:
    """Put robot and ball of a model where frame ``t`` of a robot ``clip`` has them; kinematics up to date."""
    data.qpos[:3], data.qpos[3:7] = clip.base_position_in_world[t], clip.base_orientation_in_world[t]
    data.qpos[body.qpos_at] = clip.joint_pos[t]
    data.qpos[-7:-4], data.qpos[-4:] = clip.ball_position_in_world[t], (1, 0, 0, 0)
    mujoco.mj_kinematics(model, data)


def _skate(clip: Clip) -> float:
    """How far a standing sole gets from the mean place of its stance, m."""
    moved = [0.0]
    for k, side in enumerate(("left", "right")):
        sole = clip.point(f"{side}_foot")
        for start, stop in spans(clip.contact[:, 2 + k]):
            moved.append(np.linalg.norm((sole[start:stop] - sole[start:stop].mean(axis=0))[:, :2], axis=1).max())
    return float(max(moved))


def efforts(clip: Clip, body: RobotBody) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Inverse dynamics with contact: joint torques (T, n) N m, and the force (T,) N and torque (T,) N m at the base that
    remain when the standing soles push as well as they can inside their friction cones (non-negative least squares).

    A held ball's weight and inertia is shared by the touching hands; what a palm's friction cannot give counts as given.
    """
    from scipy.optimize import nnls

    model, data = body.model, mujoco.MjData(body.model)
    v = np.zeros((len(clip), model.nv))
    v[:, :3] = clip.base_velocity_in_world
    v[:, 3:6] = clip.base_angular_velocity_in_base
    v[:, body.qvel_at] = clip.joint_vel
    a = smooth(rate(smooth(v, SMOOTHING), clip.fps), SMOOTHING)
    pull = _ball_force(clip)
    torque = np.zeros((len(clip), len(body.qvel_at)))
    missing = np.zeros((len(clip), 6))
    full = np.zeros((model.nv, model.nv))
    for t in range(len(clip)):
        data.qpos[:3], data.qpos[3:7] = clip.base_position_in_world[t], clip.base_orientation_in_world[t]
        data.qpos[body.qpos_at], data.qvel[:], data.qacc[:] = clip.joint_pos[t], v[t], 0.0
        mujoco.mj_forward(model, data)
        mujoco.mj_fullM(model, data, full)
        need = full @ a[t] + data.qfrc_bias
        for k in np.flatnonzero(clip.contact[t, :2]):
            jacobian = _jacobian(model, data, data.site_xpos[body.palms[k]], model.site_bodyid[body.palms[k]])
            need += jacobian.T @ pull[t] / clip.contact[t, :2].sum()
        soles = np.concatenate(body.foot_geoms)
        edges = [
            _edges(model, data, g) for g in soles[data.geom_xpos[soles, 2] - model.geom_size[soles, 0] < NEAR_FLOOR]
        ]
        if edges:
            push = np.concatenate(edges, axis=1)
            # Forces in units of the body's weight, and torques in those of weight x 0.1 m: comparable.
            weights = np.array([1.0] * 3 + [10.0] * 3)[:, None]
            share, _ = nnls(weights * push[:6], (weights[:, 0] * need[:6]))
            need = need - push @ share
        torque[t], missing[t] = need[body.qvel_at], need[:6]
    return torque, np.linalg.norm(missing[:, :3], axis=1), np.linalg.norm(missing[:, 3:], axis=1)


def _ball_force(clip: Clip) -> np.ndarray:
    """(T, 3) N that the hands give the ball while they hold it."""
    v = smooth(clip.ball_velocity_in_world, SMOOTHING)
    return MASS * (rate(v, clip.fps) - GRAVITY)


def _edges(model: mujoco.MjModel, data: mujoco.MjData, geom: int) -> np.ndarray:
    """(nv, 4): what unit pushes along the edges of the friction pyramid under one sole geom do to the coordinates."""
    point = data.geom_xpos[geom] - [0, 0, model.geom_size[geom, 0]]
    jacobian = _jacobian(model, data, point, model.geom_bodyid[geom])
    slope = ROBOT_FRICTION / np.sqrt(2)
    edges = np.array([[sx * slope, sy * slope, 1.0] for sx in (-1, 1) for sy in (-1, 1)])
    return jacobian.T @ edges.T


def _jacobian(model: mujoco.MjModel, data: mujoco.MjData, point: np.ndarray, body: int) -> np.ndarray:
    jacobian = np.zeros((3, model.nv))
    mujoco.mj_jac(model, data, jacobian, None, np.asarray(point, float), int(body))
    return jacobian


def base_up(clip: Clip) -> np.ndarray:
    """(T, 3): the base's up in the world."""
    return rotate(clip.base_orientation_in_world, np.broadcast_to([0.0, 0.0, 1.0], (len(clip), 3)))
