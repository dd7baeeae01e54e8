"""A few steps of training: that it runs, resumes, and that the discriminator learns what a clip looks like."""

from __future__ import annotations

import dataclasses
import json

import numpy as np
import pytest
import torch

from policies.skillmimic.amp import Discriminator, features
from policies.skillmimic.config import TASKS, SkillMimic
from policies.skillmimic.graph import PolicyGraph
from policies.skillmimic.train import SkillTraining, load_config, load_graph
from policies.training import LastingNoise
from sim2real.types import Sim2realError

TINY = dataclasses.replace(
    SkillMimic(clips=("hold_05",)), envs=8, threads=1, horizon=4, hidden=(16,), samples=64, frames=8,
    evaluate_every=2, evaluate_envs=4, evaluate_seconds=0.1, save_every=1,
)  # fmt: skip

pytestmark = pytest.mark.usefixtures("one_thread")


def test_a_run_writes_its_settings_its_curve_and_its_best_policy(tmp_path):
    training = SkillTraining(TINY, tmp_path)
    training.run()
    rows = [json.loads(line) for line in (tmp_path / "curve.jsonl").read_text().splitlines()]
    assert [r["samples"] for r in rows] == [32, 64]
    assert {"reward", "reward_contact", "reward_body", "score", "success_hold", "ball_error"} <= set(rows[-1])
    assert load_config(tmp_path) == TINY
    torch.testing.assert_close(load_graph(tmp_path).actor.state_dict(), training.graph().actor.state_dict())

    again = SkillTraining(dataclasses.replace(TINY, samples=96), tmp_path)
    assert again.resume() and again.samples == 64
    torch.testing.assert_close(again.ppo.actor.state_dict(), training.ppo.actor.state_dict())
    again.run()
    assert again.samples == 96


def test_a_resumed_run_with_noise_that_lasts_continues_exactly(tmp_path):
    config = dataclasses.replace(TINY, lasts=0.9, evaluate_every=1000)
    whole = SkillTraining(config, tmp_path / "whole")
    whole.run()
    SkillTraining(dataclasses.replace(config, samples=32), tmp_path / "split").run()
    rest = SkillTraining(config, tmp_path / "split")
    assert rest.resume() and rest.samples == 32
    rest.run()
    assert (rest.ppo.actor.distribution.std_param == config.std).all()
    torch.testing.assert_close(rest.ppo.actor.state_dict(), whole.ppo.actor.state_dict(), rtol=0, atol=0)


def test_noise_that_lasts_is_as_large_as_noise_that_does_not():
    torch.manual_seed(0)
    noise = LastingNoise(4, lasts=0.9, init_std=0.5)
    noise.update(torch.ones(2000, 4))
    drawn = torch.stack([noise.sample() for _ in range(20)]) - 1
    assert abs(drawn[0].std() - 0.5) < 0.02 and abs(drawn[-1].std() - 0.5) < 0.02
    together = lambda a, b: float((a * b).mean() / (a.std() * b.std()))  # noqa: E731
    assert abs(together(drawn[-2], drawn[-1]) - 0.9) < 0.02
    noise.forget()
    assert abs(together(drawn[-1], noise.sample() - 1)) < 0.05
    again = LastingNoise(4, lasts=0.0, init_std=0.5)
    again.update(torch.ones(2000, 4))
    assert abs(together(again.sample() - 1, again.sample() - 1)) < 0.05


def test_a_start_from_another_run_has_the_noise_of_a_start(tmp_path):
    first = SkillTraining(TINY, tmp_path / "first")
    first.run()
    assert float(first.ppo.actor.distribution.std_param.max()) != TINY.std
    second = SkillTraining(TINY, tmp_path / "second")
    second.start_from(tmp_path / "first" / "last.pt")
    assert (second.ppo.actor.distribution.std_param == TINY.std).all()
    torch.testing.assert_close(second.ppo.actor.mlp.state_dict(), first.ppo.actor.mlp.state_dict())


def test_a_run_of_another_version_is_named(tmp_path):
    (tmp_path / "config.json").write_text(json.dumps({"config": {"robot": "g1", "magic": 1}}))
    with pytest.raises(Sim2realError, match=r"config.json: its settings are of another version .*magic"):
        load_config(tmp_path)
    with pytest.raises(Sim2realError, match="no such checkpoint"):
        load_graph(tmp_path)


def test_the_discriminator_tells_robots_from_clips_and_pays_the_likeness(tmp_path):
    config = dataclasses.replace(TINY, variant="amp")
    graph = PolicyGraph(config)
    judge = Discriminator(graph.clips, graph.clips.motion, 4, seed=1)
    judge.batch = 128
    clips = judge.references(512)
    robots = clips + np.random.default_rng(0).normal(0, 0.3, clips.shape)
    judge.reward(robots)
    first = judge.learn()
    for _ in range(24):
        last = judge.learn()
    assert last["loss_discriminator"] < 0.7 * first["loss_discriminator"]
    assert last["robots_found"] > 0.95 and last["clips_found"] > 0.95
    paid = judge.reward(clips)
    assert paid.mean() > 2 * judge.reward(robots).mean()
    assert (paid >= 0).all() and (paid <= 1).all()


def test_what_the_discriminator_sees_does_not_depend_on_place_or_heading():
    graph = PolicyGraph(TINY)
    m = graph.clips.motion(*graph.clips.rows(np.zeros(3, int), np.array([0, 50, 100])))
    half_turn, ahead = np.array([-1.0, -1.0, 1.0]), np.array([2.0, -1.0, 0.0])
    q = m.orientation_base_in_world
    turned = m._replace(
        points=m.points * half_turn + ahead,
        orientation_base_in_world=np.column_stack([-q[:, 3], -q[:, 2], q[:, 1], q[:, 0]]),  # z half turn times q
        object_position=m.object_position * half_turn + ahead,
        object_velocity=m.object_velocity * half_turn,
    )
    np.testing.assert_allclose(features(turned), features(m), atol=1e-6)


def test_amp_trains_and_its_discriminator_is_in_the_checkpoint(tmp_path):
    training = SkillTraining(dataclasses.replace(TINY, variant="amp", samples=32), tmp_path)
    training.run()
    row = json.loads((tmp_path / "curve.jsonl").read_text().splitlines()[-1])
    assert "loss_discriminator" in row and 0 <= row["reward_discriminator"] <= 1
    again = SkillTraining(dataclasses.replace(TINY, variant="amp"), tmp_path)
    again.resume()
    old, new = (t.env.discriminator.network.state_dict() for t in (training, again))
    torch.testing.assert_close(new, old)


@pytest.mark.parametrize("task", TASKS)
def test_every_task_has_its_clips(task):
    graph = PolicyGraph(TASKS[task])
    assert sorted(set(graph.clips.skill)) == list(range(len(TASKS[task].skills)))
    assert torch.isfinite(graph.postures).all()
    assert ((graph.postures > graph.lower - 0.3) & (graph.postures < graph.upper + 0.3)).all()
