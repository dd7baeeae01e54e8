"""Trajectory optimisation of the arms' plan (Liu & Hodgins 2018, section 4.1): CMA-ES over offsets and feedback.

A candidate is judged by the training's own reward, over several randomised robots and balls, with no network in the loop.
``python -m policies.skillmimic.optimise g1-ball catch`` continues from what the task's corrections hold.
"""

from __future__ import annotations

import dataclasses
import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
import tyro
import yaml
from torch import Tensor

from policies.mirror import joint_mirror
from policies.skillmimic import plan
from policies.skillmimic.config import TASKS, SkillMimic, Task, check_skill
from policies.skillmimic.env import Env
from policies.skillmimic.evaluate import ticks_of
from policies.skillmimic.graph import PolicyGraph
from policies.skillmimic.plan import KNOTS, REACH, ROOT, TIPS, Correction
from sim2real.options import Count, Positive

with warnings.catch_warnings():  # that there is no matplotlib
    warnings.simplefilter("ignore", UserWarning)
    import cma

# What is one unit of the search: rad; m and rad per m; the same per m/s.
OFFSET, GAIN, DAMP = 0.1, np.repeat([0.4, 0.8], [3, 2]), np.repeat([0.04, 0.3], [3, 2])
SIGMA = 0.3  # of the first generation, in those units
QUIET = 1.3  # strokes without a touch, after which a ball is not being dribbled


class Search:
    """The corrections of one skill as a vector, about 1 in size.

    Where both palms work, both arms do the same, mirrored; where one does, the other arm is left alone.
    """

    def __init__(self, graph: PolicyGraph, skill: int) -> None:
        self.graph, self.skill = graph, skill
        clip = int(np.flatnonzero(graph.clips.skill == skill)[0])
        still = bool(graph.clips.swing[clip])
        self.count = 1 if still else KNOTS
        names = [graph.joint_names[j] for j in graph.acting]
        self.order, sign = joint_mirror(names)
        self.sign = np.array(sign)
        both = bool(graph.clips.hands[clip].all())
        side = "left" if both or graph.clips.hands[clip, 0] else "right"
        self.free = np.array([name.startswith(side) for name in names])
        self.both = both
        # Palms tip only under a ball that one of them bounces again and again.
        tips = bool(graph.clips.loop[clip]) and not both
        self.unit = np.concatenate(
            [unit * np.repeat([1.0, tips], [TIPS.start, len(REACH) - TIPS.start]) for unit in (GAIN, DAMP)]
        )

    def offsets(self, x: np.ndarray) -> np.ndarray:
        """(..., KNOTS, arms) rad of vectors (..., size)."""
        arms = len(self.free)
        own = np.zeros((*x.shape[:-1], self.count, arms))
        own[..., self.free] = x[..., : -2 * len(REACH)].reshape(*x.shape[:-1], self.count, -1) * OFFSET
        if self.both:
            own = own + own[..., self.order] * self.sign
        return np.broadcast_to(own, (*x.shape[:-1], KNOTS, arms))

    def gains(self, x: np.ndarray) -> np.ndarray:
        """(..., 10) of vectors (..., size)."""
        return x[..., -2 * len(REACH) :] * self.unit

    def correction(self, x: np.ndarray) -> Correction:
        return Correction(self.offsets(x)[: self.count], *np.split(self.gains(x), 2))

    def vector(self, c: Correction) -> np.ndarray:
        """Of what a file holds."""
        own = c.offsets[: self.count][:, self.free] / OFFSET
        return np.concatenate([own.ravel(), c.follow / GAIN, c.damp / DAMP])


class Alike(np.random.Generator):
    """Random numbers that are the same for every candidate: of ``each`` robots, repeated for ``candidates``, so that luck
    decides less. What is drawn for some of all robots (that start anew after a failure) is not shared."""

    def __init__(self, seed: int, each: int, candidates: int) -> None:
        super().__init__(np.random.PCG64(seed))
        self._each, self._candidates = each, candidates

    def random(self, size: Any = None) -> Any:  # type: ignore[override]
        return self._repeated(super().random, size)

    def standard_normal(self, size: Any = None) -> Any:  # type: ignore[override]
        return self._repeated(super().standard_normal, size)

    def uniform(self, low: Any = 0.0, high: Any = 1.0, size: Any = None) -> Any:  # type: ignore[override]
        return self._repeated(lambda size: super(Alike, self).uniform(low, high, size), size)

    def _repeated(self, draw: Callable[[Any], Any], size: Any) -> Any:
        count, *rest = size if isinstance(size, tuple) else (size,)
        if count != self._each * self._candidates:
            return draw(size)
        return np.repeat(draw((self._each, *rest)), self._candidates, axis=0)


def score(env: Env, candidates: np.ndarray, search: Search, ticks: int) -> np.ndarray:
    """(candidates,): mean reward of a tick, 0 after a failure, plus half the share of ticks before one; of a ball that
    bounces, of those ticks in which it was touched less than ``QUIET`` of its strokes ago.

    ``env`` has as many robots for each candidate as for another, in turn.
    """
    each = env.num_envs // len(candidates)
    of = np.tile(np.arange(len(candidates)), each)
    offsets = torch.from_numpy(search.offsets(candidates)[of].astype(np.float32))
    gains = torch.from_numpy(search.gains(candidates)[of].astype(np.float32))
    env.graph.plan.corrections = lambda skill: (offsets, gains)  # type: ignore[method-assign]
    env.reset()
    env.episode_length_buf[:] = 0
    idle: Tensor = torch.zeros(env.num_envs, env.num_actions)
    alive, total, quiet = np.full(env.num_envs, True), np.zeros(env.num_envs), np.zeros(env.num_envs)
    longest = QUIET * np.where(env.clips.loop, env.clips.length, np.inf)[env.clip] / env.substeps  # ticks
    with torch.no_grad():
        for _ in range(ticks):
            _, rewards, _, _ = env.step(idle)
            alive &= ~env.failures
            quiet = np.where(env.now.state.contact[:, 0] > 0, 0, quiet + 1)
            total += alive * (rewards.numpy() + 0.5 * (quiet < longest))
    return (total / ticks).reshape(each, len(candidates)).mean(axis=0)


def optimise(
    config: SkillMimic,
    skill: str,
    generations: int,
    candidates: int,
    each: int,
    keep: Callable[[Correction, int], None],
    seconds: float = 4.0,
    seed: int = 0,
) -> None:
    """Search for ``generations``, each robot of ``each`` judging every candidate once a generation.

    ``keep`` is given the middle of the search's distribution after every generation, and how many samples that took. Prints
    a line for each. ``seconds``: of an episode that does not end by itself.
    """
    config = dataclasses.replace(
        config, skills=(skill,), envs=candidates * each, anywhere=False, push_chance=0.0, easy=1.0
    )
    graph = PolicyGraph(config)
    ticks = ticks_of(graph, 0, seconds)
    env = Env(dataclasses.replace(config, frames=ticks), seed, graph)
    env.rng = Alike(seed, each, candidates)
    search = Search(graph, 0)
    start = search.vector(plan.read(config.corrections, [skill], len(graph.acting))[0])
    options = {"popsize": candidates - 1, "seed": seed + 1, "verbose": -9, "CMA_diagonal": 15}
    es = cma.CMAEvolutionStrategy(start, SIGMA, options)
    began = time.monotonic()
    for generation in range(1, generations + 1):
        asked = es.ask()
        values = score(env, np.array([*asked, es.mean]), search, ticks)
        es.tell(asked, (-values[:-1]).tolist())
        keep(search.correction(es.mean), ticks * env.num_envs)
        left = (time.monotonic() - began) / generation * (generations - generation) / 60
        print(
            f"{skill}: {generation} of {generations}, {left:.0f} min left; mean {values[-1]:.3f}, best {values.max():.3f},"
            f" sigma {es.sigma:.3f}",
            flush=True,
        )


def write(file: str | Path, skill: str, c: Correction, samples: int = 0) -> None:
    """Put a skill's correction into a file, beside the others', and add ``samples`` to those that the skill has cost."""
    document, path = plan.document(file), ROOT / file
    before = document.get(skill, {}).get("samples", 0)
    document[skill] = {
        "samples": before + samples,
        "offsets": [[round(float(x), 4) for x in row] for row in c.offsets],
        "follow": [round(float(x), 4) for x in c.follow],
        "damp": [round(float(x), 4) for x in c.damp],
    }
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(yaml.safe_dump(document, default_flow_style=None, width=120, sort_keys=True))


@dataclass(frozen=True)
class Args:
    """Find the corrections of a skill's plan."""

    task: tyro.conf.Positional[Task]
    """whose settings"""
    skill: tyro.conf.Positional[str]
    """which of the task's"""
    generations: Count = 40
    """of the search"""
    candidates: Count = 24
    """a generation"""
    each: Count = 16
    """randomised robots that a candidate is judged by"""
    seconds: Positive = 4.0
    """of an episode that does not end by itself"""


def main() -> None:
    a = tyro.cli(Args, prog="python -m policies.skillmimic.optimise")
    check_skill(a.skill, TASKS[a.task].skills)
    config = TASKS[a.task]
    assert config.corrections is not None  # with a base there is a plan
    torch.set_num_threads(1)
    keep = lambda c, samples: write(config.corrections, a.skill, c, samples)  # noqa: E731
    optimise(config, a.skill, a.generations, a.candidates, a.each, keep, a.seconds)


if __name__ == "__main__":
    main()
