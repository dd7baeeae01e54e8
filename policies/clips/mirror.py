"""A clip seen in a mirror: left becomes right."""

from __future__ import annotations

import numpy as np

from policies.clips import skeleton
from policies.clips.format import Clip, ClipError

ACROSS = np.array([1.0, -1.0, 1.0])  # world y changes sign


def mirror(clip: Clip) -> Clip:
    """A human ``clip`` mirrored in the world's xz plane. Raises ClipError for a robot's: mirror it before retargeting."""
    if clip.header.body != "human":
        raise ClipError(f"clip '{clip.name}': got a clip of {clip.header.body}, expected a human's: mirror it first")
    label = {"left": "right", "right": "left"}
    skill = "_".join(label.get(word, word) for word in clip.header.skill.split("_"))
    return Clip(
        clip.header.model_copy(update={"name": f"{clip.name}_mirrored", "skill": skill}),
        base_position_in_world=clip.base_position_in_world * ACROSS,
        # A reflection M turns a rotation R into M R M: the axis is reflected and the angle changes sign.
        base_orientation_in_world=clip.base_orientation_in_world * [1.0, -1.0, 1.0, -1.0],
        joint_pos=clip.joint_pos,
        points_in_world=clip.points_in_world[:, list(skeleton.MIRROR)] * ACROSS,
        ball_position_in_world=clip.ball_position_in_world * ACROSS,
        ball_velocity_in_world=clip.ball_velocity_in_world * ACROSS,
        contact=clip.contact[:, [1, 0, 3, 2]],
    )
