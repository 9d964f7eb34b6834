"""What a piece of a study depends on, read in the scripts of this folder without running them.

A piece reaches the definitions that its study hands to the harness as pieces, those that these
name, and so on through the imports of this folder: functions, classes, constants, and what a script
runs when it is imported. Tables, figures and the command line are not reached. Of a literal dict
whose keys are words those entries count whose key is in the name of the piece, or is a string of
code that is reached; all of them, where there are none. A study without pieces reaches all that it
defines.

Comments, docstrings, annotations, layout and what is printed mean nothing; nor does the harness,
which measures nothing.
"""

from __future__ import annotations

import ast
import dataclasses
import functools
import re
import symtable
from collections.abc import Callable, Iterable, Iterator
from pathlib import PurePosixPath

# With two former modules of the harness
NO_NUMBERS = ("commits", "current", "harness", "ran", "reached", "summary")
RUNNERS = (
    "main",
    "run_pieces",
    "harness.main",
)  # of the harness; the second argument is the pieces
Place = tuple[str, str]  # script, and name of what is defined in it, "" of what it only runs


class _Plain(ast.NodeTransformer):
    """Without docstrings, prints, and annotations except those of a class, maybe a dataclass."""

    def visit(self, node: ast.AST) -> ast.AST | None:
        documented = isinstance(node, (ast.Module, ast.ClassDef, ast.FunctionDef))
        if documented and ast.get_docstring(node):
            del node.body[0]
        if isinstance(node, (ast.FunctionDef, ast.Lambda)):
            for a in ast.walk(node.args):
                if isinstance(a, ast.arg):
                    a.annotation = None
        if isinstance(node, ast.FunctionDef):
            node.returns = None
        if isinstance(node, ast.ClassDef):
            own = [x if isinstance(x, ast.AnnAssign) else self.visit(x) for x in node.body]
            node.body = [x for x in own if isinstance(x, ast.stmt)] or [ast.Pass()]
            return node
        if isinstance(node, ast.Expr) and ast.unparse(node).startswith("print("):
            return ast.copy_location(ast.Pass(), node)
        if isinstance(node, ast.AnnAssign):
            if node.value is None:
                return None
            node = ast.copy_location(ast.Assign([node.target], node.value), node)
        return self.generic_visit(node)


@functools.cache
def _named(node: ast.AST) -> tuple[frozenset[str], frozenset[str]]:
    """The names of its module that code assigns, and those that it uses."""
    text = ast.unparse(node)
    own = symtable.symtable(text, "one", "exec")
    scopes, used = [own], set()
    while scopes:
        scope = scopes.pop()
        scopes += scope.get_children()
        for symbol in scope.get_symbols():
            if symbol.is_referenced() and (scope is own or symbol.is_global()):
                used.add(symbol.get_name())
    return frozenset(s.get_name() for s in own.get_symbols() if s.is_assigned()), frozenset(used)


@dataclasses.dataclass(frozen=True)
class Script:
    """The statements that define a name, "" of those that only run; (script, name or "" of the
    whole) of what is imported from this folder; the names of its pieces."""

    definitions: dict[str, list[ast.stmt]]
    imported: dict[str, Place]
    pieces: list[str]


class Scripts:
    """The scripts of this folder, of a commit or of today.

    source: the text of a script by its name, "" where there is none.
    """

    def __init__(self, source: Callable[[str], str]) -> None:
        self.source = functools.cache(source)
        self.script = functools.cache(self._read)

    def _read(self, name: str) -> Script:
        tree = ast.parse(self.source(name))
        _Plain().visit(tree)
        calls = (x for x in ast.walk(tree) if isinstance(x, ast.Call) and x.args[2:])
        run = [x.args[1] for x in calls if ast.unparse(x.func) in RUNNERS]
        pieces = [x.id for one in run for x in ast.walk(one) if isinstance(x, ast.Name)]
        own = Script({}, {}, pieces)
        for node in tree.body:
            if isinstance(node, (ast.Import, ast.ImportFrom)):
                own.imported.update(self._imports(node))
                continue
            nodes = [node]
            if isinstance(node, ast.If) and "__name__" in ast.unparse(node.test):
                more = [x for x in ast.walk(node) if isinstance(x, ast.AugAssign)]
                nodes = [x for x in more if ast.unparse(x.target) in own.definitions]
                own.definitions["__file__"] = [node]  # what a process of its own runs
            for one in nodes:
                for defined in _named(one)[0] or {""}:
                    own.definitions.setdefault(defined, []).append(one)
        return own

    def _imports(self, node: ast.Import | ast.ImportFrom) -> Iterator[tuple[str, Place]]:
        for alias in node.names:
            places = [(alias.name, "")]
            if isinstance(node, ast.ImportFrom):
                places = [(f"{node.module}.{alias.name}", ""), (node.module or "", alias.name)]
            for script, name in places:
                path = f"{script.replace('.', '/')}.py"
                if PurePosixPath(path).stem not in NO_NUMBERS and self.source(path):
                    yield alias.asname or alias.name, (path, name)
                    break

    def reached(self, study: str, piece: str) -> dict[Place, frozenset[str]]:
        """(script, name) -> what it means, of all that a piece of a study depends on."""
        return _Reach(self, study, piece).all()


@dataclasses.dataclass
class _Table:
    """The entries of a literal dict that have not been taken."""

    place: Place
    left: list[tuple[list[str], ast.AST]]


class _Reach:
    def __init__(self, scripts: Scripts, study: str, piece: str) -> None:
        self.scripts, self.piece = scripts, _slug(piece)
        self.found: dict[Place, set[str]] = {}
        self.tables: list[_Table] = []
        self.taken: set[Place] = set()  # of tables of which an entry was
        self.strings: set[str] = set()
        own = scripts.script(study)
        known = own.definitions.keys() | own.imported.keys()
        names = [name for name in (*own.pieces, "PIECES") if name in known]
        self.waiting = [(study, name) for name in names or own.definitions]

    def all(self) -> dict[Place, frozenset[str]]:
        while True:
            while self.waiting:
                self.follow(self.waiting.pop())
            chosen = [(t, e) for t in self.tables for e in t.left if all(map(self.counts, e[0]))]
            if not chosen:
                alone = (t for t in self.tables if t.place not in self.taken)
                chosen = [(t, e) for t in alone for e in t.left]
            if not chosen:
                return {place: frozenset(parts) for place, parts in self.found.items() if parts}
            for table, entry in chosen:
                self.taken.add(table.place)
                table.left.remove(entry)
                self.take(table.place, entry[1])

    def counts(self, key: str) -> bool:
        return key in self.strings or _slug(key) in self.piece

    def follow(self, place: Place) -> None:
        script = self.scripts.script(place[0])
        if place in self.found:
            return
        self.found[place] = set()
        if place[1] in script.imported:
            self.waiting.append(script.imported[place[1]])
        if place[1]:
            self.waiting.append((place[0], ""))
        for node in script.definitions.get(place[1], []):
            entries, rest = _entries(node)
            if entries:
                self.tables.append(_Table(place, entries))
            for part in rest:
                self.take(place, part)

    def take(self, place: Place, node: ast.AST) -> None:
        self.found[place].add(ast.dump(node))
        script = self.scripts.script(place[0])
        for name in _named(node)[1]:
            if name in script.definitions or script.imported.get(name, ("", ""))[1]:
                self.waiting.append((place[0], name))
        for part in ast.walk(node):
            if isinstance(part, ast.Constant) and isinstance(part.value, str):
                self.strings.add(part.value)
            if isinstance(part, ast.Attribute) and isinstance(part.value, ast.Name):
                module = script.imported.get(part.value.id, ("", "x"))
                if not module[1]:
                    self.waiting.append((module[0], part.attr))


def _entries(node: ast.stmt) -> tuple[list[tuple[list[str], ast.AST]], list[ast.AST]]:
    """Entries of a dict that a statement assigns, with the words of their keys, and all else."""
    value = node.value if isinstance(node, (ast.Assign, ast.AugAssign)) else None
    if isinstance(value, ast.DictComp):
        return [(_words([value.key]), node)], []
    if not isinstance(value, ast.Dict):
        return [], [node]
    entries, rest = [], []
    for key, inside in zip(value.keys, value.values, strict=True):
        if isinstance(key, ast.Constant) and isinstance(key.value, str):
            entries.append(([key.value], inside))
        else:
            rest += [inside, *filter(None, [key])]
    return entries, rest


def _words(nodes: Iterable[ast.AST]) -> list[str]:
    parts = (part for node in nodes for part in ast.walk(node) if isinstance(part, ast.Constant))
    return [part.value for part in parts if isinstance(part.value, str)]


def _slug(text: str) -> str:
    return re.sub("[^a-z0-9]+", "-", text.lower()).strip("-")


def differing(study: str, piece: str, then: Scripts, now: Scripts) -> list[str]:
    """What a piece reaches that two versions of the scripts have not alike: "script: names"."""
    before, today = (scripts.reached(study, piece) for scripts in (then, now))
    found: dict[str, list[str]] = {}
    for script, name in sorted(before.keys() | today.keys()):
        if before.get((script, name)) != today.get((script, name)):
            found.setdefault(script, []).append(name or "what it runs")
    return [f"{script}: {', '.join(names)}" for script, names in found.items()]
