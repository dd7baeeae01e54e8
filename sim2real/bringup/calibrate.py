"""Where a joint's zero is on its motor, and which way it turns: found by moving it by hand from one stop to the other.

Motors are off and only asked. The range of the joint is known from the YAML, that of the motor is measured; they lie on
each other in two ways, and the order in which the joint was held at its ends, the lower one first, tells which. Where
the body blocks one stop (``reach`` in the YAML), the other is enough, touched twice. Then the robot hangs still, and
two checks find what a hand did wrong: a limp joint at rest bears no more torque than its friction holds, and left and
right hang alike.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np

from drivers.bus import Clock
from sim2real.calibration import MotorCalibration
from sim2real.config import RobotConfig, Wiring
from sim2real.preflight import UNREFERENCED, anonymous
from sim2real.records import layout, state_fields, state_view
from sim2real.robot import Robot
from sim2real.types import RobotState, Sim2realError

ASK_PERIOD = 0.02  # s between two questions to every motor
SPAN_TOLERANCE = 0.1  # rad by which a range between stops may differ from the YAML's
REST = 0.02  # rad that a joint which is held still may move
HOLD_TIME = 0.8  # s for which it is held at its upper end
NEAR = 0.05  # rad from an end that is at it
AWAY, AWAY_SHARE = 0.2, 0.2  # rad from an end that is not, and the share of a short range that is as good
QUIET_TIME, QUIET_VELOCITY = 1.0, 0.05  # s, rad/s: the robot hangs still
TORQUE_SHARE = 0.03  # of a joint's torque that friction may hold, where the model says less
SYMMETRY = 0.25  # rad between left and right, hanging


def bare(wiring: Wiring) -> Wiring:
    """The wiring as if joints were motors: no signs, no offsets."""
    plain = {"sign": 1, "offset": 0.0}
    buses = [b.model_copy(update={"motors": [m.model_copy(update=plain) for m in b.motors]}) for b in wiring.buses]
    return wiring.model_copy(update={"buses": buses})


class Motors:
    """All motors of a robot, seen in their own coordinates (a Robot of a ``bare`` wiring) and never commanded."""

    def __init__(self, config: RobotConfig, robot: Robot, clock: Clock) -> None:
        """Connects. Raises BusError."""
        self.config, self.clock, self.robot = config, clock, robot
        self._state = state_view(layout("State", state_fields(config.joint_names)).new())
        robot.connect(clock)
        self.turn: dict[str, float] = {}
        self.fingerprint: dict[str, str] = {}
        self.place: dict[str, tuple[str, int]] = {}  # bus and id
        self.warnings: list[str] = []  # of buses whose motors tell no serial number
        for bus in robot.buses:
            fingerprints = bus.fingerprints()
            if warning := anonymous(bus, fingerprints):
                self.warnings.append(warning)
            for motor, fingerprint, turn in zip(bus.spec.motors, fingerprints, bus.turns(), strict=True):
                if np.isnan(turn):
                    raise Sim2realError(f"{motor.joint}: {UNREFERENCED}")
                self.turn[motor.joint], self.fingerprint[motor.joint] = turn, fingerprint
                self.place[motor.joint] = bus.spec.name, motor.id

    def look(self) -> RobotState:
        """Ask, and a moment later: what everybody said (the same object each time). Raises Sim2realError for motors that
        fell silent."""
        self.robot.poll()
        self.clock.sleep_until(self.clock.now() + ASK_PERIOD)
        self.robot.read(self.clock.now(), self._state)
        silent = [j for j, age in zip(self.config.joint_names, self._state.joint_age, strict=True) if age > 0.5]
        if silent:
            raise Sim2realError(f"{', '.join(silent)}: silent for 0.5 s; check power and connector, then start again")
        return self._state


@dataclass
class Track:
    """Where a motor was while a hand moved its joint. ``turn``: rad that it jumps by where its count wraps.

    ``holds``: where it was held still, one after the other, once it had been moved at all: where it happened to be before
    says nothing. ``away``: rad that are a move.
    """

    turn: float
    away: float = AWAY
    low: float = np.inf  # rad
    high: float = -np.inf
    last: float = np.nan
    jumped: float = 0.0  # rad at once, farther than any hand moves it
    holds: list[float] = field(default_factory=list)
    _first: float = field(default=np.nan, repr=False)
    _moved: bool = field(default=False, repr=False)
    _anchor: float = field(default=np.nan, repr=False)
    _since: float = field(default=np.inf, repr=False)
    _left: bool = field(default=True, repr=False)  # where it was held last

    def see(self, time: float, position: float) -> None:
        """The motor is at ``position`` (rad)."""
        if np.isnan(self._first):
            self._first = position
        if self.turn and abs(position - self.last) > self.turn / 2:
            self.jumped = position - self.last
        self.low, self.high, self.last = min(self.low, position), max(self.high, position), position
        self._moved |= abs(position - self._first) > self.away
        if not abs(position - self._anchor) <= REST:
            self._anchor, self._since = position, time
        self._left |= bool(self.holds) and abs(position - self.holds[-1]) > self.away
        if self._moved and self._left and time - self._since >= HOLD_TIME:
            self.holds.append(position)
            self._left = False

    @property
    def span(self) -> float:
        """rad between the farthest places."""
        return max(0.0, self.high - self.low)

    def ends(self) -> int:
        """Held at both its ends, one after the other: 1 if at its greatest place last, -1 if at its least; 0: not so."""
        held = self._held_ends()
        return held[-1] if len(held) > 1 and held[-1] != held[-2] else 0

    def twice(self) -> int:
        """Held at one end, moved away and held there again: 1 at its greatest place, -1 at its least; 0: not so."""
        held = self._held_ends()
        return held[-1] if held and held.count(held[-1]) > 1 else 0

    def _held_ends(self) -> list[int]:
        """At which of its ends it was held, in turn; what was held between them does not count. Empty: not at one now."""
        if not self.holds or min(self.high - self.holds[-1], self.holds[-1] - self.low) > NEAR:
            return []
        sides = [1 if self.high - h < NEAR else -1 if h - self.low < NEAR else 0 for h in self.holds]
        return [side for side in sides if side]


def measure(
    motors: Motors, joint: str, timeout: float = 120.0, show: Callable[[float], None] = lambda span: None
) -> MotorCalibration:
    """Watch ``joint`` being moved to its lower stop, then to its upper one and held there. ``show(span)``: each look.

    Raises Sim2realError if its range is not that of the YAML, its count wraps within it, or another motor moved.
    """
    config, clock = motors.config, motors.clock
    index = config.joint_names.index(joint)
    position = config.joints[index].position
    ranges = [j.position[1] - j.position[0] for j in config.joints]
    expected = ranges[index]
    tracks = [
        Track(motors.turn[name], min(AWAY, AWAY_SHARE * r)) for name, r in zip(config.joint_names, ranges, strict=True)
    ]
    end = clock.now() + timeout
    mine, reach = tracks[index], config.joints[index].reach
    while True:
        state, now = motors.look(), clock.now()
        for track, q in zip(tracks, state.joint_pos, strict=True):
            track.see(now, float(q))
        show(mine.span)
        if mine.jumped:
            raise Sim2realError(
                f"{joint}: its motor jumped by {mine.jumped:.2f} rad: its count wraps within the joint's range\n"
                "  Remount it, or turn its zero, so that the whole range lies within one turn"
            )
        if mine.span > expected + SPAN_TOLERANCE:
            raise Sim2realError(
                f"{joint}: moved over {mine.span:.3f} rad, expected {expected:.3f} between its stops ({position[0]:g} to "
                f"{position[1]:g}): is this the joint, and are these its stops?"
            )
        held = mine.twice() if reach != "both" else mine.ends() if mine.span >= expected - SPAN_TOLERANCE else 0
        if held:
            break
        others = [
            (name, t.span) for name, t in zip(config.joint_names, tracks, strict=True)
            if reach == "both" and abs(t.span - expected) < SPAN_TOLERANCE and t.ends() and mine.span < expected / 4
        ]  # fmt: skip
        if others:
            named = " or ".join(name for name, _ in others)
            raise Sim2realError(
                f"{joint}: the motor of {named} moved over its range instead, its own over {mine.span:.3f} rad: are "
                "their ids swapped? `sim2real setup` gives ids, one motor at a time"
            )
        if now > end:
            raise Sim2realError(
                f"{joint}: moved over {mine.span:.3f} of {expected:.3f} rad within {timeout:g} s, expected both stops"
            )
    sign = -held if reach == "lower" else held
    if reach == "both":
        offset = (mine.low + mine.high) / 2 - sign * sum(position) / 2
    else:
        stop = mine.high if held > 0 else mine.low
        offset = stop - sign * position[reach == "upper"]
    bus, id = motors.place[joint]
    return MotorCalibration(
        joint=joint, bus=bus, id=id, fingerprint=motors.fingerprint[joint], sign=1 if sign > 0 else -1,
        offset=round(offset, 6), position=position, span=round(mine.span, 6),
    )  # fmt: skip


def rest(motors: Motors, timeout: float = 60.0) -> RobotState:
    """Wait until everything hangs still. Raises Sim2realError."""
    end = motors.clock.now() + timeout
    since = motors.clock.now()
    while True:
        state, now = motors.look(), motors.clock.now()
        if not (np.abs(state.joint_vel) < QUIET_VELOCITY).all():
            since = now
        if now - since > QUIET_TIME:
            return state
        if now > end:
            moving = [
                j for j, v in zip(motors.config.joint_names, state.joint_vel, strict=True) if abs(v) >= QUIET_VELOCITY
            ]
            raise Sim2realError(f"{', '.join(moving)}: still moving after {timeout:g} s; hold the robot still")


def checks(
    config: RobotConfig, site: str, measured: Sequence[MotorCalibration], state: RobotState, orientation: np.ndarray
) -> Iterator[str]:
    """What contradicts the calibration while the robot hangs still: a line each.

    ``state``: in motor coordinates; ``orientation``: of the base (4,) w, x, y, z; ``site``: of the IMU.
    """
    from drivers.sim.plant import Plant

    of = {m.joint: m for m in measured}
    known = [of[j] for j in config.joint_names]
    q = np.array([m.sign * (p - m.offset) for m, p in zip(known, state.joint_pos, strict=True)])
    model = Plant(config.model_path, config.joint_names, config.base, imu_site=site)
    mirror = _mirrors(config.joint_names, model.axes_in_base)
    torque = model.gravity_torque(q, orientation)
    slack = np.maximum(2 * model.friction, TORQUE_SHARE * config.torque_max)
    for i, joint in enumerate(config.joints):
        if joint.group == "waist":  # which bears the robot's lower half if it hangs by its shoulders
            continue
        low, high = joint.position
        pressed = (torque[i] > 0 and q[i] < low + NEAR) or (torque[i] < 0 and q[i] > high - NEAR)  # against its stop
        if abs(torque[i]) > slack[i] and not pressed:
            yield (
                f"{joint.name}: at {q[i]:.2f} rad gravity turns it with {-torque[i]:.1f} N m, and yet it hangs still; "
                f"expected at most {slack[i]:.1f}. Were its ends taken for each other?"
            )
    for left, right, sign in mirror:
        alike = q.copy()
        alike[right] = sign * q[left]
        if abs(q[left] - sign * q[right]) > SYMMETRY and (
            abs(model.gravity_torque(alike, orientation)[right]) > slack[right]  # else friction holds it anywhere
        ):
            yield (
                f"{config.joint_names[left]} hangs at {q[left]:.2f} rad and {config.joint_names[right]} at {q[right]:.2f}, "
                f"expected {'the same' if sign > 0 else 'opposites'} within {SYMMETRY:g}. Did one of them come down the other "
                "way round (three axes reach every place twice)? Lay both down alike and start again: what is measured is kept"
            )


def _mirrors(names: Sequence[str], axes: np.ndarray) -> Iterator[tuple[int, int, int]]:
    """Pairs of joints that are each other's mirror image: indices, and the sign between their positions. Mirrored left to
    right, an axis (x, y, z) of rotation becomes (-x, y, -z)."""
    for i, name in enumerate(names):
        other = name.replace("left", "right", 1)
        if other != name and other in names:
            k = names.index(other)
            yield i, k, 1 if float(axes[i] * (-1, 1, -1) @ axes[k]) > 0 else -1
