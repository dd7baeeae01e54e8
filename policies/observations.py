"""What the network sees: one function per term, used by the training environment and inside the exported graph."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from policies.gait import Gait


class Signals(NamedTuple):
    """All that an observation may be made of, each (N, size): what was measured, and where the formulas have got to."""

    joint_pos: Tensor  # rad
    joint_vel: Tensor  # rad/s
    gravity_in_base: Tensor  # unit vector, and
    angular_velocity_base_in_base: Tensor  # rad/s, both from those of the pose that is stood in
    skill: Tensor  # one-hot
    home: Tensor  # (n,) rad
    phase: Tensor  # (N, 1) in [0, 1), of the skill's motion
    posture: Tensor  # rad, the skill's, without steps
    command: Tensor  # (N, 3) forward m/s, left m/s, turn rad/s: what is followed now
    gait: Tensor  # (N, 1) in [0, 1), see gait.Gait
    capture: Tensor  # (N, 2) rad, forwards and left, averaged: see gait.Gait
    reference: Tensor  # rad, with steps
    last_action: Tensor


def gravity_in_base(orientation_base_in_world: Tensor) -> Tensor:
    """Unit vector of gravity (N, 3) in the base: R(q)^T (0, 0, -1); upright is (0, 0, -1)."""
    w, x, y, z = orientation_base_in_world.unbind(-1)
    return torch.stack([2 * (w * y - x * z), -2 * (w * x + y * z), 2 * (x * x + y * y) - 1], dim=-1)


def pitched(vectors: Tensor, pitch: Tensor) -> Tensor:
    """``vectors`` (N, 3) in a base that is pitched forwards by ``pitch`` (N, 1) rad, in a level one."""
    sin, cos, (x, y, z) = torch.sin(pitch), torch.cos(pitch), vectors.split(1, dim=-1)
    return torch.cat([cos * x + sin * z, y, cos * z - sin * x], dim=-1)


def _circle(phase: Tensor) -> Tensor:
    return torch.cat([torch.sin(2 * torch.pi * phase), torch.cos(2 * torch.pi * phase)], -1)


class Term(NamedTuple):
    """One part of the observation. ``scale`` brings it to about 1; ``kind`` says how it turns over in a mirror."""

    scale: float
    kind: str  # vector, axial, joints, actions, command, gait or same
    term: Callable[[Signals], Tensor]


TERMS: dict[str, Term] = {
    "gravity_in_base": Term(5.0, "vector", lambda s: s.gravity_in_base),
    "angular_velocity_base_in_base": Term(1.0, "axial", lambda s: s.angular_velocity_base_in_base),
    "joint_error": Term(5.0, "joints", lambda s: s.joint_pos - s.reference),
    "joint_vel": Term(0.3, "joints", lambda s: s.joint_vel),
    "last_action": Term(1.0, "actions", lambda s: s.last_action),
    "skill": Term(1.0, "same", lambda s: s.skill),
    "phase": Term(1.0, "same", lambda s: _circle(s.phase)),
    "command": Term(1.0, "command", lambda s: s.command),
    "gait": Term(1.0, "gait", lambda s: torch.where(Gait.resting(s.gait), 0.0, _circle(s.gait))),
    "reference": Term(1.0, "joints", lambda s: s.reference - s.home),
}


def observe(signals: Signals) -> Tensor:
    """The observation (N, size): every term of TERMS times its scale, in that order."""
    return torch.cat([scale * term(signals) for scale, _, term in TERMS.values()], dim=-1)
