"""Atoms of a law: products of shapes of arguments.

Nothing is parsed until a law is found: the gradients of thousands of atoms at a few hundred states
are a few products of arrays.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Sequence
from itertools import count, islice

import numpy as np

from gfnn_jax.models.textbook.arguments import Argument
from gfnn_jax.models.textbook.shapes import Kind, complexity, text_of, values


@dataclasses.dataclass(frozen=True)
class Factor:
    """The shape of the argument at this place of a list, its constant θ, and the centre from which
    the argument is a distance, where that is not the origin."""

    place: int
    kind: Kind
    theta: float | None = None
    centre: tuple[float, ...] = ()

    @property
    def form(self) -> tuple[int, Kind, int]:
        """The factor without its constants."""
        return self.place, self.kind, len(self.centre)

    def argument(self, arguments: Sequence[Argument]) -> Argument:
        """The argument among these."""
        found = arguments[self.place]
        return found.around(self.centre) if self.centre else found


Atom = tuple[Factor, ...]


def constants_of(atom: Atom) -> list[float]:
    """The constants inside the atom: of each factor θ, then its centre."""
    return [c for f in atom for c in (*(() if f.theta is None else (f.theta,)), *f.centre)]


def with_constants(atom: Atom, constants: Iterable[float]) -> Atom:
    """The atom with these constants inside, in the order of ``constants_of``."""
    given = iter(constants)
    return tuple(
        dataclasses.replace(
            f,
            theta=None if f.theta is None else next(given),
            centre=tuple(islice(given, len(f.centre))),
        )
        for f in atom
    )


def gradient_of(atom: Atom, arguments: Sequence[Argument], along: int | None = None) -> np.ndarray:
    """∇ (N, 2d) of the atom; with ``along`` its derivative in that one of its constants."""
    parts, step_size = [], 1e-30  # of a complex step
    step = (1j * step_size if k == along else 0.0 for k in count())
    for factor in atom:
        theta = None if factor.theta is None else factor.theta + next(step)
        centre = tuple(c + next(step) for c in factor.centre)
        argument = arguments[factor.place]
        argument = argument.around(centre) if centre else argument
        parts.append((argument.gradient, *values(factor.kind, argument.value, theta)))
    total = np.zeros(1)
    for k, (gradient, _, slope) in enumerate(parts):
        for j, (_, value, _) in enumerate(parts):
            slope = slope * value if j != k else slope
        total = total + slope[:, None] * gradient
    return total if along is None else np.imag(total) / step_size


def atom_text(atom: Atom, arguments: Sequence[Argument]) -> str:
    """The atom as code writes it."""
    over, under = [], []
    for factor in atom:
        argument = factor.argument(arguments)
        text = text_of(factor.kind, argument.text, argument.square, factor.theta)
        (under if text.startswith("1/") else over).append(text.removeprefix("1/"))
    return "*".join(over or ["1"]) + "".join(f"/{text}" for text in under)


def powers_of(atom: Atom, arguments: Sequence[Argument], width: int) -> tuple[int, ...] | None:
    """The exponents (2d,) of an atom that is a product of coordinates; None of another."""
    row = [0] * width
    for factor in atom:
        index, (name, n) = arguments[factor.place].index, factor.kind
        if index < 0 or name != "power" or n < 0 or n % 1:
            return None
        row[index] += int(n)
    return tuple(row)


def complexity_of(atoms: Sequence[Atom]) -> float:
    """Complexity of atoms: of their shapes, and of centres that are not 0."""
    factors = [factor for atom in atoms for factor in atom]
    return sum(complexity(f.kind) + sum(c != 0 for c in f.centre) for f in factors)


def value_of(atom: Atom, arguments: Sequence[Argument]) -> np.ndarray:
    """The values (N,) of the atom."""
    found = np.ones(len(arguments[0].value))
    for factor in atom:
        argument = factor.argument(arguments)
        found = found * values(factor.kind, argument.value, factor.theta)[0]
    return found
