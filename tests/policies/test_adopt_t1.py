"""The T1's foreign policies: parity with what was recorded in their makers' simulations, what each dialect does at zero
command, and bad sources. That they walk is in tests/sim2real/test_simulation.py."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import NamedTuple

import numpy as np
import onnx
import onnxruntime
import pytest

from policies.adopt import adopt, playground
from policies.adopt.odometry import LegOdometry
from policies.adopt.shipped import read_onnx
from sim2real import cli
from sim2real.config import load_robot
from sim2real.policy import PolicyError

T1 = load_robot("t1")
LEG = [-0.2, 0, 0, 0.4, -0.25, 0]
ARM = np.array([0.2, 1.35, 0, 0.5, 0, 0, 0])
MIRROR = np.array([1, -1, 1, -1, 1, 1, 1])


class Shipped(NamedTuple):
    """One network in ``shared/policies``: what was recorded of it, and the target that an action means."""

    dialect: str
    folder: str
    network: str
    golden: str
    scale: float
    default: np.ndarray


HOLOSOMA = np.concatenate([[0, 0], ARM * MIRROR, ARM, [0], LEG, LEG])
SHIPPED = {
    "holosoma ppo": Shipped(
        "holosoma", "holosoma_t1", "ppo_t1_29dof.onnx", "golden_io_ppo.npz", 0.25, HOLOSOMA
    ),
    "holosoma fastsac": Shipped(
        "holosoma", "holosoma_t1", "fastsac_t1_29dof.onnx", "golden_io_fastsac.npz", 0.25, HOLOSOMA
    ),
    "booster_gym onnx": Shipped("booster_gym", "booster_gym_t1", "T1.onnx", "golden_io.npz", 1.0, np.array(LEG * 2)),
    "booster_gym torch": Shipped("booster_gym", "booster_gym_t1", "T1.pt", "golden_io.npz", 1.0, np.array(LEG * 2)),
}  # fmt: skip


def recorded(shared: Path, shipped: Shipped):
    """(observation, action, signals) of each recorded step."""
    golden = np.load(shared / "policies" / shipped.folder / shipped.golden)
    for obs, action, qpos, qvel in zip(golden["obs"], golden["action"], golden["qpos"], golden["qvel"], strict=True):
        yield obs, action, signals(qpos, qvel)


def signals(qpos, qvel, command=(0.5, 0.0, 0.0)):
    return {
        "joint_pos": qpos[7:],
        "joint_vel": qvel[6:],
        "orientation_base_in_world": qpos[3:7],
        "angular_velocity_base_in_base": qvel[3:6],
        "command_velocity": np.array(command),
    }


def adopted(shared, name, tmp_path, **options):
    shipped = SHIPPED[name]
    source = shared / "policies" / shipped.folder / shipped.network
    return adopt(source, shipped.dialect, T1, tmp_path / "walk.onnx", **options)


@pytest.mark.parametrize("name", SHIPPED)
def test_parity(name, shared, tmp_path):
    """Observation, action and target from recorded signals, against what was recorded."""
    policy = adopted(shared, name, tmp_path)
    shipped, worst = SHIPPED[name], 0.0
    for obs, action, inputs in recorded(shared, shipped):
        if shipped.dialect == "booster_gym":
            inputs |= measured_with(obs[0:3], obs[3:6])
        outputs = policy.step(inputs)
        target = shipped.scale * action + shipped.default
        for key, expected in (("observation", obs), ("action", action), ("joint_pos_target", target)):
            worst = max(worst, np.abs(outputs[key] - expected).max())
    assert worst < 1e-4


def measured_with(gravity, gyro):
    """The signals that give an observation's gravity and gyroscope: an upright frame turned onto ``gravity``.

    Two of the recordings took them from MuJoCo's sensors, which lag one physics step of 2 ms behind qpos and qvel."""
    x, y, z = np.asarray(gravity, float) / np.linalg.norm(gravity)
    quaternion = np.array([1 - z, -y, x, 0.0])  # the shortest turn
    return {
        "orientation_base_in_world": quaternion / np.linalg.norm(quaternion),
        "angular_velocity_base_in_base": gyro,
    }


@pytest.fixture
def scene(shared):
    return playground.read_scene(shared / "policies" / "playground_t1" / "model" / "scene_nomesh.xml")


def test_playground_parity(scene, shared):
    """Of the graph as it was trained, with the true velocity as an input."""
    folder = shared / "policies" / "playground_t1"
    network = read_onnx(folder / "t1_policy.onnx")
    model, fields = playground.assemble(scene, network, T1, folder / "t1_policy.onnx", None)
    session = onnxruntime.InferenceSession(model.SerializeToString(), providers=["CPUExecutionProvider"])
    names = [v.name for v in session.get_outputs()]
    carry = {name: np.array([c["start"]], np.float32) for name, c in fields["carry"].items()}
    worst = 0.0
    for obs, action, inputs in recorded(
        shared, Shipped("playground", "playground_t1", "", "golden_io.npz", 1.0, scene.default)
    ):
        inputs |= measured_with(obs[6:9], obs[3:6]) | {"linear_velocity_base_in_base": obs[0:3]}
        fed = {name: np.asarray(value, np.float32)[None] for name, value in inputs.items()}
        outputs = dict(zip(names, session.run(None, fed | carry), strict=True))
        carry = {name: outputs[f"{name}_next"] for name in carry}
        target = np.clip(action + scene.default, scene.target_min, scene.target_max)
        for key, expected in (("observation", obs), ("action", action), ("joint_pos_target", target)):
            worst = max(worst, np.abs(outputs[key][0] - expected).max())
    assert worst < 1e-4


def test_odometry_follows_the_recorded_velocity(shared, tmp_path):
    """What the adopted graph estimates from joints and IMU, against the true velocity that was recorded."""
    folder = shared / "policies" / "playground_t1"
    policy = adopt(folder, "playground", T1, tmp_path / "walk.onnx")
    golden = np.load(folder / "golden_io.npz")
    estimated = []
    for qpos, qvel in zip(golden["qpos"], golden["qvel"], strict=True):
        estimated.append(policy.step(signals(qpos, qvel))["observation"][:3].copy())
    error = (np.array(estimated) - golden["obs"][:, :3])[10:]
    assert np.all(np.abs(error.mean(axis=0)) < [0.03, 0.03, 0.06]), error.mean(axis=0)
    assert np.all(error.std(axis=0) < [0.06, 0.04, 0.10]), error.std(axis=0)


def test_odometry_of_a_body_that_turns_over_a_standing_foot(scene):
    """The base pitches at 0.5 rad/s about soles that stand: it moves at 0.5 rad/s times their distance."""
    odometry = LegOdometry(T1, scene.joints)
    spin, down = np.array([0.0, 0.5, 0.0]), np.array([0.0, 0.0, -1.0])
    pose, still = scene.default, np.zeros(len(scene.joints))
    velocity = odometry.estimate(pose, still, spin, down, np.zeros(3))
    height = 0.6658  # m, keyframe `home` of t1.xml: of the trunk over the soles
    assert velocity[0] == pytest.approx(0.5 * height, rel=0.02)
    assert abs(velocity[1]) < 1e-3


@pytest.mark.parametrize("name", ["holosoma ppo", "booster_gym onnx"])
def test_standing_and_walking_again(name, shared, tmp_path):
    """The gait's clock at zero command, and after it."""
    policy = adopted(shared, name, tmp_path)
    shipped = SHIPPED[name]
    rest = signals(np.concatenate([[0, 0, 0.7, 1, 0, 0, 0], shipped.default]), np.zeros(6 + len(shipped.default)))
    clock = {
        "holosoma": lambda o: np.arctan2(o[98:100], o[35:37]),
        "booster_gym": lambda o: np.append(o[9:11], o[6:9]),
    }[shipped.dialect]

    def after(command):
        return clock(policy.step(rest | {"command_velocity": np.array(command)})["observation"].astype(float))

    walking = after((0.5, 0, 0))
    for _ in range(7):
        standing = after((0, 0, 0))
    again = after((0, 0, 0.2))
    if shipped.dialect == "holosoma":
        np.testing.assert_allclose(walking, [2 * np.pi / 50, 2 * np.pi / 50 - np.pi], atol=1e-5)
        np.testing.assert_allclose(np.abs(standing), np.pi, atol=1e-5)
        np.testing.assert_allclose(np.abs(again), [0, np.pi], atol=1e-5)  # starts over
    else:
        np.testing.assert_allclose(walking, [1, 0, 0.5, 0, 0], atol=1e-6)
        np.testing.assert_allclose(standing, 0, atol=0)
        angle = 2 * np.pi * 0.03  # its clock stood still meanwhile
        np.testing.assert_allclose(again, [np.cos(angle), np.sin(angle), 0, 0, 0.2], atol=1e-6)


def test_what_the_deploy_configuration_changes(shared, tmp_path):
    """Ankles damped by 3 instead of 1, and a gait of 1.0 instead of 1.5 Hz."""
    config = shared / "policies" / "booster_gym_t1" / "deploy_T1.yaml"
    contract = adopted(shared, "booster_gym onnx", tmp_path, configs=[config]).contract
    assert contract.kd == [5, 5, 5, 5, 3, 3] * 2 and contract.kp == [200, 200, 200, 200, 50, 50] * 2
    trained = adopted(shared, "booster_gym onnx", tmp_path).contract
    assert trained.kd == [5, 5, 5, 5, 1, 1] * 2 and trained.default_joint_pos == contract.default_joint_pos


def test_gains_and_order_are_the_files_own(shared, tmp_path):
    contract = adopted(shared, "holosoma fastsac", tmp_path).contract
    assert contract.joint_names == list(T1.joint_names) and not contract.hold
    assert contract.kp[:3] == [5, 5, 20] and contract.kd[-6:] == [5, 5, 5, 5, 3, 3]
    assert contract.command_velocity_max == (1.0, 1.0, 1.0)


def _without_metadata(path: Path, key: str) -> None:
    network = onnx.load_from_string(path.read_bytes())
    kept = {p.key: p.value for p in network.metadata_props if p.key != key}
    del network.metadata_props[:]
    onnx.helper.set_model_props(network, kept)
    path.write_bytes(network.SerializeToString())


def _edit(file: Path, old: str, new: str) -> None:
    text = file.read_text()
    assert old in text
    file.write_text(text.replace(old, new, 1))


HOLO, BOOST, PLAY = ("holosoma", "holosoma_t1"), ("booster_gym", "booster_gym_t1"), ("playground", "playground_t1")
REFUSALS = {
    "two networks": (HOLO, lambda f: None, "name the file instead"),
    "no gains": (
        HOLO,
        lambda f: [(f / "fastsac_t1_29dof.onnx").unlink(), _without_metadata(f / "ppo_t1_29dof.onnx", "kp")],
        "metadata: kp: missing; add it",
    ),
    "another's network": (
        HOLO,
        lambda f: (
            [p.unlink() for p in f.glob("*.onnx")] + [shutil.copy(f.parents[1] / "other" / "T1.onnx", f / "T1.onnx")]
        ),
        "metadata: dof_names: missing; add it",
    ),
    "no training or deploy file": (BOOST, lambda f: [p.unlink() for p in f.glob("*.yaml")], "got no YAML"),
    "missing key": (
        BOOST,
        lambda f: _edit(f / "train_T1.yaml", "gait_frequency:", "gait:"),
        "commands.gait_frequency: missing; add it",
    ),
    "gain for no ankle": (
        BOOST,
        lambda f: _edit(f / "train_T1.yaml", '"Ankle": 50.', '"Foot": 50.'),
        "expected one for Left_Ankle_Pitch",
    ),
    "not a number": (
        BOOST,
        lambda f: _edit(f / "train_T1.yaml", "dof_vel: 0.1", "dof_vel: .nan"),
        "normalization.dof_vel: got nan",
    ),
    "no scene": (PLAY, lambda f: shutil.rmtree(f / "model"), "got no MJCF"),
    "not a scene": (PLAY, lambda f: (f / "model" / "scene_nomesh.xml").write_text("<x/>"), "expected an MJCF scene"),
    "torque motors": (
        PLAY,
        lambda f: shutil.copy(T1.model_path, f / "model" / "scene_nomesh.xml"),
        "expected position actuators of joints",
    ),
    "damaged network": (
        PLAY,
        lambda f: (f / "t1_policy.onnx").write_bytes((f / "t1_policy.onnx").read_bytes()[:999]),
        "the file is damaged",
    ),
    "size": (
        PLAY,
        lambda f: shutil.copy(f.parents[1] / "other" / "T1.onnx", f / "t1_policy.onnx"),
        "got shapes [[1, 47]] -> [[1, 12]], expected [1, 85] -> [1, 23]",
    ),
}


@pytest.mark.parametrize("case", REFUSALS)
def test_refusals(case, shared, tmp_path, capsys):
    """One message, exit code 2, and nothing written."""
    (dialect, folder), spoil, words = REFUSALS[case]
    source = tmp_path / "in" / folder
    shutil.copytree(shared / "policies" / folder, source)
    (tmp_path / "other").mkdir()
    shutil.copy(shared / "policies" / "booster_gym_t1" / "T1.onnx", tmp_path / "other")
    for path in source.rglob("*"):
        path.chmod(0o755 if path.is_dir() else 0o644)
    spoil(source)
    output = tmp_path / "walk.onnx"
    assert cli.main(["adopt", str(source), "--dialect", dialect, "--robot", "t1", "-o", str(output)]) == 2
    out, err = capsys.readouterr()
    assert words in err and err.startswith("error: ") and not out
    assert not output.exists()


@pytest.mark.parametrize("folder", [HOLO, BOOST, PLAY])
def test_another_robot_is_refused(folder, shared, tmp_path):
    dialect, name = folder
    source = shared / "policies" / name
    source = source / "ppo_t1_29dof.onnx" if dialect == "holosoma" else source
    with pytest.raises(PolicyError, match="robot 'g1'"):
        adopt(source, dialect, load_robot("g1"), tmp_path / "walk.onnx")


@pytest.mark.parametrize("dialect, source", [
    ("holosoma", "holosoma_t1/fastsac_t1_29dof.onnx"), ("booster_gym", "booster_gym_t1"), ("playground", "playground_t1"),
])  # fmt: skip
def test_command_line_and_check(dialect, source, shared, tmp_path, capsys):
    output = tmp_path / "walk.onnx"
    given = str(shared / "policies" / source)
    assert cli.main(["adopt", given, "--dialect", dialect, "--robot", "t1", "-o", str(output)]) == 0
    assert cli.main(["check", str(output), "--robot", "t1"]) == 0
    assert "fits t1" in capsys.readouterr().out
