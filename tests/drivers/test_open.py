"""The registry: every entry can be loaded, unknown names are refused with what there is, heavy modules stay out."""

from __future__ import annotations

import subprocess
import sys
import uuid
from dataclasses import replace
from pathlib import Path

import pytest
from scripted_can import leg

from drivers.bus import BusError, ImuSpec
from drivers.can_bus import CanBus
from drivers.can_wire import PythonCanWire
from drivers.open import IMUS, PROTOCOLS, load, open_bus, open_codec, open_imu, open_wire

IMU = ImuSpec("hipnuc")


@pytest.mark.parametrize("protocol", PROTOCOLS)
def test_every_protocol_loads(protocol):
    assert callable(load(PROTOCOLS[protocol].bus))
    typical, worst = load(PROTOCOLS[protocol].codec).TICK_BITS
    assert 0 <= typical <= worst


@pytest.mark.parametrize("protocol", IMUS)
def test_every_imu_loads(protocol):
    assert load(IMUS[protocol].parser)().feed(b"") == []


def test_every_wiring_of_every_robot_has_its_protocols(robot):
    for wiring in robot.wirings.values():
        for spec in wiring.bus_specs():
            open_codec(spec)
        assert wiring.imu.protocol in IMUS


def test_a_bus_on_python_can():
    bus = open_bus(leg(interface="virtual", channel=uuid.uuid4().hex))
    assert isinstance(bus, CanBus)
    assert isinstance(bus._wire, PythonCanWire)
    bus.close()


@pytest.mark.parametrize(
    ("spec", "message"),
    [
        (leg(protocol="damaio"), r"bus leg: got protocol 'damaio' \(did you mean 'damiao'\?\), expected one of damiao"),
        (leg(interface="sockatcan"), r"interface 'sockatcan' \(did you mean 'socketcan'\?\), expected one of sim, .*virtual"),
        (leg(interface="socketcan", channel="nocan99"), "bus leg: socketcan nocan99: "),
        (leg(interface="sim", channel="/nothing"), "bus leg: /nothing: No such file or directory; expected a simulated robot"),
        (replace(IMU, interface="sim", channel="/nothing"), "imu: /nothing: No such file or directory"),
        (replace(IMU, protocol="hipnic"), r"imu: got protocol 'hipnic' \(did you mean 'hipnuc'\?\), expected one of hipnuc"),
        (replace(IMU, interface="seriell"), r"imu: got interface 'seriell' \(did you mean 'serial'\?\), expected one of serial, sim"),
    ],
)  # fmt: skip
def test_what_is_unknown_is_refused_with_what_there_is(spec, message):
    with pytest.raises(BusError, match=message):
        (open_imu if isinstance(spec, ImuSpec) else open_bus)(spec)


def test_an_unknown_protocol_has_no_wire_either():
    with pytest.raises(BusError, match="protocol 'x'"):
        open_wire(leg(protocol="x"))


def test_drivers_are_imported_without_their_adapters():
    code = """
import sys
import drivers.bus, drivers.open, drivers.can_bus, drivers.codecs.damiao, drivers.can_wire, drivers.serial_wire
import drivers.imu.serial, drivers.budget
print(sorted({m.partition('.')[0] for m in sys.modules} & {'can', 'serial', 'mujoco', 'torch', 'onnxruntime', 'sim2real'}))
"""
    root = Path(__file__).resolve().parents[2]
    done = subprocess.run([sys.executable, "-c", code], cwd=root, capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
