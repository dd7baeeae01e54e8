"""The paper's Tables 2 and 3, in training's own world: other balls, and one skill after another."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from drivers.sim.ball import MASS, RADIUS, RESTITUTION
from policies.evaluate import Rate
from policies.graph import one_hot
from policies.skillmimic.env import Env
from policies.skillmimic.evaluate import Trace, episodes_of, performed, succeeded, ticks_of, traced
from policies.skillmimic.graph import PolicyGraph
from policies.skillmimic.starts import aiming

# The paper's factors of Table 2. Of its restitutions those above 1.2 are left out: 1.25 x 0.80 is a ball that never stops.
SWEEPS: dict[str, tuple[float, ...]] = {
    "radius": (0.5, 0.7, 0.9, 1.1, 1.3, 1.5),
    "density": (0.1, 0.4, 0.7, 2.0, 3.0, 4.0),
    "restitution": (0.6, 0.8, 1.2),
}
NOMINAL = f"{RADIUS:g} m, {MASS:g} kg, restitution {RESTITUTION:g}"
FIRST, SECOND, REST = 2.0, 5.0, 0.5  # s of the first skill (or its clip and REST), and of the second

Act = Callable[[Env], Tensor]


def fixed(what: str, factor: float) -> dict[str, float]:
    """Terms of the randomisation for a ball that differs from the nominal one by ``factor`` in ``what`` of SWEEPS. A larger
    one of the same density is heavier."""
    return {
        "radius": {"ball_radius": factor, "ball_mass": factor**3},
        "density": {"ball_mass": factor},
        "restitution": {"ball_restitution": factor * RESTITUTION},
    }[what]


CELLS = [(what, factor) for what, factors in SWEEPS.items() for factor in factors]


def sweep(graph: PolicyGraph, label: str, episodes: int, seconds: float, act: Act) -> dict[str, Rate]:
    """Table 2 of one skill: "radius x 0.5" -> success over ``episodes``, all side by side in one environment of
    ``len(CELLS) * episodes`` robots."""
    terms = {name: np.full((len(CELLS), episodes), np.nan) for what in SWEEPS for name in fixed(what, 1.0)}
    for k, (what, factor) in enumerate(CELLS):
        for name, value in fixed(what, factor).items():
            terms[name][k] = value
    balls = {name: values.ravel() for name, values in terms.items()}
    done = performed(graph, label, len(CELLS) * episodes, seconds, seed=2, act=act, fixed=balls)
    good = done.success.reshape(len(CELLS), episodes).sum(axis=1)
    return {f"{what} x {f:g}": Rate(round(float(n)), episodes) for (what, f), n in zip(CELLS, good, strict=True)}


def pairs(graph: PolicyGraph) -> list[tuple[str, str]]:
    """Every two skills of which the first ends, or begins again, with the ball in both hands, and the second begins so."""
    begins, ends = [], []
    for k, label in enumerate(graph.labels):
        clips = graph.clips.of(k)
        starts = all(c.contact[0, :2].all() for c in clips)
        begins += [label] * starts
        goes_on = label in (*graph.config.swing, *graph.config.loop)
        ends += [label] * (starts if goes_on else all(c.contact[-1, :2].all() for c in clips))
    return [(a, b) for a in ends for b in begins if a != b]


def switched(graph: PolicyGraph, first: str, second: str, episodes: int, act: Act) -> np.ndarray:
    """Table 3, right half: success (k,) in [0, 1] of ``second``, by its rule, in the episodes that came through ``first``."""
    clips, config = graph.clips, graph.config
    env = episodes_of(graph, first, episodes, 2 * (FIRST + SECOND), seed=3)
    nexts = env.rng.choice(np.flatnonzero(clips.skill == graph.labels.index(second)), episodes)
    ticks = np.array([ticks_of(graph, clip, SECOND) for clip in nexts])
    rest = np.where(clips.swing[env.clip] | clips.loop[env.clip], np.inf, clips.length[env.clip])  # rows
    waited = aiming(graph, int(env.clip[0]))
    began, ended = np.full((2, episodes), -1)
    asked, lost, up = np.zeros(episodes, bool), np.zeros(episodes, bool), np.full(episodes, True)
    rows: list[Trace] = []
    with torch.no_grad():
        while not (lost | (ended >= 0)).all():
            late = len(rows) * config.period >= FIRST + waited
            due = ~asked & ~lost & (late | (env.since - rest >= REST / config.timestep))
            if due.any():
                asked |= due
                ask(env, np.flatnonzero(due), second)
            now = asked & (began < 0) & ~lost & performs(env, second)
            began[now] = len(rows)
            env.clip[now], env.row[now], env.since[now] = nexts[now], 0, 0
            _, _, dones, _ = env.step(act(env))
            running, over = (began >= 0) & (ended < 0), dones.numpy().astype(bool)
            up &= ~(running & env.failures)
            rows.append(traced(env, up))
            ended[running & (over | (len(rows) - began >= ticks))] = len(rows)
            lost |= (began < 0) & over
    everything = Trace(*(np.stack(values) for values in zip(*rows, strict=True)))
    return np.array(
        [
            succeeded(second, Trace(*(x[began[n] : ended[n], n] for x in everything)), config.period, int(ticks[n]))
            for n in np.flatnonzero(~lost)
        ]
    )


def ask(env: Env, ids: np.ndarray, label: str) -> None:
    """The robots ``ids`` (k,) are told to do ``label`` now, as fast as training tells them to."""
    graph, skill = env.graph, env.graph.labels.index(label)
    env.skill[ids] = one_hot([skill], len(graph.labels))
    env.command[ids] = torch.from_numpy(graph.draw(env.rng, np.full(len(ids), skill)).astype(np.float32))
    env._observe()


def performs(env: Env, label: str) -> np.ndarray:
    """(envs,) bool: who does ``label`` in this tick. A ball in the air is caught before another skill begins."""
    done = env.measured.carried.get("carry_skill", env.skill)
    return done[:, env.graph.labels.index(label)].numpy() > 0
