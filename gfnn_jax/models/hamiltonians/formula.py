"""H as text: the terms of a law with their coefficients, as people and as programs read them."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from gfnn_jax.families.expressions import plain
from gfnn_jax.families.sums import Sums
from gfnn_jax.families.terms import Terms


class Term(NamedTuple):
    """One term of the formula, its coefficient and that one's standard error."""

    term: str
    coefficient: float
    std: float


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
    text = ""
    for term, coefficient, std in terms:
        if coefficient == 0:
            continue
        sign = " - " if coefficient < 0 else " + "
        size = abs(coefficient)
        digits = 12 if std <= 0 else int(np.clip(np.ceil(np.log10(size / std)) + 1, 2, 12))
        number = f"{size:.{digits}g}"
        factor = "" if number == "1" else f"{number} "
        if factor and term.startswith("1/"):
            factor, term = number, term[1:]
        shown = f"({term})" if factor and _is_sum(term) else term
        text += (sign if text else sign.strip().removeprefix("+")) + factor + shown
    return text or "0"


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
