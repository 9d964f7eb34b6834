"""Docstrings open with a verb or a noun."""

import ast
import re
from pathlib import Path

import gfnn_jax

PACKAGE = Path(gfnn_jax.__file__).parent
FRAGMENTS = {
    "as",
    "before",
    "between",
    "but",
    "by",
    "for",
    "from",
    "how",
    "if",
    "in",
    "its",
    "no",
    "none",
    "not",
    "of",
    "on",
    "or",
    "so",
    "some",
    "than",
    "that",
    "their",
    "these",
    "this",
    "those",
    "to",
    "what",
    "when",
    "where",
    "whether",
    "which",
    "who",
    "whose",
    "why",
    "with",
    "without",
}


def openings():
    """List (place, first word) of the docstrings of all modules, classes and functions."""
    for path in sorted(PACKAGE.rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, (ast.Module, ast.ClassDef, ast.FunctionDef)):
                text = ast.get_docstring(node)
                word = re.search(r"\w[\w'’]*", text or "")
                name = getattr(node, "name", "")
                yield f"{path.relative_to(PACKAGE)} {name}", word[0].lower() if word else ""


def test_no_docstring_opens_with_a_fragment():
    assert [place for place, word in openings() if word in FRAGMENTS] == []
