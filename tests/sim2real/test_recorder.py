"""A record is what it was: bit for bit with our reader, by joint name with other people's, and what is left of it when
it was cut, flipped or ran out of disk."""

from __future__ import annotations

import json
import re
import resource
import stat
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from recorded import BUSES, JOINTS, LAYOUTS, random_walk, write_record

from sim2real.recorder.mcap import Writer, nanoseconds
from sim2real.recorder.reader import Reader
from sim2real.recorder.repair import repair
from sim2real.recorder.schema import identifiers, layout_from_json, layout_to_json, ros2msg
from sim2real.records import layout
from sim2real.types import Sim2realError

ARRAYS = {"/tick": random_walk(LAYOUTS["/tick"], 2000), "/pilot": random_walk(LAYOUTS["/pilot"], 400, rate=50.0)}
ATTACHMENTS = {"robot.yaml": b"name: g1\n", "empty": b"", "basics.onnx": bytes(range(256)) * 40}


@pytest.fixture(scope="module")
def record(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("run") / "runs" / "run.mcap"
    return write_record(path, ARRAYS, metadata={"seed": 7, "clock": "lockstep"}, attachments=ATTACHMENTS)


def test_bit_for_bit(record):
    reader = Reader(record)
    assert reader.topics == ("/tick", "/pilot")
    for topic, array in ARRAYS.items():
        assert reader[topic].dtype == array.dtype
        assert reader[topic].tobytes() == array.tobytes()
        assert reader.layouts[topic] == LAYOUTS[topic]
        assert reader.log_time[topic].tolist() == [nanoseconds(t) for t in array["time"]]
    assert reader.metadata == {"seed": "7", "clock": "lockstep"}
    assert reader.attachments == ATTACHMENTS
    assert json.loads(reader.ending["written"]) == {"/tick": 2000, "/pilot": 400}
    assert reader.damage == []


def test_private_and_whole(record):
    assert stat.S_IMODE(record.stat().st_mode) == 0o600
    assert stat.S_IMODE(record.parent.stat().st_mode) == 0o700
    assert list(record.parent.iterdir()) == [record]


def test_an_independent_reader_finds_every_value_by_name(record):
    """mcap-ros2-support decodes the CDR from the schema alone: it knows nothing of layouts."""
    from mcap.reader import SeekingReader
    from mcap_ros2.decoder import DecoderFactory

    names = dict(zip(JOINTS, identifiers(JOINTS), strict=True))
    seen = {topic: 0 for topic in ARRAYS}
    messages = SeekingReader(record.open("rb"), decoder_factories=[DecoderFactory()]).iter_decoded_messages()
    for _, channel, message, decoded in messages:
        topic = channel.topic
        row = ARRAYS[topic][seen[topic]]
        assert message.log_time == message.publish_time == nanoseconds(float(row["time"]))
        assert message.sequence == seen[topic]
        for field in LAYOUTS[topic].dtype.names:
            value = decoded
            for part in field.split("."):
                value = getattr(value, part)
            elements = LAYOUTS[topic].elements.get(field)
            got = value if elements is None else [getattr(value, n) for n in identifiers(elements)]
            assert np.array(got, row[field].dtype).tobytes() == row[field].tobytes(), field
        seen[topic] += 1
    assert seen == {"/tick": 2000, "/pilot": 400}
    assert names["left_knee_joint"] == "left_knee_joint"  # a viewer's path: /tick state.joint_pos.left_knee_joint


def test_the_index_is_sound(record):
    """mcap's own seeking reader works from the summary section alone."""
    from mcap.reader import SeekingReader

    with record.open("rb") as file:
        reader = SeekingReader(file, validate_crcs=True)
        assert reader.get_header().profile == "ros2"
        summary = reader.get_summary()
        assert {c.topic: c.message_encoding for c in summary.channels.values()} == {"/tick": "cdr", "/pilot": "cdr"}
        assert {s.encoding for s in summary.schemas.values()} == {"ros2msg"}
        assert summary.statistics.message_count == 2400
        late = list(reader.iter_messages(topics="/pilot", starting_at=nanoseconds(107.0)))
        assert len(late) == 50
        assert [a.name for a in reader.iter_attachments()] == list(ATTACHMENTS)


@pytest.mark.parametrize("compression", ["NONE", "LZ4", "ZSTD"])
@pytest.mark.parametrize("chunked", [True, False])
def test_a_record_rewritten_by_another_tool(record, tmp_path, compression, chunked):
    """Other compression, other channel numbers, one topic after the other, no chunks: the same record."""
    from mcap.reader import SeekingReader
    from mcap.writer import CompressionType
    from mcap.writer import Writer as McapWriter

    path = tmp_path / "rewritten.mcap"
    with record.open("rb") as file, path.open("wb") as copy:
        source, writer = (
            SeekingReader(file),
            McapWriter(copy, 100_000, CompressionType[compression], use_chunking=chunked),
        )
        writer.start()
        for metadata in source.iter_metadata():
            writer.add_metadata(metadata.name, metadata.metadata)
        for a in source.iter_attachments():
            writer.add_attachment(a.create_time, a.log_time, a.name, a.media_type, a.data)
        writer.register_channel("/unrelated", "json", 0)
        for topic in ("/pilot", "/tick"):
            channel = writer.register_channel(topic, "cdr", 0)
            for _, _, m in source.iter_messages(topics=topic):
                writer.add_message(channel, m.log_time, m.data, m.publish_time)
        writer.finish()
    reader = Reader(path)
    assert all(reader[topic].tobytes() == array.tobytes() for topic, array in ARRAYS.items())
    assert reader.attachments == ATTACHMENTS


def test_names_become_ros_identifiers():
    hostile = ["Left Knee", "left_knee", "left-knee", "7", "", "__x__", "é", "a\n# b", "x" * 5]
    names = identifiers(hostile)
    assert len(set(names)) == len(hostile)
    assert all(re.fullmatch("[a-z]([a-z0-9]|_(?!_))*", n) and not n.endswith("_") for n in names), names
    assert names[:3] == ["left_knee", "left_knee_2", "left_knee_3"]
    assert "Right Hip/Joint" in layout_from_json(layout_to_json(LAYOUTS["/tick"])).elements["state.joint_pos"]


def test_a_layout_that_is_not_cdr_is_refused():
    with pytest.raises(Sim2realError, match="'a.z' is apart from the other 'a.\\*' fields"):
        ros2msg(layout("Odd", [("a.x", "f8", None), ("b", "f8", None), ("a.z", "f8", None)]))


def test_an_array_of_nobody_takes_no_field():
    nobody = layout("Nobody", [("x", "f8", None), ("none", "f8", ()), ("y", "i8", None)])
    assert ros2msg(nobody) == "float64 x\nint64 y"


@pytest.mark.parametrize(
    "document", ["", "[]", "{}", '{"name": "x", "fields": [["a", "O", null]]}', '{"name": "x", "fields": 3}']
)
def test_a_layout_from_elsewhere_is_checked(document):
    with pytest.raises(ValueError, match="not a record layout"):
        layout_from_json(document)


@pytest.mark.parametrize("time", [np.nan, -np.inf, np.inf, -1.0, 0.0])
def test_a_time_that_is_none_is_zero(time):
    assert nanoseconds(time) == 0


def test_no_record_is_overwritten(record):
    with pytest.raises(Sim2realError, match="is there already"):
        Writer(record, LAYOUTS)
    assert Reader(record).records == 2400


def test_a_wrong_size_is_refused(tmp_path):
    writer = Writer(tmp_path / "a.mcap", LAYOUTS)
    with pytest.raises(ValueError, match="got 8 bytes, expected"):
        writer.write(0, 0.0, b"8 bytes!")


# --- damage ----------------------------------------------------------------------------------------------------------


def prefix(reader: Reader, topic: str) -> bool:
    return ARRAYS[topic].tobytes().startswith(reader[topic].tobytes())


def test_cut_anywhere(record, tmp_path):
    """At any length: the reader says so in one sentence, and repair keeps a prefix that grows with the length."""
    data = record.read_bytes()
    cut, kept = tmp_path / "cut.mcap", []
    for length in np.linspace(8, len(data) - 1, 60).astype(int):
        cut.write_bytes(data[:length])
        with pytest.raises(Sim2realError, match="damaged: .*sim2real log repair"):
            Reader(cut)
        reader = Reader(cut, salvage=True)
        assert all(prefix(reader, topic) for topic in reader.topics)
        kept.append(reader.records)
    assert kept == sorted(kept)
    assert kept[0] == 0 and kept[-1] == 2400
    assert len(set(kept)) > 20  # of the last of 7 chunks, too, what is whole


def test_repair_of_a_cut_file_is_a_whole_file(record, tmp_path):
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(record.read_bytes()[: record.stat().st_size // 2])
    done = repair(cut)
    assert done.output == tmp_path / "cut-repaired.mcap"
    reader = Reader(done.output)
    assert {t: len(reader[t]) for t in reader.topics} == done.recovered
    assert 600 < done.recovered["/tick"] < 1400
    assert all(prefix(reader, topic) for topic in reader.topics)
    assert reader.attachments == ATTACHMENTS and reader.metadata["seed"] == "7"
    assert json.loads(reader.ending["damage"]) == done.damage != []
    with pytest.raises(Sim2realError, match="is there already"):
        repair(cut)


def test_flipped_bytes_lose_a_chunk_and_nothing_else(record, tmp_path):
    """Every record that the salvage returns was written; one flip costs at most one chunk."""
    data, rng = record.read_bytes(), np.random.default_rng(1)
    whole = {row.tobytes() for array in ARRAYS.values() for row in array}
    flipped = tmp_path / "flipped.mcap"
    for at in rng.integers(20_000, len(data) - 20_000, 30):
        damaged = bytearray(data)
        damaged[at] ^= 1 << int(rng.integers(8))
        flipped.write_bytes(damaged)
        reader = Reader(flipped, salvage=True)
        assert reader.records >= 2400 - 450
        assert all(row.tobytes() in whole for topic in reader.topics for row in reader[topic])


def test_a_lost_start_of_a_chunk_is_passed_over(record, tmp_path):
    """The next chunk is found again after bytes that are no record at all."""
    data = bytearray(record.read_bytes())
    first = data.find(b"\3\0\0\0lz4")
    second = data.find(b"\3\0\0\0lz4", first + 1)
    data[second - 37 : second] = bytes(37)
    path = tmp_path / "hole.mcap"
    path.write_bytes(data)
    reader = Reader(path, salvage=True)
    assert 2400 - 450 < reader.records < 2400
    assert reader["/tick"][-1].tobytes() == ARRAYS["/tick"][-1].tobytes()


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (None, "cannot read: No such file"),
        (b"", "an empty file"),
        (b"hello, I am a text\n", "not a record: got a file that starts with b'hello, I'"),
        (b"\x89MCAP0\r\n" + bytes(100), "damaged: no whole record at byte 8 of 108"),
    ],
)
def test_unreadable(tmp_path, content, message):
    path = tmp_path / "x.mcap"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(Sim2realError, match=message):
        Reader(path)
    with pytest.raises(Sim2realError):
        repair(path)


def test_somebody_elses_mcap(tmp_path):
    from mcap.writer import Writer as McapWriter

    path = tmp_path / "theirs.mcap"
    with path.open("wb") as file:
        writer = McapWriter(file)
        writer.start()
        writer.finish()
    with pytest.raises(Sim2realError, match="an MCAP file, but not a record of a run"):
        Reader(path)


def test_an_unfinished_record_is_pointed_at(tmp_path):
    Writer(tmp_path / "run.mcap", LAYOUTS).flush()
    with pytest.raises(Sim2realError, match="log repair .*run.mcap.part"):
        Reader(tmp_path / "run.mcap")


def test_a_chunk_that_claims_too_much_is_not_unpacked(record, tmp_path):
    data = bytearray(record.read_bytes())
    name = data.find(b"\3\0\0\0lz4")
    data[name - 12 : name - 4] = (2**40).to_bytes(8, "little")
    path = tmp_path / "bomb.mcap"
    path.write_bytes(data)
    reader = Reader(path, salvage=True)
    assert "a chunk of 1099511627776 bytes" in reader.damage[0]


# --- disk full -------------------------------------------------------------------------------------------------------

FULL = """
import resource, sys
from recorded import LAYOUTS, random_walk
from sim2real.recorder.mcap import Writer
from sim2real.types import Sim2realError
resource.setrlimit(resource.RLIMIT_FSIZE, (int(sys.argv[2]),) * 2)
try:
    writer = Writer(sys.argv[1], LAYOUTS, {}, {"robot.yaml": b"x"})
except Sim2realError as error:
    sys.exit(str(error))
rows = random_walk(LAYOUTS["/tick"], 8000)
kept = [writer.write(0, t, rows[i : i + 1]) for i, t in enumerate(rows["time"].tolist())]
writer.finish({"dropped": {"/tick": kept.count(False)}})
print(sum(kept), kept == sorted(kept, reverse=True), writer.stopped)
"""


def record_on_a_small_disk(path: Path, size: int) -> subprocess.CompletedProcess:
    """A process that may write files of ``size`` bytes at most: to it, a full disk (EFBIG instead of ENOSPC)."""
    root, here = Path(__file__).resolve().parents[2], Path(__file__).parent
    return subprocess.run(
        [sys.executable, "-c", FULL, str(path), str(size)],
        env={"PYTHONPATH": f"{root}:{here}"}, capture_output=True, text=True, timeout=60,
    )  # fmt: skip


def test_a_full_disk_ends_the_record_as_a_whole_file(tmp_path):
    path = tmp_path / "full.mcap"
    done = record_on_a_small_disk(path, 5_000_000)
    assert done.returncode == 0, done.stderr
    reader = Reader(path)  # whole, index and all: nothing to repair
    n = len(reader["/tick"])
    assert 100 < n < 8000
    assert done.stdout.strip() == f"{n} True {path}: recording stopped: File too large"
    assert json.loads(reader.ending["dropped"])["/tick"] == 8000 - n
    assert reader["/tick"].tobytes() == random_walk(LAYOUTS["/tick"], 8000)[:n].tobytes()
    assert path.stat().st_size <= 5_000_000


def test_no_room_at_all_is_refused_before_the_run(tmp_path):
    done = record_on_a_small_disk(tmp_path / "none.mcap", 10_000)
    assert "no room to record" in done.stderr and done.returncode == 1
    assert list(tmp_path.iterdir()) == []


def test_buses_are_elements_too():
    assert LAYOUTS["/tick"].elements["bus.load"] == BUSES
    assert resource.getrlimit(resource.RLIMIT_FSIZE)[0] != 5_000_000  # the small disk was the child's alone
