"""Dynamixel Protocol 2.0, X series and MX with firmware 2.0: bytes to SI and back, host side and servo side.

Framing, stuffing and CRC are in dynamixel_packet.py. Source: ROBOTIS e-manual, the control table pages of the models.

**What a PD target becomes.** A position-controlled servo turns the goal's distance into a duty cycle,
``pwm = P / 128 * ticks`` of 885 (e-manual, "Position PID Gain"), and a DC motor that into
``torque = stall_torque * pwm / 885 - stall_torque / no_load_speed * velocity``. So:

- ``kp`` becomes the P gain, every tick, by the model's stall torque at its nominal voltage (MODELS); its step is
  stall_torque / 174 rad (0.02 N m/rad for an XM430-W350). Off that voltage the torque scales with the supply.
- ``kd`` has no register: the D gain's time base is not published, and it is set to 0. What damps is the motor's own
  back-EMF, ``damping_of(model)``, whether asked for or not, also at kp = 0: the windings are then shorted.
- the terms ``kd * velocity + torque`` move the goal position by themselves over kp, which gives the same torque.

Profiles are switched off, so that targets are not smoothed. There is no current loop in these modes: CURRENT_LIMIT and
GOAL_CURRENT do nothing, and torque ends with the duty cycle, at the stall torque or at PWM_LIMIT where that is lower.
A policy for such a robot is trained with kd = ``damping_of(model)``; the robot's YAML says the same for kd, kd_max and
damping (configs/robots/op3.yaml).

Operating modes 3 (position, one turn) and 4 (extended position) work so. Mode 5 (current-based position) is refused: how
its P gain relates to current is not published.
"""

from __future__ import annotations

import difflib
from collections.abc import Sequence
from enum import IntEnum
from functools import cache
from typing import NamedTuple

import numpy as np

from drivers.bus import BusError, BusSpec, MotorCommand, MotorState
from drivers.codecs.dynamixel_packet import (
    BROADCAST,
    HEADER,
    ID_MAX,
    OVERHEAD,
    STUFFED,
    Instruction,
    Parser,
    crc16,
    crc_table,
    pack,
    pack_sync_read,
    pack_sync_write,
    unstuff,
)
from drivers.serial_bus import RegisterCheck

TICKS = 4096  # a turn
TICK = 2 * np.pi / TICKS  # rad
ZERO = 2048  # position at 0 rad
VELOCITY_UNIT = 0.0239691227  # rad/s, as in the maker's own model files ("0.229 rpm", rounded, in the tables)
PWM_MAX = 885  # 100 %
GAIN_UNIT = 128  # P gain of 1 PWM unit per tick
GAIN_MAX = 16383
LOAD_UNIT = 0.001  # of the stall torque, where there is no current sensor
WATCHDOG_UNIT = 0.02  # s
WATCHDOG_TRIPPED = 0xFF  # -1 in its register
EXTENDED_MAX = 1_048_575  # ticks, mode 4


class StatusError(IntEnum):
    """Low seven bits of a status packet's error byte: what was wrong with the instruction."""

    NONE = 0
    RESULT_FAIL = 1
    INSTRUCTION = 2
    CRC = 3
    DATA_RANGE = 4
    DATA_LENGTH = 5
    DATA_LIMIT = 6
    ACCESS = 7


ALERT = 0x80  # bit of the same byte: read HARDWARE_ERROR; the packet's data are good all the same
HARDWARE_ERRORS = {
    0x01: "input voltage",
    0x04: "overheating",
    0x08: "encoder",
    0x10: "electrical shock",
    0x20: "overload",
    0x100: "bus watchdog tripped",  # not in the servo's byte: register BUS_WATCHDOG says -1
}
TRIPPED = 0x100


class Model(NamedTuple):
    """What tells models apart: number, current of one unit (A; 0: it reports load), and the motor at its nominal
    voltage: stall torque (N m), stall current (A), no-load speed (rpm)."""

    number: int
    current: float
    stall_torque: float
    stall_current: float
    no_load_speed: float


# Source: e-manual, specifications of each model, at the voltage in the comment.
MODELS: dict[str, Model] = {
    "XL330-M077": Model(1190, 0.001, 0.215, 1.47, 383),  # 5 V
    "XL330-M288": Model(1200, 0.001, 0.52, 1.47, 103),
    "XC330-M181": Model(1230, 0.001, 0.60, 1.80, 129),
    "XC330-M288": Model(1240, 0.001, 0.93, 1.80, 81),
    "XC330-T181": Model(1210, 0.001, 0.80, 0.88, 113),  # 12 V from here on
    "XC330-T288": Model(1220, 0.001, 1.00, 0.88, 71),
    "XL430-W250": Model(1060, 0.0, 1.5, 1.4, 61),
    "XC430-W150": Model(1070, 0.0, 1.6, 1.4, 106),
    "XC430-W240": Model(1080, 0.0, 1.9, 1.4, 70),
    "XM430-W210": Model(1030, 0.00269, 3.0, 2.3, 77),
    "XM430-W350": Model(1020, 0.00269, 4.1, 2.3, 46),
    "XM540-W150": Model(1130, 0.00269, 7.3, 4.4, 53),
    "XM540-W270": Model(1120, 0.00269, 10.6, 4.4, 30),
    "XH430-W210": Model(1010, 0.00269, 2.5, 1.3, 50),
    "XH430-W350": Model(1000, 0.00269, 3.4, 1.3, 30),
    "XW540-T140": Model(1180, 0.00269, 6.9, 4.9, 72),
    "XW540-T260": Model(1170, 0.00269, 9.5, 4.9, 40),
    "MX-28": Model(30, 0.0, 2.5, 1.4, 55),  # MX: firmware 2.0
    "MX-64": Model(311, 0.00336, 6.0, 4.1, 63),
    "MX-106": Model(321, 0.00336, 8.4, 5.2, 45),
}


class Register(NamedTuple):
    """An item of the control table. Values outside ``low`` to ``high`` are refused by the servo."""

    address: int
    size: int
    low: int = 0
    high: int = -1  # -1: read-only
    default: int = 0


RAM = 64  # first address that can be written while torque is on
INDIRECT_ADDRESS, INDIRECT_DATA = 168, 224  # of the first indirect register: 2 bytes of address, 1 byte of data
INDIRECT_COUNT = 20  # what the smallest models have

REGISTERS: dict[str, Register] = {
    "MODEL": Register(0, 2),
    "FIRMWARE": Register(6, 1, default=45),
    "ID": Register(7, 1, 0, ID_MAX),
    "BAUD": Register(8, 1, 0, 7, 1),
    "RETURN_DELAY": Register(9, 1, 0, 254, 250),  # 2 us
    "DRIVE_MODE": Register(10, 1, 0, 13),
    "OPERATING_MODE": Register(11, 1, 0, 16, 3),
    "SHADOW_ID": Register(12, 1, 0, 255, 255),
    "HOMING_OFFSET": Register(20, 4, -1_044_479, 1_044_479),
    "TEMPERATURE_LIMIT": Register(31, 1, 0, 100, 80),  # deg C
    "PWM_LIMIT": Register(36, 2, 0, PWM_MAX, PWM_MAX),
    "CURRENT_LIMIT": Register(38, 2, 0, 2047, 1193),
    "VELOCITY_LIMIT": Register(44, 4, 0, 2047, 200),
    "POSITION_MAX": Register(48, 4, 0, TICKS - 1, TICKS - 1),
    "POSITION_MIN": Register(52, 4, 0, TICKS - 1, 0),
    "SHUTDOWN": Register(63, 1, 0, 63, 52),  # errors that switch torque off until a reboot
    "TORQUE_ENABLE": Register(64, 1, 0, 1),
    "LED": Register(65, 1, 0, 1),
    "STATUS_RETURN_LEVEL": Register(68, 1, 0, 2, 2),
    "HARDWARE_ERROR": Register(70, 1),
    "POSITION_D_GAIN": Register(80, 2, 0, GAIN_MAX),
    "POSITION_I_GAIN": Register(82, 2, 0, GAIN_MAX),
    "POSITION_P_GAIN": Register(84, 2, 0, GAIN_MAX, 800),
    "BUS_WATCHDOG": Register(98, 1, 0, 127),
    "GOAL_PWM": Register(100, 2, -PWM_MAX, PWM_MAX, PWM_MAX),
    "GOAL_CURRENT": Register(102, 2, -2047, 2047, 1193),
    "GOAL_VELOCITY": Register(104, 4, -2047, 2047),
    "PROFILE_ACCELERATION": Register(108, 4, 0, 32767),
    "PROFILE_VELOCITY": Register(112, 4, 0, 32767),
    "GOAL_POSITION": Register(116, 4, -EXTENDED_MAX, EXTENDED_MAX),
    "REALTIME_TICK": Register(120, 2),  # ms
    "PRESENT_CURRENT": Register(126, 2),
    "PRESENT_VELOCITY": Register(128, 4),
    "PRESENT_POSITION": Register(132, 4),
    "PRESENT_VOLTAGE": Register(144, 2),  # 0.1 V
    "PRESENT_TEMPERATURE": Register(146, 1),  # deg C
    "INDIRECT": Register(INDIRECT_ADDRESS, 2 * INDIRECT_COUNT, 0, 2 ** (16 * INDIRECT_COUNT)),  # all addresses at once
}

# What indirect registers gather: the goal of a tick, and behind it the state that is read back.
GOAL = ("POSITION_P_GAIN", "GOAL_POSITION")
STATE = ("TORQUE_ENABLE", "HARDWARE_ERROR", "BUS_WATCHDOG", "PRESENT_CURRENT", "PRESENT_VELOCITY", "PRESENT_POSITION",
         "PRESENT_TEMPERATURE")  # fmt: skip
GOAL_SIZE = sum(REGISTERS[name].size for name in GOAL)
STATE_SIZE = sum(REGISTERS[name].size for name in STATE)
GOAL_AT, STATE_AT = INDIRECT_DATA, INDIRECT_DATA + GOAL_SIZE
MAPPED = [a for name in GOAL + STATE for a in range(REGISTERS[name].address, sum(REGISTERS[name][:2]))]
INDIRECT_VALUE = int.from_bytes(np.array(MAPPED, "<u2").tobytes(), "little")
assert len(MAPPED) == INDIRECT_COUNT

GOAL_ITEM = np.dtype([("id", "u1"), ("p_gain", "<u2"), ("position", "<i4")])
STATE_FIELDS = [("torque_enable", "u1"), ("error", "u1"), ("watchdog", "u1"), ("current", "<i2"), ("velocity", "<i4"),
                ("position", "<i4"), ("temperature", "u1")]  # fmt: skip
STATE_ITEM = np.dtype(STATE_FIELDS)
TAIL_SIZE = STATE_SIZE + 3  # bytes of a status packet from its error byte on: that, the state, the CRC
STATUS = np.dtype(
    {
        "names": ["head", "tail", "state"],  # the state is in the tail
        "formats": ["<u8", ("u1", (TAIL_SIZE,)), STATE_ITEM],
        "offsets": [0, 8, 9],
        "itemsize": 8 + TAIL_SIZE,
    }
)
FAST_ITEM = np.dtype([("alert", "u1"), ("id", "u1"), ("state", STATE_ITEM), ("crc", "<u2")])
_TAIL_PLACES = (np.arange(TAIL_SIZE) * 256)[:, None]
BAUD_RATES = {0: 9600, 1: 57600, 2: 115200, 3: 1_000_000, 4: 2_000_000, 5: 3_000_000, 6: 4_000_000, 7: 4_500_000}
FIRMWARE_MIN = 38  # the first with a bus watchdog


@cache
def _tail_table() -> np.ndarray:
    """The rows of the CRC table for what follows the head of a STATUS, and for its CRC the bytes themselves: over a good
    one, all entries together are what its head adds to the CRC."""
    rows = crc_table().reshape(-1, 256)[-(STATE_SIZE + 1) :]
    crc = np.array([np.arange(256), np.arange(256) << 8], np.uint16)
    return np.concatenate([rows, crc]).reshape(-1)


# -- units -----------------------------------------------------------------------------------------------------------


def gain_scale(model: Model) -> float:
    """P gain per N m/rad."""
    return GAIN_UNIT * PWM_MAX * TICK / model.stall_torque


def damping_of(model: Model) -> float:
    """N m s/rad of a servo whose torque is on: its back-EMF at nominal voltage."""
    return model.stall_torque / (model.no_load_speed * 2 * np.pi / 60)


def torque_scale(model: Model) -> float:
    """N m per unit of PRESENT_CURRENT (of PRESENT_LOAD, where the model has no current sensor)."""
    return model.current * model.stall_torque / model.stall_current or LOAD_UNIT * model.stall_torque


def watchdog_ticks(seconds: float) -> int:
    """Value of BUS_WATCHDOG for ``seconds``, rounded down, at least one tick: 0 would switch it off."""
    return min(127, max(1, int(seconds / WATCHDOG_UNIT + 1e-9)))


# -- the host's side -------------------------------------------------------------------------------------------------


class DynamixelCodec:
    """Packets for the servos of one bus, and what their answers say (a ``serial_bus.SerialCodec``)."""

    # Bits of one servo's share of a tick, ten a byte: its goal, its place in the request, its answer; and the packets
    # around these. Worst: every third byte of the payloads calls for stuffing.
    TICK_BITS = (
        10.0 * (GOAL_ITEM.itemsize + 1 + STATUS.itemsize),
        10.0 * (GOAL_ITEM.itemsize + 1 + STATUS.itemsize + 6),
    )
    TICK_OVERHEAD_BITS = 10.0 * 2 * (OVERHEAD + 4)
    IDENTITY = ("MODEL", "FIRMWARE")  # there is no serial number: a servo of the same make passes for another
    TURN = 2 * np.pi
    ERROR_REGISTER = "HARDWARE_ERROR"
    HAS_FAST_READ = True

    def __init__(self, spec: BusSpec) -> None:
        """Raises BusError for an unknown model, an id that cannot be, or a bit rate that no servo has."""
        self._spec = spec
        self.models = models_of(spec)
        self.ids = _ids_of(spec)
        n = len(self.ids)
        self.checks = _checks(spec, self.models)
        self.rejected = 0  # answers that failed a check, or came from nobody on this bus
        self._row_of = np.full(256, -1, np.intp)
        self._row_of[self.ids] = np.arange(n)
        self._gain = np.array([gain_scale(m) for m in self.models])
        # Of position, velocity and current, (3, n): what is read at 0 rad, rad/s and N m, and what a unit is.
        self._zeros = np.array([[float(ZERO)] * n, [0.0] * n, [0.0] * n])
        self._units = np.array([[TICK] * n, [VELOCITY_UNIT] * n, [torque_scale(m) for m in self.models]])
        self._low, self._high = np.zeros(n), np.full(n, TICKS - 1.0)
        self._parser = Parser()
        head = np.array([GOAL_AT, GOAL_SIZE], "<u2").tobytes()
        length = 3 + len(head) + n * GOAL_ITEM.itemsize
        prefix = HEADER + bytes([BROADCAST]) + length.to_bytes(2, "little") + bytes([Instruction.SYNC_WRITE]) + head
        self._goal_packet = np.frombuffer(prefix + bytes(n * GOAL_ITEM.itemsize), np.uint8).copy()
        self._goals = self._goal_packet[len(prefix) :].view(GOAL_ITEM)
        self._goals["id"] = self.ids
        self._everyone = list(range(n))
        self._given = np.zeros((5, n))
        self._kp = b""  # that the gains in the packet are for
        self._request = b""  # the last one
        self._requested = b"", False  # the rows that it asks, as bytes; whether fast
        self._fast_rows = np.zeros(0, np.intp)  # these rows, in their order, if it is fast
        self._asked = self._fast_rows  # if it is plain
        self._answered = 0  # of these
        self._in_order = False  # they are 0, 1, 2, ...
        heads = [HEADER + bytes([id, STATE_SIZE + 4, 0, Instruction.STATUS]) for id in self.ids.tolist()]
        self._all_heads = np.frombuffer(b"".join(heads), "<u8")
        self._all_head_crcs = np.array([crc16(head + bytes(STATE_SIZE + 1)) for head in heads], np.uint16)
        self._heads, self._head_crcs = self._all_heads[:0], self._all_head_crcs[:0]

    # -- to the servos -----------------------------------------------------------------------------------------------

    def pack_wake(self) -> bytes:
        """Torque off, and answers to what will be asked."""
        return self.pack_disable() + self.pack_write("STATUS_RETURN_LEVEL", [2] * len(self.ids))

    def pack_command(self, command: MotorCommand) -> bytes:
        """P gains and goal positions of all servos in one sync write. Saturates at the ranges of gain and position;
        raises ValueError for a value not finite."""
        c, given = command, self._given
        given[0], given[1], given[2], given[3], given[4] = c.position, c.velocity, c.kp, c.kd, c.torque
        if np.count_nonzero(np.isfinite(given)) < given.size:
            raise ValueError(
                f"bus {self._spec.name}: got a command that is not finite, expected numbers; nothing was sent"
            )
        position = c.position
        if np.count_nonzero(c.velocity) or np.count_nonzero(c.torque):
            with np.errstate(over="ignore"):
                shift = np.divide(c.kd * c.velocity + c.torque, c.kp, out=np.zeros(len(self.ids)), where=c.kp > 0)
                position = position + shift
        if (kp := c.kp.tobytes()) != self._kp:
            self._kp = kp
            self._goals["p_gain"] = np.clip(np.rint(c.kp * self._gain), 0, GAIN_MAX)
        ticks = np.rint(position * (1.0 / TICK) + ZERO)
        self._goals["position"] = np.maximum(np.minimum(ticks, self._high), self._low)
        return self._sealed(self._goal_packet)

    def pack_request(self, rows: np.ndarray, fast: bool = False) -> bytes:
        """Ask the servos ``rows`` for their state, in this order."""
        self._answered = 0
        if (requested := (rows.tobytes(), fast)) != self._requested:
            self._requested = requested
            self._request = pack_sync_read(self.ids[rows].tobytes(), STATE_AT, STATE_SIZE, fast)
            asked = rows.copy()  # the caller may change its own
            self._fast_rows, self._asked = (asked, asked[:0]) if fast else (asked[:0], asked)
            self._heads, self._head_crcs = self._all_heads[self._asked], self._all_head_crcs[self._asked]
            self._in_order = rows.tolist() == self._everyone
        return self._request

    def reply_size(self, n: int, fast: bool = False) -> int:
        """Bytes that ``n`` servos answer to that, without stuffing."""
        return 8 + n * FAST_ITEM.itemsize if fast else n * STATUS.itemsize

    def pack_enable(self, state: MotorState) -> bytes:
        """Reset and start every watchdog, set the goal to where each servo stands with a gain of 0, torque on."""
        n = len(self.ids)
        here = np.nan_to_num(state.position)
        hold = self.pack_command(MotorCommand(here, np.zeros(n), np.zeros(n), np.zeros(n), np.zeros(n)))
        return (
            self.pack_write("BUS_WATCHDOG", [0] * n)
            + self.pack_write("BUS_WATCHDOG", [watchdog_ticks(self._spec.watchdog)] * n)
            + hold
            + self.pack_write("TORQUE_ENABLE", [1] * n)
        )

    def pack_disable(self) -> bytes:
        return self.pack_write("TORQUE_ENABLE", [0] * len(self.ids))

    def pack_recover(self, state: MotorState) -> bytes:
        """What a poll does besides asking: a watchdog that tripped and whose servo is off is started again, for what it
        complains of is over once it is polled."""
        rows = np.flatnonzero((state.error & TRIPPED != 0) & ~state.enabled)
        if not len(rows):
            return b""
        zero, ticks = [0] * len(rows), [watchdog_ticks(self._spec.watchdog)] * len(rows)
        off = self.pack_write("TORQUE_ENABLE", zero, rows)  # it holds its position until then
        return off + self.pack_write("BUS_WATCHDOG", zero, rows) + self.pack_write("BUS_WATCHDOG", ticks, rows)

    def pack_reboot(self, row: int) -> bytes:
        """Clears a hardware error; takes about 0.3 s, and the RAM half of the control table is gone."""
        return pack(int(self.ids[row]), Instruction.REBOOT)

    def pack_read(self, register: str, rows: np.ndarray) -> bytes:
        """Ask the servos ``rows`` for a register."""
        r = REGISTERS[register]
        return pack_sync_read(self.ids[rows].tobytes(), r.address, r.size)

    def pack_write(self, register: str, values: Sequence[int], rows: np.ndarray | None = None) -> bytes:
        """Write ``values`` to a register of the servos ``rows`` (None: all). Nobody answers."""
        r = REGISTERS[register]
        ids = self.ids if rows is None else self.ids[rows]
        mask = (1 << 8 * r.size) - 1
        items = [bytes([i]) + (v & mask).to_bytes(r.size, "little") for i, v in zip(ids.tolist(), values, strict=True)]
        return pack_sync_write(r.address, b"".join(items), r.size)

    def _sealed(self, packet: np.ndarray) -> bytes:
        raw = packet.tobytes()
        if raw.find(STUFFED, 7) >= 0:
            return pack(raw[4], raw[7], raw[8:])
        return raw + crc16(packet).to_bytes(2, "little")

    # -- from the servos ---------------------------------------------------------------------------------------------

    def unpack(self, data: bytes, state: MotorState, now: float) -> int:
        """Put the states among ``data`` into ``state``; an incomplete packet waits for the next call. Returns how many
        servos answered; ``rejected`` counts what was no good."""
        if rest := self._parser.pending:  # bytes come in pieces; put back together, they nearly always are regular
            self._parser.clear()
            data = rest + data
        whole = len(data) - len(data) % STATUS.itemsize
        if not whole or not self._unpack_regular(data[:whole], state, now):
            return self._unpack_any(data, state, now)
        if whole < len(data):
            return whole // STATUS.itemsize + self._unpack_any(data[whole:], state, now)
        return whole // STATUS.itemsize

    def _unpack_regular(self, data: bytes, state: MotorState, now: float) -> bool:
        """The same if ``data`` are the next answers to the last request, undamaged and without stuffing, as nearly
        always; else do nothing."""
        status = np.frombuffer(data, STATUS)
        n = len(status)
        at = slice(self._answered, self._answered + n)
        rows = self._asked[at]
        if len(rows) < n or status["head"].tobytes() != self._heads[at].tobytes():
            return False
        crcs = np.bitwise_xor.reduce(_tail_table()[status["tail"].T + _TAIL_PLACES], axis=0)
        if crcs.tobytes() != self._head_crcs[at].tobytes():
            return False
        self._answered += n
        self._store(at if self._in_order else rows, status["state"], state, now)
        return True

    def _unpack_any(self, data: bytes, state: MotorState, now: float) -> int:
        bad, found, items = self._parser.rejected, [], []
        for p in self._parser.feed(data):
            if p.instruction != Instruction.STATUS:
                continue  # an adapter's echo of what was sent
            if p.id == BROADCAST:
                rows, blocks = self._split_fast(p.parameters)
                found += rows
                items += blocks
            elif (row := int(self._row_of[p.id])) >= 0 and len(p.parameters) == STATE_SIZE + 1:
                found.append(row)
                items.append(p.parameters[1:])
            else:
                self.rejected += 1
        self.rejected += self._parser.rejected - bad
        if found:
            rows = slice(len(found)) if found == self._everyone else np.array(found)
            self._store(rows, np.frombuffer(b"".join(items), STATE_ITEM), state, now)
        return len(found)

    def _split_fast(self, parameters: bytes) -> tuple[list[int], list[bytes]]:
        """Rows and states in a whole fast answer: [error, id, state, CRC] of each servo, the last CRC being the packet's.
        Whether servos stuff inside is not documented: a length as if not is taken as not."""
        size, n = FAST_ITEM.itemsize, len(self._fast_rows)
        if len(parameters) != n * size - 2:
            parameters = unstuff(parameters)
        if not n or len(parameters) != n * size - 2:
            self.rejected += 1
            return [], []
        items = np.frombuffer(parameters + b"\0\0", FAST_ITEM)
        rows = self._row_of[items["id"]]
        if not np.array_equal(rows, self._fast_rows):
            self.rejected += 1
            return [], []
        return rows.tolist(), [items["state"].tobytes()]

    def _split_fast_prefix(self, raw: bytes) -> tuple[list[int], list[bytes]]:
        """The same of one that broke off because a servo in the middle is silent: those whose running CRC is right."""
        size, rows, blocks = FAST_ITEM.itemsize, [], []
        for k, row in enumerate(self._fast_rows.tolist()):
            end = 8 + (k + 1) * size
            item = raw[end - size : end]
            if len(raw) < end or item[1] != self.ids[row] or crc16(raw[: end - 2]) != item[-2] | item[-1] << 8:
                break
            rows.append(row)
            blocks.append(item[2:-2])
        return rows, blocks

    def _store(self, rows: np.ndarray | slice, item: np.ndarray, state: MotorState, now: float) -> None:
        readings = np.empty((3, len(item)))
        readings[0], readings[1], readings[2] = item["position"], item["velocity"], item["current"]
        readings -= self._zeros[:, rows]
        readings *= self._units[:, rows]
        state.position[rows], state.velocity[rows], state.torque[rows] = readings[0], readings[1], readings[2]
        state.temperature[rows] = item["temperature"]
        state.error[rows] = item["error"]
        state.enabled[rows] = item["torque_enable"] == 1
        state.time[rows] = now
        if WATCHDOG_TRIPPED in item["watchdog"].tobytes():
            tripped = item["watchdog"] == WATCHDOG_TRIPPED
            state.error[rows] += TRIPPED * tripped
            state.enabled[rows] &= ~tripped

    def unpack_register(self, register: str, data: bytes) -> list[tuple[int, int]]:
        """Answers (row, value) to ``pack_read`` of that register among ``data``."""
        r = REGISTERS[register]
        answers = []
        for p in self._parser.feed(data):
            row = int(self._row_of[p.id])
            if p.instruction == Instruction.STATUS and row >= 0 and len(p.parameters) == r.size + 1:
                answers.append((row, int.from_bytes(p.parameters[1:], "little", signed=r.low < 0)))
        return answers

    def finish(self, state: MotorState, now: float) -> int:
        """No more answers will come to the last request: take from a fast one that broke off what it says, and forget
        the rest. ``now``: when the last bytes came. Returns how many servos answered."""
        rows, items = self._split_fast_prefix(self._parser.pending)
        self._parser.clear()
        if rows:
            self._store(np.array(rows), np.frombuffer(b"".join(items), STATE_ITEM), state, now)
        return len(rows)

    def configure(self, values: dict[str, list[int]]) -> None:
        """Take over what the servos' registers said while connecting: goals outside their position limits would be
        ignored without a word, so they saturate here."""
        extended = np.array(values["OPERATING_MODE"]) == 4
        self._low = np.where(extended, -EXTENDED_MAX, values["POSITION_MIN"]).astype(float)
        self._high = np.where(extended, EXTENDED_MAX, values["POSITION_MAX"]).astype(float)

    def error_name(self, code: int) -> str:
        names = [name for bit, name in HARDWARE_ERRORS.items() if code & bit]
        rest = code & ~sum(HARDWARE_ERRORS)
        return ", ".join(names + [f"unknown error {rest:#x}"] * bool(rest)) or "none"


def models_of(spec: BusSpec) -> list[Model]:
    """Rows of MODELS of a bus. Raises BusError for a model that is not there."""
    for m in spec.motors:
        if m.model not in MODELS:
            close = difflib.get_close_matches(m.model, MODELS, n=1)
            hint = f" (did you mean '{close[0]}'?)" if close else ""
            raise BusError(
                f"bus {spec.name}, motor of {m.joint} (id {m.id}): no Dynamixel model '{m.model}'{hint}; known: "
                f"{', '.join(MODELS)}.\n  Add its row to MODELS in drivers/codecs/dynamixel.py"
            )
    return [MODELS[m.model] for m in spec.motors]


def _ids_of(spec: BusSpec) -> np.ndarray:
    taken: dict[int, str] = {}
    for m in spec.motors:
        where = f"bus {spec.name}, motor of {m.joint}: got id {m.id}"
        if not 0 <= m.id <= ID_MAX:
            raise BusError(f"{where}, expected 0 to {ID_MAX}")
        if m.id in taken:
            raise BusError(f"{where}, which the motor of {taken[m.id]} has too: give it one of its own")
        taken[m.id] = m.joint
    return np.array(list(taken), np.uint8)


def _checks(spec: BusSpec, models: list[Model]) -> list[RegisterCheck]:
    """What connecting reads, writes and compares, in this order."""
    baud = [code for code, rate in BAUD_RATES.items() if rate == spec.bitrate]
    if not baud:
        rates = ", ".join(map(str, BAUD_RATES.values()))
        raise BusError(f"bus {spec.name}: got {spec.bitrate} bit/s, expected a rate that servos have: {rates}")
    if spec.watchdog < WATCHDOG_UNIT:
        raise BusError(f"bus {spec.name}: got a watchdog of {spec.watchdog:g} s, expected at least {WATCHDOG_UNIT:g} s")
    numbers, ticks = [m.number for m in models], watchdog_ticks(spec.watchdog)
    wizard = "set it with DYNAMIXEL Wizard while torque is off"
    return [
        RegisterCheck(
            "TORQUE_ENABLE", 0, 0, "does another program command it? Stop that, and connect again", write=True
        ),
        RegisterCheck("STATUS_RETURN_LEVEL", 2, 2, "the servo would not answer reads", write=True),
        RegisterCheck("MODEL", numbers, numbers, "put the servo's model into the wiring"),
        RegisterCheck("FIRMWARE", FIRMWARE_MIN, 255, "no bus watchdog: update the firmware"),
        RegisterCheck("BAUD", baud[0], baud[0], f"the bus runs at {spec.bitrate} bit/s: {wizard}"),
        RegisterCheck("RETURN_DELAY", 0, 0, f"each answer would come units of 2 us late: {wizard}"),
        RegisterCheck("DRIVE_MODE", 0, 0, f"reversed or time-based profiles would falsify targets: {wizard}"),
        RegisterCheck("OPERATING_MODE", 3, 4, f"position (3) or extended position (4): {wizard}"),
        RegisterCheck("POSITION_MIN", 0, TICKS - 1, "outside a turn"),
        RegisterCheck("POSITION_MAX", 0, TICKS - 1, "outside a turn"),
        RegisterCheck(
            "INDIRECT", INDIRECT_VALUE, INDIRECT_VALUE, "no indirect addressing: update the firmware", write=True
        ),
        RegisterCheck("PROFILE_ACCELERATION", 0, 0, "targets would be smoothed", write=True),
        RegisterCheck("PROFILE_VELOCITY", 0, 0, "targets would be smoothed", write=True),
        RegisterCheck("POSITION_D_GAIN", 0, 0, "see the docstring of drivers/codecs/dynamixel.py", write=True),
        RegisterCheck("POSITION_I_GAIN", 0, 0, "targets would be overshot", write=True),
        RegisterCheck("BUS_WATCHDOG", ticks, ticks, "the servo would not stop by itself", write=True),
    ]
