"""Formulas for people, for parsers, and as sympy reads them: its home."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Mapping, Sequence
from typing import Any

from gfnn_jax.families.text import Term, added, digits, in_letters, measured


@dataclasses.dataclass(frozen=True)
class Formula:
    """A sum of terms, each as code in the names of its variables."""

    terms: tuple[Term, ...]

    @property
    def formula(self) -> str:
        """Formula as Python writes it, which ``--terms`` and sympy read."""
        return added(f"{digits(c, s)}*{t}" for t, c, s in self.terms) or "0"

    def __str__(self) -> str:
        """Formula as a person writes it: the last digits' standard errors in brackets."""
        return added(f"{measured(c, s)} {in_letters(t)}" for t, c, s in self.terms) or "0"

    def sympy(self) -> Any:
        """Formula as a sympy expression."""
        return as_sympy(self.formula)

    def latex(self) -> str:
        """Formula in LaTeX's notation, its terms in their order."""
        return added(f"{digits(c, s)} {as_latex(t)}" for t, c, s in self.terms) or "0"


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


def hamiltonian(entries: Mapping[tuple[int, ...], Sequence[str]], potential: str, dim: int) -> Any:
    """½ (p − a)ᵀ M⁻¹ (p − a) + V in p1, …, pd: of V, and of the summands of the entries (i, j),
    i <= j, of M and (i,) of a."""
    import sympy

    mass, field = sympy.zeros(dim, dim), sympy.zeros(dim, 1)
    for axes, summands in entries.items():
        entry = sum(map(as_sympy, summands), sympy.Integer(0))
        if len(axes) == 1:
            field[axes[0]] = entry
        else:
            mass[axes], mass[axes[::-1]] = entry, entry
    p = sympy.Matrix(sympy.symbols(f"p1:{dim + 1}")) - field
    kinetic = (p.T * mass.inv() * p)[0, 0] / 2
    return kinetic + as_sympy(potential)
