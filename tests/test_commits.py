"""Results that are older than their code are found, told and measured again."""

import json
import subprocess
import sys
from pathlib import Path

import pytest
from other_python import run_python

sys.path.insert(0, str(Path(__file__).parent.parent / "benchmarks"))

import commits

from benchmarks.__main__ import studies

STUDY = """
import json, pathlib, sys
import commits

def main(doc, pieces, prefix):
    if sys.argv[2] == "broken":
        sys.exit(1)
    found = {"code": commits.code(), "measured": {"rms": 2.0}}
    pathlib.Path(f"benchmarks/results/{prefix}-{sys.argv[2]}.json").write_text(json.dumps(found))

main(__doc__, {}, "a-try")
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
    source = Path(__file__).parent.parent / "benchmarks/commits.py"
    Path("benchmarks/commits.py").write_bytes(source.read_bytes())
    forget()
    yield tmp_path, commit
    forget()


def forget():
    for cached in (commits._came_with, commits._differ, commits._meaning, commits._minor_today):
        cached.cache_clear()


def is_old(code, name="a-try-one.json"):
    forget()
    return list(commits.changed(code, name))


def test_a_result_is_old_where_a_script_changed_that_it_loaded(repository):
    root, commit = repository
    first = commit()
    code = {
        "commit": first,
        "dirty": False,
        "files": "benchmarks/a_try.py benchmarks/used.py gfnn_jax/room.py",
    }
    assert is_old(code) == []
    used = root / "benchmarks/used.py"
    used.write_text("def f(x):  # the same\n    '''Other words.'''\n    return (x)\n")
    (root / "gfnn_jax/room.py").write_text("Y = 2\n")
    assert is_old(code) == []
    used.write_text("def f(x):\n    return 2 * x\n")
    assert is_old(code) == ["benchmarks/used.py"]
    # One that was measured beside this change is of the commit that it came with, as one of 0.3.
    for other in (code | {"dirty": True}, {"benchmarks/used.py": "ab1 cd2"}, {"benchmarks": "ab1"}):
        (root / "benchmarks/results/a-try-one.json").write_text(json.dumps({"code": other}))
        commit()
        assert is_old(other) == []
        used.write_text(used.read_text() + "Z = 1\n")
        assert is_old(other) == ["benchmarks/used.py"]
    used.unlink()
    assert is_old(code) == ["benchmarks/used.py"]
    assert len(is_old(None)) == len(is_old(code, "")) == 1
    assert [commits.behind(f"0.{minor}.1") for minor in (2, 3, 4)] == ["of version 0.2.1", "", ""]


def test_what_is_old_is_measured_again(repository, capsys):
    root, commit = repository
    results = root / "benchmarks/results"
    commit()
    for name in ("one", "broken", "other"):
        code = None if name != "other" else {"benchmarks/used.py": ""}
        found = {"code": code, "versions": {"gfnn_jax": "0.4.0"}}
        (results / f"a-try-{name}.json").write_text(json.dumps(found))
    (results / "nobody.json").write_text("{}")
    commit()
    forget()
    before = (results / "a-try-broken.json").read_bytes()
    assert commits.check(["a_try"], [], results, tell=True) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith("nobody.json")
    assert lines[1].startswith("1 of 3")
    assert [line.split(",")[0] for line in lines[2:]] == ["a-try-broken.json", "a-try-one.json"]
    assert commits.check(["a_try"], ["a_try"], results, tell=False) == 1
    assert (results / "a-try-broken.json").read_bytes() == before
    found = json.loads((results / "a-try-one.json").read_text())
    assert found["measured"] == {"rms": 2.0}
    assert found["code"]["dirty"] is False
    assert "benchmarks/a_try.py" in found["code"]["files"].split()


def test_every_result_of_the_repository_has_a_study():
    here = commits.HERE
    made = [r for s in studies() for r in commits.results_of(here / f"{s}.py", here / "results")]
    assert {path for _, path, _ in made} == set((here / "results").glob("*.json"))


def test_a_study_tells_its_commit_and_files():
    text = "import harness, json; print(json.dumps(harness.circumstances()['code']))"
    code = json.loads(run_python(text))
    assert {"gfnn_jax/phase_space.py", "benchmarks/harness.py"} <= set(code["files"].split())
    assert "gfnn_jax/cli.py" not in code["files"]
