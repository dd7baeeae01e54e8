"""Emulated Feetech servos: packets byte by byte, their state machine, the bus that drives them, and the maker's SDK on a pty."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from sim_robots import ARM, IMU, write_model
from sim_servos import Bench, tick
from test_dynamixel import command

from drivers.bus import BusError, BusSpec, MotorSpec
from drivers.codecs import feetech
from drivers.codecs.feetech import BROADCAST, Instruction, pack
from drivers.open import open_bus, open_world
from drivers.sim.serial_pty import bus_of
from sim2real.bringup.observe import observers

ROOT = Path(__file__).resolve().parents[2]
MODEL = "STS3215-12V"
STALL = feetech.MODELS[MODEL].stall_torque


def bench(n: int = 3, **options) -> Bench:
    return Bench(spec=bus_of(MODEL, n, 1_000_000), **options)


def write(id: int, address: int, *data: int) -> bytes:
    return pack(id, Instruction.WRITE, bytes([address, *data]))


def word(value: int) -> tuple[int, int]:
    return value & 0xFF, value >> 8


def asked(b: Bench, raw: bytes) -> str:
    """What comes back on the line within 5 ms."""
    b.wire.write(raw)
    b.wait(0.005)
    return b.wire.read().hex(" ")


def test_a_new_id_and_a_new_bit_rate_are_heard_at_once_and_kept_only_where_the_lock_was_open():
    b = bench(2)
    ping = lambda id: asked(b, pack(id, Instruction.PING))  # noqa: E731
    asked(b, write(1, feetech.REGISTERS["ID"][0], 9))
    assert ping(9) and not ping(1)
    for address, value in (("LOCK", 0), ("BAUD", 1)):
        asked(b, write(2, feetech.REGISTERS[address][0], value))
    assert not ping(2)
    for row in (0, 1):
        b.servos.power(row, False, b.time)
        assert not ping(9)
        b.servos.power(row, True, b.time)
    b.wait(0.5)
    assert ping(1) and not ping(2)
    b.line.retune(500_000)
    assert ping(2) and not ping(1)


# FT-SCS protocol manual, checksums by hand: ~(01 + 02 + 01) = FB; an answer has its error (0) for the instruction.
def test_packets_byte_by_byte():
    b = bench()
    assert asked(b, bytes.fromhex("ff ff 01 02 01 fb")) == "ff ff 01 02 00 fc"  # ping
    assert asked(b, bytes.fromhex("ff ff 01 04 02 38 02 be")) == "ff ff 01 04 00 00 08 f2"  # position: 2048
    assert asked(b, bytes.fromhex("ff ff 01 04 02 03 02 f3")) == "ff ff 01 04 00 09 03 ee"  # model: 777
    assert asked(b, bytes.fromhex("ff ff fe 06 82 38 02 02 03 3a")) == "ff ff 02 04 00 00 08 f1 ff ff 03 04 00 00 08 f0"
    assert asked(b, bytes.fromhex("ff ff 01 02 01 fa")) == ""  # a bad checksum
    assert asked(b, bytes.fromhex("ff ff 09 02 01 f3")) == ""  # nobody
    assert asked(b, pack(BROADCAST, Instruction.WRITE, bytes([55, 0]))) == ""  # everybody obeys, nobody answers
    assert [b.servos.register(j, "LOCK") for j in b.servos.joints] == [0, 0, 0]


def test_a_silent_servo_ends_a_group_read_unless_they_are_patient():
    for patient, heard in ((False, [1]), (True, [1, 3])):
        b = bench(patient=patient)
        b.servos.power(1, False, 0.0)
        packets = b.ask(pack(BROADCAST, Instruction.SYNC_READ, bytes([56, 2, 1, 2, 3])))
        assert [p.id for p in packets] == heard


def test_a_goal_is_reached_and_reported_with_its_sign():
    b = bench(1)
    b.ask(write(1, 42, *word(1000)) + write(1, 40, 1))
    b.wait(0.05)
    assert b.body.joint_vel[0] < -0.5
    raw = int.from_bytes(b.ask(pack(1, Instruction.READ, bytes([58, 2])))[0].parameters, "little")
    assert raw & 0x8000 and (raw & 0x7FFF) * feetech.TICK == pytest.approx(-b.body.joint_vel[0], rel=0.2)
    b.wait(3.0)
    assert b.body.joint_pos[0] == pytest.approx((1000 - 2048) * feetech.TICK, abs=2e-3)


def test_the_law():
    """15 N m/rad at P = 32, saturating at the torque limit; back-EMF; nothing without torque."""
    b = bench(1)
    b.ask(write(1, 40, 1))
    b.ask(write(1, 42, *word(2048 + 32)))
    b.body.joint_pos[:], b.body.joint_vel[:] = 0.0, 0.0
    bias, kp, kd = b.servos._decide()[:, 0]
    assert kp == pytest.approx(STALL / (128 * feetech.TICK)) and bias == pytest.approx(STALL / 4)
    assert kd == pytest.approx(STALL / (45 / 60 * 2 * np.pi))
    b.ask(write(1, 48, *word(0)))
    assert b.servos._decide()[:2, 0].tolist() == [0.0, 0.0] and b.servos._decide()[2, 0] == pytest.approx(kd)
    b.ask(write(1, 48, *word(250)))
    b.servos._decide()
    assert b.body._limit[0] == pytest.approx(STALL / 4)
    b.ask(write(1, 40, 0))
    assert not b.servos._decide().any()


def test_the_lock_keeps_eeprom_from_lasting():
    b = bench(1)
    for lock, lasts in ((1, False), (0, True)):
        b.ask(write(1, 55, lock) + write(1, 21, 50))
        assert b.servos.register("servo_1", "P_GAIN") == 50
        b.servos.power(0, False, b.time)
        b.servos.power(0, True, b.time)
        assert b.ask(pack(1, Instruction.PING)) == []  # it boots
        b.wait(0.4)
        assert b.servos.register("servo_1", "P_GAIN") == (50 if lasts else 32)
        assert b.servos.register("servo_1", "LOCK") == 1


def test_here_is_the_middle_from_now_on():
    b = bench(1)
    b.body.joint_pos[:] = -0.5
    b.ask(write(1, 40, 128))
    assert b.servos.register("servo_1", "PRESENT_POSITION") == 2048
    raw = b.servos.register("servo_1", "HOMING_OFFSET")
    assert raw == 1 << 11 | round(0.5 / feetech.TICK)  # sign and magnitude, bit 11
    b.ask(write(1, 42, *word(2048)) + write(1, 40, 1))
    b.wait(1.0)
    assert b.body.joint_pos[0] == pytest.approx(-0.5, abs=2e-3)


def test_positions_wrap_within_a_turn():
    b = bench(1)
    b.body.joint_pos[:] = np.pi + 0.1
    b.wait(0.01)
    assert b.servos.register("servo_1", "PRESENT_POSITION") == pytest.approx(0.1 / feetech.TICK, abs=1)


def test_what_cannot_be_written_is_left_alone():
    b = bench(1)
    (answer,) = b.ask(write(1, 56, 1, 2))
    assert answer.instruction == 0 and b.servos.register("servo_1", "PRESENT_POSITION") == 2048
    b.ask(write(1, 3, 1, 2))
    assert b.servos.register("servo_1", "MODEL") == 777
    b.ask(write(1, 8, 0))  # response level: only questions are answered
    assert b.ask(write(1, 21, 40)) == [] and len(b.ask(pack(1, Instruction.READ, bytes([21, 1])))) == 1


def test_a_registered_write_waits_for_action():
    b = bench(2)
    b.ask(pack(1, Instruction.REG_WRITE, bytes([42, *word(2000)])))
    assert b.servos.register("servo_1", "GOAL_POSITION") == 0
    b.ask(pack(BROADCAST, Instruction.ACTION))
    assert [b.servos.register(j, "GOAL_POSITION") for j in b.servos.joints] == [2000, 0]


def test_a_new_id_is_the_one_that_is_listened_to():
    b = bench(1)
    b.ask(write(1, 5, 9))
    assert b.ask(pack(1, Instruction.PING)) == [] and b.ask(pack(9, Instruction.PING))[0].id == 9


def test_overload_leaves_a_fifth_of_the_torque_until_the_goal_is_on_the_other_side():
    b = bench(1)
    b.body._inertia = 1e6  # it does not move
    b.ask(write(1, 42, *word(3000)) + write(1, 40, 1))
    b.wait(1.9)
    assert abs(b.body.joint_torque[0]) == pytest.approx(STALL) and b.servos.register("servo_1", "STATUS") == 0
    b.wait(0.3)
    assert abs(b.body.joint_torque[0]) == pytest.approx(0.2 * STALL)
    (answer,) = b.ask(pack(1, Instruction.PING))
    assert answer.instruction == 0x20
    b.ask(write(1, 42, *word(3500)))
    assert b.servos.register("servo_1", "STATUS") == 0x20
    b.ask(write(1, 42, *word(1000)))
    assert b.servos.register("servo_1", "STATUS") == 0
    assert [e.event for e in b.servos.log] == ["enabled", "overload", "cleared"]


def test_a_hot_servo_switches_off():
    b = bench(1)
    b.ask(write(1, 40, 1))
    b.servos.temperature[0] = 71.0
    b.wait(0.05)
    assert b.servos.register("servo_1", "TORQUE_ENABLE") == 0 and b.servos.register("servo_1", "STATUS") == 4


# -- the driver --------------------------------------------------------------------------------------------------------


def test_the_bus_connects_drives_and_stops():
    b = bench()
    bus = b.connected()
    assert not bus.read(b.time).enabled.any()
    assert [b.servos.register(j, "LOCK") for j in b.servos.joints] == [1, 1, 1]
    bus.enable()
    state = tick(bus, b, command(3, position=0.4, kp=1.0), 300, 0.005)
    assert state.enabled.all() and not state.error.any()
    assert state.position == pytest.approx(0.4, abs=3e-3) and b.body.joint_pos == pytest.approx(0.4, abs=3e-3)
    bus.disable()
    assert not tick(bus, b, None, 3, 0.005).enabled.any()


def test_without_kp_it_only_resists():
    b = bench()
    bus = b.connected()
    bus.enable()
    tick(bus, b, command(3, position=0.4, kp=0.0, kd=1.0), 20, 0.005)
    b.body.joint_vel[:] = 3.0
    tick(bus, b, command(3, position=0.4, kp=0.0, kd=1.0), 100, 0.005)
    assert np.abs(b.body.joint_vel).max() < 0.05 and (b.body.joint_pos > 0.02).all()


def test_the_bus_survives_lost_and_damaged_answers():
    b = bench(faults=("drop:servos/*:0.1", "corrupt:servos/*:0.1"), seed=4)
    bus = b.connected()
    for _ in range(10):
        bus.enable()
        tick(bus, b, command(3, kp=1.0), period=0.005)
    state = tick(bus, b, command(3, position=-0.3, kp=1.0), 300, 0.005)
    assert state.position == pytest.approx(-0.3, abs=5e-3) and (b.time - state.time < 0.05).all()
    assert bus.counters.rejected > 10


def test_a_wrong_model_is_named():
    b = bench(registers={"servo_2": {"MODEL": 1284}})
    with pytest.raises(BusError, match="motor of servo_2 .*register MODEL is 1284, expected 777"):
        b.connected()


def test_a_robot_of_two_kinds_of_servos(tmp_path):
    """One line each, behind one plant; same seed, same bytes."""

    def run() -> str:
        buses = (
            BusSpec("left", "feetech", (MotorSpec("left", MODEL, 1, sign=-1, offset=0.2),), "serial", bitrate=1_000_000,
                    watchdog=feetech.NO_WATCHDOG),
            BusSpec("right", "dynamixel", (MotorSpec("right", "XM430-W350", 1),), "serial", bitrate=1_000_000),
        )  # fmt: skip
        world = open_world(write_model(tmp_path, ARM), "base", buses, IMU, hang=None, seed=3, faults=["drop:left:0.05"])

        class Clock:
            now = staticmethod(lambda: world.time)
            sleep_until = staticmethod(world.advance)

        opened = [open_bus(spec, world.wires[spec.name]) for spec in buses]
        for bus in opened:
            bus.connect(Clock())
            bus.enable()
        for _ in range(200):
            for bus in opened:
                bus.write(command(1, position=0.3, kp=8.0))
            world.advance(world.time + 0.005)
            for bus in opened:
                bus.read(world.time)
        assert world.plant.joint_pos == pytest.approx([-(0.3 - 0.2), 0.3], abs=0.02)
        return world.digest

    assert run() == run()


# -- the maker's SDK ---------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def port() -> Iterator[str]:
    """Three servos on a pseudo-terminal, in a process of their own."""
    pytest.importorskip("scservo_sdk", reason="the maker's SDK (pip install ftservo-python-sdk) is not installed")
    command = [sys.executable, "-m", "drivers.sim.serial_pty", "--model", MODEL, "--count", "3", "--baud", "1000000"]
    with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, text=True) as server:
        assert server.stdout is not None
        yield server.stdout.readline().strip()
        server.terminate()


@pytest.fixture
def sdk(port):
    import scservo_sdk

    serial = scservo_sdk.PortHandler(port)
    assert serial.openPort() and serial.setBaudRate(1_000_000)
    yield scservo_sdk, scservo_sdk.sms_sts(serial)
    serial.closePort()


def heard(call, tries: int = 20):
    """The SDK gives up early, which a busy machine may take."""
    for _ in range(tries):
        *values, result, error = call()
        if result == 0:
            return *values, error
    raise AssertionError(f"no answer in {tries} tries: {result}")


def test_the_sdk_pings_reads_and_writes(sdk):
    _, servos = sdk
    assert heard(lambda: servos.ping(3)) == (777, 0)
    assert servos.ping(77)[1] != 0
    assert heard(lambda: servos.ReadPosSpeed(1)) == (2048, 0, 0)
    assert heard(lambda: servos.unLockEprom(2)) == (0,)
    assert heard(lambda: servos.read1ByteTxRx(2, 55)) == (0, 0)


def test_the_sdk_moves_servos_and_sees_it(sdk):
    api, servos = sdk
    for id in (1, 2, 3):
        heard(lambda id=id: servos.write1ByteTxRx(id, 40, 1))
        assert servos.SyncWritePosEx(id, 2048 - 300 * id, 0, 0)
    assert servos.groupSyncWrite.txPacket() == 0
    present = api.GroupSyncRead(servos, 56, 4)
    for id in (1, 2, 3):
        present.addParam(id)
    for _ in range(300):
        if present.txRxPacket() == 0 and all(present.isAvailable(id, 56, 4)[0] for id in (1, 2, 3)):
            at = [present.getData(id, 56, 2) for id in (1, 2, 3)]
            if all(abs(p - (2048 - 300 * id)) < 10 for id, p in zip((1, 2, 3), at, strict=True)):
                return
    raise AssertionError(at)


def test_the_sdk_packs_what_we_pack():
    api = pytest.importorskip("scservo_sdk")
    sent: list[bytes] = []

    class Port:
        is_using = False

        def clearPort(self) -> None: ...

        def writePort(self, packet: list[int]) -> int:
            sent.append(bytes(packet))
            return len(packet)

        def setPacketTimeout(self, length: int) -> None: ...

    servos = api.sms_sts(Port())
    servos.writeTxOnly(3, 42, 2, [0x34, 0x12])
    servos.portHandler.is_using = False
    servos.syncReadTx(56, 4, [1, 2], 2)
    servos.portHandler.is_using = False
    servos.syncWriteTxOnly(40, 1, [1, 0, 2, 1], 4)
    assert sent == [
        write(3, 42, 0x34, 0x12),
        pack(BROADCAST, Instruction.SYNC_READ, bytes([56, 4, 1, 2])),
        pack(BROADCAST, Instruction.SYNC_WRITE, bytes([40, 1, 1, 0, 2, 1])),
    ]
    assert servos.scs_toscs(-5, 15) == feetech.to_sign_magnitude(np.array(-5))


def test_servos_that_nobody_has_connected_to_are_seen_where_they_are():
    b = bench(3)
    b.body.joint_pos[:] = [-0.5, 0.0, 1.0]
    (observer,) = observers([b.spec], {b.spec.name: b.wire})
    for _ in range(10):
        observer.ask()
        b.wait(0.02)
        observer.look(b.time)
    state = observer.state
    assert (b.time - state.time < 0.05).all() and not state.enabled.any() and observer.remark() == ""
    assert state.position == pytest.approx([-0.5, 0.0, 1.0], abs=0.01)
