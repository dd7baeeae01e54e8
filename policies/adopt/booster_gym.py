"""Dialect ``booster_gym``: an MLP in TorchScript (or ONNX) and the YAML it was trained or is deployed with.

Facts: BoosterRobotics/booster_gym @da396a06, envs/T1.yaml, deploy/ and play_mujoco.py (Apache-2.0). The network drives the
legs. The two configurations differ on purpose: trained with ankle kd 1 and played at the middle of its gait frequencies,
deployed with ankle kd 3 at 1 Hz. Without ``--config`` the training one is taken, which is what the recorded figures ran.
Not adopted are the deploy program's own low-pass of targets, its slew of commands and its torque path of the parallel ankles.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from pydantic import BaseModel, ConfigDict, ValidationError

from policies.adopt import Draft, Step
from policies.adopt.rebuild import rebuild_mlp
from policies.adopt.shipped import feed_forward, network_file, read_onnx, read_yaml
from policies.adopt.splice import splice
from policies.adopt.walking import GRAVITY, GRAVITY_CONSTANTS, gravity_in_base, run_shipped, walk_fields, welded
from sim2real.config import Positive, RobotConfig, Unsigned, explain
from sim2real.policy import PolicyError

if TYPE_CHECKING:
    from onnx import ModelProto

# The 23 joints of the maker's SDK, in its order: those of deploy_T1.yaml. The policy drives the last twelve.
ARM = ("Shoulder_Pitch", "Shoulder_Roll", "Elbow_Pitch", "Elbow_Yaw")
LEG = ("Hip_Pitch", "Hip_Roll", "Hip_Yaw", "Knee_Pitch", "Ankle_Pitch", "Ankle_Roll")
SDK_JOINTS = {
    "t1": (
        *("AAHead_yaw", "Head_pitch"),
        *(f"{side}_{joint}" for side in ("Left", "Right") for joint in ARM),
        "Waist",
        *(f"{side}_{joint}" for side in ("Left", "Right") for joint in LEG),
    )
}
# rad, deploy_T1.yaml: how the robot holds what the policy does not drive.
POSTURE = {"Shoulder_Pitch": 0.2, "Left_Shoulder_Roll": -1.35, "Right_Shoulder_Roll": 1.35,
           "Left_Elbow_Yaw": -0.5, "Right_Elbow_Yaw": 0.5}  # fmt: skip
COMMAND_MAX = (1.0, 1.0, 1.0)  # m/s, m/s, rad/s: envs/T1.yaml; a deploy configuration states none

BODY = f"""{GRAVITY}
    gravity_term = Mul (gravity, gravity_scale)
    gyro = Mul (angular_velocity_base_in_base, gyro_scale)
    command = Mul (command_velocity, command_scale)
    wish = Abs (command_velocity)
    largest_wish = ReduceMax <axes = [1]> (wish)
    walks = Sign (largest_wish)
    angle = Mul (carry_phase, two_pi)
    sine = Sin (angle)
    cosine = Cos (angle)
    sine_term = Mul (walks, sine)
    cosine_term = Mul (walks, cosine)
    advance = Mul (walks, phase_step)
    following = Add (carry_phase, advance)
    carry_phase_next = Mod <fmod = 1> (following, one)
    deviation = Sub (joint_pos, default_joint_pos)
    position = Mul (deviation, position_scale)
    velocity = Mul (joint_vel, velocity_scale)
    observation = Concat <axis = 1> (gravity_term, gyro, command, cosine_term, sine_term, position, velocity, carry_action)
    raw = Network (observation)
    action = Clip (raw, action_min, action_max)
    carry_action_next = Identity (action)
    offset = Mul (action, action_scale)
    joint_pos_target = Add (offset, default_joint_pos)
"""


class Foreign(BaseModel):
    """What we use of a YAML file; it is another project's, so unknown keys are theirs."""

    model_config = ConfigDict(extra="ignore", allow_inf_nan=False)


class Normalization(Foreign):
    """Scales of the observation's terms, and the clip of the action; the same in both files."""

    gravity: float
    lin_vel: float
    ang_vel: float
    dof_pos: float
    dof_vel: float
    clip_actions: Positive


class TrainControl(Foreign):
    """Gains by a part of the joint's name."""

    stiffness: dict[str, Unsigned]
    damping: dict[str, Unsigned]
    action_scale: float
    decimation: int


class Train(Foreign):
    """envs/T1.yaml. Gains and angles by a part of the joint's name."""

    class Sim(Foreign):
        dt: Positive

    class InitState(Foreign):
        default_joint_angles: dict[str, float]

    class Commands(Foreign):
        gait_frequency: tuple[float, float]

    sim: Sim
    init_state: InitState
    control: TrainControl
    commands: Commands
    normalization: Normalization


class Deploy(Foreign):
    """deploy/configs/T1.yaml. Lists in the order of the SDK."""

    class Common(Foreign):
        dt: Positive
        stiffness: list[Unsigned]
        damping: list[Unsigned]
        default_qpos: list[float]

    class Plan(Foreign):
        class Control(Foreign):
            action_scale: float
            decimation: int

        gait_frequency: float
        normalization: Normalization
        control: Control

    common: Common
    policy: Plan


class Settings(NamedTuple):
    """What either configuration comes to; (12,) per leg joint."""

    default: np.ndarray  # rad
    kp: np.ndarray  # N m/rad
    kd: np.ndarray  # N m s/rad
    gait_frequency: float  # Hz
    period: float  # s
    action_scale: float
    scales: Normalization


def read(source: Path, configs: Sequence[Path], robot: RobotConfig) -> Draft:
    """Understand a policy of this dialect. Raises PolicyError."""
    if robot.name not in SDK_JOINTS:
        raise PolicyError(f"{source}: got robot '{robot.name}', expected one of {', '.join(SDK_JOINTS)}: booster_gym")
    file = network_file(source, "booster_gym")
    joints = SDK_JOINTS[robot.name]
    legs = joints[-2 * len(LEG) :]
    settings = _settings(_config_file(configs, file.parent), joints, legs)
    n = len(legs)
    network = rebuild_mlp(file, 11 + 3 * n) if file.suffix == ".pt" else read_onnx(file)
    feed_forward(network, 11 + 3 * n, n, file)
    scales = settings.scales
    fields = walk_fields(
        "BoosterRobotics/booster_gym",
        "Apache-2.0",
        file,
        robot,
        joints=legs,
        default=settings.default.tolist(),
        kp=settings.kp.tolist(),
        kd=settings.kd.tolist(),
        hold=welded(robot, legs, {j: _named(POSTURE, j, 0.0) for j in robot.joint_names}),
        action_scale=settings.action_scale,
        observation=11 + 3 * n,
        carry={"carry_action": [0.0] * n, "carry_phase": [0.0]},
        command_max=COMMAND_MAX,
        period=settings.period,
        at_zero="stands",
    )
    constants = {
        **GRAVITY_CONSTANTS,
        "default_joint_pos": settings.default,
        "gravity_scale": scales.gravity,
        "gyro_scale": scales.ang_vel,
        "command_scale": [scales.lin_vel, scales.lin_vel, scales.ang_vel],
        "position_scale": scales.dof_pos,
        "velocity_scale": scales.dof_vel,
        "action_min": -scales.clip_actions,
        "action_max": scales.clip_actions,
        "action_scale": settings.action_scale,
        "two_pi": 2 * np.pi,
        "phase_step": settings.period * settings.gait_frequency,
    }
    model = splice(BODY, fields, constants, {}, network)
    return Draft(model, fields, lambda: deploy_script(settings, network))


def deploy_script(settings: Settings, network: ModelProto) -> Step:
    """What play_mujoco.py computes from the same signals, in float64, around the network as it was shipped."""
    shipped = run_shipped(network)
    scales = settings.scales
    action, phase = np.zeros(len(settings.default)), 0.0

    def step(inputs: Mapping[str, np.ndarray]) -> Mapping[str, np.ndarray]:
        nonlocal action, phase
        command = np.asarray(inputs["command_velocity"], float)
        frequency = settings.gait_frequency if command.any() else 0.0
        walks = float(frequency > 0)
        observation = np.concatenate(
            [
                scales.gravity * gravity_in_base(inputs["orientation_base_in_world"]),
                scales.ang_vel * inputs["angular_velocity_base_in_base"],
                walks * command * np.array([scales.lin_vel, scales.lin_vel, scales.ang_vel]),
                [walks * np.cos(2 * np.pi * phase), walks * np.sin(2 * np.pi * phase)],
                scales.dof_pos * (inputs["joint_pos"] - settings.default),
                scales.dof_vel * inputs["joint_vel"],
                action,
            ]
        ).astype(np.float32)
        phase = (phase + settings.period * frequency) % 1.0
        action = np.clip(shipped(observation[None])[0][0], -scales.clip_actions, scales.clip_actions)
        return {
            "observation": observation,
            "action": action,
            "joint_pos_target": settings.action_scale * action + settings.default,
        }

    return step


def _config_file(configs: Sequence[Path], folder: Path) -> Path:
    files = list(configs) or sorted(folder.glob("train*.yaml")) or sorted(folder.glob("*.yaml"))
    if len(files) != 1:
        got = f"{[f.name for f in files]}" if files else "no YAML"
        raise PolicyError(f"{folder}: got {got}, expected one, of training or of deployment; name it: --config")
    return files[0]


def _settings(file: Path, joints: Sequence[str], legs: Sequence[str]) -> Settings:
    document = read_yaml(file, "booster_gym")
    trained = "init_state" in document
    kind = Train if trained else Deploy
    try:
        config = kind.model_validate(document)
    except ValidationError as error:
        raise PolicyError(explain(str(file), error, kind)) from None
    if isinstance(config, Train):
        angles, control = config.init_state.default_joint_angles, config.control
        by_name = ((angles, angles.get("default", 0.0)), (control.stiffness, None), (control.damping, None))
        default, kp, kd = (np.array([_named(t, j, other, file) for j in legs]) for t, other in by_name)
        frequency = float(np.mean(config.commands.gait_frequency))
        scales, dt = config.normalization, config.sim.dt
    else:
        common, control = config.common, config.policy.control
        for key in ("stiffness", "damping", "default_qpos"):
            if len(getattr(common, key)) != len(joints):
                got = len(getattr(common, key))
                raise PolicyError(f"{file}: common.{key}: got {got} values, expected {len(joints)}, one per SDK joint")
        default, kp, kd = (np.array(v[-len(legs) :]) for v in (common.default_qpos, common.stiffness, common.damping))
        frequency, scales, dt = config.policy.gait_frequency, config.policy.normalization, common.dt
    return Settings(default, kp, kd, frequency, dt * control.decimation, control.action_scale, scales)


def _named(table: Mapping[str, float], joint: str, other: float | None, file: Path | None = None) -> Any:
    """The value whose key is a part of ``joint``; ``other`` if none is, and no value at all is refused."""
    values = [value for part, value in table.items() if part in joint]
    if not values and other is None:
        raise PolicyError(f"{file}: got gains for {sorted(table)}, expected one for {joint}")
    return values[0] if values else other
