"""A clip at another frame rate or speed."""

from __future__ import annotations

import numpy as np

from policies.clips import kinematics
from policies.clips.format import Clip

KINK = 1.0  # m/s between two frames: more is a bounce or a hit, and nothing in between ever happened


def resample(clip: Clip, fps: float, slower: float = 1.0) -> Clip:
    """``clip`` at ``fps``, with every time multiplied by ``slower``. Positions are interpolated linearly, orientations
    along the shorter arc, contacts and the velocity of a ball that was just hit taken from the nearest frame; velocities
    are divided by ``slower``."""
    frames = int(np.floor((len(clip) - 1) * slower / clip.fps * fps + 1e-9)) + 1
    at = np.clip(np.arange(frames) / fps * clip.fps / slower, 0, len(clip) - 1)
    low = np.minimum(np.floor(at).astype(int), max(len(clip) - 2, 0))
    high = np.minimum(low + 1, len(clip) - 1)
    nearest, share = np.round(at).astype(int), at - low

    def linear(x: np.ndarray) -> np.ndarray:
        w = share.reshape(-1, *(1,) * (x.ndim - 1))
        return (1 - w) * x[low] + w * x[high]

    v = clip.ball_velocity_in_world
    hit = np.linalg.norm(v[high] - v[low], axis=1) > KINK
    return Clip(
        clip.header.model_copy(update={"fps": float(fps)}),
        base_position_in_world=linear(clip.base_position_in_world),
        base_orientation_in_world=_slerp(clip.base_orientation_in_world, low, high, share),
        joint_pos=linear(clip.joint_pos),
        points_in_world=linear(clip.points_in_world),
        ball_position_in_world=linear(clip.ball_position_in_world),
        ball_velocity_in_world=np.where(hit[:, None], v[nearest], linear(v)) / slower,
        contact=clip.contact[nearest],
    )


def _slerp(q: np.ndarray, low: np.ndarray, high: np.ndarray, share: np.ndarray) -> np.ndarray:
    between = kinematics.rotation_vector_from_quaternion(kinematics.multiply(q[high], kinematics.conjugate(q[low])))
    return kinematics.multiply(kinematics.quaternion_from_rotation_vector(share[:, None] * between), q[low])
