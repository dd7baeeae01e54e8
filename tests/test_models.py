"""Every robot's MJCF against its robot file: what any new robot must get right."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from drivers.sim.plant import Plant


@pytest.fixture(scope="module")
def model(robot) -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_path(str(robot.model_path))


@pytest.fixture
def plant(robot) -> Plant:
    site = robot.wiring().imu.site
    plant = Plant(robot.model_path, robot.joint_names, robot.base, imu_site=site)
    plant.reset(robot.home_pos)
    return plant


def hinges(model: mujoco.MjModel) -> np.ndarray:
    return np.flatnonzero(model.jnt_type == mujoco.mjtJoint.mjJNT_HINGE)


def test_order_is_the_robot_file_s(robot, model) -> None:
    assert [model.joint(i).name for i in hinges(model)] == list(robot.joint_names)
    assert [model.actuator(i).name for i in range(model.nu)] == list(robot.joint_names)
    assert model.actuator_trnid[:, 0].tolist() == hinges(model).tolist()


def test_it_needs_no_file_beside_it(model) -> None:
    assert (model.nmesh, model.nhfield, model.nskin) == (0, 0, 0)


def test_the_robot_file_asks_for_no_more_than_the_body_has(robot, model) -> None:
    joints = hinges(model)
    low, high = model.jnt_range[joints].T
    assert np.all(low - 1e-6 <= robot.position_min) and np.all(robot.position_max <= high + 1e-6)
    assert np.all(robot.torque_max <= model.actuator_ctrlrange[:, 1] + 1e-6)
    np.testing.assert_array_equal(model.actuator_ctrlrange, model.jnt_actfrcrange[joints])


def test_home_is_inside_the_soft_ranges_and_within_the_gains(robot) -> None:
    margin = robot.safety.position_margin
    assert np.all(robot.position_min + margin <= robot.home_pos)
    assert np.all(robot.home_pos <= robot.position_max - margin)
    assert np.all(robot.home_kp <= robot.kp_max) and np.all(robot.home_kd <= robot.kd_max)


def test_at_home_feet_are_lowest_and_nothing_pokes_into_another(robot, plant) -> None:
    if plant.floating:
        plant.data.qpos[2] -= 1e-3
        mujoco.mj_forward(plant.model, plant.data)
    touching = {tuple(sorted(plant.model.geom(g).name for g in c.geom)) for c in plant.data.contact}
    assert all("floor" in pair and any("_foot_" in name for name in pair) for pair in touching), touching
    assert plant.floating == bool(touching)
    assert not plant.fallen


def test_a_fallen_robot_lies_on_the_floor_and_is_seen_to_have_fallen(plant) -> None:
    if not plant.floating:
        pytest.skip("bolted to a table")
    height = float(plant.data.subtree_com[plant._root, 2])
    plant.push([0.3, 0.0, 0.0])
    for _ in range(2000):  # 4 s limp
        plant.step()
    lying = plant.data.xipos[plant._robot, 2]
    assert 0.0 < lying.min() and lying.max() < 0.6 * height
    assert plant.fallen
