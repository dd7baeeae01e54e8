"""Small drawings for the report: lines, strips and bars as SVG text, thinned to what an eye can see.

Everything that was not a number of ours goes through ``text``, so that a name from a file cannot become markup.
"""

from __future__ import annotations

import base64
import html
import math
import unicodedata
from collections.abc import Sequence
from io import BytesIO

import numpy as np

COLUMNS = 300  # of a line chart: more than its pixels would show


def text(value: object) -> str:
    """``value`` for HTML and SVG, in text or in a quoted attribute; control characters are dropped."""
    return html.escape("".join(c for c in str(value) if unicodedata.category(c)[0] != "C"), quote=True)


def ticks(low: float, high: float, count: int = 5) -> list[float]:
    """Round numbers (1, 2 or 5 times a power of ten apart) inside a range, about ``count`` of them."""
    if not (math.isfinite(low) and math.isfinite(high)) or high <= low:
        return [low] if math.isfinite(low) else []
    raw = (high - low) / count
    power = 10.0 ** math.floor(math.log10(raw))
    step = min((m * power for m in (1, 2, 5, 10)), key=lambda s: abs(s - raw))
    first = math.ceil(low / step - 1e-9)
    return [round(i * step, 12) for i in range(first, math.floor(high / step + 1e-9) + 1)]


def thin(time: np.ndarray, values: np.ndarray, columns: int = COLUMNS) -> tuple[np.ndarray, np.ndarray]:
    """The lowest and highest value of each of ``columns`` equal stretches of time, in the order in which they came.

    What is not finite is left out, and a stretch with nothing else becomes one NaN: a gap in the line.
    """
    if len(time) <= 2 * columns:
        return time, values
    edges = np.searchsorted(time, np.linspace(time[0], time[-1], columns + 1)[1:-1])
    picked: list[int] = []
    for a, b in zip([0, *edges], [*edges, len(time)], strict=True):
        finite = a + np.flatnonzero(np.isfinite(values[a:b]))
        if len(finite):
            picked += sorted({int(finite[values[finite].argmin()]), int(finite[values[finite].argmax()])})
        elif b > a:
            picked.append(a)
    return time[picked], values[picked]


def path(x: np.ndarray, y: np.ndarray) -> str:
    """The ``d`` of a line through (x, y) in drawing units, rounded to whole ones; gaps where y is not finite."""
    out, pen, last = [], "M", None
    for a, b in zip(x.tolist(), y.tolist(), strict=True):
        if not math.isfinite(b):
            pen = "M"
        elif (point := f"{a:.0f} {b:.0f}") != last:
            out.append(pen + point)
            pen, last = "L", point
    return "".join(out)


def bounds(*arrays: np.ndarray, least: float = 1e-3) -> tuple[float, float]:
    """(low, high) of every finite value, at least ``least`` apart, with a little air."""
    finite = np.concatenate([a[np.isfinite(a)].ravel() for a in arrays] or [np.zeros(0)])
    low, high = (float(finite.min()), float(finite.max())) if len(finite) else (0.0, 0.0)
    air = max((high - low) * 0.06, (least - (high - low)) / 2)
    return low - air, high + air


class Frame:
    """The area of a chart: data ranges onto ``width`` x ``height`` drawing units, with room for labels around it."""

    def __init__(
        self, x: tuple[float, float], y: tuple[float, float], width: int, height: int, left: int = 40, bottom: int = 18
    ) -> None:
        self.x, self.y, self.width, self.height, self.left, self.bottom = x, y, width, height, left, bottom

    def to_x(self, value):
        return self.left + (value - self.x[0]) / ((self.x[1] - self.x[0]) or 1.0) * (self.width - self.left - 6)

    def to_y(self, value):
        return 6 + (self.y[1] - value) / ((self.y[1] - self.y[0]) or 1.0) * (self.height - self.bottom - 6)

    def grid(self, x_count: int = 5, y_count: int = 3, unit: str = "") -> str:
        """Lines and numbers behind a chart."""
        out = []
        for value in ticks(*self.y, y_count):
            y = self.to_y(value)
            out.append(f'<path class="grid" d="M{self.left} {y:.1f}H{self.width - 6}"/>')
            out.append(f'<text class="tick end" x="{self.left - 5}" y="{y + 3.5:.1f}">{value:g}{text(unit)}</text>')
        for value in ticks(*self.x, x_count):
            out.append(f'<text class="tick mid" x="{self.to_x(value):.1f}" y="{self.height - 3}">{value:g} s</text>')
        return "".join(out)

    def line(self, time: np.ndarray, values: np.ndarray, css: str, scale: int = 4) -> str:
        """A thinned line, drawn in ``scale`` times finer units."""
        x, y = thin(time, values)
        d = path(scale * self.to_x(x), scale * np.asarray(self.to_y(y)))
        return f'<path class="{css}" transform="scale({1 / scale})" d="{d}"/>'

    def level(self, value: float, css: str) -> str:
        """A horizontal line, if it is inside the frame."""
        if not self.y[0] <= value <= self.y[1]:
            return ""
        return f'<path class="{css}" d="M{self.left} {self.to_y(value):.1f}H{self.width - 6}"/>'

    def svg(self, *content: str, label: str) -> str:
        """The drawing. ``label``: what it shows, for those who cannot see it."""
        size = f'viewBox="0 0 {self.width} {self.height}"'
        return f'<svg {size} role="img" aria-label="{text(label)}">{"".join(content)}</svg>'


def strip_image(values: np.ndarray, time: np.ndarray, columns: int = 600) -> str:
    """A PNG data URI of (n, rows) shares, one row of pixels each: deeper from 0 to 1, red above 1, clear where NaN.

    Each pixel shows the largest value of its stretch of time. Transparency makes it fit any background.
    """
    from PIL import Image

    edges = np.searchsorted(time, np.linspace(time[0], time[-1], min(columns, len(time)) + 1)[:-1])
    filled = np.where(np.isfinite(values), values, -np.inf)
    most = np.maximum.reduceat(filled, np.minimum(edges, len(time) - 1), axis=0).T
    pixels = np.zeros((*most.shape, 4), np.uint8)
    over = most > 1.0
    pixels[..., :3] = np.where(over[..., None], (208, 59, 59), (42, 120, 214))
    pixels[..., 3] = np.where(np.isfinite(most), 12 + 243 * np.clip(most, 0, 1), 0)
    png = BytesIO()
    Image.fromarray(pixels).save(png, "PNG", optimize=True)
    return "data:image/png;base64," + base64.b64encode(png.getvalue()).decode()


def strips(values: np.ndarray, time: np.ndarray, names: Sequence[str], notes: Sequence[str], label: str) -> str:
    """A row per name: the name, its values over time as colour, and a note."""
    row, left, right, width = 15, 190, 60, 1000
    frame = Frame((float(time[0]), float(time[-1])), (0, 1), width - right, row * len(names) + 20, left)
    image = (
        f'<image x="{left}" y="0" width="{width - left - right - 6}" height="{row * len(names)}"'
        f' preserveAspectRatio="none" href="{strip_image(values, time)}"/>'
    )
    labels = "".join(
        f'<text class="name end" x="{left - 8}" y="{row * i + 11}">{text(name)}</text>'
        f'<text class="tick" x="{width - right}" y="{row * i + 11}">{text(note)}</text>'
        for i, (name, note) in enumerate(zip(names, notes, strict=True))
    )
    rules = "".join(f'<path class="rule" d="M{left} {row * i}H{width - right - 6}"/>' for i in range(1, len(names)))
    seconds = "".join(
        f'<text class="tick mid" x="{frame.to_x(t):.1f}" y="{frame.height - 5}">{t:g} s</text>'
        for t in ticks(*frame.x, 8)
    )
    frame.width = width
    return frame.svg(image, rules, labels, seconds, label=label)


def histogram(values: np.ndarray, edges: np.ndarray, label: str) -> str:
    """Bars of how many ``values`` (s) lie between the ``edges``, what is beyond them in the outermost; logarithmic."""
    counts, _ = np.histogram(np.clip(values[np.isfinite(values)], edges[0], edges[-1]), edges)
    height = np.log10(np.maximum(counts, 0.5) / 0.5)
    frame = Frame((0, len(counts)), (0, max(1.0, float(height.max()) * 1.1)), 490, 170, 14, 22)
    bars = []
    for i, count in enumerate(counts.tolist()):
        if count:
            x, y, base = frame.to_x(i) + 1, frame.to_y(height[i]), frame.to_y(0)
            width = frame.to_x(i + 1) - x - 1
            tip = f"{_duration(edges[i])} to {_duration(edges[i + 1])}: {count} ticks"
            bars.append(
                f'<rect class="bar" x="{x:.1f}" y="{y:.1f}" width="{width:.1f}" height="{base - y:.1f}" rx="2">'
                f"<title>{tip}</title></rect>"
                f'<text class="tick mid" x="{x + width / 2:.1f}" y="{y - 3:.1f}">{count}</text>'
            )
    names = "".join(
        f'<text class="tick mid" x="{frame.to_x(i):.1f}" y="{frame.height - 6}">{_duration(edge)}</text>'
        for i, edge in enumerate(edges[:-1])
    )
    base = f'<path class="axis" d="M{frame.left} {frame.to_y(0):.1f}H{frame.width - 6}"/>'
    return frame.svg(*bars, base, names, label=label)


def _duration(seconds: float) -> str:
    return "0" if seconds <= 0 else f"{seconds * 1e6:g} µs" if seconds < 1e-3 else f"{seconds * 1e3:g} ms"
