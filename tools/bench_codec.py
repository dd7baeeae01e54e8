"""Benchmark: packing and unpacking a whole G1 against one motor and one field at a time."""

from __future__ import annotations

import importlib.util
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from types import ModuleType

import can
import numpy as np
from bench_table import ROOT, Row, interleaved

from drivers.bus import MotorCommand
from drivers.codecs.damiao import DamiaoTick, ranges_of
from drivers.codecs.mit import MitCodec
from sim2real.config import load_robot

FACTOR, PACK_FACTOR = 8.0, 10.0  # how many times faster than the incumbents we want to be


def rows() -> Iterator[Row]:
    """The payloads alone, both ways; and what a deploy sends in a tick, as frames. The codecs are first checked to agree."""
    reference = load(ROOT / "tests" / "drivers" / "reference_mit.py")
    motors = [m for bus in load_robot("g1").wiring("can").bus_specs() for m in bus.motors]
    ranges, tick = ranges_of(motors), DamiaoTick(motors)
    codec, rng = MitCodec(ranges), np.random.default_rng(0)
    command = MotorCommand(*np.abs(rng.uniform(-1, 1, (5, len(motors)))))
    values = command.position, command.velocity, command.kp, command.kd, command.torque
    replies = rng.integers(0, 256, (len(motors), 8), np.uint8)
    scalars = list(
        zip(np.array(values).T.tolist(), [bytes(r) for r in replies], np.array(ranges).T.tolist(), strict=True)
    )

    def ours() -> None:
        codec.pack_command(*values)
        codec.unpack_feedback(replies)

    def one_by_one() -> None:
        for asked, reply, scale in scalars:
            reference.pack_command(*asked, *scale)
            reference.unpack_feedback(reply, *scale[:3])

    def messages() -> list[can.Message]:
        packed = ((m.id, reference.pack_command(*asked, *s)) for m, (asked, _, s) in zip(motors, scalars, strict=True))
        return [can.Message(arbitration_id=id, data=data, is_extended_id=False) for id, data in packed]

    frames = tick.pack_command(command)
    assert [bytes(f) for f in codec.pack_command(*values)] == [bytes(m.data) for m in messages()], "the codecs disagree"
    assert [(f["id"], bytes(f["data"])) for f in frames] == [(m.arbitration_id, bytes(m.data)) for m in messages()]
    n = len(motors)
    yield compared(f"pack and unpack {n} motors", ours, one_by_one, "motor by motor in Python", FACTOR)
    yield compared(
        f"pack a tick of {n} motors into frames, as a deploy does", lambda: tick.pack_command(command), messages,
        "motor by motor into python-can's messages, as lerobot does", PACK_FACTOR,
    )  # fmt: skip


def compared(
    words: str, ours: Callable[[], object], theirs: Callable[[], object], incumbent: str, factor: float
) -> Row:
    """One row of both, timed in turns."""
    took = interleaved({"ours": ours, "theirs": theirs})
    ratio = took["theirs"] / took["ours"]
    return Row(
        f"codec: {words}",
        f"{took['ours'] * 1e6:.1f} us",
        f"{took['theirs'] * 1e6:.0f} us {incumbent}",
        f"{ratio:.1f}x faster",
        f">= {factor:g}x",
        ratio >= factor,
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
