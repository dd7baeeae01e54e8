"""moteus controllers on CAN-FD (1 Mbit/s, payloads at 5 Mbit/s): bytes to SI and back, both sides.

    identifier = source << 8 | destination, bit 15: an answer is wanted; above 7FF the frame is an extended one
    payload    = subframes (moteus_frame.py)

Positions are turns of the output shaft. The law runs in the controller:

    torque = kp kp_scale (position - p) + kd kd_scale (velocity - v) + feed-forward

where the position moves on with the velocity until the next command. kp and kd are of its own configuration, which connecting
sets to the model's (full scale of the gains that a command can ask for, not a tuning) and reads back over its console, with
no integral gain, its time-out, and damping as what a time-out does. These live in RAM: a controller that was without power
has its flash's again, so save them there (``conf write`` in the maker's tview), or connect again.

Any command makes a stopped controller obey. So a motor is commanded only after ``pack_enable``, and only while it says that it
obeys or is about to: one that left UNANSWERED_MAX commands without such an answer is only asked until it gives one, and one
that obeyed and then says that it is stopped was reset, and is only asked until it is enabled again.

What its position is worth after power-on, a controller says in register 00C (HOME_STATE): referenced to the rotor, whose
turns are lost; or to the output, by an encoder there or because somebody set it since ("set output nearest"); or to nothing.
That somebody set another zero than the one that was calibrated, nothing tells.

Every command carries the watchdog's time. On expiry the controller goes to mode 11 (timeout), where it damps with its own kd,
and stays there until it is told to stop.

The maker's register reference says that kd_scale is limited to kp_scale. The firmware has no such limit (fw/pid.h scales the
two by themselves, and its zero-velocity mode is kp_scale 0), which is what is relied on here: damping is kp 0.

Source: mjbots/moteus, docs/protocol/can.md, registers.md, diagnostic.md, docs/reference/configuration.md.
"""

from __future__ import annotations

from enum import IntEnum
from typing import NamedTuple

import numpy as np

from drivers.bus import BusError, BusSpec, MotorCommand, MotorState
from drivers.can_bus import RegisterAnswer, RegisterCheck
from drivers.codecs.mit import QUANTITIES
from drivers.codecs.moteus_frame import (
    CONSOLE,
    CONSOLE_MAX,
    CONSOLE_READ,
    CONSOLE_SAYS,
    CONSOLE_WRITE,
    NOP,
    READ,
    REPLY,
    WRITE,
    Register,
    Resolution,
    console,
    pad,
    serial_number,
    subframes,
    varuint,
)
from drivers.codecs.robstride import model_of
from drivers.wire import ERROR, EXTENDED, REMOTE, make_fd_frames

TURN = 2 * np.pi
DATA_BITRATE = 5_000_000
REPLY_WANTED = 0x8000
HOST = 0  # our source
ID_MAX = 0x7E  # 7F is everybody
UNANSWERED_MAX = 5  # commands; 20 ms at 250 Hz, and it takes 8 ms to get ready


class Model(NamedTuple):
    """Of a servo: turns of the output for one of the rotor; N m it peaks at; kp (N m/rev) and kd (N m s/rev) of its
    configuration, which are the largest that a command can ask for."""

    ratio: float
    torque: float
    kp: float
    kd: float


# qdd100 beta 2: 6:1 and 16 N m, blog.mjbots.com "qdd100 beta 2"; beta 1: 12.5 N m, there too.
MODELS: dict[str, Model] = {
    "qdd100-beta2": Model(1 / 6, 16.0, 400.0, 20.0),
    "qdd100-beta1": Model(1 / 6, 12.5, 400.0, 20.0),
}


class Mode(IntEnum):
    """Register 000."""

    STOPPED = 0
    FAULT = 1
    ENABLING = 2
    CALIBRATING = 3
    CALIBRATED = 4
    POSITION = 10
    TIMEOUT = 11
    ZERO_VELOCITY = 12
    BRAKE = 15


class HomeState(IntEnum):
    """Register 00C: to what the position is referenced."""

    RELATIVE = 0  # nothing: it began where it was switched on
    ROTOR = 1
    OUTPUT = 2


READY = (Mode.ENABLING, Mode.CALIBRATING, Mode.CALIBRATED, Mode.POSITION)  # obeys, or is about to
TIMED_OUT = 0x100  # as MotorState.error; below it: register 00F

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
    45: "stop position deprecated",
    46: "timing violation",
    47: "back-EMF feed-forward without acceleration limit",
    48: "invalid limits",
    TIMED_OUT: "time-out: no command in time",
}

# A command: mode, six floats from 020, the time-out, no limits on the way there, and the questions; 46 bytes and 2 NOP.
COMMAND = np.dtype(
    [("mode", "u1", (3,)), ("target_head", "u1", (3,)), ("target", "<f4", (6,)), ("timeout_head", "u1", (2,)),
     ("timeout", "<f4"), ("limits", "i1", (4,)), ("questions", "u1", (6,)), ("nop", "u1", (2,))]
)  # fmt: skip
NO_LIMITS = (WRITE | 2, Register.COMMAND_VELOCITY_LIMIT, -1, -1)  # negative: none, whatever is configured
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
SERIAL = "serial_number"  # no name of the configuration: registers 120 to 122
ASK_SERIAL = bytes([READ | Resolution.INT32 << 2 | 3]) + varuint(Register.SERIAL_NUMBER)
HOME = "home_state"  # register 00C
ASK_HOME = bytes([READ | 1, Register.HOME_STATE])
ASK_FIRMWARE = bytes([READ | Resolution.INT32 << 2 | 1]) + varuint(Register.FIRMWARE)
QUESTION_OF = {SERIAL: ASK_SERIAL, HOME: ASK_HOME}
HEARING = bytes([CONSOLE_READ, CONSOLE, CONSOLE_MAX])


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


def gains_of(spec: BusSpec) -> Gains:
    """Of the motors of ``spec``. Raises BusError for an unknown model."""
    models = [model_of(m, MODELS, "moteus.py") for m in spec.motors]
    return Gains(*(np.array([getattr(m, name) for m in models]) for name in Gains._fields))


def identifier(source: int, destination: int, reply: bool = False) -> int:
    """16 bits, with EXTENDED where a standard frame cannot hold them."""
    id = source << 8 | destination | REPLY_WANTED * reply
    return id | EXTENDED if id > 0x7FF else id


def pack_question(id: int, payload: bytes) -> np.ndarray:
    """FD_FRAME (1,) to controller ``id``, which answers."""
    data = np.frombuffer(pad(payload), np.uint8)
    return make_fd_frames(np.array([identifier(HOST, id, reply=True)], np.uint32), data[None], len(data))


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
    frames["limits"] = NO_LIMITS
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


class MoteusCodec:
    """Frames for the controllers of one bus, and what their answers say (a ``can_bus.CanCodec``)."""

    # A command of 48 bytes and an answer of 24, in bits at 1 Mbit/s: random motion of a motor whose answers are extended
    # frames (id above 7; else 22 bits less), and the most that stuffing can make of them (one for every four bits).
    TICK_BITS = (244.0, 271.6)
    IDENTITY = (SERIAL,)
    TURN = 2 * np.pi / 6  # of the output, in one turn of the rotor; of all MODELS
    HOME = HOME, {HomeState.RELATIVE: np.nan, HomeState.ROTOR: TURN, HomeState.OUTPUT: 2 * np.pi}

    def __init__(self, spec: BusSpec) -> None:
        """Raises BusError for an unknown model, an id that cannot be, or a bus without CAN-FD."""
        _check_ids(spec)
        if spec.data_bitrate != DATA_BITRATE:
            raise BusError(
                f"bus {spec.name}: got data_bitrate {spec.data_bitrate}, expected {DATA_BITRATE}: moteus speaks CAN-FD.\n"
                f"  Write 'data_bitrate: {DATA_BITRATE}' into the wiring, and use an adapter that can do it"
            )
        models = [model_of(m, MODELS, "moteus.py") for m in spec.motors]
        n = len(models)
        self._spec, self._gains, self._timeout = spec, gains_of(spec), spec.watchdog
        ids = [m.id for m in spec.motors]
        self._ids = np.array([identifier(HOST, id, reply=True) for id in ids], np.uint32)
        self._silent_ids = np.array([identifier(HOST, id) for id in ids], np.uint32)
        self._row_of = np.full(0x80, -1, np.intp)
        self._row_of[ids] = np.arange(n)
        self._wanted = np.zeros(n, bool)  # to obey
        self._following = np.zeros(n, bool)  # has said, since it was enabled, that it obeys
        self._unready = np.zeros(n, np.int64)  # commands sent since it last said that it is READY
        self._asked: list[tuple[str, int]] = [("", 0)] * n  # on the console: what, and how often its answer was fetched
        self._said = [b""] * n
        full, none = np.ones(n), np.zeros(n)
        tview = "set it in the maker's tview, and 'conf write'"
        self.checks = [
            RegisterCheck("motor_position.rotor_to_output_ratio", np.array([m.ratio for m in models]),
                          f"another gear, or it is not calibrated: correct the model in the wiring, or {tview}"),
            RegisterCheck("servo.pid_position.kp", self._gains.kp, "gains would be others than asked for", True),
            RegisterCheck("servo.pid_position.kd", self._gains.kd, "gains would be others than asked for", True),
            RegisterCheck("servo.pid_position.ki", none, "an integral gain is not in the law", True),
            RegisterCheck("servo.default_timeout_s", full * spec.watchdog, "it would not stop in time by itself", True),
            RegisterCheck("servo.timeout_mode", full * Mode.ZERO_VELOCITY, "it would not damp after a time-out", True),
        ]  # fmt: skip

    def _frames(self, payload: bytes) -> np.ndarray:
        """The same to every motor, with an answer wanted (FD_FRAME, (n,))."""
        data = np.frombuffer(pad(payload), np.uint8)
        return make_fd_frames(self._ids, np.broadcast_to(data, (len(self._ids), len(data))), len(data))

    def pack_command(self, command: MotorCommand) -> np.ndarray:
        """A command to each motor that was enabled, a question to the others (FD_FRAME, (n,)). Raises ValueError for a value
        not finite."""
        data = pack_command(command, self._gains, self._timeout)
        frames = make_fd_frames(self._ids, data, data.shape[1])
        off = ~self._wanted | (self._unready >= UNANSWERED_MAX)
        self._unready[~off] += 1
        if off.any():
            frames[off] = self._frames(bytes(QUESTIONS))[off]
        return frames

    def pack_enable(self, state: MotorState) -> np.ndarray:
        """To each motor that does not obey: a stop where it is in an error, and position mode without gains or torque."""
        off = np.flatnonzero(~state.enabled)
        self._wanted[off], self._following[off], self._unready[off] = True, False, 0
        stop = self._frames(STOP)[off[state.error[off] != 0]]
        return np.concatenate([stop, self.pack_command(MotorCommand(*np.zeros((5, len(self._ids)))))[off]])

    def pack_disable(self) -> np.ndarray:
        self._wanted[:] = False
        return self._frames(STOP)

    def pack_poll(self, state: MotorState) -> np.ndarray:
        return self._frames(bytes(QUESTIONS))

    def pack_register(self, row: int, register: str, value: float | int | None = None) -> np.ndarray:
        """Write a configuration value, or ask for it and fetch what the console has to say; or ask for SERIAL or HOME.

        The console's answers do not tell what they answer, so that only one question is out at a time: it is put again
        when its answer was fetched twice and did not come, and before that only fetched.
        """
        if value is not None:
            return self._type(row, f"conf set {register} {value:.9g}\n")
        if register in QUESTION_OF:
            return pack_question(self._spec.motors[row].id, QUESTION_OF[register])
        asked, fetched = self._asked[row]
        fetch = make_fd_frames(self._ids[row : row + 1], np.frombuffer(HEARING, np.uint8)[None], len(HEARING))
        if asked == register and fetched < 2:
            self._asked[row] = register, fetched + 1
            return fetch
        self._asked[row], self._said[row] = (register, 1), b""
        return np.concatenate([self._type(row, f"conf get {register}\n"), fetch])

    def _type(self, row: int, text: str) -> np.ndarray:
        payload = np.frombuffer(pad(console(CONSOLE_WRITE, text.encode())), np.uint8)
        return make_fd_frames(self._silent_ids[row : row + 1], payload[None], len(payload))

    def unpack_registers(self, frames: np.ndarray) -> list[RegisterAnswer]:
        """What the consoles said of what was asked for, serial numbers and home states. OK confirms a write; ERR stands
        for a value that there is not.
        """
        answers = []
        rows = self.owners(frames)
        for frame, row in zip(frames[rows >= 0], rows[rows >= 0].tolist(), strict=True):
            payload = frame["data"][: frame["length"]].tobytes()
            if (serial := _serial_number(payload)) is not None:
                answers.append(RegisterAnswer(row, SERIAL, serial, False))
            if (home := _home_state(payload)) is not None:
                answers.append(RegisterAnswer(row, HOME, home, False))
            for text in _console_texts(payload):
                *lines, self._said[row] = (self._said[row] + text)[-1024:].split(b"\n")
                for line in lines:
                    register = self._asked[row][0]
                    if register and (value := _number(line)) is not None:
                        answers.append(RegisterAnswer(row, register, value, False))
                        self._asked[row] = "", 0
        return answers

    def unpack(self, frames: np.ndarray, state: MotorState, now: float) -> int:
        """Put answers into ``state``, the latest of each motor last. Returns how many frames came from nobody on this bus, or
        were no whole answers."""
        rows = self.owners(frames)
        rows[frames["length"] != ANSWER.itemsize] = -1
        answers, sound = unpack_answer(frames["data"][:, : ANSWER.itemsize])
        good = (rows >= 0) & sound
        mine, mode = rows[good], answers.mode[good]
        state.position[mine], state.velocity[mine] = answers.position[good], answers.velocity[good]
        state.torque[mine], state.temperature[mine] = answers.torque[good], answers.temperature[good]
        state.enabled[mine] = mode == Mode.POSITION
        fault = np.maximum(answers.fault[good], 1)
        state.error[mine] = np.where(mode == Mode.FAULT, fault, np.where(mode == Mode.TIMEOUT, TIMED_OUT, 0))
        state.time[mine] = now
        latest = np.full(len(self._ids), -1)
        latest[mine] = mode  # of several the last
        self._unready[np.isin(latest, READY)] = 0
        self._wanted &= ~self._following | (latest != Mode.STOPPED)
        self._following |= latest == Mode.POSITION
        return int(len(frames) - np.count_nonzero(good))

    def owners(self, frames: np.ndarray) -> np.ndarray:
        """Whose each of ``frames`` is: (m,) rows of the motors, -1 for nobody on this bus."""
        ids = frames["id"].astype(np.int64)
        bare = ids & ~EXTENDED
        rows = self._row_of[bare >> 8 & 0x7F].copy()
        rows[(bare > 0x7F00) | (bare & 0xFF != HOST) | (ids & (REMOTE | ERROR) != 0)] = -1
        return rows

    def error_name(self, code: int) -> str:
        return fault_name(code)


def fault_name(code: int) -> str:
    """The maker's name of register 00F, or of TIMED_OUT."""
    if code in FAULTS or not code:
        return FAULTS.get(code, "none")
    return "limited" if 96 <= code <= 103 else f"unknown fault {code}"


def _check_ids(spec: BusSpec) -> None:
    for m in spec.motors:
        where = f"bus {spec.name}, motor of {m.joint}"
        if not 1 <= m.id <= ID_MAX:
            raise BusError(f"{where}: got id {m.id:#x}, expected 0x1 to {ID_MAX:#x}")
        if m.feedback_id:
            raise BusError(
                f"{where} (id {m.id:#x}): got feedback_id {m.feedback_id:#x}, expected none: it answers to who asked"
            )


def _serial_number(payload: bytes) -> int | None:
    try:
        return serial_number(payload)
    except ValueError:
        return None


def _home_state(payload: bytes) -> int | None:
    try:
        for s in subframes(payload):
            if (s.type, s.first, s.count, s.resolution) == (REPLY, Register.HOME_STATE, 1, Resolution.INT8):
                return int(s.values[0])
    except ValueError:
        pass
    return None


def _console_texts(payload: bytes) -> list[bytes]:
    try:
        return [s.text for s in subframes(payload) if s.type == CONSOLE_SAYS and s.first == CONSOLE]
    except ValueError:
        return []


def _number(line: bytes) -> float | None:
    """The value in a line of the console; NaN: there is no such thing; None: no answer to a question."""
    if line.startswith(b"ERR"):
        return float("nan")
    try:
        return float(line)
    except ValueError:
        return None


class MoteusMotors:
    """The motors' side: the frames that emulated controllers answer with."""

    def __init__(self, spec: BusSpec) -> None:
        self.ids = [m.id for m in spec.motors]
        self.models = [model_of(m, MODELS, "moteus.py") for m in spec.motors]

    def pack(self, row: int, destination: int, payload: bytes) -> np.ndarray:
        """FD_FRAME (1,) with ``payload`` to who asked."""
        data = np.frombuffer(pad(payload), np.uint8)
        return make_fd_frames(np.array([identifier(self.ids[row], destination)], np.uint32), data[None], len(data))
