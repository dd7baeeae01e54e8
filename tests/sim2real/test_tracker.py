"""The tracker against balls whose course is known: flying, bouncing, carried, hidden, and seen from a robot that turns."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from sim2real.limbs import Limbs
from sim2real.object.camera import CameraModel, SimCamera
from sim2real.quaternion import rotate
from sim2real.solids import Solids
from sim2real.tracker import NOBODY, ObjectSample, ObjectTracker

TICK, RADIUS, HEIGHT = 0.02, 0.09, 0.78
UPRIGHT = np.array([1.0, 0, 0, 0])
GOOD = CameraModel(jitter=0.0, noise=0.003, loss=0.0)


def ballistic(t: float) -> np.ndarray:
    """Thrown from 1.2 m at 1.5 m/s forwards and 2 m/s up, bouncing with restitution 0.8; (3,) m in the world. A bounce lasts
    22 ms, as those of the simulated ball do, during which its centre comes nearer to the floor."""
    height, speed, left, lasts = 1.2, 2.0, t, 0.022
    ahead = 0.5 + 1.5 * t
    while True:
        hits = np.sqrt(speed**2 + 2 * 9.81 * (height - RADIUS))
        fall = (speed + hits) / 9.81
        if left <= fall:
            return np.array([ahead, 0.1, height + speed * left - 9.81 * left**2 / 2])
        if left <= fall + lasts:
            return np.array([ahead, 0.1, RADIUS - hits * lasts / np.pi * np.sin(np.pi * (left - fall) / lasts)])
        left, height, speed = left - fall - lasts, RADIUS, 0.8 * hits


def turning(t: float) -> np.ndarray:
    """A base that yaws by 1 rad/s and nods."""
    pitch, yaw = 0.2 * np.sin(3 * t), t
    cy, sy, cp, sp = np.cos(yaw / 2), np.sin(yaw / 2), np.cos(pitch / 2), np.sin(pitch / 2)
    return np.array([cy * cp, -sy * sp, cy * sp, sy * cp])


def run(
    course, camera: CameraModel, seconds: float, orientation=lambda t: UPRIGHT, hidden=(9.0, 9.0), seed=0, limbs=NOBODY
):
    """Track ``course(t)``; returns times (T,), errors of position (T, 3) m in the base, and estimates by tick."""
    tracker, eye = ObjectTracker(RADIUS, height=HEIGHT), SimCamera(camera, seed)
    base = np.array([0.0, 0.0, HEIGHT])
    rows = []
    for k in range(round(seconds / 0.004)):
        now = k * 0.004
        if not hidden[0] <= now < hidden[1]:
            eye.expose(now, course(now), base, orientation(now))
        if k % round(TICK / 0.004):
            continue
        for sample in eye.read(now):
            tracker.measure(sample)
        e = tracker.estimate(now, orientation(now), limbs)
        truth = rotate(orientation(now) * [1, -1, -1, -1], course(now) - base)
        rows.append((now, e.position_in_base - truth, e.velocity_in_base.copy(), e.age, e.flying))
    times, errors, velocities, ages, flying = (np.array(column) for column in zip(*rows, strict=True))
    return tracker, times, errors, velocities, ages, flying


def rms(errors: np.ndarray) -> float:
    return float(np.sqrt(np.square(errors).sum(axis=1).mean()))


def test_nothing_is_known_before_the_first_sample():
    e = ObjectTracker(RADIUS).estimate(0.0, UPRIGHT)
    assert np.isnan(e.position_in_base).all() and np.isnan(e.velocity_in_base).all() and e.age == np.inf


def test_a_flight_with_bounces_is_followed_in_spite_of_the_delay():
    tracker, times, errors, velocities, ages, flying = run(ballistic, GOOD, 1.8)
    settled = times > 0.3
    assert rms(errors[settled]) < 0.03
    assert (flying[settled] > 0.5).mean() > 0.9
    assert (ages[settled] < 0.06).all() and (ages[settled] > 0.03).all()
    # With every answer 35 ms and more late, what was last seen is off by 0.1 m and more when the ball is fast.
    late = np.array([ballistic(t) - ballistic(t - 0.045) for t in times[settled]])
    assert rms(errors[settled]) < 0.5 * rms(late)
    assert tracker.counters.strange == 0 and tracker.counters.restarts == 1


FAR = Limbs(np.array([[0.3, 0.4, 0.6], [0.3, -0.4, 0.6]]))  # m in the base: palms that are nowhere near


def dribbled(seconds: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Heights and speeds of a ball and heights of a palm, a row a millisecond: pushed down over 0.2 m from every peak, with
    5 g; the floor gives it back 0.75 of its speed within 22 ms, and the palm goes up ahead of it."""
    z, v, palm, pushed, pressed, hits, rows = 0.9, 0.0, 1.0, 0.0, 0.0, 0.0, []
    for _ in range(round(seconds * 1000)):
        palm = max(palm, z + 0.101)
        if pressed > 0:
            pressed -= 0.001
            v = 0.0 if pressed > 0 else 0.75 * hits
        elif pushed > 0:
            v, pushed, palm = v - 0.05, pushed + v * 0.001, z + 0.1
        elif z <= RADIUS and v < 0:
            hits, pressed = -v, 0.022
        else:
            pushed = 0.2 if v > 0 and v < 0.00981 else 0.0
            v -= 0.00981
        z += v * 0.001
        rows.append((z, v, palm))
    return np.array(rows).T


def off_in_a_dribble(limbs: Callable[[np.ndarray], Limbs], counts: np.ndarray) -> float:
    """m/s, rms, by which a tracker that is told ``limbs`` of where the palm is in the base (1, 3) m is wrong about the speed of
    the ``dribbled`` ball, at the milliseconds that ``counts`` (4000,) bool, from the second on."""
    height, speed, palm = dribbled(4.0)
    base, errors = np.array([0.0, 0.0, HEIGHT]), []
    tracker, eye = ObjectTracker(RADIUS, height=HEIGHT), SimCamera(CameraModel(), 0)
    for k in range(0, 4000, 4):
        now, ball = k * 0.001, np.array([0.4, 0.0, height[k]])
        eye.expose(now, ball, base, UPRIGHT)
        if k % 20:
            continue
        for sample in eye.read(now):
            tracker.measure(sample)
        e = tracker.estimate(now, UPRIGHT, limbs(np.array([[0.4, 0.0, palm[k]]]) - base))
        if k > 1000 and counts[k]:
            errors.append(e.velocity_in_base - [0.0, 0.0, speed[k]])
    return rms(np.array(errors))


def test_far_from_the_hands_a_dribbled_ball_flies():
    """What a dribble depends on: how fast it comes up, from 80 ms after it bounced."""
    _, speed, _ = dribbled(4.0)
    up = np.convolve(speed > 0.3, np.ones(80))[:4000] == 80
    known, unknown = (off_in_a_dribble(told, up) for told in (Limbs, lambda palms: NOBODY))
    assert known < 0.25 and known < 0.8 * unknown


def test_what_its_own_hand_does_to_a_ball_the_robot_need_not_see():
    """A dribbled ball, and the plate that pushes it: how fast that is known to go in a stroke, and at once after it."""
    _, speed, _ = dribbled(4.0)
    pushed = np.append(np.diff(speed) < -0.03, False)
    stroke = (np.convolve(pushed, np.ones(41))[:4000] > 0.5) & (speed < -0.5)
    plate = np.eye(3)[None], np.array([[0.06, 0.04, 0.01]]), np.zeros(1)
    told = lambda palms: Limbs(palms, solids=Solids(palms, *plate))  # noqa: E731
    known, unknown = off_in_a_dribble(told, stroke), off_in_a_dribble(Limbs, stroke)
    assert known < 0.5 * unknown


def test_hands_that_are_near_may_move_it_and_where_they_were_counts():
    """A ball that falls no faster from 0.4 s on: a palm that goes with it explains that at once."""

    def carried(t: float) -> np.ndarray:
        return np.array([0.35, 0.0, 2.1 - 9.81 * min(t, 0.4) ** 2 / 2 - 9.81 * 0.4 * max(t - 0.4, 0.0)])

    weights = {}
    for name, apart in (("near", 0.1), ("far", 0.6)):
        tracker, eye, base = ObjectTracker(RADIUS, height=HEIGHT), SimCamera(GOOD, 0), np.array([0.0, 0.0, HEIGHT])
        for k in range(135):
            now = k * 0.004
            eye.expose(now, carried(now), base, UPRIGHT)
            if k % 5 == 0:
                for sample in eye.read(now):
                    tracker.measure(sample)
                tracker.estimate(now, UPRIGHT, Limbs((carried(now) - base + [0.0, apart, 0.0])[None]))
        weights[name] = tracker.current.flying
    assert weights["near"] < 0.3 < 0.6 < weights["far"]


def test_a_flight_seen_from_a_base_that_sways_is_one_where_the_feet_tell():
    """It sways forwards and back by 4 cm, once in 0.9 s, and squats by 2 cm; the answer is where and how fast from there."""

    def base(t: float) -> np.ndarray:
        return np.array([0.04 * np.sin(7 * t), 0.0, HEIGHT - 0.01 + 0.01 * np.cos(7 * t)])

    def moves(t: float) -> np.ndarray:
        return (base(t + 1e-4) - base(t - 1e-4)) / 2e-4

    off = {}
    for known in (True, False):
        errors = []
        for seed in range(5):
            tracker, eye = ObjectTracker(RADIUS, height=HEIGHT), SimCamera(CameraModel(), seed)
            for k in range(250):
                now = k * 0.004
                eye.expose(now, ballistic(now), base(now), UPRIGHT)
                if k % 5:
                    continue
                for sample in eye.read(now):
                    tracker.measure(sample)
                e = tracker.estimate(now, UPRIGHT, Limbs(base=base(now), velocity=moves(now)) if known else NOBODY)
                if 0.3 < now < 0.7 or now > 0.84:
                    speed = (ballistic(now + 1e-4) - ballistic(now - 1e-4)) / 2e-4
                    errors.append(e.velocity_in_base - speed + moves(now))
                    place = ballistic(now) - base(now)
                    assert not known or np.linalg.norm(e.position_in_base - place) < 0.07
        off[known] = rms(np.array(errors))
    assert off[True] < 0.25 and off[True] < 0.6 * off[False]


def test_limbs_that_are_lost_for_a_moment_lose_nothing():
    tracker, seen = ObjectTracker(RADIUS, height=HEIGHT), np.array([0.3, 0.0, 0.1])
    below = Solids(seen[None] - [[0.0, 0.0, 0.1]], np.eye(3)[None], np.array([[0.06, 0.04, 0.01]]), np.zeros(1))
    known = Limbs(np.zeros((2, 3)), np.array([5.0, 1.0, 0.7]), solids=below)
    lost = Limbs(base=known.base)
    for k in range(40):
        tracker.measure(ObjectSample(k * TICK - 0.013, seen))
        e = tracker.estimate(k * TICK, UPRIGHT, lost if k in (20, 21) else known)
    np.testing.assert_allclose(e.position_in_base, seen, atol=0.01)
    assert tracker.counters.restarts == 1 and tracker.counters.strange == 0


def test_somebody_else_may_take_a_ball_out_of_its_flight():
    def course(t: float) -> np.ndarray:
        return ballistic(min(t, 0.3))

    _, times, errors, velocities, *_ = run(course, CameraModel(), 1.2, limbs=FAR)
    settled = times > 0.8
    assert rms(errors[settled]) < 0.02 and rms(velocities[settled]) < 0.3


def test_the_delay_of_the_camera_is_foretold_away():
    """What is left of 35 to 45 ms, as time: training has nothing left of it (``policies/skillmimic/sight.py``)."""
    left = []
    for seed in range(10):
        _, times, errors, *_ = run(ballistic, CameraModel(), 0.6, seed=seed)
        falling = (times > 0.3) & (times < 0.6)
        speed = np.array([(ballistic(t + 1e-4) - ballistic(t - 1e-4)) / 2e-4 for t in times[falling]])
        left.append(-(errors[falling] * speed).sum(axis=1) / np.square(speed).sum(axis=1))
    assert abs(np.mean(left)) < 0.003 and np.quantile(np.abs(left), 0.99) < 0.010


def test_a_ball_held_still_is_not_thought_to_fall():
    _, times, errors, velocities, _, flying = run(lambda t: np.array([0.3, 0.0, 0.8]), CameraModel(), 2.0)
    settled = times > 0.5
    assert rms(errors[settled]) < np.sqrt(3) * CameraModel().noise  # better than a sample, and it is for now
    assert rms(velocities[settled]) < 0.2
    assert (flying[settled] < 0.5).mean() > 0.9


def test_a_base_that_turns_sees_the_ball_where_it_is():
    _, times, errors, _, _, _ = run(lambda t: np.array([0.6, 0.2, 0.9]), GOOD, 2.0, orientation=turning)
    assert rms(errors[times > 0.5]) < 0.01


def test_a_hidden_ball_is_foretold_and_its_age_grows():
    _, times, errors, _, ages, _ = run(ballistic, GOOD, 0.75, hidden=(0.45, 9.0))
    dark = times > 0.5
    assert np.linalg.norm(errors[dark][-1]) < 0.12  # a quarter of a second and one bounce later
    assert ages[-1] == pytest.approx(times[-1] - 0.434, abs=0.02)
    assert (np.diff(ages[dark]) > 0).all()


def test_it_finds_a_ball_that_reappears_elsewhere():
    def course(t: float) -> np.ndarray:
        return np.array([0.3, 0.0, 0.8]) if t < 0.5 else np.array([1.0, -0.5, 0.5])

    tracker, times, errors, *_ = run(course, GOOD, 1.2)
    assert rms(errors[times > 0.9]) < 0.01
    assert tracker.counters.strange >= ObjectTracker.patience and tracker.counters.restarts == 2


def test_one_wild_sample_moves_nothing():
    tracker = ObjectTracker(RADIUS, height=HEIGHT)
    for k in range(30):
        tracker.estimate(k * TICK, UPRIGHT)
        wild = k == 20
        used = tracker.measure(ObjectSample(k * TICK, np.array([2.0 if wild else 0.3, 0.0, 0.0])))
        assert used != wild
    assert abs(tracker.estimate(30 * TICK, UPRIGHT).position_in_base[0] - 0.3) < 0.01


def test_samples_that_come_too_late_or_from_the_future_or_not_finite_are_counted_and_left():
    tracker, here = ObjectTracker(RADIUS), np.array([0.3, 0.0, 0.0])
    for k in range(51):
        tracker.estimate(k * TICK, UPRIGHT)
    assert tracker.measure(ObjectSample(0.96, here))
    assert not tracker.measure(ObjectSample(0.95, here))
    assert not tracker.measure(ObjectSample(0.3, here))
    assert not tracker.measure(ObjectSample(1.2, here))
    assert not tracker.measure(ObjectSample(1.0, here * np.nan))
    c = tracker.counters
    assert (c.used, c.late, c.stale, c.early, c.strange) == (1, 1, 1, 1, 1)


def test_the_velocity_of_a_flight():
    _, times, _, velocities, _, _ = run(ballistic, GOOD, 0.55)
    expected = np.array([[1.5, 0.0, 2.0 - 9.81 * t] for t in times])
    assert rms((velocities - expected)[times > 0.35]) < 0.35


def test_an_orientation_that_is_not_finite_gives_no_estimate():
    tracker = ObjectTracker(RADIUS)
    tracker.estimate(0.0, UPRIGHT)
    tracker.measure(ObjectSample(0.0, np.zeros(3)))
    assert np.isfinite(tracker.estimate(0.02, UPRIGHT).position_in_base).all()
    assert np.isnan(tracker.estimate(0.04, UPRIGHT * np.nan).position_in_base).all()
    assert np.isfinite(tracker.estimate(0.06, UPRIGHT).position_in_base).all()


def test_the_camera_is_late_and_loses_pictures():
    eye = SimCamera(CameraModel(rate=60, latency=0.03, jitter=0.0, loss=0.25), seed=3)
    seen = 0
    for k in range(1000):
        now = k * 0.004
        eye.expose(now, np.zeros(3), np.zeros(3), UPRIGHT)
        for sample in eye.read(now):
            assert now - sample.time >= 0.03
            seen += 1
    assert seen == pytest.approx(4.0 * 60 * 0.75, rel=0.1)


@pytest.mark.parametrize("nothing", [np.zeros(4), np.full(4, np.nan), np.array([np.inf, 0, 0, 0])])
def test_a_sighting_is_not_placed_by_an_imu_that_has_not_spoken(nothing):
    tracker, seen = ObjectTracker(RADIUS, height=HEIGHT), np.array([0.5, 0.1, 0.2])
    tracker.estimate(0.0, nothing)
    assert not tracker.measure(ObjectSample(0.0, seen))
    tracker.estimate(0.02, UPRIGHT)
    assert tracker.measure(ObjectSample(0.02, seen))
    assert tracker.estimate(0.02, UPRIGHT).position_in_base == pytest.approx(seen)
    assert np.isnan(tracker.estimate(0.04, nothing).position_in_base).all()
