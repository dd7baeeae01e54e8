"""Where the joints should be: a formula per skill label, followed at a limited rate so that any switch is continuous."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import torch
from torch import Tensor, nn


class Motion(NamedTuple):
    """A periodic motion around the home pose, angles in rad by joint name.

    ``pose(phase) = home + hold + lift (1 - cos 2 pi phase) / 2 + swing sin 2 pi phase``
    """

    description: str
    period: float  # s
    hold: Mapping[str, float] = {}
    lift: Mapping[str, float] = {}
    swing: Mapping[str, float] = {}
    walks: bool = False  # obeys the velocity command


class References(nn.Module):
    """The formulas of all motions as matrices, one row per label; part of the exported graph."""

    home: Tensor
    hold: Tensor
    lift: Tensor
    swing: Tensor
    phase_rate: Tensor

    def __init__(
        self,
        joint_names: Sequence[str],
        home: Sequence[float],
        motions: Mapping[str, Motion],
        period: float,
        rate: float,
        pull: float,
    ) -> None:
        """``home`` (n,) rad; ``period`` s of the policy; ``rate`` rad/s and ``pull`` 1/s: how a reference approaches
        its goal. Raises KeyError for a motion that names a stranger."""
        super().__init__()
        self.joint_names, self.labels = tuple(joint_names), tuple(motions)
        self.step = rate * period
        self.share = pull * period
        self.register_buffer("home", torch.tensor(home, dtype=torch.float32))
        for part in ("hold", "lift", "swing"):
            matrix = torch.zeros(len(motions), len(joint_names))
            for row, motion in zip(matrix, motions.values(), strict=True):
                for joint, angle in getattr(motion, part).items():
                    row[self._index(joint)] = angle
            self.register_buffer(part, matrix)
        self.register_buffer("phase_rate", torch.tensor([period / m.period for m in motions.values()]))

    def _index(self, joint: str) -> int:
        if joint not in self.joint_names:
            raise KeyError(f"motion: got joint '{joint}', expected one of {', '.join(self.joint_names)}")
        return self.joint_names.index(joint)

    def goal(self, skill: Tensor, phase: Tensor) -> Tensor:
        """The formula's pose (N, n) rad for one-hot ``skill`` (N, labels) at ``phase`` (N, 1) in [0, 1)."""
        angle = 2 * torch.pi * phase
        lift, swing = (1 - torch.cos(angle)) / 2, torch.sin(angle)
        return self.home + skill @ self.hold + lift * (skill @ self.lift) + swing * (skill @ self.swing)

    def advance(
        self, skill: Tensor, last_skill: Tensor, phase: Tensor, reference: Tensor, further: Tensor | float = 0.0
    ) -> tuple[Tensor, Tensor]:
        """Phase (N, 1) and reference pose (N, n) of this tick from those of the last one; ``further`` (N, n) rad is
        added to the formula's.

        A new label starts at phase 0. ``last_skill`` all zero (the start state) counts as another label.
        """
        same = (skill * last_skill).sum(-1, keepdim=True)
        phase = phase + (skill * self.phase_rate).sum(-1, keepdim=True)
        phase = same * (phase - torch.floor(phase))
        move = self.share * (self.goal(skill, phase) + further - reference)
        return phase, reference + torch.clamp(move, -self.step, self.step)
