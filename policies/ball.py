"""A ball in MuJoCo that bounces like a basketball: mass, size and contact by time step.

MuJoCo has no coefficient of restitution. A negative ``solref`` (-stiffness, -damping) makes a contact a damped spring of
``stiffness`` 1/s^2 per unit mass, whose restitution is about exp(-pi damping / (2 sqrt(stiffness))) and whose contact
lasts about pi / sqrt(stiffness) s. The solver sees it in steps: with fewer than five in a contact, restitution depends
on where in a step the ball arrives, and below four a bounce can gain energy. So stiffness follows from the time step.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import mujoco
import numpy as np

NAME = "ball"  # of the body, its joint and its geom
MASS = 0.62  # kg, a basketball of size 7 (FIBA Official Basketball Rules, Basketball Equipment: 0.58 to 0.62 kg)
RADIUS = 0.09  # m. The recorded ball (0.12 m) x the G1's leg length over the actor's (0.745), so that hands, bounces
# and flights of a retargeted clip keep their proportions; as large as a ball of size 3, and as heavy as one of size 7.
RESTITUTION = 0.80  # of the recorded bounces: median 0.80; SkillMimic and Liu & Hodgins use 0.80 and 0.81
FRICTION = (0.8, 0.005, 0.0005)  # sliding, torsional m, rolling m


class Contact(NamedTuple):
    """How stiff a ball's contact is."""

    stiffness: float  # 1/s^2
    damping: float  # 1/s


# time step (s) up to which -> contact: at RESTITUTION +- 0.05 over drops from 0.3 to 1.2 m (tests/policies/test_ball.py)
CONTACTS: dict[float, Contact] = {
    0.002: Contact(20000, 20),
    0.005: Contact(10000, 14),
    0.00834: Contact(5000, 10),
}


def contact(timestep: float, restitution: float = RESTITUTION) -> Contact:
    """The stiffest contact that ``timestep`` s carries, its damping scaled to ``restitution`` in (0, 1).

    Raises ValueError for a time step that is too long for any, and for a restitution out of range.
    """
    if not 0 < restitution < 1:
        raise ValueError(f"restitution: got {restitution}, expected more than 0 and less than 1")
    for longest, (stiffness, damping) in CONTACTS.items():
        if timestep <= longest:
            return Contact(stiffness, damping * float(np.log(restitution) / np.log(RESTITUTION)))
    raise ValueError(f"timestep: got {timestep} s, expected at most {max(CONTACTS)} s for a ball that bounces")


def ball(
    timestep: float,
    *,
    position: tuple[float, float, float] = (0.6, 0.0, RADIUS),
    radius: float = RADIUS,
    mass: float = MASS,
    restitution: float = RESTITUTION,
    friction: tuple[float, float, float] = FRICTION,
) -> Callable[[mujoco.MjSpec], None]:
    """A ``prepare`` for any world: adds a free ball to its ``mujoco.MjSpec``, at ``position`` (3,) m in the world.

    ``timestep`` s is that of the world it will live in. The ball is the last body, so that the robot keeps its place at
    the front of ``qpos``. It is hollow: a thin shell's inertia, 2/3 m r^2.
    """
    law = contact(timestep, restitution)

    def prepare(spec: mujoco.MjSpec) -> None:
        body = spec.worldbody.add_body(name=NAME, pos=position)
        body.add_freejoint(name=NAME)
        body.mass, body.inertia = mass, [2 / 3 * mass * radius**2] * 3
        body.ipos, body.iquat, body.explicitinertial = [0, 0, 0], [1, 0, 0, 0], True
        body.add_geom(
            name=NAME,
            type=mujoco.mjtGeom.mjGEOM_SPHERE,
            size=[radius, 0, 0],
            contype=1,  # touches whatever the floor touches, and the floor
            conaffinity=1,
            condim=4,  # sliding and torsional friction: two hands can hold it
            priority=2,  # its contact law holds against floor, hands and feet alike
            friction=friction,
            solref=[-law.stiffness, -law.damping],
            solimp=[0.95, 0.99, 0.001, 0.5, 2],
            rgba=[0.85, 0.40, 0.12, 1],
        )
        _seams(body, radius)
        _extend_keyframes(spec, [*position, 1, 0, 0, 0])

    return prepare


def _seams(body: Any, radius: float) -> None:
    """Two dark rings that show the spin; they touch nothing and weigh nothing."""
    for quat in ([1, 0, 0, 0], [np.sqrt(0.5), np.sqrt(0.5), 0, 0]):
        body.add_geom(
            type=mujoco.mjtGeom.mjGEOM_CYLINDER,
            size=[radius * 1.003, radius * 0.03, 0],
            quat=quat,
            contype=0,
            conaffinity=0,
            mass=0,
            rgba=[0.12, 0.10, 0.09, 1],
        )


def _extend_keyframes(spec: mujoco.MjSpec, qpos: list[float]) -> None:
    """Keyframes of a model name every coordinate: give them the ball's."""
    for key in spec.keys:
        if len(key.qpos):
            key.qpos = np.concatenate([key.qpos, qpos])
        if len(key.qvel):
            key.qvel = np.concatenate([key.qvel, np.zeros(6)])
