"""What may be inside a policy file: one sealed, self-contained ONNX graph of known operators. Nothing is executed here.

The **seal** is the sha256 of the file's own bytes with the seal's 64 digits replaced by zeros. It travels inside the
file, so that any damage, down to one flipped bit of a weight, is found without a second file to keep beside the first.
It is no signature: to pin one particular file, compare ``load_policy(..., sha256=...)``.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Iterator, Sequence
from typing import TYPE_CHECKING

from sim2real.contract import METADATA_KEY
from sim2real.types import Sim2realError

if TYPE_CHECKING:
    from onnx import GraphProto, ModelProto, NodeProto, TensorProto, ValueInfoProto

SEAL_KEY = "sim2real_seal"
MAX_BYTES = 64 * 2**20

# What exporters emit for feed-forward, recurrent and convolutional policies. Left out on purpose: operators that contain
# graphs (Loop, If, Scan: a file could then run for ever), random ones (no golden sequence could hold), strings,
# sequences and optional values.
OPERATORS = frozenset(
    """
    Abs Acos Add And ArgMax ArgMin Asin Atan AveragePool BatchNormalization Cast CastLike Ceil Celu Clip Concat Constant
    ConstantOfShape Conv ConvTranspose Cos Cosh CumSum Div Elu Equal Erf Exp Expand Flatten Floor GRU Gather
    GatherElements GatherND Gelu Gemm GlobalAveragePool GlobalMaxPool Greater GreaterOrEqual GroupNormalization
    HardSigmoid HardSwish Identity InstanceNormalization IsInf IsNaN LSTM LayerNormalization LeakyRelu Less LessOrEqual
    Log LogSoftmax MatMul Max MaxPool Mean Min Mish Mod Mul Neg Not OneHot Or PRelu Pad Pow RMSNormalization RNN Range
    Reciprocal ReduceL1 ReduceL2 ReduceLogSumExp ReduceMax ReduceMean ReduceMin ReduceProd ReduceSum ReduceSumSquare
    Relu Reshape Round ScatterElements ScatterND Selu Shape Sigmoid Sign Sin Sinh Size Slice Softmax Softplus Softsign
    Split Sqrt Squeeze Sub Sum Tan Tanh ThresholdedRelu Tile TopK Transpose Trilu Unsqueeze Where Xor
    """.split()
)


class PolicyError(Sim2realError):
    """A policy file that must not run: what, where, got, expected, next step."""


def parse(data: bytes, where: str) -> ModelProto:
    """The model in ``data``, after every check that needs no execution. Raises PolicyError."""
    import onnx

    if len(data) > MAX_BYTES:
        most = MAX_BYTES // 2**20
        raise PolicyError(f"{where}: got more than {most} MiB, expected at most {most}; is it a policy?")
    try:
        model = onnx.load_from_string(data)
    except Exception as error:  # protobuf raises DecodeError, and on some damage UnicodeDecodeError
        raise PolicyError(
            f"{where}: got {len(data)} bytes that do not parse, expected an ONNX file"
            f" ({_one_line(error)}); it is truncated or damaged: copy or export it again"
        ) from None
    if not model.graph.node:
        raise PolicyError(
            f"{where}: got no graph, expected an ONNX file; it is empty or something else: export it again"
        )
    refuse_strange(model, where)
    _check_seal(data, metadata(model), where)
    return model


def metadata(model: ModelProto) -> dict[str, str]:
    """The key-value pairs of an ONNX file."""
    return {p.key: p.value for p in model.metadata_props}


def tensors(values: Iterable[ValueInfoProto]) -> dict[str, tuple[str, list[int | str]]]:
    """name -> (element type, shape) of graph inputs or outputs; a free axis is its name, or ``"?"``."""
    import onnx

    types = onnx.TensorProto.DataType
    found = {}
    for value in values:
        tensor = value.type.tensor_type
        kind = "float32" if tensor.elem_type == types.Value("FLOAT") else types.Name(tensor.elem_type).lower()
        shape = [d.dim_value if d.HasField("dim_value") else d.dim_param or "?" for d in tensor.shape.dim]
        found[value.name] = (kind, shape)
    return found


def seal(model: ModelProto) -> bytes:
    """The bytes of ``model`` with its seal written into it."""
    import onnx

    kept = {k: v for k, v in metadata(model).items() if k != SEAL_KEY}
    onnx.helper.set_model_props(model, {**kept, SEAL_KEY: "0" * 64})
    blank = model.SerializeToString(deterministic=True)
    onnx.helper.set_model_props(model, {**kept, SEAL_KEY: hashlib.sha256(blank).hexdigest()})
    return model.SerializeToString(deterministic=True)


def sealed_constant(name: str, values: Sequence[float], found: dict[str, str]) -> bytes:
    """The bytes of a policy file with no input, whose one output ``name`` (1, n) is always ``values`` (n,). ``found``: its
    metadata."""
    import onnx

    make, shape, kind = onnx.helper, [1, len(values)], onnx.TensorProto.FLOAT
    output = make.make_tensor_value_info(name, kind, shape)
    tensor = make.make_tensor("values", kind, shape, values)
    graph = make.make_graph([make.make_node("Identity", ["values"], [name])], name, [], [output], [tensor])
    model = make.make_model(graph, opset_imports=[make.make_opsetid("", 17)], ir_version=8)
    make.set_model_props(model, found)
    return seal(model)


def _check_seal(data: bytes, found: dict[str, str], where: str) -> None:
    for key in (METADATA_KEY, SEAL_KEY):
        if key not in found:
            keys = ", ".join(sorted(found)) or "none"
            raise PolicyError(
                f"{where}: no metadata '{key}' (it has: {keys}), expected a policy written by `sim2real export`;"
                " a foreign policy becomes one with `sim2real adopt`"
            )
    digits = found[SEAL_KEY].encode()
    got = hashlib.sha256(data.replace(digits, b"0" * 64, 1)).hexdigest().encode()
    if len(digits) != 64 or data.count(digits) != 1 or got != digits:
        raise PolicyError(
            f"{where}: got seal {got[:12].decode()}..., expected {digits[:12].decode(errors='replace')}..., the one"
            " written at export; the file was changed or damaged since: copy or export it again"
        )


def refuse_strange(model: ModelProto, where: str) -> None:
    """Refuse whatever could read other files, run for ever, or call code that is not onnxruntime's own."""
    if model.functions:
        names = ", ".join(sorted({f.name for f in model.functions}))
        raise PolicyError(f"{where}: got model-local functions ({names}), expected none; inline them and export again")
    if model.graph.sparse_initializer:
        raise PolicyError(f"{where}: got sparse weights, expected dense ones; export again")
    for node in model.graph.node:
        if node.domain not in ("", "ai.onnx"):
            raise PolicyError(
                f"{where}: node '{node.name}': got operator {node.domain}.{node.op_type}, expected the standard ONNX"
                " domain; custom operators run unknown code: export without them"
            )
        if any(True for _ in _graphs(node)):
            raise PolicyError(
                f"{where}: node '{node.name}': got {node.op_type}, which contains a graph, expected a graph without"
                " loops or branches; export one step, with the state as carry_* inputs and outputs"
            )
        if node.op_type not in OPERATORS:
            raise PolicyError(
                f"{where}: node '{node.name}': got operator {node.op_type}, expected one of {', '.join(sorted(OPERATORS))}"
            )
    for tensor in _weights(model.graph):
        if tensor.data_location == tensor.EXTERNAL or tensor.external_data:
            raise PolicyError(
                f"{where}: tensor '{tensor.name}': got data in another file, expected it inside;"
                " export again with external_data=False"
            )


def _graphs(node: NodeProto) -> Iterator[GraphProto]:
    for attribute in node.attribute:
        if attribute.HasField("g"):
            yield attribute.g
        yield from attribute.graphs


def _weights(graph: GraphProto) -> Iterator[TensorProto]:
    yield from graph.initializer
    for node in graph.node:
        for attribute in node.attribute:
            if attribute.HasField("t"):
                yield attribute.t
            yield from attribute.tensors


def _one_line(error: Exception) -> str:
    text = " ".join(str(error).split())
    return f"{type(error).__name__}: {text[:160]}"
