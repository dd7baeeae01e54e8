"""CAN wires to real adapters: Linux SocketCAN without a layer between, and whatever else python-can names.

Both carry CAN-FD as well, where they are opened for it. What arrives as a classic frame there becomes a row without
BIT_RATE_SWITCH.
"""

from __future__ import annotations

import errno
import socket
from typing import Any

import numpy as np

from drivers.wire import (
    BIT_RATE_SWITCH,
    BUS_OFF,
    CONTROLLER,
    ERROR,
    EXTENDED,
    FD_FRAME,
    FRAME,
    REMOTE,
    RESTARTED,
    WireError,
    WireFull,
    WireGone,
)

ID_MASK = 0x1FFF_FFFF
GONE = (errno.ENODEV, errno.ENXIO, errno.EBADF)  # the interface was unregistered, not only set down
CAN_RAW_ERR_FILTER, CAN_RAW_FD_FRAMES = 2, 5  # linux/can/raw.h
ERRORS_HEARD = CONTROLLER | BUS_OFF | RESTARTED


def interfaces() -> list[str]:
    """Every interface that python-can knows."""
    import can

    return sorted(can.VALID_INTERFACES)


class RawCanWire:
    """CAN over a raw SocketCAN socket, one ``struct can_frame`` (or ``canfd_frame``) a datagram.

    About a third of the cost of python-can, and a full queue (ENOBUFS) is told apart from other errors, which
    ``can.Bus.send`` with a timeout does not do (python-can 4.6: "Transmit buffer full" without an errno).
    """

    def __init__(self, sock: socket.socket, fd: bool = False) -> None:
        """``sock``: a datagram socket that carries ``struct can_frame``, such as ``open`` makes; ``fd``: and
        ``struct canfd_frame``, which is what is sent then."""
        sock.setblocking(False)
        self._socket = sock
        self._frame = FD_FRAME if fd else FRAME

    @classmethod
    def open(cls, channel: str, bitrate: int = 1_000_000, data_bitrate: int = 0) -> RawCanWire:
        """The interface ``channel`` (``can0``), for CAN-FD if there is a ``data_bitrate``. Both rates are the
        interface's own. Raises WireError if there is none, it is down, or it does not do CAN-FD."""
        fd = f" dbitrate {data_bitrate} fd on" if data_bitrate else ""
        try:
            sock = socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW)
        except (OSError, AttributeError) as error:
            raise WireError(
                f"socketcan {channel}: no SocketCAN in this system ({error}); is it Linux with CAN?"
            ) from None
        try:
            sock.setsockopt(socket.SOL_CAN_RAW, CAN_RAW_ERR_FILTER, ERRORS_HEARD)
            if data_bitrate:
                sock.setsockopt(socket.SOL_CAN_RAW, CAN_RAW_FD_FRAMES, 1)
            sock.bind((channel,))
        except OSError as error:
            sock.close()
            raise WireError(
                f"socketcan {channel}: {error.strerror}\n"
                f"  sudo ip link set {channel} up type can bitrate {bitrate}{fd} restart-ms 100 && "
                f"sudo ip link set {channel} txqueuelen 100"
            ) from None
        return cls(sock, bool(data_bitrate))

    def send(self, frames: np.ndarray) -> None:
        data, size = frames.tobytes(), self._frame.itemsize
        for at in range(0, len(data), size):
            try:
                self._socket.send(data[at : at + size])
            except OSError as error:
                sent = f"sent {at // size} of {len(frames)} frames"
                if error.errno in (errno.ENOBUFS, errno.EAGAIN):
                    raise WireFull(f"{sent}: {error.strerror}") from None
                kind = WireGone if error.errno in GONE else WireError
                raise kind(f"{sent}: {error.strerror}; is the interface up?") from None

    def recv(self) -> np.ndarray:
        received, size = [], self._frame.itemsize
        while True:
            try:
                received.append(self._socket.recv(size))
            except BlockingIOError:
                break
            except OSError as error:
                kind = WireGone if error.errno in GONE else WireError
                raise kind(f"receiving: {error.strerror}; is the interface up?") from None
            if len(received[-1]) == FRAME.itemsize:
                received[-1] = received[-1].ljust(size, b"\0")  # a classic frame, among those of CAN-FD
            elif len(received[-1]) != size:
                raise WireError(f"receiving: got {len(received[-1])} bytes, expected a frame of {size}; wire closed?")
        return np.frombuffer(b"".join(received), self._frame)

    def fileno(self) -> int:
        return self._socket.fileno()

    def close(self) -> None:
        self._socket.close()


class PythonCanWire:
    """CAN over any interface of python-can (``virtual``, ``pcan``, ``kvaser``, ``slcan``, ...)."""

    def __init__(self, interface: str, channel: str, bitrate: int, data_bitrate: int = 0) -> None:
        """``data_bitrate``: for CAN-FD. Raises WireError if python-can cannot open it."""
        import can

        self._can = can
        self._frame = FD_FRAME if data_bitrate else FRAME
        self._where = f"{interface} {channel}"
        try:
            fd = {"fd": True, "data_bitrate": data_bitrate} if data_bitrate else {}
            self._bus: Any = can.Bus(interface=interface, channel=channel, bitrate=bitrate, **fd)
        except (can.CanError, OSError, ImportError) as error:
            raise WireError(f"{self._where}: {error}\n  Is the adapter plugged in, and its driver installed?") from None

    def send(self, frames: np.ndarray) -> None:
        fd = self._frame == FD_FRAME
        for sent, frame in enumerate(frames):
            id = int(frame["id"])
            message = self._can.Message(
                arbitration_id=id & ID_MASK,
                is_extended_id=bool(id & EXTENDED),
                is_remote_frame=bool(id & REMOTE),
                dlc=int(frame["length"]),
                data=None if id & REMOTE else frame["data"][: frame["length"]].tobytes(),
                is_fd=fd,
                bitrate_switch=fd and bool(frame["flags"] & BIT_RATE_SWITCH),
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
                if not message.is_fd or self._frame == FD_FRAME:
                    received.append(message)
        except (self._can.CanError, OSError) as error:
            raise WireError(f"{self._where}: receiving: {error}") from None
        frames = np.zeros(len(received), self._frame)
        for frame, m in zip(frames, received, strict=True):
            flags = m.is_extended_id * EXTENDED | m.is_remote_frame * REMOTE | m.is_error_frame * ERROR
            frame["id"] = m.arbitration_id | flags
            frame["length"] = m.dlc
            frame["data"][: len(m.data)] = bytearray(m.data)
            if m.bitrate_switch:
                frame["flags"] = BIT_RATE_SWITCH
        return frames

    def fileno(self) -> int:
        try:
            return self._bus.fileno()
        except NotImplementedError:
            return -1

    def close(self) -> None:
        self._bus.shutdown()
