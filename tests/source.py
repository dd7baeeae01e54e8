"""The repository's own source as syntax trees, for the tests that read it instead of running it."""

from __future__ import annotations

import ast
from collections.abc import Callable, Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = ("sim2real", "drivers", "policies", "configs")

Check = Callable[[str, ast.Module], Iterator[tuple[int, str]]]  # (path, tree) -> (line, what is wrong)


def files(*folders: str) -> list[Path]:
    """Every Python file under the folders named, sorted."""
    return sorted(p for f in folders for p in (ROOT / f).rglob("*.py"))


def complaints(check: Check, *folders: str) -> list[str]:
    """``path:line: what`` for everything that ``check`` finds in the folders named."""
    found = []
    for file in files(*folders):
        path = file.relative_to(ROOT).as_posix()
        tree = ast.parse(file.read_text(encoding="utf-8"), path)
        found += [f"{path}:{line}: {what}" for line, what in check(path, tree)]
    return found


def complaints_about(check: Check, path: str, text: str) -> list[str]:
    """What ``check`` would say about ``text`` if it stood in a file at ``path``: how the checks are themselves checked."""
    return [f"{path}:{line}: {what}" for line, what in check(path, ast.parse(text))]


def dotted(node: ast.AST) -> str:
    """``a.b.c`` for a chain of attributes of a name, else ''."""
    if isinstance(node, ast.Name):
        return node.id
    if isinstance(node, ast.Attribute) and (head := dotted(node.value)):
        return f"{head}.{node.attr}"
    return ""


def calls(tree: ast.AST) -> Iterator[tuple[ast.Call, str]]:
    """Every call, with the dotted name of what is called ('' where it is not a plain name)."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Call):
            yield node, dotted(node.func)


def imports(tree: ast.AST, running: bool = False) -> Iterator[tuple[int, str]]:
    """Every module imported anywhere in the file, also inside functions: (line, dotted name).

    ``running``: leave out what only a type checker sees (``if TYPE_CHECKING:``).
    """
    unseen: set[ast.AST] = set()
    for node in ast.walk(tree):
        if running and isinstance(node, ast.If) and dotted(node.test).endswith("TYPE_CHECKING"):
            unseen |= {inside for statement in node.body for inside in ast.walk(statement)}
        if node in unseen:
            continue
        if isinstance(node, ast.Import):
            yield from ((node.lineno, alias.name) for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            yield node.lineno, node.module
