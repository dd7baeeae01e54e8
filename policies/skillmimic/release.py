"""From a checkpoint to a policy file: golden sequences and envelope are recorded in training's own world, then exported."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import numpy as np
import onnx
import torch
from onnx import numpy_helper
from rsl_rl.modules import MLP
from torch import nn

from drivers.sim import ball
from policies.evaluate import UNSEEN
from policies.export import envelope, export
from policies.skillmimic.config import SkillMimic
from policies.skillmimic.env import Env
from policies.skillmimic.graph import PolicyGraph
from policies.skillmimic.plan import RESTED, SETTLE, samples
from policies.skillmimic.starts import approach, first_clips, object_start, start_posture
from policies.skillmimic.train import load_graph, skills
from policies.training import git_revision
from policies.training import settings as read_settings
from sim2real.contract import Contract
from sim2real.policy import Policy
from sim2real.types import Sim2realError

SETTINGS = ("robot", "skills", "clips", "swing", "loop", "after", "base", "walks", "bends", "corrections", "timed", "period",
            "timestep", "action_ratio", "action_max", "grip", "balance_gain", "balance_damping", "position_margin",
            "history", "frames", "throw", "placed", "terminations", "meets", "stands")  # fmt: skip
ARMS_COME = 1.0  # s, at most, until arms are where a clip begins
SHOWN, NONE = (0.3, 0.0, 0.0), (0.0, 0.0, 0.0)  # m/s, m/s, rad/s: of a timeline that names none, at most
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
    low, high = (NONE, NONE) if graph.base is None else (graph.base.config.command_low, graph.base.config.command_high)
    sequences, seen = record(graph)
    fields = {
        "name": path.stem,
        "robot": robot.name,
        "variants": robot.variants,
        "period": config.period,
        "joint_names": list(robot.joint_names),
        "target_joint_names": list(robot.joint_names),
        "default_joint_pos": start_posture(graph).tolist(),
        "approach_joint_pos": approach(graph),
        "kp": robot.home_kp.tolist(),
        "kd": robot.home_kd.tolist(),
        "action_scale": graph.scale.tolist(),
        "object": {"kind": "ball", "radius": ball.RADIUS, "mass": ball.MASS, "restitution": ball.RESTITUTION},
        "skills": [
            {
                "label": label,
                "description": f"{label}, {origin(graph, clip)}",
                **({} if label in (*config.swing, *config.loop) else {"dwell": dwell(graph, label, clip)}),
                "velocity": np.clip(SHOWN, *graph.paces[graph.labels.index(label)]).tolist(),
                "object": object_start(graph, clip),
            }
            for label, clip in zip(graph.labels, first_clips(graph), strict=True)
        ],
        "default_skill": graph.labels[0],
        "command_velocity_min": low,
        "command_velocity_max": high,
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
                "settings": settings(config),
                **({"plan_samples": samples(config.corrections, config.skills)} if config.corrections else {}),
                **(measured or {}),
            },
        },
    }
    return export(graph, path, fields=fields, sequences=sequences)


def dwell(graph: PolicyGraph, label: str, clip: int) -> float:
    """s that a skill with clip number ``clip`` takes, with what comes before where the base bends: who throws or is down goes
    through with it, for no other skill begins from there."""
    before = (RESTED + SETTLE) * graph.config.period + ARMS_COME if label in graph.config.bends else 0.0
    return graph.clips.seconds(clip) + before


def origin(graph: PolicyGraph, clip: int) -> str:
    """Where clip number ``clip`` comes from."""
    made = graph.clips.recorded[clip].header.source.startswith("policies/")
    return "by formula" if made else "from retargeted clips"


def settings(config: SkillMimic) -> str:
    """What it takes to build the graph and its clips again (``graph_of``), as JSON."""
    return json.dumps({name: getattr(config, name) for name in SETTINGS})


def graph_of(contract: Contract) -> PolicyGraph:
    """The graph that ``contract``'s file was exported from, without its actor. Raises Sim2realError where it does not say, or
    is of another version."""
    text = contract.provenance.training.get("settings")
    if not isinstance(text, str):
        raise Sim2realError(f"{contract.name}: its provenance has no 'settings': export it again (sim2real export)")
    return PolicyGraph(read_settings(json.loads(text), skills, Path(contract.name)))


def network_in(path: Path) -> nn.Module:
    """The actor in the policy file ``path``."""
    weights = {
        t.name: torch.tensor(numpy_helper.to_array(t))
        for t in onnx.load_from_string(path.read_bytes()).graph.initializer
    }
    own = {name.removeprefix("actor."): w for name, w in weights.items() if name.startswith("actor.")}
    *hidden, last = [w for name, w in own.items() if name.endswith("weight")]
    network = MLP(hidden[0].shape[1], len(last), [len(w) for w in hidden], "elu")
    network.load_state_dict(own)
    return network


def record(graph: PolicyGraph) -> tuple[list[dict[str, np.ndarray]], list[dict[str, np.ndarray]]]:
    """Closed-loop recordings from the start of episodes, one a robot; and the same signals of many robots, tick by tick."""
    config = dataclasses.replace(
        graph.config, envs=64, frames=10 * GOLDEN_STEPS, variant="skillmimic", terminations=("broken",), hopeless=()
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
