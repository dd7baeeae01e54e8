"""Adopted policies compute what their makers' deploy scripts compute, from raw signals, and say so themselves."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import onnx
import pytest

from policies.adopt import DIALECTS, adopt
from policies.adopt.unitree_rl_gym import BALANCED
from sim2real import cli
from sim2real.config import load_robot
from sim2real.policy import PolicyError, load_policy

G1 = load_robot("g1")


@pytest.fixture
def source(shared, tmp_path):
    """A copy of the maker's files, to spoil."""
    folder = tmp_path / "source"
    folder.mkdir()
    for name in ("motion.pt", "motion_stateful.onnx", "config_mujoco_g1.yaml", "config_real_g1.yaml"):
        shutil.copyfile(shared / "policies" / "unitree_rl_gym_g1" / name, folder / name)
    return folder


def walk(source, tmp_path, network="", **options):
    return adopt(source / network, "unitree_rl_gym", G1, tmp_path / "walk.onnx", **options)


@pytest.mark.parametrize("network", ["motion_stateful.onnx", "motion.pt"])
def test_parity(network, source, shared, tmp_path):
    """Observation and action from recorded qpos and qvel, against what was recorded in the maker's own simulation."""
    policy = walk(source, tmp_path, network)
    golden = np.load(shared / "policies" / "unitree_rl_gym_g1" / "golden_io.npz")
    errors = {"observation": 0.0, "action": 0.0, "joint_pos_target": 0.0}
    for obs, action, qpos, qvel in zip(golden["obs"], golden["action"], golden["qpos"], golden["qvel"], strict=True):
        outputs = policy.step(
            {
                "joint_pos": qpos[7:],
                "joint_vel": qvel[6:],
                "orientation_base_in_world": qpos[3:7],
                "angular_velocity_base_in_base": qvel[3:6],
                "command_velocity": [0.5, 0.0, 0.0],
            }
        )
        target = 0.25 * action + np.array([-0.1, 0, 0, 0.3, -0.2, 0] * 2)
        for name, expected in (("observation", obs), ("action", action), ("joint_pos_target", target)):
            errors[name] = max(errors[name], np.abs(outputs[name] - expected).max())
    assert max(errors.values()) < 1e-4, errors


def test_contract(source, tmp_path):
    policy = walk(source, tmp_path)
    contract = policy.contract
    assert contract.joint_names == contract.target_joint_names == list(G1.joint_names[:12])
    assert list(contract.hold) == list(G1.joint_names[12:])
    waist, shoulder = contract.hold["waist_yaw_joint"], contract.hold["left_shoulder_pitch_joint"]
    assert (waist.position, waist.kp, waist.kd) == (0.0, 400.0, 5.0)  # as stiff as the motor allows
    assert (shoulder.position, shoulder.kp) == (BALANCED["left_shoulder_pitch_joint"], 20.0)
    assert contract.command_velocity_max == (0.8, 0.5, 1.57) and contract.period == 0.02
    assert contract.skill_labels == ("walk",) and contract.provenance.licence == "BSD-3-Clause"
    assert len(contract.golden) == 3 and policy.golden_error < 1e-5
    first = (tmp_path / "walk.onnx").read_bytes()
    walk(source, tmp_path)
    assert (tmp_path / "walk.onnx").read_bytes() == first, "same source, same bytes"


def test_gait_clock_starts_over_after_one_period(source, tmp_path):
    policy = walk(source, tmp_path)
    rest = {n: np.zeros(s) for n, s in policy.contract.inputs.items()}
    rest["orientation_base_in_world"] = np.array([1.0, 0.0, 0.0, 0.0])
    phases = np.array([policy.step(rest)["observation"][45:].copy() for _ in range(81)])
    np.testing.assert_allclose(phases[:, 0], np.sin(2 * np.pi * np.arange(81) / 40), atol=1e-6)
    np.testing.assert_allclose(phases[40], phases[80], atol=0)


def test_gravity_in_observation(source, tmp_path):
    """Lying on its back, the base's x axis points up: gravity in base is (-1, 0, 0)."""
    policy = walk(source, tmp_path)
    inputs = {n: np.zeros(s) for n, s in policy.contract.inputs.items()}
    inputs["orientation_base_in_world"] = np.array([1.0, 0.0, -1.0, 0.0]) / np.sqrt(2)
    np.testing.assert_allclose(policy.step(inputs)["observation"][3:6], [-1, 0, 0], atol=1e-6)


def test_without_the_real_robots_configuration_the_rest_is_held_as_in_training(source, tmp_path):
    contract = walk(source, tmp_path, configs=[source / "config_mujoco_g1.yaml"]).contract
    elbow = contract.hold["left_elbow_joint"]
    assert (elbow.position, elbow.kp, elbow.kd) == (0.0, 20.0, 5.0) and len(contract.hold) == 17
    assert contract.command_velocity_max == (0.5, 0.0, 0.0)


def _edit(file, old, new):
    text = file.read_text()
    assert old in text
    file.write_text(text.replace(old, new))


def _loop(folder):
    """A network that would never return."""
    path = folder / "motion_stateful.onnx"
    network = onnx.load_from_string(path.read_bytes())
    network.graph.node[0].op_type = "Loop"
    network.graph.node[0].attribute.append(onnx.helper.make_attribute("body", network.graph))
    path.write_bytes(network.SerializeToString())


def _without_networks(folder):
    (folder / "motion.pt").unlink()
    (folder / "motion_stateful.onnx").unlink()


def _truncate(path):
    path.write_bytes(path.read_bytes()[:1000])


REFUSALS = {
    "no yaml": (lambda f: [p.unlink() for p in f.glob("*.yaml")], "got no YAML"),
    "no network": (_without_networks, "got no .onnx or .pt file"),
    "two networks": (lambda f: shutil.copy(f / "motion_stateful.onnx", f / "b.onnx"), "name the file instead"),
    "contradiction": (
        lambda f: _edit(f / "config_real_g1.yaml", "action_scale: 0.25", "action_scale: 0.5"),
        "action_scale: got 0.5, expected 0.25 as in",
    ),
    "length": (
        lambda f: _edit(f / "config_real_g1.yaml", "arm_waist_target: [ 0, 0, 0,", "arm_waist_target: [ 0, 0,"),
        "arm_waist_target: got 16 values, expected 17",
    ),
    "not a number": (
        lambda f: _edit(f / "config_real_g1.yaml", "max_cmd: [0.8,", "max_cmd: [.nan,"),
        "max_cmd[0]: got nan",
    ),
    "missing key": (
        lambda f: [_edit(f / f"config_{k}_g1.yaml", "dof_vel_scale", "other") for k in ("real", "mujoco")],
        "dof_vel_scale: missing; add it",
    ),
    "other observation": (
        lambda f: [_edit(f / f"config_{k}_g1.yaml", "num_obs: 47", "num_obs: 48") for k in ("real", "mujoco")],
        "num_obs: got 48, expected 47 for 12 actions",
    ),
    "period": (
        lambda f: [
            _edit(f / "config_real_g1.yaml", "control_dt: 0.02", "control_dt: 0.03"),
        ],
        "control_dt: got 0.03, expected a whole part of 0.8 s",
    ),
    "gains": (
        lambda f: _edit(f / "config_real_g1.yaml", "[300, 300, 300,", "[500, 300, 300,"),
        "hold.kp.waist_yaw_joint: got 500, expected at most 400",
    ),
    "not yaml": (lambda f: (f / "config_real_g1.yaml").write_text("a: ["), "expected a YAML file"),
    "code in yaml": (
        lambda f: (f / "config_real_g1.yaml").write_text("a: !!python/object/apply:os.system [true]"),
        "expected a YAML file",
    ),
    "damaged network": (lambda f: _truncate(f / "motion_stateful.onnx"), "the file is damaged"),
    "loop in network": (_loop, "got Loop, which contains a graph"),
}


@pytest.mark.parametrize("case", REFUSALS)
def test_refusals(case, source, tmp_path, capsys):
    """One message, exit code 2, and nothing written."""
    spoil, words = REFUSALS[case]
    spoil(source)
    output = tmp_path / "walk.onnx"
    assert cli.main(["adopt", str(source), "--dialect", "unitree_rl_gym", "--robot", "g1", "-o", str(output)]) == 2
    out, err = capsys.readouterr()
    assert words in err and err.startswith("error: ") and not out and ".walk.onnx." not in err
    assert [p.name for p in tmp_path.iterdir()] == ["source"]


def test_damaged_torchscript(source, tmp_path):
    _truncate(source / "motion.pt")
    with pytest.raises(PolicyError, match="expected a TorchScript policy"):
        walk(source, tmp_path, "motion.pt")


def test_nowhere_to_write(source, tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(PolicyError, match="expected a place to write"):
        adopt(source, "unitree_rl_gym", G1, tmp_path / "file" / "walk.onnx")


def test_onnx_is_adopted_without_torch(source, tmp_path):
    """The base installation has none."""
    program = (
        "import sys; from sim2real.cli import main; code = main(sys.argv[1:]); sys.exit(code or 'torch' in sys.modules)"
    )
    command = ["adopt", str(source), "--dialect", "unitree_rl_gym", "-o", str(tmp_path / "walk.onnx")]
    subprocess.run([sys.executable, "-c", program, *command], check=True, cwd=Path(__file__).resolve().parents[2])


def test_unknown_dialect(tmp_path):
    with pytest.raises(
        PolicyError, match=r"dialect 'unitree_gym' \(did you mean 'unitree_rl_gym'\?\), expected one of"
    ):
        adopt(tmp_path, "unitree_gym", G1, tmp_path / "x.onnx")


def test_command_line(source, tmp_path, capsys):
    output = tmp_path / "walk.onnx"
    assert cli.main(["adopt", str(source), "--dialect", "unitree_rl_gym", "--robot", "g1", "-o", str(output)]) == 0
    assert "drives 12 joints, holds 17; skills walk" in capsys.readouterr().out
    assert load_policy(output, G1).contract.name == "unitree_rl_gym_walk"


def test_every_dialect_is_there():
    import importlib

    assert all(callable(importlib.import_module(module).read) for module in DIALECTS.values())
