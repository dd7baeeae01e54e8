"""From a checkpoint to a policy file: golden sequences and envelope are recorded in training's own world, then exported."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import numpy as np
import torch

from policies.evaluate import UNSEEN
from policies.export import envelope, export
from policies.skillmimic.env import Env
from policies.skillmimic.graph import PolicyGraph
from policies.skillmimic.train import load_graph
from policies.training import git_revision
from sim2real.policy import Policy

GOLDEN_STEPS, GOLDEN = 40, 4  # ticks of each golden sequence, and how many


def release(folder: Path, path: Path, checkpoint: str = "best.pt") -> Policy:
    """Export a checkpoint of the run in ``folder`` to ``path`` and return the proved policy. Raises Sim2realError."""
    graph = load_graph(folder, checkpoint)
    document = json.loads((folder / "config.json").read_text())
    rows = [json.loads(line) for line in (folder / "curve.jsonl").read_text().splitlines()]
    best = max((r for r in rows if "score" in r), key=lambda r: (r["score"], r["samples"]), default={})
    measured = {k: best[k] for k in ("samples", "score", "accuracy", "body_error", "ball_error") if k in best}
    return export_graph(graph, path, document["revision"], document["tools"], measured)


def export_graph(
    graph: PolicyGraph,
    path: Path,
    revision: str = "",
    tools: dict[str, str] | None = None,
    measured: dict | None = None,
) -> Policy:
    """Export ``graph``, with what its run ``measured``. Raises Sim2realError."""
    config, robot = graph.config, graph.robot
    sequences, seen = record(graph)
    fields = {
        "name": path.stem,
        "robot": robot.name,
        "variants": robot.variants,
        "period": config.period,
        "joint_names": list(robot.joint_names),
        "target_joint_names": list(robot.joint_names),
        "default_joint_pos": graph.postures[0].tolist(),
        "kp": robot.home_kp.tolist(),
        "kd": robot.home_kd.tolist(),
        "action_scale": graph.scale.tolist(),
        "skills": [{"label": label, "description": f"{label}, from retargeted clips"} for label in graph.labels],
        "default_skill": graph.labels[0],
        "history": f"{config.history} ticks, carried in carry_history",
        "envelope": envelope(seen),
        "provenance": {
            "source": "sim2real train",
            "revision": revision or git_revision(),
            "licence": "Apache-2.0; clips: policies/g1/clips/ATTRIBUTION.md",
            "tools": tools or {},
            "training": {
                "algorithm": "PPO (rsl_rl)",
                "variant": config.variant,
                "seed": config.seed,
                "timestep": config.timestep,
                **(measured or {}),
            },
        },
    }
    return export(graph, path, fields=fields, sequences=sequences)


def record(graph: PolicyGraph) -> tuple[list[dict[str, np.ndarray]], list[dict[str, np.ndarray]]]:
    """Closed-loop recordings from the start of episodes, one a robot; and the same signals of many robots, tick by tick."""
    config = dataclasses.replace(
        graph.config, envs=64, frames=10 * GOLDEN_STEPS, variant="skillmimic", terminations=("broken",)
    )
    env = Env(config, UNSEEN + 3, graph)
    env.episode_length_buf[:] = 0
    rows: list[dict[str, np.ndarray]] = []
    with torch.no_grad():
        for _ in range(GOLDEN_STEPS):
            rows.append({name: signal.numpy().copy() for name, signal in env.inputs.items()})
            env.step(graph.actor(env.observation))
    sequences = [{name: np.stack([row[name][k] for row in rows]) for name in rows[0]} for k in range(GOLDEN)]
    return sequences, rows
