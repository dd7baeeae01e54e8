"""``sim2real deploy`` as a user types it: a whole run, and every way to ask for something wrong."""

from __future__ import annotations

import json

import pytest
import tiny_policy

from sim2real.cli import main
from sim2real.cli.deploy import Args, _operator, _unshown
from sim2real.config import CONFIG_DIR, load_robot
from sim2real.policy import load_policy
from sim2real.types import Sim2realError


@pytest.fixture
def deploy(monkeypatch, capsys, tmp_path):
    """Run the command; returns (exit code, what it printed to stdout, to stderr)."""

    def run(*argv: object) -> tuple[int, str, str]:
        monkeypatch.setattr("sys.argv", ["sim2real", "deploy", *map(str, argv)])
        try:
            code = main()
        except SystemExit as stop:
            code = stop.code
        said = capsys.readouterr()
        return code, said.out, said.err

    return run


@pytest.fixture
def policy(tmp_path):
    robot = load_robot("g1")
    return tiny_policy.write(tmp_path / "tiny.onnx", tiny_policy.model(robot), tiny_policy.document(robot))


def test_a_run_prints_and_writes_its_summary_and_its_record(deploy, policy, tmp_path):
    out = tmp_path / "out.json"
    arguments = ["--robot", "g1", "--policy", policy, "--skill", "stand", "--duration", "0.5", "--clock", "lockstep"]
    code, said, _ = deploy(*arguments, "--json", out, "--record", tmp_path / "records")
    summary = json.loads(out.read_text())
    assert code == int(bool(summary["fell"] or summary["faults"]))
    for key in ("fell", "distance", "mean_velocity", "ticks", "late_ticks", "faults", "joint_margin", "torque_max"):
        assert key in summary
    assert summary["record"].startswith(str(tmp_path / "records")) and summary["record"] in said.replace("\n", "")
    assert len(summary["wire_sha256"]) == 64 and summary["late_ticks"] == 0


WRONG = {
    "unknown robot": (["--robot", "g2"], "robots here:"),
    "unknown wiring": (["--robot", "g1", "--wiring", "cann"], "did you mean 'can'"),
    "absent policy": (["--robot", "g1", "--policy", "nowhere.onnx"], "nowhere.onnx"),
    "unknown skill": (["--robot", "g1", "--policy", "POLICY", "--skill", "stadn"], "did you mean 'stand'"),
    "bad script": (["--robot", "g1", "--policy", "POLICY", "--script", "stand"], "expected LABEL:SECONDS"),
    "both": (["--robot", "g1", "--policy", "POLICY", "--skill", "stand", "--script", "stand:1"], "expected one"),
    "unknown skills": (["--robot", "g1", "--skills", "basic"], "no skills 'basic' (did you mean 'basics'?)"),
    "no skills": (["--robot", "t1"], "give a policy with --policy FILE.onnx"),
    "skills and policy": (["--robot", "g1", "--skills", "basics", "--policy", "POLICY"], "expected one"),
    "sightings": (["--robot", "g1", "--sightings", "0.0.0.0:1"], "its own camera"),
    "a sight": (
        ["--robot", "g1", "--hardware", "--operator", "keyboard", "--sight", "capture"],
        "sends to --sightings",
    ),
    "no address": (["--robot", "g1", "--hardware", "--operator", "keyboard", "--sightings", "x"], "expected HOST:PORT"),
    "velocity of nothing": (["--robot", "g1", "--policy", "POLICY", "--velocity", "1", "0", "0"], "add --skill"),
    "lockstep hardware": (["--robot", "g1", "--hardware", "--clock", "lockstep"], "real time"),
    "faulty hardware": (
        ["--robot", "g1", "--hardware", "--operator", "keyboard", "--fault", "drop:0.1"],
        "only in simulation",
    ),
    "hung hardware": (["--robot", "g1", "--hardware", "--operator", "keyboard", "--hang"], "only in simulation"),
    "unknown fault": (
        ["--robot", "g1", "--policy", "POLICY", "--skill", "stand", "--clock", "lockstep", "--fault", "drp:0.1"],
        "drop",
    ),
    "keyboard in lockstep": (["--robot", "g1", "--operator", "keyboard", "--clock", "lockstep"], "realtime"),
    "no terminal": (["--robot", "g1", "--policy", "POLICY", "--operator", "keyboard"], "no terminal"),
    "unattended hardware": (["--robot", "g1", "--policy", "POLICY", "--hardware"], "a person arms"),
}


@pytest.mark.parametrize("case", WRONG)
def test_a_wrong_wish_gets_one_clear_message_and_nothing_moves(deploy, policy, case, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    arguments, expected = WRONG[case]
    code, _, err = deploy(*(policy if a == "POLICY" else a for a in arguments))
    assert code == 2
    assert expected in " ".join(err.split()) and "Traceback" not in err
    assert not (tmp_path / "runs").exists() or not list((tmp_path / "runs").glob("*.mcap"))


SPOILED = {
    "typo in a key": ("  - {name: left_hip_pitch_joint,", "  - {nmae: left_hip_pitch_joint,", "did you mean 'name'"),
    "NaN": ("velocity: 32", "velocity: .nan", "velocity"),
    "negative gain": ("kp_max: 200", "kp_max: -1", "kp_max: got -1"),
    "wrong length": ("position: [-2.5307, 2.8798]", "position: [-2.5307]", "position"),
    "turned range": ("position: [-2.5307, 2.8798]", "position: [2.8798, -2.5307]", "lower < upper"),
    "unwired joint": ("{joint: left_knee_joint, model", "{joint: left_hip_roll_joint, model", "left_knee_joint"),
    "no YAML": ("name: g1", "name: [g1", "not YAML"),
    "unknown motor": ("DM10010L, id: 1,", "DM10010X, id: 1,", "DM10010L"),
    "unknown protocol": ("protocol: damiao", "protocol: damio", "damiao"),
    "too fast": ("rate: 250", "rate: 1000", "6 motors at 1000 Hz need"),
}


@pytest.mark.parametrize("case", SPOILED)
def test_a_spoiled_robot_file_is_refused_with_its_path(deploy, tmp_path, case, policy):
    before, after, expected = SPOILED[case]
    text = (CONFIG_DIR / "g1.yaml").read_text()
    assert before in text
    (tmp_path / "g1.xml").write_text((CONFIG_DIR / "g1.xml").read_text())
    (tmp_path / "mine.yaml").write_text(text.replace(before, after, 1))
    code, _, err = deploy(
        "--robot", tmp_path / "mine.yaml", "--policy", policy, "--skill", "stand", "--clock", "lockstep"
    )
    assert code == 2
    assert expected in " ".join(err.split()) and "Traceback" not in err


def test_a_robot_without_a_policy_is_told_how_to_get_its_first(deploy, tmp_path):
    text = (CONFIG_DIR / "bench.yaml").read_text()
    begin, end = text.index("policies:"), text.index("default_wiring:")
    (tmp_path / "mine.yaml").write_text(text[:begin] + text[end:])
    code, _, err = deploy("--robot", tmp_path / "mine.yaml", "--clock", "lockstep")
    assert code == 2
    assert f"sim2real posture --robot {tmp_path / 'mine.yaml'}" in " ".join(err.split())


def test_what_a_robot_has_unshown_is_performed_only_where_it_is_asked_for():
    config = load_robot("g1")
    entry = config.policies["ball"]
    policy = load_policy(CONFIG_DIR.parents[1] / entry.file, config, trial=0)
    labels = list(policy.contract.skill_labels)
    ball = Args(robot="g1", skills="ball")
    unshown = _unshown(ball, config, labels)
    assert set(entry.unshown) == unshown < set(labels)
    shown = _operator(ball, labels, [policy], unshown).steps
    assert [s.skill for s in shown] == [x for x in labels if x not in unshown] + labels[:1]
    asked = _operator(Args(robot="g1", skill=entry.unshown[0]), labels, [policy], unshown).steps
    assert [s.skill for s in asked] == entry.unshown
    assert not _unshown(Args(robot="g1", policy=[policy.path]), config, labels), "a file of one's own is all shown"
    with pytest.raises(
        Sim2realError, match=rf"g1.yaml: .*unshown: got '{entry.unshown[0]}', expected one of hold, carry"
    ):
        _unshown(ball, config, labels[:2])
