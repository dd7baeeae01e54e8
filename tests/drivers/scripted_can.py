"""A fake at the wire: motors that answer frames by a script, without physics. What they are asked is kept in ``sent``."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from drivers.bus import BusSpec, MotorSpec
from drivers.codecs import damiao
from drivers.codecs.damiao import DamiaoMotors, Kind, Operation
from drivers.wire import FRAME


def leg(n: int = 3, **changes) -> BusSpec:
    """A bus of n motors, ids 1.., answering on id + 0x10."""
    motors = tuple(MotorSpec(f"joint_{i}", "DM8009", i, i + 0x10) for i in range(1, n + 1))
    return BusSpec(**{"name": "leg", "protocol": "damiao", "motors": motors, "channel": "can7"} | changes)


class ScriptedMotors:
    """A CanWire with Damiao motors behind it that answer at once."""

    def __init__(self, spec: BusSpec) -> None:
        n = len(spec.motors)
        self.codec = DamiaoMotors(spec)
        models = [damiao.MODELS[m.model] for m in spec.motors]
        self.registers: list[dict[str, float]] = [
            {"PMAX": m.position, "VMAX": m.velocity, "TMAX": m.torque, "CTRL_MODE": 1, "TIMEOUT": 0} for m in models
        ]
        self.position, self.velocity, self.torque = np.zeros((3, n))
        self.status = np.zeros(n, int)
        self.temperature = np.full((2, n), 25)
        self.silent: set[int] = set()  # rows that never answer
        self.obey_disable = True
        self.refuse: Callable[[np.ndarray], None] = lambda frames: None  # may raise, as a wire does
        self.lose: Callable[[int, int], bool] = lambda row, kind: False  # frames that get lost on the way
        self.sent: list[np.ndarray] = []
        self.closed = False
        self._waiting: list[np.ndarray] = []

    def send(self, frames: np.ndarray) -> None:
        self.refuse(frames)
        self.sent.append(frames.copy())
        rows, kinds = self.codec.classify(frames)
        for row, kind, frame in zip(rows.tolist(), kinds.tolist(), frames, strict=True):
            if row < 0 or row in self.silent or self.lose(row, kind):
                continue
            if kind == Kind.REGISTER:
                request = damiao.unpack_register(frame["data"])
                if request.operation == Operation.REFRESH:
                    self._waiting.append(self.feedback()[row : row + 1])
                    continue
                if request.operation == Operation.WRITE:
                    self.registers[row][request.register] = request.value
                value = self.registers[row][request.register]
                self._waiting.append(self.codec.pack_register(row, request.operation, request.register, value))
            else:
                self._waiting.append(self.feedback()[row : row + 1])
                if kind == Kind.DISABLE and self.obey_disable or kind == Kind.CLEAR_ERROR:
                    self.status[row] = 0
                elif kind == Kind.ENABLE and self.status[row] == 0:
                    self.status[row] = 1

    def feedback(self) -> np.ndarray:
        return self.codec.pack_feedback(self.position, self.velocity, self.torque, self.status, *self.temperature)

    def arrive(self, frames: np.ndarray) -> None:
        """Let the host receive ``frames`` next."""
        self._waiting.append(frames)

    def recv(self) -> np.ndarray:
        frames = np.concatenate([*self._waiting, np.zeros(0, FRAME)])
        self._waiting.clear()
        return frames

    def fileno(self) -> int:
        return -1

    def close(self) -> None:
        self.closed = True
