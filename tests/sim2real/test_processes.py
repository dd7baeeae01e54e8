"""Whole runs in real time, as processes: what happens when one of them is killed, measured on the motors' side.

Killed is SIGKILL: nothing gets a chance to clean up. "Damping" is what the emulated motor was last told to do (kp 0,
kd > 0); "stopped" is what its own firmware did when nobody told it anything any more.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time

import pytest
import tiny_policy
from source import ROOT

from drivers.sim.socket_wire import WorldRemote
from sim2real.config import load_robot
from sim2real.launch import Launch
from sim2real.operators.script import ScriptOperator, Step
from sim2real.policy import load_policy
from sim2real.skills import SkillPlayer
from sim2real.types import Mode, Sim2realError

PROMISE = 0.1  # s, SAFETY.md sentence 2

pytestmark = pytest.mark.slow


@pytest.fixture
def launch(tmp_path):
    """A G1 that will hold its home posture on the gantry for long."""
    robot = load_robot("g1")
    file = tiny_policy.write(tmp_path / "tiny.onnx", tiny_policy.model(robot), tiny_policy.document(robot))
    player = SkillPlayer(robot, [load_policy(file, robot, trial=0)])
    return Launch(robot, player, ScriptOperator([Step("stand", 60.0)]), gantry=False, timeout=20.0)


def when_running(launch, act, after: float = 0.3):
    """Run ``act()`` in a thread once the robot obeys its policy's soft start."""

    def watch():
        while launch.mode != Mode.RUN:
            time.sleep(0.01)
        time.sleep(after)
        act()

    threading.Thread(target=watch, daemon=True).start()


def look(launch, seen):
    """The motors' own log, on the launcher's clock."""
    world = WorldRemote(launch.directory / "world.sock")
    seen["log"], seen["epoch"] = world.motor_log, launch.clock.now() - world.time
    world.close()


def test_a_killed_pilot_leaves_every_motor_damping_in_time(launch):
    seen = {}

    def kill():
        seen["killed"] = launch.clock.now()
        launch.children["pilot"].process.kill()
        time.sleep(0.4)
        seen["mode"] = launch.mode
        look(launch, seen)
        launch.children["guardian"].process.terminate()

    when_running(launch, kill)
    summary = launch.run()
    assert seen["mode"] == Mode.DAMP
    assert any("command" in m and "S2R" in m for m in summary.messages)
    damped = {e.joint: e.time + seen["epoch"] for e in seen["log"] if e.event == "damping"}
    assert set(damped) == set(launch.config.joint_names)
    late = {j: t - seen["killed"] for j, t in damped.items() if t > seen["killed"]}
    assert set(late) == set(launch.config.joint_names)
    assert max(late.values()) < PROMISE


def test_a_killed_guardian_is_replaced_by_the_last_will(launch):
    seen = {}

    def kill():
        seen["killed"] = launch.clock.now()
        launch.children["guardian"].process.kill()
        time.sleep(0.4)
        look(launch, seen)

    when_running(launch, kill)
    summary = launch.run()
    assert any("guardian: died" in m for m in summary.messages)
    after = [e for e in seen["log"] if e.time + seen["epoch"] > seen["killed"]]
    safe = {
        e.joint: e.time + seen["epoch"] - seen["killed"] for e in reversed(after) if e.event in ("damping", "watchdog")
    }
    assert set(safe) == set(launch.config.joint_names)
    assert max(safe.values()) < PROMISE


RUN = """
import sys, json
from pathlib import Path
sys.path[:0] = [{root!r}, {root!r} + "/tests"]
import tiny_policy
from sim2real.config import load_robot
from sim2real.launch import Launch
from sim2real.operators.script import ScriptOperator, Step
from sim2real.policy import load_policy
from sim2real.skills import SkillPlayer
robot = load_robot("g1")
file = Path({file!r})
player = SkillPlayer(robot, [load_policy(file, robot, trial=0)])
shown = []
def show(launch):
    print(json.dumps({{"mode": launch.mode.name, "directory": str(launch.directory),
                       "pids": {{k: c.process.pid for k, c in launch.children.items()}}}}), flush=True)
Launch(robot, player, ScriptOperator([Step("stand", 60.0)]), gantry=False, timeout=20.0, show=show).run()
"""


def test_when_launcher_and_guardian_are_killed_the_motors_stop_by_themselves(tmp_path):
    """Only the world is left: this is what the motors' own watchdogs, programmed while connecting, are for. A Damiao
    motor disables itself then; it does not damp (SAFETY.md)."""
    import json

    robot = load_robot("g1")
    file = tiny_policy.write(tmp_path / "tiny.onnx", tiny_policy.model(robot), tiny_policy.document(robot))
    code = RUN.format(root=str(ROOT), file=str(file))
    process = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True)
    try:
        running, state = 0, {}
        for line in process.stdout:
            state = json.loads(line)
            running += state["mode"] == "RUN"
            if running >= 5:
                break
        world = WorldRemote(os.path.join(state["directory"], "world.sock"))
        os.kill(state["pids"]["world"], 0)
        os.kill(process.pid, signal.SIGSTOP)  # the launcher can execute no last will, but its pipes stay open
        os.kill(state["pids"]["guardian"], signal.SIGKILL)
        time.sleep(0.5)
        last, log = world.last_command_times(), world.motor_log
    finally:
        process.kill()
        process.wait()
    stopped = {e.joint: e.time for e in log if e.event == "watchdog"}
    assert set(stopped) == set(robot.joint_names)
    assert max(stopped[j] - last[j] for j in stopped) < PROMISE


def test_a_closed_launcher_ends_the_run_in_damping_then_off(launch):
    """SIGTERM to the guardian stands for it: the same path as end-of-file on its stdin."""
    when_running(launch, lambda: launch.children["guardian"].process.terminate())
    launch.run()
    assert launch.children["guardian"].process.returncode == 0
    assert launch.mode in (Mode.DAMP, Mode.OFF)


def test_a_robot_that_is_not_there_is_refused_and_nothing_moves(tmp_path):
    robot = load_robot("g1")
    file = tiny_policy.write(tmp_path / "tiny.onnx", tiny_policy.model(robot), tiny_policy.document(robot))
    player = SkillPlayer(robot, [load_policy(file, robot, trial=0)])
    launch = Launch(robot, player, ScriptOperator([Step("stand", 1.0)]), simulated=False)
    with pytest.raises(Sim2realError, match="can0"):
        launch.run()
