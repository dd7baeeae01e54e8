"""A bench of emulated servos, each turning a wheel, moved on in lockstep by the clock of its host."""

from __future__ import annotations

from drivers.bus import BusSpec
from drivers.codecs.dynamixel_packet import Packet
from drivers.open import PROTOCOLS, load, open_bus
from drivers.serial_bus import SerialBus
from drivers.sim.faults import parse_fault
from drivers.sim.serial_line import SerialLine, SerialLineWire
from drivers.sim.serial_pty import Wheels, bus_of

SUBSTEP = 0.002  # s
PERIOD = 0.004  # s between two ticks


class Bench:
    """Servos, their line, and the clock by which they live (a drivers.bus.Clock)."""

    def __init__(self, n: int = 3, faults: tuple[str, ...] = (), spec: BusSpec | None = None, seed: int = 0, **options):
        timing = {k: options.pop(k) for k in ("latency", "gap") if k in options}
        self.spec = spec or bus_of("XM430-W350", n)
        self.body = Wheels(len(self.spec.motors))
        self.servos = load(PROTOCOLS[self.spec.protocol].motors)(self.spec, self.body, **options)
        self.line = SerialLine(self.spec, self.servos, seed=seed, **timing)
        for fault in faults:
            self.line.inject(parse_fault(fault))
        self.time = 0.0
        self._substeps = 0
        self.wire = SerialLineWire(self.line, self.now)
        self._parser = self.servos.parser()

    def now(self) -> float:
        return self.time

    def sleep_until(self, time: float) -> None:
        while (due := (self._substeps + 1) * SUBSTEP) <= time + 1e-9:
            self.line.carry(due)
            self.servos.act(due - SUBSTEP, due)
            self.body.step(SUBSTEP)
            self._substeps += 1
            self.time = due
        if time > self.time:
            self.line.carry(time)
            self.time = time

    def wait(self, seconds: float) -> None:
        self.sleep_until(self.time + seconds)

    def connected(self) -> SerialBus:
        bus = open_bus(self.spec, self.wire)
        bus.connect(self)
        return bus

    def ask(self, raw: bytes, seconds: float = 0.01) -> list[Packet]:
        """Every packet that comes back within ``seconds``."""
        self.wire.write(raw)
        self.wait(seconds)
        return self._parser.feed(self.wire.read())


def tick(bus: SerialBus, bench: Bench, command=None, ticks: int = 1, period: float = PERIOD):
    """Poll or write, let a period pass, read: ``ticks`` times. Returns the last state."""
    state = None
    for _ in range(ticks):
        bus.poll() if command is None else bus.write(command)
        bench.wait(period)
        state = bus.read(bench.time)
    return state
