"""Predictor: an explicit polynomial model of a chart's unknowns, at which the solve starts.

The model is fitted to pairs, where the unknowns are explicit: the pairs that S is fitted to, or
states and their images by the map itself, to which it can be closer where S is coarse. It need not
be symplectic, because the solve corrects it. A guess as close as the root of roundoff leaves a
single Newton update. Next to a fold of S the guess decides which branch is found, that of the data.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import scipy.linalg

from gfnn_jax.arrays import matmul, namespace, pytree
from gfnn_jax.families.inputs import Inputs, box_inputs
from gfnn_jax.families.products import Basis, Products, basis_of
from gfnn_jax.generating.charts import AnyChart
from gfnn_jax.phase_space import sizes

# A guess this close, in units of the data's spread, is the root of roundoff: one update is left.
CLOSE = 5e-8


class Options:
    """Options of predictors (benchmarks/speed.py)."""

    # That update leaves the square of the guess's error, the same at every step: below the floor,
    # but more than the roundoff of a million steps. Guesses closer than this leave less
    # (Hénon–Heiles, S of degree 8: the energy error grows with the 0.55th power of the steps
    # instead of the 0.86th).
    steady: float = 1e-8
    # The model extends a little outside the box, as rollouts of states at its edge do, but not to
    # where T_n of its own degree is larger than 250.
    reach: float = 1.2
    largest: float = 250.0
    most_degree: int = 20
    most_terms: int = 250
    rows: int = 4_000
    # relative to a column's size: data on a surface leave some products undetermined
    ridge: float = 1e-13


@pytree()
class PolynomialModel:
    """Polynomials of the state for the unknowns minus the chart's own first guess.

    family: the products and their box. Far outside, the model is evaluated at the nearest point of
    a slightly larger box, so that it stays as small as near the data. matrices: (k, m, n) the
    coefficients of the k unknowns, the constant included.
    """

    family: Products
    matrices: Any

    @property
    def basis(self) -> Basis:
        return _basis(self.family)

    @property
    def operations(self) -> int:
        """Floating-point operations of an evaluation."""
        basis, count = self.basis, len(self.matrices)
        (m, i), (n, j) = (h.indices.shape for h in basis.halves)
        row, column = basis.corner
        tables = m * (i - 1) + n * max(j - 1, 0) + 4 * self.family.degree * (i + j)
        return 2 * count * (row * n + (m - row) * column + m) + tables

    def __call__(self, z, args=None):
        """Evaluate the difference (..., k) at the states z (..., 2d), NumPy or JAX."""
        xp, x = namespace(z), self.family.inputs(z, args)
        bound = xp.broadcast_to(xp.asarray(self.reach, dtype=x.dtype), x.shape)
        return self.of_variables(xp.clip(x, -bound, bound))

    @property
    def reach(self) -> np.ndarray:
        """Largest magnitude of each variable at which the polynomials are evaluated."""
        reach = min(Options.reach, math.cosh(math.acosh(Options.largest) / self.family.degree))
        return np.where(self.family.inputs.is_angle, np.inf, reach)

    def of_variables(self, x):
        """Evaluate the difference (..., k) at the family's variables x (..., n), within reach."""
        (u,), (v,) = self.basis.tables(x, 0)
        row, column = self.basis.corner
        low = self._product(self.matrices[:, :row], u[..., :row], v)
        return low + self._product(self.matrices[:, row:, :column], u[..., row:], v[..., :column])

    @staticmethod
    def _product(matrices, u, v):
        """Compute Σ C_ab u_a v_b for each matrix (k, m, n), by one product with all of them."""
        count, m, n = matrices.shape
        by_row = matmul(v, matrices.reshape(count * m, n).T).reshape(*u.shape[:-1], count, m)
        return namespace(u).sum(by_row * u[..., None, :], axis=-1)


@pytree()
class Predictor:
    """First guesses for the solves of a map (forward) and of its inverse (backward)."""

    forward: PolynomialModel
    backward: PolynomialModel

    def reverse(self) -> Predictor:
        """Make the predictor of the inverse map."""
        return Predictor(self.backward, self.forward)


class Fitted(NamedTuple):
    """Predictor with its RMS error in the worse direction, in units of the data's spread."""

    predictor: Predictor
    error: float


def fit_predictors(
    chart: AnyChart,
    y0,
    y1,
    dt: Any,
    inputs_of: Callable[..., Inputs] = box_inputs,
    args=None,
) -> list[Fitted]:
    """Fit predictors of a chart's map and of its inverse, by rising degree.

    y0, y1: (N, 2d) states and images, NumPy, angles lifted. dt: a number, or one per pair (N,), of
    either sign, on which the models then depend beside the state, or args (N, k). inputs_of: makes
    the variables of states, as ``box_inputs``. The degree rises until the model is close enough or
    no longer improves, because of noise or of the number of pairs.
    """
    rows = np.linspace(0, len(y0) - 1, min(Options.rows, len(y0))).astype(int)
    y0, y1, args = y0[rows], y1[rows], None if args is None else args[rows]
    args, back = (dt[rows, None], -dt[rows, None]) if np.ndim(dt) else (args, args)

    def fitted(chart: AnyChart, given, other, args) -> list[tuple[PolynomialModel, float]]:
        free = chart.free(given.shape[1] // 2)
        unknown = chart.evaluation_point(given, other)[:, free]
        known = chart.first_guess(given)[:, free]
        inputs = inputs_of(given, args=args)
        return _by_degree(inputs, inputs(given, args), unknown - known, sizes(unknown))

    forward, backward = fitted(chart, y0, y1, args), fitted(chart.reverse(dt)[0], y1, y0, back)
    # The direction that is close first waits for the other.
    rising = range(max(len(forward), len(backward)))
    sides = ([side[min(i, len(side) - 1)] for i in rising] for side in (forward, backward))
    return [
        Fitted(Predictor(one, other), max(error, its_error))
        for (one, error), (other, its_error) in zip(*sides, strict=True)
    ]


def affordable(fitted: list[Fitted], family) -> Fitted:
    """Choose the closest predictor that costs at most half as much as the family's own gradient.

    Where no such predictor leaves a single update, one that does may cost as much as the updates
    that it saves: two or three evaluations with a Hessian, whose operations take about twice as
    long as those of a polynomial model.
    """
    gradient, with_hessian = family.operations
    cheap = [f for f in fitted if f.predictor.forward.operations <= 0.5 * gradient] or fitted[:1]
    close = [
        f for f in fitted if f.error <= CLOSE and f.predictor.forward.operations <= 5 * with_hessian
    ]
    return close[-1] if close and cheap[-1].error > CLOSE else cheap[-1]


def _basis(family: Products) -> Basis:
    """Basis of a model: unlike S it also has products of args alone."""
    return basis_of(family.inputs.is_angle, family.degree, None)


def _by_degree(inputs: Inputs, x, target, unit) -> list[tuple[PolynomialModel, float]]:
    """Fit the target (N, k) at the variables x (N, ...) by least squares, by rising degree.

    One factorisation serves all degrees. Returns the models with their held-out errors.
    """
    held = np.arange(len(x)) % 5 == 0
    most = min(Options.most_terms, len(x) // 3)
    top = 1
    while top < Options.most_degree and Products(inputs, top + 1).num_parameters <= most:
        top += 1
    largest = _basis(Products(inputs, top))
    design = _design(largest, x)
    width = design.shape[1]
    ridge = Options.ridge * np.linalg.norm(design[~held], axis=0)
    ridge = np.where(ridge > 0, ridge, 1.0)  # a product that vanishes on all states gets 0
    rows = np.vstack([design[~held], np.diag(ridge)])
    q, r = np.linalg.qr(rows)
    along = q.T @ np.vstack([target[~held], np.zeros((width, target.shape[1]))])
    found, closest = [], np.inf
    for degree in range(1, top + 1):
        m = 1 + int(np.sum(largest.term_orders <= degree))
        solution = scipy.linalg.solve_triangular(r[:m, :m], along[:m], check_finite=False)
        error = np.sqrt(np.mean((design[held, :m] @ solution - target[held]) ** 2 / unit**2))
        if found and not error < 0.5 * closest:
            if degree > found[-1][0].family.degree + 1:
                break
            continue  # an odd map gains nothing by an even degree
        closest = error
        family = Products(inputs, degree)
        matrices = _basis(family).placed(solution[1:].T)
        matrices[:, 0, 0] = solution[0]
        found.append((PolynomialModel(family, matrices), float(error)))
        if error < Options.steady:
            break
    return found


def _design(basis, x) -> np.ndarray:
    """Evaluate the constant and the products at x (N, k): (N, 1 + terms)."""
    (u,), (v,) = basis.tables(x, 0)
    row, column = basis.terms.T
    return np.concatenate([np.ones((len(x), 1)), u[:, row] * v[:, column]], axis=1)
