"""A ball in MuJoCo that bounces like a basketball: mass, size and contact by time step.

MuJoCo has no coefficient of restitution. A negative ``solref`` (-stiffness, -damping) makes a contact a damped spring of
``stiffness`` 1/s^2 per unit mass, whose restitution is about exp(-pi damping / (2 sqrt(stiffness))) and whose contact
lasts about pi / sqrt(stiffness) s. The solver sees it in steps: with fewer than five in a contact, restitution depends
on where in a step the ball arrives, and below four a bounce can gain energy. So stiffness follows from the time step.

Between two palms that law is wrong: they play ping-pong with the ball, and it falls in a fifth of a second however hard
they press. A palm is padded and a wrist yields, so ball and palm touch through explicit pairs that are critically damped
and have the friction of rubber. Then 30 N a palm hold 0.62 kg.
"""

# MuJoCo ships no types.
# pyright: reportAttributeAccessIssue=false

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import mujoco
import numpy as np

NAME = "ball"  # of the body, its joint and its geom
MASS = 0.62  # kg, a basketball of size 7 (FIBA Official Basketball Rules, Basketball Equipment: 0.58 to 0.62 kg)
RADIUS = 0.09  # m. The recorded ball (0.12 m) x the G1's leg length over the actor's (0.745), so that hands, bounces
# and flights of a retargeted clip keep their proportions; as large as a ball of size 3, and as heavy as one of size 7.
RESTITUTION = 0.80  # of the recorded bounces: median 0.80; SkillMimic and Liu & Hodgins use 0.80 and 0.81
FRICTION = (0.8, 0.005, 0.0005)  # sliding, torsional m, rolling m
PAD_STIFFNESS = 5000.0  # 1/s^2: 4 mm deep at 25 N
PAD_FRICTION = (1.0, 1.0, 0.01, 0.0005, 0.0005)  # sliding twice, torsional m, rolling m twice: rubber on rubber
GRIP = (
    400.0  # 1/s^2: how firmly a person carries the ball; 250 N/m give way to the robot's hands, which press with 25 N
)
PERSON = "sim2real/person"  # of the body, and the equality, that carries the ball where somebody hands it over


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


def palms(spec: mujoco.MjSpec) -> tuple[str, ...]:
    """Names of the geoms that are hands, left before right: the solid ones of the bodies with the site ``<side>_palm``."""
    found = []
    for side in ("left", "right"):
        site = spec.site(f"{side}_palm")
        solid = [g.name for g in site.parent.geoms if g.contype or g.conaffinity] if site is not None else []
        found += solid
    return tuple(found)


def add_ball(timestep: float, **properties: Any) -> Callable[[mujoco.MjSpec], None]:
    """A ``prepare`` for any world of a robot: the ball (``properties``: see ``ball``), and pads between it and the palms.

    Training and deployment both build their world with it.
    """

    def prepare(spec: mujoco.MjSpec) -> None:
        # With the pyramid that is MuJoCo's default a held ball creeps out of the hands within four seconds; with the cone it
        # still creeps down 4 cm in five seconds, for friction is soft: a few sweeps against slip halve that.
        spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
        spec.option.noslip_iterations = 3
        ball(timestep, **properties)(spec)
        for palm in palms(spec):
            pair = spec.add_pair(name=f"pad/{palm}", geomname1=NAME, geomname2=palm)
            pair.condim, pair.friction = 4, PAD_FRICTION
            pair.solref = [-PAD_STIFFNESS, -2 * np.sqrt(PAD_STIFFNESS)]
            pair.solimp = [0.95, 0.99, 0.001, 0.5, 2]

    return prepare


def add_person(spec: mujoco.MjSpec) -> None:
    """Whoever hands the ball over: a point that can hold it by its centre. Holds nothing until ``Ball.carry``."""
    spec.worldbody.add_body(name=PERSON, mocap=True, pos=spec.body(NAME).pos)  # so that it holds the centre
    grip = spec.add_equality(name=PERSON, type=mujoco.mjtEq.mjEQ_CONNECT, objtype=mujoco.mjtObj.mjOBJ_BODY)
    grip.name1, grip.name2, grip.active = PERSON, NAME, False
    grip.data[:3] = 0.0  # the anchor: its centre
    grip.solref = [-GRIP, -2 * np.sqrt(GRIP)]
    grip.solimp = [
        0.5,
        0.5,
        0.001,
        0.5,
        2,
    ]  # at a half, GRIP is the stiffness that is felt, and not its square of sorts


class Ball:
    """The ball of a compiled world that has ``add_ball`` and ``add_person``: where it is, and how it gets there."""

    def __init__(self, model: mujoco.MjModel, data: mujoco.MjData) -> None:
        self._model, self._data = model, data
        self._grip, self._hand = model.equality(PERSON).id, int(model.body(PERSON).mocapid[0])
        joint = model.joint(NAME)
        self._qpos, self._qvel = int(joint.qposadr[0]), int(joint.dofadr[0])

    @property
    def position(self) -> np.ndarray:
        """(3,) m of its centre in the world."""
        return self._data.qpos[self._qpos : self._qpos + 3].copy()

    @property
    def velocity(self) -> np.ndarray:
        """(3,) m/s in the world."""
        return self._data.qvel[self._qvel : self._qvel + 3].copy()

    @property
    def radius(self) -> float:
        """m."""
        return float(self._model.geom(NAME).size[0])

    @property
    def carried(self) -> bool:
        return bool(self._data.eq_active[self._grip])

    def carry(self, position: Sequence[float]) -> None:
        """Hold it at ``position`` (3,) m in the world, until told otherwise. Not held before: it appears there."""
        if not self.carried:
            self.throw(position, (0.0, 0.0, 0.0))
        self._data.mocap_pos[self._hand] = np.add(position, [0.0, 0.0, 9.81 / GRIP])  # it hangs that far below
        self._data.eq_active[self._grip] = 1
        mujoco.mj_step1(self._model, self._data)

    def throw(self, position: Sequence[float], velocity: Sequence[float]) -> None:
        """Let it fly from ``position`` (3,) m with ``velocity`` (3,) m/s in the world, without spin."""
        self.let_go()
        self._data.qpos[self._qpos : self._qpos + 7] = [*position, 1.0, 0.0, 0.0, 0.0]
        self._data.qvel[self._qvel : self._qvel + 6] = [*velocity, 0.0, 0.0, 0.0]
        mujoco.mj_step1(self._model, self._data)

    def let_go(self) -> None:
        """Whoever held it takes their hands away."""
        self._data.eq_active[self._grip] = 0


def ball_of(model: mujoco.MjModel, data: mujoco.MjData) -> Ball | None:
    """The ball of a compiled world that has one, with a person to carry it."""
    return Ball(model, data) if mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, PERSON) >= 0 else None


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
