"""The policy `basics`: its motions, its network and the settings that trained it. Everything to tune is in this file."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from policies.gait import Stride
from policies.references import Motion


def both(joint: str, left: float, mirrored: bool = False) -> dict[str, float]:
    """The same angle on the left and on the right; ``mirrored`` for roll and yaw, whose signs differ."""
    return {f"left_{joint}_joint": left, f"right_{joint}_joint": -left if mirrored else left}


# Angles are rad from the robot's home pose. The squat keeps the sum of hip, knee and ankle, so the feet stay flat and
# the pelvis level; arms and waist bring the centre of mass to 6 cm before the ankles (5 cm at home, of 12 to the toes).
MOTIONS: dict[str, Motion] = {
    "stand": Motion("Stand at the home pose", period=2.0),
    "squat": Motion(
        "Squat and rise, every 4 s",
        period=4.0,
        lift={
            **both("hip_pitch", -0.75),
            **both("knee", 1.3),
            **both("ankle_pitch", -0.55),
            **both("shoulder_pitch", -1.1),
            **both("elbow", 0.6),
            "waist_pitch_joint": 0.12,
        },
    ),
    "raise_arms": Motion(
        "Raise both arms overhead and lower them, every 4 s",
        period=4.0,
        lift={**both("shoulder_pitch", -2.6), **both("shoulder_roll", 0.45, mirrored=True), **both("elbow", 0.85)},
    ),
    "wave": Motion(
        "Wave with the right hand",
        period=1.2,
        hold={"right_shoulder_roll_joint": -1.5, "right_shoulder_yaw_joint": -1.5, "right_elbow_joint": -0.45},
        swing={"right_elbow_joint": 0.55},
    ),
    "walk": Motion("Walk as commanded: forwards, sideways, turning", period=1.0, walks=True),
}

# To the floor, and there a ball's breadth between the hands: angles beyond the home pose where the hands are there, and
# those on top of it half-way down, which keep the centre of mass 3 to 5 cm before the ankles. The pelvis pitches by 0.6 rad.
DOWN: tuple[dict[str, float], dict[str, float]] = (
    {
        **both("hip_pitch", -2.314),
        **both("knee", 2.049),
        **both("ankle_pitch", -0.335),
        **both("shoulder_pitch", -1.327),
        **both("shoulder_roll", -0.066, mirrored=True),
        **both("shoulder_yaw", 0.182, mirrored=True),
        **both("elbow", 0.361),
        **both("wrist_roll", -0.062, mirrored=True),
        **both("wrist_pitch", 0.281),
        **both("wrist_yaw", 0.113, mirrored=True),
        "waist_pitch_joint": 0.361,
    },
    {**both("hip_pitch", 0.12), **both("ankle_pitch", -0.12)},
)
BOWED = 0.6  # rad that it is pitched


def down(joint_names: Sequence[str], share: np.ndarray) -> np.ndarray:
    """(N, n) rad, what being ``share`` (N,) of the way ``DOWN`` adds to the home pose."""
    way = np.array([[angles.get(name, 0.0) for name in joint_names] for angles in DOWN])
    share = share[:, None]
    return share * way[0] + 4 * share * (1 - share) * way[1]


@dataclass(frozen=True)
class Basics:
    """Settings of one training run; written beside its checkpoints."""

    robot: str = "g1"
    seed: int = 1
    envs: int = 512
    threads: int = 2  # of the physics; the networks have one more
    device: str = "cpu"  # of the learner; "cuda": a GPU
    # the policy
    period: float = 0.02  # s
    hidden: tuple[int, ...] = (256, 128)
    driven: tuple[str, ...] = ("leg", "waist")  # groups of joints that actions move; the rest follows its reference
    action_ratio: float = 0.25  # action 1 moves the target by this share of torque / kp
    action_max: float = 6.0
    # An ankle strategy to start from, in the manner of a person standing: ankle targets move by offset rad, against the
    # centre of mass being ahead of the ankles, + gain x pitch + damping x pitch rate. Alone it stands for some seconds.
    balance_offset: float = 0.19  # rad
    balance_gain: float = 2.3  # rad of ankle per rad of pitch
    balance_damping: float = 0.25  # rad per rad/s
    # The same for who has gone down, where legs are soft and cannot step; in full at BOWED. Rad per rad of roll, and per
    # rad/s, by which one leg bends and the other stretches, and hips roll; rad of hips per rad of pitch; and rad that joints
    # are sent further. Found by CMA-ES; without one of the first three the others do nearly as well.
    bow_legs: tuple[float, float] = (1.7, 0.04)
    bow_hips: tuple[float, float] = (-1.8, -0.09)
    bow_pitch: float = 0.7
    bow_lean: tuple[float, float, float, float] = (-0.18, 0.25, -0.24, -0.06)  # hips, knees, ankles, waist
    stride: Stride = Stride()
    reference_rate: float = 2.5  # rad/s, the fastest a reference moves
    reference_pull: float = 8.0  # 1/s, how eagerly it moves towards its goal
    position_margin: float = 0.05  # rad inside the mechanical range; wider than the safety gate's
    # the world
    timestep: float = 0.005  # s of the physics
    episode: float = 10.0  # s
    switch: tuple[float, float] = (1.5, 5.0)  # s between skill switches
    push: tuple[float, float] = (1.5, 4.0)  # s between pushes
    push_speed: tuple[float, float] = (0.1, 0.7)  # m/s, the largest at curriculum level 0 and 1
    push_least: float = 0.0  # share of the largest push that each has at least
    push_turn: float = 0.6  # rad/s per m/s of push
    # what the rest of the body does without the balance being told: in a share of the robots, arms and trunk go somewhere
    # every so often, and the knees bend
    busy: float = 0.4  # share
    busy_every: tuple[float, float] = (0.6, 3.0)  # s
    busy_arms: float = 1.2  # rad from the formula's pose, the furthest
    busy_waist: float = 0.25  # rad
    busy_crouch: float = 0.4  # of a full squat
    # the share of episodes in which a standing robot goes down to the floor and up again, and how fast
    down: float = 0.0
    down_in: tuple[float, float] = (1.0, 3.0)  # s, all the way
    command_low: tuple[float, float, float] = (-0.4, -0.3, -0.8)  # m/s, m/s, rad/s
    command_high: tuple[float, float, float] = (0.8, 0.3, 0.8)
    command_zero: float = 0.15  # share of commands that are none
    easy: float = 0.5  # at curriculum level 0, all of this is so much of what it is at level 1
    home_start: float = 0.2  # share of episodes that start at home instead of inside a motion
    # the learner
    horizon: int = 24  # ticks per iteration
    learning_rate: float = 4e-4
    samples: float = 6e6
    gamma: float = 0.98
    ppo: dict[str, float | int | str | bool] = field(
        default_factory=lambda: {
            "num_learning_epochs": 4,
            "num_mini_batches": 4,
            "clip_param": 0.2,
            "lam": 0.95,
            "value_loss_coef": 1.0,
            "entropy_coef": 0.002,
            "max_grad_norm": 1.0,
            "schedule": "fixed",
            "use_clipped_value_loss": False,
        }
    )
    std: float = 0.2  # of the actions at the start
    std_again: float = 0.0  # at least, of a start from another run's networks
    # checkpoints and evaluation, in iterations
    save_every: int = 200
    evaluate_every: int = 80
    evaluate_envs: int = 64


TASKS: dict[str, Basics] = {
    "g1-basics": Basics(),
    # who goes down to the floor; to be started from the basics
    "g1-down": Basics(seed=4, down=0.35, learning_rate=2e-4, samples=5e6, std_again=0.07),
}
