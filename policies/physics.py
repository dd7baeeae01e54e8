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


class Stature:
    """How high the base of a robot is whose soles are flat on the floor, and how far it is pitched, by its leg joints."""

    JOINTS = ("hip_pitch", "knee", "ankle_pitch")

    def __init__(self, model: mujoco.MjModel, home: np.ndarray) -> None:
        """``home`` (n,) rad: a pose with flat soles and a level base. Of a chain in a plane, height is linear in the sines
        and cosines of its links' angles, and that is fitted here."""
        self._legs = np.array([[model.jnt_qposadr[model.joint(f"{side}_{j}_joint").id] - 7 for j in self.JOINTS]
                               for side in ("left", "right")])  # fmt: skip
        self._level = home[self._legs].sum(axis=1).mean()
        angles = np.random.default_rng(0).uniform((-2.0, 0.0, -0.8), (0.0, 2.4, 0.0), (50, 3))
        poses = np.tile(home, (len(angles), 1))
        poses[:, self._legs] = angles[:, None]
        data, heights = mujoco.MjData(model), []
        feet = [g for g in range(model.ngeom) if "_foot_" in model.geom(g).name]
        for pose, pitch in zip(poses, self.pitch(poses), strict=True):
            data.qpos[:] = [0, 0, 0, np.cos(pitch / 2), 0, np.sin(pitch / 2), 0, *pose]
            mujoco.mj_kinematics(model, data)
            heights.append(-(data.geom_xpos[feet, 2] - model.geom_size[feet, 0]).min())
        self._share = np.linalg.lstsq(self._parts(poses), np.array(heights), rcond=None)[0]

    def pitch(self, pose: np.ndarray) -> np.ndarray:
        """(k,) rad forwards for poses (k, n)."""
        return self._level - pose[:, self._legs].sum(axis=2).mean(axis=1)

    def height(self, pose: np.ndarray) -> np.ndarray:
        """(k,) m for poses (k, n)."""
        return self._parts(pose) @ self._share

    def _parts(self, pose: np.ndarray) -> np.ndarray:
        hip, knee, _ = pose[:, self._legs].mean(axis=1).T
        pitch = self.pitch(pose)
        angles = np.stack([pitch, pitch + hip, pitch + hip + knee], axis=1)
        return np.concatenate([np.cos(angles), np.sin(angles), np.ones((len(pose), 1))], axis=1)
