"""Which hand touches the ball, which foot stands."""

from __future__ import annotations

import numpy as np

from policies.clips.kinematics import rate
from policies.clips.skeleton import ANKLE_HEIGHT, HANDS, INDEX

TOUCH = 0.15  # m from a hand joint to the ball's centre; against the recorded bit: recall 0.97, false positives 0.07
SUPPORT = 0.20  # m: where the recording says contact, a hand this near helps the nearer one (no finger is curled back)
LIFTED = 0.03  # m an ankle may stand above its height when standing, and still stand
MOVING = 0.6  # m/s: an ankle slower than this, and low, stands
SHORTEST = 3  # frames: shorter contacts, and shorter gaps in one, are noise


def hand_distance(points: np.ndarray, ball: np.ndarray) -> np.ndarray:
    """(T, 2) m from the ball's centre (T, 3) to the nearest joint of the left and right hand of bodies (T, 53, 3)."""
    return np.stack([np.linalg.norm(points[:, h] - ball[:, None], axis=-1).min(axis=1) for h in HANDS], axis=1)


def hand_contact(points: np.ndarray, ball: np.ndarray, recorded: np.ndarray) -> np.ndarray:
    """(T, 2) bool: left, right hand on the ball.

    The recording has one bit (T,) for both hands. Where it is set, the nearer hand has contact, and so has the other
    within ``SUPPORT``; where it is not, none has.
    """
    distance = hand_distance(points, ball)
    nearest = distance.argmin(axis=1)[:, None] == np.arange(2)
    touching = nearest | (distance < SUPPORT)
    return np.stack([debounce(side & recorded) & recorded for side in touching.T], axis=1)


def foot_contact(points: np.ndarray, fps: float) -> np.ndarray:
    """(T, 2) bool: left, right foot stands flat. By height and speed of the ankle of bodies (T, 53, 3)."""
    sides = []
    for side in "LR":
        ankle = points[:, INDEX[f"{side}_Ankle"]]
        speed = np.linalg.norm(rate(ankle, fps), axis=-1)
        sides.append(debounce((ankle[:, 2] < ANKLE_HEIGHT + LIFTED) & (speed < MOVING)))
    return np.stack(sides, axis=1)


def debounce(on: np.ndarray, shortest: int = SHORTEST) -> np.ndarray:
    """(T,) bool with gaps, then contacts, shorter than ``shortest`` frames removed; those at the ends stay."""
    on = on.copy()
    for value in (False, True):
        for start, stop in spans(on == value):
            if stop - start < shortest and start > 0 and stop < len(on):
                on[start:stop] = not value
    return on


def spans(on: np.ndarray) -> list[tuple[int, int]]:
    """Runs of True in (T,) as [start, stop)."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], on, [False]]).astype(int)))
    return [(int(a), int(b)) for a, b in zip(edges[::2], edges[1::2], strict=True)]
