"""A Layout as a ROS 2 message definition, so that Foxglove and PlotJuggler show every value by its joint's name.

CDR aligns an eight-byte value to eight bytes; a record has nothing else, so its packed bytes are its CDR body.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable

from sim2real.records import Layout, layout
from sim2real.types import Sim2realError

PACKAGE = "sim2real"
CDR_HEADER = b"\x00\x01\x00\x00"  # CDR, little-endian, no options (OMG RTPS 2.3, 10.2.1.2)
ROS_TYPES = {"<f8": "float64", "<i8": "int64"}
SEPARATOR = "=" * 80  # between the definitions of a concatenated ros2msg schema (mcap.dev/spec/registry)


def ros2msg(record: Layout) -> str:
    """The ``ros2msg`` schema of a record: its own fields first, then every nested message it needs.

    Dots in field names and the elements of array fields become nesting. Raises Sim2realError where the fields of one
    nested message do not lie side by side: their bytes would not be its CDR body.
    """
    tree: dict = {}
    last = ""
    for field in record.dtype.names or ():
        *parents, leaf = field.split(".")
        node, path = tree, ""
        for parent in parents:
            path += parent + "."
            if parent in node and not last.startswith(path):
                raise Sim2realError(f"layout {record.name}: field '{field}' is apart from the other '{path}*' fields")
            node = node.setdefault(parent, {})
        base = record.dtype[field].base.str
        elements = record.elements.get(field)
        if elements is None:
            node[leaf] = ROS_TYPES[base]
        elif elements:  # an array of nobody takes no bytes and no field
            node[leaf] = dict.fromkeys(identifiers(elements), ROS_TYPES[base])
        last = field
    definitions = _definitions(record.name, tree)
    (_, first), *nested = definitions
    return f"\n{SEPARATOR}\n".join([first, *(f"MSG: {PACKAGE}/{name}\n{text}" for name, text in nested)])


def _definitions(name: str, tree: dict) -> list[tuple[str, str]]:
    """(message name, its lines) of a tree of fields and of every message nested in it, depth first."""
    lines, nested = [], []
    for key, field in zip(identifiers(tree), tree.values(), strict=True):
        kind = field
        if isinstance(field, dict):
            kind = name + "".join(word.capitalize() for word in key.split("_"))
            nested += _definitions(kind, field)
            kind = f"{PACKAGE}/{kind}"
        lines.append(f"{kind} {key}")
    return [(name, "\n".join(lines)), *nested]


def identifiers(names: Iterable[str]) -> list[str]:
    """``names`` as ROS 2 field names: ``[a-z][a-z0-9_]*``, no double or trailing underscore, each once."""
    taken: list[str] = []
    for name in names:
        word = re.sub(r"[^a-z0-9]+", "_", name.lower()).strip("_")
        if not word or not word[0].isalpha():
            word = f"n_{word}".strip("_")
        unique, count = word, 2
        while unique in taken:
            unique, count = f"{word}_{count}", count + 1
        taken.append(unique)
    return taken


def layout_to_json(record: Layout) -> str:
    """A Layout with its names untouched, for the record's own metadata."""
    fields = [
        [name, record.dtype[name].base.str[1:], list(record.elements[name]) if name in record.elements else None]
        for name in record.dtype.names or ()
    ]
    return json.dumps({"name": record.name, "fields": fields})


def layout_from_json(text: str) -> Layout:
    """The inverse of ``layout_to_json``. Raises ValueError on anything that is not a Layout."""
    try:
        document = json.loads(text)
        fields = [(str(name), str(kind), names) for name, kind, names in document["fields"]]
        for _, kind, names in fields:
            if kind not in ("f8", "i8") or not (names is None or all(isinstance(n, str) for n in names)):
                raise ValueError(f"got a field of {kind!r} over {names!r}")
        return layout(str(document["name"]), fields)
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(f"not a record layout: {error}") from None
