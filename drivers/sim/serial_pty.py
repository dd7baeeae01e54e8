"""Emulated Dynamixel or Feetech servos on a pseudo-terminal, in real time, for programs that expect a serial port.

    python -m drivers.sim.serial_pty --model XM430-W350 --count 20 --baud 4000000
    -> /dev/pts/7        open that with dynamixel-sdk, DYNAMIXEL Wizard, or a wiring's ``channel``
    python -m drivers.sim.serial_pty --model STS3215-12V --count 6 --baud 1000000         for Feetech's SDK, lerobot, ...

Ids count from 1. Each servo turns a wheel of its own (Wheels), free of gravity. A pseudo-terminal has no speed: answers
leave when the simulated line would have carried them, ``--instant`` at once.
"""

from __future__ import annotations

import argparse
import os
import select
import sys
import time
import tty
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from drivers.bus import BusError, BusSpec, MotorSpec
from drivers.codecs import dynamixel, feetech
from drivers.open import PROTOCOLS, load
from drivers.sim.faults import parse_fault
from drivers.sim.serial_line import SerialLine

TIMESTEP = 0.002  # s
READ_SIZE = 65536
INSTANT = 10**12  # bit/s


class Wheels:
    """n wheels of ``inertia`` kg m^2, each on a motor: what servos drive where there is no robot (a motor.Body)."""

    def __init__(self, n: int, inertia: float = 0.01):
        self.joint_pos, self.joint_vel, self.joint_torque = np.zeros((3, n))
        self._inertia = inertia
        self._law = np.zeros((3, n))
        self._limit = np.full(n, np.inf)

    def drive(self, bias: np.ndarray, kp: np.ndarray, kd: np.ndarray) -> None:
        self._law = np.array([bias, kp, kd])

    def limit(self, torque: np.ndarray) -> None:
        self._limit = np.array(torque)

    def step(self, timestep: float) -> None:
        """Move on; implicit in the velocity, so that stiff damping stays stable."""
        bias, kp, kd = self._law
        inertia, h = self._inertia, timestep
        velocity = (self.joint_vel + h * (bias - kp * self.joint_pos) / inertia) / (1 + h * (kd + h * kp) / inertia)
        torque = np.clip((velocity - self.joint_vel) * inertia / h, -self._limit, self._limit)
        self.joint_torque = torque
        self.joint_vel = self.joint_vel + h * torque / inertia
        self.joint_pos = self.joint_pos + h * self.joint_vel


class PtyServer:
    """``line`` behind a pseudo-terminal whose other end is ``path``; ``body`` moves on with real time."""

    def __init__(self, line: SerialLine, body: Wheels):
        self.line, self._body = line, body
        self._master, self._slave = os.openpty()  # ours stays open, so that hosts may come and go
        tty.setraw(self._slave)
        os.set_blocking(self._master, False)
        self.path = os.ttyname(self._slave)
        self._substeps = 0

    def run(self, goes_on: Callable[[], bool] = lambda: True) -> None:
        """Serve while ``goes_on()``, asked at least every substep."""
        began = time.monotonic()
        while goes_on():
            now = time.monotonic() - began
            due = min((self._substeps + 1) * TIMESTEP, self.line.next_arrival)
            if select.select([self._master], [], [], max(0.0, due - now))[0]:
                self.line.write(os.read(self._master, READ_SIZE), time.monotonic() - began)
            self._advance(time.monotonic() - began)
            if out := self.line.read(time.monotonic() - began):
                try:
                    os.write(self._master, out)
                except BlockingIOError:
                    pass  # nobody reads there: lost, as on a wire

    def _advance(self, now: float) -> None:
        self._substeps = max(self._substeps, int(now / TIMESTEP) - 25)  # a lag beyond 50 ms is not caught up
        while (self._substeps + 1) * TIMESTEP <= now:
            start = self._substeps * TIMESTEP
            self._substeps += 1
            self.line.carry(start + TIMESTEP)
            self.line.servos.act(start, start + TIMESTEP)
            self._body.step(TIMESTEP)
        self.line.carry(now)

    def close(self) -> None:
        os.close(self._slave)
        os.close(self._master)


def serve_servos(spec: BusSpec, *, instant: bool = False, fast: bool = True, faults: Sequence[str] = ()) -> PtyServer:
    """A server of the servos of ``spec``. ``instant``: no time on the line. Raises BusError for an unknown model or
    fault."""
    body = Wheels(len(spec.motors))
    servos = load(PROTOCOLS[spec.protocol].motors)(spec, body, fast=fast)
    slow = SerialLine(spec, servos, latency=0.0)
    line = SerialLine(replace(spec, bitrate=INSTANT), servos, latency=0.0, gap=0.0) if instant else slow
    for fault in faults:
        line.inject(parse_fault(fault))
    return PtyServer(line, body)


def bus_of(model: str, count: int, baud: int = 4_000_000, **changes) -> BusSpec:
    """A bus of ``count`` servos with the ids 1, 2, ... and joints of these names."""
    motors = tuple(MotorSpec(f"servo_{i}", model, i) for i in range(1, count + 1))
    own: dict[str, Any] = {"protocol": "dynamixel"}
    if model in feetech.MODELS:
        own = {"protocol": "feetech", "watchdog": feetech.NO_WATCHDOG}
    elif model not in dynamixel.MODELS:
        raise BusError(f"no model '{model}', expected one of {', '.join([*dynamixel.MODELS, *feetech.MODELS])}")
    return BusSpec(**{"name": "servos", "motors": motors, "interface": "serial", "bitrate": baud} | own | changes)


def main(argv: list[str] | None = None) -> int:
    """Print the path of the pseudo-terminal, then serve until the process that started this ends."""
    parser = argparse.ArgumentParser(prog="python -m drivers.sim.serial_pty", description=main.__doc__)
    parser.add_argument("--model", default="XM430-W350")
    parser.add_argument("--count", type=int, default=20)
    parser.add_argument("--baud", type=int, default=4_000_000)
    parser.add_argument("--instant", action="store_true", help="no time on the line")
    parser.add_argument("--no-fast", action="store_true", help="firmware without fast reads")
    parser.add_argument("--fault", action="append", default=[], help="like drop:servos/servo_3@5; see faults.py")
    a = parser.parse_args(argv)
    parent = os.getppid()
    try:
        server = serve_servos(bus_of(a.model, a.count, a.baud), instant=a.instant, fast=not a.no_fast, faults=a.fault)
    except BusError as error:
        print(error, file=sys.stderr)
        return 2
    print(server.path, flush=True)
    try:
        server.run(lambda: os.getppid() == parent)
    except KeyboardInterrupt:
        pass
    finally:
        server.close()
    return 0


if __name__ == "__main__":
    sys.exit(main())
