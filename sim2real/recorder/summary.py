"""What a record says about its run: times, modes, faults, skills, and how far joints, motors and buses were stretched."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np

from sim2real.config import ConfigError
from sim2real.recorder.run import STAGES, Run, plain, rule_name
from sim2real.types import Mode

QUANTILES = {"p50": 0.5, "p99": 0.99, "p99.9": 0.999, "max": 1.0}


@dataclass
class JointSummary:
    """``tracking_rmse``: of commanded against measured position while armed. ``margin``: the closest it came to its
    mechanical range while armed (negative: beyond). None: the record has no robot file, or no armed tick."""

    name: str
    tracking_rmse: float | None  # rad
    margin: float | None  # rad
    torque_max: float  # N m
    torque_share: float | None  # of the joint's limit
    temperature_max: float  # deg C


@dataclass
class BusSummary:
    """Frames are counted since the bus was opened. ``load``: share of the wire's time."""

    name: str
    load_mean: float
    load_max: float
    sent: int
    received: int
    rejected: int
    lost: int


@dataclass
class ObjectSummary:
    """What was seen of the object. ``age``: quantiles of the age of its estimate since it was first seen."""

    sightings: int
    used: int
    age: dict[str, float]  # quantile -> s


@dataclass
class Period:
    """A stretch of the run with one mode or skill, seconds since the run began."""

    start: float
    end: float
    name: str
    fault: str = ""
    joint: str = ""


@dataclass
class RecordSummary:
    """One JSON-able object. Seconds, unless a field says otherwise; ``*_missing``: ticks that the record lacks."""

    record: str
    run: dict[str, str]  # what the run said about itself
    duration: float
    ticks: int
    ticks_late: int
    ticks_missing: int
    policy_ticks: int
    policy_ticks_late: int
    policy_ticks_missing: int
    recording_stopped: str
    modes: list[Period]
    skills: list[Period]
    faults: list[str]
    refused_switches: int
    limited_ticks: int  # in which the gate changed a target
    timing: dict[str, dict[str, float]]  # stage -> quantile -> s
    buses: list[BusSummary]
    joints: list[JointSummary]
    object: ObjectSummary | None = None  # None: no policy asked where it is
    notes: list[str] = field(default_factory=list)

    def as_dict(self) -> dict[str, Any]:
        """Plain JSON types; what is not finite is null."""
        return plain(asdict(self))


def summarise(run: Run) -> RecordSummary:
    """The summary of a run. Values that the robot never reported (NaN) count nowhere."""
    tick, pilot, notes = run.tick, run.pilot, []
    try:
        robot = run.robot
    except ConfigError as error:
        robot = None
        notes.append(f"no joint limits: {error}")
    if missing := run.missing(tick):
        notes.append(f"{missing} ticks are not in the record: the recorder could not keep up")
    modes = [_period(run, span) for span in run.modes()]
    timing = {stage: quantiles(tick[f"timing.{stage}"]) for stage in ("lateness", "read", "safety", "write")}
    if len(pilot):
        timing |= {f"pilot {stage}": quantiles(pilot[f"timing.{stage}"]) for stage in ("lateness", "policy", "total")}
    return RecordSummary(
        record=str(run.path),
        run=dict(run.metadata),
        duration=run.duration,
        ticks=len(tick),
        ticks_late=int(tick["late"][-1]),
        ticks_missing=missing,
        policy_ticks=len(pilot),
        policy_ticks_late=int(pilot["late"][-1]) if len(pilot) else 0,
        policy_ticks_missing=run.missing(pilot),
        recording_stopped=run.reader.ending.get("stopped", ""),
        modes=modes,
        skills=[Period(s.start, s.end, skill_name(run, *s.value)) for s in run.skills()],
        faults=faults(modes),
        refused_switches=int(pilot["refused"][-1]) if len(pilot) else 0,
        limited_ticks=int((tick["limited"] > 0).sum()),
        timing=timing,
        buses=[_bus(run, i) for i in range(len(run.buses))],
        joints=_joints(run, robot),
        object=_object(run),
        notes=notes,
    )


def quantiles(values: np.ndarray) -> dict[str, float]:
    """p50, p99, p99.9 and max of the finite ones; NaN where there is none."""
    finite = values[np.isfinite(values)]
    return {name: float(np.quantile(finite, q)) if len(finite) else float("nan") for name, q in QUANTILES.items()}


def skill_name(run: Run, stage: int, skill: int) -> str:
    """``walk`` while the policy drives, else the stage."""
    return run.label(skill) if stage == 2 else STAGES[stage] if 0 <= stage < 2 else f"stage {stage}"


def faults(modes: list[Period]) -> list[str]:
    """Each fault once, in the order in which they came."""
    return list(dict.fromkeys(f"{m.fault}{f' of {m.joint}' if m.joint else ''}" for m in modes if m.fault))


def mode_name(mode: int) -> str:
    """``RUN`` ... ``OFF``."""
    return Mode(mode).name if mode in tuple(Mode) else f"mode {mode}"


def _period(run: Run, span) -> Period:
    mode, fault, joint = span.value
    return Period(
        span.start, span.end, mode_name(mode), rule_name(fault) if fault else "", run.joint(joint) if fault else ""
    )


def _bus(run: Run, i: int) -> BusSummary:
    load, last = run.tick["bus.load"][:, i], run.tick[-1]
    finite = load[np.isfinite(load)]
    counts = {name: int(last[f"bus.{name}"][i]) for name in ("sent", "received", "rejected", "lost")}
    mean, most = (float(finite.mean()), float(finite.max())) if len(finite) else (float("nan"),) * 2
    return BusSummary(run.buses[i], mean, most, **counts)


def _object(run: Run) -> ObjectSummary | None:
    if not len(run.object):
        return None
    last = run.object[-1]
    return ObjectSummary(int(last["sightings"]), int(last["used"]), quantiles(run.object["age"]))


def _joints(run: Run, robot) -> list[JointSummary]:
    tick = run.tick
    armed = tick["mode"] <= Mode.HOLD
    pos, target = tick["state.joint_pos"][armed], tick["command.joint_pos"][armed]
    held = (tick["command.kp"][armed] > 0) & np.isfinite(pos)
    torque = np.fmax.reduce(np.abs(tick["state.joint_torque"]), axis=0)
    temperature = np.fmax.reduce(tick["state.joint_temperature"], axis=0)
    out = []
    for i, name in enumerate(run.joints):
        error = (target[:, i] - pos[:, i])[held[:, i]]
        heard = pos[np.isfinite(pos[:, i]), i]
        margin = share = None
        if robot is not None:
            low, high = robot.joints[i].position
            margin = float(min(heard.min() - low, high - heard.max())) if len(heard) else None
            share = float(torque[i] / robot.joints[i].torque)
        rmse = float(np.sqrt(np.mean(error**2))) if len(error) else None
        out.append(JointSummary(name, rmse, margin, float(torque[i]), share, float(temperature[i])))
    return out
