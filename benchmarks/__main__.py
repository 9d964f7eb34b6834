"""The studies of this folder, by name.

    python -m benchmarks --list            what there is, a line each
    python -m benchmarks laws args         two of them, after one another
    python -m benchmarks --quick           all of them, small sizes, into runs/
    python -m benchmarks laws --only hard  options are handed to each study
    python -m benchmarks --check           what is older than its code again, oldest first
    python -m benchmarks --check --tell    only says which these are, and how long they took
    python -m benchmarks args --check      of these studies alone
    python -m benchmarks args --check --read WHY    their scripts changed in no number, for WHY

Each study is a script with a command line of its own (`python benchmarks/laws.py --help`) and runs
in a process of its own: a process may map only so many compiled programs.
"""

from __future__ import annotations

import ast
import itertools
import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent))

from commits import check

HERE = Path(__file__).resolve().parent


def studies() -> dict[str, str]:
    """name -> first line of its docstring, of every script here that has a ``main``."""
    found = {}
    for path in sorted(HERE.glob("*.py")):
        module = ast.parse(path.read_text(encoding="utf-8"))
        runs = any(isinstance(node, ast.If) for node in module.body)  # if __name__ == "__main__"
        if runs and path.stem not in ("__main__", "summary"):  # which measures nothing
            found[path.stem] = (ast.get_docstring(module) or "").splitlines()[0]
    return found


def main(argv: Sequence[str]) -> int:
    known = studies()
    names = list(itertools.takewhile(lambda word: not word.startswith("-"), argv))
    options = list(argv[len(names) :])
    if {"-h", "--help"} & set(options) and not names:
        print(__doc__)
        return 0
    if not (names or options) or options == ["--list"]:
        width = max(map(len, known))
        print("\n".join(f"{name:{width}}  {line}" for name, line in known.items()))
        return 0
    unknown = [name for name in names if name not in known]
    if unknown:
        print(
            f"expected studies of this folder, got '{unknown[0]}'; there are {', '.join(known)}",
            file=sys.stderr,
        )
        return 2
    if options[:1] == ["--check"]:
        how = options[1:]
        if how not in ([], ["--tell"]) and not (names and how[0] == "--read" and len(how) == 2):
            known_ways = "alone, with --tell, or after studies with --read WHY"
            print(f"expected --check {known_ways}, got {' '.join(options)}", file=sys.stderr)
            return 2
        read = how[1] if len(how) == 2 else ""
        folder = HERE / "results"
        return check(list(known), names, folder, tell=how == ["--tell"], read=read)
    paths = os.pathsep.join([str(HERE.parent), *filter(None, [os.environ.get("PYTHONPATH")])])
    failed = []
    for name in names or known:
        done = subprocess.run(
            [sys.executable, HERE / f"{name}.py", *options],
            check=False,
            env=os.environ | {"PYTHONPATH": paths},
        )
        if done.returncode:
            failed.append(name)
    if failed:
        print(f"failed: {', '.join(failed)}", file=sys.stderr)
    return int(bool(failed))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
