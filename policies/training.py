"""PPO (rsl_rl) on a vectorised environment: resumable, self-evaluating, keeping the checkpoint that scores best."""

from __future__ import annotations

import contextlib
import copy
import dataclasses
import io
import json
import math
import os
import subprocess
import time
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import torch
from rsl_rl.algorithms import PPO
from rsl_rl.modules.distribution import GaussianDistribution
from torch import nn

from sim2real.types import Sim2realError

Report = Callable[[dict[str, float]], None]


class Training:
    """One run in ``folder``: ``config.json``, ``curve.jsonl``, ``last.pt`` (resumes) and ``best.pt`` (scores best).

    A kind of task says how its environment and networks are made (``make``), what its policy graph is (``graph``) and how
    good that is (``evaluate``). Under torchrun every process simulates ``config.envs`` robots of its own and the
    gradients are averaged (gloo). The physics are the CPU's, the learner is where ``config.device`` says. Raises Sim2realError
    where there is none.
    """

    task = ""  # whose run this is, by name

    def __init__(self, config: Any, folder: Path) -> None:
        self.config, self.folder = config, folder
        self.rank, self.world = int(os.environ.get("RANK", 0)), int(os.environ.get("WORLD_SIZE", 1))
        self.device = learner_device(config.device)
        torch.set_num_threads(1)
        torch.manual_seed(config.seed + self.rank)
        if self.world > 1:
            torch.distributed.init_process_group("gloo")
        self.env, self.ppo = self.make(config.seed + 1000 * self.rank)
        if self.world > 1:
            self.ppo.broadcast_parameters()
        self.iteration, self.samples, self.best = 0, 0, -1.0

    def make(self, seed: int) -> tuple[Any, PPO]:
        """The environment, and the learner on it."""
        raise NotImplementedError

    def graph(self) -> Any:
        """The policy graph with the networks as they are now."""
        raise NotImplementedError

    def evaluate(self) -> dict[str, float]:
        """What training selects by, as ``score``, and whatever else belongs into the curve."""
        raise NotImplementedError

    def beside_physics(self, network: nn.Module) -> nn.Module:
        """``network`` itself, or its copy where the learner is elsewhere."""
        return network if self.device.type == "cpu" else copy.deepcopy(network).cpu()

    def run(self, report: Report = lambda row: None) -> None:
        """Until ``config.samples`` have been seen. ``report(row)`` after each iteration."""
        config, first = self.config, self.rank == 0
        if first:
            self.folder.mkdir(parents=True, exist_ok=True)
            (self.folder / "config.json").write_text(json.dumps(self._provenance(), indent=1))
        while self.samples < config.samples:
            began = time.process_time()
            row = self.step()
            if first and self.iteration % config.evaluate_every == 0:
                row |= self.evaluate()
                if row["score"] >= self.best:
                    self.best = row["score"]
                    self._save("best.pt")
            if first:
                row["cpu"] = self.world * (time.process_time() - began)  # s, of all threads of all processes
                with (self.folder / "curve.jsonl").open("a") as file:
                    file.write(json.dumps(row) + "\n")
                report(row)
            if self.iteration % config.save_every == 0 or self.samples >= config.samples:
                if first:
                    self._save("last.pt")
                self.env.reset()  # what a resumed run does too, so both continue alike

    def step(self) -> dict[str, float]:
        """One iteration: collect ``horizon`` ticks, update. Returns a row of the curve."""
        config, ppo, env, device = self.config, self.ppo, self.env, self.device
        ppo.train_mode()
        ppo.actor.distribution.forget()  # what rsl_rl's last update drew
        total, survived, fell = 0.0, 0, 0
        with torch.no_grad():
            observations = env.get_observations().to(device)
            for _ in range(config.horizon):
                seen, rewards, dones, extras = env.step(ppo.act(observations).cpu())
                observations = seen.to(device)
                # Scaled so that the value of an undisturbed state is about 1.
                scaled = (1 - config.gamma) * rewards
                ppo.process_env_step(observations, scaled.to(device), dones.to(device), extras)
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

    def resume(self) -> bool:
        """Continue from ``last.pt`` if there is one; then everything goes on as if it had never stopped."""
        path = self.folder / "last.pt"
        if not path.is_file():
            return False
        state = load(path, f"go on from another with --start in another --folder, or delete {path.name} to begin anew")
        self.ppo.load(state["ppo"], None, strict=True)
        self.iteration, self.samples, self.best = state["iteration"], state["samples"], state["best"]
        self.env.load_state_dict(state["env"])
        torch.set_rng_state(state["torch_rng"])
        if self.device.type == "cuda" and len(dice := state.get("cuda_rng", ())):
            torch.cuda.set_rng_state(dice, self.device)
        if self.rank > 0:  # the checkpoint holds the first process's dice: the others get their own
            torch.manual_seed(self.config.seed + self.rank + self.iteration)
            self.env.rng = np.random.default_rng([self.config.seed, self.rank, self.iteration])
            self.env.reset()
        if self.rank == 0:  # what came after the checkpoint never happened
            curve = self.folder / "curve.jsonl"
            lines = curve.read_text().splitlines(keepends=True) if curve.is_file() else []
            curve.write_text("".join(x for x in lines if 0 < _iteration(x) <= self.iteration))
        return True

    def start_from(self, checkpoint: Path) -> None:
        """Take the networks and the optimiser of another run; samples and curve begin at zero. Raises Sim2realError."""
        state = load(checkpoint, "name another with --start")
        try:
            self.ppo.load(state["ppo"], None, strict=True)
        except Exception as error:  # torch has no common base for what a wrong file raises
            raise Sim2realError(
                f"{checkpoint}: {_reason(error)}; expected a checkpoint of this network (best.pt, last.pt)"
            ) from None
        for group in self.ppo.optimizer.param_groups:  # the other run's came with its optimiser
            group["lr"] = self.config.learning_rate
        self.ppo.learning_rate = self.config.learning_rate

    def _save(self, name: str) -> None:
        state = {
            "config": dataclasses.asdict(self.config),
            "ppo": self.ppo.save(),
            "iteration": self.iteration,
            "samples": self.samples,
            "best": self.best,
            "env": self.env.state_dict(),
            "torch_rng": torch.get_rng_state(),
            "cuda_rng": torch.cuda.get_rng_state(self.device) if self.device.type == "cuda" else torch.empty(0),
        }
        torch.save(state, self.folder / f"{name}.part")
        os.replace(self.folder / f"{name}.part", self.folder / name)

    def _provenance(self) -> dict:
        tools = ("mujoco", "torch", "rsl-rl-lib", "numpy")
        return {
            "task": self.task,
            "config": dataclasses.asdict(self.config),
            "world": self.world,
            "revision": git_revision(),
            "tools": {name: version(name) for name in tools},
        }


def learner_device(name: str) -> torch.device:
    """Where the learner of this process is: ``name``, and of several GPUs each process under torchrun has its own. Raises
    Sim2realError."""
    if name == "cpu":
        return torch.device(name)
    if name != "cuda" or not torch.cuda.is_available():
        found = f"torch {torch.__version__} finds no GPU" if name == "cuda" else "no such device"
        raise Sim2realError(
            f"device: got '{name}', but {found}; expected 'cpu', or 'cuda' with a torch and a driver for it"
        )
    return torch.device(name, int(os.environ.get("LOCAL_RANK", 0)) % torch.cuda.device_count())


class LastingNoise(GaussianDistribution):
    """Of what an action was off by, ``lasts`` is still there a tick later, within an iteration; each tick's actions are
    distributed as ever, which is what PPO reckons with.

    Noise that is drawn anew every tick hardly moves an arm, so its rewards tell little of what the arm might have done
    otherwise (correlated noise in PPO: Hollenstein, Martius and Piater, AAAI 2024). Noise that lasts is not learned but
    stays as large as it is: PPO would shrink it, since it costs reward, and with it what the rewards tell.
    """

    def __init__(self, output_dim: int, lasts: float, **settings: Any) -> None:
        super().__init__(output_dim, learn_std=lasts == 0, **settings)
        self._lasts, self._off = lasts, torch.zeros(0)

    def forget(self) -> None:
        """What comes next has nothing to do with what was."""
        self._off = torch.zeros(0)

    def sample(self) -> torch.Tensor:
        fresh = torch.randn_like(self.mean)
        known = self._off.shape == fresh.shape  # an update draws too, for as many as are in its batch
        self._off = self._lasts * self._off + math.sqrt(1 - self._lasts**2) * fresh if known else fresh
        return self.mean + self.std * self._off


def make_ppo(config: Any, env: Any, actor: dict, critic: dict, sees: dict[str, list[str]], lasts: float = 0.0) -> PPO:
    """rsl_rl's PPO. ``actor`` and ``critic``: rsl_rl's settings of each network, beyond ``config``'s; ``sees``: which
    groups of observations each is given; ``lasts``: of the actions' noise (``LastingNoise``)."""
    rank, world = int(os.environ.get("RANK", 0)), int(os.environ.get("WORLD_SIZE", 1))
    network = {"class_name": "MLPModel", "hidden_dims": list(config.hidden), "activation": "elu"}
    noise = {"class_name": LastingNoise, "lasts": lasts, "init_std": config.std, "std_type": "scalar"}
    settings = {
        "num_steps_per_env": config.horizon,
        "obs_groups": sees,
        "actor": {**network, **actor, "distribution_cfg": noise},
        "critic": {**network, **critic},
        "algorithm": {"class_name": "PPO", "gamma": config.gamma, "learning_rate": config.learning_rate, **config.ppo},
        "multi_gpu": {"global_rank": rank, "local_rank": rank, "world_size": world} if world > 1 else None,
    }
    with contextlib.redirect_stdout(io.StringIO()):  # rsl_rl prints the networks
        ppo: PPO = PPO.construct_algorithm(env.get_observations(), env, settings, str(learner_device(config.device)))
    with torch.no_grad():
        last = [m for m in ppo.actor.mlp.modules() if isinstance(m, nn.Linear)][-1]
        last.weight.mul_(0.01)  # start with no action at all
        last.bias.zero_()
    return ppo


def weights(state: dict, part: str) -> dict[str, torch.Tensor]:
    """The parameters of ``actor`` or ``critic`` in a checkpoint's ``state``, named as in the plain network."""
    found = state["ppo"][f"{part}_state_dict"]
    return {k.removeprefix("mlp."): v for k, v in found.items() if k.startswith("mlp.")}


def read_checkpoint(path: Path, make: Callable[[dict[str, Any]], Any]) -> tuple[dict, Any]:
    """A checkpoint's state, and its settings as ``make`` makes them of the document. Raises Sim2realError."""
    if not path.is_file():
        raise Sim2realError(f"{path}: no such checkpoint; train first: sim2real train --help lists the tasks")
    state = load(path, "train anew, or take another checkpoint")
    return state, settings(state.get("config", {}), make, path)


def load(path: Path, remedy: str) -> dict:
    """What a checkpoint holds. Raises Sim2realError, with the ``remedy``, if it is none or damaged."""
    try:
        return torch.load(path, weights_only=True, map_location="cpu")
    except Exception as error:  # torch has no common base for what a wrong file raises
        raise Sim2realError(f"{path}: {_reason(error)}; expected a checkpoint (best.pt, last.pt): {remedy}") from None


def _reason(error: Exception) -> str:
    return (str(error) or type(error).__name__).splitlines()[0]


def read_config(folder: Path, make: Callable[[dict[str, Any]], Any], task: str = "") -> Any:
    """The settings written beside a run's checkpoints. Raises Sim2realError if they cannot be read, are of another version, or
    the run is of another task than ``task``, where both are told."""
    path = folder / "config.json"
    try:
        document = json.loads(path.read_text())
        held, config = document.get("task"), dict(document["config"])
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise Sim2realError(
            f"{path}: {type(error).__name__}, {error}; expected what a training wrote; train in another folder"
        ) from None
    if held and task and held != task:
        raise Sim2realError(f"{folder}: got task '{task}', but it holds a run of '{held}'; name another --folder")
    return settings(config, make, path)


def _iteration(line: str) -> int:
    """Of a line of a curve; 0 of one that was torn when the machine stopped."""
    try:
        return int(json.loads(line)["iteration"])
    except ValueError:
        return 0


def settings(document: dict[str, Any], make: Callable[[dict[str, Any]], Any], where: Path) -> Any:
    """``make`` of a document that was JSON, or came from ``where``. Raises Sim2realError if it is of another version."""
    try:
        return make({k: tuple(v) if isinstance(v, list) else v for k, v in document.items()})
    except (TypeError, KeyError) as error:
        raise Sim2realError(
            f"{where}: its settings are of another version ({error}); check out the revision that made it, or train anew"
            " in another folder"
        ) from None


def git_revision() -> str:
    """The commit of the working tree, with ``+`` if it has changes; empty outside a repository."""
    root = Path(__file__).resolve().parents[1]
    run = lambda *a: subprocess.run(["git", *a], cwd=root, capture_output=True, text=True).stdout.strip()  # noqa: E731
    with contextlib.suppress(OSError):
        return run("rev-parse", "HEAD") + ("+" if run("status", "--porcelain", "--", "policies", "configs") else "")
    return ""
