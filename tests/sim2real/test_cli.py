"""The dispatcher: contents, wrong words, and refusals without a traceback."""

from __future__ import annotations

import ast
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

from drivers.bus import BusError
from drivers.wire import WireError
from sim2real import cli
from sim2real.types import Sim2realError

FILES = sorted(p for p in Path(cli.__file__).parent.glob("*.py") if p.stem != "__init__")


def planted(monkeypatch: pytest.MonkeyPatch, act) -> None:
    """Make ``sim2real robots`` call ``act``."""
    monkeypatch.setitem(sys.modules, "sim2real.cli.robots", SimpleNamespace(main=act))


def test_every_file_is_in_the_table_of_contents(capsys):
    assert cli.main([]) == cli.main(["--help"]) == 0
    lines = capsys.readouterr().out.splitlines()
    for file in FILES:
        summary = (ast.get_docstring(ast.parse(file.read_text())) or "").partition("\n")[0]
        assert summary, f"{file}: its docstring's first line is its line in the table of contents"
        assert any(line.split()[:1] == [file.stem] and line.endswith(summary) for line in lines)


@pytest.mark.parametrize("file", FILES, ids=lambda p: p.stem)
def test_every_command_explains_itself(file, capsys):
    with pytest.raises(SystemExit) as ended:
        cli.main([file.stem, "--help"])
    assert ended.value.code == 0
    assert f"sim2real {file.stem}" in capsys.readouterr().out


def test_wrong_command_names_the_close_one(capsys):
    assert cli.main(["robot"]) == 2
    assert "no command 'robot' (did you mean 'robots'?)" in capsys.readouterr().err


@pytest.mark.parametrize("kind", [Sim2realError, BusError, WireError])
def test_refusal_is_one_message(kind, monkeypatch, capsys):
    def refuse(argv):
        raise kind("robot 'g2': no file; robots here: [g1]")

    planted(monkeypatch, refuse)
    assert cli.main(["robots"]) == 2
    assert capsys.readouterr().err == "error: robot 'g2': no file; robots here: [g1]\n"


def test_a_bug_keeps_its_traceback(monkeypatch):
    planted(monkeypatch, lambda argv: {}["missing"])
    with pytest.raises(KeyError):
        cli.main(["robots"])


def test_interrupted(monkeypatch):
    def interrupt(argv):
        raise KeyboardInterrupt

    planted(monkeypatch, interrupt)
    assert cli.main(["robots"]) == 130


def test_arguments_and_exit_code_pass_through(monkeypatch):
    planted(monkeypatch, lambda argv: len(argv))
    assert cli.main(["robots", "--json"]) == 1


def test_text_from_outside_cannot_drive_the_terminal():
    assert cli.printable("a\x1b[2Jb\x07\x9bc\u202ed\udcffe\n\tf") == "a[2Jbcde\n\tf"
