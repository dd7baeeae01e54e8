"""The one registry: which class speaks a protocol, and which carries an interface. Classes are imported when opened."""

from __future__ import annotations

import difflib
from collections.abc import Callable, Iterable, Sequence
from importlib import import_module
from typing import Any, NamedTuple

from drivers.bus import BusError, BusSpec, Imu, ImuSpec, MotorBus
from drivers.wire import WireError


class BusProtocol(NamedTuple):
    """A motor protocol: the kind of wire that it runs on, its bus class, its codec and its emulated motors
    ("module:Class")."""

    wire: str
    bus: str
    codec: str
    motors: str = ""
    watchdog: bool = True  # connecting programs one
    calibrated: bool = False  # the maker did it: positions are those of the joints
    serial: str = ""  # what of a motor's fingerprint is its serial number; "": it tells none


def _can(name: str, codec: str, watchdog: bool = True, serial: str = "") -> BusProtocol:
    """A protocol on CanBus: its codec, and in drivers/sim its motors, are files of its ``name``."""
    codec_path, motors_path = f"drivers.codecs.{name}:{codec}Codec", f"drivers.sim.{name}:Sim{codec}"
    return BusProtocol("can", "drivers.can_bus:CanBus", codec_path, motors_path, watchdog, serial=serial)


PROTOCOLS: dict[str, BusProtocol] = {
    "damiao": _can("damiao", "Damiao", serial="SN"),
    "robstride": _can("robstride", "Robstride", serial="MCU_UID"),
    "recoil": _can("recoil", "Recoil", serial="FLUX_OFFSET"),
    "mini_cheetah": _can("mini_cheetah", "MiniCheetah", watchdog=False),
    "cubemars": _can("cubemars", "Cubemars", watchdog=False),
    "robstride_mit": _can("robstride_mit", "RobstrideMit", watchdog=False),
    "odrive": _can("odrive", "Odrive", watchdog=False, serial="SERIAL"),
    "moteus": _can("moteus", "Moteus", serial="serial_number"),
    "dynamixel": BusProtocol(
        "serial",
        "drivers.serial_bus:SerialBus",
        "drivers.codecs.dynamixel:DynamixelCodec",
        "drivers.sim.servo:SimServos",
    ),
    "feetech": BusProtocol(
        "serial",
        "drivers.serial_bus:SerialBus",
        "drivers.codecs.feetech:FeetechCodec",
        "drivers.sim.feetech:SimFeetech",
        watchdog=False,
    ),
    "unitree_hg": BusProtocol(
        "dds", "drivers.dds_bus:DdsBus", "drivers.codecs.unitree_hg:UnitreeHgCodec", watchdog=False, calibrated=True
    ),
}

WORLDS: dict[str, str] = {
    "can": "drivers.sim.world:World",
    "dds": "drivers.sim.dds_world:DdsWorld",
    "serial": "drivers.sim.serial_world:SerialWorld",
}


class ImuProtocol(NamedTuple):
    """An IMU's protocol: what reads its packets, and the sensor's side for the twin ("module:Class")."""

    parser: str
    sensor: str = ""


IMUS: dict[str, ImuProtocol] = {
    "hipnuc": ImuProtocol("drivers.codecs.hipnuc:Parser", "drivers.codecs.hipnuc:Sensor"),
    "witmotion": ImuProtocol("drivers.codecs.witmotion:Parser", "drivers.codecs.witmotion:Sensor"),
    "bno085": ImuProtocol("drivers.codecs.bno085:Parser", "drivers.codecs.bno085:Sensor"),
    "bno085_shtp": ImuProtocol("drivers.codecs.bno085_shtp:Parser", "drivers.codecs.bno085_shtp:Sensor"),
    "unitree_hg": ImuProtocol("drivers.codecs.unitree_hg:ImuParser"),
}


def open_bus(spec: BusSpec, wire: Any = None) -> MotorBus:
    """The bus of ``spec``, not yet connected; on ``wire`` where given, else on the one that its interface names.

    Raises BusError for an unknown protocol or interface, a wiring that the protocol cannot carry, or a busy port.
    """
    codec = open_codec(spec)
    return load(PROTOCOLS[spec.protocol].bus)(spec, codec, open_wire(spec) if wire is None else wire)


def open_codec(spec: BusSpec) -> Any:
    """The host's codec for the motors of ``spec``, without any wire. Raises BusError."""
    _known("protocol", spec.protocol, PROTOCOLS, f"bus {spec.name}")
    protocol = PROTOCOLS[spec.protocol]
    if spec.watchdog and not protocol.watchdog and protocol.wire == "can":
        raise BusError(
            f"bus {spec.name}: got watchdog {spec.watchdog:g} s, expected 0: no frame of '{spec.protocol}' programs one.\n"
            "  With 0 the wiring says that these motors may go on without the host; set their own time-out with the "
            "maker's tool"
        )
    if not spec.watchdog and protocol.watchdog:
        raise BusError(
            f"bus {spec.name}: got watchdog 0, expected more: '{spec.protocol}' has one, and it must be used"
        )
    return load(protocol.codec)(spec)


def open_imu(spec: ImuSpec, wire: Any = None) -> Imu:
    """The IMU of ``spec``; on ``wire`` where given, else on the one that its interface names. Raises BusError."""
    _known("protocol", spec.protocol, IMUS, "imu")
    parser = load(IMUS[spec.protocol].parser)()
    return load("drivers.imu.serial:SerialImu")(spec, parser, open_wire(spec) if wire is None else wire)


def open_world(model_path: Any, base: str, buses: Sequence[BusSpec], imu: ImuSpec, **options: Any) -> Any:
    """The simulated twin of a wiring (a drivers.sim.world.World, see there): a body, motors and wires. Raises BusError."""
    for spec in buses:
        _known("protocol", spec.protocol, PROTOCOLS, f"bus {spec.name}")
    wires = {PROTOCOLS[spec.protocol].wire for spec in buses}
    kind = wires.pop() if len(wires) == 1 else "can"  # which says what it cannot have
    return load(WORLDS.get(kind, WORLDS["can"]))(model_path, base, buses, imu, **options)


def open_wire(spec: BusSpec | ImuSpec) -> Any:
    """The wire that ``spec.interface`` and ``spec.channel`` name. Raises BusError.

    ``sim``: a simulated bus served on the unix socket ``channel``. CAN: ``socketcan``, or any interface of python-can.
    Serial: ``serial``. DDS: ``dds``, and as channel a network interface.
    """
    is_bus = isinstance(spec, BusSpec)
    where = f"bus {spec.name}" if is_bus else "imu"
    try:
        if is_bus:
            _known("protocol", spec.protocol, PROTOCOLS, where)
        if is_bus and PROTOCOLS[spec.protocol].wire == "can":
            return _open_can(spec, where)
        if spec.interface == "dds" or (is_bus and PROTOCOLS[spec.protocol].wire == "dds"):
            return _open_dds(spec, where)
        _known("interface", spec.interface, ("serial", "sim") if is_bus else ("serial", "sim", "dds"), where)
        if spec.interface == "sim":
            return _lasting(lambda: load("drivers.sim.socket_wire:SocketSerialWire")(spec.channel))
        rate = spec.bitrate if is_bus else spec.baud
        return _lasting(lambda: load("drivers.serial_wire:PySerialWire")(spec.channel, rate))
    except WireError as error:
        raise BusError(f"{where}: {error}") from error


def _open_can(spec: BusSpec, where: str) -> Any:
    if spec.interface == "sim":
        return _lasting(lambda: load("drivers.sim.socket_wire:SocketCanWire")(spec.channel, spec.data_bitrate))
    if spec.interface == "socketcan":
        rates = spec.bitrate, spec.data_bitrate
        return _lasting(lambda: load("drivers.can_wire:RawCanWire").open(spec.channel, *rates))
    _known("interface", spec.interface, ["sim", *load("drivers.can_wire:interfaces")()], where)
    return load("drivers.can_wire:PythonCanWire")(spec.interface, spec.channel, spec.bitrate, spec.data_bitrate)


def _lasting(make: Callable[[], Any]) -> Any:
    """A wire that is opened again when its adapter is plugged in again."""
    return load("drivers.reopening:ReopeningWire")(make)


def _open_dds(spec: BusSpec | ImuSpec, where: str) -> Any:
    _known("interface", spec.interface, ("dds", "sim"), where)
    if spec.interface == "sim":
        return load("drivers.sim.dds_port:SocketDdsWire")(spec.channel)
    try:
        return load("drivers.dds_wire:open_dds")(spec)
    except ImportError as error:
        raise WireError(f"{error}; DDS needs an extra: pip install 'sim2real[dds]'") from None


def load(path: str) -> Any:
    """What ``module:Name`` names."""
    module, name = path.split(":")
    return getattr(import_module(module), name)


def _known(what: str, name: str, options: Iterable[str], where: str) -> None:
    if name not in options:
        close = difflib.get_close_matches(name, options, n=1)
        hint = f" (did you mean '{close[0]}'?)" if close else ""
        raise BusError(f"{where}: got {what} '{name}'{hint}, expected one of {', '.join(options)}")
