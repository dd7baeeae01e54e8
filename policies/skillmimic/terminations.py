"""When an episode has failed. The released code knows only the first; a run chooses by ``config.terminations``, and its
training ends more of them by ``config.hopeless``."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from policies.skillmimic.rewards import Step, off, peak

# m between ball and its reference, seen from the first key point, while the reference has it in hand; of a ball that
# bounces, at any time and over the floor: after that one the robot can still go
BALL_LOST, BALL_GONE = 0.3, 0.5
# m above the floor, its centre, seen from a trunk as high as the reference's: what a ball has to come up to again for a hand to
# bounce it; and that of one which is on the floor, in another's hands or pressed flat, and may yet
DEAD, FLAT = 0.54, 0.2
FALLEN, SUNK = 0.3, 0.2  # m: how low a base has fallen; and how far below its reference, where that is as low


def up(orientation_base_in_world: np.ndarray) -> np.ndarray:
    """(N,) cosine of the tilt, from quaternions (N, 4)."""
    _, x, y, _ = orientation_base_in_world.T
    return 1 - 2 * (x * x + y * y)


def _ball_lost(s: Step) -> np.ndarray:
    away = off(s) * np.where(s.bounces[:, None], [1.0, 1.0, 0.0], 1.0)
    limit = np.where(s.bounces, BALL_GONE, BALL_LOST)
    return (s.bounces | (s.reference.contact[:, 0] > 0)) & (np.linalg.norm(away, axis=1) > limit)


def _dead(s: Step) -> np.ndarray:
    flies = (s.state.contact[:, 0] == 0) & (s.state.object_position[:, 2] > FLAT)
    return s.bounces & flies & (peak(s.state) < DEAD)


TERMINATIONS: dict[str, Callable[[Step], np.ndarray]] = {
    "fallen": lambda s: s.height < np.minimum(FALLEN, s.height_reference - SUNK),
    # 0.6 rad more than the reference leans; a bending pickup leans too
    "tilted": lambda s: np.arccos(np.clip(s.up, -1, 1)) > np.arccos(np.clip(s.up_reference, -1, 1)) + 0.6,
    "ball_lost": _ball_lost,
    "dead": _dead,
    "broken": lambda s: ~np.isfinite(s.state.joint_vel).all(axis=1) | (np.abs(s.state.joint_vel).max(axis=1) > 60.0),
}


def failed(s: Step, chosen: Sequence[str]) -> np.ndarray:
    """(N,) bool."""
    return np.logical_or.reduce([TERMINATIONS[name](s) for name in chosen])
