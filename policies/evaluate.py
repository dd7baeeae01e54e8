"""How often a policy stays up: per skill, pushed or not, and over every ordered switch."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from policies.basics import Basics
from policies.env import Env
from policies.graph import PolicyGraph
from policies.parts import Array, Over, unseen
from sim2real.policy import Policy, load_policy
from sim2real.types import Sim2realError

UNSEEN = 900_000  # seeds from here on are never trained on
Actor = Callable[[Env], Tensor]  # what to do in every robot of an environment: actions (envs, driven)


class Rate(NamedTuple):
    """``survived`` of ``episodes``."""

    survived: int
    episodes: int

    @property
    def value(self) -> float:
        return self.survived / self.episodes

    @property
    def interval(self) -> tuple[float, float]:
        """95 % confidence of a binomial share (Wilson 1927, JASA 22:209, eq. 2)."""
        z, n, p = 1.96, self.episodes, self.value
        centre = (p + z * z / (2 * n)) / (1 + z * z / n)
        half = z / (1 + z * z / n) * np.sqrt(p * (1 - p) / n + z * z / (4 * n * n))
        return float(max(0.0, centre - half)), float(min(1.0, centre + half))

    def __str__(self) -> str:
        low, high = self.interval
        return f"{self.value:.1%} ({low:.1%} to {high:.1%}, {self.episodes} episodes)"


class Episodes(NamedTuple):
    """What became of scripted episodes."""

    survived: Array  # (episodes,) bool
    error: Array  # (episodes,) rad, mean distance of the joints from their reference
    life: Array  # (episodes,) ticks until it fell
    velocity: Array  # (episodes, 2) m/s, mean of the base over the ground, forwards and to the left, while it is up

    def rate(self, where: np.ndarray | slice = slice(None)) -> Rate:
        chosen = self.survived[where]
        return Rate(int(chosen.sum()), len(chosen))


class FileActor:
    """A policy file in every robot of an environment, fed what a robot would measure, each with a memory of its own. Where
    there are more robots than files, the others have the same ``network`` on the environment's own observation.

    The environment turns actions into targets; Sim2realError if the file's own targets are others, because it was made
    with other settings than ``settings`` holds now.
    """

    settings = "policies/basics.py"

    def __init__(self, path: Path, robots: int, network: nn.Module | None = None) -> None:
        self.path, self.network = path, network
        first, data = load_policy(path, trial=0), path.read_bytes()  # proved once, run in every robot
        self.policies: list[Policy] = [first, *(Policy(data, first.contract, path) for _ in range(robots - 1))]

    def signals(self, env: Any) -> dict[str, Tensor]:
        """What every robot measures: (envs, size) by name."""
        return env.signals

    def begin(self, env: Any, k: int) -> None:
        """An episode of robot number ``k`` begins."""
        self.policies[k].reset()

    def __call__(self, env: Any) -> Tensor:
        signals = {name: signal.numpy() for name, signal in self.signals(env).items()}
        born = env.episode_length_buf.numpy() == 0
        files = self.policies[: env.num_envs]
        actions = np.zeros((env.num_envs, env.num_actions), np.float32)
        told = env.num_envs
        if self.network is not None:
            actions, told = env.graph.clip(self.network(env.observation)).numpy(), len(files)
        targets = np.zeros((told, env.model.nu), np.float32)
        for k, policy in enumerate(files):
            if born[k]:
                self.begin(env, k)
            outputs = policy.step({name: rows[k] for name, rows in signals.items()})
            actions[k], targets[k] = outputs["action"], outputs["joint_pos_target"]
        result = torch.from_numpy(actions)
        error = float((env.graph.target(env.measured, result)[:told] - torch.from_numpy(targets)).abs().max())
        if not error < 1e-3:
            raise Sim2realError(
                f"{self.path}: its targets are up to {error:.2g} rad off those of {self.settings} for the same actions,"
                " expected the same; it was made with other settings: export it again (sim2real export)"
            )
        return result


def graph_actor(graph: PolicyGraph) -> Actor:
    """The torch policy, on the environment's own observation."""
    return lambda env: graph.actor(env.observation)


def run_episodes(
    config: Basics,
    actor: Actor,
    script: np.ndarray,
    push: float = 0.0,
    seed: int = 0,
    command: tuple[float, float, float] | None = None,
    over: Over = unseen,
) -> Episodes:
    """One episode per row of ``script`` (episodes, ticks) of label indices, under randomisation that training never saw.

    ``push``: m/s, the largest of random pushes every ``config.push`` seconds; 0: none. ``command``: forward m/s, left
    m/s, turn rad/s for skills that walk; None: each robot its own, from the ranges of training.
    """
    config = dataclasses.replace(config, push_speed=(push, push), episode=script.shape[1] * config.period + 1.0)
    env = Env(config, UNSEEN + seed, script, level=1.0 if push else None)
    if command is not None:
        env.command[:] = torch.tensor(command)
    survived, moved, ticks = np.full(len(script), True), np.zeros((len(script), 2)), np.zeros((len(script), 1))
    errors = np.zeros((script.shape[1], len(script)))
    with torch.no_grad():
        for t in over(range(script.shape[1]), script.shape[1]):
            env.step(actor(env))
            survived &= ~env.failures
            moved += env.tick.velocity * survived[:, None]
            ticks += survived[:, None]
            errors[t] = np.abs(env.tick.joint_pos - env.tick.reference).mean(axis=-1)
    return Episodes(survived, errors.mean(axis=0), ticks[:, 0], moved / np.maximum(ticks, 1))


def skill_script(config: Basics, labels: int, episodes: int, seconds: float) -> np.ndarray:
    """(labels * episodes, ticks): ``episodes`` of each label, one label throughout."""
    return np.repeat(np.arange(labels), episodes)[:, None].repeat(round(seconds / config.period), axis=1)


def switch_script(config: Basics, labels: int, episodes: int) -> tuple[list[tuple[int, int]], np.ndarray]:
    """Every ordered pair of labels, and (pairs * episodes, ticks): 2 to 4 s of the first, then the second, 8 s in all."""
    pairs = list(itertools.permutations(range(labels), 2))
    ticks = round(8.0 / config.period)
    switch = np.random.default_rng(0).integers(ticks // 4, ticks // 2, len(pairs) * episodes)
    first, second = np.repeat(pairs, episodes, axis=0).T
    return pairs, np.where(np.arange(ticks) < switch[:, None], first[:, None], second[:, None])


def random_script(
    config: Basics, labels: int, episodes: int, seconds: float, every: float = 2.5, seed: int = 0
) -> np.ndarray:
    """(episodes, ticks): a random label every ``every`` seconds."""
    rng = np.random.default_rng(seed)
    block = round(every / config.period)
    blocks = int(np.ceil(seconds / config.period / block))
    return np.repeat(rng.integers(labels, size=(episodes, blocks)), block, axis=1)[:, : round(seconds / config.period)]


def quick_survival(config: Basics, graph: PolicyGraph) -> dict[str, float]:
    """The rates that training selects by: 10 s of random skills, without and with pushes up to 0.5 m/s; and, where robots go
    down to the floor, of those."""
    script = random_script(config, len(graph.labels), config.evaluate_envs, 10.0)
    calm, pushed = (run_episodes(config, graph_actor(graph), script, push) for push in (0.0, 0.5))
    low = {} if config.down == 0 else {"survival_down": down_survival(config, graph).value}
    return {
        "survival": calm.rate().value,
        "survival_pushed": pushed.rate().value,
        "joint_error": float(calm.error.mean()),
        **low,
    }


def down_survival(config: Basics, graph: PolicyGraph, seed: int = 0) -> Rate:
    """Of ``config.evaluate_envs`` robots that stand and for one episode go some way down to the floor and up, again and
    again."""
    config = dataclasses.replace(config, envs=config.evaluate_envs, down=1.0, home_start=1.0)
    env, act = Env(config, UNSEEN + seed, level=None), graph_actor(graph)
    env.episode_length_buf[:] = 0
    survived = np.full(env.num_envs, True)
    with torch.no_grad():
        for _ in range(env.max_episode_length - 1):
            env.step(act(env))
            survived &= ~env.failures
    return Rate(int(survived.sum()), len(survived))
