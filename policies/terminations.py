"""When an episode has failed."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from policies.rewards import Tick

TERMINATIONS: dict[str, Callable[[Tick], np.ndarray]] = {
    "tilt": lambda t: t.gravity_in_base[:, 2] > -np.cos(0.8),  # rad; the safety gate damps at 1.0
    "height": lambda t: np.abs(t.height - t.height_reference) > 0.25,  # m
    "broken": lambda t: ~np.isfinite(t.joint_vel).all(axis=-1) | (np.abs(t.joint_vel).max(axis=-1) > 60.0),
}


def failed(tick: Tick) -> np.ndarray:
    """(N,) bool."""
    return np.logical_or.reduce([term(tick) for term in TERMINATIONS.values()])
