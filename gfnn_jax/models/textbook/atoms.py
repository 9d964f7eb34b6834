"""Atoms of a law: products of shapes of arguments; and the dictionary of those that are tried.

Nothing is parsed until a law is found: the gradients of thousands of atoms at a few hundred states
are a few products of arrays.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from itertools import combinations_with_replacement
from typing import NamedTuple

import numpy as np

from gfnn_jax.families.terms import exponents
from gfnn_jax.models.textbook.arguments import Argument
from gfnn_jax.models.textbook.shapes import (
    Kind,
    complexity,
    constants_for,
    has_constant,
    kinds_for,
    text_of,
    values,
)

_STEP = 1e-30  # of a complex step
_COARSE = 3  # of the constants tried of one factor, those of a product
_SMALL = 4  # coordinates 2d; beyond them products have no constants: they are too many
_INDEPENDENT = 1e-6  # of a column's length, that the base does not span
_MOST_MONOMIALS = 500  # of the dictionary


@dataclasses.dataclass(frozen=True)
class Factor:
    """The shape of the argument at this place of a list, and its constant."""

    place: int
    kind: Kind
    theta: float | None = None


Atom = tuple[Factor, ...]
Average = Callable[[np.ndarray], np.ndarray]  # rows (…, R, 2d) of gradients (…, N, 2d)


def gradient_of(atom: Atom, arguments: Sequence[Argument], along: int | None = None) -> np.ndarray:
    """∇ (N, 2d) of the atom; with ``along`` its derivative in the constant of that factor."""
    parts = []
    for k, factor in enumerate(atom):
        theta = factor.theta
        if k == along:
            assert theta is not None
            theta = theta + 1j * _STEP
        argument = arguments[factor.place]
        parts.append((argument.gradient, *values(factor.kind, argument.value, theta)))
    total = np.zeros(1)
    for k, (gradient, _, slope) in enumerate(parts):
        for j, (_, value, _) in enumerate(parts):
            slope = slope * value if j != k else slope
        total = total + slope[:, None] * gradient
    return total if along is None else np.imag(total) / _STEP


def atom_text(atom: Atom, arguments: Sequence[Argument]) -> str:
    """The atom as code writes it."""
    over, under = [], []
    for factor in atom:
        argument = arguments[factor.place]
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


def weight_of(atoms: Sequence[Atom]) -> float:
    """Amount that there is to say of atoms."""
    return sum(complexity(factor.kind) for atom in atoms for factor in atom)


class Dictionary(NamedTuple):
    """Atoms and their gradients, weighted by coordinate, without what a base spans of them, as
    columns of unit length (rows, atoms)."""

    atoms: list[Atom]
    columns: np.ndarray


class _Singles(NamedTuple):
    """The atoms of one argument: their factors, f and f' (atoms, N)."""

    factors: list[Factor]
    value: np.ndarray
    slope: np.ndarray


def dictionary_of(
    arguments: Sequence[Argument], weight: np.ndarray, base: np.ndarray, *, degree: int,
    products: bool, average: Average = np.asarray,
) -> Dictionary:  # fmt: skip
    """The atoms that are tried. weight (2d,), or of each row: by which gradients are multiplied.
    base: orthonormal columns (rows, n), beside which atoms are looked for.

    Shapes of one argument, and products of coordinates from the third to this degree, without the
    coordinates and products of two, which are in every law. products: of a coordinate, a product
    of two or a sine or cosine with a shape of another argument too. average: makes the rows of
    gradients at the states.
    """
    atoms: list[Atom] = []
    gradients: list[np.ndarray] = []
    with np.errstate(all="ignore"):
        singles = [_singles(place, argument, 1) for place, argument in enumerate(arguments)]
        for argument, single in zip(arguments, singles, strict=True):
            atoms += [(factor,) for factor in single.factors]
            gradients.append(average(single.slope[:, :, None] * argument.gradient))
        mixed = _monomials(arguments, degree)
        atoms += mixed
        gradients += [average(gradient_of(atom, arguments))[None] for atom in mixed]
        if products:
            every = _COARSE if weight.shape[-1] <= _SMALL else None
            coarse = [_singles(p, argument, every) for p, argument in enumerate(arguments)]
            for multiplier in _multipliers(arguments):
                used = {index for f in multiplier for index in _entering(arguments[f.place])}
                value, gradient = (
                    _value_of(multiplier, arguments),
                    gradient_of(multiplier, arguments),
                )
                for argument, single in zip(arguments, coarse, strict=True):
                    if used == _entering(argument):
                        continue
                    atoms += [(*multiplier, factor) for factor in single.factors]
                    along = (single.slope * value)[:, :, None] * argument.gradient
                    gradients.append(average(along + single.value[:, :, None] * gradient))
        rows = (np.concatenate(gradients) * weight).reshape(len(atoms), -1)
        size = np.linalg.norm(rows, axis=1)
    kept = np.flatnonzero(np.isfinite(size) & (size > 0))
    columns = (rows[kept] / size[kept, None]).T
    for _ in range(2):  # the second time makes them orthogonal to roundoff
        columns = columns - base @ (base.T @ columns)
    size = np.linalg.norm(columns, axis=0)
    told = np.flatnonzero(size > _INDEPENDENT)
    return Dictionary([atoms[kept[i]] for i in told], columns[:, told] / size[told])


def blocks_of(arguments: Sequence[Argument], degree: int) -> list[tuple[Atom, ...]]:
    """Atoms that laws have together: the first inverse powers of an argument, all products of
    coordinates up to a degree."""
    found: list[tuple[Atom, ...]] = []
    for place, argument in enumerate(arguments):
        kinds = kinds_for(
            argument.value, distance=bool(argument.square), circular=argument.circular
        )
        for last in (2, 3, 4):
            if ("power", -float(last)) in kinds and not argument.circular:
                powers = range(1, last + 1)
                found.append(tuple((Factor(place, ("power", -float(n))),) for n in powers))
    for highest in range(3, degree + 1):
        block = tuple(_monomials(arguments, highest, alone=True))
        if block and len(block) <= _MOST_MONOMIALS:
            found.append(block)
    return found


def _singles(place: int, argument: Argument, every: int | None) -> _Singles:
    """Shapes of the argument, with every so manieth of the constants that are tried; None: those
    without constants."""
    x, factors, f, slopes = argument.value, [], [], []
    kinds = kinds_for(x, distance=bool(argument.square), circular=argument.circular)
    for kind in kinds:
        if argument.index >= 0 and kind in (("power", 1.0), ("power", 2.0)):
            continue  # these are in every law
        if every is None and has_constant(kind):
            continue
        thetas = constants_for(kind, x)[::every].tolist() if has_constant(kind) else [None]
        for theta in thetas:
            value, slope = values(kind, x, theta)
            factors.append(Factor(place, kind, theta))
            f.append(value)
            slopes.append(slope)
    return _Singles(factors, np.array(f), np.array(slopes))


def _monomials(arguments: Sequence[Argument], degree: int, *, alone: bool = False) -> list[Atom]:
    """Products of coordinates of degree 3 to this one. alone: powers of one coordinate too."""
    plain = [place for place, argument in enumerate(arguments) if argument.index >= 0]
    return [
        tuple(Factor(plain[k], ("power", float(n))) for k, n in enumerate(row) if n)
        for row in exponents(len(plain), degree)
        if sum(row) > 2 and (alone or sum(n > 0 for n in row) > 1)
    ]


def _multipliers(arguments: Sequence[Argument]) -> list[Atom]:
    """Coordinates, products of two of them, sines and cosines: what shapes are multiplied by."""
    plain = [place for place, argument in enumerate(arguments) if argument.index >= 0]
    found: list[Atom] = [(Factor(place, ("power", 1.0)),) for place in plain]
    for i, j in combinations_with_replacement(plain, 2):
        if i == j:
            found.append((Factor(i, ("power", 2.0)),))
        else:
            found.append((Factor(i, ("power", 1.0)), Factor(j, ("power", 1.0))))
    circular = [place for place, argument in enumerate(arguments) if argument.circular]
    return [*found, *((Factor(place, ("power", 1.0)),) for place in circular)]


def _value_of(atom: Atom, arguments: Sequence[Argument]) -> np.ndarray:
    found = np.ones(len(arguments[0].value))
    for factor in atom:
        found = found * values(factor.kind, arguments[factor.place].value, factor.theta)[0]
    return found


def _entering(argument: Argument) -> set[int]:
    """The coordinates that the argument depends on."""
    return set(np.flatnonzero(np.any(argument.gradient != 0, axis=0)).tolist())
