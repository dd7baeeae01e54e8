"""Emulated RobStride motors in MIT mode: mini-cheetah motors with other ranges. TIMEOUT stands for their canTimeout, whose
effect is not documented."""

from __future__ import annotations

from typing import ClassVar

from drivers.codecs.mini_cheetah import MiniCheetahMotors
from drivers.codecs.robstride_mit import RobstrideMitMotors
from drivers.sim.mini_cheetah import SimMiniCheetah


class SimRobstrideMit(SimMiniCheetah):
    """Emulated RobStride motors switched to the MIT protocol."""

    MOTORS: ClassVar[type[MiniCheetahMotors]] = RobstrideMitMotors
