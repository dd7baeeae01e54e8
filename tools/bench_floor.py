"""The floor of a real-time loop on this machine: how late a program wakes up that does nothing else.

``cyclictest`` (rt-tests) where it is installed, else a bare loop around ``clock_nanosleep`` in Python, with the same
scheduling as ours. Also the hogs that keep every core busy.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
from bench_table import ROOT

from sim2real.clock import MonotonicClock, tune

LONGEST = 200_000  # us: cyclictest counts what is later than this as this


class Sleeper:
    """A process that wakes up at ``rate`` Hz for ``seconds`` and does nothing. Start it; ``lateness`` waits for it."""

    name = "cyclictest" if shutil.which("cyclictest") else "bare clock_nanosleep"

    def __init__(self, rate: float, seconds: float, priority: int, cpu: int):
        """``priority``: SCHED_FIFO's, with everything else that ``sim2real.clock.tune`` asks for; 0: untuned."""
        if shutil.which("cyclictest"):
            how = ["-p", str(priority), "-a", str(cpu), "-m"] if priority else ["--laptop"]
            command = [
                "cyclictest",
                "-q",
                "-t1",
                "-i",
                f"{1e6 / rate:.0f}",
                "-D",
                f"{seconds:.0f}s",
                "-h",
                str(LONGEST),
            ]
            command += how
        else:
            command = [sys.executable, __file__, *(str(v) for v in (rate, seconds, priority, cpu))]
        self._process = subprocess.Popen(
            command,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            env={**os.environ, "PYTHONPATH": str(ROOT)},
        )

    def lateness(self) -> np.ndarray:
        """Seconds between due and awake, one for each wake-up; in no order."""
        output, errors = self._process.communicate()
        if self._process.returncode:
            raise OSError(f"{self.name}: {errors.strip()}")
        bins = np.array([line.split() for line in output.splitlines() if line[:1].isdigit()], int)
        overflows = [int(line.split()[-1]) for line in output.splitlines() if line.startswith("# Histogram Overflows")]
        late = np.repeat(bins[:, 0], bins[:, 1])
        return np.append(late, np.full(sum(overflows), LONGEST)) * 1e-6


def sleep_and_print(rate: float, seconds: float, priority: int, cpu: int) -> None:
    """What the fallback's process does; prints a histogram as cyclictest does."""
    clock = MonotonicClock()
    if priority:
        tune(priority, cpu, spin=0.0)
    start = clock.now() + 0.1
    late = np.zeros(int(rate * seconds))
    for i in range(len(late)):
        clock.sleep_until(start + i / rate)
        late[i] = clock.now() - (start + i / rate)
    for microseconds, count in zip(*np.unique(np.rint(late * 1e6).astype(int), return_counts=True), strict=True):
        print(microseconds, count)


@contextmanager
def hogs(count: int) -> Iterator[None]:
    """``count`` processes that never sleep, at ordinary priority."""
    processes = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(count)]
    try:
        yield
    finally:
        for process in processes:
            process.kill()
            process.wait()


if __name__ == "__main__":
    sleep_and_print(float(sys.argv[1]), float(sys.argv[2]), int(sys.argv[3]), int(sys.argv[4]))
