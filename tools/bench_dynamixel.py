"""Benchmark: 20 Dynamixel servos, emulated behind a pseudo-terminal: CPU of a cycle, and the cost of a lost answer."""

from __future__ import annotations

import select
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from time import perf_counter, process_time, sleep

import numpy as np
from bench_table import ROOT, Row

from drivers.bus import MotorCommand
from drivers.open import open_bus
from drivers.serial_wire import PySerialWire
from drivers.sim.serial_pty import bus_of
from sim2real.clock import MonotonicClock

SERVOS, BAUD, FAULT_AT = 20, 4_000_000, 6.0  # bit/s, s after the servos started
FACTOR, LOSS = 8.0, 2e-3  # less CPU than the SDK; s of a cycle that a lost answer may cost
Cycle = Callable[[], int]  # returns how many servos were heard


def rows() -> Iterator[Row]:
    """CPU of a cycle on a line that takes its time and on one that does not; what one lost answer adds to a cycle."""
    for option, words in (([], "4 Mbit/s"), (["--instant"], "no time on the line")):
        with port("--no-fast", *option) as path:
            ours, theirs = measured([host(path), sdk(path)], process_time, 20, least=SERVOS)
        what, ratio = f"dynamixel: goals and states of {SERVOS} servos, {words}, CPU a cycle", theirs / ours
        yield Row(what, f"{ours * 1e6:.0f} us", f"{theirs * 1e6:.0f} us dynamixel-sdk", f"{ratio:.1f}x less",
                  f">= {FACTOR:g}x", ratio >= FACTOR, {"seconds": {"ours": ours, "sdk": theirs}})  # fmt: skip
    with port("--no-fast") as whole, port("--no-fast", "--fault", f"drop:servos/servo_10@{FAULT_AT}") as lossy:
        cycles = [host(whole, True), sdk(whole), host(lossy, True), sdk(lossy)]
        sleep(FAULT_AT)
        cost, sdk_cost = np.diff(np.reshape(measured(cycles, perf_counter, 5, 0.01), (2, 2)), axis=0)[0].tolist()
        heard = max(cycles[2]() for _ in range(9))
    yield Row(f"dynamixel: a lost answer, {heard} of {SERVOS} servos heard, cycle longer by", f"{cost * 1e3:.2f} ms",
              f"{sdk_cost * 1e3:.0f} ms dynamixel-sdk, the rest dropped", "", "< 2 ms", cost < LOSS and heard == SERVOS - 1,
              {"seconds": {"ours": cost, "sdk": sdk_cost}})  # fmt: skip


@contextmanager
def port(*options: str) -> Iterator[str]:
    """The path of a pseudo-terminal with servos behind it."""
    program = ["-m", "drivers.sim.serial_pty", "--count", str(SERVOS), "--baud", str(BAUD), *options]
    with subprocess.Popen([sys.executable, *program], cwd=ROOT, stdout=subprocess.PIPE, text=True) as server:
        try:
            assert server.stdout is not None
            yield server.stdout.readline().strip()
        finally:
            server.terminate()


def measured(cycles: list[Cycle], clock: Callable[[], float], blocks: int, rest=0.0, least=0) -> list[float]:
    """Least seconds of each cycle that heard ``least`` servos, in interleaved blocks of ten: others only make it slower."""
    times = np.zeros((len(cycles), blocks, 10))
    for block, k, i in np.ndindex(blocks, len(cycles), 10):
        sleep(rest)  # s, for answers that a busy machine brings late: the next cycle would take them for its own
        start, heard = clock(), cycles[k]()
        times[k, block, i] = clock() - start if heard >= least else np.inf  # who did not wait for all was cheap
    return times.min(axis=(1, 2)).tolist()


def host(path: str, drain: bool = False) -> Cycle:
    """Our cycle: goals out (``drain``: late answers in), states in until all have answered or time is over; how many did."""
    clock, wire, command = MonotonicClock(), PySerialWire(path, BAUD), MotorCommand(*np.zeros((5, SERVOS)))
    (servos := open_bus(bus_of("XM430-W350", SERVOS, BAUD), wire)).connect(clock)

    def cycle() -> int:
        began = clock.now()
        if drain:
            servos.read(began)
        servos.write(command)
        while (left := servos.waiting) > 0.0:
            select.select([wire], [], [], left)
            servos.read(clock.now())
        return int(np.count_nonzero(servos.read(clock.now()).time > began))

    return cycle


def sdk(path: str) -> Cycle:
    """The maker's: goal positions out, then current, velocity and position of each servo in, as numbers."""
    import dynamixel_sdk as api

    serial, packets, ids = api.PortHandler(path), api.PacketHandler(2.0), range(1, SERVOS + 1)
    serial.openPort(), serial.setBaudRate(BAUD)
    goals, present = api.GroupSyncWrite(serial, packets, 116, 4), api.GroupSyncRead(serial, packets, 126, 10)
    for id in ids:
        goals.addParam(id, [0, 8, 0, 0]), present.addParam(id)

    def cycle() -> int:
        goals.txPacket()
        result = present.txRxPacket()
        values = [[present.getData(id, *item) for item in ((126, 2), (128, 4), (132, 4))] for id in ids]
        return len(values) if result == api.COMM_SUCCESS else 0

    return cycle
