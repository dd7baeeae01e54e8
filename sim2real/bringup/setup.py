"""One motor on a bus, whatever id and bit rate it has: made what the wiring says, and proved to have kept it.

TOOLS is the table: how the registers of a protocol are read, written and kept, and which of them a wiring decides.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, NamedTuple, Protocol

import numpy as np
import yaml
from pydantic import ValidationError

from drivers.bus import BusSpec, Clock, MotorSpec
from drivers.codecs import damiao, dynamixel, dynamixel_packet, feetech, robstride
from drivers.wire import CanWire, SerialWire, make_frames
from sim2real.bringup.retune import opened
from sim2real.bringup.sweep import Found, Sweep, converse
from sim2real.bringup.sweeps import SWEEPS, read_dynamixel, read_feetech, sweep
from sim2real.calibration import FOLDER
from sim2real.config import Strict, explain
from sim2real.types import Sim2realError

TRIES = 3
WRITE_TIME = 0.02  # s for a register to be taken over
BOOT_TIME = 1.0  # s after power-on
TURNED = 0.15  # rad by which a shaft was turned by hand


class Setting(NamedTuple):
    """A register and what it is to hold."""

    register: str
    value: float | int


class Tool(Protocol):
    """The registers of one protocol, on an open wire."""

    def read(self, id: int, register: str) -> float | int | None:
        """What it holds; None: no answer."""
        ...

    def write(self, id: int, register: str, value: float | int) -> None:
        """Nobody confirms it: read it back."""
        ...

    def save(self, id: int) -> None:
        """Make it outlive power, where the protocol does not by itself."""
        ...

    def position(self, id: int) -> float | None:
        """rad of its shaft, in its own count."""
        ...


class DamiaoTool:
    """Registers by 0x7FF; they are kept once stored."""

    def __init__(self, wire: CanWire, clock: Clock, bitrate: int) -> None:
        self._wire, self._clock = wire, clock

    def _ask(self, data: np.ndarray) -> Iterator[np.ndarray]:
        frames = make_frames(np.array([damiao.BROADCAST_ID], np.uint32), data[None])
        for frame in converse(self._wire, self._clock, frames, Sweep([])):
            yield frame["data"]

    def read(self, id: int, register: str) -> float | int | None:
        for data in self._ask(damiao.pack_register(id, damiao.Operation.READ, register)):
            answer = damiao.unpack_register(data)
            if (answer.id, answer.register, answer.operation) == (id, register, damiao.Operation.READ):
                return answer.value
        return None

    def write(self, id: int, register: str, value: float | int) -> None:
        list(self._ask(damiao.pack_register(id, damiao.Operation.WRITE, register, value)))

    def save(self, id: int) -> None:
        list(self._ask(damiao.pack_register(id, damiao.Operation.STORE)))

    def position(self, id: int) -> float | None:
        if (full := self.read(id, "PMAX")) is None:
            return None
        for data in self._ask(damiao.pack_register(id, damiao.Operation.REFRESH)):
            if int(data[0]) & 0xF == id & 0xF:
                return (int(data[1]) << 8 | int(data[2])) / 0xFFFF * 2 * full - full
        return None


class RobstrideTool:
    """Parameters, and the frames that set id and bit rate, which are kept without being saved."""

    def __init__(self, wire: CanWire, clock: Clock, bitrate: int) -> None:
        self._wire, self._clock = wire, clock

    def _ask(self, kind: robstride.Type, id: int, data: np.ndarray | None = None, high: int = 0) -> Iterator[Any]:
        """(type, data, payload) of what comes back."""
        identifier = robstride.identifier(kind, high << 8 | robstride.HOST_ID, id)
        payload = np.zeros(8, np.uint8) if data is None else data
        for frame in converse(self._wire, self._clock, make_frames(np.array([identifier]), payload[None]), Sweep([])):
            yield int(frame["id"]) >> 24 & 0x1F, int(frame["id"]) >> 8 & 0xFFFF, frame["data"]

    def read(self, id: int, register: str) -> float | int | None:
        if register in ("CAN_ID", robstride.UID):
            for kind, data, payload in self._ask(robstride.Type.GET_ID, id):
                if kind == robstride.Type.GET_ID and data & 0xFF == id:
                    return id if register == "CAN_ID" else int.from_bytes(payload.tobytes(), "little")
        elif register in robstride.PARAMETERS:
            for kind, data, payload in self._ask(robstride.Type.READ, id, robstride.pack_parameter(register)):
                answer = robstride.unpack_parameter(payload)
                if kind == robstride.Type.READ and data == id and answer.name == register:
                    return answer.value
        return None

    def write(self, id: int, register: str, value: float | int) -> None:
        if register == "CAN_ID":
            list(self._ask(robstride.Type.SET_ID, id, high=int(value)))
        elif register == "CAN_BITRATE":
            code = next(code for code, rate in robstride.BIT_RATES.items() if rate == value)
            payload = np.frombuffer(robstride.SEQUENCE[:6] + bytes([code, 0]), np.uint8)
            list(self._ask(robstride.Type.BAUD, id, payload))
        else:
            list(self._ask(robstride.Type.WRITE, id, robstride.pack_parameter(register, value)))

    def save(self, id: int) -> None:
        list(self._ask(robstride.Type.SAVE, id, np.frombuffer(robstride.SEQUENCE, np.uint8)))

    def position(self, id: int) -> float | None:
        return self.read(id, "mechPos")


class DynamixelTool:
    """The control table. EEPROM is locked while torque is on."""

    def __init__(self, wire: SerialWire, clock: Clock, bitrate: int) -> None:
        self._wire, self._clock, self._bitrate = wire, clock, bitrate

    def read(self, id: int, register: str) -> float | int | None:
        values = read_dynamixel(self._wire, self._clock, id, register, self._bitrate)[0]
        return values[0] if values else None

    def write(self, id: int, register: str, value: float | int) -> None:
        r = dynamixel.REGISTERS[register]
        data = (int(value) & (1 << 8 * r.size) - 1).to_bytes(r.size, "little")
        self._wire.write(dynamixel_packet.pack_write(id, r.address, data))
        self._clock.sleep_until(self._clock.now() + WRITE_TIME)

    def save(self, id: int) -> None: ...

    def position(self, id: int) -> float | None:
        ticks = self.read(id, "PRESENT_POSITION")
        return None if ticks is None else ticks * dynamixel.TICK


class FeetechTool:
    """The memory table. EEPROM is kept while LOCK is 0."""

    def __init__(self, wire: SerialWire, clock: Clock, bitrate: int) -> None:
        self._wire, self._clock, self._bitrate = wire, clock, bitrate

    def read(self, id: int, register: str) -> float | int | None:
        values = read_feetech(self._wire, self._clock, id, register, self._bitrate)[0]
        return values[0] if values else None

    def write(self, id: int, register: str, value: float | int) -> None:
        address, size = feetech.REGISTERS[register]
        data = bytes([address]) + int(value).to_bytes(size, "little")
        self._wire.write(feetech.pack(id, feetech.Instruction.WRITE, data))
        self._clock.sleep_until(self._clock.now() + WRITE_TIME)

    def save(self, id: int) -> None:
        self.write(id, "LOCK", 1)

    def position(self, id: int) -> float | None:
        values = read_feetech(self._wire, self._clock, id, "PRESENT_POSITION", self._bitrate)[0]
        return None if not values else float(feetech.from_sign_magnitude(np.array(values[0]))) * feetech.TICK


def _damiao(spec: BusSpec, m: MotorSpec) -> list[Setting]:
    return [
        Setting("CTRL_MODE", damiao.MIT_MODE),
        Setting("TIMEOUT", damiao.timeout_ticks(spec.watchdog)),
        Setting("CAN_BR", _code(damiao.BIT_RATES, spec)),
        Setting("MST_ID", m.feedback_id),
        Setting("ESC_ID", m.id),
    ]


def _robstride(spec: BusSpec, m: MotorSpec) -> list[Setting]:
    _code(robstride.BIT_RATES, spec)
    return [
        Setting("zero_sta", 1),
        Setting("canTimeout", robstride.timeout_ticks(spec.watchdog)),
        Setting("limit_torque", robstride.MODELS[m.model].torque),
        Setting("CAN_BITRATE", spec.bitrate),
        Setting("CAN_ID", m.id),
    ]


def _dynamixel(spec: BusSpec, m: MotorSpec) -> list[Setting]:
    return [
        Setting("TORQUE_ENABLE", 0),
        Setting("RETURN_DELAY", 0),
        Setting("DRIVE_MODE", 0),
        Setting("OPERATING_MODE", 3),
        Setting("POSITION_MIN", 0),
        Setting("POSITION_MAX", dynamixel.TICKS - 1),
        Setting("SHUTDOWN", dynamixel.REGISTERS["SHUTDOWN"].default),
        Setting("ID", m.id),
        Setting("BAUD", _code(dynamixel.BAUD_RATES, spec)),
    ]


def _feetech(spec: BusSpec, m: MotorSpec) -> list[Setting]:
    return [
        Setting("TORQUE_ENABLE", 0),
        Setting("LOCK", 0),
        Setting("RETURN_DELAY", 0),
        Setting("MODE", 0),
        Setting("POSITION_MIN", 0),
        Setting("POSITION_MAX", feetech.TICKS - 1),
        Setting("ID", m.id),
        Setting("BAUD", _code(feetech.BAUD_RATES, spec)),
    ]


def _code(rates: dict[int, int], spec: BusSpec) -> int:
    """The register value that means the bus's bit rate."""
    for code, rate in rates.items():
        if rate == spec.bitrate:
            return code
    raise Sim2realError(
        f"bus {spec.name}: got {spec.bitrate} bit/s, expected one of {', '.join(map(str, rates.values()))}"
    )


class Row(NamedTuple):
    """A protocol: its registers, the settings that a wiring decides (in the order in which they are written), which of
    them change where the motor is found, and what tells it from others. ``light``: a register that lights its LED."""

    tool: Callable[..., Tool]
    settings: Callable[[BusSpec, MotorSpec], list[Setting]]
    id: str
    bitrate: str
    identity: tuple[str, ...]
    light: str = ""


TOOLS: dict[str, Row] = {
    "damiao": Row(DamiaoTool, _damiao, "ESC_ID", "CAN_BR", ("SN",)),
    "robstride": Row(RobstrideTool, _robstride, "CAN_ID", "CAN_BITRATE", (robstride.UID,)),
    "dynamixel": Row(DynamixelTool, _dynamixel, "ID", "BAUD", ("MODEL", "FIRMWARE"), "LED"),
    "feetech": Row(FeetechTool, _feetech, "ID", "BAUD", ("MODEL",)),
}
LOST_WITH_POWER = ("TORQUE_ENABLE", "LOCK")  # of the settings


class MotorRecord(Strict):
    """One motor that was set up. ``found_id``, ``found_bitrate``: how it came; ``settings``: what it was proved to hold."""

    joint: str
    bus: str
    id: int
    fingerprint: str  # drivers.bus.MotorBus.fingerprints
    found_id: int
    found_bitrate: int
    settings: dict[str, float]


class MotorList(Strict):
    """Every motor of a wiring that was set up so far."""

    schema_version: Literal[1] = 1
    robot: str
    wiring: str
    motors: list[MotorRecord] = []

    def save(self, path: Path) -> None:
        """Write it, whole or not at all."""
        path.parent.mkdir(parents=True, exist_ok=True)
        partial = path.with_suffix(".partial")
        partial.write_text(yaml.safe_dump(self.model_dump(mode="json"), sort_keys=False))
        partial.replace(path)


def list_path(robot: str, wiring: str, simulated: bool = False) -> Path:
    """Where the list of a wiring's motors is, unless somebody says otherwise."""
    return FOLDER / f"{robot}-{wiring}{'-sim' * simulated}.motors.yaml"


def load_list(path: Path) -> MotorList:
    """Read one. Raises Sim2realError with path and place of what is wrong."""
    try:
        return MotorList.model_validate(yaml.safe_load(path.read_text()))
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        raise Sim2realError(f"{path}: not YAML: {error}") from None
    except ValidationError as error:
        raise Sim2realError(explain(str(path), error, MotorList)) from None


@dataclass
class Bench:
    """A bus with one motor on it. ``world``: of simulated motors, else None. ``cycle_power`` takes the motor's supply away
    and gives it back; ``confirm(turn)`` has its shaft turned by hand (True) or left alone."""

    spec: BusSpec
    world: Any
    clock: Clock
    cycle_power: Callable[[], None]
    turn: Callable[[bool], None]
    show: Callable[[str], None] = lambda text: None
    patience: float = 60.0  # s for a person to do something

    @property
    def row(self) -> Row:
        """Raises Sim2realError for a protocol whose motors cannot be set up over their bus."""
        if self.spec.protocol not in TOOLS:
            raise Sim2realError(
                f"bus {self.spec.name}: no frame sets up '{self.spec.protocol}' motors, expected {' or '.join(TOOLS)}; use "
                "the maker's tool"
            )
        return TOOLS[self.spec.protocol]

    def find(self) -> tuple[Found, int]:
        """The only motor there, and its bit rate: at the bus's own one first. Raises Sim2realError for none, or several."""
        own = self.spec.bitrate
        rates = [own, *(r for r in SWEEPS[self.spec.protocol].bitrates if r != own)]
        if self.spec.interface == "socketcan" and self.world is None:
            rates = rates[:1]
        for bitrate in rates:
            with opened(self.spec, self.world, bitrate) as wire:
                swept = sweep(self.spec.protocol, wire, self.clock, bitrate)
            if len(swept.motors) == 1 and not swept.motors[0].duplicate:
                return swept.motors[0], bitrate
            if swept.motors:
                ids = ", ".join(f"{m.id:#x}{' twice' * m.duplicate}" for m in swept.motors)
                raise Sim2realError(f"bus {self.spec.name}: got motors {ids}, expected one: connect one at a time")
        tried = ", ".join(map(str, rates))
        raise Sim2realError(
            f"bus {self.spec.name}: nobody answers at {tried} bit/s; check power, connector and termination"
        )

    def set_up(self, motor: MotorSpec) -> MotorRecord:
        """Make the motor on the bus that of ``motor``'s joint; afterwards it was without power once, and has it all still.
        Raises Sim2realError naming the register that it did not take."""
        settings = self.row.settings(self.spec, motor)
        found, bitrate = self.find()
        if found.models is not None and motor.model not in found.models:
            raise Sim2realError(
                f"{motor.joint}: got a {' or '.join(found.models) or 'motor of no known model'}, expected {motor.model}"
            )
        self.show(f"{motor.joint}: found id {found.id:#x} at {bitrate} bit/s")
        self._write(motor, settings, found.id, bitrate)
        self.cycle_power()
        self.clock.sleep_until(self.clock.now() + BOOT_TIME)
        with opened(self.spec, self.world, self.spec.bitrate) as wire:
            tool = self.row.tool(wire, self.clock, self.spec.bitrate)
            kept = {}
            for register, value in settings:
                if register in LOST_WITH_POWER:
                    continue
                got = _read(tool, motor.id, register)
                if (
                    got is None
                    and register != self.row.bitrate
                    or got is not None
                    and not np.isclose(got, value, rtol=1e-4)
                ):
                    raise Sim2realError(
                        f"{motor.joint}: {register} is {got if got is not None else 'silent'} after its power was off, "
                        f"expected {value:g}: it was not kept"
                    )
                kept[register] = float(value)
            identity = {name: _read(tool, motor.id, name) for name in self.row.identity}
            self._confirm(tool, motor)
        fingerprint = ", ".join(f"{name} {value}" for name, value in identity.items())
        return MotorRecord(joint=motor.joint, bus=self.spec.name, id=motor.id, fingerprint=fingerprint, found_id=found.id,
                           found_bitrate=bitrate, settings=kept)  # fmt: skip

    def _write(self, motor: MotorSpec, settings: list[Setting], id: int, bitrate: int) -> None:
        with opened(self.spec, self.world, bitrate) as wire:
            tool = self.row.tool(wire, self.clock, bitrate)
            for register, value in settings:
                if register == self.row.bitrate and bitrate == self.spec.bitrate:
                    continue  # it would not have been found there
                for _ in range(TRIES):
                    if (got := tool.read(id, register)) is not None and np.isclose(got, value, rtol=1e-4):
                        break
                    tool.write(id, register, value)
                    id = motor.id if register == self.row.id and tool.read(motor.id, register) is not None else id
                    if register == self.row.bitrate:
                        break  # heard from now on, or from the next power-on, at that rate only
                else:
                    got = tool.read(id, register)
                    if got is None or not np.isclose(got, value, rtol=1e-4):
                        raise Sim2realError(
                            f"{motor.joint}: {register} is {got if got is not None else 'silent'} after writing {value:g} "
                            f"{TRIES} times"
                        )
                self.show(f"{motor.joint}: {register} = {value:g}")
            if bitrate == self.spec.bitrate or self.spec.protocol != "feetech":
                tool.save(id)
        if bitrate != self.spec.bitrate and SWEEPS[self.spec.protocol].serial:
            with opened(self.spec, self.world, self.spec.bitrate) as wire:
                self.row.tool(wire, self.clock, self.spec.bitrate).save(motor.id)

    def _confirm(self, tool: Tool, motor: MotorSpec) -> None:
        """That it is the one in the person's hand: its LED is on, and turning its shaft is seen. Raises Sim2realError."""
        if self.row.light:
            tool.write(motor.id, self.row.light, 1)
        before = tool.position(motor.id)
        end = self.clock.now() + self.patience
        self.turn(True)
        while True:
            here = tool.position(motor.id)
            if before is not None and here is not None and abs(here - before) > TURNED:
                break
            if self.clock.now() > end:
                raise Sim2realError(
                    f"{motor.joint}: its shaft did not turn within {self.patience:g} s, expected to see that"
                )
            self.clock.sleep_until(self.clock.now() + 0.05)
        self.turn(False)
        if self.row.light:
            tool.write(motor.id, self.row.light, 0)


def _read(tool: Tool, id: int, register: str) -> float | int | None:
    for _ in range(TRIES):
        if (got := tool.read(id, register)) is not None:
            return got
    return None
