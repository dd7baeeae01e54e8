"""The policy: signals in, joint targets out. Training steps through its parts; the exporter traces it whole."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor, nn

import policies.graph
from policies.clips.robot import RobotBody
from policies.gait import Gait
from policies.observations import gravity_in_base
from policies.observations import observe as observe_base
from policies.skillmimic.clips import ReferenceClips
from policies.skillmimic.config import SkillMimic
from policies.skillmimic.observations import Signals, observe, present
from policies.skillmimic.plan import RESTED, ROOT, Plan
from policies.skillmimic.plan import read as corrections
from policies.skillmimic.world import training_world
from policies.train import graph_of
from sim2real.config import RobotConfig, load_robot

WALKS = 0.05  # m/s or rad/s: what is slower is stood
PULL = 12.0  # rows of the plan, per tick, per s that the ball is ahead of it


class PolicyGraph(nn.Module):
    """Residual actions on one posture a skill.

    ``target = clip(rest + scale * clip(action))``. ``rest`` is the mean posture of the skill's clips, with the arms' weight
    and the grip on the ball inside it; where ``config.base`` names a policy that keeps the robot up, legs and waist are
    that policy's, which walks as it is told and sees where the arms are going. There is no phase and no reference in
    here: as in the paper the policy knows the time from what it senses. ``actor`` maps an observation (N, size) to
    actions (N, acting).
    """

    postures: Tensor
    lean: Tensor
    scale: Tensor
    ankles: Tensor
    drive: Tensor
    acts: Tensor
    slowest: Tensor
    fastest: Tensor
    gaits: Tensor
    spread: Tensor
    lower: Tensor
    upper: Tensor

    def __init__(self, config: SkillMimic, robot: RobotConfig | None = None) -> None:
        super().__init__()
        robot = robot or load_robot(config.robot)
        self.config, self.robot = config, robot
        self.joint_names, self.labels = robot.joint_names, config.skills
        self.kp, self.kd = robot.home_kp, robot.home_kd  # (n,)
        self.body = RobotBody.of(robot)
        self.base: policies.graph.PolicyGraph | None = graph_of(ROOT / config.base) if config.base else None
        acts = np.array([self.base is None or j.group == "arm" for j in robot.joints])
        self.acting = np.flatnonzero(acts).tolist()  # the arms, which follow the plan; every joint where there is none
        crouch = None
        if self.base is not None:
            self.base.requires_grad_(False)
            self.base.gait.stride = self.base.gait.stride.steadier(config.stands)
            legs = np.array([j.group == "leg" for j in robot.joints])
            crouch = self.base.references.lift[self.base.labels.index("squat")].numpy() * legs
        self.model, self.contact_graph = training_world(robot, self.body, self.kp, self.kd, config.timestep)
        self.clips = ReferenceClips(config, self.model, self.body, self.contact_graph, self.kp, crouch)
        means = [self.clips.mean(k) for k in range(len(self.labels))]
        self.register_buffer("postures", _buffer(np.stack([posture for posture, _ in means])))
        self.register_buffer("lean", _buffer(np.stack([gravity[:1] for _, gravity in means])))
        scale = acts * config.action_ratio * robot.torque_max / self.kp
        self.register_buffer("scale", _buffer(scale))
        self.register_buffer("drive", _buffer(np.diag(scale)[self.acting]))  # actions to joints
        self.register_buffer("ankles", _buffer(np.array(["ankle_pitch" in name for name in robot.joint_names])))
        self.register_buffer("acts", _buffer(acts))
        self.plan: Plan  # where there is a base
        if self.base is not None:
            rows = [
                self.clips.plan(k, self.acting, PULL * (name in config.timed)) for k, name in enumerate(self.labels)
            ]
            self.plan = Plan(rows, corrections(config.corrections, self.labels, len(self.acting)))
            labels = list(self.base.labels)
            self.register_buffer("gaits", torch.eye(len(labels))[[labels.index("walk"), labels.index("stand")]])
            self.register_buffer("spread", _buffer(np.eye(len(acts))[self.acting]))  # arms to joints
        self.paces = np.array([self._pace(skill) for skill in config.skills])  # (labels, 2, 3), from and to
        self.register_buffer("slowest", _buffer(np.minimum(self.paces[:, 0], 0.0)))
        self.register_buffer("fastest", _buffer(np.maximum(self.paces[:, 1], 0.0)))
        self.register_buffer("lower", _buffer(robot.position_min + config.position_margin))
        self.register_buffer("upper", _buffer(robot.position_max - config.position_margin))
        self.actor: nn.Module = nn.Identity()

    def _pace(self, skill: str) -> tuple[Sequence[float], Sequence[float]]:
        """Commands that ``skill`` is trained on, from and to, each (3,): forward m/s, left m/s, turn rad/s."""
        if self.base is None or skill not in self.config.walks:
            return (0.0,) * 3, (0.0,) * 3
        low, high = self.config.walks[skill] or (self.base.config.command_low, self.base.config.command_high)
        return low, high

    def told(self, command: Tensor, skill: Tensor) -> Tensor:
        """What of a ``command`` (N, 3) the base obeys during ``skill`` (N, labels)."""
        return torch.minimum(torch.maximum(command, skill @ self.slowest), skill @ self.fastest)

    def draw(self, rng: np.random.Generator, skill: np.ndarray) -> np.ndarray:
        """(k, 3) commands for episodes of skills (k,), by index: none in a share ``config.still`` of them, of a skill that may
        stand."""
        low, high = self.paces[skill, 0], self.paces[skill, 1]
        stands = ((low <= 0) & (high >= 0)).all(axis=1) & (rng.random(len(skill)) < self.config.still)
        return rng.uniform(low, high) * ~stands[:, None]

    @property
    def history(self) -> int:
        """Numbers in the history."""
        return self.config.history * (3 + 3 + len(self.joint_names) + 3)

    def clip(self, action: Tensor) -> Tensor:
        return torch.clamp(action, -self.config.action_max, self.config.action_max)

    def acted(self, signals: Signals, action: Tensor) -> Tensor:
        """What is done of an actor's ``action`` (N, acting): no more than may be, and nothing about a ball that is lost."""
        return (1 - signals.lost.to(action.dtype)) * self.clip(action)

    def target(self, signals: Signals, action: Tensor) -> Tensor:
        """Joint targets (N, n) rad for what is done of an ``action`` (N, acting)."""
        target = signals.rest + action @ self.drive
        return torch.minimum(torch.maximum(target, self.lower), self.upper)

    @staticmethod
    def walking(command: Tensor) -> Tensor:
        """Whether ``command`` (N, 3) says so (N, 1) bool."""
        return command.abs().amax(dim=-1, keepdim=True) > WALKS

    def gait(self, command: Tensor) -> Tensor:
        """What the base does (N, its labels), one-hot: it walks where ``command`` (N, 3) says so, and else keeps its feet
        where they are; told to walk on the spot, it would drift towards a ball that it holds."""
        moves = self.walking(command).to(command.dtype)
        return moves * self.gaits[0] + (1 - moves) * self.gaits[1]

    def remember(self, signals: Signals) -> Tensor:
        """The history (N, size) that the next tick sees."""
        size = self.history // self.config.history
        return torch.cat([present(signals), signals.history[:, : self.history - size]], dim=-1)

    def carries(self, signals: Signals, action: Tensor) -> dict[str, Tensor]:
        """What the next tick has to be told of this one."""
        return {"carry_action": action, "carry_history": self.remember(signals), **signals.carried}

    def carry_start(self) -> dict[str, list[float]]:
        """What each carried tensor is before the first tick; an empty list is zeros."""
        start = torch.where(self.acts > 0, _buffer(self.clips.start()), _buffer(self.clips.stance[0]))
        known = {"carry_base_posture": start.tolist(), "carry_arms": start[self.acting].tolist()}
        return {n: known.get(n, []) for n in self.inputs() if n.startswith("carry_")}

    def inputs(self) -> dict[str, list[int]]:
        """Every input by name with its shape, without the batch axis, in the order of ``forward``."""
        n = len(self.joint_names)
        base = {} if self.base is None else self.base.inputs()
        return {
            "joint_pos": [n],
            "joint_vel": [n],
            "orientation_base_in_world": [4],
            "angular_velocity_base_in_base": [3],
            **({} if self.base is None else {"command_velocity": [3]}),
            "skill": [len(self.labels)],
            "object_position_in_base": [3],
            "object_velocity_in_base": [3],
            "carry_action": [len(self.acting)],
            "carry_history": [self.history],
            **(
                {}
                if self.base is None
                else {
                    "carry_skill": [len(self.labels)],
                    "carry_clock": [1],
                    "carry_arms": [len(self.acting)],
                    "carry_rested": [1],
                }
            ),
            **{_of_base(name): shape for name, shape in base.items() if name.startswith("carry_")},
        }

    def outputs(self) -> dict[str, list[int]]:
        """Every output by name with its shape, without the batch axis, in the order of ``forward``."""
        n, actions = len(self.joint_names), len(self.acting)
        size = self.history // self.config.history + n + 3 + actions + len(self.labels) + 7 + self.history
        return {
            "joint_pos_target": [n],
            **{f"{name}_next": shape for name, shape in self.inputs().items() if name.startswith("carry_")},
            "observation": [size],
            "action": [actions],
        }

    def signals(self, **inputs: Tensor) -> Signals:
        """The inputs by name, each (N, size), and what follows from them."""
        joints = inputs["joint_pos"], inputs["joint_vel"]
        orientation, gyro, skill = (
            inputs[n] for n in ("orientation_base_in_world", "angular_velocity_base_in_base", "skill")
        )
        ball = torch.cat([inputs["object_position_in_base"], inputs["object_velocity_in_base"]], dim=-1)
        if self.base is not None:
            last = inputs["carry_skill"]
            skill = self.plan.performed(skill, last, inputs["carry_clock"], ball)
        posture, gravity, carried = skill @ self.postures, gravity_in_base(orientation), {}
        if self.base is None:
            planned, lost = torch.zeros(len(skill), 7), torch.zeros(len(skill), 1, dtype=torch.bool)
            config = self.config
            ankle = config.balance_gain * (gravity[:, 0:1] - skill @ self.lean) + config.balance_damping * gyro[:, 1:2]
            rest = posture + self.ankles * ankle
        else:
            command = self.told(inputs["command_velocity"], skill)
            steps = inputs["carry_base_gait"]
            rested = (inputs["carry_rested"] + 1) * Gait.resting(steps)
            calm = (rested >= RESTED) | (Gait.even(steps) & self.walking(command))
            plan = self.plan(skill, last, inputs["carry_clock"], inputs["carry_arms"], ball, calm)
            planned, lost = torch.cat([plan.ball_error, plan.clock / self.plan.longest], dim=-1), plan.lost
            posture = plan.target @ self.spread
            # The base sees the arms on their way to where they were last sent.
            hands = self.acts * (posture - self.base.home + inputs["carry_action"] @ self.drive)
            pose = plan.pose * (1 - self.acts) + hands
            given = {n.replace("carry_base", "carry"): v for n, v in inputs.items() if n.startswith("carry_base_")}
            seen = self.base.advance(*joints, orientation, gyro, command, self.gait(command), **given, pose=pose)
            action = self.base.clip(self.base.actor(observe_base(seen)))
            rest = torch.where(self.acts > 0, posture, self.base.target(seen, action))
            carried = {"carry_skill": skill + 0.0, "carry_clock": plan.clock, "carry_arms": plan.target,
                       "carry_rested": rested}  # fmt: skip
            carried |= {_of_base(name): value for name, value in self.base.carries(seen, action).items()}
        return Signals(*joints, gravity, gyro, skill, inputs["object_position_in_base"],
                       inputs["object_velocity_in_base"], rest, planned, inputs["carry_action"],
                       inputs["carry_history"], lost, carried)  # fmt: skip

    def forward(self, *inputs: Tensor) -> tuple[Tensor, ...]:
        """One tick of a batch of one: the tensors of ``inputs()``, in that order, to those of ``outputs()``."""
        signals = self.signals(**dict(zip(self.inputs(), inputs, strict=True)))
        observation = observe(signals)
        action = self.acted(signals, self.actor(observation))
        return self.target(signals, action), *self.carries(signals, action).values(), observation, action + 0.0


def _of_base(carry: str) -> str:
    return carry.replace("carry_", "carry_base_", 1)


def _buffer(values: np.ndarray) -> Tensor:
    return torch.tensor(values, dtype=torch.float32)
