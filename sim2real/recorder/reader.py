"""Records out of MCAP files: back to the arrays they were, bit for bit, also from what is left of a damaged file.

The file is walked front to back without its index, so a whole file and a torn one are read by the same lines.
"""

from __future__ import annotations

import contextlib
import mmap
import os
import struct
import zlib
from collections.abc import Iterator
from io import BytesIO
from pathlib import Path

import numpy as np

from sim2real.recorder.mcap import ENDING, LAYOUTS, PART, RUN
from sim2real.recorder.schema import CDR_HEADER, layout_from_json
from sim2real.records import Layout
from sim2real.types import Sim2realError

MAGIC = b"\x89MCAP0\r\n"
OPCODE = struct.Struct("<BQ")  # opcode, length of what follows
MESSAGE = struct.Struct("<HIQQ")  # channel, sequence, log time, publish time
CHUNK = struct.Struct(
    "<QQQII"
)  # start and end time, uncompressed size, CRC-32 of that, length of the compression's name
CHUNK_LIMIT = 64 * 1024 * 1024  # bytes; a chunk that claims to hold more is damaged or hostile


class Reader:
    """A record file in memory.

    ``reader[topic]``: structured array (n,) of the topic's Layout, in file order, read-only; ``log_time[topic]``:
    (n,) int64 ns. ``metadata``: what the run said about itself; ``ending``: what the recorder said at the end (empty if
    it never did). ``damage``: one sentence for each part that could not be read.

    Raises Sim2realError: no such file, empty, not MCAP, not a record of ours; and, unless ``salvage``, damaged.
    """

    def __init__(self, path: Path | str, salvage: bool = False) -> None:
        self.path = Path(path)
        self.layouts: dict[str, Layout] = {}
        self.metadata: dict[str, str] = {}
        self.ending: dict[str, str] = {}
        self.attachments: dict[str, bytes] = {}
        self.damage: list[str] = []
        self.log_time: dict[str, np.ndarray] = {}
        self._channels: dict[int, str] = {}
        self._bodies: dict[int, list[bytes]] = {}
        self._times: dict[int, list[int]] = {}
        self._finished = False
        with _mapped(self.path) as data:
            if data[: len(MAGIC)] != MAGIC:
                raise Sim2realError(
                    f"{self.path}: not a record: got a file that starts with {bytes(data[:8])!r}, expected MCAP;"
                    " give a file that sim2real deploy wrote"
                )
            self._walk(data)
            self._finished &= data[-len(MAGIC) :] == MAGIC
        if not self._finished and not self.damage:
            self.damage.append("the end is missing")
        if not self.layouts and not self.damage:
            raise Sim2realError(
                f"{self.path}: an MCAP file, but not a record of a run: no '{LAYOUTS}' in it;"
                " give a file that sim2real deploy wrote"
            )
        if self.damage and not salvage:
            raise Sim2realError(
                f"{self.path}: damaged: {self.damage[0]}; save what is there with: sim2real log repair {self.path}"
            )
        self._arrays = {topic: self._array(topic, layout) for topic, layout in self.layouts.items()}

    def __getitem__(self, topic: str) -> np.ndarray:
        return self._arrays[topic]

    @property
    def topics(self) -> tuple[str, ...]:
        return tuple(self.layouts)

    @property
    def records(self) -> int:
        """How many records of all topics together."""
        return sum(map(len, self._arrays.values()))

    def _walk(self, data: mmap.mmap) -> None:
        """Everything outside of chunks, and the chunks. Where no record can start, look for the next chunk."""
        at = len(MAGIC)
        while at < len(data) and not self._finished:
            opcode, length = OPCODE.unpack(data[at : at + OPCODE.size].ljust(OPCODE.size, b"\0"))
            body = data[at + OPCODE.size : at + OPCODE.size + length]
            sound = opcode in _KINDS and len(body) == length
            if not sound:
                self.damage.append(f"no whole record at byte {at} of {len(data)}")
            if sound or opcode == _CHUNK:
                try:
                    _KINDS[opcode](self, body)
                except Exception as error:  # noqa: BLE001 - whatever a library makes of damaged bytes
                    self.damage.append(f"unreadable record at byte {at} of {len(data)}: {error}")
            at = at + OPCODE.size + length if sound else _next_chunk(data, at + 1)

    def _skip(self, body: bytes) -> None:
        pass

    def _footer(self, body: bytes) -> None:
        self._finished = True

    def _metadata(self, body: bytes) -> None:
        from mcap.data_stream import ReadDataStream
        from mcap.records import Metadata

        record = Metadata.read(ReadDataStream(BytesIO(body)))
        if record.name == LAYOUTS:
            self.layouts = {topic: layout_from_json(text) for topic, text in record.metadata.items()}
        elif record.name in (RUN, ENDING):
            (self.metadata if record.name == RUN else self.ending).update(record.metadata)

    def _attachment(self, body: bytes) -> None:
        from mcap.data_stream import ReadDataStream
        from mcap.records import Attachment

        attachment = Attachment.read(ReadDataStream(BytesIO(body)))
        if zlib.crc32(body[:-4]) != int.from_bytes(body[-4:], "little"):
            raise ValueError(f"attachment '{attachment.name}' is corrupt")
        self.attachments[attachment.name] = attachment.data

    def _channel(self, body: bytes) -> None:
        from mcap.data_stream import ReadDataStream
        from mcap.records import Channel

        channel = Channel.read(ReadDataStream(BytesIO(body)))
        self._channels[channel.id] = channel.topic

    def _message(self, body: bytes) -> None:
        channel, _, time, _ = MESSAGE.unpack_from(body)
        self._bodies.setdefault(channel, []).append(body[MESSAGE.size :])
        self._times.setdefault(channel, []).append(time)

    def _chunk(self, body: bytes) -> None:
        """The records of one chunk; of a cut one those that are whole."""
        _, _, size, crc, name_length = CHUNK.unpack_from(body)
        start = CHUNK.size + name_length
        compression = body[CHUNK.size : start].decode()
        (length,) = struct.unpack_from("<Q", body, start)
        if size > CHUNK_LIMIT:
            raise ValueError(f"a chunk of {size} bytes")
        stored = body[start + 8 : start + 8 + length]
        data = _decompress(compression, stored, size)
        whole = len(stored) == length
        if whole and (len(data) != size or (crc and zlib.crc32(data) != crc)):
            raise ValueError("a chunk does not match its checksum")
        for opcode, record in _split(data):
            if opcode in (_CHANNEL, _MESSAGE):
                _KINDS[opcode](self, record)

    def _array(self, topic: str, layout: Layout) -> np.ndarray:
        # A file whose first chunk is lost names no channel: then they are numbered in the order of the layouts.
        places = {t: c for c, t in self._channels.items()}
        channel = places.get(topic, 1 + list(self.layouts).index(topic))
        size = len(CDR_HEADER) + layout.dtype.itemsize
        good = [i for i, b in enumerate(self._bodies.get(channel, ())) if len(b) == size and b.startswith(CDR_HEADER)]
        if strange := len(self._bodies.get(channel, ())) - len(good):
            self.damage.append(f"{strange} records of {topic} are not {size} bytes of CDR")
        self.log_time[topic] = np.array([self._times[channel][i] for i in good], np.uint64).astype(np.int64)
        return np.frombuffer(b"".join(self._bodies[channel][i][4:] for i in good) if good else b"", layout.dtype)


_MESSAGE, _CHUNK, _CHANNEL = 0x05, 0x06, 0x04
# Opcodes of the specification; what only repeats or indexes the data is passed over.
_KINDS = {number: Reader._skip for number in range(0x01, 0x10)} | {
    0x02: Reader._footer,
    _CHANNEL: Reader._channel,
    _MESSAGE: Reader._message,
    _CHUNK: Reader._chunk,
    0x09: Reader._attachment,
    0x0C: Reader._metadata,
}


@contextlib.contextmanager
def _mapped(path: Path) -> Iterator[mmap.mmap]:
    """A file as memory. Raises Sim2realError where there is none, or nothing in it."""
    try:
        with path.open("rb") as file:
            if os.fstat(file.fileno()).st_size == 0:
                raise Sim2realError(f"{path}: an empty file, expected an MCAP record; nothing was recorded")
            with mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
                yield data
    except OSError as error:
        part = path.with_name(path.name + PART)
        hint = f"; its run did not end properly: sim2real log repair {part}" if part.is_file() else ""
        raise Sim2realError(f"{path}: cannot read: {error.strerror}{hint}") from None


def _next_chunk(data: mmap.mmap, start: int) -> int:
    """Where the next chunk of our writer begins, or the end of the file."""
    name = data.find(b"\3\0\0\0lz4", start + OPCODE.size + CHUNK.size - 4)
    return len(data) if name < 0 else name - OPCODE.size - CHUNK.size + 4


def _decompress(compression: str, data: bytes, size: int) -> bytes:
    """At most ``size`` bytes; fewer if ``data`` was cut."""
    if compression == "":
        return data[:size]
    if compression == "lz4":
        import lz4.frame

        return lz4.frame.LZ4FrameDecompressor().decompress(data, max_length=size)
    if compression == "zstd":
        import zstandard

        with zstandard.ZstdDecompressor().stream_reader(data) as stream:
            return stream.read(size)
    raise ValueError(f"compression '{compression}', expected lz4 or zstd")


def _split(data: bytes) -> Iterator[tuple[int, bytes]]:
    """(opcode, body) of the whole records in a chunk's data."""
    at = 0
    while at + OPCODE.size <= len(data):
        opcode, length = OPCODE.unpack_from(data, at)
        at += OPCODE.size
        if at + length > len(data):
            return
        yield opcode, data[at : at + length]
        at += length
