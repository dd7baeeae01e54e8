"""What can go wrong on a simulated wire, as data: seeded, scriptable, and readable from a command line.

The words are PX4's failure words (off, stuck, garbage, wrong, delayed) and the usual ones of wires. ``drop:0.1`` loses a
tenth of all frames; ``off:left_leg/left_knee_joint@5`` silences one motor from 5 s on; ``bus_off:waist@3-4`` lasts a
second; ``delay:left_arm:0.2=0.005`` holds a fifth of one bus's frames back by 5 ms; ``stuck:imu@2`` freezes the IMU.
"""

from __future__ import annotations

import difflib
import math
import re
from dataclasses import dataclass
from fnmatch import fnmatchcase

from drivers.bus import BusError

IMU = "imu"  # the bus name that means the IMU's serial line


@dataclass(frozen=True)
class Kind:
    """``meaning``, what ``value`` is and its default, and what the fault can befall."""

    meaning: str
    value: float = 0.0
    unit: str = ""
    imu: bool = False
    can: bool = True


KINDS: dict[str, Kind] = {
    "drop": Kind("a frame or packet is sent and heard by nobody", imu=True),
    "delay": Kind("a frame or packet is held back by its sender", 0.005, "s", imu=True),
    "corrupt": Kind("bad CRC: an error frame, an error count, and the controller sends again", imu=True),
    "garbage": Kind("feedback with random payload, accepted as valid", imu=True),
    "wrong": Kind("feedback with one bit of its payload flipped, accepted as valid", imu=True),
    "duplicate": Kind("a frame arrives twice", imu=True),
    "stuck": Kind("feedback repeats its first payload", imu=True),
    "off": Kind("a motor without power: silent and free of torque; or an IMU that is silent", imu=True),
    "reboot": Kind("a motor loses power, and has it again after a while, disabled", 0.5, "s"),
    "bus_off": Kind("the host's controller has left the bus: nothing goes in or out"),
    "no_buffer": Kind("the host's transmit queue takes nothing (ENOBUFS)"),
}
ALIASES = {"delayed": "delay", "slow": "delay"}
POWER = frozenset({"off", "reboot"})  # befall a motor itself, not its frames
HOST = frozenset({"bus_off", "no_buffer"})  # befall the host's controller
FEEDBACK = frozenset({"garbage", "wrong", "stuck"})  # befall only what motors say


@dataclass(frozen=True)
class Fault:
    """One thing going wrong from ``start`` to ``end`` (s of simulated time), to each frame with ``probability``.

    ``bus`` and ``motor`` (the name of its joint) are patterns; the IMU is the bus ``imu``, which ``*`` does not mean.
    ``value``: see KINDS; NaN: the default.
    """

    kind: str
    bus: str = "*"
    motor: str = "*"
    start: float = 0.0
    end: float = math.inf
    probability: float = 1.0
    value: float = math.nan

    def __post_init__(self) -> None:
        object.__setattr__(self, "kind", ALIASES.get(self.kind, self.kind))
        if self.kind not in KINDS:
            close = difflib.get_close_matches(self.kind, KINDS, n=1)
            hint = f" (did you mean '{close[0]}'?)" if close else ""
            raise BusError(f"fault: got kind '{self.kind}'{hint}, expected one of {', '.join(KINDS)}")
        if not 0.0 <= self.probability <= 1.0:
            raise BusError(f"fault '{self.kind}': got probability {self.probability}, expected 0 to 1")
        if not self.start < self.end:
            raise BusError(f"fault '{self.kind}': got {self.start}-{self.end} s, expected start before end")
        if self.bus == IMU and not KINDS[self.kind].imu:
            kinds = ", ".join(k for k, v in KINDS.items() if v.imu)
            raise BusError(f"fault '{self.kind}': cannot befall the IMU; expected one of {kinds}")
        if math.isnan(self.value):
            object.__setattr__(self, "value", KINDS[self.kind].value)

    def befalls(self, bus: str, motor: str = "*") -> bool:
        """Whether the motor of this joint on this bus is meant; without ``motor``, whether anything on the bus is."""
        if (bus == IMU) != (self.bus == IMU):
            return False
        return fnmatchcase(bus, self.bus) and (motor == "*" or fnmatchcase(motor, self.motor))


_NUMBER = r"[0-9]*\.?[0-9]+(?:e[+-]?[0-9]+)?"
_FAULT = re.compile(
    rf"(?P<kind>[a-z_]+)"
    rf"(?::(?P<bus>(?!{_NUMBER}(?:[:=@]|$))[^:/=@]+)(?:/(?P<motor>[^:=@]+))?)?"
    rf"(?::(?P<probability>{_NUMBER}))?"
    rf"(?:=(?P<value>{_NUMBER}))?"
    rf"(?:@(?P<start>{_NUMBER})(?:-(?P<end>{_NUMBER}))?)?"
)


def parse_fault(text: str) -> Fault:
    """``kind[:bus[/motor]][:probability][=value][@start[-end]]`` as a Fault. Raises BusError."""
    match = _FAULT.fullmatch(text.strip())
    if match is None:
        raise BusError(
            f"fault: got '{text}', expected kind[:bus[/motor]][:probability][=value][@start[-end]], "
            f"like drop:0.1 or off:left_leg/left_knee_joint@5; kinds: {', '.join(KINDS)}"
        )
    fields = {k: v for k, v in match.groupdict().items() if v is not None}
    return Fault(**{k: v if k in ("kind", "bus", "motor") else float(v) for k, v in fields.items()})  # type: ignore
