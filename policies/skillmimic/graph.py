"""The policy: signals in, joint targets out. Training steps through its parts; the exporter traces it whole."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor, nn

from policies.clips.robot import RobotBody
from policies.observations import gravity_in_base
from policies.skillmimic.clips import ReferenceClips
from policies.skillmimic.config import SkillMimic
from policies.skillmimic.observations import Signals, observe, present
from policies.skillmimic.world import training_world
from sim2real.config import RobotConfig, load_robot


class PolicyGraph(nn.Module):
    """Residual actions on one posture a skill.

    ``target = clip(posture[skill] + ankle strategy + scale * clip(action))``. The posture is the mean of the skill's clips,
    with the arms' weight and the grip on the ball inside it. There is no phase and no reference in here: as in the paper
    the policy knows the time from what it senses. ``actor`` maps an observation (N, size) to actions (N, n).
    """

    postures: Tensor
    lean: Tensor
    scale: Tensor
    ankles: Tensor
    lower: Tensor
    upper: Tensor

    def __init__(self, config: SkillMimic, robot: RobotConfig | None = None) -> None:
        super().__init__()
        robot = robot or load_robot(config.robot)
        self.config, self.robot = config, robot
        self.joint_names, self.labels = robot.joint_names, config.skills
        self.kp, self.kd = robot.home_kp, robot.home_kd  # (n,)
        self.body = RobotBody.of(robot)
        self.model, self.contact_graph = training_world(robot, self.body, self.kp, self.kd, config.timestep)
        self.clips = ReferenceClips(config, self.model, self.body, self.contact_graph, self.kp)
        means = [self.clips.mean(k) for k in range(len(self.labels))]
        self.register_buffer("postures", _buffer(np.stack([posture for posture, _ in means])))
        self.register_buffer("lean", _buffer(np.stack([gravity[:1] for _, gravity in means])))
        self.register_buffer("scale", _buffer(config.action_ratio * robot.torque_max / self.kp))
        self.register_buffer("ankles", _buffer(np.array(["ankle_pitch" in name for name in robot.joint_names])))
        self.register_buffer("lower", _buffer(robot.position_min + config.position_margin))
        self.register_buffer("upper", _buffer(robot.position_max - config.position_margin))
        self.actor: nn.Module = nn.Identity()

    @property
    def history(self) -> int:
        """Numbers in the history."""
        return self.config.history * (3 + 3 + len(self.joint_names) + 3)

    def clip(self, action: Tensor) -> Tensor:
        return torch.clamp(action, -self.config.action_max, self.config.action_max)

    def target(self, signals: Signals, action: Tensor) -> Tensor:
        """Joint targets (N, n) rad for a clipped ``action`` (N, n)."""
        config = self.config
        lean = gravity_in_base(signals.orientation_base_in_world)[:, 0:1] - signals.skill @ self.lean
        ankle = config.balance_gain * lean + config.balance_damping * signals.angular_velocity_base_in_base[:, 1:2]
        target = signals.posture + self.ankles * ankle + self.scale * action
        return torch.minimum(torch.maximum(target, self.lower), self.upper)

    def remember(self, signals: Signals) -> Tensor:
        """The history (N, size) that the next tick sees."""
        size = self.history // self.config.history
        return torch.cat([present(signals), signals.history[:, : self.history - size]], dim=-1)

    def carry_start(self) -> dict[str, list[float]]:
        """What each carried tensor is before the first tick; an empty list is zeros."""
        return {"carry_action": [], "carry_history": []}

    def inputs(self) -> dict[str, list[int]]:
        """Every input by name with its shape, without the batch axis, in the order of ``forward``."""
        n = len(self.joint_names)
        return {
            "joint_pos": [n],
            "joint_vel": [n],
            "orientation_base_in_world": [4],
            "angular_velocity_base_in_base": [3],
            "skill": [len(self.labels)],
            "object_position_in_base": [3],
            "object_velocity_in_base": [3],
            "carry_action": [n],
            "carry_history": [self.history],
        }

    def outputs(self) -> dict[str, list[int]]:
        """Every output by name with its shape, without the batch axis, in the order of ``forward``."""
        n = len(self.joint_names)
        size = self.history // self.config.history + n + 3 + n + len(self.labels) + self.history
        return {
            "joint_pos_target": [n],
            "carry_action_next": [n],
            "carry_history_next": [self.history],
            "observation": [size],
            "action": [n],
        }

    def signals(
        self,
        joint_pos: Tensor,
        joint_vel: Tensor,
        orientation_base_in_world: Tensor,
        angular_velocity_base_in_base: Tensor,
        skill: Tensor,
        object_position_in_base: Tensor,
        object_velocity_in_base: Tensor,
        carry_action: Tensor,
        carry_history: Tensor,
    ) -> Signals:
        """The inputs, and what follows from them."""
        return Signals(
            joint_pos,
            joint_vel,
            orientation_base_in_world,
            angular_velocity_base_in_base,
            skill,
            object_position_in_base,
            object_velocity_in_base,
            posture=skill @ self.postures,
            last_action=carry_action,
            history=carry_history,
        )

    def forward(self, *inputs: Tensor) -> tuple[Tensor, ...]:
        """One tick of a batch of one: the tensors of ``inputs()``, in that order, to those of ``outputs()``."""
        signals = self.signals(*inputs)
        observation = observe(signals)
        action = self.clip(self.actor(observation))
        return self.target(signals, action), action, self.remember(signals), observation, action + 0.0


def _buffer(values: np.ndarray) -> Tensor:
    return torch.tensor(values, dtype=torch.float32)
