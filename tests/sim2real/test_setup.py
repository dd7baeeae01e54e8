"""``sim2real setup``: new simulated motors become those of the wiring, over their wires, and still are after a power cycle."""

from __future__ import annotations

import pytest
import yaml
from test_scan import rig

from drivers.bus import BusSpec, MotorSpec
from drivers.codecs import feetech
from sim2real.bringup.setup import Bench, load_list
from sim2real.cli import main
from sim2real.cli.setup import Bag
from sim2real.config import load_robot
from sim2real.robot import open_robot
from sim2real.types import Sim2realError

RIGS = {
    "damiao": ("DM4310", 1_000_000),
    "robstride": ("RS02", 1_000_000),
    "dynamixel": ("XM430-W350", 1_000_000),
    "feetech": ("STS3215-12V", 500_000),
}
SERIAL = {"dynamixel": 57_600, "feetech": 1_000_000}  # no serial numbers; bit/s of a new one


@pytest.fixture(autouse=True)
def elsewhere(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


def robot(tmp_path, protocol: str):
    path = rig(tmp_path, protocol, *RIGS[protocol])
    if protocol == "damiao":
        document = yaml.safe_load(open(path))
        for motor in document["wirings"]["can"]["buses"][0]["motors"]:
            motor["feedback_id"] = motor["id"] + 0x10
        open(path, "w").write(yaml.safe_dump(document))
    return load_robot(path)


def bag_of(tmp_path, protocol: str = "damiao") -> tuple[Bag, BusSpec]:
    config = robot(tmp_path, protocol)
    return Bag(config, config.wiring()), config.wiring().bus_specs()[0]


@pytest.mark.parametrize("protocol", RIGS)
def test_new_motors_become_those_of_the_wiring_and_the_robot_connects(protocol, tmp_path):
    config = robot(tmp_path, protocol)
    bag = Bag(config, config.wiring())
    (spec,) = config.wiring().bus_specs()
    records = [bag.bench(spec, motor).set_up(motor) for motor in spec.motors]
    assert [r.id for r in records] == [3, 5] and len({r.found_id for r in records}) == 1
    assert protocol in SERIAL or len({r.fingerprint for r in records}) == 2
    assert records[0].found_bitrate == SERIAL.get(protocol, spec.bitrate)
    for motor in spec.motors:
        bag._power(spec, motor.joint, True)
    bag.clock.sleep_until(bag.clock.now() + 1.0)
    bag.world.plant.reset([0.0, 0.0])
    whole = open_robot(config, config.wiring(), {**bag.world.wires, "imu": bag.world.imu_wire})
    whole.connect(bag.clock)  # the production bus, with all that it demands
    assert whole.buses[0].fingerprints() == [r.fingerprint for r in records]


def test_nothing_ever_had_torque(tmp_path):
    bag, spec = bag_of(tmp_path)
    bag.bench(spec, spec.motors[0]).set_up(spec.motors[0])
    assert {e.event for e in bag.world.motor_log} <= {"powered on", "powered off"}


def test_a_feetech_servo_is_locked_again_at_its_new_bit_rate(tmp_path):
    """What it was told afterwards does not outlive its power."""
    bag, spec = bag_of(tmp_path, "feetech")
    (motor, _), (line,) = spec.motors, bag.world.lines
    record = bag.bench(spec, motor).set_up(motor)
    servos = line.servos
    held = {name: servos.register(motor.joint, name) for name in ("ID", "BAUD", "RETURN_DELAY", "LOCK", "POSITION_MAX")}
    assert held == {"ID": 3, "BAUD": 1, "RETURN_DELAY": 0, "LOCK": 1, "POSITION_MAX": 4095}
    assert record.fingerprint == "MODEL 777" and record.settings["ID"] == 3
    bag.world.wires[spec.name].write(feetech.pack(3, feetech.Instruction.WRITE, bytes([5, 9])))
    bag.clock.sleep_until(bag.clock.now() + 0.1)
    assert servos.register(motor.joint, "ID") == 9
    for on in (False, True):
        bag._power(spec, motor.joint, on)
    assert servos.register(motor.joint, "ID") == 3


def test_the_command_writes_a_list_and_goes_on_from_it(tmp_path, capsys):
    config = robot(tmp_path, "damiao")
    argv = ["setup", "--robot", str(config.path), "--sim"]
    assert main([*argv, "--joint", "elbow_joint"]) == 0
    path = tmp_path / "bringup" / "bench-can-sim.motors.yaml"
    assert [m.joint for m in load_list(path).motors] == ["elbow_joint"]
    assert main(argv) == 0
    said = capsys.readouterr().out
    assert said.count("elbow_joint: arm/0x5") == 1 and "2 motors set up" in said
    assert {m.joint: m.fingerprint for m in load_list(path).motors} == {
        "shoulder_joint": "SN 1001",
        "elbow_joint": "SN 1002",
    }


def refusal(bench: Bench, motor: MotorSpec) -> str:
    with pytest.raises(Sim2realError) as refused:
        bench.set_up(motor)
    return str(refused.value)


def test_two_motors_at_once_are_refused(tmp_path):
    bag, spec = bag_of(tmp_path)
    bench = bag.bench(spec, spec.motors[0])
    bag.world.motors._flash[1]["ESC_ID"] = 9
    bag._power(spec, "elbow_joint", True)
    assert "got motors 0x1, 0x9, expected one" in refusal(bench, spec.motors[0])


def test_an_empty_bus_says_what_was_tried(tmp_path):
    bag, spec = bag_of(tmp_path)
    bench = bag.bench(spec, spec.motors[0])
    bag._power(spec, "shoulder_joint", False)
    assert "nobody answers at 1000000, 500000, 250000, 125000 bit/s" in refusal(bench, spec.motors[0])


def test_another_model_is_refused(tmp_path):
    bag, spec = bag_of(tmp_path)
    bag.world.motors._flash[0]["TMAX"] = 40.0
    assert "shoulder_joint: got a motor of no known model, expected DM4310" in refusal(
        bag.bench(spec, spec.motors[0]), spec.motors[0]
    )


def test_what_a_motor_does_not_keep_is_named(tmp_path):
    bag, spec = bag_of(tmp_path)
    bench = bag.bench(spec, spec.motors[0])
    cycle = bench.cycle_power
    bench.cycle_power = lambda: (bag.world.motors._flash[0].update(TIMEOUT=0), cycle())  # a worn-out flash
    assert "shoulder_joint: TIMEOUT is 0 after its power was off, expected 1600" in refusal(bench, spec.motors[0])


def test_a_shaft_that_nobody_turns_is_not_confirmed(tmp_path):
    bag, spec = bag_of(tmp_path)
    bag.world.plant.reset([0.0, 0.0])
    bench = bag.bench(spec, spec.motors[0])
    bench.turn, bench.patience = (lambda on: None), 1.0
    assert "shoulder_joint: its shaft did not turn within 1 s" in refusal(bench, spec.motors[0])


def test_a_protocol_without_such_frames_is_refused(tmp_path, capsys):
    path = rig(tmp_path, "recoil", "6512", 1_000_000)
    assert main(["setup", "--robot", path, "--sim"]) == 2
    assert "no frame sets up 'recoil' motors" in capsys.readouterr().err
