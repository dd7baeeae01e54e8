"""Which clips there are: files, labels and skills of a data folder, and a robot's library of retargeted pieces.

A library is a YAML, ``policies/<robot>/clips/library.yaml``: for every skill the pieces of recordings that show it. Its
retargeted clips lie beside it, made by ``sim2real clips retarget --library``.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Literal

import yaml
from pydantic import ValidationError

from policies.clips import ballplay
from policies.clips.format import Clip, ClipError, load_clip
from policies.clips.mirror import mirror
from sim2real.config import RobotConfig, Strict, did_you_mean, explain

HERE = Path(__file__).resolve().parents[1]  # policies/
DATA = "SIM2REAL_CLIPS"


class Piece(Strict):
    """Some frames of a recording that show a skill."""

    clip: str  # path under the data folder
    frames: tuple[int, int] | None = None  # [start, stop) of the recording; none: all
    mirror: bool = False


class Library(Strict):
    """Every piece that a robot's skills are trained on."""

    skills: dict[str, list[Piece]]
    # made by formula: bounces (bounce.py) by these hands, or the right one, stretched, for robots that stand or walk,
    # and pickups from the floor (pickup.py)
    formulas: dict[str, list[Literal["left", "right", "stretched", "both", "walking", "floor"]]] = {}


def library_path(robot: str) -> Path:
    """Where a robot's library lies."""
    return HERE / robot / "clips" / "library.yaml"


def read_library(path: Path) -> Library:
    """Raises ClipError."""
    if not path.is_file():
        raise ClipError(f"{path}: no such file; a library lists, for every skill, pieces of recordings")
    try:
        return Library.model_validate(yaml.safe_load(path.read_text()))
    except yaml.YAMLError as error:
        raise ClipError(f"{path}: not YAML: {error}") from None
    except ValidationError as error:
        raise ClipError(explain(str(path), error, Library)) from None


def pieces(library: Library, data: Path) -> list[Clip]:
    """Every piece as a human clip named ``<skill>_<number>``. Raises ClipError."""
    known = {e.path: e for e in ballplay.read_index(data)}
    found = []
    for skill, rows in library.skills.items():
        for number, piece in enumerate(rows, 1):
            entry = known.get(data / piece.clip)
            if entry is None:
                raise ClipError(f"library: {skill}[{number - 1}]: '{piece.clip}' is not in {data / 'INDEX.csv'}")
            clip = ballplay.read(entry)
            start, stop = piece.frames or (0, len(clip))
            source = f"{clip.header.source}, frames {start}:{stop}"
            clip = mirror(clip) if piece.mirror else clip
            source += ", mirrored" if piece.mirror else ""
            found.append(clip.cut(start, stop, name=f"{skill}_{number:02d}", skill=skill, source=source))
    return found


def robot_clips(robot: str, skill: str = "") -> list[Clip]:
    """The clips shipped for a robot, in the order of their names: of one skill or all. Raises ClipError."""
    folder = library_path(robot).parent
    clips = [load_clip(p) for p in sorted(folder.glob("*.npz"))]
    chosen = [c for c in clips if skill in ("", c.header.skill)]
    if not chosen:
        skills = sorted({c.header.skill for c in clips})
        raise ClipError(f"{folder}: no clips of '{skill}'{did_you_mean(skill, skills)}; it has {', '.join(skills)}")
    return chosen


def select(words: tuple[str, ...], data: Path | None) -> list[Clip]:
    """Clips by path (.pt or .npz), or by label (``013``), skill (``dribble_left``), name or ``all`` of a data folder.

    Raises ClipError.
    """
    found = []
    for word in words:
        path = Path(word)
        if path.suffix == ".npz":
            found.append(load_clip(path))
        elif path.suffix == ".pt":
            found.append(ballplay.read(path))
        else:
            found += [ballplay.read(entry) for entry in _entries(word, data_folder(data))]
    return found


def _entries(word: str, data: Path) -> list[ballplay.Entry]:
    entries = [e for e in ballplay.read_index(data) if not e.duplicate]
    chosen = [e for e in entries if word == "all" or word in (e.label, e.skill, e.path.stem)]
    if not chosen:
        options = sorted({e.skill for e in entries} | {e.label for e in entries if e.label})
        raise ClipError(f"no clip '{word}'{did_you_mean(word, options)} in {data}; it has {', '.join(options)}")
    return chosen


def data_folder(data: Path | None) -> Path:
    """``data``, or ``$SIM2REAL_CLIPS``, or ``../shared/data`` beside the repository. Raises ClipError."""
    candidates = [data] if data else [Path(p) for p in (os.environ.get(DATA), HERE.parents[1] / "shared/data") if p]
    for folder in candidates:
        if (folder / "INDEX.csv").is_file():
            return folder
    raise ClipError(
        f"no recordings: looked for INDEX.csv in {', '.join(map(str, candidates))}\n"
        f"  give --data FOLDER or set {DATA}; docs/clips/README.md says where to get BallPlay-M and what INDEX.csv holds"
    )


def robot_library(robot: RobotConfig) -> Library:
    """The library of a robot. Raises ClipError."""
    return read_library(library_path(robot.name))
