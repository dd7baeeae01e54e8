"""Is a recording physics? Free fall, bounces and contacts of clips against what they should be, as a report with pictures."""

from __future__ import annotations

from dataclasses import dataclass
from html import escape
from pathlib import Path

import numpy as np

from policies.clips.contact import hand_distance, spans
from policies.clips.flight import bounces, flights
from policies.clips.format import CONTACTS, Clip

WIDTH, HEIGHT, LEFT, ROW = 640, 150, 44, 9  # pixels of a picture; ROW: of a contact bar
COLOURS = ("#c0392b", "#2471a3", "#e59866", "#7fb3d5")


@dataclass(frozen=True)
class Check:
    """What one clip says about its ball."""

    name: str
    skill: str
    split: str
    frames: int
    seconds: float
    gravity: tuple[float, ...]  # m/s^2, one a free flight
    flight_error: float  # m, root mean square from the parabolas
    restitution: tuple[float, ...]  # one a clean floor bounce
    touch_distance: float  # m from the nearer hand to the ball's centre while there is contact, median; 0: never
    apart_distance: float  # m while there is none, 5th percentile; 0: always contact


def check(clip: Clip) -> Check:
    """Measure a human ``clip``; a clip without ball has no flights, bounces or touches."""
    touched = clip.contact[:, :2].any(axis=1)
    ball, radius = clip.ball_position_in_world, clip.header.ball_radius
    flying = flights(ball, touched, clip.fps, radius) if clip.header.has_ball else []
    hit = bounces(ball, touched, clip.fps, radius) if clip.header.has_ball else []
    human = clip.header.has_ball and clip.header.body == "human"
    distance = hand_distance(clip.points_in_world, ball).min(axis=1) if human else np.zeros(0)
    return Check(
        name=clip.name,
        skill=clip.header.skill,
        split=clip.header.split,
        frames=len(clip),
        seconds=clip.seconds,
        gravity=tuple(f.gravity for f in flying),
        flight_error=float(np.sqrt(np.mean([f.error**2 for f in flying]))) if flying else 0.0,
        restitution=tuple(b.restitution for b in hit),
        touch_distance=float(np.median(distance[touched])) if human and touched.any() else 0.0,
        apart_distance=float(np.percentile(distance[~touched], 5)) if human and not touched.all() else 0.0,
    )


def summary(checks: list[Check]) -> dict[str, str]:
    """All clips together, as text by quantity."""
    gravity = [g for c in checks for g in c.gravity]
    restitution = [r for c in checks for r in c.restitution]
    touch = [c.touch_distance for c in checks if c.touch_distance]
    return {
        "clips": f"{len(checks)}, {sum(c.seconds for c in checks):.1f} s",
        "free fall": _quartiles(gravity, "m/s^2, expected 9.81", "flights"),
        "restitution": _quartiles(restitution, "expected 0.80", "floor bounces"),
        "hand to ball centre in contact": _quartiles(touch, "m", "clips"),
    }


def _quartiles(values: list[float], unit: str, of: str) -> str:
    if not values:
        return f"no {of}"
    low, middle, high = np.percentile(values, [25, 50, 75])
    return f"{middle:.3f} (quartiles {low:.3f} to {high:.3f}) {unit}; {len(values)} {of}"


def write_report(clips: list[Clip], path: str | Path) -> None:
    """One HTML file: a table, and for every clip the ball's height with its flights, bounces and contacts."""
    checks = [check(clip) for clip in clips]
    rows = "".join(f"<tr><th>{escape(k)}</th><td>{escape(v)}</td></tr>" for k, v in summary(checks).items())
    head = "clip skill split frames s gravity restitution touch picture".split()
    table = "".join(_row(c, clip) for c, clip in zip(checks, clips, strict=True))
    Path(path).write_text(
        "<!doctype html><meta charset='utf-8'><title>Clips</title>"
        "<style>body{font:14px sans-serif;margin:2em}table{border-collapse:collapse}td,th{padding:2px 8px;"
        "border-bottom:1px solid #ddd;text-align:left;vertical-align:top}svg{display:block}</style>"
        f"<h1>Clips</h1><table>{rows}</table><p>Line: height of the ball's centre, m. Green: fitted flight. Dots: floor"
        f" bounces. Bars: {', '.join(CONTACTS)}.</p><table><tr>{''.join(f'<th>{h}</th>' for h in head)}</tr>{table}</table>"
    )


def _row(c: Check, clip: Clip) -> str:
    gravity = " ".join(f"{g:.2f}" for g in c.gravity) or "-"
    restitution = " ".join(f"{r:.2f}" for r in c.restitution) or "-"
    cells = [c.name, c.skill, c.split, c.frames, f"{c.seconds:.2f}", gravity, restitution, f"{c.touch_distance:.3f}"]
    return f"<tr>{''.join(f'<td>{escape(str(x))}</td>' for x in cells)}<td>{picture(clip)}</td></tr>"


def picture(clip: Clip) -> str:
    """An SVG of the ball's height over time, with flights, bounces and contact bars."""
    z = clip.ball_position_in_world[:, 2]
    top = max(float(z.max()) * 1.05, 0.5)
    plot = HEIGHT - len(CONTACTS) * ROW - 16
    x = LEFT + np.arange(len(clip)) / max(len(clip) - 1, 1) * (WIDTH - LEFT - 6)
    y = 4 + plot * (1 - z / top)
    touched = clip.contact[:, :2].any(axis=1)
    parts = [
        f"<polyline fill='none' stroke='{colour}' stroke-width='{width}' points='"
        + " ".join(f"{a:.1f},{b:.1f}" for a, b in zip(x[lo:hi], y[lo:hi], strict=True))
        + "'/>"
        for lo, hi, colour, width in [
            (0, len(clip), "#666", 1.5),
            *((f.start, f.stop, "#27ae60", 3) for f in _flights(clip, touched)),
        ]
    ]
    parts += [
        f"<circle cx='{x[b.frame]:.1f}' cy='{y[b.frame]:.1f}' r='4' fill='#8e44ad'/>" for b in _bounces(clip, touched)
    ]
    for k, contact in enumerate(clip.contact.T):
        level = plot + 12 + k * ROW
        parts += [
            f"<rect x='{x[a]:.1f}' y='{level}' width='{x[b - 1] - x[a] + 1:.1f}' height='{ROW - 2}' fill='{COLOURS[k]}'/>"
            for a, b in spans(contact)
        ]
    axis = f"<text x='2' y='14' font-size='11'>{top:.1f} m</text><text x='2' y='{plot + 4}' font-size='11'>0</text>"
    end = f"<text x='{WIDTH - 40}' y='{HEIGHT - 2}' font-size='11'>{clip.seconds:.2f} s</text>"
    return (
        f"<svg width='{WIDTH}' height='{HEIGHT}' xmlns='http://www.w3.org/2000/svg'>{axis}{end}{''.join(parts)}</svg>"
    )


def _flights(clip: Clip, touched: np.ndarray) -> list:
    return flights(clip.ball_position_in_world, touched, clip.fps, clip.header.ball_radius)


def _bounces(clip: Clip, touched: np.ndarray) -> list:
    return bounces(clip.ball_position_in_world, touched, clip.fps, clip.header.ball_radius)
