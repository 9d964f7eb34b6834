"""Results that are older than their code: found, measured again oldest first, what moved told."""

import ast
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

import gfnn_jax

sys.path.insert(0, str(Path(__file__).parent.parent / "benchmarks"))

import current
import ran
from parts import parts

STUDY = '''"""A study."""
import json, pathlib, sys

def main(doc, pieces, prefix):
    piece = sys.argv[2]
    if piece == "broken":
        sys.exit(1)
    out = pathlib.Path({out!r}) / f"{{prefix}}-{{piece}}.json"
    code = {{"tries.py": {code!r}}}
    out.write_text(json.dumps({{"date": "2026-11-23", "code": code, "measured": {{"rms": 2.0}}}}))

main(__doc__, {{}}, "tries")
'''


def test_code_is_told_by_what_it_does(tmp_path):
    one, other, third = (tmp_path / f"{n}.py" for n in ("a", "b", "c"))
    one.write_text('"""Doc."""\ndef f(x):\n    """Adds."""\n    return x + 1  # one\n')
    other.write_text("def f(x):\n    return (x+1)\n")
    third.write_text("def f(x):\n    return x + 2\n")
    meanings = [current._meaning(path) for path in (one, other, third)]
    assert meanings[0] == meanings[1] != meanings[2]


def test_a_result_is_old_where_a_function_changed_that_it_ran(tmp_path, monkeypatch):
    """Of a package that is imported whole, the functions that ran count, and constants that files
    with some of them take."""
    package, study = tmp_path / "noted_package", tmp_path / "study.py"
    package.mkdir()
    files = {
        "__init__": "from noted_package import ran_one, idle, limits",
        "ran_one": "from math import pi\nfrom noted_package.limits import MOST\n_HALF = 0.5\n"
        "def f(x):\n    'Doc.'\n    return min(x, MOST)\n"
        "def other():\n    return pi * _HALF",
        "idle": "def g(x):\n    return x",
        "limits": "MOST = 3\ndef h():\n    return MOST",
    }
    for name, text in files.items():
        (package / f"{name}.py").write_text(f"{text}\n")
    study.write_text("import noted_package\n")
    monkeypatch.setattr(current, "HERE", tmp_path)
    monkeypatch.setattr(current, "PACKAGE", package)
    monkeypatch.syspath_prepend(tmp_path)
    assert list(current.code_of(study)) == ["noted_package", "study.py"]  # nothing is noted
    monkeypatch.setattr(sys, "meta_path", [*sys.meta_path])
    ran.note("noted_package")
    import noted_package  # pyright: ignore[reportMissingImports]

    with pytest.raises(RuntimeError, match="imported already"):
        ran.note("noted_package")
    assert noted_package.ran_one.f(5) == 3
    assert noted_package.ran_one.f.__doc__ == "Doc."
    path = tmp_path / "study.json"
    (package / "ran_one.py").write_text("def f(x):\n    return 0\n")  # after it was imported
    path.write_text(json.dumps({"code": current.code_of(study)}))
    (package / "ran_one.py").write_text(f"{files['ran_one']}\n")
    ran._texts.clear()
    current._parts.cache_clear()
    result = current.Result(path, study, "")
    assert result.changed == []
    for name, text, changed in (
        ("idle", "def g(x):\n    return x + 1", []),
        ("ran_one", files["ran_one"] + "  # a comment", []),
        ("ran_one", files["ran_one"].replace("pi * _HALF", "1"), []),
        ("ran_one", files["ran_one"].replace("_HALF = 0.5", "_HALF = 0.6"), []),
        ("ran_one", files["ran_one"] + "\ndef new(x):\n    return x", []),
        ("ran_one", files["ran_one"].replace("min", "max"), ["noted_package/ran_one.py"]),
        (
            "ran_one",
            files["ran_one"].replace("MOST\n_", "h as MOST\n_"),
            ["noted_package/ran_one.py"],
        ),
        ("ran_one", files["ran_one"], []),
        ("limits", "MOST = 4", ["noted_package/limits.py"]),
    ):
        (package / f"{name}.py").write_text(f"{text}\n")
        current._parts.cache_clear()
        assert result.changed == changed, (name, text)
    path.write_text(json.dumps({"code": "0123456789abcdef"}))  # as of a version before
    assert result.changed is None
    study.write_text("import sys\nprint(sys.executable)\n")  # what Python it starts runs is unknown
    assert "noted_package" in current.code_of(study)


MODULE = """
\'\'\'Doc.\'\'\'
from typing import TYPE_CHECKING
from a import b, c, shown
if TYPE_CHECKING:
    from a import T
X: int = 3
_y = b(1)
_z = 2
class C:
    "Doc."
    size = 2
    def one(self):
        def inner():
            return c
        return _y
    def two(self):
        return inner, _z
def _f():
    return c
_f = wrap(_f)
print(X)
"""


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("Doc.", "Docs."),
        ("a import T\n", "a import S\n"),
        ("return inner, _z", "return 1"),
        ("return c\n        return", "return b\n        return"),
        ("b, c", "b, c, d"),
        ("_z = 2", "_z = 3"),
        ("print(X)", "print(X)  # shows it"),
        ("def _f():", "def g():\n    pass\ndef _f():"),
    ],
)
def test_parts_that_a_result_did_not_run(old, new):
    assert old in MODULE
    assert parts(MODULE.replace(old, new)) >= parts(MODULE, {"C.one"})


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("print(X)", "print(2)"),
        ("size = 2", "size = 3"),
        ("two", "three"),
        ("b(1)", "b(2)"),
        ("import b", "import e as b"),
        ("return _y", "return 1"),
        ("X: int = 3", "X: int = 4"),
        ("shown", "e as shown"),
    ],
)
def test_parts_that_a_result_ran_or_that_the_module_shows(old, new):
    assert not parts(MODULE.replace(old, new)) >= parts(MODULE, {"C.one"})


def test_parts_that_are_imported_elsewhere_and_a_name_that_is_given_twice():
    assert not parts(MODULE.replace("_z = 2", "_z = 3")) >= parts(MODULE, {"C.one"}, {"_z"})
    assert parts(MODULE) >= parts(MODULE, {"_f"})
    assert not parts(MODULE.replace("wrap(_f)", "other(_f)")) >= parts(MODULE, {"_f"})


def test_parts_of_each_function_are_among_those_of_its_module():
    for path in (Path(gfnn_jax.__file__).parent / "signals").glob("*.py"):
        text = path.read_text(encoding="utf-8")
        for name, _ in ran.functions_of(ast.parse(text)):
            assert parts(text, {name}) <= parts(text), name


def test_what_is_old_is_measured_again(tmp_path, monkeypatch):
    study, said = tmp_path / "tries.py", []
    monkeypatch.setattr(current, "HERE", tmp_path)
    monkeypatch.setattr(current, "PACKAGE", tmp_path / "none")
    study.write_text(STUDY.format(out=str(tmp_path), code="new"))
    monkeypatch.setattr(current, "_digest", lambda path: "new")
    for name, date, code in (
        ("new", "2026-11-20", "new"),
        ("young", "2026-11-22", "old"),
        ("old", "2026-11-21", "old"),
        ("broken", "2026-11-22", None),
    ):
        of = code and {"tries.py": code}
        result = {"date": date, "code": of, "seconds": 9.0, "measured": {"rms": 1.0}}
        (tmp_path / f"tries-{name}.json").write_text(json.dumps(result))
    assert current.check(["tries"], tmp_path, only_tell=True, say=said.append) == 0
    assert said[0] == "1 of 4 results are of current code"
    assert [line.split(":")[0] for line in said[1:]] == [
        "tries-old.json",
        "tries-young.json",
        "tries-broken.json",
        "all of them again",
    ]
    assert said[1].endswith(": changed since: tries.py (2026-11-21, 9 s)")
    assert "which files it ran is not recorded" in said[3]
    said.clear()
    assert current.check(["tries"], tmp_path, say=said.append) == 1
    assert said[1] == "tries-old.json: rms 1 → 2"
    assert said[3] == "tries-broken.json: its study failed"
    said.clear()
    assert current.check(["tries"], tmp_path, only_tell=True, say=said.append) == 0
    assert said[0] == "3 of 4 results are of current code"


def test_a_study_alone_leaves_the_others_results_and_what_a_kill_left_is_found(
    tmp_path, monkeypatch
):
    """Results of "tries-again" are not those of "tries", whose names begin as theirs do."""
    said = []
    monkeypatch.setattr(current, "HERE", tmp_path)
    monkeypatch.setattr(current, "PACKAGE", tmp_path / "none")
    monkeypatch.setattr(current, "_digest", lambda path: "new")
    for name in ("tries", "tries_again"):
        prefix = name.replace("_", "-")
        text = STUDY.replace('"tries")', f'"{prefix}")').format(out=str(tmp_path), code="new")
        (tmp_path / f"{name}.py").write_text(text)
        result = {"date": "2026-11-21", "code": {"tries.py": "old"}, "measured": {"rms": 1.0}}
        (tmp_path / f"{prefix}-one.json").write_text(json.dumps(result))
    (tmp_path / "tries-one.json").rename(tmp_path / "tries-one.before")  # killed
    both = ["tries", "tries_again"]
    assert current.check(both, tmp_path, only=["tries"], say=said.append) == 0
    assert said == ["0 of 1 results are of current code", "tries-one.json: rms 1 → 2"]
    assert json.loads((tmp_path / "tries-again-one.json").read_text())["code"] == {
        "tries.py": "old"
    }
    assert not list(tmp_path.glob("*.before"))


@pytest.mark.parametrize(
    ("found", "seconds"),
    [
        ({"seconds": 3.0, "measured": {"a": {"seconds": 9.0}}}, 3.0),
        ({"measured": {"a": {"seconds": 1.0}, "b": {"seconds": 2.0}}}, 3.0),
        ({"measured": {"a": {"seconds": {"x": 1.0}}}}, None),
        ({"measured": [1, 2]}, None),
    ],
)
def test_the_time_that_a_result_took(found, seconds):
    assert current._seconds(found) == seconds


def test_what_moved():
    before = {"a": 1.0, "b": [1.0, 2.0], "met": True, "seconds": 5.0, "gone": 0}
    after = {"a": 1.05, "b": [1.0, 3.0], "met": False, "seconds": 50.0}
    assert current.what_moved(before, after) == (
        "met True → False; b[1] 2 → 3; 1 numbers gone, 0 new"
    )
    assert current.what_moved(before, before) == "nothing moved by more than a tenth"


def test_every_result_of_the_repository_has_a_study(monkeypatch):
    from benchmarks.__main__ import studies

    folder, said = Path(current.__file__).parent / "results", []
    assert current.check(list(studies()), folder, only_tell=True, say=said.append) == 0
    assert not [line for line in said if "no study" in line]


def test_a_figure_drawn_otherwise_makes_no_result_old(tmp_path):
    path = tmp_path / "study-one.json"
    files = ["evaluate/figures_style.py", "evaluate/metrics.py"]
    path.write_text(json.dumps({"code": {f"gfnn_jax/{name}": "other" for name in files}}))
    assert current.Result(path, tmp_path / "study.py", "one").changed == [f"gfnn_jax/{files[1]}"]


@pytest.mark.parametrize("how", ["script", "-m", "-c"])
def test_what_another_python_runs_counts(tmp_path, how):
    """Of a process that comes to its end; where one is killed nothing is known."""
    package, study = tmp_path / "counted", tmp_path / "study.py"
    package.mkdir()
    (package / "__init__.py").write_text("")
    (package / "idle.py").write_text("def g(x):\n    return x\n")
    (package / "works.py").write_text(
        "import sys, counted.idle\ndef f(x):\n    print(x)\n"
        "if __name__ == '__main__':\n    import counted.works\n"
        "    counted.works.f(*sys.argv[1:])\n"
    )
    text = "import sys\nfrom counted.works import f\nf(*sys.argv[1:])"
    (tmp_path / "script.py").write_text(text)
    words = {"script": [tmp_path / "script.py"], "-m": ["-m", "counted.works"], "-c": ["-c", text]}
    study.write_text(f"""
import os, subprocess, sys
sys.path.insert(0, {str(Path(ran.__file__).parent)!r})
import ran
ran.note("counted")
import counted
command = ran.python("counted", *{list(map(str, words[how]))}, "heard")
print(subprocess.run(command, capture_output=True, text=True).stdout.strip())
print({{path.name: names for path, names in ran.functions("counted").items()}})
ran.python("counted", "-c", "")
print(ran.functions("counted"))
""")
    done = subprocess.run(
        [sys.executable, study],
        capture_output=True,
        text=True,
        check=False,
        env=os.environ | {"PYTHONPATH": str(tmp_path)},
    )
    assert done.stdout.splitlines() == ["heard", "{'works.py': {'f'}}", "None"], done.stderr
