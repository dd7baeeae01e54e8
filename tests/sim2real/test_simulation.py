"""Whole runs in lockstep: a real policy through real bytes, the same bytes for the same seed, faults on the wire."""

from __future__ import annotations

import json
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import pytest
import tiny_policy

from sim2real.config import load_robot
from sim2real.operators.script import ScriptOperator, Step, parse_script
from sim2real.policy import load_policy
from sim2real.simulation import Scene, Simulation
from sim2real.types import Mode, Sim2realError


@pytest.fixture
def tiny(tmp_path, robot):
    """A policy that holds the home posture."""
    graph = tiny_policy.model(robot)
    return load_policy(tiny_policy.write(tmp_path / "tiny.onnx", graph, tiny_policy.document(robot)), trial=0)


def perform(robot, policy, seconds=1.0, each_tick=None, **scene):
    operator = ScriptOperator([Step(policy.contract.default_skill, seconds)])
    simulation = Simulation(robot, [policy], operator, Scene(**scene), each_tick=each_tick)
    return simulation.run(), simulation


def test_a_run_starts_silent_and_ends_switched_off(robot, tiny):
    modes = []
    summary, simulation = perform(robot, tiny, each_tick=lambda s: modes.append(int(s.guardian.record["mode"][0])))
    ladder = [m for i, m in enumerate(modes) if i == 0 or m != modes[i - 1]]
    assert ladder[:2] == [Mode.OFF, Mode.RUN] and ladder[-2:] == [Mode.DAMP, Mode.OFF]
    assert not simulation.world.motors.enabled.any()
    assert summary.ticks > 0 and summary.late_ticks == 0 and summary.frames_lost == 0


def test_the_same_seed_gives_the_same_bytes_and_another_seed_others(robot, tiny):
    same = [perform(robot, tiny, seed=3, faults=["drop:0.05"])[0].wire_sha256 for _ in range(2)]
    assert same[0] == same[1]
    assert perform(robot, tiny, seed=4, faults=["drop:0.05"])[0].wire_sha256 != same[0]


def test_a_robot_with_a_dead_motor_is_damped_and_says_which(robot, tiny):
    joint = robot.joint_names[0]
    bus = next(b.name for b in robot.wiring().buses if joint in [m.joint for m in b.motors])
    summary, simulation = perform(robot, tiny, faults=[f"off:{bus}/{joint}@4"])
    assert summary.faults and joint in summary.faults[0]
    assert any("not been heard" in m and joint in m for m in summary.messages)


class Hesitant(ScriptOperator):
    """Arms only a while after everything else is up."""

    def read(self, now, since):
        wish = super().read(now, since)
        return replace(wish, arm=wish.arm and now > 3.5)


def test_nothing_but_questions_is_sent_before_arming(robot, tiny):
    torque, enabled = [], []

    def look(simulation):
        if simulation.world.time < 3.5:
            torque.append(float(np.abs(simulation.world.plant.joint_torque).max()))
            enabled.append(bool(simulation.world.motors.enabled.any()))

    operator = Hesitant([Step(tiny.contract.default_skill, 0.2)])
    Simulation(robot, [tiny], operator, each_tick=look).run()
    assert len(torque) > 0.4 * robot.wiring().rate and max(torque) < 1e-9 and not any(enabled)


class Walk(NamedTuple):
    """A foreign policy in ``shared/policies``, and where its velocity in its maker's own simulation is recorded."""

    robot: str
    dialect: str
    source: str
    result: str


WALKS = {
    "unitree_rl_gym": Walk("g1", "unitree_rl_gym", "unitree_rl_gym_g1", "unitree_rl_gym_g1/result.json"),
    "holosoma ppo": Walk("t1", "holosoma", "holosoma_t1/ppo_t1_29dof.onnx", "holosoma_t1/result_ppo.json"),
    "holosoma fastsac": Walk("t1", "holosoma", "holosoma_t1/fastsac_t1_29dof.onnx", "holosoma_t1/result_fastsac.json"),
    "booster_gym": Walk("t1", "booster_gym", "booster_gym_t1", "booster_gym_t1/result.json"),
    "playground": Walk("t1", "playground", "playground_t1", "playground_t1/result.json"),
}


def walk(name, shared, tmp_path, **scene):
    from policies.adopt import adopt

    robot = load_robot(WALKS[name].robot)
    path = tmp_path / "walk.onnx"
    adopt(shared / "policies" / WALKS[name].source, WALKS[name].dialect, robot, path)
    policy = load_policy(path, robot, trial=0)
    operator = ScriptOperator([Step("walk", 20.0, (0.5, 0.0, 0.0))])
    return Simulation(robot, [policy], operator, Scene(**scene)).run()


@pytest.mark.slow
@pytest.mark.parametrize("name", WALKS)
def test_an_adopted_walk_keeps_its_recorded_velocity_through_the_bytes(name, shared, tmp_path):
    """One seed here; ``make bench`` runs five."""
    summary = walk(name, shared, tmp_path, seed=0)
    assert not summary.fell and not summary.faults
    recorded = json.loads((shared / "policies" / WALKS[name].result).read_text())["runs"]["forward_0.5"]
    assert summary.mean_velocity[0] == pytest.approx(recorded["mean_vx_body_after2s"], rel=0.05)


@pytest.mark.slow
def test_the_adopted_walk_survives_a_tenth_of_all_frames_dropped(shared, tmp_path):
    summary = walk("unitree_rl_gym", shared, tmp_path, seed=0, faults=["drop:0.1"])
    assert not summary.fell and not summary.faults


def test_a_script_reads_as_it_is_written():
    assert parse_script("stand:2, walk:5@0.5/0/-0.1") == [Step("stand", 2.0), Step("walk", 5.0, (0.5, 0.0, -0.1))]
    for text in ("stand", "stand:x", "walk:5@0.5", "walk:5@a/b/c"):
        with pytest.raises(Sim2realError, match="expected LABEL:SECONDS"):
            parse_script(text)


def test_a_script_arms_again_and_again_until_it_performs_and_never_after():
    operator = ScriptOperator([Step("a", 1.0), Step("b", 1.0)])
    asked = [operator.read(t / 8, -1.0).arm for t in range(48)]
    assert asked.count(True) == asked.count(False)
    assert operator.read(9.0, 0.5).skill == "a" and not operator.read(9.0, 0.5).arm
    assert operator.read(9.0, 1.5).skill == "b"
    assert operator.read(9.0, 2.0).quit
