"""A ball skill judged in the deployed loop: real codecs, emulated motors, the safety gate, and a camera or the truth.

What counts is the same as in the training environment (``evaluate``): its measures at every policy tick, of the robot and
the clip that the skill imitates, from the moment in which the skill began; and success by the same rules. The robot begins
from its soft start, or from the skill before, and not from the clip's first frame.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from drivers.sim.ball import MASS, RADIUS
from policies.clips.kinematics import heading, multiply, rotate
from policies.clips.robot import POINT_NAMES
from policies.parts import Array
from policies.skillmimic.evaluate import Measures, Trace, measure, succeeded, ticks_aimed, ticks_of
from policies.skillmimic.graph import PolicyGraph
from policies.skillmimic.randomisation import TABLE
from policies.skillmimic.release import NONE, graph_of
from policies.skillmimic.rewards import Motion, Step
from policies.skillmimic.stance import Place, arms, moved
from policies.skillmimic.starts import object_start
from policies.skillmimic.terminations import failed, up
from policies.through_bytes import deployed, random_body
from sim2real.contract import ObjectStart
from sim2real.object.camera import CameraModel
from sim2real.object.scene import Handover
from sim2real.policy import load_policy
from sim2real.simulation import Scene, Simulation

BEFORE = 2.0  # s of the policy's first skill before another one that needs the ball in the hands
AFTER = 0.1  # s that a run goes on after what is judged


class Judge:
    """``each_tick`` of a Simulation: from the moment in which the skill of clip number ``clip`` of ``graph`` begins there,
    compares it with the clip for ``ticks`` of the policy."""

    def __init__(self, graph: PolicyGraph, clip: int, ticks: int) -> None:
        self.graph, self.clip, self.ticks = graph, clip, ticks
        self.label = graph.labels[graph.clips.skill[clip]]
        self.sums, self.failed = np.zeros(len(Measures._fields)), False
        self._rows: list[tuple] = []  # of the Trace
        self._touched = np.zeros(0, bool)
        self._began: float | None = None
        self._clock: float | None = None
        self._laid: _Laid | None = None
        self._read: _Body | None = None

    @property
    def frames(self) -> int:
        """How many ticks were compared."""
        return len(self._rows)

    @property
    def success(self) -> float:
        """In [0, 1], by the skill's rule; 0 if it never began."""
        if not self._rows:
            return 0.0
        trace = Trace(*(np.array(column) for column in zip(*self._rows, strict=True)))
        trace.up[-1] &= not self.failed  # a fault shows only when all is over
        aimed = ticks_aimed(self.graph, self.clip)
        return succeeded(self.label, trace, self.graph.config.period, self.ticks, aimed)

    def __call__(self, simulation: Simulation) -> None:
        body = self._read = self._read or _Body(self.graph, simulation.world.plant)
        player, config, clips = simulation.player, self.graph.config, self.graph.clips
        touched = body.touching()
        self._touched = touched if not self._touched.size else self._touched | touched
        if self.failed or self.frames == self.ticks or simulation.guardian.record["tick"][0] % simulation.every:
            return
        touched, self._touched = self._touched, np.zeros(0, bool)
        before, self._clock = self._clock, self._now(player.policies[player.policy_index])
        if self._began is None:
            if simulation.since >= 0 and player.labels[player.skill] == self.label:
                self._began = simulation.since
            return  # whoever throws the ball does so now, and training too looks a tick later first
        state, qvel = body.motion(touched), body.velocity()
        since = simulation.since - self._began if before is None else before * config.period
        row = np.array([round(since / config.timestep)])
        rows, way = clips.rows(np.array([self.clip]), row)
        reference = clips.motion(rows, way)
        tilt = [up(m.orientation_base_in_world) for m in (state, reference)]
        low = [m.points[:, 0, 2] for m in (state, reference)]
        apart, lifted = np.linalg.norm(state.object_position - state.points[:, 0], axis=1), state.object_position[:, 2]
        state, reference = self._comparable(state, reference, qvel, body, rows)
        ends = not (clips.swing[self.clip] or clips.loop[self.clip])
        if ends and row[0] >= clips.length[self.clip] and not reference.contact[0, 0]:  # it flies where it may
            reference = reference._replace(object_position=state.object_position, object_velocity=state.object_velocity)
        step = Step(state, reference, np.zeros((1, 1)), np.zeros((1, 1)), *low, *tilt, clips.loop[[self.clip]])
        self.failed = bool(failed(step, config.terminations)[0])
        self.sums += np.array(measure(step))[:, 0]
        self._rows.append((touched[0], state.object_velocity[0], apart[0], lifted[0], low[0][0], not self.failed))

    def _now(self, policy: Any) -> float | None:
        """How far the plan is, in ticks, of a skill whose plan waits for its ball."""
        waits = self.graph.base is not None and self.label in self.graph.config.timed
        return max(0.0, float(policy.carries["carry_clock"][0])) if waits else None

    def _comparable(
        self, state: Motion, reference: Motion, qvel: np.ndarray, body: _Body, rows: np.ndarray
    ) -> tuple[Motion, Motion]:
        """Both where training compares them: seen from the trunk if the legs are a base policy's, else laid on the clip."""
        clips, graph = self.graph.clips, self.graph
        if graph.base is not None:
            there = clips.trunk_position[rows], clips.trunk_orientation[rows]
            state = arms(moved(state, qvel, body.trunk(), there), graph.acting)
            reference = arms(reference, graph.acting)
        else:
            self._laid = self._laid or _Laid.at(state, reference)
            state = self._laid(state)
        return state, reference


class _Laid(NamedTuple):
    """From a robot's place and heading to the clip's."""

    turn: np.ndarray  # (4,)
    shift: np.ndarray  # (3,) m

    @classmethod
    def at(cls, state: Motion, reference: Motion) -> _Laid:
        yaw = heading(reference.orientation_base_in_world[0]) - heading(state.orientation_base_in_world[0])
        turn = np.array([np.cos(yaw / 2), 0.0, 0.0, np.sin(yaw / 2)])
        return cls(turn, (reference.points[0, 0] - rotate(turn, state.points[0, 0])) * [1.0, 1.0, 0.0])

    def __call__(self, m: Motion) -> Motion:
        return m._replace(
            points=rotate(self.turn, m.points) + self.shift,
            orientation_base_in_world=multiply(self.turn, m.orientation_base_in_world),
            object_position=rotate(self.turn, m.object_position) + self.shift,
            object_velocity=rotate(self.turn, m.object_velocity),
        )


class _Body:
    """A deployed robot and its ball as a Motion of one row."""

    def __init__(self, graph: PolicyGraph, plant: Any) -> None:
        self._plant, model = plant, plant.model
        place = graph.body.joint_ids
        named = graph.body.model
        self._anchors = {n: model.joint(named.joint(i).name).id for n, i in place.items()}
        self._sites = {n: model.site(n).id for n in POINT_NAMES if n not in place}
        self._base, self._trunk = model.body(graph.robot.base).id, model.body(graph.body.trunk).id
        self._free = int(model.jnt_dofadr[model.body_jntadr[self._base]])
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

    def velocity(self) -> np.ndarray:
        """(1, 6) of the base: m/s in the world, rad/s in the base."""
        return self._plant.data.qvel[None, self._free : self._free + 6].copy()

    def trunk(self) -> Place:
        """Where the trunk is."""
        return self._plant.data.xpos[None, self._trunk].copy(), self._plant.data.xquat[None, self._trunk].copy()

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


def before(graph: PolicyGraph, clip: int) -> float:
    """s of the policy's first skill before that of clip number ``clip``: none where that is the first, or where somebody
    else has the ball, and the arms come from the soft start."""
    in_hands = graph.clips.skill[clip] > 0 and object_start(graph, clip)["how"] == "held"
    return BEFORE if in_hands else 0.0


def deploy_episode(
    path: Path,
    graph: PolicyGraph,
    clip: int,
    seconds: float,
    camera: CameraModel | None,
    seed: int,
    watch: Callable[[Simulation], None] = lambda simulation: None,
) -> Judge:
    """One lockstep run of the skill of clip number ``clip``, on a randomised body with a randomised ball.

    ``seconds``: its length, as in ``ticks_of``. A skill that walks is told a velocity as in training. ``camera`` None: the
    policy is fed the truth about its ball. A fault of the safety gate, and a run that ends before its time, fail. ``watch`` is
    called after every tick of the guardian.
    """
    rng = np.random.default_rng([seed, clip])
    config, ticks = graph.config, ticks_of(graph, clip, seconds)
    label, first = graph.labels[graph.clips.skill[clip]], graph.labels[0]
    starts = {n: ObjectStart.model_validate(object_start(graph, clip if n == label else 0)) for n in {first, label}}
    lead = before(graph, clip)
    steps = [(first, lead)] * (lead > 0) + [(label, ticks * config.period + AFTER)]
    judge = Judge(graph, clip, ticks)

    def each_tick(simulation: Simulation) -> None:
        judge(simulation)
        watch(simulation)

    scene = Scene(seed=seed, prepare=random_body(rng), camera=camera, ball=random_ball(rng))
    simulation = deployed(path, steps, scene, [NONE] * (len(steps) - 1) + [command(graph, label, rng)], each_tick)
    if starts[label].how == "thrown":
        flight = starts[label].velocity + rng.uniform(-config.throw, config.throw, 3)
        starts[label] = starts[label].model_copy(update={"velocity": tuple(flight.tolist())})
    elif starts[label].how == "placed":
        place = starts[label].position + np.append(rng.uniform(-config.placed, config.placed, 2), 0.0)
        starts[label] = starts[label].model_copy(update={"position": tuple(place.tolist())})
    simulation.handover = Handover(simulation.world, starts)
    summary = simulation.run()
    judge.failed |= bool(summary.faults) or judge.frames < ticks
    return judge


def judged(path: Path, clip: int, seconds: float, camera: CameraModel | None, seed: int) -> tuple[float, Array, int]:
    """Success, sums of Measures (4,) and frames of a ``deploy_episode`` of a policy file."""
    judge = deploy_episode(path, graph_in(path), clip, seconds, camera, seed)
    return judge.success, judge.sums, judge.frames


@functools.lru_cache(maxsize=1)
def graph_in(path: Path) -> PolicyGraph:
    """That a policy file was exported from, without its actor, built once a process."""
    return graph_of(load_policy(path, trial=0).contract)


def command(graph: PolicyGraph, label: str, rng: np.random.Generator) -> tuple[float, float, float]:
    """A velocity command (m/s, m/s, rad/s) for an episode of a skill, drawn as training draws them."""
    forward, left, turn = graph.draw(rng, np.array([graph.labels.index(label)]))[0].tolist()
    return forward, left, turn


def random_ball(rng: np.random.Generator) -> dict[str, float]:
    """The ball's terms of the randomisation table."""
    x = {name: float(rng.uniform(TABLE[name].low, TABLE[name].high)) for name in TABLE if name.startswith("ball_")}
    return {"mass": MASS * x["ball_mass"], "radius": RADIUS * x["ball_radius"], "restitution": x["ball_restitution"]}
