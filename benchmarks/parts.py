"""What a module is made of: digests of its functions, classes and other statements by their names.

A result that notes the parts of which its code consisted stays of current code while each of them
means what it meant, whatever is added beside them. Not seen are: the order of a module's
statements, names that are looked up as text, what a decorator does to functions that did not run,
and a name that hides another one from outside its module.
"""

from __future__ import annotations

import ast
import hashlib
from collections.abc import Collection, Iterator

from ran import functions_of

_DIGITS = 5  # of hexadecimal: of 20 parts, another one has a given digest once in 50,000
_FUNCTIONS = (ast.FunctionDef, ast.AsyncFunctionDef)
_IMPORTS = (ast.Import, ast.ImportFrom)


def parts(
    text: str, ran: Collection[str] | None = None, imported: Collection[str] = ()
) -> frozenset[str]:
    """Digests of a module's parts, by name: a function without those inside of it; a class, with
    the names of its methods; what an import or an assignment gives; all else together. Comments,
    docstrings, layout and what is for type checkers alone are left out.

    ran: qualified names of the functions that count; with None all. Where it is given, an import
    and an assignment to a private name count only where a part that counts uses the name, where it
    is among those ``imported`` elsewhere, or where nothing in the module uses it.
    """
    tree = ast.parse(text)
    named: dict[str, list[ast.AST]] = {}
    functions = set()
    for name, node in functions_of(tree):
        named.setdefault(name, []).append(_alone(node))
        functions.add(name)
    lasting = set()  # that count in any case
    for name, node in _named(tree.body):
        named.setdefault(name, []).append(_alone(node))
        lasting |= set() if isinstance(node, _IMPORTS) or name.startswith("_") else {name}
    if ran is None:
        return frozenset(_digest(name, nodes) for name, nodes in named.items())
    idle = named.keys() - lasting - functions
    counts = (lasting | set(ran) | set(imported) & idle | idle - _used(named)) & named.keys()
    while more := _used({name: named[name] for name in counts}) & idle - counts:
        counts |= more
    return frozenset(_digest(name, named[name]) for name in counts)


def _digest(name: str, nodes: list[ast.AST]) -> str:
    meaning = name + "".join(ast.dump(node) for node in nodes)
    return hashlib.sha256(meaning.encode()).hexdigest()[:_DIGITS]


def _named(body: list[ast.stmt]) -> Iterator[tuple[str, ast.stmt]]:
    """Statements of a module other than functions, by the names that they give; "" of others."""
    for node in body:
        if isinstance(node, _IMPORTS):
            for alias in node.names:
                one = ast.Import([alias])
                if isinstance(node, ast.ImportFrom):
                    one = ast.ImportFrom(node.module, [alias], node.level)
                yield (alias.asname or alias.name).partition(".")[0], one
        elif isinstance(node, ast.ClassDef):
            yield node.name, node
        elif isinstance(node, (ast.Assign, ast.AnnAssign)):
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            names = [
                one.id
                for target in targets
                for one in ast.walk(target)
                if isinstance(one, ast.Name)
            ]
            for name in names or [""]:
                yield name, node
        elif not isinstance(node, _FUNCTIONS) and not _is_text(node) and not _for_types(node):
            yield "", node


def _is_text(node: ast.stmt) -> bool:
    """Return whether a statement is a docstring."""
    value = node.value if isinstance(node, ast.Expr) else None
    return isinstance(value, ast.Constant) and isinstance(value.value, str)


def _for_types(node: ast.stmt) -> bool:
    return isinstance(node, ast.If) and ast.unparse(node.test).endswith("TYPE_CHECKING")


def _alone(node: ast.AST) -> ast.AST:
    """A copy without docstrings and without the functions inside, of a class with their names."""
    copy = ast.parse(ast.unparse(node)).body[0]
    for one in ast.walk(copy):
        body = getattr(one, "body", None)
        if not isinstance(body, list):
            continue
        body = body[1:] if body and _is_text(body[0]) else body
        methods = isinstance(one, ast.ClassDef)
        one.body = [  # pyright: ignore[reportAttributeAccessIssue]
            ast.Expr(ast.Constant(inner.name)) if isinstance(inner, _FUNCTIONS) else inner
            for inner in body
            if methods or not isinstance(inner, _FUNCTIONS)
        ]
    return copy


def _used(named: dict[str, list[ast.AST]]) -> set[str]:
    """Names that parts read, but for the one whose part it is."""
    return {
        inner.id
        for name, nodes in named.items()
        for node in nodes
        for inner in ast.walk(node)
        if isinstance(inner, ast.Name) and inner.id != name
    }
