"""How well a policy performs its skills: the paper's measures (section 6.2), and how often it gets to the end."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from policies.evaluate import UNSEEN, Rate
from policies.skillmimic.env import Env
from policies.skillmimic.graph import PolicyGraph
from policies.skillmimic.rewards import Step
from policies.skillmimic.starts import aiming

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
    """What happened in an episode, a row a tick until it ended: seen from the trunk where a base policy moves the legs,
    else in the world."""

    held: np.ndarray  # (T,) bool: hands touch the ball
    ball_velocity: np.ndarray  # (T, 3) m/s
    apart: np.ndarray  # (T,) m between ball and base
    lifted: np.ndarray  # (T,) m of the ball's centre above the floor
    height: np.ndarray  # (T,) m of the base
    up: np.ndarray  # (T,) bool: nothing failed up to here


LENGTH = 0.745  # of the G1, over a person's: distances of the paper's rules times this
ASIDE, LEAST = np.deg2rad(20.0), 1.5  # rad off the commanded direction, and m/s forwards, of a ball that was thrown
HELD = 0.5  # s at the end of an episode during which a caught ball is held
LIVELY = 2.0  # s for which a ball is being dribbled after its last touch, and bounced after it last came from the floor
BOUNCED = 1.0  # m/s upwards of a ball that nobody touches: it comes from the floor


def _kept(t: Trace, period: float, ticks: int) -> float:
    """Nothing failed: the robot stands, and the ball stays near where the clip has it."""
    return float(t.up[-1])


def _thrown(t: Trace, period: float, ticks: int) -> float:
    """The ball left the hands for good, forwards (to 20 degrees) at 1.5 m/s or more, and the robot stands at the end."""
    last = np.flatnonzero(t.held)
    free = last[-1] + 2 if len(last) else 0  # a tick later nothing touches it
    if free >= len(t.held):
        return 0.0
    forward, left = t.ball_velocity[free, :2]
    return float(t.up[-1] and forward >= LEAST and abs(np.arctan2(left, forward)) <= ASIDE)


def _caught(t: Trace, period: float, ticks: int) -> float:
    """The robot stands, and holds the ball during the last half second."""
    return float(t.up[-1] and t.held[-round(HELD / period) :].all())


def _picked(t: Trace, period: float, ticks: int) -> float:
    """Section 6.2, at the robot's size: at the end the ball is more than 1 m above the floor; and the robot stands."""
    return float(t.up[-1] and t.lifted[-1] > 1.0 * LENGTH)


def _dribbled(t: Trace, period: float, ticks: int) -> float:
    """Section 6.2: the share of frames with base above 0.5 m and ball nearer than 1.5 m, at the robot's size; frames after
    a failure do not count, nor those more than 2 s after the last touch."""
    return _lively(t, t.held, period, ticks)


def _bounced(t: Trace, period: float, ticks: int) -> float:
    """As a dribble, and frames more than 2 s after the ball last came up from the floor do not count: who only holds it
    does not bounce it."""
    return _lively(t, ~t.held & (t.ball_velocity[:, 2] > BOUNCED), period, ticks)


def _lively(t: Trace, event: np.ndarray, period: float, ticks: int) -> float:
    """The share of good frames that are less than ``LIVELY`` s after an ``event`` (T,) bool, or after the beginning."""
    frames = np.arange(len(event))
    last = np.maximum.accumulate(np.where(event, frames, 0))
    lively = (frames - last) * period < LIVELY
    return float((t.up & lively & (t.height > 0.5 * LENGTH) & (t.apart < 1.5 * LENGTH)).sum() / ticks)


RULES: dict[str, Callable[[Trace, float, int], float]] = {
    "pass": _thrown,
    "shot": _thrown,
    "catch": _caught,
    "dribble_in_place": _dribbled,
    "dribble_forward": _dribbled,
    "bounce": _bounced,
    "bounce_walk": _bounced,
    "pickup": _picked,
}
"""Success in [0, 1] of an episode of ``ticks``, had nothing failed, by skill; of every other skill: ``_kept``."""


def rule_of(skill: str) -> Callable[[Trace, float, int], float]:
    """What counts as a success of ``skill``."""
    return RULES.get(skill, _kept)


def succeeded(skill: str, trace: Trace, period: float, ticks: int, aimed: int = 0) -> float:
    """By the skill's rule. ``aimed``: frames at the beginning in which somebody aims the ball, which are nobody's merit."""
    performed = Trace(*(column[aimed:] for column in trace))
    return rule_of(skill)(performed, period, ticks - aimed) if len(performed.up) else 0.0


def ticks_of(graph: PolicyGraph, clip: int, seconds: float) -> int:
    """Of an episode of ``seconds`` from the beginning of clip number ``clip``; where that ends, at most ``config.after`` s
    beyond. A ball that is thrown is aimed before."""
    clips, config = graph.clips, graph.config
    if not (clips.swing[clip] or clips.loop[clip]):
        seconds = min(seconds, (clips.length[clip] - 1) * config.timestep + config.after)
    return math.ceil((seconds + aiming(graph, clip)) / config.period - 1e-6)


def ticks_aimed(graph: PolicyGraph, clip: int) -> int:
    """Of these, how many the ball of clip number ``clip`` is aimed for."""
    return round(aiming(graph, clip) / graph.config.period)


class Result(NamedTuple):
    """Of one skill over episodes: success by its rule, and means over frames until an episode failed."""

    success: Rate
    accuracy: float
    body_error: float  # m
    ball_error: float  # m
    contact_error: float


class Episodes(NamedTuple):
    """Of one skill, a row an episode."""

    success: np.ndarray  # (episodes,) in [0, 1], by the skill's rule
    sums: np.ndarray  # (episodes, 4) of Measures over its frames
    frames: np.ndarray  # (episodes,) until it ended

    def result(self) -> Result:
        """What they amount to."""
        body, ball, contact, right = (self.sums.sum(axis=0) / self.frames.sum()).tolist()
        return Result(Rate(round(float(self.success.sum())), len(self.success)), right, body, ball, contact)


def evaluate(
    graph: PolicyGraph,
    episodes: int,
    seconds: float,
    skills: Sequence[str] = (),
    push: float = 0.0,
    seed: int = 0,
    act: Callable[[Env], Tensor] | None = None,
) -> dict[str, Result]:
    """Of every skill (of ``skills``), ``episodes`` of ``seconds`` from the beginning of a clip (a clip that ends is
    over ``config.after`` s after its end), with robots and balls drawn from randomisation that training never saw.

    ``push``: m/s, the largest of random pushes. ``act``: what to do, (episodes, actions); by default what ``graph.actor``
    says.
    """
    chosen = skills or graph.config.skills
    return {skill: performed(graph, skill, episodes, seconds, push, seed, act).result() for skill in chosen}


def performed(
    graph: PolicyGraph,
    skill: str,
    episodes: int,
    seconds: float,
    push: float = 0.0,
    seed: int = 0,
    act: Callable[[Env], Tensor] | None = None,
    fixed: Mapping[str, np.ndarray] | None = None,
) -> Episodes:
    """As ``evaluate``, of one skill; ``fixed``: see ``episodes_of``."""
    env = episodes_of(graph, skill, episodes, seconds, push, seed, fixed)
    config = env.config
    act = act or (lambda e: graph.actor(e.observation))
    running, up = np.full(episodes, True), np.full(episodes, True)
    sums, frames, clips = np.zeros((episodes, len(Measures._fields))), np.zeros(episodes, int), env.clip.copy()
    rows: list[Trace] = []
    with torch.no_grad():
        while running.any():
            _, _, dones, _ = env.step(act(env))
            up = up & ~(running & env.failures)
            rows.append(traced(env, up))
            sums[running] += np.stack(measure(env.now), axis=1)[running]
            frames += running
            running &= ~dones.numpy().astype(bool)
    everything = Trace(*(np.stack(values) for values in zip(*rows, strict=True)))
    ticks = {clip: ticks_of(graph, clip, seconds) for clip in np.unique(clips)}
    aimed = {clip: ticks_aimed(graph, clip) for clip in ticks}
    shares = []
    for n, clip in enumerate(clips):
        trace = Trace(*(x[: min(frames[n], ticks[clip]), n] for x in everything))
        shares.append(succeeded(skill, trace, config.period, ticks[clip], aimed[clip]))
    return Episodes(np.array(shares), sums, frames)


def episodes_of(
    graph: PolicyGraph,
    skill: str,
    episodes: int,
    seconds: float,
    push: float = 0.0,
    seed: int = 0,
    fixed: Mapping[str, np.ndarray] | None = None,
) -> Env:
    """An environment in which every robot begins an episode of ``skill``: at the beginning of a clip, where its rule needs
    that. ``fixed``: of terms of the randomisation what they are in each episode (episodes,); NaN: drawn, as ever."""
    clips = np.flatnonzero(graph.clips.skill == graph.labels.index(skill)).tolist()
    config = dataclasses.replace(
        graph.config,
        envs=episodes,
        frames=round(seconds / graph.config.period) + max(ticks_aimed(graph, clip) for clip in clips),
        push_speed=push,
        push_chance=graph.config.push_chance if push else 0.0,
        anywhere=skill not in RULES,
        disturbed=0.0,
        easy=1.0,
        hopeless=(),
    )
    env = Env(config, UNSEEN + seed, graph, skill)
    if fixed:
        env.random.fixed = dict(fixed)
        env.reset()
    env.episode_length_buf[:] = 0
    return env


def traced(env: Env, up: np.ndarray) -> Trace:
    """This tick of every robot; ``up`` (envs,) bool: nothing failed so far."""
    state = env.now.state
    return Trace(state.contact[:, 0] > 0, state.object_velocity, env.apart, env.lifted, env.now.height, up)
