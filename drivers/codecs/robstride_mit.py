"""RobStride motors switched to MIT mode (11-bit identifiers): mini_cheetah.py with other ranges and a finer temperature.

Answers come on the host's id, FD: [id, position 16, velocity 12, torque 12, temperature 16 in tenths of deg C], not
two temperatures as on Damiao. There are more special frames behind FF x 6 or x 7 (id, host id, save, protocol), none of which
is sent from here; "disable" is FF x 7 FD in full, for with 0, 1 or 2 as its seventh byte it switches the protocol.

The protocol is chosen by the private one (type 25, then a power cycle). A motor that speaks the other one is silent.
Parameters, among them canTimeout and zero_sta, and faults are better asked there: connect once with ``robstride`` to program
and save them; their frames in MIT mode are not documented well enough to rely on.

Source: the maker's manuals, edition of 2026-04-28 (MIT protocol, ranges by model; the +-15 rad of the RS04 may be a
misprint for 12.57).
"""

from __future__ import annotations

from typing import ClassVar

import numpy as np

from drivers.codecs.mini_cheetah import MiniCheetahCodec, MiniCheetahMotors, Model
from drivers.codecs.mit import MitFeedback
from drivers.codecs.robstride import HOST_ID, TEMPERATURE_UNIT


class RobstrideMitCodec(MiniCheetahCodec):
    """The host's side of one bus (a ``can_bus.CanCodec``)."""

    MODELS: ClassVar[dict[str, Model]] = {
        "RS00": Model(12.57, 33, 14),
        "RS01": Model(12.57, 44, 17),
        "RS02": Model(12.57, 33, 17),
        "RS03": Model(12.57, 33, 60),
        "RS04": Model(15, 33, 120),
        "RS05": Model(12.57, 50, 5.5),
        "RS06": Model(12.57, 50, 36, 5000, 100),
        "EL05": Model(12.57, 50, 6),
    }
    FILE: ClassVar[str] = "robstride_mit.py"
    MASTER: ClassVar[int] = HOST_ID
    LENGTHS: ClassVar[tuple[int, ...]] = (8,)

    def _condition(self, feedback: MitFeedback) -> tuple[np.ndarray, int]:
        return (feedback.byte6 * 256 + feedback.byte7) * TEMPERATURE_UNIT, 0


class RobstrideMitMotors(MiniCheetahMotors):
    """The motors' side."""

    CODEC: ClassVar[type[MiniCheetahCodec]] = RobstrideMitCodec
    LENGTH: ClassVar[int] = 8
    SPECIAL: ClassVar[tuple[int, ...]] = (0x01, *range(0xF8, 0xFF))  # beyond Kind: set host id, save, report, id, clear

    def _condition(self, temperature: np.ndarray, error: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        tenths = np.round(temperature / TEMPERATURE_UNIT).astype(np.int64)
        return tenths >> 8, tenths
