"""Records as the files that other tools take: one .npz, or a .csv for each topic."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np

from sim2real.recorder.reader import Reader
from sim2real.types import Sim2realError


def export(reader: Reader, output: Path | str) -> list[Path]:
    """Write every topic to ``output``: ``.npz`` (arrays ``tick/state.joint_pos`` (n, joints), and under ``.names`` what
    their columns are) or ``.csv`` (one file a topic, one column an element). Returns the files. Raises Sim2realError."""
    output = Path(output)
    writers = {".npz": _npz, ".csv": _csv}
    if output.suffix not in writers:
        raise Sim2realError(f"{output}: got '{output.suffix}', expected one of {', '.join(writers)}")
    try:
        return writers[output.suffix](reader, output)
    except OSError as error:
        raise Sim2realError(f"{output}: cannot write: {error.strerror}; name another file with -o") from None


def _npz(reader: Reader, output: Path) -> list[Path]:
    arrays = {}
    for topic in reader.topics:
        for field in reader[topic].dtype.names or ():
            key = f"{topic.strip('/')}/{field}"
            arrays[key] = reader[topic][field]
            if names := reader.layouts[topic].elements.get(field):
                arrays[f"{key}.names"] = np.array(names)
    np.savez_compressed(output, **arrays)
    return [output]


def _csv(reader: Reader, output: Path) -> list[Path]:
    written = []
    for topic in reader.topics:
        path = output.with_name(f"{output.stem}-{''.join(c for c in topic if c.isalnum())}.csv")
        elements = reader.layouts[topic].elements
        fields = reader[topic].dtype.names or ()
        head = [c for f in fields for c in ([f"{f}.{e}" for e in elements[f]] if f in elements else [f])]
        with path.open("w", newline="", encoding="utf-8") as file:
            out = csv.writer(file)
            out.writerow(head)
            columns = [reader[topic][f].reshape(len(reader[topic]), -1) for f in fields]
            for i in range(len(reader[topic])):
                out.writerow([repr(v) for column in columns for v in column[i].tolist()])
        written.append(path)
    return written
