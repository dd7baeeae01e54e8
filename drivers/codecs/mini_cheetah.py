"""MIT-mode motors with nothing but MIT mode: the mini-cheetah firmware, and the host's side of those that came from it.

A motor listens on its CAN_ID for MIT commands and FF x 7 with FC enable, FD disable, FE set zero. Every frame to it is
answered once, on CAN_MASTER (``MotorSpec.feedback_id``; the same for all, factory: 0): [id, position 16, velocity 12,
torque 12, and up to two bytes of the vendor's].

There is no register, so that no range can be read back: a wrong model is noticed by nobody. There is no state in the answer
either: a motor counts as enabled once it has answered every frame since it was told so, until it is told otherwise or falls
silent. Polling repeats "disable", the only question that commands nothing to a motor that must not move.

The watchdog (CAN_TIMEOUT, cycles of 25 us, factory: 0 = off) can only be set by serial line. On expiry the firmware sets
kp, kd and torque to zero: the joint goes limp, and the next command takes it up again. A wiring of such motors must say
``watchdog: 0``.

Source: bgkatz/motorcontrol (CAN_com, hw_config, user_config).
"""

from __future__ import annotations

from enum import IntEnum
from typing import ClassVar, NamedTuple

import numpy as np

from drivers.bus import BusError, BusSpec, MotorCommand, MotorSpec, MotorState
from drivers.can_bus import RegisterAnswer, RegisterCheck
from drivers.codecs.mit import MitCodec, MitFeedback, Ranges, words_of
from drivers.codecs.robstride import model_of
from drivers.wire import make_frames

CYCLE = 25e-6  # s, unit of CAN_TIMEOUT
PATIENCE = 5  # commands without an answer: the motor may have lost power, and would come back disabled
NOT_TOLD = 1 << 40  # answers that a motor owes which nobody enabled: more than will ever come


class Model(NamedTuple):
    """Full scale of position (rad), velocity (rad/s), torque (N m), kp (N m/rad) and kd (N m s/rad)."""

    position: float
    velocity: float
    torque: float
    kp: float = 500.0
    kd: float = 5.0


class Kind(IntEnum):
    """What a frame from the host is, for a motor: the last of eight bytes behind seven of FF, or a command."""

    COMMAND = 0
    ENABLE = 0xFC
    DISABLE = 0xFD
    SET_ZERO = 0xFE


def special_payload(kind: Kind) -> np.ndarray:
    """The payload (8,) uint8 of FF x 7 and the kind."""
    return np.array([0xFF] * 7 + [kind], np.uint8)


class MiniCheetahCodec:
    """The host's side of one bus (a ``can_bus.CanCodec``). It remembers whom it enabled, for no motor says so."""

    # Firmware defaults (V_MAX 65 rad/s). Torque is I_MAX KT GR of the build; some builds report over a larger range than
    # they take (I_MAX + SENSE_BUFFER): then the torque of the state is too small by that ratio.
    MODELS: ClassVar[dict[str, Model]] = {"mini-cheetah": Model(12.5, 65, 18)}
    FILE: ClassVar[str] = "mini_cheetah.py"  # where MODELS is, for the error message
    MASTER: ClassVar[int] = 0  # identifier of answers where the wiring says 0
    LENGTHS: ClassVar[tuple[int, ...]] = (6, 7, 8)  # of answers; by firmware
    TICK_BITS = (117.6 + 115.0, 135.0 + 135.0)  # of a command and an answer of 8 bytes, as Damiao's; others are shorter
    IDENTITY = ()
    TURN = 0.0  # where it starts to count after power-on is the build's own affair

    def __init__(self, spec: BusSpec) -> None:
        """Raises BusError for an unknown model, or identifiers by which the motors could not be told apart."""
        n = len(spec.motors)
        self.mit = MitCodec(self.ranges_of(spec.motors))
        self.checks: list[RegisterCheck] = []
        self._masters = self.masters_of(spec)
        self._ids = np.array([m.id for m in spec.motors], np.uint32)
        self._row_of = np.full(0x100, -1, np.intp)
        self._row_of[self._ids] = np.arange(n)
        self._obeys = np.zeros(n, bool)
        self._owed = np.full(n, NOT_TOLD)  # answers to the enable frame and what followed it
        self._silence = np.zeros(n, int)  # commands since the last answer
        self._special = {
            kind: make_frames(self._ids, np.tile(special_payload(kind), (n, 1))) for kind in (Kind.ENABLE, Kind.DISABLE)
        }

    @classmethod
    def ranges_of(cls, motors: tuple[MotorSpec, ...]) -> Ranges:
        """Full scales of ``motors`` by their model. Raises BusError for one that is not in MODELS."""
        position, velocity, torque, kp, kd = np.array([model_of(m, cls.MODELS, cls.FILE) for m in motors], float).T
        return Ranges(position, velocity, torque, kp, kd)

    @classmethod
    def masters_of(cls, spec: BusSpec) -> np.ndarray:
        """The identifier (n,) on which each motor answers. Raises BusError for ids that cannot be."""
        for m in spec.motors:
            where = f"bus {spec.name}, motor of {m.joint}"
            if not 0 < m.id <= 0xFF:
                raise BusError(f"{where}: got id {m.id:#x}, expected 0x1 to 0xff (CAN_ID; answers hold 8 bits of it)")
            for other in spec.motors:
                if (m.feedback_id or cls.MASTER) == other.id:
                    raise BusError(
                        f"{where} (id {m.id:#x}): it answers on {other.id:#x}, where the motor of {other.joint} listens for "
                        "commands; set its CAN_MASTER to an identifier that no motor has"
                    )
        return np.array([m.feedback_id or cls.MASTER for m in spec.motors], np.uint32)

    def pack_command(self, command: MotorCommand) -> np.ndarray:
        """One MIT command for each motor (FRAME, (n,)). Saturates; raises ValueError for a value not finite."""
        c = command
        frames = make_frames(self._ids, self.mit.pack_command(c.position, c.velocity, c.kp, c.kd, c.torque))
        self._owed += 1
        self._silence += 1
        lost = self._silence > PATIENCE
        self._obeys[lost], self._owed[lost] = False, NOT_TOLD
        return frames

    def pack_enable(self, state: MotorState) -> np.ndarray:
        self._owed[:] = 1
        return self._special[Kind.ENABLE]

    def pack_disable(self) -> np.ndarray:
        self._obeys[:] = False
        self._owed[:] = NOT_TOLD
        return self._special[Kind.DISABLE]

    def pack_poll(self, state: MotorState) -> np.ndarray:
        return self.pack_disable()

    def pack_register(self, row: int, register: str, value: float | int | None = None) -> np.ndarray:
        raise KeyError(register)  # there are none

    def unpack_registers(self, frames: np.ndarray) -> list[RegisterAnswer]:
        return []

    def unpack(self, frames: np.ndarray, state: MotorState, now: float) -> int:
        """Put the answers among ``frames`` into ``state``, the latest of each motor last. Returns how many frames came
        from nobody on this bus or were malformed."""
        owners = self.owners(frames)
        known = owners >= 0
        rows = owners[known]
        f = self.mit.unpack_feedback(frames["data"][known], rows)
        np.subtract.at(self._owed, rows, 1)
        self._silence[rows] = 0
        self._obeys[rows[self._owed[rows] == 0]] = True
        state.position[rows] = f.position
        state.velocity[rows] = f.velocity
        state.torque[rows] = f.torque
        state.temperature[rows], state.error[rows] = self._condition(f)
        state.enabled[:] = self._obeys & (state.error == 0)
        state.time[rows] = now
        return int(np.count_nonzero(~known))

    def _condition(self, feedback: MitFeedback) -> tuple[np.ndarray | float, np.ndarray | int]:
        """Temperature (deg C) and error code that the vendor's bytes mean."""
        return np.nan, 0

    def owners(self, frames: np.ndarray) -> np.ndarray:
        """Whose each of ``frames`` is: (m,) rows of the motors, -1 for nobody on this bus."""
        rows = self._row_of[frames["data"][:, 0]].copy()
        rows[(frames["id"] != self._masters[rows]) | ~np.isin(frames["length"], self.LENGTHS)] = -1
        return rows

    def error_name(self, code: int) -> str:
        return f"unknown error {code}" if code else "none"


class MiniCheetahMotors:
    """The motors' side: what emulated motors do with the frames of a host, and the frames that they answer with."""

    CODEC: ClassVar[type[MiniCheetahCodec]] = MiniCheetahCodec
    LENGTH: ClassVar[int] = 6
    SPECIAL: ClassVar[tuple[int, ...]] = (Kind.ENABLE, Kind.DISABLE, Kind.SET_ZERO)  # last bytes behind seven of FF

    def __init__(self, spec: BusSpec) -> None:
        self.ranges = self.CODEC.ranges_of(spec.motors)
        self.mit = MitCodec(self.ranges)
        self.ids = np.array([m.id for m in spec.motors], np.uint32)
        self.masters = self.CODEC.masters_of(spec)
        self._row_of = np.full(0x801, -1, np.intp)
        self._row_of[self.ids] = np.arange(len(self.ids))

    def classify(self, frames: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Whom each of ``frames`` (FRAME, (m,)) is for, -1 for none of them, and its Kind: (m,) int64 each."""
        rows = self._row_of[np.minimum(frames["id"], 0x800)]
        words = words_of(frames["data"])
        kinds = np.where(words >> np.uint64(8) == (1 << 56) - 1, words & np.uint64(0xFF), 0).astype(np.int64)
        kinds[~np.isin(kinds, self.SPECIAL)] = Kind.COMMAND
        return np.where(frames["length"] == 8, rows, -1), kinds

    def unpack_command(self, data: np.ndarray) -> MotorCommand:
        """Commands of payloads (n, 8) uint8, one for each motor, in SI units."""
        return self.mit.unpack_command(data)

    def pack_feedback(
        self,
        position: np.ndarray,
        velocity: np.ndarray,
        torque: np.ndarray,
        temperature: np.ndarray | float = 0.0,
        error: np.ndarray | int = 0,
    ) -> np.ndarray:
        """Answers (FRAME, (n,)) of every motor: rad (comes back in from the other end beyond full scale, as the firmware
        does not clamp), rad/s, N m, deg C, the vendor's error code."""
        byte6, byte7 = self._condition(np.asarray(temperature), np.asarray(error))
        data = self.mit.pack_feedback(position, velocity, torque, self.ids, byte6, byte7, wrap=True)
        frames = make_frames(self.masters, data, self.LENGTH)
        frames["data"][:, self.LENGTH :] = 0
        return frames

    def _condition(self, temperature: np.ndarray, error: np.ndarray) -> tuple[np.ndarray | int, np.ndarray | int]:
        """The vendor's two bytes."""
        return 0, 0
