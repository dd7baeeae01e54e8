"""The body of BallPlay-M: 53 bodies in SMPL-X order, their parents and where they rest.

Rest frame: y up, z forward, x to the body's left; metres. Bone offsets are the published ones of the data set's own
skeleton (SkillMimic, `mocap_humanoid.xml`, Apache-2.0), rounded to a millimetre, fingers averaged over both hands. The
body positions stored in the clips are those of a simulated skeleton that tracked the recording: they lie 2.6 to 4.2 cm
from what these bones give, and the ball touches the hands of these bones and not of those.
"""

from __future__ import annotations

import numpy as np

_FINGERS = ("Index", "Middle", "Pinky", "Ring", "Thumb")
_LEG = ("Hip", "Knee", "Ankle", "Toe")
_ARM = ("Thorax", "Shoulder", "Elbow", "Wrist", *(f"{finger}{i}" for finger in _FINGERS for i in (1, 2, 3)))
_TRUNK = ("Torso", "Spine", "Spine2", "Chest", "Neck", "Head")

BODIES: tuple[str, ...] = (
    "Pelvis",
    *(f"L_{n}" for n in _LEG),
    *(f"R_{n}" for n in _LEG),
    *_TRUNK,
    *(f"L_{n}" for n in _ARM),
    *(f"R_{n}" for n in _ARM),
)
INDEX: dict[str, int] = {name: i for i, name in enumerate(BODIES)}


def _parent(name: str) -> str:
    """Fingers hang on the wrist, thoraces on the chest, hips and torso on the pelvis; all else on the one before."""
    side, _, part = name.rpartition("_")
    if part in ("Hip", "Torso"):
        return "Pelvis"
    if part == "Thorax":
        return "Chest"
    if part[:-1] in _FINGERS and part.endswith("1"):
        return f"{side}_Wrist"
    return BODIES[INDEX[name] - 1]


PARENTS: tuple[int, ...] = (-1, *(INDEX[_parent(name)] for name in BODIES[1:]))

_LEFT_LEG = [[0.110, -0.037, 0.0], [0.0, -0.461, 0.026], [0.0, -0.364, -0.026], [0.0, -0.099, 0.157]]
_SPINE = [[0, 0.088, -0.028], [0, 0.106, 0], [0, 0.106, 0], [0, 0.167, 0], [0, 0.084, 0.015], [0, 0.110, 0]]
_LEFT_ARM = [
    *([0.018, -0.030, 0.037], [0.166, 0.0, 0.0], [0.253, 0.0, 0.0], [0.244, 0.0, 0.0]),
    *([0.098, 0.0, 0.051], [0.034, 0.0, 0.0], [0.024, 0.0, 0.0]),
    *([0.091, 0.0, 0.026], [0.041, 0.0, 0.0], [0.029, 0.0, 0.0]),
    *([0.077, 0.0, -0.025], [0.027, 0.0, 0.0], [0.019, 0.0, 0.0]),
    *([0.084, 0.0, 0.001], [0.039, 0.0, 0.0], [0.028, 0.0, 0.0]),
    *([0.044, 0.0, 0.067], [0.029, 0.0, 0.010], [0.021, 0.0, 0.0]),
]
_TO_RIGHT = np.array([-1.0, 1.0, 1.0])

OFFSETS = np.array(
    [[0, 0, 0], *_LEFT_LEG, *_TO_RIGHT * _LEFT_LEG, *_SPINE, *_LEFT_ARM, *_TO_RIGHT * _LEFT_ARM], dtype=float
)
"""(53, 3) m: each body in its parent's frame at rest."""

HANDS: tuple[tuple[int, ...], tuple[int, ...]] = tuple(  # type: ignore[assignment]
    tuple(INDEX[f"{side}_{n}"] for n in _ARM[3:]) for side in "LR"
)
"""Wrist and finger joints, 16 a hand: left, right."""

MIRROR: tuple[int, ...] = tuple(
    INDEX[{"L": "R", "R": "L"}.get(n[0], n[0]) + n[1:] if n[1] == "_" else n] for n in BODIES
)
"""Which body takes a body's place in a mirror."""

FORWARD_LEFT_UP = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]])
"""(3, 3): columns are a robot's x (forward), y (left) and z (up) in a body's rest frame (x left, y up, z forward)."""

ANKLE_HEIGHT = 0.105
"""Ankle above the floor while standing, m: the median over the standing frames of the pick-up clips."""

BALL_RADIUS = 0.12
"""m, of the ball that was recorded."""

# Share of the body's mass and where it sits on a segment (0 the first body, 1 the second).
# P. de Leva, Adjustments to Zatsiorsky-Seluyanov's segment inertia parameters, J. Biomechanics 29 (1996), table 4, men.
SEGMENTS: tuple[tuple[str, str, float, float], ...] = (
    ("Pelvis", "Neck", 0.435, 0.42),
    ("Neck", "Head", 0.069, 1.0),
    *((f"{s}_Hip", f"{s}_Knee", 0.142, 0.41) for s in "LR"),
    *((f"{s}_Knee", f"{s}_Ankle", 0.043, 0.45) for s in "LR"),
    *((f"{s}_Ankle", f"{s}_Toe", 0.014, 0.44) for s in "LR"),
    *((f"{s}_Shoulder", f"{s}_Elbow", 0.027, 0.58) for s in "LR"),
    *((f"{s}_Elbow", f"{s}_Wrist", 0.016, 0.46) for s in "LR"),
    *((f"{s}_Wrist", f"{s}_Middle2", 0.006, 0.79) for s in "LR"),
)


def centre_of_mass(points: np.ndarray) -> np.ndarray:
    """Of bodies at ``points`` (..., 53, 3) m, by segment masses. Returns (..., 3) m."""
    total = sum(mass for *_, mass, _ in SEGMENTS)
    parts = [
        mass / total * ((1 - at) * points[..., INDEX[a], :] + at * points[..., INDEX[b], :])
        for a, b, mass, at in SEGMENTS
    ]
    return np.sum(parts, axis=0)
