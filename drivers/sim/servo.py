"""Emulated Dynamixel servos: what is behind the connector, decoded with the same codec as the host's side.

Each is a state machine over its control table (servo_table.py): EEPROM that is locked while torque is on, indirect
registers, operating modes, a bus watchdog that any instruction feeds, hardware errors with their shutdown and reboot, a
count of turns that does not survive power.

The law is that of the codec's docstring: duty cycle from the position error by the P gain, torque from duty cycle and
back-EMF at nominal voltage. Not modelled: D, I and feed-forward gains, profiles, the current loop's bandwidth, cogging,
backlash, supply voltage, torque that saturates between substeps (what limits is the sum of drive and back-EMF).
Velocity mode is a stiff damper towards its goal, for the gains' units are not published.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from functools import cache
from typing import Any

import numpy as np

from drivers.bus import BusError, BusSpec
from drivers.codecs import dynamixel
from drivers.codecs.dynamixel import (
    ALERT,
    INDIRECT_ADDRESS,
    INDIRECT_DATA,
    RAM,
    REGISTERS,
    TICK,
    ZERO,
    Register,
    StatusError,
)
from drivers.codecs.dynamixel_packet import BROADCAST, HEADER, Instruction, Packet, Parser, crc16, pack_status
from drivers.sim.motor import Body, MotorEvent
from drivers.sim.servo_table import Answer, TableServos, to_bytes

TABLE_SIZE = 256
GOALS = range(100, 120)  # read-only once the watchdog has tripped
WATCHDOG = REGISTERS["BUS_WATCHDOG"].address
VOLTAGE = 120  # 0.1 V
OVERHEATING = 0x04
CLEAR_TURNS = bytes([0x01, 0x44, 0x58, 0x4C, 0x22])  # parameters of CLEAR: the count of turns
VELOCITY_STIFFNESS = 10.0  # times the back-EMF, in velocity mode

CURRENT_MODE, VELOCITY_MODE, POSITION_MODE, EXTENDED_MODE, CURRENT_POSITION_MODE, PWM_MODE = 0, 1, 3, 4, 5, 16
DRIVEN_BY = {CURRENT_MODE: "GOAL_CURRENT", VELOCITY_MODE: "GOAL_VELOCITY", PWM_MODE: "GOAL_PWM"}  # 0 at torque-on


class SimServos(TableServos):
    """The servos of one bus, on the joints of ``body`` (which has the same order).

    ``registers``: by joint, what differs from the factory. Id, bit rate and model are the wiring's, and the return delay
    is 0, as ``sim2real setup`` would leave it. ``fast``: the firmware knows fast reads. ``patient``: a servo whose
    predecessor in a group read stays silent answers all the same; else it never does.
    """

    BAUD_RATES = dynamixel.BAUD_RATES

    def __init__(
        self,
        spec: BusSpec,
        body: Body,
        *,
        registers: Mapping[str, Mapping[str, int]] | None = None,
        fast: bool = True,
        patient: bool = False,
        log: list[MotorEvent] | None = None,
    ):
        models = dynamixel.models_of(spec)
        super().__init__(spec, body, np.array([m.stall_torque for m in models]), TABLE_SIZE, log)
        n = len(models)
        self.fast, self._patient = fast, patient
        self._damping = np.array([dynamixel.damping_of(m) for m in models])
        self._unit = np.array([dynamixel.torque_scale(m) for m in models])
        self._gain = np.array([dynamixel.gain_scale(m) for m in models])
        for row, (motor, model) in enumerate(zip(spec.motors, models, strict=True)):
            own = {"MODEL": model.number, "ID": motor.id, "BAUD": self._baud(1), "RETURN_DELAY": 0}
            for name, register in REGISTERS.items():
                self._set(row, name, own.get(name, register.default))
        for joint, changes in (registers or {}).items():
            if joint not in self.joints:
                raise BusError(f"registers: got joint '{joint}', expected one of {', '.join(self.joints)}")
            for name, value in changes.items():
                self._set(self.joints.index(joint), name, value)
        self._factory = self._table.copy()
        self._turns = np.zeros(n)  # ticks that the count is off the shaft's
        self._fed = -np.inf  # s, when an instruction packet last ended
        self._readdress()
        for row in range(n):
            self._lose_turns(row)

    # -- packets -----------------------------------------------------------------------------------------------------

    def parser(self) -> Parser:
        return Parser()

    def retell(self, answer: bytes, change: Callable[[bytearray], None]) -> bytes:
        said = Parser().feed(answer)
        if not said or said[0].id == BROADCAST:  # of all servos at once
            return answer
        payload = bytearray(said[0].parameters)
        change(payload)
        return pack_status(said[0].id, payload[0], bytes(payload[1:]))

    def receive(self, packet: Packet, time: float) -> list[Answer]:
        if packet.instruction == Instruction.STATUS:
            return []
        self._fed = time
        act: Any = self._ACTIONS.get(packet.instruction)
        if act is None:
            rows = self._addressed(packet.id, time) if packet.id != BROADCAST else []
            answers = [self._answer(row, StatusError.INSTRUCTION) for row in rows]
        else:
            answers = list(act(self, packet, time))
        return [answer for answer in answers if answer is not None]

    def _ping(self, packet: Packet, time: float) -> Iterator[Answer | None]:
        for row in self._addressed(packet.id, time):
            yield self._answer(row, 0, bytes(self._table[row, [0, 1, 6]]), level=0)

    def _read_one(self, packet: Packet, time: float) -> Iterator[Answer | None]:
        if len(packet.parameters) != 4:
            yield from self._refuse(packet, time, StatusError.DATA_LENGTH)
            return
        address, size = np.frombuffer(packet.parameters, "<u2").tolist()
        if packet.id != BROADCAST:
            for row in self._addressed(packet.id, time):
                data = self._read([row], address, size)
                yield self._answer(row, StatusError.DATA_RANGE if data is None else 0, b"" if data is None else data[0])

    def _write_one(self, packet: Packet, time: float) -> Iterator[Answer | None]:
        if len(packet.parameters) < 3:
            yield from self._refuse(packet, time, StatusError.DATA_LENGTH)
            return
        address = int.from_bytes(packet.parameters[:2], "little")
        for row in self._addressed(packet.id, time):
            error = StatusError.NONE
            if packet.instruction == Instruction.REG_WRITE:
                self._registered[row] = (address, packet.parameters[2:])
            else:
                error = self._write(row, address, packet.parameters[2:], time)
            if packet.id != BROADCAST:
                yield self._answer(row, error, level=2)

    def _action(self, packet: Packet, time: float) -> Iterator[Answer | None]:
        for row in self._addressed(packet.id, time):
            error = StatusError.RESULT_FAIL
            if row in self._registered:
                error = self._write(row, *self._registered.pop(row), time)
            if packet.id != BROADCAST:
                yield self._answer(row, error, level=2)

    def _reboot(self, packet: Packet, time: float) -> Iterator[Answer | None]:
        for row in self._addressed(packet.id, time):
            if packet.id != BROADCAST:
                yield self._answer(row, 0, level=2)
            self._restart(row, time, "rebooted")

    def _clear(self, packet: Packet, time: float) -> Iterator[Answer | None]:
        for row in self._addressed(packet.id, time):
            done = packet.parameters == CLEAR_TURNS and not self._get(row, "TORQUE_ENABLE")
            if done:
                self._lose_turns(row)
            if packet.id != BROADCAST:
                yield self._answer(row, StatusError.NONE if done else StatusError.RESULT_FAIL, level=2)

    def _read_group(self, packet: Packet, time: float) -> Iterator[Answer | None]:
        p, fast = packet.parameters, packet.instruction in (Instruction.FAST_SYNC_READ, Instruction.FAST_BULK_READ)
        if packet.instruction in (Instruction.SYNC_READ, Instruction.FAST_SYNC_READ):
            address, size = int.from_bytes(p[:2], "little"), int.from_bytes(p[2:4], "little")
            asked = [(id, address, size) for id in p[4:]]
        else:
            item = np.dtype([("id", "u1"), ("address", "<u2"), ("size", "<u2")])
            asked = np.frombuffer(p[: len(p) // 5 * 5], item).tolist()
        if fast:
            if self.fast and asked:
                yield self._answer_fast(asked, time)
            return
        same = len({a[1:] for a in asked}) == 1
        rows = [row for id, _, _ in asked for row in self._addressed(id, time)]
        block = self._read(rows, *asked[0][1:]) if same and rows else None
        at = 0
        for id, address, size in asked:
            if not (found := self._addressed(id, time)):
                if self._patient:
                    continue
                return
            data = [block[at]] if block is not None else self._read(found, address, size)
            at += 1
            yield self._answer(
                found[0], StatusError.DATA_RANGE if data is None else 0, b"" if data is None else data[0]
            )

    def _answer_fast(self, asked: list[tuple[int, int, int]], time: float) -> Answer | None:
        """One status packet from all; a silent servo ends it there."""
        length = 1 + sum(size + 4 for _, _, size in asked)
        raw = HEADER + bytes([BROADCAST]) + length.to_bytes(2, "little") + bytes([Instruction.STATUS])
        first = -1
        for id, address, size in asked:
            rows = self._addressed(id, time)
            data = self._read(rows, address, size) if rows else None
            if data is None:
                break
            first = rows[0] if first < 0 else first
            raw += bytes([self._alert(rows[0]), id]) + data[0]
            raw += crc16(raw).to_bytes(2, "little")
        return None if first < 0 else (first, self._delay(first), raw)

    def _write_group(self, packet: Packet, time: float) -> Iterator[Answer | None]:
        p = packet.parameters
        if packet.instruction == Instruction.SYNC_WRITE:
            address, size = int.from_bytes(p[:2], "little"), int.from_bytes(p[2:4], "little")
            items = [(p[at], address, p[at + 1 : at + 1 + size]) for at in range(4, len(p) - size, 1 + size)]
        else:
            items, at = [], 0
            while at + 5 <= len(p):
                size = int.from_bytes(p[at + 3 : at + 5], "little")
                items.append((p[at], int.from_bytes(p[at + 1 : at + 3], "little"), p[at + 5 : at + 5 + size]))
                at += 5 + size
        for id, address, data in items:
            for row in self._addressed(id, time):
                self._write(row, address, data, time)
        yield from ()

    _ACTIONS: dict[int, Callable] = {
        Instruction.PING: _ping,
        Instruction.READ: _read_one,
        Instruction.WRITE: _write_one,
        Instruction.REG_WRITE: _write_one,
        Instruction.ACTION: _action,
        Instruction.REBOOT: _reboot,
        Instruction.CLEAR: _clear,
        Instruction.SYNC_READ: _read_group,
        Instruction.FAST_SYNC_READ: _read_group,
        Instruction.BULK_READ: _read_group,
        Instruction.FAST_BULK_READ: _read_group,
        Instruction.SYNC_WRITE: _write_group,
        Instruction.BULK_WRITE: _write_group,
    }

    def _refuse(self, packet: Packet, time: float, error: StatusError) -> Iterator[Answer | None]:
        if packet.id != BROADCAST:
            for row in self._addressed(packet.id, time):
                yield self._answer(row, error)

    def _answer(self, row: int, error: int, data: bytes = b"", level: int = 1) -> Answer | None:
        """``level``: the lowest status return level at which this is answered."""
        if self._get(row, "STATUS_RETURN_LEVEL") < level:
            return None
        return row, self._delay(row), pack_status(self._get(row, "ID"), error | self._alert(row), data)

    def _alert(self, row: int) -> int:
        return ALERT if self._get(row, "HARDWARE_ERROR") else 0

    def _delay(self, row: int) -> float:
        return self._get(row, "RETURN_DELAY") * 2e-6

    # -- control table -----------------------------------------------------------------------------------------------

    def _get(self, row: int, name: str) -> int:
        r = REGISTERS[name]
        return int.from_bytes(self._table[row, r.address : r.address + r.size].tobytes(), "little", signed=r.low < 0)

    def _set(self, row: int, name: str, value: int) -> None:
        r = REGISTERS[name]
        raw = (value & (1 << 8 * r.size) - 1).to_bytes(r.size, "little")
        self._table[row, r.address : r.address + r.size] = np.frombuffer(raw, np.uint8)

    def _column(self, name: str) -> np.ndarray:
        """A register of all servos, as float."""
        r = REGISTERS[name]
        raw = np.ascontiguousarray(self._table[:, r.address : r.address + r.size])
        return raw.view(f"<{'i' if r.low < 0 else 'u'}{r.size}")[:, 0].astype(float)

    def _read(self, rows: list[int], address: int, size: int) -> list[bytes] | None:
        """``size`` bytes of each of ``rows`` from ``address`` on; None beyond the table."""
        if address + size > TABLE_SIZE:
            return None
        self._refresh()
        table = self._table[rows]
        return [
            row[list(_real(row[INDIRECT_ADDRESS:INDIRECT_DATA].tobytes(), address, size))].tobytes() for row in table
        ]

    def _write(self, row: int, address: int, data: bytes, time: float) -> StatusError:
        """All of ``data`` or, where any of it is refused, nothing."""
        if address + len(data) > TABLE_SIZE or not data:
            return StatusError.DATA_LENGTH
        table = self._table[row]
        real = _real(table[INDIRECT_ADDRESS:INDIRECT_DATA].tobytes(), address, len(data))
        names = _registers(real)
        if names is None:
            return StatusError.ACCESS
        after = table.copy()
        after[list(real)] = np.frombuffer(data, np.uint8)
        torque, tripped = table[RAM], table[WATCHDOG] == dynamixel.WATCHDOG_TRIPPED
        for name, r in names:
            locked = r.address < RAM or name == "INDIRECT"
            if r.high < 0 or (locked and torque):
                return StatusError.ACCESS
            value = int.from_bytes(after[r.address : r.address + r.size].tobytes(), "little", signed=r.low < 0)
            low, high = r.low, r.high
            if name == "GOAL_POSITION" and self._get(row, "OPERATING_MODE") == POSITION_MODE:
                low, high = self._get(row, "POSITION_MIN"), self._get(row, "POSITION_MAX")
            if not low <= value <= high or (tripped and r.address in GOALS):
                return StatusError.DATA_RANGE
        if any(name == "TORQUE_ENABLE" for name, _ in names) and after[RAM] and self._shut(row):
            return StatusError.RESULT_FAIL
        self._table[row] = after
        self._since[row] = time
        self._changed = self._stale = True
        for name, r in names:
            if name == "TORQUE_ENABLE" and bool(after[RAM]) != bool(torque):
                self._switch(row, bool(after[RAM]), time, "enabled" if after[RAM] else "disabled")
            elif name == "BUS_WATCHDOG" and tripped:
                self._note(time, row, "cleared")
            elif name in ("ID", "BAUD"):
                self._readdress()
            elif r.address in GOALS:
                self.last_command_time[row] = time
        return StatusError.NONE

    def _refresh(self) -> None:
        """Put what the servos measure now into their tables."""
        if not self._stale:
            return
        self._stale = False
        t = self._table
        t[:, 132:136] = to_bytes(self.position, "<i4")
        t[:, 128:132] = to_bytes(self._sign * self._body.joint_vel / dynamixel.VELOCITY_UNIT, "<i4")
        t[:, 126:128] = to_bytes(self._sign * self._body.joint_torque / self._unit, "<i2")
        t[:, 144:146] = to_bytes(np.full(len(t), VOLTAGE), "<u2")
        t[:, 146] = np.clip(self.temperature, 0, 255)

    @property
    def position(self) -> np.ndarray:
        """(n,) ticks as the servos count them."""
        shaft = (self._sign * self._body.joint_pos + self._offset) / TICK + ZERO
        return shaft + self._turns + self._column("HOMING_OFFSET")

    @property
    def enabled(self) -> np.ndarray:
        return (self._table[:, RAM] > 0) & np.array(self.powered)

    # -- time --------------------------------------------------------------------------------------------------------

    def _watch(self, now: float) -> None:
        ticks = self._table[:, WATCHDOG]
        running = (ticks > 0) & (ticks != dynamixel.WATCHDOG_TRIPPED) & (self._table[:, RAM] > 0)
        for row in np.flatnonzero(running & (now - self._fed >= ticks * dynamixel.WATCHDOG_UNIT)):
            self._set(int(row), "GOAL_POSITION", round(float(self.position[row])))
            self._table[row, WATCHDOG] = dynamixel.WATCHDOG_TRIPPED
            self._note(now, int(row), "watchdog")
            self._changed = True

    def _decide(self) -> np.ndarray:
        """The law (3, n) that goals and modes make: bias, kp, kd at the joints."""
        on = self.enabled
        mode = self._column("OPERATING_MODE")
        by_position = np.isin(mode, (POSITION_MODE, EXTENDED_MODE, CURRENT_POSITION_MODE))
        kp = np.where(by_position, self._column("POSITION_P_GAIN") / self._gain, 0.0)
        kd = self._damping * np.where(
            mode == CURRENT_MODE, 0.0, np.where(mode == VELOCITY_MODE, VELOCITY_STIFFNESS, 1.0)
        )
        goal = (
            self._column("GOAL_POSITION") - ZERO - self._turns - self._column("HOMING_OFFSET")
        ) * TICK - self._offset
        bias = kp * goal
        bias += (mode == PWM_MODE) * self._column("GOAL_PWM") / dynamixel.PWM_MAX * self._stall
        bias += (mode == CURRENT_MODE) * self._column("GOAL_CURRENT") * self._unit
        bias += (mode == VELOCITY_MODE) * kd * self._column("GOAL_VELOCITY") * dynamixel.VELOCITY_UNIT
        return np.array([self._sign * bias, kp, kd]) * on

    def _overheat(self, row: int, now: float) -> None:
        self.fail(self.joints[row], OVERHEATING, now)

    # -- state -------------------------------------------------------------------------------------------------------

    def fail(self, joint: str, error: int, time: float) -> None:
        """Give a servo a hardware error, a key of the codec's HARDWARE_ERRORS. If it is one of SHUTDOWN, torque goes off
        until a reboot."""
        row = self.joints.index(joint)
        if self._get(row, "HARDWARE_ERROR") & error:
            return
        self._set(row, "HARDWARE_ERROR", self._get(row, "HARDWARE_ERROR") | error)
        self._note(time, row, dynamixel.HARDWARE_ERRORS.get(error, f"error {error:#x}"))
        if self._shut(row) and self._get(row, "TORQUE_ENABLE"):
            self._switch(row, False, time, "shut down")

    def _restart(self, row: int, time: float, event: str) -> None:
        """EEPROM stays; RAM is the factory's; the count of turns is lost."""
        self._table[row, RAM:] = self._factory[row, RAM:]
        self._booting[row] = time + self.BOOT_TIME
        self._registered.pop(row, None)
        self._lose_turns(row)
        self._switch(row, False, time, event)

    def _lose_turns(self, row: int) -> None:
        self._turns[row] = 0.0
        self._turns[row] = -dynamixel.TICKS * np.floor(float(self.position[row]) / dynamixel.TICKS)
        self._stale = self._changed = True

    def _shut(self, row: int) -> bool:
        return bool(self._get(row, "HARDWARE_ERROR") & self._get(row, "SHUTDOWN"))

    def _switch(self, row: int, on: bool, time: float, event: str) -> None:
        self._table[row, RAM] = on
        if on:  # it stays where it is
            r, mode = REGISTERS["GOAL_POSITION"], self._get(row, "OPERATING_MODE")
            self._set(row, "GOAL_POSITION", min(r.high, max(r.low, round(float(self.position[row])))))
            if mode in DRIVEN_BY:
                self._set(row, DRIVEN_BY[mode], 0)
        self._since[row] = time
        self._stale = self._changed = True
        self._note(time, row, event)


@cache
def _real(indirect: bytes, address: int, size: int) -> tuple[int, ...]:
    """Addresses that ``size`` bytes from ``address`` on stand for, given the table of indirect addresses."""
    count = len(indirect) // 2
    target = np.frombuffer(indirect, "<u2").tolist()
    found = []
    for a in range(address, address + size):
        at = a - INDIRECT_DATA
        found.append(target[at] % TABLE_SIZE if 0 <= at < count and target[at] else a)
    return tuple(found)


@cache
def _registers(addresses: tuple[int, ...]) -> tuple[tuple[str, Register], ...] | None:
    """The registers that these bytes belong to; None if one belongs to none."""
    found: dict[str, Register] = {}
    for a in addresses:
        owner = next(((k, r) for k, r in REGISTERS.items() if r.address <= a < r.address + r.size), None)
        if owner is None:
            return None
        found[owner[0]] = owner[1]
    return tuple(found.items())
