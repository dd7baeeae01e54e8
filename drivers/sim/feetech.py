"""Emulated Feetech STS servos: state machines over their memory table (servo_table.py).

EEPROM that is kept only while the lock is open, a homing offset, single-turn positions that wrap, response levels, torque
limit, temperature and overload protection, 128 in TORQUE_ENABLE that makes here the middle. The overload protection is the
one of registers 34 to 36: a load above OVERLOAD_TORQUE for PROTECTION_TIME leaves PROTECTIVE_TORQUE, until the goal is on the
other side. There is no watchdog.

The law: the maker publishes no unit of its gains. Here full duty at P = 32 stands for 128 counts (11 degrees) of error, and
duty and back-EMF make torque as in any brushed motor, down to none at NO_LOAD_SPEED. For 12 V that is 15 N m/rad and
0.62 N m s/rad. Not modelled: D, I, dead band, minimum force, speed and acceleration limits of a move, step mode, supply
voltage, backlash, two servos with one id (one of them answers). A new id and a new bit rate are heard at once.

Source: Feetech, memory table of STS servos with magnetic encoder; what is not in it, by the maker's SCServo library.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping

import numpy as np

from drivers.bus import BusError, BusSpec
from drivers.codecs import feetech
from drivers.codecs.feetech import (
    BROADCAST,
    LOAD_UNIT,
    REGISTERS,
    TICK,
    TICKS,
    TORQUE_FULL,
    ZERO,
    Instruction,
    Packet,
    Parser,
    from_sign_magnitude,
    pack,
    to_sign_magnitude,
)
from drivers.sim.motor import Body, MotorEvent
from drivers.sim.servo_table import Answer, TableServos

TABLE_SIZE = 128
RAM = 40  # below it EEPROM
WRITABLE = range(5, 56)
NO_LOAD_SPEED = 45 / 60 * 2 * np.pi  # rad/s: 0.222 s for 60 degrees, maker's data sheets of both voltages
FULL_DUTY = 32 * 128  # P gain times counts of error
MIDDLE_HERE = 128  # in TORQUE_ENABLE
OFFSET_BIT, LOAD_BIT = 11, 10  # signs
OVERHEATING, OVERLOAD = 0x04, 0x20
POSITION_MODE, VELOCITY_MODE, PWM_MODE = 0, 1, 2
VELOCITY_STIFFNESS = 10.0  # times the back-EMF
VOLTAGE = {"7V4": 74}  # 0.1 V, by the end of a model's name; else 12 V
FACTORY = {
    "FIRMWARE": 9 << 8 | 3,  # 3.9
    "RESPONSE_LEVEL": 1,
    "POSITION_MAX": TICKS - 1,
    "TEMPERATURE_LIMIT": 70,
    "TORQUE_MAX": TORQUE_FULL,
    "UNLOADING": 0x2C,
    "P_GAIN": 32,
    "D_GAIN": 32,
    "PROTECTIVE_TORQUE": 20,
    "PROTECTION_TIME": 200,
    "OVERLOAD_TORQUE": 80,
    "TORQUE_LIMIT": TORQUE_FULL,
    "LOCK": 1,
}


class SimFeetech(TableServos):
    """The servos of one bus, on the joints of ``body`` (which has the same order).

    ``registers``: by joint, what differs from FACTORY. ``patient``: a servo whose predecessor in a group read stays silent
    answers all the same; else it never does (which of the two it is, is not published). ``fast``: they know none.
    """

    BAUD_RATES = feetech.BAUD_RATES

    def __init__(
        self,
        spec: BusSpec,
        body: Body,
        *,
        registers: Mapping[str, Mapping[str, int]] | None = None,
        fast: bool = False,
        patient: bool = False,
        log: list[MotorEvent] | None = None,
    ):
        models = feetech.models_of(spec)
        super().__init__(spec, body, np.array([m.stall_torque for m in models]), TABLE_SIZE, log)
        self._patient = patient
        self._volts = [VOLTAGE.get(m.model.rpartition("-")[2], 120) for m in spec.motors]
        for row, (motor, model) in enumerate(zip(spec.motors, models, strict=True)):
            own = {"MODEL": model.number, "ID": motor.id, "BAUD": self._baud(0)}
            for name, value in (FACTORY | own).items():
                self._set(row, name, value)
        for joint, changes in (registers or {}).items():
            if joint not in self.joints:
                raise BusError(f"registers: got joint '{joint}', expected one of {', '.join(self.joints)}")
            for name, value in changes.items():
                self._set(self.joints.index(joint), name, value)
        self._kept = self._table.copy()  # what a power cycle leaves
        self._readdress()
        self._overloaded = np.full(len(models), np.inf)  # s, since when; inf: is not
        self._side = np.zeros(len(models))  # of the goal, when the protection set in; 0: it has not
        self._turn = np.zeros(len(models))  # of the shaft, by which a position is less

    # -- packets -----------------------------------------------------------------------------------------------------

    def parser(self) -> Parser:
        return Parser()

    def retell(self, answer: bytes, change: Callable[[bytearray], None]) -> bytes:
        (said,) = Parser().feed(answer)
        payload = bytearray([said.instruction]) + said.parameters
        change(payload)
        return pack(said.id, payload[0], bytes(payload[1:]))

    def receive(self, packet: Packet, time: float) -> list[Answer]:
        return list(self._act_on(packet, time))

    def _act_on(self, packet: Packet, time: float) -> Iterator[Answer]:
        p, rows = packet.parameters, self._addressed(packet.id, time)
        alone = packet.id != BROADCAST
        match packet.instruction:
            case Instruction.PING if alone or len(rows) == 1:  # several at once garble each other
                for row in rows:
                    yield self._answer(row)
            case Instruction.READ if alone and len(p) == 2:
                for row in rows:
                    yield self._answer(row, self._read(row, p[0], p[1]))
            case Instruction.WRITE | Instruction.REG_WRITE if len(p) >= 2:
                for row in rows:
                    if packet.instruction == Instruction.REG_WRITE:
                        self._registered[row] = p[0], p[1:]
                    else:
                        self._write(row, p[0], p[1:], time)
                    if alone and self._get(row, "RESPONSE_LEVEL"):
                        yield self._answer(row)
            case Instruction.ACTION:
                for row in rows:
                    if row in self._registered:
                        self._write(row, *self._registered.pop(row), time)
                    if alone and self._get(row, "RESPONSE_LEVEL"):
                        yield self._answer(row)
            case Instruction.SYNC_READ if len(p) > 2:
                for id in p[2:]:
                    found = self._addressed(id, time) if id != BROADCAST else []
                    if not found and not self._patient:
                        return
                    for row in found:
                        yield self._answer(row, self._read(row, p[0], p[1]))
            case Instruction.SYNC_WRITE if len(p) > 2:
                for at in range(2, len(p) - p[1], 1 + p[1]):
                    for row in self._addressed(p[at], time):
                        self._write(row, p[0], p[at + 1 : at + 1 + p[1]], time)

    def _answer(self, row: int, data: bytes = b"") -> Answer:
        error = self._get(row, "STATUS")
        return row, self._get(row, "RETURN_DELAY") * 2e-6, pack(self._get(row, "ID"), error, data)

    # -- memory table ------------------------------------------------------------------------------------------------

    def _get(self, row: int, name: str) -> int:
        address, size = REGISTERS[name]
        return int.from_bytes(self._table[row, address : address + size].tobytes(), "little")

    def _set(self, row: int, name: str, value: int) -> None:
        address, size = REGISTERS[name]
        self._table[row, address : address + size] = np.frombuffer(value.to_bytes(size, "little"), np.uint8)

    def _column(self, name: str) -> np.ndarray:
        """A register of all servos, unsigned, as float."""
        address, size = REGISTERS[name]
        return np.ascontiguousarray(self._table[:, address : address + size]).view(f"<u{size}")[:, 0].astype(float)

    def _put(self, name: str, values: np.ndarray, bit: int = 15) -> None:
        """A measured quantity of all servos, rounded; signed by ``bit``."""
        address, size = REGISTERS[name]
        raw = to_sign_magnitude(np.rint(values).astype(np.int64), bit)
        self._table[:, address : address + size] = raw.astype(f"<u{size}").reshape(-1, 1).view(np.uint8)

    def _read(self, row: int, address: int, size: int) -> bytes:
        self._refresh()
        return self._table[row, address : address + size].tobytes()

    def _write(self, row: int, address: int, data: bytes, time: float) -> None:
        """What can be written is; the rest is ignored."""
        goals = range(REGISTERS["GOAL_POSITION"][0], REGISTERS["TORQUE_LIMIT"][0] + 2)
        before = self._get(row, "TORQUE_ENABLE")
        for at, byte in enumerate(data, address):
            if at in WRITABLE:
                self._table[row, at] = byte
                if at < RAM and not self._get(row, "LOCK"):
                    self._kept[row, at] = byte
                if at in goals:
                    self.last_command_time[row] = time
        torque = self._get(row, "TORQUE_ENABLE")
        if torque == MIDDLE_HERE:
            self._center(row)
            self._set(row, "TORQUE_ENABLE", before)
        elif bool(torque) != bool(before):
            self._switch(row, bool(torque), time, "enabled" if torque else "disabled")
        self._readdress()
        if self._side[row] and np.sign(self._error(row)) != self._side[row]:
            self._side[row] = 0.0
            self._set(row, "STATUS", self._get(row, "STATUS") & ~OVERLOAD)
            self._note(time, row, "cleared")
        self._since[row] = time
        self._changed = self._stale = True

    def _center(self, row: int) -> None:
        """Make the present position the middle of the turn."""
        offset = round(float(self._shaft[row])) - ZERO
        self._set(row, "HOMING_OFFSET", int(to_sign_magnitude(np.array(offset), OFFSET_BIT)))

    @property
    def _shaft(self) -> np.ndarray:
        """(n,) counts within a turn, before the homing offset."""
        return np.mod((self._sign * self._body.joint_pos + self._offset) / TICK + ZERO, TICKS)

    @property
    def _homing(self) -> np.ndarray:
        return from_sign_magnitude(self._column("HOMING_OFFSET"), OFFSET_BIT)

    @property
    def position(self) -> np.ndarray:
        """(n,) counts as the servos tell them."""
        return np.mod(self._shaft - self._homing, TICKS)

    def _error(self, row: int) -> float:
        return self._get(row, "GOAL_POSITION") - float(self.position[row])

    def _refresh(self) -> None:
        if not self._stale:
            return
        self._stale = False
        self._put("PRESENT_POSITION", np.mod(np.rint(self.position), TICKS))
        self._put("PRESENT_VELOCITY", self._sign * self._body.joint_vel / TICK)
        load = self._sign * self._body.joint_torque / (self._stall * LOAD_UNIT)
        self._put("PRESENT_LOAD", np.clip(load, -TORQUE_FULL, TORQUE_FULL), LOAD_BIT)
        self._put("PRESENT_TEMPERATURE", np.clip(self.temperature, 0, 255), 8)
        self._table[:, REGISTERS["PRESENT_VOLTAGE"][0]] = self._volts
        self._table[:, REGISTERS["MOVING"][0]] = np.abs(self._body.joint_vel) > 2 * TICK

    # -- time --------------------------------------------------------------------------------------------------------

    def _watch(self, now: float) -> None:
        turn = np.floor(((self._sign * self._body.joint_pos + self._offset) / TICK + ZERO - self._homing) / TICKS)
        if (turn != self._turn).any():
            self._turn, self._changed = turn, True
        heavy = np.abs(self._body.joint_torque) > self._column("OVERLOAD_TORQUE") / 100 * self._stall
        heavy &= self._column("TORQUE_ENABLE") == 1
        self._overloaded = np.where(heavy, np.minimum(self._overloaded, now), np.inf)
        late = (now - self._overloaded >= self._column("PROTECTION_TIME") * 0.01) & (self._side == 0)
        for row in np.flatnonzero(late).tolist():
            if self._get(row, "UNLOADING") & OVERLOAD:
                self._side[row] = np.sign(self._error(row)) or 1.0
                self._set(row, "STATUS", self._get(row, "STATUS") | OVERLOAD)
                self._note(now, row, "overload")
                self._changed = True

    @property
    def enabled(self) -> np.ndarray:
        return (self._column("TORQUE_ENABLE") == 1) & np.array(self.powered)

    def _decide(self) -> np.ndarray:
        on = self.enabled
        mode, limit = self._column("MODE"), self._column("TORQUE_LIMIT")
        limit = np.minimum(limit, self._column("TORQUE_MAX")) / TORQUE_FULL
        limit = np.where(self._side != 0, np.minimum(limit, self._column("PROTECTIVE_TORQUE") / 100), limit)
        driven = limit > 0
        self._body.limit(self._stall * np.where(driven, limit, 1.0))
        emf = self._stall / NO_LOAD_SPEED
        kp = self._stall / (FULL_DUTY * TICK) * self._column("P_GAIN") * (mode == POSITION_MODE) * driven
        kd = emf * np.where(driven & (mode == VELOCITY_MODE), VELOCITY_STIFFNESS, 1.0)
        goal = (self._column("GOAL_POSITION") + self._turn * TICKS + self._homing - ZERO) * TICK - self._offset
        bias = kp * goal
        velocity = from_sign_magnitude(self._column("GOAL_VELOCITY")) * TICK
        bias += (mode == VELOCITY_MODE) * driven * kd * velocity
        duty = from_sign_magnitude(self._column("GOAL_TIME"), LOAD_BIT) / TORQUE_FULL
        bias += (mode == PWM_MODE) * driven * duty * self._stall
        return np.array([self._sign * bias, kp, kd]) * on

    def _overheat(self, row: int, now: float) -> None:
        if self._get(row, "STATUS") & OVERHEATING:
            return
        self._set(row, "STATUS", self._get(row, "STATUS") | OVERHEATING)
        if self._get(row, "UNLOADING") & OVERHEATING:
            self._switch(row, False, now, "over-temperature")

    # -- state -------------------------------------------------------------------------------------------------------

    def _restart(self, row: int, time: float, event: str) -> None:
        self._table[row] = self._kept[row]
        self._booting[row] = time + self.BOOT_TIME
        self._registered.pop(row, None)
        self._side[row], self._overloaded[row] = 0.0, np.inf
        self._switch(row, False, time, event)

    def _switch(self, row: int, on: bool, time: float, event: str) -> None:
        self._set(row, "TORQUE_ENABLE", int(on))
        if not on:
            self._side[row] = 0.0
            self._set(row, "STATUS", self._get(row, "STATUS") & ~OVERLOAD)
        self._since[row] = time
        self._stale = self._changed = True
        self._note(time, row, event)
