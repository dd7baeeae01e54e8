"""The recorded ball as physics: glitches, free flight, bounces, velocity."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from policies.clips.contact import spans

FASTEST = 9.0  # m/s: the fastest true ball of BallPlay-M moves at 8.2; one-frame tracking jumps at 10 to 15
NEAR_FLOOR = 0.05  # m above its radius: from here up a ball without contact is taken to fly
SHORTEST = 8  # frames of a flight that is fitted


class Flight(NamedTuple):
    """One free flight and the parabola through it."""

    start: int  # frame
    stop: int  # frame, not included
    gravity: float  # m/s^2, fitted
    error: float  # m, root mean square distance from the parabola


class Bounce(NamedTuple):
    """One bounce on the floor."""

    frame: int
    speed_before: float  # m/s downwards, where the ball's surface meets the floor
    restitution: float  # speed after / speed before


def clamp_glitches(ball: np.ndarray, fps: float) -> tuple[np.ndarray, list[int]]:
    """Positions (T, 3) m with single frames that jump there and back replaced by their neighbours' mean, and which.

    A frame is a glitch if the ball would have to be faster than ``FASTEST`` to enter or to leave it, and no faster to
    pass it by.
    """
    ball = ball.copy()
    found = []
    step = FASTEST / fps
    for t in range(1, len(ball) - 1):
        into, out = np.linalg.norm(ball[t] - ball[t - 1]), np.linalg.norm(ball[t + 1] - ball[t])
        if max(into, out) > step and np.linalg.norm(ball[t + 1] - ball[t - 1]) <= 2 * step:
            ball[t] = (ball[t - 1] + ball[t + 1]) / 2
            found.append(t)
    return ball, found


def flights(ball: np.ndarray, touched: np.ndarray, fps: float, radius: float) -> list[Flight]:
    """Every stretch of ``SHORTEST`` frames or more in which (T, 3) m flies: no hand on it (T,), clear of the floor.

    One frame is left out at each end: contact bits are a frame late or early.
    """
    return [
        _fit(ball, start, stop, fps)
        for a, b in spans(~touched & (ball[:, 2] > radius + NEAR_FLOOR))
        for start, stop in [(a + 1, b - 1)]
        if stop - start >= SHORTEST
    ]


def _fit(ball: np.ndarray, start: int, stop: int, fps: float) -> Flight:
    t = np.arange(stop - start) / fps
    plane = np.stack([np.ones_like(t), t], axis=1)
    space = np.stack([np.ones_like(t), t, t**2 / 2], axis=1)
    across, *_ = np.linalg.lstsq(plane, ball[start:stop, :2], rcond=None)
    down, *_ = np.linalg.lstsq(space, ball[start:stop, 2], rcond=None)
    off = np.concatenate([ball[start:stop, :2] - plane @ across, (ball[start:stop, 2] - space @ down)[:, None]], axis=1)
    return Flight(start, stop, -float(down[2]), float(np.sqrt((off**2).sum(axis=1).mean())))


def bounces(ball: np.ndarray, touched: np.ndarray, fps: float, radius: float, gravity: float = 9.81) -> list[Bounce]:
    """Every clean bounce on the floor of (T, 3) m: free flight of four frames or more on both sides.

    Heights are fitted on each side with ``gravity`` m/s^2; speeds are those at height ``radius``.
    """
    found = []
    height = ball[:, 2]
    low = spans(height < radius + NEAR_FLOOR)
    for start, stop in low:
        before, after = np.arange(start - 6, start), np.arange(stop, stop + 6)
        if start < 6 or stop + 6 > len(ball) or stop - start > 6 or touched[start - 6 : stop + 6].any():
            continue
        fall, rise = (_speed_at(height[w], (w - start) / fps, radius, gravity) for w in (before, after))
        if fall > 1.0 and rise > 0:
            found.append(Bounce(start + int(height[start:stop].argmin()), fall, rise / fall))
    return found


def _speed_at(height: np.ndarray, t: np.ndarray, level: float, gravity: float) -> float:
    """Speed of the parabola through ``height`` (n,) m at ``t`` (n,) s where it crosses ``level`` m; 0 if it does not."""
    v, z = np.polyfit(t, height + gravity * t**2 / 2, 1)
    return float(np.sqrt(max(v**2 + 2 * gravity * (z - level), 0.0)))


def velocity(ball: np.ndarray, touched: np.ndarray, fps: float, radius: float) -> np.ndarray:
    """(T, 3) m/s of the ball at (T, 3) m: in free flight that of the fitted parabola, elsewhere central differences
    that do not reach across a bounce or an edge of a flight."""
    v = np.empty_like(ball)
    flying = flights(ball, touched, fps, radius)
    edges = sorted(
        {0, len(ball), *(f.start for f in flying), *(f.stop for f in flying), *_turns(ball, touched, radius)}
    )
    for start, stop in zip(edges[:-1], edges[1:], strict=True):
        lo, hi = (start, stop) if stop - start > 1 else (max(start - 1, 0), min(stop + 1, len(ball)))
        part = np.gradient(ball[lo:hi], 1 / fps, axis=0) if hi - lo > 1 else np.zeros((1, 3))
        v[start:stop] = part[start - lo : stop - lo]
    for f in flying:
        t = np.arange(f.stop - f.start) / fps
        for axis, degree in ((0, 1), (1, 1), (2, 2)):
            v[f.start : f.stop, axis] = np.polyval(np.polyder(np.polyfit(t, ball[f.start : f.stop, axis], degree)), t)
    return v


def _turns(ball: np.ndarray, touched: np.ndarray, radius: float) -> list[int]:
    """Frames at which the ball turns round on the floor."""
    low = spans((ball[:, 2] < radius + NEAR_FLOOR) & ~touched)
    return [start + int(ball[start:stop, 2].argmin()) for start, stop in low if 0 < start and stop < len(ball)]
