"""Every observation, reward and termination term on its own."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
import torch

from policies.basics import Basics
from policies.graph import PolicyGraph
from policies.observations import TERMS, Signals, gravity_in_base, observe
from policies.rewards import REWARDS, Tick, reward
from policies.terminations import TERMINATIONS, failed

N, JOINTS, LABELS, DRIVEN = 5, 29, 5, 15


def signals(seed: int = 0) -> Signals:
    g = torch.Generator().manual_seed(seed)
    random = lambda k: torch.randn(N, k, generator=g)  # noqa: E731
    gravity = torch.nn.functional.normalize(random(3), dim=-1)
    once = torch.rand(N, 2, generator=g)
    return Signals(random(JOINTS), random(JOINTS), gravity, random(3), torch.eye(LABELS), torch.zeros(JOINTS), once[:, :1],
                   random(JOINTS), random(3), once[:, 1:], random(2), random(JOINTS), random(DRIVEN))  # fmt: skip


def tick(**changes: np.ndarray) -> Tick:
    """A robot that stands exactly where it should."""
    zeros = lambda k: np.zeros((N, k))  # noqa: E731
    perfect = Tick(zeros(JOINTS), zeros(JOINTS), np.tile([0.0, 0.0, -1.0], (N, 1)), zeros(2), zeros(3), zeros(3), np.ones(N),
                   np.full(N, 0.78), np.full(N, 0.78), zeros(JOINTS), zeros(JOINTS), zeros(JOINTS))  # fmt: skip
    return perfect._replace(**changes)


@pytest.mark.parametrize("name", TERMS)
def test_observation_term_is_a_finite_row_per_robot(name):
    value = TERMS[name].term(signals())
    assert value.shape[0] == N and value.ndim == 2 and torch.isfinite(value).all()


def test_observation_has_the_size_that_the_graph_declares():
    assert observe(signals()).shape == (N, *PolicyGraph(Basics()).outputs()["observation"])


def test_gravity_in_base_agrees_with_mujoco():
    for orientation in torch.nn.functional.normalize(
        torch.randn(N, 4, generator=torch.Generator().manual_seed(0)), dim=-1
    ):
        matrix = np.zeros(9)
        mujoco.mju_quat2Mat(matrix, orientation.double().numpy())
        expected = matrix.reshape(3, 3).T @ [0.0, 0.0, -1.0]
        np.testing.assert_allclose(gravity_in_base(orientation[None])[0], expected, atol=1e-6)


@pytest.mark.parametrize("name", REWARDS)
def test_reward_term_is_a_finite_number_per_robot(name):
    rng = np.random.default_rng(0)
    random = Tick(*(rng.normal(size=np.shape(field)) for field in tick()))
    value = REWARDS[name].term(random)
    assert value.shape == (N,) and np.isfinite(value).all()


def test_reward_is_one_for_a_robot_that_does_everything_right():
    np.testing.assert_allclose(reward(tick()), 1.0)


@pytest.mark.parametrize(
    ("name", "change"),
    [
        ("upper_body", {"joint_pos": np.eye(N, JOINTS, 15)}),
        ("legs", {"joint_pos": np.eye(N, JOINTS)}),
        ("upright", {"gravity_in_base": np.tile([0.3, 0.0, -0.95], (N, 1))}),
        ("height", {"height": np.full(N, 0.6)}),
        ("rest", {"resting": np.zeros(N)}),
        ("velocity", {"velocity": np.full((N, 2), 0.5)}),
        ("velocity", {"command": np.full((N, 3), 0.5)}),
        ("turn", {"angular_velocity_base_in_base": np.tile([0.0, 0.0, 0.5], (N, 1))}),
        ("steady", {"angular_velocity_base_in_base": np.full((N, 3), 1.0)}),
        ("action_rate", {"action": np.full((N, JOINTS), 0.5)}),
        ("action", {"action": np.full((N, JOINTS), 0.5)}),
        ("joint_vel", {"joint_vel": np.full((N, JOINTS), 3.0)}),
    ],
)
def test_reward_term_falls_when_its_subject_gets_worse(name, change):
    term = REWARDS[name]
    assert np.all(term.weight * term.term(tick(**change)) < term.weight * term.term(tick()) - 1e-3)


def test_where_the_robot_stands_costs_nothing():
    """A recovery step must not be punished: no term knows the base's horizontal position."""
    assert not {"position", "x", "y"} & set(Tick._fields)


def test_a_standing_robot_has_not_failed():
    assert not failed(tick()).any()


@pytest.mark.parametrize(
    ("name", "change"),
    [
        ("tilt", {"gravity_in_base": np.tile([np.sin(0.81), 0.0, -np.cos(0.81)], (N, 1))}),
        ("height", {"height": np.full(N, 0.52)}),
        ("broken", {"joint_vel": np.full((N, JOINTS), np.nan)}),
    ],
)
def test_termination_ends_the_episode(name, change):
    assert TERMINATIONS[name](tick(**change)).all()
    assert failed(tick(**change)).all()


def test_a_tilt_just_inside_is_no_failure():
    assert not failed(tick(gravity_in_base=np.tile([np.sin(0.79), 0.0, -np.cos(0.79)], (N, 1)))).any()
