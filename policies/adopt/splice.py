"""Write a policy graph as text around a network, then put the network in its place.

The text is ONNX's own syntax; one line calls the network as if it were an operator::

    action, hidden_next, cell_next = Network (observation, hidden, cell)
"""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from sim2real.policy import PolicyError

if TYPE_CHECKING:
    from numpy.typing import ArrayLike
    from onnx import ModelProto

OPSET = 17
IR_VERSION = 8


def splice(
    body: str,
    fields: Mapping[str, Any],
    constants: Mapping[str, ArrayLike],
    axes: Mapping[str, Sequence[int]],
    network: ModelProto,
) -> ModelProto:
    """The graph of ``body`` between the inputs and outputs of the contract's ``fields``, with ``constants`` (float32) and
    ``axes`` (int64) as weights and the nodes of ``network`` where it is called. Inputs and outputs of ``network`` are
    matched by position. Raises PolicyError if their numbers differ."""
    import onnx

    outside = [
        ", ".join(f"float[{','.join(map(str, [1, *shape]))}] {name}" for name, shape in fields[side].items())
        for side in ("inputs", "outputs")
    ]
    text = f"{fields['name']} ({outside[0]}) => ({outside[1]}) {{{body}}}"

    opset = next((e.version for e in network.opset_import if e.domain == ""), 0)
    if opset != OPSET:
        network = onnx.version_converter.convert_version(network, OPSET)
    graph = onnx.parser.parse_graph(text)
    nodes = list(graph.node)
    (place,) = [i for i, n in enumerate(nodes) if n.op_type == "Network"]
    call = nodes[place]
    inner = copy.deepcopy(network.graph)
    weights = {t.name for t in inner.initializer}
    inputs, outputs = [v.name for v in inner.input if v.name not in weights], [v.name for v in inner.output]
    if (len(inputs), len(outputs)) != (len(call.input), len(call.output)):
        raise PolicyError(
            f"network: got inputs {inputs} and outputs {outputs}, expected {len(call.input)} and {len(call.output)}:"
            f" {', '.join(call.input)} -> {', '.join(call.output)}; is this the dialect's network?"
        )
    outer = dict(zip([*inputs, *outputs], [*call.input, *call.output], strict=True))
    rename = lambda name: outer.get(name, f"network/{name}" if name else "")  # noqa: E731
    for node in inner.node:
        node.name = f"network/{node.name or node.output[0]}"
        node.input[:] = [rename(n) for n in node.input]
        node.output[:] = [rename(n) for n in node.output]
    for tensor in inner.initializer:
        tensor.name = rename(tensor.name)
    del graph.node[:]
    graph.node.extend([*nodes[:place], *inner.node, *nodes[place + 1 :]])
    arrays = {n: np.asarray(v, np.float32) for n, v in constants.items()}
    arrays |= {n: np.asarray(v, np.int64) for n, v in axes.items()}
    graph.initializer.extend(onnx.numpy_helper.from_array(v, n) for n, v in arrays.items())
    graph.initializer.extend(inner.initializer)
    return onnx.helper.make_model(graph, opset_imports=[onnx.helper.make_opsetid("", OPSET)], ir_version=IR_VERSION)
