"""``sim2real calibrate``: a robot put together at random, moved by simulated hands, measured through its wires."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from test_preflight import rig

from drivers.open import open_world
from sim2real.bringup.calibrate import Motors, Track, bare, checks, measure, rest
from sim2real.bringup.person import Person, assembled
from sim2real.calibration import Calibration, load_calibration
from sim2real.cli import main
from sim2real.clock import SimClock
from sim2real.config import RobotConfig, load_robot
from sim2real.robot import open_robot
from sim2real.types import Sim2realError

FILE = "bringup/bench-can-sim.calibration.yaml"
ROBOTS = Path(__file__).resolve().parents[2] / "configs" / "robots"


@pytest.fixture(autouse=True)
def elsewhere(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


def truth(seed: int, robot: str = "bench") -> dict[str, tuple[int, float]]:
    specs = assembled(load_robot(robot).wiring().bus_specs(), seed)
    return {m.joint: (m.sign, m.offset) for b in specs for m in b.motors}


def agrees(path: str, seed: int, robot: str = "bench") -> None:
    found = load_calibration(path)
    assert found.checked
    for joint, (sign, offset) in truth(seed, robot).items():
        m = found.motor(joint)
        assert m is not None and m.sign == sign, joint
        assert m.offset == pytest.approx(offset, abs=0.02), joint


@pytest.mark.parametrize("seed", [0, 1, 2, 3])
def test_whatever_way_it_was_put_together_is_found(seed, capsys):
    assert main(["calibrate", "--robot", "bench", "--sim", "--seed", str(seed)]) == 0
    assert "gravity and symmetry agree" in capsys.readouterr().out
    agrees(FILE, seed)


@pytest.mark.slow
def test_a_whole_humanoid_is_found_and_would_be_armed():
    assert main(["calibrate", "--robot", "g1", "--sim", "--seed", "1"]) == 0
    path = "bringup/g1-can-sim.calibration.yaml"
    agrees(path, 1, "g1")
    assert not list(load_calibration(path).complaints(load_robot("g1"), "can"))


def test_hands_lay_a_limb_back_where_they_found_it():
    """Dropped from its stop it might come down anywhere: a leg has two sets of hip angles that hang straight down."""
    table = Table()
    plant, home = table.world.plant, table.world.plant.joint_pos
    table.measured("shoulder_joint")
    upper = plant.joint_pos[0]
    assert upper > 1.9
    table.person.move("elbow_joint")
    passed: list[float] = []
    while table.person._joint == "shoulder_joint":
        table.motors.clock.sleep_until(table.motors.clock.now() + 0.01)
        passed.append(float(plant.joint_vel[0]))
    assert plant.joint_pos[0] == pytest.approx(home[0], abs=0.2)
    assert max(map(abs, passed)) < 2.5, "it was led, not dropped"
    table.person.let_go()
    assert rest(table.motors).joint_vel == pytest.approx([0.0, 0.0], abs=0.05)
    assert not table.person._joint and not plant.data.qfrc_applied.any()


def test_what_was_measured_is_kept_and_gone_on_from(capsys):
    main(["calibrate", "--robot", "bench", "--sim", "--seed", "3"])
    whole = load_calibration(FILE)
    half = whole.model_copy(update={"motors": whole.motors[:1], "checked": False})
    half.save(Path(FILE))
    capsys.readouterr()
    assert main(["calibrate", "--robot", "bench", "--sim", "--seed", "3"]) == 0
    assert "1 joints are measured already" in capsys.readouterr().out
    assert load_calibration(FILE).motors[0] == whole.motors[0]
    agrees(FILE, 3)


def test_a_motor_that_was_replaced_since_is_measured_again(capsys):
    main(["calibrate", "--robot", "bench", "--sim", "--seed", "3"])
    whole = load_calibration(FILE)
    old = whole.motors[0].model_copy(update={"fingerprint": "SN 5", "offset": 9.0})
    whole.model_copy(update={"motors": [old, whole.motors[1]]}).save(Path(FILE))
    assert main(["calibrate", "--robot", "bench", "--sim", "--seed", "3"]) == 0
    agrees(FILE, 3)


class Table:
    """A robot on a test bench, its hands, and who watches them."""

    def __init__(self, seed: int = 3, specs=None, **options) -> None:
        self.config: RobotConfig = load_robot("bench")
        self.wiring = self.config.wiring()
        self.world = open_world(self.config.model_path, self.config.base, specs or assembled(self.wiring.bus_specs(), seed),
                                self.wiring.imu_spec(), **options)  # fmt: skip
        limbs = {j.name: j.name for j in self.config.joints}
        self.person = Person(self.world, {j.name: j.position for j in self.config.joints}, limbs)
        clock = SimClock(self.person.advance, lambda: self.world.time)
        clock.sleep_until(0.1)
        wires = {**self.world.wires, "imu": self.world.imu_wire}
        self.motors = Motors(self.config, open_robot(self.config, bare(self.wiring), wires), clock)

    def measured(self, joint: str, moved: str = "", timeout: float = 15.0):
        self.person.move(moved or joint)
        return measure(self.motors, joint, timeout)


def test_another_joint_than_asked_for_is_told():
    """As if ids were swapped. Both joints of the bench have ranges of their own."""
    table = Table()
    joints = [j.model_copy(update={"position": (-2.4, 2.4)}) for j in table.config.joints]
    table.motors.config = table.config.model_copy(update={"joints": joints})
    with pytest.raises(Sim2realError, match="the motor of elbow_joint moved over its range instead.*swapped"):
        table.measured("shoulder_joint", moved="elbow_joint")


def test_a_range_that_is_too_short_is_told_by_its_length():
    table = Table()
    table.person._ranges = {j.name: (-1.0, 1.0) for j in table.config.joints}  # a hand that stops half way
    with pytest.raises(Sim2realError, match=r"shoulder_joint: moved over 2\.\d+ of 4.000 rad within 15 s"):
        table.measured("shoulder_joint")


def test_a_range_that_is_too_long_is_another_joint():
    table = Table()
    joints = [j.model_copy(update={"position": (-1.0, 1.0)}) for j in table.config.joints]
    table.motors.config = table.config.model_copy(update={"joints": joints})
    with pytest.raises(Sim2realError, match="expected 2.000 between its stops"):
        table.measured("elbow_joint")


def test_a_motor_that_falls_silent_is_told():
    table = Table(faults=["off:arm/elbow_joint@1.0"])
    with pytest.raises(Sim2realError, match="elbow_joint: silent for 0.5 s"):
        table.measured("shoulder_joint")


def test_a_count_that_wraps_within_the_range_is_told():
    track = Track(2 * np.pi)
    for time, q in enumerate((3.0, 3.1, -3.1)):
        track.see(float(time), q)
    assert track.jumped == pytest.approx(-6.2)


def track(*places: float, **settings: float) -> Track:
    """Held at each of ``places`` for a second, and moved to the next at 1 rad/s."""
    seen, time, here = Track(0.0, **settings), 0.0, places[0]
    for place in places:
        while abs(place - here) > 0.011:
            here += 0.01 if place > here else -0.01
            time += 0.01
            seen.see(time, here)
        for _ in range(100):
            time += 0.01
            seen.see(time, place)
    return seen


@pytest.mark.parametrize(
    ("places", "ends"),
    [((0.5, 0.0, 1.0), 1), ((0.5, 1.0, 0.0), -1), ((0.0, 1.0), 0), ((1.0, 0.0), 0), ((1.0, 0.0, 1.0), 1),
     ((0.5, 0.0, 1.0, 0.6), 0), ((0.5, 0.0), 0), ((0.5, 0.0, 0.5, 1.0), 1)],
)  # fmt: skip
def test_only_ends_that_were_held_one_after_the_other_count(places, ends):
    """Where it was before it was moved does not: a leg that starts at its upper end has not been brought there."""
    assert track(*places).ends() == ends


def test_a_stop_near_where_a_short_joint_hangs_counts():
    """A G1's ankle rolls over 0.52 rad and may hang 0.15 rad from its stop."""
    assert track(0.15, 0.0, 0.52, away=0.2 * 0.52).ends() == 1
    assert track(0.15, 0.0, 0.52).ends() == 0


@pytest.mark.parametrize(
    ("places", "twice"),
    [((0.5, 1.0, 0.4, 1.0), 1), ((0.5, 0.0, 0.4, 0.0), -1), ((0.5, 1.0), 0), ((1.0, 0.5, 1.0), 0), ((0.5, 1.0, 0.4, 0.8), 0)],
)  # fmt: skip
def test_one_stop_counts_when_it_was_touched_twice(places, twice):
    assert track(*places).twice() == twice


@pytest.mark.parametrize("wrong", ["sign", "offset"])
def test_gravity_contradicts_a_wrong_calibration(wrong):
    """The arm hangs, an upper arm pushed to one side by friction alone: nothing that the model could explain otherwise."""
    table = Table()
    found = [table.measured(j.name) for j in table.config.joints]
    table.person.let_go()
    state = rest(table.motors)
    up = np.array([1.0, 0, 0, 0])
    assert list(checks(table.config, "imu", found, state, up)) == []
    shoulder = found[0]
    if (
        wrong == "sign"
    ):  # its ends taken for each other: mirrored about the middle of its range, which is not where it hangs
        joints = [j.model_copy(update={"position": (-1.5, 2.5)}) if j.name == shoulder.joint else j
                  for j in table.config.joints]  # fmt: skip
        table.config = table.config.model_copy(update={"joints": joints})
        middle = shoulder.offset + shoulder.sign * 0.5  # of the motor
        shoulder = shoulder.model_copy(update={"sign": -shoulder.sign, "offset": middle + shoulder.sign * 0.5})
    else:
        shoulder = shoulder.model_copy(update={"offset": shoulder.offset + 0.6})
    contradicted = list(checks(table.config, "imu", [shoulder, found[1]], state, up))
    assert any("shoulder_joint: at" in line and "gravity turns it" in line for line in contradicted)


def test_left_and_right_that_hang_otherwise_contradict():
    r = rig("g1", hang=0.3)
    config, calibration = r.preflight.config, r.preflight.calibration
    assert isinstance(calibration, Calibration)
    state = r.preflight.robot  # connected below, in motor coordinates, which here are the joints'
    state.connect(r.preflight.clock)
    seen = r.preflight.look(5)
    hip = config.joint_names.index("left_hip_pitch_joint")
    seen.joint_pos[:] = 0.0
    seen.joint_pos[hip] = 0.4
    lines = list(checks(config, "imu_in_pelvis", calibration.motors, seen, np.array([1.0, 0, 0, 0])))
    assert any("left_hip_pitch_joint hangs at 0.40 rad and right_hip_pitch_joint at 0.00" in line for line in lines)
    seen.joint_pos[config.joint_names.index("right_hip_pitch_joint")] = 0.4
    lines = list(checks(config, "imu_in_pelvis", calibration.motors, seen, np.array([1.0, 0, 0, 0])))
    assert not any("hangs at" in line for line in lines)


def test_motors_that_tell_no_serial_number_are_named(capsys, tmp_path):
    """Their calibration is bound to bus and id alone, which is said where it is written."""
    text = (
        (ROBOTS / "bench.yaml").read_text().replace("damiao", "mini_cheetah").replace("DM4310, id", "mini-cheetah, id")
    )
    text = (
        text.replace("watchdog: 0.08", "watchdog: 0")
        .replace(", feedback_id: 0x11", "")
        .replace(", feedback_id: 0x12", "")
    )
    (tmp_path / "bench.yaml").write_text(text)
    (tmp_path / "bench.xml").write_bytes((ROBOTS / "bench.xml").read_bytes())
    assert main(["calibrate", "--robot", str(tmp_path / "bench.yaml"), "--sim"]) == 0
    said = capsys.readouterr().out
    assert "bus arm: its motors tell no serial number: the calibration knows them by bus and id alone" in said
    assert [m.fingerprint for m in load_calibration(FILE).motors] == ["", ""]


def test_a_robot_that_its_maker_calibrated_is_left_alone(capsys):
    assert main(["calibrate", "--robot", "g1", "--wiring", "dds", "--sim"]) == 2
    assert "its maker calibrated it" in capsys.readouterr().err


def test_the_file_of_another_robot_is_not_written_over(capsys, tmp_path):
    other = Calibration(robot="g1", wiring="can")
    other.save(tmp_path / "other.yaml")
    assert main(["calibrate", "--robot", "bench", "--sim", "--out", "other.yaml"]) == 2
    assert load_calibration("other.yaml") == other
