"""The simulated wire: exact times, arbitration, its physical limit, every fault, and determinism."""

from __future__ import annotations

from hashlib import sha256
from pathlib import Path

import numpy as np
import pytest
from sim_robots import BUS, ENABLE, IMU, MOTORS, REFRESH, Host, answers, make_world, mit, write_model

from drivers.budget import frame_bits
from drivers.bus import BusError, BusSpec
from drivers.codecs import hipnuc
from drivers.sim.faults import KINDS, Fault, parse_fault
from drivers.sim.world import World
from drivers.wire import CONTROLLER, ERROR, WireError, WireFull, make_frames

LATENCY, REPLY_DELAY, BIT = 250e-6, 50e-6, 1e-6  # the defaults of World
REGISTER = 0x7FF
COMMAND = mit(0.1, 0.2, 10, 1, 0.5)
OTHER = bytes([2]) + REFRESH[1:]


def bits(id: int, data: bytes) -> int:
    return int(frame_bits(make_frames(np.array([id], np.uint32), np.frombuffer(data, np.uint8)[None]))[0])


def arrivals(host: Host) -> list[tuple[float, int, bytes]]:
    """(arrival at the host, identifier, payload) of all that is under way, in order."""
    host.world.advance(host.world.time + 0.01)
    return [(t, int.from_bytes(raw[:4], "little"), raw[8:]) for t, raw in host.world.buses[0].inbox]


@pytest.fixture
def host(tmp_path) -> Host:
    return Host(make_world(tmp_path))


# -- time and order ----------------------------------------------------------------------------------------------------


def test_one_frame_and_its_answer_take_their_bits(host):
    host.send((1, COMMAND))
    ((time, id, data),) = arrivals(host)
    assert id == 0x11
    expected = LATENCY + bits(1, COMMAND) * BIT + REPLY_DELAY + bits(0x11, data) * BIT + LATENCY
    assert time == pytest.approx(expected, abs=1e-12)


def test_nothing_arrives_before_its_time(host):
    host.send((1, COMMAND))
    ((time, _, _),) = arrivals(host)
    again = host.world.time
    host.wire.recv()
    host.send((1, COMMAND))
    assert len(host.wait(time - 1e-6)) == 0
    assert len(host.wait(again + time + 1e-6 - host.world.time)) == 1


def test_commands_win_against_answers(host):
    """Three commands in one burst: the answers to the first two are ready, and wait for the third. The answer to that
    is ready while the first is on the wire, and by its identifier goes before the second."""
    host.send((1, COMMAND), (2, COMMAND), (1, COMMAND))
    out = arrivals(host)
    burst = LATENCY + (2 * bits(1, COMMAND) + bits(2, COMMAND)) * BIT
    assert [id for _, id, _ in out] == [0x11, 0x11, 0x12]
    assert out[0][0] == pytest.approx(burst + bits(0x11, out[0][2]) * BIT + LATENCY, abs=1e-12)
    assert out[2][0] - out[1][0] == pytest.approx(bits(0x12, out[2][2]) * BIT, abs=1e-12)


def test_answers_win_against_questions(host):
    """0x7FF is the least urgent identifier: the first answer overtakes the third question."""
    host.send((REGISTER, REFRESH), (REGISTER, OTHER), (REGISTER, REFRESH))
    out = arrivals(host)
    first = LATENCY + (bits(REGISTER, REFRESH) + bits(REGISTER, OTHER)) * BIT + bits(0x11, out[0][2]) * BIT + LATENCY
    assert out[0][0] == pytest.approx(first, abs=1e-12)
    assert [id for _, id, _ in out] == [0x11, 0x12, 0x11]


def test_lower_answers_go_first(tmp_path):
    turned = (MOTORS[0].__class__("left", "DM8006", 1, 0x22), MOTORS[1].__class__("right", "DM8006", 2, 0x12))
    host = Host(make_world(tmp_path, bus=BusSpec("arm", "damiao", turned), reply_delay=300e-6))
    host.send((2, COMMAND), (1, COMMAND), (1, COMMAND), (1, COMMAND), (1, COMMAND))
    assert [id for _, id, _ in arrivals(host)] == [0x12, 0x22, 0x22, 0x22, 0x22]
    host = Host(make_world(tmp_path, bus=BusSpec("arm", "damiao", turned), reply_delay=300e-6))
    host.send((1, COMMAND), (2, COMMAND), (1, COMMAND), (1, COMMAND), (1, COMMAND))
    assert [id for _, id, _ in arrivals(host)] == [0x12, 0x22, 0x22, 0x22, 0x22]


def test_no_more_frames_than_fit(host):
    """A host that always has something to say gets what 1 Mbit/s carries, and no more."""
    bus = host.world.buses[0]
    for _ in range(500):
        try:
            host.send((1, COMMAND), (2, COMMAND), *[(1, COMMAND), (2, COMMAND)] * 10)
        except WireFull:
            pass
        host.wait(0.002)
    load = host.world.counters()["arm"]["load"]
    assert 0.995 < load <= 1.0
    assert 1.0 / 135e-6 < bus.traffic.frames < 1.0 / 111e-6  # worst and least bits of a standard frame with 8 bytes
    assert bus.traffic.overflowed > 0


def test_bit_rate_counts(tmp_path):
    host = Host(make_world(tmp_path, bus=BusSpec("arm", "damiao", MOTORS, bitrate=500_000)))
    host.send((1, COMMAND))
    ((time, _, data),) = arrivals(host)
    total = bits(1, COMMAND) + bits(0x11, data)
    assert time == pytest.approx(2 * LATENCY + REPLY_DELAY + 2 * total * BIT, abs=1e-12)


def test_queue_takes_only_what_fits(tmp_path):
    host = Host(make_world(tmp_path, queue_length=10))
    with pytest.raises(WireFull, match="took 10 of 12"):
        host.send(*[(1, COMMAND)] * 12)
    assert len(host.wait(0.01)) == 10


def test_nobody_acknowledges(tmp_path):
    """Without a powered motor the first frame is sent for ever; what is queued goes out, stale, when power returns."""
    host = Host(make_world(tmp_path, queue_length=10, faults=["off:arm@0-0.1"]))
    host.wait(0.01)
    host.send(*[(1, COMMAND)] * 6)
    assert host.wait(0.05)["id"].tolist() == [ERROR | CONTROLLER]  # it is error-passive, and says so
    with pytest.raises(WireFull):
        host.send(*[(1, COMMAND)] * 6)
    assert host.world.counters()["arm"]["busy"] == pytest.approx(0.05, abs=0.001)
    assert len(host.wait(0.1)) == 10


def test_closed_wire(host):
    host.wire.close()
    with pytest.raises(WireError, match="arm"):
        host.wire.recv()


# -- faults ------------------------------------------------------------------------------------------------------------


def tell(host: Host, times: int = 100) -> list[tuple[int, str]]:
    """Answers to ``times`` questions to each motor."""
    out = []
    for _ in range(times):
        host.send((REGISTER, REFRESH), (REGISTER, OTHER))
        out += answers(host.wait(0.004))
    return out


def faulty(tmp_path, *faults: str, **options) -> Host:
    return Host(make_world(tmp_path, faults=faults, **options))


def test_drop(tmp_path):
    host = faulty(tmp_path, "drop:0.2")
    heard = len(tell(host))
    dropped = host.world.counters()["arm"]["dropped"]
    assert 0.5 < heard / 200 < 0.78  # 0.8 for the question times 0.8 for the answer: 0.64
    assert heard + dropped == 200  # either frame of an exchange, lost, costs one answer


def test_drop_of_one_motor(tmp_path):
    out = tell(faulty(tmp_path, "drop:arm/left"), 20)
    assert {id for id, _ in out} == {0x12} and len(out) == 20


def test_delay(tmp_path):
    host = faulty(tmp_path, "delay:arm/left=0.003")
    host.send((REGISTER, REFRESH))
    ((late, _, data),) = arrivals(host)
    # Both frames are held back by 3 ms, each from the moment it would have had the wire.
    plain = 2 * LATENCY + REPLY_DELAY + (bits(REGISTER, REFRESH) + bits(0x11, data)) * BIT
    assert late == pytest.approx(plain + 2 * 0.003, abs=1e-9)


def test_an_answer_held_back_does_not_hold_back_others(tmp_path):
    host = faulty(tmp_path, "delay:arm/left=0.003")
    host.send((REGISTER, REFRESH))
    assert len(host.wait(0.004)) == 0  # its answer is due at 6.5 ms
    host.send((REGISTER, OTHER))
    assert [id for id, _ in answers(host.wait(0.001))] == [0x12]
    assert [id for id, _ in answers(host.wait(0.002))] == [0x11]


def test_corrupt_frames_are_sent_again(tmp_path):
    host = faulty(tmp_path, "corrupt:0.08")  # more would take the host off the bus: +8 for a failure, -1 for a success
    assert len(tell(host)) == 200  # nothing is lost,
    counters = host.world.counters()["arm"]
    assert counters["corrupted"] == pytest.approx(400 * 0.08 / 0.92, rel=0.4)  # it only takes longer
    clean = faulty(tmp_path)
    tell(clean)
    assert counters["busy"] > 1.03 * clean.world.counters()["arm"]["busy"]
    assert counters["frames"] == clean.world.counters()["arm"]["frames"] == 400


def test_corrupting_everything_ends_in_bus_off(tmp_path):
    host = faulty(tmp_path, "corrupt@0-0.1")
    host.send((1, COMMAND))
    host.wait(0.02)
    assert host.world.counters()["arm"] | {"busy": 0, "load": 0} == {
        "frames": 0, "busy": 0, "dropped": 0, "corrupted": 32, "overflowed": 0, "bus_off": 1, "load": 0,
    }  # fmt: skip
    with pytest.raises(WireError, match="bus off"):
        host.send((1, COMMAND))
    host.wait(0.2)
    assert len(host.ask(1, COMMAND)) == 1


def test_garbage_and_wrong_are_lies_of_motors_only(tmp_path):
    truth = tell(faulty(tmp_path), 1)[0][1]
    (_, lie) = tell(faulty(tmp_path, "wrong:arm/left"), 1)[0]
    flipped = int(truth.replace(" ", ""), 16) ^ int(lie.replace(" ", ""), 16)
    assert flipped.bit_count() == 1
    lies = [data for id, data in tell(faulty(tmp_path, "garbage:arm/left"), 20) if id == 0x11]
    assert len(set(lies)) == 20
    host = faulty(tmp_path, "garbage")
    host.ask(1, ENABLE)
    assert host.world.motors.enabled.tolist() == [True, False]  # what the host says arrives as it was


def test_duplicate(tmp_path):
    host = faulty(tmp_path, "duplicate:arm/left")
    # The question is heard twice and answered twice, and either answer is heard twice.
    assert len(host.ask(REGISTER, REFRESH)) == 4
    assert len(host.ask(REGISTER, OTHER)) == 1


def test_stuck(tmp_path):
    host = faulty(tmp_path, "stuck:arm/left@0.1-0.2")
    seen = []
    for _ in range(40):
        host.world.plant.data.qvel[0] = 1.0
        seen.append((host.world.time, host.ask(REGISTER, REFRESH)[0][1]))
    during = [data for t, data in seen if 0.1 <= t < 0.2]
    outside = [data for t, data in seen if not 0.1 <= t < 0.2]
    assert len(during) == 15 and len(set(during)) == 1
    assert len(set(outside)) == len(outside) == 25


def test_off_is_silent_and_free_of_torque(tmp_path):
    host = faulty(tmp_path, "off:arm/left@0.05-0.1")
    host.send((1, ENABLE), (2, ENABLE))
    host.wait(0.004)
    heard = []
    for _ in range(40):
        host.command(torque=1.0)
        heard += [(round(host.world.time, 3), id) for id, _ in answers(host.wait(0.004))]
        if 0.056 < host.world.time < 0.1:
            assert host.world.plant.joint_torque == pytest.approx([0.0, 1.0], abs=0.02)
    silent = [t for t in {t for t, _ in heard} if (t, 0x11) not in heard]
    assert min(silent) == pytest.approx(0.052, abs=0.005) and max(silent) == pytest.approx(0.1, abs=0.005)
    assert host.world.plant.joint_torque[0] == 0.0  # it came back disabled


def test_bus_off(tmp_path):
    host = faulty(tmp_path, "bus_off@0.1-0.2")
    heard, refused = [], []
    for _ in range(100):
        try:
            host.send((1, COMMAND))
        except WireError as error:
            assert not isinstance(error, WireFull)
            refused.append(host.world.time)
        heard += [host.world.time] * len(host.wait(0.004))
    assert min(refused) == pytest.approx(0.1, abs=0.005) and max(refused) == pytest.approx(0.2, abs=0.005)
    assert not any(0.1 <= t < 0.196 for t in heard)
    assert len(heard) + len(refused) == 100


def test_no_buffer(tmp_path):
    host = faulty(tmp_path, "no_buffer@0.1-0.2")
    host.send((1, COMMAND))
    host.wait(0.15)
    with pytest.raises(WireFull, match="took 0 of 1"):
        host.send((1, COMMAND))
    assert len(host.wait(0.1)) == 0
    assert len(host.ask(1, COMMAND)) == 1


def test_faults_can_be_added_while_it_runs(host):
    assert len(tell(host, 5)) == 10
    host.world.inject("drop")
    assert tell(host, 5) == []


# -- text form ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        ("drop:0.1", Fault("drop", probability=0.1)),
        ("drop", Fault("drop")),
        ("off:left_leg/left_knee_joint@5", Fault("off", "left_leg", "left_knee_joint", start=5.0)),
        ("bus_off:waist@3-4", Fault("bus_off", "waist", start=3.0, end=4.0)),
        ("delay:left_arm:0.2=0.005@1.5-2e1", Fault("delay", "left_arm", "*", 1.5, 20.0, 0.2, 0.005)),
        ("delayed:imu=0.01", Fault("delay", "imu", value=0.01)),
        ("stuck:*/right_*@1e-3", Fault("stuck", "*", "right_*", start=1e-3)),
        ("reboot:waist=2@1", Fault("reboot", "waist", value=2.0, start=1.0)),
    ],
)
def test_parse_fault(text, fault):
    assert parse_fault(text) == fault


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("dorp:0.1", "did you mean 'drop'"),
        ("drop:1.5", "probability 1.5"),
        ("off@4-3", "start before end"),
        ("bus_off:imu", "cannot befall the IMU"),
        ("drop:0.1:0.2", "expected kind"),
        ("", "expected kind"),
    ],
)
def test_bad_fault(text, message):
    with pytest.raises(BusError, match=message):
        parse_fault(text)


def test_fault_of_nobody(tmp_path):
    with pytest.raises(BusError, match="nothing here is 'leg/knee'.*arm, imu"):
        make_world(tmp_path, faults=["off:leg/knee"])


def test_every_kind_has_a_test():
    """This file, or the IMU's, uses every word of the vocabulary."""
    text = "".join((Path(__file__).parent / f"test_sim_{part}.py").read_text() for part in ("wire", "motor", "imu"))
    assert [kind for kind in KINDS if f'"{kind}' not in text] == []


# -- determinism -------------------------------------------------------------------------------------------------------


def run(tmp_path, seed: int, *faults: str) -> str:
    host = faulty(tmp_path, *faults, seed=seed)
    host.send((1, ENABLE), (2, ENABLE))
    for i in range(100):
        host.command(position=np.sin(0.1 * i), kp=10, kd=1)
        host.wait(0.004)
    return host.world.digest


def test_same_seed_same_bytes(tmp_path):
    first = run(tmp_path, 1, "drop:0.1")
    assert run(tmp_path, 1, "drop:0.1") == first
    assert run(tmp_path, 2, "drop:0.1") != first
    assert run(tmp_path, 1, "drop:0.11") != first


def test_digest_is_over_the_frames_in_order(tmp_path):
    # An IMU that is silent, so that the frames are all there is.
    host = faulty(tmp_path, "off:imu")
    host.send((2, COMMAND))
    heard = host.wait(0.002)
    question = make_frames(np.array([2], np.uint32), np.frombuffer(COMMAND, np.uint8)[None])
    assert host.world.digest == sha256(b"0:" + question.tobytes() + heard.tobytes()).hexdigest()


def test_two_buses_do_not_wait_for_each_other(tmp_path):
    one, two = BusSpec("one", "damiao", MOTORS[:1]), BusSpec("two", "damiao", MOTORS[1:])
    world = World(write_model(tmp_path), "base", [one, two], IMU, hang=None, faults=["drop:one"])
    hosts = [Host(world, "one"), Host(world, "two")]
    hosts[0].send((1, COMMAND))
    hosts[1].send((2, COMMAND))
    world.advance(0.002)
    assert len(world.buses[0].inbox) == 0
    ((time, raw),) = world.buses[1].inbox
    assert time == pytest.approx(2 * LATENCY + REPLY_DELAY + (bits(2, COMMAND) + bits(0x12, raw[8:])) * BIT, abs=1e-12)


def test_imu_packets_pass_unharmed(tmp_path):
    """Bus faults without a bus name do not befall the IMU."""
    world = make_world(tmp_path, bus=BUS, faults=["drop"])
    world.advance(0.1)
    assert len(hipnuc.Parser().feed(world.imu_wire.read())) >= 48
