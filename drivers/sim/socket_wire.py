"""The host's ends of a World in another process (see serve.py): unix SEQPACKET sockets, a whole tick a datagram.

A bus socket carries rows of FRAME, of a CAN-FD bus of FD_FRAME. What SocketCAN would tell in error frames, the served
bus tells in the same ones (linux/can/error.h), and sending then raises as it would on a real controller.
"""

from __future__ import annotations

import json
import socket
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from drivers.sim.motor import MotorEvent
from drivers.sim.truth import Truth
from drivers.wire import ERROR, WireError, WireFull, WireGone, frame_type

DATAGRAM = 1 << 18  # bytes: more than any tick
ANSWER_TIME = 2.0  # s that a call may take
# linux/can/error.h: classes are bits of the identifier, CONTROLLER says more in data[1].
CONTROLLER, BUS_OFF, RESTARTED = 0x04, 0x40, 0x100
TX_OVERFLOW = 0x02


def _connect(path: str, timeout: float) -> socket.socket:
    """A SEQPACKET socket to ``path``. Raises WireError if nobody listens there."""
    sock = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    try:
        sock.connect(path)
    except OSError as error:
        sock.close()
        raise WireError(f"{path}: {error}; expected a simulated robot there, is it running?") from None
    sock.settimeout(timeout)
    return sock


class HostSocket:
    """A connected, non-blocking SEQPACKET socket."""

    def __init__(self, path: str | Path):
        self.path = str(path)
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        try:
            self._socket.connect(self.path)
        except OSError as error:
            self._socket.close()
            raise WireError(
                f"{self.path}: {error.strerror}; expected a simulated robot there, is it running?"
            ) from None
        self._socket.setblocking(False)

    def send(self, data: bytes) -> None:
        try:
            self._socket.send(data)
        except BlockingIOError:
            raise WireFull(f"{self.path}: the simulated robot takes nothing in; has it stopped?") from None
        except OSError as error:
            raise WireGone(f"{self.path}: {error.strerror}; the simulated robot has gone") from None

    def receive(self) -> bytes:
        parts = []
        while True:
            try:
                data = self._socket.recv(DATAGRAM)
            except BlockingIOError:
                break
            except OSError as error:
                raise WireGone(f"{self.path}: {error.strerror}; the simulated robot has gone") from None
            if not data:
                if parts:  # hand over what came before the end; the next call tells
                    break
                raise WireGone(f"{self.path}: end of file; the simulated robot has gone")
            parts.append(data)
        return b"".join(parts)

    def fileno(self) -> int:
        return self._socket.fileno()

    def close(self) -> None:
        self._socket.close()


class SocketCanWire:
    """A drivers.wire.CanWire to the bus served at ``path``."""

    def __init__(self, path: str | Path, data_bitrate: int = 0):
        self._socket = HostSocket(path)
        self._frame = frame_type(data_bitrate)
        self._away = self._full = False

    def send(self, frames: np.ndarray) -> None:
        if self._away:
            raise WireError(f"{self._socket.path}: bus off; check cable and termination")
        self._socket.send(frames.tobytes())
        if self._full:
            self._full = False
            raise WireFull(f"{self._socket.path}: transmit queue full; the bus is too slow, or nobody acknowledges")

    def recv(self) -> np.ndarray:
        frames = np.frombuffer(self._socket.receive(), self._frame)
        errors = frames[frames["id"] & ERROR != 0] if len(frames) else frames
        for id, reason in zip(errors["id"].tolist(), errors["data"][:, 1].tolist(), strict=True):
            self._away = (self._away or bool(id & BUS_OFF)) and not id & RESTARTED
            self._full |= bool(id & CONTROLLER and reason & TX_OVERFLOW)
        return frames

    def fileno(self) -> int:
        return self._socket.fileno()

    def close(self) -> None:
        self._socket.close()


class SocketSerialWire:
    """A drivers.wire.SerialWire to the line served at ``path``."""

    def __init__(self, path: str | Path):
        self._socket = HostSocket(path)

    def write(self, data: bytes) -> None:
        self._socket.send(data)

    def read(self) -> bytes:
        return self._socket.receive()

    def fileno(self) -> int:
        return self._socket.fileno()

    def close(self) -> None:
        self._socket.close()


class WorldRemote:
    """A World in another process, by the names it has in this one. Every call waits for its answer, up to 2 s.

    Raises WireError where the process is gone, or where it says why it refuses.
    """

    def __init__(self, path: str | Path):
        self.path = str(path)
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._socket.settimeout(2.0)
        try:
            self._socket.connect(self.path)
        except OSError as error:
            self._socket.close()
            raise WireError(
                f"{self.path}: {error.strerror}; expected a simulated robot there, is it running?"
            ) from None

    def call(self, name: str, **arguments: Any) -> Any:
        try:
            self._socket.send(json.dumps({"call": name, "arguments": arguments}).encode())
            data = self._socket.recv(DATAGRAM)
        except OSError as error:
            raise WireError(f"{self.path}: {error}; the simulated robot has gone or hangs") from None
        if not data:
            raise WireError(f"{self.path}: end of file; the simulated robot has gone")
        answer = json.loads(data)
        if "error" in answer:
            raise WireError(f"{self.path}: {name}: {answer['error']}")
        return answer["result"]

    def hold(self) -> None:
        self.call("hold")

    def lower(self, rate: float = 0.1) -> None:
        self.call("lower", rate=rate)

    def release(self) -> None:
        self.call("release")

    def push(self, velocity_delta: Sequence[float]) -> None:
        self.call("push", velocity_delta=[float(v) for v in velocity_delta])

    def carry_ball(self, position: Sequence[float]) -> None:
        self.call("carry_ball", position=[float(v) for v in position])

    def throw_ball(self, position: Sequence[float], velocity: Sequence[float]) -> None:
        self.call("throw_ball", position=[float(v) for v in position], velocity=[float(v) for v in velocity])

    def let_go_ball(self) -> None:
        self.call("let_go_ball")

    def inject(self, fault: str) -> None:
        """A fault in its text form; its times are those of the World (``status()['time']``)."""
        self.call("inject", fault=fault)

    def truth(self) -> Truth:
        fields: dict[str, Any] = {k: np.array(v) if isinstance(v, list) else v for k, v in self.call("truth").items()}
        return Truth(**fields)

    @property
    def time(self) -> float:
        return self.status()["time"]

    @property
    def digest(self) -> str:
        return self.call("digest")

    @property
    def motor_log(self) -> list[MotorEvent]:
        """In parts, because a long run's log is larger than a datagram."""
        events: list[MotorEvent] = []
        while part := self.call("motor_log", start=len(events)):
            events += [MotorEvent(*event) for event in part]
        return events

    def last_command_times(self) -> dict[str, float]:
        """By joint; NaN: never."""
        return {k: float("nan") if v is None else v for k, v in self.call("last_command_times").items()}

    def counters(self) -> dict[str, dict[str, float]]:
        return self.call("counters")

    def status(self) -> dict[str, float]:
        """How real the time is: see serve.Pace."""
        return self.call("status")

    def stop(self) -> None:
        """End the process."""
        self.call("stop")

    def close(self) -> None:
        self._socket.close()
