"""What every test may ask for: ``robot``, each robot shipped in turn; ``shared``, reference material beside the clone."""

from __future__ import annotations

import os
from pathlib import Path

import hypothesis
import pytest

from sim2real.config import RobotConfig, load_robot, robot_names

ROOT = Path(__file__).resolve().parents[1]

# Reproducible by default, so that a failure in CI is a failure here; `make fuzz` explores instead.
hypothesis.settings.register_profile("fixed", deadline=None, derandomize=True)
hypothesis.settings.register_profile("fuzz", deadline=None, max_examples=5000)
hypothesis.settings.load_profile("fixed")


@pytest.fixture(params=robot_names(), scope="session")
def robot(request: pytest.FixtureRequest) -> RobotConfig:
    """Each robot in ``configs/robots``: a new YAML is enrolled in every test that uses this."""
    return load_robot(request.param)


@pytest.fixture(scope="session")
def shared() -> Path:
    """Reference models and recorded policies: the folder ``shared`` beside the clone, or ``$SIM2REAL_SHARED``."""
    path = Path(os.environ.get("SIM2REAL_SHARED", ROOT.parent / "shared"))
    if not path.is_dir():
        pytest.skip(f"reference material: no folder {path}; set SIM2REAL_SHARED to where it is")
    return path
