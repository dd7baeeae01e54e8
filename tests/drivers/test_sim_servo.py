"""Emulated Dynamixel servos: control table, watchdog, errors, turns, order and time of answers; dynamixel-sdk on a pty."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from sim_servos import Bench

from drivers.bus import BusError
from drivers.codecs import dynamixel
from drivers.codecs.dynamixel import ALERT, REGISTERS, StatusError
from drivers.codecs.dynamixel_packet import (
    BROADCAST,
    Instruction,
    pack,
    pack_bulk_read,
    pack_bulk_write,
    pack_read,
    pack_status,
    pack_sync_read,
    pack_write,
)
from drivers.sim.serial_pty import bus_of

ROOT = Path(__file__).resolve().parents[2]
TICK = 2 * np.pi / 4096


def write(bench: Bench, register: str, value: int, id: int = 1) -> int:
    """Write a register; returns the error byte of the answer."""
    r = REGISTERS[register]
    raw = (value & (1 << 8 * r.size) - 1).to_bytes(r.size, "little")
    (answer,) = bench.ask(pack_write(id, r.address, raw))
    return answer.parameters[0]


def read(bench: Bench, register: str, id: int = 1) -> int:
    r = REGISTERS[register]
    (answer,) = bench.ask(pack_read(id, r.address, r.size))
    return int.from_bytes(answer.parameters[1:], "little", signed=r.low < 0)


def ids(answers) -> list[int]:
    return [a.id for a in answers]


# -- control table ---------------------------------------------------------------------------------------------------


def test_ping_tells_model_and_firmware():
    (answer,) = Bench(2).ask(pack(2, Instruction.PING))
    assert answer.raw == pack_status(2, 0, (1020).to_bytes(2, "little") + bytes([45]))


def test_everybody_answers_a_broadcast_ping():
    assert ids(Bench(3).ask(pack(BROADCAST, Instruction.PING))) == [1, 2, 3]


def test_eeprom_is_locked_while_torque_is_on():
    bench = Bench(1)
    assert write(bench, "RETURN_DELAY", 5) == 0
    write(bench, "TORQUE_ENABLE", 1)
    assert write(bench, "RETURN_DELAY", 6) == StatusError.ACCESS
    assert write(bench, "INDIRECT", 0) == StatusError.ACCESS
    write(bench, "TORQUE_ENABLE", 0)
    assert write(bench, "RETURN_DELAY", 6) == 0 and read(bench, "RETURN_DELAY") == 6


@pytest.mark.parametrize(
    "register, value, error",
    [
        ("OPERATING_MODE", 17, StatusError.DATA_RANGE),
        ("GOAL_POSITION", -1, StatusError.DATA_RANGE),
        ("GOAL_POSITION", 4096, StatusError.DATA_RANGE),
        ("POSITION_P_GAIN", 16384, StatusError.DATA_RANGE),
        ("PRESENT_POSITION", 0, StatusError.ACCESS),
        ("HARDWARE_ERROR", 0, StatusError.ACCESS),
        ("GOAL_POSITION", 4095, StatusError.NONE),
    ],
)
def test_what_cannot_be_written_is_refused_and_stays(register, value, error):
    bench = Bench(1)
    before = read(bench, register)
    assert write(bench, register, value) == error
    assert read(bench, register) == (before if error else value)


def test_a_write_that_is_refused_in_part_is_refused_whole():
    bench = Bench(1)
    (answer,) = bench.ask(pack_write(1, 80, np.array([1, 2, 20000], "<u2").tobytes()))
    assert answer.parameters[0] == StatusError.DATA_RANGE and read(bench, "POSITION_D_GAIN") == 0


def test_unknown_instructions_and_short_requests_are_answered_with_an_error():
    bench = Bench(1)
    assert bench.ask(pack(1, 0x42))[0].parameters == bytes([StatusError.INSTRUCTION])
    assert bench.ask(pack(1, Instruction.READ, b"ab"))[0].parameters == bytes([StatusError.DATA_LENGTH])
    assert bench.ask(pack_read(1, 250, 10))[0].parameters == bytes([StatusError.DATA_RANGE])


def test_indirect_registers_stand_for_others_both_ways():
    bench = Bench(1)
    write(bench, "INDIRECT", dynamixel.INDIRECT_VALUE)
    (answer,) = bench.ask(pack_write(1, dynamixel.GOAL_AT, (77).to_bytes(2, "little") + bytes([1, 2, 0, 0])))
    assert answer.parameters[0] == 0
    assert read(bench, "POSITION_P_GAIN") == 77 and read(bench, "GOAL_POSITION") == 0x201
    (answer,) = bench.ask(pack_read(1, dynamixel.STATE_AT, dynamixel.STATE_SIZE))
    item = np.frombuffer(answer.parameters[1:], dynamixel.STATE_ITEM)[0]
    assert item["position"] == 2048 and item["temperature"] == 25


def test_reg_write_waits_for_action():
    bench = Bench(2)
    for id in (1, 2):
        bench.ask(pack(id, Instruction.REG_WRITE, bytes([116, 0, 0, 1, 0, 0])))
    assert read(bench, "GOAL_POSITION") == 0
    assert bench.ask(pack(BROADCAST, Instruction.ACTION)) == []
    assert (read(bench, "GOAL_POSITION"), read(bench, "GOAL_POSITION", 2)) == (256, 256)


@pytest.mark.parametrize("level, answers", [(0, (1, 0, 0)), (1, (1, 1, 0)), (2, (1, 1, 1))])
def test_status_return_level_says_what_is_answered(level, answers):
    bench = Bench(1, registers={"servo_1": {"STATUS_RETURN_LEVEL": level}})
    said = [
        len(bench.ask(raw))
        for raw in (
            pack(1, Instruction.PING),
            pack_read(1, 0, 2),
            pack_write(1, 65, b"\1"),
        )
    ]
    assert tuple(said) == answers


def test_a_changed_id_is_where_it_listens_from_then_on():
    bench = Bench(1)
    assert write(bench, "ID", 9) == 0
    assert ids(bench.ask(pack(1, Instruction.PING))) == []
    assert ids(bench.ask(pack(9, Instruction.PING))) == [9]


def test_registers_of_joints_that_are_not_there_are_refused():
    with pytest.raises(BusError, match="got joint 'knee', expected one of servo_1"):
        Bench(1, registers={"knee": {"LED": 1}})


# -- motion, watchdog, errors ----------------------------------------------------------------------------------------


def test_switching_on_holds_where_it_stands():
    bench = Bench(1)
    write(bench, "GOAL_POSITION", 100)
    write(bench, "TORQUE_ENABLE", 1)
    assert read(bench, "GOAL_POSITION") == 2048
    bench.wait(0.5)
    assert read(bench, "PRESENT_POSITION") == 2048


@pytest.mark.parametrize(
    "mode, register, value, moved",
    [(3, "GOAL_POSITION", 3000, 1), (4, "GOAL_POSITION", -5000, -1), (0, "GOAL_CURRENT", 50, 1), (0, "GOAL_CURRENT", -50, -1),
     (1, "GOAL_VELOCITY", 50, 1), (16, "GOAL_PWM", -100, -1)],
)  # fmt: skip
def test_operating_modes_move_the_shaft_their_way(mode, register, value, moved):
    bench = Bench(1, registers={"servo_1": {"OPERATING_MODE": mode}})
    write(bench, "TORQUE_ENABLE", 1)
    write(bench, register, value)
    bench.wait(0.05)
    assert np.sign(bench.body.joint_vel[0]) == moved
    if register == "GOAL_CURRENT":
        assert bench.body.joint_torque[0] == pytest.approx(value * 0.00269 * 4.1 / 2.3)


def test_torque_is_duty_cycle_less_back_emf():
    """800/128 * 100 ticks of 885 at a stall torque of 4.1 N m, and 46 rpm without load."""
    bench = Bench(1)
    write(bench, "TORQUE_ENABLE", 1)
    write(bench, "GOAL_POSITION", 2148)
    bias, kp, kd = bench.servos._decide()[:, 0]
    assert bias - kp * 0.0 == pytest.approx(800 / 128 * 100 / 885 * 4.1)
    assert kd == pytest.approx(4.1 / (46 / 60 * 2 * np.pi))


def test_the_watchdog_stops_and_locks_goals_until_it_is_reset():
    bench = Bench(2)
    write(bench, "TORQUE_ENABLE", 1)
    write(bench, "BUS_WATCHDOG", 3)
    write(bench, "GOAL_POSITION", 4000)
    bench.wait(0.8)
    where = read(bench, "PRESENT_POSITION")
    assert 2048 < where < 3900 and abs(read(bench, "GOAL_POSITION") - where) < 10
    assert read(bench, "BUS_WATCHDOG") == 255
    assert write(bench, "GOAL_POSITION", 4000) == StatusError.DATA_RANGE
    assert read(bench, "TORQUE_ENABLE") == 1, "it stops and holds, it does not let go"
    assert write(bench, "BUS_WATCHDOG", 0) == 0 and write(bench, "GOAL_POSITION", 4000) == 0


def test_traffic_for_another_servo_feeds_the_watchdog():
    bench = Bench(2)
    write(bench, "TORQUE_ENABLE", 1)
    write(bench, "BUS_WATCHDOG", 3)
    for _ in range(10):
        bench.ask(pack(2, Instruction.PING), 0.03)
    assert read(bench, "BUS_WATCHDOG") == 3
    bench.wait(0.07)
    assert read(bench, "BUS_WATCHDOG") == 255


def test_a_shutdown_error_takes_torque_off_until_a_reboot():
    bench = Bench(1)
    write(bench, "TORQUE_ENABLE", 1)
    bench.servos.fail("servo_1", 0x20, bench.time)
    assert read(bench, "TORQUE_ENABLE") == 0 and read(bench, "HARDWARE_ERROR") == 0x20
    assert write(bench, "TORQUE_ENABLE", 1) == StatusError.RESULT_FAIL | ALERT
    assert bench.ask(pack(1, Instruction.REBOOT))[0].parameters[0] == ALERT
    assert bench.ask(pack(1, Instruction.PING)) == [], "it is booting"
    bench.wait(0.4)
    assert read(bench, "HARDWARE_ERROR") == 0 and write(bench, "TORQUE_ENABLE", 1) == 0


def test_an_error_that_is_not_in_shutdown_is_only_told():
    bench = Bench(1, registers={"servo_1": {"SHUTDOWN": 0x20}})
    write(bench, "TORQUE_ENABLE", 1)
    bench.servos.fail("servo_1", 0x01, bench.time)
    assert read(bench, "TORQUE_ENABLE") == 1
    assert bench.ask(pack(1, Instruction.PING))[0].parameters[0] == ALERT


def test_a_servo_that_stalls_overheats():
    bench = Bench(1, registers={"servo_1": {"TEMPERATURE_LIMIT": 40}})
    write(bench, "TORQUE_ENABLE", 1)
    bench.body.step = lambda timestep: setattr(bench.body, "joint_torque", np.array([3.0]))
    bench.wait(8.0)
    assert [e.event for e in bench.servos.log][-2:] == ["overheating", "shut down"]
    assert read(bench, "PRESENT_TEMPERATURE") > 40


def test_turns_do_not_survive_power_and_can_be_cleared():
    bench = Bench(1, registers={"servo_1": {"OPERATING_MODE": 4}})
    bench.body.joint_pos[:] = 5000 * TICK
    bench.wait(0.002)
    assert read(bench, "PRESENT_POSITION") == 7048
    bench.servos.power(0, False, bench.time)
    assert bench.ask(pack(1, Instruction.PING)) == []
    bench.servos.power(0, True, bench.time)
    bench.wait(0.4)
    assert read(bench, "PRESENT_POSITION") == 7048 - 4096
    bench.body.joint_pos[:] += 4096 * TICK
    bench.wait(0.002)
    clear = pack(1, Instruction.CLEAR, bytes([0x01, 0x44, 0x58, 0x4C, 0x22]))
    assert bench.ask(clear)[0].parameters == b"\0" and read(bench, "PRESENT_POSITION") == 7048 - 4096
    write(bench, "TORQUE_ENABLE", 1)
    assert bench.ask(clear)[0].parameters == bytes([StatusError.RESULT_FAIL])


# -- order and time on the line --------------------------------------------------------------------------------------


def test_answers_come_in_the_order_of_the_request():
    bench = Bench(4)
    assert ids(bench.ask(pack_sync_read(bytes([3, 1, 4]), 132, 4))) == [3, 1, 4]
    bulk = bench.ask(pack_bulk_read([(2, 144, 2), (1, 146, 1)]))
    assert [(a.id, a.parameters[1:]) for a in bulk] == [(2, bytes([120, 0])), (1, bytes([25]))]
    assert bench.ask(pack_bulk_write([(2, 65, b"\1"), (3, 116, bytes([9, 0, 0, 0]))])) == []
    assert read(bench, "LED", 2) == 1 and read(bench, "GOAL_POSITION", 3) == 9


@pytest.mark.parametrize("patient, answer", [(False, [1]), (True, [1, 3])])
def test_those_behind_a_silent_servo_wait_for_it(patient, answer):
    bench = Bench(3, faults=("off:servos/servo_2",), patient=patient)
    assert ids(bench.ask(pack_sync_read(bytes([1, 2, 3]), 132, 4))) == answer


@pytest.mark.parametrize("delay", [0, 250])
def test_the_time_of_every_byte(delay):
    """10 bits a byte; the adapter either way; each servo's gap and return delay (in 2 us) behind the one before."""
    bench = Bench(2, registers={j: {"RETURN_DELAY": delay} for j in ("servo_1", "servo_2")}, latency=300e-6, gap=20e-6)
    request = pack_sync_read(bytes([1, 2]), 132, 4)
    byte = 10 / 4e6
    first = 300e-6 + len(request) * byte + 20e-6 + delay * 2e-6 + 15 * byte + 300e-6
    second = first + 20e-6 + delay * 2e-6 + 15 * byte
    bench.wire.write(request)
    bench.sleep_until(first - byte / 2)
    assert len(bench.wire.read()) == 14
    bench.sleep_until(first + byte / 2)
    assert len(bench.wire.read()) == 1
    bench.sleep_until(second - byte / 2)
    assert len(bench.wire.read()) == 14
    bench.sleep_until(second + byte / 2)
    assert len(bench.wire.read()) == 1


def test_who_speaks_while_another_does_garbles_both():
    bench = Bench(2)
    bench.wire.write(pack_sync_read(bytes([1, 2]), 132, 4))
    bench.wait(0.00004)
    bench.wire.write(pack_write(1, 65, b"\1"))
    bench.wait(0.01)
    assert len(bench._parser.feed(bench.wire.read())) < 2
    assert bench.line.traffic.collisions > 0 and read(bench, "LED") == 0


@pytest.mark.parametrize(
    "fault, heard",
    [("drop:servos/servo_1", []), ("corrupt:servos/servo_1", []), ("drop", []), ("corrupt", []),
     ("duplicate:servos/servo_1", [1, 1]), ("delay:servos/servo_1=0.001", [1]), ("drop:servos/servo_2", [1])],
)  # fmt: skip
def test_faults_befall_whom_they_name(fault, heard):
    bench = Bench(2, faults=(fault,))
    answers = bench.ask(pack(1, Instruction.PING))
    assert ids(answers) == heard


@pytest.mark.parametrize("kind", ["garbage", "wrong", "stuck"])
def test_lies_have_a_good_crc(kind):
    bench = Bench(1, faults=(f"{kind}:servos/servo_1@0.1",))
    truth = bench.ask(pack_read(1, 128, 8))[0].parameters
    bench.sleep_until(0.1)
    if kind == "stuck":
        bench.ask(pack_read(1, 128, 8))
        bench.body.joint_pos[:] = 1.0
        bench.wait(0.002)
        assert bench.ask(pack_read(1, 128, 8))[0].parameters == truth
    else:
        assert bench.ask(pack_read(1, 128, 8))[0].parameters != truth


def test_a_reboot_fault_takes_power_away_for_a_while():
    bench = Bench(1, faults=("reboot:servos/servo_1=0.2@0.1",))
    write(bench, "TORQUE_ENABLE", 1)
    bench.sleep_until(0.15)
    assert bench.ask(pack(1, Instruction.PING)) == []
    bench.sleep_until(0.7)
    assert read(bench, "TORQUE_ENABLE") == 0
    assert [e.event for e in bench.servos.log] == ["enabled", "powered off", "powered on"]


# -- the maker's own software ----------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def port() -> Iterator[str]:
    """Four servos on a pseudo-terminal, in a process of their own."""
    pytest.importorskip("dynamixel_sdk")
    command = [sys.executable, "-m", "drivers.sim.serial_pty", "--count", "4"]
    with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, text=True) as server:
        assert server.stdout is not None
        yield server.stdout.readline().strip()
        server.terminate()


@pytest.fixture
def sdk(port):
    import dynamixel_sdk

    serial = dynamixel_sdk.PortHandler(port)
    assert serial.openPort() and serial.setBaudRate(4_000_000)
    yield dynamixel_sdk, serial, dynamixel_sdk.PacketHandler(2.0)
    serial.closePort()


def until_heard(call, tries: int = 20):
    """The SDK gives up after 34 ms, which a busy machine may take."""
    for _ in range(tries):
        *values, result, error = call()
        if result == 0:
            return *values, error
    raise AssertionError(f"no answer in {tries} tries: {result}")


def heard_fast(group) -> bool:
    """Taking a late answer of another servo for the fast one, the SDK stumbles."""
    try:
        return group.fastSyncRead() == 0
    except IndexError:
        return False


def test_sdk_pings_reads_and_writes(sdk):
    _, serial, packets = sdk
    for id in (1, 4):
        assert until_heard(lambda id=id: packets.ping(serial, id)) == (1020, 0)
    assert until_heard(lambda: packets.read4ByteTxRx(serial, 1, 132)) == (2048, 0)
    assert until_heard(lambda: packets.write4ByteTxRx(serial, 1, 116, 3000)) == (0,)
    assert until_heard(lambda: packets.read4ByteTxRx(serial, 1, 116)) == (3000, 0)
    assert until_heard(lambda: packets.write1ByteTxRx(serial, 1, 11, 99)) == (StatusError.DATA_RANGE,)
    assert packets.ping(serial, 77)[1] != 0, "nobody there"


def test_sdk_moves_servos_with_sync_write_and_sees_it_with_sync_read(sdk):
    api, serial, packets = sdk
    for id in (1, 2, 3, 4):
        until_heard(lambda id=id: packets.write1ByteTxRx(serial, id, 64, 1))
    goals, present = api.GroupSyncWrite(serial, packets, 116, 4), api.GroupSyncRead(serial, packets, 126, 10)
    for id in (1, 2, 3, 4):
        goals.addParam(id, list((2048 + 100 * id).to_bytes(4, "little")))
        present.addParam(id)
    assert goals.txPacket() == 0
    for _ in range(200):
        if present.txRxPacket() == 0 and all(
            abs(present.getData(id, 132, 4) - (2048 + 100 * id)) < 20 for id in (1, 2, 3, 4)
        ):
            break
    else:
        raise AssertionError([present.getData(id, 132, 4) for id in (1, 2, 3, 4)])
    fast = api.GroupSyncRead(serial, packets, 132, 4)
    for id in (1, 2, 3, 4):
        fast.addParam(id)
    assert any(heard_fast(fast) for _ in range(20))
    assert [abs(fast.getData(id, 132, 4) - 2048 - 100 * id) < 20 for id in (1, 2, 3, 4)] == [True] * 4


def test_sdk_reads_in_bulk_and_reboots(sdk):
    api, serial, packets = sdk
    bulk = api.GroupBulkRead(serial, packets)
    bulk.addParam(1, 144, 2)
    bulk.addParam(2, 146, 1)
    assert any(bulk.txRxPacket() == 0 for _ in range(20))
    assert (bulk.getData(1, 144, 2), bulk.getData(2, 146, 1)) == (120, 25)
    until_heard(lambda: packets.write2ByteTxRx(serial, 2, 84, 123))
    packets.reboot(serial, 2)
    assert until_heard(lambda: packets.read2ByteTxRx(serial, 2, 84), tries=60) == (800, 0)


def test_the_bus_drives_servos_over_a_real_serial_port(port):
    """The wire of a deploy, PySerialWire, on the same pseudo-terminal."""
    import time

    from test_dynamixel import command

    from drivers.codecs.dynamixel import DynamixelCodec
    from drivers.serial_bus import SerialBus
    from drivers.serial_wire import PySerialWire

    class Monotonic:
        now = staticmethod(time.monotonic)

        @staticmethod
        def sleep_until(due: float) -> None:
            time.sleep(max(0.0, due - time.monotonic()))

    clock, spec = Monotonic(), bus_of("XM430-W350", 4)
    bus = SerialBus(spec, DynamixelCodec(spec), PySerialWire(port, 4_000_000))
    try:
        bus.connect(clock)
        end = clock.now() + 5.0
        while clock.now() < end:
            state = bus.read(clock.now())
            if not state.enabled.all():
                bus.enable()
            bus.write(command(4, position=0.3, kp=15.0))
            clock.sleep_until(clock.now() + 0.01)
            if state.enabled.all() and np.abs(state.position - 0.3).max() < 0.02:
                break
        else:
            raise AssertionError(f"{state} {bus.counters}")
        bus.disable()
    finally:
        bus.close()
