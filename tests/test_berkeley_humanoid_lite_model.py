"""The Berkeley Humanoid Lite's body against its makers' URDF, whose numbers stand here as a table.

The body is written from their MJCF (quaternions, Cartesian inertias); the table is their URDF (roll, pitch, yaw), exported
by another run: HybridRobotics/Berkeley-Humanoid-Lite-Assets, data/urdf/berkeley_humanoid_lite.urdf, revision 6e3fcd2.
"""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from sim2real.config import load_robot

ROBOT = load_robot("berkeley_humanoid_lite")

# link: parent; joint origin xyz, rpy; joint range (fixed: none); mass, centre, inertia xx xy xz yy yz zz
LINKS = """
base: -; 0 0 0, 0 0 0; -; 4.44401, -0.0030965 0.000264765 0.675059, 0.0667167 1.21504e-06 -0.00131643 0.0447686 2.88151e-05 0.0318661
imu_2: base; 0.061722 0 0.68, 0 0 0; -; 0.00197704, 0 0 0.0025, 1.11441e-07 0 0 4.06118e-08 0 1.43815e-07
arm_left_shoulder_pitch: base; 0 0.133 0.764028, -1.5708 0 0; -2.35619 1.5708; 0.342876, -0.00661228 -8.80749e-05 0.0396144, 0.000218285 -1.17021e-06 1.05191e-05 0.000260325 -4.52438e-07 0.00022463
arm_left_shoulder_roll: arm_left_shoulder_pitch; 0.0255 0 0.043, 1.5708 1.309 1.5708; -0.261799 1.309; 0.443945, -4.00762e-05 0.0737019 -0.0277329, 0.000698118 -4.07105e-07 -1.31045e-07 0.000365437 -1.56428e-05 0.000568315
arm_left_shoulder_yaw: arm_left_shoulder_roll; 0 0.123 -0.0255, -1.5708 0 0; -1.5708 1.5708; 0.329199, -0.00781722 -9.17114e-05 0.0409759, 0.000196136 -1.164e-06 8.20811e-06 0.000241556 -4.93374e-07 0.000214842
arm_left_elbow_pitch: arm_left_shoulder_yaw; 0.0245 0 0.043, 1.5708 0 1.5708; 0 1.5708; 0.443945, -4.00762e-05 0.0737019 -0.0277329, 0.000698118 -4.07105e-07 -1.31045e-07 0.000365437 -1.56428e-05 0.000568315
arm_left_elbow_roll: arm_left_elbow_pitch; 0 0.123 -0.0255, -1.5708 0 0; -1.5708 1.5708; 0.000826239, 0 0 0.005, 1.20493e-08 0 0 1.20493e-08 0 1.0328e-08
arm_left_hand_link: arm_left_elbow_roll; 0 0 0, 3.14159 0 -1.5708; -; 0.291741, -0.00248666 0.0134979 -0.0541316, 0.000556491 3.82363e-06 -2.67254e-06 0.000494025 -0.000102102 0.000161723
arm_right_shoulder_pitch: base; 0 -0.133 0.764028, -1.5708 0 -3.14159; -1.5708 2.35619; 0.342876, 0.00661228 -1.57066e-05 0.0397088, 0.000218503 2.55599e-07 -1.17928e-05 0.000260541 5.72405e-07 0.000224632
arm_right_shoulder_roll: arm_right_shoulder_pitch; -0.0255 0 0.043, 1.5708 -1.309 -1.5708; -1.309 0.261799; 0.443945, -4.00762e-05 0.0737019 -0.0277329, 0.000698118 -4.07105e-07 -1.31045e-07 0.000365437 -1.56428e-05 0.000568315
arm_right_shoulder_yaw: arm_right_shoulder_roll; 0 0.123 -0.0255, 1.5708 0 3.14159; -1.5708 1.5708; 0.329199, -0.00781722 -1.63693e-05 0.0404875, 0.000195409 -2.54474e-07 1.84257e-06 0.000240827 -5.40945e-07 0.000214844
arm_right_elbow_pitch: arm_right_shoulder_yaw; 0.0245 0 0.043, 1.5708 0 1.5708; -1.5708 0; 0.443945, -4.00762e-05 0.0737019 -0.0277329, 0.000698118 -4.07105e-07 -1.31045e-07 0.000365437 -1.56428e-05 0.000568315
arm_right_elbow_roll: arm_right_elbow_pitch; 0 0.123 -0.0255, 1.5708 0 -3.14159; -1.5708 1.5708; 0.000826239, 0 0 0.005, 1.20493e-08 0 0 1.20493e-08 0 1.0328e-08
arm_right_hand_link: arm_right_elbow_roll; 0 0 0, -3.14159 0 -1.5708; -; 0.291741, -0.00248666 0.0134979 -0.0541316, 0.000556491 3.82363e-06 -2.67254e-06 0.000494025 -0.000102102 0.000161723
leg_left_hip_roll: base; -0.0290919 0.08 0.542631, 0 0.785398 0; -0.174533 1.5708; 0.83786, -0.00410941 -0.000112596 -0.0464623, 0.000979918 6.45954e-06 -1.63173e-05 0.000896043 -5.43389e-06 0.000727678
leg_left_hip_yaw: leg_left_hip_roll; 0.027 0 -0.052, -1.5708 0 -1.5708; -0.981748 0.589049; 0.837683, -0.00411632 -8.63203e-05 0.0463382, 0.000979031 -1.13217e-06 1.96352e-05 0.000898166 -5.91541e-06 0.000724287
leg_left_hip_pitch: leg_left_hip_yaw; 0.027 0 0.052, 1.5708 -0.785398 -1.5708; -1.89805 0.981748; 0.947974, 0.0030405 0.120388 0.0210924, 0.00286449 0.00012235 -2.15676e-05 0.00102465 0.000265775 0.00259958
leg_left_knee_pitch: leg_left_hip_pitch; 0 0.15 -0.018, 0 0 -3.14159; 0 2.44346; 0.653864, -4.14041e-05 -0.112249 0.0257397, 0.00230126 -4.24923e-07 1.36589e-06 0.000559753 3.7889e-05 0.00203727
leg_left_ankle_pitch: leg_left_knee_pitch; 0 -0.16 -0.003, 0 0 -3.14159; -0.785398 0.785398; 0.106196, 0.0131065 0.0273743 0.0274153, 0.000188241 -2.50802e-05 -7.26755e-06 0.000142962 -7.72963e-06 8.17202e-05
leg_left_ankle_roll: leg_left_ankle_pitch; 0.03 0.05 0.025, 0 1.5708 0; -0.261799 0.261799; 0.706476, 2.29341e-05 0.0226611 0.0197836, 0.00198705 5.37011e-07 -8.3949e-07 0.00190341 0.000143151 0.000619673
leg_right_hip_roll: base; -0.0290919 -0.08 0.542631, 0 -0.785398 3.14159; -1.5708 0.174533; 0.83786, 0.00410941 -0.00018505 -0.0464478, 0.000979766 -3.69135e-06 1.57667e-05 0.000896334 -4.74708e-06 0.000727235
leg_right_hip_yaw: leg_right_hip_roll; -0.027 0 -0.052, -1.5708 0 1.5708; -0.589049 0.981748; 0.837683, 0.00411632 -1.3851e-05 0.0463238, 0.000978901 -1.63559e-06 -1.90847e-05 0.000898454 -5.23378e-06 0.000723868
leg_right_hip_pitch: leg_right_hip_yaw; -0.027 0 0.052, 1.5708 -0.785398 -1.5708; -1.89805 0.981748; 0.947974, 0.00319928 0.120388 -0.0210924, 0.00286448 0.000117078 2.6845e-05 0.00102371 -0.000265774 0.00259864
leg_right_knee_pitch: leg_right_hip_pitch; 0 0.15 0.018, 0 0 0; 0 2.44346; 0.653864, -5.09429e-05 0.112249 -0.0257397, 0.00230126 1.34936e-06 -1.17826e-06 0.000559752 3.7889e-05 0.00203727
leg_right_ankle_pitch: leg_right_knee_pitch; 0 0.16 0.003, 0 0 0; -0.785398 0.785398; 0.106196, 0.0131065 0.0273743 -0.0274153, 0.000188241 -2.50802e-05 7.26754e-06 0.000142962 7.72962e-06 8.17203e-05
leg_right_ankle_roll: leg_right_ankle_pitch; 0.03 0.05 -0.025, 0 1.5708 0; -0.261799 0.261799; 0.706476, 2.29341e-05 0.0226611 0.0197836, 0.00198705 5.37011e-07 -8.3949e-07 0.00190341 0.000143151 0.000619673
"""
NARROWED = {
    "shoulder_pitch",
    "shoulder_yaw",
    "elbow_roll",
}  # by the README and the later MJCF: 90 and 45, 45, 45 degrees


class Link:
    """A row of LINKS."""

    def __init__(self, line: str):
        self.name, rest = line.split(": ")
        self.parent, origin, range_, inertial = rest.split("; ")
        numbers = lambda text: np.array([float(x) for x in text.split()])  # noqa: E731
        self.xyz, rpy = map(numbers, origin.split(", "))
        self.rotation = turn(2, rpy[2]) @ turn(1, rpy[1]) @ turn(0, rpy[0])
        self.range = None if range_ == "-" else numbers(range_)
        mass, self.com, i = map(numbers, inertial.split(", "))
        self.mass = float(mass[0])
        self.inertia = np.array([[i[0], i[1], i[2]], [i[1], i[3], i[4]], [i[2], i[4], i[5]]])


def turn(axis: int, angle: float) -> np.ndarray:
    """(3, 3) rotation about an axis."""
    c, s = np.cos(angle), np.sin(angle)
    a, b = (axis + 1) % 3, (axis + 2) % 3
    out = np.eye(3)
    out[a, a], out[a, b], out[b, a], out[b, b] = c, -s, s, c
    return out


TABLE = [Link(line) for line in LINKS.strip().split("\n")]


@pytest.fixture(scope="module")
def model() -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_path(str(ROBOT.model_path))


def test_the_bodies_are_the_makers(model: mujoco.MjModel) -> None:
    assert [model.body(i).name for i in range(1, model.nbody)] == [link.name for link in TABLE]
    for link in TABLE:
        ours = model.body(link.name)
        assert model.body(ours.parentid[0]).name == (link.parent if link.parent != "-" else "world")
        assert ours.mass[0] == pytest.approx(link.mass, rel=1e-9), link.name
        np.testing.assert_allclose(ours.ipos, link.com, atol=1e-9, err_msg=link.name)
        axes = np.zeros(9)
        mujoco.mju_quat2Mat(axes, ours.iquat)
        principal = axes.reshape(3, 3)
        tensor = principal @ np.diag(ours.inertia) @ principal.T
        np.testing.assert_allclose(tensor, link.inertia, atol=1e-4 * link.inertia.max(), err_msg=link.name)


def test_the_ranges_are_the_makers(model: mujoco.MjModel) -> None:
    jointed = [link for link in TABLE if link.range is not None]
    assert [f"{link.name}_joint" for link in jointed] == list(ROBOT.joint_names)
    for link in jointed:
        ours, kind = model.joint(f"{link.name}_joint"), link.name.split("_", 2)[2]
        if kind not in NARROWED:
            np.testing.assert_allclose(ours.range, link.range, atol=1e-9, err_msg=link.name)
            continue
        low, high = np.deg2rad([-90, 45] if kind == "shoulder_pitch" else [-45, 45])
        if link.name.startswith("arm_right_shoulder_pitch"):
            low, high = -high, -low
        np.testing.assert_allclose(ours.range, [low, high], atol=1e-5, err_msg=link.name)
        assert link.range[0] <= ours.range[0] and ours.range[1] <= link.range[1]


def test_forward_kinematics_agree_to_a_tenth_of_a_millimetre(model: mujoco.MjModel) -> None:
    rng, data = np.random.default_rng(0), mujoco.MjData(model)
    for _ in range(100):
        q = dict(zip(ROBOT.joint_names, rng.uniform(ROBOT.position_min, ROBOT.position_max), strict=True))
        data.qpos[:7] = [0, 0, 0, 1, 0, 0, 0]
        data.qpos[7:] = list(q.values())
        mujoco.mj_kinematics(model, data)
        frames = {"-": (np.zeros(3), np.eye(3))}
        for link in TABLE:
            place, axes = frames[link.parent]
            angle = q.get(f"{link.name}_joint", 0.0)
            frames[link.name] = (place + axes @ link.xyz, axes @ link.rotation @ turn(2, angle))
            place, axes = frames[link.name]
            np.testing.assert_allclose(data.body(link.name).xpos, place, atol=1e-4, err_msg=link.name)
            np.testing.assert_allclose(data.body(link.name).xipos, place + axes @ link.com, atol=1e-4)
