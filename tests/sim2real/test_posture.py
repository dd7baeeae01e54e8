"""The policy that holds the home posture: what it writes, what is shipped, and ten seconds of it through every robot's wires."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from sim2real.cli import main
from sim2real.config import load_robot
from sim2real.operators.script import ScriptOperator, Step
from sim2real.policy import load_policy
from sim2real.posture import write_posture
from sim2real.simulation import Scene, Simulation

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture
def posture(tmp_path, robot):
    write_posture(robot, tmp_path / "posture.onnx")
    return load_policy(tmp_path / "posture.onnx", robot)


def test_it_holds_home_with_the_robot_file_s_gains_at_a_whole_number_of_ticks(robot, posture):
    np.testing.assert_allclose(posture.step({})["joint_pos_target"], robot.home_pos, atol=1e-6)
    contract = posture.contract
    assert contract.kp == robot.home_kp.tolist() and contract.kd == robot.home_kd.tolist()
    assert contract.inputs == {} and contract.skill_labels == ("home",)
    assert 1 / contract.period == pytest.approx(50.0) and contract.period * robot.wiring().rate == pytest.approx(
        round(contract.period * robot.wiring().rate)
    )


def test_what_is_shipped_is_what_is_written_today(robot, tmp_path):
    if "posture" not in robot.policies:
        pytest.skip("its YAML names none")
    write_posture(robot, tmp_path / "today.onnx")
    shipped = ROOT / robot.policies["posture"].file
    assert shipped.read_bytes() == (tmp_path / "today.onnx").read_bytes(), (
        f"home of {robot.name}.yaml changed: sim2real posture --robot {robot.name} -o {shipped}"
    )


def hold(robot, policy, seconds: float, **scene):
    """A run of so many seconds, and how far joints were from home at its end (n,) rad."""
    errors = []

    def look(simulation):
        if 0 <= simulation.since <= seconds - 0.1:  # afterwards it is damped
            errors.append(np.abs(simulation.guardian.record["state.joint_pos"][0] - robot.home_pos))

    operator = ScriptOperator([Step("home", seconds)])
    return Simulation(robot, [policy], operator, Scene(**scene), each_tick=look).run(), errors[-1]


@pytest.mark.slow
def test_ten_seconds_on_the_gantry_through_the_wires(robot, posture):
    summary, error = hold(robot, posture, 10.0, hang=True)
    assert not summary.faults and not summary.fell and not summary.refused_skills
    assert summary.duration > 9.9 and summary.frames_lost == 0 and summary.late_ticks == 0
    assert error.max() < 0.1  # rad: limbs hang on their gains


@pytest.mark.slow
def test_an_op3_stands_by_itself(tmp_path):
    """Short, light and with large feet: its ankles are stiffer than gravity."""
    op3 = load_robot("op3")
    summary, _ = hold(op3, load_policy(ROOT / op3.policies["posture"].file, op3), 10.0)
    assert summary.fell is False and not summary.faults and summary.duration > 9.9


def test_the_command_writes_a_file_and_says_what_is_next(tmp_path, capsys):
    file = tmp_path / "home.onnx"
    assert main(["posture", "--robot", "bench", "-o", str(file)]) == 0
    assert f"sim2real deploy --robot bench --policy {file}" in capsys.readouterr().out
    assert load_policy(file, load_robot("bench")).contract.name == "posture"
    assert main(["posture", "--robot", "bench", "-o", "/dev/full"]) == 2
    assert "No space left on device; expected a file that can be written" in capsys.readouterr().err
