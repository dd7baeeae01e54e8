"""A dribble by formula: no recording shows a ball bounced in place, so this one is physics.

A stroke begins where the ball stands still, at its peak: a palm on top of it pushes it down with one constant
acceleration, leaves it, comes to rest, and is back when the ball is, which has bounced with its restitution. So the
stroke repeats exactly, and palm and ball meet with no speed between them. The arm follows by inverse kinematics, which
keeps the palm down, but minds where the hand is ten times as much: to keep it level to the last degree would swing a heavy
shoulder, and that shakes the robot off its feet. On its way back the palm follows a cubic. Liu & Hodgins (2018), too, needed no recorded ball.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import mink
import mujoco
import numpy as np

from policies import ball
from policies.clips.format import Clip, Header
from policies.clips.kinematics import smooth
from policies.clips.robot import POINT_NAMES, SIDES, RobotBody
from policies.physics import standing_height

GRAVITY = 9.81  # m/s^2
SOLVER = "daqp"
CLEAR = 0.015  # m between palm and ball while they do not touch
SMOOTHING = 0.5  # frames
TURNED = 0.1  # m/rad: what a turned hand counts beside one that is elsewhere
TICK = 0.02  # s of a policy: a stroke lasts some of them
SETTLING = 3  # strokes before the one that is kept: then inverse kinematics has forgotten where it began


@dataclass(frozen=True)
class Stroke:
    """One bounce, at the size of the robot."""

    peak: float = 1.0  # m, the ball's centre where the palm finds it
    push: float = 0.2  # m that the palm stays on it
    follow: float = 0.3  # m in which the palm then comes to rest
    place: tuple[float, float] = (0.3, 0.27)  # m from the base: ahead, and to the side of the arm
    knees: float = 0.35  # rad, bent: as the robot stands at home


class Times(NamedTuple):
    """Of a stroke: seconds, and m/s."""

    push: float
    fall: float  # from the palm to the floor
    rise: float  # from the floor to the peak
    release: float  # speed downwards where the palm leaves the ball

    @property
    def period(self) -> float:
        return self.push + self.fall + self.rise


def times(stroke: Stroke, radius: float) -> Times:
    """What follows from the restitution: ball speeds are those that bring it back to its peak."""
    off = np.sqrt(2 * GRAVITY * (stroke.peak - radius))
    hit = off / ball.RESTITUTION
    release = np.sqrt(hit**2 - 2 * GRAVITY * (stroke.peak - stroke.push - radius))
    return Times(2 * stroke.push / release, (hit - release) / GRAVITY, off / GRAVITY, release)


def lasting(stroke: Stroke, radius: float, period: float) -> Stroke:
    """The stroke with its peak moved so that it lasts ``period`` s."""
    low, high = stroke.peak - 0.1, stroke.peak + 0.1
    for _ in range(50):
        stroke = replace(stroke, peak=(low + high) / 2)
        low, high = (stroke.peak, high) if times(stroke, radius).period < period else (low, stroke.peak)
    return stroke


def path(stroke: Stroke, radius: float, t: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """At times ``t`` (T,) s since a peak, (T,) each: the ball's height m and velocity m/s, the height m of a ball that the
    palm would lie on, and whether it does."""
    k = times(stroke, radius)
    s = np.mod(t, k.period)
    pull = k.release / k.push
    on, falls = s < k.push, s < k.push + k.fall
    f, left = s - k.push, k.period - s  # since the palm left, and until the next peak
    leave = stroke.peak - stroke.push
    z = np.select([on, falls], [stroke.peak - pull * s**2 / 2, leave - k.release * f - GRAVITY * f**2 / 2],
                  stroke.peak - GRAVITY * left**2 / 2)  # fmt: skip
    v = np.select([on, falls], [-pull * s, -k.release - GRAVITY * f], GRAVITY * left)
    stop = 2 * stroke.follow / k.release  # s in which the palm comes to rest
    low = leave - stroke.follow
    u = np.clip((f - stop) / (k.fall + k.rise - stop), 0, 1)  # and back, from rest to rest
    back = np.where(
        f < stop,
        leave - k.release * f + k.release**2 / (4 * stroke.follow) * f**2,
        low + (stroke.peak - low) * (3 * u**2 - 2 * u**3),
    )
    above = np.maximum.reduce([back, z + np.minimum(CLEAR, GRAVITY * left**2 / 4)])
    return z, v, np.where(on, z, above), on


def dribble(body: RobotBody, name: str, stroke: Stroke = Stroke(), side: str = "right", fps: float = 100.0) -> Clip:
    """One stroke of ``side``'s hand, from peak to peak, by a robot that stands with bent knees."""
    sign = 1.0 if side == "left" else -1.0
    frames = round(round(times(stroke, ball.RADIUS).period / TICK) * TICK * fps)
    stroke = lasting(stroke, ball.RADIUS, frames / fps)
    period = frames / fps
    t = np.arange(frames * (SETTLING + 2)) * period / frames
    z, v, palm, on = path(stroke, ball.RADIUS, t)
    names = body.robot.joint_names
    pose = body.robot.home_pos.copy()
    for joint, angle in (("hip_pitch", -stroke.knees / 2), ("knee", stroke.knees), ("ankle_pitch", -stroke.knees / 2)):
        pose[[names.index(f"{s}_{joint}_joint") for s in SIDES]] = angle
    height = float(standing_height(body.model, pose[None])[0])
    model = body.model
    touch = body.palm_height(ball.RADIUS)
    place = np.array([stroke.place[0], sign * stroke.place[1]])

    data = mujoco.MjData(model)
    configuration = mink.Configuration(model)
    q = model.qpos0.copy()
    q[:3], q[3:7] = [0, 0, height], [1, 0, 0, 0]
    q[body.qpos_at] = pose
    configuration.update(q)
    mine = np.array([j.group == "arm" and side in j.name for j in body.robot.joints])
    still = np.ones(model.nv, bool)
    still[body.qvel_at[mine]] = False
    reach = mink.FrameTask(f"{side}_palm", "site", 1.0, TURNED)
    posture = mink.PostureTask(model, 3e-2)
    posture.set_target(q)
    freeze = mink.DofFreezingTask(model, np.flatnonzero(still).tolist())
    limits = [mink.ConfigurationLimit(model)]
    down = mink.SO3.from_x_radians(np.pi)
    rows = []
    for k in range(len(t)):
        reach.set_target(mink.SE3.from_rotation_and_translation(down, np.array([*place, palm[k] + touch])))
        for _ in range(12):
            speed = mink.solve_ik(
                configuration, [reach, posture], 0.1, SOLVER, damping=1e-3, limits=limits, constraints=[freeze]
            )
            configuration.integrate_inplace(speed, 0.1)
        rows.append(configuration.q[body.qpos_at].copy())
    last = slice(frames * SETTLING, frames * (SETTLING + 1))
    joint_pos = smooth(np.array(rows), SMOOTHING)[last]
    points = np.zeros((frames, len(POINT_NAMES), 3))
    for k, joints in enumerate(joint_pos):
        data.qpos[:3], data.qpos[3:7], data.qpos[body.qpos_at] = [0, 0, height], [1, 0, 0, 0], joints
        mujoco.mj_kinematics(model, data)
        points[k] = body.points(data)
    hands = np.array([[on_now and s == side for s in SIDES] for on_now in on[last]])
    header = Header(
        name=name, skill=name.rsplit("_", 1)[0], body=body.robot.name, fps=fps,
        joint_names=names, point_names=POINT_NAMES, ball_radius=ball.RADIUS, source=f"policies/clips/bounce.py, {side} hand",
        licence="Apache-2.0",
    )  # fmt: skip
    return Clip(
        header,
        base_position_in_world=np.tile([0.0, 0.0, height], (frames, 1)),
        base_orientation_in_world=np.tile([1.0, 0, 0, 0], (frames, 1)),
        joint_pos=joint_pos,
        points_in_world=points,
        ball_position_in_world=np.column_stack([np.tile(place, (frames, 1)), z[last]]),
        ball_velocity_in_world=np.column_stack([np.zeros((frames, 2)), v[last]]),
        contact=np.column_stack([hands, np.ones((frames, 2), bool)]),
    )
