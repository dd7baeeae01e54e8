"""The contact graph: which named groups of geoms touch (SkillMimic, section 5.3.1), for one simulation or thousands.

A node is a group of geoms, an edge a pair of nodes, and an edge is 1 where any geom of one presses on any geom of the
other. MuJoCo measures that itself: ``prepare`` adds a contact sensor for every pair of geoms that can touch, so the
answer comes with ``sensordata``, from ``MjData`` and from ``mujoco.batch`` alike, and costs some 5 % of a step for the
54 pairs of a G1 and a ball. Isaac Gym, which the paper used, has no such sensors: its code looks at net forces of nodes
and cannot tell who touches whom.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import mujoco
import numpy as np

THRESHOLD = 0.1  # N of normal force; what the paper's code asks of a force component


class Edge(NamedTuple):
    """Two nodes."""

    a: str
    b: str

    def __str__(self) -> str:
        return f"{self.a}-{self.b}"


class ContactGraph:
    """``nodes``: name -> names of its geoms; ``edges``: which pairs of nodes matter. Raises ValueError, by name, for an
    edge to no node and a geom in two nodes.

    Use: ``prepare(spec)`` before the model is compiled, ``attach(model)`` after, then ``touching(sensordata)``.
    """

    def __init__(
        self, nodes: Mapping[str, Sequence[str]], edges: Sequence[tuple[str, str]], threshold: float = THRESHOLD
    ) -> None:
        self.nodes = {name: tuple(geoms) for name, geoms in nodes.items()}
        self.edges = tuple(Edge(*edge) for edge in edges)
        self.threshold = threshold
        for edge in self.edges:
            for node in edge:
                if node not in self.nodes:
                    raise ValueError(f"edge {edge}: got node '{node}', expected one of {', '.join(self.nodes)}")
        members = [geom for geoms in self.nodes.values() for geom in geoms]
        if twice := sorted({g for g in members if members.count(g) > 1}):
            raise ValueError(f"nodes: got {', '.join(twice)} in more than one, expected every geom in one node")
        self._columns = np.zeros(0, np.intp)  # of sensordata: normal forces, edge by edge
        self._first = np.zeros(0, np.intp)  # where each edge's columns begin

    def prepare(self, spec: mujoco.MjSpec) -> None:
        """Add the contact sensors. Raises ValueError for an unknown geom and for an edge that can never be 1."""
        geoms = {g.name: g for g in spec.geoms}
        explicit = {frozenset((p.geomname1, p.geomname2)) for p in spec.pairs}
        for e, edge in enumerate(self.edges):
            for geom in (*self.nodes[edge.a], *self.nodes[edge.b]):
                if geom not in geoms:
                    raise ValueError(f"edge {edge}: no geom '{geom}', expected one of {', '.join(filter(None, geoms))}")
            pairs = [
                (a, b)
                for a in self.nodes[edge.a]
                for b in self.nodes[edge.b]
                if frozenset((a, b)) in explicit or can_touch(geoms[a], geoms[b])
            ]
            if not pairs:
                raise ValueError(f"edge {edge}: none of their geoms can touch, expected a pair that collides")
            for k, (a, b) in enumerate(pairs):
                sensor = spec.add_sensor(
                    name=f"contact/{e}/{k}",
                    type=mujoco.mjtSensor.mjSENS_CONTACT,
                    objtype=mujoco.mjtObj.mjOBJ_GEOM,
                    objname=a,
                    reftype=mujoco.mjtObj.mjOBJ_GEOM,
                    refname=b,
                )
                # What it reports (the force, in the contact's frame: normal first), of which contact (2: the one with
                # the largest force), and of how many.
                sensor.intprm[:3] = [1 << int(mujoco.mjtConDataField.mjCONDATA_FORCE), 2, 1]

    def attach(self, model: mujoco.MjModel) -> ContactGraph:
        """Find the sensors in the compiled model. Raises ValueError if ``prepare`` never saw its spec."""
        columns: list[list[int]] = [[] for _ in self.edges]
        for s in range(model.nsensor):
            name = model.sensor(s).name
            if name.startswith("contact/"):
                columns[int(name.split("/")[1])].append(int(model.sensor_adr[s]))
        if not all(columns):
            raise ValueError("contact graph: the model has no contact sensors; call prepare(spec) before compiling it")
        self._columns = np.concatenate([np.array(c, np.intp) for c in columns])
        self._first = np.cumsum([0, *map(len, columns)])[:-1]
        return self

    def force(self, sensordata: np.ndarray) -> np.ndarray:
        """(..., edges) N, the largest normal force of each edge, from ``sensordata`` (..., nsensordata)."""
        return np.maximum.reduceat(np.abs(sensordata[..., self._columns]), self._first, axis=-1)

    def touching(self, sensordata: np.ndarray) -> np.ndarray:
        """(..., edges) bool, from ``sensordata`` (..., nsensordata)."""
        return self.force(sensordata) > self.threshold

    def node_values(self, touching: np.ndarray) -> np.ndarray:
        """(..., nodes) bool: whether a node touches any other, from edges (..., edges); what the paper's nodes store."""
        incident = np.array([[node in edge for node in self.nodes] for edge in self.edges])
        return np.any(touching[..., None] & incident, axis=-2)


def can_touch(a: mujoco.MjsGeom, b: mujoco.MjsGeom) -> bool:
    """Whether MuJoCo's filters let these geoms collide: bits, and not the same body or parent and child."""
    if not (a.contype & b.conaffinity or b.contype & a.conaffinity):
        return False
    one, other = a.parent.name, b.parent.name
    if one == other:
        return False
    parents = [g.parent.parent.name if g.parent.name != "world" else None for g in (a, b)]
    return not (parents[0] == other != "world" or parents[1] == one != "world")


def reference_edges(graph: ContactGraph, hands: np.ndarray, ball: str, sides: Sequence[str]) -> np.ndarray:
    """(T, edges) bool: the reference graph of a clip whose per-hand contacts are ``hands`` (T, len(sides)) bool.

    ``sides``: a geom of each hand. An edge between ``ball`` and a node with hands is 1 where one of its hands touches;
    every other edge of a reference is 0, as in the paper.
    """
    result = np.zeros((len(hands), len(graph.edges)), bool)
    for e, edge in enumerate(graph.edges):
        other = edge.b if edge.a == ball else edge.a
        if ball in edge and other != ball:
            mine = [k for k, geom in enumerate(sides) if geom in graph.nodes[other]]
            result[:, e] = hands[:, mine].any(axis=1)
    return result
