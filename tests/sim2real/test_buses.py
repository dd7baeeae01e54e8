"""``sim2real buses``: the numbers are the budget's, and every remedy it names is one."""

from __future__ import annotations

import json
import re
from dataclasses import replace

import pytest

from drivers.budget import LOAD_MAX, budget
from sim2real.cli import buses, main
from sim2real.config import load_robot


def test_every_wiring_of_every_robot_is_within_its_budget(robot, capsys):
    for name, wiring in robot.wirings.items():
        assert main(["buses", "--robot", str(robot.path), "--wiring", name]) == 0
        said = capsys.readouterr().out
        assert all(bus.name in said for bus in wiring.buses)


@pytest.mark.parametrize("rate", [500.0, 700.0, 1000.0, 2500.0])
def test_every_remedy_is_one(rate):
    for spec in load_robot("g1").wiring("can").bus_specs():
        fixes = buses.remedies(spec, rate)
        assert bool(fixes) == (budget(spec, rate).load > LOAD_MAX)
        if not fixes:
            continue
        slower = float(re.search(r"([0-9]+) Hz", fixes[0])[1])
        assert budget(spec, slower).load <= LOAD_MAX < budget(spec, slower + 1).load
        if match := re.search(r"at most ([0-9]+) of", fixes[1]):
            k = int(match[1])
            assert budget(replace(spec, motors=spec.motors[:k]), rate).load <= LOAD_MAX
            assert budget(replace(spec, motors=spec.motors[: k + 1]), rate).load > LOAD_MAX
        faster = float(re.search(r"([0-9.]+) Mbit/s", fixes[2])[1]) * 1e6
        assert budget(replace(spec, bitrate=int(faster)), rate).load == pytest.approx(LOAD_MAX, rel=0.05)


def test_one_motor_that_is_too_much():
    spec = load_robot("g1").wiring("can").bus_specs()[0]
    assert "no number of buses" in buses.remedies(spec, 4000.0)[1]


def test_an_overload_is_exit_code_1_and_says_what_would_do(capsys):
    assert main(["buses", "--robot", "g1", "--rate", "1000"]) == 1
    said = capsys.readouterr().out
    assert "left_leg is overloaded" in said and "at most 3 of its 6 motors" in said


def test_json(capsys):
    assert main(["buses", "--robot", "g1", "--wiring", "dds", "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    (bus,) = document["buses"]
    assert bus["frames"] == 2 and bus["motors"] == 29 and bus["fixes"] == [] and document["rate"] == 250
