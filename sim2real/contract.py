"""The policy contract: what a policy file says about itself, as one JSON document under the ONNX key ``sim2real``.

A policy's inputs are named physical signals in SI units and its outputs are joint targets; everything in between
(observation, normalisation, history, scaling) is inside the graph. ``SIGNALS`` is the complete vocabulary: what a signal
is called, its shape, unit and frame, and its LEAPP ``kind``, so that export to LEAPP is a renaming.
"""

from __future__ import annotations

import math
from typing import Annotated, Literal, NamedTuple

from pydantic import Field, model_validator

from sim2real.config import Positive, Strict, Unsigned

METADATA_KEY = "sim2real"
SCHEMA = 1


class Signal(NamedTuple):
    """One word of the vocabulary. ``size``: a number, or what it counts (``joints``, ``targets``, ``skills``)."""

    size: int | str
    unit: str
    kind: str
    meaning: str


INPUTS: dict[str, Signal] = {
    "joint_pos": Signal("joints", "rad", "state/joint/position", "in the policy's own joint_names order"),
    "joint_vel": Signal("joints", "rad/s", "state/joint/velocity", "in the policy's own joint_names order"),
    "orientation_base_in_world": Signal(4, "1", "state/body/rotation", "quaternion w, x, y, z; yaw is arbitrary"),
    "angular_velocity_base_in_base": Signal(3, "rad/s", "state/body/angular_velocity", "gyroscope"),
    "command_velocity": Signal(3, "m/s, m/s, rad/s", "command/body/velocity", "forward, left, turn, in the base"),
    "skill": Signal("skills", "1", "command/skill", "one-hot over skill_labels"),
    "object_position_in_base": Signal(3, "m", "state/body/position", "centre of the object"),
    "object_velocity_in_base": Signal(3, "m/s", "state/body/linear_velocity", "of the object, less the base's own"),
    "linear_velocity_base_in_base": Signal(3, "m/s", "state/body/linear_velocity", "needs an estimator on hardware"),
}
OUTPUTS: dict[str, Signal] = {
    "joint_pos_target": Signal("targets", "rad", "target/joint/position", "absolute, in target_joint_names order"),
    "observation": Signal("any", "-", "inspect/observation", "what the network saw"),
    "action": Signal("any", "-", "inspect/action", "what the network said"),
    "skill_value": Signal("skills", "1", "inspect/value", "per label, how well the policy expects to do from here"),
}
CARRY = "carry_"  # carry_x is fed back from carry_x_next
OBJECT = ("object_position_in_base", "object_velocity_in_base")  # inputs that somebody has to see

# Policy files come from elsewhere: what they say ends up in terminals, file names and web pages.
Name = Annotated[str, Field(pattern=r"^[A-Za-z0-9_.-]{1,64}$")]
Text = Annotated[str, Field(pattern=r"^[^\x00-\x1f\x7f-\x9f]*$", max_length=1000)]


class Envelope(Strict):
    """What training saw of one input, per element."""

    min: list[float]
    max: list[float]
    mean: list[float]
    std: list[float]


class Carry(Strict):
    """A state tensor: its shape without the batch axis, and the values it starts from (flat; empty: zeros)."""

    shape: list[int]
    start: list[float] = []


class Golden(Strict):
    """A recorded sequence: ``steps`` consecutive calls from the start state. Each array is (steps, size), row by row."""

    steps: Annotated[int, Field(gt=0)]
    inputs: dict[str, list[list[float]]]
    outputs: dict[str, list[list[float]]]


class Hold(Strict):
    """What a joint that the policy does not drive does meanwhile."""

    position: float
    kp: Unsigned
    kd: Unsigned


class Object(Strict):
    """The object that a policy was trained to handle: what a tracker expects, and a simulation builds."""

    kind: Literal["ball"] = "ball"
    radius: Positive  # m
    mass: Positive  # kg
    restitution: Annotated[float, Field(gt=0, lt=1)]


class ObjectStart(Strict):
    """How a skill finds its object when it begins: in its hands, at rest on the floor, or flying.

    What is ``held`` is told in the base. Else the frame is the heading's: the origin on the floor below the base, x where
    the robot faces, z up.
    """

    how: Literal["held", "placed", "thrown"]
    position: tuple[float, float, float]  # m
    velocity: tuple[float, float, float] = (0.0, 0.0, 0.0)  # m/s


class Skill(Strict):
    """One label a policy can perform."""

    label: Name
    description: Text = ""
    next: list[Name] | None = None  # labels it may be followed by; None: any
    dwell: Unsigned = 0.3  # s, shortest stay
    value_min: float | None = None  # refuse to switch to it while skill_value is below
    object: ObjectStart | None = None  # None: wherever it is


class Provenance(Strict):
    """Where the policy comes from."""

    source: Text
    revision: Text = ""
    licence: Text
    created: Text = ""  # date
    tools: dict[Name, Text] = {}
    training: dict[Name, Text | float | int | bool] = {}


class Contract(Strict):
    """All that a policy says about itself. Lists per joint are in ``joint_names`` / ``target_joint_names`` order."""

    schema_version: Literal[1] = SCHEMA
    name: Name
    robot: Name
    variants: list[int] = []
    period: Positive  # s
    joint_names: Annotated[list[Name], Field(min_length=1)]  # joints it observes
    target_joint_names: Annotated[list[Name], Field(min_length=1)]  # joints it drives
    default_joint_pos: list[float]  # rad, of joint_names: where it expects to start
    approach_joint_pos: list[
        float
    ] = []  # rad: where the soft start goes before, such as hands around an object; or none
    kp: list[Unsigned]  # N m/rad, of target_joint_names, full precision
    kd: list[Unsigned]  # N m s/rad
    hold: dict[Name, Hold] = {}  # joints of the robot that it does not drive
    action_scale: list[float] = []  # for other stacks: already applied inside joint_pos_target
    inputs: dict[Name, list[int]]  # name -> shape without the batch axis
    outputs: dict[Name, list[int]]
    carry: dict[Name, Carry] = {}
    object: Object | None = None  # None: it handles none
    skills: Annotated[list[Skill], Field(min_length=1)]
    default_skill: Name
    command_velocity_min: tuple[float, float, float] = (0.0, 0.0, 0.0)
    command_velocity_max: tuple[float, float, float] = (0.0, 0.0, 0.0)
    quaternion_order: Literal["wxyz"] = "wxyz"
    history: str = "inside the graph"
    envelope: dict[str, Envelope] = {}
    golden: Annotated[list[Golden], Field(min_length=1)]
    golden_tolerance: Annotated[float, Field(gt=0, le=1e-3)] = 1e-4
    provenance: Provenance

    @property
    def skill_labels(self) -> tuple[str, ...]:
        return tuple(s.label for s in self.skills)

    def skill(self, label: str) -> Skill:
        return self.skills[self.skill_labels.index(label)]

    @property
    def sees_object(self) -> bool:
        """Whether somebody has to tell it where its object is."""
        return any(name in self.inputs for name in OBJECT)

    @model_validator(mode="after")
    def _consistent(self) -> Contract:
        sizes = {
            "default_joint_pos": self.joint_names,
            **({"approach_joint_pos": self.joint_names} if self.approach_joint_pos else {}),
            "kp": self.target_joint_names,
            "kd": self.target_joint_names,
            **({"action_scale": self.target_joint_names} if self.action_scale else {}),
        }
        for key, names in sizes.items():
            if len(getattr(self, key)) != len(names):
                raise ValueError(f"{key}: got {len(getattr(self, key))} numbers, expected {len(names)}, one per joint")
        for key in ("joint_names", "target_joint_names", "skill_labels"):
            if len(set(getattr(self, key))) < len(getattr(self, key)):
                raise ValueError(f"{key}: a name appears twice, expected every name once")
        if self.default_skill not in self.skill_labels:
            raise ValueError(f"default_skill: got '{self.default_skill}', expected one of {list(self.skill_labels)}")
        for skill in self.skills:
            for label in skill.next or ():
                if label not in self.skill_labels:
                    raise ValueError(f"skills: '{skill.label}' leads to '{label}', expected one of {self.skill_labels}")
        counts = {"joints": len(self.joint_names), "targets": len(self.target_joint_names), "skills": len(self.skills)}
        for side, vocabulary in (("inputs", INPUTS), ("outputs", OUTPUTS)):
            for name, shape in getattr(self, side).items():
                if name.startswith(CARRY):
                    continue
                if name not in vocabulary:
                    raise ValueError(f"{side}: got '{name}', expected one of {sorted(vocabulary)} or carry_*")
                size = vocabulary[name].size
                expected = counts.get(size, None) if isinstance(size, str) else size
                if expected is not None and shape != [expected]:
                    raise ValueError(f"{side}: '{name}' has shape {shape}, expected [{expected}]")
        if "joint_pos_target" not in self.outputs:
            raise ValueError("outputs: no 'joint_pos_target', expected it: a policy's outputs are joint targets")
        for name, carry in self.carry.items():
            if name not in self.inputs or f"{name}_next" not in self.outputs:
                raise ValueError(f"carry: '{name}' needs the input '{name}' and the output '{name}_next'")
            if self.inputs[name] != carry.shape or self.outputs[f"{name}_next"] != carry.shape:
                raise ValueError(f"carry: '{name}' has shape {self.inputs[name]} in the graph, {carry.shape} declared")
            if carry.start and len(carry.start) != math.prod(carry.shape):
                got = len(carry.start)
                raise ValueError(
                    f"carry: '{name}' starts from {got} numbers, expected {math.prod(carry.shape)} or none"
                )
        if strangers := [n for n in self.inputs if n.startswith(CARRY) and n not in self.carry]:
            raise ValueError(f"carry: nothing says how {strangers} start")
        if self.object is None and (needy := [n for n in OBJECT if n in self.inputs]):
            raise ValueError(f"object: missing, expected what {' and '.join(needy)} are about: kind, radius, ...")
        if driven := [n for n in self.hold if n in self.target_joint_names]:
            raise ValueError(f"hold: {driven} are in target_joint_names too, expected joints that are not driven")
        if "skill_value" not in self.outputs and (gated := [s.label for s in self.skills if s.value_min is not None]):
            raise ValueError(f"skills: {gated} have a value_min, expected an output 'skill_value' to compare it with")
        for low, high in zip(self.command_velocity_min, self.command_velocity_max, strict=True):
            if not low <= high:
                raise ValueError(f"command_velocity_max: got {high} below the minimum {low}, expected min <= max")
        return self

    @model_validator(mode="after")
    def _recorded(self) -> Contract:
        """Envelope and golden sequences fit the signals they are about."""
        for name, envelope in self.envelope.items():
            if name not in self.inputs:
                raise ValueError(f"envelope: got '{name}', expected one of {sorted(self.inputs)}")
            size = math.prod(self.inputs[name])
            for key, values in envelope:
                if len(values) != size:
                    raise ValueError(f"envelope.{name}.{key}: got {len(values)} numbers, expected {size}")
        signals = {n for n in self.inputs if not n.startswith(CARRY)}
        for k, golden in enumerate(self.golden):
            if set(golden.inputs) != signals:
                raise ValueError(f"golden[{k}].inputs: got {sorted(golden.inputs)}, expected {sorted(signals)}")
            if "joint_pos_target" not in golden.outputs or not set(golden.outputs) <= set(self.outputs):
                raise ValueError(
                    f"golden[{k}].outputs: got {sorted(golden.outputs)}, expected joint_pos_target"
                    f" and any of {sorted(self.outputs)}"
                )
            for side, shapes in (("inputs", self.inputs), ("outputs", self.outputs)):
                for name, rows in getattr(golden, side).items():
                    size = math.prod(shapes[name])
                    if len(rows) != golden.steps or any(len(row) != size for row in rows):
                        raise ValueError(f"golden[{k}].{side}.{name}: expected {golden.steps} rows of {size} numbers")
        return self
