"""When the loops of a run are due: in step with one another, and beside the kernel's own tick."""

import pytest

from sim2real import pilot
from sim2real.clock import SPIN
from sim2real.guardian import Guardian
from sim2real.run import ASIDE, RunSpec, keep_time

PERIOD = 0.004  # s
SPEC = RunSpec(robot="g1", wiring="can", simulated=True, policies={}, tune=False)


def test_ticks_are_due_aside_of_whole_periods():
    due = []
    keep_time(lambda scheduled, *_: due.append(scheduled), PERIOD, SPEC, 0, lambda: len(due) < 3, pilot.PHASE)
    assert [t % PERIOD for t in due] == pytest.approx([ASIDE + pilot.PHASE] * 3, abs=1e-6)


@pytest.mark.parametrize("due", [ASIDE, ASIDE + pilot.PHASE], ids=["guardian", "pilot"])
def test_no_tick_of_the_kernel_comes_while_a_loop_waits_for_its_own(due):
    kernel = 0.001  # s: CONFIG_HZ is 1000 at the most
    assert (due - SPIN) // kernel == due // kernel


def test_a_guardian_answers_aside_of_the_kernel_too():
    assert (ASIDE + Guardian.response_share * PERIOD) % 0.001 > 50e-6
