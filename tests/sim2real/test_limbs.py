"""Palms and base by forward kinematics, against MuJoCo's own of a robot that is put where its foot stands."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from sim2real.config import load_robot
from sim2real.limbs import Kinematics, Limbs

TICK = 0.02


def standing(robot, bent: float, foot: str = "left"):
    """The robot with ``bent`` rad in every joint of the standing leg and in the right arm, the other knee high up; put so that
    its sole lies level at (0.2, 0.1, 0). Returns joint positions (n,), and base position, orientation and palms in the
    world."""
    model = mujoco.MjModel.from_xml_path(str(robot.model_path))
    data, q = mujoco.MjData(model), robot.home_pos.copy()
    other = "right" if foot == "left" else "left"
    for k, name in enumerate(robot.joint_names):
        name = name.lower()
        if (foot in name and any(part in name for part in ("hip", "knee", "ankle"))) or "right_elbow" in name:
            q[k] += bent
        if f"{other}_knee" in name:
            q[k] += 0.8
    data.qpos[[model.joint(name).qposadr[0] for name in robot.joint_names]] = q
    mujoco.mj_kinematics(model, data)
    base, sole = model.body(robot.base).id, model.site(f"{foot}_foot").id
    level = data.site_xmat[sole].reshape(3, 3).T
    place = lambda x: np.array([0.2, 0.1, 0.0]) + level @ (x - data.site_xpos[sole])  # noqa: E731
    turned, quaternion = level @ data.xmat[base].reshape(3, 3), np.zeros(4)
    mujoco.mju_mat2Quat(quaternion, turned.flatten())
    palms = [place(data.site_xpos[model.site(f"{side}_palm").id]) for side in ("left", "right")]
    return q, place(data.xpos[base]), quaternion, turned, np.array(palms)


@pytest.fixture(scope="module", params=["g1", "t1"])
def robot(request):
    return load_robot(request.param)


def test_palms_are_where_mujoco_has_them(robot):
    q, base, quaternion, turned, palms = standing(robot, 0.1)
    limbs = Kinematics(robot)(q, 0 * q, quaternion, np.zeros(3))
    np.testing.assert_allclose(limbs.palms, (palms - base) @ turned, atol=1e-9)


@pytest.mark.parametrize("foot", ["left", "right"])
def test_the_base_moves_as_the_standing_foot_says(robot, foot):
    kinematics, first, before = Kinematics(robot), None, None
    for k in range(20):
        bent = 0.1 * np.sin(0.3 * k)
        q, base, quaternion, turned, _ = standing(robot, bent, foot)
        ahead, there, _, turned_then, _ = standing(robot, bent + 1e-5, foot)
        rate = 0.03 * np.cos(0.3 * k) / TICK  # of bent, a second
        spin = (turned.T @ turned_then - np.eye(3)) / 1e-5 * rate
        gyro = np.array([spin[2, 1], spin[0, 2], spin[1, 0]])
        limbs = kinematics(q, (ahead - q) / 1e-5 * rate, quaternion, gyro)
        first = base - limbs.base if first is None else first
        np.testing.assert_allclose(limbs.base + first, base, atol=1e-9)
        np.testing.assert_allclose(limbs.velocity, (there - base) / 1e-5 * rate, atol=5e-3)
        assert limbs.base[2] == pytest.approx(base[2], abs=1e-9)
        before = limbs.base if before is None else before
    assert np.linalg.norm(limbs.base - before) > 0.005


def test_what_is_not_finite_moves_nothing():
    robot = load_robot("g1")
    kinematics, rest = Kinematics(robot), (np.zeros(3),)
    q, base, quaternion, *_ = standing(robot, 0.1)
    assert kinematics(q * np.nan, 0 * q, quaternion, *rest).base is None
    assert kinematics(q, 0 * q, 0 * quaternion, *rest).base is None
    known = kinematics(q, 0 * q, quaternion, *rest)
    for bad in (
        (q * np.nan, 0 * q, quaternion),
        (q, q + np.inf, quaternion),
        (q, 0 * q, quaternion * np.nan),
        (q, 0 * q, 0 * quaternion),
    ):
        lost = kinematics(*bad, *rest)
        np.testing.assert_array_equal(lost.base, known.base)
        assert not len(lost.palms) and not lost.velocity.any()
    again = kinematics(q, 0 * q, quaternion, *rest)
    np.testing.assert_array_equal(again.base, known.base)


def test_a_robot_without_palms_and_soles_says_nothing():
    robot = load_robot("bench")
    limbs = Kinematics(robot)(robot.home_pos, 0 * robot.home_pos, np.array([1.0, 0, 0, 0]), np.zeros(3))
    assert limbs.base is None and limbs.palms.shape == Limbs().palms.shape
