"""A good policy on a robot that it does not fit: every mismatch by name, with its fix."""

from __future__ import annotations

import json

import numpy as np
import pytest
import tiny_policy

from sim2real import cli
from sim2real.config import load_robot
from sim2real.contract import Contract
from sim2real.policy import PolicyError, load_policy, mismatches

G1 = load_robot("g1")
KNEE = "left_knee_joint"
N = G1.joint_names.index(KNEE)


def found(**changes) -> list[str]:
    """Mismatches of the tiny policy with some fields replaced."""
    contract = Contract.model_validate(tiny_policy.document(G1)).model_copy(update=changes)
    return [str(m) for m in mismatches(contract, G1)]


def replaced(values, place, value):
    return [value if i == place else v for i, v in enumerate(values)]


def test_fits_the_robot_it_was_made_for(robot):
    assert mismatches(Contract.model_validate(tiny_policy.document(robot)), robot) == []


LIMIT = G1.joints[N]
CASES = {
    "other robot": ({"robot": "t1"}, "robot: got 't1', expected 'g1'; choose a policy trained for this robot"),
    "other hardware": ({"variants": [1, 2]}, f"variants: got [1, 2], expected one of {G1.variants}"),
    "foreign joint": (
        {"joint_names": replaced(G1.joint_names, N, "left_knee")},
        f"joint_names: got 'left_knee', expected a joint of g1 (did you mean '{KNEE}'?)",
    ),
    "signal": (
        {"inputs": {"joint_pos": [len(G1.joints)], "linear_velocity_base_in_base": [3], "carry_x": [1]}},
        "inputs.linear_velocity_base_in_base: got a signal nothing measures, expected one of joint_pos, joint_vel,",
    ),
    "kp": (
        {"kp": replaced(G1.home_kp, N, np.nextafter(LIMIT.kp_max, np.inf))},
        f"kp.{KNEE}: got 300, expected at most 300; train with a lower kp, or raise kp_max in g1.yaml",
    ),
    "kd": ({"kd": replaced(G1.home_kd, N, 8.0)}, f"kd.{KNEE}: got 8, expected at most 5; train with a lower kd"),
    "default pose": (
        {"default_joint_pos": replaced(G1.home_pos, N, -0.08)},
        f"default_joint_pos.{KNEE}: got -0.08 rad, expected -0.06727 to 2.86; check that joint_names has the order",
    ),
    "period": (
        {"period": 0.015},
        "period: got 0.015 s, expected a whole number of ticks of 1/250 s; a wiring rate of 266.667 Hz would fit",
    ),
}


@pytest.mark.parametrize("case", CASES)
def test_mismatch(case):
    changes, words = CASES[case]
    lines = found(**changes)
    assert len(lines) == 1 and lines[0].startswith(words), lines


@pytest.mark.parametrize(
    "changes",
    [
        {"kp": [j.kp_max for j in G1.joints], "kd": [j.kd_max for j in G1.joints]},
        {"default_joint_pos": [j.position[0] + G1.safety.position_margin for j in G1.joints]},
        {"variants": []},
        {"variants": [4, *G1.variants]},
        {"period": 0.004},
    ],
    ids=["largest gains", "at the soft limit", "no variants", "one variant of several", "every tick"],
)
def test_just_fits(changes):
    assert found(**changes) == []


def undriven(*held: str) -> dict:
    """The tiny contract less the joints ``held``."""
    names = [n for n in G1.joint_names if n not in held]
    return {"target_joint_names": names, "kp": [1.0] * len(names), "kd": [1.0] * len(names)}


def test_every_joint_is_driven_or_held():
    (line,) = found(**undriven(KNEE))
    assert line.startswith(f"hold.{KNEE}: got nothing, expected every joint either driven or held")


def test_held_joints_obey_the_limits_too():
    hold = {KNEE: {"position": 3.0, "kp": 301.0, "kd": 5.5}}
    contract = Contract.model_validate({**tiny_policy.document(G1), **undriven(KNEE), "hold": hold, "outputs": {"joint_pos_target": [28], "carry_count_next": [1]}, "golden": _shorter()})  # fmt: skip
    assert [m.what for m in mismatches(contract, G1)] == [f"hold.kp.{KNEE}", f"hold.kd.{KNEE}", f"hold.{KNEE}.position"]


def _shorter() -> list[dict]:
    golden = tiny_policy.document(G1)["golden"]
    for g in golden:
        g["outputs"]["joint_pos_target"] = [row[1:] for row in g["outputs"]["joint_pos_target"]]
    return golden


def test_wrong_joint_order():
    """Knees and ankles swapped: what was recorded on one cannot be on the other."""
    names, golden = list(G1.joint_names), tiny_policy.document(G1)["golden"]
    ankle = names.index("left_ankle_pitch_joint")
    names[N], names[ankle] = names[ankle], names[N]
    document = {**tiny_policy.document(G1), "joint_names": names, "target_joint_names": names, "golden": golden}
    found = mismatches(Contract.model_validate(document), G1)
    assert {m.what for m in found} >= {
        f"default_joint_pos.{KNEE}",
        f"golden joint_pos.{KNEE}",
        "kp.left_ankle_pitch_joint",
    }
    assert "check that joint_names has the order, sign and zero of the graph" in found[-1].fix


def test_loading_for_a_robot_names_every_mismatch(tmp_path):
    document = {**tiny_policy.document(G1), "robot": "t1", "period": 0.015}
    path = tiny_policy.write(tmp_path / "tiny.onnx", tiny_policy.model(G1), document)
    with pytest.raises(PolicyError, match="(?s)does not fit robot 'g1':\n  robot: got 't1'.*\n  period: got 0.015 s"):
        load_policy(path, G1)


@pytest.mark.parametrize("fits", [True, False])
def test_command_line(tmp_path, capsys, monkeypatch, fits):
    monkeypatch.setenv("COLUMNS", "200")
    document = {**tiny_policy.document(G1), **({} if fits else {"kp": [400.0] * 29})}
    path = str(tiny_policy.write(tmp_path / "tiny.onnx", tiny_policy.model(G1), document))
    assert cli.main(["check", path, "--robot", "g1"]) == (0 if fits else 1)
    out = capsys.readouterr().out
    assert all(
        words in out
        for words in ("policy tiny", "left_knee_joint", "joint_pos_target", "stand (default)", "3 sequences")
    )
    assert "'tiny' fits g1" in out if fits else "kp.left_knee_joint" in out and "raise kp_max" in out
    assert cli.main(["check", path, "--robot", "g1", "--json"]) == (0 if fits else 1)
    answer = json.loads(capsys.readouterr().out)
    assert answer["contract"]["period"] == 0.02 and answer["golden_error"] < 1e-6
    assert [m["what"] for m in answer["mismatches"]][:1] == ([] if fits else ["kp.left_hip_pitch_joint"])
