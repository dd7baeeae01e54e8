"""Human clip to robot clip: inverse kinematics with mink, frame by frame, in two passes.

The first pass follows all targets; it is smoothed, and the second stays close to it while it puts the palms back on the
ball and the soles back on the floor. Joint limits hold throughout, joint velocity limits in the first pass.
"""

from __future__ import annotations

from dataclasses import dataclass

import mink
import mujoco
import numpy as np

from policies.ball import RADIUS
from policies.clips import kinematics
from policies.clips.format import Clip
from policies.clips.kinematics import smooth, smooth_orientation
from policies.clips.robot import POINT_NAMES, SIDES, RobotBody, solid
from policies.clips.targets import Targets, pulled_in, targets

FPS = 50.0  # of policies
SOLVER = "daqp"
FIRST_STEPS, STEPS, POLISH_STEPS = (
    60,
    4,
    4,
)  # inverse kinematics steps for the first frame, every further one, and in pass 2
DAMPING = 1e-3
VELOCITY_SHARE = 0.7  # of the joint velocity limits, in the first pass: putting a palm back on the ball adds some
MARGIN = 0.02  # rad inside the joint limits, as the safety gate demands by default
SMOOTHING = (1.5, 0.8)  # frames, before each further pass
LAST_SMOOTHING = 0.6  # frames, at the end: halves a jerk of one frame, and costs a fast palm a few mm
CLEARANCE = 0.005  # m between arms and everything else of the robot


@dataclass(frozen=True)
class Costs:
    """Weights of the tasks: per m, per rad; of squared errors."""

    base: float
    base_turn: float
    trunk_turn: float
    balance: float  # centre of mass over the floor
    knee: float
    foot: float
    foot_turn: float
    stance: float  # added to `foot` while it stands
    elbow: float
    palm: float
    palm_on_ball: float  # added to `palm` where it is placed by the ball
    fingers: float
    palm_turn: float  # towards the ball, where the palm is placed by it
    posture: float
    posture_of_waist: float


FOLLOW = Costs(
    base=1.0, base_turn=2.0, trunk_turn=1.0, balance=2.0, knee=0.3, foot=20.0, foot_turn=2.0, stance=20.0, elbow=0.7,
    palm=2.0, palm_on_ball=8.0, fingers=0.15, palm_turn=0.2, posture=0.03, posture_of_waist=0.03,
)  # fmt: skip
POLISH = Costs(
    base=20.0, base_turn=10.0, trunk_turn=0.3, balance=0.0, knee=0.0, foot=40.0, foot_turn=5.0, stance=60.0, elbow=0.0,
    palm=0.0, palm_on_ball=40.0, fingers=0.0, palm_turn=0.5, posture=0.6, posture_of_waist=2.0,
)  # fmt: skip


class Imitator:
    """Solves for one robot's configuration, frame after frame."""

    def __init__(self, body: RobotBody, fps: float, steps: int):
        self.body = body
        self.model = model = body.model
        self.configuration = mink.Configuration(model)
        self.dt = 1.0 / fps / steps
        velocities = dict(zip(body.robot.joint_names, VELOCITY_SHARE * body.robot.velocity_max, strict=True))
        apart = mink.CollisionAvoidanceLimit(
            model,
            self._arms_and_the_rest(),
            minimum_distance_from_collisions=CLEARANCE,
            collision_detection_distance=0.05,
        )
        self.limits = [mink.ConfigurationLimit(model), apart, mink.VelocityLimit(model, velocities)]
        bodies = {part: model.body(model.jnt_bodyid[i]).name for part, i in body.joint_ids.items()}
        self.base = mink.FrameTask(body.robot.base, "body", 1.0, 1.0)
        self.trunk = mink.FrameTask(body.trunk, "body", 0.0, 1.0)
        self.balance = mink.ComTask([1.0, 1.0, 0.0])
        self.knees = [mink.FrameTask(bodies[f"{side}_knee"], "body", 1.0, 0.0) for side in SIDES]
        self.feet = [mink.FrameTask(f"{side}_foot", "site", 1.0, 1.0) for side in SIDES]
        self.elbows = [mink.FrameTask(bodies[f"{side}_elbow"], "body", 1.0, 0.0) for side in SIDES]
        self.palms = [mink.FrameTask(f"{side}_palm", "site", 1.0, 1.0) for side in SIDES]
        self.posture = mink.PostureTask(model, 1.0)
        self.waist = np.zeros(model.nv, bool)
        self.waist[body.qvel_at] = [j.group == "waist" for j in body.robot.joints]
        box = mujoco.mjtGeom.mjGEOM_BOX  # other hands are as round on every side
        self.flat = [bool((model.geom_type[geoms] == box).any()) for geoms in body.hand_geoms]
        self.finger_axes = [self._finger_axis(k) for k in range(2)]
        self.tasks = [
            *(self.base, self.trunk, self.balance, self.posture),
            *(self.knees + self.feet + self.elbows + self.palms),
        ]

    def _arms_and_the_rest(self) -> list[tuple[list[int], list[int]]]:
        """Pairs to keep apart: what moves with an elbow, and every other colliding geom of the robot."""
        model = self.model
        ours = solid(model, np.flatnonzero(model.geom_bodyid)).tolist()
        elbows = [model.jnt_bodyid[self.body.joint_ids[f"{side}_elbow"]] for side in SIDES]
        arms = [[g for g in ours if _carries(model, elbow, model.geom_bodyid[g])] for elbow in elbows]
        shoulders = [model.jnt_bodyid[self.model.joint(self.body.limbs[f"{s}_shoulder"][0]).id] for s in SIDES]
        rest = [g for g in ours if not any(_carries(model, s, model.geom_bodyid[g]) for s in shoulders)]
        return [(arms[0], rest), (arms[1], rest), (arms[0], arms[1])]

    def _finger_axis(self, k: int) -> np.ndarray:
        """Where fingers would point, in the palm's frame: away from the elbow at rest."""
        data = mujoco.MjData(self.model)
        data.qpos[self.body.qpos_at] = 0.0
        mujoco.mj_kinematics(self.model, data)
        site = self.body.palms[k]
        along = data.site_xpos[site] - data.xpos[self.model.site_bodyid[site]]
        elbow = data.xanchor[self.body.joint_ids[f"{SIDES[k]}_elbow"]]
        along = along if np.linalg.norm(along) > 1e-3 else data.site_xpos[site] - elbow
        return kinematics.unit(data.site_xmat[site].reshape(3, 3).T @ along)

    def aim(self, goal: Targets, t: int, costs: Costs) -> None:
        """Set every target of frame ``t`` that does not depend on the configuration."""
        self.base.set_target(_pose(goal.base[t], goal.base_frame[t]))
        self.base.set_position_cost(costs.base)
        self.base.set_orientation_cost(costs.base_turn)
        self.trunk.set_target(_pose(np.zeros(3), goal.trunk_frame[t]))
        self.trunk.set_orientation_cost(costs.trunk_turn)
        self.balance.set_target(goal.centre_of_mass[t])
        self.balance.set_cost([costs.balance, costs.balance, 0.0])
        self.posture.set_cost(np.where(self.waist, costs.posture_of_waist, costs.posture))
        for k in range(2):
            self.knees[k].set_target(_pose(goal.knees[t, k], np.eye(3)))
            self.knees[k].set_position_cost(costs.knee)
            self.feet[k].set_target(_pose(goal.feet[t, k], goal.foot_frames[t, k]))
            self.feet[k].set_position_cost(costs.foot + costs.stance * goal.stance[t, k])
            self.feet[k].set_orientation_cost(costs.foot_turn)

    def reach(self, goal: Targets, t: int, costs: Costs) -> None:
        """Set the targets of the arms, which hang on where the shoulders are now."""
        data = self.configuration.data
        for k, side in enumerate(SIDES):
            shoulder = data.xanchor[self.body.joint_ids[f"{side}_shoulder"]]
            elbow = shoulder + goal.upper_arms[t, k]
            free, held = elbow + goal.forearms[t, k], goal.palms[t, k]
            by_ball = goal.by_ball[t, k]
            now = data.site_xmat[self.body.palms[k]].reshape(3, 3)
            turned = _least_turn(now @ self.finger_axes[k], goal.fingers[t, k]) @ now if costs.fingers else now
            towards = kinematics.unit(goal.ball[t] - data.site_xpos[self.body.palms[k]])
            turned = _least_turn(turned[:, 2], by_ball * towards + (1 - by_ball) * turned[:, 2]) @ turned
            self.elbows[k].set_target(_pose(elbow, np.eye(3)))
            self.elbows[k].set_position_cost(costs.elbow * (1 - 0.8 * by_ball))
            self.palms[k].set_target(_pose(by_ball * held + (1 - by_ball) * free, turned))
            self.palms[k].set_position_cost(costs.palm + costs.palm_on_ball * by_ball)
            lays = (
                costs.fingers + self.flat[k] * costs.palm_turn * by_ball
            )  # turning about its own axis lays no palm down
            self.palms[k].set_orientation_cost([lays, lays, costs.fingers])

    def solve(self, goal: Targets, t: int, costs: Costs, steps: int) -> np.ndarray:
        """The configuration (nq,) of frame ``t``, from the one before."""
        self.aim(goal, t, costs)
        for _ in range(steps):
            self.reach(goal, t, costs)
            v = mink.solve_ik(self.configuration, self.tasks, self.dt, SOLVER, damping=DAMPING, limits=self.limits)
            self.configuration.integrate_inplace(v, self.dt)
        return self.configuration.q.copy()

    def follow(self, goal: Targets) -> np.ndarray:
        """First pass: all targets, from the robot's home pose on. Returns (T, nq)."""
        q = self.model.qpos0.copy()
        q[self.body.qpos_at] = self.body.robot.home_pos
        self.posture.set_target(q)
        q[:3], q[3:7] = goal.base[0], kinematics.quaternion_from_matrix(goal.base_frame[0])
        self.configuration.update(q)
        return np.stack([self.solve(goal, t, FOLLOW, STEPS if t else FIRST_STEPS) for t in range(len(goal.base))])

    def polish(self, goal: Targets, path: np.ndarray) -> np.ndarray:
        """Second pass: near ``path`` (T, nq), contacts exact. Returns (T, nq)."""
        solved = []
        frames = kinematics.matrix_from_quaternion(path[:, 3:7])
        for t, q in enumerate(path):
            self.configuration.update(q)
            self.posture.set_target(q)
            self.aim(goal, t, POLISH)
            self.base.set_target(_pose(q[:3], frames[t]))
            for _ in range(POLISH_STEPS):
                self.reach(goal, t, POLISH)
                v = mink.solve_ik(
                    self.configuration, self.tasks, self.dt, SOLVER, damping=DAMPING, limits=self.limits[:2]
                )
                self.configuration.integrate_inplace(v, self.dt)
            solved.append(self.configuration.q.copy())
        return np.stack(solved)

    def shoulders(self, path: np.ndarray) -> np.ndarray:
        """(T, 2, 3) m in the world, for configurations (T, nq)."""
        joints = [self.body.joint_ids[f"{side}_shoulder"] for side in SIDES]
        found = []
        for q in path:
            self.configuration.update(q)
            found.append(self.configuration.data.xanchor[joints].copy())
        return np.stack(found)


def retarget(clip: Clip, body: RobotBody, fps: float = FPS, ball_radius: float = RADIUS) -> tuple[Clip, Targets]:
    """``clip`` of a human as a clip of the robot, and the targets it was solved for. Raises ClipError."""
    body = _within_limits(body)
    goal = targets(clip, body, fps, ball_radius, body.palm_height(ball_radius))
    imitator = Imitator(body, fps, STEPS)
    path = imitator.follow(goal)
    reachable = pulled_in(
        goal, imitator.shoulders(path), body.length("shoulder", "elbow") + body.length("elbow", "palm")
    )
    if reachable is not goal:
        goal, path = reachable, imitator.follow(reachable)
    for width in SMOOTHING:
        path = imitator.polish(goal, _smoothed(path, width))
    path = _smoothed(path, LAST_SMOOTHING)
    return _clip(clip, body, goal, path), goal


def _within_limits(body: RobotBody) -> RobotBody:
    """The same body, with joint ranges ``MARGIN`` narrower: where a policy may send it."""
    model = mujoco.MjModel.from_xml_path(str(body.robot.model_path))
    for name, low, high in zip(body.robot.joint_names, body.robot.position_min, body.robot.position_max, strict=True):
        model.joint(name).range = low + MARGIN, high - MARGIN
    return RobotBody(body.robot, model, body.trunk, body.limbs)


def _smoothed(path: np.ndarray, width: float) -> np.ndarray:
    return np.concatenate(
        [smooth(path[:, :3], width), smooth_orientation(path[:, 3:7], width), smooth(path[:, 7:], width)], axis=1
    )


def _clip(clip: Clip, body: RobotBody, goal: Targets, path: np.ndarray) -> Clip:
    data = mujoco.MjData(body.model)
    points = []
    for q in path:
        data.qpos[:] = q
        mujoco.mj_kinematics(body.model, data)
        points.append(body.points(data))
    header = clip.header.model_copy(
        update={
            "body": body.robot.name,
            "fps": goal.fps,
            "joint_names": body.robot.joint_names,
            "point_names": POINT_NAMES,
            "ball_radius": goal.ball_radius,
            "length_scale": goal.length_scale,
        }
    )
    return Clip(
        header,
        base_position_in_world=path[:, :3],
        base_orientation_in_world=path[:, 3:7],
        joint_pos=path[:, body.qpos_at],
        points_in_world=np.stack(points),
        ball_position_in_world=goal.ball,
        ball_velocity_in_world=goal.ball_velocity,
        contact=np.concatenate([goal.touching, goal.stance], axis=1),
    )


def _carries(model: mujoco.MjModel, ancestor: int, body: int) -> bool:
    """Whether ``body`` hangs on ``ancestor``."""
    while body != ancestor and body:
        body = model.body_parentid[body]
    return body == ancestor


def _pose(position: np.ndarray, rotation: np.ndarray) -> mink.SE3:
    return mink.SE3.from_rotation_and_translation(mink.SO3.from_matrix(rotation), position)


def _least_turn(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """(3, 3): the smallest rotation that takes unit vector ``a`` to the direction of ``b``."""
    b = kinematics.unit(b)
    axis, cosine = np.cross(a, b), float(a @ b)
    sine = float(np.linalg.norm(axis))
    if sine < 1e-9:
        return np.eye(3)
    turn = kinematics.quaternion_from_rotation_vector(axis / sine * np.arctan2(sine, cosine))
    return kinematics.matrix_from_quaternion(turn)
