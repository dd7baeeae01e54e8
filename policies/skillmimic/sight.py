"""What the trackers of many robots say of their balls, as training has them: ``sim2real.tracker`` is too slow for that.

Like that, from a sighting that is some ticks old they foretell where in the world the ball is now, and where the base is
they know. Of a ball that flies and bounces this is right but for noise; a push they know only when a sighting tells them.
"""

from __future__ import annotations

import numpy as np

from policies import ball
from policies.skillmimic.plan import GRAVITY
from policies.skillmimic.randomisation import LATEST, LOSS_TICKS
from sim2real.tracker import PRESSED

LASTS = 0.6  # of a filter's error, what is left of it a tick later


class Sight:
    """``lost`` (robots,): ticks until the ball is seen again."""

    def __init__(self, robots: int, period: float) -> None:
        self.lost = np.zeros(robots, np.int64)
        self._period, self._all = period, np.arange(robots)
        self._past = np.zeros((LATEST + 1, robots, 6))  # m and m/s where the ball was, newest first
        self._held = np.zeros((LATEST + 1, robots), bool)
        self._sighting, self._in_hand = np.zeros((robots, 6)), np.zeros(robots, bool)
        self._age, self._ticks = np.zeros(robots, np.int64), np.zeros(robots, np.int64)
        self._error = np.zeros((robots, 6))

    def begin(self, ids: np.ndarray, truth: np.ndarray, held: np.ndarray) -> None:
        """Episodes of robots ``ids`` (k,) begin, with the ball in sight, ``truth`` (k, 6) and ``held`` (k,) bool."""
        self._sighting[ids], self._in_hand[ids] = truth, held
        self.lost[ids] = self._age[ids] = self._ticks[ids] = 0
        self._error[ids] = 0.0

    def look(
        self,
        truth: np.ndarray,
        held: np.ndarray,
        late: np.ndarray,
        chance: np.ndarray,
        noise: np.ndarray,
        rng: np.random.Generator,
    ) -> np.ndarray:
        """(robots, 6) m and m/s: where in the world the balls are now, as trackers tell it. What they truly are is ``truth``
        (robots, 6), and whether somebody holds them ``held`` (robots,) bool.

        The newest sighting is ``late`` (robots,) ticks old, or older: there is a ``chance`` (robots,) that the ball goes
        out of sight. ``noise`` (robots, 6): m and m/s, standard deviations of what the filter is off by.
        """
        self._past, self._held = np.roll(self._past, 1, axis=0), np.roll(self._held, 1, axis=0)
        self._past[0], self._held[0] = truth, held
        out = (self.lost == 0) & (rng.random(len(chance)) < chance)
        self.lost[out] = rng.integers(*LOSS_TICKS, size=int(out.sum()), endpoint=True)
        sees = self.lost == 0
        self.lost[~sees] -= 1
        late = np.minimum(late, self._ticks)  # before an episode nothing was
        newest = self._past[late, self._all], self._held[late, self._all]
        self._sighting = np.where(sees[:, None], newest[0], self._sighting)
        self._in_hand = np.where(sees, newest[1], self._in_hand)
        self._age = np.where(sees, late, self._age + 1)
        self._ticks += 1
        self._error = LASTS * self._error + np.sqrt(1 - LASTS**2) * noise * rng.standard_normal(noise.shape)
        return foretold(self._sighting, self._age * self._period, ~self._in_hand) + self._error


def foretold(seen: np.ndarray, dt: np.ndarray, flies: np.ndarray) -> np.ndarray:
    """``seen`` (k, 6) m and m/s, ``dt`` (k,) s on: it goes on as it went, or ``flies`` (k,) bool, and bounces once on the
    floor; after that it lies there."""
    after, pull, floor = seen.copy(), flies * GRAVITY, ball.RADIUS
    z, v = seen[:, 2], seen[:, 5]
    under = (z < floor) & (v > 0)  # it comes up from a bounce
    speed = np.sqrt(v * v + 2 * GRAVITY * np.maximum(z - floor, 0.0))  # m/s at which it meets the floor
    fall = np.where(flies & ~under, (v + speed) / GRAVITY, np.inf)  # s
    bounces = fall < dt
    rest = np.where(bounces, dt - np.where(bounces, fall, 0.0), dt)
    z = np.where(bounces, floor - PRESSED * ball.RESTITUTION * speed, z)
    v = np.where(bounces, ball.RESTITUTION * speed, v)
    z, v = z + v * rest - pull * rest**2 / 2, v - pull * rest
    lies = bounces & (z < floor) & (v < 0)
    after[:, :2] += dt[:, None] * seen[:, 3:5]
    after[:, 2], after[:, 5] = np.where(lies, floor, z), np.where(lies, 0.0, v)
    return after
