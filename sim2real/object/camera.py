"""A simulated camera on the robot: sees the ball of a simulated world at its own rate, late, noisily, and not always."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np

from sim2real.object.packet import Receiver, encode
from sim2real.quaternion import rotate
from sim2real.tracker import ObjectSample

if TYPE_CHECKING:
    from drivers.sim.world import World


@dataclass(frozen=True)
class CameraModel:
    """What a camera with a detector is like; the defaults are those of a global-shutter camera with a small network."""

    rate: float = 60.0  # Hz
    latency: float = 0.035  # s from exposure to answer
    jitter: float = 0.01  # s more, uniform
    noise: float = 0.006  # m, standard deviation on each axis
    loss: float = 0.05  # share of exposures without an answer


# What sees the object in a simulation: a camera on the robot's head, or motion capture (markers on ball and robot; slower and
# less exact than such systems' makers say, for the network and the markers between).
SIGHTS = {
    "camera": CameraModel(),
    "capture": CameraModel(rate=240.0, latency=0.008, jitter=0.002, noise=0.001, loss=0.001),
}
Sight = Literal["camera", "capture"]  # the keys of SIGHTS


class SimCamera:
    """``expose`` at least as often as ``model.rate``; ``sent(now)`` are the datagrams that have left it by then, and
    ``read(now)`` what they say, for whoever is in the same process."""

    def __init__(self, model: CameraModel | None = None, seed: int = 0) -> None:
        self.model = model or CameraModel()
        self._rng = np.random.default_rng(seed)
        self._next = -np.inf
        self._exposures = 0
        self._coming: deque[tuple[float, bytes]] = deque()
        self._receiver = Receiver()

    def expose(self, now: float, position: np.ndarray, base: np.ndarray, orientation: np.ndarray) -> None:
        """Perhaps take a picture: object and base (3,) m and the base's orientation (4,), in the world, at ``now`` s."""
        if now < self._next - 1e-9:
            return
        m, rng = self.model, self._rng
        self._next = (now if self._next == -np.inf else self._next) + 1 / m.rate
        lost, delay = rng.random() < m.loss, m.latency + m.jitter * rng.random()
        seen = rotate(orientation * [1.0, -1.0, -1.0, -1.0], position - base) + m.noise * rng.standard_normal(3)
        if not lost:
            self._coming.append((now + delay, encode(self._exposures, now, seen)))
        self._exposures += 1

    def sent(self, now: float) -> list[bytes]:
        """Datagrams that have left by ``now`` (s), in the order of their exposure."""
        found = []
        while self._coming and self._coming[0][0] <= now:
            found.append(self._coming.popleft()[1])
        return found

    def read(self, now: float) -> list[ObjectSample]:
        """The same, decoded."""
        return [sample for data in self.sent(now) if (sample := self._receiver.take(data)) is not None]

    def watch(self, world: World, now: float | None = None) -> None:
        """Perhaps take a picture of the ball of a simulated world; ``now``: by whose clock, if not the world's."""
        now = world.time if now is None else now
        if now < self._next - 1e-9:
            return
        truth = world.truth()
        if truth.position_object_in_world is not None:
            base, orientation = truth.position_base_in_world, truth.orientation_base_in_world
            self.expose(now, truth.position_object_in_world, base, orientation)
