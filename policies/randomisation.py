"""What differs between simulated robots, so that the real one is one of them: a table of ranges, each with its reason.

Every term is drawn uniformly per simulation at each reset. A term with ``apply`` writes fields of the physics model; the
others are read by the environment (sensors, timing, starts). ``sim2real eval`` draws from the same table with other seeds.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import mujoco
import numpy as np
from mujoco.batch import Batch

Fields = dict[str, np.ndarray]  # model field -> (sims, ...), live


class Term(NamedTuple):
    """One quantity: its range, how many numbers it has, why, and what it does to the model."""

    low: float
    high: float
    size: int | str  # a number, or "joints" or "bodies"
    why: str
    apply: Callable[[Fields, mujoco.MjModel, np.ndarray, np.ndarray], None] | None = None


def _scale(field: str, where: Callable[[mujoco.MjModel], slice]) -> Callable:
    """Multiply a nominal model field by the drawn numbers."""

    def apply(fields: Fields, model: mujoco.MjModel, ids: np.ndarray, x: np.ndarray) -> None:
        fields[field][ids, where(model)] = getattr(model, field)[where(model)] * x

    return apply


def _joints(model: mujoco.MjModel) -> slice:
    return slice(6, model.nv)


def _friction(fields: Fields, model: mujoco.MjModel, ids: np.ndarray, x: np.ndarray) -> None:
    fields["geom_friction"][ids, :, 0] = model.geom_friction[:, 0] * x


def _mass(fields: Fields, model: mujoco.MjModel, ids: np.ndarray, x: np.ndarray) -> None:
    fields["body_mass"][ids] = model.body_mass * x
    fields["body_inertia"][ids] = model.body_inertia * x[:, :, None]


def _load(fields: Fields, model: mujoco.MjModel, ids: np.ndarray, x: np.ndarray) -> None:
    fields["body_mass"][ids, model.body("torso_link").id] += x[:, 0]


def _com(fields: Fields, model: mujoco.MjModel, ids: np.ndarray, x: np.ndarray) -> None:
    torso = model.body("torso_link").id
    fields["body_ipos"][ids, torso] = model.body_ipos[torso] + x


def _hand_load(fields: Fields, model: mujoco.MjModel, ids: np.ndarray, x: np.ndarray) -> None:
    for side, load in zip(("left", "right"), x.T, strict=True):
        fields["body_mass"][ids, model.body(f"{side}_wrist_yaw_link").id] += load


def _kp(fields: Fields, model: mujoco.MjModel, ids: np.ndarray, x: np.ndarray) -> None:
    fields["actuator_gainprm"][ids, :, 0] = model.actuator_gainprm[:, 0] * x
    fields["actuator_biasprm"][ids, :, 1] = model.actuator_biasprm[:, 1] * x


def _kd(fields: Fields, model: mujoco.MjModel, ids: np.ndarray, x: np.ndarray) -> None:
    fields["actuator_biasprm"][ids, :, 2] = model.actuator_biasprm[:, 2] * x


def _strength(fields: Fields, model: mujoco.MjModel, ids: np.ndarray, x: np.ndarray) -> None:
    fields["actuator_forcerange"][ids] = model.actuator_forcerange * x[:, :, None]


TABLE: dict[str, Term] = {
    # the body
    "friction": Term(0.6, 2.0, 1, "x 0.6: 0.36 (dusty tiles) to 1.2 (rubber mat)", _friction),
    "mass": Term(0.95, 1.05, "bodies", "x: cables, covers, hands that the description leaves out", _mass),
    "torso_load": Term(-1.0, 2.0, 1, "kg: battery, computer, backpack", _load),
    "torso_com": Term(-0.03, 0.03, 3, "m: where that load sits", _com),
    "hand_load": Term(0.0, 0.4, 2, "kg a hand: a ball, a tool, gloves", _hand_load),
    # the motors
    "kp": Term(0.9, 1.1, "joints", "x: torque constants differ by some 10 %", _kp),
    "kd": Term(0.8, 1.2, "joints", "x: velocity is estimated in the motor", _kd),
    "strength": Term(0.9, 1.0, "joints", "x: hot windings, sagging battery", _strength),
    "damping": Term(5.0, 40.0, "joints", "x 0.01 N m s/rad: grease, and dry friction", _scale("dof_damping", _joints)),
    "armature": Term(0.9, 1.1, "joints", "x: rotor inertias are catalogue values", _scale("dof_armature", _joints)),
    # the sensors
    "joint_offset": Term(-0.02, 0.02, "joints", "rad: calibration"),
    "imu_tilt": Term(-0.02, 0.02, 2, "rad: how the IMU is mounted (roll, pitch)"),
    "joint_pos_noise": Term(0.0, 0.005, 1, "rad, standard deviation: encoder and gear play"),
    "joint_vel_noise": Term(0.0, 0.1, 1, "rad/s, standard deviation: differentiated encoder"),
    "gyro_noise": Term(0.0, 0.05, 1, "rad/s, standard deviation: ten times a MEMS gyro's, for vibration"),
    "gravity_noise": Term(0.0, 0.01, 1, "rad, standard deviation: attitude filter"),
    # time: the guardian runs at 250 Hz, a bus tick takes 1 to 3 ms, states are up to a tick old
    "action_delay": Term(0.0, 3.0, 1, "substeps of 5 ms (whole ones): command to motor"),
    "state_delay": Term(0.0, 2.0, 1, "substeps of 5 ms (whole ones): motor to policy"),
    "jitter": Term(0.0, 0.5, 1, "chance that one tick's command is a substep later"),
}

EXPANDED = ("geom_friction", "body_mass", "body_inertia", "body_ipos", "actuator_gainprm", "actuator_biasprm",
            "actuator_forcerange", "dof_damping", "dof_armature")  # fmt: skip


class Randomisation:
    """Draws the table for the simulations of a batch. ``drawn[name]``: (sims, size)."""

    def __init__(self, batch: Batch, model: mujoco.MjModel) -> None:
        self._batch, self._model = batch, model
        self._fields = {field: batch.expand(field) for field in EXPANDED}
        sizes = {"joints": model.nu, "bodies": model.nbody}
        self._sizes = {n: t.size if isinstance(t.size, int) else sizes[t.size] for n, t in TABLE.items()}
        self.drawn = {n: np.zeros((batch.nsim, size)) for n, size in self._sizes.items()}

    def draw(self, ids: np.ndarray, rng: np.random.Generator) -> None:
        """New robots in the simulations ``ids`` (k,)."""
        for name, term in TABLE.items():
            x = rng.uniform(term.low, term.high, (len(ids), self._sizes[name]))
            self.drawn[name][ids] = x
            if term.apply:
                term.apply(self._fields, self._model, ids, x)
        self._batch.set_const(ids)
