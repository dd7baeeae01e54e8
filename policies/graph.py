"""The policy graph: signals in, joint targets out. Training steps through its parts; the exporter traces it whole."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor, nn

from policies.basics import MOTIONS, Basics
from policies.observations import Signals, gravity_in_base, observe
from policies.references import References
from sim2real.config import RobotConfig, load_robot


class PolicyGraph(nn.Module):
    """Residual actions on a reference pose.

    ``target = clip(reference + balance + scale * clip(action))``, with the reference from the skill's formula, simple
    reflexes for balance, and the action (legs and waist) from the actor. ``actor`` and ``critic`` map an observation
    (N, size) to actions (N, driven) and a value (N, 1); without them
    the graph still observes and makes targets, which is all that the training environment needs of it.
    """

    scale: Tensor
    drive: Tensor
    ankles: Tensor
    shoulders: Tensor
    legs: Tensor
    lower: Tensor
    upper: Tensor
    value_healthy: Tensor

    def __init__(self, config: Basics, robot: RobotConfig | None = None) -> None:
        super().__init__()
        robot = robot or load_robot(config.robot)
        self.config = config
        self.joint_names = robot.joint_names
        self.labels = tuple(MOTIONS)
        self.kp, self.kd = robot.home_kp, robot.home_kd  # (n,)
        self.references = References(
            robot.joint_names,
            robot.home_pos.tolist(),
            MOTIONS,
            config.period,
            config.reference_rate,
            config.reference_pull,
        )
        margin = config.position_margin
        groups = {j.name: j.group for j in robot.joints}
        self.driven = [k for k, name in enumerate(robot.joint_names) if groups[name] in config.driven]
        scale = config.action_ratio * robot.torque_max / robot.home_kp
        self.register_buffer("scale", _buffer(np.where([groups[n] in config.driven for n in groups], scale, 0.0)))
        self.register_buffer("drive", torch.diag(self.scale)[self.driven])  # actions to joints
        self.register_buffer("lower", _buffer(robot.position_min + margin))
        self.register_buffer("upper", _buffer(robot.position_max - margin))
        part = lambda joint: torch.tensor([float(joint in name) for name in robot.joint_names])  # noqa: E731
        self.register_buffer("ankles", part("ankle_pitch"))
        self.register_buffer("shoulders", part("shoulder_pitch"))
        # Thigh and shin are equally long: their mean pitch is that of the line from ankle to hip, here of both legs.
        self.register_buffer("legs", part("hip_pitch") / 2 + part("knee") / 4)
        self.register_buffer("value_healthy", torch.ones(len(self.labels)))
        self.actor: nn.Module = nn.Identity()
        self.critic: nn.Module = nn.Identity()

    @property
    def home(self) -> Tensor:
        return self.references.home

    def target(self, signals: Signals, action: Tensor) -> Tensor:
        """Joint targets (N, n) rad for a clipped ``action`` (N, driven)."""
        target = signals.reference + self.balance(signals) + action @ self.drive
        return torch.minimum(torch.maximum(target, self.lower), self.upper)

    def balance(self, signals: Signals) -> Tensor:
        """What a person does without thinking (N, n) rad: ankles lean against the pitch; arms swing once the capture
        point, lean + rate / pendulum frequency, comes near the end of the feet (Pratt et al., "Capture Point", 2006)."""
        config = self.config
        pitch = gravity_in_base(signals.orientation_base_in_world)[:, 0:1]  # sine of the forward pitch
        pitch_rate = signals.angular_velocity_base_in_base[:, 1:2]
        ankle = config.balance_offset + config.balance_gain * pitch + config.balance_damping * pitch_rate
        lean = pitch + ((signals.joint_pos - signals.reference) * self.legs).sum(-1, keepdim=True)
        lean_rate = pitch_rate + (signals.joint_vel * self.legs).sum(-1, keepdim=True)
        capture = lean + lean_rate / config.pendulum
        swing = capture - torch.clamp(capture, -config.swing_from, config.swing_from)
        hanging = (
            torch.clamp(torch.cos(signals.reference), min=0.0) ** 2
        )  # raised arms would topple what they should save
        return ankle * self.ankles + config.swing_gain * swing * hanging * self.shoulders

    def clip(self, action: Tensor) -> Tensor:
        return torch.clamp(action, -self.config.action_max, self.config.action_max)

    def carry_start(self) -> dict[str, list[float]]:
        """What each carried tensor is before the first tick; an empty list is zeros."""
        return {
            "carry_phase": [],
            "carry_skill": [],
            "carry_reference": self.home.tolist(),
            "carry_action": [],
        }

    def inputs(self) -> dict[str, list[int]]:
        """Every input by name with its shape, without the batch axis, in the order of ``forward``."""
        n, labels = len(self.joint_names), len(self.labels)
        return {
            "joint_pos": [n],
            "joint_vel": [n],
            "orientation_base_in_world": [4],
            "angular_velocity_base_in_base": [3],
            "skill": [labels],
            "carry_phase": [1],
            "carry_skill": [labels],
            "carry_reference": [n],
            "carry_action": [len(self.driven)],
        }

    def outputs(self) -> dict[str, list[int]]:
        """Every output by name with its shape, without the batch axis, in the order of ``forward``."""
        n, labels = len(self.joint_names), len(self.labels)
        size = 3 + 3 + 2 * n + len(self.driven) + labels + 2 + n
        return {
            "joint_pos_target": [n],
            "carry_phase_next": [1],
            "carry_skill_next": [labels],
            "carry_reference_next": [n],
            "carry_action_next": [len(self.driven)],
            "observation": [size],
            "action": [len(self.driven)],
            "skill_value": [labels],
        }

    def forward(
        self,
        joint_pos: Tensor,
        joint_vel: Tensor,
        orientation_base_in_world: Tensor,
        angular_velocity_base_in_base: Tensor,
        skill: Tensor,
        carry_phase: Tensor,
        carry_skill: Tensor,
        carry_reference: Tensor,
        carry_action: Tensor,
    ) -> tuple[Tensor, ...]:
        """One tick of a batch of one. Returns the tensors of ``outputs()`` in that order.

        All labels are computed at once, row k as if label k were asked for now; the asked one drives the joints, all of
        them give ``skill_value``: the critic's value over that of an undisturbed episode, so 1 is healthy.
        """
        every = torch.eye(len(self.labels))
        rows = lambda x: x.expand(len(self.labels), -1)  # noqa: E731
        phases, references = self.references.advance(every, rows(carry_skill), rows(carry_phase), rows(carry_reference))
        measured = joint_pos, joint_vel, orientation_base_in_world, angular_velocity_base_in_base
        observations = observe(Signals(*map(rows, measured), every, self.home, phases, references, rows(carry_action)))
        observation = skill @ observations
        phase, reference = skill @ phases, skill @ references
        signals = Signals(*measured, skill, self.home, phase, reference, carry_action)
        action = self.clip(self.actor(observation))
        value = (self.critic(observations).T / self.value_healthy).reshape(1, -1)
        return (
            self.target(signals, action),
            phase,
            skill + 0.0,
            reference,
            action,
            observation,
            action + 0.0,
            value,
        )


def one_hot(labels: Sequence[int] | np.ndarray, size: int) -> Tensor:
    """(N,) label indices -> (N, size) float32."""
    return torch.eye(size)[torch.as_tensor(np.asarray(labels), dtype=torch.long)]


def _buffer(values: np.ndarray) -> Tensor:
    return torch.tensor(values, dtype=torch.float32)
