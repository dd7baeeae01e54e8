"""Dialect ``holosoma``: one ONNX network that carries its gains and joint names as JSON, and nothing else.

Facts: amazon-far/holosoma @fc600e7d, holosoma_inference (Apache-2.0). PPO and FastSAC export the same interface. The
configuration declares the observation's terms in one order, the code concatenates them sorted by name. Default pose and
action scale are the stack's constants for each robot; no file carries them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, Json, ValidationError

from policies.adopt import Draft, Step
from policies.adopt.shipped import feed_forward, network_file, read_onnx
from policies.adopt.splice import splice
from policies.adopt.walking import GRAVITY, GRAVITY_CONSTANTS, gravity_in_base, run_shipped, walk_fields
from sim2real.config import RobotConfig, Unsigned, explain
from sim2real.graph import metadata
from sim2real.policy import PolicyError

if TYPE_CHECKING:
    from onnx import ModelProto

PERIOD = 0.02  # s
GAIT_PERIOD = 1.0  # s
PHASE = (0.0, np.pi)  # rad: where the feet's clocks start, and start again after standing
STANDING = np.pi  # rad: both clocks while standing
SLOW = 0.01  # m/s and rad/s: a command below stands
ACTION_SCALE, ACTION_MAX = 0.25, 100.0
VELOCITY_SCALE = 0.1
ARM = {"Shoulder_Pitch": 0.2, "Shoulder_Roll": 1.35, "Elbow_Yaw": 0.5}  # of the right; rolls and yaws mirrored left
LEG = {"Hip_Pitch": -0.2, "Knee_Pitch": 0.4, "Ankle_Pitch": -0.25}
DEFAULT_POSE = {  # robot -> rad, by joint; others at zero
    "t1": {
        **{f"Right_{joint}": q for joint, q in {**ARM, **LEG}.items()},
        **{f"Left_{joint}": q if "Pitch" in joint else -q for joint, q in {**ARM, **LEG}.items()},
    }
}

BODY = f"""{GRAVITY}
    velocity_wish, turn_wish = Split <axis = 1> (command_velocity, linear_and_angular)
    speed_wish = ReduceL2 <axes = [1]> (velocity_wish)
    turn_rate_wish = Abs (turn_wish)
    slow = Less (speed_wish, slow_below)
    steady = Less (turn_rate_wish, slow_below)
    stands = And (slow, steady)
    stood = Greater (carry_standing, half)
    ahead = Add (carry_phase, phase_step_and_pi)
    within = Mod <fmod = 1> (ahead, two_pi)
    advanced = Sub (within, pi)
    walking = Where (stood, phase_start, advanced)
    phase = Where (stands, phase_standing, walking)
    carry_phase_next = Identity (phase)
    carry_standing_next = Cast <to = 1> (stands)
    sine = Sin (phase)
    cosine = Cos (phase)
    position = Sub (joint_pos, default_joint_pos)
    velocity = Mul (joint_vel, velocity_scale)
    observation = Concat <axis = 1> (
        carry_action, angular_velocity_base_in_base, turn_wish, velocity_wish, cosine, position, velocity, gravity, sine)
    raw = Network (observation)
    action = Clip (raw, action_min, action_max)
    carry_action_next = Identity (action)
    offset = Mul (action, action_scale)
    joint_pos_target = Add (offset, default_joint_pos)
"""

Limits = tuple[float, float]


class Ranges(BaseModel):
    """Of commands, m/s and rad/s."""

    model_config = ConfigDict(extra="ignore", allow_inf_nan=False)

    lin_vel_x: Limits
    lin_vel_y: Limits
    ang_vel_yaw: Limits


class Metadata(BaseModel):
    """What the ONNX file says beside its graph; further keys are the other project's."""

    model_config = ConfigDict(extra="ignore", allow_inf_nan=False)

    dof_names: Annotated[Json[list[str]], Field(min_length=1)]
    kp: Json[list[Unsigned]]
    kd: Json[list[Unsigned]]
    command_ranges: Json[Ranges]


def read(source: Path, configs: Sequence[Path], robot: RobotConfig) -> Draft:
    """Understand a policy of this dialect. Raises PolicyError."""
    if configs:
        raise PolicyError(f"{configs[0]}: got a configuration, expected none: holosoma's networks carry it themselves")
    if robot.name not in DEFAULT_POSE:
        raise PolicyError(f"{source}: got robot '{robot.name}', expected one of {', '.join(DEFAULT_POSE)}: holosoma")
    file = network_file(source, "holosoma")
    network = read_onnx(file)
    stated = _metadata(network, file)
    n = len(stated.dof_names)
    feed_forward(network, 13 + 3 * n, n, file)
    default = np.array([DEFAULT_POSE[robot.name].get(name, 0.0) for name in stated.dof_names])
    ranges = stated.command_ranges
    fields = walk_fields(
        "amazon-far/holosoma",
        "Apache-2.0",
        file,
        robot,
        joints=stated.dof_names,
        default=default.tolist(),
        kp=stated.kp,
        kd=stated.kd,
        hold={},
        action_scale=ACTION_SCALE,
        observation=13 + 3 * n,
        carry={"carry_action": [0.0] * n, "carry_phase": PHASE, "carry_standing": [0.0]},
        command_max=[min(-low, high) for low, high in (ranges.lin_vel_x, ranges.lin_vel_y, ranges.ang_vel_yaw)],
        period=PERIOD,
        at_zero="stands",
    )
    constants = {
        **GRAVITY_CONSTANTS,
        "default_joint_pos": default,
        "velocity_scale": VELOCITY_SCALE,
        "action_scale": ACTION_SCALE,
        "action_min": -ACTION_MAX,
        "action_max": ACTION_MAX,
        "slow_below": SLOW,
        "half": 0.5,
        "pi": np.pi,
        "two_pi": 2 * np.pi,
        "phase_step_and_pi": 2 * np.pi * PERIOD / GAIT_PERIOD + np.pi,
        "phase_start": [PHASE],
        "phase_standing": [[STANDING, STANDING]],
    }
    model = splice(BODY, fields, constants, {"linear_and_angular": [2, 1]}, network)
    return Draft(model, fields, lambda: deploy_script(default, network))


def deploy_script(default: np.ndarray, network: ModelProto) -> Step:
    """What holosoma_inference computes from the same signals, in float64, around the network as it was shipped."""
    shipped = run_shipped(network)
    action, phase, stood = np.zeros(len(default)), np.array(PHASE), False

    def step(inputs: Mapping[str, np.ndarray]) -> Mapping[str, np.ndarray]:
        nonlocal action, phase, stood
        command = np.asarray(inputs["command_velocity"], float)
        phase = np.mod(phase + 2 * np.pi * PERIOD / GAIT_PERIOD + np.pi, 2 * np.pi) - np.pi
        if np.linalg.norm(command[:2]) < SLOW and abs(command[2]) < SLOW:
            phase, stood = np.full(2, STANDING), True
        elif stood:
            phase, stood = np.array(PHASE), False
        terms = {
            "base_ang_vel": inputs["angular_velocity_base_in_base"],
            "projected_gravity": gravity_in_base(inputs["orientation_base_in_world"]),
            "command_lin_vel": command[:2],
            "command_ang_vel": command[2:],
            "dof_pos": inputs["joint_pos"] - default,
            "dof_vel": VELOCITY_SCALE * inputs["joint_vel"],
            "actions": action,
            "sin_phase": np.sin(phase),
            "cos_phase": np.cos(phase),
        }
        observation = np.concatenate([terms[name] for name in sorted(terms)]).astype(np.float32)
        action = np.clip(shipped(observation[None])[0][0], -ACTION_MAX, ACTION_MAX)
        return {"observation": observation, "action": action, "joint_pos_target": ACTION_SCALE * action + default}

    return step


def _metadata(network: ModelProto, file: Path) -> Metadata:
    try:
        stated = Metadata.model_validate(metadata(network))
    except ValidationError as error:
        raise PolicyError(explain(f"{file}: metadata", error, Metadata)) from None
    for key in ("kp", "kd"):
        if len(getattr(stated, key)) != len(stated.dof_names):
            got = len(getattr(stated, key))
            raise PolicyError(f"{file}: metadata: {key}: got {got} values, expected {len(stated.dof_names)}")
    return stated
