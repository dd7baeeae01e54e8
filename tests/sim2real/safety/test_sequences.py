"""Every sequence of four events, from disarmed and from armed, against an oracle that counts ticks."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from bench import Bench

from sim2real.types import Mode

TICK = 3 / 128  # s: after two ticks a command is late enough to hold, after three to damp; a hold lasts one more tick
EVENTS = ("fresh", "late", "nan", "tilt", "arm", "stop", "off")


class Oracle:
    """What must happen, in whole ticks. ``age`` of the newest command, ``held`` since a hold began, ``cause`` of it all."""

    def __init__(self):
        self.mode, self.cause, self.age, self.held, self.bad = Mode.OFF, None, math.inf, 0, False

    def __call__(self, event: str) -> Mode:
        self.age, self.held = self.age + 1, self.held + 1
        if event == "arm" and self.mode >= Mode.DAMP:
            if not (self.cause == "late" and self.age >= 2 or self.cause == "nan" and self.bad):
                self.mode, self.cause, self.age = Mode.RUN, None, 0
        if event in ("fresh", "nan"):
            self.age, self.bad = 0, event == "nan"
        if event in ("stop", "off"):
            self.mode = max(self.mode, Mode.DAMP) if event == "stop" else Mode.OFF
        if self.mode <= Mode.HOLD:
            self.climb(event)
        return self.mode

    def climb(self, event: str) -> None:
        causes = [("tilt", event == "tilt"), ("late", self.age >= 3), ("nan", self.bad), ("late", self.age >= 2)]
        found = [name for name, present in causes if present]
        too_long = self.mode == Mode.HOLD and self.held >= 2  # even if its cause ends in this very tick
        if not found and not too_long:
            self.mode, self.cause = Mode.RUN, None
            return
        if self.mode == Mode.RUN:
            self.cause, self.held = found[0], 0
        self.mode = Mode.DAMP if event == "tilt" or self.age >= 3 or too_long else Mode.HOLD


def play(bench: Bench, event: str) -> Mode:
    tilted = {"orientation_base_in_world": np.array([0.0, 1.0, 0.0, 0.0])} if event == "tilt" else {}
    bench.time += TICK
    if event == "arm":
        bench.safety.arm(bench.state(), bench.time)
    elif event == "stop":
        bench.safety.stop(bench.time)
    elif event == "off":
        bench.safety.off()
    command = None
    if event in ("fresh", "nan"):
        command = bench.command(**({"kp": {0: math.nan}} if event == "nan" else {}))
    out = bench.safety.step(bench.state(**tilted), command, bench.time)
    bench.assert_inside(out)
    return bench.safety.mode


@pytest.mark.parametrize("start", [(), ("arm", "fresh")], ids=["off", "armed"])
@pytest.mark.parametrize("first", EVENTS)
def test_every_sequence_of_four(robot, start, first):
    for rest in itertools.product(EVENTS, repeat=3):
        bench, oracle = Bench(robot), Oracle()
        for event in (*start, first, *rest):
            got, expected = play(bench, event), oracle(event)
            assert got == expected, (*start, first, *rest)
            cause = bench.safety.fault.rule.name if bench.safety.fault else None
            names = {"late": ("command_age", "command_age_hold"), "nan": ("command_finite",), "tilt": ("tilt",)}
            if got != Mode.OFF:  # off() and stop() keep the cause that was
                assert cause in names.get(oracle.cause, (None,)), (*start, first, *rest)
