"""Sightings of the object as UDP datagrams: what a camera or motion-capture computer sends.

One datagram is one sighting, 60 bytes, little endian:

    offset  type       what
    0       char[4]    "S2RO"
    4       uint16     version, 1
    6       uint16     frame: 0, seen from the robot; 1, seen in a world with the floor at z = 0 (motion capture)
    8       uint32     sequence: one more each time, wrapping; an older one than the newest is dropped
    12      uint64     stamp, ns: CLOCK_MONOTONIC of the robot's computer at the exposure
    20      float32[3] m, the object's centre: in the base (frame 0) or in the world (frame 1)
    32      float32[3] m, the base's origin in the world; zeros for frame 0
    44      float32[4] w, x, y, z, of the base in the world; zeros for frame 0

A sender on another computer has to translate its clock (PTP, or half a round trip): a stamp in the future is refused, and
so is one older than the tracker remembers. The default address is the loopback: whoever opens the port to a network
decides whom the robot believes.
"""

from __future__ import annotations

import math
import socket
import struct
from dataclasses import dataclass

import numpy as np

from sim2real.quaternion import rotate
from sim2real.tracker import ObjectSample
from sim2real.types import Sim2realError

LAYOUT = struct.Struct("<4sHHIQ3f3f4f")
MAGIC, VERSION = b"S2RO", 1
IN_BASE, IN_WORLD = 0, 1
ADDRESS = ("127.0.0.1", 47201)


class PacketError(Sim2realError):
    """A datagram that is no sighting."""


def encode(
    sequence: int,
    time: float,
    position_object: np.ndarray,
    position_base_in_world: np.ndarray | None = None,
    orientation_base_in_world: np.ndarray | None = None,
) -> bytes:
    """A sighting at ``time`` (s, CLOCK_MONOTONIC): (3,) m in the base, or in the world where the base's pose is given."""
    in_world = position_base_in_world is not None and orientation_base_in_world is not None
    base = position_base_in_world if in_world else np.zeros(3)
    turn = orientation_base_in_world if in_world else np.zeros(4)
    stamp = round(time * 1e9)
    frame = IN_WORLD if in_world else IN_BASE
    return LAYOUT.pack(MAGIC, VERSION, frame, sequence & 0xFFFFFFFF, stamp, *position_object, *base, *turn)  # type: ignore[misc]


def decode(data: bytes) -> tuple[int, ObjectSample]:
    """Sequence number and sighting. Raises PacketError."""
    if len(data) != LAYOUT.size:
        raise PacketError(f"object packet: got {len(data)} bytes, expected {LAYOUT.size}")
    magic, version, frame, sequence, stamp, *numbers = LAYOUT.unpack(data)
    if magic != MAGIC or version != VERSION:
        raise PacketError(f"object packet: got {magic!r} version {version}, expected {MAGIC!r} version {VERSION}")
    if frame not in (IN_BASE, IN_WORLD):
        raise PacketError(f"object packet: got frame {frame}, expected {IN_BASE} (base) or {IN_WORLD} (world)")
    if not all(map(math.isfinite, numbers)):
        raise PacketError("object packet: got a number that is not finite, expected metres and a quaternion")
    position, base, turn = np.array(numbers[0:3]), np.array(numbers[3:6]), np.array(numbers[6:10])
    if frame == IN_BASE:
        return sequence, ObjectSample(stamp * 1e-9, position)
    norm = float(np.linalg.norm(turn))
    if abs(norm - 1) > 0.01:
        raise PacketError(f"object packet: got an orientation of norm {norm:.3f}, expected 1")
    back = turn / norm * [1.0, -1.0, -1.0, -1.0]
    return sequence, ObjectSample(stamp * 1e-9, rotate(back, position - base), float(base[2]))


@dataclass
class Received:
    """Datagrams so far."""

    good: int = 0
    bad: int = 0
    disordered: int = 0
    missing: int = 0


class Receiver:
    """Turns datagrams into sightings, in order; ``received`` counts what they were."""

    def __init__(self) -> None:
        self.received = Received()
        self._newest: int | None = None

    def take(self, data: bytes) -> ObjectSample | None:
        """The sighting in ``data``; None: it is none, or not newer than one before."""
        try:
            sequence, sample = decode(data)
        except PacketError:
            self.received.bad += 1
            return None
        if self._newest is not None:
            step = (sequence - self._newest) & 0xFFFFFFFF
            if step == 0 or step >= 0x80000000:
                self.received.disordered += 1
                return None
            self.received.missing += step - 1
        self._newest = sequence
        self.received.good += 1
        return sample


def listen(address: tuple[str, int] = ADDRESS) -> socket.socket:
    """A UDP socket bound to ``address``. Raises PacketError where the port is taken, or no such address is ours."""
    sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    try:
        sock.bind(address)
    except OSError as error:
        sock.close()
        raise PacketError(f"udp {address[0]}:{address[1]}: {error.strerror}, expected a free port") from None
    return sock


class UdpSightings(Receiver):
    """Sightings that come to a socket of ``listen``; ``read`` never blocks."""

    most = 64  # datagrams a read: a flood must not hold up a tick

    def __init__(self, sock: socket.socket) -> None:
        super().__init__()
        self._socket = sock
        self._socket.setblocking(False)
        self.address: tuple[str, int] = sock.getsockname()

    def read(self, now: float = 0.0) -> list[ObjectSample]:
        """What has arrived, oldest first; ``now`` is not needed: packets tell their own time."""
        found = []
        for _ in range(self.most):
            try:
                data = self._socket.recv(LAYOUT.size + 1)
            except BlockingIOError:
                break
            if (sample := self.take(data)) is not None:
                found.append(sample)
        return found

    def close(self) -> None:
        """Free the port."""
        self._socket.close()
