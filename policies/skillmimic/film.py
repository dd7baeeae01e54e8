"""A moving picture of a ball skill, as the deployed loop performs it. Needs an OpenGL (``drivers.sim.camera``)."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from drivers.sim.camera import Camera
from policies.skillmimic.evaluate import ticks_of
from policies.skillmimic.graph import PolicyGraph
from policies.skillmimic.through_bytes import before, deploy_episode
from sim2real.object.camera import SIGHTS, Sight
from sim2real.simulation import Simulation

TRIES = 5  # runs, of which the first good one is shown, else the last
GOOD = 0.5  # success of one
SECONDS = 4.0  # of a skill that does not end by itself
LEAD = 0.6  # s shown of the skill before it
SIZE, RATE = (300, 260), 12.5  # pixels, Hz: a few hundred kB


def film(path: Path, graph: PolicyGraph, label: str, gif: Path, sight: Sight) -> int:
    """Write ``gif`` of a skill of a policy file, robot and ball drawn at random and the ball seen by ``sight``. Returns which
    run it shows, from 1; 0: none was good, it shows the last."""
    clips = np.flatnonzero(graph.clips.skill == graph.labels.index(label))
    skill = before(graph, int(clips[0]))  # s: when it begins
    endless = label in (*graph.config.swing, *graph.config.loop)
    seconds = SECONDS if endless else np.inf

    def run(seed: int, watch: Callable[[Simulation], None] = lambda simulation: None) -> bool:
        clip = int(clips[seed % len(clips)])
        return deploy_episode(path, graph, clip, seconds, SIGHTS[sight], seed, watch).success >= GOOD

    good = next((seed for seed in range(TRIES) if run(seed)), -1)
    gif.parent.mkdir(parents=True, exist_ok=True)
    camera = Camera(gif, rate=RATE, width=SIZE[0], height=SIZE[1], distance=3.0)
    end = skill + ticks_of(graph, int(clips[good % TRIES % len(clips)]), seconds) * graph.config.period

    def watch(simulation: Simulation) -> None:
        if max(0.0, skill - LEAD) <= simulation.since <= end:
            camera.see(simulation.world.plant)

    run(good % TRIES, watch)
    camera.save()
    return good + 1
