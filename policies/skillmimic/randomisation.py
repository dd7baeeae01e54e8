"""What differs between simulated robots, balls and trackers: ``policies.randomisation`` plus what a ball adds.

Every term is drawn uniformly per simulation at each reset, in the order of the table.
"""

from __future__ import annotations

import mujoco
import numpy as np
from mujoco.batch import Batch

from policies import ball
from policies.randomisation import TABLE as ROBOT_TABLE
from policies.randomisation import Fields, Term


def _friction(fields: Fields, model: mujoco.MjModel, ids: np.ndarray, x: np.ndarray) -> None:
    robot = slice(0, _ball_geom(model))
    fields["geom_friction"][ids, robot, 0] = model.geom_friction[robot, 0] * x


def _damping(fields: Fields, model: mujoco.MjModel, ids: np.ndarray, x: np.ndarray) -> None:
    fields["dof_damping"][ids, 6:-6] = model.dof_damping[6:-6] * x


def _armature(fields: Fields, model: mujoco.MjModel, ids: np.ndarray, x: np.ndarray) -> None:
    fields["dof_armature"][ids, 6:-6] = model.dof_armature[6:-6] * x


def _ball_mass(fields: Fields, model: mujoco.MjModel, ids: np.ndarray, x: np.ndarray) -> None:
    b = model.body(ball.NAME).id
    fields["body_mass"][ids, b] = model.body_mass[b] * x[:, 0]
    fields["body_inertia"][ids, b] = model.body_inertia[b] * x


def _ball_radius(fields: Fields, model: mujoco.MjModel, ids: np.ndarray, x: np.ndarray) -> None:
    """The sphere, and what the broad phase believes of it."""
    g = _ball_geom(model)
    radius = model.geom_size[g, 0] * x
    fields["geom_size"][ids, g, :1] = radius
    fields["geom_rbound"][ids, g] = radius[:, 0]
    fields["geom_aabb"][ids, g, 3:] = radius


def _ball_restitution(fields: Fields, model: mujoco.MjModel, ids: np.ndarray, x: np.ndarray) -> None:
    """See ``ball.contact``: damping goes with the logarithm of the restitution."""
    g = _ball_geom(model)
    fields["geom_solref"][ids, g, 1] = model.geom_solref[g, 1] * np.log(x[:, 0]) / np.log(ball.RESTITUTION)


def _ball_friction(fields: Fields, model: mujoco.MjModel, ids: np.ndarray, x: np.ndarray) -> None:
    g = _ball_geom(model)
    fields["geom_friction"][ids, g, 0] = model.geom_friction[g, 0] * x[:, 0]
    fields["pair_friction"][ids, :, :2] = model.pair_friction[:, :2] * x[:, :, None]


def _ball_geom(model: mujoco.MjModel) -> int:
    return int(model.geom(ball.NAME).id)


LATEST = 4  # ticks, of object_delay
TABLE: dict[str, Term] = {
    **ROBOT_TABLE,
    # the same ranges, of the robot's joints and geoms alone
    "friction": ROBOT_TABLE["friction"]._replace(apply=_friction),
    "damping": ROBOT_TABLE["damping"]._replace(apply=_damping),
    "armature": ROBOT_TABLE["armature"]._replace(apply=_armature),
    # the ball
    "ball_mass": Term(0.85, 1.15, 1, "x 0.62 kg: balls of size 6 (0.53 kg) to 7, dirt, water", _ball_mass),
    "ball_radius": Term(0.96, 1.04, 1, "x: pressure, and cheap balls", _ball_radius),
    "ball_restitution": Term(
        0.72, 0.84, 1, "recorded bounces spread over 0.78 to 0.84; soft floors", _ball_restitution
    ),
    "ball_friction": Term(0.6, 1.2, 1, "x 0.8 on the floor, x 1 on palms: sweat, dust, new rubber", _ball_friction),
    # the tracker: what is left after its filter
    "object_offset": Term(-0.01, 0.01, 3, "m: calibration of camera or markers to the base"),
    "object_noise": Term(0.0, 0.008, 1, "m, standard deviation of the position; it lasts"),
    "object_velocity_noise": Term(0.0, 0.1, 1, "m/s, standard deviation: it is differentiated"),
    "object_delay": Term(
        2.0,
        LATEST + 1.0,
        1,
        "ticks (whole ones) since the sighting from which it is foretold: 40 ms of camera, and to believe it",
    ),
    "object_loss": Term(0.0, 0.05, 1, "chance a tick that the ball is lost from sight; its course is foretold then"),
}
LOSS_TICKS = (1, 8)  # how long it stays lost

EXPANDED = ("geom_friction", "body_mass", "body_inertia", "body_ipos", "actuator_gainprm", "actuator_biasprm",
            "actuator_forcerange", "dof_damping", "dof_armature", "geom_size", "geom_rbound", "geom_aabb",
            "geom_solref", "pair_friction")  # fmt: skip


class Randomisation:
    """Draws the table for the simulations of a batch. ``drawn[name]``: (sims, size); ``fixed[name]`` (sims,), which may
    be changed between draws, is what a term is instead, where it is not NaN. ``share``, too, may be changed: that of every
    range that is drawn from, around its middle, or from its beginning if that is nothing at all."""

    share = 1.0

    def __init__(self, batch: Batch, model: mujoco.MjModel) -> None:
        self.fixed: dict[str, np.ndarray] = {}
        self._batch, self._model = batch, model
        self._fields = {field: batch.expand(field) for field in EXPANDED}
        sizes = {"joints": model.nu, "bodies": model.nbody}
        self._sizes = {n: t.size if isinstance(t.size, int) else sizes[t.size] for n, t in TABLE.items()}
        self.drawn = {n: np.zeros((batch.nsim, size)) for n, size in self._sizes.items()}

    def draw(self, ids: np.ndarray, rng: np.random.Generator) -> None:
        """New robots, balls and trackers in the simulations ``ids`` (k,)."""
        for name, term in TABLE.items():
            x = rng.uniform(term.low, term.high, (len(ids), self._sizes[name]))
            if self.share < 1:
                middle = (term.low + term.high) / 2 if term.low else 0.0
                x = middle + self.share * (x - middle)
            if name in self.fixed:
                given = self.fixed[name][ids, None]
                x = np.where(np.isnan(given), x, given)
            self.drawn[name][ids] = x
            if term.apply:
                term.apply(self._fields, self._model, ids, x)
        self._batch.set_const(ids)

    def vector(self) -> np.ndarray:
        """(sims, k): what was drawn of the scalars that a critic may know, each brought to [-1, 1]."""
        rows = [(self.drawn[n], t) for n, t in TABLE.items() if isinstance(t.size, int)]
        return np.concatenate([2 * (x - t.low) / (t.high - t.low) - 1 for x, t in rows], axis=1)
