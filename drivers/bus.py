"""The nouns a driver author needs: MotorState, MotorCommand, MotorBus, and the plain specs they are opened from.

Everything here is per bus, struct of arrays, SI units at the output shaft, in the motor's own sign and zero.
Signs, offsets and joint names belong to ``sim2real.robot``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, fields
from typing import Protocol

import numpy as np


class BusError(Exception):
    """A bus or a motor on it is not what the wiring says, or does not answer: what, where, got, expected, next step."""


class Clock(Protocol):
    """What drivers need of time: monotonic seconds, and to wait for one of them."""

    def now(self) -> float: ...

    def sleep_until(self, time: float, /) -> None: ...


@dataclass(frozen=True)
class MotorSpec:
    """One motor of a wiring.

    ``model`` is a row of the codec's ``MODELS``. ``id`` is where it listens, ``feedback_id`` where it answers (0: the
    protocol has no such thing). ``sign`` and ``offset`` place the joint on it:
    ``joint_pos = sign * (motor_pos - offset)``, offset in motor radians.
    """

    joint: str
    model: str
    id: int
    feedback_id: int = 0
    sign: int = 1
    offset: float = 0.0


@dataclass(frozen=True)
class BusSpec:
    """One bus of a wiring.

    ``interface`` and ``channel`` are python-can's words for CAN (``socketcan``, ``can0``) and ``serial`` plus a device
    for serial buses. ``bitrate`` in bit/s; ``data_bitrate``: of the payloads on CAN-FD, 0 on classic CAN. ``watchdog``:
    seconds after which a motor without commands must stop by itself; programmed and read back before torque. 0: it has
    none, and a person accepts that.
    """

    name: str
    protocol: str
    motors: tuple[MotorSpec, ...]
    interface: str = "socketcan"
    channel: str = ""
    bitrate: int = 1_000_000
    watchdog: float = 0.08
    data_bitrate: int = 0


@dataclass(frozen=True)
class ImuSpec:
    """An IMU of a wiring. ``orientation_imu_in_base``: (w, x, y, z), how the chip is mounted; ``rate`` in Hz."""

    protocol: str
    interface: str = "serial"
    channel: str = ""
    baud: int = 921_600
    rate: float = 500.0
    site: str = "imu"
    orientation_imu_in_base: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0)


@dataclass(slots=True)
class MotorState:
    """What each motor of a bus last said. Arrays of shape (n,), in the order of ``BusSpec.motors``."""

    position: np.ndarray  # rad
    velocity: np.ndarray  # rad/s
    torque: np.ndarray  # N m
    temperature: np.ndarray  # deg C, the hottest the motor reports
    error: np.ndarray  # int64; 0: healthy, else the protocol's own code (named by ``MotorBus.error_name``)
    enabled: np.ndarray  # bool: the motor says that it obeys commands
    time: np.ndarray  # s, clock time at which this was received; -inf: never

    @classmethod
    def empty(cls, n: int) -> MotorState:
        """A state that knows nothing: NaN everywhere, received never."""
        nan = lambda: np.full(n, np.nan)  # noqa: E731
        return cls(nan(), nan(), nan(), nan(), np.zeros(n, np.int64), np.zeros(n, bool), np.full(n, -np.inf))

    @classmethod
    def concatenate(cls, states: Sequence[MotorState]) -> MotorState:
        """A copy of several, one after the other."""
        return cls(*(np.concatenate([getattr(s, f.name) for s in states]) for f in fields(cls)))

    def part(self, rows: slice) -> MotorState:
        """A view of some motors: what is written to it is written to the whole."""
        return MotorState(*(getattr(self, f.name)[rows] for f in fields(self)))


@dataclass(slots=True)
class MotorCommand:
    """PD targets for each motor of a bus, arrays of shape (n,), evaluated in the motor:
    ``torque = kp (position - q) + kd (velocity - dq) + torque_ff``."""

    position: np.ndarray  # rad
    velocity: np.ndarray  # rad/s
    kp: np.ndarray  # N m/rad
    kd: np.ndarray  # N m s/rad
    torque: np.ndarray  # N m, feed-forward


@dataclass(slots=True)
class BusCounters:
    """Counted since opening; a recorder or a status line reads them."""

    sent: int = 0
    received: int = 0
    rejected: int = 0  # frames that failed a check, or came from nobody on this bus
    lost: int = 0  # transmit queue full
    extra: dict[str, int] = field(default_factory=dict)


class MotorBus(Protocol):
    """A bus with motors on it. ``read``, ``write``, ``poll``, ``enable`` and ``disable`` never block."""

    spec: BusSpec
    counters: BusCounters

    def connect(self, clock: Clock) -> None:
        """Find every motor, compare its ranges with the model table, program the watchdog and read it back.
        Leaves every motor disabled. Blocks up to a second. Raises BusError naming the motor, got and expected."""
        ...

    def poll(self) -> None:
        """Ask every motor for its state without commanding anything (the only traffic while disarmed)."""
        ...

    def enable(self) -> None:
        """Make every motor obey commands from now on."""
        ...

    def disable(self) -> None:
        """Take torque off every motor. Never raises: this is the stop path."""
        ...

    def write(self, command: MotorCommand) -> None:
        """Send one tick of commands. Out-of-range values saturate; a non-finite value raises ValueError and sends
        nothing. Raises BusError if the wire is gone."""
        ...

    def read(self, now: float) -> MotorState:
        """Take in everything that arrived and return the latest state of every motor (the same object each call)."""
        ...

    def error_name(self, code: int) -> str:
        """The protocol's name for a ``MotorState.error`` code."""
        ...

    def fingerprints(self) -> list[str]:
        """What tells each motor from any other in its place, such as its serial number; "": its protocol tells nothing.
        Once connected, and disabled; blocks as ``connect`` does. Raises BusError."""
        ...

    def turns(self) -> list[float]:
        """rad by whose multiples each motor's position may be off since it was calibrated. 0: the maker sees to it, or
        nobody knows; NaN: the motor says that its position means nothing. As ``fingerprints``."""
        ...

    def close(self) -> None: ...


@dataclass(slots=True)
class ImuState:
    """What an IMU last said, in its own frame."""

    orientation_imu_in_world: np.ndarray  # (4,) w, x, y, z
    angular_velocity_imu_in_imu: np.ndarray  # (3,) rad/s
    acceleration_imu_in_imu: np.ndarray  # (3,) m/s^2, +g upwards at rest
    time: float  # s, when received; -inf: never

    @classmethod
    def empty(cls) -> ImuState:
        return cls(np.full(4, np.nan), np.full(3, np.nan), np.full(3, np.nan), -np.inf)


class Imu(Protocol):
    """An inertial measurement unit on its wire. ``read`` never blocks."""

    spec: ImuSpec
    counters: BusCounters

    def read(self, now: float) -> ImuState:
        """Take in everything that arrived and return the latest state (the same object each call). Never blocks."""
        ...

    def close(self) -> None: ...
