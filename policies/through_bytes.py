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
from sim2real.policy import load_policy
from sim2real.simulation import Scene, Simulation
from sim2real.summary import Summary


def deploy_episode(
    path: Path, config: Basics, steps: list[tuple[str, float]], push: float = 0.0, seed: int = 0
) -> Summary:
    """One lockstep run: stand up, perform ``steps`` (label, seconds) on a randomised body.

    ``push``: m/s, the largest of random pushes, as in training but without their spin; 0: none.
    """
    rng = np.random.default_rng(seed)
    robot = load_robot(config.robot)
    duration = sum(seconds for _, seconds in steps)
    pushes = list(random_pushes(rng, config, duration, push)) if push else []
    simulation = Simulation(
        robot,
        [load_policy(path, robot, trial=0)],
        ScriptOperator([Step(label, seconds, command(label, rng, config)) for label, seconds in steps]),
        Scene(seed=seed, prepare=random_body(rng), pushes=pushes),
    )
    return simulation.run()


def command(label: str, rng: np.random.Generator, config: Basics) -> tuple[float, float, float]:
    """A velocity command as in training, for a skill that obeys one."""
    forward, left, turn = rng.uniform(config.command_low, config.command_high) * MOTIONS[label].walks
    return float(forward), float(left), float(turn)


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
