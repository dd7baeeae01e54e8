"""What the processes of one run share: a specification on disk, channels beside it, and how a process lives and dies.

A run has a private directory. ``run.json`` in it says everything; the channels and, in simulation, the sockets of the world
lie beside it. Each process is started as ``python -m <module> DIRECTORY``. Its stdin is a pipe whose other end only the
launcher holds, so that end-of-file means: the launcher is gone, stop. What it says on stdout, one JSON object a line, is
for the operator.
"""

from __future__ import annotations

import json
import os
import select
import signal
import socket
import sys
from collections.abc import Callable
from pathlib import Path

from sim2real.calibration import load_calibration
from sim2real.channel import Channel
from sim2real.clock import MonotonicClock, Schedule, tune
from sim2real.config import RobotConfig, Strict, Wiring, load_robot
from sim2real.contract import Object
from sim2real.object.camera import Sight
from sim2real.recorder.process import Sink
from sim2real.records import Layout

# s beside whole periods. There Linux has its own tick (CONFIG_HZ of this clock, in step with it since 6.4, e9523a0d8189), and
# who is due at the same time waits 15 us for that, and now and then for all that the kernel has put off.
ASIDE = 0.0007


class RunSpec(Strict):
    """Everything a process of a run needs to know."""

    robot: str  # path of the YAML
    wiring: str
    simulated: bool
    policies: dict[str, str]  # path -> sha256 of the file that was proved before the run
    tune: bool = True  # ask the kernel for punctuality
    recorder: int = -1  # file descriptor of the recorder's channel, inherited; -1: no record
    sightings: int = (
        -1
    )  # file descriptor of the UDP socket on which the object's sightings come; -1: there is no object
    camera: tuple[str, int] | None = None  # where the simulated camera sends its own
    sight: Sight = "camera"  # what that is
    object: Object | None = None  # what the simulated world has besides the robot
    seed: int = 0
    faults: list[str] = []
    calibration: str = ""  # path of the file; "": signs and offsets are the wiring's own
    variants: tuple[int, ...] = ()  # hardware variants that robot and policies allow; empty: any

    def save(self, directory: Path) -> None:
        (directory / "run.json").write_text(self.model_dump_json(indent=1))

    @classmethod
    def load(cls, directory: Path) -> RunSpec:
        return cls.model_validate_json((directory / "run.json").read_text())

    def open(self) -> tuple[RobotConfig, Wiring]:
        """The robot, and its wiring as calibrated. Raises ConfigError, or Sim2realError for the calibration."""
        config = load_robot(self.robot)
        wiring = config.wiring(self.wiring)
        return config, load_calibration(self.calibration).applied_to(wiring) if self.calibration else wiring


def sink(spec: RunSpec) -> Sink | None:
    """The way to the recorder, if this run has one."""
    if spec.recorder < 0:
        return None
    return Sink(socket.socket(fileno=spec.recorder), topics=2 if spec.sightings < 0 else 3)


def channel(directory: Path, name: str, layout: Layout) -> Channel:
    """The channel ``name`` of the run in ``directory``."""
    return Channel(layout, directory / f"{name}.channel")


def tell(text: str, **more: object) -> None:
    """Say something to the operator. A launcher that does not listen costs nothing: the line is dropped."""
    try:
        os.write(1, (json.dumps({"text": text, **more}) + "\n").encode())
    except OSError:
        pass


class Life:
    """Whether this process should go on: false after SIGTERM, or when the launcher has closed our stdin."""

    def __init__(self) -> None:
        self._wanted = True
        os.set_blocking(1, False)
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the launcher's to interpret
        signal.signal(signal.SIGTERM, self._end)

    def _end(self, *_: object) -> None:
        self._wanted = False

    def goes_on(self) -> bool:
        if self._wanted and select.select([sys.stdin], [], [], 0)[0] and not os.read(0, 4096):
            self._wanted = False
        return self._wanted


def keep_time(
    tick: Callable[[float, float, int], None],
    period: float,
    spec: RunSpec,
    priority: int,
    goes_on: Callable[[], bool],
    phase: float = 0.0,
    cpu: int = -1,
) -> None:
    """Call ``tick(scheduled, lateness, late)`` on an absolute schedule while ``goes_on()``.

    Ticks are due at whole periods of the monotonic clock plus ``ASIDE`` and ``phase`` (s), so that processes agree without
    talking.
    ``cpu``: which of the permitted ones to stay on, counted as a list's index.
    """
    clock = MonotonicClock()
    cpus = sorted(os.sched_getaffinity(0))
    if spec.tune:
        granted = tune(priority, cpus[cpu] if len(cpus) > 1 else None)
        clock.spin = granted.spin
        tell(f"tuned: {granted}", tuning=str(granted))
    schedule = Schedule(clock, period)
    schedule.start(at=(int(clock.now() / period) + 2) * period + ASIDE + phase)
    ready = False
    while goes_on():
        due = schedule.wait()
        tick(due, schedule.lateness, schedule.late)
        if not ready:
            ready = True
            tell("ready", ready=True)
