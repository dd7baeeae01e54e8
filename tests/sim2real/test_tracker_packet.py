"""Sightings as datagrams: the bytes, what is refused, and a real socket on the loopback."""

from __future__ import annotations

import socket

import numpy as np
import pytest

from sim2real.object.packet import PacketError, UdpSightings, decode, encode, listen

# Written out by hand from the table in the module: sequence 7, stamp 1.5 s, object at (0.5, -0.25, 1), seen from the base.
GOLDEN = bytes.fromhex(
    "53 32 52 4f 01 00 00 00 07 00 00 00 00 2f 68 59 00 00 00 0000 00 00 3f 00 00 80 be 00 00 80 3f" + "00" * 28
)


def test_golden_bytes():
    assert encode(7, 1.5, np.array([0.5, -0.25, 1.0])) == GOLDEN
    sequence, sample = decode(GOLDEN)
    assert (sequence, sample.time) == (7, 1.5)
    assert sample.position_object_in_base.tolist() == [0.5, -0.25, 1.0]
    assert np.isnan(sample.height_base_in_world)


def test_motion_capture_is_turned_into_the_base():
    quarter = np.array([np.sqrt(0.5), 0, 0, np.sqrt(0.5)])  # the base looks along the world's y
    data = encode(1, 2.0, np.array([1.0, 3.0, 1.0]), np.array([1.0, 2.0, 0.75]), quarter)
    _, sample = decode(data)
    np.testing.assert_allclose(sample.position_object_in_base, [1.0, 0.0, 0.25], atol=1e-6)
    assert sample.height_base_in_world == 0.75


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (GOLDEN[:-1], "got 59 bytes, expected 60"),
        (b"XXXX" + GOLDEN[4:], "got b'XXXX' version 1"),
        (GOLDEN[:4] + b"\x02" + GOLDEN[5:], "version 2, expected b'S2RO' version 1"),
        (GOLDEN[:6] + b"\x09" + GOLDEN[7:], "got frame 9"),
        (GOLDEN[:20] + b"\x00\x00\xc0\x7f" + GOLDEN[24:], "not finite"),
        (GOLDEN[:6] + b"\x01" + GOLDEN[7:], "orientation of norm 0.000"),
    ],
)
def test_what_is_refused(data, words):
    with pytest.raises(PacketError, match=words):
        decode(data)


@pytest.fixture
def wire():
    sightings = UdpSightings(listen(("127.0.0.1", 0)))
    sender = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    sender.connect(sightings.address)
    yield sightings, sender
    sender.close()
    sightings.close()


def test_over_a_socket_late_repeated_missing_and_broken_datagrams(wire):
    sightings, sender = wire
    for sequence in (1, 2, 2, 5, 4, 6):
        sender.send(encode(sequence, float(sequence), np.zeros(3)))
    sender.send(b"nonsense")
    assert [s.time for s in sightings.read()] == [1.0, 2.0, 5.0, 6.0]
    r = sightings.received
    assert (r.good, r.bad, r.disordered, r.missing) == (4, 1, 2, 2)
    assert sightings.read() == []


def test_the_sequence_wraps(wire):
    sightings, sender = wire
    for sequence in (2**32 - 1, 0, 1):
        sender.send(encode(sequence, 1.0 + sequence, np.zeros(3)))
    assert len(sightings.read()) == 3


def test_a_flood_does_not_hold_up_a_tick(wire):
    sightings, sender = wire
    for sequence in range(100):
        sender.send(encode(sequence, 1.0, np.zeros(3)))
    assert len(sightings.read()) == UdpSightings.most


def test_a_taken_port_is_named(wire):
    with pytest.raises(PacketError, match="udp 127.0.0.1:.*expected a free port"):
        listen(wire[0].address)
