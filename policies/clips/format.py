"""A clip: one recorded motion of a human or a robot, with its ball. One ``.npz`` file, no pickle inside.

Arrays, float32 unless said otherwise, T frames at ``fps``, world frame z up with the floor at z = 0:

    base_position_in_world      (T, 3)     m, of the pelvis (human) or the base body (robot)
    base_orientation_in_world   (T, 4)     quaternion w, x, y, z
    joint_pos                   (T, J)     rad; J = 0 for a human
    points_in_world             (T, K, 3)  m, of the bodies or key points in ``point_names``
    ball_position_in_world      (T, 3)     m, centre
    ball_velocity_in_world      (T, 3)     m/s
    contact                     (T, 4)     bool: left hand and right hand on the ball, left foot and right foot on the floor
    header                      JSON (0-d string): everything in ``Header``

A file with a missing, further, misshapen or non-finite array, or an unknown key in its header, is refused.
"""

from __future__ import annotations

import json
import zipfile
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from pathlib import Path
from typing import Literal

import numpy as np
from pydantic import ValidationError

from policies.clips.kinematics import angular_velocity_in_world, conjugate, rate, rotate
from sim2real.config import Strict, explain
from sim2real.types import Sim2realError

CONTACTS = ("left_hand", "right_hand", "left_foot", "right_foot")
UNITS = {
    "base_position_in_world": "m",
    "base_orientation_in_world": "quaternion w, x, y, z",
    "joint_pos": "rad",
    "points_in_world": "m",
    "ball_position_in_world": "m",
    "ball_velocity_in_world": "m/s",
    "contact": "0 or 1",
}


class ClipError(Sim2realError):
    """A clip that cannot be read, found or retargeted."""


class Header(Strict):
    """What a clip says about itself."""

    format: Literal["sim2real clip 1"] = "sim2real clip 1"
    name: str
    skill: str = ""  # what is done, in words: pick_up, dribble_left
    label: str = ""  # the source's own label, where it has one
    split: Literal["train", "test"] = "train"
    body: str = "human"  # whose joints these are: "human" or a robot's name
    fps: float
    joint_names: tuple[str, ...] = ()
    point_names: tuple[str, ...] = ()
    has_ball: bool = True  # False: the ball lies parked and means nothing
    ball_radius: float = 0.12  # m
    length_scale: float = 1.0  # lengths here = this x lengths of the recording; times = its square root
    source: str = ""  # file and data set this was made from
    licence: str = ""
    attribution: str = ""
    units: dict[str, str] = UNITS


@dataclass(frozen=True)
class Clip:
    """See the module: arrays as listed there, in float64."""

    header: Header
    base_position_in_world: np.ndarray
    base_orientation_in_world: np.ndarray
    joint_pos: np.ndarray
    points_in_world: np.ndarray
    ball_position_in_world: np.ndarray
    ball_velocity_in_world: np.ndarray
    contact: np.ndarray = field(repr=False)

    def __post_init__(self) -> None:
        frames = len(self.base_position_in_world)
        shapes = {
            "base_position_in_world": (frames, 3),
            "base_orientation_in_world": (frames, 4),
            "joint_pos": (frames, len(self.header.joint_names)),
            "points_in_world": (frames, len(self.header.point_names), 3),
            "ball_position_in_world": (frames, 3),
            "ball_velocity_in_world": (frames, 3),
            "contact": (frames, len(CONTACTS)),
        }
        for name, shape in shapes.items():
            value = getattr(self, name)
            if value.shape != shape:
                raise ClipError(f"clip '{self.header.name}': {name}: got shape {value.shape}, expected {shape}")
            if not np.isfinite(value).all():
                at = np.argwhere(~np.isfinite(value))[0].tolist()
                raise ClipError(f"clip '{self.header.name}': {name}{at}: got {value[tuple(at)]}, expected a number")
        if not self.header.fps > 0:
            raise ClipError(f"clip '{self.header.name}': fps: got {self.header.fps}, expected more than 0")
        norm = np.linalg.norm(self.base_orientation_in_world, axis=-1)
        if frames and abs(norm - 1).max() > 1e-3:
            frame = int(abs(norm - 1).argmax())
            raise ClipError(
                f"clip '{self.header.name}': base_orientation_in_world[{frame}]: got norm {norm[frame]:.4f}, expected 1"
            )

    def __len__(self) -> int:
        return len(self.base_position_in_world)

    @property
    def name(self) -> str:
        """Of the clip."""
        return self.header.name

    @property
    def fps(self) -> float:
        """Frames per second."""
        return self.header.fps

    @property
    def seconds(self) -> float:
        """From the first frame to the last."""
        return max(len(self) - 1, 0) / self.fps

    @cached_property
    def joint_vel(self) -> np.ndarray:
        """(T, J) rad/s."""
        return rate(self.joint_pos, self.fps)

    @cached_property
    def base_velocity_in_world(self) -> np.ndarray:
        """(T, 3) m/s."""
        return rate(self.base_position_in_world, self.fps)

    @cached_property
    def base_angular_velocity_in_base(self) -> np.ndarray:
        """(T, 3) rad/s."""
        q = self.base_orientation_in_world
        return rotate(conjugate(q), angular_velocity_in_world(q, self.fps))

    def point(self, name: str) -> np.ndarray:
        """(T, 3) m: one of ``point_names``. Raises ClipError."""
        if name not in self.header.point_names:
            raise ClipError(f"clip '{self.name}': no point '{name}'; it has {', '.join(self.header.point_names)}")
        return self.points_in_world[:, self.header.point_names.index(name)]

    def cut(self, start: int, stop: int, **header: str) -> Clip:
        """Frames ``start`` to ``stop`` (not included), with some of the header replaced. Raises ClipError."""
        if not 0 <= start < stop <= len(self):
            raise ClipError(f"clip '{self.name}': got frames {start}:{stop}, expected 0 <= start < stop <= {len(self)}")
        arrays = {name: getattr(self, name)[start:stop] for name in UNITS}
        return Clip(self.header.model_copy(update=header), **arrays)

    def with_header(self, **header: object) -> Clip:
        """The same motion with some of the header replaced."""
        return replace(self, header=self.header.model_copy(update=header))


ARRAYS = tuple(f.name for f in fields(Clip) if f.name != "header")


def save_clip(clip: Clip, path: str | Path) -> None:
    """Write a clip; the same clip gives the same bytes."""
    arrays = {name: getattr(clip, name).astype(bool if name == "contact" else np.float32) for name in ARRAYS}
    header = np.array(json.dumps(clip.header.model_dump(mode="json"), sort_keys=True))
    np.savez_compressed(path, header=header, **arrays)


def load_clip(path: str | Path) -> Clip:
    """Read a clip. Raises ClipError."""
    path = Path(path)
    try:
        with np.load(path, allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
    except (OSError, ValueError, zipfile.BadZipFile, EOFError) as error:
        raise ClipError(f"{path}: not a clip ({error}); expected an .npz made by sim2real clips") from None
    missing = sorted({"header", *ARRAYS} - set(arrays))
    extra = sorted(set(arrays) - {"header", *ARRAYS})
    if missing or extra:
        raise ClipError(f"{path}: arrays missing {missing}, unknown {extra}; expected header, {', '.join(ARRAYS)}")
    try:
        header = Header.model_validate_json(str(arrays.pop("header")))
    except ValidationError as error:
        raise ClipError(explain(f"{path}: header", error, Header)) from None
    try:
        return Clip(header, **{n: a.astype(bool if n == "contact" else float) for n, a in arrays.items()})
    except ClipError as error:
        raise ClipError(f"{path}: {error}") from None
