"""Formulas as text, read by sympy: its home."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Any


def as_sympy(text: str) -> Any:
    """The expression that a formula in Python's notation says; every name but a function's is a
    symbol, those that sympy has for its own (S, N, E, …) too."""
    import sympy  # loaded when first used

    named = re.findall(r"[A-Za-z_]\w*\b(?!\()", text)
    known: dict[str, Any] = {"arctan": sympy.atan} | {name: sympy.Symbol(name) for name in named}
    return sympy.sympify(text, locals=known)  # pyright: ignore[reportCallIssue]


def as_latex(text: str) -> str:
    """The formula in LaTeX's notation."""
    import sympy

    return sympy.latex(as_sympy(text))


def hamiltonian(mass: Mapping[tuple[int, int], Sequence[str]], potential: str, dim: int) -> Any:
    """½ pᵀ M⁻¹ p + V in p1, …, pd: of the summands of the entries (i, j), i <= j, of M, and V."""
    import sympy

    entries = sympy.zeros(dim, dim)
    for (i, j), summands in mass.items():
        for summand in summands:
            entries[i, j] += as_sympy(summand)
        entries[j, i] = entries[i, j]
    p = sympy.Matrix(sympy.symbols(f"p1:{dim + 1}"))
    kinetic = (p.T * entries.inv() * p)[0, 0] / 2
    return kinetic + as_sympy(potential)
