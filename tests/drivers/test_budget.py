"""Bus budget: exact frame lengths against an independent bit-by-bit coder, loads against the table of limits."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.budget import budget, check, frame_bits
from drivers.bus import BusError, BusSpec, MotorSpec
from drivers.codecs.mit import MitCodec, Ranges
from drivers.wire import EXTENDED, REMOTE, make_frames
from sim2real.config import load_robot


def slow_bits(id: int, data: bytes, extended: bool = False, remote: bool = False) -> int:
    """Length of a frame on the wire, written down from the Bosch specification without regard to speed."""
    if extended:
        fields = [(0, 1), (id >> 18, 11), (1, 1), (1, 1), (id & 0x3FFFF, 18), (remote, 1), (0, 2)]
    else:
        fields = [(0, 1), (id, 11), (remote, 1), (0, 1), (0, 1)]
    fields += [(len(data), 4)] + ([] if remote else [(byte, 8) for byte in data])
    bits = [value >> n & 1 for value, width in fields for n in reversed(range(width))]
    # Polynomial division of the bits with 15 zeros behind, x^15 + x^14 + x^10 + x^8 + x^7 + x^4 + x^3 + 1.
    divisor = [1 if power in (15, 14, 10, 8, 7, 4, 3, 0) else 0 for power in range(15, -1, -1)]
    rest = [*bits, *[0] * 15]
    for at in range(len(bits)):
        if rest[at]:
            rest[at : at + 16] = [a ^ b for a, b in zip(rest[at : at + 16], divisor, strict=True)]
    sent: list[int] = []
    for bit in bits + rest[-15:]:
        sent.append(bit)
        if len(sent) >= 5 and len(set(sent[-5:])) == 1:
            sent.append(1 - bit)
    return len(sent) + 1 + 2 + 7 + 3


def test_known_lengths():
    zeros = make_frames(np.array([0]), np.zeros((1, 8), np.uint8))
    assert frame_bits(zeros) == [127]  # 111 and a stuff bit after every fourth or fifth of the zeros
    alternating = make_frames(np.array([0x2AA]), np.full((1, 8), 0xAA, np.uint8))
    assert frame_bits(alternating)[0] == slow_bits(0x2AA, b"\xaa" * 8)


runs = st.sampled_from([0x00, 0xFF, 0x0F, 0xF0, 0x1F, 0xE0, 0x83, 0x3E, 0x7C, 0xC1])
payloads = st.lists(runs | st.integers(0, 255), min_size=8, max_size=8)


@given(st.lists(st.tuples(st.integers(0, 0x7FF), payloads), min_size=1, max_size=20))
def test_standard_frames_with_eight_bytes(frames):
    made = make_frames(np.array([id for id, _ in frames]), np.array([data for _, data in frames], np.uint8))
    assert frame_bits(made).tolist() == [slow_bits(id, bytes(data)) for id, data in frames]


@given(
    st.lists(
        st.tuples(st.integers(0, 0x1FFF_FFFF) | st.sampled_from([0, 0x1FFF_FFFF]), payloads), min_size=1, max_size=20
    )
)
def test_extended_frames_with_eight_bytes(frames):
    made = make_frames(np.array([id | EXTENDED for id, _ in frames]), np.array([data for _, data in frames], np.uint8))
    assert frame_bits(made).tolist() == [slow_bits(id, bytes(data), True) for id, data in frames]


@given(st.integers(0, 0x1FFF_FFFF), st.binary(max_size=8), st.booleans(), st.booleans())
def test_every_other_kind_of_frame(id, data, extended, remote):
    id = id if extended else id & 0x7FF
    made = make_frames(np.array([id], np.uint32), np.zeros((1, 8), np.uint8), len(data))
    made["data"][0, : len(data)] = list(data)
    made["id"] |= np.uint32(extended * EXTENDED | remote * REMOTE)
    assert frame_bits(made).tolist() == [slow_bits(id, data, extended, remote)]


def test_a_mixture_of_kinds():
    made = make_frames(np.array([1, 2, 3 | EXTENDED], np.uint32), np.zeros((3, 8), np.uint8))
    made["length"][1] = 4
    assert frame_bits(made).tolist() == [slow_bits(1, bytes(8)), slow_bits(2, bytes(4)), slow_bits(3, bytes(8), True)]
    assert frame_bits(made[:0]).tolist() == []


def bus(n: int, bitrate: int = 1_000_000) -> BusSpec:
    motors = tuple(MotorSpec(f"joint_{i}", "DM8009", i, i + 0x40) for i in range(1, n + 1))
    return BusSpec("leg", "damiao", motors, bitrate=bitrate)


@pytest.mark.parametrize(("n", "typical", "worst"), [(3, 1433, 1235), (6, 717, 617), (10, 430, 370), (29, 148, 128)])
def test_highest_rates(n, typical, worst):
    """Rates at full load, computed with another bit-exact coder (classic CAN, 1 Mbit/s, command and answer)."""
    b = budget(bus(n), 100.0)
    assert 100 / b.load == pytest.approx(typical, abs=1)
    assert 100 / b.load_worst == pytest.approx(worst, abs=1)
    assert b.rate_max == pytest.approx(0.7 * typical, abs=1)
    assert b.frames == 2 * n


def test_the_typical_length_is_that_of_random_traffic():
    n, rng = 4000, np.random.default_rng(3)
    full = lambda x: np.full(n, x)  # noqa: E731
    codec = MitCodec(Ranges(full(12.5), full(45.0), full(54.0), full(500.0), full(5.0)))
    motion = rng.uniform(-1, 1, (3, n)) * [[3.0], [5.0], [20.0]]
    zero, ids = np.zeros(n), rng.integers(1, 9, n)
    command = codec.pack_command(motion[0], zero, rng.uniform(20, 200, n), rng.uniform(1, 5, n), zero)
    feedback = codec.pack_feedback(*motion, 0x10 | ids, full(35), full(40))
    bits = frame_bits(make_frames(ids, command)).mean() + frame_bits(make_frames(ids + 0x10, feedback)).mean()
    assert bits == pytest.approx(budget(bus(1), 1.0).bits, rel=0.03)


def test_every_bus_of_every_robot_fits(robot):
    for wiring in robot.wirings.values():
        for spec in wiring.bus_specs():
            assert check(spec, wiring.rate).load < 0.7


def test_a_rate_that_does_not_fit_is_refused():
    spec = load_robot("g1").wiring("can").bus_specs()[3]
    assert check(spec, 500.0).load_worst < 1.0
    with pytest.raises(BusError, match=r"left_arm: 7 motors at 600 Hz need 113% of 1000000 .*\n.*at most 430 Hz"):
        check(spec, 600.0)
