"""Training the basics, and the command that trains any task."""

from __future__ import annotations

import dataclasses
import os
from pathlib import Path
from typing import Any

import torch
from rsl_rl.algorithms import PPO
from rsl_rl.models import MLPModel
from rsl_rl.modules import MLP
from torch import nn

from policies import training
from policies.basics import TASKS, Basics
from policies.env import Env
from policies.evaluate import quick_survival
from policies.gait import Stride
from policies.graph import PolicyGraph
from policies.mirror import Mirrored, Turn, action_mirror, observation_mirror
from sim2real.types import Sim2realError


class Training(training.Training):
    """Basics: one observation for actor and critic (the exported critic sees what the actor sees), both symmetric."""

    def make(self, seed: int) -> tuple[Env, PPO]:
        env = Env(self.config, seed)
        return env, make_ppo(self.config, env)

    def graph(self) -> PolicyGraph:
        graph = PolicyGraph(self.config)
        graph.actor, graph.critic = (self.beside_physics(network) for network in networks(self.ppo))
        return graph.eval()

    def evaluate(self) -> dict[str, float]:
        row = quick_survival(self.config, self.graph())
        shares = [share for name, share in row.items() if name.startswith("survival")]
        return row | {"score": sum(shares) / len(shares)}

    def start_from(self, checkpoint: Path) -> None:
        super().start_from(checkpoint)
        with torch.no_grad():
            self.ppo.actor.distribution.std_param.clamp_(min=self.config.std_again)


class MirroredModel(MLPModel):
    """rsl_rl's network, made symmetric."""

    def __init__(self, *args: Any, observation_mirror: Turn, output_mirror: Turn, **settings: Any) -> None:
        super().__init__(*args, **settings)
        self.mlp = Mirrored(self.mlp, observation_mirror, output_mirror)


def make_ppo(config: Basics, env: Env) -> PPO:
    """rsl_rl's PPO with symmetric networks."""
    network = {"class_name": MirroredModel, "observation_mirror": observation_mirror(env.graph)}
    actor = {**network, "output_mirror": action_mirror(env.graph)}
    critic = {**network, "output_mirror": ([0], [1.0])}
    return training.make_ppo(config, env, actor, critic, {"actor": ["policy"], "critic": ["policy"]})


def networks(ppo: PPO) -> tuple[nn.Module, nn.Module]:
    """Actor and critic as plain modules from observation to mean action and to value."""
    return ppo.actor.mlp, ppo.critic.mlp


def load_graph(folder: Path, name: str = "best.pt") -> PolicyGraph:
    """The policy graph of a finished or running training. Raises Sim2realError."""
    return graph_of(folder / name)


def graph_of(checkpoint: Path) -> PolicyGraph:
    """The policy graph in a checkpoint, with its networks. Raises Sim2realError."""
    state, config = training.read_checkpoint(checkpoint, basics)
    graph = PolicyGraph(config)
    size, mirror = graph.outputs()["observation"][0], observation_mirror(graph)
    for part, outputs, turn in (("actor", len(graph.driven), action_mirror(graph)), ("critic", 1, ([0], [1.0]))):
        network = Mirrored(MLP(size, outputs, list(config.hidden), "elu"), mirror, turn)
        network.load_state_dict(training.weights(state, part))
        setattr(graph, part, network)
    return graph.eval()


def basics(document: dict[str, Any]) -> Basics:
    """Settings as ``dataclasses.asdict`` gave them."""
    stride = {k: tuple(v) if isinstance(v, list) else v for k, v in document["stride"].items()}
    return Basics(**{**document, "stride": Stride(**stride)})


def load_config(folder: Path) -> Basics:
    """The settings written beside a run's checkpoints. Raises Sim2realError if they are of another version."""
    return training.read_config(folder, basics)


def tasks() -> dict[str, tuple[Any, Any, Any]]:
    """Every task by name: its settings, its kind of training, and what reads such settings back."""
    from policies.skillmimic import config
    from policies.skillmimic.train import SkillTraining, skills

    ball = {name: (c, SkillTraining, skills) for name, c in config.TASKS.items()}
    return {name: (c, Training, basics) for name, c in TASKS.items()} | ball


def own_cores() -> int:
    """How many cores there are for each of the processes that torchrun began here, or for this one."""
    return max(1, len(os.sched_getaffinity(0)) // int(os.environ.get("LOCAL_WORLD_SIZE", 1)))


def train_command(task: str, folder: Path, start: Path | None = None, **settings: Any) -> None:
    """``sim2real train``: a progress line with the time left, and what the run came to. Raises Sim2realError."""
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

    known = tasks()
    if task not in known:
        raise Sim2realError(f"task: got '{task}', expected one of {', '.join(known)}")
    config, kind, reader = known[task]
    if (folder / "config.json").is_file():
        config = training.read_config(folder, reader, task)
    settings.setdefault("threads", own_cores())
    if strangers := sorted(set(settings) - {f.name for f in dataclasses.fields(config)}):
        raise Sim2realError(f"--{strangers[0]}: task '{task}' has no such setting")
    run = kind(dataclasses.replace(config, **settings), folder)
    run.task = task
    resumed = run.resume()
    if start is not None and not resumed:
        run.start_from(start)
    console = Console(quiet=run.rank > 0)  # of several processes one tells
    console.print(
        f"{'resuming' if resumed else 'training'} in {folder}: {run.env.num_envs} robots, "
        f"{run.samples / 1e6:.1f} of {run.config.samples / 1e6:.1f} M samples done"
    )
    columns = (TextColumn("{task.percentage:5.1f} %"), BarColumn(), TimeElapsedColumn(), TextColumn("left"),
               TimeRemainingColumn(elapsed_when_finished=True), TextColumn("{task.description}"))  # fmt: skip
    with Progress(*columns, console=console) as progress:
        bar = progress.add_task("", total=run.config.samples, completed=run.samples)

        def report(row: dict[str, float]) -> None:
            text = f"reward {row['reward']:.2f}  fell {row['fell']}  level {row['level']:.2f}"
            progress.update(bar, completed=row["samples"], description=text)
            if "score" in row:
                shares = {k: v for k, v in row.items() if k.startswith(("survival", "success"))}
                each = ", ".join(f"{k.replace('_', ' ')} {v:.0%}" for k, v in shares.items())
                console.print(f"{row['samples'] / 1e6:6.2f} M samples: {each}")

        run.run(report)
    if run.best >= 0:
        console.print(f"best: {run.best:.1%}, {folder / 'best.pt'}; next: sim2real export {folder} -o FILE.onnx")
    else:
        console.print(
            f"never evaluated, which happens every {run.config.evaluate_every} iterations: no {folder / 'best.pt'};"
            f" next: give it more --samples, it goes on from {folder / 'last.pt'}"
        )
