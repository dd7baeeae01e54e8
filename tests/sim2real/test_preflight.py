"""What is demanded of a real robot before it may be armed: each demand fails by name, and no motor was ever driven.

The robots are simulated down to their bytes, behind the same wires, buses and codecs as real ones.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest

from drivers.codecs.moteus import HomeState
from drivers.open import open_world
from drivers.sim.moteus import FIRST_SERIAL
from sim2real.calibration import Calibration, MotorCalibration, load_calibration
from sim2real.clock import SimClock
from sim2real.config import RobotConfig, load_robot
from sim2real.preflight import Preflight
from sim2real.robot import open_robot
from sim2real.types import Sim2realError

HARMLESS = {"enabled", "disabled", "watchdog", "cleared", "limp", "powered off", "powered on"}


@dataclass
class Rig:
    """A simulated robot in the place of a real one."""

    preflight: Preflight
    world: Any
    told: list[str]

    def refusal(self) -> str:
        with pytest.raises(Sim2realError) as refused:
            self.preflight.run()
        self.unmoved()
        return str(refused.value)

    def unmoved(self) -> None:
        assert {e.event for e in self.world.motor_log} <= HARMLESS
        assert not self.world.motors.enabled.any()


def rig(name: str | RobotConfig = "bench", wiring: str = "", calibration: Calibration | None = None, **options) -> Rig:
    config = name if isinstance(name, RobotConfig) else load_robot(name)
    wiring = wiring or config.default_wiring
    wired = config.wiring(wiring)
    home = dict(zip(config.joint_names, config.home_pos, strict=True))
    world = open_world(
        config.model_path, config.base, wired.bus_specs(), wired.imu_spec(), **{"joint_pos": home} | options
    )
    world.advance(0.1)
    calibration = calibration or measured(config, wiring)
    wired = calibration.applied_to(wired)
    robot = open_robot(config, wired, {**world.wires, "imu": world.imu_wire})
    told: list[str] = []
    clock = SimClock(world.advance, lambda: world.time)
    return Rig(Preflight(config, wiring, wired, robot, clock, calibration, tell=told.append), world, told)


def measured(config: RobotConfig, wiring: str, first: int = 1001) -> Calibration:
    """The calibration that the twin has."""
    joints = {j.name: j.position for j in config.joints}
    specs = [(b, m) for b in config.wiring(wiring).bus_specs() for m in b.motors]
    return Calibration(robot=config.name, wiring=wiring, checked=True, motors=[
        MotorCalibration(joint=m.joint, bus=b.name, id=m.id, fingerprint=f"SN {first + i}", sign=m.sign, offset=m.offset,
                         position=joints[m.joint], span=joints[m.joint][1] - joints[m.joint][0])
        for i, (b, m) in enumerate(specs)])  # fmt: skip


def changed(calibration: Calibration, of: str, **values) -> Calibration:
    motors = [m.model_copy(update=values) if m.joint == of else m for m in calibration.motors]
    return calibration.model_copy(update={"motors": motors})


BENCH = measured(load_robot("bench"), "can")


@pytest.mark.parametrize("name", ["bench", "g1"])
def test_a_robot_with_which_all_is_well_is_ready_and_every_watchdog_was_seen_to_trip(name):
    r = rig(name)
    r.preflight.run()
    r.unmoved()
    tripped = [e.joint for e in r.world.motor_log if e.event == "watchdog"]
    assert sorted(tripped) == sorted(r.preflight.config.joint_names)
    assert not r.world.motors.error.any() and not r.told


def test_motors_are_silent_on_the_wire_while_watchdogs_are_tried():
    """Else a question might have fed them."""
    r = rig()
    sent: list[float] = []
    wire = r.preflight.robot.buses[0]._wire
    send = wire.send
    wire.send = lambda frames: (sent.append(r.world.time), send(frames))
    r.preflight.run()
    watchdog = r.preflight.wiring.buses[0].watchdog
    assert sum(gap > watchdog for gap in np.diff(sent)) == 1


CALIBRATIONS = {
    "another robot": (BENCH.model_copy(update={"robot": "g1"}), "got one of g1, wiring can; expected bench"),
    "half": (BENCH.model_copy(update={"motors": BENCH.motors[:1]}), "not measured yet: elbow_joint"),
    "unchecked": (BENCH.model_copy(update={"checked": False}), "gravity and symmetry have not been checked"),
    "other range": (changed(BENCH, "elbow_joint", position=(-2.0, 2.4)), "the YAML now says [-2.4, 2.4]"),
    "other motor": (changed(BENCH, "elbow_joint", id=7), "got motor arm/0x7, expected arm/0x2"),
    "stranger": (changed(BENCH, "elbow_joint", joint="knee"), "knee: got a joint that the wiring has not"),
    "replaced motor": (changed(BENCH, "elbow_joint", fingerprint="SN 7"), "elbow_joint: got motor SN 1002, expected SN 7"),
    "twice": (BENCH.model_copy(update={"motors": [*BENCH.motors, BENCH.motors[0]]}), "more than once: shoulder_joint"),
}  # fmt: skip


@pytest.mark.parametrize("case", CALIBRATIONS)
def test_a_calibration_that_is_not_of_this_robot_is_refused(case):
    calibration, expected = CALIBRATIONS[case]
    assert expected in rig(calibration=calibration).refusal()


def test_no_calibration_is_refused():
    r = rig()
    r.preflight.calibration = None
    assert "calibration:\n  got no calibration" in r.refusal()


def test_ranges_of_another_model_are_refused_by_motor():
    said = rig(registers={"elbow_joint": {"VMAX": 45.0}}).refusal()
    assert "motor of elbow_joint" in said and "VMAX is 45, expected 30" in said


def test_a_bus_without_room_is_refused_before_anything_is_sent():
    r = rig()
    r.preflight.wiring = r.preflight.wiring.model_copy(update={"rate": 1900.0})
    assert "bus load:\n  bus arm: got a load of 88% at 1900 Hz, expected at most 70%" in r.refusal()
    assert r.world.counters()["arm"]["frames"] == 0


def test_a_motor_that_falls_silent_is_refused_by_name():
    r = rig(faults=["off:arm/elbow_joint@0.15"])
    said = r.refusal()
    assert "freshness:\n  elbow_joint: last heard" in said and "shoulder" not in said


def test_a_silent_imu_is_refused():
    assert "IMU: last heard inf s ago" in rig(faults=["off:imu"]).refusal()


def test_an_imu_that_has_to_be_set_up_is_waited_for():
    config = load_robot("bench")
    wiring = config.wiring()
    imu = wiring.imu.model_copy(update={"protocol": "bno085_shtp", "baud": 3_000_000, "rate": 400.0})
    r = rig(config.model_copy(update={"wirings": {"can": wiring.model_copy(update={"imu": imu})}}))
    r.preflight.run()
    r.unmoved()


def test_a_watchdog_that_does_not_trip_is_refused_by_name():
    r = rig()
    trip = r.world.motors._trip
    r.world.motors._trip = lambda row, now: trip(row, now) if row == 0 else None  # a firmware that forgets it
    said = r.refusal()
    assert "watchdogs:\n  elbow_joint: is still enabled" in said and "shoulder" not in said


def test_a_motor_that_does_not_enable_is_refused_by_name():
    r = rig()
    decide = r.world.motors._set_enabled
    r.world.motors._set_enabled = lambda row, on, *rest: decide(row, on and row != 0, *rest)
    assert "shoulder_joint: not enabled after 0.3 s" in r.refusal()


@pytest.mark.parametrize("turns", [-1, 1, 2])
def test_a_lost_turn_is_put_back(turns):
    """Calibrated before the power went; the motor now counts from elsewhere."""
    r = rig(calibration=changed(BENCH, "elbow_joint", offset=BENCH.motors[1].offset + turns * 2 * np.pi))
    r.preflight.run()
    assert r.told == ["whole turns put back since the calibration: elbow_joint"]
    joint_pos = r.preflight.look().joint_pos
    np.testing.assert_allclose(joint_pos, r.world.plant.joint_pos, atol=0.01)
    target = r.preflight.robot
    command = joint_pos.copy()
    np.testing.assert_allclose(
        command[target._joint_of_motor] * target._motor_sign + target._motor_offset,
        r.world.motors.position, atol=0.01,
    )  # fmt: skip


def test_a_joint_that_no_turn_brings_into_its_range_is_refused():
    said = rig(calibration=changed(BENCH, "shoulder_joint", offset=3.1)).refusal()
    assert "turns:\n  shoulder_joint: reads" in said and "no whole turn" in said


def test_a_joint_that_two_turns_bring_into_its_range_is_refused():
    """A joint of more than a turn."""
    r = rig()
    joints = [j.model_copy(update={"position": (-4.5, 4.5)}) for j in r.preflight.config.joints]
    r.preflight.config = r.preflight.config.model_copy(update={"joints": joints})
    r.preflight.calibration = measured(r.preflight.config, "can")
    r.world.plant.reset([2.0, 0.0])
    assert "shoulder_joint: reads" in (said := r.refusal()) and "fit; move it" in said and "elbow" not in said


def bench_of(protocol: str, model: str, rate: float = 250.0, **changes: Any) -> RobotConfig:
    """The bench with other motors."""
    bench = load_robot("bench")
    wiring = bench.wiring("can")
    motors = [m.model_copy(update={"model": model, "feedback_id": 0}) for m in wiring.buses[0].motors]
    bus = wiring.buses[0].model_copy(update={"protocol": protocol, "motors": motors} | changes)
    return bench.model_copy(update={"wirings": {"can": wiring.model_copy(update={"buses": [bus], "rate": rate})}})


ENCODER = {"motor_position.output.reference_source": 1.0, "motor_position.sources.1.reference": 1.0}


def moteus_rig(*encoders: str, lost: float = 0.0, **options) -> Rig:
    """``encoders``: the joints with one at the output; ``lost``: rad by which the elbow counted otherwise when it was
    calibrated."""
    config = bench_of("moteus", "qdd100-beta2", data_bitrate=5_000_000)  # the rotor turns six times for the joint's one
    calibration = measured(config, "can")
    serials = [f"serial_number {moteus_serial(row)}" for row in range(2)]
    calibration = calibration.model_copy(update={"motors": [
        m.model_copy(update={"fingerprint": serial, "offset": m.offset + (lost if row else 0.0)})
        for row, (m, serial) in enumerate(zip(calibration.motors, serials, strict=True))
    ]})  # fmt: skip
    return rig(config, calibration=calibration, registers={joint: ENCODER for joint in encoders}, **options)


def moteus_serial(row: int) -> int:
    return sum(word + row * (not i) << 32 * i for i, word in enumerate(FIRST_SERIAL))


JOINTS = ("shoulder_joint", "elbow_joint")


def test_a_moteus_that_knows_its_rotor_alone_is_refused_in_a_wide_joint():
    said = moteus_rig("elbow_joint").refusal()
    assert re.search(
        r"shoulder_joint: reads .*, its range is -2 to 2 rad: [-.0-9]+, [-.0-9]+, [-.0-9]+, [-.0-9]+ fit; its motor",
        said,
    )
    assert "knows only where in a turn of 1.047 rad it is: give it an output encoder" in said and "elbow" not in said


@pytest.mark.parametrize("turns", [-1, 0, 1])
def test_a_moteus_with_an_output_encoder_is_accepted(turns):
    """It may have lost turns of the output, and those are put back."""
    r = moteus_rig(*JOINTS, lost=turns * 2 * np.pi)
    r.preflight.run()
    assert r.told == ["whole turns put back since the calibration: elbow_joint"] * bool(turns)
    np.testing.assert_allclose(r.preflight.look().joint_pos, r.world.plant.joint_pos, atol=0.01)


def test_turns_of_a_rotor_are_not_put_back_where_the_output_is_known():
    """An offset by a turn of the rotor is no lost turn then, but another zero."""
    said = moteus_rig(*JOINTS, lost=4 * np.pi / 3).refusal()
    assert "elbow_joint: reads" in said and "no whole turn brings it there" in said


def test_a_moteus_whose_position_means_nothing_is_refused():
    r = moteus_rig(*JOINTS)
    r.world.motors._home_state = lambda row: HomeState.RELATIVE if row else HomeState.OUTPUT
    assert "turns:\n  elbow_joint: its motor says that its position is referenced to nothing" in r.refusal()


ANONYMOUS = {
    "recoil": (
        "6512",
        0.08,
        "",
        ["FIRMWARE_VERSION 65793, FLUX_OFFSET 0.1", "FIRMWARE_VERSION 65793, FLUX_OFFSET 2.499"],
    ),
    "odrive": ("D6374-8:1", 0.0, "by bus and id alone", ["", ""]),
    "mini_cheetah": ("mini-cheetah", 0.0, "by bus and id alone", ["", ""]),
}


@pytest.mark.parametrize("protocol", ANONYMOUS)
def test_motors_without_a_serial_number_are_known_as_well_as_they_can_be_and_that_is_said(protocol):
    model, watchdog, said, told = ANONYMOUS[protocol]
    config = bench_of(protocol, model, watchdog=watchdog)
    calibration = measured(config, "can")
    calibration = calibration.model_copy(update={"motors": [
        m.model_copy(update={"fingerprint": t}) for m, t in zip(calibration.motors, told, strict=True)
    ]})  # fmt: skip
    r = rig(config, calibration=calibration)
    r.preflight.run()
    warned = [text for text in r.told if "no serial number" in text]
    assert len(warned) == bool(said) and all(said in text for text in warned)
    assert any("its motors lose their zero without power, and cannot tell" in text for text in r.told)


def test_a_recoil_motor_that_was_replaced_is_refused_by_what_its_calibration_measured():
    config = bench_of("recoil", "6512")
    calibration = measured(config, "can").model_copy()
    told = ANONYMOUS["recoil"][3]
    calibration = calibration.model_copy(update={"motors": [
        m.model_copy(update={"fingerprint": t}) for m, t in zip(calibration.motors, told, strict=True)
    ]})  # fmt: skip
    said = rig(config, calibration=calibration, registers={"elbow_joint": {"FLUX_OFFSET": 1.25}}).refusal()
    assert (
        "elbow_joint: got motor FIRMWARE_VERSION 65793, FLUX_OFFSET 1.25, expected" in said and "shoulder" not in said
    )


def test_another_variant_than_that_of_the_policies_is_refused():
    r = rig("g1", "dds")
    r.preflight = replace(r.preflight, calibration=None, variants=(6,))
    said = []
    with pytest.raises(Sim2realError, match="got mode_machine 5, expected 6 as robot and policies say"):
        r.preflight.run()
    r.preflight = replace(r.preflight, variants=(5,), tell=said.append)
    r.preflight.run()
    assert any("no watchdog can be programmed" in text for text in said)


def test_a_calibration_is_written_and_read_back(tmp_path):
    path = tmp_path / "deep" / "bench.yaml"
    BENCH.save(path)
    assert load_calibration(path) == BENCH


@pytest.mark.parametrize(
    ("before", "after", "expected"),
    [("sign: 1", "sign: 0", "sign"), ("offset: 0.0", "offset: .nan", "offset"), ("robot: bench", "robto: bench", "did you"),
     ("schema_version: 1", "schema_version: 2", "schema_version"), ("span: 4.0", "span: -1", "span")],
)  # fmt: skip
def test_a_spoiled_calibration_is_refused_with_its_path(tmp_path, before, after, expected):
    path = tmp_path / "bench.yaml"
    BENCH.save(path)
    text = path.read_text()
    assert before in text
    path.write_text(text.replace(before, after, 1))
    with pytest.raises(Sim2realError, match=expected):
        load_calibration(path)


def test_a_calibration_that_is_not_there_says_how_to_get_one(tmp_path):
    with pytest.raises(Sim2realError, match="sim2real calibrate"):
        load_calibration(tmp_path / "none.yaml")
