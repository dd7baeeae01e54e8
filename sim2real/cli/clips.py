"""Read recorded motions, check them, and retarget them to a robot."""

from __future__ import annotations

import importlib
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from sim2real.options import MaybeNewFile, MaybeNewFolder, NewFolder, NewGif, NotNegative, Positive
from sim2real.types import Sim2realError

Clips = Annotated[
    tyro.conf.Positional[tuple[str, ...]], tyro.conf.arg(metavar="CLIP...", help="files (.pt, .npz), or labels, skills, names or `all` of --data")
]  # fmt: skip


@dataclass(frozen=True)
class Data:
    """Where recordings are."""

    data: Path | None = None
    """folder with an INDEX.csv; default: $SIM2REAL_CLIPS, or ../shared/data beside the repository"""


@dataclass(frozen=True)
class Import(Data):
    """BallPlay-M recordings (T, 337) as clips of our own format, with body positions recomputed and contact split."""

    clips: Clips = ()
    output: Annotated[NewFolder, tyro.conf.arg(aliases=["-o"])] = Path("clips")
    """folder to write to"""
    fps: NotNegative = 0.0
    """frames per second; default: as recorded"""
    mirror: bool = False
    """write every clip's mirror image too"""
    report: MaybeNewFile = None
    """also check them, as an .html file with pictures"""


@dataclass(frozen=True)
class Describe(Data):
    """What clips hold, and whether their ball obeys physics."""

    clips: Clips = ()
    report: MaybeNewFile = None
    """also as an .html file with pictures"""


@dataclass(frozen=True)
class View(Data):
    """A clip as a moving picture. Needs MUJOCO_GL=egl or osmesa on a machine without screen."""

    clips: Clips = ()
    output: Annotated[NewGif, tyro.conf.arg(aliases=["-o"])] = Path("clip.gif")
    """GIF to write; with several clips, their names are added"""


@dataclass(frozen=True)
class Retarget(Data):
    """Human clips as clips of a robot, with a table of what remains wrong."""

    clips: Clips = ()
    robot: str = "g1"
    """name of a robot, or its YAML"""
    library: bool = False
    """all pieces of the robot's library.yaml, into its folder"""
    output: Annotated[MaybeNewFolder, tyro.conf.arg(aliases=["-o"])] = None
    """folder to write to; default: clips/<robot>, or the library's"""
    fps: Positive = 50.0
    """frames per second of the result"""
    ball_radius: NotNegative = 0.0
    """m; default: that of policies/ball.py"""
    mirror: bool = False
    """each clip's mirror image too"""
    table: MaybeNewFile = None
    """write the table of residuals to this .md or .json file"""
    gif: MaybeNewFolder = None
    """write side-by-side GIFs, person and robot, into this folder"""


Command = (
    Annotated[Import, tyro.conf.subcommand("import")]
    | Annotated[Describe, tyro.conf.subcommand("info")]
    | Annotated[View, tyro.conf.subcommand("view")]
    | Annotated[Retarget, tyro.conf.subcommand("retarget")]
)


def main(argv: list[str]) -> int:
    args = tyro.cli(Command, args=argv, prog="sim2real clips", description=__doc__)  # type: ignore[arg-type]
    try:
        return run(args)
    except ModuleNotFoundError as error:
        raise Sim2realError(
            f"clips: needs '{error.name}', which is not installed; pip install 'sim2real[train]'"
        ) from None


def run(args: Import | Describe | View | Retarget) -> int:
    """Hand over: the runtime does not import the packages above it. Raises ModuleNotFoundError without [train]."""
    commands = importlib.import_module("policies.clips.commands")
    if isinstance(args, Import):
        return commands.import_clips(args.clips, args.data, args.output, args.fps, args.mirror, args.report)
    if isinstance(args, Describe):
        return commands.describe(args.clips, args.data, args.report)
    if isinstance(args, View):
        return commands.view_clips(args.clips, args.data, args.output)
    return commands.retarget_clips(
        args.clips,
        args.data,
        args.robot,
        from_library=args.library,
        output=args.output,
        fps=args.fps,
        ball_radius=args.ball_radius,
        mirrored=args.mirror,
        table=args.table,
        gif=args.gif,
    )
