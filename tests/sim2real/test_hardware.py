"""``deploy --hardware`` as processes in real time, with wires that lead out of the run: simulated motors served elsewhere."""

from __future__ import annotations

import json
import subprocess
import sys
import threading
import time
from dataclasses import asdict

import pytest
import tiny_policy
import yaml
from test_preflight import HARMLESS, changed, measured

from drivers.sim.socket_wire import WorldRemote
from sim2real.cli import main
from sim2real.config import CONFIG_DIR, load_robot
from sim2real.launch import Launch
from sim2real.operators.script import ScriptOperator, Step
from sim2real.policy import load_policy
from sim2real.skills import SkillPlayer
from sim2real.types import Mode, Sim2realError

pytestmark = pytest.mark.slow


@pytest.fixture
def bench(tmp_path):
    """The bench robot whose wires are sockets of a process that nobody here controls; its YAML, and that world."""
    document = yaml.safe_load((CONFIG_DIR / "bench.yaml").read_text())
    wiring = document["wirings"]["can"]
    wiring["buses"][0] |= {"interface": "sim", "channel": str(tmp_path / "arm.sock")}
    wiring["imu"] |= {"interface": "sim", "channel": str(tmp_path / "imu.sock")}
    (tmp_path / "bench.xml").write_text((CONFIG_DIR / "bench.xml").read_text())
    file = tmp_path / "bench.yaml"
    file.write_text(yaml.safe_dump(document))
    config = load_robot(file)
    wired = config.wiring()
    spec = {"model": str(config.model_path), "base": config.base, "buses": [asdict(b) for b in wired.bus_specs()],
            "imu": asdict(wired.imu_spec())}  # fmt: skip
    server = subprocess.Popen([sys.executable, "-m", "drivers.sim.serve", tmp_path], stdin=subprocess.PIPE,
                              stdout=subprocess.PIPE, text=True)  # fmt: skip
    server.stdin.write(json.dumps(spec))
    server.stdin.close()
    assert server.stdout.readline() == "ready\n"
    world = WorldRemote(tmp_path / "world.sock")
    yield config, world, server
    world.close()
    server.kill()
    server.wait()


def launch(config, tmp_path, calibration) -> Launch:
    policy = tiny_policy.write(tmp_path / "tiny.onnx", tiny_policy.model(config), tiny_policy.document(config))
    player = SkillPlayer(config, [load_policy(policy, config, trial=0)])
    path = tmp_path / "calibration.yaml"
    calibration.save(path)
    return Launch(config, player, ScriptOperator([Step("stand", 0.5)]), simulated=False, calibration=path, timeout=20.0)


def judge(world) -> None:
    """Skip what a machine that is too slow for real time cannot decide."""
    if slipped := world.status()["slipped"]:
        pytest.skip(f"this machine is too slow to judge: the simulated motors lost {slipped:.3f} s")


def test_a_robot_that_meets_every_demand_is_armed_and_runs(bench, tmp_path):
    config, world, _ = bench
    run = launch(config, tmp_path, measured(config, "can"))
    try:
        run.run()
        time.sleep(0.2)  # the last frames are still on their way
        events = [e.event for e in world.motor_log]
        assert "driving" in events and events.index("watchdog") < events.index("driving")
        assert events[-1] == "disabled"
    except (AssertionError, Sim2realError):
        judge(world)
        raise


def test_a_replaced_motor_is_refused_and_nothing_moved(bench, tmp_path):
    config, world, _ = bench
    run = launch(config, tmp_path, changed(measured(config, "can"), "elbow_joint", fingerprint="SN 9"))
    with pytest.raises(Sim2realError) as refused:
        run.run()
    if "expected SN 9" not in str(refused.value):
        judge(world)
    assert "elbow_joint: got motor SN 1002, expected SN 9" in str(refused.value)
    assert {e.event for e in world.motor_log} <= HARMLESS


def test_an_adapter_that_vanishes_damps_what_is_left_and_is_not_armed_again(bench, tmp_path):
    """Unplugged in mid-run: there is nobody left to talk to; the run says so, ends, and replays nothing."""
    config, world, server = bench
    run = launch(config, tmp_path, measured(config, "can"))

    def unplug():
        while run.mode != Mode.RUN:
            time.sleep(0.01)
        time.sleep(0.3)
        server.kill()
        time.sleep(0.5)
        seen.append(run.mode)
        run.children["guardian"].process.terminate()

    seen: list[Mode] = []
    threading.Thread(target=unplug, daemon=True).start()
    try:
        summary = run.run()
    except Sim2realError:
        judge(world)
        raise
    assert seen == [Mode.DAMP]
    assert any("the simulated robot has gone" in m for m in summary.messages)


def test_deploy_demands_the_calibration_file(bench, tmp_path, monkeypatch, capsys):
    config, world, _ = bench
    monkeypatch.chdir(tmp_path)
    policy = tiny_policy.write(tmp_path / "tiny.onnx", tiny_policy.model(config), tiny_policy.document(config))
    monkeypatch.setattr("sys.stdin.isatty", lambda: True, raising=False)
    monkeypatch.setattr("sim2real.operators.keyboard.KeyboardOperator", lambda labels: ScriptOperator([]))
    argv = ["deploy", "--robot", str(config.path), "--policy", str(policy), "--hardware", "--operator", "keyboard"]
    assert main(argv) == 2
    said = " ".join(capsys.readouterr().err.split())
    assert f"no file {tmp_path}/bringup/bench-can.calibration.yaml" in said and "sim2real calibrate" in said
    assert world.motor_log == []
