"""A run in real time: starts its processes, watches them, and ends them so that the robot is never left with torque.

World (simulation only), recorder, guardian and pilot are processes; this one is the operator's. If the guardian dies, the
last will is executed here: the buses are opened again and damping is streamed until the end. If this process dies too,
the motors' own watchdogs are what is left.
"""

from __future__ import annotations

import contextlib
import json
import os
import select
import shutil
import subprocess
import sys
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from sim2real.channel import run_directory
from sim2real.clock import MonotonicClock, Schedule
from sim2real.config import RobotConfig
from sim2real.guardian import operator_layout
from sim2real.object.camera import Sight
from sim2real.object.packet import ADDRESS, listen
from sim2real.object.scene import Handover, starts_of
from sim2real.operators import Operator, store
from sim2real.pilot import topics
from sim2real.robot import Robot, open_robot
from sim2real.run import RunSpec, channel
from sim2real.simulation import support
from sim2real.skills import SkillPlayer, Stage, object_for
from sim2real.summary import Measures, Summary
from sim2real.types import JointCommand, Mode, Sim2realError


class Child:
    """A process of the run: ``python -m module directory``, its stdin our sign of life, its stdout its messages."""

    def __init__(self, module: str, directory: Path, inherit: Sequence[int] = ()):
        self.module = module
        root = str(Path(__file__).resolve().parents[1])
        path = os.pathsep.join(filter(None, (root, os.environ.get("PYTHONPATH"))))
        self.process = subprocess.Popen(
            [sys.executable, "-m", module, str(directory)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            bufsize=0,
            pass_fds=list(inherit),
            env={**os.environ, "PYTHONPATH": path, "OMP_NUM_THREADS": "1"},
        )
        assert self.process.stdin and self.process.stdout
        self._stdout = self.process.stdout.fileno()
        os.set_blocking(self._stdout, False)
        self._text = b""

    def messages(self) -> list[dict[str, Any]]:
        """What it said since the last call. Never blocks."""
        try:
            while chunk := os.read(self._stdout, 65536):
                self._text += chunk
        except BlockingIOError:
            pass
        *lines, self._text = self._text.split(b"\n")
        return [json.loads(line) for line in lines if line.startswith(b"{")]

    def ready(self, timeout: float) -> list[str]:
        """Wait until it says so; returns what it said before. Raises Sim2realError with what it said instead."""
        clock, said = MonotonicClock(), []
        end = clock.now() + timeout
        while clock.now() < end:
            select.select([self._stdout], [], [], 0.05)
            for message in self.messages():
                if message.get("ready"):
                    return said
                if message.get("failed"):
                    raise Sim2realError(message["text"])
                said.append(message["text"])
            if self.process.poll() is not None:
                break
        raise Sim2realError(
            f"{self.module}: not ready within {timeout:g} s (exit {self.process.poll()}); {' '.join(said) or 'it said nothing'}"
        )

    def end(self, timeout: float) -> None:
        """Close its stdin and wait; kill it if it does not go."""
        if self.process.stdin:
            self.process.stdin.close()
        try:
            self.process.wait(timeout)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()


@dataclass
class Launch:
    """Build it, then ``run()``. ``show(launch)`` is called at 10 Hz with everything public here."""

    config: RobotConfig
    player: SkillPlayer
    operator: Operator
    wiring: str = ""
    simulated: bool = True
    calibration: Path | None = None  # of real motors
    tune: bool = True
    seed: int = 0
    faults: Sequence[str] = ()
    recorder: Any = None  # a started sim2real.recorder.process.Recorder
    show: Callable[[Launch], None] = lambda launch: None
    hang: bool = False  # nobody sets the simulated robot down from its gantry
    sight: Sight = "camera"  # what sees the object of a simulation
    sightings: tuple[str, int] = ADDRESS  # of hardware: the UDP address at which the object's sightings are awaited
    messages: list[str] = field(default_factory=list)
    timeout: float = 10.0  # s to be armed and through the soft start, counted from the wish to arm

    def __post_init__(self) -> None:
        self.wiring = self.wiring or self.config.default_wiring
        self.directory = run_directory()
        inherit = self.recorder.sink.fileno() if self.recorder else -1
        contracts = [policy.contract for policy in self.player.policies]
        thing = object_for(contracts)
        self._sightings = None
        if self.player.tracker is not None:
            self._sightings = listen(("127.0.0.1", 0) if self.simulated else self.sightings)
        self._starts = starts_of(contracts)
        self.handover: Handover | None = None
        self.spec = RunSpec(
            robot=str(self.config.path.absolute()),
            wiring=self.wiring,
            simulated=self.simulated,
            policies={str(p.path.absolute()): p.sha256 for p in self.player.policies},
            tune=self.tune,
            recorder=inherit,
            sightings=self._sightings.fileno() if self._sightings else -1,
            camera=self._sightings.getsockname() if self._sightings and self.simulated else None,
            sight=self.sight,
            object=thing,
            seed=self.seed,
            faults=list(self.faults),
            calibration=str(self.calibration.absolute()) if self.calibration else "",
            variants=self._variants(),
        )
        wired = self.wired = self.spec.open()[1]
        self.spec.save(self.directory)
        layouts = topics(self.config, [b.name for b in wired.buses], self.player)
        self.states = channel(self.directory, "tick", layouts["/tick"])
        self.pilot_states = channel(self.directory, "pilot", layouts["/pilot"])
        self._wishes = channel(self.directory, "operator", operator_layout())
        self._wish = self._wishes.layout.new()
        self.measures = Measures(self.config, wired, self.player)
        self.clock = MonotonicClock()
        self.children: dict[str, Child] = {}
        self.world: Any = None
        self.since = -1.0
        self._inherit = [inherit] if inherit >= 0 else []
        self._heir = threading.Thread(target=self._last_will, daemon=True)
        self._standing_by = self.clock.now()

    @property
    def stage(self) -> Stage:
        return Stage(int(self.pilot_states.record["stage"][0]))

    @property
    def skill(self) -> str:
        return self.player.labels[int(self.pilot_states.record["skill"][0])]

    @property
    def mode(self) -> Mode:
        return Mode(int(self.states.record["mode"][0])) if self.states.record["tick"][0] else Mode.OFF

    def run(self) -> Summary:
        """The whole run. Always ends with every motor damped, then off, whatever happens in between."""
        try:
            self._start()
            self._operate()
        finally:
            self._end()
        return self.measures.summary(self.messages, self.player)

    def _start(self) -> None:
        if self.simulated:
            from drivers.sim.socket_wire import WorldRemote

            self._child("world", "sim2real.world").ready(20.0)
            self.world = WorldRemote(self.directory / "world.sock")
            if self.spec.object is not None:
                self.handover = Handover(self.world, self._starts)
        self._robot().close()  # rehearses the last will: everything is imported, every wire is there
        guardian = self._child("guardian", "sim2real.guardian")
        pilot = self._child("pilot", "sim2real.pilot")
        said = guardian.ready(30.0)  # a real robot's motors are put to the proof meanwhile
        self.messages += [f"guardian: {text}" for text in said if not text.startswith("tuned")]
        pilot.ready(30.0)
        self._heir.start()

    def _robot(self) -> Robot:
        directory = str(self.directory) if self.simulated else None
        return open_robot(self.config, self.wired, simulated_in=directory)

    def _variants(self) -> tuple[int, ...]:
        """Of the hardware: those that the robot's limits and every policy are for; empty: nobody says."""
        named = [
            set(said) for said in (self.config.variants, *(p.contract.variants for p in self.player.policies)) if said
        ]
        if named and not set.intersection(*named):
            listed = " and ".join(str(sorted(said)) for said in named)
            raise Sim2realError(f"hardware variants: got {listed} of robot and policies, expected one in all of them")
        return tuple(sorted(set.intersection(*named))) if named else ()

    def _child(self, name: str, module: str) -> Child:
        inherit = [] if name == "world" else list(self._inherit)
        if name == "pilot" and self._sightings is not None:
            inherit.append(self._sightings.fileno())
        child = self.children[name] = Child(module, self.directory, inherit)
        return child

    def _operate(self) -> None:
        schedule = Schedule(self.clock, 0.02)
        schedule.start()
        running: float | None = None
        asked: float | None = None
        guardian = self.children["guardian"].process
        hanging = not self.hang
        n = 0
        while guardian.poll() is None:
            schedule.wait()
            now = self.clock.now()
            self.states.read()
            self.pilot_states.read()
            if running is None and self.stage == Stage.RUN and self.mode == Mode.RUN:
                running = now
            self.since = now - running if running is not None else -1.0
            wish = self.operator.read(now, self.since)
            asked = asked or (now if wish.arm else None)
            store(wish, self.player.labels, self._wish)
            if running is None and asked is not None and now - asked > self.timeout:
                self._wish["quit"] = 1
            self._wishes.write(self._wish)
            if self.world is not None:
                if hanging:
                    hanging = support(self.world, self.stage, self._engage_left(now), self.since)
                if self.handover is not None:
                    self.handover.act(self.stage, self.skill, self._engage_left(now), self.since, wish.skill)
                self.measures.observe(self.world, self.states.record, self.pilot_states.record, self.since)
            self.measures.tick(self.states.record)
            self._listen()
            if n % 5 == 0:
                self.show(self)
            n += 1
        self._listen()
        self.show(self)

    def _engage_left(self, now: float) -> float:
        if self.stage == Stage.STANDBY:
            self._standing_by = now
        return self._standing_by + self.player.engage_time - now

    def _listen(self) -> None:
        for name, child in self.children.items():
            for message in child.messages():
                self.messages.append(f"{name}: {message['text']}")
        if self.recorder is not None:
            self.messages += [f"recorder: {text}" for text in self.recorder.poll()]

    def _last_will(self) -> None:
        """If the guardian ends other than regularly, damp the robot from here for longer than any fall takes."""
        process = self.children["guardian"].process
        if self.tune:
            with contextlib.suppress(OSError, AttributeError):  # of this thread alone
                os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(60))
        if process.wait() == 0:
            return
        robot = self._robot()
        zero = np.zeros(len(self.config.joint_names))
        anywhere = np.clip(zero, self.config.position_min, self.config.position_max)  # kp is 0
        damp = JointCommand(0.0, anywhere, zero, zero, zero, self.config.damping)
        schedule = Schedule(self.clock, 0.005)
        schedule.start(self.clock.now())
        self.messages.append(f"guardian: died (exit {process.returncode}); damping from the launcher")
        try:
            for _ in range(400):
                schedule.wait()
                robot.write(damp)
        except Exception as error:  # noqa: BLE001 - then off is what is left
            self.messages.append(f"last will: {error}")
        robot.disable()
        robot.close()

    def _end(self) -> None:
        for name in ("pilot", "guardian"):
            if name in self.children:
                child = self.children[name]
                child.end(5.0)
        if self._heir.ident is not None:
            self._heir.join(5.0)
        self._listen()
        if "world" in self.children:
            self.children["world"].end(3.0)
        self.operator.close()
        if self._sightings is not None:
            self._sightings.close()
        shutil.rmtree(self.directory, ignore_errors=True)
