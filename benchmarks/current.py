"""Which results are of current code, and those that are not measured again, oldest first.

A result notes what it ran (`code`): of the package the parts of every file of which a function
ran, or a constant was taken by one of these, as `parts` tells them; of the study's own files the
whole. Comments, docstrings and layout are left out. It is of current code where all of these mean
what they meant; the style of figures changes no number. What a Python runs that a study starts
counts too (`ran.python`); a study whose start of Python is timed, in which nothing is noted, counts
the whole package. Of an older result whose files are not recorded nothing is known: it is old.
`--tell` says what has changed, and how long measuring again would take. A run that is interrupted
goes on with what is still old.
"""

from __future__ import annotations

import ast
import functools
import hashlib
import json
import math
import os
import subprocess
import sys
from collections.abc import Callable, Collection, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import ran
from parts import parts

HERE = Path(__file__).resolve().parent
PACKAGE = HERE.parent / "gfnn_jax"
_RECORDING = {HERE / f"{name}.py" for name in ("current", "parts", "ran")}  # change no result
_STYLE = "evaluate/figures_style.py"  # of the package, which changes no result
# Numbers that moved by more than this part are told, the largest moves first; names of times and
# circumstances, which move with the machine.
_MOVED, _TOLD = 0.1, 4
_OF_MACHINE = ("second", "load", "date", "time")


class Result(NamedTuple):
    """A result's file, the study that makes it and the piece, "" where a study has one result."""

    path: Path
    study: Path
    piece: str

    @property
    def command(self) -> list[str]:
        only = ["--only", self.piece, "--overwrite"] if self.piece else []
        return [sys.executable, str(self.study), *only]

    @property
    def changed(self) -> list[str] | None:
        """The files that it ran and that have changed since; None where it does not say which."""
        found = json.loads(self.path.read_text(encoding="utf-8")).get("code")
        if not isinstance(found, dict):
            return None
        found.pop(f"{PACKAGE.name}/{_STYLE}", None)
        return [name for name, code in found.items() if not _same(PACKAGE.parent / name, code)]


def code_of(study: Path) -> dict[str, str | None]:
    """What this process has run, by file: the digests of the parts of the package's files; one
    digest of the whole of a study and of the studies' modules that it imports, and of the folder of
    the package where nothing is noted of it."""
    own, noted = _modules_of(study) - _RECORDING, ran.functions(PACKAGE.name)
    elsewhere = any("sys.executable" in path.read_text(encoding="utf-8") for path in own)
    whole = {path.resolve() for path in own}
    found: dict[Path, str | None] = {}
    if noted is None or elsewhere:
        whole.add(PACKAGE)
    else:
        found |= parts_of(noted)
    found |= {path: _digest(path) for path in whole}
    return {str(path.relative_to(PACKAGE.parent)): found[path] for path in sorted(found)}


def parts_of(noted: dict[Path, set[str]]) -> dict[Path, str]:
    """Digests of the parts of files of the package of which these functions ran, and of those whose
    constants they import."""
    files = _with_constants(set(noted))
    imported: dict[Path, set[str]] = {}
    for node in (node for path in files for node in _imports(path)):
        names = {alias.name for alias in node.names}
        imported.setdefault(_file_of(node), set()).update(names)
    return {
        path.resolve(): " ".join(
            sorted(parts(ran.text_of(path), noted.get(path, set()), imported.get(path, set())))
        )
        for path in files
    }


def _imports(path: Path) -> Iterator[ast.ImportFrom]:
    """Imports of names of the package in a file."""
    for node in ast.walk(ast.parse(ran.text_of(path))):
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith(PACKAGE.name):
            yield node


def _file_of(node: ast.ImportFrom) -> Path:
    return (PACKAGE.parent / str(node.module).replace(".", "/")).with_suffix(".py")


def _same(path: Path, code: str | None) -> bool:
    """Whether a file holds the parts that a result notes, or is the one whose digest it notes."""
    if _digest(path) == code:
        return True
    return path.is_file() and code is not None and _parts(path).issuperset(code.split())


@functools.cache  # of the package's modules for every study
def _parts(path: Path) -> frozenset[str]:
    return parts(path.read_text(encoding="utf-8"))


def _digest(path: Path) -> str | None:
    """Digest of a file, or of all files of a folder; None where it is gone."""
    if not path.exists():
        return None
    digest = hashlib.sha256()
    for file in sorted(path.rglob("*.py")) if path.is_dir() else [path]:
        digest.update(file.name.encode() + _meaning(file).encode())
    return digest.hexdigest()[:8]


def _with_constants(files: set[Path]) -> set[Path]:
    """These files of the package, and those whose constants they import."""
    found, left = set(), list(files)
    while left:
        path = left.pop()
        if path in found:
            continue
        found.add(path)
        for node in _imports(path):
            of = _file_of(node)
            if of.exists() and {alias.name for alias in node.names} & _constants(of):
                left.append(of)
    return found


@functools.cache
def _constants(path: Path) -> frozenset[str]:
    """Names that a module assigns."""
    body = ast.parse(ran.text_of(path)).body
    targets = [
        target
        for node in body
        for target in (
            node.targets
            if isinstance(node, ast.Assign)
            else [node.target]
            if isinstance(node, ast.AnnAssign)
            else []
        )
    ]
    return frozenset(target.id for target in targets if isinstance(target, ast.Name))


def _modules_of(study: Path) -> set[Path]:
    """The files in this folder that a study is made of."""
    found, left = set(), [study]
    while left:
        path = left.pop()
        if path in found:
            continue
        found.add(path)
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            if isinstance(node, ast.ImportFrom) and node.module:
                names = [node.module, *(f"{node.module}.{alias.name}" for alias in node.names)]
            files = (HERE.joinpath(*name.split(".")).with_suffix(".py") for name in names)
            left += [file for file in files if file.exists()]
    return found


@functools.cache  # of the package's modules for every study
def _meaning(path: Path) -> str:
    """A module without comments, docstrings and layout."""
    tree = ast.parse(ran.text_of(path))
    for node in ast.walk(tree):
        body = getattr(node, "body", None)
        if isinstance(body, list) and body and isinstance(body[0], ast.Expr):
            value = body[0].value
            if isinstance(value, ast.Constant) and isinstance(value.value, str):
                node.body = body[1:]  # pyright: ignore[reportAttributeAccessIssue]
    return ast.dump(tree)


def results_of(study: Path, folder: Path) -> Iterator[Result]:
    """The results in a folder whose names begin as those of the study do: with the prefix that it
    gives to the harness, or with its own name."""
    prefix = _prefix(study)
    alone = folder / f"{prefix}.json"
    if alone.exists():
        yield Result(alone, study, "")
    for path in sorted(folder.glob(f"{prefix}-*.json")):
        yield Result(path, study, path.stem.removeprefix(f"{prefix}-"))


def _prefix(study: Path) -> str:
    """The third argument of the call of ``harness.main``, or the constant ``PREFIX``, where there
    is one of them."""
    for node in ast.walk(ast.parse(study.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == "PREFIX":
            return ast.literal_eval(node.value)
        name = (
            node.func.id if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) else ""
        )
        if name in ("main", "run_pieces") and len(node.args) > 2:  # pyright: ignore
            third = node.args[2]  # pyright: ignore[reportAttributeAccessIssue]
            if isinstance(third, ast.Constant) and isinstance(third.value, str):
                return third.value
    return study.stem.replace("_", "-")


def check(
    studies: list[str],
    folder: Path,
    *,
    only: Collection[str] = (),
    only_tell: bool = False,
    say: Callable[[str], Any] = print,
) -> int:
    """Measure again what is not of current code, oldest first; 1 where a study failed.

    studies: all that there are, which tells whose a result is. only: those that are looked at; with
    none, all of them.
    """
    for aside in sorted(folder.glob("*.before")):  # of a run that was killed
        result = aside.with_suffix(".json")
        aside.unlink() if result.exists() else aside.rename(result)
    known: dict[Path, Result] = {}
    for name in studies:  # of two prefixes of a name the longer one is its study's
        for result in results_of(HERE / f"{name}.py", folder):
            other = known.get(result.path)
            if other is None or len(result.piece) < len(other.piece):
                known[result.path] = result
    for path in sorted(set(folder.glob("*.json")) - set(known)):
        say(f"{path.name}: no study of this folder makes it: remove it?")
    asked = [result for result in known.values() if not only or result.study.stem in only]
    old = [result for result in asked if result.changed != []]
    say(f"{len(asked) - len(old)} of {len(asked)} results are of current code")
    failed = False
    if only_tell:
        _tell(sorted(old, key=_age), say)
        return 0
    for result in sorted(old, key=_age):
        before = json.loads(result.path.read_text(encoding="utf-8"))
        aside = result.path.with_suffix(".before")
        if not result.piece:  # such a study measures what has no result
            result.path.rename(aside)
        paths = os.pathsep.join(filter(None, [str(HERE.parent), os.environ.get("PYTHONPATH")]))
        done = subprocess.run(result.command, check=False, env=os.environ | {"PYTHONPATH": paths})
        if done.returncode or not result.path.exists():
            if aside.exists():
                aside.rename(result.path)
            say(f"{result.path.name}: its study failed")
            failed = True
            continue
        aside.unlink(missing_ok=True)
        after = json.loads(result.path.read_text(encoding="utf-8"))
        say(f"{result.path.name}: {what_moved(before.get('measured'), after.get('measured'))}")
    return int(failed)


def _tell(old: list[Result], say: Callable[[str], Any]) -> None:
    """Say which results these are, how long each took, and how long all of them would."""
    known = []
    for result in old:
        seconds = _seconds(json.loads(result.path.read_text(encoding="utf-8")))
        known += [] if seconds is None else [seconds]
        took = "time not known" if seconds is None else f"{seconds:.0f} s"
        say(f"{result.path.name}: {_why(result)} ({_age(result)[0]}, {took})")
    if old:
        unknown = len(old) - len(known)
        others = f", and {unknown} more whose time is not known" if unknown else ""
        say(f"all of them again: about {sum(known) / 3600:.1f} h{others}")


def _why(result: Result) -> str:
    """Say what makes a result old."""
    changed = result.changed
    if changed is None:
        return "which files it ran is not recorded"
    more = f" and {len(changed) - _TOLD} more" if len(changed) > _TOLD else ""
    return f"changed since: {', '.join(changed[:_TOLD])}{more}"


def _seconds(found: dict[str, Any]) -> float | None:
    """Seconds that a result took: of the whole, else the sum of its cases'; None where neither is
    known."""
    if "seconds" in found:
        return float(found["seconds"])
    measured = found.get("measured")
    cases = measured.values() if isinstance(measured, dict) else ()
    each = [case["seconds"] for case in cases if isinstance(case, dict) and "seconds" in case]
    return float(sum(each)) if each and all(isinstance(s, (int, float)) for s in each) else None


def _age(result: Result) -> tuple[str, float]:
    found = json.loads(result.path.read_text(encoding="utf-8"))
    return found.get("date", ""), result.path.stat().st_mtime


def what_moved(before: Any, after: Any) -> str:
    """The numbers that moved by more than a tenth, and verdicts that changed."""
    old, new = dict(_leaves(before)), dict(_leaves(after))
    moved = []
    for name in old.keys() & new.keys():
        a, b = old[name], new[name]
        if isinstance(a, (bool, str)) or isinstance(b, (bool, str)) or a is None or b is None:
            size = math.inf if a != b and not isinstance(a, str) else 0.0
        else:
            size = abs(a - b) / max(abs(a), abs(b), 1e-300)
        if size > _MOVED:
            moved.append((size, f"{name} {_short(a)} → {_short(b)}"))
    moved.sort(reverse=True)
    words = [text for _, text in moved[:_TOLD]]
    gone, come = len(old.keys() - new.keys()), len(new.keys() - old.keys())
    if len(moved) > _TOLD:
        words.append(f"{len(moved) - _TOLD} more")
    if gone or come:
        words.append(f"{gone} numbers gone, {come} new")
    return "; ".join(words) or "nothing moved by more than a tenth"


def _short(value: Any) -> str:
    return f"{value:.3g}" if isinstance(value, float) else str(value)


def _leaves(value: Any, name: str = "") -> Iterator[tuple[str, Any]]:
    if any(word in name.rpartition(".")[2] for word in _OF_MACHINE):
        return
    if isinstance(value, dict):
        for key, inner in value.items():
            yield from _leaves(inner, f"{name}.{key}" if name else str(key))
    elif isinstance(value, list):
        for i, inner in enumerate(value):
            yield from _leaves(inner, f"{name}[{i}]")
    else:
        yield name, value
