"""Clips on made-up motion: kinematics, the file format, flights and bounces, contact, resampling, mirroring."""

from __future__ import annotations

import json

import numpy as np
import pytest

from policies.clips import ballplay, check, flight, kinematics, library, skeleton
from policies.clips.contact import debounce, foot_contact, hand_contact, spans
from policies.clips.format import ARRAYS, Clip, ClipError, Header, load_clip, save_clip
from policies.clips.mirror import mirror
from policies.clips.resample import resample

FPS = 60.0


def standing(frames: int = 40) -> np.ndarray:
    """(T, 337) in the files' own layout: a person standing still in rest pose, facing +x, no ball in reach."""
    x = np.zeros((frames, 337))
    upright = kinematics.quaternion_from_matrix(skeleton.FORWARD_LEFT_UP.T)
    x[:, 2] = -skeleton.OFFSETS[[1, 2, 3], 1].sum() + skeleton.ANKLE_HEIGHT
    x[:, 3:6] = x[:, 6:9] = kinematics.rotation_vector_from_quaternion(upright)
    x[:, 324:327] = 3.0, 0.0, 0.5
    return x


def thrown(frames: int, speed: float, bounce: float = 0.8) -> np.ndarray:
    """(T, 3) m: a ball of radius 0.12 m let go at 1 m, rolling through the air at ``speed`` m/s, off the floor exactly."""
    t, z, v, dt, steps = 0.0, 1.0, 0.0, 1 / FPS / 100, 100
    path = []
    for _ in range(frames):
        path.append([speed * t, 0.3, z])
        for _ in range(steps):
            z, v, t = z + v * dt - 9.81 * dt**2 / 2, v - 9.81 * dt, t + dt
            if z < 0.12 and v < 0:
                v = -bounce * v
    return np.array(path)


def human(x: np.ndarray, **header: object) -> Clip:
    return ballplay.clip_from_tensor(x, Header(name="made_up", fps=FPS, **header))  # type: ignore[arg-type]


# -- kinematics ----------------------------------------------------------------------------------------------------------


def random_rotations(n: int = 200) -> np.ndarray:
    return np.random.default_rng(0).normal(size=(n, 3))


def test_rotation_conversions_agree():
    r = random_rotations()
    r *= (np.linalg.norm(r, axis=1, keepdims=True) % np.pi) / np.linalg.norm(r, axis=1, keepdims=True)
    q = kinematics.quaternion_from_rotation_vector(r)
    assert kinematics.rotation_vector_from_quaternion(q) == pytest.approx(r, abs=1e-9)
    assert kinematics.rotation_vector_from_quaternion(-q) == pytest.approx(r, abs=1e-9)
    m = kinematics.matrix_from_quaternion(q)
    assert kinematics.matrix_from_quaternion(kinematics.quaternion_from_matrix(m)) == pytest.approx(m, abs=1e-9)
    assert np.linalg.det(m) == pytest.approx(1.0)


@pytest.mark.parametrize("turn", np.eye(3) * np.pi, ids="xyz")
def test_quaternion_of_a_half_turn(turn):
    m = kinematics.matrix_from_quaternion(kinematics.quaternion_from_rotation_vector(turn))
    assert abs(kinematics.quaternion_from_matrix(m)[1:] @ turn / np.pi) == pytest.approx(1.0)


def test_angular_velocity_does_not_wrap():
    """Turning evenly through many turns: a rotation vector jumps at every half turn, the rate must not."""
    rate = np.array([0.3, -2.0, 5.0])
    q = kinematics.quaternion_from_rotation_vector(np.arange(200)[:, None] / FPS * rate)
    q[::3] *= -1
    assert kinematics.angular_velocity_in_world(q, FPS) == pytest.approx(np.tile(rate, (200, 1)), abs=1e-9)


def test_forward_kinematics_of_a_bent_chain():
    offsets = np.array([[0, 0, 0], [1, 0, 0], [1, 0, 0]], float)
    bend = np.array([[[0, 0, np.pi / 2], [0, 0, -np.pi / 2], [0, 0, 0]]])
    positions, orientations = kinematics.forward(np.array([[0, 0, 2.0]]), bend, offsets, (-1, 0, 1))
    assert positions[0] == pytest.approx(np.array([[0, 0, 2], [0, 1, 2], [1, 1, 2]]), abs=1e-12)
    assert abs(orientations[0, 2, 0]) == pytest.approx(1.0)


def test_smoothing_keeps_a_constant_rate_to_the_ends():
    line = np.arange(30.0)[:, None] * [1.0, -2.0]
    assert kinematics.smooth(line, 2.0) == pytest.approx(line)
    noise = np.random.default_rng(1).normal(size=(400, 1))
    assert kinematics.smooth(noise, 2.0).std() < 0.5 * noise.std()


# -- the body --------------------------------------------------------------------------------------------------------------


def test_skeleton_is_a_tree_and_symmetric():
    assert len(skeleton.BODIES) == len(set(skeleton.BODIES)) == len(skeleton.PARENTS) == len(skeleton.OFFSETS) == 53
    assert all(parent < body for body, parent in enumerate(skeleton.PARENTS))
    assert [skeleton.MIRROR[i] for i in skeleton.MIRROR] == list(range(53))
    assert skeleton.OFFSETS[list(skeleton.MIRROR)] * [-1, 1, 1] == pytest.approx(skeleton.OFFSETS)
    assert skeleton.BODIES[18] == "L_Wrist" and skeleton.BODIES[37] == "R_Wrist"
    assert sum(mass for *_, mass, _ in skeleton.SEGMENTS) == pytest.approx(1.0, abs=0.01)


def test_standing_person_stands_upright_and_faces_forward():
    clip = human(standing())
    assert clip.base_orientation_in_world == pytest.approx(np.tile([1.0, 0, 0, 0], (len(clip), 1)), abs=1e-9)
    assert clip.point("Head")[0, 2] == pytest.approx(1.55, abs=0.15)
    assert clip.point("L_Hip")[0, 1] > 0 > clip.point("R_Hip")[0, 1]
    assert clip.point("L_Toe")[0, 0] > clip.point("L_Ankle")[0, 0]
    assert clip.contact[:, 2:].all() and not clip.contact[:, :2].any()
    assert skeleton.centre_of_mass(clip.points_in_world)[0, 2] == pytest.approx(0.98, abs=0.05)  # arms held out


# -- ball ------------------------------------------------------------------------------------------------------------------


def test_flight_is_fitted_and_bounce_found():
    ball = thrown(70, speed=2.0)
    touched = np.zeros(70, bool)
    flights = flight.flights(ball, touched, FPS, 0.12)
    assert len(flights) == 2
    assert [f.gravity for f in flights] == pytest.approx([9.81] * 2, abs=0.02)
    assert max(f.error for f in flights) < 1e-3
    (bounce,) = flight.bounces(ball, touched, FPS, 0.12)
    assert bounce.restitution == pytest.approx(0.8, abs=0.01)
    assert bounce.speed_before == pytest.approx(np.sqrt(2 * 9.81 * 0.88), abs=0.05)


def test_a_touched_ball_does_not_fly():
    ball = thrown(70, speed=2.0)
    assert flight.flights(ball, np.ones(70, bool), FPS, 0.12) == []
    assert flight.bounces(ball, np.ones(70, bool), FPS, 0.12) == []


def test_velocity_does_not_reach_across_a_bounce():
    ball = thrown(58, speed=2.0)
    v = flight.velocity(ball, np.zeros(58, bool), FPS, 0.12)
    assert v[:, 0] == pytest.approx(np.full(58, 2.0), abs=0.02)
    t = np.arange(58) / FPS
    fall = np.sqrt(2 * 0.88 / 9.81)
    up = 0.8 * 9.81 * fall
    expected = np.where(t < fall, -9.81 * t, up - 9.81 * (t - fall))
    clear = abs(t - fall) > 2.5 / FPS
    assert v[clear, 2] == pytest.approx(expected[clear], abs=0.1)


def test_one_frame_jumps_are_removed_and_nothing_else():
    ball = thrown(70, speed=2.0)
    broken = ball.copy()
    broken[20] += [0.0, 0.3, 0.0]
    fixed, found = flight.clamp_glitches(broken, FPS)
    assert found == [20]
    assert fixed == pytest.approx(ball, abs=2e-3)
    same, none = flight.clamp_glitches(ball, FPS)
    assert none == [] and (same == ball).all()


# -- contact ---------------------------------------------------------------------------------------------------------------


def test_contact_is_given_to_the_hands_that_are_there():
    x = standing()
    points, _ = ballplay.body_motion(x)
    left, right = (points[0, skeleton.INDEX[f"{side}_Middle1"]] for side in "LR")
    bit = np.ones(len(x), bool)
    at_left = np.tile(left + [0.1, 0, 0], (len(x), 1))
    assert hand_contact(points, at_left, bit)[5].tolist() == [True, False]
    assert hand_contact(points, np.tile(right + [0.1, 0, 0], (len(x), 1)), bit)[5].tolist() == [False, True]
    assert not hand_contact(points, at_left, ~bit).any()


def test_a_moving_foot_does_not_stand():
    x = standing(60)
    x[:, 0] = np.arange(60) / FPS * 1.5
    assert not foot_contact(ballplay.body_motion(x)[0], FPS).any()


def test_debounce():
    on = np.array([1, 1, 1, 0, 1, 1, 1, 0, 0, 0, 0, 1, 0, 0, 0, 1], bool)
    assert spans(debounce(on)) == [(0, 7), (15, 16)]


# -- resample, mirror, cut -------------------------------------------------------------------------------------------------


def test_resampling_keeps_flight_physical_when_lengths_scale():
    """Positions x s and times x sqrt(s): the ball still falls with g."""
    x = standing(70)
    x[:, 324:327] = thrown(70, speed=2.0)
    x[0, 336] = 1  # so that the ball counts
    s = 0.745
    clip = resample(human(x), 50.0, slower=np.sqrt(s))
    (first, *_) = flight.flights(s * clip.ball_position_in_world, clip.contact[:, :2].any(1), 50.0, s * 0.12)
    assert first.gravity == pytest.approx(9.81, abs=0.3)
    assert clip.seconds == pytest.approx(69 / 60 * np.sqrt(s), abs=0.02)
    assert s * clip.ball_velocity_in_world[:, 0] == pytest.approx(s * 2.0 / np.sqrt(s), abs=0.02)


def test_resampling_to_the_same_rate_changes_nothing():
    clip = human(standing())
    again = resample(clip, FPS)
    for name in ARRAYS:
        assert getattr(again, name) == pytest.approx(getattr(clip, name), abs=1e-12)


def test_a_mirror_swaps_sides_and_twice_is_nothing():
    x = standing()
    x[:, 1] = 0.7
    x[:, 9 + 3 * (skeleton.INDEX["L_Shoulder"] - 1) + 1] = 0.8  # left arm moves
    clip = human(x, skill="dribble_left")
    image = mirror(clip)
    assert image.header.skill == "dribble_right"
    assert image.point("R_Wrist") == pytest.approx(clip.point("L_Wrist") * [1, -1, 1])
    assert image.base_position_in_world[0, 1] == pytest.approx(-0.7)
    back = mirror(image)
    for name in ARRAYS:
        assert getattr(back, name) == pytest.approx(getattr(clip, name), abs=1e-12)


def test_a_mirrored_pelvis_turns_the_other_way():
    x = standing()
    q = kinematics.multiply(
        kinematics.quaternion_from_rotation_vector(np.array([0.0, 0, 0.5])),
        kinematics.quaternion_from_rotation_vector(x[0, 3:6]),
    )
    x[:, 3:6] = kinematics.rotation_vector_from_quaternion(q)
    clip, image = human(x), mirror(human(x))
    assert clip.base_orientation_in_world[0] == pytest.approx([np.cos(0.25), 0, 0, np.sin(0.25)])
    assert image.base_orientation_in_world[0] == pytest.approx([np.cos(0.25), 0, 0, -np.sin(0.25)])


@pytest.mark.parametrize(("start", "stop"), [(-1, 5), (5, 5), (0, 41)])
def test_cut_refuses_frames_that_are_not_there(start, stop):
    with pytest.raises(ClipError, match="expected 0 <= start < stop <= 40"):
        human(standing(40)).cut(start, stop)


# -- format ----------------------------------------------------------------------------------------------------------------


@pytest.fixture
def file(tmp_path):
    path = tmp_path / "a.npz"
    save_clip(human(standing(), skill="stand", licence="CC0-1.0"), path)
    return path


def arrays(path) -> dict[str, np.ndarray]:
    with np.load(path, allow_pickle=False) as loaded:
        return {name: loaded[name] for name in loaded.files}


def test_a_saved_clip_reads_back_and_saves_to_the_same_bytes(file, tmp_path):
    clip = load_clip(file)
    assert clip.header.skill == "stand" and clip.header.licence == "CC0-1.0" and clip.header.units["joint_pos"] == "rad"
    save_clip(clip, tmp_path / "b.npz")
    assert (tmp_path / "b.npz").read_bytes() == file.read_bytes()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda a: a.pop("contact"), r"missing \['contact'\]"),
        (lambda a: a.update(extra=np.zeros(3)), r"unknown \['extra'\]"),
        (lambda a: a.update(ball_position_in_world=np.zeros((3, 3))), "ball_position_in_world: got shape"),
        (lambda a: a["points_in_world"].__setitem__((2, 1, 0), np.nan), r"points_in_world\[2, 1, 0\]: got nan"),
        (lambda a: a["base_orientation_in_world"].__setitem__(4, 0.0), r"base_orientation_in_world\[4\]: got norm 0"),
        (lambda a: a.update(header=header_with(a, fsp=60)), "fsp: unknown key .did you mean 'fps'"),
        (lambda a: a.update(header=header_with(a, fps=-1.0)), "fps: got -1.0"),
        (lambda a: a.update(header=header_with(a, format="other 2")), "format"),
        (lambda a: a.update(header=np.array("{")), "header"),
    ],
)
def test_a_wrong_file_is_refused_by_name(file, tmp_path, change, message):
    content = arrays(file)
    change(content)
    wrong = tmp_path / "wrong.npz"
    np.savez(wrong, **content)
    with pytest.raises(ClipError, match=message) as error:
        load_clip(wrong)
    assert "wrong.npz" in str(error.value)


def header_with(content: dict[str, np.ndarray], **fields: object) -> np.ndarray:
    return np.array(json.dumps({**json.loads(str(content["header"])), **fields}))


@pytest.mark.parametrize("content", [b"", b"not a zip", b"PK\x03\x04 cut"])
def test_what_is_no_clip_is_refused(tmp_path, content):
    path = tmp_path / "x.npz"
    path.write_bytes(content)
    with pytest.raises(ClipError, match="not a clip"):
        load_clip(path)


def test_a_pickle_inside_is_not_opened(file, tmp_path):
    content = arrays(file) | {"contact": np.array([{"a": 1}], dtype=object)}
    path = tmp_path / "pickle.npz"
    np.savez(path, **content)
    with pytest.raises(ClipError, match="not a clip"):
        load_clip(path)


# -- reading, choosing, reporting ------------------------------------------------------------------------------------------


def test_reads_a_tensor_file_and_refuses_others(tmp_path):
    torch = pytest.importorskip("torch")
    path = tmp_path / "a.pt"
    torch.save(torch.tensor(standing()), path)
    assert len(ballplay.read(path)) == 40
    for content, message in [
        (torch.zeros(3, 331), r"got \(3, 331\), expected a tensor \(T, 337\)"),
        ({"a": 1}, "got dict"),
        (torch.full((3, 337), torch.nan), "frame 0, column 0: got nan"),
    ]:
        torch.save(content, path)
        with pytest.raises(ClipError, match=message):
            ballplay.read(path)
    path.write_bytes(b"nothing")
    with pytest.raises(ClipError, match="not a BallPlay-M file"):
        ballplay.read(path)


def test_an_index_that_is_not_there_says_what_to_do(tmp_path):
    with pytest.raises(ClipError, match="INDEX.csv: no such file"):
        ballplay.read_index(tmp_path)
    (tmp_path / "INDEX.csv").write_text("path,label\na,001\n")
    with pytest.raises(ClipError, match="no columns"):
        ballplay.read_index(tmp_path)
    with pytest.raises(ClipError, match="--data"):
        library.data_folder(tmp_path / "nowhere")


def test_a_library_with_a_typo_is_refused(tmp_path):
    path = tmp_path / "library.yaml"
    path.write_text("skills:\n  hold:\n    - {clip: a.pt, frame: [0, 3]}\n")
    with pytest.raises(ClipError, match=r"skills.hold\[0\].frame: unknown key .did you mean 'frames'"):
        library.read_library(path)


def test_report_shows_every_clip(tmp_path):
    x = standing(70)
    x[:, 324:327] = thrown(70, speed=0.0) + [3.0, 0.0, 0.0]
    x[-1, 336] = 1
    clip = human(x, skill="<drop>")
    found = check.check(clip)
    assert found.gravity == pytest.approx([9.81] * len(found.gravity), abs=0.05) and len(found.gravity) == 2
    assert found.restitution == pytest.approx([0.8], abs=0.01)
    check.write_report([clip], tmp_path / "r.html")
    page = (tmp_path / "r.html").read_text()
    assert "made_up" in page and "&lt;drop&gt;" in page and page.count("<svg") == 1 and "#27ae60" in page
