"""A simulated person who calibrates a simulated robot: hands on its joints, eyes on its body, no idea of its motors.

One hand moves a joint; the other holds the rest of the limb in the middle of its ranges, out of the way, and
somewhere else where the joint still runs into something before its stop. Afterwards both lay the limb back where it was
found: three axes of a hip have two sets of angles for a leg that hangs straight down, so a leg that is dropped from its stops
may come down by the other one.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from drivers.bus import BusSpec

SPEED = 1.5  # rad/s at which a joint is moved
GRIP = 15.0  # rad/s, how firmly it is held: the natural frequency of joint and hand
BEYOND = 0.1  # rad that the hand would go on behind the stop
YIELD = 0.15  # rad by which it runs ahead of a joint that does not follow
PATIENCE = 1.5  # s
BACK = 0.6  # rad from a stop, to come back to it
HOLD_TIME = 1.2  # s at each stop


class Person:
    """Moves the joints of ``world`` while it advances. ``ranges``: by joint, where its stops are (rad); ``limbs``: by
    joint, of which limb it is; ``reach``: by joint, the one stop that can be reached, where it is only one."""

    def __init__(
        self, world: Any, ranges: Mapping[str, tuple[float, float]], limbs: Mapping[str, str],
        reach: Mapping[str, str] | None = None, timestep: float = 0.002,
    ) -> None:  # fmt: skip
        self._world, self._ranges, self._limbs, self._timestep = world, ranges, limbs, timestep
        self._reach = reach or {}
        self._found = dict(zip(world.plant.joints, world.plant.joint_pos.tolist(), strict=True))
        self._joint = self._next = ""
        self._laying_down = False
        self._held: dict[str, float] = {}  # where the other hand has the rest of the limb
        self._target = 0.0
        self._goals: list[tuple[float, float]] = []  # (where to, how long to stay there)
        self._stayed = self._blocked = 0.0
        self._posture: dict[str, float] = {}  # where the other hand wants the rest of the limb
        self._random = np.random.default_rng(0)

    def move(self, joint: str) -> None:
        """As soon as the limb in hand is laid down: from its middle to its lower stop, then to its upper one, and stay there;
        or twice to the only one there is."""
        self.let_go()
        self._next = joint
        if not self._joint:
            self._take()

    def let_go(self) -> None:
        """Lay the limb down, and hands off."""
        self._next = ""
        if self._joint and not self._laying_down:
            self._laying_down, self._stayed, self._blocked = True, 0.0, 0.0
            self._goals = [(self._found[self._joint], 0.0)]
            self._posture = {other: self._found[other] for other in self._held}

    def _take(self) -> None:
        """The next joint in hand."""
        self._joint, self._next = self._next, ""
        low, high = self._ranges[self._joint]
        self._target = self._at(self._joint)
        limb = [other for other, limb in self._limbs.items() if limb == self._limbs[self._joint]]
        self._held = {other: self._at(other) for other in limb if other != self._joint}
        self._posture = {other: sum(self._ranges[other]) / 2 for other in self._held}
        if (reach := self._reach.get(self._joint, "both")) == "both":
            self._goals = [((low + high) / 2, 0.0), (low - BEYOND, HOLD_TIME), (high + BEYOND, np.inf)]
        else:
            stop, back = (high + BEYOND, high - BACK) if reach == "upper" else (low - BEYOND, low + BACK)
            self._goals = [(back, 0.0), (stop, HOLD_TIME), (back, 0.0), (stop, np.inf)]

    def _release(self) -> None:
        """Hands off, and on to the next joint where there is one."""
        for joint in (self._joint, *self._held):
            self._world.plant.pull(joint, 0.0)
        self._joint, self._laying_down, self._held, self._stayed, self._blocked = "", False, {}, 0.0, 0.0
        if self._next:
            self._take()

    def advance(self, until: float) -> None:
        """Let time pass in the world, and hands do what they do."""
        while self._world.time < until - 1e-9:
            if self._joint:
                self._act(self._timestep)
            self._world.advance(min(until, self._world.time + self._timestep))

    def _act(self, dt: float) -> None:
        goal, stay = self._goals[0]
        step = self._grip(self._joint, self._target, goal, dt)
        self._target += step
        for joint, target in self._held.items():
            self._held[joint] += self._grip(joint, target, self._posture[joint], dt)
        there = abs(self._at(self._joint) - goal) < 2 * BEYOND
        self._blocked = 0.0 if there or step else self._blocked + dt
        if self._laying_down:
            self._stayed += dt if there and not step else 0.0
            if self._stayed > stay or self._blocked > PATIENCE:
                self._release()
        elif self._blocked > PATIENCE and self._held:
            self._blocked = 0.0
            self._posture = {joint: 0.8 * float(self._random.uniform(*self._ranges[joint])) for joint in self._held}
            self._goals.insert(0, (sum(self._ranges[self._joint]) / 2, 0.5))
        elif there and not step:
            self._stayed += dt
            if self._stayed > stay:
                del self._goals[0]
                self._stayed = 0.0

    def _grip(self, joint: str, target: float, goal: float, dt: float) -> float:
        """Pull at a joint so that it follows ``target`` on its way to ``goal``; returns how far that goes on in ``dt``."""
        step = float(np.clip(goal - target, -SPEED * dt, SPEED * dt))
        plant = self._world.plant
        weight, inertia = plant.weight_on(joint)
        ahead = float(np.clip(target + step - self._at(joint), -YIELD, YIELD))
        velocity = plant.joint_vel[plant.joints.index(joint)]
        pull = GRIP**2 * ahead + 2 * GRIP * (step / dt - velocity)
        plant.pull(joint, weight + inertia * float(pull))
        return step

    def _at(self, joint: str) -> float:
        return float(self._world.plant.joint_pos[self._world.plant.joints.index(joint)])


def assembled(specs: Sequence[BusSpec], seed: int) -> list[BusSpec]:
    """The buses of a robot that somebody put together: motors either way round, their zeros anywhere within a fifth of a
    turn."""
    random = np.random.default_rng(seed)
    return [
        replace(spec, motors=tuple(
            replace(m, sign=int(random.choice((-1, 1))), offset=float(random.uniform(-1.25, 1.25))) for m in spec.motors
        ))
        for spec in specs
    ]  # fmt: skip
