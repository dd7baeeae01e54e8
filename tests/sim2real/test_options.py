"""Options: a number or a path that could not be meant is refused by name, before anything is done."""

from __future__ import annotations

import dataclasses
import importlib
import inspect
import os
import typing

import pytest

from sim2real.cli import commands, main
from sim2real.operators.script import parse_script
from sim2real.types import Sim2realError

REFUSED = [
    ("train g1-ball --envs 0", "--envs: got 0, expected a whole number, at least 1"),
    ("train g1-ball --envs 2.5", "--envs: got 2.5, expected a whole number, at least 1"),
    ("train g1-ball --threads -1", "--threads: got -1, expected a whole number, at least 1"),
    ("train g1-ball --samples nan", "--samples: got nan, expected a number above 0"),
    ("train g1-ball --samples inf", "--samples: got inf, expected a number above 0"),
    ("train g1-ball --seed -1", "--seed: got -1, expected a whole number, at least 0"),
    ("eval policies/g1/basics.onnx --episodes 0", "--episodes: got 0, expected a whole number, at least 1"),
    ("deploy --robot g1 --seed -1", "--seed: got -1, expected a whole number, at least 0"),
    ("deploy --robot g1 --skill stand --duration -3", "--duration: got -3, expected a number, at least 0"),
    ("deploy --robot g1 --skill walk --velocity nan 0 0", "--velocity: got nan 0 0, expected three numbers"),
    ("buses --robot g1 --rate nan", "--rate: got nan, expected a number, at least 0"),
    ("clips retarget hold --ball-radius=-1", "--ball-radius: got -1, expected a number, at least 0"),
]


PATHS = [
    ("eval policies/g1/ball.onnx --report there/x.json", "--report: got there/x.json, whose folder cannot be made:"),
    ("eval policies/g1/ball.onnx --card .", "--card: got ., a folder, expected a file to write"),
    (
        "eval policies/g1/ball.onnx --videos there/films",
        "--videos: got there/films, but there is a file, expected a folder",
    ),
    ("train g1-ball --folder there", "--folder: got there, but there is a file, expected a folder to write into"),
    ("deploy --robot g1 --video x.txt", "--video: got x.txt, expected a file to write that ends in .gif"),
    ("export runs/g1 -o there/x.onnx", "got there/x.onnx, whose folder cannot be made:"),
]


def refusal(line: str, capsys: pytest.CaptureFixture[str]) -> str:
    """What a command line is told, which ends it with status 2."""
    with pytest.raises(SystemExit) as stopped:
        main(line.split())
    assert stopped.value.code == 2
    return " ".join(capsys.readouterr().err.replace("│", " ").split())


@pytest.mark.parametrize("line, message", REFUSED)
def test_a_number_that_cannot_be_meant_is_refused_by_name(line, message, capsys):
    assert message in refusal(line, capsys)


@pytest.mark.parametrize("line, message", PATHS)
def test_a_path_that_cannot_be_written_is_refused_before_the_work(line, message, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "there").write_text("a file")
    assert message in refusal(line, capsys)


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write anywhere")
@pytest.mark.parametrize("option", ["--report no/x.json", "--videos no/films"])
def test_a_folder_that_may_not_be_written_is_refused_before_the_work(option, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "no").mkdir(mode=0o500)
    assert "may not be written" in refusal(f"eval policies/g1/ball.onnx {option}", capsys)


def test_the_folder_of_a_file_to_write_is_made(tmp_path):
    file = tmp_path / "a" / "b" / "home.onnx"
    assert main(["posture", "--robot", "g1", "-o", str(file)]) == 0
    assert file.is_file()


def test_every_number_of_every_command_says_what_it_may_be():
    for name in commands():
        module = importlib.import_module(f"sim2real.cli.{name}")
        for args in vars(module).values():
            if inspect.isclass(args) and dataclasses.is_dataclass(args) and args.__module__ == module.__name__:
                for option, hint in typing.get_type_hints(args, include_extras=True).items():
                    bare = {hint, *typing.get_args(hint)} if typing.get_origin(hint) is not typing.Annotated else set()
                    assert not bare & {int, float}, f"{name} --{option}: see sim2real/options.py"


@pytest.mark.parametrize("part", ["stand:nan", "stand:-1", "stand:0", "walk:2@nan/0/0", "walk:2@1/0/0/0", "walk:2@1"])
def test_a_step_of_a_script_takes_time_and_has_a_velocity(part):
    with pytest.raises(Sim2realError, match="script: got '.*', expected LABEL:SECONDS"):
        parse_script(f"stand:1,{part}")
