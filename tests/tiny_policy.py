"""The smallest policy under the contract, and the means to spoil it: each test changes one thing and seals the file.

It drives every joint: ``joint_pos_target = default + W joint_pos + 0.001 count``, with ``count`` carried.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import onnx

from sim2real.config import RobotConfig
from sim2real.contract import METADATA_KEY
from sim2real.graph import seal

STEPS = 20
TEXT = """
tiny (float[1,{n}] joint_pos, float[1,1] carry_count) => (float[1,{n}] joint_pos_target, float[1,1] carry_count_next) {{
    pulled = MatMul (joint_pos, weights)
    drift = Mul (carry_count, rate)
    moved = Add (pulled, drift)
    joint_pos_target = Add (moved, default)
    carry_count_next = Add (carry_count, one)
}}
"""


SEEING = (
    TEXT.replace("joint_pos,", "joint_pos, float[1,3] object_position_in_base,", 1)
    .replace(
        "    moved",
        "    ignored = MatMul (object_position_in_base, blind)\n    there = Add (drift, ignored)\n    moved",
    )
    .replace("(pulled, drift)", "(pulled, there)")
)


def weights(n: int) -> np.ndarray:
    """(n, n) float32, small."""
    return (0.05 * np.random.default_rng(1).normal(size=(n, n))).astype(np.float32)


def model(robot: RobotConfig, text: str = TEXT) -> onnx.ModelProto:
    """The graph, without metadata."""
    n = len(robot.joint_names)
    graph = onnx.parser.parse_graph(text.format(n=n))
    values = {"weights": weights(n), "rate": 0.001, "default": robot.home_pos[None], "one": 1.0}
    if "blind" in text:
        values["blind"] = np.zeros((3, n))
    graph.initializer.extend(onnx.numpy_helper.from_array(np.asarray(v, np.float32), k) for k, v in values.items())
    return onnx.helper.make_model(graph, opset_imports=[onnx.helper.make_opsetid("", 17)], ir_version=8)


def document(robot: RobotConfig) -> dict[str, Any]:
    """The contract; the golden outputs are numpy's."""
    n = len(robot.joint_names)
    rng = np.random.default_rng(2)
    golden = []
    for _ in range(3):
        joint_pos = robot.home_pos + rng.uniform(-0.02, 0.02, (STEPS, n))
        target = robot.home_pos + joint_pos @ weights(n) + 0.001 * np.arange(STEPS)[:, None]
        golden.append(
            {"steps": STEPS, "inputs": {"joint_pos": joint_pos.tolist()}, "outputs": {"joint_pos_target": target.tolist()}}
        )  # fmt: skip
    return {
        "name": "tiny",
        "robot": robot.name,
        "variants": list(robot.variants),
        "period": 0.02,
        "joint_names": list(robot.joint_names),
        "target_joint_names": list(robot.joint_names),
        "default_joint_pos": robot.home_pos.tolist(),
        "kp": robot.home_kp.tolist(),
        "kd": robot.home_kd.tolist(),
        "inputs": {"joint_pos": [n], "carry_count": [1]},
        "outputs": {"joint_pos_target": [n], "carry_count_next": [1]},
        "carry": {"carry_count": {"shape": [1]}},
        "skills": [{"label": "stand"}],
        "default_skill": "stand",
        "golden": golden,
        "provenance": {"source": "a test", "licence": "Apache-2.0"},
    }


def seeing(robot: RobotConfig, **start: Any) -> tuple[onnx.ModelProto, dict[str, Any]]:
    """The same, fed where a ball is, which it ignores; graph and contract. ``start``: how its skill finds the ball."""
    contract = document(robot)
    contract["inputs"]["object_position_in_base"] = [3]
    for golden in contract["golden"]:
        golden["inputs"]["object_position_in_base"] = [[0.5, 0.0, 0.0]] * STEPS
    contract["object"] = {"radius": 0.09, "mass": 0.62, "restitution": 0.8}
    contract["skills"][0]["object"] = start
    return model(robot, SEEING), contract


def write(path: Path, graph: onnx.ModelProto, contract: dict[str, Any] | str, **more: str) -> Path:
    """Seal ``graph`` and ``contract``, right or wrong, into a file; ``more`` metadata beside it."""
    text = contract if isinstance(contract, str) else json.dumps(contract)
    onnx.helper.set_model_props(graph, {METADATA_KEY: text, **more})
    path.write_bytes(seal(graph))
    return path
