"""A record as the run that it was: ticks, joints, buses, skills, and the robot file that it carries."""

from __future__ import annotations

import json
import tempfile
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from sim2real.config import ConfigError, RobotConfig, load_robot
from sim2real.recorder.reader import Reader
from sim2real.records import object_layout, pilot_layout, tick_layout
from sim2real.types import Sim2realError

TICK, PILOT, OBJECT = "/tick", "/pilot", "/object"
STAGES = ("standby", "engage", "run")  # of skills.Stage


class Span(NamedTuple):
    """``value`` from ``start`` to ``end``, seconds since the run began."""

    start: float
    end: float
    value: tuple[int, ...]


class Run:
    """``tick`` (n,), ``pilot`` (m,) and ``object`` (k,) are the recorded arrays; the latter two may be empty. Times are
    seconds since the first tick. Raises Sim2realError as ``Reader`` does, and where the record holds no tick.
    """

    def __init__(self, path: Path | str) -> None:
        self.reader = Reader(path)
        self.path = self.reader.path
        if TICK not in self.reader.topics or not {"state.joint_pos", "bus.load"} <= set(
            self.reader.layouts[TICK].elements
        ):
            raise Sim2realError(
                f"{self.path}: a record without a guardian's ticks; it has {', '.join(self.reader.topics) or 'nothing'}"
            )
        self.tick: np.ndarray = self.reader[TICK]
        if len(self.tick) == 0:
            raise Sim2realError(f"{self.path}: a record with no tick in it: the run ended before it began")
        for topic, expected in (
            (TICK, tick_layout(("x",), ("x",))),
            (PILOT, pilot_layout(("x",), {}, ("x",))),
            (OBJECT, object_layout()),
        ):
            if topic in self.reader.topics:
                self._same_version(topic, set(expected.dtype.names or ()))
        self.pilot: np.ndarray = self.reader[PILOT] if PILOT in self.reader.topics else np.zeros(0)
        self.object: np.ndarray = self.reader[OBJECT] if OBJECT in self.reader.topics else np.zeros(0)
        elements = self.reader.layouts[TICK].elements
        self.joints = elements["state.joint_pos"]
        self.buses = elements["bus.load"]
        self.labels = self.reader.layouts[PILOT].elements.get("skill_value", ()) if PILOT in self.reader.topics else ()
        self.start = float(self.tick["time"][0])

    def _same_version(self, topic: str, expected: set[str]) -> None:
        if absent := sorted(expected - set(self.reader[topic].dtype.names or ())):
            names = ", ".join(f"'{name}'" for name in absent)
            raise Sim2realError(
                f"{self.path}: recorded by another version of sim2real: its {topic.strip('/')}s have no {names};"
                f" look into it with the version that wrote it ({self.metadata.get('revision') or 'not stated'})"
            )

    @property
    def metadata(self) -> dict[str, str]:
        return self.reader.metadata

    @cached_property
    def robot(self) -> RobotConfig:
        """The robot file of the run. Raises ConfigError where the record has none, or not for these joints."""
        content = self.reader.attachments.get("robot.yaml")
        if content is None:
            raise ConfigError(f"{self.path}: no robot.yaml in the record; give the robot's file with --robot")
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "robot.yaml"
            path.write_bytes(content)
            try:
                robot = load_robot(path)
            except ConfigError as error:
                raise ConfigError(f"{self.path}: its {str(error).replace(folder + '/', '')}") from None
        return self.check(robot)

    def check(self, robot: RobotConfig) -> RobotConfig:
        """``robot``, if it has the record's joints in the record's order. Raises ConfigError."""
        if robot.joint_names != self.joints:
            first = next(
                (a, b) for a, b in zip((*self.joints, None), (*robot.joint_names, None), strict=False) if a != b
            )
            raise ConfigError(
                f"{self.path}: recorded of another robot: joint '{first[0]}' where {robot.name} has '{first[1]}';"
                " give the robot file that fits with --robot"
            )
        return robot

    @cached_property
    def time(self) -> np.ndarray:
        """(n,) s of the ticks."""
        return self.tick["time"] - self.start

    @cached_property
    def pilot_time(self) -> np.ndarray:
        """(m,) s of the pilot's ticks."""
        return self.pilot["time"] - self.start if len(self.pilot) else np.zeros(0)

    @property
    def duration(self) -> float:
        return float(self.time[-1])

    def missing(self, records: np.ndarray) -> int:
        """How many ticks the record lacks between its first and its last."""
        return int(records["tick"][-1] - records["tick"][0] + 1 - len(records)) if len(records) else 0

    def dropped(self) -> dict[str, int]:
        """Topic -> records that the recorder knows it lost."""
        return json.loads(self.reader.ending.get("dropped", "{}"))

    def modes(self) -> list[Span]:
        """Spans of (mode, fault's rule number, fault's joint)."""
        return spans(self.time, self.tick["mode"], self.tick["fault"], self.tick["fault_joint"])

    def skills(self) -> list[Span]:
        """Spans of (stage, skill's label index)."""
        return spans(self.pilot_time, self.pilot["stage"], self.pilot["skill"]) if len(self.pilot) else []

    def label(self, index: int) -> str:
        return self.labels[index] if 0 <= index < len(self.labels) else f"skill {index}"

    def joint(self, index: int) -> str:
        return self.joints[index] if 0 <= index < len(self.joints) else ""


def spans(time: np.ndarray, *values: np.ndarray) -> list[Span]:
    """Where a tuple of integers stays the same: from its first tick to the first tick of the next."""
    rows = np.stack([np.asarray(v, np.int64) for v in values], axis=1)
    edges = [0, *(np.flatnonzero((rows[1:] != rows[:-1]).any(axis=1)) + 1).tolist(), len(rows)]
    return [
        Span(float(time[a]), float(time[min(b, len(rows) - 1)]), tuple(rows[a].tolist()))
        for a, b in zip(edges, edges[1:], strict=False)
    ]


def rule_name(number: int) -> str:
    """``S2R-014 temperature_warn``."""
    from sim2real.safety import RULES

    names = {rule.number: f" {rule.name}" for rule in RULES}
    return f"S2R-{number:03d}{names.get(number, '')}"


def plain(value: Any) -> Any:
    """Numbers as JSON has them: what is not finite is null."""
    if isinstance(value, dict):
        return {k: plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [plain(v) for v in value]
    if isinstance(value, float | np.floating):
        return float(value) if np.isfinite(value) else None
    return int(value) if isinstance(value, np.integer) else value
