"""Random and mutated frames, bytes and samples against every codec of ``drivers/open.py``, from the host's and the motors' side.

No exception, no packet taken whose check is wrong, no state that is not finite. Frames to mutate are recorded from a bus that
drives its twin. FRAMES here; a million for each codec with ``make fuzz``, and other ones each time.
"""

from __future__ import annotations

import os
import zlib
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import hypothesis
import numpy as np
import pytest
from can_bench import RATE, Bench, rig
from sim_servos import Bench as ServoBench
from sim_servos import tick
from test_dynamixel import command
from test_imu_codecs import UNCHECKED, awake
from test_unitree_hg import SPEC as G1
from test_unitree_hg import state_words

from drivers.bus import ImuSpec, MotorState
from drivers.codecs import feetech
from drivers.codecs import unitree_api as api
from drivers.codecs import unitree_hg as hg
from drivers.open import IMUS, PROTOCOLS, load, open_codec, open_imu
from drivers.sim.serial_pty import bus_of
from drivers.wire import EXTENDED, REMOTE

LONG = hypothesis.settings.get_current_profile_name() == "fuzz"
FRAMES = 1_000_000 if LONG else 20_000
TOLD = 100_000 if LONG else 4_000  # frames that a twin is told: one by one, as they come on a wire
BATCH = 500
SEED = int.from_bytes(os.urandom(4), "little") if LONG else 1
CAN = [name for name, p in PROTOCOLS.items() if p.wire == "can"]
SERIAL = {"dynamixel": bus_of("XM430-W350", 3), "feetech": bus_of("STS3215-12V", 3, 1_000_000)}
SENSORS = [name for name, p in IMUS.items() if p.sensor]
pytestmark = pytest.mark.hypothesis  # what `make fuzz` runs


def generator(name: str) -> np.random.Generator:
    """Seeded by the codec; a failure names the seed in its traceback's locals, and in what it prints."""
    print(f"{name}: seed {SEED}")
    return np.random.default_rng([SEED, zlib.crc32(name.encode())])


def test_every_codec_is_fuzzed():
    assert {*CAN, *SERIAL, "unitree_hg"} == set(PROTOCOLS) and {*SENSORS, "unitree_hg"} == set(IMUS)


def sound(state: MotorState, codec: Any) -> None:
    """Of every motor that was heard, position and velocity are finite; whatever else is known is finite too."""
    heard = np.isfinite(state.time)
    for quantity in (state.position, state.velocity):
        assert np.isfinite(quantity[heard]).all()
    for quantity in (state.torque, state.temperature):
        assert not np.isinf(quantity).any()
    for code in state.error.tolist():
        assert codec.error_name(code)


# -- CAN ---------------------------------------------------------------------------------------------------------------


class Tap:
    """A CAN wire that keeps what goes over it."""

    def __init__(self, wire) -> None:
        self._wire, self.sent, self.received = wire, [], []

    def send(self, frames: np.ndarray) -> None:
        self.sent.append(frames.copy())
        self._wire.send(frames)

    def recv(self) -> np.ndarray:
        self.received.append(self._wire.recv())
        return self.received[-1]


def recorded(folder, protocol: str) -> tuple[Bench, np.ndarray, np.ndarray]:
    """A bench after a short run, and every frame of its host and of its motors."""
    bench = Bench(folder, protocol, connect=False)
    tap = Tap(bench.world.wires["arm"])
    bench.bus._wire = tap  # type: ignore[attr-defined]
    bench.bus.connect(bench.clock)
    bench.enable()
    bench.run(20 / RATE, position=0.2, kp=5.0, kd=0.2)
    bench.bus.disable()
    bench.poll(0.02)
    return bench, np.concatenate(tap.sent), np.concatenate(tap.received)


def mutated(rng: np.random.Generator, corpus: np.ndarray, n: int) -> np.ndarray:
    """n frames: of the corpus with up to three bits flipped, with another length, id or payload; a tenth wholly random."""
    frames = corpus[rng.integers(0, len(corpus), n)].copy()
    data = frames["data"]
    for _ in range(3):
        rows = np.flatnonzero(rng.random(n) < 0.4)
        data[rows, rng.integers(0, data.shape[1], len(rows))] ^= (1 << rng.integers(0, 8, len(rows))).astype(np.uint8)
    special = np.array([0x00, 0xFF, 0x7F, 0x80, 0xC0], np.uint8)
    rows = np.flatnonzero(rng.random(n) < 0.1)
    start = rng.integers(0, max(1, data.shape[1] - 4), len(rows))
    for k in range(4):  # 7F C0 00 00 and the like: not numbers
        data[rows, start + k] = rng.choice(special, len(rows))
    rows = np.flatnonzero(rng.random(n) < 0.1)
    frames["length"][rows] = rng.integers(0, data.shape[1] + 1, len(rows))
    rows = np.flatnonzero(rng.random(n) < 0.2)
    frames["id"][rows] ^= (1 << rng.integers(0, 32, len(rows))).astype(np.uint32)
    rows = np.flatnonzero(rng.random(n) < 0.1)
    data[rows] = rng.integers(0, 256, (len(rows), data.shape[1]), np.uint8)
    frames["id"][rows] = rng.integers(0, 1 << 32, len(rows), np.uint32)
    frames["length"][rows] = data.shape[1]
    return frames


@pytest.mark.parametrize("protocol", CAN)
def test_the_host_of_a_can_bus(tmp_path, protocol):
    _, _, corpus = recorded(tmp_path, protocol)
    rng, codec, state = generator(protocol), open_codec(rig(protocol)), MotorState.empty(2)
    for k in range(FRAMES // BATCH):
        frames = mutated(rng, corpus, BATCH)
        codec.pack_poll(state)
        assert codec.owners(frames).shape == (BATCH,)
        for answer in codec.unpack_registers(frames):
            assert 0 <= answer.row < 2 and isinstance(answer.register, str)
        assert 0 <= codec.unpack(frames, state, float(k)) <= BATCH
        sound(state, codec)
    assert np.isfinite(state.time).all()  # some were good enough


@pytest.mark.parametrize("protocol", CAN)
def test_the_motors_of_a_can_bus(tmp_path, protocol):
    bench, corpus, _ = recorded(tmp_path, protocol)
    rng, motors, time = generator(protocol), bench.world.motors, bench.world.time
    for _ in range(TOLD // BATCH):
        frames = mutated(rng, corpus, BATCH)
        raw, size = frames.tobytes(), frames.itemsize
        motors.refresh(raw)  # their time on the wire
        for i, id in enumerate(frames["id"].tolist()):
            answer = motors.receive(0, id, raw[size * i : size * i + size], time)
            if answer is not None:
                assert 0 <= answer[0] < 2 and len(answer[2]) == size and answer[3] > 0
            if i % 50 == 0:
                motors.act(time, time + 0.002)
                time += 0.002
                assert np.isfinite(motors._law).all()
    for row in (0, 1):  # and it can still be put right
        motors.power(row, False, time)
        motors.power(row, True, time)
    assert not motors.enabled.any()


# -- serial lines ------------------------------------------------------------------------------------------------------


def stream(rng: np.random.Generator, corpus: list[bytes], n: int) -> Iterator[bytes]:
    """n packets in pieces of any size: of the corpus, with bits flipped, cut short, doubled, or between random bytes."""
    kept = b""
    for _ in range(n):
        packet = bytearray(corpus[rng.integers(len(corpus))])
        kind = rng.integers(8)
        if kind < 3:
            for at in rng.integers(0, 8 * len(packet), kind + 1).tolist():
                packet[at // 8] ^= 1 << at % 8
        elif kind == 3:
            del packet[rng.integers(len(packet)) :]
        elif kind == 4:
            packet += packet[rng.integers(len(packet)) :]
        elif kind == 5:
            packet[:0] = rng.integers(0, 256, rng.integers(1, 40), np.uint8).tobytes()
        elif kind == 6:
            at = rng.integers(len(packet))
            packet[at : at + 4] = bytes([0xFF, 0x7F, 0xC0, 0x80][: len(packet) - at])
        kept += bytes(packet)
        cut = int(rng.integers(0, len(kept) + 1))
        yield kept[:cut]
        kept = kept[cut:]
    yield kept


def conversation(protocol: str) -> tuple[ServoBench, list[bytes], list[bytes]]:
    """A bench after a short run, and what its host and its servos sent."""
    bench = ServoBench(spec=SERIAL[protocol])
    sent: list[bytes] = []
    received: list[bytes] = []
    write, read = bench.wire.write, bench.wire.read
    bench.wire.write = lambda data: (sent.append(data), write(data))[1]  # type: ignore[method-assign]
    bench.wire.read = lambda: received.append(read()) or received[-1]  # type: ignore[method-assign,func-returns-value]
    if protocol == "dynamixel":
        bench.servos.fast = False  # one packet from each servo
    bus = bench.connected()
    bus.enable()
    tick(bus, bench, command(3, position=0.2, kp=5.0), 10, 0.006)
    return bench, packets(protocol, bench, sent), packets(protocol, bench, received)


def packets(protocol: str, bench: ServoBench, chunks: list[bytes]) -> list[bytes]:
    """The packets in ``chunks``, each by itself."""
    found = bench.servos.parser().feed(b"".join(chunks))
    return [p.raw if protocol == "dynamixel" else feetech.pack(p.id, p.instruction, p.parameters) for p in found]


def checked(protocol: str, raw: bytes) -> bool:
    """Whether a packet's own check fits, by its definition."""
    if protocol == "feetech":
        return ~sum(raw[2:-1]) & 0xFF == raw[-1]
    crc = 0
    for byte in raw[:-2]:
        crc ^= byte << 8
        for _ in range(8):
            crc = (crc << 1 ^ 0x8005 if crc & 0x8000 else crc << 1) & 0xFFFF
    return crc == raw[-2] | raw[-1] << 8


@pytest.mark.parametrize("protocol", SERIAL)
def test_both_ends_of_a_serial_line(protocol):
    bench, sent, received = conversation(protocol)
    rng, codec, state = generator(protocol), open_codec(SERIAL[protocol]), MotorState.empty(3)
    for k, data in enumerate(stream(rng, received, FRAMES)):
        codec.unpack(data, state, float(k))
        if k % 64 == 0:
            codec.unpack_register("MODEL", data)
            codec.finish(state, float(k))
            sound(state, codec)
    sound(state, codec)
    assert np.isfinite(state.time).all() and codec.rejected > FRAMES // 20

    parser, time, taken = bench.servos.parser(), bench.time, 0
    for k, data in enumerate(stream(rng, sent, TOLD)):
        for packet in parser.feed(data):
            taken += 1
            if protocol == "feetech":
                body = bytes([packet.id, len(packet.parameters) + 2, packet.instruction]) + packet.parameters
                assert len(body) <= 255
            elif k % 8 == 0:
                assert checked(protocol, packet.raw)
            for row, delay, answer in bench.servos.receive(packet, time):
                assert 0 <= row < 3 and delay >= 0 and checked(protocol, answer)
        if k % 20 == 0:
            bench.servos.act(time, time + 0.002)
            time += 0.002
            assert np.isfinite(bench.servos._law).all()
    assert taken > TOLD // 10


@pytest.mark.parametrize("protocol", SERIAL)
def test_no_packet_is_taken_whose_check_is_wrong(protocol):
    """Every single bit of every packet of a conversation flipped: none is taken."""
    bench, sent, received = conversation(protocol)
    for packet in {*sent[:40], *received[-10:]}:
        assert len(bench.servos.parser().feed(packet)) == 1 and checked(protocol, packet)
        for at in range(8 * len(packet)):
            damaged = bytearray(packet)
            damaged[at // 8] ^= 1 << at % 8
            assert bench.servos.parser().feed(bytes(damaged)) == []


# -- IMUs --------------------------------------------------------------------------------------------------------------


class Pieces:
    """A serial wire that gives one piece a read."""

    def __init__(self) -> None:
        self.piece = b""

    def read(self) -> bytes:
        return self.piece

    def write(self, data: bytes) -> None:
        assert len(data) == 1  # to a sensor that has to be told to send


@pytest.mark.parametrize("protocol", SENSORS)
def test_imus(protocol):
    rng, wire = generator(protocol), Pieces()
    sensor = awake(protocol)
    corpus = []
    for k in range(300):
        q = rng.normal(size=4)
        corpus.append(sensor.pack(0.01 * k, q / np.linalg.norm(q), rng.normal(size=3), 5 * rng.normal(size=3)))
    imu = open_imu(ImuSpec(protocol), wire)
    for k, piece in enumerate(stream(rng, corpus, FRAMES)):
        wire.piece = piece
        state = imu.read(float(k))
        if np.isfinite(state.time):
            assert np.isfinite(state.angular_velocity_imu_in_imu).all()
            assert np.isfinite(state.acceleration_imu_in_imu).all()
            assert abs(np.linalg.norm(state.orientation_imu_in_world) - 1) < 0.01
    assert imu.counters.rejected > FRAMES // 50
    intact = load(IMUS[protocol].parser)()
    for packet in corpus[:10]:
        checked = (
            8 * len(packet) if protocol not in UNCHECKED else 8 * 5
        )  # else only flag, protocol, length and channel
        for at in range(checked):
            damaged = bytearray(packet)
            damaged[at // 8] ^= 1 << at % 8
            assert load(IMUS[protocol].parser)().feed(bytes(damaged)) == []
        intact.feed(packet)
    assert intact.rejected == 0


# -- DDS ---------------------------------------------------------------------------------------------------------------


def test_the_topics_of_a_g1():
    rng, codec, state = generator("unitree_hg"), open_codec(G1), MotorState.empty(len(G1.motors))
    imu, robot = load(IMUS["unitree_hg"].parser)(), load("drivers.sim.dds_robot:SimG1")
    from drivers.sim.serial_pty import Wheels

    twin = robot(G1, Wheels(len(G1.motors)), controller="")
    states = [hg.state_payload(state_words(seed)) for seed in range(20)]
    asked = [codec.pack_enable(5), codec.pack_disable(5), api.pack_request(api.Request(1, 1002, "{}"))]
    structs = {sound_state.tobytes() for s in states if (sound_state := hg.read_state(s)) is not None}
    taken = 0
    for k in range(FRAMES // (1 if LONG else 4)):
        payload = bytearray(states[rng.integers(20)])
        flips = int(rng.integers(0, 4))
        for at in rng.integers(0, 8 * len(payload), flips).tolist():
            payload[at // 8] ^= 1 << at % 8
        if rng.random() < 0.1:
            del payload[rng.integers(len(payload)) :]
        sample = hg.read_state(bytes(payload))
        if sample is not None:
            taken += 1
            assert sample.tobytes() in structs  # what was flipped was padding
            codec.unpack(sample, state, float(k))
        imu.feed(bytes(payload))
        wanted = bytearray(asked[rng.integers(len(asked))])
        for at in rng.integers(0, 8 * len(wanted), int(rng.integers(0, 3))).tolist():
            wanted[at // 8] ^= 1 << at % 8
        topic = (hg.COMMAND_TOPIC, api.MOTION_REQUEST, "rt/other")[rng.integers(3)]
        twin.receive(topic, bytes(wanted), 0.001 * k)
        api.unpack_response(bytes(wanted))
        if k % 50 == 0:
            twin.act(0.001 * k, 0.001 * k + 0.002)
            assert np.isfinite(twin._law).all()
            sound(state, codec)
    assert taken and np.isfinite(state.time).all()


def test_the_mutations_reach_what_they_should(tmp_path):
    """Lest this file test nothing: unchanged frames stay among them, and every kind of change occurs."""
    _, _, corpus = recorded(tmp_path, "damiao")
    frames = mutated(generator("mutations"), corpus, 2000)
    known = {f.tobytes() for f in corpus}
    unchanged = np.mean([f.tobytes() in known for f in frames])
    assert 0.02 < unchanged < 0.5
    assert (frames["id"] & np.uint32(EXTENDED) > 0).any() and (frames["id"] & np.uint32(REMOTE) > 0).any()
    assert len(set(frames["length"].tolist())) > 5


def test_replaced_specs_are_refused_not_crashed():
    """Ids of all sizes in a wiring: a codec, or a BusError."""
    from drivers.bus import BusError

    for protocol in PROTOCOLS:
        spec = G1 if protocol == "unitree_hg" else SERIAL.get(protocol) or rig(protocol)
        for id in (-1, 0, 0x7F, 0xFF, 0x7FF, 0x800, 1 << 29):
            try:
                open_codec(replace(spec, motors=(replace(spec.motors[0], id=id),)))
            except BusError as error:
                assert str(error)
