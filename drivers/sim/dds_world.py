"""A World whose robot is reached over DDS: samples on topics instead of frames on buses.

A sample takes ``latency`` and arrives whole, or is lost; loopback and a quiet Ethernet are like that. Faults befall what
travels between the host and the robot, by bus, or as ``imu`` what the IMU's reader gets.
"""

from __future__ import annotations

import random
from collections import deque
from collections.abc import Sequence
from heapq import heappop, heappush
from typing import Any

import numpy as np

from drivers.bus import BusError, BusSpec, ImuSpec
from drivers.codecs import unitree_hg as hg
from drivers.dds_bus import StateStream
from drivers.sim.dds_port import DdsPort
from drivers.sim.dds_robot import SimG1, only_bus
from drivers.sim.faults import IMU, POWER, Fault, parse_fault
from drivers.sim.imu import ImuNoise, multiply
from drivers.sim.wire import TOLERANCE
from drivers.sim.world import World
from drivers.wire import WireError

BLOCK = 256  # samples of noise drawn at once
FAULTS = ("drop", "delay", "corrupt", "duplicate", "stuck", "off", "reboot")  # those of faults.KINDS that DDS can have


class Link:
    """One way of one reader or writer, with what goes wrong on it."""

    def __init__(self, seed: str) -> None:
        self.faults: list[Fault] = []
        self.dropped = self.corrupted = 0
        self._random = random.Random(seed)
        self._stuck: dict[tuple[int, str], bytes] = {}

    def pass_on(self, topic: str, payload: bytes, now: float) -> list[tuple[float, bytes]]:
        """What becomes of a sample: (s of delay, payload) of every copy that arrives."""
        delay, copies = 0.0, 1
        for fault in self.faults:
            if not fault.start <= now < fault.end or self._random.random() >= fault.probability:
                continue
            if fault.kind in ("drop", "off"):
                self.dropped += 1
                return []
            if fault.kind == "delay":
                delay += fault.value
            elif fault.kind == "duplicate":
                copies = 2
            elif fault.kind == "stuck":
                payload = self._stuck.setdefault((id(fault), topic), payload)
            elif fault.kind == "corrupt":
                self.corrupted += 1
                spoiled = bytearray(payload)
                at = self._random.randrange(32, 8 * len(payload))
                spoiled[at // 8] ^= 1 << at % 8
                payload = bytes(spoiled)
        return [(delay, payload)] * copies


class DdsWorld(World):
    """A G1 in MuJoCo behind simulated DDS. Arguments as for World."""

    def _check(self, buses: Sequence[BusSpec]) -> None:
        only_bus(buses)

    def _wire(
        self,
        buses: Sequence[BusSpec],
        imu: ImuSpec,
        seed: int,
        *,
        imu_noise: ImuNoise | None = None,
        latency: float = 250e-6,
        others: int = 0,
        **robot: Any,
    ) -> None:
        """``robot``: what else SimG1 takes. ``others``: how many other programs publish LowCmd, as far as a host can see
        (they say nothing here)."""
        (spec,) = buses
        self.motors = SimG1(spec, self.plant, **robot)
        self.others, self.latency = others, latency
        self.up = Link(f"{seed}/{spec.name}/up")  # from the host to the robot
        self._down = {spec.name: SimDdsWire(self, f"{seed}/{spec.name}/down"), IMU: SimDdsWire(self, f"{seed}/{IMU}")}
        self.imu = StatePublisher(self, imu, seed, imu_noise or ImuNoise())
        self.wires = {spec.name: self._down[spec.name]}
        self.ports = {spec.name: DdsPort(self, self._down[spec.name])}
        self.imu_wire = StateStream(self._down[IMU])
        self._travelling: list[tuple[float, int, str, bytes]] = []  # heap of (arrival, order, topic, payload)
        self._sent = self._published = 0

    def send(self, topic: str, payload: bytes, now: float) -> None:
        """A sample leaves the host at ``now``."""
        for delay, copy in self.up.pass_on(topic, payload, now):
            self._sent += 1
            heappush(self._travelling, (now + self.latency + delay, self._sent, topic, copy))

    def publish(self, topic: str, payload: bytes, time: float) -> None:
        """A sample leaves the robot, for every reader."""
        self._published += 1
        self._sha.update(topic.encode() + payload)
        for wire in self._down.values():
            for delay, copy in wire.link.pass_on(topic, payload, time):
                wire.arrive(time + self.latency + delay, topic, copy)

    def _carry(self, until: float) -> None:
        while self._travelling and self._travelling[0][0] <= until + TOLERANCE:
            time, _, topic, payload = heappop(self._travelling)
            self._sha.update(topic.encode() + payload)
            for of, answer in self.motors.receive(topic, payload, time):
                self.publish(of, answer, time)

    @property
    def busy(self) -> bool:
        return bool(self._travelling) or any(wire.busy for wire in self._down.values())

    def inject(self, fault: Fault | str) -> None:
        """Make something go wrong. Raises BusError for a fault that DDS does not have, or that befalls nothing here."""
        fault = parse_fault(fault) if isinstance(fault, str) else fault
        if fault.kind not in FAULTS:
            raise BusError(f"fault: got kind '{fault.kind}', expected one that DDS can have: {', '.join(FAULTS)}")
        if fault.bus == IMU:
            self._down[IMU].link.faults.append(fault)
        else:
            super().inject(fault)

    def _befall(self, fault: Fault, rows: list[int]) -> None:
        if fault.kind in POWER:
            super()._befall(fault, rows)
            return
        name = self.motors.spec.name
        if fault.motor != "*":
            raise BusError(f"fault '{fault.kind}': a sample holds all motors; expected '{fault.kind}:{name}'")
        self._down[name].link.faults.append(fault)
        if fault.kind != "stuck":  # of what the robot says
            self.up.faults.append(fault)

    def counters(self) -> dict[str, dict[str, float]]:
        """By bus: samples sent to the robot, published by it, and lost or damaged between."""
        name = self.motors.spec.name
        down = self._down[name].link
        return {
            name: {
                "sent": self._sent,
                "published": self._published,
                "ignored": self.motors.ignored,
                "dropped": self.up.dropped + down.dropped,
                "corrupted": self.up.corrupted + down.corrupted,
            }
        }


class StatePublisher:
    """Publishes LowState every 1/rate s, with noise on what the IMU in it says."""

    def __init__(self, world: DdsWorld, spec: ImuSpec, seed: int, noise: ImuNoise) -> None:
        if spec.orientation_imu_in_base != (1.0, 0.0, 0.0, 0.0):
            raise BusError("imu: a G1's is mounted straight; expected orientation_imu_in_base 1, 0, 0, 0")
        self._world, self._period = world, 1.0 / spec.rate
        self._samples = 0
        self._generator = np.random.default_rng([seed, 0x1A])
        self._scale = np.repeat([noise.orientation / 2, noise.angular_velocity, noise.acceleration], 3)
        self._mean = np.concatenate([np.zeros(3), noise.angular_velocity_bias, noise.acceleration_bias])

    def hear(self, data: bytes, now: float) -> None:
        """Nobody tells it anything."""

    def sample(self, now: float) -> None:
        """Publish what is due by ``now``."""
        if now + TOLERANCE < (self._samples + 1) * self._period:
            return
        at = self._samples % BLOCK
        self._samples += 1
        if at == 0:
            self._block = self._generator.standard_normal((BLOCK, 9)) * self._scale + self._mean
        noise, plant = self._block[at], self._world.plant
        orientation = np.array(multiply(plant.orientation_imu_in_world.tolist(), (1.0, *noise[:3].tolist())))
        imu = (
            orientation / np.linalg.norm(orientation),
            plant.angular_velocity_imu_in_imu + noise[3:6],
            plant.acceleration_imu_in_imu + noise[6:9],
        )
        self._world.publish(hg.STATE_TOPIC, self._world.motors.state(imu, now), now)

    def read(self, now: float) -> bytes:
        """What has arrived for the IMU's reader by ``now``."""
        return self._world.imu_wire.read()


class SimDdsWire:
    """A host's end of a simulated domain: a drivers.wire.DdsWire."""

    def __init__(self, world: DdsWorld, seed: str) -> None:
        self.link = Link(seed)
        self._world = world
        self._inbox: dict[str, deque[tuple[float, bytes]]] = {}
        self._open = True

    def arrive(self, time: float, topic: str, payload: bytes) -> None:
        """A sample that can be read from ``time`` on. What nobody reads is lost, the oldest first."""
        self._inbox.setdefault(topic, deque(maxlen=16)).append((time, payload))

    @property
    def busy(self) -> bool:
        return any(self._inbox.values())

    def write(self, topic: str, payload: bytes) -> None:
        self._check()
        self._world.send(topic, payload, self._world.time)

    def read(self, topic: str) -> list[bytes]:
        self._check()
        inbox = self._inbox.get(topic, ())
        arrived = [payload for time, payload in inbox if time <= self._world.time + TOLERANCE]
        if arrived:
            rest = [sample for sample in inbox if sample[0] > self._world.time + TOLERANCE]
            self._inbox[topic] = deque(rest, maxlen=16)
        return arrived

    def writers(self, topic: str) -> int:
        return self._world.others if topic == hg.COMMAND_TOPIC else 0

    def close(self) -> None:
        self._open = False

    def _check(self) -> None:
        if not self._open:
            raise WireError("used after close; open the wire again")
