"""Wires: the last thing before a syscall. A wire moves frames or bytes; it knows no protocol.

A CAN frame is one row of a structured array with the memory layout of Linux's ``struct can_frame`` (linux/can.h),
so that a whole tick of frames is one array, one ``bytes`` and one datagram. On a CAN-FD bus every frame is a row of
``struct canfd_frame``, with the same names.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np

EXTENDED = 0x8000_0000  # bit 31 of ``id``: 29-bit identifier (CAN_EFF_FLAG)
REMOTE = 0x4000_0000  # bit 30: remote request (CAN_RTR_FLAG)
ERROR = 0x2000_0000  # bit 29: error frame (CAN_ERR_FLAG)
# Of an error frame's ``id``: what the controller says of itself (linux/can/error.h). CONTROLLER: and in data[1], how it is.
CONTROLLER, BUS_OFF, RESTARTED = 0x04, 0x40, 0x100
ERROR_PASSIVE = 0x30  # of data[1]: receiving 10, transmitting 20

FRAME = np.dtype(
    [("id", "<u4"), ("length", "u1"), ("pad", "u1", (3,)), ("data", "u1", (8,))]
)  # 16 bytes, struct can_frame
FD_FRAME = np.dtype(
    [("id", "<u4"), ("length", "u1"), ("flags", "u1"), ("pad", "u1", (2,)), ("data", "u1", (64,))]
)  # 72 bytes, struct canfd_frame
BIT_RATE_SWITCH = 0x01  # of ``flags`` (CANFD_BRS): the payload travels at the data bit rate
FD_LENGTHS = np.array([0, 1, 2, 3, 4, 5, 6, 7, 8, 12, 16, 20, 24, 32, 48, 64])  # bytes, all that CAN-FD has


class WireError(Exception):
    """A wire cannot carry traffic: what, where, got, expected, next step."""


class WireGone(WireError):
    """The adapter is not there any more: this wire will carry nothing again, another one may (drivers/reopening.py)."""


class WireFull(WireError):
    """The transmit queue took only part of the frames (ENOBUFS). The rest was dropped, never queued for later."""


class CanWire(Protocol):
    """A CAN bus: whole ticks of frames in, whole ticks out. Rows are FRAME, on a CAN-FD bus FD_FRAME."""

    def send(self, frames: np.ndarray) -> None:
        """Queue ``frames`` (FRAME or FD_FRAME, shape (n,)) in order. Never blocks. Raises WireFull or WireError."""
        ...

    def recv(self) -> np.ndarray:
        """All frames that arrived since the last call (the same, shape (n,), may be empty). Never blocks."""
        ...

    def fileno(self) -> int:
        """For ``select``; -1 where there is nothing to wait on (lockstep simulation)."""
        ...

    def close(self) -> None: ...


class SerialWire(Protocol):
    """A byte stream (UART, RS-485)."""

    def write(self, data: bytes) -> None:
        """Queue bytes. Never blocks. Raises WireError when the port is gone."""
        ...

    def read(self) -> bytes:
        """Everything that arrived since the last call, possibly ``b""``. Never blocks."""
        ...

    def fileno(self) -> int: ...

    def close(self) -> None: ...


class DdsWire(Protocol):
    """A DDS domain: samples on named topics, each with its CDR payload, header included."""

    def write(self, topic: str, payload: bytes) -> None:
        """Publish one sample. Never blocks. Raises WireError."""
        ...

    def read(self, topic: str) -> list[bytes]:
        """The payloads that arrived since the last call, oldest first. Never blocks."""
        ...

    def writers(self, topic: str) -> int:
        """How many others publish on ``topic``."""
        ...

    def close(self) -> None: ...


def make_frames(ids: np.ndarray, data: np.ndarray, length: int = 8) -> np.ndarray:
    """Frames from ``ids`` (n,) uint32 and ``data`` (n, 8) uint8."""
    frames = np.zeros(len(ids), FRAME)
    frames["id"] = ids
    frames["length"] = length
    frames["data"] = data
    return frames


def frame_type(data_bitrate: int) -> np.dtype:
    """The rows of a CAN wire: FD_FRAME where there is a data bit rate, else FRAME."""
    return FD_FRAME if data_bitrate else FRAME


def make_fd_frames(ids: np.ndarray, data: np.ndarray, length: int | np.ndarray) -> np.ndarray:
    """CAN-FD frames with bit-rate switch from ``ids`` (n,) uint32 and ``data`` (n, k) uint8, k at most 64. ``length``: of
    FD_LENGTHS."""
    frames = np.zeros(len(ids), FD_FRAME)
    frames["id"] = ids
    frames["length"] = length
    frames["flags"] = BIT_RATE_SWITCH
    frames["data"][:, : data.shape[1]] = data
    return frames
