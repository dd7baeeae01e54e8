"""The maker's library (PyPI: moteus) packs what we pack, reads what we answer, and drives our twin."""

from __future__ import annotations

import asyncio
import math
from importlib import import_module

import numpy as np
import pytest
from can_bench import Bench, rig

from drivers.bus import MotorCommand
from drivers.codecs import moteus as ours
from drivers.codecs.moteus import TURN, Answers, Gains, Mode
from drivers.codecs.moteus_frame import registers_of
from drivers.wire import EXTENDED, make_fd_frames

moteus = pytest.importorskip("moteus", reason="the maker's library (pip install moteus) is not installed")
devices = import_module("moteus.transport_device")

GAINS = Gains(np.array([400.0]), np.array([20.0]), np.array([16.0]))


def controller(id: int = 1, **options):
    """One whose commands and questions have the resolutions that we use."""
    position, query = moteus.PositionResolution(), moteus.QueryResolution()
    for name in vars(moteus.PositionResolution):
        if not name.startswith("_"):
            setattr(position, name, moteus.F32)
    position.velocity_limit = position.accel_limit = moteus.INT8
    for name in ("mode", "temperature", "fault"):
        setattr(query, name, moteus.INT8)
    for name in ("position", "velocity", "torque"):
        setattr(query, name, moteus.F32)
    query.voltage = moteus.IGNORE
    return moteus.Controller(id=id, query_resolution=query, position_resolution=position, **options)


def test_the_library_packs_the_same_command():
    theirs = controller().make_position(
        position=0.5, velocity=-0.25, feedforward_torque=0.25, kp_scale=0.5, kd_scale=0.25, maximum_torque=16.0,
        watchdog_timeout=0.08, velocity_limit=-0.1, accel_limit=-0.05, query=True,
    )  # fmt: skip
    one = lambda x: np.array([x])  # noqa: E731
    command = MotorCommand(
        one(0.5 * TURN), one(-0.25 * TURN), one(200.0 / TURN), one(5.0 / TURN), one(0.25)
    )  # half of kp, a quarter of kd
    payload = ours.pack_command(command, GAINS, 0.08)[0].tobytes()
    assert registers_of(theirs.data) == registers_of(payload)
    assert (theirs.destination, theirs.source, theirs.reply_required) == (1, 0, True)
    assert registers_of(controller().make_stop(query=True).data) == registers_of(ours.STOP)
    assert registers_of(controller().make_query().data) == registers_of(bytes(ours.QUESTIONS))


def test_the_library_reads_our_answer():
    payload = ours.pack_answer(Answers(*(np.array([x]) for x in (10, 0.5 * TURN, -0.25 * TURN, 0.25, 41.0, 38))))
    values = import_module("moteus.protocol").parse_reply(payload[0].tobytes())
    assert values[moteus.Register.MODE] == Mode.POSITION and values[moteus.Register.POSITION] == 0.5
    assert values[moteus.Register.TORQUE] == 0.25 and values[moteus.Register.FAULT] == 38


class TwinDevice(devices.TransportDevice):
    """A CAN-FD adapter whose bus is a twin's, in lockstep with it."""

    def __init__(self, bench: Bench) -> None:
        super().__init__()
        self._world, self._wire = bench.world, bench.world.wires["arm"]

    def empty_bus_tx_safe(self) -> bool:
        return True

    async def send_frame(self, frame) -> None:
        length = self._round_up_dlc(len(frame.data))
        data = np.frombuffer(bytes(frame.data).ljust(length, b"\x50"), np.uint8)
        id = frame.arbitration_id | EXTENDED * frame.is_extended_id
        self._wire.send(make_fd_frames(np.array([id], np.uint32), data[None], length))

    async def transaction(self, requests, **_) -> None:
        for request in requests:
            await self.send_frame(request.frame)
        for _ in range(10):
            self._world.advance(self._world.time + 0.001)
            for row in self._wire.recv():
                id = int(row["id"])
                heard = devices.Frame(id & ~EXTENDED, row["data"][: row["length"]].tobytes(), int(row["length"]),
                                      bool(id & EXTENDED), True, True, self)  # fmt: skip
                for request in requests:
                    if request.frame_filter is not None and request.frame_filter(heard):
                        request.responses.append(heard)
                        break
            if all(r.responses for r in requests if r.frame_filter is not None):
                return


@pytest.fixture
def bench(tmp_path) -> Bench:
    return Bench(tmp_path, "moteus", connect=False)


def theirs(bench: Bench, id: int = 1):
    return moteus.Controller(id=id, transport=moteus.Transport([TwinDevice(bench)]))


def test_the_library_drives_the_twin(bench):
    left = theirs(bench)
    R = moteus.Register

    async def drive():
        await left.set_stop()
        before = await left.query()
        assert before.values[R.MODE] == Mode.STOPPED and before.values[R.VOLTAGE] == 24.0
        await left.set_position(position=math.nan, query=True)
        stream = moteus.Stream(left, use_flow_control=False)
        for name, value in (("kp", 100.0), ("kd", 4.0)):
            await stream.command(f"conf set servo.pid_position.{name} {value}".encode())
        assert await stream.command(b"conf get servo.pid_position.kp", allow_any_response=True) == b"100.000000"
        with pytest.raises(moteus.CommandError):
            await stream.command(b"conf get servo.nothing")
        for _ in range(600):
            said = await left.set_position(position=0.1, watchdog_timeout=0.05, query=True)
        assert said.values[R.MODE] == Mode.POSITION
        assert said.values[R.POSITION] == pytest.approx(0.1, abs=2e-3)
        bench.world.advance(bench.world.time + 0.1)
        said = await left.set_position(position=0.3, query=True)
        assert said.values[R.MODE] == Mode.TIMEOUT  # and stays there
        assert (await left.query()).values[R.MODE] == Mode.TIMEOUT
        await left.set_stop()
        assert (await left.query()).values[R.MODE] == Mode.STOPPED

    asyncio.run(asyncio.wait_for(drive(), 60))
    assert bench.world.plant.joint_pos[0] == pytest.approx(0.1 * TURN, abs=0.02)
    assert bench.world.plant.joint_pos[1] == 0.0


@pytest.mark.parametrize("resolution", ["INT8", "INT16", "INT32", "F32"])
def test_the_library_reads_every_resolution_of_the_twin(tmp_path, resolution):
    bench = Bench(tmp_path, "moteus", connect=False, joint_pos={"left": 0.9})
    query = moteus.QueryResolution()
    for name in ("mode", "position", "velocity", "torque", "voltage", "temperature", "fault"):
        setattr(query, name, getattr(moteus, resolution))
    device = moteus.Transport([TwinDevice(bench)])
    left = moteus.Controller(id=1, transport=device, query_resolution=query)
    said = asyncio.run(asyncio.wait_for(left.query(), 10)).values
    assert said[moteus.Register.POSITION] == pytest.approx(0.9 / TURN, abs=0.005)
    assert said[moteus.Register.VOLTAGE] == 24.0 and said[moteus.Register.MODE] == 0
    assert said[moteus.Register.TEMPERATURE] == pytest.approx(25.0)


def test_the_library_sets_the_position_of_the_twin(tmp_path):
    bench = Bench(tmp_path, "moteus", connect=False, joint_pos={"left": 0.9})
    left, R = theirs(bench), moteus.Register

    async def said():
        return (await left.custom_query({R.POSITION: moteus.F32, R.HOME_STATE: moteus.INT8})).values

    async def drive():
        before = await said()
        assert (before[R.HOME_STATE], before[R.POSITION]) == (1, pytest.approx(0.9 / TURN, abs=1e-3))
        await left.set_output_nearest(position=0.4)
        after = await said()
        assert (after[R.HOME_STATE], after[R.POSITION]) == (2, pytest.approx(0.9 / TURN + 2 / 6, abs=1e-3))
        await left.set_output_exact(position=0.4)
        assert (await said())[R.POSITION] == pytest.approx(0.4, abs=1e-3)
        bench.world.motors.power(0, False, bench.world.time)
        bench.world.motors.power(0, True, bench.world.time)
        assert (await said())[R.HOME_STATE] == 1

    asyncio.run(asyncio.wait_for(drive(), 30))


def test_the_driver_takes_over_where_the_library_stopped(tmp_path):
    bench = Bench(tmp_path, "moteus", connect=False)

    async def configure():
        stream = moteus.Stream(theirs(bench), use_flow_control=False)
        await stream.command(b"conf set servo.timeout_mode 0")
        await stream.command(b"conf set servo.default_timeout_s nan")

    asyncio.run(asyncio.wait_for(configure(), 30))
    bench.bus.connect(bench.clock)  # programs its own, and reads it back
    assert bench.world.motors.register("left", "servo.timeout_mode") == Mode.ZERO_VELOCITY
    assert bench.world.motors.register("left", "servo.default_timeout_s") == rig("moteus").watchdog
