"""Terms of a law that a user gives: text in the names of positions and velocities.

    omega1**2;  omega1*omega2*cos(theta1 - theta2);  V: cos(theta1);  V: 1/sqrt(x**2 + y**2);
    v1*x2;  R: omega1**2;  R: abs(omega2)

A term is one of L unless V: (potential) or R: (friction) stands before it. A sum gives each of its
terms, so that the formula of a fit can be given again; factors before terms say nothing, because
the fit finds them. A coefficient may be told:

    omega**2*x = 0.3;  0 <= cos(theta1);  -5 <= V: x**2 <= 0;  cos(theta2) = 2*cos(theta1)

is a value, a bound, two bounds, and a multiple of another coefficient. What is no power of a
position and no first cosine or sine of whole multiples is the term's shape, one formula of the
positions and, in V, of the inputs: the current of a magnet, V: i**2/(0.01 + y), or a support that
moves, V: (y - s)**2.
"""

from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np

from gfnn_jax.errors import InputError
from gfnn_jax.families.expressions import (
    Expression,
    depends_on,
    factors_of,
    has_parameters,
    product_of,
    summands,
    to_text,
    whole_multiples,
)
from gfnn_jax.families.friction import (
    DRY,
    ISOTROPIC,
    LINEAR,
    LOADED,
    ONE_SIDED,
    PLACED,
    POWER,
    QUADRATIC,
    STRIBECK,
)
from gfnn_jax.families.lagrangian import INPUTS, MAX_POWER, coordinates_in
from gfnn_jax.families.told import told_of
from gfnn_jax.models.lagrangians.structure import SINE, Loss, Row, with_powers


class Told(NamedTuple):
    """A coefficient of L that is told: between two bounds, equal ones for a value; or so many times
    that of another term."""

    row: Row
    low: float
    high: float
    of: Row | None = None


class Given(NamedTuple):
    """Terms of L, the first with v₁², and of R, None where none was given; what is told of the
    coefficients."""

    terms: tuple[Row, ...]
    friction: tuple[Loss, ...] | None
    told: tuple[Told, ...] = ()


def given_terms(
    texts: Sequence[Any],
    positions: Sequence[str],
    speeds: Sequence[str],
    parameters: Sequence[str] = (),
    inputs: Sequence[str] = (),
) -> Given:
    """The terms that these texts name. ``parameters`` are those in which the systems of the
    runs differ.

    Without a kinetic term each coordinate has its ½v². Raises InputError, a line with the text, for
    what is no term of such a law.
    """
    reader = _Reader(tuple(positions), tuple(speeds), tuple(parameters), tuple(inputs))
    rows: list[Row] = []
    losses: list[Loss] = []
    told: list[Told] = []
    kinds = set()
    for text in texts:
        if not isinstance(text, str):
            raise InputError("expected terms of a recording's law as text, got a function")
        text, low, high, times, tied = one = told_of(text)
        kind, colon, rest = text.partition(":")
        kind = kind.strip().upper() if colon else "L"
        if kind not in ("L", "V", "R"):
            raise InputError(f"terms: expected L:, V: or R: before a term, got '{text}'")
        kinds.add(kind)
        parts = reader.summands(rest if colon else text)
        if one.says:
            if kind == "R" or len(parts) != 1:
                raise InputError(
                    f"terms: expected one term of L or V whose coefficient is told, got '{text}'; "
                    "coefficients of friction are 0 or above, and fitted"
                )
            row, sign = reader.row(parts[0][1], parts[0][0]), -1.0 if kind == "V" else 1.0
            if tied is None:
                ends = sorted((sign * low, sign * high))
                told.append(Told(row, ends[0], ends[1]))
            else:
                of = reader.summands(tied)
                if len(of) != 1:
                    raise InputError(f"terms: expected a multiple of one term, got '{tied}'")
                told.append(Told(row, times, times, reader.row(of[0][1], of[0][0])))
        for shown, tree in parts:
            if kind == "R":
                losses.append(reader.loss(tree, shown))
            else:
                row = reader.row(tree, shown)
                if kind == "V" and any(row[0]):
                    raise InputError(f"terms: '{shown}' has a velocity, and is no term of V")
                rows.append(row)
    dim = len(positions)
    if not any(sum(row[0]) == 2 for row in rows):
        none = (0,) * dim
        own = [tuple(2 * int(i == k) for i in range(dim)) for k in range(dim)]
        rows = [(speeds_of, none, none, 0.0) for speeds_of in own] + rows
    first = next((row for row in rows if row[0][0] == 2), None)
    if first is None:
        raise InputError(f"terms: add a kinetic one, {speeds[0]}**2, which sets the scale of L")
    ordered = dict.fromkeys([first, *rows])
    moving = tuple(row for row in ordered if any(row[0]) or any(coordinates_in(row)))
    tied = [one.row for one in told if one.of is not None]
    for one in told:
        if one.of is not None and (one.of not in moving or one.of in tied):
            raise InputError(
                "terms: a coefficient can be a multiple of that of another given term, which is no "
                "multiple itself"
            )
    return Given(moving, tuple(dict.fromkeys(losses)) if "R" in kinds else None, tuple(told))


class _Reader(NamedTuple):
    """Reads terms in these names, which are the coordinates of trees in this order."""

    positions: tuple[str, ...]
    speeds: tuple[str, ...]
    parameters: tuple[str, ...]
    inputs: tuple[str, ...]

    def summands(self, text: str) -> list[tuple[str, Expression]]:
        """The terms of a sum, with their texts."""
        return summands(text, (*self.positions, *self.speeds, *self.parameters), self.inputs)

    def apart(self, tree: Expression) -> tuple[dict[Expression, float], tuple[int, ...]]:
        """The factors of a product that are no parameters, and the powers of these."""
        powers, others, first = [0] * len(self.parameters), {}, 2 * len(self.positions)
        for base, exponent in factors_of(tree).items():
            if _index(base) >= first and exponent.is_integer():
                powers[_index(base) - first] = int(exponent)
            else:
                others[base] = exponent
        return others, tuple(powers)

    def row(self, tree: Expression, text: str) -> Row:
        """(k, n, m, φ), with the shape and the powers of parameters where it has such."""
        d, wave, shape = len(self.positions), None, {}
        k, n = [0] * d, [0] * d
        factors, of_system = self.apart(tree)
        for base, exponent in factors.items():
            i, power = _index(base), int(exponent) if exponent.is_integer() else -1
            if i >= d and power > 0:
                k[i - d] += power
            elif 0 <= i < d and 0 <= power <= MAX_POWER:
                n[i] += power
            elif power == 1 and wave is None and (found := self.wave(base)) is not None:
                wave = found
            elif all(i < d for i in depends_on(base)):
                shape[base] = exponent
            else:
                raise self.refused(text)
        if sum(k) > 2 or (any(k) and any(map(has_parameters, shape))):
            raise self.refused(text)
        row = (tuple(k), tuple(n), *(wave or ((0,) * d, 0.0)))
        shown = to_text(product_of(shape), d, INPUTS)
        return with_powers((*row, shown) if shape else row, of_system)

    def wave(self, tree: Expression) -> tuple[tuple[int, ...], float] | None:
        """(m, φ) of the cosine or the sine of whole multiples of positions; None of another
        tree."""
        found = whole_multiples(tree.operands[0]) if tree.operation in ("cos", "sin") else None
        if found is None or max(found[0], default=0) >= len(self.positions):
            return None
        m = tuple(found[0].get(i, 0) for i in range(len(self.positions)))
        return (m, found[1] + (SINE if tree.operation == "sin" else 0.0)) if any(m) else None

    def loss(self, tree: Expression, text: str) -> Loss:
        """(c, kind, ε) of a friction, with its powers of parameters."""
        factors, of_system = self.apart(tree)
        loads = [base for base, exponent in factors.items() if exponent == 1 and _of_input(base)]
        if len(factors) == 2 and len(loads) == 1:
            del factors[loads[0]]
            direction, kind, width = self.loss(product_of(factors), text)
            if kind != DRY:
                raise self.refused(text)
            (which,) = loads[0].operands[0].operands
            return with_powers((direction, LOADED + which, width), of_system)
        if len(factors) == 2 and {*factors.values()} == {2}:
            return with_powers(self.by_place(factors, text), of_system)
        if len(factors) != 1:
            raise self.refused(text)
        ((inside, exponent),) = factors.items()
        kind, width, d = LINEAR, 0.0, len(self.positions)
        squares, half = (inside, 2) if inside.operation != "sqrt" else (inside.operands[0], 1)
        plane = _squared(squares)
        if len(plane) > 1 and min(plane) >= d and half * exponent >= 2:
            direction = tuple(int(d + i in plane) for i in range(d))
            return with_powers((direction, ISOTROPIC, half * exponent - 1), of_system)
        if exponent == 1 and (fading := _fading(inside)) is not None:
            inside, width = fading
            kind = STRIBECK
        elif inside.operation == "abs" and exponent >= 1:
            inside, kind = inside.operands[0], _OF_POWER.get(exponent, POWER)
            width = exponent - 1 if kind == POWER else 0.0
        elif exponent == 2 and (side := _side(inside)) is not None:
            inside, kind = side, ONE_SIDED
        elif exponent == 4:
            kind, width = POWER, exponent - 1
        elif inside.operation == "sqrt" and exponent == 1:
            inside, width = self.smoothed(inside.operands[0], text)
            kind = DRY
        elif exponent != 2:
            raise self.refused(text)
        found = whole_multiples(inside)
        if found is None or found[1] or not found[0] or not all(d <= i < 2 * d for i in found[0]):
            raise self.refused(text)
        direction = tuple(found[0].get(d + i, 0) for i in range(d))
        return with_powers((direction, kind, width), of_system)

    def by_place(self, squares: Iterable[Expression], text: str) -> Loss:
        """(c, kind, C) of (c·q − C)² (c·v)², by c·q − C and c·v."""
        d, found, constants = len(self.positions), {}, {}
        for multiples, constant in filter(None, map(whole_multiples, squares)):
            for k in (0, d):
                if multiples and {*multiples} <= {*range(k, k + d)}:
                    found[k] = tuple(multiples.get(k + i, 0) for i in range(d))
                    constants[k] = constant
        either = [found.get(d), tuple(-k for k in found.get(d, ()))]
        if found.get(0) not in either or constants[d]:
            raise self.refused(text)
        return found[0], PLACED, -constants[0]

    def smoothed(self, tree: Expression, text: str) -> tuple[Expression, float]:
        """(v, ε) of v² + ε²."""
        if tree.operation == "+" and (tree.operands[1].value or 0.0) > 0:
            squared, size = tree.operands[0], tree.operands[1].value
            if squared.operation == "power" and squared.operands[1] == 2:
                return squared.operands[0], float(np.sqrt(size))
        raise self.refused(text)

    def refused(self, text: str) -> InputError:
        of = f", times whole powers of {', '.join(self.parameters)}" if self.parameters else ""
        return InputError(
            f"terms: '{text}' is no term of a law. A term of L or V is a formula of "
            f"{', '.join((*self.positions, *self.inputs))}, in L without inputs times up to two of "
            f"{', '.join(self.speeds)}; one of R is v**2, abs(v)**a, abs(v), "
            f"(abs(v) + v)**2, exp(-abs(v)/0.1) beside abs(v), abs(u)*abs(v) of an input u, "
            f"(q - 0.1)**2*v**2, or sqrt(v**2 + w**2)**a, a >= 2{of}"
        )


_OF_POWER: dict[float, int] = {1: DRY, 2: LINEAR, 3: QUADRATIC}  # of |v| to this power in R


def _squared(tree: Expression) -> set[int]:
    """The coordinates of which a tree is the sum of squares; none of another tree."""
    if tree.operation == "+":
        parts = [_squared(part) for part in tree.operands]
        return set.union(*parts) if all(parts) and not set.intersection(*parts) else set()
    square = tree.operation == "power" and tree.operands[1] == 2
    return {_index(tree.operands[0])} - {-1} if square else set()


def _side(tree: Expression) -> Expression | None:
    """v of |v| + v; None of another tree."""
    if tree.operation != "+":
        return None
    parts = [part for part in tree.operands if part.operation != "abs"]
    sizes = [part.operands[0] for part in tree.operands if part.operation == "abs"]
    alike = len(parts) == len(sizes) == 1 and sizes[0] in (parts[0], -parts[0])
    return parts[0] if alike else None


def _fading(tree: Expression) -> tuple[Expression, float] | None:
    """(v, w) of e^(−|v|/w), or of |v| + w e^(−|v|/w); None of another tree."""
    for part in tree.operands if tree.operation == "+" else (tree,):
        one = part.operands[-1] if part.operation == "*" else part
        rate = one.operands[0] if one.operation == "exp" else one
        if rate.operation == "*" and rate.operands[-1].operation == "abs":
            size = rate.operands[0].value
            if size is not None and size < 0:
                return rate.operands[-1].operands[0], float(f"{-1 / size:.6g}")
    return None


def _of_input(tree: Expression) -> bool:
    """Return whether a tree is the size of an input."""
    return tree.operation == "abs" and tree.operands[0].operation == "parameter"


def _index(tree: Expression) -> int:
    """The index of a coordinate; −1 of another tree."""
    return tree.operands[0] if tree.operation == "coordinate" else -1
