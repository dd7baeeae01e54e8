"""Humanoid bodies against their makers' descriptions, link by link and joint by joint. What every robot must get right: test_models.py."""

from __future__ import annotations

import os
from pathlib import Path
from typing import NamedTuple

import mujoco
import numpy as np
import pytest

from sim2real.config import RobotConfig, load_robot

SHARED = Path(os.environ.get("SIM2REAL_SHARED", Path(__file__).resolve().parents[2] / "shared"))
MARKER = 0.0015  # kg: a body lighter than that is a training stack's mark, not a part of the robot


class Description(NamedTuple):
    """A maker's own: where it is, how much it weighs (kg), and which joint ranges in it are known to be wrong."""

    path: Path
    mass: float
    ranges: dict[str, list[float]] = {}


DESCRIPTIONS = {
    # This one gives the right hip the left one's range; the maker's URDF mirrors it.
    "g1": Description(
        SHARED / "models" / "g1_29dof_reference.xml", 33.341142, {"right_hip_roll_joint": [-2.9671, 0.5236]}
    ),
    "t1": Description(SHARED / "policies" / "holosoma_t1" / "model" / "scene_nomesh.xml", 34.512469),
}


@pytest.fixture(params=DESCRIPTIONS, scope="module")
def robot(request: pytest.FixtureRequest) -> RobotConfig:
    return load_robot(request.param)


@pytest.fixture(scope="module")
def model(robot: RobotConfig) -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_path(str(robot.model_path))


@pytest.fixture(scope="module")
def reference(robot: RobotConfig) -> mujoco.MjModel:
    path = DESCRIPTIONS[robot.name].path
    if not path.is_file():
        pytest.skip(f"the maker's description is not at {path}")
    return mujoco.MjModel.from_xml_path(str(path))


def bodies(model: mujoco.MjModel) -> list[str]:
    return [model.body(i).name for i in range(1, model.nbody) if model.body(i).mass[0] > MARKER]


def joints(model: mujoco.MjModel) -> list[str]:
    """All but the free one."""
    return [model.joint(i).name for i in range(1, model.njnt)]


def torque_ranges(model: mujoco.MjModel) -> np.ndarray:
    """(n, 2) N m of every joint: the joint's own limit, or its actuator's where it has none."""
    limited = model.jnt_actfrclimited[model.actuator_trnid[:, 0], None] != 0
    return np.where(limited, model.jnt_actfrcrange[model.actuator_trnid[:, 0]], model.actuator_ctrlrange)


def test_no_shape_carries_mass(robot: RobotConfig, model: mujoco.MjModel) -> None:
    assert model.body_mass.sum() == pytest.approx(DESCRIPTIONS[robot.name].mass, abs=1e-6)


def test_bodies_are_the_maker_s(model: mujoco.MjModel, reference: mujoco.MjModel) -> None:
    assert bodies(model) == bodies(reference)
    for name in bodies(reference):
        ours, theirs = model.body(name), reference.body(name)
        assert ours.mass == pytest.approx(theirs.mass, rel=1e-6), name
        np.testing.assert_allclose(ours.inertia, theirs.inertia, rtol=1e-5, err_msg=name)
        np.testing.assert_allclose(ours.ipos, theirs.ipos, atol=1e-6, err_msg=name)
        same = abs(float(ours.iquat @ theirs.iquat))  # q and -q are one rotation
        assert same == pytest.approx(1.0, abs=1e-9), name


def test_joints_are_the_maker_s(robot: RobotConfig, model: mujoco.MjModel, reference: mujoco.MjModel) -> None:
    assert joints(model) == joints(reference)
    np.testing.assert_array_equal(torque_ranges(model), torque_ranges(reference))
    for name in robot.joint_names:
        ours, theirs = model.joint(name), reference.joint(name)
        np.testing.assert_array_equal(ours.axis, theirs.axis, err_msg=name)
        assert ours.armature == pytest.approx(theirs.armature), name
        range_ = DESCRIPTIONS[robot.name].ranges.get(name, theirs.range)
        np.testing.assert_allclose(ours.range, range_, atol=1e-6, err_msg=name)


def test_forward_kinematics_agree_to_a_millimetre(model: mujoco.MjModel, reference: mujoco.MjModel) -> None:
    rng = np.random.default_rng(0)
    ours, theirs = mujoco.MjData(model), mujoco.MjData(reference)
    here, there = ([m.body(name).id for name in bodies(reference)] for m in (model, reference))
    low, high = model.jnt_range[1:].T
    for _ in range(100):
        orientation = rng.normal(size=4)
        orientation /= np.linalg.norm(orientation)
        ours.qpos[:] = theirs.qpos[:] = [*rng.normal(size=3), *orientation, *rng.uniform(low, high)]
        mujoco.mj_kinematics(model, ours)
        mujoco.mj_kinematics(reference, theirs)
        np.testing.assert_allclose(ours.xpos[here], theirs.xpos[there], atol=1e-3)
        np.testing.assert_allclose(ours.xipos[here], theirs.xipos[there], atol=1e-3)


def test_home_stands_with_flat_feet(robot: RobotConfig, model: mujoco.MjModel) -> None:
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, model.key("home").id)
    np.testing.assert_allclose(data.qpos[7:], robot.home_pos)
    mujoco.mj_forward(model, data)
    touching = {model.geom(g).name for contact in data.contact for g in contact.geom} - {"floor"}
    assert touching == {g for g in (model.geom(i).name for i in range(model.ngeom)) if "_foot_" in g}


@pytest.mark.parametrize(
    "left, right", [("left_shin", "right_shin"), ("left_hand", "chest"), ("left_hand", "right_hand")]
)
def test_what_could_collide_does(model: mujoco.MjModel, left: str, right: str) -> None:
    """A hand may be several geoms: every one of them."""
    names = [model.geom(g).name for g in range(model.ngeom)]
    ones, others = ([n for n in names if n.startswith(part)] for part in (left, right))
    assert ones and others
    for a, b in ((model.geom(one), model.geom(other)) for one in ones for other in others):
        assert (int(a.contype[0]) & int(b.conaffinity[0])) | (int(b.contype[0]) & int(a.conaffinity[0]))
