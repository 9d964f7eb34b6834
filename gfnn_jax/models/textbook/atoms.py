"""Arguments and atoms of laws.

Arguments are the scalars of a state that its roles and geometry suggest: each coordinate; sines and
cosines of angles and of their differences; differences of positions; distances from the origin, or
from another centre, of momenta, of a degree of freedom in its plane (q, p), between vortices,
between bodies; q·p and q × p. Atoms are products of shapes of arguments. Nothing is parsed until a
law is found: the gradients of thousands of atoms at a few hundred states are a few products of
arrays.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Sequence
from itertools import combinations, count, islice
from typing import NamedTuple

import numpy as np

from gfnn_jax.families.expressions import coordinate_names
from gfnn_jax.models.textbook.shapes import Kind, complexity, kinds_for, number, text_of, values


class Argument(NamedTuple):
    """text: as formulas write it. value (N,), gradient (N, 2d) at the states. square: of a
    distance, the text of its square. index: of the coordinate that it is, -1 of another. circular:
    whether it is the sine or cosine of an angle. axes: of a distance from the origin that may be
    one from another centre, the positions."""

    text: str
    value: np.ndarray
    gradient: np.ndarray
    square: str = ""
    index: int = -1
    circular: bool = False
    axes: tuple[Argument, ...] = ()

    @property
    def kinds(self) -> list[Kind]:
        """The shapes that have values at all states."""
        return kinds_for(self.value, distance=bool(self.square), circular=self.circular)

    @property
    def entering(self) -> set[int]:
        """The coordinates that the argument depends on."""
        return set(np.flatnonzero(np.any(self.gradient != 0, axis=0)).tolist())

    def around(self, centre: tuple[complex, ...]) -> Argument:
        """The distance from this centre, which may be complex."""
        return _distance([_less(x, c) for x, c in zip(self.axes, centre, strict=True)])


def arguments_of(
    z: np.ndarray, angles: tuple[int, ...] = (), cyclic: tuple[int, ...] = ()
) -> list[Argument]:
    """The arguments at states z (N, 2d): the coordinates first. angles, cyclic: indices of z."""
    width = z.shape[1]
    dim, unit, names = width // 2, np.eye(width), coordinate_names(width // 2)

    def linear(text: str, row: np.ndarray, index: int = -1) -> Argument:
        return Argument(text, z @ row, np.broadcast_to(row, z.shape), index=index)

    def at(i: int) -> Argument:
        return linear(names[i], unit[i], i)

    def apart(i: int, j: int) -> Argument:
        return linear(f"{names[i]} - {names[j]}", unit[i] - unit[j])

    turning = [i for i in angles if i < dim and i not in cyclic]
    plain = [i for i in range(width) if i not in angles and i not in cyclic]
    positions = [i for i in plain if i < dim]
    pairs = list(combinations(positions, 2))
    found = [at(i) for i in plain]
    for x in [*map(at, turning), *(apart(i, j) for i, j in combinations(turning, 2))]:
        sine, cosine = np.sin(x.value), np.cos(x.value)
        found.append(Argument(f"cos({x.text})", cosine, -sine[:, None] * x.gradient, circular=True))
        found.append(Argument(f"sin({x.text})", sine, cosine[:, None] * x.gradient, circular=True))
    found += [apart(i, j) for i, j in pairs]
    found += [_distance([at(i), at(i + dim)]) for i in positions]
    found += [_distance([apart(i, j), apart(i + dim, j + dim)]) for i, j in pairs]
    if len(positions) == dim and dim in (2, 3):
        axes = tuple(map(at, positions))
        found.append(_distance(list(axes))._replace(axes=axes))
        found.append(_distance([at(i + dim) for i in positions]))
        found.append(_along([(at(i), at(i + dim)) for i in positions]))
    if dim == 3:
        found += [_distance([at(i), at(j)]) for i, j in pairs]
    for axes in (2, 3):  # bodies in the plane or in space
        if dim > axes and dim % axes == 0 and len(positions) == dim:
            found += [
                _distance([apart(axes * a + k, axes * b + k) for k in range(axes)])
                for a, b in combinations(range(dim // axes), 2)
            ]
    if len(positions) == dim == 2:
        found.append(_turning(at(0), at(1), at(2), at(3)))
    return found


def _distance(parts: list[Argument]) -> Argument:
    """√(Σ x²)."""
    root = np.sqrt(np.sum([x.value**2 for x in parts], axis=0))
    gradient = np.sum([x.value[:, None] * x.gradient for x in parts], axis=0) / root[:, None]
    square = " + ".join(f"({x.text})**2" if " " in x.text else f"{x.text}**2" for x in parts)
    return Argument(f"sqrt({square})", root, gradient, square=square)


def _less(x: Argument, c: complex) -> Argument:
    """x − c."""
    if c == 0:
        return x
    shift = float(np.real(c))
    text = f"{x.text} {'-' if shift > 0 else '+'} {number(abs(shift))}"
    return Argument(text, x.value - c, x.gradient)


def _along(parts: list[tuple[Argument, Argument]]) -> Argument:
    """q·p."""
    value = np.sum([q.value * p.value for q, p in parts], axis=0)
    gradient = np.sum([_of_product(q, p) for q, p in parts], axis=0)
    return Argument(" + ".join(f"{q.text}*{p.text}" for q, p in parts), value, gradient)


def _turning(q1: Argument, q2: Argument, p1: Argument, p2: Argument) -> Argument:
    """q × p in the plane."""
    value = q1.value * p2.value - q2.value * p1.value
    return Argument("q1*p2 - q2*p1", value, _of_product(q1, p2) - _of_product(q2, p1))


def _of_product(x: Argument, y: Argument) -> np.ndarray:
    return x.value[:, None] * y.gradient + y.value[:, None] * x.gradient


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


def powers_of(atom: Atom, coordinates: int) -> tuple[int, ...] | None:
    """The exponents of an atom that is a product of the first so many arguments; None of
    another."""
    row = [0] * coordinates
    for factor in atom:
        name, n = factor.kind
        if factor.place >= coordinates or name != "power" or n < 0 or n % 1:
            return None
        row[factor.place] += int(n)
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
