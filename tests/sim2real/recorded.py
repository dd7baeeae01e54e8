"""Synthetic records for the recorder's tests: random walks over every field, with the values that break things."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from sim2real.recorder.mcap import Writer
from sim2real.records import QUATERNION, Layout, pilot_layout, tick_layout

JOINTS = ("left_hip_joint", "left_knee_joint", "Right Hip/Joint")
BUSES = ("left_leg", "right_leg")
SKILLS = ("stand", "<wave>")
LAYOUTS = {
    "/tick": tick_layout(JOINTS, BUSES),
    "/pilot": pilot_layout(JOINTS, {"p.joint_pos": JOINTS, "p.orientation_base_in_world": QUATERNION}, SKILLS),
}


def random_walk(layout: Layout, n: int, seed: int = 0, rate: float = 250.0) -> np.ndarray:
    """(n,) records: every field walks, some are NaN, infinite or as large as they can be; ``time`` and ``tick`` count."""
    rng = np.random.default_rng(seed)
    records = np.zeros(n, layout.dtype)
    for name in layout.dtype.names or ():
        field = records[name]
        steps = rng.normal(size=field.shape)
        records[name] = (
            np.cumsum(steps, axis=0) if field.dtype.kind == "f" else rng.integers(-(2**63), 2**63 - 1, field.shape)
        )
        if field.dtype.kind == "f":
            records[name][rng.random(field.shape) < 0.01] = rng.choice([np.nan, -np.inf, np.inf, 5e-324, 1.7e308, -0.0])
    records["time"] = 100.0 + np.arange(n) / rate
    records["tick"] = np.arange(n)
    return records


def write_record(
    path: Path,
    arrays: dict[str, np.ndarray],
    layouts: dict[str, Layout] = LAYOUTS,
    metadata: dict | None = None,
    attachments: dict[str, bytes] | None = None,
) -> Path:
    """A finished record of ``arrays``, all topics in the order of their times."""
    writer = Writer(path, layouts, metadata, attachments)
    order = sorted((t, k, i) for k, topic in enumerate(layouts) for i, t in enumerate(arrays[topic]["time"].tolist()))
    for time, k, i in order:
        assert writer.write(k, time, arrays[list(layouts)[k]][i : i + 1])
    return writer.finish({"written": dict(zip(layouts, writer.written, strict=True))})
