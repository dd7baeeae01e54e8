"""The guardian: owns the buses; each tick reads, publishes, lets the safety gate decide, writes.

It is small on purpose. It knows no policy, no skill and no file; a hung or dead pilot is to it only a command that grows
old. The one call that moves the robot is in ``Guardian._transmit``.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Protocol

import numpy as np

from drivers.budget import budget
from drivers.bus import BusError
from drivers.wire import WireError
from sim2real.calibration import load_calibration
from sim2real.channel import Channel
from sim2real.clock import MonotonicClock, SimClock
from sim2real.preflight import Preflight
from sim2real.records import Calls, Layout, command_fields, command_view, layout, state_view, tick_layout
from sim2real.robot import Robot, open_robot
from sim2real.run import Life, RunSpec, channel, keep_time, sink, tell
from sim2real.safety import Limits, Safety
from sim2real.types import JointCommand, Mode, Sim2realError

TICK, PILOT, OBJECT = 0, 1, 2  # topics of a record


class Sink(Protocol):
    """Where records go; never blocks."""

    def write(self, topic: int, time: float, record: np.ndarray) -> bool: ...


def request_layout(joints: tuple[str, ...]) -> Layout:
    """What a pilot sends to the guardian."""
    return layout("Request", command_fields("command", joints))


def operator_layout() -> Layout:
    """What an operator sends to the pilot and the guardian. ``skill``: index over the run's labels, -1: none."""
    return layout(
        "Operator",
        [
            ("time", "f8", None),
            ("skill", "i8", None),
            ("velocity", "f8", ("forward", "left", "turn")),
            ("arm", "i8", None),
            ("stop", "i8", None),
            ("quit", "i8", None),
        ],
    )


class Guardian:
    """Call ``tick`` at the bus rate until ``done``.

    Arming takes a few ticks: motors are enabled torque-free, and only when every one of them says so is the gate asked.
    ``tell`` receives a sentence for the operator whenever something was refused or went wrong.
    """

    # Share of a tick between sensing and acting: the pilot's answer goes out in the tick it belongs to, and the motors'
    # replies are still back before the next.
    response_share = 0.35
    enable_time = 0.3  # s for every motor to answer that it is enabled
    restart_time = 0.2  # s of silence in which a motor may have been without power, and lost what connecting programmed
    damp_time = 1.5  # s of damping at the end of a run before the motors are switched off

    def __init__(
        self,
        robot: Robot,
        safety: Safety,
        clock: MonotonicClock | SimClock,
        period: float,
        requests: Channel,
        operator: Channel,
        states: Channel,
        sink: Sink | None = None,
        tell: Callable[[str], None] = lambda text: None,
    ):
        self.robot, self.safety, self.clock, self.period = robot, safety, clock, period
        self.requests, self.operator, self.states, self.sink, self.tell = requests, operator, states, sink, tell
        self.response = self.response_share * period
        self.done = False
        self.record = states.layout.new()
        self.record["mode"] = Mode.OFF
        self._fields = {name: self.record[name] for name in states.layout.dtype.names or ()}  # views: cheaper to fill
        self._state = state_view(self.record)
        self._sent = command_view(self.record, "command")
        self._requested = command_view(self.record, "request")
        self._wish = command_view(requests.record, "command")
        self._enabling: float | None = None  # since when
        self._arm_seen = False
        self._lost = np.zeros(len(robot.config.joint_names), bool)  # were silent so long since connecting
        self._asked, self._sensed = np.inf, -np.inf  # s, when this process first listened, and when it last did
        self._ending: float | None = None
        self._told_fault: object = None
        self._told_error = ""
        self._failed = Calls(0)  # stops that a failing bus caused in this tick
        budgets = [budget(bus.spec, 1.0 / period) for bus in robot.buses]
        self._load = [b.load / b.frames for b in budgets]  # of the wire, a frame per tick
        self._frames = [0] * len(robot.buses)
        self._tick = 0

    def tick(self, scheduled: float, lateness: float = 0.0, late: int = 0) -> None:
        """One turn of the loop: sense, leave the pilot time to answer, act."""
        self.sense(scheduled, lateness, late)
        self.clock.sleep_until(scheduled + self.response)
        self.act()

    def sense(self, scheduled: float, lateness: float = 0.0, late: int = 0) -> None:
        """Take in what the robot said and publish it. Never raises for anything that a bus does."""
        r, start = self._fields, self.clock.now()
        self._failed = Calls(0)
        self._guard(lambda: self.robot.read(start, self._state), Calls.STOP)
        r["time"][0], r["tick"][0], r["late"][0], r["timing.lateness"][0] = scheduled, self._tick, late, lateness
        # Silence before anybody asked, and while nobody listened because this process was late, is no sign of a motor's.
        self._asked = min(self._asked, start)
        silent = np.minimum(self._state.joint_age, start - self._asked) - (start - self._sensed)
        self._lost |= np.isfinite(self._state.joint_age) & (silent > self.restart_time)
        self._sensed = start
        r["state.time"][0], r["state.imu_age"][0] = self._state.time, self._state.imu_age
        r["timing.read"][0] = self.clock.now() - start
        self.states.write(self.record)

    def act(self) -> None:
        """Let the gate decide on the newest request and send the outcome. Never raises for anything that a bus, a policy
        or an operator does."""
        clock = self.clock
        start = clock.now()
        request = self._request()
        calls = self._obey_operator(start)
        command = self.safety.step(self._state, request, start)
        judged = clock.now()
        self._transmit(command)
        self._report_fault()
        self._store(command, calls | self._failed, (start, judged, clock.now()))
        self._tick += 1

    def damp_at_once(self) -> None:
        """The way out when something unforeseen happened: damping, whatever else is broken. Never raises."""
        try:
            self.safety.stop(self._state.time)
            self._transmit(self.safety.step(self._state, None, self.clock.now()))
        except Exception:  # noqa: BLE001 - the motors' watchdogs are next
            self.robot.disable()

    def quit(self) -> None:
        """Damp, then switch off and be ``done``. Safe to call again and again."""
        if self._ending is None:
            self._ending = self.clock.now()

    def _request(self) -> JointCommand | None:
        if self.requests.read():
            r, wish = self._fields, self._wish
            wish.time = float(self.requests.record["command.time"][0])
            wish.object_time = float(self.requests.record["command.object_time"][0])
            _copy(wish, self._requested)
            r["request.time"][0], r["request.object_time"][0] = wish.time, wish.object_time
        return self._wish if self._wish.time else None

    def _obey_operator(self, now: float) -> Calls:
        calls = Calls(0)
        self.operator.read()
        wish = self.operator.record
        if wish["quit"][0]:
            self.quit()
        stop = bool(wish["stop"][0]) or self._ending is not None
        if stop:
            self._enabling = None
            self.safety.stop(now)
            calls |= Calls.STOP
        arm = bool(wish["arm"][0]) and not stop
        if arm and not self._arm_seen and self.safety.mode != Mode.RUN:
            if self._lost.any():
                names = ", ".join(self.robot.config.joint_names[i] for i in np.flatnonzero(self._lost))
                self.tell(
                    f"not armed: {names} silent for {self.restart_time:g} s or more since connecting; a motor that lost its "
                    "power lost its watchdog too. End this run and start another, which proves everything anew"
                )
            elif now - self._wish.time < self.safety.limits.command_age_hold:
                self._enabling = now
            else:
                self.tell("not armed: the pilot sends no commands; see its messages, then arm again")
        self._arm_seen = arm
        if self._enabling is not None and self._arm(now):
            calls |= Calls.ARM
        if self._ending is not None and now - self._ending > self.damp_time:
            self.safety.off()
            self.done = True
            calls |= Calls.OFF
        return calls

    def _arm(self, now: float) -> bool:
        """Carry an arming on. Returns whether the gate was asked in this tick."""
        state = self._state
        assert self._enabling is not None
        if not state.joint_enabled.all():
            if now - self._enabling > self.enable_time:
                silent = [self.robot.config.joint_names[i] for i in np.flatnonzero(state.joint_enabled == 0)]
                self.tell(f"not armed: no enabled motor answers for {', '.join(silent)}; check power, wiring and ids")
                self._enabling = None
                self.robot.disable()
            else:
                self._guard(self.robot.enable, Calls.STOP)
            return False
        self._enabling = None
        if refusal := self.safety.arm(state, now):
            self.tell(f"not armed: {refusal}")
            if self.safety.mode == Mode.OFF:
                self.robot.disable()
        return True

    def _transmit(self, command: JointCommand) -> None:
        if self.safety.mode != Mode.OFF or self._enabling is not None:
            self._guard(lambda: self.robot.write(command), Calls.STOP_AFTER)
        elif self.record["mode"][0] != Mode.OFF or self._tick == 0:
            self.robot.disable()
        else:
            self._guard(self.robot.poll, Calls.STOP_AFTER)

    def _guard(self, act: Callable[[], None], call: Calls) -> None:
        """Do something on the wire. If it fails the gate is stopped, and ``call`` says so in the record."""
        try:
            act()
        except Exception as error:  # noqa: BLE001 - the loop must not unwind while motors hold torque
            if str(error) != self._told_error:
                self.tell(str(error))
            self._told_error = str(error)
            self._failed |= call
            self.safety.stop(self._state.time)

    def _report_fault(self) -> None:
        fault = self.safety.fault
        if fault is not None and fault is not self._told_fault:
            self.tell(self.safety.explain(fault, self.robot.config.joint_names))
        self._told_fault = fault

    def _store(self, command: JointCommand, calls: Calls, times: tuple[float, float, float]) -> None:
        """Complete the tick's record, for the log and for the next ``sense`` to publish."""
        r, fault = self._fields, self.safety.fault
        start, judged, written = times
        r["now"][0], r["calls"][0] = start, int(calls)
        r["mode"][0], r["limited"][0] = self.safety.mode, self.safety.limited
        r["fault"][0] = fault.rule.number if fault else 0
        r["fault_joint"][0] = fault.joint if fault else -1
        _copy(command, self._sent)
        r["command.time"][0], r["command.object_time"][0] = command.time, command.object_time
        r["timing.safety"][0], r["timing.write"][0] = judged - start, written - judged
        self._count()
        if self.sink is not None:
            self.sink.write(TICK, float(r["time"][0]), self.record)

    def _count(self) -> None:
        """What every bus counted so far, and how much of its time is taken. Numbers of a few buses: plain Python is faster."""
        r, counted = self._fields, [bus.counters for bus in self.robot.buses]
        r["bus.sent"][0], r["bus.received"][0] = [c.sent for c in counted], [c.received for c in counted]
        r["bus.rejected"][0], r["bus.lost"][0] = [c.rejected for c in counted], [c.lost for c in counted]
        frames = [c.sent + c.received for c in counted]
        if self._tick:  # smoothed over a tenth of a second; without what connecting took
            share, loads = 10 * self.period, r["bus.load"][0].tolist()
            r["bus.load"][0] = [
                load + share * ((now - before) * each - load)
                for load, now, before, each in zip(loads, frames, self._frames, self._load, strict=True)
            ]
        self._frames = frames


def _copy(source: JointCommand, target: JointCommand) -> None:
    target.joint_pos[:] = source.joint_pos
    target.joint_vel[:] = source.joint_vel
    target.joint_torque[:] = source.joint_torque
    target.kp[:] = source.kp
    target.kd[:] = source.kd


def main(directory: Path) -> int:
    """The guardian process of the run in ``directory``. Returns 0 after a regular end."""
    life = Life()
    spec = RunSpec.load(directory)
    config, wiring = spec.open()
    joints = config.joint_names
    clock = MonotonicClock()
    try:
        robot = open_robot(config, wiring, simulated_in=str(directory) if spec.simulated else None)
        if spec.simulated:
            robot.connect(clock)
        else:
            calibration = load_calibration(spec.calibration) if spec.calibration else None
            Preflight(config, spec.wiring, wiring, robot, clock, calibration, spec.variants, tell).run()
    except (BusError, WireError, Sim2realError) as error:
        tell(str(error), failed=True)
        return 2
    guardian = Guardian(
        robot,
        Safety(Limits.of(config)),
        clock,
        1.0 / wiring.rate,
        channel(directory, "request", request_layout(joints)),
        channel(directory, "operator", operator_layout()),
        channel(directory, "tick", tick_layout(joints, [b.name for b in wiring.buses])),
        sink(spec),
        tell,
    )

    def goes_on() -> bool:
        if not life.goes_on():
            guardian.quit()
        return not guardian.done

    try:
        keep_time(guardian.tick, guardian.period, spec, 80, goes_on)
    except BaseException:
        guardian.damp_at_once()  # the launcher goes on damping when it sees us die
        raise
    robot.disable()
    robot.close()
    return 0


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1])))
