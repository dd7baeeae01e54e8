"""CAN wires to real adapters: Linux SocketCAN without a layer between, and whatever else python-can names."""

from __future__ import annotations

import errno
import socket
from typing import Any

import numpy as np

from drivers.wire import ERROR, EXTENDED, FRAME, REMOTE, WireError, WireFull, WireGone, make_frames

FRAME_SIZE = FRAME.itemsize
ID_MASK = 0x1FFF_FFFF
GONE = (errno.ENODEV, errno.ENXIO, errno.EBADF)  # the interface was unregistered, not only set down
CAN_RAW_ERR_FILTER = 2  # linux/can/raw.h
ERRORS_HEARD = 0x04 | 0x40 | 0x100  # linux/can/error.h: controller problems, bus-off, restarted


def interfaces() -> list[str]:
    """Every interface that python-can knows."""
    import can

    return sorted(can.VALID_INTERFACES)


class RawCanWire:
    """Classic CAN over a raw SocketCAN socket, one ``struct can_frame`` a datagram.

    About a third of the cost of python-can, and a full queue (ENOBUFS) is told apart from other errors, which
    ``can.Bus.send`` with a timeout does not do (python-can 4.6: "Transmit buffer full" without an errno).
    """

    def __init__(self, sock: socket.socket) -> None:
        """``sock``: a datagram socket that carries ``struct can_frame``, such as ``open`` makes."""
        sock.setblocking(False)
        self._socket = sock

    @classmethod
    def open(cls, channel: str) -> RawCanWire:
        """The interface ``channel`` (``can0``). Raises WireError if there is none, or it is down."""
        try:
            sock = socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW)
        except (OSError, AttributeError) as error:
            raise WireError(
                f"socketcan {channel}: no SocketCAN in this system ({error}); is it Linux with CAN?"
            ) from None
        try:
            sock.setsockopt(socket.SOL_CAN_RAW, CAN_RAW_ERR_FILTER, ERRORS_HEARD)
            sock.bind((channel,))
        except OSError as error:
            sock.close()
            raise WireError(
                f"socketcan {channel}: {error.strerror}\n"
                f"  sudo ip link set {channel} up type can bitrate 1000000 restart-ms 100 && "
                f"sudo ip link set {channel} txqueuelen 100"
            ) from None
        return cls(sock)

    def send(self, frames: np.ndarray) -> None:
        data = frames.tobytes()
        for at in range(0, len(data), FRAME_SIZE):
            try:
                self._socket.send(data[at : at + FRAME_SIZE])
            except OSError as error:
                sent = f"sent {at // FRAME_SIZE} of {len(frames)} frames"
                if error.errno in (errno.ENOBUFS, errno.EAGAIN):
                    raise WireFull(f"{sent}: {error.strerror}") from None
                kind = WireGone if error.errno in GONE else WireError
                raise kind(f"{sent}: {error.strerror}; is the interface up?") from None

    def recv(self) -> np.ndarray:
        received = []
        while True:
            try:
                received.append(self._socket.recv(FRAME_SIZE))
            except BlockingIOError:
                break
            except OSError as error:
                kind = WireGone if error.errno in GONE else WireError
                raise kind(f"receiving: {error.strerror}; is the interface up?") from None
            if len(received[-1]) != FRAME_SIZE:
                raise WireError(
                    f"receiving: got {len(received[-1])} bytes, expected a frame of {FRAME_SIZE}; wire closed?"
                )
        return np.frombuffer(b"".join(received), FRAME)

    def fileno(self) -> int:
        return self._socket.fileno()

    def close(self) -> None:
        self._socket.close()


class PythonCanWire:
    """Classic CAN over any interface of python-can (``virtual``, ``pcan``, ``kvaser``, ``slcan``, ...)."""

    def __init__(self, interface: str, channel: str, bitrate: int) -> None:
        """Raises WireError if python-can cannot open it."""
        import can

        self._can = can
        self._where = f"{interface} {channel}"
        try:
            self._bus: Any = can.Bus(interface=interface, channel=channel, bitrate=bitrate)
        except (can.CanError, OSError, ImportError) as error:
            raise WireError(f"{self._where}: {error}\n  Is the adapter plugged in, and its driver installed?") from None

    def send(self, frames: np.ndarray) -> None:
        for sent, frame in enumerate(frames):
            id = int(frame["id"])
            message = self._can.Message(
                arbitration_id=id & ID_MASK,
                is_extended_id=bool(id & EXTENDED),
                is_remote_frame=bool(id & REMOTE),
                dlc=int(frame["length"]),
                data=None if id & REMOTE else frame["data"][: frame["length"]].tobytes(),
                check=True,
            )
            try:
                self._bus.send(message)  # without a timeout: an immediate error instead of waiting
            except self._can.CanError as error:
                reason = f"{self._where}: sent {sent} of {len(frames)} frames: {error}"
                if error.error_code == errno.ENOBUFS or str(error) == "Transmit buffer full":
                    raise WireFull(reason) from None
                raise WireError(reason) from None

    def recv(self) -> np.ndarray:
        received = []
        try:
            while (message := self._bus.recv(timeout=0)) is not None:
                if not message.is_fd:
                    received.append(message)
        except (self._can.CanError, OSError) as error:
            raise WireError(f"{self._where}: receiving: {error}") from None
        frames = make_frames(np.zeros(len(received), np.uint32), np.zeros((len(received), 8), np.uint8))
        for frame, m in zip(frames, received, strict=True):
            flags = m.is_extended_id * EXTENDED | m.is_remote_frame * REMOTE | m.is_error_frame * ERROR
            frame["id"] = m.arbitration_id | flags
            frame["length"] = m.dlc
            frame["data"][: len(m.data)] = bytearray(m.data)
        return frames

    def fileno(self) -> int:
        try:
            return self._bus.fileno()
        except NotImplementedError:
            return -1

    def close(self) -> None:
        self._bus.shutdown()
