"""Evaluation: its scripts, its statistics, and that it can tell a policy that falls from one that stands."""

from __future__ import annotations

import dataclasses
import json

import numpy as np
import pytest
import torch

from policies.basics import MOTIONS, Basics
from policies.card import Evaluation, by, card, steps
from policies.env import Env
from policies.evaluate import (
    Episodes,
    FileActor,
    Rate,
    graph_actor,
    random_script,
    run_episodes,
    skill_script,
    switch_script,
)
from policies.release import golden_sequences, release
from policies.through_bytes import deploy_episode, random_pushes, stayed_up
from policies.train import Training, load_graph
from sim2real.policy import load_policy
from sim2real.types import Sim2realError

CONFIG = Basics()
LABELS = len(MOTIONS)


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A training of one iteration: the ankle strategy with next to nothing learned, which stands for seconds."""
    folder = tmp_path_factory.mktemp("run")
    tiny = dataclasses.replace(CONFIG, envs=8, horizon=4, samples=32, save_every=1, hidden=(16,),
                               ppo={**CONFIG.ppo, "num_mini_batches": 2})  # fmt: skip
    Training(tiny, folder).run()
    return folder


@pytest.mark.parametrize(
    ("survived", "episodes", "low", "high"),
    [(0, 10, 0.0, 0.2775), (10, 10, 0.7225, 1.0), (15, 148, 0.0624, 0.1605), (81, 263, 0.2553, 0.3662)],
)
def test_intervals_are_wilson_s(survived, episodes, low, high):
    """The last two are the worked examples of Newcombe 1998, Statistics in Medicine 17:857, method 3."""
    assert Rate(survived, episodes).interval == pytest.approx((low, high), abs=2e-4)


def test_switch_script_has_every_ordered_pair_once_per_episode():
    pairs, script = switch_script(CONFIG, LABELS, 3)
    assert len(pairs) == len(set(pairs)) == LABELS * (LABELS - 1)
    for k, row in enumerate(script):
        assert (row[0], row[-1]) == pairs[k // 3]
        assert np.count_nonzero(np.diff(row)) == 1


def test_scripts_have_the_length_asked_for():
    assert skill_script(CONFIG, LABELS, 2, 10.0).shape == (2 * LABELS, 500)
    script = random_script(CONFIG, LABELS, 5, 10.0)
    assert script.shape == (5, 500) and set(np.unique(script)) <= set(range(LABELS))
    np.testing.assert_array_equal(script, random_script(CONFIG, LABELS, 5, 10.0))


def test_a_row_of_labels_as_steps():
    assert steps(np.array([0, 0, 2, 2, 2, 1]), ["a", "b", "c"], 0.5) == [("a", 1.0), ("c", 1.5), ("b", 0.5)]


def test_an_episode_that_falls_is_counted_once_and_for_good():
    """Full steam on every joint falls within seconds; doing nothing about balance at home does not within 0.4 s."""
    script = skill_script(CONFIG, 1, 8, 2.0)
    wild = run_episodes(CONFIG, lambda env: torch.full((8, env.num_actions), 3.0), script)
    assert wild.rate() == Rate(0, 8)
    calm = run_episodes(CONFIG, lambda env: torch.zeros(8, env.num_actions), script[:, :20])
    assert calm.rate() == Rate(8, 8) and calm.error.max() < 0.2


def test_episodes_are_reproducible_and_seeds_matter():
    script = skill_script(CONFIG, 2, 2, 0.5)
    play = lambda seed: run_episodes(CONFIG, lambda env: torch.zeros(4, env.num_actions), script, 0.5, seed).error  # noqa: E731
    np.testing.assert_array_equal(play(1), play(1))
    assert not np.array_equal(play(1), play(2))


@pytest.fixture(scope="module")
def file(run):
    """That training as a policy file."""
    release(run, run / "basics.onnx", "last.pt")
    return run / "basics.onnx"


@pytest.mark.slow
def test_the_file_does_what_the_checkpoint_does(run, file):
    """On the same robots, tick by tick, through switches, pushes and falls: the torch graph and the exported file."""
    graph = load_graph(run, "last.pt")
    config = dataclasses.replace(graph.config, push_speed=(0.8, 0.8), push=(0.1, 0.5))
    env = Env(config, 0, random_script(config, LABELS, 4, 2.0, every=0.3), level=1.0)
    ours, theirs, fell = graph_actor(graph), FileActor(file, 4), 0
    with torch.no_grad():
        for _ in range(100):
            action = ours(env)
            torch.testing.assert_close(theirs(env), action, atol=1e-5, rtol=0)
            env.step(action)
            fell += int(env.failures.sum())
    assert fell > 0  # so that starting anew was part of it


@pytest.mark.slow
def test_a_file_made_with_other_settings_is_refused(run, file):
    other = dataclasses.replace(load_graph(run, "last.pt").config, balance_gain=0.0)
    with pytest.raises(Sim2realError, match="other settings"):
        run_episodes(other, FileActor(file, 1), skill_script(other, 1, 1, 0.1))


@pytest.mark.slow
def test_the_file_carries_its_proof(file):
    policy = load_policy(file, trial=0)
    assert policy.golden_error <= 1e-4 and len(policy.contract.golden) >= 3
    assert set(policy.contract.envelope) == {n for n in policy.contract.inputs if not n.startswith("carry_")}


@pytest.mark.slow
def test_the_released_file_stands_in_the_deployed_loop(file):
    summary = deploy_episode(file, CONFIG, [("stand", 1.0), ("wave", 0.5)], seed=1)
    assert stayed_up(summary, 1.5), summary
    assert not stayed_up(dataclasses.replace(summary, faults=["S2R-014"]), 1.5)
    assert not stayed_up(summary, 3.0)


def test_golden_sequences_switch_skills_and_start_at_the_start(run):
    for sequence in golden_sequences(load_graph(run, "last.pt")):
        assert len(sequence["skill"]) >= 20
        assert len(np.unique(sequence["skill"].argmax(-1))) > 1


def test_pushes_keep_to_their_size_and_spare_the_first_second():
    pushes = list(random_pushes(np.random.default_rng(0), CONFIG, 60.0, 0.5))
    assert len(pushes) > 10
    assert min(t for t, _ in pushes) > 1.0
    assert max(np.hypot(x, y) for _, (x, y, _) in pushes) <= 0.5


@pytest.mark.slow
def test_the_card_says_what_was_measured(file):
    policy = load_policy(file, trial=0)
    labels = policy.contract.skill_labels
    rates = {label: Rate(7 + k, 20) for k, label in enumerate(labels)}
    pairs, script = switch_script(CONFIG, LABELS, 2)
    switched = Episodes(
        np.arange(len(script)) > 1, np.zeros(len(script)), np.zeros(len(script)), np.zeros((len(script), 2))
    )
    single = {"0.2": Rate(20, 20), "0.3": Rate(13, 20), "0.4": Rate(9, 20), "0.5": Rate(3, 20)}
    e = Evaluation("ab" * 32, rates, rates, {label: 0.04 for label in labels}, single,
                   by([f"{labels[a]} > {labels[b]}" for a, b in pairs], switched, 2),
                   Rate(19, 20), (0.48, -0.01), Rate(18, 20), Rate(16, 20), Rate(9, 20), 0.07, "left_knee_joint", 0.61, ["S2R-009"])  # fmt: skip
    text = card(policy.contract, e)
    assert all(str(rate) in text for rate in rates.values())
    assert "100%, 65%, 45%, 15%" in text
    assert "+10.0 points" in text and "S2R-009" in text and f"`{labels[0]} > {labels[1]}`, 0 of 2" in text
    document = json.loads(json.dumps(e.as_dict()))
    assert document["deployed"]["value"] == 0.8 and document["gap"] == pytest.approx(10.0)
    assert document["calm"]["stand"]["interval"][0] < 0.35 < document["calm"]["stand"]["interval"][1]
