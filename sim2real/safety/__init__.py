"""The safety gate: numpy only, no I/O, no clock, no logging."""

from sim2real.safety.gate import Fault as Fault
from sim2real.safety.gate import Safety as Safety
from sim2real.safety.limits import Limits as Limits
from sim2real.safety.rules import RULES as RULES
from sim2real.safety.rules import Rule as Rule
