"""The same question asked of the deployed loop: real codecs, emulated motors on their buses, the safety gate, one file."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import mujoco
import numpy as np

from policies.basics import MOTIONS, Basics
from policies.randomisation import TABLE
from sim2real.config import load_robot
from sim2real.operators.script import ScriptOperator, Step
from sim2real.policy import load_policy, read_contract
from sim2real.simulation import Scene, Simulation
from sim2real.summary import Summary


def deploy_episode(
    path: Path, config: Basics, steps: list[tuple[str, float]], push: float = 0.0, seed: int = 0
) -> Summary:
    """One lockstep run: stand up, perform ``steps`` (label, seconds) on a randomised body.

    ``push``: m/s, the largest of random pushes, as in training but without their spin; 0: none.
    """
    rng = np.random.default_rng(seed)
    duration = sum(seconds for _, seconds in steps)
    pushes = list(random_pushes(rng, config, duration, push)) if push else []
    return deployed(
        path, steps, Scene(seed=seed, prepare=random_body(rng), pushes=pushes), commands(steps, rng, config)
    ).run()


def deployed(
    path: Path,
    steps: list[tuple[str, float]],
    scene: Scene,
    velocities: list[tuple[float, float, float]] | None = None,
    each_tick: Callable[[Simulation], None] | None = None,
) -> Simulation:
    """A lockstep run of a policy file, to be run: ``steps`` (label, seconds) on the robot that it was made for, with a
    velocity command each."""
    robot = load_robot(read_contract(path).robot)
    given = velocities or [(0.0, 0.0, 0.0)] * len(steps)
    operator = ScriptOperator([Step(label, seconds, v) for (label, seconds), v in zip(steps, given, strict=True)])
    return Simulation(robot, [load_policy(path, robot, trial=0)], operator, scene, each_tick=each_tick)


def commands(
    steps: list[tuple[str, float]], rng: np.random.Generator, config: Basics
) -> list[tuple[float, float, float]]:
    """A velocity command for every step, as in training; none for skills that obey none."""
    drawn = [rng.uniform(config.command_low, config.command_high) * MOTIONS[label].walks for label, _ in steps]
    return [(float(forward), float(left), float(turn)) for forward, left, turn in drawn]


def stayed_up(summary: Summary, seconds: float) -> bool:
    """On its feet for all of it, and the gate found no fault."""
    return summary.fell is False and not summary.faults and summary.duration > seconds - 0.1


def random_pushes(rng: np.random.Generator, config: Basics, duration: float, speed: float):
    """(seconds, velocity change (3,) m/s) as in training; none in the first second, while the gantry lets go."""
    t = 1.0 + rng.uniform(*config.push)
    while t < duration:
        heading, size = rng.uniform(-np.pi, np.pi), rng.uniform(0, speed)
        yield t, (size * np.cos(heading), size * np.sin(heading), 0.0)
        t += rng.uniform(*config.push)


def random_body(rng: np.random.Generator) -> Callable[[mujoco.MjSpec], None]:
    """The body's terms of the randomisation table, applied to a model before it is compiled."""

    def draw(name: str, size: int | None = None) -> np.ndarray:
        return rng.uniform(TABLE[name].low, TABLE[name].high, size)

    def prepare(spec: mujoco.MjSpec) -> None:
        friction = float(draw("friction"))
        for geom in spec.geoms:
            geom.friction[0] *= friction
        for body in spec.bodies:
            scale = float(draw("mass"))
            body.mass *= scale
            body.inertia = body.inertia * scale
        torso = spec.body("torso_link")
        torso.mass += float(draw("torso_load"))
        torso.ipos = torso.ipos + draw("torso_com", 3)
        for joint in spec.joints:
            joint.armature *= float(draw("armature"))

    return prepare
