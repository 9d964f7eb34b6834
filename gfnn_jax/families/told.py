"""Values, bounds and ties of coefficients that a user tells, and a family that keeps them.

    p1**2 = 0.5;    0 <= q1**4 <= 2;    cos(q2) = 2*cos(q1)

are a value, bounds, and a multiple of the coefficient of another term. Values and multiples leave
f = Σ c_j φ_j with fewer free numbers x: c = c₀ + B x.
"""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np

from gfnn_jax.errors import InputError
from gfnn_jax.families.family import AroundAnother
from gfnn_jax.families.terms import Terms

_TURNED = {"<=": ">=", ">=": "<=", "=": "="}


class Told(NamedTuple):
    """A term's text, and its coefficient's bounds, equal ones for a value; or that it is ``times``
    the coefficient of the term ``of``."""

    term: str
    low: float = -np.inf
    high: float = np.inf
    times: float = 1.0
    of: str | None = None

    @property
    def says(self) -> bool:
        """Return whether anything is told."""
        return (self.low, self.high, self.of) != (-np.inf, np.inf, None)


def told_of(text: str) -> Told:
    """Read "low <= term <= high", "term = value", "term = 2*other", or a term alone.

    Raises InputError for other text.
    """
    parts = re.split(r"(<=|>=|=)", text)
    if len(parts) == 1:
        return Told(text)
    words, signs = [part.strip() for part in parts[::2]], parts[1::2]
    numbers = [_number(word) for word in words]
    if len(words) == 3 and signs == ["<=", "<="] and None not in (numbers[0], numbers[2]):
        low, high, term = numbers[0], numbers[2], words[1]
    elif len(words) == 2 and numbers[0] is not None and numbers[1] is None:
        return told_of(f"{words[1]} {_TURNED[signs[0]]} {words[0]}")
    elif len(words) == 2 and signs == ["="] and numbers[1] is None:
        number, times, rest = words[1].partition("*")
        factor = _number(number.strip()) if times and not rest.startswith("*") else None
        whole = factor is None
        return Told(words[0], times=1.0 if whole else factor, of=words[1] if whole else rest)
    elif len(words) == 2 and numbers[0] is None and numbers[1] is not None:
        term, value = words[0], numbers[1]
        low = -np.inf if signs == ["<="] else value
        high = np.inf if signs == [">="] else value
    else:
        low = high = None
    if low is None or high is None or not low <= high or np.isnan(low + high):
        raise InputError(f"terms: expected low <= term <= high, or term = value, got '{text}'")
    return Told(term, low, high)


def untold(terms: Iterable[Any]) -> tuple[Any, ...]:
    """The terms, text or functions, without what is told of their coefficients."""
    return tuple(told_of(term).term if isinstance(term, str) else term for term in terms)


def anything_told(terms: Iterable[Any]) -> bool:
    """Return whether of one of these terms, text or functions, a coefficient is told."""
    return any(told_of(term).says for term in terms if isinstance(term, str))


def _number(word: str) -> float | None:
    try:
        return float(word)
    except ValueError:
        return None


@dataclasses.dataclass(frozen=True, eq=False)
class Constrained(AroundAnother):
    """Family whose params x (m,) make the coefficients ``fixed`` (N,) + ``basis`` (N, m) x of
    another one. free: (m,) places of the terms whose coefficients are x. For fits, in NumPy."""

    family: Terms
    fixed: np.ndarray
    basis: np.ndarray
    free: tuple[int, ...]

    @classmethod
    def of(cls, family: Terms, told: Sequence[Told]) -> Constrained:
        """Bind the coefficients of the terms of these names. Bounds bind none.

        Raises InputError for a term that the family has not, for a multiple of one that is a
        multiple itself, and where no coefficient is free.
        """
        names = list(family.term_names)
        values = {one.term: one.low for one in told if one.of is None and one.low == one.high}
        ties = {one.term: one for one in told if one.of is not None}
        for one in told:
            if any(name not in names for name in (one.term, one.of or one.term)) or one.of in ties:
                raise InputError(
                    f"terms: expected a given term that the others do not contain, and no multiple "
                    f"itself, got {one.of or one.term} in what is told of {one.term}"
                )
        free = tuple(j for j, n in enumerate(names) if n not in values and n not in ties)
        if not free:
            raise InputError("terms: expected a coefficient that is free, got all of them by value")
        fixed, basis = np.zeros(len(names)), np.eye(len(names))[:, free]
        for name, value in values.items():
            fixed[names.index(name)] = value
        for name, one in ties.items():
            j, source = names.index(name), names.index(str(one.of))
            fixed[j], basis[j] = one.times * fixed[source], one.times * basis[source]
        return cls(family, fixed, basis, free)

    def held(self, values: dict[int, float]) -> Constrained:
        """Fix the params at these places, multiples of them too."""
        left = [j for j in range(len(self.free)) if j not in values]
        fixed = self.fixed + self.basis[:, list(values)] @ np.array(list(values.values()))
        return Constrained(
            self.family, fixed, self.basis[:, left], tuple(self.free[j] for j in left)
        )

    @property
    def num_parameters(self) -> int:
        return len(self.free)

    @property
    def term_names(self) -> tuple[str, ...]:
        """Names of the terms whose coefficients are free."""
        return tuple(self.family.term_names[j] for j in self.free)

    def coefficients(self, params: np.ndarray) -> np.ndarray:
        """Coefficients (N,) of all terms."""
        return self.fixed + self.basis @ params

    def params_of(self, held: Constrained, params: np.ndarray) -> np.ndarray:
        """The params (m,) whose coefficients are those of this family ``held``."""
        return held.coefficients(params)[list(self.free)]

    def take(self, rows: Sequence[int]) -> Constrained:
        """Make the family without the other free terms and their multiples."""
        basis = self.basis[:, list(rows)]
        kept = np.flatnonzero(basis.any(axis=1) | (self.fixed != 0)).tolist()
        free = tuple(kept.index(self.free[j]) for j in rows)
        return Constrained(self.family.take(kept), self.fixed[kept], basis[kept], free)

    def inside(self, params, args):
        """All coefficients, and the same args."""
        return self.coefficients(params), args

    def term_gradients(self, w, args=None):
        """∂/∂x of the gradient (..., 2d, m)."""
        return self.family.term_gradients(w, args) @ self.basis
