"""The shape of the code, read from its syntax: who imports whom, who writes to motors, names, sizes, docstrings."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import PurePosixPath

import pytest
from source import PACKAGES, ROOT, calls, complaints, complaints_about, files, imports

# tools -> policies -> sim2real -> drivers -> numpy and the standard library: the whole architecture in one table.
MAY_IMPORT = {
    "tools": {"policies", "sim2real", "drivers"},
    "policies": {"sim2real", "drivers"},
    "sim2real": {"drivers"},
    "drivers": set(),
    "configs": set(),
}
# Third-party modules that only these files may import (within sim2real and drivers); empty: none.
ONLY_IN = {
    "torch": (),
    "onnxruntime": ("sim2real/policy.py",),
    "onnx": ("sim2real/policy.py", "sim2real/graph.py"),
    "mujoco": ("drivers/sim/plant.py", "drivers/sim/ball.py", "drivers/sim/camera.py", "sim2real/limbs.py"),
    "can": ("drivers/can_wire.py", "drivers/open.py", "drivers/sim/*.py"),
    "serial": ("drivers/serial_wire.py",),
    "cyclonedds": ("drivers/dds_wire.py",),
}
WALL_CLOCK = {"time.time", "time.time_ns", "datetime.now", "datetime.utcnow", "datetime.datetime.now", "datetime.today"}
WALL_CLOCK_IN = ("sim2real/recorder/*.py", "sim2real/cli/deploy.py")  # the date of a record, and nothing else
WRITERS = {  # who writes to a robot, and what: each on one line
    "sim2real/guardian.py": "command",  # what came out of the gate
    "sim2real/launch.py": "damp",  # the last will, when the guardian is dead
}
UNWANTED = {"manager", "handler", "helper", "helpers", "util", "utils", "wrapper", "dof", "dofs", "info"}
LONGEST = {"sim2real": 600, "drivers": 600, "policies": 600, "tools": 100, "tests": 800}  # lines


def arrows(path: str, tree: ast.Module) -> Iterator[tuple[int, str]]:
    package = path.partition("/")[0]
    for line, module in imports(tree):
        target = module.partition(".")[0]
        if target in MAY_IMPORT and target != package and target not in MAY_IMPORT[package]:
            yield line, f"{package} imports {module}; it may import {sorted(MAY_IMPORT[package]) or 'nothing of ours'}"


def heavy_imports(path: str, tree: ast.Module) -> Iterator[tuple[int, str]]:
    for line, module in imports(tree, running=True):
        places = ONLY_IN.get(module.partition(".")[0])
        if places is not None and not any(PurePosixPath(path).match(p) for p in places):
            yield line, f"imports {module}; only {', '.join(places) or 'the training side'} may"


def robot_writes(path: str, tree: ast.Module) -> Iterator[tuple[int, str]]:
    for call, name in calls(tree):
        if name == "robot.write" or name.endswith(".robot.write"):
            yield call.lineno, ", ".join(ast.unparse(a) for a in call.args)


def bus_writes(path: str, tree: ast.Module) -> Iterator[tuple[int, str]]:
    for call, name in calls(tree):
        if name == "bus.write" or name.endswith(".bus.write"):
            yield call.lineno, name


def wall_clock(path: str, tree: ast.Module) -> Iterator[tuple[int, str]]:
    if not any(PurePosixPath(path).match(p) for p in WALL_CLOCK_IN):
        yield from ((call.lineno, f"{name} can jump; use a Clock") for call, name in calls(tree) if name in WALL_CLOCK)


def names(path: str, tree: ast.Module) -> Iterator[tuple[int, str]]:
    """Names we chose ourselves: of files, classes, functions, arguments, variables and attributes of self.

    Not those of another stack, whose files a dialect reads by their own keys.
    """
    if path.startswith("policies/adopt/"):
        return
    chosen = [(1, PurePosixPath(path).stem)]
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
            chosen.append((node.lineno, node.name))
        elif isinstance(node, ast.arg):
            chosen.append((node.lineno, node.arg))
        elif isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
            chosen.append((node.lineno, node.id))
        elif isinstance(node, ast.Attribute) and isinstance(node.ctx, ast.Store) and ast.unparse(node.value) == "self":
            chosen.append((node.lineno, node.attr))
    for line, name in chosen:
        if bad := UNWANTED.intersection(words(name)):
            yield line, f"'{name}': say what it is instead of '{', '.join(bad)}'"


def words(name: str) -> list[str]:
    """``motorBus_info`` -> motor, bus, info."""
    return re.sub(r"([a-z0-9])([A-Z])", r"\1_\2", name).lower().split("_")


def docstrings(path: str, tree: ast.Module) -> Iterator[tuple[int, str]]:
    """Every module, and every public class and function at its top level. ``main`` is explained by its module."""
    if not ast.get_docstring(tree):
        yield 1, "the file has no docstring"
    for node in tree.body:
        if isinstance(node, ast.FunctionDef | ast.ClassDef) and not node.name.startswith("_") and node.name != "main":
            if not ast.get_docstring(node):
                yield node.lineno, f"{node.name} has no docstring"


@pytest.mark.parametrize("check", [arrows, docstrings, names], ids=lambda check: check.__name__)
def test_all_packages(check):
    found = complaints(check, *PACKAGES, "tools")
    assert not found, "\n".join(found)


@pytest.mark.parametrize("check", [heavy_imports, wall_clock], ids=lambda check: check.__name__)
def test_runtime(check):
    found = complaints(check, "sim2real", "drivers")
    assert not found, "\n".join(found)


def test_one_line_writes_to_the_robot():
    """Only the guardian moves a robot, on one line right behind the gate; only the robot writes to its buses."""
    found = [w.split(":") for w in complaints(robot_writes, *PACKAGES, "tools")]
    assert sorted((path, what.strip()) for path, _, what in found) == sorted(WRITERS.items())
    assert {w.partition(":")[0] for w in complaints(bus_writes, *PACKAGES, "tools")} == {"sim2real/robot.py"}


@pytest.mark.parametrize("folder", LONGEST)
def test_files_can_be_read_in_one_sitting(folder):
    lengths = {p.relative_to(ROOT).as_posix(): len(p.read_text().splitlines()) for p in files(folder)}
    assert {path: n for path, n in lengths.items() if n > LONGEST[folder]} == {}


def test_tools_and_tests_are_no_packages():
    """So that they can never be imported from an installed copy."""
    assert [p for folder in ("tools", "tests") for p in (ROOT / folder).rglob("__init__.py")] == []


@pytest.mark.parametrize(
    ("check", "path", "text"),
    [
        (arrows, "drivers/bus.py", "def f():\n    from sim2real.types import Mode"),
        (arrows, "sim2real/pilot.py", "import policies.train"),
        (arrows, "policies/env.py", "import tools"),
        (heavy_imports, "sim2real/pilot.py", "from torch.nn import Module"),
        (heavy_imports, "sim2real/policy.py", "import mujoco"),
        (heavy_imports, "drivers/bus.py", "import onnxruntime as ort"),
        (robot_writes, "sim2real/pilot.py", "self.robot.write(command)"),
        (bus_writes, "sim2real/pilot.py", "bus.write(command)"),
        (heavy_imports, "sim2real/pilot.py", "if fast:\n    import torch"),
        (wall_clock, "sim2real/pilot.py", "import time\nx = time.time()"),
        (names, "sim2real/utils.py", "x = 1"),
        (names, "sim2real/bus.py", "class BusManager: ..."),
        (names, "sim2real/bus.py", "def f(num_dof): self.frame_info = 1"),
        (docstrings, "sim2real/bus.py", "x = 1"),
        (docstrings, "sim2real/bus.py", '"""A file."""\ndef public(): ...'),
    ],
)
def test_the_checks_can_fail(check, path, text):
    assert complaints_about(check, path, text)
