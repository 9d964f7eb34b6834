"""The dictionary of the atoms that are tried, and the states at which they are looked at."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from itertools import chain, combinations, combinations_with_replacement, permutations, product
from typing import Any, NamedTuple

import numpy as np

from gfnn_jax.families.terms import Terms, exponents, given_terms, joined, polynomial_terms
from gfnn_jax.fitting.significance import beside, null_terms
from gfnn_jax.models.textbook.atoms import (
    Argument,
    Atom,
    Factor,
    arguments_of,
    atom_text,
    gradient_of,
    powers_of,
    value_of,
)
from gfnn_jax.models.textbook.shapes import COSH, TURNING, Kind, constants_for, has_constant, values


class Options:
    """Tuned on the laws of benchmarks/textbook.py.

    degrees: of products of coordinates, by degrees of freedom from 1; 3 beyond. coarse: of the
    constants tried of one factor every so manieth, in products; beyond 2d = ``small`` coordinates
    products have no constants: they are too many. independent: of a column's length, that the base
    does not span. most_monomials: of a block. centres: tried along each axis, of the plane and of
    space; wider: times the box of the positions, where these are; central: shapes of the distance
    from one.
    """

    degrees: tuple[int, ...] = (6, 4, 4)
    coarse: int = 3
    small: int = 4
    independent: float = 1e-6
    most_monomials: int = 500
    centres: tuple[tuple[int, int], ...] = ((2, 15), (3, 9))
    wider: float = 1.2
    central: tuple[Kind, ...] = (
        *(("power", -1.0), ("power", -2.0), ("power", -3.0)),
        *(("power", 1.0), ("log", 0.0)),
    )


_Group = Iterator[tuple[list[Atom], np.ndarray]]  # atoms, gradients (atoms, N, 2d)


class Dictionary(NamedTuple):
    """Atoms and their gradients, weighted by coordinate, without what a base spans of them, as
    columns of unit length (rows, atoms)."""

    atoms: list[Atom]
    columns: np.ndarray


class Setting:
    """The states at which laws are looked at, and the rows that gradients of H make there.

    states: (N, 2d). angles, cyclic: indices of z. average: makes the rows (…, R, 2d) of gradients
    (…, N, 2d) at the states, where they are not these themselves. forces: makes a family of H one
    with forces, linear in their coefficients. arguments: at the states. null:
    the coordinates and products of two that the states do not tell from those before. base: the
    others, as atoms, which are in every law; spanned: (rows, n) orthonormal columns of them.
    weight: (2d,), or of each row, by which gradients are multiplied.
    """

    def __init__(
        self,
        states: np.ndarray,
        weight: np.ndarray,
        angles: Sequence[int] = (),
        cyclic: Sequence[int] = (),
        average: Callable[[np.ndarray], np.ndarray] = np.asarray,
        forces: Callable[[Terms], Any] = lambda h: h,
    ):
        self.states, self.angles, self.cyclic = states, tuple(angles), tuple(cyclic)
        self.average, self.forces, self.dim = average, forces, states.shape[1] // 2
        self.arguments = arguments_of(states, self.angles, self.cyclic)
        every = polynomial_terms(self.dim, 2, cyclic=(*angles, *cyclic))
        kept, null = null_terms(every, states)
        self.null = tuple(every.term_names[j] for j in null)
        self.base = tuple(self.product(every.powers[j]) for j in kept)
        self.weigh(weight)

    def weigh(self, weight: np.ndarray) -> None:
        """Take these weights."""
        self.weight = weight
        self.spanned = orthonormal(self.columns(self.law(())))

    @property
    def degree(self) -> int:
        """The highest degree of products of coordinates."""
        degrees = Options.degrees
        return degrees[self.dim - 1] if self.dim <= len(degrees) else 3

    def flat(self, gradient: np.ndarray) -> np.ndarray:
        """(rows,) of a gradient (N, 2d) at the states."""
        return (self.average(gradient) * self.weight).ravel()

    def columns(self, family) -> np.ndarray:
        """(rows, terms): the weighted gradients of a family's terms."""
        gradients = np.moveaxis(family.term_gradients(self.states), -1, 0)
        return (self.average(gradients) * self.weight).reshape(family.num_parameters, -1).T

    def ordered(self, atoms: Sequence[Atom]) -> tuple[Atom, ...]:
        """The base and these atoms, each once: products of coordinates, then the others."""
        every = {atom: self.powers(atom) for atom in (*self.base, *atoms)}
        products = {row: atom for atom, row in every.items() if row is not None}
        return (*products.values(), *(atom for atom, row in every.items() if row is None))

    def terms(self, atoms: Iterable[Atom]) -> Terms:
        """The terms of atoms in their order. Raises InputError for a constant that has run away."""
        rows = [(atom, self.powers(atom)) for atom in atoms]
        names = tuple(self.arguments[k].text for k in self._coordinates)
        found = Terms(self.dim, names, tuple(row for _, row in rows if row is not None))
        texts = [atom_text(atom, self.arguments) for atom, row in rows if row is None]
        return joined(found, given_terms(self.dim, texts)) if texts else found

    def law(self, atoms: Sequence[Atom]) -> Any:
        """Terms of the base and these atoms, and the forces. Raises InputError for a constant that
        has run away."""
        return self.forces(self.terms(self.ordered(atoms)))

    def dictionary(
        self,
        *,
        products: bool = False,
        centres: bool = False,
    ) -> Dictionary:
        """The atoms that are tried: shapes of one argument, and products of coordinates from the
        third degree on; the base is in every law.

        products: of a coordinate, a product of two or a sine or cosine with a shape of another
        argument too. centres: shapes of distances from centres beside the origin too.
        """
        atoms: list[Atom] = []
        gradients: list[np.ndarray] = []
        with np.errstate(all="ignore"):
            groups = [self._of_one(), self._of_coordinates()]
            groups += [self._of_products()] if products else []
            groups += [self._of_centres()] if centres else []
            for own, gradient in chain(*groups):
                atoms += own
                gradients.append(self.average(gradient))
            rows = (np.concatenate(gradients) * self.weight).reshape(len(atoms), -1)
            size = np.linalg.norm(rows, axis=1)
        kept = np.flatnonzero(np.isfinite(size) & (size > 0))
        columns = beside(self.spanned, (rows[kept] / size[kept, None]).T)
        size = np.linalg.norm(columns, axis=0)
        independent = np.flatnonzero(size > Options.independent)
        atoms = [atoms[kept[i]] for i in independent]
        return Dictionary(atoms, columns[:, independent] / size[independent])

    def blocks(self) -> list[tuple[Atom, ...]]:
        """Atoms that laws have together: the first inverse powers of an argument, exponentials of
        either sign, all products of coordinates up to a degree."""
        found: list[tuple[Atom, ...]] = []
        for place, argument in enumerate(self.arguments):
            kinds = [] if argument.circular else argument.kinds
            for last in (2, 3, 4):
                if ("power", -float(last)) in kinds:
                    powers = range(1, last + 1)
                    found.append(tuple((Factor(place, ("power", -float(n))),) for n in powers))
            if not argument.circular and not argument.square:
                # Not among the functions of one argument: beside exponentials a greedy search that
                # takes it early finds fewer laws.
                for theta in constants_for(COSH, argument.value):
                    found.append(((Factor(place, COSH, float(theta)),),))
        for highest in range(3, self.degree + 1):
            block = tuple(self._monomials(highest, alone=True))
            if block and len(block) <= Options.most_monomials:
                found.append(block)
        return found

    def turning(self) -> list[tuple[Atom, ...]]:
        """Cosines of the positions that may be angles: of each, and of all."""
        each = [
            (Factor(place, TURNING),)
            for place, x in enumerate(self.arguments)
            if 0 <= x.index < self.dim
        ]
        return [*((atom,) for atom in each), *([tuple(each)] if len(each) > 1 else [])]

    def tops(self) -> list[tuple[Atom, ...]]:
        """The three atoms that (p_i − p_j cos q)²/sin² q has beside p_j²: of a body that turns
        about several axes, in Euler angles. None of them explains much without the others."""
        places = dict(enumerate(self.arguments))
        momenta = [place for place, argument in places.items() if argument.index >= self.dim]
        circular = [place for place, argument in places.items() if argument.circular]
        found = []
        for above, under in permutations(circular, 2):
            one_angle = places[above].entering == places[under].entering
            if not one_angle or ("power", -2.0) not in places[under].kinds:
                continue
            pole = Factor(under, ("power", -2.0))
            for i, j in combinations(momenta, 2):
                squares = ((Factor(k, ("power", 2.0)), pole) for k in (i, j))
                both = (Factor(place, ("power", 1.0)) for place in (i, j, above))
                found.append((*squares, (*both, pole)))
        return found

    def curved(self) -> list[tuple[Atom, ...]]:
        """p_r²/r and 1/r², which motion around a heavy body has beside other functions of r, and
        with them 1/(r + θ), that of its horizon: none explains much without the others."""
        found = []
        for place, argument in enumerate(self.arguments):
            if argument.circular or ("power", -2.0) not in argument.kinds:
                continue
            for k, other in enumerate(self.arguments):
                if argument.index >= 0 and other.index == argument.index + self.dim:
                    square, pole = Factor(k, ("power", 2.0)), Factor(place, ("power", -1.0))
                    both: list[Atom] = [(square, pole), (Factor(place, ("power", -2.0)),)]
                    horizon: Kind = ("pole", 0.0)
                    radii = constants_for(horizon, argument.value)[:: Options.coarse].tolist()
                    found.append(tuple(both))
                    found += [(*both, (Factor(place, horizon, theta),)) for theta in radii]
        return found

    def _of_one(self) -> _Group:
        """Shapes of one argument."""
        for place, argument in enumerate(self.arguments):
            factors, _, slopes = singles(place, argument, 1)
            yield [(factor,) for factor in factors], slopes[:, :, None] * argument.gradient

    def _of_coordinates(self) -> _Group:
        """Products of coordinates."""
        for atom in self._monomials(self.degree):
            yield [atom], gradient_of(atom, self.arguments)[None]

    def _of_products(self) -> _Group:
        """Products with a shape of something else."""
        every = Options.coarse if 2 * self.dim <= Options.small else None
        coarse = [singles(place, x, every) for place, x in enumerate(self.arguments)]
        entering = [x.entering for x in self.arguments]
        for multiplier in self._multipliers():
            used = {i for f in multiplier for i in entering[f.place]}
            value = value_of(multiplier, self.arguments)
            gradient = gradient_of(multiplier, self.arguments)
            for argument, own, single in zip(self.arguments, entering, coarse, strict=True):
                if used == own:
                    continue
                factors, f, slopes = single
                along = (slopes * value)[:, :, None] * argument.gradient
                atoms: list[Atom] = [(*multiplier, factor) for factor in factors]
                yield atoms, along + f[:, :, None] * gradient

    def _of_centres(self) -> _Group:
        """Shapes of distances from the points of a grid, along the positions' range and somewhat
        beyond."""

        def grid(x: np.ndarray, points: int) -> list[float]:
            middle, half = 0.5 * (x.min() + x.max()), 0.5 * Options.wider * np.ptp(x)
            return np.linspace(middle - half, middle + half, points).tolist()

        for place, argument in enumerate(self.arguments):
            if not argument.axes:
                continue
            points = dict(Options.centres)[len(argument.axes)]
            for centre in product(*(grid(x.value, points) for x in argument.axes)):
                moved = argument.around(centre)
                slopes = np.array([values(kind, moved.value, None)[1] for kind in Options.central])
                atoms = [(Factor(place, kind, centre=centre),) for kind in Options.central]
                yield atoms, slopes[:, :, None] * moved.gradient

    @property
    def _coordinates(self) -> list[int]:
        """The places of the coordinates."""
        return [place for place, x in enumerate(self.arguments) if x.index >= 0]

    def _monomials(self, degree: int, *, alone: bool = False) -> list[Atom]:
        """Products of coordinates of degree 3 to this one. alone: powers of one coordinate too."""
        return [
            self.product(row)
            for row in exponents(len(self._coordinates), degree)
            if sum(row) > 2 and (alone or sum(n > 0 for n in row) > 1)
        ]

    def product(self, powers: Sequence[int]) -> Atom:
        """The product of these powers of the coordinates."""
        places = zip(self._coordinates, powers, strict=True)
        return tuple(Factor(place, ("power", float(n))) for place, n in places if n)

    def powers(self, atom: Atom) -> tuple[int, ...] | None:
        """The exponents of an atom that is a product of coordinates; None of another."""
        return powers_of(atom, len(self._coordinates))

    def _multipliers(self) -> list[Atom]:
        """Coordinates, products of two of them, sines and cosines: what shapes are multiplied
        by."""

        def one(place: int, n: float = 1.0) -> Factor:
            return Factor(place, ("power", n))

        plain = self._coordinates
        pairs = combinations_with_replacement(plain, 2)
        squares = ((one(i, 2.0),) if i == j else (one(i), one(j)) for i, j in pairs)
        circular = [place for place, x in enumerate(self.arguments) if x.circular]
        return [*((one(i),) for i in plain), *squares, *((one(i),) for i in circular)]


def singles(
    place: int, argument: Argument, every: int | None
) -> tuple[list[Factor], np.ndarray, np.ndarray]:
    """Factors of the shapes of the argument, with every so manieth of the constants that are tried,
    None: those without constants; and f and f' (shapes, N)."""
    x, factors, f, slopes = argument.value, [], [], []
    for kind in argument.kinds:
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
    return factors, np.array(f), np.array(slopes)


def orthonormal(columns: np.ndarray) -> np.ndarray:
    """A basis of what the columns span."""
    if not columns.shape[1]:
        return columns
    size = np.linalg.norm(columns, axis=0)
    u, s, _ = np.linalg.svd(columns / np.where(size > 0, size, 1.0), full_matrices=False)
    return u[:, s > 1e-12 * s[0]]
