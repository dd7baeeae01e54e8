"""The wire of a bus at a bit rate of choice, as long as motors may still listen at another."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

from drivers.bus import BusSpec
from drivers.open import open_wire


@contextmanager
def opened(spec: BusSpec, world: Any, bitrate: int) -> Iterator[Any]:
    """The wire of ``spec`` at ``bitrate``; of a simulated ``world`` where there is one. Raises BusError."""
    if world is not None:
        lines = [*world.buses, *getattr(world, "lines", ())]
        next(line for line in lines if line.spec.name == spec.name).retune(bitrate)
        yield world.wires[spec.name]
        return
    wire = open_wire(replace(spec, bitrate=bitrate))
    try:
        yield wire
    finally:
        wire.close()
