"""Operators: whoever picks the skill. Each yields the latest OperatorInput and never blocks."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np

from sim2real.types import OperatorInput


class Operator(Protocol):
    """``read(now, since)``: the latest wish at clock time ``now``; ``since`` is how long the robot has been performing
    (s; negative before). Never blocks."""

    def read(self, now: float, since: float) -> OperatorInput: ...

    def close(self) -> None: ...


def store(wish: OperatorInput, labels: Sequence[str], record: np.ndarray) -> None:
    """Write a wish into a record of ``guardian.operator_layout``. A label nobody performs becomes "none"."""
    record["time"] = wish.time
    record["skill"] = labels.index(wish.skill) if wish.skill in labels else -1
    record["velocity"][0] = wish.velocity
    record["arm"], record["stop"], record["quit"] = wish.arm, wish.stop, wish.quit
