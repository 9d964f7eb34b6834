"""S of a Poisson map without a law, in the chart of `flows.lie`: fitted to pairs by Gauss–Newton.

    Z(c) = z + h B(x) ∇S(x),   x = ψ(M) z,   S = Σ c_j φ_j

Each pair has its x, which moves with c. A change of c changes Z by T ∇φ_j(x), T (n, n) of each
pair, so that every iteration is one linear least-squares problem. The degree rises step by step,
each from the last S: a chart's x is then known well enough. S is determined up to functions of
the Casimirs, and on a thin shell up to more: small singular values are left out.
"""

from typing import NamedTuple

import numpy as np

from gfnn_jax.arrays import matmul
from gfnn_jax.brackets import Constant, LieAlgebra
from gfnn_jax.families.inputs import box_inputs
from gfnn_jax.families.products import Products, number_of_terms
from gfnn_jax.fitting.triangle import Spectrum
from gfnn_jax.flows.lie import LieGenerated, lie_generated, mean_of_arc
from gfnn_jax.phase_space import sizes


class Options:
    """Numbers of the fit."""

    # Of the largest singular value; smaller ones are left out. With 1e-11 Euler's top at degree 8
    # stays at 2e-9 instead of 9e-14.
    truncated: float = 1e-9
    iterations: int = 12  # of Gauss–Newton at a degree
    parts: tuple[float, ...] = (1.0, 0.5, 0.25, 0.125)  # of a step, tried in turn
    newton: int = 8  # of x at an iteration
    solved: float = 3e-15  # of the sizes: a change of x that small is roundoff
    settled: float = 0.7  # an iteration that leaves more than this part of the residual is the last
    held: int = 5  # one pair of so many is held out: it says which degree is best
    worse: float = 2.0  # held-out error beyond that of the best degree: higher ones are not tried
    rows_per_term: float = 1.5  # at least
    most_terms: int = 1000  # of S: more take longer than 12 s (benchmarks/bracket_maps.py)


class LieMap(NamedTuple):
    """Fitted piece, its degree and its held-out error (RMS in units of the coordinates' sizes)."""

    piece: LieGenerated
    degree: int
    error: float


def fit_lie_map(z0, z1, bracket: Constant | LieAlgebra, dt: float, degree: int = 10) -> LieMap:
    """Fit S up to a total ``degree`` to pairs z0, z1 (N, n) of a Lie algebra or constant bracket;
    the degree with the least held-out error is taken."""
    scale = sizes(np.concatenate([z0, z1]))
    held = np.arange(len(z0)) % Options.held == Options.held - 1
    train, test = (_Pairs(bracket, z0[of], z1[of], dt, scale) for of in (~held, held))
    inputs = box_inputs(0.5 * (z0 + z1))
    best, c, family = None, None, None
    for d in range(2, degree + 1):
        terms = number_of_terms(inputs.is_angle, d)
        most = min(Options.most_terms, z0[~held].size / Options.rows_per_term)
        if terms > most:
            break
        larger = Products(inputs, d)
        c = np.zeros(terms) if family is None else _carried(family, c, larger)
        family = larger
        c = train.fitted(family, c)
        error = test.error(family, c)
        if best is None or error < best[2]:
            best = family, c, error
        elif not error < Options.worse * best[2]:
            break
    assert best is not None
    family, c, error = best
    return LieMap(
        lie_generated(family, family.unflatten(c), bracket, dt, scale), family.degree, error
    )


class _Pairs:
    """Pairs with the x of each, which is kept from one iteration to the next."""

    def __init__(self, bracket: Constant | LieAlgebra, z0, z1, dt: float, scale):
        self.bracket, self.z0, self.z1, self.dt, self.scale = bracket, z0, z1, dt, scale
        self.x = 0.5 * (z0 + z1)

    def fitted(self, family: Products, c):
        """Coefficients after Gauss–Newton from c, each step halved until the residual shrinks."""
        residual, by_slope = self.linearised(family, c)
        for _ in range(Options.iterations):
            size, terms = _rms(residual), family.term_gradients(self.x)
            rows = (by_slope @ terms / self.scale[:, None]).reshape(-1, terms.shape[-1])
            step, x = _solved(rows, residual.ravel() + rows @ c) - c, self.x
            for part in Options.parts:
                residual, by_slope = self.linearised(family, c + part * step)
                if _rms(residual) < size:
                    break
                self.x = x
            else:
                return c
            c = c + part * step
            if not _rms(residual) < Options.settled * size:
                return c
        return c

    def error(self, family: Products, c) -> float:
        """RMS of Z(c) − Z in units of the sizes."""
        return _rms(self.linearised(family, c)[0])

    def linearised(self, family: Products, c) -> tuple[np.ndarray, np.ndarray]:
        """(Z − Z(c)) / size (N, n), and T (N, n, n): what a change of ∇S(x) changes Z by."""
        params, h, z = family.unflatten(c), self.dt, self.z0

        def evaluated(x):
            gradient, hessian = family.gradient_and_hessian(params, x)
            return gradient, hessian, *mean_of_arc(self.bracket, z, h * gradient, slopes=True)

        x, eye = self.x, np.eye(z.shape[1])
        gradient, hessian, mean, slope = evaluated(x)
        for _ in range(Options.newton):
            step = np.linalg.solve(eye - h * slope @ hessian, (x - mean)[..., None])[..., 0]
            x = x - step
            gradient, hessian, mean, slope = evaluated(x)
            if not np.abs(step / self.scale).max() > Options.solved:
                break
        if np.isfinite(x).all():
            self.x = x
        form = self.bracket.matrix(x)
        moved = z + h * matmul(form, gradient[..., None])[..., 0]
        bent = form @ hessian
        if isinstance(self.bracket, LieAlgebra):
            bent = bent + np.einsum("ijk,nj->nik", self.bracket.constants, gradient)
        by_slope = h * (form + h * bent @ np.linalg.solve(eye - h * slope @ hessian, slope))
        return (self.z1 - moved) / self.scale, by_slope


def _solved(rows: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Least squares of least norm, in units of the columns, without small singular values."""
    factor = np.asarray(np.linalg.qr(np.column_stack([rows, target]), mode="r"))
    found = Spectrum.of(factor[:, :-1], factor[:, -1], 0.0, Options.truncated)
    return found.solution(found.inverse)


def _carried(family: Products, c, larger: Products) -> np.ndarray:
    """The coefficients of a family as those of one of higher degree."""
    place = {tuple(row): k for k, row in enumerate(_factors(larger))}
    found = np.zeros(larger.num_parameters)
    for row, value in zip(_factors(family), c, strict=True):
        found[place[tuple(row)]] = value
    return found


def _factors(family: Products) -> np.ndarray:
    """Degree of each variable in each term (terms, n)."""
    a, b = family.basis.halves
    first, second = family.basis.terms.T
    return np.concatenate([a.indices[first], b.indices[second]], axis=1)


def _rms(values) -> float:
    size = float(np.sqrt(np.mean(values**2)))
    return size if np.isfinite(size) else np.inf
