"""What the trackers of many robots say of their balls, as training has them: ``sim2real.tracker`` is too slow for that."""

from __future__ import annotations

import numpy as np

from policies import ball
from policies.skillmimic.plan import GRAVITY
from policies.skillmimic.randomisation import LOSS_TICKS


class Sight:
    """``answer`` (robots, 6): m and m/s of the ball in the base, the last one given; ``lost`` (robots,): ticks until the
    ball is seen again."""

    def __init__(self, robots: int, period: float) -> None:
        self.answer, self.lost = np.zeros((robots, 6)), np.zeros(robots, np.int64)
        self._period = period

    def begin(self, ids: np.ndarray, truth: np.ndarray) -> None:
        """Episodes of robots ``ids`` (k,) begin, with the ball in sight, ``truth`` (k, 6)."""
        self.answer[ids], self.lost[ids] = truth, 0

    def look(
        self, measured: np.ndarray, chance: np.ndarray, held: np.ndarray, height: np.ndarray, rng: np.random.Generator
    ) -> np.ndarray:
        """This tick's ``answer``: what is ``measured`` (robots, 6), unless the ball is out of sight, for which there is a
        ``chance`` (robots,). Of a ball that is not ``held`` (robots,) bool it is then foretold how it flies; ``height``
        (robots,) m of the base."""
        out = (self.lost == 0) & (rng.random(len(chance)) < chance)
        self.lost[out] = rng.integers(*LOSS_TICKS, size=int(out.sum()), endpoint=True)
        sees = self.lost == 0
        self.answer[sees] = measured[sees]
        self.lost[~sees] -= 1
        self.answer[~sees] = self._foretold(self.answer[~sees], ~held[~sees], height[~sees])
        return self.answer

    def _foretold(self, seen: np.ndarray, flies: np.ndarray, height: np.ndarray) -> np.ndarray:
        """``seen`` (k, 6), a tick on: it goes on as it went, or flies and bounces."""
        seen, floor = seen.copy(), ball.RADIUS - height
        seen[:, :3] += self._period * seen[:, 3:]
        seen[:, 2] -= flies * GRAVITY * self._period**2 / 2
        seen[:, 5] -= flies * GRAVITY * self._period
        bounces = (seen[:, 2] < floor) & (seen[:, 5] < 0)
        seen[:, 5] *= np.where(bounces, -ball.RESTITUTION, 1.0)
        seen[:, 2] = np.maximum(seen[:, 2], floor)
        return seen
