"""Robot and ball in MuJoCo, and their contact graph.

``ball.ball`` gives every contact of the ball the restitution of the floor. Between two palms that is wrong: they play
ping-pong with it, and it falls in a fifth of a second however hard they press. A palm is padded and a wrist yields, so
here ball and palm touch through explicit pairs that are critically damped and have the friction of rubber. Then 25 N a
palm hold 0.62 kg.
"""

from __future__ import annotations

from collections.abc import Callable

import mujoco
import numpy as np

from policies import ball
from policies.clips.robot import RobotBody
from policies.contact_graph import ContactGraph
from sim2real.config import RobotConfig

PAD_STIFFNESS = 5000.0  # 1/s^2: 4 mm deep at 25 N
PAD_FRICTION = (1.0, 1.0, 0.01, 0.0005, 0.0005)  # sliding twice, torsional m, rolling m twice: rubber on rubber
EDGES = [("ball", "hands"), ("ball", "body"), ("body", "hands")]  # of the paper, in the order of Table 7


def hands(body: RobotBody) -> tuple[str, ...]:
    """Names of the geoms that are hands: one a side, left and right."""
    return tuple(body.model.geom(int(geoms[0])).name for geoms in body.hand_geoms)


def add_ball(timestep: float, palms: tuple[str, ...], radius: float = ball.RADIUS) -> Callable[[mujoco.MjSpec], None]:
    """A ``prepare`` for any world of ``timestep`` s: the ball, and pads between it and the geoms ``palms``."""

    def prepare(spec: mujoco.MjSpec) -> None:
        # With the pyramid that is MuJoCo's default a held ball creeps out of the hands within four seconds.
        spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
        ball.ball(timestep, radius=radius)(spec)
        for palm in palms:
            pair = spec.add_pair(name=f"pad/{palm}", geomname1=ball.NAME, geomname2=palm)
            pair.condim, pair.friction = 4, PAD_FRICTION
            pair.solref = [-PAD_STIFFNESS, -2 * np.sqrt(PAD_STIFFNESS)]
            pair.solimp = [0.95, 0.99, 0.001, 0.5, 2]

    return prepare


def paper_graph(spec: mujoco.MjSpec, palms: tuple[str, ...]) -> ContactGraph:
    """The three nodes of the paper: hands, body (every other solid geom of the robot) and ball."""
    solid = [g.name for g in spec.geoms if (g.contype or g.conaffinity) and g.parent.name != "world"]
    rest = [name for name in solid if name not in (*palms, ball.NAME)]
    return ContactGraph({"hands": palms, "body": rest, "ball": (ball.NAME,)}, EDGES)


def training_world(
    robot: RobotConfig, body: RobotBody, kp: np.ndarray, kd: np.ndarray, timestep: float
) -> tuple[mujoco.MjModel, ContactGraph]:
    """The model, with ``ctrl`` being joint position targets (n,) rad, and its graph attached.

    ``kp`` N m/rad and ``kd`` N m s/rad (n,): the motors' law acts in every substep, as it does inside a real motor.
    """
    spec = mujoco.MjSpec.from_file(str(robot.model_path))
    spec.option.timestep = timestep
    spec.option.iterations, spec.option.ls_iterations = 6, 10
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
    palms = hands(body)
    add_ball(timestep, palms)(spec)
    graph = paper_graph(spec, palms)
    graph.prepare(spec)
    model = spec.compile()
    names = tuple(model.joint(j).name for j in range(1, model.njnt - 1))
    if names != robot.joint_names or model.nu != len(names):
        raise ValueError(f"{robot.model_path}: joints {names}, expected {robot.joint_names}, one motor each")
    return model, graph.attach(model)
