"""Pictures of a simulated robot, where this machine can render."""

from __future__ import annotations

import numpy as np
import pytest
from PIL import Image
from sim_robots import BOX

from drivers.bus import BusError
from drivers.sim.camera import Camera
from drivers.sim.plant import Plant


@pytest.fixture
def plant(tmp_path):
    (tmp_path / "box.xml").write_text(BOX)
    return Plant(tmp_path / "box.xml", ["left", "right"], "base", imu_site="imu")


def frames(camera: Camera, plant: Plant, seconds: float) -> list[np.ndarray]:
    while plant.data.time < seconds:
        try:
            camera.see(plant)
        except BusError as error:
            if "MUJOCO_GL" in str(error):
                pytest.skip(str(error))
            raise
        plant.step()
    camera.save()
    with Image.open(camera.path) as gif:
        return [np.asarray(gif.seek(i) or gif.convert("RGB")) for i in range(gif.n_frames)]


def test_frames_come_at_their_rate_and_show_motion(plant, tmp_path):
    plant.reset()
    plant.push((1.0, 0.0, 1.0))
    seen = frames(Camera(tmp_path / "run.gif", rate=10.0), plant, 0.45)
    assert len(seen) == 5
    assert (seen[0] != seen[-1]).mean() > 0.01


def test_other_visuals_take_the_posture(plant, tmp_path):
    (tmp_path / "red.xml").write_text(BOX.replace('mass="8"', 'mass="8" rgba="1 0 0 1"'))
    plant.reset()
    seen = frames(Camera(tmp_path / "run.gif", tmp_path / "red.xml", rate=10.0), plant, 0.15)
    grey = frames(Camera(tmp_path / "grey.gif", rate=10.0), plant, 0.3)
    redness = [float((f[..., 0].astype(float) - f[..., 1]).max()) for f in (seen[0], grey[0])]
    assert redness[0] > 60 + redness[1]


@pytest.mark.parametrize(("text", "reason"), [("<mujoco/>", "no joint"), ("<mujoco>", "can load")])
def test_visuals_that_do_not_fit_are_refused(plant, tmp_path, text, reason):
    (tmp_path / "bad.xml").write_text(text)
    with pytest.raises(BusError, match=reason):
        frames(Camera(tmp_path / "run.gif", tmp_path / "bad.xml"), plant, 0.1)
