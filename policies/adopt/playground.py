"""Dialect ``playground``: an ONNX network of MuJoCo Playground's T1 joystick task and the MJCF scene it was trained in.

Facts: google-deepmind/mujoco_playground @d5e6b475, locomotion/t1 and experimental/sim2sim (Apache-2.0). The scene carries
joint order, default pose (keyframe ``home``), gains (position actuators; damping of the joints) and the range that targets
are clamped to. The network was trained with the true velocity of the base: ``policies.adopt.odometry`` estimates it inside
the graph.
"""

# MuJoCo ships no types.
# pyright: reportAttributeAccessIssue=false

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from policies.adopt import Draft, Step
from policies.adopt.odometry import LegOdometry
from policies.adopt.shipped import feed_forward, network_file, read_onnx
from policies.adopt.splice import splice
from policies.adopt.walking import GRAVITY, GRAVITY_CONSTANTS, gravity_in_base, run_shipped, walk_fields, welded
from sim2real.config import RobotConfig
from sim2real.policy import PolicyError

if TYPE_CHECKING:
    from onnx import ModelProto

PERIOD = 0.02  # s
GAIT_FREQUENCY = 1.5  # Hz, of the sim2sim script; training draws 1.25 to 1.75
PHASE = (0.0, np.pi)  # rad, of the feet's clocks
STANDING = np.pi  # rad: both clocks, as shown, while the command is below
SLOW = 0.01
MASKED = "Head"  # joints whose deviation and velocity the observation leaves out
# rad. The scene's arms end at the elbow; seven-joint arms with straight wrists put the T1's centre of mass 4.9 mm further
# ahead (0.0694 m of the trunk's origin, not 0.0645). With hands bent back it is where the training model had it.
BALANCED = {"Left_Wrist_Yaw": 1.4, "Right_Wrist_Yaw": -1.4}
COMMAND_MAX = (1.0, 0.8, 1.0)  # m/s, m/s, rad/s: joystick.py, default_config

BODY = """
    wish = ReduceL2 <axes = [1]> (command_velocity)
    stands = Less (wish, slow_below)
    phase = Where (stands, phase_standing, carry_phase)
    sine = Sin (phase)
    cosine = Cos (phase)
    ahead = Add (carry_phase, phase_step_and_pi)
    within = Mod <fmod = 1> (ahead, two_pi)
    carry_phase_next = Sub (within, pi)
    deviation = Sub (joint_pos, default_joint_pos)
    position = Mul (deviation, seen)
    velocity = Mul (joint_vel, seen)
    observation = Concat <axis = 1> (
        linear_velocity_base_in_base, angular_velocity_base_in_base, gravity, command_velocity, position, velocity,
        carry_action, cosine, sine)
    action = Network (observation)
    carry_action_next = Identity (action)
    free_target = Add (action, default_joint_pos)
    high_target = Max (free_target, target_min)
    joint_pos_target = Min (high_target, target_max)
"""


class Scene(NamedTuple):
    """What the MJCF says, per actuated joint (n,)."""

    joints: list[str]
    default: np.ndarray  # rad
    kp: np.ndarray  # N m/rad
    kd: np.ndarray  # N m s/rad
    target_min: np.ndarray  # rad
    target_max: np.ndarray

    @property
    def seen(self) -> np.ndarray:
        """1 where the observation shows the joint, 0 where it masks it."""
        return np.array([float(MASKED not in name) for name in self.joints])


def read(source: Path, configs: Sequence[Path], robot: RobotConfig) -> Draft:
    """Understand a policy of this dialect. Raises PolicyError."""
    file = network_file(source, "playground")
    scene = read_scene(_scene_file(configs, file.parent))
    if strangers := [name for name in scene.joints if name not in robot.joint_names]:
        raise PolicyError(
            f"{source}: got joints {strangers}, expected joints of robot '{robot.name}'; is it for another?"
        )
    network = feed_forward(read_onnx(file), 16 + 3 * len(scene.joints), len(scene.joints), file)
    odometry = LegOdometry(robot, scene.joints)
    model, fields = assemble(scene, network, robot, file, odometry)
    return Draft(model, fields, lambda: deploy_script(scene, network, odometry))


def assemble(
    scene: Scene, network: ModelProto, robot: RobotConfig, file: Path, odometry: LegOdometry | None
) -> tuple[ModelProto, dict[str, Any]]:
    """Graph and contract's fields; without ``odometry`` the base's velocity is an input, as the network was trained."""
    n = len(scene.joints)
    fields = walk_fields(
        "google-deepmind/mujoco_playground",
        "Apache-2.0",
        file,
        robot,
        joints=scene.joints,
        default=scene.default.tolist(),
        kp=scene.kp.tolist(),
        kd=scene.kd.tolist(),
        hold=welded(robot, scene.joints, BALANCED),
        action_scale=1.0,
        observation=16 + 3 * n,
        carry={"carry_action": [0.0] * n, "carry_phase": PHASE, **(odometry.carry if odometry else {})},
        command_max=COMMAND_MAX,
        period=PERIOD,
        at_zero="stands",
    )
    if odometry is None:
        fields["inputs"]["linear_velocity_base_in_base"] = [3]
    constants = {
        **GRAVITY_CONSTANTS,
        **(odometry.constants if odometry else {}),
        "default_joint_pos": scene.default,
        "seen": scene.seen,
        "target_min": scene.target_min,
        "target_max": scene.target_max,
        "slow_below": SLOW,
        "pi": np.pi,
        "two_pi": 2 * np.pi,
        "phase_step_and_pi": 2 * np.pi * GAIT_FREQUENCY * PERIOD + np.pi,
        "phase_standing": [[STANDING, STANDING]],
    }
    body = GRAVITY + (odometry.body if odometry else "") + BODY
    return splice(body, fields, constants, odometry.axes if odometry else {}, network), fields


def deploy_script(scene: Scene, network: ModelProto, odometry: LegOdometry) -> Step:
    """What the sim2sim script computes from the same signals, in float64, around the network as it was shipped, with
    the velocity that MuJoCo's Jacobians give."""
    shipped = run_shipped(network)
    action, phase, moving = np.zeros(len(scene.joints)), np.array(PHASE), np.zeros(3)

    def step(inputs: Mapping[str, np.ndarray]) -> Mapping[str, np.ndarray]:
        nonlocal action, phase, moving
        joint_pos, joint_vel = (np.asarray(inputs[name], float) for name in ("joint_pos", "joint_vel"))
        omega, gravity = inputs["angular_velocity_base_in_base"], gravity_in_base(inputs["orientation_base_in_world"])
        moving = odometry.estimate(joint_pos, joint_vel, omega, gravity, moving)
        shown = phase if np.linalg.norm(inputs["command_velocity"]) >= SLOW else np.full(2, STANDING)
        masked = [MASKED in name for name in scene.joints]
        position, velocity = joint_pos - scene.default, joint_vel.copy()
        position[masked] = velocity[masked] = 0.0
        observation = np.concatenate(
            [
                moving,
                omega,
                gravity,
                inputs["command_velocity"],
                position,
                velocity,
                action,
                np.cos(shown),
                np.sin(shown),
            ]
        ).astype(np.float32)
        phase = np.mod(phase + 2 * np.pi * GAIT_FREQUENCY * PERIOD + np.pi, 2 * np.pi) - np.pi
        action = shipped(observation[None])[0][0]
        target = np.clip(scene.default + action, scene.target_min, scene.target_max)
        return {"observation": observation, "action": action, "joint_pos_target": target}

    return step


def _scene_file(configs: Sequence[Path], folder: Path) -> Path:
    files = list(configs) or sorted({*folder.glob("*.xml"), *folder.glob("model/*.xml")})
    if len(files) != 1:
        got = f"{[f.name for f in files]}" if files else "no MJCF"
        raise PolicyError(f"{folder}: got {got}, expected the scene it was trained in, one file; name it: --config")
    return files[0]


def read_scene(file: Path) -> Scene:
    """Joints, pose, gains and ranges from an MJCF of position actuators. Raises PolicyError."""
    import mujoco

    try:
        model = mujoco.MjModel.from_xml_path(str(file))
    except ValueError as error:
        raise PolicyError(f"{file}: got {' '.join(str(error).split())[:200]}, expected an MJCF scene") from None
    home = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_KEY, "home")
    if home < 0:
        names = [model.key(k).name for k in range(model.nkey)]
        raise PolicyError(f"{file}: got keyframes {names}, expected 'home': the default pose")
    ids = model.actuator_trnid[:, 0]
    kp = model.actuator_gainprm[:, 0]
    position = (model.actuator_trntype == mujoco.mjtTrn.mjTRN_JOINT) & (model.actuator_biasprm[:, 1] == -kp) & (kp > 0)
    if not model.nu or not position.all():
        names = [model.actuator(int(i)).name for i in np.flatnonzero(~position)]
        raise PolicyError(
            f"{file}: got actuators {names or 'none'} of another kind, expected position actuators of joints"
        )
    low, high = np.where(model.actuator_ctrllimited[:, None] != 0, model.actuator_ctrlrange, [-np.inf, np.inf]).T
    return Scene(
        joints=[model.joint(int(i)).name for i in ids],
        default=model.key_qpos[home, model.jnt_qposadr[ids]],
        kp=kp.copy(),
        kd=model.dof_damping[model.jnt_dofadr[ids]] - model.actuator_biasprm[:, 2],
        target_min=low,
        target_max=high,
    )
