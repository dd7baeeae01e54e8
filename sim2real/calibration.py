"""The calibration of one robot: where its joints' zeros are on its motors, and which way they turn.

``sim2real calibrate`` measures it and writes it; ``sim2real deploy --hardware`` demands it. It belongs to one robot, one
wiring, the motors by their serial numbers, and the joint ranges of the YAML by which it was measured.

What a motor tells of itself is in its protocol's IDENTITY: a serial number (Damiao, RobStride, moteus, ODrive from firmware 0.6
on), what its own calibration measured (Recoil), its model and firmware (Dynamixel, Feetech), or nothing (ODrive 0.5, MIT
mode). Without a serial number bus, id and make are all that binds it: calibrating and arming say so.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Literal

import yaml
from pydantic import Field, ValidationError

from drivers.open import PROTOCOLS
from sim2real.config import MotorConfig, Positive, Range, RobotConfig, Strict, Wiring, explain
from sim2real.types import Sim2realError

FOLDER = Path("bringup")  # where bring-up writes and deploy looks, under the folder it is run in


class MotorCalibration(Strict):
    """One motor: ``joint_pos = sign * (motor_pos - offset)``, as long as it has not lost a turn since."""

    joint: str
    bus: str
    id: Annotated[int, Field(ge=0)]
    fingerprint: str  # drivers.bus.MotorBus.fingerprints
    sign: Literal[-1, 1]
    offset: float  # motor rad
    position: Range  # rad, the joint's range in the YAML then
    span: Positive  # rad between its stops, as measured


class Calibration(Strict):
    """All that was measured so far. ``checked``: all of it, and gravity and symmetry agree."""

    schema_version: Literal[1] = 1
    robot: str
    wiring: str
    checked: bool = False
    motors: list[MotorCalibration] = []

    def motor(self, joint: str) -> MotorCalibration | None:
        """What was measured of a joint."""
        return next((m for m in self.motors if m.joint == joint), None)

    def save(self, path: Path) -> None:
        """Write it, whole or not at all."""
        path.parent.mkdir(parents=True, exist_ok=True)
        partial = path.with_suffix(".partial")
        partial.write_text(yaml.safe_dump(self.model_dump(mode="json"), sort_keys=False))
        partial.replace(path)

    def complaints(self, config: RobotConfig, name: str) -> Iterator[str]:
        """Why it is not the one of wiring ``name`` of a robot, or not whole: a line each."""
        if (self.robot, self.wiring) != (config.name, name):
            yield f"got one of {self.robot}, wiring {self.wiring}; expected {config.name}, wiring {name}"
            return
        ranges = {j.name: j.position for j in config.joints}
        wired = {m.joint: (bus.name, m) for bus in config.wiring(name).buses for m in bus.motors}
        for m in self.motors:
            bus, motor = wired.get(m.joint, ("", None))
            if motor is None:
                yield f"{m.joint}: got a joint that the wiring has not"
            elif (m.bus, m.id) != (bus, motor.id):
                yield f"{m.joint}: got motor {m.bus}/{m.id:#x}, expected {bus}/{motor.id:#x} as wired"
            elif m.position != ranges[m.joint]:
                yield f"{m.joint}: measured by the range {list(m.position)}, the YAML now says {list(ranges[m.joint])}"
        measured = [m.joint for m in self.motors]
        if missing := [joint for joint in wired if joint not in measured]:
            yield f"not measured yet: {', '.join(missing)}"
        if twice := sorted({j for j in measured if measured.count(j) > 1}):
            yield f"measured more than once: {', '.join(twice)}"
        if not self.checked:
            yield "gravity and symmetry have not been checked, or did not agree"

    def applied_to(self, wiring: Wiring) -> Wiring:
        """The wiring with the measured signs and offsets."""
        measured = {m.joint: {"sign": m.sign, "offset": m.offset} for m in self.motors}

        def fit(motor: MotorConfig) -> MotorConfig:
            return motor.model_copy(update=measured.get(motor.joint, {}))

        buses = [bus.model_copy(update={"motors": [fit(m) for m in bus.motors]}) for bus in wiring.buses]
        return wiring.model_copy(update={"buses": buses})


def calibration_path(robot: str, wiring: str, simulated: bool = False) -> Path:
    """Where the calibration of a wiring is, unless somebody says otherwise. That of a twin is another file."""
    return FOLDER / f"{robot}-{wiring}{'-sim' * simulated}.calibration.yaml"


def is_needed(wiring: Wiring) -> bool:
    """Whether the robot's own motors know nothing of joints. A factory G1's do."""
    return any(not PROTOCOLS[bus.protocol].calibrated for bus in wiring.buses if bus.protocol in PROTOCOLS)


def load_calibration(path: str | Path) -> Calibration:
    """Read one. Raises Sim2realError with path and place of what is wrong, or with the command that writes it."""
    path = Path(path)
    try:
        document = yaml.safe_load(path.read_text())
    except FileNotFoundError:
        raise Sim2realError(
            f"calibration: no file {path}; `sim2real calibrate --robot ...` measures and writes it"
        ) from None
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        raise Sim2realError(f"{path}: not YAML: {error}") from None
    try:
        return Calibration.model_validate(document)
    except ValidationError as error:
        raise Sim2realError(explain(str(path), error, Calibration)) from None
