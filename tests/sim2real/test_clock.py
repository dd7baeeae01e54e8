"""Schedules: absolute, skipping, drift-free."""

import pytest

from sim2real.clock import MonotonicClock, Schedule, SimClock


class FakeTime:
    """A world whose time only moves when told."""

    def __init__(self):
        self.time = 0.0

    def clock(self):
        return SimClock(self.advance, lambda: self.time)

    def advance(self, until):
        self.time = until


def test_ticks_are_due_at_exact_multiples_however_many():
    world = FakeTime()
    schedule = Schedule(world.clock(), 0.004)
    schedule.start(at=0.0)
    due = [schedule.wait() for _ in range(100_001)]
    assert due[-1] == 100_000 * 0.004
    assert schedule.late == 0


@pytest.mark.parametrize(("stall", "skipped"), [(0.003, 0), (0.0041, 1), (0.0119, 2), (0.1, 25)])
def test_a_late_tick_is_counted_and_what_is_past_is_skipped_not_burst(stall, skipped):
    world = FakeTime()
    schedule = Schedule(world.clock(), 0.004)
    schedule.start(at=0.0)
    schedule.wait()
    world.time += 0.004 + stall  # the work of the first tick took this long
    due = schedule.wait()
    assert schedule.late == skipped
    assert due <= world.time < due + 0.004
    assert schedule.lateness == pytest.approx(world.time - due)
    assert schedule.wait() == pytest.approx(due + 0.004)  # back on the grid at once


def test_the_simulated_clock_never_turns_back():
    world = FakeTime()
    clock = world.clock()
    clock.sleep_until(1.0)
    clock.sleep_until(0.5)
    assert clock.now() == 1.0


@pytest.mark.parametrize("spin", [0.0, 100e-6])
def test_the_real_clock_never_wakes_early(spin):
    clock = MonotonicClock(spin)
    for _ in range(20):
        deadline = clock.now() + 0.002
        clock.sleep_until(deadline)
        assert clock.now() >= deadline
    clock.sleep_until(clock.now() - 1.0)  # already past: at once
