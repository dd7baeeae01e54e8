"""Topics over a unix socket: the two ends of a simulated DDS domain between processes (see serve.py).

A datagram holds samples, one behind the other: length of the topic (u16), of the payload (u32), topic, payload.
"""

from __future__ import annotations

import struct
from collections import deque
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from drivers.codecs.unitree_api import MOTION_RESPONSE
from drivers.codecs.unitree_hg import STATE_TOPIC
from drivers.sim.socket_wire import HostSocket

if TYPE_CHECKING:
    from drivers.sim.dds_world import DdsWorld, SimDdsWire

TOPICS = (STATE_TOPIC, MOTION_RESPONSE)  # what a robot publishes
DEPTH = 16  # samples kept until they are read
_HEAD = struct.Struct("<HI")


def join(samples: Iterable[tuple[str, bytes]]) -> bytes:
    """A datagram of (topic, payload)."""
    return b"".join(_HEAD.pack(len(t.encode()), len(p)) + t.encode() + p for t, p in samples)


def split(data: bytes) -> Iterator[tuple[str, bytes]]:
    """The (topic, payload) in a datagram, up to where it is cut short."""
    at = 0
    while at + _HEAD.size <= len(data):
        topic, payload = _HEAD.unpack_from(data, at)
        at += _HEAD.size
        if at + topic + payload > len(data):
            return
        yield data[at : at + topic].decode(errors="replace"), data[at + topic : at + topic + payload]
        at += topic + payload


class DdsPort:
    """The robot's end, in the process of its World (a serve.Port)."""

    def __init__(self, world: DdsWorld, wire: SimDdsWire) -> None:
        self._world, self._wire = world, wire

    def hear(self, data: bytes, now: float) -> bytes:
        """A datagram from a host, read at ``now``. Nothing to answer."""
        for topic, payload in split(data):
            self._world.send(topic, payload, now)
        return b""

    def give(self, now: float) -> bytes:
        """What has arrived for the hosts."""
        return join((topic, payload) for topic in TOPICS for payload in self._wire.read(topic))


class SocketDdsWire:
    """A host's end: a drivers.wire.DdsWire to the robot served at ``path``. It cannot see who else publishes there."""

    def __init__(self, path: str | Path) -> None:
        self._socket = HostSocket(path)
        self._inbox: dict[str, deque[bytes]] = {}

    def write(self, topic: str, payload: bytes) -> None:
        self._socket.send(join([(topic, payload)]))

    def read(self, topic: str) -> list[bytes]:
        for name, payload in split(self._socket.receive()):
            self._inbox.setdefault(name, deque(maxlen=DEPTH)).append(payload)
        return list(self._inbox.pop(topic, ()))

    def writers(self, topic: str) -> int:
        return 0

    def close(self) -> None:
        self._socket.close()
