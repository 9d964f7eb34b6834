"""Which results are old: told, or measured again, oldest first.

A result is old in two cases. Its study changed: a script of this folder that its process had loaded
(`code`) differs from today's in more than comments, docstrings and layout; the harness measures
nothing and does not count. Or the package did: it was measured with a version more than one minor
version behind today's. Between two versions `freeze.py` guards the package, by the bits of thirty
fits; a commit that moves numbers on purpose measures the studies that it names again. A result
that was measured with scripts that differed, or that notes no commit of this repository, counts as
of the commit that it came with.
"""

from __future__ import annotations

import ast
import functools
import json
import os
import subprocess
import sys
import tomllib
from collections.abc import Iterator, Sequence
from itertools import islice
from pathlib import Path
from typing import Any

HERE = Path(__file__).resolve().parent
PACKAGE = "gfnn_jax"
_NO_NUMBERS = tuple(f"{HERE.name}/{name}.py" for name in ("commits", "harness", "summary"))
_BEHIND = 1  # minor versions that a result may be
_WITH_DOCSTRING = (ast.Module, ast.ClassDef, ast.FunctionDef)
_TOLD = 4  # files of which it is told that they changed


def git(*words: str) -> str:
    """What git says of the repository that this folder is in; "" where it fails or is not there."""
    command = ["git", "-C", str(HERE.parent), *words]
    try:
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout
    except (OSError, subprocess.CalledProcessError):
        return ""


def code() -> dict[str, Any]:
    """The commit, whether files differ from it, and the files that this process has loaded."""
    loaded = (Path(getattr(module, "__file__", None) or "/") for module in [*sys.modules.values()])
    own = {path.resolve() for path in loaded if path.suffix == ".py"}
    names = (path.relative_to(HERE.parent) for path in own if path.is_relative_to(HERE.parent))
    files = sorted(str(name) for name in names if name.parts[0] in (PACKAGE, HERE.name))
    return {
        "commit": git("rev-parse", "HEAD").strip(),
        "dirty": bool(git("status", "--porcelain", "--", f"{PACKAGE}/*.py", f"{HERE.name}/*.py")),
        "files": " ".join(files),
    }


def changed(noted: Any, result: str) -> Iterator[str]:
    """The scripts that mean something else today, of those that a result's `code` notes, or why
    they are not known. result: name of its file."""
    noted = noted or {}  # {file or folder: digest} in results until 0.3
    loaded = noted["files"].split() if "commit" in noted else list(noted)
    base = noted.get("commit")
    if not base or noted["dirty"] or not git("cat-file", "-t", base):
        base = _came_with().get(result)
    if not base or not loaded:
        yield "its code is not recorded"
        return
    for name in _differ(base):
        counts = name.startswith(tuple(loaded)) and name not in _NO_NUMBERS
        if counts and _meaning(base, name) != _meaning("", name):
            yield name


def behind(version: str) -> str:
    """Why a result of this version of the package is old, "" where it is not."""
    minor = int(version.split(".")[1])
    return f"of version {version}" if _minor_today() > minor + _BEHIND else ""


@functools.cache
def _minor_today() -> int:
    about = tomllib.loads((HERE.parent / "pyproject.toml").read_text(encoding="utf-8"))
    return int(about["project"]["version"].split(".")[1])


@functools.cache
def _came_with() -> dict[str, str]:
    """Name of a result's file -> the last commit that changed it."""
    found, commit = {}, ""
    for line in git("log", "--format=commit %H", "--name-only", "--", HERE.name).splitlines():
        if line.startswith("commit "):
            commit = line.split()[1]
        elif line.endswith(".json"):
            found.setdefault(Path(line).name, commit)
    return found


@functools.cache
def _differ(base: str) -> list[str]:
    return git("diff", "--name-only", "--no-renames", base, "--", f"{HERE.name}/*.py").splitlines()


@functools.cache
def _meaning(commit: str, name: str) -> str:
    """A module of a commit, or of today, without comments, docstrings and layout; "" if gone."""
    path = HERE.parent / name
    now = path.read_text(encoding="utf-8") if path.is_file() else ""
    tree = ast.parse(git("show", f"{commit}:{name}") if commit else now)
    for node in ast.walk(tree):
        if isinstance(node, _WITH_DOCSTRING) and ast.get_docstring(node):
            del node.body[0]
    return ast.dump(tree)


def results_of(study: Path, folder: Path) -> Iterator[tuple[str, Path, Path]]:
    """(piece, file, study) of the results in a folder whose names begin with the prefix that a
    study gives to the harness, or to its constant ``PREFIX``, else with its own name. The piece is
    "" where a study has one result."""
    prefix = study.stem.replace("_", "-")
    for node in ast.walk(ast.parse(study.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == "PREFIX":
            prefix = ast.literal_eval(node.value)
        elif isinstance(node, ast.Call) and ast.unparse(node.func) in ("main", "run_pieces"):
            third = node.args[2] if len(node.args) > 2 else None
            prefix = str(third.value) if isinstance(third, ast.Constant) else prefix
    for path in sorted([*folder.glob(f"{prefix}.json"), *folder.glob(f"{prefix}-*.json")]):
        yield path.stem.removeprefix(prefix).removeprefix("-"), path, study


def check(studies: Sequence[str], only: Sequence[str], folder: Path, *, tell: bool) -> int:
    """Measure what is old again, oldest first, or only tell it; 1 where a study failed.

    studies: all that there are, which tells whose a result is. only: those that are looked at; with
    none, all.
    """
    results = [r for name in studies for r in results_of(HERE / f"{name}.py", folder)]
    # Of two prefixes of a name the longer one, which leaves the shorter piece, is its study's.
    known = {r[1]: r for r in sorted(results, key=lambda r: len(r[0]), reverse=True)}
    for path in sorted(set(folder.glob("*.json")) - set(known)):
        print(f"{path.name}: no study of this folder makes it: remove it?")
    asked = [result for result in known.values() if not only or result[2].stem in only]
    old = []
    for piece, path, study in asked:
        found = json.loads(path.read_text(encoding="utf-8"))
        why = list(islice(changed(found.get("code"), path.name), _TOLD))
        why += filter(None, [behind(found.get("versions", {}).get("gfnn_jax") or "0.0.0")])
        if why:
            took = f"{found['seconds']:.0f} s" if "seconds" in found else "time not known"
            old.append((found.get("date", ""), path, study, piece, f"{', '.join(why)}; {took}"))
    print(f"{len(asked) - len(old)} of {len(asked)} results are of current studies")
    paths = os.pathsep.join(filter(None, [str(HERE.parent), os.environ.get("PYTHONPATH")]))
    failed = 0
    for date, path, study, piece, why in sorted(old):
        print(f"{path.name}, {date}: {why}", flush=True)
        if tell:
            continue
        command = [sys.executable, study, *(["--only", piece, "--overwrite"] if piece else [])]
        before = path.read_bytes()
        if not piece:  # such a study measures what has no result
            path.unlink()
        try:
            done = subprocess.run(command, check=False, env=os.environ | {"PYTHONPATH": paths})
            failed |= done.returncode != 0
        finally:
            if not path.exists():
                path.write_bytes(before)
    return int(failed)
