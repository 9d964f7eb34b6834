"""Pairs that lose area: Z = D_b ∘ Φ, the factor b found together with the S of Φ.

D_b: (q, p) -> (q, b p) multiplies the symplectic form by b, and Φ keeps it, so that the map's
Jacobians A obey AᵀJA = b J. For a given b the pairs (z, D_b⁻¹ Z) are those of a symplectic map, and
its S is linear in its coefficients; b is one more unknown of the same least-squares problem, solved
by Gauss–Newton. The drift c of an angle's momentum, which no periodic S has, is another.

Local Jacobians say where to begin. What decides is how much less S and b leave over together than
S alone: a constant determinant is not enough, which two oscillators of different friction have too.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
import scipy.linalg

from gfnn_jax.dataset.dataset import Dataset
from gfnn_jax.dataset.rows import rows_of
from gfnn_jax.diagnosis.charts import choose_charts
from gfnn_jax.errors import FitError
from gfnn_jax.families.expressions import coordinate_names
from gfnn_jax.families.inputs import box_inputs
from gfnn_jax.families.products import Products
from gfnn_jax.generating.charts import AnyChart
from gfnn_jax.maps.affine import Affine
from gfnn_jax.maps.damping import Damping
from gfnn_jax.phase_space import split, symplectic_form
from gfnn_jax.threads import one_thread

_CERTAIN = 5.0  # standard errors that make a factor other than 1 certain
_DEGREES = (2, 3, 4, 5, 6, 7, 8, 9, 10, 12, 14, 16, 20, 24, 28)  # of S, that are tried in turn
_ROWS_PER_TERM = 3
_MOST_OPERATIONS = 1e9  # rows × terms² of one solve: a quarter of a second on one core
_UPDATES = 10  # of Gauss–Newton, which converges in four or five
_CLOSE = 0.01  # standard errors: an update that is smaller is the last
_BETTER, _WORSE = 0.9, 2  # of the held-out rows' residual: degrees in a row that leave more end it
_GAIN = 0.5  # of the held-out residual: what another unknown must lower it to
_ROUNDOFF = 1e-15  # of the spread
_EXPLAINED = 0.3  # of the factors' variance, by one coordinate that is named


@dataclasses.dataclass(frozen=True)
class LearnedDamping:
    """The factor b of a step, (), or (d,) where degrees of freedom have their own, its standard
    error, and the drift c (d,) of the momenta, which is 0 but for those of angles."""

    factor: np.ndarray
    std: np.ndarray
    shift: np.ndarray

    @property
    def piece(self) -> Damping:
        return Damping(self.factor, self.shift)

    def undone(self, jacobians):
        """The Jacobians (n, 2d, 2d) of the map without D_b."""
        linear = Damping(self.factor, np.zeros_like(self.shift)).inverse()
        return np.swapaxes(linear.image(np.swapaxes(jacobians, 1, 2)), 1, 2)

    def __str__(self) -> str:
        """Line about what was learned."""
        told = [f"{b:.12g} ± {s:.1g}" for b, s in np.c_[self.factor.ravel(), self.std.ravel()]]
        if not self.factor.ndim:
            return f"every step multiplies areas by {told[0]}, the same everywhere"
        return (
            f"every step multiplies areas by {', '.join(told)}, each degree of freedom by its own: "
            "no multiple of the symplectic form is kept"
        )


def area_factors(jacobians, scale) -> np.ndarray:
    """(n,): the μ for which μ J is nearest to AᵀJA, of Jacobians A (n, 2d, 2d), in coordinates
    of unit size."""
    unit = symplectic_form(len(scale) // 2)
    inner = jacobians * scale[None, None, :] / scale[None, :, None]
    pulled = np.swapaxes(inner, 1, 2) @ unit @ inner
    return np.sum(pulled * unit, axis=(1, 2)) / np.sum(unit**2)


def learn_damping(
    data: Dataset, jacobians, error: float, chart: str, reversor
) -> LearnedDamping | None:
    """The D_b behind these pairs; None where areas are kept, or no D_b explains what is lost.

    data: without a base map. jacobians: (n, 2d, 2d) local ones, known to
    the error.
    """
    factors, dim = area_factors(jacobians, data.scale), data.dim
    b = float(np.median(factors))
    deviation = 1.5 * float(np.median(np.abs(factors - b))) / np.sqrt(len(factors))
    if not b > 0 or not abs(b - 1) > max(3 * error, _CERTAIN * deviation):
        return None
    start = LearnedDamping(np.asarray(b), np.asarray(np.inf), np.zeros(dim))
    undamped = data.without(None, start.piece)
    try:
        charts = choose_charts(chart, undamped, reversor, start.undone(jacobians))
    except FitError:  # no chart covers the rest
        return None
    problems = [_Problem(data, each, charts.half) for each in charts.charts]

    def best(spread: np.ndarray) -> tuple[_Fitted, _Problem]:
        found = [(problem.best(spread, np.full(len(spread), b)), problem) for problem in problems]
        return min(found, key=lambda each: each[0].held_out)

    found, problem = best(np.ones((1, dim)))
    if dim > 1:
        own, its = best(np.eye(dim))
        if own.held_out < _GAIN * found.held_out:
            found, problem = own, its
    certain = np.abs(found.factor - 1) > _CERTAIN * found.std
    if found.family is None or not certain.any():
        return None
    kept = problem.fitted(found.family, np.zeros((0, dim)), np.zeros(0))  # areas are
    if not found.held_out < _GAIN * kept.held_out:
        return None
    shape = (dim,) if len(found.factor) > 1 else ()
    return LearnedDamping(found.factor.reshape(shape), found.std.reshape(shape), found.shift)


def where_areas_differ(jacobians, centres, scale) -> str:
    """Along which coordinate the factor of areas differs, as a sentence; "" where along none.

    centres: (n, 2d), the states at which the Jacobians are.
    """
    factors = area_factors(jacobians, scale)
    explained, told = _EXPLAINED, ""
    for name, x in zip(coordinate_names(len(scale) // 2), np.asarray(centres).T, strict=True):
        fitted = np.polyval(np.polyfit(x - x.mean(), factors, 2), x - x.mean())
        share = 1 - np.var(factors - fitted) / np.var(factors)
        if share > explained:
            explained, ends = share, (np.argmin(fitted), np.argmax(fitted))
            low, high = (f"{fitted[i]:.3g} at {name} = {x[i]:.3g}" for i in ends)
            told = f" Areas change by a factor that differs over phase space, from {low} to {high}"
    return told


class _Fitted(NamedTuple):
    """b (k,) with its standard errors, c (d,), the RMS residual of held-out rows, and which S."""

    factor: np.ndarray
    std: np.ndarray
    shift: np.ndarray
    held_out: float
    family: Products | None = None


@dataclasses.dataclass(frozen=True)
class _Problem:
    """The pairs, chart and half base map of the symplectic part, and the rows that train and
    judge."""

    data: Dataset
    chart: AnyChart
    half: Affine | None

    def best(self, spread: np.ndarray, factor: np.ndarray) -> _Fitted:
        """Degree of S which leaves least of the held-out rows.

        spread: (k, d), which of the k factors multiplies each momentum; none: they are kept.
        factor: (k,), the first guess.
        """
        best, worse = _Fitted(factor, np.full(len(factor), np.inf), self._drift(0.0), np.inf), 0
        for family in self._families(spread, factor):
            with one_thread():
                found = self.fitted(family, spread, best.factor)
            worse = 0 if found.held_out < _BETTER * best.held_out else worse + 1
            best = found if worse == 0 else best
            if worse == _WORSE or best.held_out < _ROUNDOFF:
                break
        return best

    def _families(self, spread, factor) -> Iterator[Products]:
        """Families by rising degree, those that the training rows determine in reasonable time."""
        undamped = self._undamped(_momenta(spread, factor), self._drift(0.0))
        w = rows_of(undamped, self.chart, self.data.training)[0][0]
        inputs = box_inputs(w, angles=tuple(self._angles), cyclic=undamped.coordinates.cyclic)
        for degree in _DEGREES:
            family = Products(inputs, degree)
            terms = family.num_parameters
            if degree > _DEGREES[0] and (
                _ROWS_PER_TERM * terms > w.size or w.size * terms**2 > _MOST_OPERATIONS
            ):
                return
            yield family

    def fitted(self, family: Products, spread: np.ndarray, factor: np.ndarray) -> _Fitted:
        """b, c and S by Gauss–Newton, from this b and c = 0."""
        k, shift = len(factor), np.zeros(len(self._angles))
        for _ in range(_UPDATES):
            b, c = _momenta(spread, factor), self._drift(shift)
            undamped = self._undamped(b, c)
            terms, target = self._design(family, undamped, self.data.training)
            solved = _solved(terms, target)
            columns = self._columns(family, solved, undamped, spread, b, c)
            change, std = _last_unknowns(np.column_stack([terms, columns, target]), terms.shape[1])
            if not (np.abs(change) > _CLOSE * std).any():
                break
            factor, shift = factor + change[:k], shift + change[k:]
            if not (factor > 0).all():
                return _Fitted(factor, np.full(k, np.inf), c, np.inf)
        held, wanted = self._design(family, undamped, self.data.validation)
        rms = float(np.sqrt(np.mean((held @ solved - wanted) ** 2)))
        return _Fitted(factor, std[:k], c, rms, family)

    def _design(self, family: Products, undamped: Dataset, rows) -> tuple[np.ndarray, np.ndarray]:
        """The terms' gradients (n, m) and what they must add up to (n,), each row without unit."""
        (w, target), weight = rows_of(undamped, self.chart, rows)
        terms = family.term_gradients(w) * weight[:, None]
        return terms.reshape(-1, terms.shape[-1]), (target * weight).ravel()

    def _columns(self, family: Products, solved, undamped: Dataset, spread, b, c) -> np.ndarray:
        """(n, k + a): the derivatives of the residuals of ∇S in b and c, which move the momenta of
        D_b⁻¹Z = (Q, (P − c)/b)."""
        dim, chart, dt = self.data.dim, self.chart, undamped.dt
        (w, _), weight = rows_of(undamped, chart, self.data.training)
        p = (split(self.data.y1[self.data.training])[1] - c) / b
        by_factor = -(p / b)[:, None, :] * spread
        by_shift = np.broadcast_to(-np.eye(dim)[self._angles] / b, (len(p), len(self._angles), dim))
        moved = np.concatenate([by_factor, by_shift], axis=1)
        moved = np.concatenate([np.zeros_like(moved), moved], axis=-1)
        if self.half is not None:
            moved = moved @ np.linalg.inv(self.half.matrix).T
        none = np.zeros_like(moved)
        hessian = family.gradient_and_hessian(family.unflatten(solved), w)[1]
        of_gradient = chart.evaluation_point(none, moved) @ hessian  # symmetric
        columns = weight * (of_gradient - chart.target_gradient(none, moved, dt))
        return np.swapaxes(columns, 1, 2).reshape(w.size, moved.shape[1])

    @property
    def _angles(self) -> list[int]:
        """The angles that S is periodic in: their momenta may drift."""
        coordinates, dim = self.data.coordinates, self.data.dim
        return [a for a in coordinates.angles if a < dim and a not in coordinates.cyclic]

    def _drift(self, shift) -> np.ndarray:
        drift = np.zeros(self.data.dim)
        drift[self._angles] = shift
        return drift

    def _undamped(self, b, c) -> Dataset:
        """The pairs of the symplectic part, without its base map."""
        found = self.data.without(None, Damping(b, c))
        return found if self.half is None else found.without(self.half, self.half)


def _solved(design: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Least squares by a pivoted QR: a quarter of the time of singular values."""
    found = scipy.linalg.lstsq(design, target, lapack_driver="gelsy", check_finite=False)
    assert found is not None
    return found[0]


def _last_unknowns(rows: np.ndarray, first: int) -> tuple[np.ndarray, np.ndarray]:
    """Solve the least-squares problem [A b], (n, m + 1), for the unknowns from ``first`` on and
    their standard errors, those of independent residuals."""
    triangle = np.asarray(np.linalg.qr(rows, mode="r"))
    inverse = np.linalg.pinv(triangle[first:-1, first:-1])
    deviation = abs(triangle[-1, -1]) / np.sqrt(max(1, len(rows) - len(triangle) + 1))
    return inverse @ triangle[first:-1, -1], deviation * np.linalg.norm(inverse, axis=1)


def _momenta(spread, factor) -> np.ndarray:
    """b (d,) of every momentum."""
    return factor @ spread if len(factor) else np.ones(spread.shape[1])
