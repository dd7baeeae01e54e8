"""A robot in MuJoCo whose motors are servos: the registry's bus, its law in the plant, watchdog, faults, same bytes."""

from __future__ import annotations

import numpy as np
import pytest
from sim_robots import ARM, ARM_INERTIA, IMU, write_model
from test_dynamixel import command

from drivers.budget import budget
from drivers.bus import BusError, BusSpec, MotorSpec
from drivers.codecs.dynamixel_packet import Instruction, pack, pack_status
from drivers.open import open_bus, open_world
from drivers.sim.serial_world import SerialWorld

LEFT, RIGHT = MotorSpec("left", "XM540-W270", 1, sign=-1, offset=0.2), MotorSpec("right", "XM430-W350", 2)


def line(name: str, *motors: MotorSpec) -> BusSpec:
    return BusSpec(name, "dynamixel", motors, "serial", bitrate=4_000_000)


class Rig:
    """A world and its buses; the clock of both."""

    def __init__(self, folder, *buses: BusSpec, **options):
        buses = buses or (line("arm", LEFT, RIGHT),)
        self.world = open_world(write_model(folder, ARM), "base", buses, IMU, hang=None, **options)
        self.buses = [open_bus(spec, self.world.wires[spec.name]) for spec in buses]
        self.now = lambda: self.world.time
        self.sleep_until = self.world.advance
        for bus in self.buses:
            bus.connect(self)
        for _ in range(2):
            self.tick()

    def tick(self, n: int = 1, **values) -> list:
        """One period of n: a command on every bus (none: polls)."""
        for _ in range(n):
            for bus in self.buses:
                bus.write(command(len(bus.spec.motors), **values)) if values else bus.poll()
            self.world.advance(self.world.time + 0.004)
            states = [bus.read(self.world.time) for bus in self.buses]
        return states

    def enable(self) -> None:
        for bus in self.buses:
            bus.enable()
        assert all(state.enabled.all() for state in self.tick(2, kp=1.0))


def test_the_registry_opens_a_world_of_servos(tmp_path):
    rig = Rig(tmp_path)
    assert isinstance(rig.world, SerialWorld)
    rig.enable()
    (state,) = rig.tick(250, position=0.4, kp=12.0)
    np.testing.assert_allclose(state.position, 0.4, atol=0.01)
    np.testing.assert_allclose(rig.world.plant.joint_pos, [-(0.4 - 0.2), 0.4], atol=0.01)
    assert rig.world.counters()["arm"]["load"] > 0.01


def test_two_lines_share_one_body_and_do_not_disturb_each_other(tmp_path):
    rig = Rig(tmp_path, line("one", LEFT), line("two", RIGHT))
    rig.enable()
    for _ in range(200):
        rig.buses[0].write(command(1, position=0.5, kp=40.0))
        rig.buses[1].write(command(1, position=-0.5, kp=12.0))
        rig.world.advance(rig.world.time + 0.004)
        states = [bus.read(rig.world.time) for bus in rig.buses]
    assert states[0].position[0] == pytest.approx(0.5, abs=0.01)
    assert states[1].position[0] == pytest.approx(-0.5, abs=0.01)
    rig.buses[0].disable()
    rig.world.advance(rig.world.time + 0.02)
    assert [bool(b.servos.register(j, "TORQUE_ENABLE")) for b, j in zip(rig.world.lines, ("left", "right"), strict=True)] == [
        False, True,
    ]  # fmt: skip


def test_the_law_acts_on_the_plant_in_every_substep(tmp_path):
    """From rest, kp (q* - q) - back-EMF accelerates the known inertia."""
    rig = Rig(tmp_path)
    rig.enable()
    start = rig.world.plant.joint_pos[1]
    rig.buses[0].write(command(2, position=start + 0.05, kp=10.0))
    began = rig.world.time
    rig.world.advance(began + 0.012)
    law = rig.world.motors.buses[0]._decide()[:, 1]
    t, q, v = 0.0, start, 0.0
    arrived = 250e-6 + (14 + 2 * 7) * 10 / 4e6
    while t < 0.012 - arrived:
        v += 1e-5 * (law[0] - law[1] * q - law[2] * v) / ARM_INERTIA
        q += 1e-5 * v
        t += 1e-5
    assert rig.world.plant.joint_pos[1] - start == pytest.approx(q - start, rel=0.1)


def test_a_host_that_falls_silent_is_noticed_by_the_servos(tmp_path):
    rig = Rig(tmp_path)
    rig.enable()
    rig.tick(5, position=0.3, kp=5.0)
    last = max(rig.world.last_command_times().values())
    rig.world.advance(rig.world.time + 0.2)
    trips = [e for e in rig.world.motor_log if e.event == "watchdog"]
    assert {e.joint for e in trips} == {"left", "right"}
    assert all(0.06 < e.time - last < 0.1 for e in trips)


def test_faults_find_their_line_and_strangers_are_refused(tmp_path):
    rig = Rig(tmp_path, line("one", LEFT), line("two", RIGHT))
    rig.world.inject("off:two/right")
    states = rig.tick(3)
    assert states[0].time[0] == rig.world.time and states[1].time[0] < rig.world.time - 0.007
    with pytest.raises(BusError, match="nothing here is 'three/.', expected one of the buses one, two, imu"):
        rig.world.inject("drop:three")
    with pytest.raises(BusError, match="got joints .*knee"):
        Rig(tmp_path, registers={"knee": {"LED": 1}})


def test_the_same_seed_gives_the_same_bytes(tmp_path):
    def run(seed: int) -> str:
        rig = Rig(tmp_path, seed=seed, faults=("drop:0.05", "corrupt:0.02"))
        rig.enable()
        rig.tick(50, position=0.3, kp=5.0)
        return rig.world.digest

    assert run(1) == run(1)
    assert run(1) != run(2)


def test_a_port_carries_bytes_to_another_process(tmp_path):
    rig = Rig(tmp_path)
    (port,) = rig.world.ports.values()

    assert port.hear(pack(2, Instruction.PING), rig.world.time) == b""
    rig.world.advance(rig.world.time + 0.004)
    assert port.give(rig.world.time) == pack_status(2, 0, (1020).to_bytes(2, "little") + bytes([45]))


def test_the_budget_counts_the_packets_around_all_servos():
    """20 servos at 4 Mbit/s: (14 + 20 * 7) + (14 + 20) bytes out and 20 * 25 in are 1.72 ms."""
    spec = line("body", *(MotorSpec(f"j{i}", "XM430-W350", i) for i in range(1, 21)))
    b = budget(spec, 100.0)
    assert b.bits == 10 * (14 + 20 * 7 + 14 + 20 + 20 * 25)
    assert b.rate_max == pytest.approx(0.7 * 4e6 / b.bits)
