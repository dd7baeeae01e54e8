"""What counts as a success, and that an episode's end, and not what would have come after it, is looked at."""

from __future__ import annotations

import numpy as np
import pytest

from policies.skillmimic.evaluate import LEAST, Trace, succeeded

PERIOD, TICKS = 0.02, 100


def trace(held, velocity=(0.0, 0.0, 0.0), up=True, apart=0.4, height=0.7, lifted=0.8) -> Trace:
    held = np.asarray(held, bool)
    up = np.broadcast_to(up, held.shape).copy()
    rows = [np.full(len(held), x) if np.ndim(x) == 0 else x for x in (apart, lifted, height)]
    return Trace(held, np.tile(velocity, (len(held), 1)), *rows, up)


def holds(first: int, then: int) -> np.ndarray:
    return np.r_[np.ones(first, bool), np.zeros(then, bool)]


def success(skill: str, t: Trace) -> float:
    return succeeded(skill, t, PERIOD, TICKS)


def test_a_kept_ball_is_one_whose_episode_never_failed():
    assert success("hold", trace(holds(TICKS, 0))) == 1
    assert success("hold", trace(holds(30, 0), up=np.arange(30) < 29)) == 0


@pytest.mark.parametrize(
    ("velocity", "good"),
    [((2.0, 0.0, 0.0), 1), ((2.0, 0.7, 0.0), 1), ((2.0, 0.8, 0.0), 0), ((-2.0, 0.0, 0.0), 0), ((LEAST - 0.1, 0, 0), 0)],
)
def test_a_thrown_ball_flies_forwards(velocity, good):
    assert success("pass", trace(holds(40, 60), velocity)) == good


def test_a_throw_lets_go_and_the_robot_stands():
    fast = (3.0, 0.0, 0.0)
    assert success("pass", trace(holds(TICKS, 0), fast)) == 0
    assert success("pass", trace(holds(40, 60), fast, up=np.arange(100) < 99)) == 0
    again = holds(40, 60)
    again[80:] = True  # it took the ball back
    assert success("shot", trace(again, fast)) == 0


def test_a_ball_is_picked_up_where_it_ends_above_a_metre_at_the_size_of_the_robot():
    low, high = 0.74, 0.75
    assert success("pickup", trace(holds(0, TICKS), lifted=high)) == 1
    assert success("pickup", trace(holds(0, TICKS), lifted=low)) == 0
    assert success("pickup", trace(holds(0, TICKS), lifted=np.r_[np.full(TICKS - 1, high), low])) == 0
    assert success("pickup", trace(holds(0, TICKS), lifted=high, up=np.arange(TICKS) < TICKS - 1)) == 0


def test_a_catch_holds_until_the_end():
    caught = ~holds(60, 40)
    assert success("catch", trace(caught)) == 1
    short = ~holds(80, 20)  # 0.4 s
    assert success("catch", trace(short)) == 0
    dropped = caught.copy()
    dropped[90] = False
    assert success("catch", trace(dropped)) == 0
    assert success("catch", trace(caught, up=np.arange(100) < 99)) == 0


def test_dribbling_counts_frames_of_all_that_were_due():
    touches = np.arange(TICKS) % 25 == 0
    assert success("dribble_in_place", trace(touches)) == 1
    assert success("dribble_in_place", trace(touches[:50], up=np.arange(50) < 49)) == pytest.approx(0.49)
    assert success("dribble_in_place", trace(touches, apart=1.2)) == 0  # 1.5 m of a person
    assert success("dribble_in_place", trace(touches, height=0.35)) == 0


def test_frames_in_which_somebody_aims_the_ball_do_not_count():
    touches = np.arange(TICKS) >= 40
    assert succeeded("dribble_in_place", trace(touches), PERIOD, TICKS, aimed=40) == 1
    late = trace(touches[:70], up=np.arange(70) < 69)
    assert succeeded("dribble_in_place", late, PERIOD, TICKS, aimed=40) == pytest.approx(29 / 60)
    assert succeeded("dribble_in_place", trace(touches[:30]), PERIOD, TICKS, aimed=40) == 0


def test_a_ball_nobody_touches_any_more_is_not_dribbled():
    once = np.arange(200) == 0
    assert succeeded("dribble_in_place", trace(once), PERIOD, 200) == pytest.approx(0.5)


def bounces(count: int, rises: int = 8) -> Trace:
    """A ball that comes up from the floor for ``rises`` ticks in every 90, ``count`` times, and is held in between."""
    held, up = np.ones(90 * count, bool), np.zeros(90 * count)
    for k in range(count):
        held[90 * k : 90 * k + 40], up[90 * k + 20 : 90 * k + 20 + rises] = False, 3.0
    t = trace(held)
    t.ball_velocity[:, 2] = up
    return t


def test_bouncing_counts_frames_that_are_not_long_after_a_bounce():
    assert succeeded("bounce", bounces(4), PERIOD, 360) == 1
    assert succeeded("bounce", bounces(4), PERIOD, 720) == 0.5


def test_who_only_holds_a_ball_does_not_bounce_it():
    held = trace(holds(360, 0))
    held.ball_velocity[:, 2] = 3.0  # in the hands
    assert succeeded("bounce", held, PERIOD, 360) == pytest.approx(100 / 360)
