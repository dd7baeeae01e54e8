"""Contacts as a graph, on worlds small enough to know the answer."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
from mujoco.batch import Batch

from policies.contact_graph import ContactGraph, reference_edges

WORLD = """
<mujoco>
  <option timestep="0.002"/>
  <worldbody>
    <geom name="floor" type="plane" size="0 0 0.05"/>
    <body name="arm" pos="0 0 0.5">
      <geom name="palm" type="box" size="0.1 0.1 0.01"/>
      <body name="wrist" pos="0.3 0 0"><geom name="wrist" type="box" size="0.1 0.1 0.01"/></body>
    </body>
    <body name="trunk" pos="-1 0 0.5"><geom name="belly" type="box" size="0.1 0.1 0.5"/></body>
    <body name="ball" pos="0 0 {height}"><freejoint/><geom name="ball" size="0.1" mass="0.62"/></body>
  </worldbody>
</mujoco>
"""
NODES = {"hands": ["palm"], "body": ["belly", "wrist"], "ball": ["ball"], "floor": ["floor"]}
EDGES = [("ball", "hands"), ("ball", "body"), ("ball", "floor"), ("hands", "body")]
PLACES = {  # where the ball is put -> what it touches; penetrating by 1 mm
    "on the palm": ((0.0, 0.0, 0.609), [True, False, False, False]),
    "on the floor": ((0.0, 1.0, 0.099), [False, False, True, False]),
    "against the body": ((-1.199, 0.0, 0.5), [False, True, False, False]),
    "on the wrist": ((0.3, 0.0, 0.609), [False, True, False, False]),
    "between body and floor": ((-1.199, 0.0, 0.099), [False, True, True, False]),
    "in the air": ((0.0, 0.0, 1.5), [False, False, False, False]),
}


def world(graph: ContactGraph) -> mujoco.MjModel:
    spec = mujoco.MjSpec.from_string(WORLD.format(height=1.0))
    graph.prepare(spec)
    model = spec.compile()
    graph.attach(model)
    return model


def test_edges_of_every_simulation_of_a_batch():
    graph = ContactGraph(NODES, EDGES)
    batch = Batch(world(graph), len(PLACES), 1)
    sensordata = batch.bind("sensordata")
    for k, (place, _) in enumerate(PLACES.values()):
        batch.bind("qpos")[k, :3] = place
    batch.step()
    expected = np.array([edges for _, edges in PLACES.values()])
    np.testing.assert_array_equal(graph.touching(sensordata), expected)
    nodes = graph.node_values(graph.touching(sensordata))
    np.testing.assert_array_equal(nodes[0], [True, False, True, False])  # hands and ball


def test_the_force_is_the_weight_at_rest():
    graph = ContactGraph(NODES, EDGES)
    model = world(graph)
    data = mujoco.MjData(model)
    data.qpos[:3] = (0, 0, 0.61)
    for _ in range(1000):
        mujoco.mj_step(model, data)
    assert graph.force(data.sensordata)[0] == pytest.approx(0.62 * 9.81, rel=0.01)


def test_a_force_below_the_threshold_is_no_contact():
    graph = ContactGraph(NODES, EDGES, threshold=7.0)
    model = world(graph)
    data = mujoco.MjData(model)
    data.qpos[:3] = (0, 0, 0.61)
    for _ in range(1000):
        mujoco.mj_step(model, data)
    assert not graph.touching(data.sensordata).any()


def test_an_explicit_pair_counts_although_its_bits_do_not_match():
    spec = mujoco.MjSpec.from_string(WORLD.format(height=0.609))
    for geom in spec.geoms:
        if geom.name in ("ball", "palm"):
            geom.contype = geom.conaffinity = 0
    spec.add_pair(geomname1="ball", geomname2="palm")
    graph = ContactGraph(NODES, [("ball", "hands")])
    graph.prepare(spec)
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data)
    assert graph.attach(model).touching(data.sensordata).tolist() == [True]


@pytest.mark.parametrize(
    ("nodes", "edges", "words"),
    [
        (NODES, [("ball", "head")], "got node 'head', expected one of hands"),
        ({**NODES, "floor": ["palm"]}, EDGES, "palm in more than one"),
    ],
)
def test_a_graph_that_makes_no_sense_is_refused(nodes, edges, words):
    with pytest.raises(ValueError, match=words):
        ContactGraph(nodes, edges)


@pytest.mark.parametrize(
    ("node", "words"),
    [({"hands": ["thumb"]}, "no geom 'thumb'"), ({"body": ["floor"], "floor": []}, "none of their geoms can touch")],
)
def test_a_graph_that_does_not_fit_the_model_is_refused(node, words):
    graph = ContactGraph(NODES | node, [("hands", "body")])
    spec = mujoco.MjSpec.from_string(WORLD.format(height=1.0))
    for geom in spec.geoms:
        geom.contype = 0
    with pytest.raises(ValueError, match=words):
        graph.prepare(spec)


def test_a_model_without_sensors_is_refused():
    with pytest.raises(ValueError, match="call prepare"):
        ContactGraph(NODES, EDGES).attach(mujoco.MjSpec.from_string(WORLD.format(height=1.0)).compile())


def test_reference_graph_of_a_clip():
    hands = np.array([[True, False], [False, True], [False, False]])
    together = ContactGraph({"hands": ["l", "r"], "body": ["b"], "ball": ["o"]}, [("ball", "hands"), ("ball", "body")])
    apart = ContactGraph({"left": ["l"], "right": ["r"], "ball": ["o"]}, [("left", "ball"), ("ball", "right")])
    np.testing.assert_array_equal(reference_edges(together, hands, "ball", ["l", "r"]), [[1, 0], [1, 0], [0, 0]])
    np.testing.assert_array_equal(reference_edges(apart, hands, "ball", ["l", "r"]), hands)
