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

from drivers.bus import BusError
from drivers.sim.socket_wire import WorldRemote
from sim2real.config import load_robot
from sim2real.launch import Launch
from sim2real.operators.script import ScriptOperator, Step
from sim2real.policy import load_policy
from sim2real.skills import SkillPlayer
from sim2real.types import Mode

PROMISE = 0.1  # s, SAFETY.md sentence 2

pytestmark = pytest.mark.slow


@pytest.fixture
def launch(tmp_path):
    """A G1 that will hold its home posture on the gantry for long."""
    robot = load_robot("g1")
    file = tiny_policy.write(tmp_path / "tiny.onnx", tiny_policy.model(robot), tiny_policy.document(robot))
    player = SkillPlayer(robot, [load_policy(file, robot, trial=0)])
    return Launch(robot, player, ScriptOperator([Step("stand", 60.0)]), hang=True, timeout=20.0)


def when_running(launch, act, after: float = 0.3):
    """Run ``act()`` in a thread once the robot obeys its policy's soft start."""

    def watch():
        while launch.mode != Mode.RUN:
            time.sleep(0.01)
        time.sleep(after)
        act()

    threading.Thread(target=watch, daemon=True).start()


def kill_and_watch(launch, name: str) -> dict:
    """Kill a process of a running launch; a moment later ask the motors what they did, on their own clock."""
    seen: dict = {}

    def act():
        world = WorldRemote(launch.directory / "world.sock")
        before = world.status()
        launch.children[name].process.kill()
        time.sleep(0.5)
        seen["slipped"] = world.status()["slipped"] - before["slipped"]
        safe = [e for e in world.motor_log if e.event in ("damping", "watchdog") and e.time > before["time"]]
        seen["after"] = {e.joint: e.time - before["time"] for e in reversed(safe)}  # the first of each joint
        seen["events"] = {e.event for e in safe}
        seen["first"] = {e.joint: e.event for e in reversed(safe)}
        seen["mode"] = launch.mode
        world.close()
        launch.children["guardian"].process.terminate()

    when_running(launch, act)
    seen["summary"] = launch.run()
    if seen["slipped"]:
        pytest.skip(f"this machine is too slow to judge: the simulated motors lost {seen['slipped']:.3f} s")
    return seen


def test_a_killed_pilot_leaves_every_motor_damping_in_time(launch):
    seen = kill_and_watch(launch, "pilot")
    assert seen["mode"] == Mode.DAMP and seen["events"] == {"damping"}
    assert any("S2R-018 command_age" in m or "S2R-017" in m for m in seen["summary"].messages)
    assert set(seen["after"]) == set(launch.config.joint_names)
    assert max(seen["after"].values()) < PROMISE


def test_a_killed_guardian_is_replaced_by_the_last_will(launch):
    seen = kill_and_watch(launch, "guardian")
    assert any("guardian: died" in m for m in seen["summary"].messages)
    assert not any("last will" in m for m in seen["summary"].messages)
    assert set(seen["first"].values()) == {"damping"}  # before any motor's own watchdog
    assert set(seen["after"]) == set(launch.config.joint_names)
    assert max(seen["after"].values()) < PROMISE


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
Launch(robot, player, ScriptOperator([Step("stand", 60.0)]), hang=True, timeout=20.0, show=show).run()
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
    with pytest.raises(BusError, match="can0"):
        launch.run()
