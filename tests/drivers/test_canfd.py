"""The time of a CAN-FD frame against one counted bit by bit, by the sums of the standard, and on the simulated wire."""

from __future__ import annotations

import numpy as np
import pytest
from can_bench import Bench
from hypothesis import given
from hypothesis import strategies as st

from drivers.canfd import fd_bits, phases
from drivers.wire import BIT_RATE_SWITCH, EXTENDED, FD_LENGTHS, make_fd_frames


def counted(id: int, data: bytes, switch: bool) -> list[int]:
    """Bits in the arbitration and in the data phase, one after the other."""
    if id & EXTENDED:
        bits = f"{id & 0x1FFF_FFFF:029b}"
        head = "0" + bits[:11] + "11" + bits[11:] + "010" + f"{switch:b}"
    else:
        head = "0" + f"{id:011b}" + "0010" + f"{switch:b}"
    body = "0" + f"{FD_LENGTHS.tolist().index(len(data)):04b}" + "".join(f"{byte:08b}" for byte in data)
    count, last, run = [len(head), len(body)], "", 0
    for at, bit in enumerate(head + body):
        run = run + 1 if bit == last else 1
        last = bit
        if run == 5 and at + 1 < len(head + body):
            count[at >= len(head)] += 1
            last, run = "01"[bit == "0"], 1
    checked = 4 + (17 if len(data) <= 16 else 21)  # stuff count and CRC
    return [count[0] + 12, count[1] + checked + 1 + checked // 4 + 1]


payloads = st.sampled_from(FD_LENGTHS.tolist()).flatmap(
    lambda n: st.lists(st.sampled_from([0, 255, 0x1F, 0xF8, 0x84, 7]) | st.integers(0, 255), min_size=n, max_size=n)
)
ids = st.integers(0, 0x7FF) | st.integers(0, 0x1FFF_FFFF).map(lambda id: id | EXTENDED)


@given(st.lists(st.tuples(ids, payloads, st.booleans()), max_size=6))
def test_frames_bit_by_bit(made):
    frames = make_fd_frames(np.zeros(len(made), np.uint32), np.zeros((len(made), 64), np.uint8), 0)
    for row, (id, data, switch) in zip(frames, made, strict=True):
        row["id"], row["length"], row["flags"] = id, len(data), BIT_RATE_SWITCH * switch
        row["data"][: len(data)] = data
    slow, fast = phases(frames)
    assert [list(pair) for pair in zip(slow, fast, strict=True)] == [counted(i, bytes(d), s) for i, d, s in made]


def one(id: int, data: bytes, **flags) -> np.ndarray:
    frame = make_fd_frames(np.array([id], np.uint32), np.frombuffer(data, np.uint8)[None], len(data))
    for name, value in flags.items():
        frame[name] = value
    return frame


@pytest.mark.parametrize(
    ("id", "data", "slow", "fast"),
    [
        # Alternating bits need no stuffing but in the id: 17 + 12, and 5 + 64 + 4 + 17 + 6 + 1
        (0x555, b"\x55" * 8, 29, 97),
        (0x555, b"\x55" * 64, 29, 5 + 512 + 4 + 21 + 7 + 1),  # a CRC of 21 from 20 bytes on
        (0x15555555 | EXTENDED, b"\x55" * 8, 36 + 12, 97),
    ],
)
def test_sums_of_the_standard(id, data, slow, fast):
    (got_slow,), (got_fast,) = phases(one(id, data))
    assert (got_slow, got_fast) == (slow, fast)


def test_without_the_switch_everything_is_slow():
    (fast,), (slow,) = fd_bits(one(1, b"\x55" * 8), 5.0), fd_bits(one(1, b"\x55" * 8, flags=0), 5.0)
    assert slow > 2 * fast


def test_the_simulated_wire_takes_that_time(tmp_path):
    bench = Bench(tmp_path, "moteus", connect=False, latency=0.0)
    before, frames = bench.world.counters()["arm"]["busy"], one(1, b"\x50" * 64)
    bench.world.wires["arm"].send(frames)  # to motor 1, no answer wanted
    bench.world.advance(0.002)
    assert bench.world.counters()["arm"]["busy"] - before == pytest.approx(fd_bits(frames, 5.0)[0] * 1e-6)
