"""Export: from a torch module to one policy file under the contract, with golden sequences inside.

A module is exported as it trains. It says what its tensors are called and takes and returns them in that order, each
with a batch axis of 1 (see ``Exportable``; the vocabulary is ``sim2real.contract.INPUTS`` and ``OUTPUTS``)::

    export(module, "basics.onnx", fields=dict(name="basics", robot="g1", ...), sequences=[...])

Same module, fields and sequences: same bytes. ``pack`` is the half that needs no torch; ``policies.adopt`` uses it too.
"""

from __future__ import annotations

import logging
import math
import os
import tempfile
import warnings
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from pydantic import ValidationError

from sim2real.config import RobotConfig, explain, load_robot
from sim2real.contract import CARRY, METADATA_KEY, Contract
from sim2real.graph import seal
from sim2real.policy import Policy, PolicyError, load_policy, refuse_mismatches

if TYPE_CHECKING:
    from onnx import ModelProto

OPSET = 18
IR_VERSION = 10
SEQUENCES = 3  # at least, of golden inputs
STEPS = 20  # at least, in each


def pack(model: ModelProto, contract: Contract, path: str | Path, robot: RobotConfig | None = None) -> Policy:
    """Write ``model`` with its contract to ``path`` and prove the file; ``path`` is touched only by a file that loads.

    Raises PolicyError, by name, for whatever ``load_policy`` would refuse later.
    """
    import onnx

    path = Path(path)
    _anonymise(model)
    onnx.helper.set_model_props(model, {METADATA_KEY: contract.model_dump_json(), **_csv(contract)})
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.NamedTemporaryFile(dir=path.parent, prefix=f".{path.name}.", delete=False) as draft:
            draft.write(seal(model))
    except OSError as error:
        raise PolicyError(f"{path}: {error.strerror}, expected a place to write; choose another with -o") from None
    try:
        load_policy(draft.name, robot or load_robot(contract.robot))
        os.chmod(draft.name, 0o644)
        os.replace(draft.name, path)
    except PolicyError as error:
        raise PolicyError(str(error).replace(draft.name, str(path))) from None
    finally:
        Path(draft.name).unlink(missing_ok=True)
    return load_policy(path, trial=0)


def numbers(values: Any) -> Any:
    """Nested lists of the shortest decimals that read back as the same float32 values."""
    array = np.asarray(values, np.float32)
    return [numbers(v) for v in array] if array.ndim else float(str(array[()]))


def golden(inputs: Mapping[str, np.ndarray], outputs: Mapping[str, np.ndarray]) -> dict[str, Any]:
    """A golden sequence for ``Contract``; every array is (steps, ...), flattened row by row. Carries are left out."""
    flat = [
        {n: numbers(np.reshape(rows, (len(rows), -1))) for n, rows in side.items() if not n.startswith(CARRY)}
        for side in (inputs, outputs)
    ]
    return {"steps": len(next(iter(inputs.values()))), "inputs": flat[0], "outputs": flat[1]}


def envelope(batches: Iterable[Mapping[str, np.ndarray]]) -> dict[str, dict[str, list[float]]]:
    """Statistics over ``batches`` of training inputs, each signal (rows, size): what ``Contract.envelope`` holds."""
    seen: dict[str, list[np.ndarray]] = {}
    for batch in batches:
        for name, rows in batch.items():
            if not name.startswith(CARRY):
                seen.setdefault(name, []).append(np.reshape(np.asarray(rows, np.float64), (len(rows), -1)))
    table = {name: np.concatenate(rows) for name, rows in seen.items()}
    return {
        name: {s: numbers(getattr(np, s)(rows, axis=0)) for s in ("min", "max", "mean", "std")}
        for name, rows in table.items()
    }


def make_contract(fields: Mapping[str, Any], where: str) -> Contract:
    """A checked Contract. Raises PolicyError naming each wrong field."""
    try:
        return Contract.model_validate(fields)
    except ValidationError as error:
        raise PolicyError(explain(where, error, Contract)) from None


class Exportable(Protocol):
    """A ``torch.nn.Module`` whose ``forward`` takes the tensors of ``inputs()`` and returns those of ``outputs()``."""

    def inputs(self) -> dict[str, list[int]]:
        """Every input by name, carries included, with its shape without the batch axis."""
        ...

    def outputs(self) -> dict[str, list[int]]:
        """Every output by name, ``carry_*_next`` included. None may be an input itself: add zero instead."""
        ...

    def carry_start(self) -> dict[str, list[float]]:
        """What each carry starts from, flat; an empty list is zeros."""
        ...


def export(
    module: Exportable,
    path: str | Path,
    *,
    fields: Mapping[str, Any],
    sequences: Sequence[Mapping[str, np.ndarray]],
) -> Policy:
    """Export ``module`` to ``path`` and return the proved Policy.

    ``fields``: the Contract's, less those that follow from the module: inputs, outputs, carry, golden.
    ``sequences``: at least 3 recordings of realistic inputs, each signal (steps >= 20, *shape), better with skill
    changes; what torch answers becomes the golden output. Raises PolicyError if the sequences are too few or the file
    would be refused.
    """
    import onnx
    import torch

    lengths = [len(next(iter(s.values()))) for s in sequences]
    if len(sequences) < SEQUENCES or min(lengths) < STEPS:
        raise PolicyError(f"{path}: got golden sequences of {lengths} steps, expected at least {SEQUENCES} of {STEPS}")
    carry = {n: {"shape": module.inputs()[n], "start": numbers(v)} for n, v in module.carry_start().items()}
    recorded = [golden(s, rollout(module, s)) for s in sequences]
    tools = {"torch": torch.__version__.split("+")[0], "onnx": onnx.__version__}
    contract = make_contract(
        {
            **fields,
            "inputs": module.inputs(),
            "outputs": module.outputs(),
            "carry": carry,
            "golden": recorded,
            "provenance": {**fields["provenance"], "tools": {**tools, **fields["provenance"].get("tools", {})}},
        },
        str(path),
    )
    robot = load_robot(contract.robot)
    refuse_mismatches(contract, robot, str(path))  # before the slow part
    return pack(_trace(module), contract, path, robot)


def rollout(module: Exportable, sequence: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """What ``module`` answers to one sequence of signals from the start: every output, (steps, *shape)."""
    import torch

    assert isinstance(module, torch.nn.Module)
    module = module.eval().cpu()
    shapes, starts = module.inputs(), module.carry_start()
    carry = {n: torch.tensor(v or 0.0).expand(math.prod(shapes[n])).reshape(1, *shapes[n]) for n, v in starts.items()}
    rows: dict[str, list[np.ndarray]] = {n: [] for n in module.outputs()}
    with torch.no_grad():
        for t in range(len(next(iter(sequence.values())))):
            signals = {n: torch.tensor(np.asarray(v[t], np.float32))[None] for n, v in sequence.items()}
            answer = module(*({**signals, **carry}[n] for n in shapes))
            outputs = dict(zip(rows, answer, strict=True))
            carry = {n: outputs[f"{n}_next"] for n in carry}
            for name, value in outputs.items():
                rows[name].append(value[0].numpy().copy())
    return {n: np.stack(r) for n, r in rows.items()}


def _trace(module: Exportable) -> ModelProto:
    """The module as ONNX, batch 1, tensors named as in the contract."""
    import torch

    assert isinstance(module, torch.nn.Module)
    logging.getLogger("torch.onnx").setLevel(logging.ERROR)  # it misses torchvision, which nobody asked for
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FutureWarning)  # about torch's own calls
        program = torch.onnx.export(
            module.eval().cpu(),
            tuple(torch.zeros(1, *shape) for shape in module.inputs().values()),
            input_names=list(module.inputs()),
            output_names=list(module.outputs()),
            opset_version=OPSET,
            dynamo=True,
            external_data=False,
            verbose=False,
        )
    assert program is not None
    model = program.model_proto
    model.ir_version = IR_VERSION
    return model


def _csv(contract: Contract) -> dict[str, str]:
    """The keys that other stacks read, at full precision, in the order of the driven joints."""
    default = dict(zip(contract.joint_names, contract.default_joint_pos, strict=True))
    signals = [n for n in contract.inputs if not n.startswith(CARRY)]
    rows: dict[str, Iterable[Any]] = {
        "joint_names": contract.target_joint_names,
        "joint_stiffness": contract.kp,
        "joint_damping": contract.kd,
        "default_joint_pos": [default.get(n, 0.0) for n in contract.target_joint_names],
        "action_scale": contract.action_scale,
        "observation_names": signals,
        "command_names": [n for n in signals if n in ("command_velocity", "skill")],
    }
    return {key: ",".join(map(str, values)) for key, values in rows.items()}


def _anonymise(model: ModelProto) -> None:
    """Drop what exporters leave behind: source paths, stack traces, unused imports. They also change from run to run."""
    model.doc_string = ""
    model.producer_name, model.producer_version = "sim2real", ""
    model.graph.doc_string = ""
    del model.graph.metadata_props[:]
    del model.graph.value_info[:]
    for item in (*model.graph.node, *model.graph.input, *model.graph.output, *model.graph.initializer):
        item.doc_string = ""
        del item.metadata_props[:]
    used = {n.domain for n in model.graph.node}
    for entry in [e for e in model.opset_import if e.domain and e.domain not in used]:
        model.opset_import.remove(entry)
