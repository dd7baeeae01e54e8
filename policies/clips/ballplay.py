"""Reads BallPlay-M, the motion data of SkillMimic: one (T, 337) tensor a clip, 60 frames per second, metres and radians.

    0:3      root position                     324:327  ball centre
    3:6      root rotation vector              327:336  zero
    9:165    52 joint rotation vectors         336      a hand is on the ball: 0 or 1
    165:324  53 body positions: not used, see `skeleton`

Labels come from an ``INDEX.csv`` beside or above the files: the first three characters of a file name, which the
original loader reads as the label, are in some files the number of the recording.
"""

from __future__ import annotations

import csv
import hashlib
from pathlib import Path
from typing import NamedTuple

import numpy as np

from policies.clips import flight, kinematics, skeleton
from policies.clips.contact import foot_contact, hand_contact
from policies.clips.format import Clip, ClipError, Header

FPS = 60.0
COLUMNS = 337
LICENCE = "Apache-2.0"
ATTRIBUTION = {
    "BallPlay-M": "BallPlay-M, Yinhuai Wang et al., SkillMimic (CVPR 2025), github.com/wyhuai/SkillMimic @12887cb",
    "SkillMimic-V2": "BallPlay, Runyi Yu et al., SkillMimic-V2 (SIGGRAPH 2025), github.com/Ingrid789/SkillMimic-V2 @c459f11",
}
TEST_SHARE = 5  # one clip in five of every label with five or more is kept for tests


class Entry(NamedTuple):
    """One row of INDEX.csv."""

    path: Path
    set: str
    skill: str
    label: str
    frames: int
    has_contact: bool
    duplicate: bool
    split: str


def read_index(folder: str | Path) -> list[Entry]:
    """Every clip of a folder with an INDEX.csv, in its order. Raises ClipError."""
    index = Path(folder) / "INDEX.csv"
    if not index.is_file():
        raise ClipError(f"{index}: no such file; expected the folder that holds it and the clips it lists")
    with index.open(newline="") as file:
        rows = list(csv.DictReader(file))
    wanted = {"path", "set", "skill", "label", "frames", "has_contact", "duplicate_of", "sha256"}
    if missing := sorted(wanted - set(rows[0] if rows else ())):
        raise ClipError(f"{index}: no columns {missing}; expected {', '.join(sorted(wanted))}")
    test = _test_split(rows)
    return [
        Entry(
            path=index.parent / row["path"],
            set=row["set"],
            skill=row["skill"],
            label=row["label"],
            frames=int(row["frames"]),
            has_contact=row["has_contact"] == "1",
            duplicate=bool(row["duplicate_of"]),
            split="test" if row["path"] in test else "train",
        )
        for row in rows
    ]


def _test_split(rows: list[dict[str, str]]) -> set[str]:
    """Paths kept for tests: in every skill, every fifth clip in the order of their hashes, so that it never moves."""
    skills: dict[str, list[dict[str, str]]] = {}
    for row in rows:
        if not row["duplicate_of"]:
            skills.setdefault(row["skill"], []).append(row)
    ordered = (sorted(clips, key=lambda r: r["sha256"]) for clips in skills.values())
    return {row["path"] for clips in ordered for row in clips[TEST_SHARE - 1 :: TEST_SHARE]}


def read_tensor(path: str | Path) -> np.ndarray:
    """The file's (T, 337) numbers as float64. Nothing in the file is executed. Raises ClipError."""
    import torch

    path = Path(path)
    try:
        x = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # torch raises half a dozen types, for zip, tensor and safety alike
        raise ClipError(f"{path}: not a BallPlay-M file ({str(error).splitlines()[0]})") from None
    if not isinstance(x, torch.Tensor) or x.ndim != 2 or x.shape[1] != COLUMNS or not len(x):
        got = tuple(x.shape) if isinstance(x, torch.Tensor) else type(x).__name__
        raise ClipError(f"{path}: got {got}, expected a tensor (T, {COLUMNS})")
    array = x.numpy().astype(float)
    if not np.isfinite(array).all():
        frame, column = np.argwhere(~np.isfinite(array))[0]
        raise ClipError(f"{path}: frame {frame}, column {column}: got {array[frame, column]}, expected a number")
    return array


def body_motion(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Positions (T, 53, 3) m and orientations (T, 53, 4) of the bodies in the world, from a file's (T, 337) numbers."""
    rotations = np.concatenate([x[:, None, 3:6], x[:, 9:165].reshape(len(x), 52, 3)], axis=1)
    return kinematics.forward(x[:, :3], rotations, skeleton.OFFSETS, skeleton.PARENTS)


def clip_from_tensor(x: np.ndarray, header: Header) -> Clip:
    """A human clip from a file's (T, 337) numbers."""
    points, orientations = body_motion(x)
    has_ball = bool(x[:, 336].any())
    ball, _ = flight.clamp_glitches(x[:, 324:327], FPS)
    hands = hand_contact(points, ball, x[:, 336] > 0.5)
    up = kinematics.quaternion_from_matrix(skeleton.FORWARD_LEFT_UP)
    return Clip(
        header.model_copy(update={"fps": FPS, "point_names": skeleton.BODIES, "has_ball": has_ball}),
        base_position_in_world=points[:, 0],
        base_orientation_in_world=kinematics.multiply(orientations[:, 0], up),
        joint_pos=np.zeros((len(x), 0)),
        points_in_world=points,
        ball_position_in_world=ball,
        ball_velocity_in_world=flight.velocity(ball, x[:, 336] > 0.5, FPS, skeleton.BALL_RADIUS),
        contact=np.concatenate([hands, foot_contact(points, FPS)], axis=1),
    )


def read(entry: Entry | Path) -> Clip:
    """One clip: by its row of the index, or by its path (then its label is looked up in an INDEX.csv above it)."""
    if isinstance(entry, Path):
        entry = next((e for e in _index_above(entry) if e.path.resolve() == entry.resolve()), None) or Entry(
            entry, "BallPlay-M", "", "", 0, True, False, "train"
        )
    digest = hashlib.sha256(entry.path.read_bytes()).hexdigest() if entry.path.is_file() else ""
    header = Header(
        name=entry.path.stem,
        skill=entry.skill,
        label=entry.label,
        split=entry.split,  # type: ignore[arg-type]
        fps=FPS,
        ball_radius=skeleton.BALL_RADIUS,
        source=f"{entry.set} {'/'.join(entry.path.parts[-2:])} sha256 {digest[:16]}",
        licence=LICENCE,
        attribution=ATTRIBUTION.get(entry.set, ATTRIBUTION["BallPlay-M"]),
    )
    return clip_from_tensor(read_tensor(entry.path), header)


def _index_above(path: Path) -> list[Entry]:
    folder = next((p for p in path.resolve().parents if (p / "INDEX.csv").is_file()), None)
    return read_index(folder) if folder else []
