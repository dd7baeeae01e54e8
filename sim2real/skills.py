"""Performing skills: soft start, the current label, guarded switches, and the policy's targets as a whole-robot command.

``SkillPlayer`` is pure: robot state and operator's wish in, JointCommand out, time as an argument. The same object runs in
the pilot process, in lockstep simulation and in replay.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from enum import IntEnum
from pathlib import Path
from typing import NamedTuple, Protocol

import numpy as np

from sim2real.config import RobotConfig
from sim2real.contract import CARRY, INPUTS, Contract, Object
from sim2real.limbs import Kinematics
from sim2real.tracker import ObjectEstimate, ObjectTracker
from sim2real.types import JointCommand, Mode, OperatorInput, RobotState, Sim2realError


class Stage(IntEnum):
    """Where a run is."""

    STANDBY = 0  # not armed: damping gains at the measured posture
    ENGAGE = 1  # soft start: gains rise, then the joints move to where the policy expects to start
    RUN = 2  # the policy drives


class Runnable(Protocol):
    """What a SkillPlayer needs of a policy (``sim2real.policy.Policy``)."""

    contract: Contract
    path: Path
    sha256: str

    def reset(self) -> None: ...

    def step(self, inputs: Mapping[str, np.ndarray]) -> Mapping[str, np.ndarray]: ...


class Refusal(NamedTuple):
    """A skill switch that was not made, and why."""

    skill: str
    reason: str


def blended(config: RobotConfig) -> np.ndarray:
    """(n,) 1 for joints whose targets blend from one policy's to another's, 0 for legs: those that step go on stepping, and
    half of one policy's targets and half of another's is no way to stand."""
    return np.array([joint.group != "leg" for joint in config.joints], float)


def blend(target: np.ndarray, before: np.ndarray, share: float, blended: np.ndarray) -> np.ndarray:
    """(n,) rad on the way from ``before`` to ``target``, ``share`` of it gone, for the joints that are ``blended``."""
    return target + blended * (1 - share) * (before - target)


class SkillPlayer:
    """Runs the skills of one or more policies on one robot.

    ``tracker``: who tells where the object is, None: no policy asks; whoever runs the player feeds it sightings. While
    the object is out of sight for longer than ``object_patience``, no skill that needs it is begun, and one that runs
    gives way to a skill of another policy that needs none, if there is one.

    Labels of all policies share one namespace (``labels``). A wish for another label is granted if the contract allows
    the transition, the current skill has had its dwell time, and the policy expects to manage it (``value_min``);
    otherwise ``refusals`` says why and the current skill goes on. Between two policies the targets blend, but for the legs'.
    """

    gain_time = 0.6  # s for the gains to rise
    move_time = 1.4  # s to move to the start posture after that, or to the posture before it if the policy has one
    close_time = 0.6  # s from there to the start posture
    blend_time = 0.3  # s from one policy's targets to another's
    operator_timeout = 0.5  # s: an operator older than this wants velocity zero
    object_patience = (
        0.2  # s; before the gate's own (SafetyConfig.object_age), so that there is something to fall back to
    )

    def __init__(self, config: RobotConfig, policies: Sequence[Runnable], tracker: ObjectTracker | None = None):
        if not policies:
            raise Sim2realError(f"{config.name}: no policy to run; give one with --policy FILE.onnx")
        self.config = config
        self.policies = list(policies)
        self.labels: list[str] = []
        self._of_label: list[tuple[int, int]] = []  # policy, its own label index
        for p, policy in enumerate(policies):
            for k, label in enumerate(policy.contract.skill_labels):
                if label in self.labels:
                    raise Sim2realError(f"skill '{label}': two policies perform it; rename it in one of them")
                self.labels.append(label)
                self._of_label.append((p, k))
        periods = {policy.contract.period for policy in policies}
        if len(periods) > 1:
            raise Sim2realError(f"policies: got periods {sorted(periods)} s, expected one; export them at one rate")
        self.period = periods.pop()
        self.tracker = tracker or tracker_for([policy.contract for policy in policies])
        seen = self.tracker.current if self.tracker is not None else ObjectEstimate()
        self._kinematics = Kinematics(config) if self.tracker is not None else None
        self.plans = [_Plan(config, policy.contract, seen) for policy in policies]
        n = len(config.joint_names)
        self.command = JointCommand(-np.inf, np.zeros(n), np.zeros(n), np.zeros(n), np.zeros(n), np.zeros(n))
        self.values = np.full(len(self.labels), np.nan)
        self.stage = Stage.STANDBY
        self.skill = self.labels.index(policies[0].contract.default_skill)
        self.refusals: list[Refusal] = []
        self._refused_wish: str | None = None
        self._since = -np.inf  # when the current skill began
        self._engaged = 0.0
        self._from = np.zeros(n)
        self._blend_from = np.zeros(n)
        self._blended = blended(config)
        self._blend_start = -np.inf

    @property
    def policy_index(self) -> int:
        return self._of_label[self.skill][0]

    @property
    def inputs(self) -> Mapping[str, np.ndarray]:
        """What the current policy was last fed."""
        return self.plans[self.policy_index].inputs

    @property
    def engage_time(self) -> float:
        """Length of the soft start, s."""
        via = self.plans[self.policy_index].approach is not None
        return self.gain_time + self.move_time + (self.close_time if via else 0.0)

    def engage_left(self, now: float) -> float:
        """Seconds until the soft start ends."""
        return self._engaged + self.engage_time - now

    @property
    def object_age(self) -> float:
        """s since the object that the current skill needs was seen; inf: never, -inf: it needs none."""
        return self._age(self.policy_index)

    def start_posture(self) -> np.ndarray:
        """(n,) rad: where the soft start ends."""
        return self.plans[self.policy_index].posture

    def step(self, state: RobotState, mode: Mode, operator: OperatorInput, now: float) -> JointCommand:
        """One policy tick. Returns the same JointCommand object each time; never raises on a bad state: that is the
        gate's to judge. A policy is never fed what is not finite (a lost sensor, an object nobody has seen): the command is
        then not renewed, it grows old, and the guardian holds and damps."""
        if self.tracker is not None and self._kinematics is not None:
            orientation, turning = state.orientation_base_in_world, state.angular_velocity_base_in_base
            limbs = self._kinematics(state.joint_pos, state.joint_vel, orientation, turning)
            self.tracker.estimate(now, orientation, limbs)
        if mode != Mode.RUN and mode != Mode.HOLD:
            self.stage = Stage.STANDBY
        elif self.stage == Stage.STANDBY:
            self.stage = Stage.ENGAGE
            self._engaged = now
            self._from[:] = state.joint_pos
        if self.stage == Stage.ENGAGE and now - self._engaged >= self.engage_time:
            self.stage = Stage.RUN
            self._begin()
        self.command.object_time = now - self.object_age
        if self.stage == Stage.STANDBY:
            self._standby(state)
        elif self.stage == Stage.ENGAGE:
            self._engage(now)
        elif not self._run(state, operator, now):
            return self.command
        self.command.time = now
        return self.command

    def _standby(self, state: RobotState) -> None:
        c = self.command
        np.copyto(c.joint_pos, state.joint_pos, where=np.isfinite(state.joint_pos))
        c.kp[:] = 0.0
        c.kd[:] = self.config.damping

    def _engage(self, now: float) -> None:
        plan, c = self.plans[self.policy_index], self.command
        elapsed = now - self._engaged
        gain = min(1.0, elapsed / self.gain_time)
        via = plan.posture if plan.approach is None else plan.approach
        moved = _ease((elapsed - self.gain_time) / self.move_time)
        closed = _ease((elapsed - self.gain_time - self.move_time) / self.close_time)
        c.joint_pos[:] = self._from + moved * (via - self._from) + closed * (plan.posture - via)
        c.kp[:] = gain * plan.kp
        c.kd[:] = self.config.damping + gain * (plan.kd - self.config.damping)

    def _begin(self) -> None:
        self.policies[self.policy_index].reset()
        self._since = -np.inf  # what it begins with nobody chose: the operator's first wish need not wait

    def _run(self, state: RobotState, operator: OperatorInput, now: float) -> bool:
        """Let the policy decide. Returns whether it could."""
        if operator.skill is not None and operator.skill != self.labels[self.skill]:
            self._switch(operator.skill, now)
        else:
            self._refused_wish = None
        if self.object_age > self.object_patience:
            self._fall_back(now)
        p, k = self._of_label[self.skill]
        plan, policy, c = self.plans[p], self.policies[p], self.command
        fresh = now - operator.time <= self.operator_timeout
        plan.fill(state, operator.velocity if fresh else (0.0, 0.0, 0.0), k)
        if not plan.finite():
            return False
        outputs = policy.step(plan.inputs)
        c.joint_pos[:] = plan.posture
        c.joint_pos[plan.targets] = outputs["joint_pos_target"]
        c.kp[:] = plan.kp
        c.kd[:] = plan.kd
        w = (now - self._blend_start) / self.blend_time
        if w < 1.0:
            c.joint_pos[:] = blend(c.joint_pos, self._blend_from, w, self._blended)
        if "skill_value" in outputs:
            first = self.skill - k
            self.values[first : first + len(policy.contract.skills)] = outputs["skill_value"]
        return True

    def _age(self, policy: int) -> float:
        return self.plans[policy].object.age if self.policies[policy].contract.sees_object else -np.inf

    def _fall_back(self, now: float) -> None:
        """Give way to the first skill that needs no object. Without one the gate will stop the robot."""
        for policy in self.policies:
            if not policy.contract.sees_object:
                lost, refuge = self.labels[self.skill], policy.contract.default_skill
                self.refusals.append(Refusal(lost, f"its object is out of sight; '{refuge}' takes over"))
                self._refused_wish = lost  # said already
                self._become(refuge, now)
                return

    def _become(self, label: str, now: float) -> None:
        before, self.skill = self.policy_index, self.labels.index(label)
        self._since = now
        if self.policy_index != before:
            self._blend_from[:] = self.command.joint_pos
            self._blend_start = now
            self.policies[self.policy_index].reset()

    def _switch(self, wish: str, now: float) -> None:
        reason = self._objection(wish, now)
        if reason is None:
            self._become(wish, now)
        elif self._refused_wish != wish:  # say it once, not at 50 Hz
            self.refusals.append(Refusal(wish, reason))
        self._refused_wish = wish if reason else None

    def _objection(self, wish: str, now: float) -> str | None:
        current = self.labels[self.skill]
        if wish not in self.labels:
            return f"unknown label; expected one of {', '.join(self.labels)}"
        p, k = self._of_label[self.skill]
        here = self.policies[p].contract.skills[k]
        if here.next is not None and wish not in here.next:
            return f"'{current}' may only be followed by {', '.join(here.next) or 'nothing'}"
        if now - self._since < here.dwell:
            return f"'{current}' lasts at least {here.dwell:g} s"
        q, j = self._of_label[self.labels.index(wish)]
        if self._age(q) > self.object_patience:
            return "its object is out of sight"
        least = self.policies[q].contract.skills[j].value_min
        value = self.values[self.labels.index(wish)]
        if least is not None and np.isfinite(value) and value < least:
            return f"the policy expects {value:.2f} from it here, less than {least:.2f}"
        return None


def object_for(contracts: Sequence[Contract]) -> Object | None:
    """The object that ``contracts`` are about; None: none is. Raises Sim2realError where they are about two."""
    objects = [c.object for c in contracts if c.object is not None]
    if different := [o for o in objects if o != objects[0]]:
        raise Sim2realError(
            f"policies: trained with {objects[0]!r} and with {different[0]!r}, expected one object in a run"
        )
    return objects[0] if objects else None


def tracker_for(contracts: Sequence[Contract]) -> ObjectTracker | None:
    """A tracker of their object, if one of ``contracts`` asks where it is. Raises as ``object_for``."""
    thing = object_for(contracts)
    if thing is None or not any(contract.sees_object for contract in contracts):
        return None
    return ObjectTracker(thing.radius, restitution=thing.restitution)


def _ease(s: float) -> float:
    """From 0 to 1 while ``s`` goes there, starting and ending at rest."""
    s = min(1.0, max(0.0, s))
    return s * s * (3 - 2 * s)


class _Plan:
    """How one policy's tensors map onto the robot's joints; buffers for its inputs."""

    def __init__(self, config: RobotConfig, contract: Contract, seen: ObjectEstimate):
        self.object = seen
        self.observed = config.indices(contract.joint_names)
        self.targets = config.indices(contract.target_joint_names)
        self.posture = config.home_pos.copy()
        self.kp = config.home_kp.copy()
        self.kd = config.home_kd.copy()
        for name, hold in contract.hold.items():
            i = config.indices([name])[0]
            self.posture[i], self.kp[i], self.kd[i] = hold.position, hold.kp, hold.kd
        self.posture[self.observed] = contract.default_joint_pos
        self.approach: np.ndarray | None = None
        if contract.approach_joint_pos:
            self.approach = self.posture.copy()
            self.approach[self.observed] = contract.approach_joint_pos
        self.kp[self.targets] = contract.kp
        self.kd[self.targets] = contract.kd
        self._low = np.array(contract.command_velocity_min)
        self._high = np.array(contract.command_velocity_max)
        signals = {name: shape for name, shape in contract.inputs.items() if not name.startswith(CARRY)}
        sizes = [math.prod(shape) for shape in signals.values()]
        self._values = np.zeros(sum(sizes), np.float32)  # of all inputs, which are views into it
        *parts, _ = np.split(self._values, np.cumsum(sizes))
        self.inputs = {n: part.reshape(shape) for (n, shape), part in zip(signals.items(), parts, strict=True)}
        if strangers := [n for n in signals if n not in _SOURCES]:
            raise Sim2realError(
                f"{contract.name}: nothing on this robot measures {', '.join(strangers)}; it measures {', '.join(_SOURCES)}"
            )
        self._sources = [(_SOURCES[name], self.inputs[name]) for name in signals]

    def fill(self, state: RobotState, velocity: tuple[float, float, float], skill: int) -> None:
        for source, out in self._sources:
            source(self, state, velocity, skill, out)

    def finite(self) -> bool:
        return bool(np.isfinite(self._values).all())


def _joint_pos(plan, state, velocity, skill, out):
    out[:] = state.joint_pos[plan.observed]


def _joint_vel(plan, state, velocity, skill, out):
    out[:] = state.joint_vel[plan.observed]


def _orientation(plan, state, velocity, skill, out):
    out[:] = state.orientation_base_in_world


def _angular_velocity(plan, state, velocity, skill, out):
    out[:] = state.angular_velocity_base_in_base


def _command_velocity(plan, state, velocity, skill, out):
    out[:] = np.clip(velocity, plan._low, plan._high)


def _skill(plan, state, velocity, skill, out):
    out[:] = 0.0
    out[skill] = 1.0


def _object_position(plan, state, velocity, skill, out):
    out[:] = plan.object.position_in_base


def _object_velocity(plan, state, velocity, skill, out):
    out[:] = plan.object.velocity_in_base


_SOURCES = {
    "joint_pos": _joint_pos,
    "joint_vel": _joint_vel,
    "orientation_base_in_world": _orientation,
    "angular_velocity_base_in_base": _angular_velocity,
    "command_velocity": _command_velocity,
    "skill": _skill,
    "object_position_in_base": _object_position,
    "object_velocity_in_base": _object_velocity,
}
assert set(_SOURCES) <= set(INPUTS)
MEASURED = tuple(_SOURCES)  # the signals that a robot can feed a policy
