"""Channels: newest value, never torn, never waiting."""

import subprocess
import sys

import numpy as np
import pytest

from sim2real.channel import Channel
from sim2real.records import layout

LAYOUT = layout("Test", [("time", "f8", None), ("x", "f8", [f"e{i}" for i in range(500)])])


@pytest.fixture(params=["process", "file"])
def pair(request, tmp_path):
    """A writing and a reading end."""
    if request.param == "process":
        channel = Channel(LAYOUT)
        yield channel, channel
    else:
        writer, reader = (Channel(LAYOUT, tmp_path / "c.channel") for _ in range(2))
        yield writer, reader
        writer.close()
        reader.close()


def test_nothing_is_new_before_the_first_write(pair):
    _, reader = pair
    assert not reader.read()
    assert reader.record["time"][0] == 0


def test_a_value_is_new_once_and_only_the_newest_is_seen(pair):
    writer, reader = pair
    record = LAYOUT.new()
    for value in (1.0, 2.0, 3.0):
        record["x"][:] = value
        writer.write(record)
    assert reader.read()
    assert (reader.record["x"] == 3.0).all()
    assert not reader.read()


def test_a_half_written_slot_is_not_taken(pair):
    writer, reader = pair
    record = LAYOUT.new()
    record["x"][:] = 1.0
    writer.write(record)
    assert reader.read()
    torn = bytes([255]) * len(writer._slots[0])
    writer._slots[0][:] = torn  # a writer caught in the middle: bytes changed, sequence moved, checksum not
    writer._sequence[0] += 1
    assert not reader.read()
    assert (reader.record["x"] == 1.0).all()


def test_no_torn_read_while_another_process_writes_as_fast_as_it_can(tmp_path):
    code = (
        "import sys, time; sys.path.insert(0, sys.argv[1])\n"
        "from pathlib import Path\n"
        "from tests.sim2real.test_channel import LAYOUT\n"
        "from sim2real.channel import Channel\n"
        "c = Channel(LAYOUT, Path(sys.argv[2])); r = LAYOUT.new(); end = time.monotonic() + 1.5\n"
        "while time.monotonic() < end:\n"
        "    r['x'] += 1; r['time'] += 1; c.write(r)\n"
        "print(int(r['time'][0]))\n"
    )
    path = tmp_path / "c.channel"
    reader = Channel(LAYOUT, path)
    root = str(__file__).rsplit("/tests/", 1)[0]
    writer = subprocess.Popen(
        [sys.executable, "-c", code, root, str(path)], stdout=subprocess.PIPE, text=True, cwd=root
    )
    reads, last = 0, 0.0
    while writer.poll() is None:
        if reader.read():
            reads += 1
            x = reader.record["x"][0]
            assert (x == x[0]).all() and x[0] == reader.record["time"][0]
            assert x[0] >= last
            last = x[0]
    reader.read()
    assert int(writer.stdout.read()) == reader.record["time"][0]
    assert reads > 10  # it did look while the other wrote, even on a busy machine
    reader.close()


def test_records_survive_bit_for_bit(pair):
    writer, reader = pair
    record = LAYOUT.new()
    record["x"][0] = np.random.default_rng(0).standard_normal(500)
    record["x"][0, :3] = (np.nan, np.inf, -0.0)
    writer.write(record)
    reader.read()
    assert reader.record.tobytes() == record.tobytes()
