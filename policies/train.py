"""PPO (rsl_rl) on the training environment: resumable, self-evaluating, keeping the checkpoint that survives best."""

from __future__ import annotations

import contextlib
import dataclasses
import io
import json
import os
import subprocess
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import torch
from rsl_rl.algorithms import PPO
from rsl_rl.models import MLPModel
from rsl_rl.modules import MLP
from torch import nn

from policies.basics import Basics
from policies.env import Env
from policies.evaluate import quick_survival
from policies.gait import Stride
from policies.graph import PolicyGraph
from policies.mirror import Mirrored, Turn, action_mirror, observation_mirror
from sim2real.types import Sim2realError

Report = Callable[[dict[str, float]], None]


class Training:
    """One run in ``folder``: ``config.json``, ``curve.jsonl``, ``last.pt`` (resumes) and ``best.pt`` (survives best).

    Under torchrun every process simulates ``config.envs`` robots of its own and the gradients are averaged (gloo).
    """

    def __init__(self, config: Basics, folder: Path) -> None:
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
        if self.rank == 0:
            self.folder.mkdir(parents=True, exist_ok=True)
            (self.folder / "config.json").write_text(json.dumps(self._provenance(), indent=1))
        while self.samples < self.config.samples:
            row = self.step()
            if self.iteration % self.config.evaluate_every == 0 and self.rank == 0:
                row |= quick_survival(self.config, self.graph())
                score = (row["survival"] + row["survival_pushed"]) / 2
                if score >= self.best:
                    self.best = score
                    self._save("best.pt")
            if self.rank == 0:
                with (self.folder / "curve.jsonl").open("a") as file:
                    file.write(json.dumps(row) + "\n")
                report(row)
            if self.iteration % self.config.save_every == 0 or self.samples >= self.config.samples:
                if self.rank == 0:
                    self._save("last.pt")
                self.env.reset()  # what a resumed run does too, so both continue alike

    def step(self) -> dict[str, float]:
        """One iteration: collect ``horizon`` ticks, update. Returns a row of the curve."""
        config, ppo, env = self.config, self.ppo, self.env
        ppo.train_mode()
        total, survived, fell = 0.0, 0, 0
        with torch.no_grad():
            observations = env.get_observations()
            for _ in range(config.horizon):
                observations, rewards, dones, extras = env.step(ppo.act(observations))
                # Scaled so that the value of an undisturbed state is about 1.
                ppo.process_env_step(observations, (1 - config.gamma) * rewards, dones, extras)
                total += float(rewards.mean())
                survived += int(extras["time_outs"].sum())
                fell += int(env.failures.sum())
            ppo.compute_returns(observations)
        losses = ppo.update()
        self.iteration += 1
        self.samples += config.horizon * env.num_envs * self.world
        return {
            "iteration": self.iteration,
            "samples": self.samples,
            "reward": total / config.horizon,
            "fell": fell,
            "survived": survived,
            "level": env.level or 0.0,
            "std": float(ppo.actor.output_std.detach().mean()),
            "learning_rate": ppo.learning_rate,
            **{f"loss_{k}": float(v) for k, v in losses.items()},
        }

    def graph(self) -> PolicyGraph:
        """The policy graph with the networks as they are now."""
        graph = PolicyGraph(self.config)
        graph.actor, graph.critic = networks(self.ppo)
        return graph.eval()

    def resume(self) -> bool:
        """Continue from ``last.pt`` if there is one; then everything goes on as if it had never stopped."""
        path = self.folder / "last.pt"
        if not path.is_file():
            return False
        state = torch.load(path, weights_only=True)
        self.ppo.load(state["ppo"], None, strict=True)
        self.iteration, self.samples, self.best = state["iteration"], state["samples"], state["best"]
        self.env.load_state_dict(state["env"])
        torch.set_rng_state(state["torch_rng"])
        if self.rank > 0:  # the checkpoint holds the first process's dice: the others get their own
            torch.manual_seed(self.config.seed + self.rank + self.iteration)
            self.env.rng = np.random.default_rng([self.config.seed, self.rank, self.iteration])
            self.env.reset()
        if self.rank == 0:  # what came after the checkpoint never happened
            curve = self.folder / "curve.jsonl"
            lines = curve.read_text().splitlines(keepends=True) if curve.is_file() else []
            curve.write_text("".join(x for x in lines if json.loads(x)["iteration"] <= self.iteration))
        return True

    def start_from(self, checkpoint: Path) -> None:
        """Take the networks and the optimiser of another run; samples and curve begin at zero. Raises Sim2realError."""
        try:
            self.ppo.load(torch.load(checkpoint, weights_only=True)["ppo"], None, strict=True)
        except Exception as error:  # torch has no common base for what a wrong file raises
            reason = str(error).splitlines()[0]
            raise Sim2realError(
                f"{checkpoint}: {reason}; expected a checkpoint of this network (best.pt, last.pt)"
            ) from None

    def _save(self, name: str) -> None:
        state = {
            "config": dataclasses.asdict(self.config),
            "ppo": self.ppo.save(),
            "iteration": self.iteration,
            "samples": self.samples,
            "best": self.best,
            "env": self.env.state_dict(),
            "torch_rng": torch.get_rng_state(),
        }
        torch.save(state, self.folder / f"{name}.part")
        os.replace(self.folder / f"{name}.part", self.folder / name)

    def _provenance(self) -> dict:
        tools = ("mujoco", "torch", "rsl-rl-lib", "numpy")
        return {
            "config": dataclasses.asdict(self.config),
            "world": self.world,
            "revision": git_revision(),
            "tools": {name: version(name) for name in tools},
        }


class MirroredModel(MLPModel):
    """rsl_rl's network, made symmetric."""

    def __init__(self, *args: Any, observation_mirror: Turn, output_mirror: Turn, **settings: Any) -> None:
        super().__init__(*args, **settings)
        self.mlp = Mirrored(self.mlp, observation_mirror, output_mirror)


def make_ppo(config: Basics, env: Env, rank: int = 0, world: int = 1) -> PPO:
    """rsl_rl's PPO with one observation for actor and critic (the exported critic sees what the actor sees)."""
    network = {"class_name": MirroredModel, "hidden_dims": list(config.hidden), "activation": "elu",
               "observation_mirror": observation_mirror(env.graph)}  # fmt: skip
    settings = {
        "num_steps_per_env": config.horizon,
        "obs_groups": {"actor": ["policy"], "critic": ["policy"]},
        "actor": {
            **network,
            "output_mirror": action_mirror(env.graph),
            "distribution_cfg": {"class_name": "GaussianDistribution", "init_std": config.std, "std_type": "scalar"},
        },
        "critic": {**network, "output_mirror": ([0], [1.0])},
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
        last.weight.mul_(0.01)  # start at the reference pose
        last.bias.zero_()
    return ppo


def networks(ppo: PPO) -> tuple[nn.Module, nn.Module]:
    """Actor and critic as plain modules from observation to mean action and to value."""
    return ppo.actor.mlp, ppo.critic.mlp


def load_graph(folder: Path, name: str = "best.pt") -> PolicyGraph:
    """The policy graph of a finished or running training. Raises Sim2realError."""
    return graph_of(folder / name)


def graph_of(checkpoint: Path) -> PolicyGraph:
    """The policy graph in a checkpoint, with its networks. Raises Sim2realError."""
    if not checkpoint.is_file():
        raise Sim2realError(f"{checkpoint}: no such checkpoint; train first: sim2real train g1-basics")
    state = torch.load(checkpoint, weights_only=True)
    graph = PolicyGraph(config_of(state.get("config", {}), checkpoint))
    size, mirror = graph.outputs()["observation"][0], observation_mirror(graph)
    for part, outputs, turn in (("actor", len(graph.driven), action_mirror(graph)), ("critic", 1, ([0], [1.0]))):
        network = Mirrored(MLP(size, outputs, list(graph.config.hidden), "elu"), mirror, turn)
        weights = state["ppo"][f"{part}_state_dict"]
        network.load_state_dict({k.removeprefix("mlp."): v for k, v in weights.items() if k.startswith("mlp.")})
        setattr(graph, part, network)
    return graph.eval()


def load_config(folder: Path) -> Basics:
    """The settings written beside a run's checkpoints. Raises Sim2realError if they are of another version."""
    return config_of(json.loads((folder / "config.json").read_text())["config"], folder / "config.json")


def config_of(document: dict[str, Any], where: Path) -> Basics:
    """Settings as they were written to ``where``. Raises Sim2realError if they are of another version."""
    try:
        settings: dict[str, Any] = {k: tuple(v) if isinstance(v, list) else v for k, v in document.items()}
        return Basics(**{**settings, "stride": Stride(**settings["stride"])})
    except (TypeError, KeyError) as error:
        raise Sim2realError(
            f"{where}: its settings are not those of policies/basics.py ({error}); check out the revision that made it,"
            " or train anew in another folder"
        ) from None


def git_revision() -> str:
    """The commit of the working tree, with ``+`` if it has changes; empty outside a repository."""
    root = Path(__file__).resolve().parents[1]
    run = lambda *a: subprocess.run(["git", *a], cwd=root, capture_output=True, text=True).stdout.strip()  # noqa: E731
    with contextlib.suppress(OSError):
        return run("rev-parse", "HEAD") + ("+" if run("status", "--porcelain", "--", "policies", "configs") else "")
    return ""


def train_command(folder: Path, start: Path | None = None, **settings: float) -> None:
    """``sim2real train``: a progress line with the time left, and what the run came to."""
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

    config = load_config(folder) if (folder / "config.json").is_file() else Basics()
    training = Training(dataclasses.replace(config, **settings), folder)  # type: ignore[arg-type]
    resumed = training.resume()
    if start is not None and not resumed:
        training.start_from(start)
    console = Console()
    console.print(
        f"{'resuming' if resumed else 'training'} in {folder}: {training.env.num_envs} robots, "
        f"{training.samples / 1e6:.1f} of {training.config.samples / 1e6:.1f} M samples done"
    )
    columns = (TextColumn("{task.percentage:5.1f} %"), BarColumn(), TimeElapsedColumn(), TextColumn("left"),
               TimeRemainingColumn(elapsed_when_finished=True), TextColumn("{task.description}"))  # fmt: skip
    with Progress(*columns, console=console) as progress:
        bar = progress.add_task("", total=training.config.samples, completed=training.samples)

        def report(row: dict[str, float]) -> None:
            text = f"reward {row['reward']:.2f}  fell {row['fell']}  push level {row['level']:.2f}"
            progress.update(bar, completed=row["samples"], description=text)
            if "survival" in row:
                console.print(
                    f"{row['samples'] / 1e6:6.2f} M samples: {row['survival']:.0%} survive 10 s, "
                    f"{row['survival_pushed']:.0%} with pushes to 0.5 m/s"
                )

        training.run(report)
    console.print(
        f"best: {training.best:.1%} mean survival, {folder / 'best.pt'}; next: sim2real train g1-basics --folder {folder} --export FILE.onnx"
    )
