"""``sim2real motors`` on simulated motors: what it shows is so, and nothing that it sends is a command."""

from __future__ import annotations

import json

import numpy as np
import pytest

from drivers.bus import BusSpec, MotorSpec
from drivers.codecs import damiao
from drivers.codecs.dynamixel_packet import Instruction, Parser
from drivers.sim.serial_line import SerialLineWire
from drivers.sim.wire import SimCanWire
from sim2real.bringup.observe import observers
from sim2real.cli import main
from sim2real.cli.motors import Watch, _table
from sim2real.config import load_robot
from sim2real.types import Sim2realError

WIRINGS = [("bench", "can"), ("g1", "can"), ("g1", "dds"), ("op3", "serial")]


def watch(robot: str, wiring: str = "", *faults: str) -> tuple[Watch, list[dict]]:
    config = load_robot(robot)
    watched = Watch(config, config.wiring(wiring), True, faults)
    return watched, watched.look(0.2)


@pytest.mark.parametrize(("robot", "wiring"), WIRINGS)
def test_every_joint_is_heard_where_it_is(robot, wiring):
    watched, seen = watch(robot, wiring)
    config = load_robot(robot)
    assert sorted(r["joint"] for r in seen) == sorted(config.joint_names)
    assert all(r["error"] == "none" and r["age"] < 0.05 and not r["enabled"] for r in seen)
    plant = watched.world.plant
    truth = dict(zip(plant.joints, zip(plant.joint_pos, plant.joint_vel, strict=True), strict=True))
    for r in seen:  # what it says is up to a question's period old, of limp limbs that swing
        position, velocity = truth[r["joint"]]
        assert r["position"] == pytest.approx(position, abs=0.03 + 0.03 * abs(velocity))


def test_nothing_but_questions_is_sent(monkeypatch):
    sent = []
    send = SimCanWire.send
    monkeypatch.setattr(SimCanWire, "send", lambda self, frames: (sent.append(frames.copy()), send(self, frames)))
    watch("g1", "can", "reboot:left_leg/left_knee_joint=0.05@0.05")
    frames = np.concatenate(sent)
    assert (frames["id"] == damiao.BROADCAST_ID).all() and (frames["data"][:, 2] == damiao.Operation.REFRESH).all()


def test_nothing_but_reads_is_sent_to_servos(monkeypatch):
    sent, write = bytearray(), SerialLineWire.write
    monkeypatch.setattr(SerialLineWire, "write", lambda self, data: (sent.extend(data), write(self, data)))
    watch("op3", "serial", "off:body/r_knee")
    packets = Parser().feed(bytes(sent))
    assert len(packets) > 5 and {p.instruction for p in packets} == {Instruction.SYNC_READ}


def test_a_slow_line_is_asked_again_when_answers_may_be_over():
    motors = tuple(MotorSpec(f"joint_{i}", "XL430-W250", i) for i in range(12))
    wire = Unanswered()
    (observer,) = observers([BusSpec("arm", "dynamixel", motors, bitrate=57600)], {"arm": wire})
    for tick in range(50):
        observer.ask()
        observer.look(tick * 0.02)
    answers = 12 * (35 + 11) * 10 / 57600  # s, without the servos' own delays
    assert 3 <= wire.written <= 1 / answers and observer.remark() == ""


class Unanswered:
    """A serial line on which nobody is."""

    written = 0

    def write(self, data: bytes) -> None:
        self.written += 1

    def read(self) -> bytes:
        return b""


def test_a_dead_motor_is_silent_and_exit_code_1(capsys):
    assert main(["motors", "--robot", "bench", "--sim", "--json", "--fault", "off:arm/elbow_joint"]) == 1
    shoulder, elbow = json.loads(capsys.readouterr().out)
    assert shoulder["error"] == "none" and elbow["error"] == "silent" and elbow["position"] is None


def test_a_motor_that_falls_silent_shows_its_age():
    watched, _ = watch("bench", "can", "off:arm/elbow_joint@0.1")
    elbow = watched.look(0.5)[1]
    assert elbow["age"] > 0.5


def test_the_table(capsys):
    assert main(["motors", "--robot", "bench", "--sim", "--duration", "0.1"]) == 0
    said = capsys.readouterr().out
    assert "shoulder_joint" in said and "elbow_joint" in said and "disabled" in said
    row = {"joint": "a", "position": None, "velocity": None, "torque": None, "temperature": None, "age": None}
    assert _table("t", [row | {"enabled": False, "error": "silent"}], ["x"]).row_count == 1


def test_another_variant_is_said():
    watched, _ = watch("g1", "dds")
    assert watched.observers[0].remark() == "mode_machine 5 (g1_29dof_rev_1_0)"
    config = load_robot("g1")
    (spec,) = config.wiring("dds").bus_specs()
    (observer,) = observers([spec], {spec.name: None})
    assert observer.remark() == "no LowState heard"


def test_motors_that_can_only_be_commanded_are_not_looked_at():
    spec = BusSpec("leg", "recoil", (MotorSpec("knee", "6512", 1),))
    with pytest.raises(Sim2realError, match="no way is known here to ask 'recoil' motors without commanding them"):
        observers([spec], {"leg": None})


def test_hardware_that_is_not_there_is_one_message(capsys):
    assert main(["motors", "--robot", "bench"]) == 2
    assert "can0" in capsys.readouterr().err
