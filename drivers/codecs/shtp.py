"""SHTP, the transport of CEVA's sensors, on a serial line: frames and packets, both sides.

    line   = 7E | protocol: 0 control, 1 SHTP | bytes, where 7D and 7E are sent as 7D and the byte ^ 20 | 7E
    SHTP   = length u16, header included | channel | sequence number of the channel | cargo

There is no checksum. A cargo in several packets (bit 15 of the length) is refused: what is asked for here fits into one.

Sources: CEVA/Hillcrest, "BNO08X Data Sheet" (1000-3927), 1.4.1; framing, and the control protocol's question for room:
ceva-dsp/sh2-demo-nucleo, app/uart_hal.c.
"""

from __future__ import annotations

from collections.abc import Iterator
from enum import IntEnum
from typing import NamedTuple

FLAG, ESCAPE, FLIP = 0x7E, 0x7D, 0x20
CONTROL, SHTP = 0, 1  # protocols
HEADER = 4
FRAME_MAX = 1024  # bytes on the line, more than any sensor sends
ROOM = bytes([FLAG, CONTROL, FLAG])  # the question for it


class Channel(IntEnum):
    """What a cargo is about."""

    COMMAND = 0
    EXECUTABLE = 1  # to it: 1 reset; from it: 1 reset complete
    CONTROL = 2
    REPORTS = 3


def line(protocol: int, content: bytes) -> bytes:
    """``content`` as it goes over the line."""
    body = bytes([protocol]) + content
    escaped = body.replace(b"\x7d", b"\x7d\x5d").replace(b"\x7e", b"\x7d\x5e")
    return bytes([FLAG]) + escaped + bytes([FLAG])


def pack(channel: Channel, sequence: int, cargo: bytes) -> bytes:
    """An SHTP packet as it goes over the line."""
    head = (HEADER + len(cargo)).to_bytes(2, "little") + bytes([channel, sequence & 0xFF])
    return line(SHTP, head + cargo)


class Packet(NamedTuple):
    """An SHTP packet; of the control protocol: channel -1."""

    channel: int
    cargo: bytes


class Framer:
    """Finds packets in a byte stream, on either side. Keeps at most FRAME_MAX bytes back."""

    def __init__(self) -> None:
        self._bytes = b""
        self.rejected = 0  # frames that were none

    def feed(self, data: bytes) -> Iterator[Packet]:
        """Every packet completed by ``data``, oldest first."""
        *frames, self._bytes = (self._bytes + data).split(bytes([FLAG]))
        if len(self._bytes) > FRAME_MAX:
            self._bytes = b""
            self.rejected += 1
        for frame in filter(None, frames):
            if (packet := _unescaped(frame)) is None:
                self.rejected += 1
            else:
                yield packet


def _unescaped(frame: bytes) -> Packet | None:
    """The packet between two flags; None: it is none."""
    first, *rest = frame.split(bytes([ESCAPE]))
    if not all(rest):  # nothing behind an escape
        return None
    content = first + b"".join(bytes([part[0] ^ FLIP]) + part[1:] for part in rest)
    if content[:1] == bytes([CONTROL]) and len(content) in (1, 3):
        return Packet(-1, content[1:])
    length = int.from_bytes(content[1:3], "little")
    if content[:1] != bytes([SHTP]) or len(content) <= 1 + HEADER or length != len(content) - 1:
        return None
    return Packet(content[3], content[1 + HEADER :])
