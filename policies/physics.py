"""The training world's physics model, from the robot's own MJCF."""

from __future__ import annotations

import mujoco
import numpy as np

from sim2real.config import RobotConfig


def training_model(robot: RobotConfig, kp: np.ndarray, kd: np.ndarray, timestep: float) -> mujoco.MjModel:
    """The robot's model with the motors' PD law inside the physics: ``ctrl`` is joint position targets (n,) rad.

    ``kp`` N m/rad and ``kd`` N m s/rad (n,), torque limits as in the model; so the law acts in every substep, as it does
    inside a real motor.
    """
    spec = mujoco.MjSpec.from_file(str(robot.model_path))
    spec.option.timestep = timestep
    # Cheaper, and not to be felt: dry friction costs a constraint per joint, so damping stands in for it (see
    # randomisation.TABLE), and a warm-started Newton solver is done after three or four iterations.
    spec.option.iterations, spec.option.ls_iterations = 4, 8
    for joint in spec.joints:
        joint.frictionloss = 0.0
    for motor, p, d in zip(spec.actuators, kp, kd, strict=True):
        motor.gaintype = mujoco.mjtGain.mjGAIN_FIXED
        motor.biastype = mujoco.mjtBias.mjBIAS_AFFINE
        motor.gainprm[0] = p
        motor.biasprm[:3] = [0.0, -p, -d]
        motor.forcerange = motor.ctrlrange
        motor.forcelimited = mujoco.mjtLimited.mjLIMITED_TRUE
        motor.ctrllimited = mujoco.mjtLimited.mjLIMITED_FALSE
    model = spec.compile()
    names = tuple(model.joint(j).name for j in range(1, model.njnt))
    if names != robot.joint_names or model.nu != len(names):
        raise ValueError(f"{robot.model_path}: joints {names}, expected {robot.joint_names}, one motor each")
    return model


def standing_height(model: mujoco.MjModel, joint_pos: np.ndarray) -> np.ndarray:
    """Base height (k,) m for poses (k, n) with an upright base whose lowest foot sphere touches the floor."""
    data = mujoco.MjData(model)
    feet = [g for g in range(model.ngeom) if "_foot_" in model.geom(g).name]
    heights = np.zeros(len(joint_pos))
    for k, pose in enumerate(joint_pos):
        data.qpos[:] = [0, 0, 0, 1, 0, 0, 0, *pose]
        mujoco.mj_kinematics(model, data)
        heights[k] = -(data.geom_xpos[feet, 2] - model.geom_size[feet, 0]).min()
    return heights
