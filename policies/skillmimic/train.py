"""A SkillMimic run: ``python -m policies.skillmimic.train g1-hold``. Resumes by itself; see ``policies.train.Training``."""

from __future__ import annotations

import contextlib
import dataclasses
import io
import json
import os
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import torch
import tyro
from rsl_rl.algorithms import PPO
from torch import nn

from policies.skillmimic.config import TASKS, SkillMimic
from policies.skillmimic.env import Env
from policies.skillmimic.evaluate import evaluate
from policies.skillmimic.graph import PolicyGraph
from policies.train import Report, Training
from sim2real.types import Sim2realError


class SkillTraining(Training):
    """As the basics are trained, with a critic that sees everything; ``best.pt`` is the most successful, not the best
    rewarded."""

    config: SkillMimic  # type: ignore[assignment]
    env: Env  # type: ignore[assignment]

    def __init__(self, config: SkillMimic, folder: Path) -> None:
        self.config, self.folder = config, folder
        self.rank, self.world = int(os.environ.get("RANK", 0)), int(os.environ.get("WORLD_SIZE", 1))
        torch.set_num_threads(1)
        torch.manual_seed(config.seed + self.rank)
        if self.world > 1:
            torch.distributed.init_process_group("gloo")
        self.env = Env(config, config.seed + 1000 * self.rank)
        self.ppo = make_ppo(config, self.env, self.rank, self.world)
        if self.world > 1:
            self.ppo.broadcast_parameters()
        self.iteration, self.samples, self.best = 0, 0, -1.0

    def run(self, report: Report = lambda row: None) -> None:
        """Until ``config.samples`` have been seen. ``report(row)`` after each iteration."""
        config, first = self.config, self.rank == 0
        if first:
            self.folder.mkdir(parents=True, exist_ok=True)
            (self.folder / "config.json").write_text(json.dumps(self._provenance(), indent=1))
        while self.samples < config.samples:
            row = self.step()
            if first and self.iteration % config.evaluate_every == 0:
                row |= self.evaluate()
                if row["success"] >= self.best:
                    self.best = row["success"]
                    self._save("best.pt")
            if first:
                with (self.folder / "curve.jsonl").open("a") as file:
                    file.write(json.dumps(row) + "\n")
                report(row)
            if self.iteration % config.save_every == 0 or self.samples >= config.samples:
                if first:
                    self._save("last.pt")
                self.env.reset()  # what a resumed run does too, so both continue alike

    def step(self) -> dict[str, float]:
        """One iteration; with it the mean of every sub-reward at its last tick."""
        row = super().step()
        if self.env.discriminator is not None:
            row |= self.env.discriminator.learn()
        return row | {f"reward_{name}": float(term.mean()) for name, term in self.env.terms.items()}

    def evaluate(self) -> dict[str, float]:
        """What training selects by: the mean over skills, and each of them."""
        config = self.config
        results = evaluate(self.graph(), config.evaluate_envs, config.evaluate_seconds, push=config.push_speed)
        mean = lambda name: sum(getattr(r, name) for r in results.values()) / len(results)  # noqa: E731
        return {
            "success": sum(r.success.value for r in results.values()) / len(results),
            **{name: mean(name) for name in ("accuracy", "body_error", "ball_error", "contact_error")},
            **{f"success_{skill}": r.success.value for skill, r in results.items()},
        }

    def graph(self) -> PolicyGraph:  # type: ignore[override]
        """The policy graph with the actor as it is now."""
        graph = self.env.graph
        graph.actor = self.ppo.actor.mlp
        return graph.eval()


def make_ppo(config: SkillMimic, env: Env, rank: int = 0, world: int = 1) -> PPO:
    """rsl_rl's PPO: the actor sees what a robot has, the critic the truth as well."""
    network = {"class_name": "MLPModel", "hidden_dims": list(config.hidden), "activation": "elu"}
    settings = {
        "num_steps_per_env": config.horizon,
        "obs_groups": {"actor": ["policy"], "critic": ["policy", "privileged"]},
        "actor": {
            **network,
            "distribution_cfg": {"class_name": "GaussianDistribution", "init_std": config.std, "std_type": "scalar"},
        },
        "critic": dict(network),
        "algorithm": {
            "class_name": "PPO",
            "gamma": config.gamma,
            "learning_rate": config.learning_rate,
            **config.ppo,
        },
        "multi_gpu": {"global_rank": rank, "local_rank": rank, "world_size": world} if world > 1 else None,
    }
    with contextlib.redirect_stdout(io.StringIO()):  # rsl_rl prints the networks
        ppo: PPO = PPO.construct_algorithm(env.get_observations(), env, settings, "cpu")
    with torch.no_grad():
        last = [m for m in ppo.actor.mlp.modules() if isinstance(m, nn.Linear)][-1]
        last.weight.mul_(0.01)  # start at the posture
        last.bias.zero_()
    return ppo


def load_config(folder: Path) -> SkillMimic:
    """The settings written beside a run's checkpoints. Raises Sim2realError."""
    path = folder / "config.json"
    document = json.loads(path.read_text())["config"]
    known = {f.name for f in dataclasses.fields(SkillMimic)}
    if strangers := sorted(set(document) - known):
        raise Sim2realError(f"{path}: unknown settings {', '.join(strangers)}; the run was made by another version")
    settings: dict[str, Any] = {k: tuple(v) if isinstance(v, list) else v for k, v in document.items()}
    return SkillMimic(**settings)


def load_graph(folder: Path, name: str = "best.pt") -> PolicyGraph:
    """The policy graph of a finished or running training. Raises Sim2realError."""
    if not (folder / name).is_file():
        raise Sim2realError(f"{folder / name}: no such checkpoint; train first: python -m policies.skillmimic.train")
    training = SkillTraining(dataclasses.replace(load_config(folder), envs=1), folder)
    training.ppo.load(torch.load(folder / name, weights_only=True)["ppo"], {"actor": True, "critic": True}, strict=True)
    return training.graph()


@dataclass(frozen=True)
class Args:
    """Train ball skills: config, curve and checkpoints go to a folder, from which a second call resumes."""

    task: tyro.conf.Positional[str]
    """which of policies.skillmimic.config.TASKS"""
    folder: Path | None = None
    """where the run lives; default: runs/<task>"""
    variant: Literal["skillmimic", "no_cgr", "no_multiplication", "deepmimic", "amp"] | None = None
    """of the reward"""
    samples: float | None = None
    """policy ticks to learn from, over all robots"""
    envs: int | None = None
    """robots simulated at once"""
    threads: int | None = None
    """threads of the physics"""
    seed: int | None = None
    """of everything random"""


def main(argv: list[str]) -> int:
    """See Args."""
    args = tyro.cli(Args, args=argv, prog="python -m policies.skillmimic.train")
    if args.task not in TASKS:
        raise Sim2realError(f"task: got '{args.task}', expected one of {', '.join(TASKS)}")
    folder = args.folder or Path("runs") / args.task
    given: dict[str, Any] = {k: getattr(args, k) for k in ("variant", "samples", "envs", "threads", "seed")}
    config = load_config(folder) if (folder / "config.json").is_file() else TASKS[args.task]
    config = dataclasses.replace(config, **{k: v for k, v in given.items() if v is not None})
    if config.variant == "deepmimic":
        config = dataclasses.replace(config, sensitivity="deepmimic")
    training = SkillTraining(config, folder)
    print("resuming" if training.resume() else "training", f"in {folder} at {training.samples / 1e6:.2f} M samples")

    def report(row: dict[str, float]) -> None:
        line = f"{row['samples'] / 1e6:7.3f} M  reward {row['reward']:.3f}  failed {row['fell']:.0f}"
        if "success" in row:
            each = ", ".join(
                f"{k.removeprefix('success_')} {v:.0%}" for k, v in row.items() if k.startswith("success_")
            )
            line += f"  success {row['success']:.0%} ({each})  accuracy {row['accuracy']:.0%}"
        print(line, flush=True)

    training.run(report)
    return 0


if __name__ == "__main__":
    try:
        sys.exit(main(sys.argv[1:]))
    except Sim2realError as error:
        sys.exit(str(error))
