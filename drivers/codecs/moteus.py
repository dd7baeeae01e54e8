"""moteus controllers: the payloads of their register protocol, bytes to SI and back, both sides.

Bytes only: a command is longer than the 8 bytes of classic CAN, and no wire of this package carries CAN-FD yet. So there is
no line for moteus in ``drivers/open.py``.

    identifier = source << 8 | destination, bit 15: an answer is wanted; above 7FF the frame is an extended one
    payload    = subframes [type | count, first register, values ...], filled up to a length of CAN-FD with 50

Numbers are little-endian; positions are turns of the output shaft. The law runs in the controller:

    torque = kp kp_scale (position - p) + kd kd_scale (velocity - v) + feed-forward

with kp and kd of its own configuration (servo.pid_position, N m/rev and N m s/rev), which only the diagnostic channel tells.
Every command carries its own watchdog time. On expiry the controller goes to mode 11 (timeout), which brakes as servo.timeout_mode
says (factory: zero velocity), and stays there until it is told to stop.

Source: mjbots/moteus, docs/reference.md (A.1 subframes, registers, scalings); the library moteus 1.1.1 packs the same bytes.
"""

from __future__ import annotations

from enum import IntEnum
from typing import NamedTuple

import numpy as np

from drivers.bus import MotorCommand
from drivers.codecs.mit import QUANTITIES

TURN = 2 * np.pi
REPLY_WANTED = 0x8000
NOP = 0x50
LENGTHS = (0, 1, 2, 3, 4, 5, 6, 7, 8, 12, 16, 20, 24, 32, 48, 64)  # of a CAN-FD payload
WRITE, READ, REPLY = 0x00, 0x10, 0x20  # type of a subframe; + 4 * Resolution, + count (0: a varuint follows)
ERROR = 0x30
VALUES = ("i1", "<i2", "<i4", "<f4")  # by resolution


class Mode(IntEnum):
    """Register 000."""

    STOPPED = 0
    FAULT = 1
    POSITION = 10
    TIMEOUT = 11
    ZERO_VELOCITY = 12
    BRAKE = 15


class Register(IntEnum):
    """Registers that the codec reads or writes."""

    MODE = 0x000
    POSITION = 0x001  # rev
    VELOCITY = 0x002  # rev/s
    TORQUE = 0x003  # N m
    TEMPERATURE = 0x00E  # deg C
    FAULT = 0x00F
    COMMAND_POSITION = 0x020
    COMMAND_VELOCITY = 0x021
    COMMAND_TORQUE = 0x022
    COMMAND_KP_SCALE = 0x023
    COMMAND_KD_SCALE = 0x024
    COMMAND_MAX_TORQUE = 0x025
    COMMAND_TIMEOUT = 0x027  # s


FAULTS: dict[int, str] = {
    32: "calibration fault",
    33: "motor driver fault",
    34: "over-voltage",
    35: "encoder fault",
    36: "motor not configured",
    37: "PWM cycle overrun",
    38: "over-temperature",
    39: "start outside limit",
    40: "under-voltage",
    41: "configuration changed",
    42: "theta invalid",
    43: "position invalid",
    44: "driver enable fault",
}

# A command: mode, six floats from 020, the time-out, and the questions; 42 bytes and 6 NOP.
COMMAND = np.dtype(
    [("mode", "u1", (3,)), ("target_head", "u1", (3,)), ("target", "<f4", (6,)), ("timeout_head", "u1", (2,)),
     ("timeout", "<f4"), ("questions", "u1", (6,)), ("nop", "u1", (6,))]
)  # fmt: skip
QUESTIONS = (READ | 1, Register.MODE, READ | 0xC | 3, Register.POSITION, READ | 2, Register.TEMPERATURE)
# Its answer: mode; position, velocity, torque; temperature, fault; 21 bytes and 3 NOP.
ANSWER = np.dtype(
    [("mode_head", "u1", (2,)), ("mode", "i1"), ("motion_head", "u1", (2,)), ("motion", "<f4", (3,)),
     ("state_head", "u1", (2,)), ("temperature", "i1"), ("fault", "u1"), ("nop", "u1", (3,))]
)  # fmt: skip
ANSWER_HEADS = {
    "mode_head": (REPLY | 1, Register.MODE),
    "motion_head": (REPLY | 0xC | 3, Register.POSITION),
    "state_head": (REPLY | 2, Register.TEMPERATURE),
}
STOP = bytes([WRITE | 1, Register.MODE, Mode.STOPPED, *QUESTIONS])  # 9 bytes: padded to 12


class Gains(NamedTuple):
    """What the controllers are configured with, arrays (n,): kp (N m/rev), kd (N m s/rev), most torque (N m)."""

    kp: np.ndarray
    kd: np.ndarray
    torque: np.ndarray


class Answers(NamedTuple):
    """Answers to commands, arrays (m,)."""

    mode: np.ndarray
    position: np.ndarray  # rad
    velocity: np.ndarray  # rad/s
    torque: np.ndarray  # N m
    temperature: np.ndarray  # deg C
    fault: np.ndarray


def identifier(source: int, destination: int, reply: bool = False) -> int:
    """29 bits; above 7FF it needs an extended frame."""
    return source << 8 | destination | REPLY_WANTED * reply


def pad(payload: bytes) -> bytes:
    """``payload`` filled up to the next length of CAN-FD. Raises ValueError beyond 64 bytes."""
    for length in LENGTHS:
        if len(payload) <= length:
            return payload.ljust(length, bytes([NOP]))
    raise ValueError(f"payload: got {len(payload)} bytes, expected at most 64")


def pack_command(command: MotorCommand, gains: Gains, timeout: float) -> np.ndarray:
    """Payloads (n, 48) uint8: position mode, and the questions. kp and kd saturate at the configured ones, torque at the
    most. ``timeout`` (s): the watchdog. Raises ValueError for a value that is not finite (NaN means "not commanded")."""
    c = command
    values = np.array([c.position, c.velocity, c.kp, c.kd, c.torque], float)
    finite = np.isfinite(values)
    if not finite.all() or not np.isfinite(timeout) or timeout <= 0:
        quantity, motor = np.argwhere(~finite)[0] if not finite.all() else (0, 0)
        what = f"{QUANTITIES[quantity]} {values[quantity, motor]}" if not finite.all() else f"timeout {timeout}"
        raise ValueError(
            f"command of motor {motor} (counted from 0): got {what}, expected a finite value; nothing was packed"
        )
    position, velocity, kp, kd, torque = values
    frames = np.zeros(len(position), COMMAND)
    frames["mode"] = WRITE | 1, Register.MODE, Mode.POSITION
    frames["target_head"] = WRITE | 0xC, 6, Register.COMMAND_POSITION
    frames["target"] = np.stack(
        [
            np.clip(position / TURN, -32768, 32767),  # where its position wraps
            np.clip(velocity / TURN, -1e6, 1e6),
            np.clip(torque, -gains.torque, gains.torque),
            np.clip(kp * TURN / gains.kp, 0.0, 1.0),
            np.clip(kd * TURN / gains.kd, 0.0, 1.0),
            gains.torque,
        ],
        axis=1,
    )
    frames["timeout_head"] = WRITE | 0xC | 1, Register.COMMAND_TIMEOUT
    frames["timeout"] = timeout
    frames["questions"] = QUESTIONS
    frames["nop"] = NOP
    return frames.view(np.uint8).reshape(len(frames), -1)


def unpack_command(data: np.ndarray, gains: Gains) -> tuple[MotorCommand, np.ndarray, np.ndarray]:
    """The motors' side of ``pack_command``: what payloads (n, 48) ask for, the most torque (n,) N m and the time-out (n,) s."""
    frames = np.ascontiguousarray(data).view(COMMAND)[:, 0]
    position, velocity, torque, kp, kd, most = frames["target"].T.astype(float)
    command = MotorCommand(position * TURN, velocity * TURN, kp * gains.kp / TURN, kd * gains.kd / TURN, torque)
    return command, most, frames["timeout"].astype(float)


def pack_answer(answers: Answers) -> np.ndarray:
    """The motors' side of ``unpack_answer``: payloads (m, 24) uint8."""
    frames = np.zeros(len(answers.mode), ANSWER)
    for name, head in ANSWER_HEADS.items():
        frames[name] = head
    frames["mode"], frames["fault"] = answers.mode, answers.fault
    frames["motion"] = np.stack([answers.position / TURN, answers.velocity / TURN, answers.torque], axis=1)
    frames["temperature"] = np.clip(np.round(answers.temperature), -127, 127)
    frames["nop"] = NOP
    return frames.view(np.uint8).reshape(len(frames), -1)


def unpack_answer(data: np.ndarray) -> tuple[Answers, np.ndarray]:
    """What payloads (m, 24) uint8 say, and which of them (m,) are whole answers with finite motion."""
    frames = np.ascontiguousarray(data).view(ANSWER)[:, 0]
    sound = np.asarray(np.isfinite(frames["motion"]).all(axis=1))
    for name, head in ANSWER_HEADS.items():
        np.logical_and(sound, (frames[name] == np.array(head, np.uint8)).all(axis=1), out=sound)
    with np.errstate(invalid="ignore"):  # a signalling NaN is a NaN
        position, velocity, torque = frames["motion"].T.astype(float)
    state = frames["temperature"].astype(float), frames["fault"].astype(np.int64)
    return Answers(frames["mode"].astype(np.int64), position * TURN, velocity * TURN, torque, *state), sound


def registers_of(payload: bytes) -> dict[int, float | int | None]:
    """Every register that a payload writes, answers, or (None) asks for. Raises ValueError if it is not whole."""
    found: dict[int, float | int | None] = {}
    at = 0

    def take(n: int) -> bytes:
        nonlocal at
        if at + n > len(payload):
            raise ValueError(f"payload {payload.hex()}: ends at byte {len(payload)}, expected {n} more from byte {at}")
        at += n
        return payload[at - n : at]

    def varuint() -> int:
        value = 0
        for shift in range(0, 35, 7):
            byte = take(1)[0]
            value |= (byte & 0x7F) << shift
            if byte < 0x80:
                return value
        raise ValueError(f"payload {payload.hex()}: a number of more than 5 bytes before byte {at}")

    while at < len(payload):
        head = take(1)[0]
        if head == NOP:
            continue
        if head >= ERROR:
            raise ValueError(
                f"payload {payload.hex()}: got subframe {head:#x} at byte {at - 1}, expected one of registers"
            )
        count, resolution = head & 3 or varuint(), head >> 2 & 3
        first = varuint()
        for register in range(first, first + count):
            kind = np.dtype(VALUES[resolution])
            reads = head & 0x30 == READ
            found[register] = None if reads else np.frombuffer(take(kind.itemsize), kind)[0].item()
    return found


def fault_name(code: int) -> str:
    """What register 00F means."""
    if code in FAULTS or not code:
        return FAULTS.get(code, "none")
    return "limited" if 96 <= code <= 103 else f"unknown fault {code}"
