"""Picking a ball up from the floor, by formula: the robot goes down as far as its balance was trained to, closes both palms
on the ball, and lifts it to where it is otherwise held.

People who pick a ball up step towards it, bend and grab it with fingers. This robot stands before it and has two palms.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import mink
import mujoco
import numpy as np

from policies import ball
from policies.basics import down
from policies.clips.bounce import eased
from policies.clips.format import Clip
from policies.clips.kinematics import rate, smooth
from policies.clips.reach import Frame, clip_of, follow
from policies.clips.robot import SIDES, RobotBody
from policies.physics import Stature

FACING = {"left": np.pi / 2, "right": -np.pi / 2}  # rad about x: palms that look at each other
UPRIGHT = 0.03  # m/rad, what a turned hand counts beside one that is elsewhere
SMOOTHING = 2.0  # frames
SETTLING = 5  # frames before the first: then inverse kinematics has forgotten where it began


@dataclass(frozen=True)
class Pickup:
    """Durations in s."""

    down: float = 2.5
    close: float = 0.5
    grip: float = 0.3  # that they press before they lift
    lift: float = 4.0
    rest: float = 0.3
    open: float = 0.06  # m between each palm and the ball before they close
    palms: float = 0.12  # m above the floor: a hand that points down reaches below the middle of the ball
    hold: tuple[float, float, float] = (0.25, 0.0, 0.04)  # m in the base, where the ball ends
    fingers: tuple[float, float] = (0.45, 0.2)  # rad down from ahead in the base: at the floor, and at the end

    @property
    def seconds(self) -> float:
        return self.down + self.close + self.grip + self.lift + self.rest

    def path(self, t: np.ndarray) -> Path:
        """At times ``t`` (T,) s."""
        lifted = eased((t - self.down - self.close - self.grip) / self.lift)
        closed = eased((t - self.down) / self.close)
        return Path(eased(t / self.down) - lifted, self.open * (1 - closed), t >= self.down + self.close)


class Path(NamedTuple):
    """A pickup over time, (T,) each."""

    down: np.ndarray  # share of the way to the floor
    apart: np.ndarray  # m between each palm and the ball
    on: np.ndarray  # bool: palms and ball touch


def pickup(body: RobotBody, name: str, motion: Pickup = Pickup(), fps: float = 100.0) -> Clip:
    """The clip: from hands ready to hold a ball to a ball in them, with feet that stay where they are."""
    radius, robot = ball.RADIUS, body.robot
    path = motion.path(np.arange(round(motion.seconds * fps) + 1) / fps)
    pose = robot.home_pos + down(robot.joint_names, path.down)
    lowest = robot.home_pos + down(robot.joint_names, np.ones(1))[0]
    base = _standing(body, pose)
    bases = [mink.SE3(np.concatenate([b[3:], b[:3]])) for b in base]
    bottom = int(path.down.argmax())
    touch, seen = body.palm_height(radius), bases[bottom].inverse()
    floor = np.array([_ahead(body, lowest, base[bottom]), 0.0, radius])
    begin, over = seen.apply(floor), seen.rotation().apply(np.array([0.0, 0.0, motion.palms - radius]))
    frames, place = [], np.tile(floor, (len(base), 1))
    for t, u in enumerate(1 - path.down):  # all seen from the base; palms go the same way down, around no ball
        there = begin + u * (motion.hold - begin)
        if path.on[t]:
            place[t] = bases[t].apply(there)
        palms = {}
        for side in SIDES:
            turn = mink.SO3.from_y_radians(np.interp(u, [0, 1], motion.fingers)) @ mink.SO3.from_x_radians(FACING[side])
            back = turn.apply(np.array([0.0, 0.0, touch + path.apart[t]]))
            palms[side] = bases[t] @ mink.SE3.from_rotation_and_translation(turn, there + (1 - u) * over - back)
        frames.append(Frame(base[t], pose[t], palms))
    joint_pos = smooth(follow(body, frames[:1] * SETTLING + frames, UPRIGHT)[SETTLING:], SMOOTHING)
    hands = np.column_stack([path.on, path.on])
    return clip_of(body, name, "policies/clips/pickup.py", fps, base, joint_pos, place, rate(place, fps), hands)


def _standing(body: RobotBody, pose: np.ndarray) -> np.ndarray:
    """(T, 7) bases of poses (T, n) whose soles are flat and stay where those of the home pose are below a base at x = 0."""
    stature, data = Stature(body.model, body.robot.home_pos), mujoco.MjData(body.model)

    def feet(joints: np.ndarray, pitch: float) -> float:
        data.qpos[:7], data.qpos[body.qpos_at] = [0, 0, 0, np.cos(pitch / 2), 0, np.sin(pitch / 2), 0], joints
        mujoco.mj_kinematics(body.model, data)
        return float(data.site_xpos[body.feet, 0].mean())

    pitch, home = stature.pitch(pose), feet(body.robot.home_pos, 0.0)
    x = home - np.array([feet(joints, p) for joints, p in zip(pose, pitch, strict=True)])
    zero = np.zeros(len(x))
    return np.column_stack([x, zero, stature.height(pose), np.cos(pitch / 2), zero, np.sin(pitch / 2), zero])


def _ahead(body: RobotBody, pose: np.ndarray, base: np.ndarray) -> float:
    """m along x in the world, where the palms are."""
    data = mujoco.MjData(body.model)
    data.qpos[:7], data.qpos[body.qpos_at] = base, pose
    mujoco.mj_kinematics(body.model, data)
    return float(data.site_xpos[body.palms, 0].mean())
