"""Where a robot's own solid parts are, and what becomes of an object that meets them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

# m/s of an object's speed that a touch leaves unknown, along what it touches, and as much sideways within LASTS s of it: pads
# yield, and rub. m of its place that it leaves unknown.
UNKNOWN, LASTS, DEEP = 0.6, 0.1, 0.008


class Solids(NamedTuple):
    """Boxes with round edges, a row each; of no width and height, a capsule, and of no length either, a ball."""

    places: np.ndarray = np.zeros((0, 3))  # (k, 3) m, of their middles
    turns: np.ndarray = np.zeros((0, 3, 3))  # (k, 3, 3): columns are their axes
    halves: np.ndarray = np.zeros((0, 3))  # (k, 3) m, half their sizes, without the edges
    rounds: np.ndarray = np.zeros(0)  # (k,) m, radii of the edges

    def seen_from(self, place: np.ndarray, turn: np.ndarray) -> Solids:
        """The same in a frame in which theirs is at ``place`` (3,) m, turned by ``turn`` (3, 3)."""
        return self._replace(places=place + self.places @ turn.T, turns=turn @ self.turns)

    def within(self, distance: float, position: np.ndarray) -> np.ndarray:
        """(k,) bool: where ``position`` (3,) m is, or might be, less than ``distance`` m away."""
        apart = ((position - self.places) ** 2).sum(axis=1)
        return apart < (np.sqrt((self.halves**2).sum(axis=1)) + self.rounds + distance) ** 2


class Touch(NamedTuple):
    """Of an object and a solid."""

    normal: np.ndarray  # (3,) out of the solid
    depth: float  # m that they are in each other
    velocity: np.ndarray  # (3,) m/s of the solid, where it is touched


def touches(
    before: Solids, after: Solids, share: float, lasts: float, position: np.ndarray, radius: float
) -> list[Touch]:
    """What a round object at ``position`` (3,) m of ``radius`` m touches, a ``share`` of ``lasts`` s after ``before``, when
    solids have gone that part of their way from there to ``after``."""
    found = []
    now = after._replace(places=before.places + share * (after.places - before.places))
    for k in np.flatnonzero(now.within(radius, position)).tolist():
        turn = before.turns[k] + share * (after.turns[k] - before.turns[k])
        here = turn.T @ (position - now.places[k])
        out = here - np.clip(here, -after.halves[k], after.halves[k])
        far = float(np.sqrt(out @ out))
        if 0.0 < far < radius + after.rounds[k]:  # at 0 it is inside, and no side of it is the near one
            moved = after.places[k] + after.turns[k] @ here - before.places[k] - before.turns[k] @ here
            found.append(Touch(turn @ out / far, float(radius + after.rounds[k] - far), moved / lasts))
    return found


def stopped(
    touch: Touch, position: np.ndarray, velocity: np.ndarray, covariance: np.ndarray, dt: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """An object's place (3,) m, speed (3,) m/s and covariance (3, 2, 2) of each axis after ``dt`` s of ``touch``: nothing goes
    into a solid or bounces off it, and what it pushes goes as fast as it does."""
    along = touch.normal**2
    position = position + touch.depth * touch.normal
    velocity = velocity - min(float((velocity - touch.velocity) @ touch.normal), 0.0) * touch.normal
    covariance = covariance.copy()
    covariance[:, 0, 0] += along * (np.minimum(covariance[:, 0, 0], DEEP**2) - covariance[:, 0, 0])
    covariance[:, 0, 1] *= 1 - along
    covariance[:, 1, 0] *= 1 - along
    covariance[:, 1, 1] += along * (UNKNOWN**2 - covariance[:, 1, 1]) + (1 - along) * UNKNOWN**2 * dt / LASTS
    return position, velocity, covariance
