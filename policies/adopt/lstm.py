"""Rebuild an LSTM followed by an ELU MLP from TorchScript as ONNX with explicit state (legged_gym's recurrent export)."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from policies.adopt.splice import IR_VERSION, OPSET
from policies.adopt.torchscript import read_torchscript
from sim2real.policy import PolicyError

if TYPE_CHECKING:
    from onnx import ModelProto

PROBE_STEPS = 100
TOLERANCE = 1e-4


def rebuild_lstm(file: Path, observation_size: int) -> ModelProto:
    """obs (1, n), h_in and c_in (1, 1, hidden) -> action (1, m), h_out, c_out. Proved against the file's own answers to
    a random sequence, so any other architecture is refused. Raises PolicyError."""
    probe = np.random.default_rng(0).normal(size=(PROBE_STEPS, observation_size)).astype(np.float32)
    weights, expected = read_torchscript(file, probe)
    layers = sorted(int(k.split(".")[1]) for k in weights if k.startswith("actor.") and k.endswith(".weight"))
    if "memory.weight_hh_l0" not in weights or "memory.weight_hh_l1" in weights or not layers:
        raise PolicyError(
            f"{file}: got weights {sorted(weights)}, expected memory.*_l0 (one LSTM) and actor.<i>.* (MLP)"
        )
    network = _assemble(weights, layers)
    error = np.abs(_answers(network, probe) - expected).max()
    if not error < TOLERANCE:
        raise PolicyError(
            f"{file}: got a rebuilt network that differs by {error:.1e} from the TorchScript one, expected below"
            f" {TOLERANCE:g}; it is not an LSTM followed by an ELU MLP: adopt an ONNX file of it"
        )
    return network


def _assemble(weights: Mapping[str, np.ndarray], layers: list[int]) -> ModelProto:
    import onnx
    from onnx import helper, numpy_helper

    def gates(name: str) -> np.ndarray:
        """torch stacks the gates i, f, g, o (torch.nn.LSTM); ONNX i, o, f, c, where c is g."""
        i, f, g, o = np.split(weights[f"memory.{name}_l0"], 4)
        return np.concatenate([i, o, f, g])

    recurrent = gates("weight_hh")
    hidden = recurrent.shape[1]
    tensors = {
        "W": gates("weight_ih")[None],
        "R": recurrent[None],
        "B": np.concatenate([gates("bias_ih"), gates("bias_hh")])[None],
        "time": np.array([0]),
        "time_direction": np.array([0, 1]),
    }
    state_in, state_out = ["h_in", "c_in"], ["h_out", "c_out"]
    nodes = [
        helper.make_node("Unsqueeze", ["obs", "time"], ["sequence"]),
        helper.make_node("LSTM", ["sequence", "W", "R", "B", "", *state_in], ["Y", *state_out], hidden_size=hidden),
        helper.make_node("Squeeze", ["Y", "time_direction"], ["x0"]),
    ]
    for k, i in enumerate(layers):
        tensors |= {f"W{k}": weights[f"actor.{i}.weight"], f"b{k}": weights[f"actor.{i}.bias"]}
        last = i == layers[-1]
        nodes.append(helper.make_node("Gemm", [f"x{k}", f"W{k}", f"b{k}"], ["action" if last else f"z{k}"], transB=1))
        if not last:
            nodes.append(helper.make_node("Elu", [f"z{k}"], [f"x{k + 1}"]))
    value = lambda name, *shape: helper.make_tensor_value_info(name, onnx.TensorProto.FLOAT, shape)  # noqa: E731
    inputs, outputs = tensors["W"].shape[2], len(tensors[f"b{len(layers) - 1}"])
    graph = helper.make_graph(
        nodes,
        "lstm",
        [value("obs", 1, inputs), *(value(n, 1, 1, hidden) for n in state_in)],
        [value("action", 1, outputs), *(value(n, 1, 1, hidden) for n in state_out)],
        [numpy_helper.from_array(v, n) for n, v in tensors.items()],
    )
    return helper.make_model(graph, opset_imports=[helper.make_opsetid("", OPSET)], ir_version=IR_VERSION)


def _answers(network: ModelProto, probe: np.ndarray) -> np.ndarray:
    import onnxruntime

    session = onnxruntime.InferenceSession(network.SerializeToString(), providers=["CPUExecutionProvider"])
    state = {v.name: np.zeros(v.shape, np.float32) for v in session.get_inputs()[1:]}
    rows = []
    for row in probe:
        action, *after = session.run(None, {"obs": row[None], **state})
        state = dict(zip(state, after, strict=True))
        rows.append(np.asarray(action)[0])
    return np.stack(rows)
