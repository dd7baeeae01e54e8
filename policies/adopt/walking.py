"""What dialects of velocity policies share: gravity in the base, the measured signals, the contract's fields."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from sim2real.config import RobotConfig

if TYPE_CHECKING:
    from onnx import ModelProto

# -R(q)^T z, with (1, 1) terms: three nodes less than a rotation matrix.
GRAVITY = """
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
    gravity = Concat <axis = 1> (gravity_x, gravity_y, gravity_z)
"""
GRAVITY_CONSTANTS = {"one": 1.0, "two": 2.0, "minus_two": -2.0}


def gravity_in_base(orientation: np.ndarray) -> np.ndarray:
    """(3,) unit vector, from the quaternion (4,) of the base in the world: upright is (0, 0, -1). The rotation matrix's
    last row, in float64: an account of ``GRAVITY`` that shares no line with it."""
    w, x, y, z = np.asarray(orientation, float)
    return -np.array([2 * (x * z - w * y), 2 * (y * z + w * x), w * w - x * x - y * y + z * z])


def run_shipped(network: ModelProto) -> Callable[..., list[np.ndarray]]:
    """The network as it was shipped, on onnxruntime: arrays in and out by position."""
    import onnxruntime

    session = onnxruntime.InferenceSession(network.SerializeToString(), providers=["CPUExecutionProvider"])
    names = [v.name for v in session.get_inputs()]
    return lambda *values: [np.asarray(v) for v in session.run(None, dict(zip(names, values, strict=True)))]


def walk_fields(
    project: str,
    licence: str,
    file: Path,
    robot: RobotConfig,
    *,
    joints: Sequence[str],
    default: Sequence[float],
    kp: Sequence[float],
    kd: Sequence[float],
    hold: Mapping[str, Mapping[str, float]],
    action_scale: float,
    observation: int,
    carry: Mapping[str, Sequence[float]],
    command_max: Sequence[float],
    period: float,
    at_zero: str,
) -> dict[str, Any]:
    """The Contract's fields of a policy that walks at the commanded velocity and drives all the joints it observes.

    ``project``: owner/name of the other stack. Per joint: rad, N m/rad, N m s/rad. ``carry``: what each starts from.
    ``command_max`` (3,) m/s, m/s, rad/s, either way. ``at_zero``: what it does at zero velocity.
    """
    n = len(joints)
    floats = lambda values: [float(v) for v in values]  # noqa: E731
    return {
        "name": f"{project.rpartition('/')[2]}_walk",
        "robot": robot.name,
        "period": period,
        "joint_names": list(joints),
        "target_joint_names": list(joints),
        "default_joint_pos": floats(default),
        "kp": floats(kp),
        "kd": floats(kd),
        "hold": hold,
        "action_scale": [action_scale] * n,
        "inputs": {
            "joint_pos": [n],
            "joint_vel": [n],
            "orientation_base_in_world": [4],
            "angular_velocity_base_in_base": [3],
            "command_velocity": [3],
            **{name: [len(start)] for name, start in carry.items()},
        },
        "outputs": {
            "joint_pos_target": [n],
            "observation": [observation],
            "action": [n],
            **{f"{name}_next": [len(start)] for name, start in carry.items()},
        },
        "carry": {name: {"shape": [len(start)], "start": floats(start)} for name, start in carry.items()},
        "skills": [{"label": "walk", "description": f"walks at the commanded velocity; {at_zero} at zero"}],
        "default_skill": "walk",
        "command_velocity_min": tuple(-float(v) for v in command_max),
        "command_velocity_max": tuple(floats(command_max)),
        "provenance": {
            "source": f"{project}: {file.name}, sha256 {hashlib.sha256(file.read_bytes()).hexdigest()}",
            "licence": licence,
        },
    }


def welded(robot: RobotConfig, joints: Sequence[str], posture: Mapping[str, float]) -> dict[str, dict[str, float]]:
    """``hold`` of all joints but ``joints``: in ``posture`` (rad; others at zero), as stiff and as damped as the robot
    permits. The other stack's training model has no such joints: there they are one piece with their links."""
    rows = zip(robot.joint_names, robot.kp_max, robot.kd_max, strict=True)
    return {
        name: {"position": float(posture.get(name, 0.0)), "kp": float(kp), "kd": float(kd)}
        for name, kp, kd in rows
        if name not in joints
    }
