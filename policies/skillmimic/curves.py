"""What learning took: success of every skill over samples, as a table and as one SVG that needs nothing else."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from sim2real.recorder.svg import Frame, text, ticks
from sim2real.types import Sim2realError

PAPER = 650e6  # samples of one ball skill of the paper (section 6.3.1)
COLOURS = ("#2a78d6", "#12805c", "#8a5fd0", "#b8621b", "#b83280", "#557a1f", "#14808f", "#a0522d")
STYLE = (
    "text{font:11px system-ui,sans-serif;fill:#808080}.end{text-anchor:end}.mid{text-anchor:middle}.grid{stroke:#8084}"
)
STYLE += "".join(f".s{k}{{fill:none;stroke-width:6;stroke:{c}}}.k{k}{{fill:{c}}}" for k, c in enumerate(COLOURS))


class Curve(NamedTuple):
    """Runs that were each started from the last one's checkpoint, as one; a row an evaluation."""

    samples: np.ndarray  # (T,)
    hours: np.ndarray  # (T,) of CPU; NaN where a run did not say
    success: dict[str, np.ndarray]  # (T,) by skill, in [0, 1]


def read(folders: Sequence[Path]) -> Curve:
    """The ``curve.jsonl`` of every folder, in their order. Raises Sim2realError for one that has none."""
    rows, samples, seconds = [], 0.0, 0.0
    for folder in folders:
        path, done = folder / "curve.jsonl", 0.0
        if not path.is_file():
            raise Sim2realError(f"{folder}: has no curve.jsonl, expected the folder of a run")
        for line in path.read_text().splitlines():
            row = json.loads(line)
            done, seconds = row["samples"], seconds + row.get("cpu", np.nan)
            skills = {k.removeprefix("success_"): v for k, v in row.items() if k.startswith("success_")}
            if skills:
                rows.append((samples + done, seconds / 3600, skills))
        samples += done
    if not rows:
        raise Sim2realError(f"{', '.join(map(str, folders))}: no evaluation yet; they come every config.evaluate_every")
    labels = dict.fromkeys(label for *_, skills in rows for label in skills)
    success = {label: np.array([skills.get(label, np.nan) for *_, skills in rows]) for label in labels}
    return Curve(np.array([r[0] for r in rows]), np.array([r[1] for r in rows]), success)


def learned(curve: Curve, targets: Mapping[str, float]) -> str:
    """Markdown: when each skill first met its target (as training measures it), and the best it came to."""
    rows = []
    for label, success in curve.success.items():
        target = targets.get(label, 0.95)
        met, best = np.flatnonzero(success >= target), int(np.nanargmax(success))
        rows.append(
            f"| `{label}` | {_when(curve, met[0]) if len(met) else 'not yet'} | {success[best]:.0%} after"
            f" {_when(curve, best)} |"
        )
    head = "| skill | at its target after | best, as training measures it |\n|---|---|---|\n"
    return head + "\n".join(rows)


def _when(curve: Curve, k: int) -> str:
    samples, hours = float(curve.samples[k]), float(curve.hours[k])
    share = f"{samples / 1e6:.2g} M samples (1/{PAPER / samples:.0f} of the paper's)"
    return share if np.isnan(hours) else f"{share}, {hours:.2f} CPU-hours"


def svg(curve: Curve) -> str:
    """Success of every skill over millions of samples."""
    millions, names = curve.samples / 1e6, list(curve.success)
    frame = Frame((0.0, float(millions[-1])), (0.0, 1.0), 640, 260, left=44, bottom=34)
    parts = [f"<style>{STYLE}</style>"]
    for value in ticks(0.0, 1.0, 5):
        y = float(frame.to_y(value))
        parts.append(f'<path class="grid" d="M{frame.left} {y:.1f}H{frame.width - 6}"/>')
        parts.append(f'<text class="end" x="{frame.left - 5}" y="{y + 4:.1f}">{value:.0%}</text>')
    for value in ticks(*frame.x, 6):
        parts.append(f'<text class="mid" x="{frame.to_x(value):.1f}" y="{frame.height - 18}">{value:g} M</text>')
    for k, (name, values) in enumerate(curve.success.items()):
        seen = np.isfinite(values)
        parts.append(frame.line(millions[seen], values[seen], f"s{k % len(COLOURS)}"))
        x = frame.left + k * (frame.width - frame.left) / len(names)
        parts.append(f'<text class="k{k % len(COLOURS)}" x="{x:.0f}" y="{frame.height - 3}">{text(name)}</text>')
    drawn = frame.svg(*parts, label=f"success of {', '.join(names)} over samples")
    return drawn.replace("<svg ", '<svg xmlns="http://www.w3.org/2000/svg" ', 1) + "\n"
