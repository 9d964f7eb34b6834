"""Simple fractions near the numbers of a law: proposed where their errors allow, never taken."""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction
from itertools import combinations
from typing import NamedTuple

import numpy as np

from gfnn_jax.models.hamiltonians.formula import Term

_DENOMINATORS = 12  # the largest that is tried
_NEAR = 2.0  # standard errors
_CHANCE = 0.02  # that some fraction as simple is as near


class Proposal(NamedTuple):
    """A number of a law, or the ratio of two, and the fraction that it may be."""

    name: str
    value: float
    std: float
    fraction: Fraction

    def __str__(self) -> str:
        """The number with its error: "p1²: 0.49998 ± 2e-05 → 1/2"."""
        digits = int(np.clip(np.ceil(-np.log10(self.std)) + 1, 2, 15)) if self.std > 0 else 15
        return f"{self.name}: {self.value:.{digits}f} ± {self.std:.0e} → {self.fraction}"


def fraction_near(value: float, std: float) -> Fraction | None:
    """The simplest fraction within two standard errors, where it is unlikely to be there by chance.

    Of fractions with denominators up to b there are Σ φ(k), k ≤ b, in every unit.
    """
    among = 0
    for b in range(1, _DENOMINATORS + 1):
        among += sum(np.gcd(k, b) == 1 for k in range(1, b + 1))
        found = Fraction(round(value * b), b)
        if found and abs(value - found) <= _NEAR * std:
            return found if 2 * _NEAR * std * among <= _CHANCE else None
    return None


def proposals(
    terms: Sequence[Term], covariance: np.ndarray, constants: int
) -> tuple[Proposal, ...]:
    """Fractions near numbers with this covariance, the last so many of them constants inside terms;
    of those that are near none, fractions near their ratios, coefficients and constants apart."""
    found, rest = [], []
    for k, term in enumerate(terms):
        near = fraction_near(term.coefficient, term.std)
        inside = k >= len(terms) - constants
        name = f"the constant in {term.term}" if inside else term.term
        if near is None:
            rest.append((k, name, inside))
        else:
            found.append(Proposal(name, term.coefficient, term.std, near))
    for (i, first, a), (j, second, b) in combinations(rest, 2):
        if a != b:
            continue
        x, y = terms[i].coefficient, terms[j].coefficient
        slope = np.array([-y / x**2, 1 / x])
        own = np.ix_([i, j], [i, j])
        std = float(np.sqrt(slope @ covariance[own] @ slope))
        near = fraction_near(y / x, std)
        if near is not None:
            found.append(Proposal(f"{second} ÷ {first}", y / x, std, near))
    return tuple(found)
