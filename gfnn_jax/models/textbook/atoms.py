"""Atoms of a law: products of shapes of arguments; and the dictionary of those that are tried.

Nothing is parsed until a law is found: the gradients of thousands of atoms at a few hundred states
are a few products of arrays.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable, Iterator, Sequence
from itertools import (
    chain,
    combinations,
    combinations_with_replacement,
    count,
    islice,
    permutations,
    product,
)
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
_CENTRES = {2: 15, 3: 9}  # tried along each axis, of the plane and of space
_WIDER = 1.2  # times the box of the positions: where centres are tried
_CENTRAL = (  # shapes of the distance from a centre
    ("power", -1.0),
    ("power", -2.0),
    ("power", -3.0),
    ("power", 1.0),
    ("log", 0.0),
)


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
Average = Callable[[np.ndarray], np.ndarray]  # rows (…, R, 2d) of gradients (…, N, 2d)


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
    parts, step = [], (1j * _STEP if k == along else 0.0 for k in count())
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
    return total if along is None else np.imag(total) / _STEP


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
    arguments: Sequence[Argument],
    weight: np.ndarray,
    base: np.ndarray,
    *,
    degree: int,
    products: bool = False,
    centres: bool = False,
    average: Average = np.asarray,
    allowed: Callable[[Atom], bool] | None = None,
) -> Dictionary:
    """The atoms that are tried. weight (2d,), or of each row: by which gradients are multiplied.
    base: orthonormal columns (rows, n), beside which atoms are looked for.

    Shapes of one argument, and products of coordinates from the third to this degree, without the
    coordinates and products of two, which are in every law. products: of a coordinate, a product
    of two or a sine or cosine with a shape of another argument too. centres: shapes of distances
    from centres beside the origin too. average: makes the rows of gradients at the states. allowed:
    says which atoms; None: all.
    """
    atoms: list[Atom] = []
    gradients: list[np.ndarray] = []
    with np.errstate(all="ignore"):
        groups = [_of_one(arguments), _of_coordinates(arguments, degree)]
        if products:
            groups.append(_of_products(arguments, _COARSE if weight.shape[-1] <= _SMALL else None))
        if centres:
            groups.append(_of_centres(arguments))
        for own, gradient in chain(*groups):
            if allowed is not None:
                chosen = [i for i, atom in enumerate(own) if allowed(atom)]
                own, gradient = [own[i] for i in chosen], gradient[chosen]
            atoms += own
            gradients.append(average(gradient))
        rows = (np.concatenate(gradients) * weight).reshape(len(atoms), -1)
        size = np.linalg.norm(rows, axis=1)
    kept = np.flatnonzero(np.isfinite(size) & (size > 0))
    columns = (rows[kept] / size[kept, None]).T
    for _ in range(2):  # the second time makes them orthogonal to roundoff
        columns = columns - base @ (base.T @ columns)
    size = np.linalg.norm(columns, axis=0)
    independent = np.flatnonzero(size > _INDEPENDENT)
    return Dictionary(
        [atoms[kept[i]] for i in independent], columns[:, independent] / size[independent]
    )


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


_Group = Iterator[tuple[list[Atom], np.ndarray]]  # atoms, gradients (atoms, N, 2d)


def tops_of(arguments: Sequence[Argument]) -> list[tuple[Atom, ...]]:
    """The three atoms that (p_i − p_j cos q)²/sin² q has beside p_j²: of a body that turns about
    several axes, in Euler angles. None of them explains much without the others."""
    dim = arguments[0].gradient.shape[1] // 2
    momenta = [place for place, argument in enumerate(arguments) if argument.index >= dim]
    circular = [place for place, argument in enumerate(arguments) if argument.circular]
    found = []
    for above, under in permutations(circular, 2):
        one_angle = _entering(arguments[above]) == _entering(arguments[under])
        kinds = kinds_for(arguments[under].value, circular=True)
        if not one_angle or ("power", -2.0) not in kinds:
            continue
        pole = Factor(under, ("power", -2.0))
        for i, j in combinations(momenta, 2):
            squares = ((Factor(k, ("power", 2.0)), pole) for k in (i, j))
            both = (Factor(place, ("power", 1.0)) for place in (i, j, above))
            found.append((*squares, (*both, pole)))
    return found


def _of_one(arguments: Sequence[Argument]) -> _Group:
    """Shapes of one argument."""
    for place, argument in enumerate(arguments):
        single = _singles(place, argument, 1)
        yield (
            [(factor,) for factor in single.factors],
            single.slope[:, :, None] * argument.gradient,
        )


def _of_coordinates(arguments: Sequence[Argument], degree: int) -> _Group:
    """Products of coordinates."""
    for atom in _monomials(arguments, degree):
        yield [atom], gradient_of(atom, arguments)[None]


def _of_products(arguments: Sequence[Argument], every: int | None) -> _Group:
    """Products with a shape of something else, of every so manieth of its constants."""
    coarse = [_singles(p, argument, every) for p, argument in enumerate(arguments)]
    for multiplier in _multipliers(arguments):
        used = {index for f in multiplier for index in _entering(arguments[f.place])}
        value, gradient = _value_of(multiplier, arguments), gradient_of(multiplier, arguments)
        for argument, single in zip(arguments, coarse, strict=True):
            if used == _entering(argument):
                continue
            along = (single.slope * value)[:, :, None] * argument.gradient
            yield (
                [(*multiplier, factor) for factor in single.factors],
                along + single.value[:, :, None] * gradient,
            )


def _of_centres(arguments: Sequence[Argument]) -> _Group:
    """Shapes of distances from the points of a grid."""
    for place, argument in enumerate(arguments):
        if not argument.axes:
            continue
        points = _CENTRES[len(argument.axes)]
        for centre in product(*(_grid(x.value, points) for x in argument.axes)):
            moved = argument.around(centre)
            slopes = np.array([values(kind, moved.value, None)[1] for kind in _CENTRAL])
            atoms = [(Factor(place, kind, centre=centre),) for kind in _CENTRAL]
            yield atoms, slopes[:, :, None] * moved.gradient


def _grid(x: np.ndarray, points: int) -> list[float]:
    """Points along the range of x and somewhat beyond."""
    middle, half = 0.5 * (x.min() + x.max()), 0.5 * _WIDER * np.ptp(x)
    return np.linspace(middle - half, middle + half, points).tolist()


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
        argument = factor.argument(arguments)
        found = found * values(factor.kind, argument.value, factor.theta)[0]
    return found


def _entering(argument: Argument) -> set[int]:
    """The coordinates that the argument depends on."""
    return set(np.flatnonzero(np.any(argument.gradient != 0, axis=0)).tolist())
