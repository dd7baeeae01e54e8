"""What is demanded of a real robot before anybody may arm it. A refusal names what it is about, and nothing has moved.

DEMANDS is the table, in its order. Motors are enabled once, without a target and with no gains (see each codec's
``pack_enable``), to see that they stop by themselves when nobody speaks to them any more.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from drivers.budget import LOAD_MAX, budget
from drivers.bus import BusError, Clock, MotorBus
from drivers.open import PROTOCOLS
from sim2real.calibration import Calibration, is_needed
from sim2real.config import RobotConfig, Wiring
from sim2real.records import layout, state_fields, state_view
from sim2real.robot import Robot
from sim2real.types import RobotState, Sim2realError

LOOK_TIME = 0.1  # s of asking before everybody must be fresh
IMU_TIME = 2.0  # s more for an IMU that has to be set up
ENABLE_TIME = 0.3  # s for every motor to say that it is enabled
TRIP_MARGIN = 0.02  # s beyond a watchdog's time at which it must have tripped
ANSWER_TIME = 0.06  # s to say so
CLEAR_TIME = 0.5  # s to be off and without error again
TURNS = range(-4, 5)  # that a motor may have lost or won since it was calibrated
UNREFERENCED = "its motor says that its position is referenced to nothing: it needs an absolute encoder, or to be set"


@dataclass
class Preflight:
    """A robot that was opened, not yet connected. ``wiring`` is the calibrated one, ``variants`` the hardware variants
    that robot and policies allow (empty: any). ``tell``: for what is accepted, and worth knowing."""

    config: RobotConfig
    name: str  # of the wiring
    wiring: Wiring
    robot: Robot
    clock: Clock
    calibration: Calibration | None = None
    variants: tuple[int, ...] = ()
    tell: Callable[[str], None] = lambda text: None

    def run(self) -> None:
        """Connect, and demand everything. Leaves every motor disabled. Raises Sim2realError with the first demand that
        is not met, and everybody who does not meet it."""
        for demand in DEMANDS:
            if said := list(demand.ask(self)):
                self.robot.disable()
                listed = "".join(f"\n  {line}" for line in said)
                raise Sim2realError(f"not ready to be armed, {demand.name}:{listed}\n  {demand.fix}")

    def look(self, ticks: int = 1, until: Callable[[RobotState], bool] | None = None) -> RobotState:
        """Ask every motor ``ticks`` times at the wiring's rate, or until content; what they said."""
        record = layout("State", state_fields(self.config.joint_names)).new()
        state = state_view(record)
        for _ in range(ticks):
            self.robot.poll()
            self.clock.sleep_until(self.clock.now() + 1.0 / self.wiring.rate)
            self.robot.read(self.clock.now(), state)
            if until is not None and until(state):
                break
        return state


class Demand(NamedTuple):
    """``ask`` yields a line for everything that is not as it must be."""

    name: str
    ask: Callable[[Preflight], Iterator[str]]
    fix: str


def bus_load(p: Preflight) -> Iterator[str]:
    """Room on every bus to say things twice."""
    for spec in p.wiring.bus_specs():
        b = budget(spec, p.wiring.rate)
        if b.load > LOAD_MAX:
            yield f"bus {spec.name}: got a load of {b.load:.0%} at {b.rate:g} Hz, expected at most {LOAD_MAX:.0%}"


def calibrated(p: Preflight) -> Iterator[str]:
    """A calibration of this robot, whole and checked."""
    if not is_needed(p.wiring):
        return
    if p.calibration is None:
        yield "got no calibration, expected one of this robot and wiring"
    else:
        yield from p.calibration.complaints(p.config, p.name)


def connected(p: Preflight) -> Iterator[str]:
    """Every motor answers, has the ranges of its model, and its watchdog holds what was programmed."""
    for bus in p.robot.buses:
        try:
            bus.connect(p.clock)
        except BusError as error:
            yield str(error)


def same_motors(p: Preflight) -> Iterator[str]:
    """The motors that were calibrated."""
    if p.calibration is None:
        return
    for bus in p.robot.buses:
        told = bus.fingerprints()
        for motor, fingerprint in zip(bus.spec.motors, told, strict=True):
            measured = p.calibration.motor(motor.joint)
            if measured and measured.fingerprint != fingerprint:
                yield f"{motor.joint}: got motor {fingerprint}, expected {measured.fingerprint}, which was calibrated"
        if warning := anonymous(bus, told):
            p.tell(warning)


def anonymous(bus: MotorBus, fingerprints: Sequence[str]) -> str:
    """What to know about the motors of ``bus`` that tell no serial number, by their fingerprints; "": all do, or the robot's
    maker calibrated it."""
    protocol = PROTOCOLS[bus.spec.protocol]
    names = [
        m.joint for m, told in zip(bus.spec.motors, fingerprints, strict=True)
        if not (protocol.serial and f"{protocol.serial} " in told)
    ]  # fmt: skip
    if protocol.calibrated or not names:
        return ""
    who = "its motors tell" if len(names) == len(fingerprints) else f"{', '.join(names)}: their motors tell"
    by = "bus and id, and what they say of their make" if any(fingerprints) else "bus and id"
    return (
        f"bus {bus.spec.name}: {who} no serial number: the calibration knows them by {by} alone, and one that was replaced "
        "by its like goes unnoticed. Calibrate again after replacing one"
    )


def variant(p: Preflight) -> Iterator[str]:
    """The hardware variant that robot YAML and policies were made for."""
    for bus in p.robot.buses:
        heard = getattr(bus, "variant", None)
        if heard is not None and p.variants and heard not in p.variants:
            allowed = " or ".join(map(str, p.variants))
            yield f"bus {bus.spec.name}: got mode_machine {heard}, expected {allowed} as robot and policies say"


def fresh(p: Preflight) -> Iterator[str]:
    """Everybody is heard now."""
    s, limits = p.look(round(LOOK_TIME * p.wiring.rate)), p.config.safety
    if not s.imu_age <= limits.imu_age:  # one that must be told to speak takes its time
        s = p.look(round(IMU_TIME * p.wiring.rate), lambda s: s.imu_age <= limits.imu_age)
    for joint, age, position in zip(p.config.joint_names, s.joint_age, s.joint_pos, strict=True):
        if not (age <= limits.joint_age and np.isfinite(position)):
            yield f"{joint}: last heard {age:.3g} s ago, expected at most {limits.joint_age:g} s"
    if not s.imu_age <= limits.imu_age:
        yield f"IMU: last heard {s.imu_age:.3g} s ago, expected at most {limits.imu_age:g} s"


def turns(p: Preflight) -> Iterator[str]:
    """Whole turns that an encoder lost since the calibration are put back, where only one of them fits the joint."""
    s = p.look()
    shift = np.zeros(len(s.joint_pos))
    turn: dict[str, float] = {}
    for bus in p.robot.buses:
        told = bus.turns()
        turn |= {m.joint: t for m, t in zip(bus.spec.motors, told, strict=True)}
        if not (PROTOCOLS[bus.spec.protocol].calibrated or any(told)):
            p.tell(
                f"bus {bus.spec.name}: its motors lose their zero without power, and cannot tell: were they without since "
                "the calibration, calibrate again"
            )
    for i, joint in enumerate(p.config.joints):
        if not turn[joint.name]:
            continue
        if np.isnan(turn[joint.name]):
            yield f"{joint.name}: {UNREFERENCED}"
            continue
        q, (low, high), margin = s.joint_pos[i], joint.position, p.config.safety.position_overrun
        shifts = [k * turn[joint.name] for k in TURNS]
        fitting = [x for x in shifts if low - margin <= q + x <= high + margin]
        if len(fitting) == 1:
            shift[i] = fitting[0]
            continue
        where = f"{joint.name}: reads {q:.3f} rad, its range is {low:g} to {high:g} rad"
        if fitting:
            what = "move it to the middle of its range"
            if high - low >= 2 * turn[joint.name]:
                what = f"its motor knows only where in a turn of {turn[joint.name]:.3f} rad it is: give it an output encoder, or set its position"
            yield f"{where}: {', '.join(f'{q + x:.3f}' for x in fitting)} fit; {what}"
        else:
            yield f"{where}: no whole turn brings it there"
    if shift.any():
        lost = ", ".join(p.config.joint_names[i] for i in np.flatnonzero(shift))
        p.tell(f"whole turns put back since the calibration: {lost}")
    p.robot.shift(shift)


def watchdogs(p: Preflight) -> Iterator[str]:
    """Every watchdog trips when nobody speaks: tried once, with motors that make no torque."""
    watched = [bus for bus in p.robot.buses if PROTOCOLS[bus.spec.protocol].watchdog]
    for bus in p.robot.buses:
        if bus not in watched:
            p.tell(f"bus {bus.spec.name}: no watchdog can be programmed; if this host dies its motors go on")
    if not watched:
        return
    try:
        yield from _trip(p, watched)
    finally:
        p.robot.disable()
    off = lambda s: not (s.joint_enabled.any() or s.joint_error.any())  # noqa: E731
    s = p.look(round(CLEAR_TIME * p.wiring.rate), off)
    for i in np.flatnonzero((s.joint_enabled != 0) | (s.joint_error != 0)):
        said = "enabled" if s.joint_enabled[i] else f"error {p.robot.error_name(int(i), int(s.joint_error[i]))}"
        yield f"{p.config.joint_names[i]}: {said} after its watchdog tripped, expected off and without error"


def _trip(p: Preflight, watched: list[MotorBus]) -> Iterator[str]:
    clock, period = p.clock, 1.0 / p.wiring.rate
    end = clock.now() + ENABLE_TIME
    states = [bus.read(clock.now()) for bus in watched]
    while not all(s.enabled.all() for s in states) and clock.now() < end:
        for bus in watched:
            bus.enable()
            bus.poll()  # some say only to a question whether they obey
        spoken = clock.now()
        clock.sleep_until(spoken + period)
        states = [bus.read(clock.now()) for bus in watched]
    off = [m.joint for bus, s in zip(watched, states, strict=True)
           for m, on in zip(bus.spec.motors, s.enabled, strict=True) if not on]  # fmt: skip
    if off:
        yield f"{', '.join(off)}: not enabled after {ENABLE_TIME:g} s, expected to be, to try the watchdog"
        return
    spoken = clock.now()  # at the latest
    clock.sleep_until(spoken + max(bus.spec.watchdog for bus in watched) + TRIP_MARGIN)
    asked = clock.now()
    while clock.now() < asked + ANSWER_TIME:
        for bus in watched:
            bus.poll()
        clock.sleep_until(clock.now() + period)
        states = [bus.read(clock.now()) for bus in watched]
        if all((s.time > asked).all() and not s.enabled.any() for s in states):
            return
    for bus, s in zip(watched, states, strict=True):
        for m, on, heard in zip(bus.spec.motors, s.enabled, s.time > asked, strict=True):
            if on or not heard:
                said = "is still enabled" if heard else "says nothing"
                yield (
                    f"{m.joint}: {said} {clock.now() - spoken:.3f} s after the last word to it, expected its watchdog of "
                    f"{bus.spec.watchdog:g} s to stop it"
                )


CALIBRATE = "`sim2real calibrate --robot ...` measures it"
DEMANDS: tuple[Demand, ...] = (
    Demand("bus load", bus_load, "`sim2real buses --robot ...` says what would fix it"),
    Demand("calibration", calibrated, CALIBRATE),
    Demand("motors", connected, "`sim2real scan --robot ...` says who is on the buses"),
    Demand("serial numbers", same_motors, f"was a motor replaced? {CALIBRATE}"),
    Demand("variant", variant, "limits and gains differ between variants: use a robot YAML and a policy for this one"),
    Demand("freshness", fresh, "`sim2real motors --robot ...` shows who is silent"),
    Demand("turns", turns, f"is it where it seems to be? {CALIBRATE}"),
    Demand("watchdogs", watchdogs, "nothing else stops these motors when this host dies: update their firmware"),
)
