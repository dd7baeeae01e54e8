"""``sim2real clips`` from the command line, on a made-up recording and on shipped clips."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
import pytest
from test_clips import standing, thrown

from policies.clips import commands, library
from policies.clips.feasibility import Residuals
from policies.clips.format import load_clip
from sim2real.cli import main

torch = pytest.importorskip("torch")
SHIPPED = library.library_path("g1").parent


@pytest.fixture
def data(tmp_path: Path) -> Path:
    """A data folder with one recording, of label 042: standing beside a ball that falls and bounces."""
    folder = tmp_path / "data"
    folder.mkdir()
    x = standing(70)
    x[:, 324:327] = thrown(70, speed=0.0) + [0.5, 0.0, 0.0]
    x[-1, 336] = 1
    torch.save(torch.tensor(x, dtype=torch.float32), folder / "999_fall.pt")
    columns = "path,set,skill,label,frames,has_contact,duplicate_of,sha256"
    (folder / "INDEX.csv").write_text(f"{columns}\n999_fall.pt,BallPlay-M,ball_falls,042,70,1,,0\n")
    return folder


def test_import_info_and_report(data, tmp_path, capsys):
    out, report = tmp_path / "out", tmp_path / "report.html"
    assert (
        main(["clips", "import", "042", "--data", str(data), "-o", str(out), "--mirror", "--report", str(report)]) == 0
    )
    names = sorted(p.name for p in out.iterdir())
    assert names == ["999_fall.npz", "999_fall_mirrored.npz"]
    clip = load_clip(out / "999_fall.npz")
    assert clip.header.label == "042" and clip.header.skill == "ball_falls", "from the index, not from the file name"
    assert report.read_text().count("<svg") == 2
    capsys.readouterr()
    assert main(["clips", "info", str(out / "999_fall.npz")]) == 0
    printed = capsys.readouterr().out
    assert "9.81" in printed and "0.80" in printed and "Apache-2.0" in printed


def test_import_at_another_rate(data, tmp_path):
    assert main(["clips", "import", "ball_falls", "--data", str(data), "-o", str(tmp_path), "--fps", "30"]) == 0
    clip = load_clip(tmp_path / "999_fall.npz")
    assert clip.fps == 30 and len(clip) == 35


def test_retarget_writes_clip_and_table(data, tmp_path, capsys):
    pytest.importorskip("mink")
    arguments = ["042", "--data", str(data), "-o", str(tmp_path), "--table", str(tmp_path / "t.json")]
    assert main(["clips", "retarget", *arguments]) == 0
    assert load_clip(tmp_path / "999_fall.npz").header.body == "g1"
    row = json.loads((tmp_path / "t.json").read_text())["999_fall"]
    assert row["limit_violations"] == 0 and np.isfinite(list(row.values())).all()
    printed = capsys.readouterr().out
    assert "999_fall" in printed and "1 clips of g1" in printed


def test_table_for_documents():
    row = Residuals(0.001, -0.002, *[0.0] * 5, 0, 0.1, 0.5, 0.7, 0.2, 3.0)
    lines = commands._document({"a": row}, ".md").splitlines()
    assert lines[0].count("|") == lines[1].count("|") == lines[2].count("|")
    assert lines[2].startswith("| a | 1.0 | -2.0 |") and lines[2].endswith("| 0 | 0.50 | 0.70 | 0.20 | 3.0 |")


def test_info_of_a_shipped_clip(capsys):
    assert main(["clips", "info", str(SHIPPED / "pickup_02.npz")]) == 0
    printed = capsys.readouterr().out
    assert "g1" in printed and "SkillMimic" in printed and "left_knee_joint" in printed


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["info"], "got no clips"),
        (["info", "nowhere.npz"], "nowhere.npz: not a clip"),
        (["info", "nowhere.pt"], "nowhere.pt: not a BallPlay-M file"),
        (["info", "042", "--data", "nowhere"], "no recordings"),
        (["info", "fall", "--data", "DATA"], "no clip 'fall'"),
        (["retarget", "042", "--data", "DATA", "--robot", "g2"], "robot 'g2'"),
        (["retarget", str(SHIPPED / "hold_01.npz")], "got one of g1, expected a human's"),
    ],
)
def test_refusals(arguments, message, data, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(["clips", *(str(data) if a == "DATA" else a for a in arguments)]) == 2
    assert message in capsys.readouterr().err


def test_without_the_training_extra_it_says_what_to_install(data, monkeypatch, tmp_path, capsys):
    monkeypatch.setitem(sys.modules, "mink", None)
    monkeypatch.delitem(sys.modules, "policies.clips.retarget", raising=False)
    assert main(["clips", "retarget", "042", "--data", str(data), "-o", str(tmp_path)]) == 2
    assert "needs 'mink'" in (said := capsys.readouterr().err) and "sim2real[train]" in said
