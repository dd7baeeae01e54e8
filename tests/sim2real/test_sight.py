"""What sees the object in a simulation: early and exact, or late and noisy, in lockstep and as processes."""

from __future__ import annotations

import numpy as np
import pytest

from sim2real.cli.deploy import main
from sim2real.object.camera import SIGHTS, SimCamera
from sim2real.recorder.run import Run
from sim2real.recorder.summary import summarise


@pytest.mark.parametrize(("sight", "late"), [("camera", (0.035, 0.045)), ("capture", (0.008, 0.010))])
def test_sightings_come_as_late_as_their_source_has_them(sight, late):
    eye, upright, ages = SimCamera(SIGHTS[sight]), np.array([1.0, 0, 0, 0]), []
    for k in range(2000):
        now = k * 0.001
        eye.expose(now, np.ones(3), np.zeros(3), upright)
        ages += [now - sample.time for sample in eye.read(now)]
    assert late[0] <= min(ages) and max(ages) < late[1] + 0.001
    assert len(ages) == pytest.approx(2 * SIGHTS[sight].rate, rel=0.1)


@pytest.mark.slow
@pytest.mark.parametrize("clock", ["lockstep", "realtime"])
def test_a_run_is_seen_by_what_it_names(clock, tmp_path):
    used = {}
    for sight in SIGHTS:
        record = tmp_path / f"{sight}.mcap"
        arguments = ["--robot", "g1", "--skills", "ball", "--skill", "hold", "--duration", "1", "--untuned"]
        assert main([*arguments, "--clock", clock, "--sight", sight, "--record", str(record)]) == 0
        report = summarise(Run(record))
        assert report.object is not None
        used[sight] = report.object.used
    assert used["capture"] > 3 * used["camera"] > 60
