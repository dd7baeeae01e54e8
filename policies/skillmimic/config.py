"""Settings of a SkillMimic run, written beside its checkpoints. Everything to tune is here or in a table of this package."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Literal


@dataclass(frozen=True)
class SkillMimic:
    """One run. A skill is a label of ``policies/<robot>/clips``; more skills are more labels, with the same settings."""

    robot: str = "g1"
    seed: int = 1
    envs: int = 512
    threads: int = 2  # of the physics; the networks have one more
    device: str = "cpu"  # of the learner; "cuda": a GPU
    # what is learned
    skills: tuple[str, ...] = ("hold",)
    clips: tuple[str, ...] = ("hold_05",)  # only these of them, by name; none: all
    swing: tuple[str, ...] = ("hold", "carry")  # skills whose clips play to and fro; others end
    loop: tuple[str, ...] = ("dribble_in_place", "bounce", "bounce_walk")  # whose clips begin again where they end
    after: float = 1.0  # s that an episode goes on beyond the end of a clip, at its last frame
    practise: tuple[str, ...] = ()  # only these of the skills, for now; none: all
    anywhere: bool = True  # episodes start anywhere in a clip, not only at its beginning
    variant: str = "skillmimic"  # see rewards.VARIANTS
    sensitivity: str = "robot"  # see rewards.SENSITIVITIES
    # Who moves the legs: a checkpoint of the basics, which goes into the policy as it is, and the actor moves the arms. None:
    # the actor moves every joint, as in the paper.
    base: str | None = None
    corrections: str | None = None  # of the plan of the arms (plan.py), a file; only with a base
    # skills in which the clip waits: for the ball, or for arms to be where it begins
    timed: tuple[str, ...] = ("catch", "dribble_in_place", "bounce", "bounce_walk", "pickup")
    # skills in which one palm, kept level, goes to where it will meet the ball that comes up
    meets: tuple[str, ...] = ()
    stands: float = 1.0  # times as far as else the base is pushed before it steps
    # skills during which the base obeys velocity commands, and those it is trained on, from and to (forward m/s, left m/s,
    # turn rad/s); None: its own
    walks: dict[str, Sequence[Sequence[float]] | None] = field(default_factory=dict)
    bends: tuple[str, ...] = ("pickup",)  # skills in which the base bends legs and waist as the clip does
    still: float = 0.3  # share of their episodes without any, where none is one of those
    # the policy
    period: float = (
        0.02  # s: 50 Hz, against the paper's 60; retargeted clips are slower by the root of the length scale
    )
    hidden: tuple[int, ...] = (256, 128)
    action_ratio: float = 0.25  # action 1 moves the target by this share of torque / kp
    action_max: float = 6.0
    grip: float = (
        30.0  # N each palm presses, where the clip has both on the ball: inside the posture actions start from
    )
    balance_gain: float = 2.3  # rad of ankle per rad of pitch away from the skill's own; 0 for skills that walk
    balance_damping: float = 0.25  # rad per rad/s
    position_margin: float = 0.05  # rad inside the mechanical range; wider than the safety gate's
    history: int = 3  # past ticks seen beside the present one
    # the world
    timestep: float = 0.005  # s of the physics
    frames: int = 60  # ticks in an episode, as in the paper: 1.2 s here, 1.4 s of the recorded motion
    disturbed: float = 0.5  # share of episodes that start beside their reference frame
    # share of every range of the randomisation that training begins with; it widens while more than half survive
    easy: float = 1.0
    # m/s, the most by which a ball that flies at the start does so otherwise than in the clip, each way
    throw: float = 0.1
    placed: float = 0.05  # m, the most by which a ball that lies there does so elsewhere, each way
    push_chance: float = 0.01  # a tick
    push_speed: float = 0.3  # m/s, the largest
    terminations: tuple[str, ...] = ("fallen", "tilted", "ball_lost", "broken")
    # more of them, in training alone: what no skill's rule counts as a failure, but nothing is to be learned from
    hopeless: tuple[str, ...] = ()
    # the learner
    horizon: int = 24  # ticks per iteration
    learning_rate: float = 5e-4
    samples: float = 20e6
    gamma: float = 0.97
    std: float = 0.15  # of the actions at the start; 0.25 costs a fifth of the reward of standing still
    # of what an action is off by, this much is left a tick later; if anything is, ``std`` is not learned
    lasts: float = 0.0
    ppo: dict[str, float | int | str | bool] = field(
        default_factory=lambda: {
            "num_learning_epochs": 4,
            "num_mini_batches": 4,
            "clip_param": 0.2,
            "lam": 0.95,
            "value_loss_coef": 1.0,
            "entropy_coef": 0.0,
            "max_grad_norm": 1.0,
            "schedule": "fixed",
            "use_clipped_value_loss": False,
        }
    )
    # checkpoints and evaluation, in iterations
    save_every: int = 100
    evaluate_every: int = 80
    evaluate_envs: int = 32
    evaluate_seconds: float = 6.0


BASE, DOWN, PLAN = "policies/g1/basics.pt", "policies/g1/down.pt", "policies/g1/plan.yaml"
DRIBBLE = "policies/g1/dribble.yaml"
BALL = {  # a clip each: the calmest, and those that come from and go to the front
    "hold": "hold_01",
    "carry": "carry_01",
    "pass": "pass_02",
    "catch": "catch_06",
    "dribble_in_place": "dribble_in_place_01",
    "bounce": "bounce_01",
    "bounce_walk": "bounce_walk_01",
}
WALKS = {"carry": None, "bounce_walk": ((0.1, -0.1, -0.3), (0.3, 0.1, 0.3))}
Task = Literal["g1-ball", "g1-dribble", "g1-pickup"]  # the keys of TASKS
# Small steps from a plan that works; each task then looks every few iterations at what is best.
GENTLE = SkillMimic(corrections=PLAN, push_chance=0.004, learning_rate=3e-4, std=0.1)
TASKS: dict[str, SkillMimic] = {
    "g1-ball": replace(GENTLE, base=BASE, skills=tuple(BALL), clips=tuple(BALL.values()), walks=WALKS, frames=200,
                       samples=0.86e6, save_every=20, evaluate_every=20, evaluate_envs=48),
    # The physics in the deployed worlds' steps: in longer ones chance decides where a ball goes that a palm has pushed.
    "g1-dribble": replace(GENTLE, base=BASE, skills=("dribble_in_place",), clips=("dribble_in_place_03",), corrections=DRIBBLE,
                          meets=("dribble_in_place",), stands=2.0, variant="bounces", timestep=0.002, easy=0.15, frames=200,
                          disturbed=0.3, push_chance=0.0, gamma=0.99, std=0.25, lasts=0.9, hopeless=("dead",),
                          ppo={**GENTLE.ppo, "schedule": "adaptive"}, samples=30e6, save_every=20, evaluate_every=200,
                          evaluate_envs=96, evaluate_seconds=10.0),
    "g1-pickup": replace(GENTLE, base=DOWN, skills=("pickup",), clips=("pickup_09",), frames=400,
                         samples=0.4e6, save_every=8, evaluate_every=8, evaluate_envs=64),
}  # fmt: skip


def check_skill(skill: str, known: Sequence[str]) -> None:
    """Ends the program, with a word of what is ``known``, for another ``skill``."""
    if skill not in known:
        sys.exit(f"skill: got '{skill}', expected one of {', '.join(known)}")
