"""Emulated T-Motor / CubeMars AK motors: mini-cheetah motors that say their temperature and error. An error is over with
the next power cycle."""

from __future__ import annotations

from typing import ClassVar

from drivers.codecs.cubemars import CubemarsMotors
from drivers.codecs.mini_cheetah import MiniCheetahMotors
from drivers.sim.mini_cheetah import SimMiniCheetah


class SimCubemars(SimMiniCheetah):
    """Emulated AK motors."""

    MOTORS: ClassVar[type[MiniCheetahMotors]] = CubemarsMotors
    OVER_TEMPERATURE: ClassVar[int] = 1
