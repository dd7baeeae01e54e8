"""Print the tables of SAFETY.md."""

from sim2real.safety.rules import markdown

print(markdown())
