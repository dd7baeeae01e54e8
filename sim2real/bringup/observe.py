"""Looking at motors without touching them: nothing is connected, enabled, programmed or commanded, only asked."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Protocol

import numpy as np

from drivers.bus import BusSpec, MotorState
from drivers.codecs.dynamixel_look import DynamixelLook
from drivers.codecs.unitree_hg import STATE_TOPIC, VARIANTS, read_state
from drivers.open import open_codec, open_wire
from drivers.serial_bus import BITS_PER_BYTE
from drivers.wire import ERROR
from sim2real.types import Sim2realError

ANSWER = 64  # bytes, more than a servo's answer is
RETURN_DELAY = 0.0005  # s, the longest that a servo may be set to wait before it answers
# By protocol, the codec of somebody who only looks, where that is another.
LOOKS: dict[str, Any] = {"dynamixel": DynamixelLook}


class Observer(Protocol):
    """The motors of one bus, seen from outside."""

    spec: BusSpec
    state: MotorState  # in motor coordinates
    codec: Any

    def ask(self) -> None:
        """Request every motor's state, where they do not tell by themselves. Raises WireError."""
        ...

    def look(self, now: float) -> None:
        """Take in what arrived. Raises WireError."""
        ...

    def remark(self) -> str:
        """Something about the bus as a whole; "": nothing."""
        ...


class CanObserver:
    """Asks with the protocol's own question about state."""

    def __init__(self, spec: BusSpec, wire: Any) -> None:
        self.spec, self.codec, self._wire = spec, open_codec(spec), wire
        self.state = MotorState.empty(len(spec.motors))
        # Of motors about which nothing is known: a question about one in error might clear it.
        self._question = self.codec.pack_poll(MotorState.empty(len(spec.motors)))
        self._errors = self._strangers = 0

    def ask(self) -> None:
        self._wire.send(self._question)

    def look(self, now: float) -> None:
        frames = self._wire.recv()
        errors = frames["id"] & ERROR != 0
        self._errors += int(errors.sum())
        self._strangers += self.codec.unpack(frames[~errors], self.state, now)

    def remark(self) -> str:
        return f"{self._errors} error frames, {self._strangers} frames of nobody here" * bool(
            self._errors + self._strangers
        )


class DdsObserver:
    """Listens to what the robot publishes."""

    def __init__(self, spec: BusSpec, wire: Any) -> None:
        self.spec, self.codec, self._wire = spec, open_codec(spec), wire
        self.state = MotorState.empty(len(spec.motors))
        self._mode_machine = -1

    def ask(self) -> None: ...

    def look(self, now: float) -> None:
        for payload in self._wire.read(STATE_TOPIC):
            if (sample := read_state(payload)) is not None:
                self._mode_machine = int(sample["mode_machine"][0])
                self.codec.unpack(sample, self.state, now)

    def remark(self) -> str:
        if self._mode_machine < 0:
            return "no LowState heard"
        variant = VARIANTS.get(self._mode_machine)
        fits = "" if not self.codec.misfits(self._mode_machine) else ": not the one of this wiring"
        return f"mode_machine {self._mode_machine} ({variant.description if variant else 'unknown'}){fits}"


class SerialObserver:
    """Reads the servos' registers, one question at a time: the line carries one way at once. A servo's bus watchdog hears the
    questions too; nobody else can hold the line open meanwhile, for it is opened exclusively."""

    def __init__(self, spec: BusSpec, wire: Any) -> None:
        self.spec, self.codec, self._wire = spec, LOOKS.get(spec.protocol, open_codec)(spec), wire
        self.state = MotorState.empty(len(spec.motors))
        self._questions = self.codec.pack_looks()
        longest = max(map(len, self._questions)) + len(spec.motors) * ANSWER
        self._patience = BITS_PER_BYTE * longest / spec.bitrate + len(spec.motors) * RETURN_DELAY  # s
        self._asked, self._now, self._due, self._strangers = 0, 0.0, 0.0, 0

    def ask(self) -> None:
        if self._now >= self._due:
            self._wire.write(self._questions[self._asked % len(self._questions)])
            self._asked, self._due = self._asked + 1, self._now + self._patience

    def look(self, now: float) -> None:
        self._now = now
        self._strangers += self.codec.unpack_look(self._wire.read(), self.state, now)

    def remark(self) -> str:
        return f"{self._strangers} packets damaged or of nobody here" * bool(self._strangers)


# By protocol, and only those whose question is nothing else: a mini-cheetah answers commands alone, a recoil motor takes the
# question for a target, a RobStride is written to, and an ODrive's watchdog would be fed for a host that has died.
OBSERVERS: dict[str, type[CanObserver] | type[SerialObserver] | type[DdsObserver]] = {
    "damiao": CanObserver,
    "dynamixel": SerialObserver,
    "feetech": SerialObserver,
    "moteus": CanObserver,
    "unitree_hg": DdsObserver,
}


def observers(specs: list[BusSpec], wires: Mapping[str, Any] | None = None) -> list[Observer]:
    """One for each bus; on ``wires`` (by bus name) where given, else on the real ones. Raises BusError."""
    out: list[Observer] = []
    for spec in specs:
        open_codec(spec)  # an unknown protocol is named first
        if spec.protocol not in OBSERVERS:
            raise Sim2realError(
                f"bus {spec.name}: no way is known here to ask '{spec.protocol}' motors without commanding them; expected "
                f"{' or '.join(OBSERVERS)}"
            )
        out.append(OBSERVERS[spec.protocol](spec, wires[spec.name] if wires else open_wire(spec)))
    return out


def rows(watched: list[Observer], now: float) -> list[dict[str, Any]]:
    """What each motor last said, in the coordinates of its joint: a plain object each; None: never heard."""
    out = []
    for observer in watched:
        s = observer.state
        for i, m in enumerate(observer.spec.motors):
            heard = s.time[i] > -np.inf
            numbers = {
                "position": m.sign * (s.position[i] - m.offset),
                "velocity": m.sign * s.velocity[i],
                "torque": m.sign * s.torque[i],
                "temperature": s.temperature[i],
                "age": now - s.time[i],
            }
            out.append(
                {"joint": m.joint, "bus": observer.spec.name, "id": m.id}
                | {k: float(v) if heard else None for k, v in numbers.items()}
                | {
                    "enabled": bool(s.enabled[i]),
                    "error": observer.codec.error_name(int(s.error[i])) if heard else "silent",
                }
            )
    return out
