"""Which files of the package a process ran a function of, noted as it runs.

Imported before the package, this reads its modules with one more statement in every function, an
assignment to a global name, which takes some nanoseconds of a call. Functions that ran while their
module was imported are counted too.
"""

from __future__ import annotations

import ast
import sys
from importlib.abc import MetaPathFinder
from importlib.machinery import ModuleSpec, PathFinder, SourceFileLoader
from pathlib import Path

_MARK = "__ran__"
_texts: dict[Path, str] = {}  # of files as they were read, which may have changed since


class _Loader(SourceFileLoader):
    """Loader of modules whose functions set the mark."""

    def get_code(self, fullname: str):
        path = self.get_filename(fullname)
        _texts[Path(path)] = self.get_data(path).decode("utf-8")
        tree = ast.parse(_texts[Path(path)], path)
        for node in ast.walk(tree):
            if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef)):
                marked = ast.parse(f"global {_MARK}\n{_MARK} = True").body
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
    sys.meta_path.insert(0, Noting(package))


def files(package: str) -> set[Path] | None:
    """Files of the package of which a function ran, and those that have none and are imported;
    None where this is not noted."""
    loaded = {n: m for n, m in sys.modules.items() if n.partition(".")[0] == package}
    if not any(isinstance(finder, Noting) and finder.package == package
               for finder in sys.meta_path):  # fmt: skip
        return None
    found = set()
    for module in loaded.values():
        path = Path(module.__file__ or "")
        holds_code = path.suffix == ".py" and path.stat().st_size > 0
        if holds_code and (hasattr(module, _MARK) or not _functions(path)):
            found.add(path)
    return found


def text_of(path: Path) -> str:
    """The text of a file, as this process has read it where it is noted."""
    return _texts[path] if path in _texts else path.read_text(encoding="utf-8")


def _functions(path: Path) -> bool:
    tree = ast.parse(path.read_text(encoding="utf-8"))
    return any(isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef)) for node in ast.walk(tree))
