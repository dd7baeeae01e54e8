"""The imitation reward, SkillMimic equations 2 to 7 and the variants of its appendix B.1, one function a sub-reward.

Every sub-reward is exp(-sensitivity * error) in (0, 1], arrays (N,). The product of all says that nothing may be
neglected: a policy that moves well and drops the ball earns nothing. Clips carry no spin of the ball, so the factors for
its rotation and angular velocity (sensitivity 0 in Table 7) do not exist here. Lengths are the robot's, 0.74 of the
recorded ones, with the paper's sensitivities: an error of the same share of the body costs 0.55 as much.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from policies import ball
from policies.clips.kinematics import conjugate, multiply, rotation_vector_from_quaternion
from policies.skillmimic.plan import GRAVITY


@dataclass(frozen=True)
class Sensitivity:
    """The lambdas. Defaults: Table 7, column SM."""

    body_position: float = 20.0  # 1/m^2
    body_rotation: float = 20.0  # 1/rad^2
    body_velocity: float = 0.0  # s^2/m^2
    joint_velocity: float = 0.0  # s^2/rad^2
    object_position: float = 20.0  # 1/m^2
    object_velocity: float = 0.0  # s^2/m^2
    relative_position: float = 20.0  # 1/m^2
    regulariser: float = 1e-12  # s^2: of (acceleration / reference velocity)^2
    velocity_floor: float = 1e-12  # (rad/s)^2: keeps that ratio finite where the reference stands still
    contact: float = 5.0  # of each edge
    action_rate: float = 0.0  # of the mean squared change of actions: not in the paper, but motors heat


PAPER = Sensitivity()
# What the released code does instead: the ball's position counts 1/20, and the regulariser 1/10.
CODE = Sensitivity(object_position=1.0, regulariser=1e-13)
# For motors: retargeted joints never stand quite still, so that with the paper's floor of 1e-12 the regulariser is always
# 1. Here an acceleration of 30 rad/s^2 of a joint that should stand costs 4 %, as does a change of every action by 0.6.
ROBOT = Sensitivity(regulariser=1e-5, velocity_floor=0.25, action_rate=0.1)
DEEPMIMIC = Sensitivity(body_rotation=2.0, joint_velocity=0.1)  # Table 7, column SM-DM
SENSITIVITIES = {"paper": PAPER, "code": CODE, "robot": ROBOT, "deepmimic": DEEPMIMIC}


class Motion(NamedTuple):
    """Robot and ball at one instant, arrays over N simulations: the simulated state, or the reference's."""

    points: np.ndarray  # (N, K, 3) m in the world: the base and the key points
    points_velocity: np.ndarray  # (N, K, 3) m/s
    orientation_base_in_world: np.ndarray  # (N, 4)
    joint_pos: np.ndarray  # (N, n) rad
    joint_vel: np.ndarray  # (N, n) rad/s
    object_position: np.ndarray  # (N, 3) m in the world
    object_velocity: np.ndarray  # (N, 3) m/s
    contact: np.ndarray  # (N, edges) 0 or 1


class Step(NamedTuple):
    """What a reward may look at."""

    state: Motion
    reference: Motion
    joint_acceleration: np.ndarray  # (N, n) rad/s^2, over the policy period
    action_change: np.ndarray  # (N, actions)
    height: np.ndarray  # (N,) m, of the base
    height_reference: np.ndarray  # (N,)
    up: np.ndarray  # (N,) cosine of its tilt
    up_reference: np.ndarray  # (N,)
    bounces: np.ndarray  # (N,) bool: the ball is to stay where it is, going up and down


def _mean_square(error: np.ndarray) -> np.ndarray:
    """(N,): the MSE of equation 5."""
    return np.square(error).reshape(len(error), -1).mean(axis=1)


def off(s: Step) -> np.ndarray:
    """(N, 3) m of the ball from its reference, seen from the bases."""
    here, there = (m.object_position - m.points[:, 0] for m in (s.state, s.reference))
    return here - there


def body_position(s: Step, k: Sensitivity) -> np.ndarray:
    """r^p, equation 5: key points and base, in the world."""
    return np.exp(-k.body_position * _mean_square(s.state.points - s.reference.points))


def body_rotation(s: Step, k: Sensitivity) -> np.ndarray:
    """r^r, of equation 4: joint positions, and the rotation vector from the reference's base to the robot's."""
    turn = multiply(conjugate(s.reference.orientation_base_in_world), s.state.orientation_base_in_world)
    error = [s.state.joint_pos - s.reference.joint_pos, rotation_vector_from_quaternion(turn)]
    return np.exp(-k.body_rotation * _mean_square(np.concatenate(error, axis=1)))


def body_velocity(s: Step, k: Sensitivity) -> np.ndarray:
    """r^pv, of equation 4: velocity of key points and base."""
    return np.exp(-k.body_velocity * _mean_square(s.state.points_velocity - s.reference.points_velocity))


def joint_velocity(s: Step, k: Sensitivity) -> np.ndarray:
    """r^rv, of equation 4."""
    return np.exp(-k.joint_velocity * _mean_square(s.state.joint_vel - s.reference.joint_vel))


def object_position(s: Step, k: Sensitivity) -> np.ndarray:
    """r^op, of equation 6: the ball's centre in the world."""
    return np.exp(-k.object_position * _mean_square(s.state.object_position - s.reference.object_position))


def object_velocity(s: Step, k: Sensitivity) -> np.ndarray:
    """r^opv, of equation 6."""
    return np.exp(-k.object_velocity * _mean_square(s.state.object_velocity - s.reference.object_velocity))


def body(s: Step, k: Sensitivity) -> np.ndarray:
    """r^b, equation 4."""
    return body_position(s, k) * body_rotation(s, k) * body_velocity(s, k) * joint_velocity(s, k)


def object_motion(s: Step, k: Sensitivity) -> np.ndarray:
    """r^o, equation 6."""
    return object_position(s, k) * object_velocity(s, k)


def relative(s: Step, k: Sensitivity) -> np.ndarray:
    """r^rel, section 5.3.3: vectors from the ball to every key point, in the world."""
    here, there = (m.points - m.object_position[:, None] for m in (s.state, s.reference))
    return np.exp(-k.relative_position * _mean_square(here - there))


def regulariser(s: Step, k: Sensitivity) -> np.ndarray:
    """r^reg, equation 7: joint accelerations, but where the reference moves; and changes of the action."""
    still = np.square(s.reference.joint_vel) + k.velocity_floor
    jitter = (np.square(s.joint_acceleration) / still).mean(axis=1)
    return np.exp(-k.regulariser * jitter - k.action_rate * _mean_square(s.action_change))


def contact(s: Step, k: Sensitivity) -> np.ndarray:
    """r^cg, equation 3: edges of the contact graph that are not as in the reference."""
    return np.exp(-k.contact * np.abs(s.state.contact - s.reference.contact).sum(axis=1))


def peak(m: Motion) -> np.ndarray:
    """(N,) m, how high the ball's centre would rise if it flew off upwards now: its energy, as a height."""
    return m.object_position[:, 2] + m.object_velocity[:, 2] ** 2 / (2 * GRAVITY)


# m: errors of a bounced ball that cost 63 %
BESIDE, LOW, HIGH = 0.2, 0.2, 0.3
MET = 0.75  # m: how high its centre is when a palm meets it


def returns(s: Step, k: Sensitivity) -> np.ndarray:
    """Of a ball that bounces: it will come up at its place beside the base. A stroke has its due as soon as it is done, and a
    ball that is away is best on its way back."""
    position, velocity = s.state.object_position, s.state.object_velocity
    high, up = np.maximum(position[:, 2] - ball.RADIUS, 0.0), velocity[:, 2]
    hits = np.sqrt(up**2 + 2 * GRAVITY * high)  # m/s on the floor
    rises = (up > 0) & (position[:, 2] < MET)
    speed = np.where(rises, up, ball.RESTITUTION * hits)  # m/s with which it sets off to where it is met
    way = np.where(rises, MET - position[:, 2], MET - ball.RADIUS)
    left = (speed - np.sqrt(np.maximum(speed**2 - 2 * GRAVITY * way, 0.0))) / GRAVITY  # s from there; or to its peak
    left += np.where(rises, 0.0, (up + hits) / GRAVITY)
    there = off(s)[:, :2] + left[:, None] * velocity[:, :2]
    return np.exp(-(there**2).sum(axis=1) / BESIDE**2)


def lively(s: Step, k: Sensitivity) -> np.ndarray:
    """While nobody touches it, it has the energy, as a height, of the reference: less of it costs more."""
    here, there = peak(s.state), peak(s.reference)
    over = here - there
    wrong = (np.minimum(over, 0.0) / LOW) ** 2 + (np.maximum(over, 0.0) / HIGH) ** 2
    held = (s.state.contact[:, 0] > 0) | (s.reference.contact[:, 0] > 0)
    return np.where(held, 1.0, np.exp(-wrong))


def smooth(s: Step, k: Sensitivity) -> np.ndarray:
    """Actions change little."""
    return np.exp(-k.action_rate * _mean_square(s.action_change))


def bouncing(terms: np.ndarray) -> np.ndarray:
    """(3, N), in the order of the variant -> (N,): a ball far off still has something to win."""
    place, energy, smooth = terms
    return (0.1 + 0.4 * place + 0.2 * energy + 0.3 * place * energy) * smooth


SubReward = Callable[[Step, Sensitivity], np.ndarray]


@dataclass(frozen=True)
class Variant:
    """Sub-rewards and what becomes of them. ``total`` maps (terms, N) to (N,)."""

    terms: dict[str, SubReward]
    total: Callable[[np.ndarray], np.ndarray]
    equation: str


def product(terms: np.ndarray) -> np.ndarray:
    """(terms, N) -> (N,)."""
    return terms.prod(axis=0)


def mean(terms: np.ndarray) -> np.ndarray:
    """(terms, N) -> (N,). The paper's sums, over their number: so that 1 is perfect in every variant."""
    return terms.mean(axis=0)


_FULL: dict[str, SubReward] = {
    "body": body,
    "object": object_motion,
    "relative": relative,
    "regulariser": regulariser,
    "contact": contact,
}
_DEEPMIMIC: dict[str, SubReward] = {
    "body_position": body_position,
    "body_rotation": body_rotation,
    "joint_velocity": joint_velocity,
    "object": object_motion,
}
VARIANTS: dict[str, Variant] = {
    "skillmimic": Variant(_FULL, product, "2"),
    "no_cgr": Variant({n: t for n, t in _FULL.items() if n != "contact"}, product, "17"),
    "no_multiplication": Variant(_FULL, mean, "16"),
    "deepmimic": Variant(_DEEPMIMIC, mean, "14"),  # with the sensitivities `deepmimic`
    # Not the paper's: nothing of the body is imitated, and where the ball goes is what counts.
    "bounces": Variant({"returns": returns, "lively": lively, "smooth": smooth}, bouncing, ""),
    # Equation 15 needs a discriminator (amp.py), which the environment asks instead; nothing is paid here.
    "amp": Variant({"none": lambda s, k: np.zeros(len(s.state.joint_pos))}, product, "15"),
}


def reward(s: Step, variant: str, k: Sensitivity) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """(N,) in [0, 1] of one policy period, and every sub-reward (N,) by name."""
    chosen = VARIANTS[variant]
    terms = {name: term(s, k) for name, term in chosen.terms.items()}
    return chosen.total(np.stack(list(terms.values()))), terms
