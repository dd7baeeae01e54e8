"""What ``sim2real clips`` does: import, info, view, retarget. Each returns the exit code."""

from __future__ import annotations

import json
from collections.abc import Iterator
from functools import partial
from pathlib import Path

from rich.console import Console
from rich.markup import escape
from rich.progress import track
from rich.table import Table

from policies.ball import RADIUS
from policies.clips import check, library
from policies.clips.feasibility import Residuals
from policies.clips.format import Clip, ClipError, save_clip
from policies.clips.mirror import mirror
from policies.clips.resample import resample
from policies.clips.robot import RobotBody
from sim2real.config import load_robot

# column -> how a residual is printed: key, factor, format
COLUMNS: dict[str, tuple[str, float, str]] = {
    "gap mm": ("hand_gap_median", 1e3, ".1f"),
    "worst": ("hand_gap_worst", 1e3, ".1f"),
    "body in ball": ("ball_penetration", 1e3, ".1f"),
    "skate": ("foot_skate", 1e3, ".1f"),
    "sole up": ("foot_height", 1e3, ".1f"),
    "in floor": ("floor_penetration", 1e3, ".1f"),
    "in itself": ("self_penetration", 1e3, ".1f"),
    "limits": ("limit_violations", 1, ".0f"),
    "velocity": ("velocity_share", 1, ".2f"),
    "torque": ("torque_share", 1, ".2f"),
    "force": ("missing_force", 1, ".2f"),
    "N m": ("missing_torque", 1, ".1f"),
}
LEGEND = """gap: palm to ball surface while they touch, median and worst; body in ball, skate (how far a standing sole moves),
sole up (how far it is off the floor), in floor, in itself: largest. All in mm. limits: joints x frames outside the position
limits. velocity, torque: share of the joint limit, largest and 99th percentile. force (share of body weight) and N m: what
standing soles cannot give the base, 95th percentile."""


def import_clips(
    words: tuple[str, ...], data: Path | None, output: Path, fps: float, mirrored: bool, report: Path | None
) -> int:
    """Write the recordings ``words`` name as ``<output>/<name>.npz``. Raises ClipError."""
    output.mkdir(parents=True, exist_ok=True)
    clips = [resample(c, fps) if fps else c for c in _chosen(words, data)]
    clips += [mirror(c) for c in clips] if mirrored else []
    for clip in clips:
        save_clip(clip, output / f"{clip.name}.npz")
    print(f"{len(clips)} clips, {sum(c.seconds for c in clips):.1f} s, in {output}")
    _report(clips, report)
    return 0


def describe(words: tuple[str, ...], data: Path | None, report: Path | None) -> int:
    """Print what the clips hold. Raises ClipError."""
    clips = _chosen(words, data)
    table = Table("clip", "skill", "body", "s", "fps", "joints", "contact", "gravity", "bounce")
    table.columns[0].no_wrap = True
    for clip in clips:
        c = check.check(clip)
        table.add_row(
            escape(clip.name), clip.header.skill, clip.header.body, f"{c.seconds:.2f}", f"{clip.fps:g}",
            str(len(clip.header.joint_names) or "-"), " ".join(f"{x:.0%}" for x in clip.contact.mean(axis=0)),
            " ".join(f"{g:.2f}" for g in c.gravity) or "-", " ".join(f"{r:.2f}" for r in c.restitution) or "-",
        )  # fmt: skip
    console = _console()
    console.print(table)
    for name, text in check.summary([check.check(clip) for clip in clips]).items():
        console.print(f"  {name}: {text}", highlight=False)
    if len(clips) == 1:
        for name, value in clips[0].header.model_dump().items():
            console.print(f"  {name}: {value}", highlight=False, markup=False)
    _report(clips, report)
    return 0


def view_clips(words: tuple[str, ...], data: Path | None, output: Path) -> int:
    """Draw every clip as a GIF. Raises ClipError."""
    from policies.clips.draw import view
    from policies.clips.robot import RobotBody

    clips = _chosen(words, data)
    for clip in track(clips, "drawing", transient=True):
        path = output if len(clips) == 1 else output.with_name(f"{output.stem}_{clip.name}.gif")
        human = clip.header.body == "human"
        view(clip, path, None if human else RobotBody.of(load_robot(clip.header.body)))
        print(path)
    return 0


def retarget_clips(
    words: tuple[str, ...],
    data: Path | None,
    robot_name: str,
    *,
    from_library: bool,
    output: Path | None,
    fps: float,
    ball_radius: float,
    mirrored: bool,
    table: Path | None,
    gif: Path | None,
) -> int:
    """Retarget, write ``<output>/<name>.npz`` and print the table of residuals. Raises ClipError."""
    from policies.clips import draw, feasibility
    from policies.clips.retarget import retarget

    body = RobotBody.of(load_robot(robot_name))
    clips = list(_to_retarget(words, data, body.robot.name, from_library, mirrored))
    folder = output or (_library_folder(body.robot.name) if from_library else Path("clips") / body.robot.name)
    for place in (folder, gif):
        if place:
            place.mkdir(parents=True, exist_ok=True)
    rows: dict[str, Residuals] = {}
    for robot in _by_formula(body) if from_library else ():
        save_clip(robot, folder / f"{robot.name}.npz")
        rows[robot.name] = feasibility.residuals(robot, body)
    for human in track(clips, "retargeting", transient=True):
        robot, _ = retarget(human, body, fps, ball_radius or RADIUS)
        save_clip(robot, folder / f"{robot.name}.npz")
        rows[robot.name] = feasibility.residuals(robot, body)
        if gif:
            draw.side_by_side(human, robot, body, gif / f"{robot.name}.gif")
    _print_residuals(rows)
    print(f"{len(rows)} clips of {body.robot.name} in {folder}")
    if table:
        table.write_text(_document(rows, table.suffix))
        print(table)
    return 0


def _to_retarget(
    words: tuple[str, ...], data: Path | None, robot: str, from_library: bool, mirrored: bool
) -> Iterator[Clip]:
    if from_library:
        chosen = library.read_library(library.library_path(robot))
        clips = library.pieces(chosen, library.data_folder(data))
    else:
        clips = _chosen(words, data)
    for clip in clips:
        yield clip
        if mirrored:
            yield mirror(clip)


def _by_formula(body: RobotBody) -> Iterator[Clip]:
    """What the library of a robot has made by formula, numbered after its pieces of recordings."""
    from policies.clips.bounce import STRETCHED, WALKING, bounce, dribble
    from policies.clips.pickup import pickup

    chosen = library.robot_library(body.robot)
    for skill, ways in chosen.formulas.items():
        for number, way in enumerate(ways, 1 + len(chosen.skills.get(skill, ()))):
            name = f"{skill}_{number:02d}"
            made = {
                "stretched": partial(dribble, side="right", stroke=STRETCHED),
                "both": bounce,
                "walking": partial(bounce, drop=WALKING),
                "floor": pickup,
            }
            yield made[way](body, name) if way in made else dribble(body, name, way)


def _library_folder(robot: str) -> Path:
    return library.library_path(robot).parent


def _chosen(words: tuple[str, ...], data: Path | None) -> list[Clip]:
    if not words:
        raise ClipError("got no clips; name files (.pt, .npz), or labels, skills or names of a data folder, or `all`")
    return library.select(words, data)


def _print_residuals(rows: dict[str, Residuals]) -> None:
    table = Table("clip", *COLUMNS)
    table.columns[0].no_wrap = True
    for name, row in rows.items():
        table.add_row(escape(name), *_cells(row))
    _console().print(table)
    print(LEGEND)


def _console() -> Console:
    """As wide as the terminal; 150 columns into a file."""
    console = Console()
    return console if console.is_terminal else Console(width=150)


def _cells(row: Residuals) -> list[str]:
    values = row.as_dict()
    return [f"{values[key] * factor:{form}}" for key, factor, form in COLUMNS.values()]


def _document(rows: dict[str, Residuals], suffix: str) -> str:
    if suffix == ".json":
        return json.dumps({name: row.as_dict() for name, row in rows.items()}, indent=2) + "\n"
    lines = [f"| clip | {' | '.join(COLUMNS)} |", "|---" + "|---:" * len(COLUMNS) + "|"]
    lines += [f"| {n} | {' | '.join(_cells(r))} |" for n, r in rows.items()]
    return "\n".join([*lines, "", *LEGEND.split("\n")]) + "\n"


def _report(clips: list[Clip], path: Path | None) -> None:
    if path:
        check.write_report(clips, path)
        print(path)
