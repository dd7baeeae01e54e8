"""The training environment: many robots with a ball on ``mujoco.batch``, numpy inside, torch at the border (rsl_rl).

Rewards are given for the instant one physics step before the end of a period: there MuJoCo's positions, contacts and
forces belong together without another pass, and the reference table has a row for it.
"""

from __future__ import annotations

import mujoco
import numpy as np
import torch
from mujoco.batch import Batch
from rsl_rl.env import VecEnv
from tensordict import TensorDict
from torch import Tensor

from policies import ball
from policies.clips.kinematics import conjugate, heading, multiply, quaternion_from_rotation_vector, rotate
from policies.clips.robot import POINT_NAMES, RobotBody
from policies.env import POSITION_STEP, VELOCITY_STEP
from policies.graph import one_hot
from policies.skillmimic.amp import Discriminator, features
from policies.skillmimic.config import SkillMimic
from policies.skillmimic.graph import PolicyGraph
from policies.skillmimic.observations import observe
from policies.skillmimic.plan import GRAVITY
from policies.skillmimic.randomisation import Randomisation
from policies.skillmimic.rewards import SENSITIVITIES, Motion, Step, reward
from policies.skillmimic.sight import Sight
from policies.skillmimic.stance import arms, moved
from policies.skillmimic.starts import object_start, thrown
from policies.skillmimic.terminations import failed, up
from sim2real.object.scene import AIMING
from sim2real.types import Sim2realError

BASE, JOINTS, BALL = slice(0, 7), slice(7, -7), slice(-7, -4)  # of qpos
WIDENS = 0.2  # of the curriculum's level, where every robot survives an episode
SPIN, RATES, FLIGHT = slice(3, 6), slice(6, -6), slice(-6, -3)  # of qvel


class Env(VecEnv):
    """One policy period per step, ``config.envs`` robots, each somewhere inside some clip of some skill.

    An episode lasts ``config.frames`` ticks; of a clip that ends, at most ``config.after`` s beyond its end. From there on
    the last frame is what is imitated, but for a ball in flight, which then may be anywhere.
    """

    def __init__(self, config: SkillMimic, seed: int, graph: PolicyGraph | None = None, skill: str = "") -> None:
        """``skill``: only this one of the policy's, whatever ``config.practise`` says."""
        self.cfg = self.config = config
        self.device = "cpu"
        self.graph = graph or PolicyGraph(config)
        self.model, self.contacts, self.clips = self.graph.model, self.graph.contact_graph, self.graph.clips
        self.sensitivity = SENSITIVITIES[config.sensitivity]
        chosen = (skill,) if skill else config.practise or config.skills
        if strangers := [name for name in chosen if name not in config.skills]:
            raise Sim2realError(f"practise: got '{strangers[0]}', expected some of {', '.join(config.skills)}")
        self.skills = [k for k, name in enumerate(config.skills) if name in chosen]
        # Of a curriculum: 0 draws ``config.easy`` of every range of the randomisation, 1 all of it.
        self.level: float | None = 0.0 if config.easy < 1 else None
        self.rng = np.random.default_rng(seed)
        self.num_envs = n = config.envs
        self.num_actions, joints = len(self.graph.acting), len(self.graph.joint_names)
        self.max_episode_length = config.frames
        self.episode_length_buf = torch.zeros(n, dtype=torch.long)
        self.substeps = round(config.period / config.timestep)
        self.batch = Batch(self.model, n, config.threads)
        self.random = Randomisation(self.batch, self.model)
        self._widen(0, 0)
        timed = np.array([name in config.timed for name in config.skills])
        self._timed = timed[self.clips.skill]  # whose clock is the plan's
        self._ends = ~(self.clips.swing | self.clips.loop)
        self._lies = np.array([object_start(self.graph, k)["how"] == "placed" for k in range(len(self.clips.names))])
        self._throws = {k: t for k in range(len(self.clips.names)) if (t := thrown(self.graph, k))}
        self._qpos, self._qvel = self.batch.bind("qpos"), self.batch.bind("qvel")
        self._anchors, self._sites = self.batch.bind("xanchor"), self.batch.bind("site_xpos")
        self._bodies, self._turns = self.batch.bind("xpos"), self.batch.bind("xquat")
        self._trunk = self.model.body(self.graph.body.trunk).id
        self._place = _point_columns(self.graph.body)
        self._recorded: dict = {
            "qpos": np.zeros((n, self.substeps, self.model.nq)),
            "qvel": np.zeros((n, self.substeps, self.model.nv)),
            "sensordata": np.zeros((n, self.substeps, self.model.nsensordata)),
        }
        self.clip, self.row = np.zeros(n, np.intp), np.zeros(n, np.intp)  # what is imitated, and how far it is
        # Physics steps since the clip began, whatever a plan's clock says; negative while the ball is aimed.
        self.since = np.zeros(n, np.intp)
        self._aims = np.zeros(n, np.intp)  # ticks until a ball that is thrown flies
        self._miss = np.zeros((n, 3))  # m/s by which a ball flies otherwise than in its clip
        self.skill, self.command = torch.zeros(n, len(self.graph.labels)), torch.zeros(n, 3)
        self.carries = {k: torch.zeros(n, *v) for k, v in self.graph.inputs().items() if k.startswith("carry_")}
        self.action, self.target = torch.zeros(n, self.num_actions), torch.zeros(n, joints)
        self.sight = Sight(n, config.period)
        self._last_points = np.zeros((n, self._place.shape[0] + 1, 3))
        self._last_joint_vel = np.zeros((n, joints))
        self.observation, self.privileged = torch.zeros(0), torch.zeros(0)
        self.terms: dict[str, np.ndarray] = {}  # sub-rewards of the last step
        self.failures = np.zeros(n, bool)
        self.discriminator: Discriminator | None = None
        if config.variant == "amp":
            self.discriminator = Discriminator(self.clips, self.reference, self.substeps, seed)
            self._last_features = features(self.reference(*self.clips.rows(self.clip, self.row)))
        self.reset()

    # rsl_rl's side

    def get_observations(self) -> TensorDict:
        groups = {"policy": self.observation, "privileged": self.privileged}
        return TensorDict(groups, batch_size=[self.num_envs])  # type: ignore[arg-type]

    def step(self, actions: Tensor) -> tuple[TensorDict, Tensor, Tensor, dict]:
        """``actions`` (envs, n) -> observations, rewards (envs,), dones (envs,), extras. Failed and finished episodes
        start anew; the observation returned is then the new episode's first."""
        last_action = self.action
        self._act(actions.detach())
        self.now = now = self._judge((self.action - last_action).numpy())
        rewards, self.terms = reward(now, self.config.variant, self.sensitivity)
        if self.discriminator is not None:
            seen = features(now.state)
            rewards = self.discriminator.reward(np.concatenate([self._last_features, seen], axis=1))
            self.terms, self._last_features = {"discriminator": rewards}, seen
        self.failures = failed(now, (*self.config.terminations, *self.config.hopeless))
        rewards[~np.isfinite(rewards)] = 0.0
        self.episode_length_buf += 1
        over = self.episode_length_buf.numpy() >= self.max_episode_length
        beyond = self.since - self.clips.length[self.clip] + 1  # physics steps past the end of a clip that has one
        over |= self._ends[self.clip] & (beyond * self.config.timestep >= self.config.after)
        timeouts = over & ~self.failures
        self._push()
        self._widen(int(timeouts.sum()), int(self.failures.sum()))
        self._start(np.flatnonzero(over | self.failures))
        self._observe()
        extras = {"time_outs": torch.from_numpy(timeouts), "observations": {}}
        dones = torch.from_numpy((over | self.failures).astype(np.int64))
        return self.get_observations(), torch.from_numpy(rewards.astype(np.float32)), dones, extras

    def reset(self) -> None:
        """Start every episode anew."""
        self._start(np.arange(self.num_envs))
        ages = self.rng.integers(self.max_episode_length, size=self.num_envs)  # so that they do not all end together
        self.episode_length_buf = torch.from_numpy(ages)
        self._observe()

    def state_dict(self) -> dict:
        """What a resumed run needs; call ``reset`` on both sides of a checkpoint and they continue alike."""
        more = {} if self.discriminator is None else {"discriminator": self.discriminator.state_dict()}
        return {"rng": self.rng.bit_generator.state, "level": self.level, **more}

    def load_state_dict(self, state: dict) -> None:
        self.rng.bit_generator.state = state["rng"]
        self.level = state.get("level", self.level)
        self._widen(0, 0)
        if self.discriminator is not None:
            self.discriminator.load_state_dict(state["discriminator"])
        self.reset()

    # one policy period

    def _act(self, action: Tensor) -> None:
        """Send the action's targets, late by each robot's delay, and let the physics run."""
        before = self.target.numpy()
        self._aim()
        self.action = self.graph.acted(self.measured, action)
        self.target = self.graph.target(self.measured, self.action)
        self.carries = self.graph.carries(self.measured, self.action)
        delay = np.floor(self.random.drawn["action_delay"][:, 0])
        delay += self.rng.random(self.num_envs) < self.random.drawn["jitter"][:, 0]
        late = np.arange(self.substeps)[None, :, None] < delay[:, None, None]
        control = np.where(late, before[:, None], self.target.numpy()[:, None]).astype(np.float64)
        self._recorded = self.batch.rollout(
            self.substeps,
            control,
            int(mujoco.mjtState.mjSTATE_CTRL),
            record=("qpos", "qvel", "sensordata"),
            out=self._recorded,
        )
        self.row += self.substeps
        self.since += self.substeps
        if self.graph.base is not None:
            clock = self.carries["carry_clock"][:, 0].numpy()
            self.row = np.where(
                self._timed[self.clip], np.round(np.maximum(clock, 0) * self.substeps).astype(int), self.row
            )

    def _aim(self) -> None:
        """Whoever throws holds the ball where it will fly from, in front of a base that may move, until they let go."""
        ids = np.flatnonzero(self._aims)
        if len(ids) == 0:
            return
        goes = (self._aims[ids] == 1)[:, None]
        self._qpos[ids, BALL], flight = self._flight(self.clip[ids], self._qpos[ids])
        held = [0.0, 0.0, GRAVITY * self.config.period / 2]  # m/s, that fall brings back within a period
        self._qvel[ids, FLIGHT] = np.where(goes, flight + self._miss[ids], held)
        self._aims[ids] -= 1

    def _flight(self, clip: np.ndarray, qpos: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Where the balls of clips ``clip`` (k,) are thrown from, (k, 3) m, and how, (k, 3) m/s, at robots of ``qpos``
        (k, nq).
        """
        place, velocity = np.array([self._throws[c] for c in clip]).transpose(1, 0, 2)
        turn = quaternion_from_rotation_vector(heading(qpos[:, 3:7])[:, None] * [0.0, 0.0, 1.0])
        return qpos[:, :3] * [1.0, 1.0, 0.0] + rotate(turn, place), rotate(turn, velocity)

    def _judge(self, action_change: np.ndarray) -> Step:
        """The state and its reference, one physics step before now."""
        qpos, qvel = self._recorded["qpos"][:, -2], self._recorded["qvel"][:, -2]
        derived = np.concatenate([self._anchors, self._sites], axis=1)
        points = np.concatenate([qpos[:, None, :3], derived[:, self._place]], axis=1)
        touched = self.contacts.touching(self._recorded["sensordata"]).any(axis=1)
        state = Motion(
            points=points,
            points_velocity=(points - self._last_points) / self.config.period,
            orientation_base_in_world=qpos[:, 3:7],
            joint_pos=qpos[:, JOINTS],
            joint_vel=qvel[:, RATES],
            object_position=qpos[:, BALL],
            object_velocity=qvel[:, FLIGHT],
            contact=touched.astype(float),
        )
        rows, way = self.clips.rows(self.clip, np.maximum(self.row - 1, 0))
        reference = self.clips.motion(rows, way)
        upright = [up(m.orientation_base_in_world) for m in (state, reference)]
        height = [m.points[:, 0, 2] for m in (state, reference)]
        acceleration = (state.joint_vel - self._last_joint_vel) / self.config.period
        self._last_points, self._last_joint_vel = points, state.joint_vel.copy()
        gone = self._ends[self.clip] & (self.row >= self.clips.length[self.clip]) & (reference.contact[:, 0] == 0)
        self.apart, self.lifted = np.linalg.norm(qpos[:, BALL] - qpos[:, :3], axis=1), qpos[:, -5].copy()
        if self.graph.base is not None:
            trunk = self._bodies[:, self._trunk], self._turns[:, self._trunk]
            there = self.clips.trunk_position[rows], self.clips.trunk_orientation[rows]
            state, reference = (arms(m, self.graph.acting) for m in (moved(state, qvel, trunk, there), reference))
            acceleration = acceleration[:, self.graph.acting]
        away = lambda there, here: np.where(gone[:, None], here, there)  # noqa: E731
        reference = reference._replace(
            object_position=away(reference.object_position, state.object_position),
            object_velocity=away(reference.object_velocity, state.object_velocity),
        )
        bounces = self.clips.loop[self.clip]
        return Step(state, reference, acceleration, action_change, *height, *upright, bounces)

    def reference(self, rows: np.ndarray, way: np.ndarray) -> Motion:
        """What is imitated at table ``rows`` (N,), as ``_judge`` sees states."""
        motion = self.clips.motion(rows, way)
        return motion if self.graph.base is None else arms(motion, self.graph.acting)

    def _observe(self) -> None:
        """Measure every robot; what its actor sees this tick, and what only the critic sees."""
        n, rng, drawn = self.num_envs, self.rng, self.random.drawn
        newest = self.substeps - 1 - np.floor(drawn["state_delay"][:, 0]).astype(int)
        qpos, qvel = (self._recorded[f][np.arange(n), newest] for f in ("qpos", "qvel"))
        joints = self.model.nu
        noise = lambda name, size: drawn[name] * rng.standard_normal((n, size))  # noqa: E731
        joint_pos = qpos[:, JOINTS] + drawn["joint_offset"] + noise("joint_pos_noise", joints)
        joint_vel = qvel[:, RATES] + noise("joint_vel_noise", joints)
        gyro = qvel[:, SPIN] + noise("gyro_noise", 3)
        tilt = drawn["imu_tilt"] + noise("gravity_noise", 2)
        orientation = multiply(qpos[:, 3:7], np.column_stack([np.ones(n), tilt / 2, np.zeros(n)]))
        orientation /= np.linalg.norm(orientation, axis=1, keepdims=True)
        seen = self._track()
        inputs = {
            "joint_pos": _tensor(np.round(joint_pos / POSITION_STEP) * POSITION_STEP),
            "joint_vel": _tensor(np.round(joint_vel / VELOCITY_STEP) * VELOCITY_STEP),
            "orientation_base_in_world": _tensor(orientation),
            "angular_velocity_base_in_base": _tensor(gyro),
            **({} if self.graph.base is None else {"command_velocity": self.command.clone()}),
            "skill": self.skill.clone(),
            "object_position_in_base": _tensor(seen[:, :3]),
            "object_velocity_in_base": _tensor(seen[:, 3:]),
        }
        self.inputs = inputs
        with torch.no_grad():
            self.measured = self.graph.signals(**inputs, **self.carries)
        self.observation = observe(self.measured)
        self.privileged = _tensor(self._truth())

    def _track(self) -> np.ndarray:
        """(envs, 6) object_position_in_base and object_velocity_in_base as a tracker tells them."""
        drawn = self.random.drawn
        touched = self.contacts.touching(self._recorded["sensordata"][:, -1])[:, 0]
        late, loss = drawn["object_delay"][:, 0].astype(int), drawn["object_loss"][:, 0]
        noise = np.repeat(np.hstack([drawn["object_noise"], drawn["object_velocity_noise"]]), 3, axis=1)
        held = touched | (self._aims > 0)
        seen = self.sight.look(_ball(self._qpos, self._qvel), held, touched, late, loss, noise, self.rng)
        return _in_base(seen, self._qpos, self._qvel) + np.pad(drawn["object_offset"], ((0, 0), (0, 3)))

    def _truth(self) -> np.ndarray:
        """(envs, size): what the critic may know beside the actor's observation; about 1 in size."""
        qpos, qvel = self._qpos, self._qvel
        rows, way = self.clips.rows(self.clip, self.row)
        reference = self.clips.motion(rows, way)
        back = conjugate(qpos[:, 3:7])
        turn = multiply(back, reference.orientation_base_in_world)
        seen = _in_base(_ball(qpos, qvel), qpos, qvel)
        if self.graph.base is None:
            place = rotate(back, reference.points[:, 0] - qpos[:, :3])
            miss = rotate(back, reference.object_position - qpos[:, BALL])
        else:  # where the base has got to is not this actor's business
            place, turn = np.zeros((len(back), 3)), turn * [[1.0, 1.0, 1.0, 0.0]]
            miss = reference.object_position - reference.points[:, 0] - seen[:, :3]
        ahead = self.episode_length_buf.numpy()[:, None] / self.max_episode_length
        left = (self.clips.length[self.clip] - self.row)[:, None] / 200.0
        columns = [
            rotate(back, qvel[:, :3]),
            place * 4,
            turn[:, 1:] * np.where(turn[:, :1] < 0, -4, 4),
            (reference.joint_pos - qpos[:, JOINTS]) * 2,
            reference.joint_vel * 0.3,
            seen * ([4.0] * 3 + [0.5] * 3),
            miss * 4,
            rotate(back, reference.object_velocity) * 0.5,
            np.minimum(self.contacts.force(self._recorded["sensordata"][:, -1]) / 20.0, 3.0),
            reference.contact,
            qpos[:, 2:3],
            ahead,
            np.where(self.clips.swing[self.clip][:, None], 1.0, np.minimum(left, 1.0)),
            self.random.vector(),
        ]
        return np.clip(np.concatenate(columns, axis=1), -10, 10)

    # between periods

    def _widen(self, survived: int, fell: int) -> None:
        """Draw from more of every range while more than half of the episodes survive."""
        if self.level is not None:
            self.level = float(np.clip(self.level + WIDENS * (survived - fell) / self.num_envs, 0.0, 1.0))
            self.random.share = self.config.easy + (1 - self.config.easy) * self.level

    def _push(self) -> None:
        config, rng = self.config, self.rng
        now = np.flatnonzero(rng.random(self.num_envs) < config.push_chance)
        heading, speed = rng.uniform(-np.pi, np.pi, len(now)), rng.uniform(0, config.push_speed, len(now))
        self._qvel[now, 0] += speed * np.cos(heading)
        self._qvel[now, 1] += speed * np.sin(heading)

    def _start(self, ids: np.ndarray) -> None:
        """New episodes in ``ids``: reference state initialisation (section 5.2), some of it disturbed."""
        if len(ids) == 0:
            return
        rng, k = self.rng, len(ids)
        self.random.draw(ids, rng)
        self.batch.reset(ids, stage=mujoco.mjtStage.mjSTAGE_NONE)
        clip, row = self.clips.sample(rng, k, self.skills)
        self.clip[ids], self.row[ids] = clip, row if self.config.anywhere else 0
        waits = self._wait(ids)
        self.row[ids[waits]] = 0
        self.since[ids] = self.row[ids] - self.substeps * np.maximum(self._aims[ids] - 1, 0)
        rows, _ = self.clips.rows(self.clip[ids], self.row[ids])
        qpos, qvel, target = self.clips.qpos[rows].copy(), self.clips.qvel[rows].copy(), self.clips.target[rows].copy()
        swollen = ball.RADIUS * (self.random.drawn["ball_radius"][ids] - 1)  # m; hands lie on the ball that there is
        qpos[:, JOINTS] -= self.clips.press[rows] * swollen
        if (lies := self._lies[self.clip[ids]] & (self.row[ids] == 0)).any():
            qpos[:, -7:-5] += lies[:, None] * rng.uniform(-self.config.placed, self.config.placed, (k, 2))
            qpos[:, -5] += lies * swollen[:, 0]
        flies = (self.clips.motion(rows, np.ones(k)).contact[:, :1] == 0) & ~self._lies[self.clip[ids], None]
        self._miss[ids] = flies * rng.uniform(-self.config.throw, self.config.throw, (k, 3))
        qvel[:, FLIGHT] += self._miss[ids]
        if waits.any():  # the ball is in other hands, and the arms come from somewhere between here and home
            arms_home = waits[:, None] * rng.random((k, 1)) * self.graph.acts.numpy()
            qpos[:, JOINTS] += arms_home * (self.graph.robot.home_pos - qpos[:, JOINTS])
            target += arms_home * (self.graph.robot.home_pos - target)
            qvel[waits] = 0.0
            qpos[waits, BALL], _ = self._flight(clip[waits], qpos[waits])
        self._disturb(qpos, qvel, rng.random(k) < self.config.disturbed)
        self._qpos[ids], self._qvel[ids] = qpos, qvel
        self._recorded["qpos"][ids], self._recorded["qvel"][ids] = qpos[:, None], qvel[:, None]
        self._recorded["sensordata"][ids] = 0.0
        self.skill[ids] = one_hot(self.clips.skill[self.clip[ids]], len(self.graph.labels))
        self.target[ids] = _tensor(target)
        self.action[ids] = 0.0
        for carry in self.carries.values():
            carry[ids] = 0.0
        if self.graph.base is not None:
            self.carries["carry_skill"][ids] = self.skill[ids]
            self.carries["carry_clock"][ids] = _tensor(
                np.where(self.clips.swing[clip], 0.0, self.row[ids] / self.substeps)[:, None]
            )
            self.carries["carry_arms"][ids] = self.target[ids][:, self.graph.acting]
            # whose arms are where they are sent
            self.carries["carry_base_posture"][ids] = torch.where(
                self.graph.acts > 0, self.target[ids], _tensor(self.clips.stance[rows])
            )
            self.command[ids] = _tensor(self.graph.draw(rng, self.clips.skill[self.clip[ids]]))
            self.carries["carry_base_skill"][ids] = self.graph.gait(self.command[ids])
        self.sight.begin(ids, _ball(qpos, qvel), ~flies[:, 0] | waits)
        before = self.clips.rows(self.clip[ids], np.maximum(self.row[ids] - 1, 0))
        self._last_points[ids] = self.clips.motion(*before).points
        if self.discriminator is not None:
            self._last_features[ids] = features(self.reference(*before))
        self._last_joint_vel[ids] = qvel[:, RATES]
        self.episode_length_buf[ids] = 0

    def _wait(self, ids: np.ndarray) -> np.ndarray:
        """(k,) bool, whose ball is aimed before it is thrown: in training half of those who can, for up to AIMING."""
        config, longest = self.config, round(AIMING / self.config.period)
        some = np.isin(self.clip[ids], list(self._throws))
        if config.anywhere:
            ticks = self.rng.integers(1, longest, size=len(ids), endpoint=True)
            self._aims[ids] = np.where(some & (self.rng.random(len(ids)) < 0.5), ticks, 0)
        else:
            self._aims[ids] = some * longest
        return self._aims[ids] > 0

    def _disturb(self, qpos: np.ndarray, qvel: np.ndarray, chosen: np.ndarray) -> None:
        """Move the starts ``chosen`` (k,) bool beside their reference, in place: all of the robot, with the ball."""
        rng, k, w = self.rng, len(qpos), chosen[:, None]
        qpos[:, JOINTS] += w * rng.uniform(-0.05, 0.05, (k, self.model.nu))
        qpos[:, JOINTS] = np.clip(qpos[:, JOINTS], *self.model.jnt_range[1:-1].T)
        turn = quaternion_from_rotation_vector(w * rng.uniform(-0.04, 0.04, (k, 3)))
        arm = qpos[:, BALL] - qpos[:, :3]  # the ball turns with the robot, so it stays in the hands
        qpos[:, 3:7] = multiply(turn, qpos[:, 3:7])
        qpos[:, BALL] = qpos[:, :3] + rotate(turn, arm)
        up = w * rng.uniform(0.0, 0.01, (k, 1))
        qpos[:, 2:3] += up
        qpos[:, -5:-4] += up
        qpos[:, BALL] += w * rng.uniform(-0.004, 0.004, (k, 3))
        shift = w * rng.uniform(-0.15, 0.15, (k, 3))
        qvel[:, :3] += shift
        qvel[:, FLIGHT] += shift
        qvel[:, RATES] += w * rng.uniform(-0.2, 0.2, (k, self.model.nu))


def _ball(qpos: np.ndarray, qvel: np.ndarray) -> np.ndarray:
    """(k, 6) m and m/s of the ball in the world."""
    return np.hstack([qpos[:, BALL], qvel[:, FLIGHT]])


def _in_base(ball: np.ndarray, qpos: np.ndarray, qvel: np.ndarray) -> np.ndarray:
    """(k, 6) m and m/s of a ``ball`` (k, 6) in the world, seen from bases that do not turn."""
    back = conjugate(qpos[:, 3:7])
    apart = ball[:, :3] - qpos[:, :3], ball[:, 3:] - qvel[:, :3]
    return np.concatenate([rotate(back, x) for x in apart], axis=1)


def _point_columns(body: RobotBody) -> np.ndarray:
    """(points,) where the key points of a clip are in joint anchors followed by site positions."""
    joints = body.model.njnt + 1  # and the ball's free joint, after the robot's
    place = dict(body.joint_ids)
    for k, side in enumerate(("left", "right")):
        place[f"{side}_palm"], place[f"{side}_foot"] = joints + int(body.palms[k]), joints + int(body.feet[k])
    return np.array([place[name] for name in POINT_NAMES])


def _tensor(values: np.ndarray) -> Tensor:
    return torch.from_numpy(values.astype(np.float32))
