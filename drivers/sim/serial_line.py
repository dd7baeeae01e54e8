"""A simulated half-duplex serial line: ten bits a byte, one speaker at a time, an adapter's latency either way.

Servos answer one after the other, each its own return delay and GAP behind the one before. Who speaks while another does
garbles both. Faults are those of faults.py; ``drop``, ``corrupt``, ``garbage``, ``wrong``, ``stuck``, ``delay`` and
``duplicate`` befall answers, and ``drop`` and ``corrupt`` without a motor the host's packets too; ``bus_off`` is an adapter
that was unplugged.

Not modelled: framing errors, noise between packets, clock tolerance, an adapter's own buffers.
"""

from __future__ import annotations

import hashlib
import math
import random
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from heapq import heappop, heappush
from typing import Any

from drivers.bus import BusSpec
from drivers.serial_bus import BITS_PER_BYTE
from drivers.sim.faults import HOST, POWER, Fault
from drivers.sim.servo_table import TableServos
from drivers.wire import WireError, WireFull

GAP = 20e-6  # s between two answers, besides the return delay
TOLERANCE = 1e-9  # s
SPOILED = ("corrupt", "drop")  # faults that keep a host's packet from the servos


@dataclass
class Traffic:
    """Counted since the start."""

    packets: int = 0  # of the host, that servos understood
    answers: int = 0
    busy: float = 0.0  # s the line was taken
    collisions: int = 0
    faulty: int = 0  # answers that a fault befell


class SerialLine:
    """One line. ``carry(until)`` lets it work; ``write`` and ``read`` are the host's end (see SerialLineWire)."""

    def __init__(self, spec: BusSpec, servos: TableServos, *, seed: int = 0, latency: float = 250e-6, gap: float = GAP):
        self.spec, self.servos, self.traffic = spec, servos, Traffic()
        self._byte = BITS_PER_BYTE / spec.bitrate
        self._latency, self._gap = latency, gap
        self._parser = servos.parser()
        self._sent: deque[tuple[float, bytearray]] = deque()  # by the host: (when its first byte starts, bytes)
        self._inbox: deque[list] = deque()  # [start, bytes, how many of them were read], in their order
        self._host_free = self._line_free = 0.0
        self._faults: list[Fault] = []
        self._power: list[tuple[float, int, int, bool]] = []  # heap of (time, order, row, on)
        self._stuck: dict[tuple[int, int], bytes] = {}
        self._random = random.Random(f"{seed}/{spec.name}")
        self._carried: list[bytes] = []

    # -- the host's end ----------------------------------------------------------------------------------------------

    def write(self, data: bytes, now: float) -> None:
        """Queue bytes. Raises WireError or WireFull where a fault says so."""
        if (fault := self._host_fault(now)) is not None:
            if fault.kind == "bus_off":
                raise WireError(f"{self.spec.name}: the adapter has gone; unplugged?")
            raise WireFull(f"{self.spec.name}: the port takes nothing")
        start = max(now + self._latency, self._host_free)
        self._host_free = start + len(data) * self._byte
        self._sent.append((start, bytearray(data)))
        self.traffic.busy += len(data) * self._byte

    def read(self, now: float) -> bytes:
        """The bytes that have arrived by ``now``."""
        if (fault := self._host_fault(now)) is not None and fault.kind == "bus_off":
            raise WireError(f"{self.spec.name}: the adapter has gone; unplugged?")
        out = b""
        while self._inbox:
            start, data, taken = self._inbox[0]
            there = min(len(data), math.floor((now - self._latency - start) / self._byte + 1e-6))
            if there <= taken:
                break
            out += data[taken:there]
            if there < len(data):
                self._inbox[0][2] = there
                break
            self._inbox.popleft()
        return out

    def retune(self, bitrate: int) -> None:
        """The host's port now runs at ``bitrate``."""
        self._byte = BITS_PER_BYTE / bitrate
        self.servos.retune(bitrate)

    def _host_fault(self, now: float) -> Fault | None:
        for fault in self._faults:
            if fault.kind in HOST and fault.start <= now < fault.end and self._random.random() < fault.probability:
                return fault
        return None

    # -- time --------------------------------------------------------------------------------------------------------

    def carry(self, until: float) -> None:
        """Let the line work up to ``until``."""
        while self._power and self._power[0][0] <= until + TOLERANCE:
            time, _, row, on = heappop(self._power)
            self.servos.power(row, on, time)
        while self._sent:
            start, data = self._sent[0]
            done = min(len(data), math.floor((until - start) / self._byte + 1e-6))
            if done <= 0:
                break
            part = data[:done]
            self._collide(start, part)
            del data[:done]
            if data:
                self._sent[0] = (start + done * self._byte, data)
            else:
                self._sent.popleft()
            self._carried.append(bytes(part))
            for packet in self._parser.feed(bytes(part)):
                self._deliver(packet, start + packet.end * self._byte)

    def _deliver(self, packet: Any, time: float) -> None:
        for fault in self._faults:
            if fault.motor == "*" and fault.kind in SPOILED and self._strikes(fault, time):
                return
        self.traffic.packets += 1
        at = max(time, self._line_free)
        for row, delay, answer in self.servos.receive(packet, time):
            at += delay + self._gap
            for raw, heard in self._befall(row, answer, at):
                at = max(at, heard)
                if raw:
                    self._inbox.append([at, raw, 0])
                    self._carried.append(bytes(raw))
                at += len(answer) * self._byte
                self.traffic.busy += len(answer) * self._byte
            self.traffic.answers += 1
        self._line_free = at

    def _befall(self, row: int, answer: bytes, time: float) -> list[tuple[bytearray, float]]:
        """What becomes of an answer: (bytes that the host hears, none if it is lost; when it starts)."""
        copies = 1
        joint = self.servos.joints[row]
        for fault in self._faults:
            if not fault.befalls(self.spec.name, joint) or not self._strikes(fault, time):
                continue
            self.traffic.faulty += 1
            if fault.kind == "drop":
                return [(bytearray(), time)]
            if fault.kind == "delay":
                time += fault.value
            elif fault.kind == "duplicate":
                copies = 2
            elif fault.kind == "corrupt":
                raw = bytearray(answer)
                at = self._random.randrange(8 * len(raw))
                raw[at // 8] ^= 1 << at % 8
                answer = bytes(raw)
            elif fault.kind in ("garbage", "wrong", "stuck"):
                answer = self._lie(fault.kind, row, answer)
        return [(bytearray(answer), time)] * copies

    def _lie(self, kind: str, row: int, answer: bytes) -> bytes:
        """An answer with another payload, and a check that fits."""

        def change(payload: bytearray) -> None:
            if kind == "garbage":
                payload[1:] = self._random.randbytes(len(payload) - 1)
            elif kind == "stuck":
                payload[:] = self._stuck.setdefault((row, len(payload)), bytes(payload))
            elif len(payload) > 1:
                at = self._random.randrange(8, 8 * len(payload))
                payload[at // 8] ^= 1 << at % 8

        return self.servos.retell(answer, change)

    def _collide(self, start: float, part: bytearray) -> None:
        """Garble what the host sends while a servo speaks, and what that says."""
        end = start + len(part) * self._byte
        for entry in self._inbox:
            first, data, taken = entry
            last = first + len(data) * self._byte
            if first >= end - TOLERANCE or last <= start + TOLERANCE:
                continue
            self.traffic.collisions += 1
            low, high = max(first, start), min(last, end)
            for said, at in ((part, start), (data, first)):
                for k in range(math.floor((low - at) / self._byte + 1e-6), math.ceil((high - at) / self._byte - 1e-6)):
                    said[k] ^= self._random.randrange(1, 256)
        self._line_free = max(self._line_free, end)

    def _strikes(self, fault: Fault, time: float) -> bool:
        return fault.start <= time < fault.end and self._random.random() < fault.probability

    # -- things that happen to it ------------------------------------------------------------------------------------

    def inject(self, fault: Fault) -> None:
        """Make something go wrong."""
        if fault.kind not in POWER:
            self._faults.append(fault)
            return
        back = fault.start + fault.value if fault.kind == "reboot" else fault.end
        for row, joint in enumerate(self.servos.joints):
            if fault.befalls(self.spec.name, joint):
                heappush(self._power, (fault.start, len(self._power), row, False))
                if back < math.inf:
                    heappush(self._power, (back, len(self._power), row, True))

    @property
    def busy(self) -> bool:
        """Bytes are on their way."""
        return bool(self._sent or self._inbox)

    @property
    def next_arrival(self) -> float:
        """When the answers on their way have arrived whole (s); inf: none is."""
        return max((start + len(data) * self._byte for start, data, _ in self._inbox), default=math.inf) + self._latency

    def digest(self, sha: hashlib._Hash) -> None:
        """Add what was carried since the last call."""
        for data in self._carried:
            sha.update(self.spec.name.encode() + data)
        self._carried.clear()


class SerialLineWire:
    """The host's end: a drivers.wire.SerialWire."""

    def __init__(self, line: SerialLine, now: Callable[[], float]):
        self._line, self._now, self._open = line, now, True

    def write(self, data: bytes) -> None:
        self._check()
        self._line.write(data, self._now())

    def read(self) -> bytes:
        self._check()
        return self._line.read(self._now())

    def _check(self) -> None:
        if not self._open:
            raise WireError(f"{self._line.spec.name}: used after close; open the wire again")

    def fileno(self) -> int:
        return -1

    def close(self) -> None:
        self._open = False
