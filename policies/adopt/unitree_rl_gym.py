"""Dialect ``unitree_rl_gym``: an LSTM in TorchScript (or ONNX with explicit state) and hand-written YAML.

Facts: unitreerobotics/unitree_rl_gym @276801e4, deploy/deploy_mujoco and deploy/deploy_real (BSD-3-Clause). The network
drives the legs; the YAML of the real robot says how waist and arms are held. Joints are named by motor index.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from pydantic import BaseModel, ConfigDict, ValidationError

from policies.adopt import Draft, Step
from policies.adopt.rebuild import rebuild_lstm
from policies.adopt.shipped import network_file, read_onnx, read_yaml
from policies.adopt.splice import splice
from policies.adopt.walking import GRAVITY, GRAVITY_CONSTANTS, gravity_in_base, run_shipped, walk_fields
from sim2real.config import Positive, RobotConfig, Unsigned, explain
from sim2real.policy import PolicyError

if TYPE_CHECKING:
    from onnx import ModelProto

GAIT_PERIOD = 0.8  # s, a constant of the deploy scripts
# rad. In g1_12dof.xml pelvis, waist and arms have their centre of mass 14.5 mm ahead of the pelvis; a 29-joint G1 with
# straight arms has it at 22.6 mm (it has wrists and hands) and walks a quarter too fast. With these it is at 14.5 mm.
BALANCED = {"left_shoulder_pitch_joint": 0.155, "right_shoulder_pitch_joint": 0.155}
ARM_KP, WRIST_KP = 20.0, 8.0  # N m/rad: overdamped with kd 5 and 3, the most a motor takes
LEG = ("hip_pitch", "hip_roll", "hip_yaw", "knee", "ankle_pitch", "ankle_roll")
ARM = ("shoulder_pitch", "shoulder_roll", "shoulder_yaw", "elbow", "wrist_roll", "wrist_pitch", "wrist_yaw")
MOTORS = {  # robot -> joint of each motor index of the maker's SDK
    "g1": tuple(
        f"{name}_joint"
        for name in (
            *(f"{side}_{j}" for side in ("left", "right") for j in LEG),
            *("waist_yaw", "waist_roll", "waist_pitch"),
            *(f"{side}_{j}" for side in ("left", "right") for j in ARM),
        )
    )
}

BODY = f"""{GRAVITY}
    gyro = Mul (angular_velocity_base_in_base, gyro_scale)
    command = Mul (command_velocity, command_scale)
    deviation = Sub (joint_pos, default_joint_pos)
    position = Mul (deviation, position_scale)
    velocity = Mul (joint_vel, velocity_scale)
    phase = Mul (carry_step, phase_per_step)
    sine = Sin (phase)
    cosine = Cos (phase)
    observation = Concat <axis = 1> (gyro, gravity, command, position, velocity, carry_action, sine, cosine)
    hidden = Unsqueeze (carry_hidden, layers)
    cell = Unsqueeze (carry_cell, layers)
    action, hidden_next, cell_next = Network (observation, hidden, cell)
    carry_hidden_next = Squeeze (hidden_next, layers)
    carry_cell_next = Squeeze (cell_next, layers)
    carry_action_next = Identity (action)
    following = Add (carry_step, one)
    carry_step_next = Mod <fmod = 1> (following, steps_per_gait)
    offset = Mul (action, action_scale)
    joint_pos_target = Add (offset, default_joint_pos)
"""


class Config(BaseModel):
    """What we use of the YAML files; they are another project's, so unknown keys are theirs."""

    model_config = ConfigDict(extra="ignore", allow_inf_nan=False)

    num_actions: int
    num_obs: int
    control_dt: Positive
    default_angles: list[float]
    kps: list[Unsigned]
    kds: list[Unsigned]
    ang_vel_scale: float
    dof_pos_scale: float
    dof_vel_scale: float
    cmd_scale: tuple[float, float, float]
    action_scale: float
    max_cmd: tuple[Unsigned, Unsigned, Unsigned] = (0.5, 0.0, 0.0)  # without one: what the maker's simulation commands
    leg_joint2motor_idx: list[int] | None = None
    arm_waist_joint2motor_idx: list[int] = []
    arm_waist_kps: list[Unsigned] = []
    arm_waist_kds: list[Unsigned] = []
    arm_waist_target: list[float] = []


def read(source: Path, configs: Sequence[Path], robot: RobotConfig) -> Draft:
    """Understand a policy of this dialect. Raises PolicyError."""
    if robot.name not in MOTORS:
        raise PolicyError(f"{source}: got robot '{robot.name}', expected one of {', '.join(MOTORS)}: unitree_rl_gym")
    file = network_file(source, "unitree_rl_gym")
    config = _read_configs(configs or sorted(file.parent.glob("*.yaml")), file.parent)
    network = rebuild_lstm(file, config.num_obs) if file.suffix == ".pt" else _read_recurrent(file)
    hidden = network.graph.output[1].type.tensor_type.shape.dim[-1].dim_value
    steps = round(GAIT_PERIOD / config.control_dt)
    fields = _fields(config, robot, file, hidden)
    model = splice(
        BODY,
        fields,
        {
            **GRAVITY_CONSTANTS,
            "default_joint_pos": config.default_angles,
            "gyro_scale": config.ang_vel_scale,
            "command_scale": config.cmd_scale,
            "position_scale": config.dof_pos_scale,
            "velocity_scale": config.dof_vel_scale,
            "action_scale": config.action_scale,
            "phase_per_step": 2 * np.pi / steps,
            "steps_per_gait": steps,
        },
        {"layers": [0]},
        network,
    )
    return Draft(model, fields, lambda: deploy_script(config, network, hidden))


def deploy_script(config: Config, network: ModelProto, hidden: int) -> Step:
    """What deploy_mujoco.py computes from the same signals, in float64, around the network as it was shipped."""
    shipped = run_shipped(network)
    state = [np.zeros((1, 1, hidden), np.float32)] * 2
    action = np.zeros(config.num_actions)
    default = np.array(config.default_angles)
    tick = 0

    def step(inputs: Mapping[str, np.ndarray]) -> Mapping[str, np.ndarray]:
        nonlocal state, action, tick
        phase = tick * config.control_dt % GAIT_PERIOD / GAIT_PERIOD
        observation = np.concatenate(
            [
                inputs["angular_velocity_base_in_base"] * config.ang_vel_scale,
                gravity_in_base(inputs["orientation_base_in_world"]),
                inputs["command_velocity"] * np.array(config.cmd_scale),
                (inputs["joint_pos"] - default) * config.dof_pos_scale,
                inputs["joint_vel"] * config.dof_vel_scale,
                action,
                [np.sin(2 * np.pi * phase), np.cos(2 * np.pi * phase)],
            ]
        ).astype(np.float32)
        answer, *state = shipped(observation[None], *state)
        action, tick = answer[0], tick + 1
        return {
            "observation": observation,
            "action": action,
            "joint_pos_target": action * config.action_scale + default,
        }

    return step


def _read_configs(files: Sequence[Path], folder: Path) -> Config:
    """The YAML files laid over each other; they may repeat a value, not contradict it."""
    if not files:
        raise PolicyError(f"{folder}: got no YAML, expected the one of deploy_real or deploy_mujoco; name it: --config")
    document: dict[str, Any] = {}
    origin: dict[str, Path] = {}
    for file in files:
        for key, value in read_yaml(file, "unitree_rl_gym").items():
            if key in Config.model_fields and document.get(key, value) != value:
                raise PolicyError(f"{file}: {key}: got {value}, expected {document[key]} as in {origin[key]}; pass one")
            document[key], origin[key] = value, file
    if "control_dt" not in document and {"simulation_dt", "control_decimation"} <= document.keys():
        document["control_dt"] = document["simulation_dt"] * document["control_decimation"]
    where = ", ".join(str(f) for f in files)
    try:
        config = Config.model_validate(document)
    except ValidationError as error:
        raise PolicyError(explain(where, error, Config)) from None
    n, held = config.num_actions, len(config.arm_waist_joint2motor_idx)
    sizes = {"default_angles": n, "kps": n, "kds": n, "leg_joint2motor_idx": n}
    sizes |= {k: held for k in ("arm_waist_kps", "arm_waist_kds", "arm_waist_target")}
    for key, size in sizes.items():
        values = getattr(config, key)
        if values is not None and len(values) != size:
            raise PolicyError(f"{where}: {key}: got {len(values)} values, expected {size}")
    if config.num_obs != 11 + 3 * n:
        raise PolicyError(
            f"{where}: num_obs: got {config.num_obs}, expected {11 + 3 * n} for {n} actions; other dialect?"
        )
    steps = GAIT_PERIOD / config.control_dt
    if abs(steps - round(steps)) > 1e-6 * steps:
        raise PolicyError(f"{where}: control_dt: got {config.control_dt}, expected a whole part of {GAIT_PERIOD} s")
    return config


def _fields(config: Config, robot: RobotConfig, file: Path, hidden: int) -> dict[str, Any]:
    motors, n = MOTORS[robot.name], config.num_actions
    joints = [motors[i] for i in config.leg_joint2motor_idx or range(n)]
    if config.arm_waist_joint2motor_idx:
        rows = zip(config.arm_waist_joint2motor_idx, config.arm_waist_target, config.arm_waist_kps, config.arm_waist_kds, strict=True)  # fmt: skip
        hold = {motors[i]: {"position": q, "kp": kp, "kd": kd} for i, q, kp, kd in rows}
    else:
        rows = zip(robot.joint_names, robot.home_kp, robot.home_kd, strict=True)
        hold = {j: {"position": 0.0, "kp": kp, "kd": kd} for j, kp, kd in rows if j not in joints}
    # The network was trained with this upper body welded: the waist as stiff as the motors allow, the arms so soft for
    # their damping that they do not swing, all in the posture that has its centre of mass where the training model had it.
    for joint, plan in hold.items():
        i = robot.joint_names.index(joint)
        plan["position"] = BALANCED.get(joint, plan["position"])
        plan["kd"] = float(robot.kd_max[i])
        plan["kp"] = (
            max(plan["kp"], float(robot.kp_max[i])) if "waist" in joint else WRIST_KP if "wrist" in joint else ARM_KP
        )
    return walk_fields(
        "unitreerobotics/unitree_rl_gym",
        "BSD-3-Clause",
        file,
        robot,
        joints=joints,
        default=config.default_angles,
        kp=config.kps,
        kd=config.kds,
        hold=hold,
        action_scale=config.action_scale,
        observation=config.num_obs,
        carry={
            "carry_action": [0.0] * n,
            "carry_hidden": [0.0] * hidden,
            "carry_cell": [0.0] * hidden,
            "carry_step": [0.0],
        },
        command_max=config.max_cmd,
        period=config.control_dt,
        at_zero="steps in place",
    )


def _read_recurrent(file: Path) -> ModelProto:
    network = read_onnx(file)
    shapes = [[d.dim_value for d in v.type.tensor_type.shape.dim] for v in network.graph.output]
    if len(shapes) != 3 or not all(shapes[1:]) or shapes[1] != shapes[2]:
        names = [v.name for v in network.graph.output]
        raise PolicyError(f"{file}: got outputs {names} {shapes}, expected action, hidden and cell state [1, 1, size]")
    return network
