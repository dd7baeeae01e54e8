"""A robot as retargeting sees it: which of its bodies and sites stand for which part of a person.

Found by the names of joints and sites, as robot descriptions usually have them: joints with ``hip``, ``knee``,
``ankle``, ``shoulder`` and ``elbow`` on a ``left`` and a ``right``, and a site ``<side>_palm`` and ``<side>_foot``.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import mujoco
import numpy as np

from policies.clips.format import ClipError
from sim2real.config import RobotConfig

SIDES = ("left", "right")
POINTS = ("shoulder", "elbow", "palm", "hip", "knee", "ankle", "foot")
POINT_NAMES = tuple(f"{side}_{point}" for side in SIDES for point in POINTS)
"""What a robot clip records: joint centres, and the sites on palms and soles."""


@dataclass(frozen=True)
class RobotBody:
    """A robot's model with its parts named."""

    robot: RobotConfig
    model: mujoco.MjModel
    trunk: str  # the body that carries both arms
    limbs: dict[str, tuple[str, ...]]  # "left_shoulder" -> every joint whose name says so, outwards

    @classmethod
    def of(cls, robot: RobotConfig) -> RobotBody:
        """Read the robot's MJCF. Raises ClipError for a part that is not there."""
        model = mujoco.MjModel.from_xml_path(str(robot.model_path))
        limbs = {}
        for side in SIDES:
            for part in ("shoulder", "elbow", "hip", "knee", "ankle"):
                names = tuple(n for n in robot.joint_names if side in n.lower() and part in n.lower())
                if not names:
                    raise ClipError(
                        f"{robot.name}: no joint of a {side} {part}; clips are retargeted to robots whose joint names"
                        f" contain 'left' or 'right' and hip, knee, ankle, shoulder, elbow"
                    )
                limbs[f"{side}_{part}"] = names
            for site in (f"{side}_palm", f"{side}_foot"):
                if mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_SITE, site) < 0:
                    raise ClipError(f"{robot.model_path}: no site '{site}'; add it where the {site} makes contact")
        first = model.joint(limbs["left_shoulder"][0]).bodyid[0]
        return cls(robot, model, model.body(model.body_parentid[first]).name, limbs)

    def joint(self, part: str) -> str:
        """The joint at whose anchor ``left_knee`` ... is: the middle one of a shoulder, else the first."""
        names = self.limbs[part]
        return names[(len(names) - 1) // 2] if part.endswith("shoulder") else names[0]

    @cached_property
    def qpos_at(self) -> np.ndarray:
        """(n,) where the robot's joints are in ``qpos``."""
        return np.array([self.model.joint(n).qposadr[0] for n in self.robot.joint_names])

    @cached_property
    def qvel_at(self) -> np.ndarray:
        """(n,) where they are in ``qvel``."""
        return np.array([self.model.joint(n).dofadr[0] for n in self.robot.joint_names])

    @cached_property
    def joint_ids(self) -> dict[str, int]:
        """The joint that stands for every part but palm and foot."""
        return {part: int(self.model.joint(self.joint(part)).id) for part in self.limbs}

    @cached_property
    def palms(self) -> np.ndarray:
        """(2,) ids of the palm sites, left and right."""
        return np.array([self.model.site(f"{side}_palm").id for side in SIDES])

    @cached_property
    def feet(self) -> np.ndarray:
        """(2,) ids of the sole sites, left and right."""
        return np.array([self.model.site(f"{side}_foot").id for side in SIDES])

    @cached_property
    def hand_geoms(self) -> list[np.ndarray]:
        """Ids of the colliding geoms of the bodies that carry the palms, left and right."""
        return [self._solid(self.model.site_bodyid[site]) for site in self.palms]

    @cached_property
    def foot_geoms(self) -> list[np.ndarray]:
        """Ids of the spheres a foot stands on (all its colliding geoms, where it has no spheres), left and right."""
        feet = [self._solid(self.model.site_bodyid[site]) for site in self.feet]
        sphere = mujoco.mjtGeom.mjGEOM_SPHERE
        spheres = [g[self.model.geom_type[g] == sphere] for g in feet]
        return [s if len(s) else g for s, g in zip(spheres, feet, strict=True)]

    def palm_height(self, radius: float) -> float:
        """m from a palm site, along its z axis, which points out of the palm, to the centre of a ball of ``radius`` m that
        lies on the hand: the mean of both; 0 for a robot whose hands touch nothing."""
        spec = mujoco.MjSpec.from_file(str(self.robot.model_path))
        sphere = mujoco.mjtGeom.mjGEOM_SPHERE
        spec.worldbody.add_body().add_geom(type=sphere, size=[radius, 0, 0], mass=0)  # last: the robot keeps its ids
        model = spec.compile()
        data, ball = mujoco.MjData(model), model.ngeom - 1
        mujoco.mj_kinematics(model, data)
        heights = []
        for k in range(len(SIDES)):
            site = self.palms[k]
            low, high = 0.0, radius + 1.0
            for _ in range(40):
                middle = (low + high) / 2
                data.geom_xpos[ball] = data.site_xpos[site] + middle * data.site_xmat[site].reshape(3, 3)[:, 2]
                apart = min(
                    (mujoco.mj_geomDistance(model, data, g, ball, 2.0, None) for g in self.hand_geoms[k].tolist()),
                    default=0.0,
                )
                low, high = (middle, high) if apart < 0 else (low, middle)
            heights.append(low)
        return float(np.mean(heights))

    def _solid(self, body: int) -> np.ndarray:
        return solid(self.model, np.flatnonzero(self.model.geom_bodyid == body))

    def points(self, data: mujoco.MjData) -> np.ndarray:
        """(14, 3) m in the world, in the order of ``POINT_NAMES``, of a configuration whose kinematics are up to date."""
        place = {name: data.xanchor[i] for name, i in self.joint_ids.items()}
        for k, side in enumerate(SIDES):
            place[f"{side}_palm"], place[f"{side}_foot"] = data.site_xpos[self.palms[k]], data.site_xpos[self.feet[k]]
        return np.stack([place[name] for name in POINT_NAMES])

    @cached_property
    def rest(self) -> dict[str, np.ndarray]:
        """Key points (3,) m in the base frame at joint position zero: where lengths are measured."""
        data = mujoco.MjData(self.model)
        base = self.model.body(self.robot.base).id
        data.qpos[:] = self.model.qpos0
        data.qpos[self.qpos_at] = 0.0
        mujoco.mj_kinematics(self.model, data)
        frame = data.xmat[base].reshape(3, 3)
        return dict(zip(POINT_NAMES, (self.points(data) - data.xpos[base]) @ frame, strict=True))

    @cached_property
    def leg_length(self) -> float:
        """Hip to knee to ankle, and from there down to the sole, m."""
        p = self.rest
        legs = [
            np.linalg.norm(p[f"{s}_hip"] - p[f"{s}_knee"])
            + np.linalg.norm(p[f"{s}_knee"] - p[f"{s}_ankle"])
            + p[f"{s}_ankle"][2]
            - p[f"{s}_foot"][2]
            for s in SIDES
        ]
        return float(np.mean(legs))

    def length(self, a: str, b: str) -> float:
        """Distance of two key points of a side at rest, m: ``length("shoulder", "elbow")``."""
        return float(np.mean([np.linalg.norm(self.rest[f"{s}_{a}"] - self.rest[f"{s}_{b}"]) for s in SIDES]))


def solid(model: mujoco.MjModel, geoms: np.ndarray) -> np.ndarray:
    """Those of ``geoms`` (k,), by id, that can touch something."""
    return geoms[(model.geom_contype[geoms] != 0) | (model.geom_conaffinity[geoms] != 0)]
