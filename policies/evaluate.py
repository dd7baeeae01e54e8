"""How often a policy stays up: per skill, pushed or not, and over every ordered switch."""

from __future__ import annotations

import dataclasses
from typing import NamedTuple

import numpy as np
import torch

from policies.basics import Basics
from policies.env import Env
from policies.graph import PolicyGraph

UNSEEN = 900_000  # seeds from here on are never trained on


class Episodes(NamedTuple):
    """What became of scripted episodes."""

    survived: np.ndarray  # (episodes,) bool
    error: np.ndarray  # (episodes,) rad, mean distance of the joints from their reference


def run_episodes(config: Basics, graph: PolicyGraph, script: np.ndarray, push: float = 0.0, seed: int = 0) -> Episodes:
    """One episode per row of ``script`` (episodes, ticks) of label indices, under randomisation that training never saw.

    ``push``: m/s, the largest of random pushes every ``config.push`` seconds; 0: none.
    """
    config = dataclasses.replace(config, push_speed=(push, push), episode=script.shape[1] * config.period + 1.0)
    env = Env(config, UNSEEN + seed, script, level=1.0 if push else None)
    survived = np.full(len(script), True)
    errors = np.zeros((script.shape[1], len(script)))
    with torch.no_grad():
        for t in range(script.shape[1]):
            env.step(graph.actor(env.observation))
            survived &= ~env.failures
            errors[t] = np.abs(env.tick.joint_pos - env.tick.reference).mean(axis=-1)
    return Episodes(survived, errors.mean(axis=0))


def random_script(
    config: Basics, labels: int, episodes: int, seconds: float, every: float = 2.5, seed: int = 0
) -> np.ndarray:
    """(episodes, ticks): a random label every ``every`` seconds."""
    rng = np.random.default_rng(seed)
    block = round(every / config.period)
    blocks = int(np.ceil(seconds / config.period / block))
    return np.repeat(rng.integers(labels, size=(episodes, blocks)), block, axis=1)[:, : round(seconds / config.period)]


def quick_survival(config: Basics, graph: PolicyGraph) -> dict[str, float]:
    """The two rates that training selects by: 10 s of random skills, without and with pushes up to 0.5 m/s."""
    script = random_script(config, len(graph.labels), config.evaluate_envs, 10.0)
    calm, pushed = (run_episodes(config, graph, script, push) for push in (0.0, 0.5))
    return {
        "survival": float(calm.survived.mean()),
        "survival_pushed": float(pushed.survived.mean()),
        "joint_error": float(calm.error.mean()),
    }
