"""How well a policy performs its skills: the paper's measures (section 6.2), and how often it gets to the end."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from policies.evaluate import UNSEEN, Rate
from policies.skillmimic.env import Env
from policies.skillmimic.graph import PolicyGraph
from policies.skillmimic.rewards import Step

# The paper's thresholds of a right frame, times the robot's length scale of 0.744: ball within 0.2 m, body within 0.1 m.
BALL_NEAR, BODY_NEAR = 0.149, 0.074  # m


class Measures(NamedTuple):
    """Of one instant, each (N,)."""

    body: np.ndarray  # m, mean distance of the key points from the reference's: E_b-mpjpe
    ball: np.ndarray  # m: E_o-mpjpe
    contact: np.ndarray  # share of the graph's edges that are wrong: E_cg
    right: np.ndarray  # bool: ball and body near, and every contact right: averaged, Acc.


def measure(s: Step) -> Measures:
    """The paper's errors, in the world frame."""
    body = np.linalg.norm(s.state.points - s.reference.points, axis=-1).mean(axis=1)
    ball = np.linalg.norm(s.state.object_position - s.reference.object_position, axis=-1)
    contact = np.abs(s.state.contact - s.reference.contact).mean(axis=1)
    return Measures(body, ball, contact, (ball < BALL_NEAR) & (body < BODY_NEAR) & (contact == 0))


class Trace(NamedTuple):
    """What happened in an episode, arrays (T, N, ...): seen from the trunk where a base policy moves the legs, else in the
    world."""

    held: np.ndarray  # bool: hands touch the ball
    ball: np.ndarray  # (T, N, 3) m
    ball_velocity: np.ndarray  # (T, N, 3) m/s
    apart: np.ndarray  # m between ball and base
    height: np.ndarray  # m of the base
    up: np.ndarray  # bool: no episode failed up to here


LENGTH = 0.745  # of the G1, over a person's: distances of the paper's rules times this
ASIDE, LEAST = np.deg2rad(20.0), 1.5  # rad off the commanded direction, and m/s forwards, of a ball that was thrown
HELD = 0.5  # s at the end of an episode during which a caught ball is held


def _kept(t: Trace, period: float) -> np.ndarray:
    """Nothing failed: the robot stands, and the ball stays near where the clip has it."""
    return t.up[-1].astype(float)


def _thrown(t: Trace, period: float) -> np.ndarray:
    """The ball left the hands for good, forwards (to 20 degrees) at 1.5 m/s or more, and the robot stands at the end."""
    good = t.up[-1].copy()
    for n in range(t.held.shape[1]):
        last = np.flatnonzero(t.held[:, n])
        free = last[-1] + 2 if len(last) else 0  # a tick later nothing touches it
        if free >= len(t.held):
            good[n] = False
            continue
        forward, left = t.ball_velocity[free, n, :2]
        good[n] &= forward >= LEAST and abs(np.arctan2(left, forward)) <= ASIDE
    return good.astype(float)


def _caught(t: Trace, period: float) -> np.ndarray:
    """The robot stands, and holds the ball during the last half second."""
    return (t.up[-1] & t.held[-round(HELD / period) :].all(axis=0)).astype(float)


def _dribbled(t: Trace, period: float) -> np.ndarray:
    """Section 6.2: the share of frames with base above 0.5 m and ball nearer than 1.5 m, at the robot's size; frames after
    a failure do not count, nor those more than 2 s after the last touch."""
    frames = np.arange(len(t.held))[:, None]
    touched = np.maximum.accumulate(np.where(t.held, frames, 0), axis=0)
    lively = (frames - touched) * period < 2.0
    return (t.up & lively & (t.height > 0.5 * LENGTH) & (t.apart < 1.5 * LENGTH)).mean(axis=0)


RULES: dict[str, Callable[[Trace, float], np.ndarray]] = {
    "pass": _thrown,
    "shot": _thrown,
    "catch": _caught,
    "dribble_in_place": _dribbled,
    "dribble_forward": _dribbled,
}
"""Success of an episode in [0, 1] by skill; of every other skill: ``_kept``."""


class Result(NamedTuple):
    """Of one skill over episodes: success by its rule, and means over frames until an episode failed."""

    success: Rate
    accuracy: float
    body_error: float  # m
    ball_error: float  # m
    contact_error: float


def result(success: np.ndarray, sums: np.ndarray, frames: np.ndarray) -> Result:
    """What episodes amount to: ``success`` (episodes,) in [0, 1], ``sums`` (episodes, 4) of Measures over ``frames``
    (episodes,) each."""
    body, ball, contact, right = (sums.sum(axis=0) / frames.sum()).tolist()
    return Result(Rate(round(float(success.sum())), len(success)), right, body, ball, contact)


def evaluate(
    graph: PolicyGraph,
    episodes: int,
    seconds: float,
    push: float = 0.0,
    seed: int = 0,
    act: Callable[[Env], Tensor] | None = None,
) -> dict[str, Result]:
    """Of every skill, ``episodes`` of ``seconds`` from the beginning of a clip (a clip that ends is over ``config.after`` s
    after its end), with robots and balls drawn from randomisation that training never saw.

    ``push``: m/s, the largest of random pushes. ``act``: what to do, (episodes, actions); by default what ``graph.actor``
    says.
    """
    return {skill: evaluate_skill(graph, skill, episodes, seconds, push, seed, act) for skill in graph.config.skills}


def evaluate_skill(
    graph: PolicyGraph,
    skill: str,
    episodes: int,
    seconds: float,
    push: float = 0.0,
    seed: int = 0,
    act: Callable[[Env], Tensor] | None = None,
) -> Result:
    """As ``evaluate``, of one skill."""
    config = dataclasses.replace(
        graph.config,
        envs=episodes,
        frames=round(seconds / graph.config.period),
        push_speed=push,
        push_chance=graph.config.push_chance if push else 0.0,
        anywhere=skill not in RULES,
        disturbed=0.0,
    )
    env = Env(config, UNSEEN + seed, graph, skill)
    env.episode_length_buf[:] = 0
    act = act or (lambda e: graph.actor(e.observation))
    running, up = np.full(episodes, True), np.full(episodes, True)
    sums, frames = np.zeros((episodes, len(Measures._fields))), np.zeros(episodes)
    rows: list[Trace] = []
    with torch.no_grad():
        while running.any():
            _, _, dones, _ = env.step(act(env))
            up = up & ~(running & env.failures)
            state, row = env.now.state, measure(env.now)
            now = Trace(state.contact[:, 0] > 0, state.object_position, state.object_velocity, env.apart,
                        env.now.height, up)  # fmt: skip
            if rows:  # an episode that is over stays as it ended
                now = Trace(*(np.where(_like(running, new), new, old) for new, old in zip(now, rows[-1], strict=True)))
            rows.append(now)
            sums[running] += np.stack(row, axis=1)[running]
            frames += running
            running &= ~dones.numpy().astype(bool)
    rows += rows[-1:] * (config.frames - len(rows))
    trace = Trace(*(np.stack(values) for values in zip(*rows, strict=True)))
    shares = RULES.get(skill, _kept)(trace, config.period)
    return result(shares, sums, frames)


def _like(chosen: np.ndarray, values: np.ndarray) -> np.ndarray:
    return chosen.reshape(-1, *[1] * (values.ndim - 1))
