"""The safety gate: numpy only, no I/O, no clock, no logging."""

from sim2real.safety.gate import Fault, Safety
from sim2real.safety.limits import Limits
from sim2real.safety.rules import RULES, Rule

__all__ = ["RULES", "Fault", "Limits", "Rule", "Safety"]
