"""Docstrings open with a verb or a noun."""

import ast
import re

from test_import_order import modules, statements

WORDS = """
    as before between but by for from how if in its no none not of on or so some than that their
    these this those to what when where whether which who whose why with without
"""
FRAGMENTS = WORDS.split()


def openings():
    """List (place, first word) of the docstrings of all modules, classes and functions."""
    for module, tree in modules():
        for node in (tree, *statements(tree)):
            if isinstance(node, (ast.Module, ast.ClassDef, ast.FunctionDef)):
                text = ast.get_docstring(node, clean=False)
                word = re.search(r"\w[\w'’]*", text or "")
                yield f"{module} {getattr(node, 'name', '')}", word[0].lower() if word else ""


def test_no_docstring_opens_with_a_fragment():
    assert [place for place, word in openings() if word in FRAGMENTS] == []
