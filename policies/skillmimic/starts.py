"""Where a skill starts: posture of the robot, place and flight of the ball. Training and contract agree on it."""

from __future__ import annotations

from typing import Any

import numpy as np

from drivers.sim import ball
from policies.clips.kinematics import conjugate, quaternion_from_rotation_vector, rotate
from policies.physics import standing_height
from policies.skillmimic.clips import PRESS, grip
from policies.skillmimic.graph import PolicyGraph
from policies.skillmimic.stance import stand
from sim2real.contract import ObjectStart
from sim2real.object.scene import AIMING, highest

OPEN = 0.05  # m


def first_clips(graph: PolicyGraph) -> list[int]:
    """Of every skill, the number of its first clip."""
    return [int(np.flatnonzero(graph.clips.skill == k)[0]) for k in range(len(graph.labels))]


def object_start(graph: PolicyGraph, clip: int) -> dict[str, Any]:
    """How the skill of clip number ``clip`` finds the ball there: a contract.ObjectStart.

    In the hands if both palms are on it at the start: then at its mean place in the skill's clips, which is where they are
    in the skill's posture. Else lying or flying, as in the first frame.
    """
    clips = graph.clips
    if clips.recorded[clip].contact[0, :2].all():
        alike = np.flatnonzero(clips.skill == clips.skill[clip])
        return {"how": "held", "position": _rounded(np.mean([_in_hands(graph, c) for c in alike], axis=0))}
    m = clips.motion(clips.first[[clip]], np.ones(1))
    base, turn, position, velocity = m.points[:, 0], m.orientation_base_in_world, m.object_position, m.object_velocity
    ahead = rotate(turn[0], np.array([1.0, 0.0, 0.0]))
    back = quaternion_from_rotation_vector(np.array([0.0, 0.0, -np.arctan2(ahead[1], ahead[0])]))
    place = rotate(back, position[0] - base[0] * [1.0, 1.0, 0.0])
    if place[2] < 1.5 * ball.RADIUS and np.linalg.norm(velocity[0]) < 0.3:
        return {"how": "placed", "position": _rounded(np.array([*place[:2], ball.RADIUS]))}
    return {"how": "thrown", "position": _rounded(place), "velocity": _rounded(rotate(back, velocity[0]))}


def _in_hands(graph: PolicyGraph, clip: int) -> np.ndarray:
    """(3,) m in the base: the ball of clip number ``clip``, mean while hands are on it; of one that begins again, there."""
    clips = graph.clips
    rows = clips.first[clip] + np.arange(1 if clips.loop[clip] else clips.length[clip])
    m = clips.motion(rows, np.ones(len(rows)))
    place = rotate(conjugate(m.orientation_base_in_world), m.object_position - m.points[:, 0])
    return place[m.contact[:, 0] > 0].mean(axis=0)


def thrown(graph: PolicyGraph, clip: int) -> tuple[np.ndarray, np.ndarray] | None:
    """Where whoever throws the ball of clip number ``clip`` aims from, (3,) m, and how it flies from there, (3,) m/s: seen
    from the floor below the base, which is level and looks ahead. None where nobody aims."""
    start = highest(ObjectStart.model_validate(object_start(graph, clip)))
    if start.how != "thrown" or not any(start.velocity):
        return None
    return np.array(start.position), np.array(start.velocity)


def aiming(graph: PolicyGraph, clip: int) -> float:
    """s between the beginning of a skill and that of its clip number ``clip``: a ball that is thrown is aimed first."""
    return 0.0 if thrown(graph, clip) is None else AIMING


def start_posture(graph: PolicyGraph) -> np.ndarray:
    """(n,) rad, where the soft start ends: the posture of the first skill; legs and waist as a base policy stands."""
    return np.where(graph.acts.numpy() > 0, graph.clips.start(), graph.clips.stance[0])


def approach(graph: PolicyGraph) -> list[float]:
    """(n,) rad, ``start_posture`` with the palms ``OPEN`` off the ball, for hands that then close on it from both sides;
    empty where the first skill does not begin with both palms on the ball."""
    clips, body = graph.clips, graph.body
    postures = []
    for clip in clips.of(0):
        both = clip.contact[:, :2].all(axis=1)
        if not both[0]:
            continue
        if graph.base is not None:
            clip = stand(clip, body, clips.stance[0], float(standing_height(body.model, clips.stance[:1])[0]))
        g = grip(clip, graph.model, body, graph.kp, force=0.0)
        postures.append((clip.joint_pos + g.effort - g.press * (OPEN / PRESS))[both].mean(axis=0))
    if not postures:
        return []
    posture = np.where(graph.acts.numpy() > 0, np.mean(postures, axis=0), clips.stance[0])
    return np.clip(posture, graph.lower.numpy(), graph.upper.numpy()).tolist()


def _rounded(vector: np.ndarray) -> list[float]:
    return [round(v, 4) for v in vector.tolist()]
