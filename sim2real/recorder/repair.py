"""What is left of a damaged record, as a whole file."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

from sim2real.recorder.mcap import PART, Writer
from sim2real.recorder.reader import Reader
from sim2real.types import Sim2realError


class Repair(NamedTuple):
    """What ``repair`` did. ``recovered``: topic -> records; ``duration`` (s) of what they cover; ``damage``: sentences."""

    source: Path
    output: Path
    recovered: dict[str, int]
    duration: float
    damage: list[str]


def repair(source: Path | str, output: Path | str | None = None) -> Repair:
    """Write everything readable in ``source`` into ``output`` (default: ``<name>-repaired.mcap`` beside it).

    ``source`` stays as it is. Raises Sim2realError where nothing can be saved, or ``output`` exists.
    """
    source = Path(source)
    reader = Reader(source, salvage=True)
    if not reader.layouts:
        raise Sim2realError(f"{source}: nothing to save: {reader.damage[0]}, before the description of its records")
    name = source.name.removesuffix(PART).removesuffix(".mcap")
    output = Path(output) if output else source.with_name(f"{name}-repaired.mcap")
    writer = Writer(output, reader.layouts, reader.metadata, reader.attachments)
    order = sorted(
        (time, topic, i)
        for topic, name in enumerate(reader.topics)
        for i, time in enumerate(reader.log_time[name].tolist())
    )
    arrays = [reader[name] for name in reader.topics]
    for time, topic, i in order:
        writer.write(topic, time / 1e9, arrays[topic][i].tobytes())
    if writer.stopped:
        writer.finish()
        raise Sim2realError(f"{writer.stopped}; the repair is incomplete: free some space, or name another file")
    writer.finish({**reader.ending, "damage": reader.damage})
    return Repair(
        source,
        output,
        {topic: len(reader[topic]) for topic in reader.topics},
        (order[-1][0] - order[0][0]) / 1e9 if order else 0.0,
        reader.damage,
    )
