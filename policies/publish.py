"""From a training run to a policy file: what the run lacks is measured on robots that training never saw.

Golden sequences (with skill changes), the envelope of every input, and what the critic says of a healthy robot, which is
the unit of ``skill_value``.
"""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import numpy as np
import torch

from policies.basics import MOTIONS, Basics
from policies.env import Env
from policies.evaluate import UNSEEN, random_script
from policies.export import envelope, export
from policies.graph import PolicyGraph
from policies.train import load_config, load_graph
from sim2real.config import load_robot
from sim2real.policy import Policy
from sim2real.types import Sim2realError

ROBOTS = 64
SECONDS = 10.0
SETTLED = 1.0  # s after a start or a skill change; from here on the critic's value counts as that of a healthy robot
GOLDEN = 4  # sequences
GOLDEN_STEPS = 36  # the skill changes every 12


def publish(run: Path, path: Path, checkpoint: str = "best.pt") -> Policy:
    """Export the policy of the training ``run`` (a folder, see ``policies.train``) to ``path``. Raises Sim2realError."""
    config, graph = load_config(run), load_graph(run, checkpoint)
    robot = load_robot(config.robot)
    seen, healthy = observe_robots(config, graph)
    graph.value_healthy.copy_(healthy)
    state = torch.load(run / checkpoint, weights_only=True)
    about = json.loads((run / "config.json").read_text())
    fields = {
        "name": "basics",
        "robot": robot.name,
        "variants": robot.variants,
        "period": config.period,
        "joint_names": list(robot.joint_names),
        "target_joint_names": list(robot.joint_names),
        "default_joint_pos": robot.home_pos.tolist(),
        "kp": graph.kp.tolist(),
        "kd": graph.kd.tolist(),
        "action_scale": graph.scale.tolist(),
        "skills": [{"label": label, "description": motion.description} for label, motion in MOTIONS.items()],
        "default_skill": next(iter(MOTIONS)),
        "envelope": envelope(seen),
        "provenance": {
            "source": "trained with sim2real train g1-basics",
            "revision": about["revision"],
            "licence": "Apache-2.0",
            "tools": about["tools"],
            "training": {
                "seed": config.seed,
                "samples": state["iteration"] * config.horizon * config.envs * about["world"],
                "checkpoint": checkpoint,
            },
        },
    }
    return export(graph, path, fields=fields, sequences=golden_inputs(config, graph))


def observe_robots(config: Basics, graph: PolicyGraph) -> tuple[list[dict[str, np.ndarray]], torch.Tensor]:
    """(every input of every tick, the mean value (labels,) of robots that are well) under randomisation and pushes.
    Raises Sim2realError for a skill that nobody performs for long enough to say."""
    script = random_script(config, len(graph.labels), ROBOTS, SECONDS, seed=1)
    env = Env(_lasting(config), UNSEEN + 1, script, level=0.5)
    ticks = np.zeros(ROBOTS)  # since the label or the robot changed
    seen: list[dict[str, np.ndarray]] = []
    values: list[list[float]] = [[] for _ in graph.labels]
    with torch.no_grad():
        for _ in range(script.shape[1]):
            seen.append({n: v.numpy().copy() for n, v in env.signals.items()})
            label = env.skill.argmax(-1).numpy()
            value = graph.critic(env.observation)[:, 0].numpy()
            for k, of_label in enumerate(values):
                of_label.extend(value[(label == k) & (ticks * config.period > SETTLED)].tolist())
            env.step(graph.actor(env.observation))
            ticks = np.where(env.failures | (env.skill.argmax(-1).numpy() != label), 0, ticks + 1)
    for label_name, of_label in zip(graph.labels, values, strict=True):
        if not of_label:
            raise Sim2realError(
                f"export: skill '{label_name}': got no robot that performs it for {SETTLED:g} s, expected some of"
                f" {ROBOTS}; train longer before exporting"
            )
    return seen, torch.tensor([float(np.mean(v)) for v in values])


def golden_inputs(config: Basics, graph: PolicyGraph) -> list[dict[str, np.ndarray]]:
    """What ``GOLDEN`` robots measure from their start on, while every skill is asked for in turn."""
    labels = len(graph.labels)
    turns = (np.arange(GOLDEN_STEPS) // 12)[None, :] + np.arange(GOLDEN)[:, None]
    env = Env(_lasting(config), UNSEEN + 2, turns % labels, level=None)
    rows: list[dict[str, np.ndarray]] = []
    with torch.no_grad():
        for _ in range(GOLDEN_STEPS):
            rows.append({n: v.numpy().copy() for n, v in env.signals.items()})
            env.step(graph.actor(env.observation))
    return [{n: np.stack([row[n][g] for row in rows]) for n in rows[0]} for g in range(GOLDEN)]


def _lasting(config: Basics) -> Basics:
    """Episodes that outlast the recording."""
    return dataclasses.replace(config, episode=SECONDS + 1.0)
