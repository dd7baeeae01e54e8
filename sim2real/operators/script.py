"""A scripted operator: a timeline of skills, armed from the start."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from sim2real.types import OperatorInput, Sim2realError


@dataclass(frozen=True)
class Step:
    """Perform ``skill`` for ``duration`` s at ``velocity``."""

    skill: str | None
    duration: float
    velocity: tuple[float, float, float] = (0.0, 0.0, 0.0)


class ScriptOperator:
    """Arms, performs ``steps`` one after another, then quits."""

    ask_every = 0.5  # s between two requests to be armed

    def __init__(self, steps: Sequence[Step]):
        self.steps = list(steps)
        self.duration = sum(s.duration for s in steps)

    def read(self, now: float, since: float) -> OperatorInput:
        # Ask again and again until the gate agrees; once performing, never: a fault is a person's to clear.
        if since < 0:
            return OperatorInput(now, self.steps[0].skill, arm=now % self.ask_every < self.ask_every / 2)
        for step in self.steps:
            if since < step.duration:
                return OperatorInput(now, step.skill, step.velocity)
            since -= step.duration
        return OperatorInput(now, quit=True)

    def close(self) -> None:
        pass


def parse_script(text: str) -> list[Step]:
    """``"stand:3, squat:6, walk:5@0.5/0/0"``: label, seconds, and optionally a velocity (m/s, m/s, rad/s)."""
    steps = []
    for part in text.split(","):
        label, _, rest = part.strip().partition(":")
        seconds, _, velocity = rest.partition("@")
        try:
            duration, (forward, left, turn) = float(seconds), map(float, velocity.split("/") if velocity else (0, 0, 0))
            if not (duration > 0 and all(map(math.isfinite, (duration, forward, left, turn)))):
                raise ValueError("no time, or no number")
            steps.append(Step(label, duration, (forward, left, turn)))
        except ValueError:
            raise Sim2realError(
                f"script: got '{part.strip()}', expected LABEL:SECONDS or LABEL:SECONDS@FORWARD/LEFT/TURN, e.g. walk:5@0.5/0/0"
            ) from None
    return steps
