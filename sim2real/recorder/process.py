"""The writer as a process of its own, behind a channel that loses records rather than wait.

``Recorder`` owns the process; its ``sink`` goes to whoever has something to record (guardian, pilot: a Sink passes
through ``multiprocessing``). A sink never blocks: when the channel is full the record is dropped and counted, and the
count travels with the next one, so the file tells what it lacks. In lockstep, where time waits, so does a ``patient``
sink, and nothing is dropped; it sends many records at once, for each wakes the writer.
"""

from __future__ import annotations

import base64
import contextlib
import json
import os
import queue
import select
import signal
import socket
import struct
import subprocess
import sys
import threading
from collections.abc import Mapping
from pathlib import Path
from typing import IO

import numpy as np

from sim2real.recorder.mcap import Writer, strings
from sim2real.recorder.schema import layout_from_json, layout_to_json
from sim2real.records import Layout
from sim2real.types import Sim2realError

ENVELOPE = struct.Struct("<IIIId")  # before each record: sink's id, topic, records of it dropped so far, bytes, time
BATCH = 64 * 1024  # bytes of records that a patient sink sends at once
CHANNEL_SIZE = 8 * 1024 * 1024  # bytes asked of the kernel; it may grant less (net.core.wmem_max)
QUEUE_LENGTH = 16384  # records in memory while the disk is slow: about 64 MB, half a minute of a G1
FLUSH_INTERVAL = 1.0  # s, at most this much of a run is in memory when the writer is killed


class Sink:
    """The sending end: ``write`` and, unless ``patient``, nothing that waits. ``dropped``: records lost so far, per topic."""

    def __init__(self, channel: socket.socket, topics: int, patient: bool = False) -> None:
        channel.setblocking(patient)
        self._channel = channel
        self._id = os.getpid()
        self._batch = bytearray()
        self._enough = BATCH if patient else 1
        self.dropped = [0] * topics

    def write(self, topic: int, time: float, record: bytes | np.ndarray) -> bool:
        """Send one record (bytes, or an array of shape (1,)) of the ``topic``-th layout, taken at ``time`` (s,
        monotonic). False: dropped and counted."""
        data = record if isinstance(record, bytes) else record.tobytes()
        batch = self._batch
        batch += ENVELOPE.pack(self._id, topic, self.dropped[topic], len(data), time)
        batch += data
        if len(batch) < self._enough:
            return True
        try:
            self._channel.send(batch)
            return True
        except OSError:  # full (EAGAIN, ENOBUFS), or the recorder is gone (EPIPE): the run goes on either way
            self.dropped[topic] += 1
            return False
        finally:
            batch.clear()

    def fileno(self) -> int:
        return self._channel.fileno()

    def close(self, timeout: float = 1.0) -> None:
        """Say how much was dropped last, and let go. Waits up to ``timeout`` seconds for room to say it; never raises."""
        with contextlib.suppress(OSError):
            self._channel.settimeout(timeout)
            for topic, dropped in enumerate(self.dropped):
                self._batch += ENVELOPE.pack(self._id, topic, dropped, 0, 0.0)
            self._channel.send(self._batch)
        self._channel.close()

    def __reduce__(self) -> tuple:
        return Sink, (self._channel, len(self.dropped), self._channel.getblocking())


class Recorder:
    """Starts the writer process for one file; arguments as of ``Writer``. ``patient``: its sink waits for room rather than
    drop a record. Raises Sim2realError if it cannot record."""

    def __init__(
        self,
        path: Path | str,
        layouts: Mapping[str, Layout],
        metadata: Mapping[str, object] | None = None,
        attachments: Mapping[str, bytes] | None = None,
        patient: bool = False,
    ) -> None:
        self.path = Path(path).absolute()
        job = {
            "path": str(self.path),
            "patient": patient,
            "layouts": {topic: layout_to_json(layout) for topic, layout in layouts.items()},
            "metadata": strings(metadata or {}),
            "attachments": {name: base64.b64encode(data).decode() for name, data in (attachments or {}).items()},
        }
        ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        ours.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, CHANNEL_SIZE)
        root = str(Path(__file__).resolve().parents[2])
        self._process = subprocess.Popen(
            [sys.executable, "-m", "sim2real.recorder.process", str(theirs.fileno())],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            bufsize=0,  # ``select`` must see every line that is not read yet
            pass_fds=[theirs.fileno()],
            env={**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, (root, os.environ.get("PYTHONPATH"))))},
        )
        theirs.close()
        assert self._process.stdin and self._process.stdout
        with contextlib.suppress(BrokenPipeError):  # it died early: the answer says so
            _write_all(self._process.stdin, json.dumps(job).encode())
        self._process.stdin.close()
        first = self._read(timeout=20.0)
        if first.get("event") != "ready":
            ours.close()
            self._process.kill()
            self._process.wait()
            raise Sim2realError(first.get("text", f"{self.path}: the recorder did not start; see the messages above"))
        self.sink = Sink(ours, len(layouts), patient)

    @property
    def pid(self) -> int:
        return self._process.pid

    def poll(self) -> list[str]:
        """What an operator should be told since the last call (recording stopped: disk full, ...). Never blocks."""
        texts = []
        while message := self._read(timeout=0.0):
            texts.append(message["text"])
        return texts

    def close(self, timeout: float = 10.0) -> dict[str, object]:
        """Take in what was sent, finish the file and end the process. Returns the ending: ``written`` and ``dropped``
        (topic -> records) and ``stopped`` (why recording stopped early, or ""). Raises Sim2realError where the file is
        not finished after ``timeout`` seconds; then it is left to ``sim2real log repair``."""
        self.sink.close(timeout)
        with contextlib.suppress(ProcessLookupError):
            self._process.terminate()  # other holders of the sink may be hung: do not wait for their end of the channel
        try:
            while message := self._read(timeout):
                if message["event"] == "finished":
                    self._process.wait(timeout)
                    return message["ending"]
        except subprocess.TimeoutExpired:
            pass
        text = message.get("text") if message else "the recorder died, or its disk does not answer"
        raise Sim2realError(f"{self.path}: record not finished: {text}; try: sim2real log repair {self.path}.part")

    def _read(self, timeout: float) -> dict:
        """The next message of the process, or {} if there is none within ``timeout`` or it has ended."""
        stream = self._process.stdout
        assert stream
        if not select.select([stream], [], [], timeout)[0]:
            return {}
        return json.loads(stream.readline() or "{}")


class _Drain:
    """The receiving end: this thread only empties the channel into memory, another one writes to the disk."""

    def __init__(self, channel: socket.socket, writer: Writer, topics: list[str], patient: bool) -> None:
        self.channel = channel
        self.writer = writer
        self.topics = topics
        self.patient = patient  # the sender waits for this thread, so this thread may for the other
        self.queue: queue.Queue[tuple[int, float, bytes] | None] = queue.Queue(QUEUE_LENGTH)
        self.lost: dict[tuple[int, int], int] = {}  # (sink, topic) -> records it dropped
        self.overflowed = [0] * len(topics)
        self.refused = [0] * len(topics)
        self.ending = False

    def run(self) -> dict[str, object]:
        thread = threading.Thread(target=self._write, name="disk", daemon=True)
        thread.start()
        while self._receive(wait=0.0 if self.ending else 0.1):
            pass
        self.queue.put(None)
        thread.join()
        dropped = [a + b for a, b in zip(self.overflowed, self.refused, strict=True)]
        for (_, topic), lost in self.lost.items():
            dropped[topic] += lost
        return {
            "written": dict(zip(self.topics, self.writer.written, strict=True)),
            "dropped": dict(zip(self.topics, dropped, strict=True)),
            "stopped": self.writer.stopped,
        }

    def _receive(self, wait: float) -> bool:
        """Take in what has arrived. False: there is nothing more to come."""
        if not select.select([self.channel], [], [], wait)[0]:
            return not self.ending
        datagram = self.channel.recv(1 << 20)
        if not datagram:
            return False
        at = 0
        while at < len(datagram):
            sink, topic, dropped, size, time = ENVELOPE.unpack_from(datagram, at)
            self.lost[sink, topic] = dropped
            at += ENVELOPE.size + size
            if size:
                try:
                    self.queue.put((topic, time, datagram[at - size : at]), block=self.patient)
                except queue.Full:
                    self.overflowed[topic] += 1
        return True

    def _write(self) -> None:
        told = False
        while item := self._next():
            if not self.writer.write(*item):
                self.refused[item[0]] += 1
            if self.writer.stopped and not told:
                told = True
                _say(event="stopped", text=self.writer.stopped)

    def _next(self) -> tuple[int, float, bytes] | None:
        while True:
            try:
                return self.queue.get(timeout=FLUSH_INTERVAL)
            except queue.Empty:
                self.writer.flush()


def _write_all(stream: IO[bytes], data: bytes) -> None:
    while data:
        data = data[stream.write(data) :]


def _say(**message: object) -> None:
    with contextlib.suppress(OSError):  # nobody listens any more: the file matters
        print(json.dumps(message), flush=True)


def main(descriptor: int) -> int:
    """The process: a job on stdin, records on the channel, messages on stdout, until end of file or SIGTERM."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C goes to the whole group: the run ends first, then the record
    with contextlib.suppress(OSError):  # whatever priority the run has is not for the disk
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
    channel = socket.socket(fileno=descriptor)
    job = json.loads(sys.stdin.buffer.read())
    layouts = {topic: layout_from_json(text) for topic, text in job["layouts"].items()}
    attachments = {name: base64.b64decode(data) for name, data in job["attachments"].items()}
    try:
        writer = Writer(job["path"], layouts, job["metadata"], attachments)
    except Sim2realError as error:
        _say(event="error", text=str(error))
        return 2
    drain = _Drain(channel, writer, list(layouts), job["patient"])
    for number in (signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, lambda *_: setattr(drain, "ending", True))
    _say(event="ready")
    ending = drain.run()
    try:
        writer.finish(ending)
    except Sim2realError as error:
        _say(event="error", text=str(error))
        return 1
    _say(event="finished", ending=ending)
    return 0


if __name__ == "__main__":
    sys.exit(main(int(sys.argv[1])))
