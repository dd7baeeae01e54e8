"""From a checkpoint to the shipped file: golden sequences, envelope and healthy values are recorded, then exported."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import torch

from policies.basics import MOTIONS
from policies.env import Env
from policies.evaluate import UNSEEN, random_script
from policies.export import envelope, export
from policies.graph import PolicyGraph
from policies.train import load_graph
from policies.training import git_revision
from sim2real.config import load_robot
from sim2real.policy import Policy

GOLDEN_STEPS = 40  # policy ticks of each golden sequence, with two skill switches
# Below this the policy refuses a switch. Measured on this task: undisturbed robots score 0.7 to 1.1 (1 % of them less),
# robots that are on the ground half a second later -0.05 to 0.25.
VALUE_MIN = 0.5
SETTLED = 100  # ticks after which an undisturbed episode counts as healthy


def release(folder: Path, path: Path, checkpoint: str = "best.pt") -> Policy:
    """Export a checkpoint of the run in ``folder`` to ``path`` and return the proved policy. Raises Sim2realError."""
    if "skills" in json.loads((folder / "config.json").read_text())["config"]:
        from policies.skillmimic.release import release as release_skills

        return release_skills(folder, path, checkpoint)
    graph = load_graph(folder, checkpoint)
    config, robot = graph.config, load_robot(graph.config.robot)
    graph.value_healthy.copy_(healthy_values(graph))
    document = json.loads((folder / "config.json").read_text())
    row = best_row(folder)
    fields = {
        "name": path.stem,
        "robot": robot.name,
        "variants": robot.variants,
        "period": config.period,
        "joint_names": list(robot.joint_names),
        "target_joint_names": list(robot.joint_names),
        "default_joint_pos": robot.home_pos.tolist(),
        "kp": robot.home_kp.tolist(),
        "kd": robot.home_kd.tolist(),
        "action_scale": graph.scale.tolist(),
        "skills": [  # to stand still is always allowed
            {"label": label, "description": m.description, "value_min": VALUE_MIN if k else None}
            for k, (label, m) in enumerate(MOTIONS.items())
        ],
        "default_skill": graph.labels[0],
        "history": "none: the only memory is carry_*",
        "envelope": envelope(training_signals(graph)),
        "provenance": {
            "source": "sim2real train g1-basics",
            "revision": document["revision"] or git_revision(),
            "licence": "Apache-2.0",
            "tools": document["tools"],
            "training": {
                "algorithm": "PPO (rsl_rl)",
                "seed": config.seed,
                "timestep": config.timestep,
                **row,
                **({"note": document["note"]} if "note" in document else {}),  # of who ran it, about how
            },
        },
    }
    return export(graph, path, fields=fields, sequences=golden_sequences(graph))


def best_row(folder: Path) -> dict[str, float]:
    """What the curve says about the checkpoint with the best mean survival."""
    rows = [json.loads(line) for line in (folder / "curve.jsonl").read_text().splitlines()]
    rows = [r for r in rows if "survival" in r]
    if not rows:
        return {}
    best = max(rows, key=lambda r: (r["survival"] + r["survival_pushed"], r["samples"]))
    return {k: best[k] for k in ("samples", "survival", "survival_pushed", "joint_error")}


def healthy_values(graph: PolicyGraph, episodes: int = 8, ticks: int = 300) -> torch.Tensor:
    """(labels,) mean value of the critic while each skill is performed undisturbed, under randomisation."""
    labels = len(graph.labels)
    script = np.repeat(np.arange(labels), episodes)[:, None].repeat(ticks, axis=1)
    env = Env(graph.config, UNSEEN + 1, script, level=None)
    values, weights = torch.zeros(labels), torch.zeros(labels)
    alive = np.full(len(script), True)
    with torch.no_grad():
        for t in range(ticks):
            if t >= SETTLED:
                good = env.skill * torch.from_numpy(alive)[:, None]
                values += (good * graph.critic(env.observation)).sum(0)
                weights += good.sum(0)
            env.step(graph.actor(env.observation))
            alive &= ~env.failures
    if not weights.all():
        raise ValueError(f"healthy values: got no surviving episode of some skill ({weights.tolist()})")
    return values / weights


def training_signals(graph: PolicyGraph, ticks: int = 300) -> Iterator[dict[str, np.ndarray]]:
    """What the policy measures in training, pushes and all, every fifth tick."""
    env = Env(dataclasses.replace(graph.config, envs=48), UNSEEN + 2, level=1.0)
    with torch.no_grad():
        for t in range(ticks):
            if t % 5 == 0:
                yield {name: signal.numpy().copy() for name, signal in env.signals.items()}
            env.step(graph.actor(env.observation))


def golden_sequences(graph: PolicyGraph, count: int = 4) -> list[dict[str, np.ndarray]]:
    """Closed-loop recordings of the inputs from the start, through skill switches; the later half with pushes."""
    script = random_script(graph.config, len(graph.labels), count, GOLDEN_STEPS * graph.config.period, every=0.4)
    script[:, 0] = np.arange(count) % len(graph.labels)
    sequences = []
    for pushed in (False, True):
        config = dataclasses.replace(graph.config, push=(0.2, 0.4), push_speed=(0.4, 0.4))
        env = Env(config, UNSEEN + 3, script, level=1.0 if pushed else None)
        rows: list[dict[str, np.ndarray]] = []
        with torch.no_grad():
            for _ in range(GOLDEN_STEPS):
                rows.append({name: signal.numpy().copy() for name, signal in env.signals.items()})
                env.step(graph.actor(env.observation))
        half = range(count // 2) if not pushed else range(count // 2, count)
        sequences += [{name: np.stack([row[name][k] for row in rows]) for name in rows[0]} for k in half]
    return sequences
