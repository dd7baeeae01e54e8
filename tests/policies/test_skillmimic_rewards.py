"""Every sub-reward against its equation, and the variants against theirs."""

from __future__ import annotations

import numpy as np
import pytest

from policies.skillmimic.rewards import CODE, DEEPMIMIC, PAPER, ROBOT, VARIANTS, Motion, Sensitivity, Step, reward

N, K, J, E, A = 3, 15, 29, 3, 29


def motion(**changes: np.ndarray) -> Motion:
    zero = Motion(
        points=np.zeros((N, K, 3)),
        points_velocity=np.zeros((N, K, 3)),
        orientation_base_in_world=np.tile([1.0, 0, 0, 0], (N, 1)),
        joint_pos=np.zeros((N, J)),
        joint_vel=np.zeros((N, J)),
        object_position=np.zeros((N, 3)),
        object_velocity=np.zeros((N, 3)),
        contact=np.zeros((N, E)),
    )
    return zero._replace(**changes)


def step(state: Motion, **more: np.ndarray) -> Step:
    rest = {"joint_acceleration": np.zeros((N, J)), "action_change": np.zeros((N, A)), "height": np.full(N, 0.79),
            "height_reference": np.full(N, 0.79), "up": np.ones(N), "up_reference": np.ones(N), "bounces": np.zeros(N, bool)}  # fmt: skip
    return Step(state, motion(), **(rest | more))


def terms_of(s: Step, k: Sensitivity, variant: str = "skillmimic") -> dict[str, float]:
    return {name: float(term[0]) for name, term in reward(s, variant, k)[1].items()}


@pytest.mark.parametrize("variant", [v for v in VARIANTS if v != "amp"])
@pytest.mark.parametrize("k", [PAPER, CODE, ROBOT, DEEPMIMIC])
def test_the_reference_itself_earns_one(variant, k):
    total, terms = reward(step(motion()), variant, k)
    np.testing.assert_allclose(total, 1.0)
    assert all(np.allclose(term, 1.0) for term in terms.values())


@pytest.mark.parametrize(
    ("changed", "size", "term", "value"),
    [
        # the errors are means over coordinates: an offset of 0.1 in every one is an MSE of 0.01
        ("points", (N, K, 3), "body", np.exp(-20 * 0.01)),
        ("points", (N, K, 3), "relative", np.exp(-20 * 0.01)),
        ("joint_pos", (N, J), "body", np.exp(-20 * 0.01 * J / (J + 3))),  # three more: the base's rotation
        ("object_position", (N, 3), "object", np.exp(-20 * 0.01)),
        ("object_position", (N, 3), "relative", np.exp(-20 * 0.01)),
    ],
)
def test_table_7(changed, size, term, value):
    assert terms_of(step(motion(**{changed: np.full(size, 0.1)})), PAPER)[term] == pytest.approx(value)


@pytest.mark.parametrize("changed", ["points_velocity", "joint_vel", "object_velocity"])
def test_velocities_are_free_in_the_paper_and_can_be_priced(changed):
    s = step(motion(**{changed: np.ones_like(getattr(motion(), changed))}))
    assert reward(s, "skillmimic", PAPER)[0][0] == pytest.approx(1.0)
    priced = Sensitivity(body_velocity=0.1, joint_velocity=0.1, object_velocity=0.1)
    assert reward(s, "skillmimic", priced)[0][0] == pytest.approx(np.exp(-0.1))


def test_a_turned_base_costs_its_angle():
    turned = np.tile([np.cos(0.15), 0, 0, np.sin(0.15)], (N, 1))  # 0.3 rad
    expected = np.exp(-20 * 0.3**2 / (J + 3))
    assert terms_of(step(motion(orientation_base_in_world=turned)), PAPER)["body"] == pytest.approx(expected)
    again = terms_of(step(motion(orientation_base_in_world=-turned)), PAPER)["body"]  # the same rotation
    assert again == pytest.approx(expected)


def test_every_wrong_edge_costs_exp_minus_five():
    wrong = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0]], float)
    _, terms = reward(step(motion(contact=wrong)), "skillmimic", PAPER)
    np.testing.assert_allclose(terms["contact"], np.exp([0.0, -5.0, -10.0]))


def test_a_ball_that_moves_with_the_body_keeps_its_relative_reward():
    s = step(motion(points=np.full((N, K, 3), 0.1), object_position=np.full((N, 3), 0.1)))
    assert terms_of(s, PAPER)["relative"] == pytest.approx(1.0)


def test_the_papers_regulariser_sees_only_joints_whose_reference_stands_still():
    shaking = {"joint_acceleration": np.full((N, J), 10.0)}
    assert terms_of(step(motion(), **shaking), PAPER)["regulariser"] == pytest.approx(np.exp(-100.0))
    moving = step(motion(), **shaking)._replace(reference=motion(joint_vel=np.full((N, J), 0.1)))
    assert terms_of(moving, PAPER)["regulariser"] == pytest.approx(1.0)


def test_the_robots_regulariser_sees_jitter_whatever_the_reference():
    shaking = {"joint_acceleration": np.full((N, J), 30.0)}
    assert terms_of(step(motion(), **shaking), ROBOT)["regulariser"] == pytest.approx(np.exp(-1e-5 * 900 / 0.25))
    hasty = {"action_change": np.ones((N, A))}
    assert terms_of(step(motion(), **hasty), ROBOT)["regulariser"] == pytest.approx(np.exp(-0.1))


def test_how_variants_combine():
    s = step(motion(object_position=np.full((N, 3), 0.2), contact=np.tile([1.0, 0, 0], (N, 1))))
    full = terms_of(s, PAPER)
    total = {v: reward(s, v, PAPER)[0][0] for v in VARIANTS}
    assert total["skillmimic"] == pytest.approx(np.prod(list(full.values())))
    assert total["no_cgr"] == pytest.approx(total["skillmimic"] / full["contact"])
    assert total["no_multiplication"] == pytest.approx(np.mean(list(full.values())))
    assert total["deepmimic"] == pytest.approx((3 + full["object"]) / 4)
    assert total["amp"] == 0.0


def test_the_released_code_forgives_the_ball():
    s = step(motion(object_position=np.full((N, 3), 0.3)))
    assert terms_of(s, CODE)["object"] == pytest.approx(np.exp(-0.09))
    assert terms_of(s, PAPER)["object"] == pytest.approx(np.exp(-1.8))


@pytest.mark.parametrize(
    ("changed", "value", "term", "expected"),
    [
        ("object_position", [0.1, 0.0, 0.0], "returns", np.exp(-((0.1 / 0.2) ** 2))),
        ("object_position", [0.0, 0.0, -0.2], "lively", np.exp(-1)),  # as a height: too low costs more than too high
        ("object_position", [0.0, 0.0, 0.3], "lively", np.exp(-1)),
        ("object_velocity", [0.0, 0.0, 2.0], "lively", np.exp(-((4 / 2 / 9.81 / 0.3) ** 2))),
    ],
)
def test_a_bounced_ball_goes_up_and_down_at_its_place(changed, value, term, expected):
    s = step(motion(**{changed: np.tile(value, (N, 1))}))
    found = terms_of(s, ROBOT, "bounces")
    assert found[term] == pytest.approx(expected)
    assert all(x == pytest.approx(1.0) for name, x in found.items() if name != term)


@pytest.mark.parametrize("whose", ["state", "reference"])
def test_the_energy_of_a_ball_in_the_hand_is_nobodys_business(whose):
    s = step(motion(object_position=np.tile([0.0, 0.0, -0.5], (N, 1))))
    s = s._replace(**{whose: getattr(s, whose)._replace(contact=np.ones((N, E)))})
    assert terms_of(s, ROBOT, "bounces")["lively"] == 1.0


def test_what_a_bounced_ball_is_worth():
    s = step(motion(object_position=np.tile([0.2, 0.0, 0.0], (N, 1))), action_change=np.full((N, A), 1.0))
    near = np.exp(-1)
    expected = (0.1 + 0.4 * near + 0.2 + 0.3 * near) * np.exp(-0.1)
    assert reward(s, "bounces", ROBOT)[0][0] == pytest.approx(expected)


FLOOR, DROP = 0.09, np.sqrt(2 * 9.81 * 0.4)  # m of a ball that lies; m/s after 0.4 m


@pytest.mark.parametrize(
    ("height", "upwards", "seconds"),
    [
        (0.7499999, 1.0, 0.0),  # that high it is met, now
        (0.75 - 0.1962, 2.4525, 0.1),  # it slows down to 1.4715 m/s on its way
        (0.75 - 0.3, 1.962, 0.2),  # not so high: to its peak
        (FLOOR + 0.4, 0.0, DROP / 9.81 + 0.8 * DROP / 9.81),  # down, and up to its peak
        (FLOOR, -5.0, (4.0 - np.sqrt(16.0 - 2 * 9.81 * 0.66)) / 9.81),  # it bounces now, with 0.8 of its speed
        (1.0, 2.0, None),  # above, and on its way there and back
    ],
)
def test_where_a_bounced_ball_comes_up_counts(height, upwards, seconds):
    position, velocity = np.tile([0.1, 0.0, height], (N, 1)), np.tile([-0.5, 0.3, upwards], (N, 1))
    there = step(motion(object_position=position, object_velocity=velocity))
    if seconds is None:
        hits = np.sqrt(4.0 + 2 * 9.81 * 0.91)
        seconds = (2.0 + hits) / 9.81 + (0.8 * hits - np.sqrt((0.8 * hits) ** 2 - 2 * 9.81 * 0.66)) / 9.81
    off = np.hypot(0.1 - 0.5 * seconds, 0.3 * seconds)
    assert terms_of(there, ROBOT, "bounces")["returns"] == pytest.approx(np.exp(-((off / 0.2) ** 2)))
