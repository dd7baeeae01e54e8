"""The factory G1's bus against its emulation: every refusal, what is on the wire, and what gets lost there."""

from __future__ import annotations

import numpy as np
import pytest

from drivers.bus import BusError, BusSpec, ImuSpec, MotorCommand, MotorSpec
from drivers.codecs import unitree_api as api
from drivers.codecs import unitree_hg as hg
from drivers.dds_bus import DdsBus
from drivers.open import open_bus, open_codec, open_imu, open_world
from drivers.sim.dds_world import DdsWorld
from drivers.wire import WireError

BASE_BODY = '<body name="pelvis" pos="0 0 1"><site name="imu" pos="0 0 0.1"/><geom size="0.1" mass="5"/>{}</body>'
LIMB = (
    '<body pos="{0} 0 0"><joint name="{1}_joint" axis="0 0 1" armature="0.019" actuatorfrcrange="-30 30"/>'
    '<geom size="0.05" mass="1" contype="0" conaffinity="0"/></body>'
)
JOINTS, MODELS = hg.JOINTS[:3], ("M7520-14", "M7520-22", "M7520-14")
SPEC = BusSpec(
    "body",
    "unitree_hg",
    tuple(MotorSpec(f"{j}_joint", m, i) for i, (j, m) in enumerate(zip(JOINTS, MODELS, strict=True))),
    "dds",
)
INERTIA = 0.019 + 0.4 * 0.05**2  # kg m^2, of each joint
N = len(JOINTS)


class WorldClock:
    """Time is the world's; sleeping moves it on."""

    def __init__(self, world: DdsWorld) -> None:
        self.world = world

    def now(self) -> float:
        return self.world.time

    def sleep_until(self, time: float, /) -> None:
        self.world.advance(time)


@pytest.fixture
def make(tmp_path):
    """A small robot with upright axes, so that gravity does nothing, and the bus on it."""

    def build(spec: BusSpec = SPEC, **options):
        limbs = "".join(LIMB.format(i + 1, j) for i, j in enumerate(JOINTS))
        path = tmp_path / "robot.xml"
        path.write_text(f"<mujoco><worldbody>{BASE_BODY.format(limbs)}</worldbody></mujoco>")
        world = open_world(path, "pelvis", [spec], ImuSpec("unitree_hg", "dds"), hang=None, **options)
        assert isinstance(world, DdsWorld)
        bus = open_bus(spec, world.wires["body"])
        assert isinstance(bus, DdsBus)
        return world, bus, WorldClock(world)

    return build


def targets(position=0.0, velocity=0.0, kp=0.0, kd=0.0, torque=0.0) -> MotorCommand:
    return MotorCommand(*(np.full(N, float(v)) for v in (position, velocity, kp, kd, torque)))


def test_connecting_takes_the_robot_over_and_leaves_it_disabled(make):
    world, bus, clock = make(stubborn=1)
    bus.connect(clock)
    assert world.motors.controller == "" and not world.motors.enabled.any()
    state = bus.read(clock.now())
    assert (state.time > -np.inf).all() and not state.enabled.any() and np.isfinite(state.position).all()


REFUSALS = {
    "silent": ({"faults": ["drop:body"]}, "no LowState on rt/lowstate within 3 s"),
    "other variant": ({"mode_machine": 11}, r"mode_machine 11, expected 2 or 5.*left_hip_pitch_joint: the robot has a M7520-22"),
    "unknown variant": ({"mode_machine": 7}, "mode_machine 7 is no variant known here"),
    "two masters": ({"others": 2}, "got 2 other publishers on rt/lowcmd, expected none"),
    "not let go": ({"stubborn": 99}, "controller 'ai' is still in charge after 5 requests"),
}  # fmt: skip


@pytest.mark.parametrize("case", REFUSALS)
def test_what_connecting_refuses(make, case):
    options, message = REFUSALS[case]
    if case == "other variant":  # hip roll alone does not tell 2 from 5: another motor there does
        message = message.replace("2 or 5", "4 or 5 or 6 or 13 or 14")
    world, bus, clock = make(**options)
    with pytest.raises(BusError, match=f"(?s){message}"):
        bus.connect(clock)
    assert not world.motors.enabled.any()


def test_a_service_that_does_not_answer_is_refused(make, monkeypatch):
    world, bus, clock = make()
    monkeypatch.setattr(world.motors, "_serve", lambda payload: [])
    with pytest.raises(BusError, match="no answer from the robot's motion_switcher to request 1001, tried 3 times"):
        bus.connect(clock)


@pytest.mark.parametrize(
    ("answer", "message"),
    [((7, ""), "refuses request 1001: got code 7"), ((0, "{"), "answered '{'"), ((0, "[1]"), r"answered '\[1\]'")],
)
def test_a_service_that_answers_nonsense_is_refused(make, monkeypatch, answer, message):
    world, bus, clock = make()

    def serve(payload: bytes):
        request = api.unpack_request(payload)
        return [(api.MOTION_RESPONSE, api.pack_response(api.Response(request.id, request.api, *answer)))]

    monkeypatch.setattr(world.motors, "_serve", serve)
    with pytest.raises(BusError, match=message):
        bus.connect(clock)


def test_a_motor_that_stays_enabled_is_refused_by_name(make, monkeypatch):
    world, bus, clock = make()
    change = world.motors._change
    monkeypatch.setattr(
        world.motors, "_change", lambda on, effect, time: change(np.array([0, 1, 0], bool), effect, time)
    )
    with pytest.raises(BusError, match="left_hip_roll_joint enabled, expected disabled"):
        bus.connect(clock)


def test_enabled_motors_obey_and_say_so(make):
    world, bus, clock = make()
    bus.connect(clock)
    bus.enable()
    world.advance(clock.now() + 0.01)
    state = bus.read(clock.now())
    assert state.enabled.all() and not world.plant.joint_torque.any()
    bus.write(targets(torque=2.0))
    world.advance(clock.now() + 0.1)
    state = bus.read(clock.now())
    assert state.torque == pytest.approx(np.full(N, 2.0)) and (state.velocity > 1).all()
    bus.disable()
    world.advance(clock.now() + 0.01)
    assert not bus.read(clock.now()).enabled.any() and not world.plant.joint_torque.any()
    events = [e.event for e in world.motor_log if e.joint == "left_hip_roll_joint"]
    assert events == ["enabled", "limp", "disabled"]


def test_a_command_acts_from_its_arrival_within_a_substep(make):
    """2 N m for a quarter of a substep: the impulse decides the velocity."""
    world, bus, clock = make(latency=0.0005)
    bus.connect(clock)
    bus.enable()
    world.advance(round(clock.now() / 0.002 + 5) * 0.002 + 0.001)
    before = world.plant.joint_vel.copy()
    bus.write(targets(torque=2.0))  # at 1.0 ms into the substep, arrives at 1.5 ms
    world.advance(clock.now() + 0.001)
    assert world.plant.joint_vel - before == pytest.approx(np.full(N, 2.0 * 0.0005 / INERTIA), rel=1e-6)


def test_the_law_of_a_motor_with_sign_and_offset(make):
    motors = tuple(
        MotorSpec(m.joint, m.model, m.id, sign=sign, offset=offset)
        for m, sign, offset in zip(SPEC.motors, (1, -1, -1), (0.0, 0.5, -0.3), strict=True)
    )
    spec = BusSpec("body", "unitree_hg", motors, "dds")
    world, bus, clock = make(spec)
    bus.connect(clock)
    for _ in range(500):
        bus.write(targets(position=0.2, kp=20, kd=1.5))
        world.advance(clock.now() + 0.004)
    assert bus.read(clock.now()).position == pytest.approx(np.full(N, 0.2), abs=1e-3)
    assert world.plant.joint_pos == pytest.approx(np.array([0.2, 0.3, -0.5]), abs=1e-3)


def test_a_robot_with_its_controller_in_charge_ignores_us(make):
    world, bus, clock = make()
    world.advance(0.1)
    world.wires["body"].write(hg.COMMAND_TOPIC, hg.UnitreeHgCodec(SPEC).pack_command(targets(torque=2.0), 5))
    world.advance(0.2)
    assert world.motors.ignored == 1 and not world.plant.joint_torque.any()


@pytest.mark.parametrize("what", ["mode_machine", "crc"])
def test_a_wrong_command_is_ignored(make, what):
    world, bus, clock = make()
    bus.connect(clock)
    payload = bytearray(hg.UnitreeHgCodec(SPEC).pack_command(targets(torque=2.0), 4 if what == "mode_machine" else 5))
    if what == "crc":
        payload[-1] ^= 1
    world.wires["body"].write(hg.COMMAND_TOPIC, bytes(payload))
    world.advance(clock.now() + 0.01)
    assert world.motors.ignored == 1 and not world.motors.enabled.any()


def test_before_connecting_only_damping_is_sent(make):
    """What the launcher does for a guardian that has died: a new bus, no connect, damping."""
    world, bus, clock = make()
    bus.connect(clock)
    bus.write(targets(kp=50, kd=1))
    world.advance(clock.now() + 0.02)
    heir = open_bus(SPEC, world.wires["body"])
    with pytest.raises(BusError, match="not connected"):
        heir.write(targets(kp=50))
    heir.write(targets(kd=3))
    world.advance(clock.now() + 0.02)
    assert world.motor_log[-1].event == "damping"


def test_nothing_is_sent_to_a_robot_that_was_never_heard(make):
    world, bus, clock = make()
    with pytest.raises(BusError, match="not a LowState heard yet"):
        bus.enable()
    bus.disable()  # never raises
    assert bus.counters.sent == 0 and bus.counters.extra["disable_failed"] == 1


def test_damaged_states_are_counted_and_old(make):
    world, bus, clock = make()
    bus.connect(clock)
    world.inject("corrupt:body")
    for _ in range(50):
        world.advance(clock.now() + 0.004)
        bus.read(clock.now())
    assert bus.counters.rejected > 80  # of 100; the rest had the flipped bit in padding


def test_a_state_that_repeats_is_old(make):
    world, bus, clock = make()
    bus.connect(clock)
    world.inject(f"stuck:body@{clock.now() + 0.01}")
    world.advance(clock.now() + 0.1)
    rejected = bus.counters.rejected
    state = bus.read(clock.now())
    assert bus.counters.rejected > rejected and bus.counters.received > 0
    last = state.time.copy()
    world.advance(clock.now() + 0.1)
    assert (bus.read(clock.now()).time == last).all()


def test_a_robot_that_becomes_another_is_no_longer_heard(make):
    world, bus, clock = make()
    bus.connect(clock)
    bus.read(clock.now())
    world.motors.mode_machine = 11
    world.advance(clock.now() + 0.02)
    bus.read(clock.now())
    last = bus.read(clock.now()).time.copy()
    world.advance(clock.now() + 0.1)
    assert (bus.read(clock.now()).time == last).all()


def test_a_motor_without_supply_is_an_error_with_a_name(make):
    world, bus, clock = make()
    bus.connect(clock)
    world.inject(f"off:body/left_hip_roll_joint@{clock.now() + 0.01}")
    for _ in range(10):
        bus.write(targets(kp=10, kd=1))
        world.advance(clock.now() + 0.004)
    state = bus.read(clock.now())
    assert state.enabled.tolist() == [True, False, True]
    assert bus.error_name(int(state.error[1])) == "under-voltage" and not state.error[[0, 2]].any()


def test_half_of_all_samples_lost_is_survived(make):
    world, bus, clock = make(seed=1)
    bus.connect(clock)
    world.inject(f"drop:body:0.5@{clock.now()}")
    ages = []
    for _ in range(200):
        bus.write(targets(kp=20, kd=1))
        world.advance(clock.now() + 0.004)
        ages.append(clock.now() - bus.read(clock.now()).time.max())
    assert max(ages) < 0.04 and world.counters()["body"]["dropped"] > 50


def test_the_imu_is_the_robots(make):
    world, bus, clock = make()
    imu = open_imu(ImuSpec("unitree_hg", "dds"), world.imu_wire)
    world.advance(0.1)
    state = imu.read(0.1)
    assert state.acceleration_imu_in_imu == pytest.approx(np.array([0, 0, 9.81]), abs=0.2)
    assert state.orientation_imu_in_world == pytest.approx(np.array([1, 0, 0, 0]), abs=0.01) and state.time == 0.1
    world.inject("drop:imu@0.1")
    world.advance(0.2)
    imu.read(0.2)  # the one that was on its way
    world.advance(0.3)
    assert imu.read(0.3).time == 0.2


@pytest.mark.parametrize(
    ("fault", "message"),
    [("garbage:body", "kind 'garbage', expected one that DDS can have"), ("drop:leg", "nothing here is 'leg/"),
     ("drop:body/left_hip_roll_joint", "a sample holds all motors")],
)  # fmt: skip
def test_faults_that_dds_cannot_have(make, fault, message):
    with pytest.raises(BusError, match=message):
        make(faults=[fault])


def test_the_same_seed_gives_the_same_bytes(make):
    def digest(seed: int) -> str:
        world, bus, clock = make(seed=seed, faults=["drop:0.1"])
        bus.connect(clock)
        return world.digest

    assert digest(1) == digest(1) != digest(2)


def test_two_buses_behind_dds_are_refused(tmp_path):
    with pytest.raises(BusError, match="expected one"):
        open_world(tmp_path / "x.xml", "pelvis", [SPEC, SPEC], ImuSpec("unitree_hg"))


def test_a_can_motor_needs_its_watchdog():
    with pytest.raises(BusError, match="watchdog 0"):
        open_codec(BusSpec("leg", "damiao", (MotorSpec("a", "DM8006", 1, 0x11),), watchdog=0.0))


def test_a_closed_wire_says_so(make):
    world, bus, clock = make()
    bus.connect(clock)
    bus.close()
    with pytest.raises(BusError, match="used after close"):
        bus.read(clock.now())
    with pytest.raises(WireError, match="only read"):
        world.imu_wire.write(b"x")


def test_requests_and_answers_there_and_back():
    request, answer = api.Request(5, 1001, '{"a": "ä"}'), api.Response(-5, 1003, 7, "")
    assert api.unpack_request(api.pack_request(request)) == request
    assert api.unpack_response(api.pack_response(answer)) == answer
    for cut in range(4 + 20 + 4 + 1):  # header, head, length, and the final zero of the string
        assert api.unpack_response(api.pack_response(answer)[:cut]) is None
