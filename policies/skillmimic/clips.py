"""The clips of a run as one table: a row is a reference instant, rows are one physics step apart."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import mujoco
import numpy as np

from policies import ball
from policies.clips.format import Clip, ClipError
from policies.clips.kinematics import conjugate, rate, rotate
from policies.clips.library import robot_clips
from policies.clips.resample import resample
from policies.clips.robot import POINT_NAMES, RobotBody
from policies.contact_graph import ContactGraph, reference_edges
from policies.skillmimic.config import SkillMimic
from policies.skillmimic.plan import GRAVITY, TIPS, Rows
from policies.skillmimic.rewards import Motion
from policies.skillmimic.stance import crouched, stand, trunks

SINGULAR = 0.08  # m/rad: damps the way back from palms to joints where an arm is stretched
LATE = 0.02  # s, on average, until a target acts: it is held for a tick, and travels
YIELD = 0.24  # s after both palms have met a ball that bounces, until which they have brought it where it belongs
LEVER = 0.3  # m: of palms, a rad counts as this far
PRESS = 0.004  # m the palms start inside the ball, so that they carry it from the first step on


class Grip(NamedTuple):
    """What standing and holding ask of the joints beyond the clip's posture, each (T, n) rad."""

    press: np.ndarray  # to be added to positions: both palms ``PRESS`` into the ball
    effort: np.ndarray  # to be added to targets: static torque over kp


class ReferenceClips:
    """Every clip of ``config.skills``, end to end.

    ``first`` and ``length`` (clips,): rows of each; ``skill`` (clips,) its label's index; ``swing`` (clips,) whether it
    plays to and fro, ``loop`` whether over and over. ``qpos`` (rows, 7 + n + 7), ``qvel`` (rows, 6 + n + 6) and ``target``
    (rows, n) start an episode. How a base policy stands: ``stance`` (rows, n) rad, which has the trunk at
    ``trunk_position`` (rows, 3) m and ``trunk_orientation`` (rows, 4).
    """

    def __init__(
        self,
        config: SkillMimic,
        model: mujoco.MjModel,
        body: RobotBody,
        graph: ContactGraph,
        kp: np.ndarray,
        crouch: np.ndarray | None = None,
    ) -> None:
        """``crouch`` (n,) rad: how a base policy bends its knees; then clips are of robots that stand (stance.py)."""
        clips: list[Clip] = []
        labels: list[int] = []
        for k, skill in enumerate(config.skills):
            found = [c for c in robot_clips(config.robot, skill) if not config.clips or c.name in config.clips]
            if not found:
                raise ClipError(f"skill '{skill}': none of its clips is in {', '.join(config.clips)}, expected one")
            clips += found
            labels += [k] * len(found)
        for clip in clips:
            _check(clip, body)
        self.recorded = list(clips)  # as they are in their files
        if crouch is not None:
            for k, skill in enumerate(config.skills):
                mine = [i for i, label in enumerate(labels) if label == k and skill not in config.bends]
                heights = [clips[i].base_position_in_world[:, 2].mean() for i in mine]
                stance, height = crouched(body, body.robot.home_pos, crouch, float(np.mean(heights or [0.0])))
                for i in mine:
                    clips[i] = stand(clips[i], body, stance, height)
        fine = [resample(clip, 1 / config.timestep) for clip in clips]
        self.hands = np.array([c.contact[:, :2].any(axis=0) for c in clips])  # (clips, 2): which ever touch the ball
        self._config, self._model, self._body = config, model, body
        self.names = [clip.name for clip in clips]
        self.length = np.array([len(c) for c in fine])
        self.first = np.cumsum([0, *self.length[:-1]])
        self.skill = np.array(labels)
        self.swing, self.loop = (np.array([config.skills[k] in c for k in labels]) for c in (config.swing, config.loop))
        sides = tuple(model.geom(int(geoms[0])).name for geoms in body.hand_geoms)
        legs = np.array([j.group != "arm" for j in body.robot.joints])
        self.stance = np.where(legs, np.concatenate([c.joint_pos for c in fine]), body.robot.home_pos)
        places = [trunks(body, c) for c in fine]
        self.trunk_position, self.trunk_orientation = (np.concatenate(x) for x in zip(*places, strict=True))
        self._motion = _concatenate([_motion(c, graph, sides) for c in fine])
        rows = [_resampled(grip(c, model, body, kp, config.grip), len(f)) for c, f in zip(clips, fine, strict=True)]
        press, effort = (np.concatenate([r[i] for r in rows]) for i in (0, 1))
        m = self._motion
        count = len(press)
        joints = m.joint_pos + press
        self.press = press / PRESS  # (rows, n) rad per m that both palms go towards the ball
        upright = np.tile([1.0, 0, 0, 0], (count, 1))
        self.qpos = np.concatenate([m.points[:, 0], m.orientation_base_in_world, joints, m.object_position, upright], 1)
        spin = np.concatenate([c.base_angular_velocity_in_base for c in fine])
        self.qvel = np.concatenate(
            [m.points_velocity[:, 0], spin, m.joint_vel, m.object_velocity, np.zeros((count, 3))], axis=1
        )
        self.target = joints + effort
        self._lag = body.robot.home_kd / kp + LATE  # s that a motor is behind its target, by its damping and by its bus

    def sample(self, rng: np.random.Generator, k: int, skills: Sequence[int] = ()) -> tuple[np.ndarray, np.ndarray]:
        """(k,) clips and (k,) rows into them: every skill (of ``skills``, by index) as often, then every clip of it, then
        every instant."""
        chosen = np.array(skills or range(self.skill.max() + 1))
        chosen = chosen[rng.integers(len(chosen), size=k)]
        counts = np.bincount(self.skill)
        first = np.searchsorted(self.skill, np.arange(len(counts)))
        clip = first[chosen] + np.floor(rng.random(k) * counts[chosen]).astype(int)
        endless = self.swing[clip] | self.loop[clip]
        last = self.length[clip] - np.where(endless, 0, self.length[clip] // 10)  # leave something to do
        return clip, np.floor(rng.random(k) * last).astype(int)

    def rows(self, clip: np.ndarray, row: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Table rows (N,) of ``row`` (N,) steps into ``clip`` (N,), and which way time runs there: 1 or -1.

        A swinging clip turns at both ends, a looping one begins again, another stays at its last row.
        """
        last = self.length[clip] - 1
        around = np.mod(row, 2 * last)
        back = self.swing[clip] & (around > last)
        once = np.where(self.loop[clip], np.mod(row, last + 1), np.minimum(row, last))
        row = np.where(self.swing[clip], np.where(back, 2 * last - around, around), once)
        return self.first[clip] + row, np.where(back, -1.0, 1.0)

    def motion(self, rows: np.ndarray, way: np.ndarray) -> Motion:
        """The reference at table ``rows`` (N,), with velocities in the direction ``way`` (N,)."""
        m = Motion(*(array[rows] for array in self._motion))
        return m._replace(
            points_velocity=m.points_velocity * way[:, None, None],
            joint_vel=m.joint_vel * way[:, None],
            object_velocity=m.object_velocity * way[:, None],
        )

    def of(self, skill: int) -> list[Clip]:
        """A skill's clips, as they are in their files."""
        return [clip for clip, label in zip(self.recorded, self.skill, strict=True) if label == skill]

    def seconds(self, clip: int) -> float:
        """How long clip number ``clip`` lasts."""
        return float((self.length[clip] - 1) * self._config.timestep)

    def start(self) -> np.ndarray:
        """(n,) rad, targets of a robot that is about to begin with the first skill: the mean of one that plays to and fro."""
        return self.mean(0)[0] if self.swing[0] else self.target[0]

    def plan(self, skill: int, acting: Sequence[int], pull: float) -> Rows:
        """What the arms, joints ``acting`` by index, do in a skill by its first clip; one row for a clip that plays to and
        fro. ``pull``: see ``plan.Rows``; a ball in the hands has no say in the time."""
        clip = int(np.flatnonzero(self.skill == skill)[0])
        every = round(self._config.period / self._config.timestep)
        at = self.first[clip] + np.arange(0, self.length[clip], every)
        m, gone = self._motion, self._gone(clip, at)
        turn = conjugate(m.orientation_base_in_world[at])
        ball_in_base = rotate(turn, m.object_position[at] - m.points[at, 0])
        velocity = rotate(turn, m.object_velocity[at] - m.points_velocity[at, 0])
        target = (self.target[at] + self._lag * m.joint_vel[at])[:, acting]
        flies = (m.contact[at, 0] == 0) & m.object_velocity[at].any(axis=1)  # a ball that lies says nothing of the time
        pulls = pull * flies
        if self.loop[
            clip
        ]:  # a stroke once begun is finished, whatever the ball makes of it; its return says when the next is
            pulls *= velocity[:, 2] > 0
        if self.swing[clip]:
            target, ball_in_base = self.mean(skill)[0][None, acting], ball_in_base.mean(axis=0, keepdims=True)
            velocity, pulls = np.zeros((1, 3)), np.zeros(1)
        pose = self.stance[at[: len(target)]] - self._body.robot.home_pos
        data, back = mujoco.MjData(self._model), np.zeros((len(target), len(acting), TIPS.stop))
        meets = self._config.skills[skill] in self._config.meets
        for t in range(len(target)):
            if gone[t]:
                continue
            data.qpos[:] = self.qpos[at[t]]
            mujoco.mj_kinematics(self._model, data)
            mujoco.mj_comPos(self._model, data)
            for site in self._body.palms[self.hands[clip]]:
                link = self._model.site_bodyid[site]
                moves, turns = _jacobian(self._model, data, data.site_xpos[site], link)[:, :, acting]
                tips = LEVER * np.array([turns[1], -turns[0]])
                level = _inverse(np.concatenate([moves, tips]))
                back[t, :, : TIPS.start] += level[:, : TIPS.start] if meets else _inverse(moves)
                back[t, :, TIPS] += level[:, TIPS] * LEVER
        if self.loop[clip] and self.hands[clip].all():
            share = _followed(m.contact[at, 0] > 0, velocity[:, 2] > 0, YIELD / self._config.period)
            back *= share[:, None, None]
        loop = bool(self.loop[clip])
        ready = loop or not (m.contact[at[0], 0] or pulls[0])
        away = (m.contact[at[: len(target)], 0] == 0) & loop & self.hands[clip].all()
        bends = self._config.skills[skill] in self._config.bends
        left = meets * flies[: len(target)] * np.maximum(velocity[:, 2], 0.0) / GRAVITY
        return Rows(target, pose, ball_in_base, velocity, back, loop, ready, bends, away, pulls, left)

    def _gone(self, clip: int, at: np.ndarray) -> np.ndarray:
        """(rows,) bool: whether the ball has left the hands for good."""
        held = self._motion.contact[at, 0] > 0
        return ~np.maximum.accumulate(held[::-1])[::-1] & ~self.loop[clip]

    def mean(self, skill: int) -> tuple[np.ndarray, np.ndarray]:
        """Of one skill, every clip counting alike: mean target (n,) rad, and mean gravity in the base (3,)."""
        chosen = np.flatnonzero(self.skill == skill)
        pieces = [slice(self.first[c], self.first[c] + self.length[c]) for c in chosen]
        w, x, y, z = self._motion.orientation_base_in_world.T
        gravity = np.stack([2 * (w * y - x * z), -2 * (w * x + y * z), 2 * (x * x + y * y) - 1], axis=1)
        posture, down = (np.mean([a[p].mean(axis=0) for p in pieces], axis=0) for a in (self.target, gravity))
        return posture, down


def grip(clip: Clip, model: mujoco.MjModel, body: RobotBody, kp: np.ndarray, force: float) -> Grip:
    """Forces of every frame: the robot's weight on the standing feet, what moves the arms, and what moves and bears the
    ball on the holding palms, which press it with ``force`` N each where both are on it."""
    data = mujoco.MjData(model)
    speeds = np.zeros((len(clip), model.nv))
    speeds[:, 6:-6] = clip.joint_vel * np.array([j.group == "arm" for j in body.robot.joints])
    accelerations = rate(speeds, clip.fps)
    push = ball.MASS * (rate(clip.ball_velocity_in_world, clip.fps) + [0.0, 0.0, GRAVITY])  # (T, 3) N on the ball
    arms = np.array([j.group == "arm" for j in body.robot.joints])
    robot = model.body(body.robot.base).id
    palms, feet = (list(zip(ids, model.site_bodyid[ids], strict=True)) for ids in (body.palms, body.feet))
    press, effort = np.zeros((2, len(clip), len(arms)))
    for t in range(len(clip)):
        data.qpos[:3], data.qpos[3:7] = clip.base_position_in_world[t], clip.base_orientation_in_world[t]
        data.qpos[7:-7], data.qpos[-7:-4] = clip.joint_pos[t], clip.ball_position_in_world[t]
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_rne(model, data, 0, data.qfrc_bias)
        torque = data.qfrc_bias[6:-6].copy()
        data.qvel[:], data.qacc[:] = speeds[t], accelerations[t]
        mujoco.mj_fwdVelocity(model, data)
        mujoco.mj_rne(model, data, 1, data.qfrc_bias)
        moving = data.qfrc_bias + model.dof_armature * accelerations[t]
        torque = np.where(arms, moving[6:-6], torque)
        data.qvel[:] = 0.0
        mass, centre = float(model.body_subtreemass[robot]), data.subtree_com[robot].copy()
        holding = [palm for palm, on in zip(palms, clip.contact[t, :2], strict=True) if on]
        standing = [foot for foot, on in zip(feet, clip.contact[t, 2:], strict=True) if on]
        for site, link in holding:
            towards = clip.ball_position_in_world[t] - data.site_xpos[site]
            towards /= np.linalg.norm(towards)
            jacobian, _ = _jacobian(model, data, data.site_xpos[site], link)
            if len(holding) == 2:
                torque += jacobian.T @ (force * towards)
                press[t] += np.linalg.pinv(jacobian * arms, rcond=1e-2) @ (PRESS * towards)
            torque += jacobian.T @ (push[t] / len(holding))
        if holding:
            centre = (mass * centre + ball.MASS * clip.ball_position_in_world[t]) / (mass + ball.MASS)
            mass += ball.MASS
        if standing:  # pressure below the centre of mass
            off = centre - np.mean([data.site_xpos[site] for site, _ in standing], axis=0)
            for site, link in standing:
                point = data.site_xpos[site] + [off[0], off[1], 0]
                torque -= _jacobian(model, data, point, link)[0].T @ [0, 0, mass * GRAVITY / len(standing)]
        legs = np.array([j.group == "leg" for j in body.robot.joints])
        effort[t] = np.where(legs & (not standing), 0.0, torque / kp)
    return Grip(press, effort)


def _followed(held: np.ndarray, rises: np.ndarray, rows: float) -> np.ndarray:
    """(T,) in [0, 1]: how far two palms follow a ball that is off its place, in a clip that begins again. ``held``, ``rises``
    (T,) bool. Not while it falls, which only shakes the robot; more and more in the first half of its rise; and less and
    less in the first ``rows`` in which they hold it: a ball between palms that follow it runs away with them."""
    free = rises & ~held
    risen = np.where(free, np.cumsum(free) / max(1.0, free.sum() / 2), 0.0)
    twice = np.tile(held, 2)
    since = np.arange(len(twice)) - np.maximum.accumulate(np.where(twice, 0, np.arange(len(twice))))
    return np.clip(np.where(held, 1 - since[len(held) :] / rows, risen), 0, 1)


def _jacobian(model: mujoco.MjModel, data: mujoco.MjData, point: np.ndarray, link: int) -> np.ndarray:
    """(2, 3, n) of a point (3,) m in the world on a body, and of how that turns, by the robot's joints."""
    jacobian = np.zeros((2, 3, model.nv))
    mujoco.mj_jac(model, data, jacobian[0], jacobian[1], np.asarray(point, float), int(link))
    return jacobian[:, :, 6:-6]


def _inverse(jacobian: np.ndarray) -> np.ndarray:
    """(n, k) of a jacobian (k, n), damped."""
    return jacobian.T @ np.linalg.inv(jacobian @ jacobian.T + SINGULAR**2 * np.eye(len(jacobian)))


def _check(clip: Clip, body: RobotBody) -> None:
    header = clip.header
    if header.joint_names != body.robot.joint_names or header.point_names != POINT_NAMES:
        raise ClipError(
            f"clip '{clip.name}': made for other joints or key points than {body.robot.name} has now;"
            f" make it again: sim2real clips retarget --library --robot {body.robot.name}"
        )
    if not header.has_ball:
        raise ClipError(
            f"clip '{clip.name}': has no ball, expected one; ball skills are learned from clips with a ball"
        )


def _motion(clip: Clip, graph: ContactGraph, sides: tuple[str, ...]) -> Motion:
    points = np.concatenate([clip.base_position_in_world[:, None], clip.points_in_world], axis=1)
    return Motion(
        points=points,
        points_velocity=rate(points, clip.fps),
        orientation_base_in_world=clip.base_orientation_in_world,
        joint_pos=clip.joint_pos,
        joint_vel=clip.joint_vel,
        object_position=clip.ball_position_in_world,
        object_velocity=clip.ball_velocity_in_world,
        contact=reference_edges(graph, clip.contact[:, :2], "ball", sides).astype(float),
    )


def _concatenate(motions: list[Motion]) -> Motion:
    return Motion(*(np.concatenate(arrays) for arrays in zip(*motions, strict=True)))


def _resampled(g: Grip, rows: int) -> Grip:
    """The same over ``rows`` rows, nearest frame."""
    at = np.round(np.linspace(0, len(g.press) - 1, rows)).astype(int)
    return Grip(g.press[at], g.effort[at])
