"""Training ball skills: ``sim2real train g1-ball``."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch
from rsl_rl.algorithms import PPO
from rsl_rl.modules import MLP

from policies import training
from policies.skillmimic.config import SkillMimic
from policies.skillmimic.env import Env
from policies.skillmimic.evaluate import evaluate
from policies.skillmimic.graph import PolicyGraph


class SkillTraining(training.Training):
    """The actor sees what a robot has, the critic the truth as well; ``best.pt`` is the most successful, not the best
    rewarded."""

    def make(self, seed: int) -> tuple[Env, PPO]:
        env = Env(self.config, seed)
        sees = {"actor": ["policy"], "critic": ["policy", "privileged"]}
        return env, training.make_ppo(self.config, env, {}, {}, sees, self.config.lasts)

    def step(self) -> dict[str, float]:
        """With the mean of every sub-reward at the iteration's last tick."""
        row = super().step()
        if self.env.discriminator is not None:
            row |= self.env.discriminator.learn()
        return row | {f"reward_{name}": float(term.mean()) for name, term in self.env.terms.items()}

    def evaluate(self) -> dict[str, float]:
        """The mean over skills, and each of them."""
        config = self.config
        results = evaluate(
            self.graph(), config.evaluate_envs, config.evaluate_seconds, config.practise, push=config.push_speed
        )
        mean = lambda name: sum(getattr(r, name) for r in results.values()) / len(results)  # noqa: E731
        success = {skill: r.success.value for skill, r in results.items()}
        return {
            "score": sum(success.values()) / len(success),
            **{name: mean(name) for name in ("accuracy", "body_error", "ball_error", "contact_error")},
            **{f"success_{skill}": value for skill, value in success.items()},
        }

    def start_from(self, checkpoint: Path) -> None:
        """With the noise of a start."""
        super().start_from(checkpoint)
        with torch.no_grad():
            self.ppo.actor.distribution.std_param.fill_(self.config.std)

    def graph(self) -> PolicyGraph:
        graph = self.env.graph
        graph.actor = self.beside_physics(self.ppo.actor.mlp)
        return graph.eval()


def load_graph(folder: Path, name: str = "best.pt") -> PolicyGraph:
    """The policy graph of a finished or running training. Raises Sim2realError."""
    state, config = training.read_checkpoint(folder / name, skills)
    graph = PolicyGraph(config)
    graph.actor = MLP(graph.outputs()["observation"][0], len(graph.acting), list(config.hidden), "elu")
    graph.actor.load_state_dict(training.weights(state, "actor"))
    return graph.eval()


def skills(document: dict[str, Any]) -> SkillMimic:
    """Settings as ``dataclasses.asdict`` gave them."""
    return SkillMimic(**document)


def load_config(folder: Path) -> SkillMimic:
    """The settings written beside a run's checkpoints. Raises Sim2realError if they are of another version."""
    return training.read_config(folder, skills)
