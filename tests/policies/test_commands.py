"""`sim2real train` and `sim2real eval` as a user meets them."""

from __future__ import annotations

import dataclasses
import json
import os
import sys

import pytest

from policies import train
from policies.basics import Basics
from sim2real.cli import main
from sim2real.cli.train import training_side
from sim2real.types import Sim2realError

TINY = Basics(envs=8, horizon=4, hidden=(16,), save_every=2, evaluate_every=2, evaluate_envs=2, samples=64,
              ppo={**Basics().ppo, "num_mini_batches": 2})  # fmt: skip


def test_without_its_extra_train_says_what_to_install(monkeypatch, capsys, tmp_path):
    for name in [m for m in sys.modules if m.partition(".")[0] in ("policies", "rsl_rl")]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "rsl_rl", None)  # what the import system does for a module that is not there
    with pytest.raises(Sim2realError, match=r"pip install 'sim2real\[train\]'"):
        training_side("policies.train")
    assert main(["train", "g1-basics", "--folder", str(tmp_path)]) == 2
    assert "sim2real[train]" in capsys.readouterr().err


def test_train_trains_evaluates_itself_and_resumes(capsys, tmp_path):
    run = tmp_path / "run"
    run.mkdir()
    (run / "config.json").write_text(json.dumps({"config": dataclasses.asdict(TINY)}))
    assert main(["train", "g1-basics", "--folder", str(run), "--seed", "3"]) == 0
    first = capsys.readouterr().out
    assert "training in" in first and "survival pushed" in first and "best:" in first
    assert train.load_config(run).seed == 3
    assert {p.name for p in run.iterdir()} == {"config.json", "curve.jsonl", "last.pt", "best.pt"}
    assert main(["train", "g1-basics", "--folder", str(run), "--samples", "128"]) == 0
    assert "resuming" in capsys.readouterr().out
    assert len((run / "curve.jsonl").read_text().splitlines()) == 4


def test_a_run_too_short_to_be_evaluated_names_no_best_policy(capsys, tmp_path):
    (tmp_path / "config.json").write_text(
        json.dumps({"config": dataclasses.asdict(dataclasses.replace(TINY, evaluate_every=1000))})
    )
    assert main(["train", "g1-basics", "--folder", str(tmp_path)]) == 0
    told = "".join(capsys.readouterr().out.split())
    assert "neverevaluated,whichhappensevery1000iterations" in told and "best:" not in told
    assert not (tmp_path / "best.pt").exists()


def test_of_several_processes_one_tells(capsys, tmp_path, monkeypatch):
    monkeypatch.setattr(train.Training, "resume", lambda self: setattr(self, "rank", 1))
    (tmp_path / "config.json").write_text(json.dumps({"config": dataclasses.asdict(TINY)}))
    assert main(["train", "g1-basics", "--folder", str(tmp_path)]) == 0
    assert not capsys.readouterr().out.strip()


def test_settings_of_another_version_are_named(tmp_path):
    train.Training(dataclasses.replace(TINY, samples=0), tmp_path).run()
    document = (tmp_path / "config.json").read_text()
    (tmp_path / "config.json").write_text(document.replace('"gamma"', '"gamme"'))
    with pytest.raises(Sim2realError, match="gamme"):
        train.load_config(tmp_path)


def test_eval_refuses_what_is_no_policy(capsys, tmp_path):
    (tmp_path / "no.onnx").write_bytes(b"no")
    assert main(["eval", str(tmp_path / "no.onnx")]) == 2
    assert "no.onnx" in capsys.readouterr().err


def trained(folder, samples="1") -> int:
    return main(["train", "g1-basics", "--folder", str(folder), "--envs", "4", "--samples", samples])


@pytest.mark.parametrize(
    ("processes", "given", "threads"), [("1", [], 3), ("2", [], 1), ("4", [], 1), ("1", ["--threads", "2"], 2)]
)
def test_the_physics_have_every_core_unless_told(tmp_path, monkeypatch, processes, given, threads):
    monkeypatch.setattr(os, "sched_getaffinity", lambda pid: {0, 1, 2})
    monkeypatch.setenv("LOCAL_WORLD_SIZE", processes)
    command = ["train", "g1-basics", "--folder", str(tmp_path), "--envs", "4", "--samples", "1", *given]
    assert main(command) == 0
    assert json.loads((tmp_path / "config.json").read_text())["config"]["threads"] == threads


def test_the_folder_of_another_task_is_refused(tmp_path, capsys):
    assert trained(tmp_path) == 0
    before = (tmp_path / "config.json").read_text()
    assert main(["train", "g1-ball", "--folder", str(tmp_path)]) == 2
    assert f"{tmp_path}: got task 'g1-ball', but it holds a run of 'g1-basics'; name another --folder" in (
        capsys.readouterr().err
    )
    assert (tmp_path / "config.json").read_text() == before


def test_a_run_goes_on_from_a_curve_whose_last_line_was_torn(tmp_path):
    assert trained(tmp_path) == 0
    with (tmp_path / "curve.jsonl").open("a") as file:
        file.write('{"iteration": 2, "samp')
    assert trained(tmp_path, "150") == 0
    curve = [json.loads(line)["iteration"] for line in (tmp_path / "curve.jsonl").read_text().splitlines()]
    assert curve == [1, 2]


@pytest.mark.parametrize("name", ["last.pt", "config.json"])
@pytest.mark.parametrize("left", [0, 100])
def test_a_run_that_was_damaged_is_named_and_left_as_it_is(tmp_path, capsys, name, left):
    assert trained(tmp_path) == 0
    torn = (tmp_path / name).read_bytes()[:left]
    (tmp_path / name).write_bytes(torn)
    assert trained(tmp_path, "150") == 2
    assert f"error: {tmp_path / name}: " in capsys.readouterr().err
    assert (tmp_path / name).read_bytes() == torn
