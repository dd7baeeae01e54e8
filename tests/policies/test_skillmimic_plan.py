"""The plan of the arms: its clock, its corrections, its feedback, and the search that finds them."""

from __future__ import annotations

import dataclasses

import mujoco
import numpy as np
import pytest
import torch
import yaml

from drivers.sim.ball import MASS
from policies.clips.library import robot_clips
from policies.gait import EVEN, Gait
from policies.skillmimic.clips import grip
from policies.skillmimic.config import TASKS
from policies.skillmimic.env import Env
from policies.skillmimic.graph import PULL, PolicyGraph
from policies.skillmimic.optimise import Search, optimise, score, write
from policies.skillmimic.plan import (
    APPROACH,
    DEAD,
    KNOTS,
    LOST,
    REACH,
    RESTED,
    SETTLE,
    TIPS,
    Correction,
    Plan,
    Rows,
    read,
    samples,
)
from sim2real.types import Sim2realError

ARMS, T = 2, 8
NONE = [0.0] * len(REACH)


def axis(up: float, tip: float = 0.0, aside: float = 0.0) -> list[float]:
    """Gains of what moves up, and of the tipping forwards and aside."""
    return [0.0, 0.0, up, tip, aside]


def rows(loop: bool = False, pull: float = 0.0, ready: bool = False, bends: bool = False, away: int = T) -> Rows:
    """A ball that flies forwards at 1 m/s, 2 cm a row, one joint that follows the row's number, and a base that goes down."""
    t = np.arange(T)
    ball = np.column_stack([t * 0.02, np.zeros(T), np.zeros(T)])
    back = np.zeros((T, ARMS, 5))
    back[:, 1, 2] = 2.0  # a metre up is two radians of the second joint
    back[:, 0, 3] = 1.0  # the first one tips the palm forwards,
    back[:, 1, 4] = 1.0  # and the second to the left
    target, pose = np.column_stack([t * 0.1, np.zeros(T)]), np.column_stack([-t * 0.2, np.zeros(T), np.zeros(T)])
    velocity = np.tile([1.0, 0, 0], (T, 1))
    return Rows(
        target,
        pose,
        ball,
        velocity,
        back,
        loop,
        loop or ready,
        bends,
        np.arange(T) >= away,
        np.full(T, pull),
        np.zeros(T),
    )


def correction(offset: float = 0.0, follow: list[float] = NONE, damp: list[float] = NONE) -> Correction:
    return Correction(np.tile([offset, 0.0], (KNOTS, 1)), np.array(follow), np.array(damp))


def at(
    plan: Plan, clock: float, ball: list[float], skill: int = 0, before: int = 0, target: float = 0.0, calm: bool = True
):
    one, last, seen = torch.eye(len(plan.first)), torch.full((1, ARMS), target), torch.tensor([ball]).float()
    return plan(one[[skill]], one[[before]], torch.tensor([[clock]]), last, seen, torch.tensor([[calm]]))


def where(row: float) -> list[float]:
    """The ball that the plan has there."""
    return [row * 0.02, 0.0, 0.0, 1.0, 0.0, 0.0]


def test_a_clock_runs_a_row_a_tick_and_stays_at_the_end():
    plan = Plan([rows()], [correction()])
    p = at(plan, 3.0, where(4))
    assert float(p.clock) == 4.0
    np.testing.assert_allclose(p.target, [[0.4, 0.0]], atol=1e-6)
    np.testing.assert_allclose(p.ball_error, np.zeros((1, 6)), atol=1e-6)
    assert float(at(plan, T - 1.0, where(7)).clock) == T - 1


def test_a_loop_begins_again():
    plan = Plan([rows(loop=True)], [correction()])
    assert float(at(plan, T - 1.0, where(0)).clock) == 0.0


def test_a_skill_begins_at_its_first_row():
    plan = Plan([rows(), rows()], [correction()] * 2)
    assert float(at(plan, 5.0, where(0), skill=1, before=0).clock) == 0.0
    assert float(at(plan, 5.0, where(6), skill=1, before=1).clock) == 6.0


@pytest.mark.parametrize(("ball", "rate"), [(where(3), 1.0), (where(1), None), ([-5.0, 0, 0, 1, 0, 0], 0.0),
                                            ([5.0, 0, 0, 1, 0, 0], 2.0)])  # fmt: skip
def test_a_clock_that_follows_the_ball_waits_for_it_and_hurries_after_it(ball, rate):
    """At row 3, 1 m/s: a ball two rows behind slows the clock by PULL x 0.04 m x v / (v^2 + 0.5^2)."""
    got = float(at(Plan([rows(pull=PULL)], [correction()]), 3.0, ball).clock) - 3.0
    assert got == pytest.approx(1 - PULL * 0.04 / 1.25 if rate is None else rate, abs=1e-5)


@pytest.mark.parametrize(("row", "speed", "seconds"), [(6, 2.0, 0.0), (6, 1.0, 1 / 9.81), (6, 3.0, -1 / 9.81),
                                                       (6, -3.0, -1 / 9.81)])  # fmt: skip
def test_a_bouncing_balls_velocity_tells_the_time_however_high_it_gets(row, speed, seconds):
    """The plan falls to -4 m/s in four rows, leaves the floor at 2 m/s, and is there at row 6. A slower ball has risen
    for longer; one that falls at 3 m/s is 0.1 s before the floor."""
    some = rows(loop=True, pull=1.0)
    some.velocity[:] = np.column_stack([np.zeros((T, 2)), [0, -1, -2, -3, -4, 2, 2, 0]])
    ball = [0.1, 0.0, -0.3, 0.0, 0.0, speed]
    assert float(at(Plan([some], [correction()]), float(row), ball).clock) == pytest.approx(row + 1 + seconds, abs=1e-5)


def test_offsets_are_spread_over_the_rows_by_their_knots():
    plain = rows()
    np.testing.assert_allclose(plain.knots.sum(axis=1), np.ones(T))
    assert plain.knots[0, 0] == plain.knots[-1, -1] == 1.0
    around = rows(loop=True).knots
    np.testing.assert_allclose(around.sum(axis=1), np.ones(T))
    late = at(Plan([rows()], [correction(offset=0.3)]), 3.0, where(4))
    np.testing.assert_allclose(late.target, [[0.7, 0.0]], atol=1e-6)


def test_palms_follow_a_ball_that_is_elsewhere_as_far_as_they_reach():
    plan = Plan([rows()], [correction(follow=axis(0.5), damp=axis(0.1))])
    off = [0.08, 0.0, 0.04, 1.0, 0.0, 0.2]  # 4 cm up, and on its way at 0.2 m/s
    np.testing.assert_allclose(at(plan, 3.0, off).target, [[0.4, 2.0 * (0.5 * 0.04 + 0.1 * 0.2)]], atol=1e-6)
    np.testing.assert_allclose(at(plan, 3.0, [0, 0, 9, 1, 0, 0]).target, [[0.4, 2.0 * REACH[2]]], atol=1e-6)


def test_a_palm_that_meets_a_ball_goes_to_where_that_will_be():
    meets = rows()
    meets.left[:] = 0.3
    meets.back[:, 1, 0] = 2.0  # a metre ahead is two radians of the second joint
    off = [0.08 + 0.01, 0.0, 0.0, 1.2, 0.0, 0.0]  # 1 cm ahead, and 0.2 m/s too fast for 0.3 s
    p = at(Plan([meets], [correction(follow=[0.5, 0.0, 0.0, 0.0, 0.0])]), 3.0, off)
    np.testing.assert_allclose(p.target, [[0.4, 2.0 * 0.5 * (0.01 + 0.3 * 0.2)]], atol=1e-6)


@pytest.mark.parametrize(
    ("clock", "speed", "after"), [(0.0, 0.0, 0.0), (0.0, 4.0, 1.0), (3.0, 0.0, 4.0), (-2.0, 0.0, -1.0)]
)
def test_a_bounce_waits_at_its_beginning_for_whoever_holds_the_ball(clock, speed, after):
    some = rows(loop=True)
    some.velocity[:] = [0.0, 0.0, 4.0]
    assert float(at(Plan([some], [correction()]), clock, [0.0, 0.0, 0.0, 0.0, 0.0, speed]).clock) == after


def test_a_bounce_that_begins_with_a_ball_at_rest_waits_for_nobody():
    some = rows(loop=True)
    some.velocity[:] = 0.0
    assert float(at(Plan([some], [correction()]), 0.0, [0.0] * 6).clock) == 1.0


def test_palms_tip_after_a_ball_that_runs_away():
    ahead = Plan([rows()], [correction(follow=axis(0.0, tip=2.0), damp=axis(0.0, tip=1.0))])
    p = at(ahead, 3.0, [0.08 + 0.05, 0.0, 0.0, 1.1, 0.0, 0.0])
    np.testing.assert_allclose(p.target, [[0.4 + 2.0 * 0.05 + 0.1, 0.0]], atol=1e-6)
    aside = Plan([rows()], [correction(follow=axis(0.0, aside=2.0))])
    p = at(aside, 3.0, [0.08, 0.05, 0.0, 1.0, 0.0, 0.0])
    np.testing.assert_allclose(p.target, [[0.4, 2.0 * 0.05]], atol=1e-6)


def test_arms_come_slowly_to_where_a_skill_begins_and_follow_it_at_once_from_there():
    plan = Plan([rows(), rows()], [correction()] * 2)
    begin = at(plan, 5.0, where(0), skill=1, before=0, target=1.0)
    np.testing.assert_allclose(begin.target, [[1.0 - APPROACH, 1.0 - APPROACH]], atol=1e-6)
    then = at(plan, 0.0, where(1), skill=1, before=1, target=1.0)
    np.testing.assert_allclose(then.target, [[0.1, 0.0]], atol=1e-6)


def test_a_loop_begins_when_the_arms_are_where_it_does():
    plan = Plan([rows(), rows(loop=True)], [correction()] * 2)
    begin = at(plan, 5.0, where(0), skill=1, before=0, target=1.0)
    np.testing.assert_allclose(begin.target, [[1.0 - APPROACH, 1.0 - APPROACH]], atol=1e-6)
    np.testing.assert_allclose(begin.clock, [[-1.0 / APPROACH]], atol=1e-4)
    waits = at(plan, -3.5, where(0), skill=1, before=1, target=0.1)
    np.testing.assert_allclose(waits.clock, [[-2.5]], atol=1e-6)
    np.testing.assert_allclose(waits.target, [[0.1 - APPROACH] * 2], atol=1e-6)
    again = at(plan, T - 0.5, where(0), skill=1, before=1, target=1.0)  # around, and at once
    np.testing.assert_allclose(again.clock, [[0.5]], atol=1e-6)
    np.testing.assert_allclose(again.target, [[0.05, 0.0]], atol=1e-6)


def test_a_ball_that_lies_waits_for_the_arms_too_and_the_base_with_them():
    plan = Plan([rows(), rows(ready=True)], [correction()] * 2)
    p = at(plan, 5.0, where(0), skill=1, before=0, target=3.5 * APPROACH)
    assert float(p.clock) == pytest.approx(-3.5)
    np.testing.assert_allclose(p.pose, [[0.0, 0.0, 0.0]], atol=1e-6)
    np.testing.assert_allclose(at(plan, 2.5, where(3), skill=1, before=1).pose, [[-0.7, 0.0, 0.0]], atol=1e-6)


@pytest.mark.parametrize(("clock", "ball", "goes_on"), [(5.0, where(5), True), (3.0, where(3), False),
                                                        (5.0, [5.0, 0, 0, 1, 0, 0], False)])  # fmt: skip
def test_a_ball_in_the_air_is_caught_before_another_skill_begins_unless_it_is_lost(clock, ball, goes_on):
    plan, one = Plan([rows(loop=True, away=4), rows()], [correction()] * 2), torch.eye(2)
    done = plan.performed(one[[1]], one[[0]], torch.tensor([[clock]]), torch.tensor([ball]).float())
    assert torch.equal(done, one[[0 if goes_on else 1]])


def test_at_the_first_tick_there_is_nothing_to_finish():
    plan, one = Plan([rows(loop=True, away=0), rows()], [correction()] * 2), torch.eye(2)
    assert torch.equal(plan.performed(one[[1]], 0 * one[[0]], torch.zeros(1, 1), torch.zeros(1, 6)), one[[1]])


def test_no_ball_is_let_go_while_the_feet_step():
    plan = Plan([rows(loop=True, away=4)], [correction()])
    clocks = {
        calm: [float(at(plan, c, where(c + 1), calm=calm).clock) for c in (1.5, 2.0, 2.5, 3.0, 5.0)]
        for calm in (True, False)
    }
    assert clocks[True] == [2.5, 3.0, 3.5, 4.0, 6.0]
    assert clocks[False] == [2.5, 2.0, 2.5, 4.0, 6.0]  # from 3.0 on hands open: they do not stop half-way


def test_legs_bend_when_the_feet_have_rested_for_a_while():
    plan = Plan([rows(), rows(ready=True, bends=True)], [correction()] * 2)
    assert float(at(plan, 5.0, where(0), skill=1, before=0).clock) == -SETTLE
    clocks = [float(at(plan, -3.0, where(0), skill=1, before=1, calm=calm).clock) for calm in (True, False)]
    assert clocks == [-2.0, -3.0]


def test_palms_do_not_follow_a_ball_that_the_plan_still_waits_for():
    plan = Plan([rows(pull=PULL)], [correction(follow=axis(0.5))])
    coming = [-5.0, 0.0, 0.1, 1.0, 0.0, 0.0]
    p = at(plan, 3.0, coming)
    assert float(p.clock) == 3.0
    np.testing.assert_allclose(p.target, [[0.3, 0.0]], atol=1e-6)


@pytest.mark.parametrize(("ball", "lost"), [
    (where(3), False),
    ([0.06, 0.0, -DEAD - 0.01, 1.0, 0.0, 0.0], True),  # it comes up to no hand
    ([0.06, 0.0, -DEAD - 0.01, 1.0, 0.0, 1.0], False),  # but for its speed
    ([0.06, LOST + 0.01, 0.0, 1.0, 0.0, 0.0], True),
    ([0.06, LOST - 0.01, 0.0, 1.0, 0.0, 0.0], False),
])  # fmt: skip
def test_arms_stand_still_while_a_ball_that_a_palm_is_to_meet_is_lost(ball, lost):
    met = rows(loop=True)
    met.left[2] = 0.1
    plan = Plan([met], [correction(follow=[0.0, 0.0, 0.5, 0.0, 0.0])])
    p = at(plan, 3.0, ball, target=0.3)
    assert bool(p.lost) == lost and float(p.clock) == (3.0 if lost else 4.0)
    if lost:
        np.testing.assert_allclose(p.target, [[0.3, 0.0]], atol=1e-6)
    assert not at(plan, 0.5, ball).lost  # nobody has brought it yet
    assert not at(Plan([rows(loop=True)], [correction()]), 3.0, ball).lost  # which two palms catch, or nobody meets


def test_what_was_found_is_read_back(tmp_path):
    path = tmp_path / "plan.yaml"
    some = Correction(
        np.round(np.random.default_rng(0).normal(size=(KNOTS, ARMS)), 4), np.ones(len(REACH)), np.zeros(len(REACH))
    )
    write(path, "catch", some, 10)
    write(path, "catch", some, 5)
    write(path, "pass", correction())
    (there, none) = read(path, ["catch", "hold"], ARMS)
    for a, b in zip(there, some, strict=True):
        np.testing.assert_allclose(a, b)
    assert not none.offsets.any() and not none.follow.any()
    assert samples(path, ["catch", "pass", "hold"]) == 15
    document = yaml.safe_load(path.read_text())
    document["catch"]["offsets"] = [[0.0]]
    path.write_text(yaml.safe_dump(document))
    with pytest.raises(Sim2realError, match=r"'catch': got offsets \(1, 1\).*expected"):
        read(path, ["catch"], ARMS)


@pytest.fixture(scope="module")
def graph():
    config = dataclasses.replace(TASKS["g1-ball"], envs=8, threads=1, anywhere=False, push_chance=0.0)
    return PolicyGraph(config)


def test_a_base_walks_no_faster_than_its_skill_is_trained_for(graph):
    skill = torch.eye(len(graph.labels))
    fast, back = (
        dict(zip(graph.labels, graph.told(x * torch.ones(1, 3), skill).tolist(), strict=True)) for x in (2.0, -2.0)
    )
    assert fast["hold"] == [0.0] * 3 and fast["bounce_walk"] == pytest.approx([0.3, 0.1, 0.3])
    assert back["bounce_walk"] == pytest.approx([0.0, -0.1, -0.3])  # it may stand, and goes not backwards
    assert fast["carry"] == pytest.approx(graph.base.config.command_high)


def test_feet_have_rested_only_when_they_have_done_so_for_a_while(graph):
    env = Env(graph.config, 3, graph, "hold")
    steps = torch.tensor([0.0, 0.5, 0.4, 0.0])
    env.carries["carry_base_gait"][:4, 0], env.carries["carry_rested"][:4, 0] = steps, torch.tensor([0.0, 6, 9, 20])
    env._observe()
    assert env.measured.carried["carry_rested"][:4, 0].tolist() == [1, 7, 0, 21]


def test_a_skill_that_may_stand_does_so_in_some_episodes(graph):
    commands = {label: graph.draw(np.random.default_rng(0), np.full(200, k)) for k, label in enumerate(graph.labels)}
    stands = {label: float((x == 0).all(axis=1).mean()) for label, x in commands.items()}
    assert stands["hold"] == 1 and stands["bounce_walk"] == 0 and 0.2 < stands["carry"] < 0.4
    forward = commands["bounce_walk"][:, 0]
    assert 0.1 <= forward.min() and forward.max() <= 0.3


@pytest.mark.slow
@pytest.mark.parametrize(("skill", "phases"), [("bounce", ()), ("bounce_walk", EVEN)])
def test_a_ball_is_let_go_by_feet_that_rest_or_in_the_even_part_of_a_step(graph, skill, phases):
    env = Env(graph.config, 5, graph, skill)
    k, let_go = graph.labels.index(skill), []
    now = lambda: (graph.plan.first[k] + env.carries["carry_clock"].clamp(min=0).floor())[:, 0].long()  # noqa: E731
    away = lambda: graph.plan.away[graph.plan.following[now()]][:, 0]  # noqa: E731
    with torch.no_grad():
        for _ in range(100):
            before, gait = away(), env.carries["carry_base_gait"][:, 0].clone()
            rested = env.carries["carry_rested"][:, 0] + 1
            env.step(torch.zeros(env.num_envs, env.num_actions))
            going = (before == 0) & (away() > 0) & (env.episode_length_buf > 1)
            let_go += gait[going].tolist()
            assert (rested[going & Gait.resting(gait)] >= RESTED).all()
    steps = [2 * p % 1 for p in let_go]
    assert len(let_go) > 4 and all(s == 0 or (phases and phases[0] < s < phases[1]) for s in steps)


def test_both_arms_are_corrected_alike_but_for_a_dribble(graph):
    names = [graph.joint_names[j] for j in graph.acting]
    for label in graph.labels:
        search = Search(graph, graph.labels.index(label))
        size = search.count * int(search.free.sum()) + 2 * len(REACH)
        c = search.correction(np.arange(1.0, size + 1))
        moved = {names[k].partition("_")[0] for k in np.flatnonzero(np.abs(c.offsets).max(axis=0))}
        assert moved == ({"right"} if label == "dribble_in_place" else {"left", "right"})
        assert search.count == (1 if label in graph.config.swing else KNOTS)
        expected = np.arange(1.0, size + 1)
        if label != "dribble_in_place":  # a palm tips only under a ball that it alone bounces again and again
            expected[-7:-5] = expected[-2:] = 0.0
        np.testing.assert_allclose(search.vector(c), expected, atol=1e-9)


def test_a_candidate_that_drops_the_ball_scores_less(graph):
    config = dataclasses.replace(graph.config, skills=("hold",), clips=("hold_01",), frames=40)
    one = PolicyGraph(config)
    search = Search(one, 0)
    still = search.vector(Correction(one.plan.offsets[0].numpy(), *np.split(one.plan.follow[0].numpy(), 2)))
    apart = still.copy()
    apart[: -2 * len(REACH)] += np.where([n.endswith("shoulder_roll_joint") for n in one.joint_names if n.startswith("left_")
                            and any(p in n for p in ("shoulder", "elbow", "wrist"))], 6.0, 0.0)  # fmt: skip
    values = score(Env(config, 0, one), np.stack([still, apart]), search, 40)
    assert values[0] > 1.2 and values[1] < 0.6


def test_a_search_keeps_what_it_has_found_after_every_generation(capsys):
    config = dataclasses.replace(TASKS["g1-ball"], clips=("hold_01",), threads=1)
    found: list[Correction] = []
    cost: list[int] = []
    optimise(config, "hold", 2, candidates=4, each=2, keep=lambda c, n: (found.append(c), cost.append(n)),
             seconds=0.2)  # fmt: skip
    assert cost == [10 * 8] * 2  # 0.2 s of eight robots
    assert len(found) == 2 and found[0].offsets.shape == (1, 14)
    assert np.abs(found[1].offsets - found[0].offsets).max() > 0
    assert "hold: 2 of 2, 0 min left" in capsys.readouterr().out


def test_arms_are_told_of_the_weight_of_the_ball_and_of_what_speeds_it_up(graph):
    """Virtual work: both palms a metre up lift the ball's weight by a metre, and a ball that is to fall freely weighs
    nothing."""
    body, model = graph.body, graph.model
    arms = np.array([j.group == "arm" for j in graph.robot.joints])
    clip = next(c for c in robot_clips("g1", "hold") if c.name == "hold_01")
    frames = len(clip)
    here = np.tile(clip.joint_pos[5], (frames, 1))
    still = dataclasses.replace(clip, joint_pos=here, ball_velocity_in_world=np.zeros((frames, 3)))
    fall = np.outer(np.arange(frames) / clip.fps, [0.0, 0.0, -9.81])
    free = dataclasses.replace(still, ball_velocity_in_world=fall)
    none = dataclasses.replace(still, contact=clip.contact & [False, False, True, True])
    held, falling, empty = (
        grip(c, model, body, graph.kp, 0.0).effort[5] * graph.kp * arms for c in (still, free, none)
    )
    data = mujoco.MjData(model)
    data.qpos[:3], data.qpos[3:7] = clip.base_position_in_world[5], clip.base_orientation_in_world[5]
    data.qpos[7:-7] = clip.joint_pos[5]
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    up = np.zeros(len(arms))
    for site in body.palms:
        jacobian = np.zeros((3, model.nv))
        mujoco.mj_jacSite(model, data, jacobian, None, int(site))
        up += np.linalg.pinv(jacobian[:, 6:-6] * arms) @ [0.0, 0.0, 1.0]
    assert (held - empty) @ up == pytest.approx(MASS * 9.81, rel=1e-3)
    assert (falling - empty) @ up == pytest.approx(0.0, abs=0.01)


def test_two_palms_follow_a_ball_on_its_way_up_and_not_when_they_have_it(graph):
    k = graph.labels.index("bounce")
    rows = graph.clips.plan(k, graph.acting, 0.0)
    moves = np.abs(rows.back[:, :, :3]).max(axis=(1, 2))
    falls, rises = rows.velocity[:, 2] < -1.5, rows.velocity[:, 2] > 1.5
    met = int(np.flatnonzero(rises)[-1])
    assert (moves[falls] == 0).all() and (np.diff(moves[rises]) > 0).all()
    assert moves[met] > 1.0  # rad per m
    assert (np.diff(moves[:12]) < 0).all() and (moves[12:met][~rises[12:met]] == 0).all()  # it begins when they have it


def test_a_tipped_palm_turns_and_stays_where_it_is(graph):
    """Of the dribbling hand: what is pushed back is a ball ahead and a ball to the left."""
    k, body = graph.labels.index("dribble_in_place"), graph.body
    clip = int(np.flatnonzero(graph.clips.skill == k)[0])
    row = graph.clips.plan(k, graph.acting, 0.0).back[0]
    data = mujoco.MjData(graph.model)
    normals, places = [], []
    for tips in ([0.0, 0.0], [0.05, 0.0], [0.0, 0.05]):
        data.qpos[:] = graph.clips.qpos[graph.clips.first[clip]]
        data.qpos[7 + np.array(graph.acting)] += row[:, TIPS] @ tips
        mujoco.mj_kinematics(graph.model, data)
        site = body.palms[1]
        normals.append(data.site_xmat[site].reshape(3, 3)[:, 2].copy())
        places.append(data.site_xpos[site].copy())
    flat, forwards, left = normals
    assert flat[2] < -0.98  # the palm looks down
    np.testing.assert_allclose((forwards - flat)[:2], [-0.05, 0.0], atol=0.015)
    np.testing.assert_allclose((left - flat)[:2], [0.0, -0.05], atol=0.015)
    assert np.linalg.norm(np.diff(places, axis=0), axis=1).max() < 0.005


def test_a_palm_that_meets_a_ball_stays_level_and_is_told_how_long_that_rises():
    config = dataclasses.replace(TASKS["g1-dribble"], threads=1, corrections=None)
    graphs = {meets: PolicyGraph(dataclasses.replace(config, meets=meets)) for meets in (config.meets, ())}
    tilts = {}
    for meets, graph in graphs.items():
        (plan, clips), data = (graph.plan, graph.clips), mujoco.MjData(graph.model)
        palm = graph.model.site("right_palm").id
        joints = 7 + np.array(graph.acting)
        data.qpos[:] = clips.qpos[0]
        mujoco.mj_kinematics(graph.model, data)
        before, there = data.site_xmat[palm].reshape(3, 3)[:, 2].copy(), data.site_xpos[palm].copy()
        data.qpos[joints] -= plan.back[0, :, 2].numpy() * 0.02
        mujoco.mj_kinematics(graph.model, data)
        tilts[meets] = np.linalg.norm(data.site_xmat[palm].reshape(3, 3)[:, 2] - before)
        assert -0.025 < (data.site_xpos[palm] - there)[2] < -0.01  # damped: the arm is stretched
    level, free = tilts.values()
    assert level < 0.3 * free
    left, rises = (graphs[config.meets].plan.table[:, k].numpy() for k in (-1, -3))
    np.testing.assert_allclose(left, np.maximum(rises, 0) / 9.81 * (left > 0), atol=1e-6)
    assert 0.4 < left[0] < 0.46 and (left[rises < 0] == 0).all()
    assert not graphs[()].plan.table[:, -1].any()


@pytest.mark.parametrize("lost", [False, True])
def test_nothing_is_done_about_a_ball_that_is_lost(lost):
    """Nor are the file's targets others, or the next tick told of anything."""
    env = Env(dataclasses.replace(TASKS["g1-dribble"], envs=2, threads=1), 0)
    graph, carries = env.graph, {**env.carries, "carry_clock": env.carries["carry_clock"].clamp(min=1.0)}
    env.inputs["object_position_in_base"] += torch.tensor([0.0, 2.0 * lost, 0.0])
    env.measured = graph.signals(**env.inputs, **carries)
    env._act(torch.full((2, env.num_actions), 99.0))
    assert env.measured.lost.all() if lost else not env.measured.lost.all()
    assert (env.action == torch.where(env.measured.lost, 0.0, env.config.action_max)).all()
    assert (env.carries["carry_action"] == env.action).all()
    graph.actor = torch.nn.Linear(graph.outputs()["observation"][0], env.num_actions)
    torch.nn.init.zeros_(graph.actor.weight)
    torch.nn.init.constant_(graph.actor.bias, 99.0)
    target, carried, *_ = graph(*(t[:1] for t in {**env.inputs, **carries}.values()))
    assert (carried == env.action[:1]).all()
    torch.testing.assert_close(target.detach(), env.target[:1], atol=1e-5, rtol=0.0)


def test_a_base_that_is_to_stand_steps_later():
    strides = [PolicyGraph(dataclasses.replace(TASKS["g1-dribble"], stands=k)).base.gait.stride for k in (1.0, 3.0)]
    usual, steady = ((s.ahead, s.behind, s.aside) for s in strides)
    np.testing.assert_allclose(steady, 3 * np.array(usual))
