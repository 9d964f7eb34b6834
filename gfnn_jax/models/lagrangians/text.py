"""A law as text: its terms by the names of columns, for people, parsers, sympy and LaTeX."""

from __future__ import annotations

import itertools
import re
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from gfnn_jax.data.recording import Recording, parameters_of
from gfnn_jax.data.roles import is_wave, symbols
from gfnn_jax.exports.symbolic import Formula
from gfnn_jax.families.friction import Friction
from gfnn_jax.families.lagrangian import INPUTS, Powers, Terms
from gfnn_jax.families.text import Term, power
from gfnn_jax.models.lagrangians.structure import powers_of


class Names(NamedTuple):
    """Symbols of coordinates, of their speeds, of parameters and of inputs, as formulas write
    them."""

    coordinates: tuple[str, ...]
    speeds: tuple[str, ...]
    parameters: tuple[str, ...] = ()
    inputs: tuple[str, ...] = INPUTS

    @classmethod
    def of(cls, recording: Recording) -> Names:
        """Make those of a recording; a wave that nobody recorded stands as it is."""
        speeds = speed_names(recording.coordinates, recording.velocities)
        of_systems = parameters_of(recording)
        return cls(recording.coordinates, speeds, of_systems, recording.inputs).symbols

    @property
    def symbols(self) -> Names:
        """Names that can stand in a formula: Cart_A_dot of Cart A_dot."""
        shown = iter(symbols(itertools.chain(*self)))
        named = Names(*(tuple(itertools.islice(shown, len(names))) for names in self))
        pushes = zip(self.inputs, named.inputs, strict=True)
        return named._replace(inputs=tuple(n if is_wave(n) else s for n, s in pushes))


def terms_of(terms: Terms, coefficients: np.ndarray, std: np.ndarray, names: Names) -> Formula:
    """Terms of Σ θ_j ℓ_j."""
    texts = terms.texts(names.coordinates, names.speeds, names.inputs)
    listed = zip(texts, coefficients, std, strict=True)
    return Formula(tuple(Term(text, float(c), float(s)) for text, c, s in listed))


def friction_of(friction: Friction, losses: np.ndarray, std: np.ndarray, names: Names) -> Formula:
    """Terms of Rayleigh's R."""
    listed = zip(
        friction.texts(names.speeds, names.inputs, names.coordinates), losses, std, strict=True
    )
    return Formula(tuple(Term(text, float(ρ * r), float(s * abs(r))) for (text, r), ρ, s in listed))


def of_systems(found: Formula, powers: Powers, parameters: Sequence[str]) -> Formula:
    """The expression with each term multiplied by its powers (m, k) of the parameters: cos(q)/l."""
    return Formula(
        tuple(
            term._replace(term=_with_powers(term.term, row, parameters))
            for term, row in zip(found.terms, powers, strict=True)
        )
    )


def _with_powers(term: str, powers: Sequence[int], parameters: Sequence[str]) -> str:
    for name, n in zip(parameters, powers, strict=True):
        if n:
            term = ("" if term == "1" and n > 0 else f"{term}{'*' if n > 0 else '/'}") + power(
                name, abs(n)
            )
    return term


def word_of(key: tuple[Any, ...], names: Names) -> str:
    """A coefficient of a structure, by its term."""
    kind, *rest = key
    one, none, dim = np.ones(1), np.zeros(1), len(names.coordinates)
    if kind in ("term", "loss"):
        found = (
            terms_of(Terms.of(rest, dim), one, none, names)
            if kind == "term"
            else friction_of(Friction.of(rest, dim), one, none, names)
        )
        powers = (powers_of(rest[0], len(names.parameters)),)
        (term,) = of_systems(found, powers, names.parameters).terms
        return term.term if kind == "term" else f"R: {term.term}"
    return f"{'gain' if kind == 'gain' else 'zero'} of {names.coordinates[rest[0]]}"


def speed_names(positions: Sequence[str], velocities: Sequence[str]) -> tuple[str, ...]:
    """Names of the velocities: of their columns, or omega1 of theta1 and v1 of x1; q_dot of q, and
    of all where one is named otherwise."""
    if len(velocities) == len(positions):
        return tuple(velocities)
    found = [re.fullmatch(r"(theta|x)(\w*)", name) for name in positions]
    named = [{"theta": "omega", "x": "v"}[one[1]] + one[2] for one in found if one]
    if len(named) < len(positions) or set(named) & set(positions):
        return tuple(f"{name}_dot" for name in positions)
    return tuple(named)
