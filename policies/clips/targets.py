"""What a robot should do to do what a person did: a human clip scaled to the robot's size and time.

One length scale s for everything, the robot's leg over the person's, and time scaled by its square root. Then heights,
steps and flights keep their proportions (equal Froude number) and the ball still falls with 9.81 m/s^2. The robot's own
segment lengths enter where s would leave a limb too short or too long: base above the hips, arms from the shoulders.

A hand on or near the ball is placed relative to the ball, a far one relative to the shoulder, with a smooth change.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from policies.clips import kinematics, skeleton
from policies.clips.contact import hand_distance, spans
from policies.clips.format import Clip, ClipError
from policies.clips.kinematics import smooth, unit
from policies.clips.resample import resample
from policies.clips.robot import RobotBody
from policies.clips.skeleton import INDEX

BODY_SMOOTHING = 1.0  # frames of the recording: fingers and wrists jump
NEAR, FAR = 0.22, 0.45  # m from hand to ball centre in the recording: placed by the ball, by the shoulder
CLOSING = 2  # frames: over the last of these before a touch, and the first after, a palm comes or goes evenly
OPPOSED = (
    0.75  # 0: both hands touch where the person's do; 1: exactly opposite. A hand without fingers holds by friction
)
KNUCKLES = ("Index1", "Middle1", "Pinky1", "Ring1")
PELVIS_SHARE = 0.15  # in a foot's left axis
STRETCHED = 0.98  # of its length, a leg reaches at most
ARM_STRETCHED = 0.95  # of its length, from shoulder to palm, while the palm is on the ball


@dataclass(frozen=True)
class Targets:
    """T frames at ``fps``, world frame, metres; sides are left, right."""

    fps: float
    length_scale: float
    ball: np.ndarray  # (T, 3)
    ball_velocity: np.ndarray  # (T, 3) m/s
    ball_radius: float
    base: np.ndarray  # (T, 3)
    base_frame: np.ndarray  # (T, 3, 3)
    trunk_frame: np.ndarray  # (T, 3, 3)
    centre_of_mass: np.ndarray  # (T, 3)
    knees: np.ndarray  # (T, 2, 3)
    feet: np.ndarray  # (T, 2, 3) sole
    foot_frames: np.ndarray  # (T, 2, 3, 3)
    stance: np.ndarray  # (T, 2) bool
    upper_arms: np.ndarray  # (T, 2, 3) from shoulder to elbow, at the robot's length
    forearms: np.ndarray  # (T, 2, 3) from elbow to palm, at the robot's length
    fingers: np.ndarray  # (T, 2, 3) unit: where they point
    palms: np.ndarray  # (T, 2, 3) where a palm should be that is placed by the ball
    by_ball: np.ndarray  # (T, 2) in [0, 1]: how much it is
    touching: np.ndarray  # (T, 2) bool


def length_scale(body: RobotBody) -> float:
    """The robot's leg over the recorded person's."""
    thigh, shin = (np.linalg.norm(skeleton.OFFSETS[INDEX[f"L_{part}"]]) for part in ("Knee", "Ankle"))
    return body.leg_length / float(thigh + shin + skeleton.ANKLE_HEIGHT)


def scaled_ball(ball: np.ndarray, s: float, radius: float) -> np.ndarray:
    """The recorded ball (T, 3) m as one of ``radius`` m in a world ``s`` as large. It touches the floor where the
    recorded one does and no deeper: that one rests at 0.11 m, of a radius of 0.12 m, and is squeezed to less."""
    scaled = s * (ball - [0, 0, skeleton.BALL_RADIUS]) + [0, 0, radius]
    return np.concatenate([scaled[:, :2], np.maximum(scaled[:, 2:], radius)], axis=1)


def targets(clip: Clip, body: RobotBody, fps: float, ball_radius: float, palm_height: float) -> Targets:
    """Everything a human ``clip`` asks of the robot, at the robot's ``fps``. A palm on the ball is ``palm_height`` m from its
    centre. Raises ClipError for a robot's clip."""
    if clip.header.body != "human":
        raise ClipError(f"clip '{clip.name}': got one of {clip.header.body}, expected a human's")
    s = length_scale(body)
    clip = resample(_smoothed(clip), fps, slower=np.sqrt(s))
    points = clip.points_in_world
    ball = scaled_ball(clip.ball_position_in_world, s, ball_radius)
    base_frame = kinematics.matrix_from_quaternion(clip.base_orientation_in_world)
    hips = s * (points[:, INDEX["L_Hip"]] + points[:, INDEX["R_Hip"]]) / 2
    base = hips - base_frame @ (body.rest["left_hip"] + body.rest["right_hip"]) / 2
    stance = clip.contact[:, 2:]
    feet, foot_frames = _feet(points, base_frame, s, stance, body)
    base = _within_reach(base, base_frame, feet, foot_frames, body)
    upper, fore, fingers = _arms(points, body)
    palms, by_ball = _palms(clip, s, ball, palm_height)
    return Targets(
        fps=fps,
        length_scale=s,
        ball=ball,
        ball_velocity=s * clip.ball_velocity_in_world,
        ball_radius=ball_radius,
        base=base,
        base_frame=base_frame,
        trunk_frame=_trunk_frame(points),
        centre_of_mass=s * skeleton.centre_of_mass(points),
        knees=s * np.stack([points[:, INDEX[f"{side}_Knee"]] for side in "LR"], axis=1),
        feet=feet,
        foot_frames=foot_frames,
        stance=stance,
        upper_arms=upper,
        forearms=fore,
        fingers=fingers,
        palms=palms,
        by_ball=by_ball,
        touching=clip.contact[:, :2],
    )


def _smoothed(clip: Clip) -> Clip:
    arrays = {
        name: getattr(clip, name)
        for name in ("joint_pos", "ball_position_in_world", "ball_velocity_in_world", "contact")
    }
    return Clip(
        clip.header,
        base_position_in_world=smooth(clip.base_position_in_world, BODY_SMOOTHING),
        base_orientation_in_world=kinematics.smooth_orientation(clip.base_orientation_in_world, BODY_SMOOTHING),
        points_in_world=smooth(clip.points_in_world, BODY_SMOOTHING),
        **arrays,
    )


def _trunk_frame(points: np.ndarray) -> np.ndarray:
    """(T, 3, 3) of the chest: up along the spine, left along the thoraces, who hardly move with the arms."""
    left = points[:, INDEX["L_Thorax"]] - points[:, INDEX["R_Thorax"]]
    return kinematics.frame(left, points[:, INDEX["Neck"]] - points[:, INDEX["Torso"]])


def _feet(
    points: np.ndarray, base_frame: np.ndarray, s: float, stance: np.ndarray, body: RobotBody
) -> tuple[np.ndarray, np.ndarray]:
    """Soles (T, 2, 3) and their frames (T, 2, 3, 3): flat and still in stance, no part of a sole under the floor."""
    at, frames = np.empty((len(points), 2, 3)), np.empty((len(points), 2, 3, 3))
    for k, (side, name) in enumerate(zip("LR", ("left", "right"), strict=True)):
        sole = body.rest[f"{name}_foot"] - body.rest[f"{name}_ankle"]
        ankle = s * points[:, INDEX[f"{side}_Ankle"]]
        ankle[:, 2] = np.maximum(ankle[:, 2] - s * skeleton.ANKLE_HEIGHT, 0.0) - sole[2]
        ankle, frames[:, k] = _planted(ankle, _foot_frame(points, base_frame, side), stance[:, k], -sole[2])
        at[:, k] = ankle + frames[:, k] @ sole
        at[:, k, 2] += np.maximum(-_lowest(at[:, k], frames[:, k], name, body), 0.0)
    return at, frames


def _foot_frame(points: np.ndarray, base_frame: np.ndarray, side: str) -> np.ndarray:
    """(T, 3, 3): level while standing. Its left is across shin and foot, helped by the pelvis's where these align."""
    knee, ankle, toe = (points[:, INDEX[f"{side}_{p}"]] for p in ("Knee", "Ankle", "Toe"))
    left = unit(np.cross(unit(knee - ankle), unit(toe - ankle)) + PELVIS_SHARE * base_frame[:, :, 1])
    x = unit(toe - ankle - ((toe - ankle) * left).sum(axis=1, keepdims=True) * left)
    toes = np.stack([x, left, np.cross(x, left)], axis=-1)
    rest = skeleton.FORWARD_LEFT_UP.T @ skeleton.OFFSETS[INDEX["L_Toe"]]
    slope = np.arctan2(rest[2], rest[0])  # of the line from ankle to toe on a level foot
    return toes @ _about_y(slope)


def _about_y(angle: float) -> np.ndarray:
    return np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])


def _lowest(at: np.ndarray, frames: np.ndarray, name: str, body: RobotBody) -> np.ndarray:
    """(T,) m: height of the lowest point of a sole whose site is ``at`` (T, 3)."""
    k = ("left", "right").index(name)
    model, site = body.model, body.feet[k]
    corners = model.geom_pos[body.foot_geoms[k]] - model.site_pos[site]
    radius = model.geom_size[body.foot_geoms[k], 0]
    return (at[:, None, 2] + np.einsum("tij,cj->tci", frames, corners)[..., 2] - radius).min(axis=1)


def _planted(ankle: np.ndarray, frames: np.ndarray, stance: np.ndarray, height: float) -> tuple[np.ndarray, np.ndarray]:
    """Ankles (T, 3) and feet's frames (T, 3, 3) with every stance at one place, level, the ankle ``height`` m up, and the
    steps between two stances drawn along."""
    yaw = np.unwrap(np.arctan2(frames[:, 1, 0], frames[:, 0, 0]))
    offset, turn = np.zeros_like(ankle), np.zeros_like(ankle)
    known = []
    for start, stop in spans(stance):
        span = slice(start, stop)
        offset[span] = [*np.median(ankle[span, :2], axis=0), height] - ankle[span]
        level = kinematics.matrix_from_quaternion(
            kinematics.quaternion_from_rotation_vector(np.array([0, 0, np.median(yaw[span])]))
        )
        turn[span] = _log(level @ np.swapaxes(frames[span], -1, -2))
        known += [start, stop - 1]
    for t in np.flatnonzero(~stance) if known else ():
        before = max((k for k in known if k < t), default=None)
        after = min((k for k in known if k > t), default=None)
        first, last = (before if before is not None else after), (after if after is not None else before)
        x = (t - first) / (last - first) if last != first else 0.0  # type: ignore[operator]
        share = 3 * x**2 - 2 * x**3
        offset[t] = (1 - share) * offset[first] + share * offset[last]
        turn[t] = (1 - share) * turn[first] + share * turn[last]
    turned = kinematics.matrix_from_quaternion(kinematics.quaternion_from_rotation_vector(turn)) @ frames
    return ankle + offset, turned


def _log(rotation: np.ndarray) -> np.ndarray:
    """Rotation vectors (..., 3) rad of matrices (..., 3, 3)."""
    return kinematics.rotation_vector_from_quaternion(kinematics.quaternion_from_matrix(rotation))


def _within_reach(
    base: np.ndarray, base_frame: np.ndarray, feet: np.ndarray, foot_frames: np.ndarray, body: RobotBody
) -> np.ndarray:
    """The base (T, 3) lowered, smoothly, where a leg would be too short to reach its foot."""
    down = np.zeros(len(base))
    for k, side in enumerate(("left", "right")):
        reach = STRETCHED * (body.length("hip", "knee") + body.length("knee", "ankle"))
        hip = base + base_frame @ body.rest[f"{side}_hip"]
        ankle = feet[:, k] + foot_frames[:, k] @ (body.rest[f"{side}_ankle"] - body.rest[f"{side}_foot"])
        across = np.linalg.norm((hip - ankle)[:, :2], axis=1)
        highest = ankle[:, 2] + np.sqrt(np.maximum(reach**2 - across**2, 0.0))
        down = np.maximum(down, hip[:, 2] - highest)
    return base - np.array([0, 0, 1]) * smooth(down, 2.0)[:, None]


def _arms(points: np.ndarray, body: RobotBody) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Upper arms, forearms to the palm (T, 2, 3) m at the robot's lengths, and finger directions (T, 2, 3)."""
    upper, fore, fingers = [], [], []
    for side in "LR":
        shoulder, elbow, wrist = (points[:, INDEX[f"{side}_{p}"]] for p in ("Shoulder", "Elbow", "Wrist"))
        knuckles = np.mean([points[:, INDEX[f"{side}_{p}"]] for p in KNUCKLES], axis=0)
        upper.append(unit(elbow - shoulder) * body.length("shoulder", "elbow"))
        fore.append(unit((wrist + knuckles) / 2 - elbow) * body.length("elbow", "palm"))
        fingers.append(unit(knuckles - wrist))
    return np.stack(upper, axis=1), np.stack(fore, axis=1), np.stack(fingers, axis=1)


def _palms(clip: Clip, s: float, ball: np.ndarray, touch: float) -> tuple[np.ndarray, np.ndarray]:
    """Where palms placed by the ball are (T, 2, 3) m, ``touch`` m from its centre at contact, and how much (T, 2)."""
    if not clip.header.has_ball:
        return np.zeros((len(clip), 2, 3)), np.zeros((len(clip), 2))
    points = clip.points_in_world
    centre = np.stack([np.mean([points[:, INDEX[f"{side}_{p}"]] for p in KNUCKLES], axis=0) for side in "LR"], axis=1)
    to_hand = centre - clip.ball_position_in_world[:, None]
    distance = hand_distance(points, clip.ball_position_in_world)
    contact = clip.contact[:, :2]
    apart = np.stack([_frames_to(contact[:, k]) for k in range(2)], axis=1)
    x = np.clip((FAR - distance) / (FAR - NEAR), 0, 1)
    by_ball = smooth(np.where(apart <= CLOSING, 1.0, 3 * x**2 - 2 * x**3), 1.5)
    by_ball = np.where(contact, 1.0, np.clip(by_ball, 0.0, 1.0))
    gap = np.linalg.norm(to_hand, axis=-1)
    closed = np.array([np.median(gap[contact[:, k], k]) if contact[:, k].any() else 0.16 for k in range(2)])
    share = np.clip(apart / CLOSING, 0, 1)
    away = (3 * share**2 - 2 * share**3) * s * smooth(np.maximum(gap - closed, 0.0), 1.5)
    towards = unit(smooth(unit(to_hand), 1.5))
    both = (by_ball[:, 0] * by_ball[:, 1])[:, None, None]
    towards = unit(towards - OPPOSED * both * towards.mean(axis=1, keepdims=True))
    return ball[:, None] + towards * (touch + away)[..., None], by_ball


def _frames_to(on: np.ndarray) -> np.ndarray:
    """(T,) frames from each to the nearest where (T,) is True; T + 1 where none is."""
    frames = np.arange(len(on))
    where = np.flatnonzero(on)
    if not len(where):
        return np.full(len(on), len(on) + 1)
    return abs(frames[:, None] - where).min(axis=1)


def pulled_in(goal: Targets, shoulders: np.ndarray, arm_length: float) -> Targets:
    """``goal`` with the ball where the arms reach it, given ``shoulders`` (T, 2, 3) m.

    While a hand is on the ball, ball and palms are drawn towards shoulders that are further away than ``arm_length`` m.
    A flight before or after is moved as a whole; one between two contacts is sheared evenly, which leaves its
    acceleration alone, and one that ends on the floor keeps its height there.
    """
    way = shoulders - goal.palms
    far = np.linalg.norm(way, axis=-1, keepdims=True)
    excess = np.maximum(far - ARM_STRETCHED * arm_length, 0.0) * goal.touching[..., None]
    if excess.max(initial=0.0) < 1e-3:
        return goal
    pull = (excess * way / np.maximum(far, 1e-9)).sum(axis=1) / np.maximum(goal.touching.sum(axis=1), 1)[:, None]
    held = goal.touching.any(axis=1)
    offset = np.zeros_like(pull)
    for start, stop in spans(held):
        offset[start:stop] = smooth(_largest_nearby(pull[start:stop], 3), 2.0)
    frames, contacts = np.arange(len(held)), np.flatnonzero(held)
    shift = np.stack([np.interp(frames, contacts, offset[contacts, axis]) for axis in range(3)], axis=1)
    low = np.flatnonzero((goal.ball[:, 2] < goal.ball_radius + 0.03) & ~held)
    knots = np.union1d(contacts, low)
    shift[:, 2] = np.interp(frames, knots, np.where(np.isin(knots, contacts), offset[knots, 2], 0.0))
    return replace(
        goal,
        ball=goal.ball + shift,
        ball_velocity=goal.ball_velocity + kinematics.rate(shift, goal.fps),
        palms=goal.palms + shift[:, None],
    )


def _largest_nearby(x: np.ndarray, reach: int) -> np.ndarray:
    """(T, 3): of the vectors at most ``reach`` frames away, the longest."""
    frames = np.arange(len(x))
    nearby = abs(frames[:, None] - frames) <= reach
    return x[np.where(nearby, np.linalg.norm(x, axis=1), -1.0).argmax(axis=1)]
