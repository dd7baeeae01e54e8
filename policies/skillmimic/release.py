"""From a checkpoint to a policy file: golden sequences and envelope are recorded in training's own world, then exported."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np
import torch

from drivers.sim import ball
from policies.clips.kinematics import conjugate, quaternion_from_rotation_vector, rotate
from policies.clips.library import robot_clips
from policies.evaluate import UNSEEN
from policies.export import envelope, export
from policies.physics import standing_height
from policies.skillmimic.clips import PRESS, grip
from policies.skillmimic.config import SkillMimic
from policies.skillmimic.env import Env
from policies.skillmimic.graph import PolicyGraph
from policies.skillmimic.plan import samples
from policies.skillmimic.stance import stand
from policies.skillmimic.train import load_graph
from policies.training import git_revision
from sim2real.contract import Contract
from sim2real.policy import Policy
from sim2real.types import Sim2realError

SETTINGS = ("robot", "skills", "clips", "swing", "loop", "after", "base", "walks", "corrections", "timed", "period",
            "timestep", "action_ratio", "action_max", "grip", "balance_gain", "balance_damping", "position_margin",
            "history", "frames", "throw", "terminations")  # fmt: skip
OPEN = 0.05  # m
SHOWN, NONE = (0.3, 0.0, 0.0), (0.0, 0.0, 0.0)  # m/s, m/s, rad/s: commands of a timeline that names none
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
                "description": f"{label}, from retargeted clips",
                "velocity": SHOWN if label in config.walks else NONE,
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


def settings(config: SkillMimic) -> str:
    """What it takes to build the graph and its clips again (``graph_of``), as JSON."""
    return json.dumps({name: getattr(config, name) for name in SETTINGS})


def graph_of(contract: Contract) -> PolicyGraph:
    """The graph that ``contract``'s file was exported from, without its actor. Raises Sim2realError where it does not say."""
    text = contract.provenance.training.get("settings")
    if not isinstance(text, str):
        raise Sim2realError(f"{contract.name}: its provenance has no 'settings': export it again (sim2real export)")
    fields = {name: tuple(v) if isinstance(v, list) else v for name, v in json.loads(text).items()}
    return PolicyGraph(SkillMimic(**fields))


def first_clips(graph: PolicyGraph) -> list[int]:
    """Of every skill, the number of its first clip."""
    return [int(np.flatnonzero(graph.clips.skill == k)[0]) for k in range(len(graph.labels))]


def object_start(graph: PolicyGraph, clip: int) -> dict[str, Any]:
    """How the skill of clip number ``clip`` finds the ball there: a contract.ObjectStart.

    In the hands if both palms are on it at the start: then at its mean place in the skill's clips, which is where they are
    in the skill's posture. Else lying or flying, as in the first frame.
    """
    clips = graph.clips
    recorded = {c.name: c for c in robot_clips(graph.config.robot, graph.labels[clips.skill[clip]])}
    if recorded[clips.names[clip]].contact[0, :2].all():
        alike = np.flatnonzero(clips.skill == clips.skill[clip])
        return {"how": "held", "position": _rounded(np.mean([_in_hands(graph, c) for c in alike], axis=0))}
    m = clips.motion(clips.first[[clip]], np.ones(1))
    base, turn, position, velocity = m.points[:, 0], m.orientation_base_in_world, m.object_position, m.object_velocity
    ahead = rotate(turn[0], np.array([1.0, 0.0, 0.0]))
    back = quaternion_from_rotation_vector(np.array([0.0, 0.0, -np.arctan2(ahead[1], ahead[0])]))
    place = rotate(back, position[0] - base[0] * [1.0, 1.0, 0.0])
    if place[2] < 1.5 * ball.RADIUS and np.linalg.norm(velocity[0]) < 0.3:
        return {"how": "placed", "position": _rounded(np.array([*place[:2], ball.RADIUS]))}
    return {"how": "thrown", "position": _rounded(place), "velocity": _rounded(rotate(back, velocity[0]))}


def _in_hands(graph: PolicyGraph, clip: int) -> np.ndarray:
    """(3,) m in the base: the ball of clip number ``clip``, mean while hands are on it."""
    clips = graph.clips
    rows = clips.first[clip] + np.arange(clips.length[clip])
    m = clips.motion(rows, np.ones(len(rows)))
    place = rotate(conjugate(m.orientation_base_in_world), m.object_position - m.points[:, 0])
    return place[m.contact[:, 0] > 0].mean(axis=0)


def start_posture(graph: PolicyGraph) -> np.ndarray:
    """(n,) rad, where the soft start ends: the posture of the first skill; legs and waist as a base policy stands."""
    return np.where(graph.acts.numpy() > 0, graph.postures[0].numpy(), graph.clips.stances[0])


def approach(graph: PolicyGraph) -> list[float]:
    """(n,) rad, ``start_posture`` with the palms ``OPEN`` off the ball, for hands that then close on it from both sides;
    empty where the first skill does not begin with both palms on the ball."""
    clips, body = graph.clips, graph.body
    postures = []
    for clip in robot_clips(graph.config.robot, graph.labels[0]):
        both = clip.contact[:, :2].all(axis=1)
        if clip.name not in clips.names or not both[0]:
            continue
        if graph.base is not None:
            clip = stand(clip, body, clips.stances[0], float(standing_height(body.model, clips.stances[:1])[0]))
        g = grip(clip, graph.model, body, graph.kp, force=0.0)
        postures.append((clip.joint_pos + g.effort - g.press * (OPEN / PRESS))[both].mean(axis=0))
    if not postures:
        return []
    posture = np.where(graph.acts.numpy() > 0, np.mean(postures, axis=0), clips.stances[0])
    return np.clip(posture, graph.lower.numpy(), graph.upper.numpy()).tolist()


def _rounded(vector: np.ndarray) -> list[float]:
    return [round(v, 4) for v in vector.tolist()]


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
