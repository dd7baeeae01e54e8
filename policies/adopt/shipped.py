"""Find and read what another stack ships: the network, its ONNX, its YAML."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import yaml

from sim2real.graph import refuse_strange
from sim2real.policy import PolicyError

if TYPE_CHECKING:
    from onnx import ModelProto


def network_file(source: Path, stack: str) -> Path:
    """The network itself; in a folder, ONNX before TorchScript, since it cannot carry code and needs no torch.
    Raises PolicyError."""
    if source.is_file():
        return source
    for suffix in (".onnx", ".pt"):
        files = sorted(source.glob(f"*{suffix}"))
        if len(files) > 1:
            raise PolicyError(f"{source}: got networks {[f.name for f in files]}, expected one; name the file instead")
        if files:
            return files[0]
    raise PolicyError(f"{source}: got no .onnx or .pt file, expected the network of {stack}")


def read_onnx(file: Path) -> ModelProto:
    """An ONNX network, refused if it could run code or for ever. Raises PolicyError."""
    import onnx

    try:
        network = onnx.load_from_string(file.read_bytes())
    except Exception as error:  # protobuf raises more than one kind
        raise PolicyError(f"{file}: got {type(error).__name__}, expected ONNX; the file is damaged") from None
    refuse_strange(network, str(file))
    return network


def feed_forward(network: ModelProto, observation: int, actions: int, where: Path) -> ModelProto:
    """``network``, if it maps (1, observation) to (1, actions). Raises PolicyError."""
    import onnx

    weights = {t.name for t in network.graph.initializer}
    sides = [[v for v in network.graph.input if v.name not in weights], network.graph.output]
    got = [[[d.dim_value for d in v.type.tensor_type.shape.dim] for v in side] for side in sides]
    if got != [[[1, observation]], [[1, actions]]]:
        raise PolicyError(
            f"{where}: got shapes {got[0]} -> {got[1]}, expected [1, {observation}] -> [1, {actions}]; other dialect?"
        )
    try:
        onnx.checker.check_model(network)
    except onnx.checker.ValidationError as error:
        raise PolicyError(f"{where}: got {' '.join(str(error).split())[:200]}, expected valid ONNX") from None
    return network


def read_yaml(file: Path, stack: str) -> dict[str, Any]:
    """A YAML mapping; nothing in it is executed. Raises PolicyError."""
    try:
        content = yaml.safe_load(file.read_text())
    except (OSError, yaml.YAMLError) as error:
        raise PolicyError(f"{file}: got {' '.join(str(error).split())[:200]}, expected a YAML file") from None
    if not isinstance(content, dict):
        raise PolicyError(f"{file}: got no keys, expected a configuration of {stack}")
    return content
