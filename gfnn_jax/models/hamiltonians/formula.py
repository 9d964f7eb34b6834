"""H as text: the terms of a law with their coefficients, as people and as programs read them."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from gfnn_jax.families.sums import Sums
from gfnn_jax.families.terms import Terms
from gfnn_jax.families.text import Term, added, digits, plain


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
