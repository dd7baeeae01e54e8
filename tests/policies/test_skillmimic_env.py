"""The environment: what starts, what is paid, what ends, and that the actor sees with a robot's senses only."""

from __future__ import annotations

import copy
import dataclasses

import numpy as np
import pytest
import torch

from policies import ball
from policies.skillmimic.config import TASKS, SkillMimic
from policies.skillmimic.env import BALL, JOINTS, Env
from policies.skillmimic.evaluate import episodes_of, evaluate, measure
from policies.skillmimic.graph import PolicyGraph
from policies.skillmimic.randomisation import LOSS_TICKS, TABLE
from policies.skillmimic.sight import FINDS, KNOWN, LASTS, WRONG, Sight, foretold
from policies.skillmimic.starts import thrown
from policies.skillmimic.terminations import TERMINATIONS
from sim2real.contract import CARRY, INPUTS
from sim2real.object.scene import AIMING
from sim2real.tracker import PRESSED
from sim2real.types import Sim2realError

CONFIG = SkillMimic(envs=8, threads=1, disturbed=0.0, push_chance=0.0)
MIXED = dataclasses.replace(CONFIG, skills=("hold", "pass", "pickup"), clips=())


@pytest.fixture(scope="module")
def graph():
    return PolicyGraph(CONFIG)


@pytest.fixture(scope="module")
def mixed():
    return PolicyGraph(MIXED)


@pytest.fixture
def env(graph):
    return Env(CONFIG, 1, graph)


def still(env: Env) -> torch.Tensor:
    return torch.zeros(env.num_envs, env.num_actions)


# the table of clips


def test_a_swinging_clip_turns_at_both_ends(graph):
    clips = graph.clips
    last = clips.length[0] - 1
    rows, way = clips.rows(np.zeros(5, int), np.array([0, last, last + 1, 2 * last - 1, 2 * last]))
    assert (rows - clips.first[0]).tolist() == [0, last, last - 1, 1, 0]
    assert way.tolist() == [1, 1, -1, -1, 1]
    there, back = (clips.motion(rows[1:2] - 1, np.array([w])) for w in (1.0, -1.0))
    np.testing.assert_array_equal(there.joint_vel, -back.joint_vel)
    np.testing.assert_array_equal(there.joint_pos, back.joint_pos)


def test_another_clip_stays_at_its_end(mixed):
    clips = mixed.clips
    c = int(np.flatnonzero(~clips.swing)[0])
    rows, way = clips.rows(np.array([c]), np.array([10_000]))
    assert rows[0] == clips.first[c] + clips.length[c] - 1 and way[0] == 1


def test_starts_are_balanced_over_skills_and_then_over_clips(mixed):
    clip, row = mixed.clips.sample(np.random.default_rng(0), 12_000)
    assert (row < mixed.clips.length[clip]).all()
    skills = np.bincount(mixed.clips.skill[clip]) / len(clip)
    np.testing.assert_allclose(skills, 1 / 3, atol=0.02)
    clips, all_of = np.bincount(clip) / len(clip), np.bincount(mixed.clips.skill)
    np.testing.assert_allclose(clips, 1 / 3 / all_of[mixed.clips.skill], atol=0.01)


def test_the_reference_graph_is_the_clips_contact(mixed):
    held = mixed.clips.motion(*mixed.clips.rows(np.array([0]), np.array([20]))).contact[0]
    passes = int(np.flatnonzero(mixed.clips.skill == 1)[0])
    thrown = mixed.clips.motion(*mixed.clips.rows(np.array([passes]), np.array([10_000]))).contact[0]
    assert held.tolist() == [1, 0, 0] and thrown.tolist() == [0, 0, 0]


# starting and holding


def test_episodes_start_where_their_clip_is(env):
    for k in range(env.num_envs):
        rows, _ = env.clips.rows(env.clip[k : k + 1], env.row[k : k + 1])
        np.testing.assert_allclose(env._qpos[k, BALL], env.clips.qpos[rows[0], BALL])
        larger = ball.RADIUS * (env.random.drawn["ball_radius"][k] - 1)  # hands lie on the ball that there is
        expected = env.clips.qpos[rows[0], JOINTS] - env.clips.press[rows[0]] * larger
        np.testing.assert_allclose(env._qpos[k, JOINTS], expected)
    assert len(np.unique(env.row)) > 4


def test_the_posture_alone_holds_the_ball_for_a_second(env):
    env.episode_length_buf[:] = 0
    lowest = 1.0
    for _ in range(50):
        _, rewards, dones, _ = env.step(still(env))
        lowest = min(lowest, float(rewards.min()))
        assert not dones.any()
    assert lowest > 0.8
    assert env.now.state.contact.tolist() == env.now.reference.contact.tolist()
    assert measure(env.now).right.all()


def test_disturbed_starts_keep_the_ball_in_the_hands(graph):
    env = Env(dataclasses.replace(CONFIG, envs=32, disturbed=1.0), 2, graph)
    arm = np.linalg.norm(env._qpos[:, BALL] - env._qpos[:, :3], axis=1)
    rows, _ = env.clips.rows(env.clip, env.row)
    reference = np.linalg.norm(env.clips.qpos[rows, BALL] - env.clips.qpos[rows, :3], axis=1)
    assert (np.abs(arm - reference) < 0.01).all()
    assert np.abs(env._qpos[:, JOINTS] - env.clips.qpos[rows, JOINTS]).max() > 0.04
    env.step(still(env))
    assert env.now.state.contact[:, 0].mean() > 0.9  # arms off by 0.05 rad a joint may begin with a gap


# ending


def test_an_episode_ends_after_its_frames(env):
    env.episode_length_buf[:] = torch.arange(8) + CONFIG.frames - 8
    _, _, dones, extras = env.step(still(env))
    assert dones.tolist() == [0] * 7 + [1]
    assert extras["time_outs"].tolist() == [False] * 7 + [True]
    assert env.episode_length_buf[7] == 0


def test_an_episode_ends_a_while_after_its_clip(mixed):
    env = Env(dataclasses.replace(MIXED, after=0.1, terminations=("broken",)), 3, mixed)
    env.episode_length_buf[:] = 0
    env.clip[:] = np.flatnonzero(~env.clips.swing)[0]
    env.row[:] = env.since[:] = env.clips.length[env.clip] + 20 - env.substeps - 1 - np.arange(8)
    _, _, dones, _ = env.step(still(env))
    assert dones.tolist() == [1] + [0] * 7


def test_a_lost_ball_ends_the_episode(env):
    env._qpos[2, BALL] += (1.0, 0.0, 0.0)
    _, rewards, dones, extras = env.step(still(env))
    assert env.failures.tolist() == [k == 2 for k in range(8)]
    assert dones[2] == 1 and not extras["time_outs"][2]
    assert rewards[2] < 0.1 < rewards[3]


@pytest.mark.parametrize(
    ("name", "change"),
    [
        ("fallen", lambda s: s.height.__setitem__(0, 0.25)),
        ("tilted", lambda s: s.up.__setitem__(0, np.cos(1.2))),
        ("broken", lambda s: s.state.joint_vel.__setitem__((0, 3), np.nan)),
        ("ball_lost", lambda s: s.state.object_position.__setitem__(0, s.state.object_position[0] + 0.2)),
        ("dead", lambda s: fly(s, 0.5)),
    ],
)
def test_terminations(env, name, change):
    env.step(still(env))
    assert not TERMINATIONS[name](env.now).any()
    now = copy.deepcopy(env.now)
    change(now)
    assert TERMINATIONS[name](now).tolist() == [True] + [False] * 7


def fly(s, height, speed=0.0):
    """The first robot's ball is one to bounce, and nobody touches it."""
    s.bounces[0], s.state.contact[0] = True, 0.0
    s.state.object_position[0, 2], s.state.object_velocity[0] = height, (0.0, 0.0, speed)


@pytest.mark.parametrize(
    ("height", "speed", "dead"),
    [(0.55, 0.0, False), (0.25, 2.3, True), (0.25, -3.0, False), (0.15, 0.0, False), (0.08, 1.0, False)],
    ids=["high", "slow", "fast", "in other hands", "pressed flat"],
)
def test_a_ball_is_dead_that_comes_up_to_no_hand(env, height, speed, dead):
    env.step(still(env))
    fly(env.now, height, speed)
    assert TERMINATIONS["dead"](env.now)[0] == dead
    env.now.state.contact[0, 0] = 1.0
    assert not TERMINATIONS["dead"](env.now)[0]


def test_a_ball_that_is_aimed_is_not_dead():
    config = dataclasses.replace(TASKS["g1-dribble"], envs=16, threads=1, anywhere=False, frames=200)
    env = Env(config, 0)
    env.episode_length_buf[:] = 0
    for _ in range(round(AIMING / config.period) + 10):
        env.step(still(env))
        assert not env.failures.any()


def test_what_is_hopeless_ends_episodes_of_training_alone(graph, monkeypatch):
    training = Env(dataclasses.replace(CONFIG, terminations=("broken",), hopeless=("ball_lost",)), 0, graph)
    training._qpos[2, BALL] += (1.0, 0.0, 0.0)
    training.step(still(training))
    assert training.failures.tolist() == [k == 2 for k in range(8)]
    monkeypatch.setattr(graph, "config", training.config)
    assert episodes_of(graph, "hold", 2, 1.0).config.hopeless == ()


# seeing


def test_the_actor_has_a_robots_senses_only(graph):
    signals = [name for name in graph.inputs() if not name.startswith(CARRY)]
    assert set(signals) < set(INPUTS) and "linear_velocity_base_in_base" not in signals
    assert list(graph.carry_start()) == [name for name in graph.inputs() if name.startswith(CARRY)]


def test_where_in_the_world_it_is_and_how_fast_the_actor_cannot_tell(env):
    env.random.drawn["object_loss"][:] = 0.0
    state, sight, truth = env.rng.bit_generator.state, copy.deepcopy(env.sight), env.privileged.clone()
    env._observe()  # the same state, with noise of its own
    before = env.observation.clone()
    env.rng.bit_generator.state, env.sight = state, sight
    for field, moved in (("qpos", 3.0), ("qvel", 0.7)):
        for part in (slice(0, 3), BALL if field == "qpos" else slice(-6, -3)):
            env._recorded[field][..., part] += moved
            (env._qpos if field == "qpos" else env._qvel)[:, part] += moved
    ages = np.arange(len(sight._past))[:, None]
    for known, age in ((sight._past, ages), (sight._sighting, sight._age), (sight._found, sight._age)):
        known[..., :3] += 3.0 - 0.7 * CONFIG.period * (1 + age[..., None])  # it has been going faster for a while
        known[..., 3:] += 0.7
    env._observe()
    np.testing.assert_allclose(env.observation, before, atol=1e-5)
    assert (env.privileged - truth).abs().max() > 0.5


def look(sight, truth, held=False, touched=False, late=0, loss=0.0, noise=0.0, seed=0):
    """One tick of a ``sight`` whose robots are all alike."""
    n = len(sight.lost)
    alike = lambda x: np.full(n, x)  # noqa: E731
    spread = np.full((n, 6), noise)
    rng = seed if isinstance(seed, np.random.Generator) else np.random.default_rng(seed)
    return sight.look(np.tile(truth, (n, 1)), alike(held), alike(touched), alike(late), alike(loss), spread, rng)


def dropped(t, floor=ball.RADIUS):
    """(6,) m and m/s of a ball that flies 1 m/s forwards, 0.4 m over its place on the floor at first, and bounces once."""
    fall = np.sqrt(2 * 0.4 / 9.81)
    if t < fall:
        return np.array([0.3 + t, 0.0, floor + 0.4 - 9.81 * t**2 / 2, 1.0, 0.0, -9.81 * t])
    off, since = ball.RESTITUTION * 9.81 * fall, t - fall
    height = floor + off * (since - PRESSED) - 9.81 * since**2 / 2
    return np.array([0.3 + t, 0.0, height, 1.0, 0.0, off - 9.81 * since])


@pytest.mark.parametrize("late", [0, 2, 4])
def test_a_flight_is_known_for_now_however_late_it_is_seen(late):
    dt, sight = CONFIG.period, Sight(2, CONFIG.period)
    sight.begin(np.arange(2), np.tile(dropped(0.0), (2, 1)), np.zeros(2, bool))
    for k in range(22):
        told = look(sight, dropped(k * dt), late=late)
        np.testing.assert_allclose(told, np.tile(dropped(k * dt), (2, 1)), atol=1e-9)


@pytest.mark.parametrize("own", [False, True])
def test_a_push_is_known_when_it_is_seen_and_most_of_the_robots_own_at_once(own, monkeypatch):
    """In a hand nothing falls; then it goes up at 2 m/s."""
    monkeypatch.setattr("policies.skillmimic.sight.WRONG", 0.0)
    sight, still = Sight(1, CONFIG.period), np.array([0.3, 0, 0, 0, 0, 0.0])
    sight.begin(np.arange(1), still[None], np.array([True]))
    for _ in range(5):
        np.testing.assert_array_equal(look(sight, still, held=True, touched=own, late=3)[0], still)
    speeds = []
    for k in range(12):
        now = still + [0, 0, 2 * k * CONFIG.period, 0, 0, 2.0]
        speeds.append(look(sight, now, held=True, touched=own, late=3)[0, 5])
    known, finds = KNOWN if own else 0.0, FINDS[5]
    expected = [2 - 2 * (1 - known) * (1 - finds) ** max(0, k - 2) for k in range(12)]
    np.testing.assert_allclose(speeds, expected)


@pytest.mark.parametrize("own", [False, True])
def test_what_the_robot_pushes_goes_otherwise_than_it_knows(own):
    """It lies in a hand, which then throws it up at 2 m/s; who has not touched it is not misled."""
    sight, still = Sight(4000, CONFIG.period), np.zeros(6)
    sight.begin(np.arange(4000), np.zeros((4000, 6)), np.ones(4000, bool))
    assert not look(sight, still, held=True, touched=own).any()
    told = look(sight, still + [0, 0, 0, 0, 0, 2.0], held=True, touched=own)
    assert told[:, 3:].std(axis=0) == pytest.approx(own * 2 * WRONG * (1 - FINDS[3:]), rel=0.05)


def test_out_of_sight_a_ball_is_foretold_from_where_it_was_seen_last():
    dt, sight = CONFIG.period, Sight(1, CONFIG.period)
    sight.begin(np.arange(1), dropped(0.0)[None], np.array([False]))
    for k in range(6):
        sight.lost[:] = k > 0
        told = look(sight, dropped(k * dt) if k == 0 else np.full(6, 9.0), late=0)
        np.testing.assert_allclose(told[0], dropped(k * dt), atol=1e-9)
    assert (look(sight, np.full(6, 9.0), held=True)[0, :3] > 8.0).all()  # there it is again
    sight.begin(np.arange(1), dropped(0.0)[None], np.array([False]))
    assert look(sight, np.full(6, 9.0), loss=1.0)[0, 0] < 1.0 and 0 <= sight.lost[0] < LOSS_TICKS[1]


def test_a_ball_that_lies_goes_on_lying():
    floor = ball.RADIUS
    seen = np.array([[0.5, 0, floor, 0, 0, 0], [0.5, 0, floor + 0.003, 0, 0, 0], [0.5, 0, floor - 0.003, 0, 0, 0.0]])
    told = foretold(seen, np.full(3, 0.15), np.ones(3, bool))
    assert np.abs(told[:, 2] - floor).max() < 0.006 and np.abs(told[:, 5]).max() < 0.2


def test_what_a_tracker_is_off_by_lasts_a_few_ticks():
    sight, rng, nowhere = Sight(4000, CONFIG.period), np.random.default_rng(0), np.zeros(6)
    sight.begin(np.arange(4000), np.zeros((4000, 6)), np.ones(4000, bool))
    told = np.array([look(sight, nowhere, held=True, noise=0.2, seed=rng) for _ in range(12)])
    assert told[-1].std(axis=0) == pytest.approx([0.2] * 6, rel=0.05)
    lasting = (told[-1] * told[-2]).mean(axis=0) / 0.2**2
    assert lasting == pytest.approx([LASTS] * 6, abs=0.07)


def test_a_ball_lost_from_the_first_tick_is_not_where_the_last_episodes_was(env):
    env.sight._sighting[:] = env.sight._found[:] = 9.0
    env._start(np.arange(env.num_envs))
    env.sight.lost[:] = 3
    env._observe()
    assert np.abs(env.inputs["object_position_in_base"].numpy()).max() < 0.5


def test_the_exported_graph_is_the_environments(graph, env):
    graph.actor = torch.nn.Linear(env.observation.shape[1], env.num_actions)
    torch.manual_seed(0)
    torch.nn.init.normal_(graph.actor.weight, std=0.02)
    try:
        env.reset()
        env.episode_length_buf[:] = 0
        carries = {n: torch.zeros(env.num_envs, *graph.inputs()[n]) for n in graph.carry_start()}
        with torch.no_grad():
            for _ in range(6):
                outputs = dict(zip(graph.outputs(), graph(*env.inputs.values(), *carries.values()), strict=True))
                torch.testing.assert_close(outputs["observation"], env.observation)
                env.step(graph.actor(env.observation))
                torch.testing.assert_close(outputs["joint_pos_target"], env.target)
                carries = {name: outputs[f"{name}_next"] for name in carries}
    finally:
        graph.actor = torch.nn.Identity()
    assert {n: list(v.shape[1:]) for n, v in outputs.items()} == graph.outputs()


# randomness


def test_the_same_seed_gives_the_same_run(graph):
    def run() -> torch.Tensor:
        env = Env(dataclasses.replace(CONFIG, disturbed=0.5, push_chance=0.1), 5, graph)
        return torch.stack([env.step(still(env))[1] for _ in range(10)])

    assert torch.equal(run(), run())


def test_a_resumed_environment_goes_on_alike(graph):
    env = Env(CONFIG, 7, graph)
    env.step(still(env))
    state = env.state_dict()
    env.reset()
    other = Env(CONFIG, 8, graph)
    other.load_state_dict(state)
    assert torch.equal(env.observation, other.observation)
    assert torch.equal(env.step(still(env))[1], other.step(still(other))[1])


def test_every_ball_is_another_ball(env):
    fields, drawn, model = env.random._fields, env.random.drawn, env.model
    g, b = model.geom(ball.NAME).id, model.body(ball.NAME).id
    np.testing.assert_allclose(fields["body_mass"][:, b], ball.MASS * drawn["ball_mass"][:, 0])
    np.testing.assert_allclose(fields["geom_size"][:, g, 0], ball.RADIUS * drawn["ball_radius"][:, 0])
    np.testing.assert_allclose(fields["geom_rbound"][:, g], fields["geom_size"][:, g, 0])
    for k in range(3):
        law = ball.contact(CONFIG.timestep, float(drawn["ball_restitution"][k, 0]))
        np.testing.assert_allclose(fields["geom_solref"][k, g], [-law.stiffness, -law.damping])
    assert len(np.unique(drawn["ball_friction"])) == env.num_envs
    np.testing.assert_allclose(fields["geom_size"][0, :g], model.geom_size[:g])  # the robot keeps its shape


@pytest.mark.parametrize("level", [0.0, 0.5, 1.0])
def test_a_curriculum_draws_from_a_share_of_every_range(graph, level):
    env = Env(dataclasses.replace(CONFIG, easy=0.2, envs=64), 3, graph)
    env.level = level
    env._widen(0, 0)
    env.reset()
    share = 0.2 + 0.8 * level
    for name, term in TABLE.items():
        middle = (term.low + term.high) / 2 if term.low else 0.0
        low, high = (middle + share * (x - middle) for x in (term.low, term.high))
        drawn = env.random.drawn[name]
        assert drawn.min() >= low - 1e-12 and drawn.max() <= high + 1e-12
        assert np.ptp(drawn) > 0.8 * (high - low)


def test_a_curriculum_goes_on_while_more_than_half_survive_and_is_kept(graph):
    env = Env(dataclasses.replace(CONFIG, easy=0.2), 3, graph)
    assert env.level == 0.0 and env.random.share == 0.2
    env._widen(env.num_envs, 0)
    assert env.level == pytest.approx(0.2) and env.random.share == pytest.approx(0.36)
    other = Env(env.config, 4, graph)
    other.load_state_dict(env.state_dict())
    assert other.random.share == pytest.approx(0.36)
    env._widen(0, 2 * env.num_envs)
    assert env.level == 0.0


def test_without_a_curriculum_and_in_an_evaluation_all_of_every_range_is_drawn_from(graph):
    assert Env(CONFIG, 3, graph).level is None
    graph.config, config = dataclasses.replace(graph.config, easy=0.2), graph.config
    try:
        assert episodes_of(graph, "hold", 2, 0.1).random.share == 1.0
    finally:
        graph.config = config


def test_evaluation_counts_episodes_and_frames(graph):
    zero = evaluate(graph, episodes=4, seconds=0.2, act=still)["hold"]
    assert zero.success.survived == 4 and zero.accuracy > 0.9 and zero.ball_error < 0.03
    wild = evaluate(graph, episodes=4, seconds=2.0, act=lambda env: still(env) + 6.0)["hold"]
    assert wild.success.survived == 0 and wild.accuracy < zero.accuracy


# a ball that is thrown

CATCH = dataclasses.replace(TASKS["g1-ball"], skills=("catch",), clips=("catch_06",), envs=6, threads=1, disturbed=0.0,
                            push_chance=0.0, throw=0.0, anywhere=False)  # fmt: skip


@pytest.fixture(scope="module")
def catches():
    return PolicyGraph(CATCH)


def ball_from_below_base(env: Env) -> np.ndarray:
    """(envs, 3) m, seen from the floor below a base that has hardly turned."""
    return env._qpos[:, BALL] - env._qpos[:, :3] * [1.0, 1.0, 0.0]


def test_a_thrown_ball_is_aimed_in_front_of_the_base_and_then_flies_as_in_its_clip(catches):
    env, (place, velocity) = Env(CATCH, 1, catches), thrown(catches, 0)
    env.episode_length_buf[:] = 0
    waits = round(AIMING / CATCH.period)
    for tick in range(waits - 1):
        env.step(still(env))
        assert not env.failures.any() and (env.since <= 0).all(), tick
        assert (env.carries["carry_clock"] < 5).all()  # the arms wait
        np.testing.assert_allclose(np.linalg.norm(ball_from_below_base(env), axis=1), np.linalg.norm(place), atol=0.05)
    assert (env.since == 0).all()
    env.step(still(env))
    speed = env._qvel[:, -6:-3]
    np.testing.assert_allclose(np.linalg.norm(speed[:, :2], axis=1), np.linalg.norm(velocity[:2]), atol=0.02)
    np.testing.assert_allclose(speed[:, 2], velocity[2] - 9.81 * CATCH.period, atol=0.02)


def test_in_training_half_of_those_who_are_thrown_a_ball_wait_for_it(catches):
    config = dataclasses.replace(CATCH, anywhere=True, envs=400)
    env = Env(config, 1, catches)
    waits = env._aims > 0
    assert 0.4 < waits.mean() < 0.6 and (env.row[waits] == 0).all() and env.row[~waits].max() > 0
    assert env._aims.max() == round(AIMING / config.period)


def test_a_base_that_is_told_nothing_keeps_its_feet_on_the_floor(catches):
    labels = list(catches.base.labels)
    told = torch.tensor([[0.0, 0.0, 0.0], [0.04, 0.0, -0.04], [0.0, 0.3, 0.0]])
    assert [labels[k] for k in catches.gait(told).argmax(dim=1)] == ["stand", "stand", "walk"]


def test_an_actor_moves_the_arms_and_nothing_else(catches):
    env = Env(catches.config, 1, catches)
    seen = catches.signals(**{name: value[:1] for name, value in (*env.inputs.items(), *env.carries.items())})
    moved = (
        catches.target(seen, torch.ones(1, env.num_actions)) - catches.target(seen, torch.zeros(1, env.num_actions))
    )[0]
    arms = torch.tensor([j.group == "arm" for j in catches.robot.joints])
    assert (moved[arms].abs() > 1e-6).all() and not moved[~arms].any()


def test_a_policy_practises_one_of_its_skills():
    task = dataclasses.replace(TASKS["g1-ball"], envs=16, threads=1, practise=("pass",))
    graph = PolicyGraph(task)
    assert (Env(task, 1, graph).skill.argmax(dim=1) == graph.labels.index("pass")).all()
    assert (Env(task, 1, graph, "hold").skill.argmax(dim=1) == graph.labels.index("hold")).all()
    with pytest.raises(Sim2realError, match="got 'juggle', expected some of hold, carry"):
        Env(dataclasses.replace(task, practise=("juggle",)), 1, graph)
