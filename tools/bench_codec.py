"""Benchmark: packing and unpacking a whole G1 against one motor and one field at a time."""

from __future__ import annotations

import importlib.util
from collections.abc import Iterator
from types import ModuleType

import numpy as np
from bench_table import ROOT, Row, interleaved

from drivers.codecs.damiao import ranges_of
from drivers.codecs.mit import MitCodec
from sim2real.config import load_robot

FACTOR = 8.0  # how many times faster than the incumbent we want to be


def rows() -> Iterator[Row]:
    """The whole wiring of the G1 in one call each way, checked first to agree with the reference."""
    reference = load(ROOT / "tests" / "drivers" / "reference_mit.py")
    motors = tuple(m for bus in load_robot("g1").wiring("can").bus_specs() for m in bus.motors)
    ranges = ranges_of(motors)
    codec = MitCodec(ranges)
    rng = np.random.default_rng(0)
    commands = rng.uniform(-1, 1, (5, len(motors)))
    commands[2:4] = np.abs(commands[2:4])
    replies = rng.integers(0, 256, (len(motors), 8), np.uint8)
    scales = np.array(ranges).T.tolist()  # position, velocity, torque, kp, kd of each motor
    each_command, each_reply = commands.T.tolist(), [bytes(r) for r in replies]

    def ours() -> None:
        codec.pack_command(*commands)
        codec.unpack_feedback(replies)

    def one_by_one() -> None:
        for command, scale, reply in zip(each_command, scales, each_reply, strict=True):
            reference.pack_command(*command, *scale)
            reference.unpack_feedback(reply, *scale[:3])

    expected = [reference.pack_command(*c, *s) for c, s in zip(each_command, scales, strict=True)]
    assert [bytes(f) for f in codec.pack_command(*commands)] == expected, "the two codecs disagree: nothing to compare"
    took = interleaved({"ours": ours, "one by one": one_by_one})
    ratio = took["one by one"] / took["ours"]
    yield Row(
        f"codec: pack and unpack {len(motors)} motors",
        f"{took['ours'] * 1e6:.1f} us",
        f"{took['one by one'] * 1e6:.0f} us motor by motor in Python",
        f"{ratio:.1f}x faster",
        f">= {FACTOR:g}x",
        ratio >= FACTOR,
        {"seconds": took},
    )


def load(path) -> ModuleType:
    """A module from a file that is in no package."""
    spec = importlib.util.spec_from_file_location(path.stem, path)
    assert spec and spec.loader
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module
