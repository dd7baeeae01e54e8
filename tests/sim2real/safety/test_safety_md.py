"""SAFETY.md promises what it should, and its tables are the code's."""

from __future__ import annotations

import runpy
from pathlib import Path

from sim2real.safety.rules import CLAMPS, RULES, When

TEXT = (Path(__file__).resolve().parents[3] / "SAFETY.md").read_text()
PROMISE = """1. No command reaches a motor unless every value in it is finite and inside that joint's limits.
2. Whatever stops - operator, policy, process or host - every motor is damping within 100 ms.
3. Nothing moves until an operator arms it; a fault latches, and cannot be cleared while its cause persists.
"""


def test_it_begins_with_the_promise():
    assert TEXT.startswith(f"# Safety\n\n{PROMISE}\n")


def test_its_tables_are_the_rules(capsys):
    runpy.run_module("sim2real.safety", run_name="__main__")
    tables = capsys.readouterr().out
    assert tables.count("\n| S2R-") == len(RULES) + len(CLAMPS)
    assert f"-->\n\n{tables}\n## " in TEXT, (
        "SAFETY.md: the tables are old; put the output of `python -m sim2real.safety`"
    )


def test_numbers_are_given_once_and_for_good_and_the_table_is_in_the_order_of_asking():
    numbers = [row.number for row in (*RULES, *CLAMPS)]
    assert len(set(numbers)) == len(numbers)
    order = list(When)
    assert [order.index(rule.when) for rule in RULES] == sorted(order.index(rule.when) for rule in RULES)


def test_every_bound_is_within_the_promise():
    assert max(rule.bound for rule in RULES) < 0.1
