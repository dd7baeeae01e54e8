"""Stepping by formula: what the legs do when a robot is told to walk, or has to step so as not to fall.

A clock runs through one stride while steps are needed and rests with both feet on the ground. Each foot's place is that
of a symmetric gait at the commanded velocity, moved by how much faster the robot is than commanded (Raibert, "Legged
Robots That Balance", 1986); the clock starts by itself once the capture point (Pratt et al., 2006) leaves the feet. It
only proposes: the actor's residual is what keeps the robot up.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import mujoco
import numpy as np
import torch
from torch import Tensor, nn


@dataclass(frozen=True)
class Stride:
    """Of the gait; angles are those of the line from ankle to hip, which bends about the hip."""

    period: float = 0.6  # s, both feet
    leg: float = 0.6  # m, hip to ankle
    # Share of a symmetric gait's sweep that is told to the legs: forwards none, for soft motors trail behind their targets,
    # and a foot that lands as far ahead as it should leave behind slows the robot by a third.
    sweep: tuple[float, float, float] = (0.0, 1.0, 1.0)
    lift: float = 0.45  # rad of thigh and shin, at the top of a step: 9 cm if nothing gave way
    sway: float = 0.06  # rad, of the pelvis towards the standing foot
    pendulum: float = 3.6  # 1/s, sqrt(g / height of the centre of mass)
    placement: float = 0.55  # of v / pendulum: how far beyond its place a foot is put, forwards ...
    placement_aside: float = 0.95  # ... and sideways
    load: float = 1.0  # share of the body's weight that a standing leg is told of beforehand
    upright: float = 1.8  # rad of a standing leg's hip per rad that the trunk is pitched or rolled
    reach: float = 0.5  # rad, the furthest of either
    ahead: float = 0.07  # rad of the capture point beyond which a step is needed: forwards,
    behind: float = 0.08  # backwards,
    aside: float = 0.11  # and sideways
    calm: float = 0.5  # share of these below which the clock may rest
    patience: float = 0.06  # s over which the capture point is averaged before that counts, for speeds are noisy ...
    alarm: float = 1.5  # ... unless it is so many times as far
    bow: float = 0.15  # rad that a pose pitches the base, beyond which the feet stay: bent legs cannot step
    acceleration: float = 1.2  # m/s^2 (rad/s^2) of a command
    idle: float = 0.05  # m/s (rad/s): a smaller command is none

    def steadier(self, times: float) -> Stride:
        """The same of legs that step only when pushed ``times`` as far."""
        return replace(self, ahead=self.ahead * times, behind=self.behind * times, aside=self.aside * times)


# Of a stride, that the clock is ahead when it starts: were its steps to meet exactly 0.5 on their way, that would be a rest,
# and after it the same foot might step again.
BEGUN = 1e-4

EVEN = 0.3, 0.36  # of a step, from and to: what is let go there flies along with the base

# Which of a leg's joints do what, rad of each per rad of it.
PARTS: dict[str, dict[str, float]] = {
    "line": {"hip_pitch": 1.0, "knee": 0.5},  # thigh and shin are equally long
    "raise": {"hip_pitch": -1.0, "knee": 2.0, "ankle_pitch": -1.0},
    "forward": {"hip_pitch": -1.0, "ankle_pitch": 1.0},  # the sole stays level
    "aside": {"hip_roll": 1.0, "ankle_roll": -1.0},
    "turn": {"hip_yaw": 1.0},
    "pitch": {"hip_pitch": 1.0},
    "roll": {"hip_roll": 1.0},
    # half of how far a flat sole pitches the base back
    "sole": {"hip_pitch": 0.5, "knee": 0.5, "ankle_pitch": 0.5},
}
MEASURED = "line", "roll"
MOVED = "raise", "forward", "aside", "turn", "pitch", "roll"


class Lean(NamedTuple):
    """How the base stands over its standing feet, each (N, 1): rad, and rad/s times the leg's length in m/s; and how the
    trunk is turned, rad."""

    forward: Tensor
    left: Tensor
    pitch: Tensor
    roll: Tensor
    forward_speed: Tensor
    left_speed: Tensor


class Gait(nn.Module):
    """The formulas for robots whose leg joints carry the usual names; part of the exported graph."""

    def __init__(
        self, joint_names: Sequence[str], period: float, stride: Stride, loads: np.ndarray | None = None
    ) -> None:
        """``period`` s of the policy. ``loads`` (2, n) rad: how far targets lie beyond the pose, so that the left leg alone,
        or the right one, bears the body (see ``single_loads``)."""
        super().__init__()
        self.stride, self.step = stride, period / stride.period
        self.period = period
        n = len(joint_names)
        loads = torch.zeros(2, n) if loads is None else torch.tensor(loads).float()
        of = {part: torch.tensor(legs(joint_names, part)) for part in PARTS}
        self.lines: Tensor  # (n, 4)
        self.register_buffer("lines", torch.cat([of[part] for part in MEASURED]).T.contiguous())
        self.basis: Tensor  # (2 parts + 1 + 2, n): what steps do, by leg; both legs aside; what one leg bears
        self.register_buffer("basis", torch.cat([*(of[part] for part in MOVED), of["aside"].sum(0)[None], loads]))
        self.soles: Tensor  # (n, 1)
        self.register_buffer("soles", of["sole"].sum(0)[:, None])
        self.sides: Tensor
        self.register_buffer("sides", torch.tensor([[-1.0, 1.0]]))

    def pitch(self, bend: Tensor) -> Tensor:
        """How far the base of a pose with flat soles is pitched forwards (N, 1) rad, ``bend`` (N, n) rad from a level one."""
        return -bend @ self.soles

    def ramp(self, last: Tensor, command: Tensor) -> Tensor:
        """The command (N, 3) that is followed now: ``command``, approached at ``stride.acceleration``."""
        most = self.stride.acceleration * self.period
        return last + torch.clamp(command - last, -most, most)

    def lean(self, phase: Tensor, gravity: Tensor, gyro: Tensor, bend: Tensor, joint_vel: Tensor) -> Lean:
        """From the legs that stand: left, right or, at rest, both. ``gravity`` (N, 3) and ``gyro`` (N, 3) rad/s in the
        base, ``bend`` (N, n) rad of the joints, ``gravity`` and ``bend`` from the pose that is stood in."""
        left = torch.where(self.resting(phase), 0.5, (phase > 0.5).to(phase.dtype))  # what the left leg bears
        shares = torch.cat([left, 1 - left, left, 1 - left], dim=-1)
        standing = lambda x: (x @ self.lines * shares).unflatten(1, (2, 2)).sum(dim=-1).split(1, dim=-1)  # noqa: E731
        (line, roll), (line_rate, roll_rate) = standing(bend), standing(joint_vel)
        leg = self.stride.leg
        return Lean(
            gravity[:, 0:1] + line,
            gravity[:, 1:2] - roll,
            gravity[:, 0:1],
            -gravity[:, 1:2],
            leg * (gyro[:, 1:2] + line_rate),
            -leg * (gyro[:, 0:1] + roll_rate),
        )

    def capture(self, lean: Lean) -> Tensor:
        """The capture point (N, 2) rad, forwards and left."""
        speed = torch.cat([lean.forward_speed, lean.left_speed], dim=-1)
        return torch.cat([lean.forward, lean.left], dim=-1) + speed / (self.stride.pendulum * self.stride.leg)

    def steady(self, last: Tensor, lean: Lean) -> Tensor:
        """The capture point (N, 2) rad averaged over ``stride.patience``, ``last`` a tick ago."""
        return last + self.period / (self.period + self.stride.patience) * (self.capture(lean) - last)

    @staticmethod
    def resting(phase: Tensor) -> Tensor:
        """Whether both feet are on the ground to stay (N, 1) bool."""
        return (phase == 0.0) | (phase == 0.5)

    @staticmethod
    def even(phase: Tensor) -> Tensor:
        """Whether a walking base goes as fast as it does on average (N, 1) bool: the moment after a foot has left the
        ground.
        """
        step = 2 * phase - torch.floor(2 * phase)
        return (step > EVEN[0]) & (step < EVEN[1])

    def advance(self, phase: Tensor, command: Tensor, lean: Lean, steady: Tensor, bows: Tensor | float = 0.0) -> Tensor:
        """This tick's phase (N, 1) in [0, 1): the left foot is in the air before 0.5, the right one after it, and at
        exactly 0 and 0.5 both feet rest. ``command`` (N, 3): forward m/s, left m/s, turn rad/s; ``steady``: see there;
        ``bows`` (N, 1) rad: how far the pose pitches the base."""
        s = self.stride
        resting = self.resting(phase)
        limit = torch.where(resting, 1.0, s.calm)
        fast = lean.forward_speed.abs() > 0.25 * (2 - limit)  # a step in mid-flight ends only when slow
        falling = self._beyond(steady, limit) | self._beyond(self.capture(lean), s.alarm * limit)
        need = (command.abs().amax(-1, keepdim=True) > s.idle) | falling | (fast & ~resting)
        need = need & (bows < s.bow)
        unloaded = torch.where(lean.left_speed > 0, 0.5, 0.0)  # pushed to the left: the right foot is light
        before = torch.where(resting, unloaded + BEGUN, phase)
        moved = before + self.step
        crossed = torch.floor(2 * moved) > torch.floor(2 * before + 1e-6)
        landed = torch.where(crossed & ~need, torch.floor(2 * moved) / 2, moved)
        following = landed - torch.floor(landed)
        return torch.where(resting & ~need, phase, following)

    def _beyond(self, capture: Tensor, limit: Tensor | float) -> Tensor:
        """Whether a capture point (N, 2) has left the feet, times ``limit`` (N, 1): (N, 1) bool."""
        s = self.stride
        forward, left = capture[:, 0:1], capture[:, 1:2]
        return (forward > s.ahead * limit) | (forward < -s.behind * limit) | (left.abs() > s.aside * limit)

    def offsets(self, phase: Tensor, command: Tensor, lean: Lean) -> Tensor:
        """What steps add to the reference pose (N, n) rad."""
        s = self.stride
        angle = 2 * torch.pi * phase
        sin, cos = torch.sin(angle), torch.cos(angle)
        walking = (~self.resting(phase)).to(phase.dtype)
        swept = command * torch.tensor(s.sweep) * (walking * s.period / 4)
        error, error_left = lean.forward_speed - command[:, 0:1], lean.left_speed - command[:, 1:2]
        further = torch.clamp(s.placement * error / (s.pendulum * s.leg), -s.reach, s.reach) * walking
        further_left = torch.clamp(s.placement_aside * error_left / (s.pendulum * s.leg), -s.reach, s.reach) * walking
        lifted = torch.relu(-self.sides * sin)  # (N, 2), left and right, as all of these
        back = self.sides * cos
        placed = (1 + back) / 2
        # A standing leg turns the trunk back; the other is put where it would be under a level trunk.
        turned = torch.where(lifted > 0, -1.0, s.upright) * walking
        shares = [
            s.lift * lifted**2,
            back * (swept[:, 0:1] / s.leg) + placed * further,
            back * (swept[:, 1:2] / s.leg) + placed * further_left,
            back * swept[:, 2:3],
            turned * lean.pitch,
            turned * lean.roll,
            s.sway * walking * sin,
            s.load * walking * (1 + self.sides * sin) / 2,
        ]
        return torch.cat(shares, dim=-1) @ self.basis


def legs(joint_names: Sequence[str], part: str) -> list[list[float]]:
    """(2, n): a share for each joint of what ``part`` of PARTS does to the left leg, and to the right one."""
    shares = [{f"{side}_{joint}_joint": x for joint, x in PARTS[part].items()} for side in ("left", "right")]
    return [[leg.get(name, 0.0) for name in joint_names] for leg in shares]


def single_loads(model: mujoco.MjModel, pose: np.ndarray, kp: np.ndarray) -> np.ndarray:
    """(2, n) rad: static torque over ``kp`` of the joints at ``pose`` (n,) rad when one foot bears the robot, by a force
    from its sole towards the centre of mass, as that of an inverted pendulum. Left leg first.

    ``model``: the robot alone, base first. Without it a motor with a gain of 100 N m/rad sinks by 0.3 rad, and no foot
    ever leaves the ground.
    """
    data = mujoco.MjData(model)
    data.qpos[:] = [0, 0, 0, 1, 0, 0, 0, *pose]
    mujoco.mj_forward(model, data)
    mass, centre = float(model.body_subtreemass[1]), data.subtree_com[1]
    loads = np.zeros((2, len(pose)))
    for k, side in enumerate(("left", "right")):
        site = model.site(f"{side}_foot").id
        jacobian = np.zeros((3, model.nv))
        mujoco.mj_jacSite(model, data, jacobian, None, site)
        way = centre - data.site_xpos[site]
        force = mass * 9.81 * way / way[2]
        loads[k] = (data.qfrc_bias - jacobian.T @ force)[6:] / kp
        other = [j for j in range(len(pose)) if model.joint(j + 1).name.startswith("right" if k == 0 else "left")]
        loads[k, other] = 0.0
    return loads
