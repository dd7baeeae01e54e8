"""Where a robot's palms and solid parts are and how its base moves over the floor, by its joints, its IMU and its MJCF."""

# MuJoCo ships no types.
# pyright: reportAttributeAccessIssue=false

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from sim2real.config import RobotConfig
from sim2real.quaternion import matrix_of
from sim2real.solids import Solids

SOON = 1e-3  # s over which velocities are differences


class Limbs(NamedTuple):
    """Of one instant. Axes of ``base`` and ``velocity`` are those of the IMU's world: z up, yaw arbitrary."""

    palms: np.ndarray = np.zeros((0, 3))  # (k, 3) m in the base; none: nobody knows where they are
    base: np.ndarray | None = None  # (3,) m: z above the soles, x and y of an origin that drifts; None: nobody knows
    velocity: np.ndarray = np.zeros(3)  # (3,) m/s of the base
    solids: Solids = Solids()  # in the base


class Kinematics:
    """``kinematics(...)`` every tick -> Limbs: palms and soles are the sites of the robot's MJCF whose names end in ``_palm``
    and ``_foot``, solids its geoms that touch what has MuJoCo's own ``contype`` and ``conaffinity``. A robot without such soles
    says nothing of its base.

    The soles nearest to the floor stand still on it, and the base moves as they say (leg odometry).
    """

    near = 0.01  # m above the lowest sole, up to which another one stands too

    def __init__(self, robot: RobotConfig) -> None:
        import mujoco  # here: only robots with an object need it at run time

        self._kinematics = mujoco.mj_kinematics
        model = self._model = mujoco.MjModel.from_xml_path(str(robot.model_path))
        self._data = mujoco.MjData(model)
        sites = {
            kind: [k for k in range(model.nsite) if model.site(k).name.endswith(kind)] for kind in ("_palm", "_foot")
        }
        self._sites, self._palms = sites["_palm"] + sites["_foot"], len(sites["_palm"])
        self._root = model.body(robot.base).id
        self._geoms = np.flatnonzero(((model.geom_contype | model.geom_conaffinity) & 1) * model.geom_bodyid)
        self._middles, around = model.geom_aabb[self._geoms, :3], model.geom_aabb[self._geoms, 3:]
        round_ones = (mujoco.mjtGeom.mjGEOM_SPHERE, mujoco.mjtGeom.mjGEOM_CAPSULE)
        rounds = np.where(np.isin(model.geom_type[self._geoms], round_ones), model.geom_size[self._geoms, 0], 0.0)
        self._shapes = around - rounds[:, None], rounds
        self._joints = [model.joint(name).qposadr[0] for name in robot.joint_names]
        self._soles: np.ndarray | None = None  # (feet, 3) m from the base, in the world's axes, a tick ago
        self._last: np.ndarray | None = None  # that was answered of the base
        self._place = np.zeros(2)

    def __call__(
        self, joint_pos: np.ndarray, joint_vel: np.ndarray, orientation: np.ndarray, angular_velocity: np.ndarray
    ) -> Limbs:
        """``joint_pos`` and ``joint_vel`` (n,) rad and rad/s, ``orientation`` (4,) of the base in the world,
        ``angular_velocity`` (3,) rad/s of the base in the base. Of what is not finite, and of the zeros of an IMU that has not
        spoken, nothing follows."""
        told = all(np.isfinite(x).all() for x in (joint_pos, joint_vel, orientation, angular_velocity))
        if not (self._sites and told and 0.9 < orientation @ orientation < 1.1):
            self._soles = None
            return Limbs(base=self._last)
        palms, feet = self._points(joint_pos)
        solids = self._solids()
        if not len(feet):
            return Limbs(palms, solids=solids)
        _, soon = self._points(joint_pos + SOON * joint_vel)
        turn = matrix_of(orientation)
        soles = feet @ turn.T
        moving = ((soon - feet) / SOON + np.cross(angular_velocity, feet)) @ turn.T
        stand = soles[:, 2] < soles[:, 2].min() + self.near
        if self._soles is not None:
            self._place -= (soles - self._soles)[stand, :2].mean(axis=0)
        self._soles, self._last = soles, np.append(self._place, -soles[:, 2].min())
        return Limbs(palms, self._last, -moving[stand].mean(axis=0), solids)

    def _points(self, joint_pos: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Palms (k, 3) and soles (feet, 3), m in the base."""
        data = self._data
        data.qpos[self._joints] = joint_pos
        self._kinematics(self._model, data)
        points = (data.site_xpos[self._sites] - data.xpos[self._root]) @ data.xmat[self._root].reshape(3, 3)
        return points[: self._palms], points[self._palms :]

    def _solids(self) -> Solids:
        """With the joints where ``_points`` has put them; what is neither box, capsule nor sphere is the box around it."""
        data = self._data
        turn = data.xmat[self._root].reshape(3, 3)
        turns = data.geom_xmat[self._geoms].reshape(-1, 3, 3)
        places = data.geom_xpos[self._geoms] + (turns @ self._middles[:, :, None])[:, :, 0]
        return Solids((places - data.xpos[self._root]) @ turn, turn.T @ turns, *self._shapes)
