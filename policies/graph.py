"""The policy graph: signals in, joint targets out. Training steps through its parts; the exporter traces it whole."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import mujoco
import numpy as np
import torch
from torch import Tensor, nn

from policies.basics import BOWED, MOTIONS, Basics
from policies.gait import Gait, legs, single_loads
from policies.observations import Signals, gravity_in_base, observe, pitched
from policies.references import References
from sim2real.config import RobotConfig, load_robot


class PolicyGraph(nn.Module):
    """Residual actions on a reference pose.

    ``target = clip(reference + balance + scale * clip(action))``, with the reference from the skill's formula and the
    gait's, simple reflexes for balance, and the action (legs and waist) from the actor. ``actor`` and ``critic`` map an
    observation (N, size) to actions (N, driven) and a value (N, 1); without them the graph still observes and makes
    targets, which is all that the training environment needs of it.
    """

    scale: Tensor
    drive: Tensor
    ankles: Tensor
    bowing: Tensor
    walks: Tensor
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
        ankles = torch.tensor([float("ankle_pitch" in name) for name in robot.joint_names])
        self.register_buffer("ankles", ankles)
        self.register_buffer("walks", torch.tensor([[float(m.walks)] for m in MOTIONS.values()]))
        body = mujoco.MjModel.from_xml_path(str(robot.model_path))
        loads = single_loads(body, robot.home_pos, self.kp) * np.array([groups[n] == "leg" for n in groups])
        loads -= config.balance_offset * ankles.numpy() * (loads != 0)  # which the ankles are told of anyway
        self.gait = Gait(robot.joint_names, config.period, config.stride, loads)
        self.register_buffer("bowing", _buffer(bowing(robot.joint_names, config)))
        self.register_buffer("value_healthy", torch.ones(len(self.labels)))
        self.actor: nn.Module = nn.Identity()
        self.critic: nn.Module = nn.Identity()

    @property
    def home(self) -> Tensor:
        return self.references.home

    def advance(
        self,
        joint_pos: Tensor,
        joint_vel: Tensor,
        orientation_base_in_world: Tensor,
        angular_velocity_base_in_base: Tensor,
        command_velocity: Tensor,
        skill: Tensor,
        carry_phase: Tensor,
        carry_skill: Tensor,
        carry_posture: Tensor,
        carry_command: Tensor,
        carry_gait: Tensor,
        carry_capture: Tensor,
        carry_action: Tensor,
        pose: Tensor | float = 0.0,
    ) -> Signals:
        """This tick of every robot (N, size): what was measured and asked for, and where the formulas have got to.
        ``pose`` (N, n) rad moves the goal: what another policy does with the rest of the body."""
        phase, posture = self.references.advance(skill, carry_skill, carry_phase, carry_posture, pose)
        command = self.gait.ramp(carry_command, command_velocity * (skill @ self.walks))
        # A pose may pitch the base; what matters is how it is turned from there.
        pitch, last = self.pitch(posture), self.pitch(carry_posture)
        gravity = pitched(gravity_in_base(orientation_base_in_world), pitch)
        gyro = angular_velocity_base_in_base - nn.functional.pad((pitch - last) / self.config.period, (1, 1))
        lean = self.gait.lean(carry_gait, gravity, angular_velocity_base_in_base, joint_pos - posture, joint_vel)
        capture = self.gait.steady(carry_capture, lean)
        gait = self.gait.advance(carry_gait, command, lean, capture, pitch)
        reference = posture + self.gait.offsets(gait, command, lean)
        return Signals(joint_pos, joint_vel, gravity, gyro, skill, self.home, phase, posture, command, gait, capture,
                       reference, carry_action)  # fmt: skip

    def pitch(self, posture: Tensor) -> Tensor:
        """How far a posture (N, n) rad pitches the base (N, 1) rad. Nothing but going down to the floor is meant to: whoever
        was not trained for that is level, and a posture on its way into a squat or out of it is no bow."""
        return self.gait.pitch(posture - self.home) if self.config.down else torch.zeros_like(posture[:, :1])

    def target(self, signals: Signals, action: Tensor) -> Tensor:
        """Joint targets (N, n) rad for a clipped ``action`` (N, driven)."""
        target = signals.reference + self.balance(signals) + action @ self.drive
        return torch.minimum(torch.maximum(target, self.lower), self.upper)

    def balance(self, signals: Signals) -> Tensor:
        """What a person does without thinking (N, n) rad: ankles lean against the pitch, and whoever has gone down keeps
        level with both legs."""
        config, gyro = self.config, signals.angular_velocity_base_in_base
        pitch, roll, one = (
            signals.gravity_in_base[:, 0:1],
            -signals.gravity_in_base[:, 1:2],
            torch.ones_like(gyro[:, :1]),
        )
        lean = config.balance_offset + config.balance_gain * pitch + config.balance_damping * gyro[:, 1:2]
        bow = torch.clamp(self.pitch(signals.posture) / BOWED, 0.0, 1.0)
        return lean * self.ankles + bow * (torch.cat([roll, gyro[:, 0:1], pitch, one], dim=-1) @ self.bowing)

    def clip(self, action: Tensor) -> Tensor:
        return torch.clamp(action, -self.config.action_max, self.config.action_max)

    def carries(self, signals: Signals, action: Tensor) -> dict[str, Tensor]:
        """What the next tick has to be told of this one."""
        return {
            "carry_phase": signals.phase,
            "carry_skill": signals.skill,
            "carry_posture": signals.posture,
            "carry_command": signals.command,
            "carry_gait": signals.gait,
            "carry_capture": signals.capture,
            "carry_action": action,
        }

    def carry_start(self) -> dict[str, list[float]]:
        """What each carried tensor is before the first tick; an empty list is zeros."""
        names = [n for n in self.inputs() if n.startswith("carry_")]
        return {n: self.home.tolist() if n == "carry_posture" else [] for n in names}

    def inputs(self) -> dict[str, list[int]]:
        """Every input by name with its shape, without the batch axis, in the order of ``forward``."""
        n, labels = len(self.joint_names), len(self.labels)
        return {
            "joint_pos": [n],
            "joint_vel": [n],
            "orientation_base_in_world": [4],
            "angular_velocity_base_in_base": [3],
            "command_velocity": [3],
            "skill": [labels],
            "carry_phase": [1],
            "carry_skill": [labels],
            "carry_posture": [n],
            "carry_command": [3],
            "carry_gait": [1],
            "carry_capture": [2],
            "carry_action": [len(self.driven)],
        }

    def outputs(self) -> dict[str, list[int]]:
        """Every output by name with its shape, without the batch axis, in the order of ``forward``."""
        n, labels = len(self.joint_names), len(self.labels)
        nexts = {f"{name}_next": shape for name, shape in self.inputs().items() if name.startswith("carry_")}
        size = 3 + 3 + 2 * n + len(self.driven) + labels + 2 + 3 + 2 + n
        return {
            "joint_pos_target": [n],
            **nexts,
            "observation": [size],
            "action": [len(self.driven)],
            "skill_value": [labels],
        }

    def forward(self, *inputs: Tensor) -> tuple[Tensor, ...]:
        """One tick of a batch of one: the tensors of ``inputs()``, in that order, to those of ``outputs()``.

        All labels are computed at once, row k as if label k were asked for now; the asked one drives the joints, all of
        them give ``skill_value``: the critic's value over that of an undisturbed episode, so 1 is healthy.
        """
        every = torch.eye(len(self.labels))
        given = dict(zip(self.inputs(), inputs, strict=True))
        skill = given.pop("skill")
        might = self.advance(skill=every, **_together(given, lambda x: x.expand(len(every), -1)))
        observations = observe(might)
        each = might._asdict() | {"observation": observations}
        del each["home"]  # which is nobody's in particular
        chosen = _together(each, lambda x: skill @ x)
        observation = chosen.pop("observation")
        signals = Signals(home=self.home, **chosen)
        action = self.clip(self.actor(observation))
        value = (self.critic(observations).T / self.value_healthy).reshape(1, -1)
        return (
            self.target(signals, action),
            *self.carries(signals, action).values(),
            observation,
            action + 0.0,
            value,
        )


def bowing(joint_names: Sequence[str], config: Basics) -> np.ndarray:
    """(4, n): rad of the joints per rad of roll, per rad/s of it, per rad of pitch, and always, of a robot that is down."""
    bend, roll, pitch = (np.array(legs(joint_names, part)) for part in ("raise", "roll", "pitch"))
    (bends, bends_rate), (rolls, rolls_rate) = config.bow_legs, config.bow_hips
    apart, aside = bend[0] - bend[1], roll.sum(axis=0)
    leans = dict(zip(("hip_pitch", "knee", "ankle_pitch", "waist_pitch"), config.bow_lean, strict=True))
    lean = [sum(x for part, x in leans.items() if name.endswith(f"{part}_joint")) for name in joint_names]
    return np.stack(
        [
            bends * apart + rolls * aside,
            bends_rate * apart + rolls_rate * aside,
            config.bow_pitch * pitch.sum(axis=0),
            np.array(lean),
        ]
    )


def one_hot(labels: Sequence[int] | np.ndarray, size: int) -> Tensor:
    """(N,) label indices -> (N, size) float32."""
    return torch.eye(size)[torch.as_tensor(np.asarray(labels), dtype=torch.long)]


def _together(tensors: dict[str, Tensor], change: Callable[[Tensor], Tensor]) -> dict[str, Tensor]:
    """``change`` of all ``tensors`` (N, size) side by side: one operation instead of one each."""
    parts = change(torch.cat([*tensors.values()], dim=-1)).split([x.shape[-1] for x in tensors.values()], dim=-1)
    return dict(zip(tensors, parts, strict=True))


def _buffer(values: np.ndarray) -> Tensor:
    return torch.tensor(values, dtype=torch.float32)
