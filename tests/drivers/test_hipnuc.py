"""HiPNUC packets: the example of the maker's manual, the stream parser on split, damaged and foreign bytes."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.codecs.hipnuc import GRAVITY, LENGTH_MAX, TAG, Hi91, Parser, crc16, frame, pack

# HiPNUC "Command and Programming Manual", serial binary protocol, example of an HI91 packet: CRC 0x516C.
EXAMPLE = bytes.fromhex(
    "5A A5 4C 00 6C 51 91 00 A0 3B 01 A8 02 97 BD BB 04 00 9C A0 65 3E A2 26 45 3F 5C E7 30 3F E2 D4 5A C2 E5 9D A0 C1"
    "EB 23 EE C2 78 77 99 41 AB AA D1 C1 AB 2A 0A C2 8D E1 42 42 8F 1D A8 C1 1E 0C 36 C2 E6 E5 5A 3F C1 94 9E 3E B8 C0"
    "9E BE BE DF 8D BE"
)


def equal(a: Hi91, b: Hi91) -> bool:
    return all(np.array_equal(x, y) for x, y in zip(a, b, strict=True))


def test_the_example_of_the_manual():
    assert crc16(EXAMPLE[6:], crc16(EXAMPLE[:4])) == 0x516C
    (packet,) = Parser().feed(EXAMPLE)
    assert packet.timestamp == pytest.approx(310.205)
    assert packet.temperature == 59
    np.testing.assert_allclose(np.divide(packet.acceleration, GRAVITY), [0.224, 0.770, 0.691], atol=5e-4)
    np.testing.assert_allclose(np.rad2deg(packet.angular_velocity), [-54.708, -20.077, -119.070], atol=5e-4)
    np.testing.assert_allclose(packet.orientation, [0.855, 0.310, -0.310, -0.277], atol=5e-4)
    assert np.linalg.norm(packet.orientation) == pytest.approx(1.0, abs=1e-6)


def test_at_rest_the_acceleration_points_up():
    """The example was taken while it moved; up by its quaternion and its acceleration agree within that motion."""
    (packet,) = Parser().feed(EXAMPLE)
    w, x, y, z = packet.orientation
    up = np.array([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)])
    cosine = up @ packet.acceleration / np.linalg.norm(packet.acceleration)
    assert cosine > math.cos(math.radians(15))


def test_packs_what_it_unpacks():
    (packet,) = Parser().feed(EXAMPLE)
    again = pack(packet)
    assert len(again) == len(EXAMPLE) == 82
    assert again[6:14] == EXAMPLE[6:10] + bytes(4)  # tag, status, temperature; pressure is not ours to know
    assert again[14:18] == EXAMPLE[14:18]
    (unpacked,) = Parser().feed(again)
    for got, expected in zip(unpacked, packet, strict=True):
        np.testing.assert_allclose(got, expected, rtol=1e-6)
    # roll, pitch and yaw of the example follow from its quaternion (deg)
    got, expected = (np.frombuffer(data[54:66], "<f4") for data in (again, EXAMPLE))
    np.testing.assert_allclose(got, expected, atol=0.01)


@given(st.lists(st.integers(0, 3 * len(EXAMPLE)), max_size=6), st.binary(max_size=40))
def test_any_split_finds_every_packet_whatever_is_between(cuts, garbage):
    garbage = garbage.replace(b"\x5a", b"")
    stream = EXAMPLE + garbage + EXAMPLE + EXAMPLE
    parser, found = Parser(), []
    at = [0, *sorted(c for c in cuts if c < len(stream)), len(stream)]
    for start, end in zip(at, at[1:], strict=False):
        found += parser.feed(stream[start:end])
    assert len(found) == 3
    assert parser.rejected == 0


@given(st.integers(0, 8 * len(EXAMPLE) - 1))
def test_no_flipped_bit_goes_unnoticed_and_the_next_packets_are_found(bit):
    damaged = bytearray(EXAMPLE)
    damaged[bit // 8] ^= 1 << bit % 8
    parser = Parser()
    clean = Parser().feed(EXAMPLE)[0]
    found = parser.feed(bytes(damaged) + EXAMPLE * 8)  # a wrong length swallows a few until its CRC is wrong
    assert all(equal(p, clean) for p in found)
    assert len(found) >= 8 if bit >= 32 else len(found) >= 2
    if bit >= 16:
        assert parser.rejected >= 1


@given(st.binary(max_size=300))
def test_garbage_is_survived_and_memory_is_bounded(data):
    parser = Parser()
    for _ in range(5):
        parser.feed(data)
    assert len(parser._bytes) <= LENGTH_MAX + 6
    assert len(parser.feed(bytes(LENGTH_MAX + 6) + EXAMPLE)) >= 1


def test_a_false_header_in_front_of_a_real_one():
    parser = Parser()
    assert len(parser.feed(b"\x5a\xa5\x02\x00" + EXAMPLE)) == 1
    assert parser.rejected == 1


def test_packets_of_other_tags_are_skipped_and_short_ones_too():
    parser = Parser()
    assert parser.feed(frame(b"\x81" + bytes(90)) + frame(bytes([TAG]) + bytes(10))) == []
    assert parser.rejected == 0
