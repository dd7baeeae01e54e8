"""Bounces by formula: no recording shows a ball bounced in place, so these are physics.

A dribble's stroke begins where the ball stands still, at its peak: a palm on top of it pushes it down with one constant
acceleration, leaves it, comes to rest, and is back when the ball is, which has bounced with its restitution. So the
stroke repeats exactly, and palm and ball meet with no speed between them.

Both hands let a ball drop that they hold between them, close on it where it comes to rest, and lift it to where it was.
Whatever they and the floor did to it on its way, they put right while they hold it.

The arms follow by inverse kinematics, which keeps the palms facing as they should, but minds where the hands are much
more: to keep a palm level to the last degree would swing a heavy shoulder, and that shakes the robot off its feet. Liu &
Hodgins (2018), too, needed no recorded ball.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import NamedTuple, Protocol, Self

import mink
import numpy as np

from policies import ball
from policies.clips.format import Clip
from policies.clips.kinematics import smooth
from policies.clips.reach import Frame, clip_of, follow
from policies.clips.robot import SIDES, RobotBody
from policies.physics import standing_height

GRAVITY = 9.81  # m/s^2
CLEAR = 0.015  # m between palm and ball while they do not touch
SMOOTHING = 0.5  # frames
TICK = 0.02  # s of a policy: a bounce lasts some of them
SETTLING = 3  # bounces before the one that is kept: then inverse kinematics has forgotten where it began
KNEES = 0.35  # rad, bent: as the robot stands at home
# m/rad, what a turned hand counts beside one that is elsewhere: a palm that pushes throws the ball where it looks; palms
# that hold it may turn, and then no joint has to be fast.
LEVEL, UPRIGHT = 0.1, 0.03


class Path(NamedTuple):
    """A bounce over time, (T,) each."""

    ball: np.ndarray  # m, height of its centre
    velocity: np.ndarray  # m/s upwards
    palm: np.ndarray  # m, height of a ball that the palms would lie on
    apart: np.ndarray  # m between each palm and that ball
    on: np.ndarray  # bool: palms and ball touch


class Bounce(Protocol):
    """One way to bounce a ball of ``radius`` m, at the size of the robot."""

    def period(self, radius: float) -> float:
        """s until it repeats."""
        ...

    def lasting(self, radius: float, period: float) -> Self:
        """The same, changed so that it lasts ``period`` s."""
        ...

    def path(self, radius: float, t: np.ndarray) -> Path:
        """At times ``t`` (T,) s since a bounce began: the ball is at its peak, and in the hands."""
        ...


class Flight(NamedTuple):
    """A ball that is pushed down from rest at ``top``, let go at ``leave``, and bounces to ``peak``: heights of its centre,
    m; durations, s; and m/s downwards where the palms leave it."""

    top: float
    leave: float
    peak: float
    push: float
    fall: float  # from the palms to the floor
    rise: float  # from the floor to the peak
    release: float

    @classmethod
    def of(cls, top: float, leave: float, peak: float, radius: float, restitution: float = ball.RESTITUTION) -> Flight:
        """What follows from the restitution: the ball's speeds are those that bring it to its peak."""
        off = np.sqrt(2 * GRAVITY * (peak - radius))
        hit = off / restitution
        release = np.sqrt(hit**2 - 2 * GRAVITY * (leave - radius))
        return cls(top, leave, peak, 2 * (top - leave) / release, (hit - release) / GRAVITY, off / GRAVITY, release)

    @property
    def period(self) -> float:
        return self.push + self.fall + self.rise

    def at(self, t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Height (T,) m and velocity upwards (T,) m/s at times ``t`` (T,) s in [0, period]."""
        pull, f, left = self.release / self.push, t - self.push, self.period - t
        phase = [t < self.push, f < self.fall]
        z = [self.top - pull * t**2 / 2, self.leave - self.release * f - GRAVITY * f**2 / 2]
        v = [-pull * t, -self.release - GRAVITY * f]
        return np.select(phase, z, self.peak - GRAVITY * left**2 / 2), np.select(phase, v, GRAVITY * left)

    def palms(self, t: np.ndarray, over: float, early: float, eased: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
        """Height (T,) m of palms that leave the ball, come to rest ``over`` m below, and then go to its peak, where they are
        ``early`` s before it; ``eased`` maps their way there, from 0 to 1."""
        f, stop, low = t - self.push, 2 * over / self.release, self.leave - over
        u = np.clip((f - stop) / (self.fall + self.rise - early - stop), 0, 1)
        brakes = self.leave - self.release * f + self.release**2 / (4 * over) * f**2
        return np.where(f < stop, brakes, low + (self.peak - low) * eased(u))


@dataclass(frozen=True)
class Stroke:
    """A dribble's: a palm from above."""

    peak: float = 1.0  # m, the ball's centre where the palm finds it
    push: float = 0.2  # m that the palm stays on it
    follow: float = 0.3  # m in which the palm then comes to rest
    place: tuple[float, float] = (0.3, 0.27)  # m from the base: ahead, and to the side of the arm
    restitution: float = ball.RESTITUTION  # that it is made for
    from_floor: bool = False  # it begins where the ball leaves the floor, and not at its peak

    def flight(self, radius: float) -> Flight:
        return Flight.of(self.peak, self.peak - self.push, self.peak, radius, self.restitution)

    def period(self, radius: float) -> float:
        return self.flight(radius).period

    def lasting(self, radius: float, period: float) -> Stroke:
        """With its peak moved."""
        stroke, low, high = self, self.peak - 0.1, self.peak + 0.1
        for _ in range(50):
            stroke = replace(stroke, peak=(low + high) / 2)
            low, high = (stroke.peak, high) if stroke.period(radius) < period else (low, stroke.peak)
        return stroke

    def path(self, radius: float, t: np.ndarray) -> Path:
        """The palm is never in the ball."""
        flight = self.flight(radius)
        off = flight.push + flight.fall + 1e-9  # when the ball has left the floor, whatever rounding says
        t = np.mod(t + self.from_floor * off, flight.period)
        z, v = flight.at(t)
        back = flight.palms(t, self.follow, 0.0, lambda u: 3 * u**2 - 2 * u**3)
        above = np.maximum(back, z + np.minimum(CLEAR, GRAVITY * (flight.period - t) ** 2 / 4))
        on = t < flight.push
        return Path(z, v, np.where(on, z, above), np.zeros(len(t)), on)


@dataclass(frozen=True)
class Drop:
    """Both palms from the sides. Nothing is pushed and nothing moves fast: a robot that has to step loses the ball."""

    top: float = 1.12  # m, the ball's centre where it is held
    along: float = 0.01  # m that the palms fall with it
    follow: float = 0.03  # m in which they then come to rest
    ahead: float = 0.22  # m from the base
    open: float = 0.08  # m between each palm and a ball that is away
    opening: float = 0.14  # s
    closing: float = 0.12  # s
    lift: float = 0.8  # s from where it is caught to where it is held
    rest: float = 0.2  # s there
    fingers: float = 0.2  # rad that they point down

    def flight(self, radius: float) -> Flight:
        peak = radius + ball.RESTITUTION**2 * (self.top - radius)
        return Flight.of(self.top, self.top - self.along, peak, radius)

    def period(self, radius: float) -> float:
        return self.flight(radius).period + self.lift + self.rest

    def lasting(self, radius: float, period: float) -> Drop:
        """With another rest."""
        return replace(self, rest=self.rest + period - self.period(radius))

    def path(self, radius: float, t: np.ndarray) -> Path:
        """It begins where the ball is caught, which is near where it is otherwise held."""
        flight = self.flight(radius)
        t = np.mod(t + flight.period, self.period(radius))
        f, left = t - flight.push, flight.period - t  # since the palms let go, and until they are back
        away = (f > 0) & (left > 1e-9)  # in the first frame hands have the ball, whatever rounding says
        u, lift = np.clip(-left / self.lift, 0, 1), flight.top - flight.peak
        z, v = flight.at(np.minimum(t, flight.period))
        z, v = z + lift * eased(u), v + lift / self.lift * 30 * u**2 * (1 - u) ** 2
        palm = flight.palms(t, self.follow, self.closing, eased)
        apart = self.open * eased(f / self.opening) * eased(left / self.closing)
        return Path(z, v, np.where(away, palm, z), np.where(away, apart, 0.0), ~away)


def eased(u: np.ndarray) -> np.ndarray:
    """From 0 to 1 with the least jerk (T. Flash and N. Hogan, J. Neuroscience 5, 1985)."""
    u = np.clip(u, 0, 1)
    return u**3 * (10 - 15 * u + 6 * u**2)


# With the arm stretched forwards, which is calmest. Somebody bounces the ball to the robot; and arms do not get as fast as
# they are sent, so the palm pushes as if a ball came back with less.
STRETCHED = Stroke(peak=1.0, push=0.25, follow=0.15, place=(0.4, 0.14), restitution=0.7, from_floor=True)
# While walking. Nearer, a thigh that swings meets the ball on its way up.
WALKING = Drop(ahead=0.25)


def dribble(body: RobotBody, name: str, side: str, stroke: Stroke = Stroke()) -> Clip:
    """One stroke of ``side``'s hand, from peak to peak, its palm looking down."""
    ahead, aside = stroke.place
    place = (ahead, aside if side == "left" else -aside)
    return _clip(body, name, stroke, place, {side: mink.SO3.from_x_radians(np.pi)}, LEVEL, f"{side} hand")


def bounce(body: RobotBody, name: str, drop: Drop = Drop()) -> Clip:
    """One bounce with both hands, from rest to rest, palms looking at each other."""
    down, towards = mink.SO3.from_y_radians(drop.fingers), {"left": np.pi / 2, "right": -np.pi / 2}
    facing = {side: down @ mink.SO3.from_x_radians(angle) for side, angle in towards.items()}
    return _clip(body, name, drop, (drop.ahead, 0.0), facing, UPRIGHT, "both hands")


def _clip(
    body: RobotBody,
    name: str,
    motion: Bounce,
    place: tuple[float, float],
    facing: Mapping[str, mink.SO3],
    turned: float,
    source: str,
    fps: float = 100.0,
) -> Clip:
    """``motion`` by a robot that stands with bent knees, with the ball ``place`` (m ahead, m left) of its base.

    ``facing``: how the palm of each hand at work is turned: a palm looks along its z axis, fingers along x;
    ``turned`` m/rad: what a hand turned otherwise counts beside one that is elsewhere.
    """
    radius = ball.RADIUS
    count = round(round(motion.period(radius) / TICK) * TICK * fps)
    motion = motion.lasting(radius, count / fps)
    path = motion.path(radius, np.arange(count * (SETTLING + 2)) / fps)
    names = body.robot.joint_names
    pose = body.robot.home_pos.copy()
    for joint, angle in (("hip_pitch", -KNEES / 2), ("knee", KNEES), ("ankle_pitch", -KNEES / 2)):
        pose[[names.index(f"{s}_{joint}_joint") for s in SIDES]] = angle
    height = float(standing_height(body.model, pose[None])[0])
    touch = body.palm_height(radius)

    base = np.array([0.0, 0.0, height, 1.0, 0.0, 0.0, 0.0])
    frames = []
    for palm, apart in zip(path.palm, path.apart, strict=True):
        over = touch + apart
        there = {s: np.array([*place, palm]) - turn.apply(np.array([0.0, 0.0, over])) for s, turn in facing.items()}
        palms = {s: mink.SE3.from_rotation_and_translation(facing[s], x) for s, x in there.items()}
        frames.append(Frame(base, pose, palms))
    last = slice(count * SETTLING, count * (SETTLING + 1))
    joint_pos = smooth(follow(body, frames, turned), SMOOTHING)[last]
    base = np.tile(base, (count, 1))
    hands = path.on[last, None] & np.array([s in facing for s in SIDES])
    where = np.column_stack([np.tile(place, (count, 1)), path.ball[last]])
    velocity = np.column_stack([np.zeros((count, 2)), path.velocity[last]])
    return clip_of(body, name, f"policies/clips/bounce.py, {source}", fps, base, joint_pos, where, velocity, hands)
