"""CAN wires: python-can's ``virtual`` bus as the other side, raw datagrams, full queues, buses that go away."""

from __future__ import annotations

import errno
import socket
import uuid

import can
import numpy as np
import pytest
from scripted_can import leg

from drivers.can_wire import PythonCanWire, RawCanWire, interfaces
from drivers.codecs import damiao
from drivers.codecs.damiao import DamiaoCodec, DamiaoMotors
from drivers.wire import ERROR, EXTENDED, FRAME, REMOTE, WireError, WireFull, make_fd_frames, make_frames


def frames(n: int = 4) -> np.ndarray:
    rng = np.random.default_rng(0)
    made = make_frames(np.arange(1, n + 1), rng.integers(0, 256, (n, 8), np.uint8))
    made["id"][-1] |= np.uint32(EXTENDED)
    made["length"][0] = 3
    made["data"][0, 3:] = 0
    return made


@pytest.fixture
def channel() -> str:
    return uuid.uuid4().hex


@pytest.fixture
def pair(channel):
    """A wire and a python-can bus on the same virtual channel."""
    wire = PythonCanWire("virtual", channel, 1_000_000)
    peer = can.Bus(interface="virtual", channel=channel)
    yield wire, peer
    peer.shutdown()
    wire.close()


def test_python_can_sees_what_was_sent(pair):
    wire, peer = pair
    sent = frames()
    wire.send(sent)
    received = [peer.recv(timeout=0) for _ in sent]
    assert [(m.arbitration_id, m.is_extended_id, bytes(m.data)) for m in received] == [
        (int(f["id"]) & ~EXTENDED, bool(f["id"] & EXTENDED), f["data"][: f["length"]].tobytes()) for f in sent
    ]


def test_two_wires_carry_frames_unchanged_and_in_order(pair, channel):
    wire, _ = pair
    other = PythonCanWire("virtual", channel, 1_000_000)
    sent = frames(40)
    sent["id"][1] |= np.uint32(REMOTE)
    sent["data"][1] = 0
    other.send(sent[:20])
    other.send(sent[20:])
    assert wire.recv().tobytes() == sent.tobytes()
    assert wire.recv().shape == (0,) and wire.recv().dtype == FRAME
    other.close()


def test_error_frames_are_marked_and_fd_frames_dropped(pair):
    wire, peer = pair
    peer.send(can.Message(arbitration_id=0x40, is_error_frame=True, dlc=8, data=bytes(8), is_extended_id=False))
    peer.send(can.Message(arbitration_id=1, is_fd=True, data=bytes(12), is_extended_id=False))
    (frame,) = wire.recv()
    assert frame["id"] == ERROR | 0x40


def test_damiao_motors_through_python_can(pair, channel):
    """The whole path of one tick: host codec, wire, python-can, motor codec, and back."""
    wire, _ = pair
    far = PythonCanWire("virtual", channel, 1_000_000)
    host, motors = DamiaoCodec(leg()), DamiaoMotors(leg())
    wire.send(host.pack_register(1, "PMAX"))
    (request,) = far.recv()
    assert damiao.unpack_register(request["data"]) == (2, damiao.Operation.READ, "PMAX", 0)
    far.send(motors.pack_register(1, damiao.Operation.READ, "PMAX", 12.5))
    assert host.unpack_registers(wire.recv()) == [(1, "PMAX", 12.5, False)]
    far.close()


def test_a_full_queue_is_told_from_other_errors(pair, monkeypatch):
    """python-can's two ways to say it: with the errno of the kernel, and with a text alone (socketcan, 4.6)."""
    wire, _ = pair

    def failing(error):
        def send(message, timeout=None):
            if message.arbitration_id == 2:
                raise error

        monkeypatch.setattr(wire._bus, "send", send)

    for full in (can.CanOperationError("Failed", errno.ENOBUFS), can.CanOperationError("Transmit buffer full")):
        failing(full)
        with pytest.raises(WireFull, match="sent 1 of 4 frames"):
            wire.send(frames())
    failing(can.CanOperationError("Failed", errno.ENETDOWN))
    with pytest.raises(WireError, match="sent 1 of 4 frames") as error:
        wire.send(frames())
    assert not isinstance(error.value, WireFull)


def test_a_closed_bus_is_a_wire_error(channel):
    wire = PythonCanWire("virtual", channel, 1_000_000)
    wire.close()
    with pytest.raises(WireError, match="closed bus"):
        wire.send(frames())
    with pytest.raises(WireError, match="receiving: .*closed bus"):
        wire.recv()


def test_an_adapter_that_is_not_there():
    with pytest.raises(WireError, match=r"slcan /dev/nothing: (.|\n)*plugged in"):
        PythonCanWire("slcan", "/dev/nothing", 1_000_000)


def test_virtual_has_nothing_to_select_on(pair):
    assert pair[0].fileno() == -1


def test_interfaces_are_those_of_python_can():
    assert {"socketcan", "virtual", "pcan"} <= set(interfaces())


@pytest.fixture
def raw():
    """A raw wire and the far end of its socket; a datagram socket of the unix family carries the same 16 bytes."""
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)
    wire = RawCanWire(ours)
    theirs.setblocking(False)
    yield wire, theirs
    wire.close()
    theirs.close()


def test_raw_frames_are_struct_can_frame(raw):
    wire, peer = raw
    wire.send(make_frames(np.array([0x123 | EXTENDED], np.uint32), np.arange(8, dtype=np.uint8)[None]))
    # linux/can.h: can_id (little-endian here, with CAN_EFF_FLAG), length, three bytes of padding, data
    assert peer.recv(100).hex(" ") == "23 01 00 80 08 00 00 00 00 01 02 03 04 05 06 07"


def test_raw_frames_both_ways(raw):
    wire, peer = raw
    assert wire.recv().shape == (0,)
    for frame in frames():
        peer.send(frame.tobytes())
    assert wire.recv().tobytes() == frames().tobytes()
    wire.send(frames())
    assert b"".join(peer.recv(16) for _ in range(4)) == frames().tobytes()
    assert wire.fileno() >= 0


def test_a_raw_queue_that_is_full(raw):
    wire, _ = raw
    with pytest.raises(WireFull, match=r"sent \d+ of 4 frames"):
        for _ in range(10_000):
            wire.send(frames())


def test_a_raw_wire_whose_other_end_is_gone(raw):
    wire, peer = raw
    peer.close()
    with pytest.raises(WireError, match="sent 0 of 4 frames: .*is the interface up"):
        wire.send(frames())


def test_an_interface_that_is_not_there():
    with pytest.raises(WireError, match="socketcan nocan99: "):
        RawCanWire.open("nocan99")


def test_socketcan_loopback():
    """On a machine with ``vcan0`` (sudo ip link add vcan0 type vcan && sudo ip link set vcan0 up)."""
    try:
        a, b = RawCanWire.open("vcan0"), RawCanWire.open("vcan0")
    except WireError as error:
        pytest.skip(str(error).splitlines()[0])
    a.send(frames())
    assert b.recv().tobytes() == frames().tobytes()
    a.close()
    b.close()


def fd_frames(n: int = 4) -> np.ndarray:
    rng = np.random.default_rng(0)
    made = make_fd_frames(np.arange(1, n + 1), rng.integers(0, 256, (n, 64), np.uint8), 64)
    made["id"][-1] |= np.uint32(EXTENDED)
    made["length"][0], made["data"][0, 12:] = 12, 0
    made["flags"][1] = 0  # without bit-rate switch
    return made


def test_fd_frames_through_python_can(channel):
    wire = PythonCanWire("virtual", channel, 1_000_000, 5_000_000)
    peer = can.Bus(interface="virtual", channel=channel)
    wire.send(fd_frames())
    received = [peer.recv(timeout=0) for _ in range(4)]
    assert all(m.is_fd for m in received) and [m.bitrate_switch for m in received] == [True, False, True, True]
    assert [bytes(m.data) for m in received] == [f["data"][: f["length"]].tobytes() for f in fd_frames()]
    for m in received:
        peer.send(m)
    assert wire.recv().tobytes() == fd_frames().tobytes()
    peer.send(can.Message(arbitration_id=5, data=b"abc", is_extended_id=False))
    (classic,) = wire.recv()
    assert classic["length"] == 3 and not classic["flags"] and classic["data"][:4].tobytes() == b"abc\0"
    wire.close()
    peer.shutdown()


def test_raw_fd_frames_are_struct_canfd_frame():
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)
    wire = RawCanWire(ours, fd=True)
    wire.send(make_fd_frames(np.array([0x8001 | EXTENDED], np.uint32), np.arange(12, dtype=np.uint8)[None], 12))
    # linux/can.h: can_id, length, flags (CANFD_BRS), two bytes reserved, 64 bytes of data
    assert theirs.recv(100).hex(" ") == "01 80 00 80 0c 01 00 00 " + bytes(range(12)).ljust(64, b"\0").hex(" ")
    theirs.send(fd_frames()[0].tobytes())
    theirs.send(frames()[1].tobytes())  # a classic frame, as an error frame is
    first, second = wire.recv()
    assert first == fd_frames()[0]
    assert second["id"] == 2 and second["length"] == 8 and second["data"][:8].tobytes() == frames()["data"][1].tobytes()
    wire.close()
    theirs.close()


def test_socketcan_fd_loopback():
    """On a machine with ``vcan0`` of mtu 72."""
    try:
        a, b = RawCanWire.open("vcan0", data_bitrate=5_000_000), RawCanWire.open("vcan0", data_bitrate=5_000_000)
    except WireError as error:
        pytest.skip(str(error).splitlines()[0])
    a.send(fd_frames())
    received = b.recv()
    assert received["data"].tobytes() == fd_frames()["data"].tobytes()
    a.close()
    b.close()
