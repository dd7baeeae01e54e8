"""The ports of a served World for programs that know nothing of it: python-can, pseudo-terminals, DDS on loopback.

A bridge hears and says what its port does (serve.Port): frames as bytes, bytes, or samples.
"""

from __future__ import annotations

import os
import tty
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from drivers.bus import BusError, BusSpec
from drivers.codecs.unitree_api import MOTION_REQUEST
from drivers.codecs.unitree_hg import COMMAND_TOPIC
from drivers.open import PROTOCOLS
from drivers.sim.dds_port import TOPICS, join, split
from drivers.sim.faults import IMU
from drivers.wire import ERROR, CanWire, DdsWire, WireError, WireFull, frame_type

if TYPE_CHECKING:
    from drivers.sim.world import World

READ_SIZE = 65536
HEARD = (COMMAND_TOPIC, MOTION_REQUEST)  # what a robot subscribes to
CAN = "udp_multicast:239.74.163.{n}"  # what python-can carries between processes without any hardware
FIRST = 2  # ``{n}`` of the first bus: python-can's default group ends in it


class Bridge(Protocol):
    """A port's other end."""

    where: str  # what other programs open

    def hear(self) -> bytes:
        """What they sent since the last call. Never blocks."""
        ...

    def say(self, data: bytes) -> None:
        """Give them what the port has. Raises WireFull where nobody takes it."""
        ...

    def fileno(self) -> int:
        """For ``select``; -1 where there is nothing to wait on."""
        ...

    def close(self) -> None: ...


class CanBridge:
    """A bus on a CAN wire of python-can."""

    def __init__(self, wire: CanWire, where: str, frame: np.dtype):
        self.where, self._wire, self._frame = where, wire, frame

    def hear(self) -> bytes:
        return self._wire.recv().tobytes()

    def say(self, data: bytes) -> None:
        frames = np.frombuffer(data, self._frame)
        self._wire.send(frames[frames["id"] & ERROR == 0])

    def fileno(self) -> int:
        return self._wire.fileno()

    def close(self) -> None:
        self._wire.close()


class PtyBridge:
    """A serial line on a pseudo-terminal, which has no speed of its own. ``link``: a path that stays the same."""

    def __init__(self, link: Path):
        self._master, self._slave = os.openpty()  # both stay open, so that hosts may come and go
        tty.setraw(self._slave)
        os.set_blocking(self._master, False)
        self._link = link
        self._link.unlink(missing_ok=True)
        self._link.symlink_to(os.ttyname(self._slave))
        self.where = str(link)

    def hear(self) -> bytes:
        try:
            return os.read(self._master, READ_SIZE)
        except BlockingIOError:
            return b""

    def say(self, data: bytes) -> None:
        try:
            sent = os.write(self._master, data)
        except BlockingIOError:
            sent = 0
        if sent < len(data):
            raise WireFull(f"{self.where}: nobody reads")

    def fileno(self) -> int:
        return self._master

    def close(self) -> None:
        self._link.unlink(missing_ok=True)
        os.close(self._slave)
        os.close(self._master)


class DdsBridge:
    """The robot's topics on a real DDS domain."""

    def __init__(self, wire: DdsWire, where: str):
        self.where, self._wire = where, wire

    def hear(self) -> bytes:
        return join((topic, payload) for topic in HEARD for payload in self._wire.read(topic))

    def say(self, data: bytes) -> None:
        for topic, payload in split(data):
            self._wire.write(topic, payload)

    def fileno(self) -> int:
        return -1

    def close(self) -> None:
        self._wire.close()


def can_bridge(spec: BusSpec, place: str) -> CanBridge:
    """The bus of ``spec`` at ``place``, "interface:channel" in python-can's words. Raises WireError."""
    from drivers.can_wire import PythonCanWire

    interface, _, channel = place.partition(":")
    try:
        wire = PythonCanWire(interface, channel, spec.bitrate, spec.data_bitrate)
    except WireError as error:
        hint = "\n  udp_multicast needs: pip install 'python-can[multicast]'" if interface == "udp_multicast" else ""
        raise WireError(f"bus {spec.name}: {error}{hint}") from None
    return CanBridge(wire, place, frame_type(spec.data_bitrate))


def dds_bridge(spec: BusSpec, channel: str) -> DdsBridge:
    """The robot's topics on loopback (``lo``, ``lo:1``: domain 1). Raises BusError for any other interface."""
    interface, _, domain = channel.partition(":")
    if interface != "lo" or not (domain or "0").isdecimal():
        raise BusError(f"bus {spec.name}: got DDS on '{channel}', expected lo or lo:1 (domain 1): a twin stays at home")
    try:
        from drivers.dds_wire import CycloneWire
    except ImportError as error:
        raise BusError(f"{error}; DDS needs an extra: pip install 'sim2real[dds]'") from None
    return DdsBridge(CycloneWire(interface, int(domain or 0), HEARD, TOPICS), channel)


def bridges(world: World, buses: list[BusSpec], directory: Path, can: str = CAN, dds: str = "lo") -> dict[str, Any]:
    """A bridge for every bus of ``world``, and for its IMU where that is a serial line. ``can``: with ``{n}`` for 2, 3, ...
    or ``{bus}``. Raises BusError, WireError."""
    made: dict[str, Any] = {}
    directory.mkdir(parents=True, exist_ok=True)
    try:
        for n, spec in enumerate(buses, FIRST):
            kind = PROTOCOLS[spec.protocol].wire
            if kind == "can":
                made[spec.name] = can_bridge(spec, can.format(n=n, bus=spec.name))
            elif kind == "dds":
                made[spec.name] = dds_bridge(spec, dds)
            else:
                made[spec.name] = PtyBridge(directory / f"{spec.name}.tty")
        if all(PROTOCOLS[b.protocol].wire != "dds" for b in buses):
            made[IMU] = PtyBridge(directory / f"{IMU}.tty")
    except Exception:
        for bridge in made.values():
            bridge.close()
        raise
    return made
