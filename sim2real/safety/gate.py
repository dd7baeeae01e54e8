"""Safety: the gate between whoever decides and the motors. Pure: no I/O, no clock, no logging, and it never raises."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from sim2real.safety.evidence import Evidence
from sim2real.safety.limits import KD, KP, POSITION, TORQUE, VELOCITY, Limiter, Limits
from sim2real.safety.rules import RULES, Rule, When
from sim2real.types import JointCommand, Mode, RobotState

# The table is in the order of When, so that what is asked is always its beginning.
DISARMED = [rule for rule in RULES if rule.when is When.ALWAYS]
ARMED = [rule for rule in RULES if rule.when is not When.ARM]


class Fault(NamedTuple):
    """A rule that was broken, and by what. ``over``: it is no longer."""

    rule: Rule
    joint: int  # index, -1: of no joint
    value: float  # in ``rule.unit``
    limit: float
    time: float  # s, when it was found, or found to be over
    over: bool = False


class Safety:
    """The ladder RUN < HOLD < DAMP < OFF. It begins in OFF; ``arm`` is the only way down it, to RUN.

    HOLD alone ends by itself, when its cause ends within ``hold_time``. Everything above it is latched.
    """

    def __init__(self, limits: Limits):
        self.limits = limits
        self.mode = Mode.OFF
        self.fault: Fault | None = None  # the first cause of the mode; None: none, or the operator's stop
        self.limited = 0  # joints whose command was changed in this step
        self.events: tuple[Fault, ...] = ()  # faults that began or ended in this step, latched or not
        self._evidence = Evidence(limits)
        self._limiter = Limiter(limits)
        self._values = np.empty((len(RULES), len(limits.joint_names)))
        self._rows = list(self._values)
        self._limits = np.empty_like(self._values)
        for i, rule in enumerate(RULES):
            self._limits[i] = rule.limit(limits)
        self._present: dict[int, Fault] = {}  # rule number -> what breaks it now
        t = self._limiter.targets
        self._command = JointCommand(math.nan, t[POSITION], t[VELOCITY], t[TORQUE], t[KP], t[KD])

    def arm(self, state: RobotState, now: float) -> str | None:
        """Go to RUN from where the robot stands, or say what forbids it. While armed: nothing to do.

        Commands that were decided before this are not obeyed: until one comes, kp is 0.
        """
        refusal = None
        if self.mode > Mode.HOLD:
            evidence = self._evidence
            with np.errstate(all="ignore"):
                evidence.see(state, now)
                broken = self._broken(RULES)
            forbidding = [fault for fault in broken if self._forbids_arming(fault.rule)]
            if forbidding:
                refusal = self.explain(forbidding[0], self.limits.joint_names)
            else:
                self.mode, self.fault = Mode.RUN, None
                evidence.armed_since, evidence.holding_since = evidence.now, math.inf
                self._limiter.damp(evidence.joint_pos)
        return refusal

    def stop(self, now: float) -> None:
        """The operator's stop: DAMP from the next step on. Never refused; OFF stays OFF."""
        self.mode = max(self.mode, Mode.DAMP)

    disarm = stop

    def off(self) -> None:
        """OFF until ``arm``."""
        self.mode = Mode.OFF

    def step(self, state: RobotState, command: JointCommand | None, now: float) -> JointCommand:
        """What may be sent to the motors now. Returns the same object each call.

        ``command`` is the newest there is, None: none yet. ``now`` in s. In RUN and HOLD the result is limited, in DAMP
        it is kp = 0, kd = damping at the measured position, in OFF it is zero and not to be sent.
        """
        evidence, limiter = self._evidence, self._limiter
        with np.errstate(all="ignore"):
            evidence.see(state, now)
            evidence.hear(command)
            self._judge(ARMED if self.mode <= Mode.HOLD else DISARMED)
            self.limited = 0
            if self.mode == Mode.OFF:
                limiter.rest()
            elif self.mode == Mode.DAMP:
                limiter.damp(evidence.joint_pos)
            else:
                obey = self.mode == Mode.RUN and evidence.command_time >= evidence.armed_since
                request = evidence.request if obey else limiter.targets.copy()
                self.limited = limiter.limit(request, evidence.joint_pos, evidence.joint_vel, evidence.gap)
        self._command.time = evidence.now
        return self._command

    def explain(self, fault: Fault, joint_names: Sequence[str]) -> str:
        """A fault in words: what, where, got, expected, next step."""
        rule = fault.rule
        where = f"{joint_names[fault.joint]}: " if fault.joint >= 0 else ""
        unit = f" {rule.unit}" if rule.unit else ""
        return (
            f"{rule.id} {rule.name}: {where}{rule.description}: "
            f"got {fault.value:.4g}{unit}, expected at most {fault.limit:.4g}; {rule.remedy}"
        )

    def _forbids_arming(self, rule: Rule) -> bool:
        if rule.when is When.COMMAND:
            return self.fault is not None and self.fault.rule is rule
        return rule.when is not When.ARMED and rule.reaction > Mode.RUN

    def _broken(self, asked: Sequence[Rule]) -> list[Fault]:
        """Which rules the evidence breaks, of those that begin the table."""
        evidence = self._evidence
        for row, rule in zip(self._rows, asked, strict=False):
            row[:] = rule.value(evidence)
        kept = self._values[: len(asked)] <= self._limits[: len(asked)]
        whole = np.logical_and.reduce(kept, axis=1).tolist()
        return [self._fault(i, kept[i]) for i, every in enumerate(whole) if not every]

    def _fault(self, i: int, kept: np.ndarray) -> Fault:
        rule, worst = RULES[i], int(kept.argmin())
        joint = worst if np.ndim(rule.value(self._evidence)) else -1
        return Fault(rule, joint, float(self._values[i, worst]), float(self._limits[i, worst]), self._evidence.now)

    def _judge(self, asked: Sequence[Rule]) -> None:
        """Tell what began and ended, and take the ladder to the gravest reaction that a broken rule asks for."""
        faults = self._broken(asked)
        present = {fault.rule.number: fault for fault in faults}
        began = [fault for number, fault in present.items() if number not in self._present]
        now = self._evidence.now
        over = [f._replace(over=True, time=now) for f in self._present.values() if f.rule.number not in present]
        self.events = (*began, *(fault for fault in over if fault.rule in asked))
        self._present = present
        if self.mode > Mode.HOLD:
            return
        gravest = max(faults, key=lambda fault: fault.rule.reaction, default=None)
        if gravest is None or gravest.rule.reaction == Mode.RUN:
            self.mode, self.fault, self._evidence.holding_since = Mode.RUN, None, math.inf
            return
        if self.mode == Mode.RUN:
            self.fault, self._evidence.holding_since = gravest, now
        self.mode = gravest.rule.reaction
