"""Which results are old: told, or measured again, oldest first.

A result is old in two cases. Its study changed: what its piece reaches (`reached`) is not what it
was at the commit of the result. Or the package did: it was measured with a version more than one
minor version behind today's. Between two versions `freeze.py` guards the package, by the bits of
thirty fits; a commit that moves numbers on purpose measures the studies that it names again.

A result that was measured with scripts that differed from its commit's, or that notes no commit of
this repository, counts as of the commit that it came with. So does one whose study somebody read,
with `--read WHY`: it changed in nothing that is measured, as where a call follows a new interface.
The result keeps the reason as ``code.read``, and is old again with the next change.
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
from pathlib import Path
from typing import Any

from reached import Scripts, differing

HERE = Path(__file__).resolve().parent
PACKAGE = "gfnn_jax"
_BEHIND = 1  # minor versions that a result may be


def git(*words: str) -> str:
    """What git says of the repository that this folder is in; "" where it fails or is not there."""
    command = ["git", "-C", str(HERE.parent), *words]
    try:
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout
    except (OSError, subprocess.CalledProcessError):
        return ""


def code() -> dict[str, Any]:
    """The commit, and whether Python files of the package or of this folder differ from it."""
    return {
        "commit": git("rev-parse", "HEAD").strip(),
        "dirty": bool(git("status", "--porcelain", "--", f"{PACKAGE}/*.py", f"{HERE.name}/*.py")),
    }


def old(path: Path, study: Path, piece: str) -> list[str]:
    """Why a result is old: "script: names" of what changed, and the version where it is behind."""
    found = json.loads(path.read_text(encoding="utf-8"))
    noted = found.get("code") or {}
    base = noted.get("commit")
    if not base or noted.get("dirty") or "read" in noted or not git("cat-file", "-t", base):
        base = _came_with().get(path.name)
    if not base:
        return ["it is not committed"]
    why = differing(study.name, piece, _scripts(base), _scripts("")) if _differ(base) else []
    version = found.get("versions", {}).get("gfnn_jax") or _version(base)
    return why + ([f"of version {version}"] if behind(version) else [])


def behind(version: str) -> bool:
    """Whether a result of this version of the package is old."""
    then, now = (int(words.split(".")[1]) for words in (version, _version("")))
    return now > then + _BEHIND


@functools.cache
def _text(commit: str, name: str) -> str:
    """A file of a commit, or of today; "" where there is none."""
    if commit:
        return git("show", f"{commit}:{name}")
    path = HERE.parent / name
    return path.read_text(encoding="utf-8") if path.is_file() else ""


@functools.cache
def _version(commit: str) -> str:
    return tomllib.loads(_text(commit, "pyproject.toml"))["project"]["version"]


@functools.cache
def _scripts(commit: str) -> Scripts:
    return Scripts(lambda name: _text(commit, f"{HERE.name}/{name}"))


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
def _differ(base: str) -> bool:
    return bool(git("diff", "--name-only", "--no-renames", base, "--", f"{HERE.name}/*.py"))


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


def check(
    studies: Sequence[str], only: Sequence[str], folder: Path, *, tell: bool, read: str = ""
) -> int:
    """Measure what is old again, oldest first; 1 where a study failed, or a result is nobody's.

    studies: all that there are, which tells whose a result is. only: those that are looked at; with
    none, all. tell: only tell what is old; 1 where something is. read: why what changed since
    changed no number, which is noted in place of measuring.
    """
    results = [r for name in studies for r in results_of(HERE / f"{name}.py", folder)]
    # Of two prefixes of a name the longer one, which leaves the shorter piece, is its study's.
    known = {r[1]: r for r in sorted(results, key=lambda r: len(r[0]), reverse=True)}
    nobodys = sorted(set(folder.glob("*.json")) - set(known))
    for path in nobodys:
        print(f"{path.name}: no study of this folder makes it: remove it?")
    asked = [result for result in known.values() if not only or result[2].stem in only]
    found = []
    for piece, path, study in asked:
        if why := old(path, study, piece):
            result = json.loads(path.read_text(encoding="utf-8"))
            found.append((result.get("date", ""), path, study, piece, why, result))
    print(f"{len(asked) - len(found)} of {len(asked)} results are of current studies")
    failed = int(bool(nobodys) or (tell and bool(found)))
    for date, path, study, piece, why, result in sorted(found, key=lambda one: one[:2]):
        took = f"{result['seconds']:.0f} s" if "seconds" in result else "time not known"
        print(f"{path.name}, {date}: {', '.join(why)}; {took}", flush=True)
        if read:
            noted = {
                k: v for k, v in (result.get("code") or {}).items() if k in ("commit", "dirty")
            }
            result["code"] = noted | {"read": read}
            text = json.dumps(result, indent=1, ensure_ascii=False)
            path.write_text(f"{text}\n", encoding="utf-8")
        elif not tell:
            failed |= not _measured(path, study, piece)
    return failed


def _measured(path: Path, study: Path, piece: str) -> bool:
    """Measure a result again, or leave it as it was; whether the study ended well."""
    paths = os.pathsep.join(filter(None, [str(HERE.parent), os.environ.get("PYTHONPATH")]))
    command = [sys.executable, study, *(["--only", piece, "--overwrite"] if piece else [])]
    before = path.read_bytes()
    if not piece:  # such a study measures what has no result
        path.unlink()
    try:
        done = subprocess.run(command, check=False, env=os.environ | {"PYTHONPATH": paths})
    finally:
        if not path.exists():
            path.write_bytes(before)
    return done.returncode == 0
