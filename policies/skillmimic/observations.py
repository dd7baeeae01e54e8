"""What the networks see: one function per term. The actor's are made of signals that a robot has; the critic's are not."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor


class Signals(NamedTuple):
    """All that the actor may see, each (N, size): the contract's inputs, and the state carried along."""

    joint_pos: Tensor  # rad
    joint_vel: Tensor  # rad/s
    gravity_in_base: Tensor  # unit vector
    angular_velocity_base_in_base: Tensor  # rad/s
    skill: Tensor  # one-hot
    object_position_in_base: Tensor  # m
    object_velocity_in_base: Tensor  # m/s
    rest: Tensor  # (N, n) rad, what actions are added to: the skill's posture, or what the base does
    planned: Tensor  # (N, 7): m and m/s of the ball from where the plan has it, and the share of the plan that is over
    last_action: Tensor  # (N, actions)
    history: Tensor  # (N, ticks * size of PRESENT), newest first
    lost: Tensor  # (N, 1) bool: a ball that comes up to no hand; arms stand still
    carried: dict[str, Tensor]  # what plan and base policy carry on, by name


class Term(NamedTuple):
    """One part of the observation; ``scale`` brings it to about 1."""

    scale: float
    term: Callable[[Signals], Tensor]


PRESENT: dict[str, Term] = {  # remembered for ``config.history`` ticks
    "gravity_in_base": Term(5.0, lambda s: s.gravity_in_base),
    "angular_velocity_base_in_base": Term(1.0, lambda s: s.angular_velocity_base_in_base),
    "joint_error": Term(4.0, lambda s: s.joint_pos - s.rest),
    "object_position_in_base": Term(4.0, lambda s: s.object_position_in_base),
}
TERMS: dict[str, Term] = {
    **PRESENT,
    "joint_vel": Term(0.3, lambda s: s.joint_vel),
    "object_velocity_in_base": Term(0.5, lambda s: s.object_velocity_in_base),
    "planned": Term(2.0, lambda s: s.planned),
    "last_action": Term(1.0, lambda s: s.last_action),
    "skill": Term(1.0, lambda s: s.skill),
    "history": Term(1.0, lambda s: s.history),
}


def present(signals: Signals) -> Tensor:
    """What this tick adds to the history (N, size)."""
    return torch.cat([scale * term(signals) for scale, term in PRESENT.values()], dim=-1)


def observe(signals: Signals) -> Tensor:
    """The actor's observation (N, size): every term of TERMS times its scale, in that order."""
    return torch.cat([scale * term(signals) for scale, term in TERMS.values()], dim=-1)
