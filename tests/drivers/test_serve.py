"""A served twin: in a process of its own over sockets, and on python-can, where a stranger drives it by the manual."""

from __future__ import annotations

import json
import select
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest
from sim_robots import BOX, BUS, CLEAR, ENABLE, IMU, REFRESH, answers, make_world, mit, write_model

from drivers.bus import BusError
from drivers.codecs import hipnuc
from drivers.open import open_imu
from drivers.sim.bridge import can_bridge
from drivers.sim.serve import serve, world_of
from drivers.sim.socket_wire import SocketCanWire, SocketSerialWire, WorldRemote
from drivers.wire import ERROR, CanWire, WireError, WireFull, make_frames

ROOT = Path(__file__).resolve().parents[2]
REGISTER = 0x7FF


def spec(folder: Path, **options) -> dict:
    model = str(write_model(folder, options.pop("model", BOX)))
    return {"model": model, "base": "base", "buses": [asdict(BUS)], "imu": asdict(IMU)} | options


def start(folder: Path, document: dict) -> subprocess.Popen:
    (folder / "spec.json").write_text(json.dumps(document))
    with open(folder / "spec.json") as stdin:
        return subprocess.Popen(
            [sys.executable, "-m", "drivers.sim.serve", str(folder)],
            cwd=ROOT, stdin=stdin, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        )  # fmt: skip


@pytest.fixture
def served(tmp_path) -> Iterator[tuple[Path, subprocess.Popen]]:
    process = start(tmp_path, spec(tmp_path, hang=0.05))
    assert process.stdout and process.stdout.readline() == "ready\n"
    yield tmp_path, process
    process.kill()
    process.communicate()


def send(wire: CanWire, *frames: tuple[int, bytes]) -> None:
    ids = np.array([id for id, _ in frames], np.uint32)
    wire.send(make_frames(ids, np.array([list(data) for _, data in frames], np.uint8)))


def hear(wire: CanWire, count: int, seconds: float = 2.0) -> np.ndarray:
    """At least ``count`` frames, as they come in."""
    parts, end = [], time.monotonic() + seconds
    while sum(map(len, parts)) < count:
        assert time.monotonic() < end, f"got {sum(map(len, parts))} frames, expected {count}"
        parts.append(wire.recv())
        time.sleep(0.0005)
    return np.concatenate(parts)


def until(condition, seconds: float = 3.0) -> None:
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.005)


def test_an_imu_is_set_up_over_its_socket(tmp_path):
    imu = replace(IMU, protocol="bno085_shtp", rate=100.0, baud=3_000_000)
    process = start(tmp_path, spec(tmp_path, hang=0.05) | {"imu": asdict(imu)})
    try:
        assert process.stdout and process.stdout.readline() == "ready\n"
        driver = open_imu(imu, SocketSerialWire(tmp_path / "imu.sock"))
        until(lambda: np.isfinite(driver.read(time.monotonic()).time), 20.0)
        assert driver.read(time.monotonic()).acceleration_imu_in_imu[2] == pytest.approx(9.8, abs=1.0)
    finally:
        process.kill()
        process.communicate()


def test_round_trip_over_sockets(served):
    folder, _ = served
    wire = SocketCanWire(folder / "arm.sock")
    send(wire, (1, ENABLE), (2, ENABLE))
    assert answers(hear(wire, 2)) == [(0x11, "01 7f ff 7f f7 ff 19 19"), (0x12, "02 7f ff 7f f7 ff 19 19")]
    send(wire, (REGISTER, REFRESH))
    ((id, data),) = answers(hear(wire, 1))
    assert id == 0x11 and data.startswith("11")

    line = SocketSerialWire(folder / "imu.sock")
    parser, packets = hipnuc.Parser(), []
    until(lambda: packets.extend(parser.feed(line.read())) or len(packets) >= 20)
    assert [p.timestamp for p in packets] == pytest.approx(packets[0].timestamp + 0.002 * np.arange(len(packets)))


def test_hosts_come_and_go(served):
    folder, _ = served
    for _ in range(3):
        wire = SocketCanWire(folder / "arm.sock")
        send(wire, (REGISTER, REFRESH))
        assert len(hear(wire, 1)) == 1
        wire.close()
    one, two = SocketCanWire(folder / "arm.sock"), SocketCanWire(folder / "arm.sock")
    send(one, (REGISTER, REFRESH))
    assert len(hear(one, 1)) == len(hear(two, 1)) == 1  # everybody on a bus hears everything


def test_what_a_host_said_last_is_heard_though_it_left_answers_unread(served):
    """As a guardian does that switches its motors off and ends."""
    folder, process = served
    wire, world = SocketCanWire(folder / "arm.sock"), WorldRemote(folder / "world.sock")
    send(wire, (REGISTER, REFRESH))
    until(lambda: select.select([wire], [], [], 0)[0])
    process.send_signal(signal.SIGSTOP)  # it hears nothing until all is said
    for _ in range(100):  # and answers, to nobody, before it has heard it all
        send(wire, (REGISTER, REFRESH))
    send(wire, (1, ENABLE))
    wire.close()
    process.send_signal(signal.SIGCONT)
    until(lambda: "enabled" in [e.event for e in world.motor_log])


def test_world_by_its_names_from_afar(served):
    folder, _ = served
    world = WorldRemote(folder / "world.sock")
    assert world.truth().position_base_in_world[2] == pytest.approx(0.35, abs=0.02)
    world.lower(1.0)
    until(lambda: world.truth().position_base_in_world[2] < 0.32)
    world.hold()
    world.release()
    world.push((0.0, 0.0, 3.0))
    until(lambda: world.truth().position_base_in_world[2] > 0.36)
    assert not world.truth().fallen
    assert len(world.digest) == 64
    status = world.status()
    assert status["time"] == pytest.approx(time.monotonic() - status["epoch"], abs=0.5)
    with pytest.raises(WireError, match="dorp.*did you mean 'drop'"):
        world.inject("dorp")
    with pytest.raises(WireError, match="expected one of hold, lower"):
        world.call("jump")
    with pytest.raises(WireError, match="unexpected keyword"):
        world.call("lower", speed=1)
    until(lambda: world.truth().time > status["time"])  # and none of that did it harm


def test_motors_stop_by_themselves_when_the_host_goes(served):
    """Measured on the motor's side: its own watchdog, 80 ms after the last command it heard."""
    folder, _ = served
    world, wire = WorldRemote(folder / "world.sock"), SocketCanWire(folder / "arm.sock")
    timeout = (1600).to_bytes(4, "little")
    send(wire, *[(REGISTER, bytes([id, 0, 0x55, 9]) + timeout) for id in (1, 2)])
    send(wire, (1, ENABLE), (2, ENABLE))
    hear(wire, 4)
    for _ in range(20):
        send(wire, (1, mit(0, 0, 20, 1, 0)), (2, mit(0, 0, 20, 1, 0)))
        hear(wire, 2)
    wire.close()
    until(lambda: sum(e.event == "watchdog" for e in world.motor_log) == 2)
    last = world.last_command_times()
    for event in world.motor_log:
        if event.event == "watchdog":
            assert 0.080 <= event.time - last[event.joint] < 0.0821
    assert [e.event for e in world.motor_log if e.joint == "left"] == ["enabled", "driving", "watchdog"]


def test_faults_of_the_host_side_reach_it(served):
    folder, _ = served
    world, wire = WorldRemote(folder / "world.sock"), SocketCanWire(folder / "arm.sock")

    def tries(error: type[Exception], message: str):
        def once() -> bool:
            try:
                wire.recv()
                send(wire, (REGISTER, REFRESH))
            except error as caught:
                assert message in str(caught)
                return True
            return False

        return once

    now = world.time
    world.inject(f"no_buffer@{now}-{now + 0.2}")
    until(tries(WireFull, "queue full"))
    until(lambda: world.time > now + 0.21)
    tries(WireFull, "queue full")()  # what was still to be said about then
    now = world.time
    world.inject(f"bus_off@{now}-{now + 0.2}")
    until(tries(WireError, "bus off"))
    until(lambda: not tries(WireError, "bus off")() or world.time > now + 2)
    assert world.time >= now + 0.2


def test_an_error_frame_says_what_socketcan_would(served):
    folder, _ = served
    world, wire = WorldRemote(folder / "world.sock"), SocketCanWire(folder / "arm.sock")
    until(lambda: bool(world.time))
    world.inject("bus_off")
    frames = hear(wire, 1)
    assert frames["id"].tolist() == [ERROR | 0x40]  # CAN_ERR_FLAG | CAN_ERR_BUSOFF, linux/can/error.h


def test_stop_ends_it_and_the_host_is_told(served):
    folder, process = served
    wire, line = SocketCanWire(folder / "arm.sock"), SocketSerialWire(folder / "imu.sock")
    WorldRemote(folder / "world.sock").stop()
    out, _ = process.communicate(timeout=5)
    assert process.returncode == 0
    pace = json.loads(out.splitlines()[-1])
    assert pace["factor"] <= 1.0 and pace["elapsed"] > 0
    with pytest.raises(WireError, match="has gone"):
        while True:
            wire.recv()
    with pytest.raises(WireError, match="has gone"):
        send(wire, (REGISTER, REFRESH))
    with pytest.raises(WireError, match="has gone"):
        while True:
            line.read()
    assert not list(folder.glob("*.sock"))
    with pytest.raises(WireError, match="is it running"):
        SocketCanWire(folder / "arm.sock")


def test_killed_without_a_word(served):
    folder, process = served
    wire, world = SocketCanWire(folder / "arm.sock"), WorldRemote(folder / "world.sock")
    process.kill()
    process.wait(5)
    with pytest.raises(WireError, match="gone"):
        while True:
            wire.recv()
    with pytest.raises(WireError, match="gone"):
        world.truth()


def test_a_wrong_document_is_refused(tmp_path):
    process = start(tmp_path, spec(tmp_path, gravity="off"))
    out, err = process.communicate(timeout=20)
    assert process.returncode == 2 and out == "" and "['gravity']" in err and "Traceback" not in err
    with pytest.raises(BusError, match=r"no \['base'\]"):
        world_of({k: v for k, v in spec(tmp_path).items() if k != "base"})


def test_a_stranger_with_python_can(tmp_path):
    """A python-can program that knows nothing of this project, only the motor's manual, turns a joint."""
    can = pytest.importorskip("can")
    world = make_world(tmp_path)  # the arm, in this process: python-can's virtual bus does not leave it
    started, stop = threading.Event(), threading.Event()
    thread = threading.Thread(
        target=serve,
        args=(world, tmp_path),
        kwargs={
            "ready": started.set,
            "goes_on": lambda: not stop.is_set(),
            "bridges": {"arm": can_bridge(BUS, "virtual:twin")},
        },
    )
    with can.Bus(interface="virtual", channel="twin") as bus:
        thread.start()
        assert started.wait(5)
        try:

            def ask(id: int, data: bytes):
                bus.send(can.Message(arbitration_id=id, data=data, is_extended_id=False))
                message = bus.recv(timeout=2.0)
                assert message is not None
                return message

            answer = ask(1, CLEAR)
            assert (answer.arbitration_id, answer.dlc, answer.is_extended_id) == (0x11, 8, False)
            assert answer.data.hex(" ") == "01 7f ff 7f f7 ff 19 19"
            assert ask(REGISTER, bytes.fromhex("01 00 33 15 00 00 00 00")).data.hex(" ") == "01 00 33 15 00 00 48 41"
            ask(1, ENABLE)
            end = time.monotonic() + 5.0
            position = 0.0
            while abs(position - 0.5) > 0.02 and time.monotonic() < end:
                data = ask(1, mit(0.5, 0, 20, 1, 0)).data
                assert data[0] == 0x11
                position = (data[1] << 8 | data[2]) / 65535 * 25 - 12.5
            assert position == pytest.approx(0.5, abs=0.02)
        finally:
            stop.set()
            thread.join(5)
    assert not thread.is_alive()
