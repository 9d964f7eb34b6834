"""Size of the package: lines by kind, functions with many parameters, numeric constants.

    python benchmarks/size.py             a table
    python benchmarks/size.py --json      the same as JSON
    python benchmarks/size.py --listed    the functions and the constants themselves

Lines are those of ``gfnn_jax/**/*.py`` as ``ruff format`` leaves them at a line length of 100.

- A *docstring* line belongs to the string that opens a module, a class or a function; an *import*
  line to an import statement; *blank* and *comment* lines hold nothing else; the rest is *code*.
- The parameters of a function are all of its signature, ``*args`` and ``**kwargs`` too, without
  ``self`` and ``cls``.
- A *numeric constant at module level* is an assignment in a module's body whose value has a number
  in it.
- A *line of two statements* is one on which two statements begin.
"""

from __future__ import annotations

import argparse
import ast
import json
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

PACKAGE = Path(__file__).resolve().parent.parent / "gfnn_jax"
MANY = 7  # parameters

Function = ast.FunctionDef | ast.AsyncFunctionDef


def number_of_parameters(function: Function) -> int:
    """Number of parameters of a signature, without self and cls."""
    a = function.args
    named = [x.arg for x in (*a.posonlyargs, *a.args)]
    count = len(named) + len(a.kwonlyargs) + (a.vararg is not None) + (a.kwarg is not None)
    return count - (named[:1] in (["self"], ["cls"]))


def has_number(value: ast.expr) -> bool:
    """Whether an expression has a number in it; True and False are none."""
    return any(
        isinstance(node, ast.Constant)
        and isinstance(node.value, (int, float, complex))
        and not isinstance(node.value, bool)
        for node in ast.walk(value)
    )


def constants(tree: ast.Module) -> Iterator[str]:
    """The names of the numeric constants of a module."""
    for node in tree.body:
        if isinstance(node, (ast.Assign, ast.AnnAssign)) and node.value and has_number(node.value):
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            yield ", ".join(ast.unparse(target) for target in targets)


def docstrings(tree: ast.Module) -> Iterator[ast.Expr]:
    """The docstring of each module, class and function that has one."""
    for node in ast.walk(tree):
        if isinstance(
            node, (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)
        ) and ast.get_docstring(node):
            first = node.body[0]
            assert isinstance(first, ast.Expr)
            yield first


def kinds(text: str, tree: ast.Module) -> Counter[str]:
    """Kind of line -> number of them."""
    kind = {}
    for node in ast.walk(tree):
        if isinstance(node, (ast.Import, ast.ImportFrom)):
            kind |= dict.fromkeys(range(node.lineno, (node.end_lineno or 0) + 1), "import")
    for node in docstrings(tree):
        kind |= dict.fromkeys(range(node.lineno, (node.end_lineno or 0) + 1), "docstring")
    found: Counter[str] = Counter()
    for number, line in enumerate(text.splitlines(), 1):
        here = kind.get(number)
        if here is None:
            bare = line.strip()
            here = "blank" if not bare else "comment" if bare.startswith("#") else "code"
        found[here] += 1
    return found


def measure(package: Path = PACKAGE) -> dict:
    """Numbers of lines, functions, constants; the longest lists are named."""
    lines: Counter[str] = Counter()
    rooms: Counter[str] = Counter()
    many, numbers, double, skips = [], [], 0, 0
    files = sorted(package.rglob("*.py"))
    classes = functions = 0
    for path in files:
        text = path.read_text(encoding="utf-8")
        tree = ast.parse(text)
        where = path.relative_to(package).with_suffix("")
        of_file = kinds(text, tree)
        lines += of_file
        rooms[where.parts[0] if len(where.parts) > 1 else "."] += of_file.total()
        skips += text.count("fmt: skip")
        simple = (n for n in ast.walk(tree) if isinstance(n, ast.stmt) and not hasattr(n, "body"))
        double += sum(n > 1 for n in Counter(node.lineno for node in simple).values())
        for node in ast.walk(tree):
            classes += isinstance(node, ast.ClassDef)
            if isinstance(node, Function):
                functions += 1
                if (count := number_of_parameters(node)) >= MANY:
                    many.append(f"{where}.{node.name} {count}")
        numbers += [f"{where}.{name}" for name in constants(tree)]
    total = lines.total()
    return {
        "lines": total,
        "files": len(files),
        "by_kind": dict(lines.most_common()),
        "docstrings_share": round(lines["docstring"] / total, 3),
        "by_room": dict(rooms.most_common()),
        "classes": classes,
        "functions": functions,
        "functions_of_7_parameters": len(many),
        "constants": len(numbers),
        "fmt_skip": skips,
        "lines_of_two_statements": double,
        "listed": {"functions": many, "constants": numbers},
    }


def main() -> None:
    """Print the size of the package."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--listed", action="store_true", help="name functions and constants")
    asked = parser.parse_args()
    found = measure()
    listed = found.pop("listed")
    if asked.json:
        print(json.dumps(found, indent=1))
    else:
        for name, value in found.items():
            print(f"{name:28s}{value}")
    if asked.listed:
        print(*listed["functions"], "", *listed["constants"], sep="\n")


if __name__ == "__main__":
    main()
