"""A law as fitted, and H as text: its terms with coefficients, as people and as programs read it.

Simple fractions near the numbers of a law are proposed where their errors allow, and never taken.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from fractions import Fraction
from itertools import combinations
from typing import Any, NamedTuple

import numpy as np

from gfnn_jax.dataset.measured_error import OneStepError
from gfnn_jax.families.sums import Sums
from gfnn_jax.families.terms import Terms
from gfnn_jax.families.text import Term, added, digits, plain
from gfnn_jax.fitting.gauss_newton import FlowFit

# Fractions: the largest denominator that is tried, the distance from the number in standard errors,
# and the chance that some fraction as simple is as near (benchmarks/textbook_noise.py).
_DENOMINATORS, _NEAR, _CHANCE = 12, 2.0, 0.02


class Rival(NamedTuple):
    """Another law that the pairs allow, and the odds of the one that was taken against it."""

    formula: str
    odds: float


class PartialLaw(NamedTuple):
    """A law that explains a part of the motion, where none explains all of it. left: what its flow
    leaves over, in ``unit``s: parts of the spread, or times the noise."""

    formula: str
    left: float
    unit: str

    def __str__(self) -> str:
        return f"a partial law leaves {self.left:.2g} {self.unit} over: {self.formula}"


OnPartial = Callable[[PartialLaw], Any]


def formula(terms: Sequence[Term]) -> str:
    """H as text: "0.5 p1² + 0.5 p2² - 0.333333333333 q2³"."""
    return added(_times(digits(c, std, spare=1), t) for t, c, std in terms if c) or "0"


def _times(number: str, term: str) -> str:
    """The term with its coefficient, one that is not 1."""
    if number in ("1", "-1"):
        return number[:-1] + term
    if term.startswith("1/"):
        return number + term[1:]
    return f"{number} ({term})" if _is_sum(term) else f"{number} {term}"


def as_code(family: Terms | Sums, terms: Sequence[Term]) -> str:
    """H as `gfnn.fit(terms=[…])` and sympy read it: "0.5*p1**2 - cos(q1)"; over equal sites
    "Sum(0.5*p(i)**2, (i, 1, 8))"; over bodies written out, their coordinates one after another.

    terms: the family's, in their order.
    """
    if isinstance(family, Terms):
        return plain(formula(terms))
    texts, ahead = [], iter(terms)
    for part in family.parts:
        own = [next(ahead)._replace(term=name) for name in part.terms.term_names]
        texts.append(plain(formula(own)))
    return family.as_code(texts)


def _is_sum(term: str) -> bool:
    """Return whether a user's term is a sum, which a coefficient before it would not multiply."""
    term = re.sub(r"\|[^|]*\|", "r", term)  # a distance holds its own difference
    depth = np.cumsum([(c in "(") - (c in ")") for c in term])
    return any(depth[i] == 0 and term[i : i + 3] in (" + ", " - ") for i in range(len(term)))


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


class Dropped(NamedTuple):
    """Terms that went because the pairs do not ask for them, and what that cost: the held-out error
    ÷ spread with them and without."""

    terms: int
    error_with: float
    error_without: float


class SequenceFit(NamedTuple):
    """Fit of a law to whole sequences. root: (k, k), rootᵀ root is the coefficients' covariance.
    noise: (2d,) standard deviation of each coordinate's noise. arcs: into which the sequences were
    cut. messages: about gross errors. misfit: whether the arcs are certain that the law misses more
    than noise."""

    root: np.ndarray
    noise: np.ndarray
    arcs: int
    messages: tuple[str, ...]
    misfit: bool = False


class FittedLaw(NamedTuple):
    """Law of terms with its fit and its held-out error.

    rows: that the fit was given; it has left out those that the flow does not resolve. null: terms
    that the pairs do not tell from the others.
    undetermined: of the null terms, those that other states would tell from the rest. ended: why a
    library that grew did so no longer. stalled: whether larger libraries were no better. noisy:
    whether their errors were the same, which is that of the pairs; larger: the largest
    of those. thresholds: standard errors below which its terms go, in turn; None: as of the
    options. dropped: terms that went in the end. whole:
    what whole sequences tell, where they were fitted. constants: numbers inside terms that were
    fitted with them. symmetries, proposals, rivals: as of `LearnedHamiltonian`. odds: of the kinds
    of its friction against others, where these competed."""

    family: Any  # of terms of H, or of L, with friction or without
    fit: FlowFit
    rows: np.ndarray
    error: OneStepError
    null: tuple[str, ...] = ()
    undetermined: tuple[str, ...] = ()
    ended: str = ""
    stalled: bool = False
    noisy: bool = False
    larger: FittedLaw | None = None
    thresholds: tuple[float, ...] | None = None
    dropped: Dropped | None = None
    whole: SequenceFit | None = None
    constants: tuple[Term, ...] = ()
    symmetries: tuple[str, ...] = ()
    proposals: tuple[Proposal, ...] = ()
    rivals: tuple[Rival, ...] = ()
    odds: dict[tuple[int, ...], float] | None = None

    def with_fit(self, other: FittedLaw) -> FittedLaw:
        """Take the terms and the fit of another, with what the search told of this one."""
        return self._replace(family=other.family, fit=other.fit, rows=other.rows, error=other.error)

    @property
    def values(self) -> dict[str, float]:
        """The coefficient of each term by its name."""
        return dict(zip(self.family.term_names, self.fit.coefficients, strict=True))

    def start_of(self, family) -> np.ndarray:
        """Coefficients (terms,) of another family: this law's, 0 of terms that it has not."""
        known = self.values
        return np.array([known.get(name, 0.0) for name in family.term_names])
