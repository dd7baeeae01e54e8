"""The simulated body: placing, driving, the gantry, and what it says about itself."""

from __future__ import annotations

import numpy as np
import pytest
from sim_robots import ARM, BOX, write_model

from drivers.bus import BusError
from drivers.sim.plant import Plant

JOINTS = ("left", "right")


def plant(tmp_path, model: str = BOX, joints=JOINTS, **options) -> Plant:
    return Plant(write_model(tmp_path, model), joints, "base", **options)


def settle(p: Plant, seconds: float) -> None:
    for _ in range(round(seconds / p.timestep)):
        p.step()


def stiffen(p: Plant) -> None:
    p.drive(np.zeros(2), np.full(2, 50.0), np.full(2, 2.0))


def test_stands_on_the_floor_it_is_given(tmp_path):
    p = plant(tmp_path)
    assert p.truth().position_base_in_world == pytest.approx([0, 0, 0.3], abs=1e-6)  # 0.2 of box and 0.1 of leg
    stiffen(p)
    settle(p, 1.0)
    truth = p.truth()
    assert truth.position_base_in_world[2] == pytest.approx(0.3, abs=0.005)
    assert truth.tilt < 0.02 and not truth.fallen
    assert p.acceleration_imu_in_imu == pytest.approx([0, 0, 9.81], abs=0.05)


def test_joint_order_is_the_callers(tmp_path):
    p = plant(tmp_path, joints=("right", "left"))
    p.reset({"left": 0.3})
    assert p.joint_pos.tolist() == [0.0, 0.3]
    p.reset([0.1, 0.2])
    assert p.data.joint("right").qpos[0] == 0.1


def test_reset_noise_is_seeded(tmp_path):
    p = plant(tmp_path)
    poses = []
    for seed in (1, 1, 2):
        p.reset(noise=0.05, seed=seed)
        poses.append(p.joint_pos.copy())
    assert np.array_equal(poses[0], poses[1]) and not np.array_equal(poses[0], poses[2])
    assert np.abs(poses[0]).max() <= 0.05


def test_hangs_sets_down_and_lets_go(tmp_path):
    p = plant(tmp_path)
    p.reset(hang=0.05)
    assert p.truth().position_base_in_world[2] == pytest.approx(0.35, abs=1e-6)
    stiffen(p)
    settle(p, 2.0)
    hanging = p.truth()
    assert hanging.position_base_in_world == pytest.approx([0, 0, 0.35], abs=0.01)
    assert np.linalg.norm(hanging.velocity_base_in_world) < 0.05 and hanging.tilt < 0.05
    assert p.data.ncon == 0

    before = p.gantry.height
    p.gantry.lower(0.1)
    settle(p, 0.2)
    assert p.gantry.height == pytest.approx(before - 0.02, abs=1e-9)
    p.gantry.hold()
    settle(p, 0.2)
    assert p.gantry.height == pytest.approx(before - 0.02, abs=1e-9)
    p.gantry.lower(0.1)
    settle(p, 5.0)
    assert p.gantry.height == p.gantry.lowest
    assert p.data.xfrc_applied[1:, 2].max() == 0.0  # the rope is slack: its feet carry it
    assert p.truth().position_base_in_world[2] == pytest.approx(0.3, abs=0.01)

    p.release()
    settle(p, 0.5)
    assert not p.fallen


def test_gantry_carries_exactly_the_weight(tmp_path):
    p = plant(tmp_path)
    p.reset(hang=0.05)
    settle(p, 3.0)
    assert p.data.xfrc_applied[:, 2].sum() == pytest.approx(10 * 9.81, rel=0.01)


def test_without_the_gantry_it_falls(tmp_path):
    p = plant(tmp_path)
    p.reset(hang=0.5)
    p.release()
    settle(p, 0.2)
    assert p.truth().velocity_base_in_world[2] == pytest.approx(-9.81 * 0.2, rel=0.02)


def test_push(tmp_path):
    p = plant(tmp_path)
    p.push((0.5, -0.25, 0.0))
    assert p.truth().velocity_base_in_world == pytest.approx([0.5, -0.25, 0.0])
    with pytest.raises(BusError, match="free joint"):
        plant(tmp_path, ARM).push((1, 0, 0))


def test_tipping_over_is_falling(tmp_path):
    p = plant(tmp_path)
    p.data.qpos[3:7] = (np.cos(0.45), np.sin(0.45), 0.0, 0.0)  # 0.9 rad: past its edge, not yet down
    p.step()
    assert not p.fallen and p.tilt == pytest.approx(0.9, abs=0.05)
    settle(p, 1.0)
    assert p.fallen and p.tilt > 1.0


def test_truth_is_of_now(tmp_path):
    """Not of before the last substep: positions, velocities and orientation agree with the state."""
    p = plant(tmp_path)
    p.reset(hang=0.5)
    p.release()
    p.data.qvel[:6] = (0.3, 0.0, 0.0, 0.0, 0.0, 1.0)
    settle(p, 0.1)
    truth = p.truth()
    assert truth.position_base_in_world == pytest.approx(p.data.qpos[:3], abs=1e-12)
    assert truth.orientation_base_in_world == pytest.approx(p.data.qpos[3:7], abs=1e-12)
    assert truth.velocity_base_in_world == pytest.approx(p.data.qvel[:3], abs=1e-12)
    assert truth.angular_velocity_base_in_base == pytest.approx(p.data.qvel[3:6], abs=1e-12)
    assert p.orientation_imu_in_world == pytest.approx(p.data.qpos[3:7], abs=1e-12)


def test_torque_is_clipped(tmp_path):
    p = plant(tmp_path, ARM)
    p.drive(np.array([100.0, -100.0]), np.zeros(2), np.zeros(2))
    p.step()
    assert p.joint_torque.tolist() == [30.0, -30.0]  # what the model says
    p.limit(np.array([5.0, 50.0]))
    p.step()
    assert p.joint_torque.tolist() == [5.0, -30.0]


def test_damping_beyond_the_explicit_limit_is_stable(tmp_path):
    """kd dt / I = 5: sampled once in a substep this would blow up; a motor's own loop is a hundred times faster."""
    p = plant(tmp_path, ARM)
    p.data.qvel[:] = 0.5
    p.drive(np.zeros(2), np.zeros(2), np.full(2, 50.0))
    speeds = []
    for _ in range(5):
        p.step()
        speeds.append(p.joint_vel[0])
    assert all(0 < b < a for a, b in zip(speeds, speeds[1:], strict=False))


def test_prepare_may_alter_the_model(tmp_path):
    def heavier(spec) -> None:
        spec.geoms[1].mass = 20

    assert plant(tmp_path, prepare=heavier).model.body_mass.sum() > plant(tmp_path).model.body_mass.sum()


def test_wrong_names(tmp_path):
    with pytest.raises(BusError, match=r"no joint \['middle'\].*'left', 'right'"):
        plant(tmp_path, joints=("left", "middle"))
    with pytest.raises(BusError, match="no body 'hips'"):
        Plant(write_model(tmp_path), JOINTS, "hips")
