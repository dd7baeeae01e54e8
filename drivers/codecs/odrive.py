"""ODrive with CANSimple, firmware 0.5.x: bytes to SI and back, host side and motor side.

    identifier = node (6 bits) << 5 | command (5 bits)

Answers carry the identifier of their question, which is a remote frame. Numbers are little-endian; positions are turns and
torques N m of the motor's shaft, which the gear of MODELS takes to the joint.

There are no gains in a command. The axis runs ``torque = vel_gain (v* + pos_gain (p* - p) - v) + t``, so that

    vel_gain = kd (2 pi / gear^2)        pos_gain = kp / kd

makes the law that was asked for, as long as ``v* + pos_gain (p* - p)`` is within the velocity limit. A kp without kd does
not exist there: kd is raised to kp / POS_GAIN_MAX. Gains go out when they change, and one of the 2 n in each tick again, so
that a lost frame lasts 2 n ticks at most. Velocity and torque of a command are in thousandths, 16 bits.

Whether an axis obeys is only in its heartbeat, which comes every 100 ms unless axis.config.can.heartbeat_rate_ms says
otherwise: set it to 10 (and encoder_rate_ms to 0, for estimates are asked for). Without a heartbeat a motor does not count as
heard. There is no temperature on this bus.

The watchdog (axis.config.enable_watchdog, watchdog_timeout) is fed by every frame to the node, questions too. It can only be
set by USB. On expiry the axis goes idle (limp) with an error, until CLEAR_ERRORS. A wiring of these motors must say
``watchdog: 0``.

Firmware 0.5 tells nobody its serial number. Newer firmware does, to a question that goes to everybody (node 3F) and that 0.5
would take for a new node id. So first each axis is asked for its version, to which 0.5 is silent, and only where all of a bus
have 0.6 or more, for its address.

Source: odriverobotics/ODrive, Firmware/communication/can/can_simple.cpp and tools/odrive-cansimple.dbc (0.5.4); for version
and address docs.odriverobotics.com, "CAN Protocol" (0.6), and its tool can_enumerate.py.
"""

from __future__ import annotations

from enum import IntEnum
from typing import NamedTuple

import numpy as np

from drivers.bus import BusError, BusSpec, MotorCommand, MotorState
from drivers.can_bus import RegisterAnswer, RegisterCheck
from drivers.codecs.mit import QUANTITIES
from drivers.codecs.robstride import model_of
from drivers.wire import ERROR, EXTENDED, FRAME, REMOTE, make_frames

COMMAND_BITS = 5
NODE_MAX = 63
BROADCAST = 0x3F  # since firmware 0.6: everybody
MODERN = 0, 6  # firmware that tells its serial number
TURN = 2 * np.pi
THOUSANDTH = 1e-3  # rev/s and N m, of the 16-bit numbers in SET_INPUT_POS
POS_GAIN_MAX = 1000.0  # 1/s
FLOAT_MAX = 1e30  # stays finite as float32


class Model(NamedTuple):
    """Of the motor behind a controller: N m/A, A, rev/s of its shaft that the axis is told to stay below; and turns of the
    shaft for one of the joint."""

    torque_constant: float
    current: float
    velocity: float
    gear: float = 1.0


# Torque constant 8.27 / KV, as the makers' documentation has it; peak current of the shop's table; no-load speed at 48 V.
MODELS: dict[str, Model] = {
    "D5065": Model(8.27 / 270, 65, 270 * 48 / 60),
    "D6374": Model(8.27 / 150, 70, 150 * 48 / 60),
    "D6374-8:1": Model(8.27 / 150, 70, 150 * 48 / 60, 8.0),
}


class Command(IntEnum):
    """Low five bits of an identifier."""

    GET_VERSION = (
        0x00  # 0.6: protocol, hardware major, minor, variant, firmware major, minor, revision, unreleased; u1 each
    )
    HEARTBEAT = 0x01  # error u4, state u1, flags
    ESTOP = 0x02
    GET_MOTOR_ERROR = 0x03
    GET_ENCODER_ERROR = 0x04
    SET_NODE_ID = 0x06
    ADDRESS = 0x06  # 0.6: node u1, serial number u6, and perhaps one byte more
    SET_AXIS_STATE = 0x07  # u4
    GET_ENCODER_ESTIMATES = 0x09  # f4 rev, f4 rev/s
    SET_CONTROLLER_MODE = 0x0B  # control u4, input u4
    SET_INPUT_POS = 0x0C  # f4 rev, i2 0.001 rev/s, i2 0.001 N m
    SET_INPUT_VEL = 0x0D
    SET_INPUT_TORQUE = 0x0E
    SET_LIMITS = 0x0F  # f4 rev/s, f4 A
    GET_IQ = 0x14  # setpoint f4, measured f4, A
    REBOOT = 0x16
    GET_VBUS = 0x17
    CLEAR_ERRORS = 0x18
    SET_POS_GAIN = 0x1A  # f4 1/s
    SET_VEL_GAINS = 0x1B  # f4 N m s/rev, integrator f4


class AxisState(IntEnum):
    """States that the driver asks for or waits for."""

    IDLE = 1
    FULL_CALIBRATION = 3
    CLOSED_LOOP = 8


POSITION_CONTROL, PASSTHROUGH = 3, 1  # control mode, input mode

ERRORS: dict[int, str] = {
    0: "invalid state",
    6: "motor failed",
    7: "sensorless estimator failed",
    8: "encoder failed",
    9: "controller failed",
    11: "watchdog timer expired",
    12: "minimum end stop pressed",
    13: "maximum end stop pressed",
    14: "emergency stop requested",
    17: "homing without end stop",
    18: "over-temperature",
    19: "unknown position",
}
WATCHDOG_ERROR = 1 << 11
MOTOR_ERROR = 1 << 6

INPUT_POS = np.dtype([("position", "<f4"), ("velocity", "<i2"), ("torque", "<i2")])
HEARTBEAT = np.dtype([("error", "<u4"), ("state", "u1"), ("flags", "u1", (3,))])


def identifier(node: int, command: int) -> int:
    """11-bit identifier."""
    return node << COMMAND_BITS | command


def pack_pair(node: int, command: Command, first: float, second: float, kind: str = "<f4") -> np.ndarray:
    """One FRAME (1,) of two numbers of four bytes."""
    data = np.array([first, second], kind).view(np.uint8)
    return make_frames(np.array([identifier(node, command)]), data[None])


def unpack_pairs(data: np.ndarray, kind: str = "<f4") -> np.ndarray:
    """(m, 2) numbers of payloads (m, 8) uint8."""
    with np.errstate(invalid="ignore"):  # a signalling NaN is a NaN
        return np.ascontiguousarray(data).view(kind).astype(float)


class Law(NamedTuple):
    """An axis' gains and targets, arrays (n,), of the motor's shaft: rev, rev/s, N m, 1/s, N m s/rev."""

    position: np.ndarray
    velocity: np.ndarray
    torque: np.ndarray
    pos_gain: np.ndarray
    vel_gain: np.ndarray


def law_of(c: MotorCommand, gear: np.ndarray) -> Law:
    """What an axis must be told to do what ``c`` asks of the joint."""
    kp = np.clip(c.kp, 0.0, FLOAT_MAX)
    kd = np.clip(np.maximum(c.kd, kp / POS_GAIN_MAX), 0.0, FLOAT_MAX)
    pos_gain = np.divide(kp, kd, out=np.zeros_like(kp), where=kd > 0)
    turns = gear / TURN
    return Law(c.position * turns, c.velocity * turns, c.torque / gear, pos_gain, kd * TURN / gear**2)


def command_of(law: Law, gear: np.ndarray) -> MotorCommand:
    """What an axis does to the joint: the inverse of ``law_of``."""
    kd = law.vel_gain * gear**2 / TURN
    turns = gear / TURN
    return MotorCommand(law.position / turns, law.velocity / turns, law.pos_gain * kd, kd, law.torque * gear)


class OdriveCodec:
    """The host's side of one bus (a ``can_bus.CanCodec``). It remembers which gains each axis has."""

    # Bits of SET_INPUT_POS, the question for estimates and its answer, every third tick of that for the current, and every
    # second (100 Hz at a rate of 200 Hz) of a heartbeat: means of random traffic. For the whole bus, one gain a tick.
    TICK_BITS = (
        118.5 + 48.0 + 115.1 + (48.0 + 116.2) / 3 + 123.0 / 2,
        135.0 + 55.0 + 135.0 + (55.0 + 135.0) / 3 + 135.0 / 2,
    )
    TICK_OVERHEAD_BITS = 119.2
    IDENTITY = NEWER = ("VERSION", "SERIAL")
    TURN = 0.0  # the count of the motor's own turns is lost, and with it the joint's zero
    MOTOR_FRAMES = 3 + 2 / 3 + 1 / 2

    def __init__(self, spec: BusSpec) -> None:
        """Raises BusError for an unknown model or a node that cannot be."""
        _check_ids(spec)
        n = len(spec.motors)
        self.checks: list[RegisterCheck] = []  # CANSimple 0.5 has nothing to read back
        self._models = [model_of(m, MODELS, "odrive.py") for m in spec.motors]
        self._gear = np.array([m.gear for m in self._models])
        self._torque_per_ampere = np.array([m.torque_constant * m.gear for m in self._models])
        self._nodes = np.array([m.id for m in spec.motors], np.uint32)
        self._row_of = np.full(0x40, -1, np.intp)
        self._row_of[self._nodes] = np.arange(n)
        self._gains = np.full((2, n), np.nan)  # pos_gain, vel_gain that each axis was last told
        self._turn = 0
        self._alive = np.zeros(n, bool)  # has sent a heartbeat
        self._modern = np.zeros(n, bool)  # has told its version, which is 0.6 or more

    def _all(self, command: Command, data: np.ndarray) -> np.ndarray:
        """The command to every node (FRAME, (n,)); ``data`` (n, 8) or (8,) uint8."""
        ids = self._nodes << np.uint32(COMMAND_BITS) | np.uint32(command)
        return make_frames(ids, np.broadcast_to(data, (len(ids), 8)))

    def _question(self, command: Command) -> np.ndarray:
        """The remote frame that asks every node (FRAME, (n,))."""
        frames = self._all(command, np.zeros(8, np.uint8))
        frames["id"] |= REMOTE
        frames["length"] = 0
        return frames

    def pack_command(self, command: MotorCommand) -> np.ndarray:
        """Gains where they are not known to be in place, a target for each motor, and questions. Raises ValueError for a
        value not finite."""
        values = np.array([command.position, command.velocity, command.kp, command.kd, command.torque], float)
        finite = np.isfinite(values)
        if not finite.all():
            quantity, motor = np.argwhere(~finite)[0]
            raise ValueError(
                f"command of motor {motor} (counted from 0): got {QUANTITIES[quantity]} {values[quantity, motor]}, "
                "expected a finite value; nothing was packed"
            )
        law = law_of(MotorCommand(*np.clip(values, -FLOAT_MAX / 1e6, FLOAT_MAX / 1e6)), self._gear)
        inputs = np.zeros(len(self._nodes), INPUT_POS)
        inputs["position"] = law.position
        inputs["velocity"] = np.clip(np.round(law.velocity / THOUSANDTH), -32768, 32767)
        inputs["torque"] = np.clip(np.round(law.torque / THOUSANDTH), -32768, 32767)
        targets = self._all(Command.SET_INPUT_POS, inputs.view(np.uint8).reshape(-1, 8))
        return np.concatenate([*self._pack_gains(law), targets, self._pack_questions()])

    def _pack_gains(self, law: Law) -> list[np.ndarray]:
        wanted = np.array([law.pos_gain, law.vel_gain])
        due = wanted != self._gains
        due.flat[self._turn % due.size] = True
        self._gains = wanted
        frames = []
        for quantity, row in np.argwhere(due):
            command = (Command.SET_POS_GAIN, Command.SET_VEL_GAINS)[quantity]
            frames.append(pack_pair(int(self._nodes[row]), command, float(wanted[quantity, row]), 0.0))
        return frames

    def _pack_questions(self) -> np.ndarray:
        """For the estimates of all, and the current of every third."""
        self._turn += 1
        rows = np.arange(len(self._nodes))
        current = self._question(Command.GET_IQ)[(rows + self._turn) % 3 == 0]
        return np.concatenate([self._question(Command.GET_ENCODER_ESTIMATES), current])

    def pack_enable(self, state: MotorState) -> np.ndarray:
        """To each axis that is not in closed loop: errors cleared, limits, position control without gains, closed loop."""
        frames = [np.zeros(0, FRAME)]
        for row in np.flatnonzero(~state.enabled).tolist():
            node, model = int(self._nodes[row]), self._models[row]
            self._gains[:, row] = 0.0
            if state.error[row]:
                frames.append(pack_pair(node, Command.CLEAR_ERRORS, 0, 0))
            frames += [
                pack_pair(node, Command.SET_LIMITS, model.velocity, model.current),
                pack_pair(node, Command.SET_CONTROLLER_MODE, POSITION_CONTROL, PASSTHROUGH, "<u4"),
                pack_pair(node, Command.SET_POS_GAIN, 0, 0),
                pack_pair(node, Command.SET_VEL_GAINS, 0, 0),
                pack_pair(node, Command.SET_AXIS_STATE, AxisState.CLOSED_LOOP, 0, "<u4"),
            ]
        return np.concatenate(frames)

    def pack_disable(self) -> np.ndarray:
        idle = np.array([AxisState.IDLE, 0], "<u4").view(np.uint8)
        return self._all(Command.SET_AXIS_STATE, idle)

    def pack_poll(self, state: MotorState) -> np.ndarray:
        return self._pack_questions()

    def pack_register(self, row: int, register: str, value: float | int | None = None) -> np.ndarray:
        """A question for VERSION (FRAME, (1,)), or for SERIAL to everybody (none, as long as somebody may have firmware
        0.5).
        """
        if value is not None or register not in self.IDENTITY:
            raise KeyError(register)
        if register == "SERIAL" and not self._modern.all():
            return np.zeros(0, FRAME)
        id = identifier(
            *((BROADCAST, Command.ADDRESS) if register == "SERIAL" else (self._nodes[row], Command.GET_VERSION))
        )
        return make_frames(np.array([REMOTE | id]), np.zeros((1, 8), np.uint8), 0)

    def unpack_registers(self, frames: np.ndarray) -> list[RegisterAnswer]:
        """Versions and serial numbers among ``frames``."""
        answers = []
        rows, commands = self._sort(frames)
        for row, command, frame in zip(rows.tolist(), commands.tolist(), frames, strict=True):
            data = frame["data"].tobytes()
            if row >= 0 and command == Command.GET_VERSION:
                major, minor, revision = data[4:7]
                self._modern[row] = (major, minor) >= MODERN
                answers.append(RegisterAnswer(row, "VERSION", major << 16 | minor << 8 | revision, False))
            elif row >= 0 and command == Command.ADDRESS and data[0] == self._nodes[row]:
                answers.append(RegisterAnswer(row, "SERIAL", int.from_bytes(data[1:7], "little"), False))
        return answers

    def unpack(self, frames: np.ndarray, state: MotorState, now: float) -> int:
        """Put heartbeats, estimates and currents into ``state``, the latest of each motor last. Returns how many frames
        came from nobody on this bus or were malformed."""
        rows, commands = self._sort(frames)
        beats = (rows >= 0) & (commands == Command.HEARTBEAT)
        heartbeat = np.ascontiguousarray(frames["data"][beats]).view(HEARTBEAT)[:, 0]
        mine = rows[beats]
        state.error[mine] = heartbeat["error"]
        state.enabled[mine] = heartbeat["state"] == AxisState.CLOSED_LOOP
        self._alive[mine] = True

        values = unpack_pairs(frames["data"])
        sound = (rows >= 0) & np.isfinite(values).all(axis=1)
        estimates = sound & (commands == Command.GET_ENCODER_ESTIMATES)
        mine = rows[estimates]
        state.position[mine], state.velocity[mine] = values[estimates].T * (TURN / self._gear[mine])
        state.time[mine] = np.where(self._alive[mine], now, state.time[mine])
        currents = sound & (commands == Command.GET_IQ)
        state.torque[rows[currents]] = values[currents, 1] * self._torque_per_ampere[rows[currents]]
        return int(np.count_nonzero(rows < 0))

    def owners(self, frames: np.ndarray) -> np.ndarray:
        """Whose each of ``frames`` is: (m,) rows of the motors, -1 for nobody on this bus."""
        return self._sort(frames)[0]

    def _sort(self, frames: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Whose each frame is (m,), -1 for nobody's or malformed, and its Command (m,)."""
        ids = frames["id"].astype(np.int64)
        commands = ids & (1 << COMMAND_BITS) - 1
        rows = self._row_of[ids >> COMMAND_BITS & 0x3F].copy()
        short = (frames["length"] != 8) & ~((commands == Command.ADDRESS) & (frames["length"] == 7))
        rows[~np.isin(commands, ANSWERS) | short | (ids & (EXTENDED | REMOTE | ERROR) != 0)] = -1
        return rows, commands

    def error_name(self, code: int) -> str:
        return ", ".join(ERRORS.get(bit, f"bit {bit}") for bit in range(32) if code >> bit & 1) or "none"


ANSWERS = [
    Command.GET_VERSION,
    Command.ADDRESS,
    Command.HEARTBEAT,
    Command.GET_MOTOR_ERROR,
    Command.GET_ENCODER_ERROR,
    Command.GET_ENCODER_ESTIMATES,
    Command.GET_IQ,
    Command.GET_VBUS,
]


def _check_ids(spec: BusSpec) -> None:
    for m in spec.motors:
        where = f"bus {spec.name}, motor of {m.joint}"
        if not 0 <= m.id <= NODE_MAX:
            raise BusError(f"{where}: got id {m.id:#x}, expected 0x0 to {NODE_MAX:#x} (node id)")
        if m.feedback_id:
            raise BusError(
                f"{where} (id {m.id:#x}): got feedback_id {m.feedback_id:#x}, expected none: it answers on its own id"
            )


class OdriveMotors:
    """The motors' side: the frames that emulated axes answer with."""

    def __init__(self, spec: BusSpec) -> None:
        models = [model_of(m, MODELS, "odrive.py") for m in spec.motors]
        self.nodes = [m.id for m in spec.motors]
        self.gear = np.array([m.gear for m in models])
        self.torque_constant = np.array([m.torque_constant for m in models])

    def pack_heartbeat(self, row: int, error: int, state: int) -> np.ndarray:
        """FRAME (1,)."""
        data = np.zeros(1, HEARTBEAT)
        data["error"], data["state"] = error, state
        return make_frames(
            np.array([identifier(self.nodes[row], Command.HEARTBEAT)]), data.view(np.uint8).reshape(1, 8)
        )

    def pack_version(self, row: int, version: int) -> np.ndarray:
        """FRAME (1,) of a firmware ``version`` (a byte each of major, minor, revision)."""
        data = np.frombuffer(bytes([2, 4, 4, 58]) + version.to_bytes(3, "big") + b"\0", np.uint8)
        return make_frames(np.array([identifier(self.nodes[row], Command.GET_VERSION)]), data[None])

    def pack_address(self, row: int, serial: int) -> np.ndarray:
        """FRAME (1,) of a serial number of 48 bits."""
        data = np.frombuffer(bytes([self.nodes[row]]) + serial.to_bytes(6, "little") + b"\0", np.uint8)
        return make_frames(np.array([identifier(self.nodes[row], Command.ADDRESS)]), data[None])

    def pack_estimates(self, row: int, position: float, velocity: float) -> np.ndarray:
        """FRAME (1,) of a joint's rad and rad/s."""
        turns = self.gear[row] / TURN
        return pack_pair(self.nodes[row], Command.GET_ENCODER_ESTIMATES, position * turns, velocity * turns)

    def pack_current(self, row: int, torque: float) -> np.ndarray:
        """FRAME (1,) of the current, setpoint and measured alike, that makes a joint's N m."""
        current = torque / (self.gear[row] * self.torque_constant[row])
        return pack_pair(self.nodes[row], Command.GET_IQ, current, current)
