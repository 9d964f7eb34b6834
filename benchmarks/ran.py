"""Which functions of the package a process ran, noted as it runs.

Imported before the package, this reads its modules with one more statement in every function, an
assignment to a global name, which takes some nanoseconds of a call. Functions that ran while their
module was imported are counted too, and those of processes that were started with `python`:

    python ran.py PACKAGE FOLDER (SCRIPT | -m MODULE | -c TEXT) …    leaves what it ran in FOLDER
"""

from __future__ import annotations

import ast
import atexit
import os
import runpy
import sys
import tempfile
from collections.abc import Iterator
from importlib.abc import MetaPathFinder
from importlib.machinery import ModuleSpec, PathFinder, SourceFileLoader
from pathlib import Path

_MARK = "__ran_{}__"  # of the function of this number; no class mangles it
_texts: dict[Path, str] = {}  # of files as they were read, which may have changed since
_started: list[tempfile.TemporaryDirectory[str]] = []  # where other processes leave what they ran


class _Loader(SourceFileLoader):
    """Loader of modules whose functions set the mark."""

    def get_code(self, fullname: str):
        path = self.get_filename(fullname)
        _texts[Path(path)] = self.get_data(path).decode("utf-8")
        tree = ast.parse(_texts[Path(path)], path)
        for number, (_, node) in enumerate(list(functions_of(tree))):
            mark = _MARK.format(number)
            marked = ast.parse(f"global {mark}\n{mark} = True").body
            for new in (one for statement in marked for one in ast.walk(statement)):
                ast.copy_location(new, node)
            first = 1 if ast.get_docstring(node, clean=False) is not None else 0
            node.body[first:first] = marked
        return compile(tree, path, "exec", dont_inherit=True)


class Noting(MetaPathFinder):
    """Finder of the modules of one package, as the path has them."""

    def __init__(self, package: str):
        self.package = package

    def find_spec(self, fullname: str, path=None, target=None) -> ModuleSpec | None:
        if fullname.partition(".")[0] != self.package:
            return None
        spec = PathFinder.find_spec(fullname, path, target)
        if spec is not None and isinstance(spec.loader, SourceFileLoader) and spec.origin:
            spec.loader = _Loader(fullname, spec.origin)
        return spec


def note(package: str) -> None:
    """Note what runs of a package from now on. Raises RuntimeError where it is imported already."""
    if package in sys.modules:
        raise RuntimeError(f"{package} is imported already: what it ran is not known")
    if not _notes(package):
        sys.meta_path.insert(0, Noting(package))


def _notes(package: str) -> bool:
    finders = (finder for finder in sys.meta_path if isinstance(finder, Noting))
    return any(finder.package == package for finder in finders)


def python(package: str, *arguments: object) -> list[str]:
    """The command of a new Python with these arguments: what it runs of a package counts as what
    this process ran, where that is noted."""
    words = [str(argument) for argument in arguments]
    if not _notes(package):
        return [sys.executable, *words]
    _started.append(tempfile.TemporaryDirectory())
    return [sys.executable, __file__, package, _started[-1].name, *words]


def functions(package: str) -> dict[Path, set[str]] | None:
    """Functions of the package that ran, by file, with none of a file that has none and is
    imported; None where this is not noted, or where a process did not come to its end."""
    loaded = {n: m for n, m in sys.modules.items() if n.partition(".")[0] == package}
    if not _notes(package):
        return None
    found: dict[Path, set[str]] = {}
    for folder in _started:
        left = list(Path(folder.name).iterdir())
        if not left:
            return None
        for line in (line for one in left for line in one.read_text("utf-8").splitlines()):
            path, *names = line.split("\t")
            found.setdefault(Path(path), set()).update(names)
    for module in loaded.values():
        path = Path(module.__file__ or "")
        if path.suffix != ".py" or not path.stat().st_size:
            continue
        names = [name for name, _ in functions_of(ast.parse(text_of(path)))]
        marked = {name for i, name in enumerate(names) if hasattr(module, _MARK.format(i))}
        if marked or not names:
            found.setdefault(path, set()).update(marked)
    return found


def functions_of(
    tree: ast.AST, within: str = ""
) -> Iterator[tuple[str, ast.FunctionDef | ast.AsyncFunctionDef]]:
    """Functions in a syntax tree by their qualified names, those inside of others too."""
    for node in ast.iter_child_nodes(tree):
        if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef)):
            yield within + node.name, node
            yield from functions_of(node, f"{within}{node.name}.<locals>.")
        elif isinstance(node, ast.ClassDef):
            yield from functions_of(node, f"{within}{node.name}.")
        else:
            yield from functions_of(node, within)


def text_of(path: Path) -> str:
    """The text of a file, as this process has read it where it is noted."""
    return _texts[path] if path in _texts else path.read_text(encoding="utf-8")


def _leave(package: str, folder: Path) -> None:
    noted = functions(package) or {}
    lines = ("\t".join([str(path), *sorted(noted[path])]) for path in sorted(noted))
    (folder / str(os.getpid())).write_text("\n".join(lines), encoding="utf-8")


def _run(package: str, folder: str, *arguments: str) -> None:
    """Run what the arguments of a Python name, and leave what it ran of a package in a folder."""
    sys.modules["ran"] = sys.modules[__name__]  # whose notes a study goes on with
    note(package)
    atexit.register(_leave, package, Path(folder))
    kind, *rest = arguments
    if kind == "-c":
        sys.argv = ["-c", *rest[1:]]
        exec(compile(rest[0], "<string>", "exec"), {"__name__": "__main__"})
    elif kind == "-m":
        sys.argv = rest
        runpy.run_module(rest[0], run_name="__main__", alter_sys=True)
    else:
        sys.argv = [kind, *rest]
        runpy.run_path(kind, run_name="__main__")


if __name__ == "__main__":
    _run(*sys.argv[1:])
