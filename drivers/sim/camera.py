"""Pictures of the simulated robot: frames of a run, saved as an animated GIF.

Needs an OpenGL that works without a screen: ``MUJOCO_GL=egl`` (libegl1, libgl1-mesa-dri) or ``osmesa`` (libosmesa6).
"""

# pyright: reportAttributeAccessIssue=false
# (mujoco's compiled modules have no type stubs)

from __future__ import annotations

import os
from pathlib import Path

import mujoco
import numpy as np

from drivers.bus import BusError
from drivers.sim.ball import ball
from drivers.sim.plant import Plant

HINT = "install libegl1 and libgl1-mesa-dri and set MUJOCO_GL=egl, or libosmesa6 and MUJOCO_GL=osmesa"


class Camera:
    """Call ``see(plant)`` as often as you like; a frame is taken every ``1 / rate`` seconds of simulated time.

    ``visuals``: another MJCF to show instead, such as the maker's with its meshes; joints are matched by name.
    """

    def __init__(
        self,
        path: Path,
        visuals: Path | None = None,
        rate: float = 12.5,
        width: int = 400,
        height: int = 300,
        distance: float = 2.6,
    ):
        self.path, self.rate, self._size, self._visuals = Path(path), rate, (height, width), visuals
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
            self._shown = _Shown(plant, self._visuals)
            if not (os.environ.get("MUJOCO_GL") or os.environ.get("DISPLAY")):
                raise BusError(
                    f"video {self.path}: no screen, and MUJOCO_GL is not set, expected egl or osmesa; {HINT}"
                )
            try:
                self._renderer = mujoco.Renderer(self._shown.model, *self._size)
            except Exception as error:  # each GL backend fails in its own way
                raise BusError(f"video {self.path}: no OpenGL to render with ({error}); {HINT}") from None
            self._view.lookat[:] = (*plant.truth().position_base_in_world[:2], 0.7)
        here = plant.truth().position_base_in_world
        self._view.lookat[:2] += 0.1 * (here[:2] - self._view.lookat[:2])
        self._renderer.update_scene(self._shown.data(), self._view)
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


class _Shown:
    """The model that is rendered: the plant's own, or another one in the plant's posture."""

    def __init__(self, plant: Plant, visuals: Path | None):
        self._plant = plant
        self.model = plant.model
        self._data = plant.data
        self._pairs: list[tuple[int, int, int]] = []  # address here, address there, how many
        if visuals is None:
            return
        try:
            spec = mujoco.MjSpec.from_file(str(visuals))
            if plant.ball is not None:
                ball(0.002, radius=plant.ball.radius)(spec)
            self.model = spec.compile()
        except ValueError as error:
            raise BusError(f"visuals {visuals}: {error}; expected an MJCF that MuJoCo can load") from None
        self._data = mujoco.MjData(self.model)
        sizes = {mujoco.mjtJoint.mjJNT_FREE: 7, mujoco.mjtJoint.mjJNT_BALL: 4}
        for i in range(self.model.njnt):
            name = self.model.joint(i).name
            there = mujoco.mj_name2id(plant.model, mujoco.mjtObj.mjOBJ_JOINT, name)
            if there >= 0:
                here, from_ = self.model.jnt_qposadr[i], plant.model.jnt_qposadr[there]
                self._pairs.append((here, from_, sizes.get(self.model.jnt_type[i], 1)))
        if not self._pairs:
            raise BusError(f"visuals {visuals}: got no joint of this robot, expected the same joint names")

    def data(self) -> mujoco.MjData:
        for here, there, n in self._pairs:
            self._data.qpos[here : here + n] = self._plant.data.qpos[there : there + n]
        if self._pairs:
            mujoco.mj_kinematics(self.model, self._data)
            mujoco.mj_camlight(self.model, self._data)
        return self._data
