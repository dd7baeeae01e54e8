"""Where a dribble loses its ball, bounce by bounce: ``python -m policies.skillmimic.strokes policies/g1/ball.onnx``.

In the training environment, as the card measures it, and then with one cause after another taken away.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
import tyro

from policies import ball
from policies.skillmimic.ablation import tell
from policies.skillmimic.card import SECONDS, BallActor, graph_in
from policies.skillmimic.config import check_skill
from policies.skillmimic.env import BASE, FLIGHT
from policies.skillmimic.evaluate import episodes_of
from policies.skillmimic.graph import PolicyGraph
from policies.skillmimic.plan import GRAVITY
from policies.skillmimic.randomisation import TABLE
from policies.skillmimic.starts import first_clips
from sim2real.options import Count, MaybeNewFile
from sim2real.simulation import Scene

SHOWN = 5  # bounces
LOW = 0.3  # m: a ball that turns below bounces
AFTER = 2  # ticks from there until nothing touches it
HEAD = "Where the one-handed dribble loses its ball"
NOTE = """Written by `python -m policies.skillmimic.strokes`; do not edit. Of the robots of the card's training environment, from the
first stroke on: how many see the ball bounce so often, how fast it then leaves the floor beside what the plan asks, and how
far it is from its place beside the robot (medians, and half of what 68 % lie within). A ball that comes up with only its
restitution, 0.72 to 0.84, times the speed of the bounce before was not pushed. Training's physics take steps of 5 ms, the
deployed worlds' of 2 ms: a contact of ball and palm is a few of them, and how the ball leaves depends on where in a step it
came."""


class Case(NamedTuple):
    """What is otherwise than in the card."""

    still: bool = False  # the base does not move, whatever the arms do
    fixed: Mapping[str, float] = {}  # terms of the randomisation that are alike for all
    timestep: float = 0.0  # s of the physics; 0: that of the card


NOT_RANDOM = {n: 0.0 if "noise" in n else (t.low + t.high) / 2 for n, t in TABLE.items()}
FINE = Scene.timestep  # s, of the deployed worlds
CASES = {
    "as in the card": Case(),
    "base held still": Case(still=True),
    "motors of four times the torque": Case(fixed={"strength": 4.0}),
    "liveliest ball": Case(fixed={"ball_restitution": TABLE["ball_restitution"].high}),
    "nothing random": Case(fixed=NOT_RANDOM),
    "physics in finer steps": Case(timestep=FINE),
    "nothing random, finer steps": Case(fixed=NOT_RANDOM, timestep=FINE),
}


class Bounces(NamedTuple):
    """Of every robot, a row a bounce; NaN where it saw no such."""

    speed: np.ndarray  # (SHOWN, N) m/s off the floor
    off: np.ndarray  # (SHOWN, N) m from its place


def bounces(lifted: np.ndarray, rising: np.ndarray, off: np.ndarray, up: np.ndarray) -> Bounces:
    """From what was seen of balls, a row a tick, (T, N) each: m of the centre above the floor, m/s upwards, m from its place,
    and whether the episode goes on."""
    came = np.zeros(up.shape, bool)
    came[1:-AFTER] = (rising[1:-AFTER] > 0) & (rising[: -AFTER - 1] <= 0) & (lifted[1:-AFTER] < LOW) & up[1 + AFTER :]
    found = Bounces(*np.full((2, SHOWN, up.shape[1]), np.nan))
    number = came.cumsum(axis=0)
    for k in range(SHOWN):
        tick, robot = np.nonzero(came & (number == k + 1))
        at = tick + AFTER, robot
        found.speed[k, robot] = np.sqrt(rising[at] ** 2 + 2 * GRAVITY * np.maximum(lifted[at] - ball.RADIUS, 0))
        found.off[k, robot] = off[at]
    return found


def watched(path: Path, graph: PolicyGraph, skill: str, robots: int, case: Case) -> Bounces:
    """What ``robots`` do with a policy file in ``case``, for ``SECONDS``."""
    fixed = {name: np.full(robots, value) for name, value in case.fixed.items()}
    if case.timestep:
        graph = PolicyGraph(replace(graph.config, timestep=case.timestep))
    env = episodes_of(graph, skill, robots, SECONDS, fixed=fixed)
    qpos, qvel = env.batch.bind("qpos"), env.batch.bind("qvel")
    act, up, place = BallActor(path, robots), np.full(robots, True), qpos[:, BASE].copy()
    rows = []
    with torch.no_grad():
        while up.any() and len(rows) < env.max_episode_length:
            if case.still:
                qpos[:, BASE], qvel[:, :6] = place, 0.0
            env.step(act(env))
            up = up & ~env.failures
            here, there = env.now.state, env.now.reference
            off = np.linalg.norm((here.object_position - there.object_position)[:, :2], axis=1)
            rows.append((env.lifted, here.object_velocity[:, 2], off, up))
    return bounces(*(np.stack(column) for column in zip(*rows, strict=True)))


def table(found: Mapping[str, Bounces], planned: float) -> str:
    """Markdown, a row a case and bounce; ``planned`` m/s: how fast the plan has the ball leave the floor."""
    rows = []
    for case, b in found.items():
        for k, (speed, off) in enumerate(zip(b.speed, b.off, strict=True)):
            there = ~np.isnan(speed)
            if there.any():
                rows.append(
                    f"| {case} | {k + 1} | {there.mean():.0%} | {_spread(speed[there] - planned)} | {_spread(off[there])} |"
                )
    head = f"| case | bounce | robots | m/s off the floor, beside {planned:.2f} | m off its place |\n|---|---|---|---|---|\n"
    return head + "\n".join(rows)


def _spread(values: np.ndarray) -> str:
    low, middle, high = np.quantile(values, [0.16, 0.5, 0.84])
    return f"{middle:+.2f} +- {(high - low) / 2:.2f}"


@dataclass(frozen=True)
class Args:
    """Where a dribble loses its ball, bounce by bounce."""

    policy: tyro.conf.Positional[Path]
    """policy file"""
    skill: str = "dribble_in_place"
    """which of its skills"""
    robots: Count = 200
    """in each case"""
    report: MaybeNewFile = None
    """write the table to this Markdown file"""


def main() -> None:
    a = tyro.cli(Args, prog="python -m policies.skillmimic.strokes")
    torch.set_num_threads(1)
    graph = graph_in(a.policy)
    check_skill(a.skill, graph.labels)
    found = {}
    for name, case in CASES.items():
        found[name] = watched(a.policy, graph, a.skill, a.robots, case)
        print(f"{name}: {np.isfinite(found[name].speed).sum(axis=0).mean():.1f} bounces a robot", flush=True)
    clips, clip = graph.clips, first_clips(graph)[graph.labels.index(a.skill)]
    rows = slice(clips.first[clip], clips.first[clip] + clips.length[clip])
    planned = float(clips.qvel[rows, FLIGHT][:, 2].max())
    text = f"`{a.skill}` of `{a.policy}`, {a.robots} robots, {SECONDS:g} s:\n\n{table(found, planned)}\n"
    tell(text, a.report, HEAD, NOTE)


if __name__ == "__main__":
    main()
