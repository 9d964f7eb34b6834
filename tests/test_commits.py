"""Results that are older than their code are found, told and measured again."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent.parent / "benchmarks"))

import commits

from benchmarks.__main__ import studies

STUDY = """
import json, pathlib, sys
import commits
import used

SYSTEMS = {"first": 1, "other": 2}
PIECES = {"one": lambda: used.f(SYSTEMS["first"]), "broken": None}
PIECES |= {"other": lambda: SYSTEMS["other"]}

def tables():
    return "a table"

def main(doc, pieces, prefix):
    if sys.argv[2] == "broken":
        sys.exit(1)
    found = {"code": commits.code(), "versions": {"gfnn_jax": "0.4.0"}, "measured": {"rms": 2.0}}
    pathlib.Path(f"benchmarks/results/{prefix}-{sys.argv[2]}.json").write_text(json.dumps(found))

if __name__ == "__main__":
    main(__doc__, PIECES, "a-try")
"""


@pytest.fixture
def repository(tmp_path, monkeypatch):
    """A repository of a package and of a study that loads two scripts; (root, commit)."""

    def commit() -> str:
        for words in (["add", "-A"], ["commit", "-qm", "one", "--allow-empty"]):
            subprocess.run(["git", *words], check=True, cwd=tmp_path)
        return commits.git("rev-parse", "HEAD").strip()

    for variable in ("GIT_AUTHOR", "GIT_COMMITTER"):
        monkeypatch.setenv(f"{variable}_NAME", "one")
        monkeypatch.setenv(f"{variable}_EMAIL", "one@example.org")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(commits, "HERE", tmp_path / "benchmarks")
    subprocess.run(["git", "init", "-q"], check=True)
    for folder in ("gfnn_jax", "benchmarks/results"):
        Path(folder).mkdir(parents=True)
    Path("benchmarks/used.py").write_text('"""Doc."""\ndef f(x):\n    return x\n')
    Path("gfnn_jax/room.py").write_text("Y = 1\n")
    Path("pyproject.toml").write_text('[project]\nversion = "0.4.0"\n')
    Path("benchmarks/a_try.py").write_text(STUDY)
    for name in ("commits.py", "reached.py"):
        source = Path(__file__).parent.parent / "benchmarks" / name
        Path("benchmarks", name).write_bytes(source.read_bytes())
    forget()
    yield tmp_path, commit
    forget()


def forget():
    for cached in (commits._came_with, commits._differ, commits._text, commits._scripts):
        cached.cache_clear()
    commits._version.cache_clear()


def is_old(root, code, piece="one"):
    result = root / f"benchmarks/results/a-try-{piece}.json"
    result.write_text(json.dumps({"code": code, "versions": {"gfnn_jax": "0.4.0"}}))
    forget()
    return commits.old(result, root / "benchmarks/a_try.py", piece)


def test_a_result_is_old_where_something_changed_that_its_piece_reaches(repository):
    root, commit = repository
    code = {"commit": commit(), "dirty": False}
    used, study = root / "benchmarks/used.py", root / "benchmarks/a_try.py"
    assert is_old(root, code) == []
    used.write_text("def f(x: int):  # the same\n    '''Other words.'''\n    return (x)\n")
    (root / "gfnn_jax/room.py").write_text("Y = 2\n")
    study.write_text(STUDY.replace('"a table"', '"another"'))
    assert is_old(root, code) == []
    study.write_text(STUDY.replace('"other": 2', '"other": 3'))  # a row of another piece
    assert is_old(root, code) == []
    assert is_old(root, code, "other") == ["a_try.py: SYSTEMS"]
    study.write_text(STUDY.replace('"first": 1', '"first": 3'))
    assert is_old(root, code) == ["a_try.py: SYSTEMS"]
    study.write_text(STUDY)
    used.write_text("def f(x):\n    return 2 * x\n")
    assert is_old(root, code) == ["used.py: f"]
    # One measured beside this change, or whose study was read, is of the commit that it came with.
    for other in (
        code | {"dirty": True},
        {"benchmarks/used.py": "ab1"},
        code | {"read": "renamed"},
    ):
        is_old(root, other)
        commit()
        assert is_old(root, other) == []
        used.write_text(used.read_text().replace("return", "return 1 +"))
        assert is_old(root, other) == ["used.py: f"]
    used.unlink()
    assert is_old(root, code) == ["used.py: f"]
    assert is_old(root, None, "never") == ["it is not committed"]
    assert [commits.behind(f"0.{minor}.1") for minor in (2, 3, 4)] == [True, False, False]


def test_every_result_of_the_repository_has_a_study():
    here = commits.HERE
    made = [r for s in studies() for r in commits.results_of(here / f"{s}.py", here / "results")]
    assert {path for _, path, _ in made} == set((here / "results").glob("*.json"))
