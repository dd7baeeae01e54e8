"""RobotConfig: one strict YAML per robot. Unknown keys, NaN and wrong lengths are refused with their path.

``load_robot("g1")`` finds ``configs/robots/g1.yaml``; a path to a YAML elsewhere works too. The models here are what a
person writes; ``RobotConfig`` also offers the arrays that the hot path reads, in the order of ``joints``.
"""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Iterator
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, Literal, get_args

import numpy as np
import yaml
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from drivers.bus import BusSpec, ImuSpec, MotorSpec
from sim2real.types import Sim2realError

CONFIG_DIR = Path(__file__).resolve().parents[1] / "configs" / "robots"

Positive = Annotated[float, Field(gt=0)]
Unsigned = Annotated[float, Field(ge=0)]
Range = Annotated[tuple[float, float], Field(description="[lower, upper]")]


class ConfigError(Sim2realError):
    """A robot file, or a name of one, that is wrong. The message says where, got, expected and what to do."""


class Strict(BaseModel):
    """Base of every document that people or other programs write."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False, ignored_types=(cached_property,))


class JointConfig(Strict):
    """A joint's hard facts and what the robot may ask of it."""

    name: str
    position: Range  # rad, the mechanical range
    velocity: Positive  # rad/s
    torque: Positive  # N m
    kp_max: Positive  # N m/rad
    kd_max: Positive  # N m s/rad
    damping: Positive  # N m s/rad: kd while damping
    thermometer: bool = True  # its motor reports a temperature; false: a motor that says nothing passes as cold
    group: Literal["leg", "waist", "arm", "hand", "head"]
    reach: Literal["both", "lower", "upper"] = "both"  # stops that a hand brings it to; the body blocks the other
    source: str  # where the numbers come from, with the hardware variant

    @model_validator(mode="after")
    def _ordered(self) -> JointConfig:
        if not self.position[0] < self.position[1]:
            raise ValueError(f"position: got {list(self.position)}, expected [lower, upper] with lower < upper")
        return self


class SafetyConfig(Strict):
    """Thresholds of the safety gate; every field is used by the rule of the same name in ``sim2real/safety``."""

    position_margin: Unsigned = 0.02  # rad inside the mechanical range
    position_overrun: Unsigned = 0.1  # rad outside the mechanical range: measured beyond is a fault
    velocity_max_ratio: Positive = 1.2  # of each joint's velocity: measured above this is a fault
    target_velocity_ratio: Positive = 1.0  # slew: targets move at most this share of the joint's velocity
    torque_ratio: Positive = 1.0  # of each joint's torque: predicted PD torque is kept below this
    jump_ratio: Positive = 3.0  # of each joint's velocity: a position that moved faster is an encoder jump
    tilt: Positive = 1.0  # rad between the base's up and gravity's
    angular_velocity: Positive = 12.0  # rad/s of the base
    temperature_warn: Positive = 80.0  # deg C
    temperature: Positive = 100.0  # deg C
    joint_age: Positive = 0.04  # s without feedback from a joint
    imu_age: Positive = 0.04  # s
    imu_frozen: Positive = 4  # consecutive bit-identical gyro samples; one more is a fault
    orientation_norm: Positive = 0.01  # distance of the base quaternion's norm from 1
    enable_time: Positive = 0.06  # s, while armed, without a motor saying that it is enabled
    command_age_hold: Positive = 0.04  # s without a fresh command: hold
    command_age: Positive = 0.06  # s without a fresh command: damp
    object_age: Positive = 0.3  # s without sight of the object that the skill handles: hold, and damp if it lasts
    hold_time: Positive = 0.04  # s: longest hold of any cause, then damp
    arm_tilt: Positive = 0.35  # rad: refuse to arm beyond
    arm_velocity: Positive = 0.5  # rad/s: refuse to arm while any joint moves faster
    arm_gravity: Positive = 2.0  # m/s^2 between the measured acceleration and gravity: refuse to arm beyond
    tick_gap: Positive = 0.06  # s between two ticks of the gate: beyond it, it was suspended


class MotorConfig(Strict):
    """The motor of one joint; see ``drivers.bus.MotorSpec``."""

    joint: str
    model: str
    id: Annotated[int, Field(ge=0)]
    feedback_id: Annotated[int, Field(ge=0)] = 0
    sign: Literal[-1, 1] = 1
    offset: float = 0.0


class BusConfig(Strict):
    """A bus and its motors; see ``drivers.bus.BusSpec``."""

    name: str
    protocol: str
    interface: str = "socketcan"
    channel: str = ""
    bitrate: Annotated[int, Field(gt=0)] = 1_000_000
    data_bitrate: Annotated[int, Field(ge=0)] = 0  # bit/s of CAN-FD payloads; 0: classic CAN
    watchdog: Unsigned = 0.08  # s; 0: the device has none, and somebody accepts that
    motors: Annotated[list[MotorConfig], Field(min_length=1)]


class ImuConfig(Strict):
    """An IMU and how it is mounted; see ``drivers.bus.ImuSpec``."""

    protocol: str
    interface: str = "serial"
    channel: str = ""
    baud: Annotated[int, Field(gt=0)] = 921_600
    rate: Positive = 500.0
    site: str = "imu"
    orientation_imu_in_base: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0)


class Wiring(Strict):
    """One way this robot is wired: joints to motors on buses, at a rate."""

    description: str
    rate: Positive  # Hz of the guardian
    buses: Annotated[list[BusConfig], Field(min_length=1)]
    imu: ImuConfig

    def bus_specs(self) -> list[BusSpec]:
        return [
            BusSpec(b.name, b.protocol, tuple(MotorSpec(**m.model_dump()) for m in b.motors), b.interface, b.channel,
                    b.bitrate, b.watchdog, b.data_bitrate)
            for b in self.buses
        ]  # fmt: skip

    def imu_spec(self) -> ImuSpec:
        return ImuSpec(**self.imu.model_dump())


class PoseConfig(Strict):
    """A posture with the gains that hold it; joints not named are at zero."""

    joints: dict[str, float] = {}
    kp: dict[str, Positive] = {}
    kd: dict[str, Positive] = {}


class PolicyEntry(Strict):
    """One policy file of this robot, relative to the repository."""

    file: str
    description: str = ""
    unshown: list[str] = []  # labels that a default timeline leaves out: performed where they are asked for by name


class RobotConfig(Strict):
    """A whole robot: what a person writes, and the same as arrays (n,) in the order of ``joints``."""

    name: str
    description: str
    variants: list[int] = []  # hardware variant ids (Unitree: mode_machine) whose limits these are
    model: str  # MJCF, beside the YAML
    base: str  # body whose frame is "base"
    licence: str
    joints: Annotated[list[JointConfig], Field(min_length=1)]
    safety: SafetyConfig = SafetyConfig()
    home: PoseConfig  # where a soft start goes when the policy says nothing else
    policies: dict[str, PolicyEntry] = {}
    default_skills: str = ""
    skills: dict[str, Annotated[list[str], Field(min_length=1)]] = {}  # sets of policies that are loaded together
    default_wiring: str
    wirings: dict[str, Wiring]

    _path: Path = Path()

    @model_validator(mode="after")
    def _consistent(self) -> RobotConfig:
        names = [j.name for j in self.joints]
        if repeated := sorted({n for n in names if names.count(n) > 1}):
            raise ValueError(f"joints: got {repeated} more than once, expected every name once")
        if self.default_wiring not in self.wirings:
            raise ValueError(f"default_wiring: got '{self.default_wiring}', expected one of {sorted(self.wirings)}")
        if self.skills and self.default_skills not in self.skills:
            raise ValueError(f"default_skills: got '{self.default_skills}', expected one of {sorted(self.skills)}")
        for name in (n for names in self.skills.values() for n in names):
            if name not in self.policies:
                raise ValueError(f"skills: got policy '{name}', expected one of {sorted(self.policies)}")
        for table in ("joints", "kp", "kd"):
            for name in getattr(self.home, table):
                if name not in names:
                    raise ValueError(f"home.{table}: got '{name}', expected a joint{did_you_mean(name, names)}")
        for w, wiring in self.wirings.items():
            wired = [m.joint for b in wiring.buses for m in b.motors]
            for name in wired:
                if name not in names:
                    raise ValueError(f"wirings.{w}: got joint '{name}', expected a joint{did_you_mean(name, names)}")
            if missing := [n for n in names if n not in wired]:
                raise ValueError(f"wirings.{w}: no motor for {missing}, expected one for every joint")
            if repeated := sorted({n for n in wired if wired.count(n) > 1}):
                raise ValueError(f"wirings.{w}: got two motors for {repeated}, expected one for every joint")
            if len({b.name for b in wiring.buses}) < len(wiring.buses):
                raise ValueError(f"wirings.{w}: two buses share a name, expected every name once")
            for b in wiring.buses:
                ids = [m.id for m in b.motors]
                if repeated := sorted({i for i in ids if ids.count(i) > 1}):
                    raise ValueError(f"wirings.{w}.{b.name}: got motor id {repeated} twice, expected every id once")
        return self

    @property
    def path(self) -> Path:
        """The YAML this was read from."""
        return self._path

    @property
    def model_path(self) -> Path:
        """The MJCF."""
        return self._path.parent / self.model

    @cached_property
    def joint_names(self) -> tuple[str, ...]:
        return tuple(j.name for j in self.joints)

    @cached_property
    def position_min(self) -> np.ndarray:
        return np.array([j.position[0] for j in self.joints])

    @cached_property
    def position_max(self) -> np.ndarray:
        return np.array([j.position[1] for j in self.joints])

    @cached_property
    def velocity_max(self) -> np.ndarray:
        return np.array([j.velocity for j in self.joints])

    @cached_property
    def torque_max(self) -> np.ndarray:
        return np.array([j.torque for j in self.joints])

    @cached_property
    def kp_max(self) -> np.ndarray:
        return np.array([j.kp_max for j in self.joints])

    @cached_property
    def kd_max(self) -> np.ndarray:
        return np.array([j.kd_max for j in self.joints])

    @cached_property
    def damping(self) -> np.ndarray:
        return np.array([j.damping for j in self.joints])

    @cached_property
    def thermometer(self) -> np.ndarray:
        return np.array([j.thermometer for j in self.joints])

    @cached_property
    def home_pos(self) -> np.ndarray:
        return self._home("joints", 0.0)

    @cached_property
    def home_kp(self) -> np.ndarray:
        return self._home("kp", 40.0)

    @cached_property
    def home_kd(self) -> np.ndarray:
        return self._home("kd", 2.0)

    def _home(self, table: str, default: float) -> np.ndarray:
        return np.array([getattr(self.home, table).get(n, default) for n in self.joint_names])

    def indices(self, names: list[str] | tuple[str, ...]) -> np.ndarray:
        """Where ``names`` are among ``joint_names`` (len(names),). Raises ConfigError naming a stranger."""
        for name in names:
            if name not in self.joint_names:
                raise ConfigError(f"{self.name}: no joint '{name}'{did_you_mean(name, self.joint_names)}")
        return np.array([self.joint_names.index(n) for n in names], dtype=np.intp)

    def wiring(self, name: str = "") -> Wiring:
        """The wiring ``name``, or the default one."""
        name = name or self.default_wiring
        if name not in self.wirings:
            raise ConfigError(
                f"{self.name}: no wiring '{name}'{did_you_mean(name, self.wirings)}; it has {', '.join(self.wirings)}"
            )
        return self.wirings[name]

    def skill_set(self, name: str = "") -> list[PolicyEntry]:
        """The policies of the set ``name``, or of the default one; a robot without sets has all of its policies as one.
        Raises ConfigError where there is none."""
        name = name or self.default_skills
        if not name and not self.skills and self.policies:
            return list(self.policies.values())
        if name not in self.skills:
            which = f"skills '{name}'" if name else "skills"
            known = f"; it has {', '.join(self.skills)}" if self.skills else ""
            raise ConfigError(
                f"{self.name}: its YAML names no {which}{did_you_mean(name, self.skills)}{known};"
                " give a policy with --policy FILE.onnx, or name a set under 'skills:'\n"
                f"  a first policy that holds the home posture: sim2real posture --robot {self.path} -o FILE.onnx"
            )
        return [self.policies[policy] for policy in self.skills[name]]


def robot_names() -> list[str]:
    """Every robot shipped."""
    return sorted(p.stem for p in CONFIG_DIR.glob("*.yaml"))


def load_robot(name: str | Path) -> RobotConfig:
    """Read a robot by name (``g1``) or by path to its YAML. Raises ConfigError."""
    path = Path(name) if str(name).endswith((".yaml", ".yml")) else CONFIG_DIR / f"{name}.yaml"
    if not path.is_file():
        known = robot_names()
        raise ConfigError(
            f"robot '{name}': no file {path}{did_you_mean(str(name), known)}\n"
            f"  robots here: {', '.join(known)}; or give the path of a YAML of your own"
        )
    try:
        document = yaml.safe_load(path.read_text())
    except yaml.YAMLError as error:
        raise ConfigError(f"{path}: not YAML: {error}") from None
    try:
        robot = RobotConfig.model_validate(document)
    except ValidationError as error:
        raise ConfigError(explain(str(path), error, RobotConfig)) from None
    robot._path = path
    return robot


def explain(where: str, error: ValidationError, model: type[BaseModel]) -> str:
    """A pydantic error of a document of ``model`` as lines ``where: a.b[3].c: got X, expected ...``."""
    lines = []
    for e in error.errors():
        path = "".join(f"[{p}]" if isinstance(p, int) else f".{p}" for p in e["loc"]).lstrip(".")
        if e["type"] == "extra_forbidden":
            key, fields = str(e["loc"][-1]), _fields_at(model, e["loc"][:-1])
            lines.append(f"{path}: unknown key{did_you_mean(key, fields)}; expected one of {', '.join(fields)}")
        elif e["type"] == "value_error":
            said = str(e.get("ctx", {}).get("error"))
            lines.append(f"{path}: {said}" if path else said)
        elif e["type"] == "missing":
            lines.append(f"{path}: missing; add it")
        else:
            message = e["msg"].replace("Input should be", "expected").replace("Field required", "expected a value")
            lines.append(f"{path}: got {e['input']!r}, {message}")
    return "\n".join(f"{where}: {line}" for line in lines)


def _fields_at(model: type[BaseModel], loc: tuple) -> list[str]:
    """Names of the fields of whatever model stands at ``loc`` in a document of ``model``."""
    for part in loc:
        if isinstance(part, str) and part in model.model_fields:
            model = next(_models_in(model.model_fields[part].annotation), model)
    return list(model.model_fields)


def _models_in(annotation: Any) -> Iterator[type[BaseModel]]:
    """The models inside an annotation: ``dict[str, list[Bus]]`` -> Bus."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        yield annotation
    for inner in get_args(annotation):
        yield from _models_in(inner)


def did_you_mean(word: str, options: Iterable[str]) -> str:
    """`` (did you mean 'left_knee_joint'?)``, or nothing where no option is close."""
    close = difflib.get_close_matches(word, list(options), n=1)
    return f" (did you mean '{close[0]}'?)" if close else ""
