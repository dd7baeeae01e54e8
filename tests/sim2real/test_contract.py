"""The contract as a document: every error says where, what it got and what it expected."""

from __future__ import annotations

import json

import pytest
import tiny_policy
from pydantic import ValidationError

from sim2real.config import explain, load_robot
from sim2real.contract import Contract

G1 = load_robot("g1")
DELETE = object()
SKILL_VALUE = {"outputs.skill_value": [1]}


def spoil(changes: dict) -> dict:
    """The tiny contract with values replaced at dotted paths."""
    document = tiny_policy.document(G1)
    for path, value in changes.items():
        *parents, last = [int(p) if p.isdigit() else p for p in path.split(".")]
        place = document
        for part in parents:
            place = place.setdefault(part, {}) if isinstance(place, dict) else place[part]
        if value is DELETE:
            del place[last]
        else:
            place[last] = value
    return document


def errors(changes: dict) -> str:
    try:
        Contract.model_validate_json(json.dumps(spoil(changes)), strict=True)
    except ValidationError as error:
        return explain("tiny", error, Contract)
    return ""


def test_the_document_is_right():
    assert errors({}) == ""


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"kp": DELETE}, "tiny: kp: missing"),
        (
            {"periode": 0.02},
            "tiny: periode: unknown key (did you mean 'period'?); expected one of schema_version, name",
        ),
        ({"skills.0.lable": "x"}, "tiny: skills[0].lable: unknown key (did you mean 'label'?)"),
        ({"provenance.license": "x"}, "tiny: provenance.license: unknown key (did you mean 'licence'?)"),
        ({"schema_version": 2}, "schema_version: got 2, expected 1"),
        ({"period": 0}, "period: got 0, expected greater than 0"),
        ({"period": float("nan")}, "period: got nan"),
        ({"period": "0.02"}, "period: got '0.02', expected a valid number"),
        ({"kp.3": -1.0}, "kp[3]: got -1.0"),
        ({"kd": [1.0]}, "kd: got 1 numbers, expected 29, one per joint"),
        ({"default_joint_pos": []}, "default_joint_pos: got 0 numbers, expected 29"),
        ({"action_scale": [0.25]}, "action_scale: got 1 numbers, expected 29"),
        ({"joint_names.1": G1.joint_names[0]}, "joint_names: a name appears twice"),
        ({"joint_names": []}, "joint_names: got []"),
        ({"name": "../x"}, "name: got '../x'"),
        ({"robot": "g1\n"}, "robot: got 'g1\\n'"),
        ({"skills": []}, "skills: got []"),
        ({"skills.0.next": ["run"]}, "'stand' leads to 'run'"),
        ({"default_skill": "walk"}, "default_skill: got 'walk', expected one of ['stand']"),
        ({"skills.0.value_min": 0.5}, "skills: ['stand'] have a value_min, expected an output 'skill_value'"),
        ({"outputs.skill_value": [2]}, "outputs: 'skill_value' has shape [2], expected [1]"),
        ({"inputs.joint_torque": [29]}, "inputs: got 'joint_torque', expected one of ['angular_velocity_base_in_base'"),
        ({"inputs.joint_pos": [12]}, "inputs: 'joint_pos' has shape [12], expected [29]"),
        ({"outputs.torque": [29]}, "outputs: got 'torque', expected one of"),
        ({"outputs.joint_pos_target": DELETE}, "outputs: no 'joint_pos_target'"),
        ({"inputs.carry_x": [1]}, "carry: nothing says how ['carry_x'] start"),
        ({"carry.carry_x": {"shape": [1]}}, "carry: 'carry_x' needs the input 'carry_x' and the output 'carry_x_next'"),
        ({"carry.carry_count.shape": [2]}, "carry: 'carry_count' has shape [1] in the graph, [2] declared"),
        ({"carry.carry_count.start": [0.0, 0.0]}, "carry: 'carry_count' starts from 2 numbers, expected 1 or none"),
        ({f"hold.{G1.joint_names[2]}": {"position": 0, "kp": 1, "kd": 1}}, "are in target_joint_names too"),
        ({"command_velocity_min": [0.0, 0.1, 0.0]}, "command_velocity_max: got 0.0 below the minimum 0.1"),
        ({"quaternion_order": "xyzw"}, "quaternion_order: got 'xyzw', expected 'wxyz'"),
        ({"envelope.skill": {"min": [], "max": [], "mean": [], "std": []}}, "envelope: got 'skill', expected one of"),
        (
            {"envelope.joint_pos": {"min": [0], "max": [], "mean": [], "std": []}},
            "envelope.joint_pos.min: got 1 numbers",
        ),
        ({"golden": []}, "golden: got []"),
        ({"golden_tolerance": 1.0}, "golden_tolerance: got 1.0, expected less than or equal to 0.001"),
        ({"golden.0.inputs": {}}, "golden[0].inputs: got [], expected ['joint_pos']"),
        ({"golden.1.outputs": {}}, "golden[1].outputs: got [], expected joint_pos_target"),
        ({"golden.2.outputs.torque": []}, "golden[2].outputs: got ['joint_pos_target', 'torque']"),
        ({"golden.0.steps": 19}, "golden[0].inputs.joint_pos: expected 19 rows of 29 numbers"),
        ({"golden.0.inputs.joint_pos.7": [0.0]}, "golden[0].inputs.joint_pos: expected 20 rows of 29 numbers"),
    ],
    ids=str,
)
def test_errors(changes, words):
    found = errors(changes)
    assert words in found, found


def test_every_signal_says_its_unit_kind_and_meaning():
    from sim2real.contract import INPUTS, OUTPUTS

    for name, signal in {**INPUTS, **OUTPUTS}.items():
        assert signal.unit and signal.meaning and signal.kind.count("/") >= 1, name
