"""What an option may be: ``envs: Count = 512``. What could not be meant is refused where it is read, before anything is done.

``MaybeCount`` and the like are for options that are None unless given.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

from tyro.constructors import PrimitiveConstructorSpec


def _spec(metavar: str, read: Callable[[list[str]], Any], count: int = 1) -> Any:
    """Of an option of ``count`` words. ``read`` raises ValueError."""
    return PrimitiveConstructorSpec(
        nargs=count,
        metavar=metavar,
        instance_from_str=read,
        is_instance=lambda value: True,  # defaults are ours
        str_from_instance=lambda value: [str(x) for x in value] if count > 1 else [str(value)],
    )


def _number(kind: type[int] | type[float], expected: str, good: Callable[[Any], bool], count: int = 1) -> Any:
    """``count`` numbers of a ``kind``, each of them finite and ``good``, which ``expected`` says in words."""

    def read(words: list[str]) -> Any:
        try:
            numbers = tuple(kind(word) for word in words)
        except ValueError:
            numbers = ()
        if not numbers or not all(math.isfinite(x) and good(x) for x in numbers):
            raise ValueError(f"got {' '.join(words)}, expected {expected}")
        return numbers if count > 1 else numbers[0]

    return _spec(" ".join([kind.__name__.upper()] * count), read, count)


def _file(ending: str = "") -> Any:
    """A file that will be written, which ends in ``ending``. Its folder is made at once: what is written last may have taken
    hours."""

    def read(words: list[str]) -> Path:
        path = Path(words[0])
        if path.is_dir():
            raise ValueError(f"got {path}, a folder, expected a file to write")
        if ending and path.suffix.lower() != ending:
            raise ValueError(f"got {path}, expected a file to write that ends in {ending}")
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise ValueError(f"got {path}, whose folder cannot be made: {error.strerror}") from None
        if not os.access(path.parent, os.W_OK):
            raise ValueError(f"got {path}, in a folder that may not be written")
        return path

    return _spec("PATH", read)


def _read_folder(words: list[str]) -> Path:
    """A folder that will be written into; it is made when there is something to write."""
    path = there = Path(words[0])
    while not there.exists() and there != there.parent:
        there = there.parent
    if not there.is_dir():
        raise ValueError(f"got {path}, but {there} is a file, expected a folder to write into")
    if not os.access(there, os.W_OK):
        raise ValueError(f"got {path}, but {there} may not be written")
    return path


_COUNT = _number(int, "a whole number, at least 1", lambda x: x >= 1)
_SEED = _number(int, "a whole number, at least 0", lambda x: x >= 0)
_POSITIVE = _number(float, "a number above 0", lambda x: x > 0)
_FILE, _GIF, _FOLDER = _file(), _file(".gif"), _spec("PATH", _read_folder)

Count = Annotated[int, _COUNT]
MaybeCount = Annotated[int | None, _COUNT]
Seed = Annotated[int, _SEED]
MaybeSeed = Annotated[int | None, _SEED]
Positive = Annotated[float, _POSITIVE]
MaybePositive = Annotated[float | None, _POSITIVE]
NotNegative = Annotated[float, _number(float, "a number, at least 0", lambda x: x >= 0)]
Velocity = Annotated[tuple[float, float, float], _number(float, "three numbers", lambda x: True, count=3)]
NewFile = Annotated[Path, _FILE]
MaybeNewFile = Annotated[Path | None, _FILE]
NewGif = Annotated[Path, _GIF]
MaybeNewGif = Annotated[Path | None, _GIF]
NewFolder = Annotated[Path, _FOLDER]
MaybeNewFolder = Annotated[Path | None, _FOLDER]
