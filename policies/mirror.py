"""Left and right: a policy that cannot tell them apart learns each lesson for both sides at once.

Mittal et al., "Symmetry Considerations for Learning Task Symmetric Robot Policies", ICRA 2024, compare ways to get
there. Here the network is averaged with its mirror image, so the symmetry is exact and needs no second copy of the data.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from policies.graph import PolicyGraph
from policies.observations import TERMS, Signals

Turn = tuple[list[int], list[float]]  # y = x[index] * sign


class Mirrored(nn.Module):
    """``f(x)`` averaged with the mirror image of ``f(mirror image of x)``. A mirrored wave is a wave with the other hand:
    a state that the formula never asks for, but a true one, since the observation shows the reference."""

    def __init__(self, network: nn.Module, observation: Turn, output: Turn) -> None:
        super().__init__()
        self.network = network
        for name, (index, sign) in {"observation": observation, "output": output}.items():
            self.register_buffer(f"{name}_index", torch.tensor(index), persistent=False)
            self.register_buffer(f"{name}_sign", torch.tensor(sign), persistent=False)

    def forward(self, x: Tensor) -> Tensor:
        image = x[:, self.observation_index] * self.observation_sign
        y, turned = self.network(torch.cat([x, image])).chunk(2)  # one pass: weights cost more than rows
        return (y + turned[:, self.output_index] * self.output_sign) / 2


def observation_mirror(graph: PolicyGraph) -> Turn:
    """How an observation turns over in the plane y = 0 of the base."""
    joints, labels = len(graph.joint_names), len(graph.labels)
    zeros = lambda k: torch.zeros(1, k)  # noqa: E731
    blank = Signals(zeros(joints), zeros(joints), zeros(3), zeros(3), zeros(labels), zeros(joints), zeros(1), zeros(joints),
                    zeros(3), zeros(1), zeros(2), zeros(joints), zeros(len(graph.driven)))  # fmt: skip
    index: list[int] = []
    sign: list[float] = []
    for _, kind, term in TERMS.values():
        size = term(blank).shape[-1]
        where, signs = {
            "vector": ([0, 1, 2], [1.0, -1.0, 1.0]),
            "axial": ([0, 1, 2], [-1.0, 1.0, -1.0]),
            "joints": joint_mirror(graph.joint_names),
            "actions": action_mirror(graph),
            "command": ([0, 1, 2], [1.0, -1.0, -1.0]),
            "gait": ([0, 1], [-1.0, -1.0]),  # the other foot's half of the stride
            "same": (list(range(size)), [1.0] * size),
        }[kind]
        index += [len(sign) + k for k in where]
        sign += signs
    return index, sign


def action_mirror(graph: PolicyGraph) -> Turn:
    """How an action turns over."""
    return joint_mirror([graph.joint_names[k] for k in graph.driven])


def joint_mirror(names: Sequence[str]) -> Turn:
    """Where each joint's mirror image is, and its sign: roll and yaw turn the other way."""
    swap = {"left": "right", "right": "left"}
    index, sign = [], []
    for name in names:
        side, _, rest = name.partition("_")
        index.append(list(names).index(f"{swap[side]}_{rest}" if side in swap else name))
        sign.append(-1.0 if "roll" in name or "yaw" in name else 1.0)
    return index, sign
