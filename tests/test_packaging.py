"""Wheel and sdist: what is in them, and that they run where no clone and no torch is."""

from __future__ import annotations

import json
import subprocess
import sys
import sysconfig
import tarfile
import venv
import zipfile
from pathlib import Path
from typing import NamedTuple

import pytest

from sim2real.config import robot_names

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = {"sim2real", "drivers", "policies", "configs"}
DATA = ("configs/robots/*.yaml", "configs/robots/*.xml", "policies/*/*.onnx")
REPORT_MODULES = """
import json, sys
from sim2real.cli import main
code = main({argv!r})
print("MODULES", json.dumps([m for m in sys.modules if "." not in m]))
sys.exit(code)
"""

pytestmark = pytest.mark.slow


class Built(NamedTuple):
    """What `python -m build` made."""

    wheel: Path
    sdist: Path


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> Built:
    """The sdist, and the wheel made from that sdist, so a file missing from one is missing from the other."""
    out = tmp_path_factory.mktemp("dist")
    run([sys.executable, "-m", "build", "--no-isolation", "--outdir", str(out), str(ROOT)], out)
    return Built(next(out.glob("*.whl")), next(out.glob("*.tar.gz")))


@pytest.fixture(scope="module")
def installed(built: Built, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A fresh environment with the wheel in it; its Python.

    Dependencies are borrowed from the environment of the tests instead of downloaded again, except torch: the base
    install has none, so importing it, here or in any child process, must fail.
    """
    home = tmp_path_factory.mktemp("elsewhere")
    venv.create(home, with_pip=False, symlinks=True)
    python = home / "bin" / "python"
    run([sys.executable, "-m", "pip", "--python", str(python), "install", "--no-deps", "-q", str(built.wheel)], home)
    site = Path(run([str(python), "-c", "import sysconfig; print(sysconfig.get_path('purelib'))"], home).strip())
    (site / "borrowed.pth").write_text(sysconfig.get_path("purelib") + "\n")
    (site / "torch.py").write_text("raise ImportError('the base install has no torch')\n")
    return python


def run(command: list[str], directory: Path) -> str:
    done = subprocess.run(command, cwd=directory, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, f"{command}\n{done.stdout}\n{done.stderr}"
    return done.stdout


def top_level_modules(output: str) -> set[str]:
    return set(
        json.loads(next(line for line in output.splitlines() if line.startswith("MODULES")).removeprefix("MODULES"))
    )


def test_wheel_holds_the_packages_and_nothing_else(built):
    names = zipfile.ZipFile(built.wheel).namelist()
    tops = {n.partition("/")[0] for n in names}
    assert {t for t in tops if not t.endswith(".dist-info")} == PACKAGES
    assert [n for n in names if n.endswith((".pt", ".mcap", ".pyc"))] == []


def test_wheel_holds_the_data(built):
    names = set(zipfile.ZipFile(built.wheel).namelist())
    wanted = {p.relative_to(ROOT).as_posix() for pattern in DATA for p in ROOT.glob(pattern)}
    assert wanted, "the repository has no data to ship"
    assert wanted <= names
    assert {n.rpartition("/")[2] for n in names} >= {"LICENSE", "NOTICE"}


def test_sdist_holds_what_the_wheel_is_made_from(built):
    with tarfile.open(built.sdist) as archive:
        names = {n.partition("/")[2] for n in archive.getnames()}
    assert {n.partition("/")[0] for n in names if "/" in n} == PACKAGES
    assert {"pyproject.toml", "README.md", "SAFETY.md", "LICENSE", "NOTICE", "CHANGELOG.md"} <= names


def test_help_needs_nothing_heavy(installed, tmp_path):
    output = run([str(installed), "-c", REPORT_MODULES.format(argv=["--help"])], tmp_path)
    assert "sim2real <command>" in output and "deploy" in output
    assert not top_level_modules(output) & {"numpy", "mujoco", "onnxruntime", "onnx", "torch", "can", "tyro", "rich"}


def test_the_command_is_on_the_path(installed, tmp_path):
    robots = json.loads(run([str(installed.parent / "sim2real"), "robots", "--json"], tmp_path))
    assert [r["name"] for r in robots] == robot_names()


def test_deploy_runs_elsewhere_without_torch(installed, tmp_path):
    summary = tmp_path / "out.json"
    argv = ["deploy", "--robot", "g1", "--clock", "lockstep", "--script", "stand:3", "--json", str(summary)]
    output = run([str(installed), "-c", REPORT_MODULES.format(argv=argv)], tmp_path)
    assert json.loads(summary.read_text())["fell"] is False
    assert {"mujoco", "onnxruntime"} <= top_level_modules(output), "the run was not a run"
