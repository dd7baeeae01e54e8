"""The recorder's process: nothing it does or suffers holds up the one who sends, and the file tells what it lacks."""

from __future__ import annotations

import json
import multiprocessing
import os
import resource
import signal
import socket
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest
from recorded import LAYOUTS, random_walk

from sim2real.recorder import process
from sim2real.recorder.mcap import Writer
from sim2real.recorder.process import Recorder, Sink
from sim2real.recorder.reader import Reader
from sim2real.recorder.repair import repair
from sim2real.types import Sim2realError

TICKS = random_walk(LAYOUTS["/tick"], 3000)
PILOTS = random_walk(LAYOUTS["/pilot"], 300, rate=50.0)


def send(sink: Sink, topic: int, rows: np.ndarray) -> list[bool]:
    return [sink.write(topic, float(rows["time"][i]), rows[i : i + 1]) for i in range(len(rows))]


def send_patiently(sink: Sink, topic: int, rows: np.ndarray) -> None:
    """Nothing is lost on a sender that tries again."""
    for i in range(len(rows)):
        while not sink.write(topic, float(rows["time"][i]), rows[i : i + 1]):
            os.sched_yield()
    sink.dropped[topic] = 0


def test_what_was_sent_is_in_the_file(tmp_path):
    recorder = Recorder(tmp_path / "run.mcap", LAYOUTS, {"seed": 1}, {"robot.yaml": b"name: g1"})
    send_patiently(recorder.sink, 0, TICKS)
    send_patiently(recorder.sink, 1, PILOTS)
    ending = recorder.close()
    assert ending == {"written": {"/tick": 3000, "/pilot": 300}, "dropped": {"/tick": 0, "/pilot": 0}, "stopped": ""}
    reader = Reader(tmp_path / "run.mcap")
    assert reader["/tick"].tobytes() == TICKS.tobytes()
    assert reader["/pilot"].tobytes() == PILOTS.tobytes()
    assert reader.metadata == {"seed": "1"} and reader.attachments == {"robot.yaml": b"name: g1"}


def test_a_stopped_recorder_blocks_nobody_and_is_told_of_every_loss(tmp_path):
    """As slow as a disk can be: the process does not run at all while records come in."""
    recorder = Recorder(tmp_path / "run.mcap", LAYOUTS)
    os.kill(recorder.pid, signal.SIGSTOP)
    start = time.monotonic()
    rows = np.concatenate([TICKS] * 10)  # more than any channel holds
    sent = send(recorder.sink, 0, rows)
    elapsed = time.monotonic() - start
    os.kill(recorder.pid, signal.SIGCONT)
    dropped = sent.count(False)
    assert 0 < dropped == recorder.sink.dropped[0]
    assert elapsed < 5.0  # 30000 writes that waited for anything would show; they take about 0.1 s together
    ending = recorder.close()
    assert ending["dropped"] == {"/tick": dropped, "/pilot": 0}
    reader = Reader(tmp_path / "run.mcap")
    assert reader["/tick"].tobytes() == rows[np.array(sent)].tobytes()
    assert json.loads(reader.ending["dropped"]) == ending["dropped"]


def test_a_patient_sink_waits_for_a_stopped_recorder_and_loses_nothing(tmp_path, monkeypatch):
    monkeypatch.setattr(process, "CHANNEL_SIZE", 64 * 1024)
    recorder = Recorder(tmp_path / "run.mcap", LAYOUTS, patient=True)
    os.kill(recorder.pid, signal.SIGSTOP)
    sent: list[bool] = []
    sender = threading.Thread(target=lambda: sent.extend(send(recorder.sink, 0, TICKS)))
    sender.start()
    sender.join(0.2)
    assert sender.is_alive() and not sent
    os.kill(recorder.pid, signal.SIGCONT)
    sender.join(60)
    assert sent == [True] * len(TICKS)
    assert recorder.close(60)["dropped"] == {"/tick": 0, "/pilot": 0}
    assert Reader(tmp_path / "run.mcap")["/tick"].tobytes() == TICKS.tobytes()


def test_a_patient_process_waits_for_its_disk(tmp_path, monkeypatch):
    monkeypatch.setattr(process, "QUEUE_LENGTH", 3)
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    writer = Writer(tmp_path / "run.mcap", LAYOUTS)
    sink, drain = Sink(ours, len(LAYOUTS), patient=True), process._Drain(theirs, writer, list(LAYOUTS), patient=True)
    receiver = threading.Thread(target=drain.run)
    receiver.start()
    assert send(sink, 0, TICKS) == [True] * len(TICKS)
    sink.close()
    receiver.join(60)
    writer.finish()
    assert drain.overflowed == [0, 0]
    assert Reader(tmp_path / "run.mcap")["/tick"].tobytes() == TICKS.tobytes()


def pilot(sink: Sink) -> None:
    send_patiently(sink, 1, PILOTS)
    sink.close()


def test_several_processes_share_a_sink(tmp_path):
    recorder = Recorder(tmp_path / "run.mcap", LAYOUTS)
    other = multiprocessing.get_context("spawn").Process(target=pilot, args=(recorder.sink,))
    other.start()
    send_patiently(recorder.sink, 0, TICKS)
    other.join(30)
    assert other.exitcode == 0
    recorder.close()
    reader = Reader(tmp_path / "run.mcap")
    assert reader["/tick"].tobytes() == TICKS.tobytes()
    assert reader["/pilot"].tobytes() == PILOTS.tobytes()


ORPHAN = """
import os, sys
from recorded import LAYOUTS
from test_recorder_process import TICKS, send_patiently
from sim2real.recorder.process import Recorder
recorder = Recorder(sys.argv[1], LAYOUTS)
send_patiently(recorder.sink, 0, TICKS)
print(recorder.pid, flush=True)
os.kill(os.getpid(), 9)
"""


def wait_for(path: Path, seconds: float = 20.0) -> None:
    """The event waited for is another process's last act: a rename."""
    deadline = time.monotonic() + seconds
    while not path.exists():
        assert time.monotonic() < deadline, f"no {path}"
        time.sleep(0.01)


def test_the_run_is_killed_and_its_record_is_whole(tmp_path):
    root, here = Path(__file__).resolve().parents[2], Path(__file__).parent
    path = tmp_path / "run.mcap"
    done = subprocess.run(
        [sys.executable, "-c", ORPHAN, str(path)], env={"PYTHONPATH": f"{root}:{here}"}, stdout=subprocess.PIPE
    )
    assert done.returncode == -signal.SIGKILL
    wait_for(path)
    assert Reader(path)["/tick"].tobytes() == TICKS.tobytes()


def test_sigterm_finishes_the_file_and_ctrl_c_does_not_touch_it(tmp_path):
    recorder = Recorder(tmp_path / "run.mcap", LAYOUTS)
    os.kill(recorder.pid, signal.SIGINT)
    send_patiently(recorder.sink, 0, TICKS[:100])
    os.kill(recorder.pid, signal.SIGTERM)
    wait_for(tmp_path / "run.mcap")
    assert len(Reader(tmp_path / "run.mcap")["/tick"]) == 100
    assert recorder.close()["written"] == {"/tick": 100, "/pilot": 0}


def test_a_killed_recorder_costs_the_record_only(tmp_path):
    recorder = Recorder(tmp_path / "run.mcap", LAYOUTS)
    send_patiently(recorder.sink, 0, TICKS)
    part = tmp_path / "run.mcap.part"
    deadline = time.monotonic() + 20
    while Reader(part, salvage=True).records < 1000 and time.monotonic() < deadline:
        time.sleep(0.01)  # until it has written what the repair is to find
    os.kill(recorder.pid, signal.SIGKILL)
    os.waitid(os.P_PID, recorder.pid, os.WEXITED | os.WNOWAIT)
    assert send(recorder.sink, 0, TICKS[:10]) == [False] * 10
    with pytest.raises(Sim2realError, match=f"record not finished: .*log repair {part}"):
        recorder.close()
    done = repair(part)
    assert done.output == tmp_path / "run-repaired.mcap"
    saved = Reader(done.output)["/tick"]
    assert 1000 <= len(saved) and TICKS.tobytes().startswith(saved.tobytes())


def test_a_full_disk_is_announced_and_the_run_goes_on(tmp_path):
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (3_000_000, hard))
    try:
        recorder = Recorder(tmp_path / "run.mcap", LAYOUTS)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert recorder.poll() == []
    rows, deadline, banners = random_walk(LAYOUTS["/tick"], 8000), time.monotonic() + 20, []
    while not banners and time.monotonic() < deadline:
        send_patiently(recorder.sink, 0, rows)
        banners = recorder.poll()
    assert banners == [f"{tmp_path}/run.mcap: recording stopped: File too large"]
    assert all(send(recorder.sink, 1, PILOTS[:5]))
    ending = recorder.close()
    assert "File too large" in str(ending["stopped"])
    assert Reader(tmp_path / "run.mcap").records > 100


def test_a_record_that_cannot_be_is_refused_at_the_start(tmp_path):
    (tmp_path / "file").write_text("not a folder")
    with pytest.raises(Sim2realError, match=f"cannot record: File exists: {tmp_path}/file"):
        Recorder(tmp_path / "file" / "run.mcap", LAYOUTS)


def test_the_process_starts_light():
    """It shares the machine with a control loop: no simulator, no network runtime, no plotting."""
    code = "import sys, sim2real.recorder.process; print(*sys.modules)"
    root = str(Path(__file__).resolve().parents[2])
    loaded = subprocess.run([sys.executable, "-c", code], env={"PYTHONPATH": root}, capture_output=True, text=True)
    modules = set(loaded.stdout.split())
    assert "numpy" in modules
    assert not modules & {"mujoco", "torch", "onnxruntime", "onnx", "pydantic", "rich", "tyro", "yaml"}
