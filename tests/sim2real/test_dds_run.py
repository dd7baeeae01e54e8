"""A whole run of the factory G1's wiring in lockstep: the same runtime, with LowCmd and LowState under it."""

from __future__ import annotations

import pytest
import tiny_policy

from sim2real.config import load_robot
from sim2real.operators.script import ScriptOperator, Step
from sim2real.policy import load_policy
from sim2real.simulation import Scene, Simulation


@pytest.mark.parametrize(("faults", "expected"), [([], ""), (["off:body/left_knee_joint@3.4"], "left_knee_joint")])
def test_a_run_over_dds(tmp_path, faults, expected):
    robot = load_robot("g1")
    graph = tiny_policy.model(robot)
    policy = load_policy(tiny_policy.write(tmp_path / "tiny.onnx", graph, tiny_policy.document(robot)), trial=0)
    operator = ScriptOperator([Step(policy.contract.default_skill, 0.3)])
    simulation = Simulation(robot, [policy], operator, Scene(faults=faults), wiring="dds")
    summary = simulation.run()
    assert simulation.world.motors.controller == "" and not simulation.world.motors.enabled.any()
    assert bool(summary.faults) == bool(expected) and summary.late_ticks == 0
    assert all(expected in fault for fault in summary.faults[:1])
    assert {e.event for e in simulation.world.motor_log} >= {"enabled", "driving", "damping", "disabled"}
