"""Keyboard operator: a terminal in cbreak mode, read without blocking.

A terminal reports no key release, so driving is hold-to-run: a velocity lives only while its key keeps repeating.
"""

from __future__ import annotations

import os
import select
import sys
import termios
import tty
from collections.abc import Sequence

from sim2real.types import OperatorInput, Sim2realError

KEYS = "a arm   SPACE stop (damp)   q end   1-9 skill   arrows drive, , . turn (hold)"
_DRIVE = {
    "\x1b[A": (1, 0, 0),
    "\x1b[B": (-1, 0, 0),
    "\x1b[D": (0, 1, 0),
    "\x1b[C": (0, -1, 0),
    ",": (0, 0, 1),
    ".": (0, 0, -1),
}


class KeyboardOperator:
    """``speed``: velocity while a key is held (m/s, m/s, rad/s). Restores the terminal on ``close``."""

    arm_time = 0.2  # s that one key press asks for: another press asks again
    hold_time = 0.75  # s after the last repeat of a driving key until the velocity is zero (faults.md row 20)

    def __init__(self, labels: Sequence[str], speed: tuple[float, float, float] = (0.5, 0.3, 0.6), stream=None):
        self._stream = stream or sys.stdin
        if not self._stream.isatty():
            raise Sim2realError(
                "operator 'keyboard': stdin is no terminal; use --operator script, or run it in a terminal"
            )
        self._labels, self._speed = list(labels), speed
        self._fd = self._stream.fileno()
        self._before = termios.tcgetattr(self._fd)
        tty.setcbreak(self._fd)
        self._skill: str | None = None
        self._velocity = (0.0, 0.0, 0.0)
        self._driven = -1e9
        self._armed = -1e9  # when it was last asked to arm
        self._stop = self._quit = False

    def read(self, now: float, since: float) -> OperatorInput:
        for key in self._keys():
            self._press(key, now)
        if now - self._driven > self.hold_time:
            self._velocity = (0.0, 0.0, 0.0)
        arm = now - self._armed < self.arm_time
        return OperatorInput(now, self._skill, self._velocity, arm, self._stop, self._quit)

    def _press(self, key: str, now: float) -> None:
        if key == "a":
            self._armed, self._stop = now, False
        elif key == " ":
            self._armed, self._stop = -1e9, True
        elif key in ("q", "\x03", "\x04"):
            self._quit = True
        elif key.isdigit() and 1 <= int(key) <= len(self._labels):
            self._skill = self._labels[int(key) - 1]
        elif key in _DRIVE:
            forward, left, turn = (d * s for d, s in zip(_DRIVE[key], self._speed, strict=True))
            self._velocity = (forward, left, turn)
            self._driven = now

    def _keys(self) -> list[str]:
        text = ""
        while select.select([self._fd], [], [], 0)[0]:
            data = os.read(self._fd, 64)
            if not data:  # the terminal is gone: that is a stop
                self._quit = True
                break
            text += data.decode(errors="ignore")
        keys, i = [], 0
        while i < len(text):
            step = 3 if text.startswith("\x1b[", i) else 1
            keys.append(text[i : i + step])
            i += step
        return keys

    def close(self) -> None:
        termios.tcsetattr(self._fd, termios.TCSADRAIN, self._before)
