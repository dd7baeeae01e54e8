"""A ball skill as a policy file: what the contract says, and that the file answers as the graph does."""

from __future__ import annotations

import json

import mujoco
import numpy as np
import pytest
import torch

from drivers.sim.ball import RADIUS
from policies.skillmimic.config import SkillMimic
from policies.skillmimic.graph import PolicyGraph
from policies.skillmimic.release import graph_of, record
from policies.skillmimic.starts import object_start
from policies.skillmimic.through_bytes import deploy_episode
from sim2real.object.camera import CameraModel
from sim2real.policy import load_policy
from sim2real.types import Sim2realError


@pytest.fixture(scope="module")
def graph():
    """One that has learned nothing: what it adds to its posture is small."""
    torch.manual_seed(0)
    graph = PolicyGraph(SkillMimic(threads=1))
    graph.actor = torch.nn.Sequential(
        torch.nn.Linear(graph.outputs()["observation"][0], 16), torch.nn.ELU(), torch.nn.Linear(16, 29)
    )
    torch.nn.init.normal_(graph.actor[2].weight, std=1e-3)
    torch.nn.init.zeros_(graph.actor[2].bias)
    return graph.eval()


@pytest.mark.slow
def test_a_ball_skill_is_a_policy_file(graph, file):
    policy = load_policy(file, trial=0)
    assert policy.contract.skill_labels == ("hold",)
    assert policy.contract.inputs["object_position_in_base"] == [3]
    assert set(policy.contract.carry) == {"carry_action", "carry_history"}
    sequence = record(graph)[0][0]
    carries = {n: torch.zeros(1, *graph.inputs()[n]) for n in graph.carry_start()}
    policy.reset()
    with torch.no_grad():
        for t in range(10):
            signals = {name: rows[t] for name, rows in sequence.items()}
            tensors = [torch.tensor(v)[None] for v in signals.values()]
            outputs = dict(zip(graph.outputs(), graph(*tensors, *carries.values()), strict=True))
            carries = {name: outputs[f"{name}_next"] for name in carries}
            got = policy.step(signals)["joint_pos_target"]
            np.testing.assert_allclose(got, outputs["joint_pos_target"][0], atol=1e-5)


@pytest.mark.slow
def test_the_file_says_what_it_was_made_of(graph, file):
    contract = load_policy(file, trial=0).contract
    again = graph_of(contract)
    torch.testing.assert_close(again.postures, graph.postures)
    assert again.clips.names == graph.clips.names
    assert contract.object is not None and contract.object.radius == RADIUS


@pytest.mark.slow
def test_a_file_of_another_version_is_named(file):
    contract = load_policy(file, trial=0).contract
    made = json.loads(contract.provenance.training["settings"]) | {"borrows": {}}
    training = contract.provenance.training | {"settings": json.dumps(made)}
    older = contract.model_copy(update={"provenance": contract.provenance.model_copy(update={"training": training})})
    with pytest.raises(Sim2realError, match="its settings are of another version.*borrows"):
        graph_of(older)


@pytest.mark.slow
def test_a_held_ball_is_where_the_palms_of_the_start_posture_are(graph, file):
    contract = load_policy(file, trial=0).contract
    start, body = contract.skills[0].object, graph.body
    assert start.how == "held" and start.model_dump()["position"] == tuple(object_start(graph, 0)["position"])
    data = mujoco.MjData(body.model)
    places = {}
    for name in ("default_joint_pos", "approach_joint_pos"):
        data.qpos[:] = body.model.qpos0
        data.qpos[body.qpos_at] = getattr(contract, name)
        mujoco.mj_kinematics(body.model, data)
        base = body.model.body(graph.robot.base).id
        palms = (data.site_xpos[body.palms] - data.xpos[base]) @ data.xmat[base].reshape(3, 3)
        places[name] = np.linalg.norm(palms - np.array(start.position), axis=1)
        # Targets lie above by what arms and ball weigh, in soft motors.
        np.testing.assert_allclose(palms.mean(axis=0), np.add(start.position, [0.0, 0.0, 0.05]), atol=0.05)
    assert (places["approach_joint_pos"] > RADIUS + 0.04 + 0.02).all()  # the palm's own radius, and air
    assert (places["default_joint_pos"] < RADIUS + 0.04).all()  # they press


@pytest.mark.slow
@pytest.mark.parametrize("camera", [None, CameraModel()])
def test_nothing_learned_holds_the_ball_for_a_second_through_the_bytes(graph, file, camera):
    """As in training, where posture and grip alone hold it for some seconds: the two worlds are one."""
    judged = deploy_episode(file, graph, 0, 1.0, camera, seed=0)
    assert not judged.failed and judged.frames == 50
    body, ball, _, right = judged.sums / judged.frames
    assert body < 0.05 and ball < 0.1 and right > 0.9


@pytest.mark.slow
def test_an_episode_that_never_begins_has_failed(graph, file):
    """A camera that sees nothing: the robot is never armed."""
    judged = deploy_episode(file, graph, 0, 0.2, CameraModel(loss=1.0), seed=0)
    assert judged.failed
