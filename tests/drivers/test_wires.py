"""One drive on every wire that there is: connect, hold a target, let go, and be told when the wire has gone.

The same driver and the same twin each time; only what is between them differs. In lockstep it is a simulated wire; the others
are served by a thread, in real time: unix sockets, python-can's virtual bus (classic and FD), a pseudo-terminal, DDS.
"""

from __future__ import annotations

import threading
import time
import uuid
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from can_bench import rig
from sim_robots import ARM, BUS, IMU, write_model

from drivers.bus import BusError, BusSpec, MotorBus, MotorCommand, MotorSpec, MotorState
from drivers.codecs import feetech
from drivers.open import open_bus, open_world
from drivers.sim.bridge import PtyBridge, can_bridge, dds_bridge
from drivers.sim.serve import serve

PERIOD = 0.01  # s
PATIENCE = 30.0  # s: machines are busy
CAN = replace(BUS, watchdog=0.5)
FD = replace(rig("moteus"), watchdog=0.5)
DYNAMIXEL = BusSpec("arm", "dynamixel", (MotorSpec("left", "XM540-W270", 1), MotorSpec("right", "XM540-W270", 2)), "serial",
                    bitrate=1_000_000, watchdog=0.5)  # fmt: skip
FEETECH = replace(DYNAMIXEL, protocol="feetech", watchdog=feetech.NO_WATCHDOG,
                  motors=(MotorSpec("left", "STS3215-12V", 1), MotorSpec("right", "STS3215-12V", 2)))  # fmt: skip
G1_MODEL = ARM.replace('"left"', '"left_hip_pitch_joint"').replace('"right"', '"right_hip_pitch_joint"')
G1 = BusSpec("arm", "unitree_hg", (MotorSpec("left_hip_pitch_joint", "M7520-14", 0),
                                   MotorSpec("right_hip_pitch_joint", "M7520-14", 6)), "dds", watchdog=0.0)  # fmt: skip


class Wire(NamedTuple):
    """A bus, and how its wire is made: with what to serve it (None: in lockstep), and interface and channel to open."""

    spec: BusSpec
    serve: Callable[[BusSpec, Path, str], Any] | None = None
    interface: str = "sim"
    channel: str = "{folder}/arm.sock"


WIRES: dict[str, Wire] = {
    "simulated CAN": Wire(CAN),
    "simulated CAN-FD": Wire(FD),
    "simulated line": Wire(DYNAMIXEL),
    "simulated line, Feetech": Wire(FEETECH),
    "simulated DDS": Wire(G1),
    "socket, CAN": Wire(CAN, lambda *_: None),
    "socket, CAN-FD": Wire(FD, lambda *_: None),
    "socket, serial": Wire(DYNAMIXEL, lambda *_: None),
    "socket, DDS": Wire(G1, lambda *_: None),
    "python-can": Wire(CAN, lambda spec, _, id: can_bridge(spec, f"virtual:{id}"), "virtual", "{id}"),
    "python-can, FD": Wire(FD, lambda spec, _, id: can_bridge(spec, f"virtual:{id}"), "virtual", "{id}"),
    "terminal": Wire(DYNAMIXEL, lambda _, folder, __: PtyBridge(folder / "arm.tty"), "serial", "{folder}/arm.tty"),
    "terminal, Feetech": Wire(
        FEETECH, lambda _, folder, __: PtyBridge(folder / "arm.tty"), "serial", "{folder}/arm.tty"
    ),
    "DDS": Wire(G1, lambda spec, _, id: dds_bridge(spec, f"lo:{id}"), "dds", "lo:{id}"),
}


class Drive:
    """A bus, its twin, and the clock of both (a drivers.bus.Clock)."""

    def __init__(self, bus: MotorBus, world: Any, lockstep: bool) -> None:
        self.bus, self.world, self.lockstep = bus, world, lockstep

    def now(self) -> float:
        return self.world.time if self.lockstep else time.monotonic()

    def sleep_until(self, due: float) -> None:
        if self.lockstep:
            self.world.advance(due)
        else:
            time.sleep(max(0.0, due - time.monotonic()))

    def connect(self) -> None:
        """In real time it may take some tries: a busy machine does not answer within the 40 ms that each is given."""
        end = self.now() + PATIENCE
        while True:
            try:
                return self.bus.connect(self)
            except BusError as error:
                if self.lockstep or "no answer" not in str(error) or self.now() > end:
                    raise

    def until(self, condition: Callable[[MotorState], bool], act: Callable[[], None]) -> MotorState:
        end = self.now() + PATIENCE
        while True:
            act()
            self.sleep_until(self.now() + PERIOD)
            state = self.bus.read(self.now())
            if condition(state):
                return state
            assert self.now() < end, state

    def command(self, position: float, kp: float, kd: float) -> None:
        zero = np.zeros(2)
        self.bus.write(MotorCommand(zero + position, zero, zero + kp, zero + kd, zero))


@pytest.fixture(params=WIRES)
def drive(request, tmp_path) -> Iterator[Drive]:
    wire = WIRES[request.param]
    if wire.spec.protocol == "unitree_hg" and wire.interface == "dds":
        pytest.importorskip("cyclonedds", reason="Cyclone DDS is not installed: pip install 'sim2real[dds]'")
    id = str(150 + uuid.uuid4().int % 80)
    model = write_model(tmp_path, G1_MODEL if wire.spec.protocol == "unitree_hg" else ARM)
    world = open_world(model, "base", [wire.spec], IMU, hang=None)
    if wire.serve is None:
        yield Drive(open_bus(wire.spec, world.wires["arm"]), world, lockstep=True)
        return
    bridge, started, stop = wire.serve(wire.spec, tmp_path, id), threading.Event(), threading.Event()
    options = {"ready": started.set, "goes_on": lambda: not stop.is_set(), "bridges": {"arm": bridge} if bridge else {}}
    thread = threading.Thread(target=serve, args=(world, tmp_path), kwargs=options | {"warn": lambda _: None})
    thread.start()
    assert started.wait(10)
    channel = wire.channel.format(folder=tmp_path, id=id)
    bus = open_bus(replace(wire.spec, interface=wire.interface, channel=channel))
    try:
        yield Drive(bus, world, lockstep=False)
    finally:
        bus.close()
        stop.set()
        thread.join(10)
    assert not thread.is_alive()


def rests(state: MotorState) -> bool:
    """At the target."""
    return np.abs(state.position - 0.3).max() < 0.02 and np.abs(state.velocity).max() < 0.05


def test_a_drive(drive):
    bus = drive.bus
    drive.connect()
    state = drive.until(lambda s: bool(np.isfinite(s.position).all()), bus.poll)
    assert not state.enabled.any() and np.abs(state.position).max() < 0.01

    def hold() -> None:
        if not bus.read(drive.now()).enabled.all():
            bus.enable()
        drive.command(0.3, 12.0, 0.6)

    state = drive.until(lambda s: bool(s.enabled.all() and rests(s)), hold)
    assert not state.error.any() and np.abs(drive.world.plant.joint_pos - 0.3).max() < 0.05
    bus.disable()
    drive.until(lambda s: not s.enabled.any(), bus.poll)
    drive.sleep_until(drive.now() + 2 * PERIOD)
    assert (drive.world.plant.joint_torque == 0.0).all()
    assert bus.counters.received > 10
    assert (
        not bus.counters.rejected or not drive.lockstep
    )  # a twin that is late on a busy machine talks into a question


def test_a_closed_wire_says_so(drive):
    drive.connect()
    drive.bus.close()
    with pytest.raises(BusError):
        drive.bus.poll()
        drive.bus.read(drive.now())
