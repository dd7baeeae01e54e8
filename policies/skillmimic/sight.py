"""What the trackers of many robots say of their balls, as training has them: ``sim2real.tracker`` is too slow for that.

Like that, from a sighting that is some ticks old they foretell where in the world the ball is now, and where the base is
they know. Of a ball that flies and bounces this is right but for noise and for how much it bounces. What the robot's own
parts do to it they know for the most part, whatever else happens only from sightings, and its speed after a few of them.
"""

from __future__ import annotations

import numpy as np

from policies import ball
from policies.skillmimic.plan import GRAVITY
from policies.skillmimic.randomisation import LATEST, LOSS_TICKS
from sim2real.tracker import PRESSED

LASTS = 0.6  # of a filter's error, what is left of it a tick later
NEVER = 10**6  # ticks
# Of what the robot does to a ball, the share that its tracker foretells, and that of its speed by which it is wrong each way.
KNOWN, WRONG = 0.75, 0.8
# Of what a filter is off by, in place and speed, what a sighting puts right: fits tracker and camera under a dribbled ball.
FINDS = np.array([0.9, 0.9, 0.9, 0.35, 0.35, 0.6])


class Sight:
    """``lost`` (robots,): ticks until the ball is seen again."""

    def __init__(self, robots: int, period: float) -> None:
        self.lost = np.zeros(robots, np.int64)
        self._period, self._all = period, np.arange(robots)
        self._past = np.zeros((LATEST + 1, robots, 6))  # m and m/s where the ball was, newest first
        self._held = np.zeros((LATEST + 1, robots), bool)
        self._sighting, self._in_hand = np.zeros((robots, 6)), np.zeros(robots, bool)
        self._found = np.zeros((robots, 6))  # what the filter made of it
        # Ticks since the sighting, of the episode, and since the robot touched the ball.
        self._age, self._ticks, self._alone = np.zeros((3, robots), np.int64)
        self._error = np.zeros((robots, 6))

    def begin(self, ids: np.ndarray, truth: np.ndarray, held: np.ndarray) -> None:
        """Episodes of robots ``ids`` (k,) begin, with the ball in sight, ``truth`` (k, 6) and ``held`` (k,) bool."""
        self._sighting[ids] = self._found[ids] = truth
        self._in_hand[ids] = held
        self.lost[ids] = self._ticks[ids] = 0
        self._age[ids] = -1  # they look for the first time in a tick that is still this one
        self._alone[ids] = NEVER
        self._error[ids] = 0.0

    def look(
        self,
        truth: np.ndarray,
        held: np.ndarray,
        touched: np.ndarray,
        late: np.ndarray,
        chance: np.ndarray,
        noise: np.ndarray,
        rng: np.random.Generator,
    ) -> np.ndarray:
        """(robots, 6) m and m/s: where in the world the balls are now, as trackers tell it. What they truly are is ``truth``
        (robots, 6), and whether somebody holds them ``held``, and the robot touches them ``touched`` (robots,) bool.

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
        newest, in_hand = self._past[late, self._all], self._held[late, self._all]
        self._alone = np.where(touched, 0, self._alone + 1)
        between = (self._age + 1 - late) * self._period  # s since the sighting before
        self._age = np.where(sees, late, self._age + 1)
        known = KNOWN * (self._alone <= self._age + 1)[:, None]
        surprise = newest - foretold(self._sighting, between, ~self._in_hand)
        found = foretold(self._found, between, ~self._in_hand) + known * surprise
        pushed = np.linalg.norm(surprise[:, 3:], axis=1) * touched
        found[:, 3:] += WRONG * pushed[:, None] * rng.standard_normal((len(found), 3))
        self._found = np.where(sees[:, None], found + FINDS * (newest - found), self._found)
        self._sighting = np.where(sees[:, None], newest, self._sighting)
        self._in_hand = np.where(sees, in_hand, self._in_hand)
        since, flies = self._age * self._period, ~self._in_hand
        surprise = truth - foretold(self._sighting, since, flies)
        self._ticks += 1
        self._error = LASTS * self._error + np.sqrt(1 - LASTS**2) * noise * rng.standard_normal(noise.shape)
        return foretold(self._found, since, flies) + known * surprise + self._error


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
