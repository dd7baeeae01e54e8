"""The two records of a run. One layout serves the shared-memory channels, the log and the replay.

Every element is eight bytes wide, so that numpy's packed layout and CDR's aligned one are the same bytes: a record goes
into an MCAP file without being touched, and any ROS 2-aware viewer reads it by joint name.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from enum import IntFlag
from typing import NamedTuple, TypeAlias

import numpy as np

from sim2real.types import JointCommand, RobotState

QUATERNION = ("w", "x", "y", "z")
VECTOR = ("x", "y", "z")

Field: TypeAlias = tuple[str, str, Sequence[str] | None]  # name, numpy type, names of its elements (None: a scalar)


class Calls(IntFlag):
    """What was asked of the gate in a tick, besides ``step``: the edges a replay has to repeat."""

    ARM = 1
    STOP = 2
    OFF = 4
    STOP_AFTER = 8  # stopped behind the step, because a bus failed to take its command


class Layout(NamedTuple):
    """A record: its name, its dtype (dots in field names are nesting), and the names of each array field's elements."""

    name: str
    dtype: np.dtype
    elements: dict[str, tuple[str, ...]]

    def new(self) -> np.ndarray:
        """One zeroed record, shape (1,): its fields are views, so filling them in place fills the record."""
        return np.zeros(1, self.dtype)


def layout(name: str, fields: Sequence[Field]) -> Layout:
    """A Layout from (field, "f8" | "i8", names of its elements or None for a scalar)."""
    dtype = np.dtype([(f, t) if names is None else (f, t, (len(names),)) for f, t, names in fields])
    assert all(np.dtype(t).itemsize == 8 for _, t, _ in fields)
    return Layout(name, dtype, {f: tuple(names) for f, _, names in fields if names is not None})


def state_fields(joints: Sequence[str]) -> list[Field]:
    """The fields of a ``types.RobotState``."""
    return [
        ("state.time", "f8", None),
        ("state.joint_pos", "f8", joints),
        ("state.joint_vel", "f8", joints),
        ("state.joint_torque", "f8", joints),
        ("state.joint_temperature", "f8", joints),
        ("state.joint_error", "i8", joints),
        ("state.joint_enabled", "i8", joints),
        ("state.joint_age", "f8", joints),
        ("state.orientation_base_in_world", "f8", QUATERNION),
        ("state.angular_velocity_base_in_base", "f8", VECTOR),
        ("state.acceleration_base_in_base", "f8", VECTOR),
        ("state.imu_age", "f8", None),
    ]


def command_fields(prefix: str, joints: Sequence[str]) -> list[Field]:
    """The fields of a ``types.JointCommand``, under ``prefix``."""
    arrays = ("joint_pos", "joint_vel", "joint_torque", "kp", "kd")
    scalars = ("time", "object_time")
    return [
        *((f"{prefix}.{name}", "f8", None) for name in scalars),
        *((f"{prefix}.{name}", "f8", joints) for name in arrays),
    ]


def tick_layout(joints: Sequence[str], buses: Sequence[str]) -> Layout:
    """What the guardian saw, was asked for, and sent, each tick."""
    return layout(
        "Tick",
        [
            ("time", "f8", None),  # s, scheduled time of the tick
            ("tick", "i8", None),
            ("late", "i8", None),  # ticks skipped so far because one was late
            ("now", "f8", None),  # s, clock time given to the gate; with ``calls`` it makes a replay exact
            ("calls", "i8", None),  # Calls made on the gate before this tick's step, in the order of their bits
            ("mode", "i8", None),  # types.Mode after the gate
            ("fault", "i8", None),  # number of the latched rule (S2R-014 -> 14), 0: none
            ("fault_joint", "i8", None),  # joint index of the fault, -1: none
            ("limited", "i8", None),  # how many joint targets the gate changed this tick
            *state_fields(joints),
            *command_fields("request", joints),  # the newest command from the pilot; time 0: none yet
            *command_fields("command", joints),  # what went to the motors; all zero while OFF
            ("timing.lateness", "f8", None),  # s between the scheduled and the real start of this tick
            ("timing.read", "f8", None),  # s spent in each stage
            ("timing.safety", "f8", None),
            ("timing.write", "f8", None),
            ("bus.load", "f8", buses),  # share of the wire's time used since the last tick
            ("bus.sent", "i8", buses),
            ("bus.received", "i8", buses),
            ("bus.rejected", "i8", buses),
            ("bus.lost", "i8", buses),
        ],
    )


def pilot_layout(joints: Sequence[str], inputs: Mapping[str, Sequence[str]], skills: Sequence[str]) -> Layout:
    """What the pilot fed its policy and what came out, each policy tick. ``inputs``: signal -> element names."""
    return layout(
        "Pilot",
        [
            ("time", "f8", None),
            ("tick", "i8", None),
            ("late", "i8", None),
            ("stage", "i8", None),  # skills.Stage
            ("policy", "i8", None),  # index of the policy in the run's list
            ("skill", "i8", None),  # index of the current label, over all labels of the run
            ("refused", "i8", None),  # skill switches refused so far
            ("operator.skill", "i8", None),  # wanted label, -1: none
            ("operator.velocity", "f8", VECTOR),
            ("operator.age", "f8", None),
            *[(f"input.{name}", "f8", elements) for name, elements in inputs.items()],
            *command_fields("command", joints),
            ("skill_value", "f8", skills),
            ("timing.lateness", "f8", None),
            ("timing.policy", "f8", None),
            ("timing.total", "f8", None),
        ],
    )


def object_layout() -> Layout:
    """What was seen of the object and what is believed of it, each policy tick. Axes of the base."""
    return layout(
        "Object",
        [
            ("time", "f8", None),
            ("tick", "i8", None),
            ("position_in_base", "f8", VECTOR),  # m, the estimate that policies are fed; NaN: never seen
            ("velocity_in_base", "f8", VECTOR),  # m/s
            ("age", "f8", None),  # s since the newest sighting behind it was taken; inf: never
            ("flying", "f8", None),  # probability
            ("sighting.time", "f8", None),  # s, exposure of the newest sighting that arrived
            ("sighting.position_in_base", "f8", VECTOR),  # m, at that time
            ("sightings", "i8", None),  # that arrived so far
            ("used", "i8", None),  # of them; the rest was late, stale, early or strange
        ],
    )


def state_view(record: np.ndarray) -> RobotState:
    """A RobotState whose arrays are views into ``record``; scalars are copies, which the caller writes back."""
    r = record[0]
    return RobotState(
        time=float(r["state.time"]),
        joint_pos=record["state.joint_pos"][0],
        joint_vel=record["state.joint_vel"][0],
        joint_torque=record["state.joint_torque"][0],
        joint_temperature=record["state.joint_temperature"][0],
        joint_error=record["state.joint_error"][0],
        joint_enabled=record["state.joint_enabled"][0],
        joint_age=record["state.joint_age"][0],
        orientation_base_in_world=record["state.orientation_base_in_world"][0],
        angular_velocity_base_in_base=record["state.angular_velocity_base_in_base"][0],
        acceleration_base_in_base=record["state.acceleration_base_in_base"][0],
        imu_age=float(r["state.imu_age"]),
    )


def command_view(record: np.ndarray, prefix: str) -> JointCommand:
    """A JointCommand whose arrays are views into ``record`` (fields ``<prefix>.*``)."""
    return JointCommand(
        time=float(record[f"{prefix}.time"][0]),
        **{f: record[f"{prefix}.{f}"][0] for f in ("joint_pos", "joint_vel", "joint_torque", "kp", "kd")},
        object_time=float(record[f"{prefix}.object_time"][0]),
    )
