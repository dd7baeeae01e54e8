"""A World as a process of its own, in real time, behind unix sockets in a directory.

    <bus>.sock    SEQPACKET, datagrams of FRAME rows, both ways; of samples where the robot is behind DDS (dds_port.py)
    imu.sock      SEQPACKET, the bytes of the serial line
    world.sock    SEQPACKET, JSON: {"call": "push", "arguments": {...}} -> {"result": ...} or {"error": "..."}

Simulated time follows CLOCK_MONOTONIC on an absolute schedule of substeps. A late substep is caught up; a lag beyond
LAG_MAX is not: time then slips, is counted, and said (``status``), for a robot that is slower than its clock without a
word would be a lie. Frames are stamped when they are read, answers leave at the first wake-up after their arrival.

    python -m drivers.sim.serve DIRECTORY [--can BUS=INTERFACE:CHANNEL ...] < spec.json

The second form also puts a bus onto any python-can interface, so that other programs can drive these motors (bridge.py;
``sim2real sim --serve`` does it for a whole robot).
"""

from __future__ import annotations

import argparse
import dataclasses
import gc
import json
import math
import os
import select
import signal
import socket
import sys
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from drivers.bus import BusError, BusSpec, ImuSpec, MotorSpec
from drivers.sim.bridge import Bridge, can_bridge
from drivers.sim.socket_wire import BUS_OFF, CONTROLLER, DATAGRAM, RESTARTED, TX_OVERFLOW
from drivers.sim.wire import SimCan
from drivers.sim.world import World
from drivers.wire import ERROR, FRAME, WireError, WireFull

LAG_MAX = 0.05  # s of lag that is still caught up
WAKE = 0.0005  # s between wake-ups while frames are on their way
EVENTS_PER_CALL = 500
OPTIONS = frozenset(
    {"timestep", "seed", "faults", "joint_pos", "hang", "noise", "registers", "wrap", "latency", "reply_delay",
     "queue_length"}
)  # fmt: skip


@dataclass
class Pace:
    """How real the time is."""

    time: float = 0.0  # s, simulated
    epoch: float = 0.0  # s, CLOCK_MONOTONIC at simulated time 0 (moves when time slips)
    elapsed: float = 0.0  # s since the start, CLOCK_MONOTONIC
    factor: float = 1.0  # simulated time per real time
    lateness_max: float = 0.0  # s, the latest a substep was
    slipped: float = 0.0  # s given up, because this machine is too slow
    unread: int = 0  # datagrams that a host did not take


class Port(Protocol):
    """What hosts on one socket are connected to."""

    def hear(self, data: bytes, now: float) -> bytes:
        """A datagram from a host; what to answer to it alone."""
        ...

    def give(self, now: float) -> bytes:
        """What has arrived for every host."""
        ...


class BusPort:
    """A bus with the hosts on it, that come and go."""

    def __init__(self, bus: SimCan):
        self.bus = bus
        self._away = False

    def hear(self, data: bytes, now: float) -> bytes:
        """Rows of the bus's frames; anything else is dropped."""
        frame = self.bus.frame
        if len(data) % frame.itemsize or (error := self.take(np.frombuffer(data, frame), now)) is None:
            return b""
        return error.tobytes()

    def take(self, frames: np.ndarray, now: float) -> np.ndarray | None:
        """Frames from a host; returns the error frame that a SocketCAN controller would report, or None."""
        try:
            self.bus.send(frames, now)
        except WireFull:
            return error_frame(CONTROLLER, TX_OVERFLOW, self.bus.frame)
        except WireError:
            if not self._away:
                self._away = True
                return error_frame(BUS_OFF, frame=self.bus.frame)
        return None

    def give(self, now: float) -> bytes:
        """What has arrived for the hosts, error frames included."""
        raw = self.bus.recv(now).tobytes()
        away = self.bus.away(now)
        if away != self._away:
            self._away = away
            raw += error_frame(BUS_OFF if away else RESTARTED, frame=self.bus.frame).tobytes()
        return raw


def error_frame(kind: int, reason: int = 0, frame: np.dtype = FRAME) -> np.ndarray:
    """One ``frame`` (1,) as linux/can/error.h has it."""
    made = np.zeros(1, frame)
    made["id"], made["length"] = ERROR | kind, 8
    made["data"][0, 1] = reason
    return made


class Server:
    """Sockets for ``world`` in ``directory``; ``run`` serves them. ``bridges``: further hosts, by port."""

    def __init__(
        self,
        world: World,
        directory: Path,
        bridges: Mapping[str, Bridge] | None = None,
        warn: Callable[[str], object] = lambda text: print(text, file=sys.stderr),
    ):
        self.world, self.pace, self._warn = world, Pace(), warn
        self._bridges = dict(bridges or {})
        self._ports: dict[str, Port] = {b.spec.name: BusPort(b) for b in world.buses}
        self._ports |= world.ports
        self._listeners: dict[socket.socket, str] = {}
        self._clients: dict[socket.socket, str] = {}
        self._stopping = False
        self._calls: dict[str, Callable[..., Any]] = {
            "hold": world.hold,
            "lower": world.lower,
            "release": world.release,
            "push": world.push,
            "carry_ball": world.carry_ball,
            "throw_ball": world.throw_ball,
            "let_go_ball": world.let_go_ball,
            "inject": world.inject,
            "truth": world.truth,
            "digest": lambda: world.digest,
            "motor_log": lambda start=0: world.motor_log[start : start + EVENTS_PER_CALL],
            "last_command_times": world.last_command_times,
            "counters": world.counters,
            "status": lambda: self.pace,
            "stop": self.stop,
        }
        directory.mkdir(parents=True, exist_ok=True)
        for name in (*self._ports, "imu", "world"):
            path = directory / f"{name}.sock"
            path.unlink(missing_ok=True)
            listener = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET | socket.SOCK_NONBLOCK)
            try:
                listener.bind(str(path))
            except OSError as error:
                raise BusError(f"{path}: {error}; expected a path of at most 107 bytes in a writable folder") from None
            listener.listen()
            self._listeners[listener] = name

    def stop(self) -> None:
        """End ``run`` at its next wake-up."""
        self._stopping = True

    def run(self, goes_on: Callable[[], bool] = lambda: True) -> None:
        """Serve until somebody calls ``stop``, or ``goes_on()`` says no."""
        gc.collect()
        gc.freeze()
        began = time.monotonic()
        self.pace.epoch = began - self.world.time
        try:
            while not self._stopping and goes_on():
                self._wait()
                self._follow(time.monotonic(), began)
                self._flush()
        finally:
            self.close()

    def _wait(self) -> None:
        """Until somebody has something to say, or the next substep is due, or frames may have arrived."""
        due = self.world.next_substep
        waited_on = {b: name for name, b in self._bridges.items() if b.fileno() >= 0}
        if self.world.busy or len(waited_on) < len(self._bridges):
            due = min(due, self.world.time + WAKE)
        timeout = max(0.0, self.pace.epoch + due - time.monotonic())
        ready: list[Any]
        ready, _, _ = select.select([*self._listeners, *self._clients, *waited_on], [], [], timeout)
        for sock in ready:
            if sock in waited_on:
                pass  # heard below
            elif sock in self._listeners:
                client, _ = sock.accept()
                client.setblocking(False)
                self._clients[client] = self._listeners[sock]
            else:
                self._hear(sock)
        for name, bridge in self._bridges.items():
            if data := bridge.hear():
                (self.world.imu if name == "imu" else self._ports[name]).hear(data, self._now())

    def _follow(self, real: float, began: float) -> None:
        """Move the world on to real time, as far as it can follow."""
        pace, world = self.pace, self.world
        now = real - pace.epoch
        lag = now - world.next_substep
        if lag > LAG_MAX:
            if not pace.slipped:
                self._warn(f"the simulated robot cannot keep up with real time: {lag:.3f} s late, its clock slips")
            pace.slipped += lag
            pace.epoch += lag
            now -= lag
        pace.lateness_max = max(pace.lateness_max, lag)
        world.advance(now)
        pace.time, pace.elapsed = world.time, real - began
        pace.factor = 1.0 - pace.slipped / pace.elapsed if pace.elapsed > 0 else 1.0

    def _hear(self, sock: socket.socket) -> None:
        name = self._clients[sock]
        try:
            data = sock.recv(DATAGRAM)
        except (BlockingIOError, ConnectionResetError):
            return  # reset: it went with answers unread, and what it said last is still there
        except OSError:
            data = b""
        if not data:
            del self._clients[sock]
            sock.close()
        elif name == "world":
            self._send(sock, self._call(data))
        elif name == "imu":
            self.world.imu.hear(data, self._now())
        elif answer := self._ports[name].hear(data, self._now()):
            self._send(sock, answer)

    def _now(self) -> float:
        """Simulated time, as a clock has it between two substeps."""
        return max(self.world.time, time.monotonic() - self.pace.epoch)

    def _flush(self) -> None:
        """Give the hosts what has arrived."""
        now = self.world.time
        out = {"imu": self.world.imu.read(now)}
        for name, port in self._ports.items():
            out[name] = port.give(now)
        for name, bridge in self._bridges.items():
            if data := out.get(name):
                try:
                    bridge.say(data)
                except WireFull:
                    self.pace.unread += 1
        for sock, name in list(self._clients.items()):
            if data := out.get(name):
                self._send(sock, data)

    def _send(self, sock: socket.socket, data: bytes) -> None:
        try:
            sock.send(data)
        except BlockingIOError:
            self.pace.unread += 1
        except OSError:  # it has gone: ``_hear`` takes in what it said last, and lets go of it
            pass

    def _call(self, data: bytes) -> bytes:
        try:
            request = json.loads(data)
            name, arguments = request["call"], request.get("arguments", {})
            if name not in self._calls:
                raise BusError(f"got call '{name}', expected one of {', '.join(self._calls)}")
            return json.dumps({"result": _plain(self._calls[name](**arguments))}).encode()
        except (BusError, KeyError, TypeError, ValueError) as error:
            return json.dumps({"error": f"{error}" or repr(error)}).encode()

    def close(self) -> None:
        for sock in (*self._clients, *self._listeners):
            if sock in self._listeners:
                Path(sock.getsockname()).unlink(missing_ok=True)
            sock.close()
        self._clients.clear()
        self._listeners.clear()
        for bridge in self._bridges.values():
            bridge.close()


def world_of(spec: Mapping[str, Any]) -> World:
    """A World from a JSON-able document: ``model``, ``base``, ``buses`` (as ``asdict(BusSpec)``), ``imu``, and any of
    OPTIONS. Raises BusError."""
    needed = {"model", "base", "buses", "imu"}
    if missing := needed - set(spec):
        raise BusError(f"world: no {sorted(missing)}, expected {sorted(needed)}")
    if strangers := set(spec) - needed - OPTIONS:
        raise BusError(f"world: got {sorted(strangers)}, expected {sorted(needed | OPTIONS)}")
    buses = [BusSpec(**{**b, "motors": tuple(MotorSpec(**m) for m in b["motors"])}) for b in spec["buses"]]
    imu = dict(spec["imu"])
    if "orientation_imu_in_base" in imu:
        imu["orientation_imu_in_base"] = tuple(imu["orientation_imu_in_base"])
    options = {k: v for k, v in spec.items() if k in OPTIONS}
    return World(spec["model"], spec["base"], buses, ImuSpec(**imu), **options)


def serve(
    world: World,
    directory: str | Path,
    *,
    ready: Callable[[], object] = lambda: None,
    goes_on: Callable[[], bool] = lambda: True,
    warn: Callable[[str], object] = lambda text: print(text, file=sys.stderr),
    bridges: Mapping[str, Bridge] | None = None,
) -> Pace:
    """Serve ``world`` in ``directory`` while ``goes_on()``, or until a ``stop`` over its socket.

    ``ready`` is called once, when every socket listens; ``warn`` when the machine is too slow. ``bridges``: by bus, or
    ``imu``, for other programs (bridge.py); closed at the end. Returns how real the time was. Raises BusError, WireError.
    """
    server = Server(world, Path(directory), bridges, warn)
    ready()
    server.run(goes_on)
    return server.pace


def _bridge(world: World, asked: str) -> tuple[str, Bridge]:
    """Of ``BUS=INTERFACE:CHANNEL``."""
    name, _, place = asked.partition("=")
    spec = next((b.spec for b in world.buses if b.spec.name == name), None)
    if spec is None:
        raise BusError(f"--can: got bus '{name}', expected one of {', '.join(world.wires)}")
    return name, can_bridge(spec, place)


def _plain(value: Any) -> Any:
    """As JSON can have it: arrays as lists, dataclasses as objects, -inf (never) and NaN as null."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return _plain(asdict(value))
    if isinstance(value, np.ndarray):
        return value.tolist()
    if isinstance(value, Mapping):
        return {k: _plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(v) for v in value]
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return value


def main(argv: list[str] | None = None) -> int:
    """Serve the world described on standard input until SIGTERM, SIGINT, or the end of the process that started this."""
    parser = argparse.ArgumentParser(prog="python -m drivers.sim.serve", description=main.__doc__)
    parser.add_argument("directory", type=Path)
    parser.add_argument("--can", action="append", default=[], metavar="BUS=INTERFACE:CHANNEL")
    arguments = parser.parse_args(argv)
    parent, signals = os.getppid(), []
    for signum in (signal.SIGTERM, signal.SIGINT):
        signal.signal(signum, lambda number, _: signals.append(number))
    try:
        world = world_of(json.load(sys.stdin))
        pace = serve(
            world,
            arguments.directory,
            ready=lambda: print("ready", flush=True),
            goes_on=lambda: not signals and os.getppid() == parent,
            bridges=dict(_bridge(world, asked) for asked in arguments.can),
        )
    except (BusError, WireError) as error:
        print(error, file=sys.stderr)
        return 2
    print(json.dumps(_plain(pace)))
    return 0


if __name__ == "__main__":
    sys.exit(main())
