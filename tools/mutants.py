"""What ``mutate.py`` changes: operators, comparisons, constants, names, conditions, returns and statements, one at a time."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path
from types import CodeType

LT, LE, GT, GE, EQ, NE = ast.Lt, ast.LtE, ast.Gt, ast.GtE, ast.Eq, ast.NotEq
OPERATORS = {
    LT: (LE, GE), LE: (LT, GT), GT: (GE, LE), GE: (GT, LT), EQ: (NE,), NE: (EQ,), ast.And: (ast.Or,),
    ast.Or: (ast.And,), ast.Is: (ast.IsNot,), ast.IsNot: (ast.Is,), ast.In: (ast.NotIn,), ast.NotIn: (ast.In,),
    ast.Add: (ast.Sub,), ast.Sub: (ast.Add,), ast.Mult: (ast.Div,), ast.Div: (ast.Mult,),
}  # fmt: skip
NAMES = {"min": "max", "minimum": "maximum", "fmin": "fmax", "argmin": "argmax", "logical_or": "logical_and"}
NAMES |= {new: old for old, new in NAMES.items()}


def replacements(node: object, field: str) -> Iterator[ast.AST]:
    """What may stand in the place of ``node``."""
    if field == "test":
        yield ast.UnaryOp(ast.Not(), node)
    match node:
        case ast.cmpop() | ast.boolop() | ast.operator():
            yield from (new() for new in OPERATORS.get(type(node), ()))
        case ast.UnaryOp():
            yield node.operand
        case ast.Constant(value=bool(v)):
            yield ast.Constant(not v)
        case ast.Constant(value=int(v) | float(v)):
            yield ast.Constant(v + 1)
        case ast.Name(id=name) if name in NAMES:
            yield ast.Name(NAMES[name], node.ctx)
        case ast.Attribute(attr=name) if name in NAMES:
            yield ast.Attribute(node.value, NAMES[name], node.ctx)
        case ast.Return(value=value):
            yield ast.Pass()
            if not isinstance(value, ast.Constant | None):
                yield ast.Return(ast.Constant(None))
        case (
            ast.Assign() | ast.AugAssign() | ast.AnnAssign(value=ast.expr()) | ast.Raise() | ast.Expr(value=ast.Call())
        ):
            yield ast.Pass()


def mutants(path: Path) -> Iterator[tuple[str, CodeType]]:
    """(what was changed where, the module's code with it) for every mutant of a file."""
    tree = ast.parse(path.read_text())
    for parent in list(ast.walk(tree)):
        for field, value in ast.iter_fields(parent):
            for i, node in enumerate(value if isinstance(value, list) else [value]):
                for new in replacements(node, field):
                    line = getattr(node, "lineno", getattr(parent, "lineno", 0))
                    change = f"{path.name}:{line}: {_text(node)} -> {_text(new)}"
                    setattr(parent, field, [*value[:i], new, *value[i + 1 :]] if isinstance(value, list) else new)
                    yield change, compile(ast.fix_missing_locations(tree), str(path), "exec")
                setattr(parent, field, value)


def _text(node: ast.AST) -> str:
    return ast.unparse(node).split("\n")[0] or type(node).__name__
