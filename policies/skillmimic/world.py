"""Robot and ball in MuJoCo, and their contact graph. The ball and its pads are those of the deployed simulation."""

from __future__ import annotations

import mujoco
import numpy as np

from drivers.sim.ball import NAME, add_ball, palms
from policies.clips.robot import RobotBody
from policies.contact_graph import ContactGraph
from sim2real.config import RobotConfig

EDGES = [("ball", "hands"), ("ball", "body"), ("body", "hands")]  # of the paper, in the order of Table 7


def paper_graph(spec: mujoco.MjSpec, hands: tuple[str, ...]) -> ContactGraph:
    """The three nodes of the paper: hands, body (every other solid geom of the robot) and ball."""
    solid = [g.name for g in spec.geoms if (g.contype or g.conaffinity) and g.parent.name != "world"]
    rest = [name for name in solid if name not in (*hands, NAME)]
    return ContactGraph({"hands": hands, "body": rest, "ball": (NAME,)}, EDGES)


def training_world(
    robot: RobotConfig, body: RobotBody, kp: np.ndarray, kd: np.ndarray, timestep: float
) -> tuple[mujoco.MjModel, ContactGraph]:
    """The model, with ``ctrl`` being joint position targets (n,) rad, and its graph attached.

    ``kp`` N m/rad and ``kd`` N m s/rad (n,): the motors' law acts in every substep, as it does inside a real motor.
    """
    spec = mujoco.MjSpec.from_file(str(robot.model_path))
    spec.option.timestep = timestep
    # With 6 iterations, which standing robots are content with, a step of the feet now and then kicks a ball out of the
    # hands: a twentieth of all holds and a tenth of all carries failed for it. More cost nothing: the solver stops when
    # it is done.
    spec.option.iterations, spec.option.ls_iterations = 30, 20
    for joint in spec.joints:
        joint.frictionloss = 0.0  # damping stands in for it: a constraint less per joint
    for motor, p, d in zip(spec.actuators, kp, kd, strict=True):
        motor.gaintype = mujoco.mjtGain.mjGAIN_FIXED
        motor.biastype = mujoco.mjtBias.mjBIAS_AFFINE
        motor.gainprm[0] = p
        motor.biasprm[:3] = [0.0, -p, -d]
        motor.forcerange = motor.ctrlrange
        motor.forcelimited = mujoco.mjtLimited.mjLIMITED_TRUE
        motor.ctrllimited = mujoco.mjtLimited.mjLIMITED_FALSE
    for sensor in list(spec.sensors):
        spec.delete(sensor)  # the IMU's: its readings follow from qpos and qvel
    add_ball(timestep)(spec)
    graph = paper_graph(spec, palms(spec))
    graph.prepare(spec)
    model = spec.compile()
    names = tuple(model.joint(j).name for j in range(1, model.njnt - 1))
    if names != robot.joint_names or model.nu != len(names):
        raise ValueError(f"{robot.model_path}: joints {names}, expected {robot.joint_names}, one motor each")
    return model, graph.attach(model)
