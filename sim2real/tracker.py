"""Where the object is now: from late, slow and lossy samples of a camera or of motion capture to an estimate every tick.

Three hypotheses run side by side and are weighed by how well each foretold the samples (interacting multiple models, Blom
& Bar-Shalom, IEEE Trans. Automatic Control 33:780, 1988): the object flies, under gravity, and bounces off the floor; or
it is held, and goes on as it went; or it is moved, and goes on much less surely. Each is a Kalman filter. What flies goes on
flying while no hand of the robot is near: seen at 60 Hz with millimetres of noise, a flight alone looks for a tenth of a
second as if something moved the object, and a dribbled ball is half-way up by then.

Axes are those of the IMU's world (z up, yaw arbitrary), the origin is on the floor: where the object is, the robot's feet
tell (``limbs``), for a base that sways is no place from which a flight looks like one. Of a robot that does not know its
feet the base counts as standing still. A sample is placed at the time it was taken, with the orientation and the base of
that time; the answer is for now. What flies meets the floor and the robot: that its own hand has pushed the ball since the
last sample the robot need not see.
"""

from __future__ import annotations

import itertools
import math
from collections import deque
from copy import copy
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from sim2real.limbs import Limbs
from sim2real.quaternion import matrix_of, rotate
from sim2real.solids import Solids, stopped, touches

GRAVITY = np.array([0.0, 0.0, -9.81])
# A bounce: s for which the ball is pressed flat on the floor (as the simulated one is: drivers/sim/ball.py); by how much of
# its speed it leaves faster or slower than it should; m/s that friction may add sideways.
PRESSED, UNSURE, RUBS = 0.022, 0.1, 0.1
PRESS = 0.02  # m, by which it is pressed
STEP = 0.01  # s, at most, in which what flies is looked at where it may meet the robot
FAST = 5.0  # m/s of a robot's hands, at most
NOBODY = Limbs()


class ObjectSample(NamedTuple):
    """One sighting."""

    time: float  # s, clock time of the exposure
    position_object_in_base: np.ndarray  # (3,) m
    height_base_in_world: float = math.nan  # m above the floor; NaN: the source does not know


@dataclass(slots=True)
class ObjectEstimate:
    """What a policy may be fed."""

    position_in_base: np.ndarray = field(default_factory=lambda: np.full(3, np.nan))  # m; NaN: never seen
    velocity_in_base: np.ndarray = field(default_factory=lambda: np.full(3, np.nan))  # m/s, relative to the base's own
    age: float = math.inf  # s since the newest sample behind it was taken
    flying: float = math.nan  # probability


@dataclass
class Counters:
    """What became of samples."""

    used: int = 0
    late: int = 0  # taken before one that was used already
    stale: int = 0  # older than the orientations that are remembered
    early: int = 0  # taken in the future: the clocks disagree
    strange: int = 0  # too far from every hypothesis, or not finite
    restarts: int = 0


class _Moment(NamedTuple):
    """What the robot was like, in the world's axes."""

    time: float  # s
    orientation: np.ndarray  # (4,) of the base
    base: np.ndarray  # (3,) m
    palms: np.ndarray  # (k, 3) m
    solids: Solids


class _Hypothesis:
    """One Kalman filter: position and velocity (3,), covariance (3, 2, 2) of each axis, and a weight."""

    def __init__(self, flies: bool, noise: float) -> None:
        self.flies, self.noise = flies, noise  # noise: m^2/s^3, of the acceleration
        self.position, self.velocity = np.zeros(3), np.zeros(3)
        self.covariance = np.tile(np.eye(2), (3, 1, 1))
        self.weight = 1.0

    def predicted(self, dt: float, floor: float, restitution: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Position, velocity and covariance ``dt`` s on. ``floor``: height (m) of the centre of an object lying on it."""
        a, b, c = dt**3 / 3, dt**2 / 2, dt
        step = np.array([[1.0, dt], [0.0, 1.0]])
        covariance = step @ self.covariance @ step.T + self.noise * np.array([[a, b], [b, c]])
        if not self.flies:
            return self.position + self.velocity * dt, self.velocity.copy(), covariance
        p, v = self.position.copy(), self.velocity.copy()
        for _ in range(4):  # bounces in one prediction; further ones are below a millimetre
            fall = _time_to(floor, p[2], v[2])
            if not fall < dt:
                break
            p += v * fall + GRAVITY * fall**2 / 2
            v += GRAVITY * fall
            covariance[2, 1, 1] += (UNSURE * v[2]) ** 2
            covariance[2, 0, 0] += (UNSURE * PRESSED * v[2]) ** 2
            covariance[:2, 1, 1] += RUBS**2
            v[2] *= -restitution
            p[2] = floor
            dt -= fall
            if v[2] < 0.05:  # it lies
                return p + v * [dt, dt, 0], v * [1, 1, 0], covariance
            p[2] -= PRESSED * v[2]  # from where it would have to come, if it were thrown back at once
        return p + v * dt + GRAVITY * dt**2 / 2, v + GRAVITY * dt, covariance

    def correct(self, measured: np.ndarray, variance: np.ndarray) -> float:
        """Take in a position (3,) m of ``variance`` (3,). Returns its likelihood before it was known."""
        innovation = measured - self.position
        s = self.covariance[:, 0, 0] + variance
        gain = self.covariance[:, :, 0] / s[:, None]
        self.position += gain[:, 0] * innovation
        self.velocity += gain[:, 1] * innovation
        self.covariance = self.covariance - gain[:, :, None] * self.covariance[:, :1]
        return math.exp(-0.5 * float((innovation * innovation / s).sum())) / math.sqrt(float(s.prod()))


class ObjectTracker:
    """``measure`` takes samples whenever they come, ``estimate`` answers every tick.

    ``radius`` m of the object, ``restitution`` of its bounces, ``noise`` m (standard deviation of a sample on an axis),
    ``height`` m of the base above the floor, for sources that do not tell.
    """

    memory = 0.5  # s of orientations: an older sample cannot be placed
    patience = 3  # strange samples in a row, after which the next one is believed
    gap = 0.3  # s without a sample, after which the filter starts anew
    gate = 25.0  # squared distance, in variances, of a strange sample: 5 sigma
    switching = 2.0  # 1/s: how often something is caught or thrown
    reach = 0.2  # m between palm and centre of an object: one farther from all palms is seldom taken out of its flight:
    alone = 0.1  # 1/s: by somebody else

    def __init__(self, radius: float, *, restitution: float = 0.8, noise: float = 0.008, height: float = 0.78) -> None:
        self.radius, self.restitution, self.noise, self.height = radius, restitution, noise, height
        self.counters = Counters()
        self.current = ObjectEstimate()
        # Drag and spin disturb a flight by less than 1 m/s^2, as a swaying robot does a ball it holds; hands that move a
        # ball do so with tens of m/s^2 for tenths of a second.
        self._hypotheses = [_Hypothesis(True, 0.01), _Hypothesis(False, 0.005), _Hypothesis(False, 30.0)]
        self._moments: deque[_Moment] = deque()
        self._time = -math.inf  # of the newest sample used
        self._strange = 0

    def measure(self, sample: ObjectSample) -> bool:
        """Take in a sample; False if it was of no use (``counters`` say why)."""
        if not (np.isfinite(sample.position_object_in_base).all() and math.isfinite(sample.time)):
            self.counters.strange += 1
            return False
        then = self._then(sample.time)
        if then is None:
            return False
        if sample.time <= self._time:
            self.counters.late += 1
            return False
        if math.isfinite(sample.height_base_in_world):
            self.height = sample.height_base_in_world
        orientation, base, palms = then
        position = base + rotate(orientation, sample.position_object_in_base)
        if sample.time - self._time > self.gap:
            self._restart(position, sample.time)
        elif not self._advance(position, sample.time, palms):
            return False
        self.counters.used += 1
        return True

    def estimate(self, now: float, orientation_base_in_world: np.ndarray, limbs: Limbs = NOBODY) -> ObjectEstimate:
        """For ``now`` (s), and remember the orientation (4,) and the limbs of now. The same object every time.

        Everything is NaN before the first sample and while the orientation is none (not finite, or the zeros of an IMU
        that has not spoken); old estimates stay, with an ``age`` that tells.
        """
        e = self.current
        if not 0.9 < orientation_base_in_world @ orientation_base_in_world < 1.1:
            e.position_in_base[:], e.velocity_in_base[:] = np.nan, np.nan
            return e
        base = np.array([0.0, 0.0, self.height]) if limbs.base is None else limbs.base
        orientation, turn = np.array(orientation_base_in_world, float), matrix_of(orientation_base_in_world)
        solids = limbs.solids.seen_from(base, turn)
        self._moments.append(_Moment(now, orientation, base, base + limbs.palms @ turn.T, solids))
        while self._moments[0].time < now - self.memory:
            self._moments.popleft()
        if self._time == -math.inf:
            return e
        e.age = now - self._time
        ahead = min(max(e.age, 0.0), self.gap)  # beyond, nobody knows
        back = orientation_base_in_world * [1.0, -1.0, -1.0, -1.0]
        position, velocity = np.zeros(3), np.zeros(3)
        for h in self._hypotheses:
            p, v, _ = self._predicted(h, ahead)
            position += h.weight * p
            velocity += h.weight * v
        e.position_in_base[:] = rotate(back, position - base)
        e.velocity_in_base[:] = rotate(back, velocity - limbs.velocity)
        e.flying = self._hypotheses[0].weight
        return e

    def _then(self, time: float) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
        """Orientation and place of the base, and places of the palms at ``time``, between those remembered next to it."""
        if not self._moments or time < self._moments[0].time:
            self.counters.stale += 1
            return None
        before, after = self._around(time)
        if time > after.time + 0.1:
            self.counters.early += 1
            return None
        if time >= after.time:
            return after[1:4]
        share = (time - before.time) / (after.time - before.time)
        q1, q0 = after.orientation, before.orientation
        mixed = (1 - share) * q0 + share * (q1 if q0 @ q1 >= 0 else -q1)
        base, palms = (
            b + share * (a - b) if a.shape == b.shape else b for a, b in zip(after[2:4], before[2:4], strict=True)
        )
        return mixed / np.linalg.norm(mixed), base, palms

    def _around(self, time: float) -> tuple[_Moment, _Moment]:
        """The newest moment that was over at ``time`` and the next; both the same if only one is known."""
        pairs = itertools.pairwise(reversed(self._moments))
        first = self._moments[0]
        return next(((before, after) for after, before in pairs if before.time <= time), (first, first))

    def _predicted(self, h: _Hypothesis, dt: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """As ``_Hypothesis.predicted``, ``dt`` s on from the newest sample that was used; the robot is in the way of what
        flies."""
        speed = math.sqrt(h.velocity @ h.velocity) + FAST - GRAVITY[2] * dt
        solids = self._moments[-1].solids
        if dt <= 0 or not (h.flies and solids.within(self.radius + speed * dt, h.position).any()):
            return h.predicted(dt, self.radius, self.restitution)
        steps = math.ceil(dt / STEP)
        ahead, step = copy(h), dt / steps
        for k in range(1, steps + 1):
            ahead.position, ahead.velocity, ahead.covariance = state = ahead.predicted(
                step, self.radius, self.restitution
            )
            time = self._time + k * step
            before, after = self._around(time)
            if len(before.solids.places) != len(after.solids.places):
                before = after  # limbs were lost for a moment
            lasts = after.time - before.time or math.inf
            share = min((time - before.time) / lasts, 1.0)
            for touch in touches(before.solids, after.solids, share, lasts, state[0], self.radius):
                state = stopped(touch, *state, step)
            ahead.position, ahead.velocity, ahead.covariance = state
        return ahead.position, ahead.velocity, ahead.covariance

    def _restart(self, position: np.ndarray, time: float) -> None:
        for h in self._hypotheses:
            h.position, h.velocity = position.copy(), np.zeros(3)
            h.covariance = np.tile(np.diag([self.noise**2, 9.0]), (3, 1, 1))  # it may move at 3 m/s
            h.weight = 1 / len(self._hypotheses)
        self._time, self._strange = time, 0
        self.counters.restarts += 1

    def _advance(self, position: np.ndarray, time: float, palms: np.ndarray) -> bool:
        dt, now = time - self._time, self._hypotheses
        variance = np.full(3, self.noise**2)
        if position[2] < self.radius:  # it presses on the floor, and its centre comes closer than a bounce here knows
            variance[2] += PRESS**2
        switched = self._switched(dt, position, palms)
        ahead = []
        for k, h in enumerate(now):
            # Where a hypothesis comes from: itself, or another that switched to it (the mixing step).
            shares = np.array([w.weight for w in now]) * switched[:, k]
            trial = _Hypothesis(h.flies, h.noise)
            trial.weight = float(shares.sum())
            trial.position, trial.velocity, trial.covariance = _mix(now, shares / trial.weight)
            trial.position, trial.velocity, trial.covariance = self._predicted(trial, dt)
            ahead.append(trial)
        distance = min(float(((position - t.position) ** 2 / (t.covariance[:, 0, 0] + variance)).sum()) for t in ahead)
        if distance > self.gate:
            self.counters.strange += 1
            self._strange += 1
            if self._strange < self.patience:
                return False
            self._restart(position, time)
            return True
        likelihoods = [t.weight * t.correct(position, variance) for t in ahead]
        total = sum(likelihoods)
        for t, likelihood in zip(ahead, likelihoods, strict=True):
            t.weight = likelihood / total if total > 0 else 1 / len(now)
        self._hypotheses, self._time, self._strange = ahead, time, 0
        return True

    def _switched(self, dt: float, position: np.ndarray, palms: np.ndarray) -> np.ndarray:
        """(k, k): chances that each hypothesis has become each other one within ``dt`` s, of an object that is seen at
        ``position`` (3,) m."""
        count = len(self._hypotheses)
        rates = np.full((count, count), self.switching / (count - 1))
        if len(palms) and np.linalg.norm(palms - position, axis=1).min() > self.reach:
            rates[0] = self.alone / (count - 1)
        np.fill_diagonal(rates, 0.0)
        total = rates.sum(axis=1, keepdims=True)
        leaves = 1 - np.exp(-total * dt)
        return rates / total * leaves + np.diag(1 - leaves[:, 0])


def _mix(hypotheses: list[_Hypothesis], shares: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Mean position, velocity and covariance of a mixture with ``shares`` that sum to 1."""
    position = sum((s * h.position for s, h in zip(shares, hypotheses, strict=True)), np.zeros(3))
    velocity = sum((s * h.velocity for s, h in zip(shares, hypotheses, strict=True)), np.zeros(3))
    covariance = np.zeros((3, 2, 2))
    for share, h in zip(shares, hypotheses, strict=True):
        off = np.stack([h.position - position, h.velocity - velocity])
        covariance += share * (h.covariance + off.T[:, :, None] * off.T[:, None])
    return position, velocity, covariance


def _time_to(floor: float, z: float, speed: float) -> float:
    """s until something at height ``z`` m with upward ``speed`` m/s falls to ``floor``; inf where it is below and rising."""
    drop = z - floor
    if drop <= 0:
        return 0.0 if speed < 0 else math.inf
    g = -GRAVITY[2]
    return float(speed + math.sqrt(speed * speed + 2 * g * drop)) / g
