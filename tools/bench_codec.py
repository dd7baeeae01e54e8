"""Benchmark: packing and unpacking a whole G1 against one motor and one field at a time."""

from __future__ import annotations

import importlib.util
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import numpy as np
from bench_table import ROOT, Row, interleaved

from drivers.bus import MotorSpec
from drivers.codecs.damiao import ranges_of
from drivers.codecs.mit import MitCodec
from sim2real.config import load_robot

FACTOR = 8.0  # how many times faster than the incumbent we want to be


def rows() -> Iterator[Row]:
    """The whole wiring of the G1 in one call each way, and bus by bus as a deploy does it."""
    buses = [bus.motors for bus in load_robot("g1").wiring("can").bus_specs()]
    yield compared("in one call each way", [sum(buses, ())], FACTOR)
    yield compared(f"in {len(buses)} calls each way, bus by bus", buses)


def compared(words: str, batches: list[tuple[MotorSpec, ...]], factor: float | None = None) -> Row:
    """``batches``: the motors of each call. Both codecs are first checked to agree."""
    reference = load(ROOT / "tests" / "drivers" / "reference_mit.py")
    rng = np.random.default_rng(0)
    vectors, scalars = [], []
    for motors in batches:
        ranges = ranges_of(motors)
        commands = np.abs(rng.uniform(-1, 1, (5, len(motors))))
        replies = rng.integers(0, 256, (len(motors), 8), np.uint8)
        vectors.append((MitCodec(ranges), commands, replies))
        scalars += zip(commands.T.tolist(), [bytes(r) for r in replies], np.array(ranges).T.tolist(), strict=True)

    def ours() -> None:
        for codec, commands, replies in vectors:
            codec.pack_command(*commands)
            codec.unpack_feedback(replies)

    def one_by_one() -> None:
        for command, reply, scale in scalars:
            reference.pack_command(*command, *scale)
            reference.unpack_feedback(reply, *scale[:3])

    packed = [bytes(frame) for codec, commands, _ in vectors for frame in codec.pack_command(*commands)]
    assert packed == [reference.pack_command(*c, *s) for c, _, s in scalars], "the codecs disagree: nothing to compare"
    took = interleaved({"ours": ours, "one by one": one_by_one})
    ratio = took["one by one"] / took["ours"]
    return Row(
        f"codec: pack and unpack {len(scalars)} motors {words}",
        f"{took['ours'] * 1e6:.1f} us",
        f"{took['one by one'] * 1e6:.0f} us motor by motor in Python",
        f"{ratio:.1f}x faster",
        f">= {factor:g}x" if factor else "",
        ratio >= factor if factor else None,
        {"seconds": took},
    )


def load(path: Path) -> ModuleType:
    """A module from a file that is in no package."""
    spec = importlib.util.spec_from_file_location(path.stem, path)
    assert spec and spec.loader
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # where dataclasses look for their module
    spec.loader.exec_module(module)
    return module
