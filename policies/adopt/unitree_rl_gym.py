"""Dialect ``unitree_rl_gym``: an LSTM in TorchScript (or ONNX with explicit state) and hand-written YAML.

Facts: unitreerobotics/unitree_rl_gym @276801e4, deploy/deploy_mujoco and deploy/deploy_real (BSD-3-Clause). The network
drives the legs; the YAML of the real robot says how waist and arms are held. Joints are named by motor index.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import yaml
from pydantic import BaseModel, ConfigDict, ValidationError

from policies.adopt import Draft, Step
from policies.adopt.lstm import rebuild_lstm
from policies.adopt.splice import splice
from sim2real.config import Positive, RobotConfig, Unsigned, explain
from sim2real.graph import refuse_strange
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

GRAPH = """
unitree_rl_gym (
    float[1,{n}] joint_pos, float[1,{n}] joint_vel, float[1,4] orientation_base_in_world,
    float[1,3] angular_velocity_base_in_base, float[1,3] command_velocity,
    float[1,{n}] carry_action, float[1,{hidden}] carry_hidden, float[1,{hidden}] carry_cell, float[1,1] carry_step
) => (
    float[1,{n}] joint_pos_target, float[1,{size}] observation, float[1,{n}] action,
    float[1,{n}] carry_action_next, float[1,{hidden}] carry_hidden_next, float[1,{hidden}] carry_cell_next,
    float[1,1] carry_step_next
) {{
    gyro = Mul (angular_velocity_base_in_base, gyro_scale)
    w, x, y, z = Split <axis = 1> (orientation_base_in_world)
    wx = Mul (w, x)
    wy = Mul (w, y)
    xz = Mul (x, z)
    yz = Mul (y, z)
    xx = Mul (x, x)
    yy = Mul (y, y)
    wy_xz = Sub (wy, xz)
    wx_yz = Add (wx, yz)
    xx_yy = Add (xx, yy)
    gravity_x = Mul (two, wy_xz)
    gravity_y = Mul (minus_two, wx_yz)
    twice_xx_yy = Mul (two, xx_yy)
    gravity_z = Sub (twice_xx_yy, one)
    command = Mul (command_velocity, command_scale)
    deviation = Sub (joint_pos, default_joint_pos)
    position = Mul (deviation, position_scale)
    velocity = Mul (joint_vel, velocity_scale)
    phase = Mul (carry_step, phase_per_step)
    sine = Sin (phase)
    cosine = Cos (phase)
    observation = Concat <axis = 1> (
        gyro, gravity_x, gravity_y, gravity_z, command, position, velocity, carry_action, sine, cosine)
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
}}
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
    file = _network_file(source)
    config = _read_configs(configs or sorted(file.parent.glob("*.yaml")), file.parent)
    network = rebuild_lstm(file, config.num_obs) if file.suffix == ".pt" else _read_onnx(file)
    hidden = network.graph.output[1].type.tensor_type.shape.dim[-1].dim_value
    n, steps = config.num_actions, round(GAIT_PERIOD / config.control_dt)
    text = GRAPH.format(n=n, size=config.num_obs, hidden=hidden)
    model = splice(
        text,
        {
            "default_joint_pos": config.default_angles,
            "gyro_scale": config.ang_vel_scale,
            "command_scale": config.cmd_scale,
            "position_scale": config.dof_pos_scale,
            "velocity_scale": config.dof_vel_scale,
            "action_scale": config.action_scale,
            "phase_per_step": 2 * np.pi / steps,
            "steps_per_gait": steps,
            "one": 1.0,
            "two": 2.0,
            "minus_two": -2.0,
        },
        {"layers": [0]},
        network,
    )
    return Draft(model, _fields(config, robot, file, hidden), lambda: deploy_script(config, network, hidden))


def deploy_script(config: Config, network: ModelProto, hidden: int) -> Step:
    """What deploy_mujoco.py computes from the same signals, in float64, around the network as it was shipped."""
    import onnxruntime

    session = onnxruntime.InferenceSession(network.SerializeToString(), providers=["CPUExecutionProvider"])
    names = [v.name for v in session.get_inputs()]
    state = [np.zeros((1, 1, hidden), np.float32)] * 2
    action = np.zeros(config.num_actions)
    default = np.array(config.default_angles)
    tick = 0

    def step(inputs: Mapping[str, np.ndarray]) -> Mapping[str, np.ndarray]:
        nonlocal state, action, tick
        w, x, y, z = np.asarray(inputs["orientation_base_in_world"], float)
        down_in_base = -np.array([2 * (x * z - w * y), 2 * (y * z + w * x), w * w - x * x - y * y + z * z])
        phase = tick * config.control_dt % GAIT_PERIOD / GAIT_PERIOD
        observation = np.concatenate(
            [
                inputs["angular_velocity_base_in_base"] * config.ang_vel_scale,
                down_in_base,
                inputs["command_velocity"] * np.array(config.cmd_scale),
                (inputs["joint_pos"] - default) * config.dof_pos_scale,
                inputs["joint_vel"] * config.dof_vel_scale,
                action,
                [np.sin(2 * np.pi * phase), np.cos(2 * np.pi * phase)],
            ]
        ).astype(np.float32)
        answer, *state = session.run(None, dict(zip(names, [observation[None], *state], strict=True)))
        action, tick = np.asarray(answer)[0], tick + 1
        return {
            "observation": observation,
            "action": action,
            "joint_pos_target": action * config.action_scale + default,
        }

    return step


def _network_file(source: Path) -> Path:
    """The network itself; in a folder, ONNX before TorchScript, since it cannot carry code and needs no torch."""
    if source.is_file():
        return source
    for suffix in (".onnx", ".pt"):
        files = sorted(source.glob(f"*{suffix}"))
        if len(files) > 1:
            raise PolicyError(f"{source}: got networks {[f.name for f in files]}, expected one; name the file instead")
        if files:
            return files[0]
    raise PolicyError(f"{source}: got no .onnx or .pt file, expected the network of unitree_rl_gym")


def _read_configs(files: Sequence[Path], folder: Path) -> Config:
    """The YAML files laid over each other; they may repeat a value, not contradict it."""
    if not files:
        raise PolicyError(f"{folder}: got no YAML, expected the one of deploy_real or deploy_mujoco; name it: --config")
    document: dict[str, Any] = {}
    origin: dict[str, Path] = {}
    for file in files:
        try:
            content = yaml.safe_load(file.read_text())
        except (OSError, yaml.YAMLError) as error:
            raise PolicyError(f"{file}: got {' '.join(str(error).split())[:200]}, expected a YAML file") from None
        if not isinstance(content, dict):
            raise PolicyError(f"{file}: got no keys, expected a configuration of unitree_rl_gym")
        for key, value in content.items():
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
    carry = {"carry_action": n, "carry_hidden": hidden, "carry_cell": hidden, "carry_step": 1}
    return {
        "name": "unitree_rl_gym_walk",
        "robot": robot.name,
        "period": config.control_dt,
        "joint_names": joints,
        "target_joint_names": joints,
        "default_joint_pos": config.default_angles,
        "kp": config.kps,
        "kd": config.kds,
        "hold": hold,
        "action_scale": [config.action_scale] * n,
        "inputs": {
            "joint_pos": [n],
            "joint_vel": [n],
            "orientation_base_in_world": [4],
            "angular_velocity_base_in_base": [3],
            "command_velocity": [3],
            **{name: [size] for name, size in carry.items()},
        },
        "outputs": {
            "joint_pos_target": [n],
            "observation": [config.num_obs],
            "action": [n],
            **{f"{name}_next": [size] for name, size in carry.items()},
        },
        "carry": {name: {"shape": [size]} for name, size in carry.items()},
        "skills": [{"label": "walk", "description": "walks at the commanded velocity; steps in place at zero"}],
        "default_skill": "walk",
        "command_velocity_min": tuple(-v for v in config.max_cmd),
        "command_velocity_max": config.max_cmd,
        "provenance": {
            "source": f"unitreerobotics/unitree_rl_gym: {file.name}, sha256 {hashlib.sha256(file.read_bytes()).hexdigest()}",
            "licence": "BSD-3-Clause",
        },
    }


def _read_onnx(file: Path) -> ModelProto:
    import onnx

    try:
        network = onnx.load_from_string(file.read_bytes())
    except Exception as error:  # protobuf raises more than one kind
        raise PolicyError(f"{file}: got {type(error).__name__}, expected ONNX; the file is damaged") from None
    refuse_strange(network, str(file))
    shapes = [[d.dim_value for d in v.type.tensor_type.shape.dim] for v in network.graph.output]
    if len(shapes) != 3 or not all(shapes[1:]) or shapes[1] != shapes[2]:
        names = [v.name for v in network.graph.output]
        raise PolicyError(f"{file}: got outputs {names} {shapes}, expected action, hidden and cell state [1, 1, size]")
    return network
