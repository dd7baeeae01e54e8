"""Latest-value channels between processes: one writer, any number of readers, nobody ever waits.

A channel is a small memory-mapped file with two slots. The writer fills the slot that readers are not looking at and then
moves the sequence number; a reader copies the newest slot and takes it only if its checksum holds, so a torn read is never
seen, on any processor. With ``path=None`` the same channel lives in this process alone (lockstep).
"""

from __future__ import annotations

import mmap
import os
import tempfile
import zlib
from pathlib import Path

import numpy as np

from sim2real.records import Layout

_SEQUENCE = np.dtype("<u8")
_HEAD = 16  # sequence number, padding


def run_directory() -> Path:
    """A new private directory for a run's channels and sockets, in memory where the system offers it."""
    return Path(tempfile.mkdtemp(prefix="sim2real-", dir="/dev/shm" if os.path.isdir("/dev/shm") else None))


class Channel:
    """The newest record of one layout.

    ``write(record)`` publishes an array made by ``layout.new()``. ``read()`` copies the newest one into ``self.record``
    and says whether it is new since the last ``read``; before anything was written it stays zeroed and is never new.
    """

    def __init__(self, layout: Layout, path: Path | None = None):
        self.layout = layout
        self.record = layout.new()
        self._size = layout.dtype.itemsize
        stride = self._size + 16  # checksum, padding
        length = _HEAD + 2 * stride
        self._file = None
        if path is None:
            buffer: mmap.mmap | bytearray = bytearray(length)
        else:
            self._file = open(path, "a+b")  # noqa: SIM115 - closed in close()
            os.chmod(path, 0o600)
            if os.fstat(self._file.fileno()).st_size < length:
                os.ftruncate(self._file.fileno(), length)
            buffer = mmap.mmap(self._file.fileno(), length)
        self._buffer = buffer
        self._sequence = np.frombuffer(buffer, _SEQUENCE, 1)
        starts = [_HEAD, _HEAD + stride]
        self._sums = [np.frombuffer(buffer, "<u4", 1, s) for s in starts]
        self._slots = [memoryview(buffer)[s + 16 : s + stride] for s in starts]
        self._bytes = self.record.view(np.uint8).data
        self._seen = 0

    def write(self, record: np.ndarray) -> None:
        """Publish ``record`` (1,) of the layout's dtype. One writer only."""
        following = int(self._sequence[0]) + 1
        slot = following & 1
        data = record.tobytes()
        self._slots[slot][:] = data
        self._sums[slot][0] = zlib.crc32(data)
        self._sequence[0] = following

    def read(self) -> bool:
        """Take the newest record into ``self.record``. Returns whether it is new. Never waits."""
        for _ in range(3):  # a reader slower than two writes sees a bad checksum and looks again
            sequence = int(self._sequence[0])
            if sequence == self._seen:
                return False
            slot = sequence & 1
            data = bytes(self._slots[slot])
            if zlib.crc32(data) == int(self._sums[slot][0]):
                self._bytes[:] = data
                self._seen = sequence
                return True
        return False

    def close(self) -> None:
        """Let go of the file. The channel must not be used afterwards."""
        del self._sequence, self._sums, self._slots  # they look into the buffer
        if isinstance(self._buffer, mmap.mmap):
            self._buffer.close()
        if self._file is not None:
            self._file.close()
