"""The parts of long work: each is named and watched, and kept until all are done, so that who is interrupted can go on."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, is_dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypeVar, get_type_hints

import numpy as np
from pydantic import PlainValidator, TypeAdapter

from policies.spread import spread

if TYPE_CHECKING:  # every worker of ``spread`` imports this file, and none of them shows anything
    from rich.console import Console

ROOT = Path(__file__).resolve().parents[1]
MADE_OF = {".py", ".yaml", ".xml", ".npz"}  # whose change makes another result
FOLDER = Path("runs/eval")
Result = TypeVar("Result")
Over = Callable[[Iterable[Any], int], Iterable[Any]]  # hands on things, of which there are so many, as they come
# In the result of a part: it comes back with the same numbers.
Array = Annotated[np.ndarray, PlainValidator(np.asarray)]


def unseen(things: Iterable[Any], total: int) -> Iterable[Any]:
    """Nobody watches."""
    return things


class Parts:
    """Work in parts, by name: ``each`` of many runs on all cores, or ``once`` in this process.

    What ``call`` returns says its annotation: numbers, texts, ``Array``, and named tuples, dataclasses and containers of these.
    """

    def __init__(self, console: Console | None = None, kept: Path | None = None) -> None:
        """``console``: shows what is being done, how far that is, and how long it will still take. ``kept``: a file of what
        is done, a line a result, where an earlier attempt at the same work may have left some."""
        self._console, self._kept = console, kept
        self._done: dict[tuple[str, int], Any] = {}
        lines = kept.read_text().splitlines(keepends=True) if kept and kept.is_file() else []
        if kept and lines and not lines[-1].endswith("\n"):  # torn when the machine stopped
            kept.write_text("".join(lines := lines[:-1]))
        for text, number, document in map(json.loads, lines):
            self._done[text, number] = document

    def say(self, text: str) -> None:
        """What is done next."""
        if self._console:
            self._console.print(f"[dim]{text} ...[/]")

    def once(self, text: str, call: Callable[..., Result], *given: Any, **named: Any) -> Result:
        """``call(*given, **named, over=over)``, which hands ``over(things, total)`` what it goes through."""
        results = self._new(text, call, 1, lambda left: (call(*given, **named, over=self._over) for _ in left))
        return results[0]

    def each(self, text: str, call: Callable[..., Result], runs: Iterable[tuple[Any, ...]]) -> list[Result]:
        """``call(*run)`` of every run, in their order; see ``spread``."""
        runs = list(runs)
        more = lambda left: self._over(spread(call, [runs[k] for k in left]), len(left))  # noqa: E731
        return self._new(text, call, len(runs), more)

    def _new(
        self, text: str, call: Callable[..., Result], count: int, more: Callable[[list[int]], Iterable[Result]]
    ) -> list[Result]:
        """``count`` results, of which ``more`` gives those that are not kept yet."""
        self.say(text)
        kind = TypeAdapter(get_type_hints(call, include_extras=True)["return"])
        left = [k for k in range(count) if (text, k) not in self._done]
        for k, result in zip(left, more(left), strict=True):
            self._keep(text, k, result)
        return [kind.validate_python(self._done[text, k]) for k in range(count)]

    def _keep(self, text: str, k: int, result: Any) -> None:
        line = json.dumps([text, k, result], default=_plain)
        self._done[text, k] = json.loads(line)[2]  # the same as of who goes on from there
        if self._kept:
            self._kept.parent.mkdir(parents=True, exist_ok=True)
            with self._kept.open("a") as file:
                file.write(line + "\n")

    def _over(self, things: Iterable[Any], total: int) -> Iterable[Any]:
        if not self._console:
            return things
        from rich.progress import track

        return track(things, "", total, console=self._console, transient=True)


@contextmanager
def kept(console: Console, name: str, *of: Any) -> Iterator[Parts]:
    """Parts of the work ``name``. Of what an attempt at the same work ``of`` with the same code has done, nothing is done
    again; when all is done nothing is kept."""
    what = hashlib.sha256(repr(of).encode() + _code()).hexdigest()
    file = FOLDER / f"{name}-{what[:16]}.jsonl"
    if file.is_file():
        count = file.read_text().count("\n")
        console.print(f"{file}: {count} results of an evaluation that was interrupted; it goes on from there")
    try:
        yield Parts(console, file)
    except KeyboardInterrupt:
        if file.is_file():
            console.print("interrupted; the same command goes on from here")
        raise
    file.unlink(missing_ok=True)


def _plain(value: Any) -> Any:
    """What JSON does not know."""
    return asdict(value) if is_dataclass(value) and not isinstance(value, type) else value.tolist()


def _code() -> bytes:
    """A fingerprint of all that decides a result."""
    found = hashlib.sha256()
    for folder in ("policies", "sim2real", "drivers", "configs"):
        for path in sorted((ROOT / folder).rglob("*")):
            if path.suffix in MADE_OF:
                found.update(str(path.relative_to(ROOT)).encode() + b"\0" + path.read_bytes())
    return found.digest()
