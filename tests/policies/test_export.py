"""Export: what torch computes is what the file computes, and the file tells nothing about the machine it came from."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import onnx
import pytest

from policies.export import envelope, export, numbers
from sim2real.config import load_robot
from sim2real.graph import metadata
from sim2real.policy import PolicyError, load_policy
from sim2real.types import Sim2realError

torch = pytest.importorskip("torch", reason="export needs torch: pip install 'sim2real[train]'")
G1 = load_robot("g1")
N = len(G1.joint_names)


class Recurrent(torch.nn.Module):
    """An LSTM, a value per skill, a counter: everything a contract can hold."""

    def __init__(self) -> None:
        super().__init__()
        torch.manual_seed(0)
        self.register_buffer("home", torch.tensor(G1.home_pos, dtype=torch.float32))
        self.lstm = torch.nn.LSTM(2 * N + 9, 16)
        self.actor = torch.nn.Sequential(torch.nn.Linear(16, 32), torch.nn.ELU(), torch.nn.Linear(32, N))
        self.critic = torch.nn.Linear(16, 2)

    def inputs(self):
        return {
            "joint_pos": [N],
            "joint_vel": [N],
            "orientation_base_in_world": [4],
            "angular_velocity_base_in_base": [3],
            "skill": [2],
            "carry_hidden": [16],
            "carry_cell": [16],
            "carry_count": [1],
        }

    def outputs(self):
        return {
            "joint_pos_target": [N],
            "skill_value": [2],
            "observation": [2 * N + 9],
            "carry_hidden_next": [16],
            "carry_cell_next": [16],
            "carry_count_next": [1],
        }

    def carry_start(self):
        return {"carry_hidden": [], "carry_cell": [0.1] * 16, "carry_count": []}

    def forward(self, joint_pos, joint_vel, orientation, gyro, skill, hidden, cell, count):
        observation = torch.cat([joint_pos - self.home, 0.05 * joint_vel, orientation, gyro, skill], 1)
        features, (hidden, cell) = self.lstm(observation[None], (hidden[None], cell[None]))
        action = torch.tanh(self.actor(features[0])) * torch.cos(count / 10)
        target = self.home + 0.1 * action
        return target, self.critic(features[0]), observation, hidden[0], cell[0], torch.remainder(count + 1, 40)


def sequences(count=3, steps=25):
    rng = np.random.default_rng(0)
    made = []
    for _ in range(count):
        quaternion = np.array([1.0, 0, 0, 0]) + rng.normal(size=(steps, 4)) * 0.1
        made.append(
            {
                "joint_pos": G1.home_pos + 0.02 * rng.normal(size=(steps, N)),
                "joint_vel": rng.normal(size=(steps, N)),
                "orientation_base_in_world": quaternion / np.linalg.norm(quaternion, axis=1, keepdims=True),
                "angular_velocity_base_in_base": rng.normal(size=(steps, 3)),
                "skill": np.eye(2)[rng.integers(0, 2, steps)],
            }
        )
    return made


FIELDS = {
    "name": "recurrent",
    "robot": "g1",
    "period": 0.02,
    "joint_names": list(G1.joint_names),
    "target_joint_names": list(G1.joint_names),
    "default_joint_pos": G1.home_pos.tolist(),
    "kp": (G1.home_kp / 3).tolist(),
    "kd": G1.home_kd.tolist(),
    "action_scale": [0.1] * N,
    "skills": [{"label": "stand"}, {"label": "wave", "value_min": 0.2}],
    "default_skill": "stand",
    "provenance": {"source": "a test", "licence": "Apache-2.0", "revision": "abc"},
}


@pytest.fixture(scope="module")
def file(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("export") / "recurrent.onnx"
    export(Recurrent(), path, fields={**FIELDS, "envelope": envelope(sequences())}, sequences=sequences())
    return path


def test_file_computes_what_torch_computes(file):
    """On inputs that are not among the golden ones."""
    policy, module = load_policy(file, G1), Recurrent().eval()
    (sequence,) = sequences(1, steps=60)
    hidden, cell, count = torch.zeros(1, 16), torch.full((1, 16), 0.1), torch.zeros(1, 1)
    with torch.no_grad():
        for t in range(60):
            inputs = {n: rows[t] for n, rows in sequence.items()}
            signals = [torch.tensor(v, dtype=torch.float32)[None] for v in inputs.values()]
            target, value, _, hidden, cell, count = module(*signals, hidden, cell, count)
            policy.step(inputs)
            np.testing.assert_allclose(policy.joint_pos_target, target[0], atol=1e-5)
            np.testing.assert_allclose(policy.skill_value, value[0], atol=1e-5)


def test_contract_follows_from_the_module(file):
    contract = load_policy(file, trial=0).contract
    assert contract.inputs == Recurrent().inputs() and contract.outputs == Recurrent().outputs()
    assert contract.carry["carry_cell"].start == [0.1] * 16 and contract.carry["carry_hidden"].start == []
    assert [g.steps for g in contract.golden] == [25] * 3
    assert contract.provenance.tools["torch"] and contract.provenance.revision == "abc"
    assert contract.envelope["joint_vel"].max[0] == numbers(max(s["joint_vel"][:, 0].max() for s in sequences()))


def test_keys_for_other_stacks_keep_full_precision(file):
    keys = metadata(onnx.load_from_string(file.read_bytes()))
    assert [float(v) for v in keys["joint_stiffness"].split(",")] == FIELDS["kp"]
    assert keys["joint_names"].split(",") == FIELDS["joint_names"]
    assert [float(v) for v in keys["default_joint_pos"].split(",")] == FIELDS["default_joint_pos"]
    assert keys["command_names"] == "skill" and keys["observation_names"].startswith("joint_pos,joint_vel,orientation")
    assert json.loads(keys["sim2real"])["schema_version"] == 1


def test_same_module_same_bytes(file, tmp_path):
    export(Recurrent(), tmp_path / "b", fields={**FIELDS, "envelope": envelope(sequences())}, sequences=sequences())
    assert (tmp_path / "b").read_bytes() == file.read_bytes()


def test_one_file_that_does_not_tell_where_it_was_made(file):
    assert [p.name for p in file.parent.iterdir()] == [file.name]
    data = file.read_bytes()
    for trace in (str(Path(__file__).resolve().parents[2]), str(Path.home()) + "/", "site-packages", ".py"):
        assert trace.encode() not in data, trace


def test_numbers_are_the_same_float32():
    values = np.random.default_rng(0).normal(size=1000).astype(np.float32)
    assert np.array_equal(np.array(json.loads(json.dumps(numbers(values))), np.float32), values)


@pytest.mark.parametrize(
    ("fields", "made", "words"),
    [
        ({}, sequences(2), r"got golden sequences of \[25, 25\] steps, expected at least 3 of 20"),
        ({}, sequences(3, steps=19), r"got golden sequences of \[19, 19, 19\] steps"),
        ({"kp": [1.0]}, sequences(), "kp: got 1 numbers, expected 29"),
        ({"kp": [1000.0] * N}, sequences(), "kp.left_hip_pitch_joint: got 1000, expected at most 200"),
        ({"robot_name": "g1"}, sequences(), r"robot_name: unknown key"),
        ({"robot": "g2"}, sequences(), r"robot 'g2': no file"),
    ],
)
def test_refusals(fields, made, words, tmp_path):
    """And nothing is written."""
    with pytest.raises(Sim2realError, match=words):
        export(Recurrent(), tmp_path / "x.onnx", fields={**FIELDS, **fields}, sequences=made)
    assert list(tmp_path.iterdir()) == []


def test_operators_outside_the_list_are_refused_at_export(tmp_path):
    class Noisy(Recurrent):
        def forward(self, *tensors):
            target, *rest = super().forward(*tensors)
            return target + 0 * torch.rand_like(target), *rest

    with pytest.raises(PolicyError, match="got operator Random"):
        export(Noisy(), tmp_path / "x.onnx", fields=FIELDS, sequences=sequences())
    assert list(tmp_path.iterdir()) == []
