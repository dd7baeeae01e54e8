"""T-Motor / CubeMars AK motors in MIT mode: mini_cheetah.py with a table of models, a temperature and an error.

Answers: [id, position 16, velocity 12, torque 12, temperature of the driver (signed, deg C), error]. Zeroing stalls the
motor's communication for about a second. MIT mode is a setting of the flash, beside "servo mode" (29-bit identifiers).

The ranges are constants of each firmware, cannot be read, and have changed: an AK80-6 with firmware V1 has a velocity
of +-45 rad/s and a position of +-95.5 rad. Compare a slow motion with the joint's before trusting a motor.

Source: neurobionics/TMotorCANControl (ranges, error codes).
"""

from __future__ import annotations

from typing import ClassVar

import numpy as np

from drivers.codecs.mini_cheetah import MiniCheetahCodec, MiniCheetahMotors, Model
from drivers.codecs.mit import MitFeedback

ERRORS: dict[int, str] = {
    1: "over-temperature",
    2: "over-current",
    3: "over-voltage",
    4: "under-voltage",
    5: "encoder",
    6: "phase unbalance",
}


class CubemarsCodec(MiniCheetahCodec):
    """The host's side of one bus (a ``can_bus.CanCodec``)."""

    MODELS: ClassVar[dict[str, Model]] = {
        "AK10-9": Model(12.5, 50, 65),
        "AK60-6": Model(12.5, 50, 15),
        "AK70-10": Model(12.5, 50, 25),
        "AK80-6": Model(12.5, 76, 12),
        "AK80-9": Model(12.5, 50, 18),
        "AK80-64": Model(12.5, 8, 144),
    }
    FILE: ClassVar[str] = "cubemars.py"
    LENGTHS: ClassVar[tuple[int, ...]] = (8,)

    def _condition(self, feedback: MitFeedback) -> tuple[np.ndarray, np.ndarray]:
        return feedback.byte6.astype(np.uint8).astype(np.int8).astype(float), feedback.byte7.astype(np.int64)

    def error_name(self, code: int) -> str:
        return ERRORS.get(code, f"unknown error {code}") if code else "none"


class CubemarsMotors(MiniCheetahMotors):
    """The motors' side."""

    CODEC: ClassVar[type[MiniCheetahCodec]] = CubemarsCodec
    LENGTH: ClassVar[int] = 8

    def _condition(self, temperature: np.ndarray, error: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return np.clip(temperature, -128, 127).astype(np.int64), error
