"""Who is on a bus: every identifier is asked, and what answers is read out. Nothing is enabled, written or commanded.

Two motors with one identifier both answer. Where they say the same, at the same moment, a CAN bus shows one frame; so each
is asked for what differs between motors (serial number, position), and answers that disagree, come twice, or garble each
other into error frames give them away.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from drivers.bus import BusSpec, Clock, MotorSpec
from drivers.codecs import damiao
from drivers.codecs.damiao import Operation
from drivers.wire import BUS_OFF, CONTROLLER, ERROR, ERROR_PASSIVE, CanWire, WireError, WireFull, WireGone, make_frames

ANSWER_TIME = 0.01  # s for the answers to one batch of questions
RESTART_TIME = 0.15  # s until a controller is back on the bus: restart-ms 100, and some
POLL_PERIOD = 0.001  # s between two looks at the wire
BATCH = 16  # identifiers asked at once: what fits into a default queue twice over would not
TRIES = 3
# What is read of a Damiao motor; the first is what it is found by. SN differs between motors.
REGISTERS = ("ESC_ID", "SN", "MST_ID", "CTRL_MODE", "TIMEOUT", "HW_VER", "SW_VER", "PMAX", "VMAX", "TMAX")
TOLERANCE = 1e-4  # relative, of a range


@dataclass
class Found:
    """A motor, or several with one identifier. ``registers``: what it says of itself."""

    id: int
    feedback_ids: set[int] = field(default_factory=set)  # identifiers of its answers
    registers: dict[str, float] = field(default_factory=dict)
    duplicate: bool = False
    error: str = ""  # "": none
    models: list[str] | None = None  # that it may be; None: nothing tells
    firmware: str = ""


@dataclass
class Sweep:
    """What a sweep of one bus came to."""

    motors: list[Found]
    error_frames: int = 0  # or, on a serial line, packets that were garbled
    controller: str = ""  # the worst that the CAN controller said of itself: "error-passive", "bus-off"; "": nothing
    protocol: str = "damiao"


def sweep_damiao(wire: CanWire, clock: Clock, ids: Iterable[int] = range(1, 0x100)) -> Sweep:
    """Every Damiao motor among ``ids``. Takes about ANSWER_TIME * TRIES for each BATCH of them. Raises WireError."""
    swept = Sweep([])
    found: dict[int, Found] = {}
    ids = list(ids)
    for batch in (ids[i : i + BATCH] for i in range(0, len(ids), BATCH)):
        missing = batch
        for _ in range(TRIES):
            _read(wire, clock, missing, "ESC_ID", found, swept)
            missing = [id for id in batch if id not in found]
    for register in REGISTERS[1:]:
        missing = list(found)
        for _ in range(TRIES):
            for batch in (missing[i : i + BATCH] for i in range(0, len(missing), BATCH)):
                _read(wire, clock, batch, register, found, swept)
            missing = [id for id in found if register not in found[id].registers]
    _states(wire, clock, found, swept)
    for motor in found.values():
        got = [motor.registers.get(name, np.nan) for name in ("PMAX", "VMAX", "TMAX")]
        motor.models = [m for m, ranges in damiao.MODELS.items() if np.allclose(got, ranges, rtol=TOLERANCE)]
        motor.firmware = f"{motor.registers['SW_VER']:g}" if "SW_VER" in motor.registers else ""
    swept.motors = [found[id] for id in sorted(found)]
    return swept


def _read(wire: CanWire, clock: Clock, ids: list[int], register: str, found: dict[int, Found], swept: Sweep) -> None:
    """Ask ``ids`` for a register and enter what they say."""
    answered: set[int] = set()
    questions = [damiao.pack_register(id, Operation.READ, register) for id in ids]
    for identifier, data in _converse(wire, clock, questions, swept):
        answer = damiao.unpack_register(data)
        if answer.operation != Operation.READ or answer.register != register or answer.id not in ids:
            continue
        motor = found.setdefault(answer.id, Found(answer.id))
        motor.duplicate |= answer.id in answered or motor.registers.get(register, answer.value) != answer.value
        motor.feedback_ids.add(identifier)
        motor.registers[register] = answer.value
        answered.add(answer.id)
    for motor in found.values():
        motor.duplicate |= len(motor.feedback_ids) > 1


def _states(wire: CanWire, clock: Clock, found: dict[int, Found], swept: Sweep) -> None:
    """Ask each motor for its state, for its error and because two of them will not stand alike."""
    for motor in found.values():
        question = [damiao.pack_register(motor.id, Operation.REFRESH)]
        told = [data for id, data in _converse(wire, clock, question, swept) if id in motor.feedback_ids]
        motor.duplicate |= len(told) > 1
        for data in told:
            status = int(data[0]) >> 4
            motor.error = damiao.ERRORS.get(status, f"unknown status {status:#x}") if status > 1 else motor.error


def _converse(
    wire: CanWire, clock: Clock, questions: list[np.ndarray], swept: Sweep
) -> Iterator[tuple[int, np.ndarray]]:
    """Send ``questions`` to everybody; the (identifier, payload) of what comes back within ANSWER_TIME."""
    if questions:
        to_all = make_frames(np.full(len(questions), damiao.BROADCAST_ID, np.uint32), np.array(questions))
        for frame in converse(wire, clock, to_all, swept):
            if frame["length"] == 8:
                yield int(frame["id"]), frame["data"]


def converse(wire: CanWire, clock: Clock, frames: np.ndarray, swept: Sweep, time: float = ANSWER_TIME) -> Iterator[Any]:
    """Send ``frames``; each FRAME that comes back within ``time`` s. Error frames are counted. Raises WireError.

    A queue that is full is a bus on which nobody acknowledges: nobody answers either. A controller that has left the bus is
    waited for.
    """
    try:
        with suppress(WireFull):
            wire.send(frames)
    except WireGone:
        raise
    except WireError:
        swept.controller = "bus-off"
        clock.sleep_until(clock.now() + RESTART_TIME)
        with suppress(WireFull):
            wire.send(frames)
    start = clock.now()
    for n in range(round(time / POLL_PERIOD)):
        clock.sleep_until(start + (n + 1) * POLL_PERIOD)
        for frame in wire.recv():
            if frame["id"] & ERROR:
                swept.error_frames += 1
                if frame["id"] & BUS_OFF:
                    swept.controller = "bus-off"
                elif frame["id"] & CONTROLLER and frame["data"][1] & ERROR_PASSIVE and not swept.controller:
                    swept.controller = "error-passive"
            else:
                yield frame


def _damiao(motor: Found, m: MotorSpec | None) -> list[str]:
    """What is wrong with a Damiao motor besides."""
    r, problems = motor.registers, []
    if r.get("CTRL_MODE", damiao.MIT_MODE) != damiao.MIT_MODE:
        problems.append(f"CTRL_MODE {r['CTRL_MODE']:g}, expected {damiao.MIT_MODE} (MIT): write it")
    if motor.feedback_ids == {0}:
        problems.append(f"MST_ID 0, expected one of its own, as {motor.id + 0x10:#x}: write it")
    if m is not None and m.feedback_id not in motor.feedback_ids:
        got = ", ".join(f"{i:#x}" for i in sorted(motor.feedback_ids))
        problems.append(f"answers on {got}, the wiring says {m.feedback_id:#x}: correct one of them")
    if silent := [name for name in REGISTERS if name not in r]:
        problems.append(f"fell silent: no answer about {', '.join(silent)}; check its connector and its power")
    return problems


def verdicts(swept: Sweep, spec: BusSpec | None = None) -> list[dict[str, Any]]:
    """A plain object for each motor found, and for each that the wiring ``spec`` has and nobody answered for.

    ``problems``: what is wrong with it and what to do; empty: nothing.
    """
    wired = {m.id: m for m in spec.motors} if spec else {}
    out = []
    for motor in swept.motors:
        m = wired.get(motor.id)
        problems = []
        if motor.duplicate:
            problems.append("two motors have this id: unplug one, and give the other a new one (`sim2real setup`)")
        if motor.error:
            problems.append(f"error: {motor.error}")
        if swept.protocol == "damiao":
            problems += _damiao(motor, m)
        if spec and m is None:
            problems.append("not in the wiring: add it, or unplug it")
        elif m is not None and motor.models is not None and m.model not in motor.models:
            problems.append(f"it is {' or '.join(motor.models) or 'no known model'}, the wiring says {m.model}")
        out.append(
            {
                "id": motor.id,
                "joint": m.joint if m else "",
                "feedback_ids": sorted(motor.feedback_ids),
                "models": motor.models or [],
                "firmware": motor.firmware,
                "registers": motor.registers,
                "problems": problems,
            }
        )
    heard = {motor.id for motor in swept.motors}
    for id, m in wired.items():
        if id not in heard:
            what = "no answer: check power, connector and bit rate; if a stranger is above, its id may be the wrong one"
            out.append(
                {
                    "id": id,
                    "joint": m.joint,
                    "feedback_ids": [],
                    "models": [],
                    "firmware": "",
                    "registers": {},
                    "problems": [what],
                }
            )
    return sorted(out, key=lambda row: row["id"])
