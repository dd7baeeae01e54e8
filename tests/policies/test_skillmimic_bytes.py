"""Ball skills on somebody else's legs: the file starts as it was trained, and both worlds measure the same."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch
from PIL import Image
from rsl_rl.modules import MLP

from drivers.bus import BusError
from policies.clips.kinematics import multiply, rotate
from policies.skillmimic import card
from policies.skillmimic.card import BallActor
from policies.skillmimic.config import TASKS
from policies.skillmimic.evaluate import performed, ticks_of
from policies.skillmimic.graph import PolicyGraph
from policies.skillmimic.stance import moved
from policies.skillmimic.starts import approach, object_start, start_posture
from policies.skillmimic.through_bytes import command, deploy_episode
from sim2real.object.camera import CameraModel
from sim2real.object.scene import AIMING
from sim2real.policy import load_policy

CONFIG = dataclasses.replace(
    TASKS["g1-ball"], skills=("hold", "carry", "catch"), clips=("hold_05", "carry_01", "catch_05"), threads=1
)
HOLD, CARRY, CATCH = range(3)

pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.fixture(scope="module")
def graph():
    """It has learned nothing: arms rest in their posture."""
    graph = PolicyGraph(CONFIG)
    graph.actor = MLP(graph.outputs()["observation"][0], len(graph.acting), [2], "elu")
    for weights in graph.actor.parameters():
        torch.nn.init.normal_(weights, std=1e-6)  # zeros would be folded
    return graph.eval()


@pytest.mark.slow
def test_the_contract_has_the_legs_of_the_stance_and_the_commands_of_the_base(graph, file):
    contract = load_policy(file, trial=0).contract
    legs = graph.acts.numpy() == 0
    for posture in (contract.default_joint_pos, contract.approach_joint_pos):
        np.testing.assert_allclose(np.array(posture)[legs], graph.clips.stance[0][legs], atol=1e-6)
    np.testing.assert_allclose(np.array(contract.default_joint_pos)[~legs], graph.postures[HOLD].numpy()[~legs])
    assert np.abs(start_posture(graph) - approach(graph))[~legs].max() > 0.05
    assert contract.command_velocity_max[0] == graph.base.config.command_high[0] > 0
    assert [s.velocity[0] > 0 for s in contract.skills] == [False, True, False]
    assert [s.object.how for s in contract.skills] == ["held", "held", "thrown"]


@pytest.mark.slow
@pytest.mark.parametrize("files", [4, 1])
def test_the_file_does_in_training_what_the_graph_does(graph, file, files, monkeypatch):
    """Starts anywhere in a clip included: the file's memory begins as the environment's. And so does its network alone."""
    monkeypatch.setattr(card, "FILES", files)
    actor = BallActor(file, 4)
    assert len(actor.policies) == files
    of_file = performed(graph, "hold", 4, 0.4, act=actor).result()
    of_graph = performed(graph, "hold", 4, 0.4).result()
    assert of_file.success == of_graph.success and of_file.ball_error == pytest.approx(of_graph.ball_error, abs=1e-4)


@pytest.mark.slow
@pytest.mark.parametrize("camera", [None, CameraModel()])
def test_holding_measures_the_same_in_both_worlds(graph, file, camera):
    there = performed(graph, "hold", 8, 1.0).result()
    judged = deploy_episode(file, graph, HOLD, 1.0, camera, seed=0)
    body, ball, _, right = judged.sums / judged.frames
    assert judged.success == 1 and judged.frames == judged.ticks == 50
    assert there.success.value >= 0.75  # nothing learned: some robot drops it at once
    assert there.accuracy > 0.95 and right > 0.9
    assert abs(body - there.body_error) < 0.02 and abs(ball - there.ball_error) < 0.03


@pytest.mark.slow
def test_a_catch_begins_with_the_ball_thrown_as_in_its_clip(graph, file):
    judged = deploy_episode(file, graph, CATCH, 10.0, None, seed=3)
    assert judged.success == 0 and judged.frames > 3  # arms that rest catch nothing
    start = object_start(graph, CATCH)
    speeds = np.array([row[1] for row in judged._rows])  # seen from the trunk
    thrown = int(np.argmax(np.linalg.norm(speeds, axis=1) > 2.0))
    assert thrown * CONFIG.period == pytest.approx(AIMING, abs=0.2)
    velocity, told = speeds[thrown], np.array(start["velocity"])  # the trunk leans a little
    assert np.linalg.norm(velocity) == pytest.approx(np.linalg.norm(told), abs=0.4)
    assert velocity @ told / np.linalg.norm(velocity) / np.linalg.norm(told) > np.cos(0.25)


@pytest.mark.slow
def test_a_film_shows_the_first_good_run(graph, file, tmp_path, monkeypatch):
    from policies.skillmimic import film

    monkeypatch.setattr(film, "SECONDS", 0.3)
    monkeypatch.setattr(film, "SIZE", (64, 64))
    gif = tmp_path / "films" / "hold.gif"
    try:
        assert film.film(file, graph, "hold", gif, "camera") == 1
    except BusError as error:
        if "MUJOCO_GL" in str(error):
            pytest.skip(str(error))
        raise
    with Image.open(gif) as shown:
        assert shown.n_frames == pytest.approx(4, abs=1)  # at 12.5 Hz


def test_an_episode_is_as_long_as_in_training(graph):
    clips = graph.clips
    length = (clips.length[CATCH] - 1) * CONFIG.timestep + CONFIG.after
    assert ticks_of(graph, CATCH, 10.0) == pytest.approx((AIMING + length) / CONFIG.period, abs=1)
    assert ticks_of(graph, HOLD, 10.0) == 500  # it swings
    assert ticks_of(graph, CATCH, 1.0) == pytest.approx((AIMING + 1.0) / CONFIG.period, abs=1)


def test_only_walking_skills_are_told_a_velocity(graph):
    drawn = [command(graph, "carry", np.random.default_rng(k)) for k in range(40)]
    still = sum(v == (0.0, 0.0, 0.0) for v in drawn)
    assert 4 < still < 22  # 30 %
    assert np.all(np.array(drawn) <= graph.base.config.command_high)
    assert command(graph, "hold", np.random.default_rng(1)) == (0.0, 0.0, 0.0)


def test_a_robot_that_is_moved_and_turned_with_its_ball_is_seen_alike(graph):
    clips = graph.clips
    rows, way = clips.rows(np.array([HOLD]), np.array([30]))
    m, there = clips.motion(rows, way), (clips.trunk_position[rows], clips.trunk_orientation[rows])
    turn, shift = np.array([np.cos(0.4), 0.0, 0.0, np.sin(0.4)]), np.array([1.0, -2.0, 0.1])
    place = lambda x: rotate(turn, x) + shift  # noqa: E731
    spin, drift = np.array([0.1, 0.2, 0.3]), np.array([0.4, 0.0, 0.1])
    world = m._replace(
        points=place(m.points),
        orientation_base_in_world=multiply(turn[None], m.orientation_base_in_world),
        object_position=place(m.object_position),
        object_velocity=rotate(turn, m.object_velocity) + drift + np.cross(rotate(turn, spin), place(there[0]) - place(m.points[:, 0])),
    )  # fmt: skip
    trunk = place(there[0]), multiply(turn[None], there[1])
    qvel = np.concatenate([drift, spin])[None]
    seen = moved(world, qvel, trunk, there)
    np.testing.assert_allclose(seen.points, m.points, atol=1e-9)
    np.testing.assert_allclose(seen.object_position, m.object_position, atol=1e-9)
    np.testing.assert_allclose(seen.object_velocity, m.object_velocity, atol=1e-9)
