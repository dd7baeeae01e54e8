"""``--joints N``: the per-joint tests of the gate on N joints of each robot only; tools/mutate.py is in a hurry."""

from __future__ import annotations

import pytest


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--joints", type=int, default=None, help="test so many joints of each robot, not all")


@pytest.fixture
def joints(request: pytest.FixtureRequest, robot) -> range:
    """Indices of the joints to test."""
    return range(len(robot.joint_names))[: request.config.getoption("--joints")]
