"""Benchmark: how often a bus can be commanded and heard whole on its simulated wire, against what that wire can carry.

The limit of CAN is that of its bits: commands and answers, stuffed, back to back. A serial line takes turns: its limit is a
turn as long as the bytes, the servos' gaps and the adapter's latency make it, the next one sent at once.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from bench_table import Row

from drivers.bus import BusSpec, ImuSpec, MotorCommand, MotorSpec
from drivers.open import open_bus, open_world
from drivers.sim.serial_pty import bus_of
from sim2real.clock import SimClock

SHARE = 0.9  # of the limit that we want to reach
TICKS, SLACK = 300, 3  # ticks by which answers may be behind, so that nothing piles up
STEP = 0.005  # of the limit, between two rates tried
LOOK = 10e-6  # s between two looks at the line
JOINT = '<body><joint name="{0}" axis="0 0 1" armature="0.01"/><geom size="0.01" mass="0.1" contype="0" conaffinity="0"/></body>'
MODEL = '<mujoco><worldbody><body name="base"><site name="imu"/>{0}</body></worldbody></mujoco>'


def rows() -> Iterator[Row]:
    """Six CAN motors, twenty servos."""
    motors = tuple(MotorSpec(f"joint_{i}", "DM8009", i, i + 0x10) for i in range(1, 7))
    can = BusSpec("can", "damiao", motors)
    yield row("6 motors, CAN at 1 Mbit/s", can, busy(can), "of bits back to back")
    serial = bus_of("XM430-W350", 20, 4_000_000)
    yield row("20 Dynamixel servos, 4 Mbit/s", serial, turn(serial), "of turns back to back, 1/4 adapter's latency")


def row(words: str, spec: BusSpec, least: float, of: str) -> Row:
    """``least``: s of a tick at the limit."""
    share = next(s for s in np.arange(1.0, 0.0, -STEP).tolist() if sustained(spec, least / s))
    return Row(f"rate: {words}", f"{share / least:.0f} Hz", f"{1 / least:.0f} Hz {of}", f"{share:.1%}", f">= {SHARE:.0%}",
               share >= SHARE, {"hz": share / least, "limit_hz": 1 / least})  # fmt: skip


class Rig:
    """A bus connected to its twin in lockstep. ``tick`` hears and commands all of it."""

    def __init__(self, spec: BusSpec) -> None:
        with TemporaryDirectory() as folder:
            path = Path(folder) / "rig.xml"
            path.write_text(MODEL.format("".join(JOINT.format(m.joint) for m in spec.motors)))
            self.world = world = open_world(path, "base", [spec], ImuSpec("hipnuc"), hang=None)
        self.clock = SimClock(world.advance, lambda: world.time)
        self.motors: Any = open_bus(spec, world.wires[spec.name])
        self.motors.connect(self.clock)
        self.clock.sleep_until(world.time + 0.01)
        self.motors.read(world.time)
        self._rng, self.heard_before = np.random.default_rng(0), self.motors.counters.received

    def tick(self) -> None:
        zero = np.zeros(len(self.motors.spec.motors))
        self.motors.read(self.world.time)
        self.motors.write(MotorCommand(self._rng.uniform(-1, 1, len(zero)), zero, zero + 20.0, zero + 1.0, zero))


def busy(spec: BusSpec) -> float:
    """s for which a tick takes the wire."""
    rig, start = Rig(spec), 0.0
    for _ in range(TICKS + 1):
        rig.tick()
        rig.clock.sleep_until(rig.world.time + 0.01)
        start = start or rig.world.buses[0].traffic.busy
    return (rig.world.buses[0].traffic.busy - start) / TICKS


def turn(spec: BusSpec) -> float:
    """s from a command to the last of the answers, at the host."""
    rig, took = Rig(spec), 0.0
    for _ in range(TICKS):
        sent = rig.world.time
        rig.tick()
        while rig.motors.waiting > 0:
            rig.clock.sleep_until(rig.world.time + LOOK)
            rig.motors.read(rig.world.time)
        took += rig.world.time - sent
    return took / TICKS


def sustained(spec: BusSpec, period: float) -> bool:
    """Whether every tick goes out and is answered by all, and in time, at that rate."""
    rig, n = Rig(spec), len(spec.motors)
    start = rig.world.time
    for k in range(TICKS):
        rig.clock.sleep_until(start + k * period)
        rig.tick()
        counted = rig.motors.counters
        if counted.lost or counted.received - rig.heard_before < n * (k - SLACK):
            return False
    return True
