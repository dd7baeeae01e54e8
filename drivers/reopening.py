"""A wire whose adapter may be unplugged and plugged in again.

What it was asked to send meanwhile is gone, and what it had received before too: nothing old reaches a motor or a reader.
That it is there again says nothing about the motors behind it, which may have lost their power and with it what connecting
had programmed: see ``sim2real.guardian``, which does not arm them again.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np

from drivers.wire import WireError, WireGone

RETRY_PERIOD = 0.25  # s between two attempts to open it


class ReopeningWire:
    """A CanWire or SerialWire that ``open`` makes, now and again whenever it broke. ``now``: monotonic seconds."""

    def __init__(self, open: Callable[[], Any], now: Callable[[], float] = time.monotonic) -> None:
        """Raises WireError if it cannot be opened now."""
        self._open, self._now = open, now
        self._wire: Any = open()
        self._retry = 0.0  # s, when to try again
        self._why = ""

    def _do(self, act: Callable[[Any], Any]) -> Any:
        """Let the wire act; what breaks it is raised, and the wire is opened again later."""
        if self._wire is None:
            self._reopen()
        try:
            return act(self._wire)
        except WireGone as error:
            self._why, self._retry = str(error), self._now() + RETRY_PERIOD
            self.close()
            self._wire = None
            raise

    def _reopen(self) -> None:
        now = self._now()
        if now < self._retry:
            raise WireError(self._why)
        self._retry = now + RETRY_PERIOD
        try:
            self._wire = self._open()
        except WireError as error:
            self._why = str(error)
            raise

    def send(self, frames: np.ndarray) -> None:
        self._do(lambda wire: wire.send(frames))

    def recv(self) -> np.ndarray:
        return self._do(lambda wire: wire.recv())

    def write(self, data: bytes) -> None:
        self._do(lambda wire: wire.write(data))

    def read(self) -> bytes:
        return self._do(lambda wire: wire.read())

    def fileno(self) -> int:
        return -1 if self._wire is None else self._wire.fileno()

    def close(self) -> None:
        if self._wire is not None:
            self._wire.close()
