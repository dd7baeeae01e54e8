"""``sim2real log`` on a real record: a G1 in lockstep, whose left knee's motor falls silent on the way."""

from __future__ import annotations

import csv
import html.parser
import json
import re
from pathlib import Path

import numpy as np
import pytest
import tiny_policy
import yaml
from recorded import JOINTS, LAYOUTS, random_walk, write_record

from sim2real import cli
from sim2real.config import ConfigError, load_robot
from sim2real.guardian import Guardian
from sim2real.operators.script import ScriptOperator, Step
from sim2real.policy import load_policy
from sim2real.recorder.plot import page, write_plot
from sim2real.recorder.process import Recorder, Sink
from sim2real.recorder.reader import Reader
from sim2real.recorder.replay import replay
from sim2real.recorder.run import Run, spans
from sim2real.recorder.summary import summarise
from sim2real.recorder.svg import bounds, path, text, thin, ticks
from sim2real.records import Calls, layout
from sim2real.simulation import Scene, Simulation
from sim2real.skills import SkillPlayer
from sim2real.types import Mode, Sim2realError

SILENT_AFTER = 0.5  # s of the policy, until the knee's motor loses power


@pytest.fixture(scope="module")
def tiny(tmp_path_factory) -> Path:
    robot = load_robot("g1")
    path = tmp_path_factory.mktemp("policy") / "tiny.onnx"
    return tiny_policy.write(path, tiny_policy.model(robot), tiny_policy.document(robot))


@pytest.fixture(scope="module")
def record(tiny, tmp_path_factory) -> Path:
    robot, policy = load_robot("g1"), load_policy(tiny)
    path = tmp_path_factory.mktemp("run") / "g1.mcap"
    recorders = []

    def sink_for(layouts) -> Sink:
        attachments = {"robot.yaml": robot.path.read_bytes(), "tiny.onnx": tiny.read_bytes()}
        recorders.append(Recorder(path, layouts, {"robot": "g1", "clock": "lockstep"}, attachments, patient=True))
        return recorders[0].sink

    def cut_power(simulation: Simulation) -> None:
        if simulation.since >= SILENT_AFTER and not cut:
            cut.append(simulation.world.time)
            simulation.world.inject("off:left_leg/left_knee_joint")

    cut: list[float] = []
    operator = ScriptOperator([Step("stand", 1.0)])
    with pytest.MonkeyPatch.context() as patch:  # a short run: every test below reads all of it
        patch.setattr(SkillPlayer, "gain_time", 0.1)
        patch.setattr(SkillPlayer, "move_time", 0.3)
        patch.setattr(Guardian, "damp_time", 0.1)
        Simulation(robot, [policy], operator, Scene(seed=3), sink_for=sink_for, each_tick=cut_power).run()
    assert cut
    recorders[0].close()
    return path


@pytest.fixture(scope="module")
def run(record) -> Run:
    return Run(record)


def log(capsys, *argv: object) -> tuple[int, str, str]:
    code = cli.main(["log", *map(str, argv)])
    return code, *capsys.readouterr()


# --- summary ---------------------------------------------------------------------------------------------------------


def test_summary_against_the_arrays(run):
    """Every figure, computed here the straightforward way."""
    s, tick = summarise(run), run.tick
    assert (s.ticks, s.policy_ticks) == (len(run.tick), len(run.pilot)) and s.ticks_missing == 0
    assert s.duration == tick["time"][-1] - tick["time"][0]
    robot = load_robot("g1")
    knee = robot.joint_names.index("left_knee_joint")
    squares, pos = [], []
    for row in tick:
        if row["mode"] <= Mode.HOLD and np.isfinite(row["state.joint_pos"][knee]):
            pos.append(row["state.joint_pos"][knee])
            if row["command.kp"][knee] > 0:
                squares.append((row["command.joint_pos"][knee] - row["state.joint_pos"][knee]) ** 2)
    joint = s.joints[knee]
    low, high = robot.joints[knee].position
    assert joint.tracking_rmse == pytest.approx(np.sqrt(sum(squares) / len(squares)))
    assert joint.margin == pytest.approx(min(min(pos) - low, high - max(pos)))
    assert joint.torque_max == np.nanmax(np.abs(tick["state.joint_torque"][:, knee]))
    assert joint.torque_share == joint.torque_max / robot.joints[knee].torque
    assert joint.temperature_max == np.nanmax(tick["state.joint_temperature"][:, knee])
    assert s.timing["read"]["max"] == tick["timing.read"].max()
    for i, bus in enumerate(s.buses):
        assert bus.name == run.buses[i] and bus.load_max == tick["bus.load"][:, i].max()
        assert (bus.sent, bus.received, bus.lost) == tuple(
            tick[f"bus.{k}"][-1, i] for k in ("sent", "received", "lost")
        )


def test_summary_names_the_fault_where_and_when(run):
    s = summarise(run)
    (fault,) = s.faults
    assert re.fullmatch(r"S2R-004 joint_age of left_knee_joint", fault)
    assert [m.name for m in s.modes] == ["OFF", "RUN", "DAMP", "OFF"]
    stand = next(p for p in s.skills if p.name == "stand")
    first = next(m for m in s.modes if m.fault)
    assert first.start - stand.start == pytest.approx(SILENT_AFTER + 0.05, abs=0.02)
    assert [p.name for p in s.skills][:3] == ["standby", "engage", "stand"]
    assert s.modes[0].start == 0.0 and s.modes[-1].end == s.duration
    assert all(a.end == b.start for a, b in zip(s.modes, s.modes[1:], strict=False))


def test_summary_on_the_command_line(record, capsys):
    code, out, _ = log(capsys, "summary", record)
    assert code == 0
    assert "S2R-004 joint_age of left_knee_joint" in out and "right_wrist_yaw_joint" in out
    code, out, _ = log(capsys, "summary", record, "--json")
    document = json.loads(out)
    assert code == 0 and document["faults"] == ["S2R-004 joint_age of left_knee_joint"]
    assert len(document["joints"]) == 29 and document["run"]["robot"] == "g1"


def test_spans():
    time = np.array([0.0, 1.0, 2.0, 3.0])
    assert spans(time, np.array([1, 1, 2, 1])) == [(0.0, 2.0, (1,)), (2.0, 3.0, (2,)), (3.0, 3.0, (1,))]
    assert spans(time[:1], np.array([5])) == [(0.0, 0.0, (5,))]


@pytest.fixture
def rubbish(tmp_path) -> Path:
    """A record in which every number is a random one, NaN and infinity among them, and no robot file."""
    arrays = {topic: random_walk(layout, 700) for topic, layout in LAYOUTS.items()}
    return write_record(tmp_path / "rubbish.mcap", arrays, metadata={"robot": "x"})


def test_rubbish_is_summarised_and_drawn(rubbish, capsys):
    """A report on a broken robot must not break."""
    assert log(capsys, "summary", rubbish)[0] == 0
    assert json.loads(log(capsys, "summary", rubbish, "--json")[1])["joints"][0]["margin"] is None
    assert log(capsys, "plot", rubbish)[0] == 0
    assert "NaN" not in rubbish.with_suffix(".html").read_text().replace(JOINTS[0], "")


# --- plot ------------------------------------------------------------------------------------------------------------


class Page(html.parser.HTMLParser):
    """Collects tags, attributes and text, and checks that tags close in order."""

    def __init__(self, content: str):
        super().__init__()
        self.tags: list[tuple[str, dict]] = []
        self.words: list[str] = []
        self._open: list[str] = []
        self.feed(content)
        assert self._open == []

    def handle_startendtag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))

    def handle_starttag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))
        if tag not in ("meta", "br"):
            self._open.append(tag)

    def handle_endtag(self, tag):
        assert self._open.pop() == tag

    def handle_data(self, data):
        self.words.append(data)


def test_the_page_needs_nothing_else(run):
    content = page(run)
    document = Page(content)
    names = [tag for tag, _ in document.tags]
    assert not {"script", "link", "iframe", "img", "object", "form", "a"} & set(names)
    links = [v for _, attrs in document.tags for k, v in attrs.items() if k in ("href", "src", "xlink:href")]
    assert links and all(v.startswith("data:image/png;base64,") for v in links)
    assert "url(" not in content and "http:" not in content and "https:" not in content
    assert "prefers-color-scheme: dark" in content
    assert "nan" not in "".join(a.get("d", "") + a.get("x", "") for _, a in document.tags)
    shown = " ".join(document.words)
    for word in (*run.joints, *run.buses, "S2R-004 joint_age", "RUN", "DAMP", "stand"):
        assert word in shown


HOSTILE = "<script>alert(1)</script>\"><img src=x onerror=alert(1)>\x1b[31m' onload=alert(1) &amp;"


def test_hostile_names_stay_text(tmp_path, capsys):
    """From a policy's labels, a robot's joints, a bus, and the run's own words."""
    from sim2real.records import pilot_layout, tick_layout

    layouts = {
        "/tick": tick_layout((HOSTILE, "b"), (HOSTILE,)),
        "/pilot": pilot_layout((HOSTILE, "b"), {"x": ("y",)}, (HOSTILE,)),
    }
    arrays = {topic: random_walk(layout, 50) for topic, layout in layouts.items()}
    arrays["/pilot"]["stage"], arrays["/pilot"]["skill"] = 2, 0
    arrays["/tick"]["fault"], arrays["/tick"]["fault_joint"], arrays["/tick"]["mode"] = 4, 0, 2
    metadata = {"robot": HOSTILE, "started": HOSTILE, "skills": HOSTILE, HOSTILE: "x"}
    path = write_record(tmp_path / "hostile.mcap", arrays, layouts, metadata, {"robot.yaml": HOSTILE.encode()})
    content = page(Run(path))
    document = Page(content)
    assert not {"script", "img"} & {tag for tag, _ in document.tags}
    assert not [k for _, attrs in document.tags for k in attrs if k.startswith("on")]
    assert "\x1b" not in content
    assert any("<script>alert(1)</script>" in word for word in document.words)  # shown, as text
    assert "script-src" not in content and "default-src &#x27;none&#x27;" in content
    code, out, _ = log(capsys, "summary", path)
    assert code == 0 and "\x1b[31m" not in out and "<script>" in out
    code, _, err = log(capsys, "replay", path)
    assert code == 2 and "\x1b[31m" not in err


def test_text_is_safe_anywhere():
    assert text("<a b=\"c\" d='e'>&\x00\x1b\u202e") == "&lt;a b=&quot;c&quot; d=&#x27;e&#x27;&gt;&amp;"


def test_a_minute_of_29_joints_stays_small(tmp_path):
    """60 s at 250 Hz of the worst to draw, noise: under 1.5 MB."""
    from sim2real.records import tick_layout

    names = load_robot("g1").joint_names
    layouts = {"/tick": tick_layout(names, ("left_leg", "right_leg", "waist", "left_arm", "right_arm"))}
    rows = np.zeros(15_000, layouts["/tick"].dtype)
    rng = np.random.default_rng(0)
    for field in rows.dtype.names or ():
        if rows.dtype[field].base.kind == "f":
            rows[field] = rng.normal(size=rows[field].shape)
    rows["time"], rows["tick"] = np.arange(15_000) / 250, np.arange(15_000)
    robot = load_robot("g1").path.read_bytes()
    run = Run(write_record(tmp_path / "long.mcap", {"/tick": rows}, layouts, attachments={"robot.yaml": robot}))
    assert len(page(run).encode()) < 1_500_000


def test_thinning_keeps_every_extreme():
    time, values = np.arange(10_000.0), np.random.default_rng(0).normal(size=10_000)
    values[777], values[4242], values[5000:5100] = 50.0, -60.0, np.nan
    t, v = thin(time, values, 100)
    assert len(t) <= 200 and (np.diff(t) > 0).all()
    assert 50.0 in v and -60.0 in v and np.isnan(v).any()
    for a, b in zip(range(0, 10_000, 100), range(100, 10_001, 100), strict=True):
        stretch = values[a:b][np.isfinite(values[a:b])]
        if 200 < a < 9800 and len(stretch) == 100:  # edges fall between samples: compare with the neighbours' extremes
            near = v[(t >= a - 100) & (t < b + 100)]
            assert np.nanmax(near) >= stretch.max() and np.nanmin(near) <= stretch.min()


def test_lines_break_where_nothing_is_known():
    assert path(np.arange(5.0), np.array([1.0, 2.0, np.nan, 3.0, np.inf])) == "M0 1L1 2M3 3"
    assert path(np.arange(2.0), np.full(2, np.nan)) == ""


@pytest.mark.parametrize(
    ("low", "high", "expected"),
    [(0, 10, [0, 2, 4, 6, 8, 10]), (-0.3, 0.32, [-0.3, -0.2, -0.1, 0, 0.1, 0.2, 0.3]), (1, 1, [1]), (np.nan, 1, [])],
)
def test_ticks(low, high, expected):
    assert ticks(low, high) == pytest.approx(expected)


def test_bounds_of_nothing():
    assert bounds(np.full(3, np.nan)) == pytest.approx((-0.0005, 0.0005))


# --- replay ----------------------------------------------------------------------------------------------------------


def test_a_run_replays_exactly(run, record, capsys):
    result = replay(run, tolerance=0.0, policy_tolerance=0.0)
    assert result.identical and result.first == [] and result.notes == []
    assert result.ticks == len(run.tick)
    assert result.policy_steps == (run.pilot["stage"] == 2).sum() > 20
    code, out, _ = log(capsys, "replay", record)
    assert code == 0 and out.startswith("identical: ")


def altered(record: Path, tmp_path: Path, change) -> Path:
    """The record with ``change(tick, pilot)`` done to copies of its arrays."""
    reader = Reader(record)
    arrays = {topic: reader[topic].copy() for topic in reader.topics}
    change(arrays["/tick"], arrays["/pilot"])
    path = tmp_path / "altered.mcap"
    return write_record(path, arrays, reader.layouts, reader.metadata, reader.attachments)


def test_a_stricter_robot_changes_verdicts(record, tmp_path, capsys):
    document = yaml.safe_load(load_robot("g1").path.read_text())
    document["safety"]["velocity_max_ratio"] = 0.02
    stricter = tmp_path / "g1.yaml"
    stricter.write_text(yaml.safe_dump(document))
    result = replay(Run(record), load_robot(stricter))
    assert {"mode", "fault", "command.kp"} <= set(result.changed)
    assert result.first[0].what == "mode" and (result.first[0].was, result.first[0].now) == ("RUN", "DAMP")
    code, out, _ = log(capsys, "replay", record, "--robot", stricter, "--show", 3)
    assert code == 1 and "CHANGED" in out and re.search(r"fault .*was none, is now S2R-009 joint_velocity", out)
    assert replay(Run(record), load_robot(stricter), keep=1).first == result.first[:1]


def test_a_changed_command_is_found_by_joint_and_time(record, tmp_path):
    def change(tick, pilot):
        tick["command.joint_pos"][300, 7] += 1e-5

    run = Run(altered(record, tmp_path, change))
    (found,) = replay(run).first
    assert (found.what, found.where, found.time) == ("command.joint_pos", run.joints[7], run.time[300])
    assert replay(run, tolerance=1e-4).identical


def test_a_changed_target_is_found(record, tmp_path):
    def change(tick, pilot):
        pilot["command.joint_pos"][np.flatnonzero(pilot["stage"] == 2)[10], 2] += 0.01

    run = Run(altered(record, tmp_path, change))
    (found,) = replay(run).first
    assert (found.what, found.where, found.time) == (
        "joint_pos_target",
        run.joints[2],
        run.pilot_time[np.flatnonzero(run.pilot["stage"] == 2)[10]],
    )


def test_every_input_of_the_gate_matters(record, tmp_path):
    """Without an edge, or with another state, the replay is another: nothing is compared with itself."""

    def not_armed(tick, pilot):
        tick["calls"][:] = 0

    def hot(tick, pilot):
        tick["state.joint_temperature"][200:, 5] = 150.0

    def silent(tick, pilot):
        tick["request.time"][:] = 0.0

    def stopped_by_a_bus(tick, pilot):
        tick["calls"][200] = Calls.STOP_AFTER

    for change in (not_armed, hot, silent, stopped_by_a_bus):
        assert "mode" in replay(Run(altered(record, tmp_path, change))).changed
        (tmp_path / "altered.mcap").unlink()


def test_another_policy_changes_targets(record, tiny, tmp_path, capsys):
    robot = load_robot("g1")
    document = tiny_policy.document(robot)
    graph = tiny_policy.model(robot)
    for tensor in graph.graph.initializer:
        if tensor.name == "default":
            tensor.CopyFrom(
                tiny_policy.onnx.numpy_helper.from_array(robot.home_pos[None].astype("f4") + 0.5, "default")
            )
    for golden in document["golden"]:
        golden["outputs"]["joint_pos_target"] = (np.array(golden["outputs"]["joint_pos_target"]) + 0.5).tolist()
    other = tiny_policy.write(tmp_path / "other.onnx", graph, document)
    code, out, _ = log(capsys, "replay", record, "--policy", other)
    assert code == 1 and re.search(r"joint_pos_target: changed in \d+ ticks, by up to 0.5", out)
    code, _, err = log(capsys, "replay", record, "--policy", tiny, other)
    assert code == 2 and "got 2 files, expected 1" in err
    document["skills"] = [{"label": "sit"}]
    document["default_skill"] = "sit"
    code, _, err = log(capsys, "replay", record, "--policy", tiny_policy.write(tmp_path / "sit.onnx", graph, document))
    assert code == 2 and "skill_labels: got ('sit',), expected ('stand',)" in err


def sealed(path: Path, name: str, skill: str, default: float) -> Path:
    """A tiny policy of another name and skill, around another posture, that also says what it expects."""
    robot = load_robot("g1")
    text = tiny_policy.TEXT.replace("carry_count_next) {{", "carry_count_next, float[1,1] skill_value) {{").replace(
        "moved = Add", "skill_value = Mul (carry_count, rate)\n    moved = Add"
    )
    graph, document = tiny_policy.model(robot, text), tiny_policy.document(robot)
    for tensor in graph.graph.initializer:
        if tensor.name == "default":
            posture = robot.home_pos[None].astype("f4") + np.float32(default)
            tensor.CopyFrom(tiny_policy.onnx.numpy_helper.from_array(posture, "default"))
    for golden in document["golden"]:
        golden["outputs"]["joint_pos_target"] = (np.array(golden["outputs"]["joint_pos_target"]) + default).tolist()
    document |= {"name": name, "skills": [{"label": skill}], "default_skill": skill}
    document["outputs"]["skill_value"] = [1]
    return tiny_policy.write(path, graph, document)


@pytest.mark.slow
def test_two_policies_replay_through_their_blends(tmp_path):
    """Switches there and back: each policy starts over, targets blend, and values are compared, too."""
    robot = load_robot("g1")
    files = [sealed(tmp_path / "a.onnx", "a", "stand", 0.0), sealed(tmp_path / "b.onnx", "b.c", "lean", 0.02)]
    policies = [load_policy(path) for path in files]
    path = tmp_path / "two.mcap"
    recorders = []

    def sink_for(layouts) -> Sink:
        attachments = {"robot.yaml": robot.path.read_bytes(), **{f.name: f.read_bytes() for f in files}}
        recorders.append(Recorder(path, layouts, {}, attachments, patient=True))
        return recorders[0].sink

    steps = [Step("stand", 0.4), Step("lean", 0.4), Step("stand", 0.2)]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(SkillPlayer, "gain_time", 0.1)
        patch.setattr(SkillPlayer, "move_time", 0.3)
        patch.setattr(Guardian, "damp_time", 0.1)
        Simulation(robot, policies, ScriptOperator(steps), Scene(seed=3), sink_for=sink_for).run()
    recorders[0].close()
    run = Run(path)
    performed = [s.value[1] for s in run.skills() if s.value[0] == 2]
    assert performed == [0, 1, 0]
    assert summarise(run).refused_switches == run.pilot["refused"][-1]
    assert replay(run, tolerance=0.0, policy_tolerance=0.0).identical

    def value(tick, pilot):
        pilot["skill_value"][np.flatnonzero(pilot["skill"] == 1)[5], 1] += 0.5

    arm = run.joints.index("left_elbow_joint")

    def blended(tick, pilot):
        pilot["command.joint_pos"][np.flatnonzero(pilot["skill"] == 1)[5], arm] += 0.01

    for change, what, where in ((value, "skill_value", "lean"), (blended, "joint_pos_target", run.joints[arm])):
        (found,) = replay(Run(altered(path, tmp_path, change))).first
        assert (found.what, found.where) == (what, where)
        (tmp_path / "altered.mcap").unlink()


def test_lost_ticks_are_said(record, tmp_path):
    reader = Reader(record)
    arrays = {topic: reader[topic] for topic in reader.topics}
    arrays["/tick"] = np.delete(arrays["/tick"], [100, 101, 200])
    run = Run(write_record(tmp_path / "gaps.mcap", arrays, reader.layouts, {}, reader.attachments))
    assert replay(run).notes == ["3 ticks are not in the record; a change behind a gap may come from it"]
    assert summarise(run).ticks_missing == 3


def test_what_cannot_be_replayed_says_why(record, tmp_path):
    reader = Reader(record)
    arrays = {topic: reader[topic] for topic in reader.topics}
    robot = {"robot.yaml": reader.attachments["robot.yaml"]}

    def run(name: str, attachments: dict) -> Run:
        return Run(write_record(tmp_path / name, arrays, reader.layouts, {}, attachments))

    with pytest.raises(ConfigError, match="no robot.yaml in the record"):
        replay(run("a.mcap", {}))
    with pytest.raises(Sim2realError, match="no policy file in the record"):
        replay(run("b.mcap", robot))
    with pytest.raises(ConfigError, match="its robot.yaml: (?s:.*)nam: unknown key"):
        replay(run("c.mcap", {"robot.yaml": b"nam: g1"}))
    other = load_robot("g1").model_copy(update={"joints": load_robot("g1").joints[::-1]})
    with pytest.raises(ConfigError, match="joint 'left_hip_pitch_joint' where g1 has 'right_wrist_yaw_joint'"):
        replay(Run(record), type(other).model_validate(other.model_dump()))


# --- repair, export, and what is no record ---------------------------------------------------------------------------


def test_a_cut_record_is_repaired_and_replays(record, tmp_path, capsys):
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(record.read_bytes()[: record.stat().st_size * 2 // 3])
    for command in ("summary", "plot", "replay"):
        code, out, err = log(capsys, command, cut)
        assert (code, out) == (2, "") and "damaged: " in err and f"sim2real log repair {cut}" in err
    code, out, _ = log(capsys, "repair", cut, "-o", tmp_path / "whole.mcap")
    assert code == 0 and re.search(r"saved \d+ of /tick, \d+ of /pilot", out.replace("\n", " "))
    code, out, _ = log(capsys, "replay", tmp_path / "whole.mcap")
    assert code == 0 and "identical" in out


@pytest.mark.parametrize("command", ["summary", "plot", "replay", "repair"])
def test_no_record(command, tmp_path, capsys):
    for name, content, message in (
        ("absent", None, "cannot read: No such file or directory"),
        ("empty", b"", "an empty file, expected an MCAP record"),
        ("text", b"# notes\n", "not a record: got a file that starts with b'# notes"),
    ):
        path = tmp_path / name
        if content is not None:
            path.write_bytes(content)
        code, out, err = log(capsys, command, path)
        assert (code, out) == (2, "") and message in err and "Traceback" not in err


def test_a_record_without_ticks(tmp_path, capsys):
    path = write_record(tmp_path / "none.mcap", {topic: random_walk(x, 0) for topic, x in LAYOUTS.items()})
    code, _, err = log(capsys, "summary", path)
    assert code == 2 and "no tick in it" in err
    only_pilot = {"/pilot": LAYOUTS["/pilot"]}
    path = write_record(tmp_path / "p.mcap", {"/pilot": random_walk(LAYOUTS["/pilot"], 9)}, only_pilot)
    code, _, err = log(capsys, "summary", path)
    assert code == 2 and "without a guardian's ticks; it has /pilot" in err


def test_a_record_of_another_version(tmp_path, capsys):
    fields = [(n, "f8", None) for n in ("time", "tick", "mode")]
    old = layout("Tick", [*fields, ("state.joint_pos", "f8", ("a",)), ("bus.load", "f8", ("b",))])
    path = write_record(tmp_path / "old.mcap", {"/tick": random_walk(old, 9)}, {"/tick": old})
    code, _, err = log(capsys, "summary", path)
    assert code == 2 and "recorded by another version of sim2real: its ticks have no 'bus.lost', 'bus.received'" in err


def test_plot_says_where(record, tmp_path, capsys):
    code, out, _ = log(capsys, "plot", record, "-o", tmp_path / "r.html")
    assert code == 0 and out.strip() == str(tmp_path / "r.html")
    with pytest.raises(Sim2realError, match="cannot write: No such file"):
        write_plot(Run(record), tmp_path / "no" / "r.html")


def test_export(record, run, tmp_path, capsys):
    assert log(capsys, "export", record, "-o", tmp_path / "run.npz")[0] == 0
    with np.load(tmp_path / "run.npz") as arrays:
        assert arrays["tick/state.joint_pos"].tobytes() == np.ascontiguousarray(run.tick["state.joint_pos"]).tobytes()
        assert tuple(arrays["tick/state.joint_pos.names"]) == run.joints
    assert log(capsys, "export", record, "-o", tmp_path / "run.csv")[0] == 0
    with (tmp_path / "run-tick.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == len(run.tick)
    assert float(rows[300]["state.joint_pos.left_knee_joint"]) == run.tick["state.joint_pos"][300, 3]
    code, _, err = log(capsys, "export", record, "-o", tmp_path / "run.xls")
    assert code == 2 and "got '.xls', expected one of .npz, .csv" in err
