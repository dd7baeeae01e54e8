"""The training environment: many simulated robots on ``mujoco.batch``, numpy inside, torch at the border (rsl_rl)."""

from __future__ import annotations

import mujoco
import numpy as np
import torch
from mujoco.batch import Batch
from rsl_rl.env import VecEnv
from tensordict import TensorDict
from torch import Tensor

from policies.basics import Basics, down
from policies.graph import PolicyGraph, one_hot
from policies.observations import gravity_in_base, observe, pitched
from policies.physics import Stature, training_model
from policies.randomisation import Randomisation
from policies.rewards import Tick, reward
from policies.terminations import failed
from sim2real.config import load_robot

# As on the wire of the `can` wiring: position 16 bit over +-12.5 rad, velocity 12 bit over +-45 rad/s (the coarsest).
POSITION_STEP, VELOCITY_STEP = 25.0 / 65535, 90.0 / 4095


class Env(VecEnv):
    """One policy period per step, ``config.envs`` robots.

    ``script`` (envs, ticks) of label indices fixes which skill is asked for when (evaluation: everything then starts at
    home, and each robot keeps one velocity command); without it labels and commands change at random times. ``level``
    in [0, 1] is the push curriculum; it adapts while ``adaptive``, and None turns pushes off.
    """

    def __init__(self, config: Basics, seed: int, script: np.ndarray | None = None, level: float | None = 0.0) -> None:
        self.cfg = self.config = config
        self.device = "cpu"
        self.graph = PolicyGraph(config)
        self.rng = np.random.default_rng(seed)
        self.script, self.level, self.adaptive = script, level, script is None
        self.num_envs = n = config.envs if script is None else len(script)
        self.num_actions, joints = len(self.graph.driven), len(self.graph.joint_names)
        self.max_episode_length = round(config.episode / config.period)
        self.episode_length_buf = torch.zeros(n, dtype=torch.long)
        robot = load_robot(config.robot)
        self.model = training_model(robot, self.graph.kp, self.graph.kd, config.timestep)
        self.substeps = round(config.period / config.timestep)
        self.batch = Batch(self.model, n, config.threads)
        self.random = Randomisation(self.batch, self.model)
        self._qpos, self._qvel = self.batch.bind("qpos"), self.batch.bind("qvel")
        self._recorded: dict = {
            "qpos": np.zeros((n, self.substeps, self.model.nq)),
            "qvel": np.zeros((n, self.substeps, self.model.nv)),
        }
        self.stature = Stature(self.model, robot.home_pos)
        labels = len(self.graph.labels)
        self.skill, self.command = torch.zeros(n, labels), torch.zeros(n, 3)
        self.carries = {k: torch.zeros(n, *v) for k, v in self.graph.inputs().items() if k.startswith("carry_")}
        self.action, self.target = torch.zeros(n, self.num_actions), torch.zeros(n, joints)
        self.pose = torch.zeros(n, joints)
        group = np.array([j.group for j in robot.joints])
        self._reach = config.busy_arms * (group == "arm") + config.busy_waist * (group == "waist")
        squat = self.graph.references.lift[self.graph.labels.index("squat")].numpy()
        self._crouch = config.busy_crouch * squat * (group == "leg")
        # How far down each robot is, where it is going and how fast, a tick; all in shares of the way.
        self._down, self._down_goal, self._down_speed = np.zeros((3, n))
        self._goes_down = np.zeros(n, bool)
        self._switch_in, self._push_in, self._busy_in = np.zeros((3, n), np.int64)
        self.observation = torch.zeros(0)
        self._command(np.arange(n))
        self.reset()

    # rsl_rl's side

    def get_observations(self) -> TensorDict:
        return TensorDict({"policy": self.observation}, batch_size=[self.num_envs])

    def step(self, actions: Tensor) -> tuple[TensorDict, Tensor, Tensor, dict]:
        """``actions`` (envs, driven) -> observations, rewards (envs,), dones (envs,), extras. Failed and finished episodes
        start anew; the observation returned is then the new episode's first."""
        self._act(actions.detach())
        tick = self._tick(self._last_action)
        rewards, failures = reward(tick), failed(tick)
        rewards[~np.isfinite(rewards)] = 0.0
        self.episode_length_buf += 1
        timeouts = (self.episode_length_buf.numpy() >= self.max_episode_length) & ~failures
        self.tick, self.failures = tick, failures
        self._adapt(int(timeouts.sum()), int(failures.sum()))
        self._disturb()
        ended = np.flatnonzero(timeouts | failures)
        self._start(ended)
        self._observe()
        extras = {"time_outs": torch.from_numpy(timeouts), "observations": {}}
        dones = torch.from_numpy((timeouts | failures).astype(np.int64))
        return self.get_observations(), torch.from_numpy(rewards.astype(np.float32)), dones, extras

    def reset(self) -> None:
        """Start every episode anew."""
        self._start(np.arange(self.num_envs))
        if self.script is None:  # so that episodes do not all end together
            ages = self.rng.integers(self.max_episode_length, size=self.num_envs)
            self.episode_length_buf = torch.from_numpy(ages)
        self._observe()

    def state_dict(self) -> dict:
        """What a resumed run needs; call ``reset`` on both sides of a checkpoint and they continue alike."""
        return {"rng": self.rng.bit_generator.state, "level": self.level}

    def load_state_dict(self, state: dict) -> None:
        self.rng.bit_generator.state = state["rng"]
        self.level = state["level"]
        self.reset()

    # one policy period

    def _act(self, action: Tensor) -> None:
        """Send the action's targets, late by each robot's delay, and let the physics run."""
        self._last_action, before = self.action, self.target.numpy()
        self.action = self.graph.clip(action)
        self.target = self.graph.target(self.measured, self.action)
        self.carries = self.graph.carries(self.measured, self.action)
        delay = np.floor(self.random.drawn["action_delay"][:, 0])
        delay += self.rng.random(self.num_envs) < self.random.drawn["jitter"][:, 0]
        late = np.arange(self.substeps)[None, :, None] < delay[:, None, None]
        control = np.where(late, before[:, None], self.target.numpy()[:, None]).astype(np.float64)
        self._recorded = self.batch.rollout(
            self.substeps, control, int(mujoco.mjtState.mjSTATE_CTRL), record=("qpos", "qvel"), out=self._recorded
        )

    def _tick(self, last_action: Tensor) -> Tick:
        qpos, qvel = self._qpos, self._qvel
        seen = self.measured
        reference, posture = seen.reference.numpy(), seen.posture.numpy()
        yaw = np.arctan2(2 * (qpos[:, 3] * qpos[:, 6] + qpos[:, 4] * qpos[:, 5]),
                         1 - 2 * (qpos[:, 5] ** 2 + qpos[:, 6] ** 2))  # fmt: skip
        cos, sin, (vx, vy) = np.cos(yaw), np.sin(yaw), qvel[:, :2].T
        return Tick(
            joint_pos=qpos[:, 7:],
            joint_vel=qvel[:, 6:],
            gravity_in_base=pitched(
                gravity_in_base(torch.from_numpy(qpos[:, 3:7])), _tensor(self.stature.pitch(posture)[:, None])
            ).numpy(),
            velocity=np.column_stack([cos * vx + sin * vy, cos * vy - sin * vx]),
            command=seen.command.numpy(),
            angular_velocity_base_in_base=qvel[:, 3:6],
            resting=self.graph.gait.resting(seen.gait)[:, 0].numpy().astype(float),
            height=qpos[:, 2],
            height_reference=self.stature.height(posture),
            reference=reference,
            action=self.action.numpy(),
            last_action=last_action.numpy(),
        )

    def _observe(self) -> None:
        """Measure every robot and build what its policy sees this tick."""
        n, rng, drawn = self.num_envs, self.rng, self.random.drawn
        newest = self.substeps - 1 - np.floor(drawn["state_delay"][:, 0]).astype(int)
        qpos, qvel = (self._recorded[f][np.arange(n), newest] for f in ("qpos", "qvel"))
        joint_pos = (
            qpos[:, 7:] + drawn["joint_offset"] + drawn["joint_pos_noise"] * rng.standard_normal((n, self.model.nu))
        )
        joint_vel = qvel[:, 6:] + drawn["joint_vel_noise"] * rng.standard_normal((n, self.model.nu))
        gyro = qvel[:, 3:6] + drawn["gyro_noise"] * rng.standard_normal((n, 3))
        tilt = drawn["imu_tilt"] + drawn["gravity_noise"] * rng.standard_normal((n, 2))
        orientation = multiply(qpos[:, 3:7], np.column_stack([np.ones(n), tilt / 2, np.zeros(n)]))
        self.signals = {
            "joint_pos": _tensor(np.round(joint_pos / POSITION_STEP) * POSITION_STEP),
            "joint_vel": _tensor(np.round(joint_vel / VELOCITY_STEP) * VELOCITY_STEP),
            "orientation_base_in_world": _tensor(orientation / np.linalg.norm(orientation, axis=-1, keepdims=True)),
            "angular_velocity_base_in_base": _tensor(gyro),
            "command_velocity": self.command.clone(),
            "skill": self.skill.clone(),
        }
        self.measured = self.graph.advance(**self.signals, **self.carries, pose=self.pose + self._reaching())
        self.observation = observe(self.measured)

    # between periods

    def _disturb(self) -> None:
        """Change skills and push, where it is time."""
        config, rng = self.config, self.rng
        if self.script is not None:
            ticks = np.minimum(self.episode_length_buf.numpy(), self.script.shape[1] - 1)
            self.skill = one_hot(self.script[np.arange(self.num_envs), ticks], len(self.graph.labels))
        else:
            self._switch_in -= 1
            now = np.flatnonzero((self._switch_in <= 0) & ~self._goes_down)
            self.skill[now] = one_hot(rng.integers(len(self.graph.labels), size=len(now)), len(self.graph.labels))
            self._switch_in[now] = self._ticks(config.switch, len(now))
            self._command(now)
            self._busy_in -= 1
            self._occupy(np.flatnonzero(self._busy_in <= 0))
            self._down += np.clip(self._down_goal - self._down, -self._down_speed, self._down_speed)
        if self.level is None:
            return
        self._push_in -= 1
        now = np.flatnonzero(self._push_in <= 0)
        low, high = config.push_speed
        speed = rng.uniform(config.push_least, 1.0, len(now)) * (low + (high - low) * self.level)
        speed *= 1 - 0.9 * self._down[now]  # who is down cannot step
        heading = rng.uniform(-np.pi, np.pi, len(now))
        self._qvel[now, 0] += speed * np.cos(heading)
        self._qvel[now, 1] += speed * np.sin(heading)
        self._qvel[now, 3:6] += rng.uniform(-1, 1, (len(now), 3)) * (config.push_turn * speed)[:, None]
        self._push_in[now] = self._ticks(config.push, len(now))

    def _command(self, ids: np.ndarray) -> None:
        """New velocity commands."""
        config, k = self.config, len(ids)
        some = self.rng.random((k, 1)) >= config.command_zero
        self.command[ids] = _tensor(
            self.rng.uniform(config.command_low, config.command_high, (k, 3)) * some * self._difficulty
        )

    def _occupy(self, ids: np.ndarray) -> None:
        """Bodies that are about something else."""
        if len(ids) == 0:
            return
        config, rng, k = self.config, self.rng, len(ids)
        pose = rng.uniform(-1, 1, (k, self.model.nu)) * self._reach + rng.uniform(0, 1, (k, 1)) * self._crouch
        goes = self._goes_down[ids]
        busy = (rng.random(k) < config.busy) & ~goes
        self.pose[ids] = _tensor(pose * busy[:, None] * self._difficulty)
        self._busy_in[ids] = self._ticks(config.busy_every, k)
        if goes.any():
            self._down_goal[ids] = goes * np.clip(rng.uniform(-0.4, 1.4, k), 0, 1)
            self._down_speed[ids] = config.period / rng.uniform(*config.down_in, k)

    def _reaching(self) -> Tensor:
        """(envs, n) rad, what the way to the floor adds to the pose."""
        if not self._down.any():
            return torch.zeros_like(self.pose)
        return _tensor(down(self.graph.joint_names, self._down))

    @property
    def _difficulty(self) -> float:
        return 1.0 if self.level is None else self.config.easy + (1 - self.config.easy) * self.level

    def _adapt(self, survived: int, fell: int) -> None:
        """Make it harder while more than half of the episodes survive."""
        if self.adaptive and self.level is not None:
            self.level = float(np.clip(self.level + 0.002 * (survived - fell), 0.0, 1.0))

    def _start(self, ids: np.ndarray) -> None:
        """New robots in ``ids``, each inside some motion at some phase, or at home."""
        if len(ids) == 0:
            return
        config, rng, k, labels = self.config, self.rng, len(ids), len(self.graph.labels)
        self.random.draw(ids, rng)
        self.batch.reset(ids, stage=mujoco.mjtStage.mjSTAGE_NONE)
        home = np.full(k, True) if self.script is not None else rng.random(k) < config.home_start
        label = self.script[ids, 0] if self.script is not None else rng.integers(labels, size=k)
        if config.down and self.script is None:
            self._goes_down[ids] = goes = rng.random(k) < config.down
            label = np.where(goes, self.graph.labels.index("stand"), label)
            self._down[ids] = goes * ~home * rng.random(k)
        skill, phase = one_hot(label, labels), _tensor(rng.random((k, 1)))
        at_home = torch.from_numpy(home)[:, None]
        pose = torch.where(at_home, self.graph.home, self.graph.references.goal(skill, phase)) + self._reaching()[ids]
        self.skill[ids] = skill
        for carry in self.carries.values():
            carry[ids] = 0.0
        self.carries["carry_skill"][ids] = torch.where(at_home, 0.0, skill)
        self.carries["carry_phase"][ids] = torch.where(at_home, 0.0, phase)
        self.carries["carry_posture"][ids] = pose
        self.target[ids] = pose
        self.action[ids] = 0.0
        self.pose[ids] = 0.0
        if self.script is None:
            self._command(ids)
            self._occupy(ids)
        joint_pos = np.clip(pose.numpy() + rng.uniform(-0.05, 0.05, pose.shape), *self.model.jnt_range[1:].T)
        yaw, tilt = rng.uniform(-np.pi, np.pi, k), rng.uniform(-0.04, 0.04, (k, 2))
        tilt[:, 1] += self.stature.pitch(pose.numpy())
        orientation = multiply(
            np.column_stack([np.cos(yaw / 2), np.zeros((k, 2)), np.sin(yaw / 2)]),
            np.column_stack([np.cos(tilt[:, 1] / 2), np.sin(tilt / 2), np.zeros(k)]),
        )
        height = self.stature.height(pose.numpy()) + rng.uniform(0.0, 0.015, k)
        self._qpos[ids] = np.column_stack([np.zeros((k, 2)), height, orientation, joint_pos])
        self._qvel[ids] = rng.uniform(-0.1, 0.1, (k, self.model.nv))
        self._recorded["qpos"][ids] = self._qpos[ids, None]
        self._recorded["qvel"][ids] = self._qvel[ids, None]
        self.episode_length_buf[ids] = 0
        self._switch_in[ids] = self._ticks(config.switch, k)
        self._push_in[ids] = self._ticks(config.push, k)

    def _ticks(self, seconds: tuple[float, float], k: int) -> np.ndarray:
        return np.round(self.rng.uniform(*seconds, k) / self.config.period).astype(np.int64)


def multiply(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Products of quaternions (N, 4), w first."""
    aw, ax, ay, az = a.T
    bw, bx, by, bz = b.T
    return np.column_stack(
        [
            aw * bw - ax * bx - ay * by - az * bz,
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
        ]
    )


def _tensor(values: np.ndarray) -> Tensor:
    return torch.from_numpy(values.astype(np.float32))
