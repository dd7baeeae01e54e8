"""The object in a simulation: what is built, who brings it, and what is known of it where nothing is seen.

``Handover`` is the person with the ball, who brings it as the skill at hand expects to find it. Before the robot moves
they stand in front of it with the ball in their hands, for the camera to see. During the soft start
they bring it to where the policy expects it and keep it there; a moment after the policy took over they let go, or throw;
a ball that flies at the start is aimed for a moment first, where it begins to fall.
When a later skill needs it otherwise than it is, they bring it, or another one, again.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from drivers.sim.truth import Truth
from sim2real.contract import Contract, Object, ObjectStart
from sim2real.limbs import Limbs
from sim2real.quaternion import rotate
from sim2real.skills import Stage
from sim2real.tracker import NOBODY, ObjectEstimate, ObjectTracker

GRAVITY = 9.81  # m/s^2
AWAY = 0.4  # m in front of its place: where a ball waits that will be put into the robot's hands
COMING, BROUGHT = 0.6, 1.4  # s that bringing it takes, s before the end of the soft start at which it is there
HANDING_OVER = 0.3  # s for which a ball in the robot's hands is held on to
CLOSING = 0.8  # s for which it is where the hands come from elsewhere, of a robot that may have walked
HEEDING = 0.1  # s in which a policy that took over heeds its operator's first wish
AIMING = 1.6  # s for which it is where it will be thrown from, while the arms go where they wait for it
REACH = 0.4  # m: a ball farther from its place is not in the robot's hands any more


class Handover:
    """Call ``act`` at least as often as policies decide. ``world``: a World, or the remote of one."""

    def __init__(self, world: Any, starts: Mapping[str, ObjectStart]) -> None:
        self._world, self._starts = world, {label: highest(start) for label, start in starts.items()}
        self._skill = ""  # that the ball was last brought for
        self._let_go = np.inf  # s since the policy took over

    def act(self, stage: Stage, skill: str, left: float, since: float, wish: str | None = None) -> None:
        """``left``: s until the soft start ends; ``since``: s since the policy took over, negative before. At first the ball
        is brought for what the operator ``wish``es to begin with."""
        if since < HEEDING and wish:
            skill = wish
        if since > self._let_go:
            self._release(self._starts[self._skill])
            self._let_go = np.inf
        elif since >= 0 and np.isfinite(self._let_go):
            self._bring(self._starts[self._skill], 0.0)
        if since < 0:
            if start := self._starts.get(skill):
                self._bring(start, np.clip((left - BROUGHT) / COMING, 0, 1) if stage == Stage.ENGAGE else 1.0)
        elif skill != self._skill:
            first, self._skill = not self._skill, skill
            if start := self._starts.get(skill):
                self._begin(start, since, first)

    def _bring(self, start: ObjectStart, away: float) -> None:
        """Carry it to its place; ``away``: how much of the way is left."""
        place, _ = in_world(start, self._world.truth(), AWAY * away if start.how == "held" else 0.0)
        self._world.carry_ball(place)

    def _begin(self, start: ObjectStart, since: float, first: bool) -> None:
        truth = self._world.truth()
        place, _ = in_world(start, truth)
        if start.how == "thrown" and any(start.velocity):
            self._world.carry_ball(place)
            self._let_go = since + AIMING
        elif start.how != "held":
            self._release(start)
        elif first or np.linalg.norm(place - truth.position_object_in_world) > REACH:
            self._world.carry_ball(place)
            self._let_go = since + (HANDING_OVER if first else CLOSING)

    def _release(self, start: ObjectStart) -> None:
        if start.how == "held":
            self._world.let_go_ball()
        else:
            self._world.throw_ball(*in_world(start, self._world.truth()))


def highest(start: ObjectStart) -> ObjectStart:
    """Where a falling object that is thrown was, and how it flew, when it began to fall: there a person can hold it until
    the robot is ready. Others as they are."""
    time = -start.velocity[2] / GRAVITY
    if start.how != "thrown" or time <= 0:
        return start
    x, y, z = np.subtract(start.position, np.multiply(start.velocity, time)) - [0.0, 0.0, GRAVITY * time**2 / 2]
    return start.model_copy(update={"position": (x, y, z), "velocity": (*start.velocity[:2], 0.0)})


def in_world(start: ObjectStart, truth: Truth, ahead: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Position (3,) m, ``ahead`` m in front of its own, and velocity (3,) m/s of ``start`` in the world."""
    w, x, y, z = truth.orientation_base_in_world
    turn, base = truth.orientation_base_in_world, truth.position_base_in_world
    if start.how != "held":
        yaw = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
        turn, base = np.array([np.cos(yaw / 2), 0.0, 0.0, np.sin(yaw / 2)]), base * [1.0, 1.0, 0.0]
    return base + rotate(turn, np.add(start.position, [ahead, 0.0, 0.0])), rotate(turn, np.array(start.velocity))


def starts_of(contracts: Sequence[Contract]) -> dict[str, ObjectStart]:
    """How every skill finds its object, of those that say so."""
    return {s.label: s.object for contract in contracts for s in contract.skills if s.object is not None}


def prepare_for(thing: Object | None, timestep: float, **properties: float) -> Callable[[Any], None] | None:
    """What adds ``thing`` to a world of ``timestep`` s; ``properties``: radius, mass, restitution if not its own."""
    if thing is None:
        return None
    from drivers.sim.ball import add_ball, add_person

    add = add_ball(timestep, **(thing.model_dump(exclude={"kind"}) | properties))

    def prepare(spec: Any) -> None:
        add(spec)
        add_person(spec)

    return prepare


class TrueObject(ObjectTracker):
    """A tracker that knows, for comparison: it needs no sightings and asks the simulation."""

    def __init__(self, world: Any, radius: float) -> None:
        super().__init__(radius)
        self._world = world

    def estimate(self, now: float, orientation_base_in_world: np.ndarray, limbs: Limbs = NOBODY) -> ObjectEstimate:
        """The truth of now, whatever the robot believes its own orientation to be."""
        truth, e = self._world.truth(), self.current
        back = truth.orientation_base_in_world * [1.0, -1.0, -1.0, -1.0]
        e.position_in_base[:] = rotate(back, truth.position_object_in_world - truth.position_base_in_world)
        e.velocity_in_base[:] = rotate(back, truth.velocity_object_in_world - truth.velocity_base_in_world)
        e.age, e.flying = 0.0, np.nan
        return e
