"""Every block of code in docs/ runs, page by page from the top; every link leads somewhere."""

import ast
import importlib
import re
import shlex
import sys
from pathlib import Path

import pytest
from test_import_order import ORDER

import gfnn_jax
from gfnn_jax import cli

ROOT = Path(__file__).parent.parent
PAGES = sorted((ROOT / "docs").glob("*.md"))
# What these pages show other tests guard.
SLOW = """
    args args-in-maps bands brackets charts-and-families cheat-sheet command-line export
    extending friction-and-inputs known-terms laws many mathematics own-family own-parts
    positions-alone storage-ring runs-that-differ scaling your-own-data
"""
sys.path.insert(0, str(ROOT / "benchmarks"))
INSTALL = ("python3 -m venv ", ".venv/bin/pip install ")


def blocks(page):
    return re.findall(r"^```(\w*)\n(.*?)^```", page.read_text(encoding="utf-8"), re.S | re.M)


@pytest.mark.parametrize(
    "page",
    [
        pytest.param(page, marks=pytest.mark.slow) if page.stem in SLOW.split() else page
        for page in PAGES
    ],
    ids=lambda page: page.stem,
)
def test_code_runs(page, tmp_path, monkeypatch, as_a_user):
    monkeypatch.chdir(tmp_path)
    names = {"__name__": page.stem}
    for language, code in blocks(page):
        assert language in ("python", "sh", "text"), f"a block of {language or 'no language'}"
        if language == "python":
            exec(compile(code, str(page), "exec"), names)
        for line in code.splitlines() if language == "sh" else ():
            if line.startswith("gfnn "):
                assert cli.main(shlex.split(line)[1:]) == 0
            else:
                assert line.startswith(INSTALL)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_what_pages_import_is_there(page):
    """Of most pages the code runs in the slow tests alone."""
    code = [ast.parse(text) for language, text in blocks(page) if language == "python"]
    for found in (node for tree in code for node in ast.walk(tree)):
        if isinstance(found, ast.ImportFrom) and (found.module or "").startswith("gfnn_jax"):
            module = importlib.import_module(str(found.module))
            assert not [name.name for name in found.names if not hasattr(module, name.name)]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_links_lead_somewhere(page):
    local = re.findall(r"\]\((?!https?:)([^)#]+)\)", page.read_text(encoding="utf-8"))
    assert not [path for path in local if not (page.parent / path).exists()]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_pages_and_paragraphs_are_short(page):
    text = page.read_text(encoding="utf-8")
    assert len(text.splitlines()) <= 150
    if page.stem in ("architecture", "extending", "inside-a-step"):
        return
    prose = re.sub(r"^```.*?^```$", "", text, flags=re.S | re.M)
    other = re.compile(r"\s*(\||- |\d+\. |#|    |<!--|\*[A-Z]|!\[)")
    paragraphs = [block.strip("\n").split("\n") for block in prose.split("\n\n")]
    plain = [lines for lines in paragraphs if not any(map(other.match, lines))]
    assert not [lines[0] for lines in plain if len(lines) > 6]


def test_every_page_is_in_the_navigation():
    navigation = (ROOT / "mkdocs.yml").read_text(encoding="utf-8").split("nav:")[1]
    assert sorted(re.findall(r"[\w-]+\.md", navigation)) == [page.name for page in PAGES]


def test_architecture_has_every_module_in_the_order_of_imports():
    table = (
        (ROOT / "docs/architecture.md").read_text("utf-8").split("|---|---|")[1].split("\n\n")[0]
    )
    first = [line.split("|")[1] for line in table.strip().splitlines()]
    rooms = [room.replace("/", ".") for room in re.findall(r"`([\w/]+?)/?`", " ".join(first))]
    assert rooms == [m for m in ORDER if m != "__main__"]


def test_one_version_everywhere():
    first = re.search(r"^## (\S+) \((.*)\)", (ROOT / "CHANGELOG.md").read_text("utf-8"), re.M)
    assert first
    assert f'version = "{first[1]}"' in (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    assert f"version: {first[1]}" in (ROOT / "CITATION.cff").read_text(encoding="utf-8")


def test_every_public_name_is_in_the_reference():
    shown = re.findall(r"::: gfnn_jax\.(\w+)\n", (ROOT / "docs/reference.md").read_text("utf-8"))
    data = {"CHARTS"}  # explained on the page of charts
    assert set(shown) == set(gfnn_jax.__all__) - data


@pytest.mark.slow
def test_site_builds_without_warnings(tmp_path):
    build = pytest.importorskip("mkdocs.commands.build").build
    load_config = pytest.importorskip("mkdocs.config").load_config
    build(load_config(str(ROOT / "mkdocs.yml"), site_dir=str(tmp_path), strict=True))
    assert (tmp_path / "reference" / "index.html").exists()


def test_numbers_in_prose_are_what_the_results_hold():
    import harness

    named = 0
    for page in [ROOT / "README.md", *PAGES]:
        text = page.read_text(encoding="utf-8")
        assert harness.in_prose(text) == text, page.name
        named += len(re.findall(r"\S<!--\s[\w.-]+/", text))
    assert named > 10


def test_times_in_prose_come_from_results():
    """Numbers of seconds are measured, and so have a marker; one page estimates."""
    unmarked = re.compile(r"(?<![\w.`])[\d.,]*\d\s(?:s|ms|µs|seconds|minutes|hours)\b")
    for page in PAGES:
        text = re.sub(
            r"^```.*?^```$|<!-- ([\w-]+) -->.*?<!-- /\1 -->",
            "",
            page.read_text("utf-8"),
            flags=re.S | re.M,
        )
        if page.stem != "scaling-costs":
            assert not unmarked.findall(re.sub(r"`[^`]*`|\S+<!--.*?-->", "", text)), page.name


def test_the_ten_lines_are_what_the_results_hold():
    import summary

    text = (ROOT / "benchmarks" / "RESULTS.md").read_text(encoding="utf-8")
    for claim, figure, _, _ in summary.LINES:
        assert f"| {claim} | {figure()} |" in text


def test_every_result_of_the_repository_has_a_study():
    import commits

    from benchmarks.__main__ import studies

    here = commits.HERE
    made = [r for s in studies() for r in commits.results_of(here / f"{s}.py", here / "results")]
    assert {path for _, path, _ in made} == set((here / "results").glob("*.json"))
