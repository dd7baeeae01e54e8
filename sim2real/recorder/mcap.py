"""Records in and out of MCAP files (mcap.dev/spec): the bytes of a record are the bytes in the file.

Messages are CDR under a ``ros2msg`` schema made from the Layout; times are CLOCK_MONOTONIC nanoseconds, and the wall
clock appears in the metadata only. A file is written as ``<name>.part`` and renamed when its index is complete.
"""

from __future__ import annotations

import errno
import json
import math
import os
from collections.abc import Mapping
from pathlib import Path
from typing import BinaryIO

import numpy as np

from sim2real.recorder.schema import CDR_HEADER, PACKAGE, layout_to_json, ros2msg
from sim2real.records import Layout
from sim2real.types import Sim2realError

PART = ".part"  # suffix of a file that is still being written, or was never finished
CHUNK_SIZE = 256 * 1024  # bytes before compression: what a killed writer may lose, about 0.25 s of a G1
ALLOCATE = getattr(os, "posix_fallocate", lambda fd, offset, size: None)  # macOS has none: a full disk tears the file
LAYOUTS, RUN, ENDING = "layouts", "run", "recorder"  # names of the metadata records


class Writer:
    """Writes one record file, mode 0600, in a directory that it makes 0700 if there is none.

    ``layouts``: topic -> Layout; a topic's place in it is its index. ``metadata``: what the run was (strings, or
    anything JSON). ``attachments``: name -> content of the files that the run used.

    Room for the next chunk and for the final index is allocated ahead, so a full disk ends the record as a complete
    file instead of a torn one: from then on ``write`` returns False and ``stopped`` says why.
    Raises Sim2realError where the file cannot be created or exists already.
    """

    def __init__(
        self,
        path: Path | str,
        layouts: Mapping[str, Layout],
        metadata: Mapping[str, object] | None = None,
        attachments: Mapping[str, bytes] | None = None,
    ) -> None:
        from mcap.writer import CompressionType
        from mcap.writer import Writer as McapWriter

        self.path = Path(path)
        self.part = self.path.with_name(self.path.name + PART)
        self.stopped = ""
        self.written = [0] * len(layouts)
        schemas = {topic: ros2msg(layout).encode() for topic, layout in layouts.items()}
        documents = {topic: layout_to_json(layout) for topic, layout in layouts.items()}
        run, attachments = strings(metadata or {}), attachments or {}
        start_size = sum(map(len, [*documents.values(), *run.values(), *attachments.values()])) + CHUNK_SIZE
        self._sizes = [layout.dtype.itemsize for layout in layouts.values()]
        self._torn = False
        self._allocated = 0
        self._end_size = CHUNK_SIZE + sum(map(len, schemas.values()))  # of the index; grows with the chunks
        self._file = self._create()
        if not self._reserve(start_size):
            self._file.close()
            self.part.unlink()
            raise Sim2realError(f"{self.stopped}: no room to record; free some space, or record elsewhere")
        self._mcap = McapWriter(self._file, CHUNK_SIZE, CompressionType.LZ4)
        self._mcap.start("ros2", "sim2real")
        self._mcap.add_metadata(LAYOUTS, documents)
        self._mcap.add_metadata(RUN, run)
        for name, content in attachments.items():
            self._mcap.add_attachment(0, 0, name, "application/octet-stream", content)
        self._mcap.flush()  # whatever happens to the run, its file says what it was
        self._channels = [
            self._mcap.register_channel(
                topic, "cdr", self._mcap.register_schema(f"{PACKAGE}/msg/{layout.name}", "ros2msg", schemas[topic])
            )
            for topic, layout in layouts.items()
        ]

    def write(self, topic: int, time: float, record: bytes | np.ndarray) -> bool:
        """Append one record (bytes, or an array of shape (1,)) of the ``topic``-th layout, taken at ``time`` (s,
        monotonic). False: the disk is full. Raises ValueError on a record of another size."""
        record = bytes(record)
        if len(record) != self._sizes[topic]:
            raise ValueError(f"record of topic {topic}: got {len(record)} bytes, expected {self._sizes[topic]}")
        if not self._reserve(2 * CHUNK_SIZE):
            return False
        stamp = nanoseconds(time)
        try:
            self._mcap.add_message(self._channels[topic], stamp, CDR_HEADER + record, stamp, self.written[topic])
        except OSError as error:
            self._stop(error, torn=True)
            return False
        self.written[topic] += 1
        self._end_size += 8
        return True

    def flush(self) -> None:
        """End the current chunk and hand everything to the operating system: what a kill cannot take back."""
        if self._reserve(2 * CHUNK_SIZE):
            try:
                self._mcap.flush()
            except OSError as error:
                self._stop(error, torn=True)
            self._end_size += 256

    def finish(self, ending: Mapping[str, object] | None = None) -> Path:
        """Write ``ending`` into the metadata, then the index, and put the file in its place. Returns where it is.

        Raises Sim2realError where the disk fails meanwhile; the ``.part`` file is left for ``sim2real log repair``.
        """
        try:
            if not self._torn:
                self._mcap.flush()
                self._mcap.add_metadata(ENDING, strings({"stopped": self.stopped, **(ending or {})}))
                self._mcap.finish()
                self._file.truncate(self._file.tell())  # give back what was allocated ahead
                os.fsync(self._file.fileno())
                self._file.close()
                os.replace(self.part, self.path)
                return self.path
        except OSError as error:
            self._stop(error, torn=True)
        raise Sim2realError(f"{self.stopped}; save what is there with: sim2real log repair {self.part}")

    def _create(self) -> BinaryIO:
        flags = os.O_CREAT | os.O_EXCL | os.O_WRONLY | os.O_CLOEXEC | os.O_NOFOLLOW
        try:
            self.path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
            if self.path.exists():
                raise FileExistsError(errno.EEXIST, "is there already, and no record is overwritten", str(self.path))
            return os.fdopen(os.open(self.part, flags, 0o600), "wb")
        except OSError as error:
            raise Sim2realError(
                f"{self.path}: cannot record: {error.strerror}: {error.filename}; name another file"
            ) from None

    def _reserve(self, size: int) -> bool:
        """Allocate disk for ``size`` bytes more and for the end of the file. False: there is none, recording stops."""
        end = self._file.tell() + size + self._end_size
        if not self.stopped and end > self._allocated:
            try:
                end += 4 * CHUNK_SIZE
                ALLOCATE(self._file.fileno(), self._allocated, end - self._allocated)
                self._allocated = end
            except OSError as error:
                self._stop(error)
        return not self.stopped

    def _stop(self, error: OSError, torn: bool = False) -> None:
        self.stopped = f"{self.path}: recording stopped: {error.strerror}"
        self._torn |= torn


def nanoseconds(time: float) -> int:
    """Seconds as an MCAP time; 0 for what is none (negative, not finite)."""
    return round(time * 1e9) if math.isfinite(time) and 0 < time < 1e10 else 0


def strings(values: Mapping[str, object]) -> dict[str, str]:
    """MCAP metadata holds strings only: everything else becomes JSON."""
    return {key: value if isinstance(value, str) else json.dumps(value) for key, value in values.items()}
