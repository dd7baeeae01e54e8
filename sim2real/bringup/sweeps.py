"""Who is on a bus, in every protocol that can be asked: one function each, and SWEEPS, the table of them.

Only what changes nothing is sent, with one exception that is forced: MIT-mode motors without registers answer nothing but
commands, and the one that moves nothing is "disable". See sweep.py for how two motors with one identifier give themselves
away; on a serial line their answers garble each other.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import NamedTuple

import numpy as np

from drivers.bus import Clock
from drivers.codecs import (
    dynamixel,
    dynamixel_packet,
    feetech,
    mini_cheetah,
    moteus,
    moteus_frame,
    odrive,
    recoil,
    robstride,
)
from drivers.wire import FRAME, REMOTE, CanWire, SerialWire, make_frames
from sim2real.bringup.sweep import BATCH, TRIES, Found, Sweep, converse, sweep_damiao

NO_DATA = np.zeros((1, 8), np.uint8)
HEARTBEAT_TIME = 0.25  # s in which every ODrive says what state it is in
SERIAL_TIME = 0.006  # s for one servo to answer, besides the time of its bytes
POLL_PERIOD = 0.001  # s


def _ask_all(
    wire: CanWire, clock: Clock, ids: Sequence[int], swept: Sweep, question: Callable[[int], np.ndarray]
) -> Iterator[tuple[int, np.void]]:
    """Put a question (FRAME, (1,)) to each of ``ids``, a few at a time; (how often that batch was asked before, frame)."""
    for batch in (ids[i : i + BATCH] for i in range(0, len(ids), BATCH)):
        for n in range(TRIES):
            for frame in converse(wire, clock, np.concatenate([question(id) for id in batch]), swept):
                yield n, frame


def _enter(found: dict[int, Found], id: int, times: dict[tuple[int, int], int], n: int) -> Found:
    """The motor ``id``, which answered the ``n``-th asking; more than once is two motors."""
    motor = found.setdefault(id, Found(id))
    times[id, n] = times.get((id, n), 0) + 1
    motor.duplicate |= times[id, n] > 1
    return motor


def sweep_robstride(wire: CanWire, clock: Clock, ids: Iterable[int] = range(1, 0x80)) -> Sweep:
    """By GET_ID, then the parameters; errors from the feedback to a canTimeout that is written as it was read."""
    swept, found, times = Sweep([], protocol="robstride"), {}, {}
    ask = lambda kind, id: robstride.identifier(kind, robstride.HOST_ID, id)  # noqa: E731
    get_id = lambda id: make_frames(np.array([ask(robstride.Type.GET_ID, id)]), NO_DATA)  # noqa: E731
    for n, frame in _ask_all(wire, clock, list(ids), swept, get_id):
        kind, data, destination = _robstride(frame)
        if (kind, destination) == (robstride.Type.GET_ID, robstride.BROADCAST_ID):
            motor, uid = _enter(found, data & 0xFF, times, n), int.from_bytes(frame["data"].tobytes(), "little")
            motor.duplicate |= motor.registers.setdefault(robstride.UID, uid) != uid
    for motor in found.values():
        for name in ("run_mode", "zero_sta", "canTimeout", "limit_torque", "VBUS"):
            for _ in range(TRIES):
                question = make_frames(
                    np.array([ask(robstride.Type.READ, motor.id)]), robstride.pack_parameter(name)[None]
                )
                for frame in converse(wire, clock, question, swept):
                    kind, data, _ = _robstride(frame)
                    answer = robstride.unpack_parameter(frame["data"])
                    if kind == robstride.Type.READ and data == motor.id and answer.name == name:
                        motor.registers[name] = answer.value
                if name in motor.registers:
                    break
        if (timeout := motor.registers.get("canTimeout")) is not None:
            again = robstride.pack_parameter("canTimeout", timeout)[None]
            for frame in converse(
                wire, clock, make_frames(np.array([ask(robstride.Type.WRITE, motor.id)]), again), swept
            ):
                kind, data, _ = _robstride(frame)
                if kind == robstride.Type.FEEDBACK and data & 0xFF == motor.id and (bits := data >> 8 & 0x3F):
                    motor.error = ", ".join(robstride.FAULTS[b] for b in range(6) if bits >> b & 1)
        limit = motor.registers.get("limit_torque", np.nan)
        motor.models = [m for m, row in robstride.MODELS.items() if np.isclose(row.torque, limit, rtol=1e-4)]
    swept.motors = [found[id] for id in sorted(found)]
    return swept


def _robstride(frame: np.void) -> tuple[int, int, int]:
    """Type, data and destination of an identifier."""
    id = int(frame["id"])
    return id >> 24 & 0x1F, id >> 8 & 0xFFFF, id & 0xFF


def sweep_recoil(wire: CanWire, clock: Clock, ids: Iterable[int] = range(1, recoil.ID_MAX + 1)) -> Sweep:
    """By SDO questions, one parameter at a time, for answers do not say what they answer."""
    swept, found, times = Sweep([], protocol="recoil"), {}, {}
    ids = list(ids)
    for k, name in enumerate(("FIRMWARE_VERSION", "ERROR", "MODE", "WATCHDOG_TIMEOUT", "TORQUE_LIMIT", "BUS_VOLTAGE")):
        asked = ids if not k else list(found)
        for n, frame in _ask_all(wire, clock, asked, swept, lambda id, name=name: recoil.pack_sdo(id, name)):
            function, id = divmod(int(frame["id"]), 1 << recoil.FUNCTION_SHIFT)
            if function == recoil.Function.TSDO and frame["length"] == 4 and id in asked:
                motor = _enter(found, id, times, n + TRIES * k)
                value = np.frombuffer(frame["data"].tobytes(), recoil.PARAMETERS[name][1], 1)[0].item()
                motor.registers[name] = value
    for motor in found.values():
        version = int(motor.registers.get("FIRMWARE_VERSION", 0))
        motor.firmware = ".".join(str(version >> shift & 0xFF) for shift in (16, 8, 0))
        error = int(motor.registers.get("ERROR", 0))
        motor.error = ", ".join(recoil.ERRORS.get(b, f"bit {b}") for b in range(32) if error >> b & 1)
    swept.motors = [found[id] for id in sorted(found)]
    return swept


def sweep_odrive(wire: CanWire, clock: Clock, ids: Iterable[int] = range(odrive.NODE_MAX + 1)) -> Sweep:
    """By questions for the estimates; state and errors from the heartbeats that come meanwhile."""
    swept, found, times = Sweep([], protocol="odrive"), {}, {}
    ids, beats = list(ids), {}

    def question(id: int) -> np.ndarray:
        return make_frames(
            np.array([REMOTE | odrive.identifier(id, odrive.Command.GET_ENCODER_ESTIMATES)]), NO_DATA, length=0
        )

    def hear(frame: np.void, n: int) -> None:
        id, command = divmod(int(frame["id"]), 1 << odrive.COMMAND_BITS)
        if command == odrive.Command.GET_ENCODER_ESTIMATES and id in ids and frame["length"] == 8:
            _enter(found, id, times, n)
        elif command == odrive.Command.HEARTBEAT:
            beats[id] = np.frombuffer(frame["data"].tobytes(), odrive.HEARTBEAT)[0]

    def version(id: int) -> np.ndarray:  # to which firmware 0.5 is silent
        return make_frames(np.array([REMOTE | odrive.identifier(id, odrive.Command.GET_VERSION)]), NO_DATA, length=0)

    for n, frame in _ask_all(wire, clock, ids, swept, question):
        hear(frame, n)
    for _, frame in _ask_all(wire, clock, list(found), swept, version):
        hear(frame, TRIES)
        id, command = divmod(int(frame["id"]), 1 << odrive.COMMAND_BITS)
        if command == odrive.Command.GET_VERSION and id in found and frame["length"] == 8:
            found[id].firmware = ".".join(map(str, frame["data"][4:7].tolist()))
    for frame in converse(wire, clock, np.zeros(0, FRAME), swept, HEARTBEAT_TIME):
        hear(frame, TRIES)
    for id, motor in found.items():
        if id in beats:
            motor.registers |= {"state": int(beats[id]["state"]), "error": int(beats[id]["error"])}
            error = motor.registers["error"]
            motor.error = ", ".join(odrive.ERRORS.get(b, f"bit {b}") for b in range(32) if int(error) >> b & 1)
        else:
            motor.error = "no heartbeat: set axis.config.can.heartbeat_rate_ms"
    swept.motors = [found[id] for id in sorted(found)]
    return swept


def sweep_mit(wire: CanWire, clock: Clock, ids: Iterable[int] = range(1, 0x80)) -> Sweep:
    """By "disable", which every MIT-mode motor answers with its id in the first byte: torque goes off where it was on."""
    swept, found, times = Sweep([], protocol="mini_cheetah"), {}, {}
    ids = list(ids)
    disable = mini_cheetah.special_payload(mini_cheetah.Kind.DISABLE)[None]
    for n, frame in _ask_all(wire, clock, ids, swept, lambda id: make_frames(np.array([id]), disable)):
        if frame["length"] >= 6 and int(frame["data"][0]) in ids:
            _enter(found, int(frame["data"][0]), times, n).feedback_ids.add(int(frame["id"]))
    swept.motors = [found[id] for id in sorted(found)]
    return swept


def sweep_moteus(wire: CanWire, clock: Clock, ids: Iterable[int] = range(1, moteus.ID_MAX + 1)) -> Sweep:
    """By questions for serial number, firmware and state. On CAN-FD."""
    swept, found, times = Sweep([], protocol="moteus"), {}, {}
    question = moteus.ASK_SERIAL + moteus.ASK_FIRMWARE + bytes(moteus.QUESTIONS)
    ids = list(ids)
    for n, frame in _ask_all(wire, clock, ids, swept, lambda id: moteus.pack_question(id, question)):
        id, payload = int(frame["id"]) >> 8 & 0x7F, frame["data"][: frame["length"]].tobytes()
        try:
            serial, told = moteus_frame.serial_number(payload), moteus_frame.registers_of(payload)
        except ValueError:
            continue
        if serial is None or id not in ids:
            continue
        motor = _enter(found, id, times, n)
        motor.duplicate |= motor.registers.setdefault(moteus.SERIAL, serial) != serial
        version = int(told.get(moteus_frame.Register.FIRMWARE) or 0)
        motor.firmware = ".".join(str(version >> shift & 0xFF) for shift in (16, 8, 0))
        fault = int(told.get(moteus_frame.Register.FAULT) or 0)
        motor.error = moteus.fault_name(fault) if told.get(moteus_frame.Register.MODE) == moteus.Mode.FAULT else ""
    swept.motors = [found[id] for id in sorted(found)]
    return swept


# -- serial lines ----------------------------------------------------------------------------------------------------


def _listen(wire: SerialWire, clock: Clock, data: bytes, time: float) -> bytes:
    """Send ``data``; what comes back within ``time`` s. Raises WireError."""
    wire.read()  # what was left there
    wire.write(data)
    end, heard = clock.now() + time, b""
    while clock.now() < end:
        clock.sleep_until(clock.now() + POLL_PERIOD)
        heard += wire.read()
    return heard


def answer_time(bitrate: int, size: int) -> float:
    """s to send and hear ``size`` bytes in all."""
    return SERIAL_TIME + 10 * size / bitrate


def read_dynamixel(wire: SerialWire, clock: Clock, id: int, register: str, bitrate: int) -> tuple[list[int], int, bool]:
    """A register of one servo: (what was answered, its error byte, whether something was garbled)."""
    r = dynamixel.REGISTERS[register]
    question = dynamixel_packet.pack_read(id, r.address, r.size)
    parser, heard = dynamixel_packet.Parser(), b""
    heard = _listen(wire, clock, question, answer_time(bitrate, len(question) + 11 + r.size))
    said = [p for p in parser.feed(heard) if p.instruction == dynamixel_packet.Instruction.STATUS and p.id == id]
    values = [
        int.from_bytes(p.parameters[1:], "little", signed=r.low < 0) for p in said if len(p.parameters) == r.size + 1
    ]
    garbled = bool(parser.rejected or len(said) > 1 or (heard and not said and heard != question))
    return values, said[0].parameters[0] if said else 0, garbled


def sweep_dynamixel(
    wire: SerialWire, clock: Clock, ids: Iterable[int] = range(dynamixel_packet.ID_MAX + 1), bitrate: int = 1_000_000
) -> Sweep:
    """By reading each servo's model, then what connecting will demand."""
    names = {row.number: name for name, row in dynamixel.MODELS.items()}
    swept = Sweep([], protocol="dynamixel")
    for id in ids:
        motor = Found(id)
        for name in ("MODEL", "FIRMWARE", "RETURN_DELAY", "OPERATING_MODE", "DRIVE_MODE", "HARDWARE_ERROR"):
            for _ in range(1 if name == "MODEL" else TRIES):
                values, _, garbled = read_dynamixel(wire, clock, id, name, bitrate)
                motor.duplicate |= garbled
                if values:
                    motor.registers[name] = values[0]
                    break
            if not motor.registers:
                break
        if motor.registers or motor.duplicate:
            number = motor.registers.get("MODEL")
            motor.models = [names[int(number)]] if number in names else [] if number is not None else None
            motor.firmware = str(motor.registers.get("FIRMWARE", ""))
            error = int(motor.registers.get("HARDWARE_ERROR", 0))
            motor.error = ", ".join(text for bit, text in dynamixel.HARDWARE_ERRORS.items() if error & bit)
            swept.motors.append(motor)
    return swept


def read_feetech(wire: SerialWire, clock: Clock, id: int, register: str, bitrate: int) -> tuple[list[int], int, bool]:
    """The same of a Feetech servo."""
    address, size = feetech.REGISTERS[register]
    question = feetech.pack(id, feetech.Instruction.READ, bytes([address, size]))
    parser = feetech.Parser()
    heard = _listen(wire, clock, question, answer_time(bitrate, len(question) + 6 + size))
    said = [p for p in parser.feed(heard.removeprefix(question)) if p.id == id and len(p.parameters) == size]
    values = [int.from_bytes(p.parameters, "little") for p in said]
    return values, said[0].instruction if said else 0, bool(parser.rejected or len(said) > 1 or (heard and not said))


def sweep_feetech(
    wire: SerialWire, clock: Clock, ids: Iterable[int] = range(feetech.ID_MAX + 1), bitrate: int = 1_000_000
) -> Sweep:
    """By reading each servo's model, then what connecting will demand."""
    swept = Sweep([], protocol="feetech")
    for id in ids:
        motor = Found(id)
        for name in ("MODEL", "FIRMWARE", "RETURN_DELAY", "MODE"):
            for _ in range(1 if name == "MODEL" else TRIES):
                values, error, garbled = read_feetech(wire, clock, id, name, bitrate)
                motor.duplicate |= garbled
                if values:
                    motor.registers[name] = values[0]
                    motor.error = ", ".join(text for bit, text in feetech.ERRORS.items() if error & bit)
                    break
            if not motor.registers:
                break
        if motor.registers or motor.duplicate:
            number = motor.registers.get("MODEL")
            motor.models = [m for m, row in feetech.MODELS.items() if row.number == number] if motor.registers else None
            firmware = int(motor.registers.get("FIRMWARE", 0))
            motor.firmware = f"{firmware & 0xFF}.{firmware >> 8}"
            swept.motors.append(motor)
    return swept


class Survey(NamedTuple):
    """How a protocol is swept, and the bit rates at which its motors may listen, the likely ones first."""

    sweep: Callable[..., Sweep]
    bitrates: tuple[int, ...]
    serial: bool = False
    data_bitrate: int = 0  # of CAN-FD payloads


CAN_RATES = (1_000_000, 500_000, 250_000, 125_000)
SWEEPS: dict[str, Survey] = {
    "damiao": Survey(sweep_damiao, CAN_RATES),
    "robstride": Survey(sweep_robstride, CAN_RATES),
    "recoil": Survey(sweep_recoil, CAN_RATES),
    "odrive": Survey(sweep_odrive, (250_000, 1_000_000, 500_000, 125_000)),
    "mini_cheetah": Survey(sweep_mit, CAN_RATES),
    "cubemars": Survey(sweep_mit, CAN_RATES),
    "robstride_mit": Survey(sweep_mit, CAN_RATES),
    "moteus": Survey(sweep_moteus, (1_000_000,), data_bitrate=moteus.DATA_BITRATE),
    "dynamixel": Survey(
        sweep_dynamixel, (57_600, 1_000_000, 4_000_000, 3_000_000, 2_000_000, 4_500_000, 115_200, 9600), serial=True
    ),
    "feetech": Survey(sweep_feetech, tuple(feetech.BAUD_RATES.values()), serial=True),
}


def sweep(
    protocol: str, wire: CanWire | SerialWire, clock: Clock, bitrate: int, ids: Iterable[int] | None = None
) -> Sweep:
    """Everybody of ``protocol`` on a wire that is open at ``bitrate``. Raises WireError."""
    survey = SWEEPS[protocol]
    chosen = {} if ids is None else {"ids": ids}
    return survey.sweep(wire, clock, **chosen, **({"bitrate": bitrate} if survey.serial else {}))
