"""What a module is made of: digests of its functions, classes and other statements by their names.

A result that notes the parts of which its code consisted stays of current code while each of them
means what it meant, whatever is added beside them.
"""

from __future__ import annotations

import ast
import builtins
import hashlib
from collections.abc import Collection, Iterator

from ran import functions_of

_DIGITS = 5  # of hexadecimal: of 20 parts, another one has a given digest once in 50,000
_FUNCTIONS = (ast.FunctionDef, ast.AsyncFunctionDef)


def parts(text: str, ran: Collection[str] | None = None) -> frozenset[str]:
    """Digests of a module's parts: a function without those inside of it; a class, with the names
    of its methods; each name that an import or an assignment gives; all else together. Comments,
    docstrings and layout are left out.

    ran: qualified names of the functions that count; with None all. Where it is given, an import
    and an assignment to a private name count only where a part that counts uses the name.
    """
    tree = ast.parse(text)
    found: dict[str, list[ast.AST]] = {}
    for name, node in functions_of(tree):
        if ran is None or name in ran:
            found.setdefault(name, []).append(_alone(node))
    idle: dict[str, list[ast.AST]] = {}
    for name, node in _named(tree.body):
        private = name.startswith("_") or isinstance(node, (ast.Import, ast.ImportFrom))
        to = idle if ran is not None and private else found
        to.setdefault(name, []).append(_alone(node))
    used = _names(found)
    while taken := used & idle.keys():
        new = {name: idle.pop(name) for name in taken}
        found |= new
        used |= _names(new)
    return frozenset(_digest(name, nodes) for name, nodes in found.items())


def _digest(name: str, nodes: list[ast.AST]) -> str:
    meaning = name + "".join(ast.dump(node) for node in nodes)
    return hashlib.sha256(meaning.encode()).hexdigest()[:_DIGITS]


def _named(body: list[ast.stmt]) -> Iterator[tuple[str, ast.stmt]]:
    """Statements of a module other than functions, by the names that they give; "" of others."""
    for node in body:
        if isinstance(node, (ast.Import, ast.ImportFrom)):
            for alias in node.names:
                one = ast.Import([alias])
                if isinstance(node, ast.ImportFrom):
                    one = ast.ImportFrom(node.module, [alias], node.level)
                yield (alias.asname or alias.name).partition(".")[0], one
        elif isinstance(node, ast.ClassDef):
            yield node.name, node
        elif isinstance(node, (ast.Assign, ast.AnnAssign)):
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            names = [one.id for target in targets for one in ast.walk(target)
                     if isinstance(one, ast.Name)]  # fmt: skip
            for name in names or [""]:
                yield name, node
        elif not isinstance(node, _FUNCTIONS):
            yield "", node


def _alone(node: ast.AST) -> ast.AST:
    """A copy without docstrings and without the functions inside, of a class with their names."""
    copy = ast.parse(ast.unparse(node)).body[0]
    for one in ast.walk(copy):
        body = getattr(one, "body", None)
        if not isinstance(body, list):
            continue
        first = body[:1]
        if first and isinstance(first[0], ast.Expr) and isinstance(first[0].value, ast.Constant):
            body = body[1:] if isinstance(first[0].value.value, str) else body
        methods = isinstance(one, ast.ClassDef)
        one.body = [  # pyright: ignore[reportAttributeAccessIssue]
            ast.Expr(ast.Constant(inner.name)) if isinstance(inner, _FUNCTIONS) else inner
            for inner in body if methods or not isinstance(inner, _FUNCTIONS)
        ]  # fmt: skip
    return copy


def _names(found: dict[str, list[ast.AST]]) -> set[str]:
    """Names that parts use, of which a module's statements may give some."""
    nodes = (inner for each in found.values() for node in each for inner in ast.walk(node))
    return {node.id for node in nodes if isinstance(node, ast.Name)} - set(dir(builtins))
