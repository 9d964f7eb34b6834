"""Values and derivatives of expressions, by truncated Taylor arithmetic.

The same lines compute in NumPy and are traced by JAX.
"""

import dataclasses
import math
import operator
from collections.abc import Sequence
from functools import cache, reduce
from typing import Any

from gfnn_jax.arrays import as_row, namespace
from gfnn_jax.families.expressions import Expression, coordinate, parameter, whole_multiples
from gfnn_jax.families.functions import CHEBYSHEV, CIRCULAR, DERIVATIVES


@dataclasses.dataclass(frozen=True)
class Jet:
    """Value, slopes {i: ∂/∂z_i} and curvatures {(i, j): ∂²/∂z_i∂z_j}, i ≤ j, of an expression.

    Slopes and curvatures that are identically zero are left out. Each entry is an array of the
    lanes' shape, or a number.
    """

    value: Any
    slope: dict[int, Any]
    curvature: dict[tuple[int, int], Any]


def jets(trees: Sequence[Expression], w, order: int, args=None) -> list[Jet]:
    """Evaluate expressions at states w (..., 2d), with derivatives in w up to ``order`` (0, 1, 2).

    args: the parameters' values (k,) or, for lanes of w, (..., k).
    """
    known: dict[Any, Any] = {}
    if args is not None:
        for i in range(args.shape[-1]):
            known[parameter(i)] = Jet(as_row(args[..., i], w[..., 0]), {}, {})
    return [_jet(tree, w, order, known) for tree in trees]


def _jet(tree: Expression, w, order: int, known) -> Jet:
    if tree not in known:
        known[tree] = _jet_of(tree, w, order, known)
    return known[tree]


def _jet_of(tree: Expression, w, order, known) -> Jet:
    xp = namespace(w)
    operation, operands = tree.operation, tree.operands
    if operation == "number":
        return Jet(operands[0], {}, {})
    if operation == "coordinate":
        return Jet(w[..., operands[0]], {operands[0]: 1.0} if order else {}, {})
    if operation == "parameter":
        raise ValueError("the terms depend on parameters: expected their values (args), got none")
    first = _jet(operands[0], w, order, known)
    if CHEBYSHEV.fullmatch(operation):
        return _chebyshev(first, operands[0], int(operation[1:]), order, known)
    if operation == "power":
        return _composed(first, order, *_power_derivatives(xp, first.value, operands[1], order))
    if operation in CIRCULAR:
        cos, sin = _circle(*_multiple(operands[0]), w, order, known)
        y, slope = (sin, cos) if operation == "sin" else (cos, -sin)
        return _composed(first, order, y, slope, -y if order > 1 else 0.0)
    if operation in DERIVATIVES:
        f, df, ddf = DERIVATIVES[operation]
        v = first.value if not isinstance(first.value, float) else xp.asarray(first.value)
        y = f(xp, v)
        return _composed(
            first, order, y, df(xp, v, y) if order else 0.0, ddf(xp, v, y) if order > 1 else 0.0
        )
    second = _jet(operands[1], w, order, known)
    if operation == "+":
        return Jet(
            first.value + second.value,
            _added(first.slope, second.slope),
            _added(first.curvature, second.curvature),
        )
    if operation == "/":
        inverse = 1.0 / second.value
        slope = -inverse * inverse if order else 0.0
        curvature = -2 * slope * inverse if order > 1 else 0.0
        second = _composed(second, order, inverse, slope, curvature)
    return _multiplied(first, second, order)


def _chebyshev(x: Jet, part: Expression, n: int, order: int, known) -> Jet:
    """Jet of T_n(x), x the jet of an expression, by T_n = 2x T_n−1 − T_n−2."""
    if n < 2:
        return x if n else Jet(1.0, {}, {})
    if ("T", part, n) not in known:
        last, before = (_chebyshev(x, part, k, order, known) for k in (n - 1, n - 2))
        twice = _multiplied(Jet(2.0, {}, {}), _multiplied(x, last, order), order)
        less = _multiplied(Jet(-1.0, {}, {}), before, order)
        known["T", part, n] = Jet(
            twice.value + less.value,
            _added(twice.slope, less.slope),
            _added(twice.curvature, less.curvature),
        )
    return known["T", part, n]


def _circle(part: Expression, n: int, w, order: int, known):
    """Compute cos and sin of n times an expression, from products of those of smaller multiples."""
    if (part, n) not in known:
        if n > 1:
            c, s = _circle(part, n // 2, w, order, known)
            d, t = _circle(part, n - n // 2, w, order, known)
            known[part, n] = c * d - s * t, s * d + c * t
        else:
            xp, v = namespace(w), _jet(part, w, order, known).value
            v = xp.asarray(v) if isinstance(v, float) else v
            known[part, n] = xp.cos(v), xp.sin(v)
    return known[part, n]


@cache
def _multiple(tree: Expression) -> tuple[Expression, int]:
    """Factor a sum of whole multiples of coordinates: (part, n) with tree = n · part.

    n is their greatest common divisor. Any other tree gives (tree, 1).
    """
    found = whole_multiples(tree)
    if found is None or found[1] or (n := math.gcd(*found[0].values())) < 2:
        return tree, 1
    parts = [coordinate(i) * (m // n) for i, m in sorted(found[0].items())]
    return reduce(operator.add, parts), n


def _power_derivatives(xp, v, exponent: float, order: int):
    whole = exponent == int(exponent) and abs(exponent) <= 32

    def raised(k: float):
        return _whole_power(v, int(k)) if whole else v**k

    if whole and exponent == 2:
        return v * v, 2 * v, 2.0
    return (
        raised(exponent),
        exponent * raised(exponent - 1) if order else 0.0,
        exponent * (exponent - 1) * raised(exponent - 2) if order > 1 else 0.0,
    )


def _whole_power(v, k: int):
    if k < 0:
        return 1.0 / _whole_power(v, -k)
    if k == 0:
        return 1.0
    half = _whole_power(v, k // 2)
    square = half * half
    return square * v if k % 2 else square


def _added(a: dict, b: dict) -> dict:
    return {k: a[k] + b[k] if k in a and k in b else a.get(k, b.get(k)) for k in {**a, **b}}


def _composed(inner: Jet, order, value, slope, curvature) -> Jet:
    """Jet of f(inner), from the value, slope and curvature of f there."""
    slopes = {i: slope * s for i, s in inner.slope.items()} if order else {}
    if order < 2:
        return Jet(value, slopes, {})
    bent = {k: slope * c for k, c in inner.curvature.items()}
    outer = {
        (i, j): curvature * a * b
        for i, a in inner.slope.items()
        for j, b in inner.slope.items()
        if i <= j
    }
    return Jet(value, slopes, _added(bent, outer))


def _multiplied(a: Jet, b: Jet, order) -> Jet:
    def scaled(entries, factor):
        return {k: factor * v for k, v in entries.items()}

    slopes = _added(scaled(a.slope, b.value), scaled(b.slope, a.value)) if order else {}
    if order < 2:
        return Jet(a.value * b.value, slopes, {})
    mixed: dict = {}
    for i, left in a.slope.items():
        for j, right in b.slope.items():
            entry = {(min(i, j), max(i, j)): (2.0 if i == j else 1.0) * left * right}
            mixed = _added(mixed, entry)
    curvature = _added(scaled(a.curvature, b.value), scaled(b.curvature, a.value))
    return Jet(a.value * b.value, slopes, _added(curvature, mixed))
