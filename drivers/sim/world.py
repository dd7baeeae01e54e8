"""The simulated twin: a plant, its motors on their buses, and its IMU, moved on by one clock.

``advance(until)`` lets everything happen up to a time: frames travel, motors obey, the plant moves. Nothing in here owns
a thread or looks at a clock, so the same inputs and the same seed give the same bytes (``digest``).

    host: wires[bus].send(frames) at time t
      -> adapter latency -> wire (frame time, arbitration, faults) -> motor: answers, then obeys
      -> wire -> adapter latency -> wires[bus].recv()

Feedback tells the state at the start of the physics substep in which the motor was asked. For what the parts leave out,
see the docstrings of plant.py, motor.py, wire.py and imu.py.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from heapq import heappop, heappush
from pathlib import Path
from typing import Any

import numpy as np

from drivers.budget import bits_of
from drivers.bus import BusError, BusSpec, ImuSpec
from drivers.open import PROTOCOLS, load
from drivers.sim.ball import Ball
from drivers.sim.faults import IMU, POWER, Fault, parse_fault
from drivers.sim.imu import ImuNoise, SimImu, SimSerialWire
from drivers.sim.motor import MotorEvent, SimMotors
from drivers.sim.plant import Plant
from drivers.sim.truth import Truth
from drivers.sim.wire import QUEUE_LENGTH, TOLERANCE, SimCan, SimCanWire


class World:
    """A robot in MuJoCo behind simulated wires: CAN buses, or what a derived class makes of them in ``_wire``.

    ``joint_pos``: where its joints start (by name, rad). ``hang``: metres of air under the feet while it hangs from the
    gantry at the start; None: it stands, without gantry. ``noise``: uniform, rad, on the starting joints.
    ``faults``: Faults or their text form. ``prepare``: see Plant. ``wiring``: what ``_wire`` takes.
    """

    motors: Any  # behind all buses, in their order
    imu: Any  # samples the plant
    wires: Mapping[str, Any]  # the host's ends, by bus
    imu_wire: Any
    ports: Mapping[str, Any] = {}  # serve.Ports of what is no CAN bus
    buses: Sequence[SimCan] = ()

    def __init__(
        self,
        model_path: str | Path,
        base: str,
        buses: Sequence[BusSpec],
        imu: ImuSpec,
        *,
        timestep: float = 0.002,
        seed: int = 0,
        faults: Sequence[Fault | str] = (),
        prepare: Callable[[Any], None] | None = None,
        joint_pos: Mapping[str, float] | None = None,
        hang: float | None = 0.01,
        noise: float = 0.0,
        **wiring: Any,
    ):
        self._check(buses)
        self.time = 0.0
        self.plant = Plant(model_path, [m.joint for b in buses for m in b.motors], base, timestep, prepare, imu.site)
        self.plant.reset(joint_pos, hang=hang, noise=noise, seed=seed)
        self._timestep = timestep
        self._substeps = 0  # done so far
        self._sha = hashlib.sha256()
        self._power: list[tuple[float, int, int, bool]] = []  # heap of (time, order, row, on)
        self._wire(buses, imu, seed, **wiring)
        for fault in faults:
            self.inject(fault)

    def _check(self, buses: Sequence[BusSpec]) -> None:
        """Raise BusError for buses that have no emulation here."""
        _motors_of(buses)

    def _wire(
        self,
        buses: Sequence[BusSpec],
        imu: ImuSpec,
        seed: int,
        *,
        registers: Mapping[str, Mapping[str, float]] | None = None,
        wrap: bool = False,
        imu_noise: ImuNoise | None = None,
        latency: float = 250e-6,
        reply_delay: float = 50e-6,
        queue_length: int = QUEUE_LENGTH,
    ) -> None:
        """Put motors and IMU on the plant, and wires to them. ``registers`` and ``wrap``: see SimMotors."""
        self.motors = _motors_of(buses)(buses, self.plant, bits_of(buses[0]), registers=registers, wrap=wrap)
        firsts = np.cumsum([0, *(len(b.motors) for b in buses)]).tolist()
        self.buses = [
            SimCan(spec, i, firsts[i], self.motors, seed=seed, latency=latency, reply_delay=reply_delay,
                   queue_length=queue_length)
            for i, spec in enumerate(buses)
        ]  # fmt: skip
        self.wires = {bus.spec.name: SimCanWire(bus, self.now) for bus in self.buses}
        self._wire_imu(imu, seed, imu_noise, latency)

    def _wire_imu(self, spec: ImuSpec, seed: int, noise: ImuNoise | None, latency: float) -> None:
        """An IMU on a serial line of its own."""
        self.imu = SimImu(spec, self.plant, seed=seed, noise=noise, latency=latency)
        self.imu_wire = SimSerialWire(self.imu, self.now)

    # -- time --------------------------------------------------------------------------------------------------------

    def now(self) -> float:
        """Simulated time (s)."""
        return self.time

    def advance(self, until: float) -> None:
        """Let everything happen up to ``until`` (s). The plant moves in whole substeps; the wires exactly."""
        end = self.next_substep
        while end <= until + TOLERANCE:
            start = end - self._timestep
            if self._power and self._power[0][0] <= start + TOLERANCE:
                self._switch_power(start)
            if self.motors.speaks:
                for bus, ready, answer in self.motors.unasked(start, end):
                    self.buses[bus].say(ready, answer)
            self._carry(end)
            self.motors.act(start, end)
            self.plant.step()
            self._substeps += 1
            self.time = end
            self.imu.sample(end)
            end = self.next_substep
        if until > self.time + TOLERANCE:
            self._carry(until)
            self.time = until

    def _carry(self, until: float) -> None:
        self._price()
        for bus in self.buses:
            if not bus.idle:
                bus.carry(until)
                bus.digest(self._sha)
        self.imu.digest(self._sha)

    def _price(self) -> None:
        """Give every frame that hosts sent its length on the wire, all in one pass."""
        talking = [bus for bus in self.buses if bus.sent]
        if not talking:
            return
        raws = b"".join([raw for bus in talking for _, raw in bus.sent])
        bits = self.motors.refresh(raws)
        frame = self.buses[0].frame
        ids = np.frombuffer(raws, frame)["id"].tolist()
        at = 0
        for bus in talking:
            for ready, raw in bus.sent:
                end = at + len(raw) // frame.itemsize
                bus.take(ready, raw, ids[at:end], bits[at:end])
                at = end
            bus.sent.clear()

    @property
    def next_substep(self) -> float:
        """When the plant moves next (s)."""
        return (self._substeps + 1) * self._timestep

    @property
    def busy(self) -> bool:
        """Frames are on their way."""
        return any(bus.busy for bus in self.buses)

    # -- things that happen to it ------------------------------------------------------------------------------------

    def inject(self, fault: Fault | str) -> None:
        """Make something go wrong. Raises BusError for a fault that befalls nothing here."""
        fault = parse_fault(fault) if isinstance(fault, str) else fault
        if fault.bus == IMU:
            self.imu.inject(fault)
            return
        motors = enumerate(zip(self.motors.bus_names, self.motors.joints, strict=True))
        rows = [row for row, (bus, joint) in motors if fault.befalls(bus, joint)]
        if not rows:
            names = ", ".join([*self.wires, IMU])
            raise BusError(
                f"fault '{fault.kind}': nothing here is '{fault.bus}/{fault.motor}', expected one of the buses {names} "
                "and, after a slash, one of its joints"
            )
        self._befall(fault, rows)

    def _befall(self, fault: Fault, rows: list[int]) -> None:
        """Let a fault befall the motors ``rows`` and their buses."""
        if fault.kind in POWER:
            back = fault.start + fault.value if fault.kind == "reboot" else fault.end
            for row in rows:
                heappush(self._power, (fault.start, len(self._power), row, False))
                if back < np.inf:
                    heappush(self._power, (back, len(self._power), row, True))
            return
        for bus in self.buses:
            if fault.befalls(bus.spec.name):
                bus.inject(fault)

    def _switch_power(self, now: float) -> None:
        while self._power and self._power[0][0] <= now + TOLERANCE:
            _, _, row, on = heappop(self._power)
            self.motors.power(row, on, now)
            if not on:
                for bus in self.buses:
                    if row in bus.rows.values():
                        bus.forget(row)

    def push(self, velocity_delta: Sequence[float]) -> None:
        """Change the base's velocity at once; (3,) m/s in the world."""
        self.plant.push(velocity_delta)

    def hold(self) -> None:
        """Stop lowering the gantry."""
        self.plant.gantry.hold()

    def lower(self, rate: float = 0.1) -> None:
        """Lower the gantry at ``rate`` m/s."""
        self.plant.gantry.lower(rate)

    def release(self) -> None:
        """Unhook the gantry."""
        self.plant.release()

    def carry_ball(self, position: Sequence[float]) -> None:
        """A person holds the ball at ``position`` (3,) m in the world."""
        self._ball.carry(position)

    def throw_ball(self, position: Sequence[float], velocity: Sequence[float]) -> None:
        """The ball flies from ``position`` (3,) m with ``velocity`` (3,) m/s in the world."""
        self._ball.throw(position, velocity)

    def let_go_ball(self) -> None:
        """Nobody holds the ball any more."""
        self._ball.let_go()

    @property
    def _ball(self) -> Ball:
        if self.plant.ball is None:
            raise BusError("ball: there is none in this world; expected one made with add_ball and add_person")
        return self.plant.ball

    # -- what happened -----------------------------------------------------------------------------------------------

    @property
    def digest(self) -> str:
        """SHA-256 (hex) over all frames and packets carried so far, in their order, with their wire."""
        return self._sha.hexdigest()

    @property
    def motor_log(self) -> list[MotorEvent]:
        """What happened in the motors, in order."""
        return self.motors.log

    def last_command_times(self) -> dict[str, float]:
        """By joint, when its motor last heard a command that it obeyed (s; -inf: never)."""
        return dict(zip(self.motors.joints, self.motors.last_command_time.tolist(), strict=True))

    def counters(self) -> dict[str, dict[str, float]]:
        """By bus: see wire.Traffic, and ``load``, the share of all time so far that the wire was taken."""
        return {
            b.spec.name: asdict(b.traffic) | {"load": b.traffic.busy / self.time if self.time else 0.0}
            for b in self.buses
        }

    def truth(self) -> Truth:
        return self.plant.truth()


def _motors_of(buses: Sequence[BusSpec]) -> type[SimMotors]:
    """The class of emulated motors that ``buses`` need. Raises BusError."""
    emulated = {name: p.motors for name, p in PROTOCOLS.items() if p.wire == "can" and p.motors}
    for spec in buses:
        if spec.protocol not in emulated:
            raise BusError(
                f"bus {spec.name}: no emulated motors for '{spec.protocol}', expected one of {', '.join(emulated)}"
            )
        if spec.protocol != buses[0].protocol:
            raise BusError(
                f"bus {spec.name}: got protocol '{spec.protocol}', expected '{buses[0].protocol}' as on bus "
                f"{buses[0].name}: a simulated robot has one CAN protocol"
            )
    return load(emulated[buses[0].protocol])
