"""The same bytes over a real DDS domain, on loopback: two wires, the vendor's types as oracle, and the whole bus.

Needs the extra [dds]; skipped without it.
"""

from __future__ import annotations

import itertools
import struct
import threading
import time

import numpy as np
import pytest

from drivers.bus import BusError, BusSpec, ImuSpec, MotorCommand, MotorSpec
from drivers.codecs import unitree_api as api
from drivers.codecs import unitree_hg as hg
from drivers.open import open_bus, open_imu, open_wire
from drivers.sim.dds_robot import SimG1
from drivers.wire import WireError

dds = pytest.importorskip("drivers.dds_wire", reason="Cyclone DDS is not installed: pip install 'sim2real[dds]'")

DOMAIN = itertools.count(40)
SPEC = BusSpec("body", "unitree_hg", (MotorSpec("left_hip_pitch_joint", "M7520-14", 0),), "dds", "lo:39")
PATIENCE = 5.0  # s, for two participants to find each other


def until(true, patience: float = PATIENCE) -> None:
    end = time.monotonic() + patience
    while not true():
        assert time.monotonic() < end, "waited in vain"
        time.sleep(0.005)


@pytest.fixture
def pair():
    """A robot's wire and a host's, in a domain of their own."""
    domain = next(DOMAIN)
    robot = dds.CycloneWire("lo", domain, (hg.COMMAND_TOPIC, api.MOTION_REQUEST), (hg.STATE_TOPIC, api.MOTION_RESPONSE))
    host = dds.CycloneWire("lo", domain, (hg.STATE_TOPIC, api.MOTION_RESPONSE), (hg.COMMAND_TOPIC, api.MOTION_REQUEST))
    yield robot, host
    robot.close()
    host.close()


def low_cmd():
    motors = [dds.MotorCmd(1, 0.1 * i, 0.2, 0.3, 4.0, 5.0, 6) for i in range(hg.SLOTS)]
    return dds.LowCmd(0, 5, motors, [1, 2, 3, 4], 0)


def low_state():
    imu = dds.ImuState([1.0, 0.0, 0.0, 0.0], [0.1, 0.2, 0.3], [0.0, 0.0, 9.75], [0.5, 0.25, 0.125], -7)
    motors = [
        dds.MotorState(1, 0.5 * i, 1.5, 2.5, 3.5, [-40, 41], 48.0, [8, 9], 0x200, [1, 2, 3, 4]) for i in range(hg.SLOTS)
    ]
    return dds.LowState([1, 2], 0, 5, 123456, imu, motors, list(range(40)), [5, 6, 7, 8], 0)


def sealed(payload: bytes, size: int) -> bytes:
    """With the CRC that its reader will check."""
    words = np.zeros(size // 4, "<u4")
    words[:] = np.frombuffer(_struct(payload, size), "<u4")
    return payload[:-4] + struct.pack("<I", hg.crc32(words[:-1]))


def _struct(payload: bytes, size: int) -> bytes:
    head = 2 if size == hg.COMMAND.itemsize else 70
    first = (head + 2 + 3) // 4 * 4  # where motor 0 begins in the struct
    return (
        payload[4 : 4 + head] + b"\0" * (first - head) + payload[4 + head : 5 + head] + b"\0" * 3 + payload[4 + first :]
    )


def test_a_command_as_cyclone_serialises_it():
    payload = sealed(dds.LowCmd.__idl__.serialize(low_cmd()), hg.COMMAND.itemsize)
    frame = hg.read_command(payload)
    assert frame is not None and hg.command_payload(frame.view("<u4").copy()) == payload
    motor = frame["motors"][0][3]
    assert [motor[n].item() for n in ("mode", "q", "dq", "tau", "kp", "kd", "reserve")] == pytest.approx(
        [1, 0.3, 0.2, 0.3, 4, 5, 6]
    )
    assert frame["mode_machine"][0] == 5 and frame["reserve"][0].tolist() == [1, 2, 3, 4]


def test_a_state_as_cyclone_serialises_it():
    payload = sealed(dds.LowState.__idl__.serialize(low_state()), hg.STATE.itemsize)
    frame = hg.read_state(payload)
    assert frame is not None and hg.state_payload(frame.view("<u4").copy()) == payload
    s = frame[0]
    assert s["tick"] == 123456 and s["imu_temperature"] == -7 and s["remote"].tolist() == list(range(40))
    assert s["acceleration"].tolist() == [0, 0, 9.75] and s["rpy"].tolist() == [0.5, 0.25, 0.125]
    motor = s["motors"][34]
    assert motor["q"] == 17.0 and motor["tau"] == 3.5 and motor["temperature"].tolist() == [-40, 41]
    assert motor["error"] == 0x200 and motor["voltage"] == 48.0 and motor["reserve"].tolist() == [1, 2, 3, 4]


def test_requests_and_answers_as_cyclone_serialises_them():
    identity = dds.RequestIdentity(5, 1001)
    request = dds.Request(dds.RequestHeader(identity, dds.RequestLease(0), dds.RequestPolicy(0, False)), '{"a":1}', [])
    answer = dds.Response(dds.ResponseHeader(identity, dds.ResponseStatus(-3)), '{"name":"ai"}', [])
    assert dds.Request.__idl__.serialize(request) == api.pack_request(api.Request(5, 1001, '{"a":1}'))
    assert dds.Response.__idl__.serialize(answer) == api.pack_response(api.Response(5, 1001, -3, '{"name":"ai"}'))


def test_bytes_go_through_unchanged_and_in_order(pair):
    robot, host = pair
    payloads = [dds.LowCmd.__idl__.serialize(dds.LowCmd(0, i, low_cmd().motor_cmd, [0] * 4, i)) for i in range(10)]
    until(lambda: robot.writers(hg.COMMAND_TOPIC) == 1)
    time.sleep(0.2)  # seen is not yet matched
    for payload in payloads:
        host.write(hg.COMMAND_TOPIC, payload)
    got: list[bytes] = []
    until(lambda: got.extend(robot.read(hg.COMMAND_TOPIC)) or len(got) == len(payloads))
    assert got == payloads and robot.read(hg.COMMAND_TOPIC) == []


def test_other_publishers_are_seen_until_they_go(pair):
    robot, host = pair
    assert host.writers(hg.COMMAND_TOPIC) == 0  # its own does not count
    domain = int(host._where.split()[2])
    other = dds.CycloneWire("lo", domain, writes=(hg.COMMAND_TOPIC,))
    until(lambda: host.writers(hg.COMMAND_TOPIC) == 1)
    other.close()
    until(lambda: host.writers(hg.COMMAND_TOPIC) == 0)


@pytest.mark.parametrize(
    ("spec", "message"),
    [
        (BusSpec("body", "unitree_hg", SPEC.motors, "dds", "nope0", watchdog=0.0), "body: DDS domain 0 on nope0: .*ip link"),
        (BusSpec("body", "unitree_hg", SPEC.motors, "dds", "eth0"), "motors of a G1 have none .*'watchdog: 0'"),
        (BusSpec("body", "unitree_hg", SPEC.motors, "dds", "lo:x"), "got channel 'lo:x'"),
        (BusSpec("body", "unitree_hg", SPEC.motors, "socketcan", "can0"), "interface 'socketcan', expected one of dds, sim"),
    ],
)  # fmt: skip
def test_what_cannot_be_opened_says_why(spec, message):
    with pytest.raises(BusError, match=f"(?s){message}"):
        open_wire(spec)


def test_an_unknown_topic_is_refused(pair):
    with pytest.raises(WireError, match="topic 'rt/x'.*expected one of rt/lowcmd"):
        pair[0].read("rt/x")


class Body:
    """Joints that stay where they are."""

    joint_pos = joint_vel = joint_torque = np.array([0.25])

    def limit(self, torque: np.ndarray) -> None: ...

    def drive(self, bias: np.ndarray, kp: np.ndarray, kd: np.ndarray) -> None: ...


class RealClock:
    now = staticmethod(time.monotonic)

    def sleep_until(self, deadline: float, /) -> None:
        time.sleep(max(0.0, deadline - time.monotonic()))


@pytest.fixture
def robot():
    """An emulated G1 of one motor on loopback, 200 times a second."""
    wire = dds.CycloneWire("lo", 39, (hg.COMMAND_TOPIC, api.MOTION_REQUEST), (hg.STATE_TOPIC, api.MOTION_RESPONSE))
    g1, stop = SimG1(SPEC, Body()), threading.Event()
    imu = (np.array([1.0, 0, 0, 0]), np.zeros(3), np.array([0, 0, 9.81]))

    def live() -> None:
        while not stop.wait(0.005):
            for topic in (hg.COMMAND_TOPIC, api.MOTION_REQUEST):
                for payload in wire.read(topic):
                    for answer in g1.receive(topic, payload, time.monotonic()):
                        wire.write(*answer)
            wire.write(hg.STATE_TOPIC, g1.state(imu, time.monotonic()))

    thread = threading.Thread(target=live)
    thread.start()
    yield g1
    stop.set()
    thread.join()
    wire.close()


def test_the_whole_bus_over_loopback(robot):
    bus = open_bus(SPEC)
    imu = open_imu(ImuSpec("unitree_hg", "dds", "lo:39"))
    bus.connect(RealClock())
    assert robot.controller == ""
    bus.write(MotorCommand(*np.array([[0.5], [0.0], [20.0], [1.0], [0.0]])))
    until(lambda: robot.enabled.all() and bus.read(time.monotonic()).enabled.all())
    assert robot.log[-1].event == "driving"
    assert bus.read(time.monotonic()).position == pytest.approx([0.25])
    until(lambda: imu.read(time.monotonic()).time > 0)
    bus.disable()
    until(lambda: not robot.enabled.any())
    bus.close()
    imu.close()
