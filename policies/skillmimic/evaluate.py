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


class Result(NamedTuple):
    """Over episodes: how many came to their end, and means over their frames until they failed."""

    success: Rate
    accuracy: float
    body_error: float  # m
    ball_error: float  # m
    contact_error: float


def evaluate(
    graph: PolicyGraph,
    episodes: int,
    seconds: float,
    push: float = 0.0,
    seed: int = 0,
    act: Callable[[Env], Tensor] | None = None,
) -> Result:
    """One episode of ``seconds`` (a clip that does not swing ends sooner) in each of ``episodes`` robots, drawn from
    randomisation that training never saw, half of them started beside their reference.

    Success: no termination of ``config.terminations``. ``push``: m/s, the largest of random pushes. ``act``: what to do,
    (episodes, n); by default what ``graph.actor`` says.
    """
    rows = run(graph, episodes, seconds, push, seed, act)
    return result(rows.failed, rows.sums, rows.frames)


class Rows(NamedTuple):
    """Of every episode, each with ``episodes`` rows."""

    skill: np.ndarray  # label index
    failed: np.ndarray  # bool
    sums: np.ndarray  # (episodes, 4) of Measures over the frames
    frames: np.ndarray  # until it failed, or ended


def result(failed: np.ndarray, sums: np.ndarray, frames: np.ndarray) -> Result:
    """What episodes amount to, from the columns of Rows."""
    body, ball, contact, right = (sums.sum(axis=0) / frames.sum()).tolist()
    return Result(Rate(int((~failed).sum()), len(failed)), right, body, ball, contact)


def run(
    graph: PolicyGraph,
    episodes: int,
    seconds: float,
    push: float = 0.0,
    seed: int = 0,
    act: Callable[[Env], Tensor] | None = None,
) -> Rows:
    """The episodes of ``evaluate``, one by one."""
    config = dataclasses.replace(
        graph.config,
        envs=episodes,
        frames=round(seconds / graph.config.period),
        push_speed=push,
        push_chance=graph.config.push_chance if push else 0.0,
    )
    env = Env(config, UNSEEN + seed, PolicyGraph(config))
    env.episode_length_buf[:] = 0
    act = act or (lambda e: graph.actor(e.observation))
    running, failed = np.full(episodes, True), np.full(episodes, False)
    sums, frames = np.zeros((episodes, len(Measures._fields))), np.zeros(episodes)
    skill = env.clips.skill[env.clip]
    with torch.no_grad():
        while running.any():
            _, _, dones, _ = env.step(act(env))
            row = np.stack(measure(env.now), axis=1)
            sums[running] += row[running]
            frames += running
            failed |= running & env.failures
            running &= ~dones.numpy().astype(bool)
    return Rows(skill, failed, sums, frames)
