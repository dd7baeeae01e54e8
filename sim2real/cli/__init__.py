"""``sim2real <command>``: every file here is a command. Its docstring's first line is its line in ``sim2real --help``.

A command file has ``main(argv: list[str]) -> int``. Commands are listed without importing them, so help stays instant.
Exit codes: 0 done, 1 done but the answer is no, 2 refused (the message says what to do), 130 interrupted.
"""

from __future__ import annotations

import ast
import difflib
import importlib
import sys
import unicodedata
from pathlib import Path

USAGE = "usage: sim2real <command> [options]     (sim2real <command> --help explains one)"
PURPOSE = "The shortest safe path from a recorded human skill to a humanoid that performs it."


def commands() -> dict[str, str]:
    """Every command and its summary, read from the files beside this one without importing them."""
    files = sorted(p for p in Path(__file__).parent.glob("*.py") if not p.stem.startswith("_"))
    return {p.stem: summary(p) for p in files}


def summary(path: Path) -> str:
    """The first line of a file's docstring."""
    docstring = ast.get_docstring(ast.parse(path.read_text(encoding="utf-8"))) or ""
    return docstring.partition("\n")[0]


def printable(text: str) -> str:
    """``text`` without control, formatting or broken characters: what came off a wire or out of a file may hold any."""
    return "".join(c for c in text if c in "\n\t" or unicodedata.category(c)[0] != "C")


def main(argv: list[str] | None = None) -> int:
    """Run one command and return the exit code; refusals are printed without a traceback."""
    argv = sys.argv[1:] if argv is None else argv
    name, *rest = argv or ["--help"]
    if name in ("-h", "--help", "help"):
        print(table_of_contents())
        return 0
    if name in ("-V", "--version"):
        print(f"sim2real {version()}")
        return 0
    if name not in commands():
        close = difflib.get_close_matches(name, commands(), n=1)
        hint = f" (did you mean '{close[0]}'?)" if close else ""
        return refuse(
            f"no command '{name}'{hint}\n  commands: {', '.join(commands())}\n  sim2real --help explains them"
        )
    return run(name, rest)


def run(name: str, argv: list[str]) -> int:
    """Import the command's file, and nothing of the others, and hand over."""
    from drivers.bus import BusError
    from drivers.wire import WireError
    from sim2real.types import Sim2realError

    try:
        return importlib.import_module(f"sim2real.cli.{name}").main(argv)
    except (Sim2realError, BusError, WireError) as error:
        return refuse(str(error))
    except KeyboardInterrupt:
        return 130


def refuse(message: str) -> int:
    """Print why not, to stderr. Returns the exit code."""
    from rich.console import Console
    from rich.text import Text

    text = Text.assemble(("error: ", "bold red"), printable(message))
    Console(stderr=True).print(text, highlight=False, soft_wrap=True)
    return 2


def table_of_contents() -> str:
    """What ``sim2real --help`` prints."""
    width = max(map(len, commands()), default=0)
    rows = [f"  {name:{width}}  {line}" for name, line in commands().items()]
    return "\n".join([USAGE, "", PURPOSE, "", *rows])


def version() -> str:
    """The installed version."""
    from importlib import metadata

    try:
        return metadata.version("sim2real")
    except metadata.PackageNotFoundError:
        return "(not installed: running from a clone)"
