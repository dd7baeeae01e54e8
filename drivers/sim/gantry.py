"""The crane a robot hangs from while it is switched on: a rope that pulls, and never pushes, at one point of a body."""

from __future__ import annotations

import math

import numpy as np

GRAVITY = 9.81  # m/s^2
FREQUENCY = 3.0  # Hz: the robot on its rope bobs at this; it then hangs g / (2 pi f)^2 = 2.8 cm into the rope's stretch
DAMPING_RATIO = 0.7
PLANAR_RATIO = 0.1  # the hook gives way sideways with this share of the vertical stiffness
SWING_DAMPING = 0.5  # N m s/rad per kg m^2: straps rub, so hanging robots stop swinging
STEADYING = 1.0  # m, of its own weight, per rad: hands that keep the robot upright, or arms held out would tip it back
GYRATION = 0.25  # m, the radius of gyration that turns mass into the inertia used above


class Gantry:
    """An elastic support of the point ``hook``. ``height`` is where the hook is held, in m above the floor.

    The pull is a spring-damper of the robot's own weight class: vertical and only upwards (it is a rope), and a soft
    planar one that keeps the robot over its place. ``lower`` pays out rope at a rate until ``lowest``.
    """

    def __init__(self, mass: float):
        self.engaged = False
        self.height = 0.0
        self.lowest = 0.0
        self._rate = 0.0
        self._place = (0.0, 0.0)
        omega = 2 * math.pi * FREQUENCY
        self._stiffness = mass * omega**2
        self._damping = 2 * DAMPING_RATIO * mass * omega
        self._swing_damping = SWING_DAMPING * mass * GYRATION**2 * omega
        self._steadying = STEADYING * mass * GRAVITY
        self._stretch = GRAVITY / omega**2

    def hang(self, hook_in_world: np.ndarray, travel: float = 0.3) -> None:
        """Hold the robot with its hook at ``hook_in_world`` (3,), in balance; ``travel``: how far it can be lowered."""
        self.engaged = True
        self.height = float(hook_in_world[2]) + self._stretch
        self.lowest = self.height - travel
        self._place = (float(hook_in_world[0]), float(hook_in_world[1]))
        self._rate = 0.0

    def hold(self) -> None:
        """Stop paying out rope."""
        self._rate = 0.0

    def lower(self, rate: float = 0.1) -> None:
        """Pay out rope at ``rate`` m/s from now on, down to ``lowest``."""
        self._rate = abs(rate)

    def release(self) -> None:
        """Unhook."""
        self.engaged = False
        self._rate = 0.0

    def wrench(
        self, hook: np.ndarray, velocity: np.ndarray, angular_velocity: np.ndarray, up: np.ndarray, timestep: float
    ) -> tuple[np.ndarray, np.ndarray]:
        """Force on the hook (3,) N and torque (3,) N m, in the world, for a hook at ``hook`` (3,) moving at ``velocity``
        (3,) m/s on a body turning at ``angular_velocity`` (3,) rad/s whose own up is ``up`` (3,); winds the winch on by
        ``timestep``."""
        self.height = max(self.height - self._rate * timestep, min(self.lowest, self.height))
        stretch = self.height - float(hook[2])
        pull = max(0.0, self._stiffness * stretch - self._damping * float(velocity[2])) if stretch > 0 else 0.0
        taut = min(1.0, max(0.0, stretch / self._stretch))  # a slack rope neither pulls sideways nor damps
        k, d = taut * PLANAR_RATIO * self._stiffness, taut * PLANAR_RATIO * self._damping
        force = np.array(
            [
                k * (self._place[0] - float(hook[0])) - d * float(velocity[0]),
                k * (self._place[1] - float(hook[1])) - d * float(velocity[1]),
                pull,
            ]
        )
        upright = self._steadying * np.array([float(up[1]), -float(up[0]), 0.0])  # up x z
        return force, taut * (upright - self._swing_damping * angular_velocity)
