"""What training rewards. Weights of the positive terms sum to 1; the world position of the base is free, so that a step
taken to stay upright costs nothing, and the pose is tracked loosely enough in the legs that such a step pays."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from policies.gait import Stride

LEGS, UPPER = slice(0, 12), slice(12, 29)


class Tick(NamedTuple):
    """The true state after a policy period, arrays (N, size)."""

    joint_pos: np.ndarray
    joint_vel: np.ndarray
    gravity_in_base: np.ndarray
    velocity: np.ndarray  # (N, 2) m/s of the base over the ground, forwards and to the left
    command: np.ndarray  # (N, 3) m/s, m/s, rad/s
    angular_velocity_base_in_base: np.ndarray
    resting: np.ndarray  # (N,) 1 where both feet are on the ground to stay, else 0
    height: np.ndarray  # (N,) m, of the base
    height_reference: np.ndarray  # (N,) m, with the feet flat at the reference pose
    reference: np.ndarray  # (N, n) rad
    action: np.ndarray
    last_action: np.ndarray


class Reward(NamedTuple):
    """A term (N,) and what it counts for; a negative weight is a penalty."""

    weight: float
    term: Callable[[Tick], np.ndarray]


def _near(error: np.ndarray, width: float) -> np.ndarray:
    """exp(-|error|^2 / width^2) of rows."""
    return np.exp(-np.sum(np.square(error), axis=-1) / width**2)


def _rests(t: Tick) -> np.ndarray:
    """Whether the feet stay where they are, unless the robot is told to go somewhere."""
    return np.maximum(t.resting, np.any(np.abs(t.command) > Stride.idle, axis=-1))


REWARDS: dict[str, Reward] = {
    "upper_body": Reward(0.1, lambda t: _near((t.joint_pos - t.reference)[:, UPPER], 0.7)),
    "legs": Reward(0.1, lambda t: _near((t.joint_pos - t.reference)[:, LEGS], 0.6)),
    "upright": Reward(0.2, lambda t: _near(t.gravity_in_base[:, :2], 0.2)),
    "height": Reward(0.1, lambda t: _near((t.height - t.height_reference)[:, None], 0.08)),
    "rest": Reward(0.2, _rests),
    "velocity": Reward(0.2, lambda t: _near(t.velocity - t.command[:, :2], 0.2)),
    "turn": Reward(0.05, lambda t: _near((t.angular_velocity_base_in_base - t.command)[:, 2:], 0.4)),
    "steady": Reward(0.05, lambda t: _near(t.angular_velocity_base_in_base[:, :2], 1.0)),
    "action_rate": Reward(-0.006, lambda t: np.sum(np.square(t.action - t.last_action), axis=-1)),
    "action": Reward(-0.002, lambda t: np.sum(np.square(t.action), axis=-1)),
    "joint_vel": Reward(-0.0005, lambda t: np.sum(np.square(t.joint_vel), axis=-1)),
}


def reward(tick: Tick) -> np.ndarray:
    """(N,) of one policy period, at most 1."""
    return sum((r.weight * r.term(tick) for r in REWARDS.values()), np.zeros(len(tick.height)))
