"""Time: a real clock and a simulated one with the same two verbs, an absolute schedule, and real-time tuning.

Only CLOCK_MONOTONIC counts; the wall clock appears in nobody's logic.
"""

from __future__ import annotations

import ctypes
import errno
import gc
import os
import time
from collections.abc import Callable
from dataclasses import dataclass, field


class _Timespec(ctypes.Structure):
    _fields_ = [("seconds", ctypes.c_long), ("nanoseconds", ctypes.c_long)]


_libc = ctypes.CDLL(None, use_errno=True)
_CLOCK_MONOTONIC, _TIMER_ABSTIME = 1, 1
_MCL_CURRENT, _MCL_FUTURE = 1, 2


class MonotonicClock:
    """CLOCK_MONOTONIC. ``spin``: seconds of busy-waiting before each deadline (0 unless tuned: it costs a core)."""

    def __init__(self, spin: float = 0.0):
        self.spin = spin
        self._timespec = _Timespec()

    now = staticmethod(time.monotonic)

    def sleep_until(self, deadline: float) -> None:
        """Return at ``deadline`` (s), at once if it has passed. Absolute: a slow caller does not shift it."""
        early = deadline - self.spin
        spec = self._timespec
        spec.seconds = int(early)
        spec.nanoseconds = int((early - spec.seconds) * 1e9)
        while _libc.clock_nanosleep(_CLOCK_MONOTONIC, _TIMER_ABSTIME, ctypes.byref(spec), None) == errno.EINTR:
            pass
        while self.spin and time.monotonic() < deadline:
            pass


class SimClock:
    """The clock of a simulated world in lockstep: sleeping *is* simulating.

    ``advance(until)`` moves the world to a time and ``read()`` tells which time it has; nothing else makes time pass, so
    that the same seed gives the same bytes.
    """

    def __init__(self, advance: Callable[[float], None], read: Callable[[], float]):
        self._advance, self.now = advance, read

    def sleep_until(self, deadline: float) -> None:
        if deadline > self.now():
            self._advance(deadline)


@dataclass
class Schedule:
    """A fixed rate that never drifts and never bursts: ``next += period``; what is already past is skipped and counted.

    After ``wait()``: ``time`` is when this tick was due, ``lateness`` how late it woke, ``late`` the ticks skipped so far.
    """

    clock: MonotonicClock | SimClock
    period: float  # s
    time: float = 0.0
    lateness: float = 0.0
    late: int = 0
    _origin: float = field(default=0.0, repr=False)
    _ticks: int = field(default=0, repr=False)

    def start(self, at: float | None = None) -> None:
        """Let the first tick be due at ``at`` (default: one period from now)."""
        self._origin = self.clock.now() + self.period if at is None else at
        self._ticks = -1

    def wait(self) -> float:
        """Sleep to the next tick; returns its scheduled time (s)."""
        self._ticks += 1
        behind = int((self.clock.now() - self._origin) / self.period) - self._ticks
        if behind > 0:
            self._ticks += behind
            self.late += behind
        self.time = self._origin + self._ticks * self.period  # a product, not a sum: no rounding drift
        self.clock.sleep_until(self.time)
        self.lateness = self.clock.now() - self.time
        return self.time


@dataclass(frozen=True)
class Tuning:
    """What the kernel granted this process."""

    fifo: bool = False
    pinned: bool = False
    locked: bool = False
    awake: bool = False  # /dev/cpu_dma_latency held at zero
    spin: float = 0.0

    def __str__(self) -> str:
        words = [w for w, on in (("FIFO", self.fifo), ("pinned", self.pinned), ("mlock", self.locked),
                                 ("no idle states", self.awake), ("spin", self.spin > 0)) if on]  # fmt: skip
        return ", ".join(words) or "untuned"


SPIN = 150e-6  # s of busy-waiting before each deadline: what a sleeping process may wake up late
_held: list[int] = []  # file descriptors kept open for as long as the process lives


def tune(priority: int = 80, cpu: int | None = None, spin: float = SPIN) -> Tuning:
    """Ask for everything that makes a Python loop punctual; take what is permitted. Never raises.

    SCHED_FIFO, one CPU, locked memory, no deep idle states, no garbage collector. Call it after warm-up, in a process
    that runs one thread of Python: under FIFO a second one starves, and the interpreter lock would cost milliseconds.
    """
    gc.collect()
    gc.freeze()
    gc.disable()
    fifo = pinned = awake = False
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
        fifo = True
    except (OSError, AttributeError):
        pass
    if cpu is not None:
        try:
            os.sched_setaffinity(0, {cpu})
            pinned = True
        except (OSError, AttributeError):
            pass
    locked = _libc.mlockall(_MCL_CURRENT | _MCL_FUTURE) == 0
    try:
        descriptor = os.open("/dev/cpu_dma_latency", os.O_WRONLY)
        os.write(descriptor, (0).to_bytes(4, "little"))
        _held.append(descriptor)  # the kernel honours it until the file is closed
        awake = True
    except OSError:
        pass
    return Tuning(fifo, pinned, locked, awake, spin if fifo else 0.0)
