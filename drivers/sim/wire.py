"""A simulated CAN or CAN-FD bus: every frame takes its exact time on the wire, and the lowest identifier goes first.

The host is a controller with one FIFO (so that its later, more urgent frames wait behind earlier ones); every motor is a
node of its own that answers ``reply_delay`` after a frame has ended. An adapter adds ``latency`` either way. A frame
that nobody on the bus acknowledges is sent again for ever, as real controllers do: then the queue fills up.

A motor at another bit rate takes every frame for an error and breaks it off, until it is error-passive and says no more. By
then the host's controller is error-passive too, or has left the bus: the slower the stranger, the longer its error flags.
The host hears of its controller what Linux tells: error-passive, bus-off, restarted.

Not modelled: other error-passive nodes, how counters fall again after errors other than those, overload frames, two
nodes sending one identifier at once, clock tolerance, an error in the middle of a CAN-FD payload (it breaks the frame
off at its end).
"""

from __future__ import annotations

import hashlib
import random
from bisect import insort
from collections import deque
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import lru_cache
from heapq import heapify, heappop, heappush
from itertools import repeat
from typing import Protocol

import numpy as np

from drivers.bus import BusSpec
from drivers.sim.faults import FEEDBACK, HOST, POWER, Fault
from drivers.wire import (
    BUS_OFF,
    CONTROLLER,
    ERROR,
    ERROR_PASSIVE,
    EXTENDED,
    FRAME,
    RESTARTED,
    WireError,
    WireFull,
    frame_type,
)

ERROR_FRAME_BITS = 20  # error flag (6), its superposition (up to 6), delimiter (8), as good as always
PASSIVE_COUNT = 128  # ISO 11898-1: error counter at which a node only sends error flags that disturb nobody
FLAG_BITS = 6  # of an active error flag
BUS_OFF_COUNT = 256  # ISO 11898-1: transmit error counter at which a controller leaves the bus
BUS_OFF_TRIES = BUS_OFF_COUNT // 8  # failures in a row that take it there; a motor's answer is lost then
RESTART = 0.1  # s: how long the host then stays away (restart-ms 100, the usual setting)
QUEUE_LENGTH = 128  # frames; Linux' default of 10 is too small for a tick (set txqueuelen 128)
TOLERANCE = 1e-9  # s: what sums of times may be off by


class Motors(Protocol):
    """What a wire asks of the motors on it. ``row``: a motor's index over all buses."""

    powered: list[bool]
    deaf: list[dict[int, int]]  # by bus, who has power and listens at another bit rate than its host: {row: bit/s}

    def retune(self, bus: int, bitrate: int) -> None:
        """The host of a bus now talks at ``bitrate``."""
        ...

    def addressee(self, bus: int, id: int, raw: bytes) -> int:
        """Row of the motor that a frame of the host is for; -1: none."""
        ...

    def receive(self, bus: int, id: int, raw: bytes, time: float) -> tuple[int, int, bytes, int] | None:
        """A frame that ended at ``time``: the answer (row, key, raw frame, bits), or None."""
        ...


@dataclass
class Traffic:
    """Counted since the start."""

    frames: int = 0  # carried whole
    busy: float = 0.0  # s the wire was taken
    dropped: int = 0  # carried, but heard by nobody (a fault)
    corrupted: int = 0  # broken off by an error frame
    overflowed: int = 0  # refused: queue full
    bus_off: int = 0  # how often the host's controller left the bus


@lru_cache(4096)
def priority(id: int) -> int:
    """Arbitration key of an identifier, the lowest wins: base identifier first, and a standard frame before an extended
    one with the same base (ISO 11898-1)."""
    if id & EXTENDED:
        return (id >> 18 & 0x7FF) << 19 | 1 << 18 | id & 0x3FFFF
    return (id & 0x7FF) << 19


class SimCan:
    """One bus. ``carry(until)`` lets it work; ``send`` and ``recv`` are the host's end (see SimCanWire)."""

    def __init__(
        self,
        spec: BusSpec,
        index: int,
        first_row: int,
        motors: Motors,
        *,
        seed: int = 0,
        latency: float = 250e-6,
        reply_delay: float = 50e-6,
        queue_length: int = QUEUE_LENGTH,
    ):
        self.spec, self.index, self.traffic = spec, index, Traffic()
        self.frame = frame_type(spec.data_bitrate)
        self.rows = {m.id: first_row + i for i, m in enumerate(spec.motors)}
        self.sent: list[tuple[float, bytes]] = []  # by the host, not yet timed: (ready, raw frames)
        self.inbox: deque[tuple[float, bytes]] = deque()  # (arrival at the host, raw frame)
        self.carried: list[bytes] = []  # raw frames since the last ``digest``
        self._label = b"%d:" % index  # of them in the digest
        self._motors, self._latency, self._reply_delay, self._room = motors, latency, reply_delay, queue_length
        self._bit = 1.0 / spec.bitrate
        self._queue: deque[tuple] = deque()  # the host's: (ready, key, id, raw, bits, tries)
        self._contending: list[tuple] = []  # heap of answers that want the wire: (key, order, answer, tries)
        self._waiting: deque[tuple] = deque()  # answers to come, sorted: (ready, what is then in the heap)
        self._free = 0.0  # when the wire is idle again
        self._order = 0
        self._errors = 0  # the host's transmit error counter
        self._passive = False  # the host was told that its controller is error-passive
        self._strain = 8  # what the last frame that was broken off added to it
        self._upset: dict[int, int] = {}  # receive error counters of motors at another bit rate
        self._away_until = -1.0
        self._faults: list[tuple[Fault, frozenset[int]]] = []
        self._host_faults: list[Fault] = []
        self._stuck: dict[tuple[int, int], bytes] = {}
        self._random = random.Random(f"{seed}/{spec.name}")

    # -- the host's end ----------------------------------------------------------------------------------------------

    def send(self, frames: np.ndarray, now: float) -> None:
        """Queue frames (``frame``, (n,)). Raises WireFull, or WireError while the controller is off the bus."""
        if self._host_faults or now < self._away_until:
            if self.away(now):
                raise WireError(f"{self.spec.name}: bus off; check cable and termination")
            for fault in self._host_faults:
                if fault.kind == "no_buffer" and fault.start <= now < fault.end:
                    if self._random.random() < fault.probability:
                        self._refuse(len(frames), 0)
        unpriced = sum([len(raw) for _, raw in self.sent]) // self.frame.itemsize
        room = max(0, self._room - len(self._queue) - unpriced)
        if room and len(frames):
            self.sent.append((now + self._latency, frames[:room].tobytes()))
        if len(frames) > room:
            self._refuse(len(frames), room)

    def _refuse(self, wanted: int, taken: int) -> None:
        self.traffic.overflowed += wanted - taken
        raise WireFull(
            f"{self.spec.name}: transmit queue took {taken} of {wanted} frames (room for {self._room}); "
            "the bus is too slow, or nobody acknowledges"
        )

    def recv(self, now: float) -> np.ndarray:
        """Frames (``frame``, (n,)) that have reached the host by ``now``."""
        inbox, due = self.inbox, now + TOLERANCE
        raws: list[bytes] = []
        while inbox and inbox[0][0] <= due:
            raws.append(inbox.popleft()[1])
        return np.frombuffer(b"".join(raws), self.frame)

    def retune(self, bitrate: int) -> None:
        """The host's controller was started anew, at ``bitrate``; what it still had to send is gone."""
        self._queue.clear()
        self.sent.clear()
        self._bit = 1.0 / bitrate
        self._errors, self._passive = 0, False
        self._upset.clear()
        self._motors.retune(self.index, bitrate)

    # -- the wire ----------------------------------------------------------------------------------------------------

    def take(self, ready: float, raw: bytes, ids: Iterable[int], bits: Iterable[int]) -> None:
        """Frames of the host, whose length on the wire is now known, enter its controller's queue."""
        size = self.frame.itemsize
        raws = [raw[at : at + size] for at in range(0, len(raw), size)]
        self._queue.extend(zip(repeat(ready), map(priority, ids), ids, raws, bits, repeat(0)))

    def say(self, ready: float, answer: tuple[int, int, bytes, int]) -> None:
        """A motor wants to send a frame (row, key, raw frame, bits) from ``ready`` on: asked, or by itself."""
        self._order += 1
        item = (ready, (answer[1], self._order, answer, 0))
        if self._waiting and self._waiting[-1][0] > ready:  # a fault holds that one back
            insort(self._waiting, item)
        else:
            self._waiting.append(item)

    @property
    def busy(self) -> bool:
        """Somebody wants to send, or something is on its way to the host."""
        return bool(self._queue or self._waiting or self._contending or self.sent or self.inbox)

    @property
    def idle(self) -> bool:
        """The wire itself has nothing to do."""
        return not (self._queue or self._waiting or self._contending)

    def carry(self, until: float) -> None:
        """Let the wire work until ``until``: every frame that ends by then is delivered."""
        queue, waiting, contending, powered = self._queue, self._waiting, self._contending, self._motors.powered
        receive, say, bus, delay, bit = self._motors.receive, self.say, self.index, self._reply_delay, self._bit
        faults = [f for f in self._faults if f[0].start < until and f[0].end > self._free] if self._faults else ()
        deaf = self._motors.deaf[bus]
        if (self._host_faults or self._away_until > self._free or deaf or False in powered) and self._stalls(until):
            return
        traffic, carried, inbox, latency = self.traffic, self.carried, self.inbox, self._latency
        while True:
            start = self._free
            if not contending:
                first = queue[0][0] if queue else until
                if waiting and waiting[0][0] < first:
                    first = waiting[0][0]
                if first > start:
                    start = first
            if start >= until:
                return
            while waiting and waiting[0][0] <= start:
                heappush(contending, waiting.popleft()[1])
            self._free = start
            if queue and queue[0][0] <= start and (not contending or queue[0][1] < contending[0][0]):
                _, _, id, raw, bits, tries = queue[0]
                end = start + bits * bit
                if end > until:
                    return
                queue.popleft()
                if deaf and self._jammed(deaf, start, bits):
                    if not self._fails(start):
                        queue.appendleft((self._free, priority(id), id, raw, bits, tries))
                    continue
                copies = self._spoil_command(faults, start, id, raw, bits, tries) if faults else 1
                if copies is None:
                    continue
                self._free = end
                traffic.busy += end - start
                traffic.frames += 1
                carried.append(raw)
                if self._errors:
                    self._errors -= 1
                    if self._passive and self._errors < PASSIVE_COUNT:
                        self._passive = False
                while copies:
                    copies -= 1
                    answer = receive(bus, id, raw, end)
                    if answer is not None:
                        say(end + delay, answer)
            else:
                key, order, answer, tries = contending[0]
                row, _, raw, bits = answer
                end = start + bits * bit
                if end > until:
                    return
                heappop(contending)
                if not powered[row]:
                    continue
                if deaf and self._jammed(deaf, start, bits):
                    if tries < BUS_OFF_TRIES:
                        insort(waiting, (self._free, (key, order, answer, tries + 1)))
                    continue
                copies = 1
                if faults:
                    copies, raw = self._spoil_feedback(faults, start, key, answer, tries)
                    if copies is None:
                        continue
                self._free = end
                traffic.busy += end - start
                traffic.frames += 1
                carried.append(raw)
                while copies:
                    copies -= 1
                    inbox.append((end + latency, raw))

    def away(self, now: float) -> bool:
        """Whether the host's controller is off the bus."""
        return now < self._away_until or any(f.kind == "bus_off" and f.start <= now < f.end for f in self._host_faults)

    def _stalls(self, until: float) -> bool:
        """Whether nothing moves: the host's controller is gone (what it had queued is lost), or nobody is there to
        acknowledge (its first frame is then sent for ever). Motors hear nothing either way."""
        queue, waiting = self._queue, self._waiting
        first = min((line[0][0] for line in (queue, waiting) if line), default=0.0)
        start = self._free if self._contending else max(self._free, first)
        if self.away(start):
            queue.clear()
        elif queue and not self._acknowledged():
            self.traffic.busy += max(0.0, until - max(start, queue[0][0]))
            self._errors = max(
                self._errors, PASSIVE_COUNT
            )  # no further: nobody there is no fault of its own (ISO 11898-1)
            self._tell(start)
        else:
            return False
        waiting.clear()
        self._contending.clear()
        self._free = max(self._free, until)
        return True

    def _acknowledged(self) -> bool:
        """Whether anybody takes the host's frames, or at least breaks them off."""
        deaf = self._motors.deaf[self.index]
        return any(
            self._motors.powered[row] and (row not in deaf or self._upset.get(row, 0) < PASSIVE_COUNT)
            for row in self.rows.values()
        )

    # -- motors at another bit rate ------------------------------------------------------------------------------------

    def _jammed(self, deaf: Mapping[int, int], start: float, bits: int) -> bool:
        """Whether one of them breaks a frame off that begins at ``start``; all that hear it count it."""
        angry = [row for row in deaf if self._upset.get(row, 0) < PASSIVE_COUNT]
        if not angry:
            return False
        self._break_off(start, bits)
        for row in angry:
            longer = max(1.0, deaf[row] * self._bit)  # the others' flags, in its own bits
            self._upset[row] = self._upset.get(row, 0) + 8 * (1 + int(FLAG_BITS * (longer - 1) // 8))
        slowest = max(1.0, 1 / (self._bit * min(deaf[row] for row in angry)))
        self._strain = 8 * (1 + int(FLAG_BITS * (slowest - 1) // 8))  # and eight more for every eight bits of dominance
        return True

    def _fails(self, start: float) -> bool:
        """The host's frame was broken off: count it. Returns whether its controller left the bus, and forgot what it had."""
        self._errors += self._strain
        if off := self._errors >= BUS_OFF_COUNT:
            self._errors = 0
            self.traffic.bus_off += 1
            self._away_until = start + RESTART
            self._queue.clear()
            self._passive = False
            self._say_error(start, BUS_OFF)
            self._say_error(self._away_until, RESTARTED)
        self._tell(start)
        return off

    def _tell(self, start: float) -> None:
        """The host learns when its controller becomes error-passive."""
        if self._errors >= PASSIVE_COUNT and not self._passive:
            self._passive = True
            self._say_error(start, CONTROLLER, ERROR_PASSIVE & 0x20)

    def _say_error(self, time: float, what: int, how: int = 0) -> None:
        frame = np.zeros(1, self.frame)
        frame["id"], frame["length"] = ERROR | what, 8
        frame["data"][0, 1] = how
        self.inbox.append((time + self._latency, frame.tobytes()))

    # -- faults ------------------------------------------------------------------------------------------------------

    def inject(self, fault: Fault) -> None:
        """Add a fault that befalls this bus (POWER faults are the motors' own)."""
        if fault.kind in HOST:
            self._host_faults.append(fault)
        elif fault.kind not in POWER:
            names = {self.rows[m.id]: m.joint for m in self.spec.motors}
            rows = frozenset(row for row, joint in names.items() if fault.befalls(self.spec.name, joint))
            self._faults.append((fault, rows))

    def _hits(self, faults, start: float, row: int):
        for fault, rows in faults:
            everyone = fault.motor == "*"
            if fault.start <= start < fault.end and (everyone or row in rows):
                if fault.probability >= 1.0 or self._random.random() < fault.probability:
                    yield fault

    def _spoil_command(self, faults, start, id, raw, bits, tries) -> int | None:
        """How often the host's frame is heard; None: it was not carried (broken off, or held back)."""
        copies = 1
        row = self._motors.addressee(self.index, id, raw)
        for fault in self._hits(faults, start, row):
            if fault.kind == "drop":
                copies = 0
                self.traffic.dropped += 1
            elif fault.kind == "duplicate":
                copies = 2
            elif fault.kind == "delay" and tries == 0:
                self._queue.appendleft((start + fault.value, priority(id), id, raw, bits, 1))
                return None
            elif fault.kind == "corrupt":
                self._break_off(start, bits)
                self._strain = 8
                if not self._fails(start):
                    self._queue.appendleft((self._free, priority(id), id, raw, bits, tries))
                return None
        return copies

    def _spoil_feedback(self, faults, start, key, answer, tries) -> tuple[int | None, bytes]:
        """How often a motor's frame is heard (None: it was not carried), and what it says by then."""
        copies: int | None = 1
        row, _, raw, bits = answer
        for fault in self._hits(faults, start, row):
            if fault.kind == "drop":
                copies = 0
                self.traffic.dropped += 1
            elif fault.kind == "duplicate":
                copies = 2
            elif fault.kind == "delay" and tries == 0:
                insort(self._waiting, (start + fault.value, (key, self._order, answer, 1)))
                return None, raw
            elif fault.kind == "corrupt":
                self._break_off(start, bits)
                if tries < BUS_OFF_TRIES:
                    insort(self._waiting, (self._free, (key, self._order, answer, tries + 1)))
                return None, raw
            elif fault.kind in FEEDBACK:
                raw = self._lie(fault, row, raw)
        return copies, raw

    def _break_off(self, start: float, bits: int) -> None:
        spent = (bits + ERROR_FRAME_BITS) * self._bit
        self._free = start + spent
        self.traffic.busy += spent
        self.traffic.corrupted += 1

    def _lie(self, fault: Fault, row: int, raw: bytes) -> bytes:
        if fault.kind == "stuck":
            return self._stuck.setdefault((id(fault), row), raw)
        if fault.kind == "garbage":
            return raw[:8] + self._random.randbytes(len(raw) - 8)
        at = self._random.randrange(64 if self.frame == FRAME else max(1, 8 * raw[4]))
        data = bytearray(raw)
        data[8 + at // 8] ^= 1 << at % 8
        return bytes(data)

    def forget(self, row: int) -> None:
        """A motor lost its power: what it wanted to say is gone."""
        self._upset.pop(row, None)
        self._waiting = deque(w for w in self._waiting if w[1][2][0] != row)
        self._contending = [c for c in self._contending if c[2][0] != row]
        heapify(self._contending)

    def digest(self, sha: hashlib._Hash) -> None:
        """Add what was carried since the last call, in its order."""
        if self.carried:
            sha.update(self._label + b"".join(self.carried))
            self.carried.clear()


class SimCanWire:
    """The host's end of a SimCan: a drivers.wire.CanWire. ``now`` tells simulated time."""

    def __init__(self, bus: SimCan, now: Callable[[], float]):
        self._bus, self._now, self._open = bus, now, True

    def send(self, frames: np.ndarray) -> None:
        self._check()
        self._bus.send(frames, self._now())

    def recv(self) -> np.ndarray:
        self._check()
        return self._bus.recv(self._now())

    def _check(self) -> None:
        if not self._open:
            raise WireError(f"{self._bus.spec.name}: used after close; open the wire again")

    def fileno(self) -> int:
        return -1

    def close(self) -> None:
        self._open = False
