"""Retargeting: on a made-up person for every robot, on recordings for the G1, and the clips that are shipped."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path

import mujoco
import numpy as np
import pytest
from test_clips import FPS, standing

from policies.ball import RADIUS
from policies.clips import ballplay, flight, kinematics, library, skeleton
from policies.clips.draw import scaled
from policies.clips.feasibility import Residuals, efforts, residuals
from policies.clips.format import Clip, ClipError, Header, load_clip
from policies.clips.robot import RobotBody
from sim2real.config import load_robot

pytest.importorskip("mink")
pytest.importorskip("torch")
from policies.clips.retarget import MARGIN, retarget  # noqa: E402
from policies.clips.targets import length_scale, pulled_in, targets  # noqa: E402

SHIPPED = sorted(library.library_path("g1").parent.glob("*.npz"))


@cache
def g1() -> RobotBody:
    return RobotBody.of(load_robot("g1"))


HEIGHT = g1().palm_height(RADIUS)  # m from palm to ball's centre


def test_a_ball_on_a_palm_touches_the_hand_and_no_more():
    """The G1's hand is a box 4 cm thick, and its palm site in the middle of it."""
    assert pytest.approx(RADIUS + 0.02, abs=1e-6) == HEIGHT


def holding(frames: int = 45) -> Clip:
    """A person who holds a ball before the chest and lifts it by 15 cm."""
    x = standing(frames)
    for side, sign in (("L", 1.0), ("R", -1.0)):
        turn = np.zeros((frames, 3))
        turn[:, 1] = -sign * np.radians(96.5)  # arm forward, a little inwards
        at = 9 + 3 * (skeleton.INDEX[f"{side}_Shoulder"] - 1)
        lift = np.zeros((frames, 3))
        lift[:, 0] = np.radians(-30 - 15 * np.linspace(0, 1, frames) ** 2)
        q = kinematics.multiply(
            kinematics.quaternion_from_rotation_vector(lift), kinematics.quaternion_from_rotation_vector(turn)
        )
        x[:, at : at + 3] = kinematics.rotation_vector_from_quaternion(q)
    points, _ = ballplay.body_motion(x)
    hands = [points[:, skeleton.INDEX[f"{side}_Middle1"]] for side in "LR"]
    x[:, 324:327] = np.mean(hands, axis=0)
    x[:, 336] = 1
    return ballplay.clip_from_tensor(x, Header(name="made_up", fps=FPS, skill="hold"))


def body_of(robot) -> RobotBody:
    try:
        return RobotBody.of(robot)
    except ClipError as error:
        pytest.skip(str(error))


def test_every_robot_with_arms_and_legs_can_hold_the_ball(robot):
    body = body_of(robot)
    clip, _ = retarget(holding(), body)
    row = residuals(clip, body)
    assert clip.header.body == robot.name and clip.header.joint_names == robot.joint_names
    assert clip.contact.all(), "both hands on the ball, both feet on the floor, throughout"
    assert abs(row.hand_gap_worst) < 0.01
    assert row.limit_violations == 0 and row.limit_margin > MARGIN - 1e-6
    assert row.foot_skate < 0.002 and row.foot_height < 0.002 and row.floor_penetration < 0.002
    assert row.velocity_share < 0.5 and row.missing_force < 0.05
    base = clip.base_position_in_world
    assert base[:, 2] == pytest.approx(np.full(len(clip), base[0, 2]), abs=0.02)
    assert kinematics.rotate(clip.base_orientation_in_world[0], np.array([0.0, 0, 1]))[2] > 0.97


def test_a_robot_without_named_limbs_is_refused():
    robot = g1().robot.model_copy(update={"joints": [j for j in g1().robot.joints if "knee" not in j.name]})
    vars(robot).pop("joint_names", None)  # cached
    with pytest.raises(ClipError, match="no joint of a left knee"):
        RobotBody.of(robot)


def test_a_robot_clip_is_not_retargeted_again():
    with pytest.raises(ClipError, match="expected a human's"):
        targets(load_clip(SHIPPED[0]), g1(), 50.0, RADIUS, 0.04)


def test_lengths_and_times_scale_together():
    s = length_scale(g1())
    assert s == pytest.approx(0.745, abs=0.005)
    assert s * skeleton.BALL_RADIUS == pytest.approx(RADIUS, abs=0.002), "the ball keeps its proportion to the body"
    person = scaled(holding(), s, RADIUS, 50.0)
    assert person.seconds == pytest.approx(holding().seconds * np.sqrt(s), abs=0.03)


def test_a_ball_out_of_reach_is_drawn_in_and_its_flight_stays_a_flight():
    """Held for ten frames two metres from the shoulders, then thrown."""
    body = g1()
    goal = targets(holding(), body, 50.0, RADIUS, 0.04)
    held = np.arange(len(goal.ball)) < 10
    t = np.maximum(np.arange(len(goal.ball)) - 9, 0) / 50.0
    fly = goal.ball[:1] + np.stack([2.0 * t, 0 * t, 3.0 * t - 9.81 * t**2 / 2], axis=1)
    goal = replace(goal, ball=fly, touching=np.stack([held, held], axis=1))
    shoulders = goal.palms - [0.8, 0.0, 0.0]
    pulled = pulled_in(goal, shoulders, arm_length=0.45)
    moved = pulled.ball - goal.ball
    assert moved[3, 0] == pytest.approx(-(0.8 - 0.95 * 0.45), abs=1e-3)
    assert moved[10:] == pytest.approx(np.tile(moved[9], (len(moved) - 10, 1)))
    assert np.linalg.norm(shoulders[3] - pulled.palms[3], axis=1) == pytest.approx([0.95 * 0.45] * 2, abs=1e-3)
    assert pulled_in(goal, goal.palms - [0.3, 0, 0], 0.45) is goal


def test_efforts_of_standing_still_are_the_robots_weight():
    """Inverse dynamics with contact: feet carry everything, joints what statics says, nothing is missing."""
    clip, _ = retarget(holding(30), g1())
    frozen = clip.cut(0, 1)
    still = Clip(
        frozen.header,
        **{n: np.repeat(getattr(frozen, n), 9, axis=0) for n in _array_names(frozen) if n != "ball_velocity_in_world"},
        ball_velocity_in_world=np.zeros((9, 3)),
    )
    torque, force, moment = efforts(still, g1())
    assert force.max() < 2.0 and moment.max() < 0.5
    share = abs(torque) / g1().robot.torque_max
    assert 0.02 < share.max() < 0.9
    floating = Clip(
        still.header,
        **{
            n: getattr(still, n) + ([0, 0, 0.1] if n == "base_position_in_world" else 0)
            for n in _array_names(still)
            if n != "contact"
        },
        contact=np.zeros_like(still.contact),
    )
    _, force, _ = efforts(floating, g1())
    assert force == pytest.approx(g1().model.body_mass.sum() * 9.81, rel=1e-3), "without floor all weight is missing"


def _array_names(clip: Clip) -> list[str]:
    return [n for n in clip.__dataclass_fields__ if n != "header"]


# -- recordings ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("path", "torque", "missing"),
    [
        ("ballplay_m/pick_40/001_007pickle_pick_009.pt", 1.7, 0.1),
        ("ballplay_m_v2/ablation3/Chestpass/016pickle_pass_016.pt", 1.2, 0.6),
        ("ballplay_m/lrun/011_018pickle_lrun_1.pt", 1.7, 0.9),
    ],
)
def test_recordings(shared: Path, path, torque, missing):
    human = ballplay.read(shared / "data" / path)
    clip, goal = retarget(human, g1())
    row = residuals(clip, g1())
    assert abs(row.hand_gap_median) < 0.004 and abs(row.hand_gap_worst) < 0.013, "palms on the ball"
    assert row.foot_skate < 0.005 and row.foot_height < 0.005, "standing feet stand still, on the floor"
    assert row.floor_penetration < 0.009 and row.self_penetration < 0.009 and row.ball_penetration < 0.005
    assert row.limit_violations == 0
    assert row.velocity_share < 1 and row.torque_share < torque and row.missing_force < missing
    # Contacts are the person's, frame by frame.
    person = scaled(human, goal.length_scale, RADIUS, clip.fps)
    assert (person.contact[:, :2] == clip.contact[:, :2]).all()
    # The ball's flight is the recorded one, in the robot's metres and seconds.
    touched = person.contact[:, :2].any(axis=1)
    theirs = [f.gravity for f in flight.flights(human.ball_position_in_world, human.contact[:, :2].any(1), FPS, 0.12)]
    ours = [f.gravity for f in flight.flights(clip.ball_position_in_world, touched, clip.fps, RADIUS)]
    if theirs and ours:
        assert np.median(ours) == pytest.approx(np.median(theirs), abs=0.35)


# -- what is shipped -------------------------------------------------------------------------------------------------------


def test_shipped_clips_are_those_of_the_library():
    chosen = library.robot_library(load_robot("g1"))
    counts = {
        s: len(chosen.skills.get(s, ())) + len(chosen.formulas.get(s, ())) for s in chosen.skills | chosen.formulas
    }
    assert {p.stem for p in SHIPPED} == {f"{s}_{k:02d}" for s, count in counts.items() for k in range(1, count + 1)}


@pytest.mark.parametrize("path", SHIPPED, ids=lambda p: p.stem)
def test_shipped_clip(path):
    """Small, attributed, on this robot, inside its limits, floor and hands where they should be."""
    clip = load_clip(path)
    robot = g1().robot
    recorded = not clip.header.source.startswith("policies/")
    assert path.stat().st_size < (100_000 if recorded else 150_000)
    assert clip.header.licence == "Apache-2.0"
    assert not recorded or (clip.header.attribution and "sha256" in clip.header.source)
    assert clip.header.body == "g1" and clip.header.joint_names == robot.joint_names
    assert clip.fps == (50 if recorded else 100)  # a stroke by formula is over in five frames of 50
    assert clip.name == path.stem and clip.header.skill == path.stem[:-3]
    assert ((clip.joint_pos > robot.position_min) & (clip.joint_pos < robot.position_max)).all()
    assert (abs(clip.joint_vel) < robot.velocity_max).all()
    assert abs(residuals(clip, g1()).hand_gap_worst) < 0.02
    assert np.linalg.norm(np.diff(clip.points_in_world, axis=0), axis=-1).max() * clip.fps < 12, "nothing jumps"
    for k, side in enumerate(("left", "right")):
        height = abs(clip.point(f"{side}_foot")[clip.contact[:, 2 + k], 2])
        assert height.max(initial=0.0) < 0.01 and (height < 0.004).mean() > 0.9


@pytest.mark.parametrize("path", SHIPPED, ids=lambda p: p.stem)
def test_a_ball_let_go_as_a_shipped_clip_says_flies_as_it_says(path):
    """From position and velocity of a flight's first frame, gravity leads to where the clip has the ball later: up to the
    recordings' own free fall, which is 9.4 to 9.9 m/s^2 and not 9.81."""
    clip = load_clip(path)
    touched = clip.contact[:, :2].any(axis=1)
    for f in flight.flights(clip.ball_position_in_world, touched, clip.fps, RADIUS) if clip.header.has_ball else []:
        t = (np.arange(f.start, f.stop) - f.start)[:, None] / clip.fps
        start, v = clip.ball_position_in_world[f.start], clip.ball_velocity_in_world[f.start]
        flown = start + v * t - np.array([0, 0, 9.81]) * t**2 / 2
        off = np.linalg.norm(flown - clip.ball_position_in_world[f.start : f.stop], axis=1).max()
        assert off < 0.02 + 0.05 * t[-1, 0] + 0.35 * t[-1, 0] ** 2 / 2, f"frames {f.start}:{f.stop}"


def test_shipped_points_are_where_the_joints_put_them():
    body, clip = g1(), load_clip(library.library_path("g1").parent / "pickup_02.npz")
    data = mujoco.MjData(body.model)
    for t in range(0, len(clip), 20):
        data.qpos[:3], data.qpos[3:7] = clip.base_position_in_world[t], clip.base_orientation_in_world[t]
        data.qpos[body.qpos_at] = clip.joint_pos[t]
        mujoco.mj_kinematics(body.model, data)
        assert body.points(data) == pytest.approx(clip.points_in_world[t], abs=1e-4)


@pytest.mark.parametrize(
    "skill", ["hold", "carry", "raise", "pass", "shot", "catch", "pickup", "dribble_in_place", "bounce", "walk"]
)
def test_a_skill_has_clips(skill):
    clips = library.robot_clips("g1", skill)
    assert clips and all(c.header.skill == skill for c in clips)
    assert all(c.header.has_ball for c in clips)


def test_a_skill_without_clips_says_what_there_is():
    with pytest.raises(ClipError, match="did you mean 'pickup'"):
        library.robot_clips("g1", "pick_up")


def test_residuals_of_a_broken_clip_are_found():
    """The measure itself: a robot lifted, its ball moved and its knees overbent must show as such."""
    clip = load_clip(library.library_path("g1").parent / "hold_02.npz")
    joints = clip.joint_pos.copy()
    joints[5, clip.header.joint_names.index("left_knee_joint")] = -1.5
    broken = Clip(
        clip.header,
        base_position_in_world=clip.base_position_in_world + np.linspace(0, 0.1, len(clip))[:, None] * [1, 0, -1],
        base_orientation_in_world=clip.base_orientation_in_world,
        joint_pos=joints,
        points_in_world=clip.points_in_world + np.linspace(0, 0.1, len(clip))[:, None, None] * [1, 0, -1],
        ball_position_in_world=clip.ball_position_in_world + [0.0, 0, 0.5],
        ball_velocity_in_world=clip.ball_velocity_in_world,
        contact=clip.contact,
    )
    good, bad = residuals(clip, g1()), residuals(broken, g1())
    assert isinstance(bad, Residuals)
    assert good.limit_violations == 0 and bad.limit_violations == 1
    assert bad.hand_gap_median > 0.2 and abs(good.hand_gap_median) < 0.005
    assert bad.foot_skate == pytest.approx(0.05, abs=0.01) and good.foot_skate < 0.001
    assert bad.foot_height > 0.05 and bad.floor_penetration > 0.05
    assert bad.velocity_share > 1
