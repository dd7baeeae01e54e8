"""``sim2real scan``: who answers, who should, and two motors with one id, on simulated buses and a scripted wire."""

from __future__ import annotations

import json

import numpy as np
import pytest
import yaml

from drivers.bus import BusSpec, MotorSpec
from drivers.codecs import damiao, dynamixel_packet, feetech
from drivers.codecs.damiao import Operation
from drivers.open import PROTOCOLS, open_world
from drivers.wire import ERROR, EXTENDED, FRAME, make_frames
from sim2real.bringup.sweep import Found, Sweep, sweep_damiao, verdicts
from sim2real.bringup.sweeps import SWEEPS, sweep_dynamixel, sweep_feetech, sweep_robstride
from sim2real.cli import main
from sim2real.cli.scan import _sweep
from sim2real.clock import SimClock
from sim2real.config import CONFIG_DIR, load_robot


@pytest.fixture(autouse=True)
def elsewhere(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


class Clock:
    """Nothing takes any time but waiting."""

    time = 0.0

    def now(self) -> float:
        return self.time

    def sleep_until(self, time: float, /) -> None:
        self.time = time


class Crowd:
    """A CanWire with motors (ESC_ID, MST_ID, serial number) on it, each answering for itself; ids may repeat."""

    def __init__(self, *motors: tuple[int, int, int], model: str = "DM8009", status: int = 0, lose: int = 0) -> None:
        self.motors, self.status, self.lose = motors, status, lose
        ranges = dict(zip(("PMAX", "VMAX", "TMAX"), damiao.MODELS[model], strict=True))
        self.registers = {"CTRL_MODE": 1, "TIMEOUT": 0, "HW_VER": 1, "SW_VER": 13, **ranges}
        self.sent: list[np.ndarray] = []
        self.waiting: list[np.ndarray] = []

    def send(self, frames: np.ndarray) -> None:
        self.sent.append(frames.copy())
        for frame in frames:
            request = damiao.unpack_register(frame["data"])
            for esc, mst, serial in self.motors:
                if request.id != esc:
                    continue
                if request.operation == Operation.REFRESH:
                    data = np.array([self.status << 4 | esc & 15, 0x80, 0, 0x80, 0x08, 0, 25, 25], np.uint8)
                else:
                    registers = self.registers | {"ESC_ID": esc, "MST_ID": mst, "SN": serial}
                    data = damiao.pack_register(esc, Operation.READ, request.register, registers[request.register])
                if self.lose:
                    self.lose -= 1
                else:
                    self.waiting.append(make_frames(np.array([mst], np.uint32), data[None]))

    def recv(self) -> np.ndarray:
        frames = np.concatenate([np.zeros(0, FRAME), *self.waiting])
        self.waiting.clear()
        return frames

    def fileno(self) -> int:
        return -1

    def close(self) -> None: ...


def sweep(crowd: Crowd) -> Sweep:
    return sweep_damiao(crowd, Clock())


def test_everybody_is_found_and_read_out():
    swept = sweep(Crowd((1, 0x11, 100), (0x42, 0x52, 101), (0xFF, 0x10F, 102)))
    assert [m.id for m in swept.motors] == [1, 0x42, 0xFF]
    motor = swept.motors[1]
    assert motor.registers["SN"] == 101 and motor.registers["SW_VER"] == 13 and motor.models == ["DM8009"]
    assert motor.feedback_ids == {0x52} and not motor.duplicate and not motor.error and not swept.error_frames


def test_only_questions_are_sent():
    crowd = Crowd((1, 0x11, 100))
    sweep(crowd)
    frames = np.concatenate(crowd.sent)
    assert (frames["id"] == damiao.BROADCAST_ID).all()
    assert set(frames["data"][:, 2].tolist()) == {Operation.READ, Operation.REFRESH}
    assert max(len(f) for f in crowd.sent) <= 16


@pytest.mark.parametrize("second", [(3, 0x13, 101), (3, 0x23, 100), (3, 0x23, 101)], ids=["SN", "MST_ID", "both"])
def test_two_motors_with_one_id_are_told(second):
    swept = sweep(Crowd((3, 0x13, 100), second, (4, 0x14, 7)))
    assert [(m.id, m.duplicate) for m in swept.motors] == [(3, True), (4, False)]
    assert "two motors have this id" in verdicts(swept)[0]["problems"][0]


def test_a_bus_that_loses_answers_is_asked_again():
    swept = sweep(Crowd((1, 0x11, 100), (2, 0x12, 101), lose=3))
    assert [m.id for m in swept.motors] == [1, 2]


def test_error_frames_and_strangers_are_no_motors():
    crowd = Crowd((1, 0x11, 100))
    noise = make_frames(np.array([ERROR | 4, 0x123], np.uint32), np.full((2, 8), 0x33, np.uint8))
    crowd.waiting.append(noise)
    swept = sweep(crowd)
    assert swept.error_frames == 1 and [m.id for m in swept.motors] == [1]


def test_an_error_has_its_name():
    assert sweep(Crowd((1, 0x11, 100), status=0xA)).motors[0].error == "over-current"


WIRING = BusSpec("leg", "damiao", (MotorSpec("knee", "DM8009", 1, 0x11), MotorSpec("ankle", "DM8009", 2, 0x12)))


@pytest.mark.parametrize(
    ("crowd", "problems"),
    [
        (Crowd((1, 0x11, 5), (2, 0x12, 6)), {}),
        (Crowd((1, 0x11, 5)), {2: "no answer"}),
        (Crowd((1, 0x11, 5), (2, 0x12, 6), (9, 0x19, 7)), {9: "not in the wiring"}),
        (Crowd((1, 0x11, 5), (2, 0x22, 6)), {2: "answers on 0x22, the wiring says 0x12"}),
        (
            Crowd((1, 0x11, 5), (2, 0x12, 6), model="DM4310"),
            dict.fromkeys((1, 2), "it is DM4310, the wiring says DM8009"),
        ),
    ],
)
def test_what_answers_is_compared_with_the_wiring(crowd, problems):
    told = {row["id"]: row["problems"][0] for row in verdicts(sweep(crowd), WIRING) if row["problems"]}
    assert told.keys() == problems.keys()
    assert all(problems[id] in told[id] for id in told)


@pytest.mark.parametrize(
    ("motor", "problem"),
    [(Found(1, {0}), "MST_ID 0"), (Found(1, {2}, {"CTRL_MODE": 2}), "CTRL_MODE 2, expected 1 (MIT)"),
     (Found(1, {2}, error="overload"), "error: overload"), (Found(1, {2}, {"ESC_ID": 1}), "fell silent: no answer about SN")],
)  # fmt: skip
def test_what_is_wrong_with_a_motor_alone(motor, problem):
    assert [p for p in verdicts(Sweep([motor]))[0]["problems"] if problem in p]


def test_a_whole_simulated_robot_is_as_wired(capsys):
    assert main(["scan", "--robot", "g1", "--sim", "--json"]) == 0
    buses = json.loads(capsys.readouterr().out)
    assert sum(len(b["motors"]) for b in buses) == 29
    assert all(not m["problems"] and m["joint"] for b in buses for m in b["motors"])


def test_a_dead_motor_is_missed_by_name(capsys):
    assert main(["scan", "--robot", "bench", "--sim", "--fault", "off:arm/elbow_joint"]) == 1
    assert "0x02 elbow_joint: no answer" in capsys.readouterr().out


def test_a_bus_with_nobody_on_it(capsys):
    assert main(["scan", "--channel", "empty", "--interface", "virtual"]) == 1
    assert "nobody answers" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("argv", "message"),
    [
        ([], "neither or both"),
        (["--robot", "g1", "--channel", "can0"], "neither or both"),
        (["--channel", "can0", "--sim"], "belong to a robot"),
        (["--robot", "bench", "--fault", "drop:0.1"], "add --sim"),
        (["--robot", "g1", "--bus", "left_lag"], "did you mean 'left_leg'"),
        (["--robot", "g1", "--wiring", "dds", "--sim"], "no sweep for 'unitree_hg', expected damiao or"),
        (["--channel", "can0", "--protocol", "damio"], "did you mean 'damiao'"),
        (["--channel", "can0", "--protocol", "unitree_hg"], "no sweep for 'unitree_hg'"),
        (["--channel", "nocan9"], "nocan9"),
    ],
)
def test_what_cannot_be_scanned_says_why(argv, message, capsys):
    assert main(["scan", *argv]) == 2
    assert message in " ".join(capsys.readouterr().err.split())


def rig(tmp_path, protocol: str, model: str, bitrate: int, **options):
    """The bench robot with other motors, as a YAML."""
    document = yaml.safe_load((CONFIG_DIR / "bench.yaml").read_text())
    (bus,) = document["wirings"]["can"]["buses"]
    watchdog = 0.08 if PROTOCOLS[protocol].watchdog else feetech.NO_WATCHDOG if protocol == "feetech" else 0.0
    bus |= {"protocol": protocol, "bitrate": bitrate, "watchdog": watchdog}
    bus |= {"data_bitrate": SWEEPS[protocol].data_bitrate}
    if PROTOCOLS[protocol].wire == "serial":
        bus["interface"] = "serial"
    for motor, id in zip(bus["motors"], (3, 5), strict=True):
        motor |= {"model": model, "id": id}
        motor.pop("feedback_id", None)
    (tmp_path / "bench.xml").write_text((CONFIG_DIR / "bench.xml").read_text())
    path = tmp_path / "bench.yaml"
    path.write_text(yaml.safe_dump(document))
    return str(path)


RIGS = {
    "robstride": ("RS02", 1_000_000, "RS01"),  # of the same torque: which of them, nothing tells
    "recoil": ("6512", 1_000_000, ""),
    "odrive": ("D6374", 1_000_000, ""),
    "mini_cheetah": ("mini-cheetah", 1_000_000, ""),
    "cubemars": ("AK80-9", 1_000_000, ""),
    "robstride_mit": ("RS02", 1_000_000, ""),
    "moteus": ("qdd100-beta2", 1_000_000, ""),
    "dynamixel": ("XM430-W350", 1_000_000, "XM430-W350"),
    "feetech": ("STS3215-12V", 1_000_000, "STS3215-12V"),
}


@pytest.mark.parametrize("protocol", RIGS)
def test_every_protocol_that_can_be_asked_finds_its_motors_over_bytes(protocol, tmp_path, capsys):
    model, bitrate, told = RIGS[protocol]
    path = rig(tmp_path, protocol, model, bitrate)
    code = main(["scan", "--robot", path, "--sim", "--json"])
    (bus,) = json.loads(capsys.readouterr().out)
    assert [(m["id"], m["joint"]) for m in bus["motors"]] == [(3, "shoulder_joint"), (5, "elbow_joint")]
    assert all(not m["problems"] and (not told or told in m["models"]) for m in bus["motors"])
    assert code == 0


@pytest.mark.parametrize("protocol", RIGS)
def test_a_dead_motor_is_missed_in_every_protocol(protocol, tmp_path, capsys):
    path = rig(tmp_path, protocol, *RIGS[protocol][:2])
    assert main(["scan", "--robot", path, "--sim", "--fault", "off:arm/elbow_joint"]) == 1
    said = capsys.readouterr().out
    assert "elbow_joint: no answer" in said and "shoulder_joint: no" not in said


def test_two_robstrides_with_one_id_are_told_by_their_chips():
    class Twins(Crowd):
        def send(self, frames: np.ndarray) -> None:
            for frame in frames:
                if int(frame["id"]) & 0x1FFFFFFF == 0x0000FD05:  # GET_ID of 5
                    for uid in (b"AAAAAAAA", b"BBBBBBBB"):
                        data = np.frombuffer(uid, np.uint8)[None]
                        self.waiting.append(make_frames(np.array([EXTENDED | 0x000005FE], np.uint32), data))

    (motor,) = sweep_robstride(Twins(), Clock()).motors
    assert motor.id == 5 and motor.duplicate


class Line:
    """A SerialWire that answers by a script."""

    def __init__(self, answer) -> None:
        self.answer, self.waiting = answer, b""

    def write(self, data: bytes) -> None:
        self.waiting += self.answer(data)

    def read(self) -> bytes:
        data, self.waiting = self.waiting, b""
        return data


def test_two_dynamixels_with_one_id_garble_each_other():
    def both(data: bytes) -> bytes:
        if data[4] != 9:
            return b""
        one, other = (dynamixel_packet.pack_status(9, 0, bytes([n, 4])) for n in (6, 252))
        return bytes(a & b for a, b in zip(one, other, strict=True))  # an open collector pulls down

    swept = sweep_dynamixel(Line(both), Clock(), range(8, 11))
    assert [(m.id, m.duplicate) for m in swept.motors] == [(9, True)]


def test_a_feetech_servo_is_found_by_its_bytes():
    """FF FF, id, length, error, value, checksum: model 777 of an STS3215, firmware 3.9, overheated."""
    registers = {3: bytes([0x09, 0x03]), 0: bytes([3, 9]), 7: b"\0", 33: b"\0"}

    def servo(data: bytes) -> bytes:
        assert data[:2] == b"\xff\xff" and data[4] == 2 and ~sum(data[2:-1]) & 0xFF == data[-1]
        if data[2] != 6:
            return b""
        body = bytes([6, 2 + data[6], 0x04]) + registers[data[5]]
        return b"\xff\xff" + body + bytes([~sum(body) & 0xFF])

    (motor,) = sweep_feetech(Line(servo), Clock(), range(5, 8)).motors
    assert motor.id == 6 and motor.firmware == "3.9" and motor.error == "overheating" and not motor.duplicate
    assert motor.models == ["STS3215-7V4", "STS3215-12V"]


def test_motors_at_another_bit_rate_are_found_when_asked_for(tmp_path, capsys):
    path = rig(tmp_path, "dynamixel", "XM430-W350", 1_000_000)
    config = load_robot(path)
    world = open_world(config.model_path, config.base, config.wiring().bus_specs(), config.wiring().imu_spec(),
                       registers={"elbow_joint": {"BAUD": 1}})  # fmt: skip
    clock = SimClock(world.advance, lambda: world.time)
    (spec,) = config.wiring().bus_specs()
    bus = _sweep(spec, True, world, clock)
    told = {m["id"]: m["problems"] for m in bus["motors"] if m["problems"]}
    assert list(told) == [5]
    elbow = [m for m in bus["motors"] if m["id"] == 5 and m["registers"]]
    assert len(elbow) == 1 and "listens at 57600 bit/s, the bus runs at 1000000" in elbow[0]["problems"][0]


def test_what_was_found_is_written_and_gone_on_from(capsys, tmp_path):
    assert main(["scan", "--robot", "bench", "--sim"]) == 0
    path = tmp_path / "bringup" / "bench-can-sim.scan.json"
    written = json.loads(path.read_text())
    written[0]["error_frames"] = 7
    path.write_text(json.dumps(written))
    assert main(["scan", "--robot", "bench", "--sim", "--go-on"]) == 1  # not swept again
    assert "7 error frames" in capsys.readouterr().out
