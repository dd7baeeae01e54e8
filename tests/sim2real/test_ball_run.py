"""Whole runs with a ball: somebody brings it, a camera sees it, a policy is fed it, and the gate minds when it is gone."""

from __future__ import annotations

import math

import numpy as np
import pytest
import tiny_policy

from drivers.bus import BusError
from drivers.sim.ball import RADIUS
from drivers.sim.world import World
from sim2real.config import load_robot
from sim2real.contract import Object, ObjectStart
from sim2real.launch import Launch
from sim2real.object.camera import CameraModel
from sim2real.object.scene import AIMING, AWAY, CLOSING, HANDING_OVER, Handover, highest, prepare_for
from sim2real.operators.script import ScriptOperator, Step
from sim2real.policy import load_policy
from sim2real.recorder.plot import page
from sim2real.recorder.process import Recorder
from sim2real.recorder.run import Run
from sim2real.recorder.summary import summarise
from sim2real.simulation import Scene, Simulation
from sim2real.skills import SkillPlayer, Stage

PLACED = {"how": "placed", "position": (0.6, 0.2, RADIUS)}
BALL = Object(radius=RADIUS, mass=0.62, restitution=0.8)


@pytest.fixture
def g1():
    return load_robot("g1")


@pytest.fixture
def seeing(tmp_path, g1):
    """Makes a policy that holds the home posture and wants to know where its ball is."""

    def make(**start):
        return load_policy(tiny_policy.write(tmp_path / "seeing.onnx", *tiny_policy.seeing(g1, **start)), g1, trial=0)

    return make


def perform(g1, policy, seconds=0.5, scene=None, **more):
    return Simulation(g1, [policy], ScriptOperator([Step("stand", seconds)]), scene or Scene(), **more)


def test_a_placed_ball_lies_there_and_is_seen_recorded_and_drawn(g1, seeing, tmp_path):
    record, fed = tmp_path / "ball.mcap", []

    def look(run):
        if 0.1 < run.since < 0.5:  # later it is damped, and sinks
            fed.append((run.player.inputs["object_position_in_base"].copy(), run.world.truth()))

    recorders = []

    def sink_for(layouts):
        recorders.append(Recorder(record, layouts, {"robot": "g1"}, {"robot.yaml": g1.path.read_bytes()}, patient=True))
        return recorders[0].sink

    run = perform(g1, seeing(**PLACED), sink_for=sink_for, each_tick=look)
    summary = run.run()
    recorders[0].close()
    assert not summary.faults and not any("S2R-028" in m for m in summary.messages)
    for seen, truth in fed:
        assert truth.position_object_in_world[2] == pytest.approx(RADIUS, abs=0.002)
        distance = np.linalg.norm(truth.position_object_in_world - truth.position_base_in_world)
        assert np.linalg.norm(seen) == pytest.approx(distance, abs=0.04)
    report = summarise(Run(record))
    assert report.object is not None and 0 < report.object.used <= report.object.sightings
    assert 0.03 < report.object.age["p50"] < 0.1
    drawn = page(Run(record))
    assert "<h2>Object</h2>" in drawn and drawn.count('class="dot s0"') > 20


def test_the_same_seed_gives_the_same_bytes_with_a_ball(g1, seeing):
    policy = seeing(**PLACED)
    one, again = (perform(g1, policy, 0.2).run().wire_sha256 for _ in range(2))
    assert one == again


def test_a_robot_that_never_sees_its_ball_is_not_armed(g1, seeing):
    run = perform(g1, seeing(**PLACED), scene=Scene(camera=CameraModel(loss=1.0)), timeout=1.0)
    run.player.object_patience = math.inf  # an operator who arms without looking
    summary = run.run()
    assert any("not armed: S2R-028 object_age" in m for m in summary.messages)
    assert not run.world.motors.enabled.any() and summary.duration == 0.0


def test_a_camera_that_dies_holds_then_damps(g1, seeing):
    modes = {}

    def cover(run):
        if run.since > 0.2:
            run.camera.model = CameraModel(loss=1.0)
        modes.setdefault(int(run.guardian.record["mode"][0]), run.since)

    summary = perform(g1, seeing(**PLACED), 2.0, each_tick=cover).run()
    assert summary.faults == ["S2R-028"]
    assert 0.2 + g1.safety.object_age - 0.1 < modes[1] < modes[2] < 0.2 + g1.safety.object_age + 0.1


def test_without_a_camera_the_policy_is_fed_the_truth(g1, seeing):
    gaps = []

    def look(run):
        if run.guardian.record["tick"][0] % run.every == 0 and 0 < run.since < 0.2:
            t = run.world.truth()
            seen = run.player.tracker.current
            gaps.append(np.linalg.norm(seen.position_in_base) - np.linalg.norm(
                t.position_object_in_world - t.position_base_in_world))  # fmt: skip
            assert seen.age == 0.0

    perform(g1, seeing(**PLACED), 0.2, Scene(camera=None), each_tick=look).run()
    assert len(gaps) > 5 and np.abs(gaps).max() < 0.002  # less than one tick of motion


@pytest.fixture
def world(g1):
    """A G1 that stands on its own for a moment, with a ball at hand."""
    wiring = g1.wiring()
    prepare = prepare_for(BALL, 0.002)
    return World(g1.model_path, g1.base, wiring.bus_specs(), wiring.imu_spec(), prepare=prepare, hang=0.0)


def place(world) -> np.ndarray:
    return world.truth().position_object_in_world


def test_a_held_ball_is_brought_held_on_to_and_let_go(world):
    handover = Handover(world, {"hold": ObjectStart(how="held", position=(0.5, 0.0, 0.1))})
    base = world.truth().position_base_in_world
    handover.act(Stage.STANDBY, "hold", 9.0, -1.0)
    assert place(world) == pytest.approx(base + [0.5 + AWAY, 0, 0.1], abs=0.05)
    handover.act(Stage.ENGAGE, "hold", 0.1, -1.0)
    world.advance(world.time + 0.6)
    assert np.linalg.norm(place(world) - world.truth().position_base_in_world) == pytest.approx(0.51, abs=0.03)
    for since in (0.0, HANDING_OVER):
        handover.act(Stage.RUN, "hold", -1.0, since)
        assert world.plant.ball.carried
    handover.act(Stage.RUN, "hold", -1.0, HANDING_OVER + 0.01)
    assert not world.plant.ball.carried
    world.advance(world.time + 0.2)
    assert world.truth().velocity_object_in_world[2] < -1.5  # it falls freely


def test_a_ball_is_aimed_and_then_thrown_for_every_skill_that_catches(world):
    thrown = ObjectStart(how="thrown", position=(1.5, 0.0, 1.0), velocity=(-3.0, 0.0, 2.0))
    handover = Handover(world, {"catch": thrown, "again": thrown})
    handover.act(Stage.STANDBY, "catch", 9.0, -1.0)
    assert world.plant.ball.carried
    for label, since in (("catch", 0.0), ("again", 3.0)):
        handover.act(Stage.RUN, label, -1.0, since)
        handover.act(Stage.RUN, label, -1.0, since + AIMING)
        assert world.plant.ball.carried
        handover.act(Stage.RUN, label, -1.0, since + AIMING + 0.01)
        truth = world.truth()
        assert np.hypot(*truth.velocity_object_in_world[:2]) == pytest.approx(3.0)
        assert truth.position_object_in_world[2] == pytest.approx(1.0)
        world.advance(world.time + 0.3)


def test_the_ball_is_brought_for_what_the_operator_wishes_to_begin_with(world):
    thrown = ObjectStart(how="thrown", position=(1.5, 0.0, 1.0), velocity=(-3.0, 0.0, 2.0))
    handover = Handover(world, {"hold": ObjectStart(how="held", position=(0.5, 0.0, 0.1)), "catch": thrown})
    for left, since in ((1.0, -1.0), (0.0, 0.0), (0.0, 0.04)):  # the policy is still at its first label
        handover.act(Stage.ENGAGE if since < 0 else Stage.RUN, "hold", left, since, "catch")
        world.advance(world.time + 0.02)
        assert place(world)[0] == pytest.approx(1.5, abs=0.05)
    handover.act(Stage.RUN, "hold", 0.0, 1.0, "catch")  # it will not
    world.advance(world.time + 0.5)
    assert place(world)[0] == pytest.approx(0.5, abs=0.1)


def test_a_ball_without_speed_is_dropped_at_once(world):
    handover = Handover(world, {"dribble": ObjectStart(how="thrown", position=(0.3, -0.3, 1.0))})
    handover.act(Stage.RUN, "dribble", -1.0, 0.0)
    assert not world.plant.ball.carried


def test_a_falling_ball_is_aimed_where_its_fall_began():
    """1.962 m/s down after 0.2 s of falling, 0.1962 m, in which it went 0.1 m back at 0.5 m/s."""
    top = highest(ObjectStart(how="thrown", position=(1.0, 0.0, 1.0), velocity=(-0.5, 0.0, -1.962)))
    assert top.position == pytest.approx((1.1, 0.0, 1.1962)) and top.velocity == (-0.5, 0.0, 0.0)
    rising = ObjectStart(how="thrown", position=(1.0, 0.0, 1.0), velocity=(-0.5, 0.0, 1.0))
    assert highest(rising) is rising


def test_a_ball_that_is_in_its_hands_is_left_alone(world):
    held = ObjectStart(how="held", position=(0.5, 0.0, 0.1))
    handover = Handover(world, {"hold": held, "raise": held})
    handover.act(Stage.RUN, "hold", -1.0, 0.0)
    handover.act(Stage.RUN, "hold", -1.0, 1.0)
    handover.act(Stage.RUN, "raise", -1.0, 1.1)
    assert not world.plant.ball.carried
    world.throw_ball((3.0, 0.0, 1.0), (0.0, 0.0, 0.0))
    handover.act(Stage.RUN, "hold", -1.0, 1.2)
    assert world.plant.ball.carried and np.linalg.norm(place(world)[:2]) < 1.0
    handover.act(Stage.RUN, "hold", -1.0, 1.2 + HANDING_OVER + 0.1)
    assert world.plant.ball.carried  # the hands come from elsewhere
    handover.act(Stage.RUN, "hold", -1.0, 1.2 + CLOSING + 0.1)
    assert not world.plant.ball.carried


def test_a_world_without_a_ball_says_so(g1):
    wiring = g1.wiring()
    world = World(g1.model_path, g1.base, wiring.bus_specs(), wiring.imu_spec())
    assert world.truth().position_object_in_world is None
    with pytest.raises(BusError, match="there is none in this world"):
        world.carry_ball((0.0, 0.0, 0.0))


@pytest.mark.slow
def test_in_real_time_the_camera_sends_datagrams(g1, seeing, tmp_path):
    from sim2real.pilot import topics

    player = SkillPlayer(g1, [seeing(**PLACED)])
    recorder = Recorder(tmp_path / "run.mcap", topics(g1, [b.name for b in g1.wiring().buses], player))
    launch = Launch(g1, player, ScriptOperator([Step("stand", 0.5)]), timeout=20.0, recorder=recorder)
    summary = launch.run()
    recorder.close()
    seen = Run(tmp_path / "run.mcap").object
    assert len(seen) > 50 and seen["used"][-1] > 20
    assert np.nanmin(seen["age"]) > 0.03  # no camera answers sooner
    placed = np.linalg.norm(seen["position_in_base"][seen["used"] >= 20][0])
    assert placed == pytest.approx(np.hypot(0.63, 0.72), abs=0.15)
    assert not any("Traceback" in m for m in summary.messages)
