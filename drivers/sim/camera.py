"""Pictures of the simulated robot: frames of a run, saved as an animated GIF.

Needs an OpenGL that works without a screen: ``MUJOCO_GL=egl`` (libegl1, libgl1-mesa-dri) or ``osmesa`` (libosmesa6).
"""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np

from drivers.bus import BusError
from drivers.sim.plant import Plant


class Camera:
    """Call ``see(plant)`` as often as you like; a frame is taken every ``1 / rate`` seconds of simulated time."""

    def __init__(self, path: Path, rate: float = 20.0, width: int = 480, height: int = 360, distance: float = 2.6):
        self.path, self.rate, self._size = Path(path), rate, (height, width)
        self._frames: list[np.ndarray] = []
        self._renderer: mujoco.Renderer | None = None
        self._view = mujoco.MjvCamera()
        self._view.distance, self._view.azimuth, self._view.elevation = distance, 130.0, -12.0
        self._next = -np.inf

    def see(self, plant: Plant) -> None:
        """Take a frame if one is due. Raises BusError where nothing can be rendered."""
        if plant.data.time < self._next:
            return
        self._next = plant.data.time + 1.0 / self.rate
        if self._renderer is None:
            try:
                self._renderer = mujoco.Renderer(plant.model, *self._size)
            except Exception as error:  # each GL backend fails in its own way
                raise BusError(
                    f"video {self.path}: no OpenGL to render with ({error}); install libegl1 and libgl1-mesa-dri and "
                    "set MUJOCO_GL=egl, or libosmesa6 and MUJOCO_GL=osmesa"
                ) from None
            self._view.lookat[:] = (*plant.truth().position_base_in_world[:2], 0.7)
        here = plant.truth().position_base_in_world
        self._view.lookat[:2] += 0.1 * (here[:2] - self._view.lookat[:2])
        self._renderer.update_scene(plant.data, self._view)
        self._frames.append(self._renderer.render().copy())

    def save(self) -> None:
        """Write the GIF."""
        from PIL import Image

        if not self._frames:
            return
        images = [Image.fromarray(f).quantize(64, method=Image.Quantize.FASTOCTREE) for f in self._frames]
        duration = round(1000 / self.rate)
        images[0].save(self.path, save_all=True, append_images=images[1:], duration=duration, loop=0, optimize=True)
        if self._renderer is not None:
            self._renderer.close()
