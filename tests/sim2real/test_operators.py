"""Operators: what keys mean, on a real pseudo-terminal."""

from __future__ import annotations

import os
import pty
import termios

import pytest

from sim2real.guardian import operator_layout
from sim2real.operators import store
from sim2real.operators.keyboard import KeyboardOperator
from sim2real.types import OperatorInput, Sim2realError

LABELS = ["stand", "walk"]


@pytest.fixture
def terminal():
    """(the typist's end, an operator at the other end)"""
    ours, theirs = pty.openpty()
    with os.fdopen(theirs, "r") as stream:
        operator = KeyboardOperator(LABELS, stream=stream)
        yield ours, operator, theirs
        operator.close()
    os.close(ours)


def test_nothing_is_wished_before_a_key_is_pressed(terminal):
    _, operator, _ = terminal
    assert operator.read(1.0, -1.0) == OperatorInput(1.0)


def test_arming_stopping_and_arming_again(terminal):
    keys, operator, _ = terminal
    os.write(keys, b"a")
    assert operator.read(1.0, -1.0).arm and operator.read(1.1, -1.0).arm and not operator.read(1.3, -1.0).arm
    os.write(keys, b"a")  # refused the first time
    assert operator.read(2.0, -1.0).arm
    os.write(keys, b" ")
    wish = operator.read(3.0, 1.0)
    assert wish.stop and not wish.arm
    os.write(keys, b"a")
    wish = operator.read(4.0, 1.0)
    assert wish.arm and not wish.stop


def test_digits_pick_skills_and_strangers_are_ignored(terminal):
    keys, operator, _ = terminal
    os.write(keys, b"2")
    assert operator.read(1.0, 0.0).skill == "walk"
    os.write(keys, b"390z")
    assert operator.read(2.0, 0.0).skill == "walk"
    os.write(keys, b"1")
    assert operator.read(3.0, 0.0).skill == "stand"


def test_a_driving_key_lives_only_while_it_repeats(terminal):
    keys, operator, _ = terminal
    os.write(keys, b"\x1b[A")
    assert operator.read(1.0, 0.0).velocity == (0.5, 0.0, 0.0)
    assert operator.read(1.0 + operator.hold_time, 0.0).velocity == (0.5, 0.0, 0.0)
    assert operator.read(1.001 + operator.hold_time, 0.0).velocity == (0.0, 0.0, 0.0)
    os.write(keys, b"\x1b[D\x1b[C")  # the last one counts
    assert operator.read(5.0, 0.0).velocity == (0.0, -0.3, 0.0)
    os.write(keys, b",")
    assert operator.read(5.1, 0.0).velocity == (0.0, 0.0, 0.6)


def test_the_end_of_the_terminal_is_a_quit(terminal):
    keys, operator, _ = terminal
    os.write(keys, b"q")
    assert operator.read(1.0, 0.0).quit


def test_the_terminal_is_left_as_it_was_found():
    ours, theirs = pty.openpty()
    before = termios.tcgetattr(theirs)
    with os.fdopen(theirs, "r") as stream:
        operator = KeyboardOperator(LABELS, stream=stream)
        assert not termios.tcgetattr(theirs)[3] & termios.ICANON
        operator.close()
        assert termios.tcgetattr(theirs) == before
    os.close(ours)


def test_a_keyboard_needs_a_terminal(tmp_path):
    with open(tmp_path / "file", "w") as stream, pytest.raises(Sim2realError, match="no terminal"):
        KeyboardOperator(LABELS, stream=stream)


def test_a_wish_survives_its_record_and_an_unknown_label_is_none():
    record = operator_layout().new()
    store(OperatorInput(2.0, "walk", (0.1, 0.2, 0.3), arm=True, stop=True, quit=True), LABELS, record)
    r = record[0]
    assert (r["time"], r["skill"], r["arm"], r["stop"], r["quit"]) == (2.0, 1, 1, 1, 1)
    assert tuple(r["velocity"]) == (0.1, 0.2, 0.3)
    store(OperatorInput(2.0, "fly"), LABELS, record)
    assert record["skill"][0] == -1
