"""Wires that fail under a running robot: what is dropped, what damps, what comes back, and that nothing old is replayed.

Lockstep, the production guardian and buses on simulated wires, judged by what the emulated motors did.
"""

from __future__ import annotations

import numpy as np
import pytest

from drivers.open import open_world
from drivers.reopening import RETRY_PERIOD, ReopeningWire
from drivers.wire import WireError, WireGone
from sim2real.channel import Channel
from sim2real.clock import Schedule, SimClock
from sim2real.config import load_robot
from sim2real.guardian import Guardian, operator_layout, request_layout
from sim2real.records import command_view, tick_layout
from sim2real.robot import open_robot
from sim2real.safety import Limits, Safety
from sim2real.types import Mode


class Run:
    """The bench robot under its guardian; a pilot that asks for its home posture, moved on by ``tick``."""

    def __init__(self, *faults: str, wires=None) -> None:
        config = self.config = load_robot("bench")
        wiring = config.wiring()
        home = dict(zip(config.joint_names, config.home_pos, strict=True))
        world = self.world = open_world(config.model_path, config.base, wiring.bus_specs(), wiring.imu_spec(),
                                        joint_pos=home, faults=faults)  # fmt: skip
        self.clock = SimClock(world.advance, lambda: world.time)
        self.told: list[str] = []
        joints = config.joint_names
        states = Channel(tick_layout(joints, [b.name for b in wiring.buses]))
        self.requests, self.wishes = Channel(request_layout(joints)), Channel(operator_layout())
        carried = {**world.wires, "imu": world.imu_wire}
        self.robot = open_robot(config, wiring, carried | (wires(world, self) if wires else {}))
        world.advance(3.0)  # it hung limp, and now hangs still
        self.robot.connect(self.clock)
        self.guardian = Guardian(self.robot, Safety(Limits.of(config)), self.clock, 1 / wiring.rate, self.requests,
                                 self.wishes, states, tell=self.told.append)  # fmt: skip
        self.schedule = Schedule(self.clock, 1 / wiring.rate)
        self.schedule.start()
        self.wish, self.request = self.wishes.layout.new(), self.requests.layout.new()

    def go(self, seconds: float, arm: bool = False) -> Mode:
        """Let ``seconds`` pass with the operator asking to be armed, or not."""
        end = self.world.time + seconds
        command = command_view(self.request, "command")
        while self.world.time < end:
            due = self.schedule.wait()
            self.wish["skill"], self.wish["arm"] = -1, arm
            self.wishes.write(self.wish)
            self.request["command.time"], self.request["command.object_time"] = self.clock.now(), np.inf
            command.joint_pos[:], command.kp[:], command.kd[:] = self.config.home_pos, 30.0, 1.0
            self.requests.write(self.request)
            self.guardian.tick(due)
        return self.guardian.safety.mode

    def running(self) -> Run:
        assert self.go(0.3, arm=True) == Mode.RUN
        self.go(0.1)
        return self

    def events(self, since: float) -> list[str]:
        return [e.event for e in self.world.motor_log if e.time > since]


def test_a_queue_that_is_full_for_a_moment_costs_ticks_and_nothing_else():
    run = Run("no_buffer@3.6-3.63").running()
    assert run.go(0.5) == Mode.RUN
    assert run.robot.buses[0].counters.lost > 3 and "watchdog" not in run.events(3.3)


@pytest.mark.parametrize("fault", ["no_buffer@3.6-3.9", "bus_off@3.6-3.75"])
def test_a_bus_that_stalls_damps_and_never_drives_again_by_itself(fault):
    run = Run(fault).running()
    assert run.go(0.8) == Mode.DAMP
    assert "driving" not in run.events(3.61)  # nothing old was replayed when the bus came back
    assert not (run.world.motors.enabled & (run.world.motors._effect == 3)).any()


def test_after_a_short_stall_the_operator_may_arm_again():
    """The controller restarts after 100 ms (restart-ms 100); the motors never lost their power."""
    run = Run("bus_off@3.6-3.7").running()
    run.go(2.5)  # it sank, and hangs still
    assert len(run.told) == 1 and "bus off" in run.told[0]  # and said so once
    assert run.go(0.3, arm=True) == Mode.RUN


def test_a_motor_that_lost_its_power_lost_its_watchdog_and_is_not_armed_again():
    run = Run("reboot:arm/elbow_joint=0.3@3.6").running()
    assert run.go(0.8) == Mode.DAMP
    assert run.world.motors.register("elbow_joint", "TIMEOUT") == 0
    assert run.go(0.3, arm=True) == Mode.DAMP
    assert any("elbow_joint silent for 0.2 s or more" in text and "lost its watchdog" in text for text in run.told)
    assert "driving" not in run.events(3.61)


class Adapter:
    """The wire of a bus behind an adapter that is unplugged for a while."""

    def __init__(self, wire, now, away: tuple[float, float]) -> None:
        self.wire, self.now, self.away, self.opened = wire, now, away, 0

    def open(self) -> Port:
        if self.away[0] <= self.now() < self.away[1]:
            raise WireError("no such device")
        self.opened += 1
        self.wire.recv()  # a driver that was opened has nothing from before
        return Port(self)


class Port:
    """What ``open`` gives: dead for ever once the adapter was away."""

    def __init__(self, adapter: Adapter) -> None:
        self.adapter, self.opened = adapter, adapter.now()

    def _check(self) -> None:
        start, _ = self.adapter.away
        if self.opened < start <= self.adapter.now():
            raise WireGone("no such device; unplugged?")

    def send(self, frames: np.ndarray) -> None:
        self._check()
        self.adapter.wire.send(frames)

    def recv(self) -> np.ndarray:
        self._check()
        return self.adapter.wire.recv()

    def fileno(self) -> int:
        return -1

    def close(self) -> None: ...


def plugged(start: float, end: float):
    def wires(world, run: Run):
        run.adapter = Adapter(world.wires["arm"], lambda: world.time, (start, end))
        return {"arm": ReopeningWire(run.adapter.open, lambda: world.time)}

    return wires


def test_unplugged_damps_and_plugged_in_again_is_heard_again_and_not_driven():
    run = Run(wires=plugged(3.6, 4.2)).running()
    assert run.go(0.5) == Mode.DAMP
    assert any("unplugged" in text for text in run.told)
    assert set(run.events(3.6)) == {"watchdog"}  # by themselves, for nobody spoke to them
    run.go(0.8)
    assert run.adapter.opened == 2
    state = run.robot.buses[0].read(run.clock.now())
    assert (run.clock.now() - state.time < 0.02).all()  # heard again
    assert not run.world.motors.enabled.any() and "driving" not in run.events(3.6)
    assert run.go(0.3, arm=True) == Mode.DAMP and any("End this run" in text for text in run.told)


def test_a_wire_that_is_gone_is_tried_again_now_and_then():
    time, tries = [0.0], []

    class Dead(Port):
        def __init__(self) -> None: ...

        def _check(self) -> None:
            raise WireGone("gone")

    def open() -> Dead:
        tries.append(time[0])
        if len(tries) in (2, 3):
            raise WireError("no such device")
        return Dead()

    wire = ReopeningWire(open, lambda: time[0])
    for n in range(100):
        time[0] = n * 0.01
        with pytest.raises(WireError):
            wire.recv()
    assert len(tries) == 4 and np.diff(tries[1:]) == pytest.approx(RETRY_PERIOD, abs=0.02)


def test_what_is_not_gone_is_not_opened_again():
    class Off(Port):
        def __init__(self) -> None: ...

        def _check(self) -> None:
            raise WireError("bus off")

    opened = []
    wire = ReopeningWire(lambda: opened.append(1) or Off(), lambda: 0.0)
    for _ in range(3):
        with pytest.raises(WireError, match="bus off"):
            wire.recv()
    assert opened == [1]
