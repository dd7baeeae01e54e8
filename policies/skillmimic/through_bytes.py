"""A ball skill judged in the deployed loop: real codecs, emulated motors, the safety gate, and a camera or the truth.

What counts is the same as in the training environment (``evaluate``): at every policy tick the body is compared with the
clip that the skill imitates, from the moment in which the skill began there. The robot begins it from its soft start,
or from the skill before, and not from the clip's first frame; so the clip is laid where the robot stands then, and turned
to where it faces.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from drivers.sim.ball import MASS, RADIUS
from policies.clips.kinematics import multiply, rotate
from policies.clips.robot import POINT_NAMES
from policies.skillmimic.evaluate import Measures, measure
from policies.skillmimic.graph import PolicyGraph
from policies.skillmimic.randomisation import TABLE
from policies.skillmimic.release import object_start
from policies.skillmimic.rewards import Motion, Step
from policies.skillmimic.terminations import failed, up
from policies.through_bytes import deployed, random_body
from sim2real.contract import ObjectStart
from sim2real.object.camera import CameraModel
from sim2real.object.scene import Handover
from sim2real.simulation import Scene, Simulation

BEFORE = 2.0  # s of the policy's first skill before another one begins


class Judge:
    """``each_tick`` of a Simulation: for ``seconds`` from ``begin`` s on, compares it with clip number ``clip`` of ``graph``."""

    def __init__(self, graph: PolicyGraph, clip: int, begin: float, seconds: float) -> None:
        self.graph, self.clip, self.begin, self.seconds = graph, clip, begin, seconds
        self.sums, self.frames, self.failed = np.zeros(len(Measures._fields)), 0, False
        self._touched: np.ndarray | None = None
        self._turn, self._shift = np.zeros(4), np.zeros(3)
        self._read: _Body | None = None

    def __call__(self, simulation: Simulation) -> None:
        body = self._read = self._read or _Body(self.graph, simulation.world.plant)
        since = simulation.since - self.begin
        touched = body.touching()
        self._touched = touched if self._touched is None else self._touched | touched
        decides = simulation.guardian.record["tick"][0] % simulation.every == 0
        if not (decides and 0 <= since < self.seconds) or self.failed:
            return
        clips, config = self.graph.clips, self.graph.config
        row = np.array([round(since / config.timestep)])
        reference = clips.motion(*clips.rows(np.array([self.clip]), row))
        state = body.motion(self._touched)
        if self.frames == 0:
            self._lay(state, reference)
        self._touched = None
        height, tilt = state.points[:, 0, 2], up(state.orientation_base_in_world)
        still, tilt_there = np.zeros((1, 1)), up(reference.orientation_base_in_world)
        step = Step(self._laid(state), reference, still, still, height, tilt, tilt_there)
        self.failed = bool(failed(step, config.terminations)[0])
        self.sums += np.array(measure(step))[:, 0]
        self.frames += 1

    def _lay(self, state: Motion, reference: Motion) -> None:
        """From the robot's place and heading to the clip's."""
        yaw = _yaw(reference.orientation_base_in_world[0]) - _yaw(state.orientation_base_in_world[0])
        self._turn = np.array([np.cos(yaw / 2), 0.0, 0.0, np.sin(yaw / 2)])
        here = rotate(self._turn, state.points[0, 0])
        self._shift = (reference.points[0, 0] - here) * [1.0, 1.0, 0.0]

    def _laid(self, m: Motion) -> Motion:
        return m._replace(
            points=rotate(self._turn, m.points) + self._shift,
            orientation_base_in_world=multiply(self._turn, m.orientation_base_in_world),
            object_position=rotate(self._turn, m.object_position) + self._shift,
            object_velocity=rotate(self._turn, m.object_velocity),
        )


class _Body:
    """A deployed robot and its ball as a Motion of one row."""

    def __init__(self, graph: PolicyGraph, plant: Any) -> None:
        self._plant, model = plant, plant.model
        place = graph.body.joint_ids
        named = graph.body.model
        self._anchors = {n: model.joint(named.joint(i).name).id for n, i in place.items()}
        self._sites = {n: model.site(n).id for n in POINT_NAMES if n not in place}
        self._base = model.body(graph.robot.base).id
        self._order = [plant.joints.index(name) for name in graph.joint_names]
        contacts = graph.contact_graph
        node = {geom: k for k, geoms in enumerate(contacts.nodes.values()) for geom in geoms}
        self._node = np.array([node.get(model.geom(g).name, -1) for g in range(model.ngeom)])
        names = list(contacts.nodes)
        self._edges = [frozenset((names.index(e.a), names.index(e.b))) for e in contacts.edges]

    def touching(self) -> np.ndarray:
        """(edges,) bool: which edges of the contact graph press on each other now.

        By depth: between two substeps MuJoCo has no forces, and what is deeper than nothing carries some.
        """
        contacts = self._plant.data.contact
        found = np.zeros(len(self._edges), bool)
        for pair, depth in zip(self._node[contacts.geom].tolist(), contacts.dist.tolist(), strict=True):
            if depth < 0 and (edge := frozenset(pair)) in self._edges:
                found[self._edges.index(edge)] = True
        return found

    def motion(self, touched: np.ndarray) -> Motion:
        plant, data = self._plant, self._plant.data
        place = {n: data.xanchor[i] for n, i in self._anchors.items()}
        place |= {n: data.site_xpos[i] for n, i in self._sites.items()}
        points = np.stack([data.xpos[self._base], *(place[n] for n in POINT_NAMES)])[None]
        return Motion(
            points=points,
            points_velocity=np.zeros_like(points),  # nothing that is judged looks at it
            orientation_base_in_world=data.xquat[self._base][None].copy(),
            joint_pos=plant.joint_pos[self._order][None],
            joint_vel=plant.joint_vel[self._order][None],
            object_position=plant.ball.position[None],
            object_velocity=plant.ball.velocity[None],
            contact=touched[None].astype(float),
        )


def deploy_episode(
    path: Path, graph: PolicyGraph, clip: int, seconds: float, camera: CameraModel | None, seed: int
) -> Judge:
    """One lockstep run of the skill of clip number ``clip``, on a randomised body with a randomised ball.

    ``seconds``: its length, at most the clip's where it does not swing. ``camera`` None: the policy is fed the truth about
    its ball. A fault of the safety gate fails the episode.
    """
    rng = np.random.default_rng([seed, clip])
    clips, config = graph.clips, graph.config
    label, first = graph.labels[clips.skill[clip]], graph.labels[0]
    if not clips.swing[clip]:
        seconds = min(seconds, (clips.length[clip] - 1) * config.timestep)
    before = [] if label == first else [(first, BEFORE)]
    judge = Judge(graph, clip, BEFORE if before else 0.0, seconds)
    scene = Scene(seed=seed, prepare=random_body(rng), camera=camera, ball=random_ball(rng))
    simulation = deployed(path, [*before, (label, seconds)], scene, each_tick=judge)
    starts = {n: ObjectStart.model_validate(object_start(graph, clip if n == label else 0)) for n in {first, label}}
    simulation.handover = Handover(simulation.world, starts)
    summary = simulation.run()
    judge.failed |= bool(summary.faults) or judge.frames < round((seconds - 0.1) / config.period)
    return judge


def random_ball(rng: np.random.Generator) -> dict[str, float]:
    """The ball's terms of the randomisation table."""
    x = {name: float(rng.uniform(TABLE[name].low, TABLE[name].high)) for name in TABLE if name.startswith("ball_")}
    return {"mass": MASS * x["ball_mass"], "radius": RADIUS * x["ball_radius"], "restitution": x["ball_restitution"]}


def _yaw(q: Sequence[float]) -> float:
    w, x, y, z = q
    return float(np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)))
