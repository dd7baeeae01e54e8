"""The G1 body against the maker's description, link by link and joint by joint. What every robot must get right: test_models.py."""

from __future__ import annotations

import os
from pathlib import Path

import mujoco
import numpy as np
import pytest

from sim2real.config import load_robot

SHARED = Path(os.environ.get("SIM2REAL_SHARED", Path(__file__).resolve().parents[2] / "shared"))
REFERENCE = SHARED / "models" / "g1_29dof_reference.xml"
ROBOT = load_robot("g1")

needs_reference = pytest.mark.skipif(not REFERENCE.is_file(), reason=f"the maker's description is not at {REFERENCE}")


@pytest.fixture(scope="module")
def model() -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_path(str(ROBOT.model_path))


@pytest.fixture(scope="module")
def reference() -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_path(str(REFERENCE))


def bodies(model: mujoco.MjModel) -> list[str]:
    return [model.body(i).name for i in range(1, model.nbody)]


def joints(model: mujoco.MjModel) -> list[str]:
    return [model.joint(i).name for i in range(model.njnt)]


def test_no_shape_carries_mass(model: mujoco.MjModel) -> None:
    assert model.body_mass.sum() == pytest.approx(33.341142, abs=1e-6)


@needs_reference
def test_bodies_are_the_maker_s(model: mujoco.MjModel, reference: mujoco.MjModel) -> None:
    assert bodies(model) == bodies(reference)
    for name in bodies(reference):
        ours, theirs = model.body(name), reference.body(name)
        assert ours.mass == pytest.approx(theirs.mass, rel=1e-6), name
        np.testing.assert_allclose(ours.inertia, theirs.inertia, rtol=1e-5, err_msg=name)
        np.testing.assert_allclose(ours.ipos, theirs.ipos, atol=1e-6, err_msg=name)
        same = abs(float(ours.iquat @ theirs.iquat))  # q and -q are one rotation
        assert same == pytest.approx(1.0, abs=1e-9), name


@needs_reference
def test_joints_are_the_maker_s(model: mujoco.MjModel, reference: mujoco.MjModel) -> None:
    assert joints(model) == joints(reference)
    for name in ROBOT.joint_names:
        ours, theirs = model.joint(name), reference.joint(name)
        np.testing.assert_array_equal(ours.axis, theirs.axis, err_msg=name)
        assert ours.armature == pytest.approx(theirs.armature), name
        np.testing.assert_array_equal(model.jnt_actfrcrange[ours.id], reference.jnt_actfrcrange[theirs.id], name)
        # This description gives the right hip the left one's range; the maker's URDF mirrors it.
        range_ = [-2.9671, 0.5236] if name == "right_hip_roll_joint" else theirs.range
        np.testing.assert_allclose(ours.range, range_, atol=1e-6, err_msg=name)


@needs_reference
def test_forward_kinematics_agree_to_a_millimetre(model: mujoco.MjModel, reference: mujoco.MjModel) -> None:
    rng = np.random.default_rng(0)
    ours, theirs = mujoco.MjData(model), mujoco.MjData(reference)
    low, high = model.jnt_range[1:].T
    for _ in range(100):
        orientation = rng.normal(size=4)
        orientation /= np.linalg.norm(orientation)
        ours.qpos[:] = theirs.qpos[:] = [*rng.normal(size=3), *orientation, *rng.uniform(low, high)]
        mujoco.mj_kinematics(model, ours)
        mujoco.mj_kinematics(reference, theirs)
        np.testing.assert_allclose(ours.xpos, theirs.xpos, atol=1e-3)
        np.testing.assert_allclose(ours.xipos, theirs.xipos, atol=1e-3)


def test_home_stands_with_flat_feet(model: mujoco.MjModel) -> None:
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, model.key("home").id)
    np.testing.assert_allclose(data.qpos[7:], ROBOT.home_pos)
    mujoco.mj_forward(model, data)
    touching = {model.geom(g).name for contact in data.contact for g in contact.geom} - {"floor"}
    assert touching == {g for g in (model.geom(i).name for i in range(model.ngeom)) if "_foot_" in g}


@pytest.mark.parametrize(
    "left, right", [("left_shin", "right_shin"), ("left_hand", "chest"), ("left_hand", "right_hand")]
)
def test_what_could_collide_does(model: mujoco.MjModel, left: str, right: str) -> None:
    a, b = model.geom(left), model.geom(right)
    assert (int(a.contype[0]) & int(b.conaffinity[0])) | (int(b.contype[0]) & int(a.conaffinity[0]))
