"""A law as fitted, and H as text: its terms with coefficients, for people and for programs."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from gfnn_jax.dataset.measured_error import OneStepError
from gfnn_jax.families.sums import Sums
from gfnn_jax.families.terms import Terms
from gfnn_jax.families.text import Term, added, digits, plain
from gfnn_jax.fitting.evidence import Rival
from gfnn_jax.fitting.gauss_newton import FlowFit


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
    undetermined: of the null terms, those that other states would tell from the rest. stalled:
    whether larger libraries were no better. noisy: whether their errors were the same, which is
    that of the pairs; larger: the largest of those. thresholds: standard errors below which its
    terms go, in turn; None: as of the options. dropped: terms that went in the end. whole: what
    whole sequences tell, where they were fitted. constants: numbers inside terms that were fitted
    with them. symmetries, rivals: as of `LearnedHamiltonian`. odds: of the kinds of its friction
    against others, where these competed."""

    family: Any  # of terms of H, or of L, with friction or without
    fit: FlowFit
    rows: np.ndarray
    error: OneStepError
    null: tuple[str, ...] = ()
    undetermined: tuple[str, ...] = ()
    stalled: bool = False
    noisy: bool = False
    larger: FittedLaw | None = None
    thresholds: tuple[float, ...] | None = None
    dropped: Dropped | None = None
    whole: SequenceFit | None = None
    constants: tuple[Term, ...] = ()
    symmetries: tuple[str, ...] = ()
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
