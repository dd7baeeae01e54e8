"""Rebuild what TorchScript files of legged_gym's kind hold as ONNX: an ELU MLP, or an LSTM followed by one."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from policies.adopt.splice import IR_VERSION, OPSET
from policies.adopt.torchscript import read_torchscript
from sim2real.policy import PolicyError

if TYPE_CHECKING:
    from onnx import ModelProto, NodeProto

PROBE_STEPS = 100
TOLERANCE = 1e-4

Weights = dict[str, np.ndarray]


def rebuild_mlp(file: Path, observation_size: int) -> ModelProto:
    """obs (1, n) -> action (1, m). Proved against the file's own answers to random observations, so any other
    architecture is refused. Raises PolicyError."""
    weights, probe, expected = _read(file, observation_size)
    layers = _layers(weights, "")
    if not layers or len(weights) != 2 * len(layers):
        raise PolicyError(f"{file}: got weights {sorted(weights)}, expected <i>.weight and <i>.bias (an MLP)")
    nodes, tensors = _mlp(weights, "", layers, "obs")
    return _proved(file, _model(nodes, tensors, observation_size), probe, expected, "an ELU MLP")


def rebuild_lstm(file: Path, observation_size: int) -> ModelProto:
    """obs (1, n), h_in and c_in (1, 1, hidden) -> action (1, m), h_out, c_out. Proved as ``rebuild_mlp``.
    Raises PolicyError."""
    weights, probe, expected = _read(file, observation_size)
    layers = _layers(weights, "actor.")
    if "memory.weight_hh_l0" not in weights or "memory.weight_hh_l1" in weights or not layers:
        raise PolicyError(
            f"{file}: got weights {sorted(weights)}, expected memory.*_l0 (one LSTM) and actor.<i>.* (MLP)"
        )
    nodes, tensors, hidden = _lstm(weights, "x0")
    rest, further = _mlp(weights, "actor.", layers, "x0")
    network = _model([*nodes, *rest], tensors | further, observation_size, hidden)
    return _proved(file, network, probe, expected, "an LSTM followed by an ELU MLP")


def _read(file: Path, observation_size: int) -> tuple[Weights, np.ndarray, np.ndarray]:
    probe = np.random.default_rng(0).normal(size=(PROBE_STEPS, observation_size)).astype(np.float32)
    weights, expected = read_torchscript(file, probe)
    return weights, probe, expected


def _layers(weights: Weights, prefix: str) -> list[int]:
    """The numbers of ``prefix<i>.weight``, in order: layers between them have no weights."""
    numbers = (k.removeprefix(prefix).removesuffix(".weight") for k in weights if k.startswith(prefix))
    return sorted(int(k) for k in numbers if k.isdigit())


def _lstm(weights: Weights, output: str) -> tuple[list[NodeProto], Weights, int]:
    from onnx import helper

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
    nodes = [
        helper.make_node("Unsqueeze", ["obs", "time"], ["sequence"]),
        helper.make_node(
            "LSTM", ["sequence", "W", "R", "B", "", "h_in", "c_in"], ["Y", "h_out", "c_out"], hidden_size=hidden
        ),
        helper.make_node("Squeeze", ["Y", "time_direction"], [output]),
    ]
    return nodes, tensors, hidden


def _mlp(weights: Weights, prefix: str, layers: Sequence[int], name: str) -> tuple[list[NodeProto], Weights]:
    """From the tensor ``name`` to ``action``."""
    from onnx import helper

    nodes, tensors = [], {}
    for k, i in enumerate(layers):
        tensors |= {f"W{k}": weights[f"{prefix}{i}.weight"], f"b{k}": weights[f"{prefix}{i}.bias"]}
        last = i == layers[-1]
        nodes.append(helper.make_node("Gemm", [name, f"W{k}", f"b{k}"], ["action" if last else f"z{k}"], transB=1))
        if not last:
            name = f"x{k + 1}"
            nodes.append(helper.make_node("Elu", [f"z{k}"], [name]))
    return nodes, tensors


def _model(nodes: Sequence[NodeProto], tensors: Weights, observation_size: int, hidden: int = 0) -> ModelProto:
    """``hidden``: the size of the recurrent state, if there is one."""
    import onnx
    from onnx import helper, numpy_helper

    value = lambda name, *shape: helper.make_tensor_value_info(name, onnx.TensorProto.FLOAT, shape)  # noqa: E731
    state = lambda *names: [value(n, 1, 1, hidden) for n in names if hidden]  # noqa: E731
    actions = [len(v) for n, v in tensors.items() if n.startswith("b")][-1]
    graph = helper.make_graph(
        nodes,
        "rebuilt",
        [value("obs", 1, observation_size), *state("h_in", "c_in")],
        [value("action", 1, actions), *state("h_out", "c_out")],
        [numpy_helper.from_array(v, n) for n, v in tensors.items()],
    )
    return helper.make_model(graph, opset_imports=[helper.make_opsetid("", OPSET)], ir_version=IR_VERSION)


def _proved(file: Path, network: ModelProto, probe: np.ndarray, expected: np.ndarray, what: str) -> ModelProto:
    try:
        error = np.abs(_answers(network, probe) - expected).max()
    except Exception as failure:  # onnxruntime's exceptions share no base class; here: sizes that do not fit each other
        raise PolicyError(f"{file}: got {' '.join(str(failure).split())[:200]}, expected {what}") from None
    if not error < TOLERANCE:
        raise PolicyError(
            f"{file}: got a rebuilt network that differs by {error:.1e} from the TorchScript one, expected below"
            f" {TOLERANCE:g}; it is not {what}: adopt an ONNX file of it"
        )
    return network


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
