"""Polynomials of many terms in C, by Horner's scheme: alone, and several side by side."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import cache
from itertools import product
from typing import Any

import numpy as np

from gfnn_jax.exports.symbols import Tape, table
from gfnn_jax.generating.predictor import PolynomialModel
from gfnn_jax.maps.domain import Domain


def christoffel(domain: Domain, y: np.ndarray) -> Any:
    """Christoffel function of a domain at y (2d,): a polynomial of degree 4 in the scaled
    coordinates, of fewer terms than the squares that it is the sum of.

    Its factor has a condition of at most 1e3: the sum's rounding is below 1e-9 of its limit.
    """
    x = [(y[i] - c) / s for i, c, s in zip(domain.keep, domain.centre, domain.scale, strict=True)]
    unit = np.eye(len(x), dtype=int)
    i, j = np.triu_indices(len(x))
    powers = np.concatenate([0 * unit[:1], unit, unit[i] + unit[j]])  # as `maps.domain` has them
    squared = domain.factor.T @ domain.factor
    terms: dict[tuple[int, ...], float] = {}
    for a, b in product(range(len(powers)), repeat=2):
        power = tuple((powers[a] + powers[b]).tolist())
        terms[power] = terms.get(power, 0.0) + float(squared[a, b])
    return horner(terms, x)


def horner(terms: Mapping[tuple[int, ...], float], x: Sequence[Any]) -> Any:
    """Polynomial Σ c Π x_i^n_i, of terms n -> c, by Horner's scheme in each variable in turn."""
    if not x:
        return sum(terms.values())
    of_power: list[dict] = [{} for _ in range(1 + max(n[0] for n in terms))]
    for n, c in terms.items():
        of_power[n[0]][n[1:]] = c
    total: Any = 0.0
    for inner in reversed(of_power):
        total = total * x[0] + (horner(inner, x[1:]) if inner else 0.0)
    return total


def variables(model: PolynomialModel, x: Sequence[Any]) -> list[Any]:
    """Variables of a model's polynomials at its family's own x, symbols: within its reach, cosine
    and sine of an angle."""
    found = []
    for value, reach, angle in zip(x, model.reach, model.family.inputs.is_angle, strict=True):
        found += [value.cos(), value.sin()] if angle else [value.clipped(-reach, reach)]
    return found


def side_by_side(name: str, model: PolynomialModel) -> str:
    """Write ``NAME(x, y)``, which adds the polynomials of a model at its `variables` x to y.

    All are computed by the same lines, whose lanes a compiler puts into vectors. Powers in place of
    Chebyshev's polynomials cost digits, of degree 20 half of them: a guess has some to spare.
    """
    terms = in_powers(model)
    count, many, width = len(model.matrices), len(terms), len(next(iter(terms)))
    tape = Tape()
    x = tape.inputs("x", width)[0].tolist()
    c = tape.inputs("c", 1 + count * (many - 1))[0, ::count]
    lane = tape.lines({"const double more": horner(dict(zip(terms, c, strict=True)), x)})
    lines = "\n".join(f"        {line}" for line in lane)
    return f"""\
static void {name}(const double *restrict x, double *restrict y)
{{
    static const double coefficients[{count * many}] = {table(np.array(list(terms.values())))};
    for (int k = 0; k < {count}; k++) {{
        const double *c = coefficients + k;
{lines}
        y[k] += more;
    }}
}}
"""


def in_powers(model: PolynomialModel) -> dict[tuple[int, ...], np.ndarray]:
    """Terms n -> coefficients (k,) of Π x_i^n_i, of the k polynomials of a model."""
    halves, degree = model.basis.halves, model.family.degree
    indices = [half.indices.tolist() for half in halves]
    angles = [angle for half in halves for angle in half.is_angle]
    found: dict[tuple[int, ...], np.ndarray] = {}
    used = np.argwhere(np.any(model.matrices != 0, axis=0)).tolist()
    for a, b in used:
        functions = [*indices[0][a], *indices[1][b]]
        each = [_powers(k, degree, angle) for k, angle in zip(functions, angles, strict=True)]
        for factors in product(*each):
            n = tuple(power for powers, _ in factors for power in powers)
            value = model.matrices[:, a, b] * math.prod(c for _, c in factors)
            found[n] = found.get(n, 0.0) + value
    return found


@cache
def _powers(k: int, degree: int, angle: bool) -> list[tuple[tuple[int, ...], float]]:
    """Terms (powers, coefficient) of the k-th function of one variable in `families.products`."""
    if k <= degree:  # T_k of x, or of the cosine
        last = (0,) if angle else ()
        coefficients = np.polynomial.chebyshev.cheb2poly(np.eye(degree + 1)[k])
        return [((n, *last), float(c)) for n, c in enumerate(coefficients) if c]
    # sin jx = sin x T_j'(cos x) / j
    j = k - degree
    slope = np.polynomial.polynomial.polyder(np.polynomial.chebyshev.cheb2poly(np.eye(j + 1)[j]))
    return [((n, 1), float(c) / j) for n, c in enumerate(slope) if c]
