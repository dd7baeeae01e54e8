"""A ball skill as a policy file: what the contract says, and that the file answers as the graph does."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from policies.skillmimic.config import SkillMimic
from policies.skillmimic.graph import PolicyGraph
from policies.skillmimic.release import export_graph, record


@pytest.mark.slow
def test_a_ball_skill_is_a_policy_file(tmp_path):
    torch.manual_seed(0)
    graph = PolicyGraph(SkillMimic(threads=1))
    graph.actor = torch.nn.Sequential(
        torch.nn.Linear(graph.outputs()["observation"][0], 16), torch.nn.ELU(), torch.nn.Linear(16, 29)
    )
    policy = export_graph(graph.eval(), tmp_path / "hold.onnx")
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
