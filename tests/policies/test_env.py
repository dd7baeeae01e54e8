"""The training environment: determined by its seed, honest about time, and one with the exported graph."""

from __future__ import annotations

import dataclasses

import mujoco
import numpy as np
import pytest
import torch
from torch import nn

from policies import randomisation
from policies.basics import MOTIONS, Basics, down
from policies.env import Env, multiply
from policies.graph import PolicyGraph
from policies.randomisation import TABLE
from sim2real.config import load_robot

CONFIG = Basics(envs=6)


def play(env: Env, ticks: int, seed: int = 0) -> list[torch.Tensor]:
    g = torch.Generator().manual_seed(seed)
    rows = [env.observation.clone()]
    for _ in range(ticks):
        env.step(0.3 * torch.randn(env.num_envs, env.num_actions, generator=g))
        rows.append(env.observation.clone())
    return rows


def test_same_seed_same_episodes_at_any_thread_count():
    one, two = (play(Env(dataclasses.replace(CONFIG, threads=k), seed=3), 60) for k in (1, 2))
    for a, b in zip(one, two, strict=True):
        assert torch.equal(a, b)


def test_another_seed_is_another_world():
    assert not torch.equal(Env(CONFIG, seed=3).observation, Env(CONFIG, seed=4).observation)


def test_everything_stays_finite_while_robots_fall():
    env = Env(CONFIG, seed=0, level=1.0)
    fell = 0
    for _ in range(150):
        observations, rewards, dones, extras = env.step(4 * torch.randn(env.num_envs, env.num_actions))
        assert torch.isfinite(observations["policy"]).all() and torch.isfinite(rewards).all()
        assert rewards.max() <= 1.0 and dones.shape == extras["time_outs"].shape == (env.num_envs,)
        fell += int(env.failures.sum())
    assert fell > 0


def test_a_failed_robot_starts_anew_and_the_others_go_on():
    env = Env(CONFIG, seed=0)
    env.step(torch.zeros(env.num_envs, env.num_actions))
    ages = env.episode_length_buf.clone()
    env._qpos[2, 2] = 0.2  # on the floor
    _, _, dones, extras = env.step(torch.zeros(env.num_envs, env.num_actions))
    assert dones[2] == 1 and not extras["time_outs"][2]
    assert env.episode_length_buf[2] == 0
    assert env._qpos[2, 2] > 0.5
    others = [k for k in range(env.num_envs) if not dones[k]]
    assert torch.equal(env.episode_length_buf[others], ages[others] + 1)


def test_a_script_says_which_skill_is_asked_for_when():
    script = np.array([[0] * 3 + [2] * 7, [1] * 10])
    env = Env(CONFIG, seed=0, script=script, level=None)
    for t in range(9):
        assert env.signals["skill"].argmax(-1).tolist() == script[:, t].tolist()
        env.step(torch.zeros(2, env.num_actions))


def test_a_command_arrives_as_late_as_was_drawn(monkeypatch):
    fixed = {"jitter": 0.0, "state_delay": 0.0}
    for name, value in fixed.items():
        monkeypatch.setitem(randomisation.TABLE, name, TABLE[name]._replace(low=value, high=value))
    env = Env(CONFIG, seed=0, script=np.zeros((3, 50), int), level=None)
    env.random.drawn["action_delay"][:, 0] = [0.0, 1.5, 3.0]
    sent = {}
    rollout = env.batch.rollout

    class Tap:
        def __getattr__(self, name):
            return getattr(env_batch, name)

        def rollout(self, nstep, control, *args, **kwargs):
            sent["control"] = control.copy()
            return rollout(nstep, control, *args, **kwargs)

    env_batch, env.batch = env.batch, Tap()
    before = env.target.clone()
    env.step(torch.ones(3, env.num_actions))
    old = (sent["control"] == before.numpy()[:, None]).all(-1)
    assert old.tolist() == [[False] * 4, [True] + [False] * 3, [True] * 3 + [False]]


def test_pushes_change_the_base_s_velocity_and_none_means_none():
    calm, pushed = (
        Env(dataclasses.replace(CONFIG, push=(0.02, 0.02), push_speed=(1.0, 1.0)), 5, np.zeros((6, 9), int), level)
        for level in (None, 1.0)
    )
    for env in (calm, pushed):
        env.step(torch.zeros(6, env.num_actions))
    assert np.abs(calm._qvel[:, :2]).max() < 0.25
    assert np.abs(pushed._qvel[:, :2]).max() > 0.25


def test_the_curriculum_rises_while_more_survive_than_fall():
    env = Env(CONFIG, seed=0, level=0.5)
    env._adapt(20, 10)
    assert env.level == pytest.approx(0.52)
    env._adapt(10, 20)
    assert env.level == pytest.approx(0.5)
    env._adapt(0, 10_000)
    assert env.level == 0.0


def test_quaternions_multiply_as_in_mujoco():
    a, b = np.random.default_rng(0).normal(size=(2, 7, 4))
    expected = np.zeros(4)
    for row, p, q in zip(multiply(a, b), a, b, strict=True):
        mujoco.mju_mulQuat(expected, p, q)
        np.testing.assert_allclose(row, expected, atol=1e-12)


def test_the_exported_graph_is_the_environment_s_own_forward():
    """Same signals and carries in: same observation, target and carries out, through skill switches and pushes."""
    torch.manual_seed(0)
    size = PolicyGraph(CONFIG).outputs()["observation"][0]
    graph = PolicyGraph(CONFIG)
    env_actions = len(graph.driven)
    graph.actor = nn.Sequential(nn.Linear(size, 16), nn.ELU(), nn.Linear(16, env_actions))
    graph.critic = nn.Sequential(nn.Linear(size, 16), nn.ELU(), nn.Linear(16, 1))
    graph.value_healthy[:] = torch.arange(1.0, 1.0 + len(graph.labels))
    env = Env(dataclasses.replace(CONFIG, switch=(0.1, 0.3), push=(0.1, 0.3), busy=0.0), seed=1, level=1.0)
    with torch.no_grad():
        for _ in range(40):
            inputs = {**env.signals, **{n: c.clone() for n, c in env.carries.items()}}
            answers = [graph(*(inputs[n][k : k + 1] for n in graph.inputs())) for k in range(env.num_envs)]
            out = {n: torch.cat(rows) for n, rows in zip(graph.outputs(), zip(*answers, strict=True), strict=True)}
            torch.testing.assert_close(out["observation"], env.observation)
            now = env.measured
            for name, value in {
                "posture": now.posture,
                "phase": now.phase,
                "gait": now.gait,
                "command": now.command,
            }.items():
                torch.testing.assert_close(out[f"carry_{name}_next"], value)
            value = graph.critic(env.observation) / (env.skill * graph.value_healthy).sum(-1, keepdim=True)
            torch.testing.assert_close((out["skill_value"] * env.skill).sum(-1, keepdim=True), value)
            start = env.episode_length_buf.clone()
            env.step(graph.actor(env.observation))
            going = env.episode_length_buf == start + 1  # not reset meanwhile
            torch.testing.assert_close(out["joint_pos_target"][going], env.target[going])
            torch.testing.assert_close(out["carry_action_next"][going], env.action[going])


def test_randomisation_is_reproducible_and_touches_only_the_robots_drawn():
    env, twin = Env(CONFIG, seed=0), Env(CONFIG, seed=0)
    for name, values in env.random.drawn.items():
        np.testing.assert_array_equal(values, twin.random.drawn[name])
        assert np.all(values >= TABLE[name].low) and np.all(values <= TABLE[name].high), name
    before = {name: values.copy() for name, values in env.random.drawn.items()}
    env.random.draw(np.array([1, 4]), np.random.default_rng(9))
    for name, values in env.random.drawn.items():
        np.testing.assert_array_equal(values[[0, 2, 3, 5]], before[name][[0, 2, 3, 5]])
        assert not np.array_equal(values[[1, 4]], before[name][[1, 4]]), name


@pytest.mark.parametrize(
    ("field", "names"),
    [("geom_friction", ["friction"]), ("body_mass", ["mass", "torso_load", "hand_load"]), ("body_ipos", ["torso_com"]),
     ("actuator_gainprm", ["kp"]), ("actuator_biasprm", ["kp", "kd"]), ("actuator_forcerange", ["strength"]),  ("dof_damping", ["damping"]), ("dof_armature", ["armature"])],
)  # fmt: skip
def test_randomisation_reaches_the_physics(field, names):
    env = Env(CONFIG, seed=0)
    fields = np.stack([getattr(env.batch.get_model(k), field) for k in range(env.num_envs)])
    assert len({row.tobytes() for row in fields}) == env.num_envs, names


def test_every_term_says_why():
    assert all(term.why and term.low < term.high for term in TABLE.values())


def test_busy_bodies_move_arms_trunk_and_knees_and_nothing_tells_the_balance():
    env = Env(dataclasses.replace(CONFIG, busy=1.0, busy_every=(0.02, 0.02)), seed=0, level=1.0)
    before = env.pose.clone()
    env.step(torch.zeros(env.num_envs, env.num_actions))
    moved = (env.pose != before).all(0)
    groups = [j.group for j in load_robot(CONFIG.robot).joints]
    assert {g for g, m in zip(groups, moved.tolist(), strict=True) if m} == {"arm", "waist", "leg"}
    assert all(m or g == "leg" for g, m in zip(groups, moved.tolist(), strict=True))


def test_robots_on_their_way_down_stand_on_flat_soles_wherever_they_start():
    env = Env(dataclasses.replace(CONFIG, envs=64, down=1.0, home_start=0.0), seed=0, level=1.0)
    stands = env.skill[:, env.graph.labels.index("stand")]
    assert (stands == 1).all()
    share = env._down
    assert share.min() < 0.2 and share.max() > 0.8
    pose = env.graph.home.numpy() + down(env.graph.joint_names, share)
    heights = env.stature.height(pose)
    assert np.ptp(heights) > 0.3
    data = mujoco.MjData(env.model)
    feet = [g for g in range(env.model.ngeom) if "_foot_" in env.model.geom(g).name]
    for joints, pitch, height in zip(pose, env.stature.pitch(pose), heights, strict=True):
        data.qpos[:] = [0, 0, height, np.cos(pitch / 2), 0, np.sin(pitch / 2), 0, *joints]
        mujoco.mj_forward(env.model, data)
        np.testing.assert_allclose(data.geom_xpos[feet, 2] - env.model.geom_size[feet, 0], 0.0, atol=2e-3)
        ankle = data.xanchor[env.model.joint("left_ankle_pitch_joint").id, 0]
        assert 0.02 < data.subtree_com[1, 0] - ankle < 0.06  # of 12 cm to the toes


def test_commands_are_for_skills_that_walk():
    labels = list(MOTIONS)
    env = Env(CONFIG, seed=0, script=np.array([[labels.index("stand")] * 9, [labels.index("walk")] * 9]), level=None)
    env.command[:] = torch.tensor([0.5, 0.0, 0.0])
    for _ in range(5):
        env.step(torch.zeros(2, env.num_actions))
    assert env.measured.command[0].tolist() == [0.0, 0.0, 0.0]
    assert 0.0 < env.measured.command[1, 0] <= 0.5 and env.measured.gait[1] > 0.0
