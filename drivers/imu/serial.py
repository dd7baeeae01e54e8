"""IMUs that stream packets over a serial wire."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, Protocol, TypeAlias

import numpy as np

from drivers.bus import BusCounters, BusError, ImuSpec, ImuState
from drivers.wire import SerialWire, WireError

NORM_TOLERANCE = 0.01  # of a quaternion

Vector: TypeAlias = Sequence[float] | np.ndarray


class ImuPacket(Protocol):
    """What a packet must say, in SI units and the sensor's own frame."""

    @property
    def orientation(self) -> Vector: ...  # (4,) w, x, y, z

    @property
    def angular_velocity(self) -> Vector: ...  # (3,) rad/s

    @property
    def acceleration(self) -> Vector: ...  # (3,) m/s^2, +g upwards at rest


class ImuParser(Protocol):
    """A codec of such packets, fed with bytes as they come."""

    rejected: int

    def feed(self, data: bytes) -> list[Any]:
        """Every ImuPacket completed by ``data``, oldest first."""
        ...

    # One whose sensor must be told to send also has:
    # def ask(self, now: float, rate: float) -> bytes: what to write to it now, for packets at ``rate`` Hz.


class SerialImu:
    """An IMU on a serial wire (a ``drivers.bus.Imu``)."""

    def __init__(self, spec: ImuSpec, parser: ImuParser, wire: SerialWire) -> None:
        self.spec = spec
        self.counters = BusCounters()
        self._parser = parser
        self._wire = wire
        self._state = ImuState.empty()
        self._implausible = 0
        self._ask = getattr(parser, "ask", None)

    def read(self, now: float) -> ImuState:
        """A packet that is not finite, or whose quaternion is not of length 1, is rejected and leaves the state old.
        Raises BusError if the port is gone."""
        try:
            data = self._wire.read()
            if self._ask is not None and (asked := self._ask(now, self.spec.rate)):
                self._wire.write(asked)
        except WireError as error:
            raise BusError(f"imu {self.spec.protocol} ({self.spec.channel}): {error}") from error
        packets = self._parser.feed(data)
        plausible = [p for p in packets if self._plausible(p)]
        if plausible:
            newest, state = plausible[-1], self._state
            state.orientation_imu_in_world[:] = newest.orientation
            state.angular_velocity_imu_in_imu[:] = newest.angular_velocity
            state.acceleration_imu_in_imu[:] = newest.acceleration
            state.time = now
        self.counters.received += len(packets)
        self._implausible += len(packets) - len(plausible)
        self.counters.rejected = self._parser.rejected + self._implausible
        return self._state

    def close(self) -> None:
        self._wire.close()

    def _plausible(self, p: ImuPacket) -> bool:
        measured = (*p.angular_velocity, *p.acceleration)
        return all(map(math.isfinite, measured)) and abs(math.hypot(*p.orientation) - 1.0) < NORM_TOLERANCE
