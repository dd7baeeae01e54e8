"""What nobody on the robot can know."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Truth:
    """The base, and the object where there is one, in the world as the simulation has it."""

    time: float  # s
    position_base_in_world: np.ndarray  # (3,) m
    orientation_base_in_world: np.ndarray  # (4,) w, x, y, z
    velocity_base_in_world: np.ndarray  # (3,) m/s
    angular_velocity_base_in_base: np.ndarray  # (3,) rad/s
    tilt: float  # rad between the base's up and the world's
    fallen: bool
    position_object_in_world: np.ndarray | None = None  # (3,) m; None: there is no object
    velocity_object_in_world: np.ndarray | None = None  # (3,) m/s
