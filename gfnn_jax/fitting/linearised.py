"""A fit close to its coefficients: one algebra for laws of pairs and of recordings.

Close to a fit its residuals are linear in a change δ of its coefficients p,

    r(p + δ) = r − A δ,      A = −∂r/∂p,

states that are latent eliminated. The `Triangle` R of [A r] holds all that this problem says:

- (AᵀA)⁻¹, times the variance of the residuals, is the *covariance*, and p in units of its standard
  errors the *significance*. Residuals that are correlated over τ samples have τ times the variance.
- Columns of A that belong to coefficients which the fit has not got are *added* to it one at a
  time: with A₂ = (I − QQᵀ) A₁ their part that the fitted ones do not imitate, the score test of
  s = A₂ᵀr, F = A₂ᵀA₂ (Rao, Proc. Camb. Phil. Soc. 44 (1948) 50) needs no further fit: sᵀF⁻¹s.
- Without some of the rows one Gauss–Newton step leads from p to the fit of the others (Rad &
  Maleki, J. R. Stat. Soc. B 82, 2020).
- A *null direction* is a change of p that moves no residual.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from functools import cached_property, reduce
from typing import NamedTuple

import numpy as np

from gfnn_jax.fitting.triangle import Spectrum, Triangle
from gfnn_jax.solve.latent_arcs import Fitted


class Options:
    """Limits of roundoff, relative numbers all; chosen on `benchmarks/measured.py`.

    rank: singular value of scaled columns, to the largest, of a combination that is not determined.
    null: the same of a combination that does nothing. part: of the largest entry of a null
    direction, of coefficients that are part of it.
    """

    rank: float = 1e-10
    null: float = 1e-9
    part: float = 1e-3


class Added(NamedTuple):
    """Coefficients, each alone added to a fit.

    value: (m,) where each would be. size: (m,) the norm of what its column does and the fitted
    ones do not; its standard error is √variance ÷ size. share: (m,) of the norm of the column, 0
    where the fitted coefficients imitate it. rest, left: norms of the residual before, and (m,)
    after.
    """

    value: np.ndarray
    size: np.ndarray
    share: np.ndarray
    rest: float
    left: np.ndarray

    def scores(self, variance: float, share: float, least_left: float) -> np.ndarray:
        """(m,) distances from zero in standard errors, by the residual that each would leave, of
        its squares at least the part ``least_left``; 0 where the unimitated share is not above
        ``share``."""
        over = np.maximum((self.left / max(self.rest, 1e-150)) ** 2, least_left)
        scores = np.abs(self.value) * self.size / np.sqrt(variance * over)
        return np.where(self.share > share, scores, 0.0)


@dataclasses.dataclass(frozen=True, eq=False)
class Linearised:
    """The linearised problem of a fit.

    p: (n,) coefficients. triangle: of [A r] at p, A = −∂r/∂p. variance: of a residual, times the
    number of neighbours among which it counts as one.
    """

    p: np.ndarray
    triangle: Triangle
    variance: float = 1.0

    @classmethod
    def of_derivatives(cls, p: np.ndarray, triangle: Triangle) -> Linearised:
        """Make it of the triangle of [∂r/∂p, r], as pairs have it."""
        factor = triangle.factor.copy()
        factor[:, -1] *= -1
        return cls(p, Triangle(factor, triangle.rows))

    @classmethod
    def of_arcs(cls, fitted: Fitted, correlation: float = 1.0) -> Linearised:
        """Make it of a fit of arcs, whose residuals are in units of the noise and correlated over
        so many nodes."""
        count = int(np.isfinite(fitted.residuals).sum())
        return cls(fitted.p, Triangle(fitted.factor, count), correlation)

    @classmethod
    def of_rows(cls, rows: np.ndarray, variance: float = 1.0) -> Linearised:
        """Make the linear problem min ‖A c − b‖ of rows (N, n + 1) of [A b], at c = 0."""
        return cls(np.zeros(rows.shape[-1] - 1), Triangle.of(rows), variance)

    @property
    def columns(self) -> np.ndarray:
        """A (n + 1, n), in the basis of the triangle."""
        return self.triangle.factor[:, :-1]

    @property
    def residual(self) -> np.ndarray:
        """The residual (n + 1,) at p, in the basis of the triangle."""
        return self.triangle.factor[:, -1]

    @cached_property
    def spectrum(self) -> Spectrum:
        """Singular values of A, its columns scaled to one. n is at least 1."""
        return self.triangle.spectrum()

    # The coefficients.

    @cached_property
    def covariance(self) -> np.ndarray:
        """(n, n); infinite where A is not known, since derivatives overflowed."""
        n = len(self.p)
        if n and not self.columns.any():
            return np.full((n, n), np.inf)
        root = self.spectrum.root() if n else np.zeros((0, 0))
        return self.variance * (root @ root.T)

    @property
    def errors(self) -> np.ndarray:
        """(n,) standard errors of the coefficients."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def significance(self) -> np.ndarray:
        """(n,) |p| in standard errors; 0 of what is known without an error."""
        errors = self.errors
        return np.divide(np.abs(self.p), errors, out=np.zeros_like(errors), where=errors > 0)

    @property
    def sharpness(self) -> float:
        """Geometric mean of the standard errors: the smaller, the sharper the coefficients."""
        return float(np.exp(0.5 * np.mean(np.log(np.maximum(np.diag(self.covariance), 1e-300)))))

    def collinear(self, least: float) -> list[tuple[int, int, float]]:
        """Pairs (i, j, correlation) of coefficients, with correlations above ``least`` in size."""
        errors = self.errors
        with np.errstate(all="ignore"):
            correlation = self.covariance / errors / errors[:, None]
        pairs = zip(*np.nonzero(np.triu(np.abs(correlation) > least, 1)), strict=True)
        return [(int(i), int(j), float(correlation[i, j])) for i, j in pairs]

    def null_space(self) -> np.ndarray:
        """Independent changes (m, n) of the coefficients that move no residual, the least last, 0
        of those that are no part of one."""
        if not len(self.p):
            return np.zeros((0, 0))
        spectrum = self.spectrum
        along = spectrum.vt[spectrum.s <= Options.null * spectrum.s[0]]
        part = np.abs(along) > Options.part * np.abs(along).max(axis=1, keepdims=True, initial=0)
        return np.where(part, along / spectrum.column, 0.0)

    def null_direction(self) -> np.ndarray:
        """The last of them (n,); 0 where there is none."""
        found = self.null_space()
        return found[-1] if len(found) else np.zeros(len(self.p))

    def shortest(self) -> np.ndarray:
        """Coefficients (n,) that move the residuals as p does, and as little as can be: without
        their part along the null space, in units of what each moves."""
        size = self.spectrum.column
        along = np.linalg.qr((self.null_space() * size).T)[0]
        return self.p - along @ (along.T @ (self.p * size)) / size

    # Other rows.

    def step(self, rank: float = Options.rank) -> np.ndarray:
        """The Gauss–Newton step (n,); 0 along combinations whose singular value, of scaled columns
        and to the largest, is at most ``rank``."""
        size = np.maximum(np.linalg.norm(self.columns, axis=0), 1e-300)
        return np.linalg.lstsq(self.columns / size, self.residual, rcond=rank)[0] / size

    def moved_by(self, other: Linearised) -> float:
        """The most that any combination of coefficients moves, in its standard errors, where the
        residuals are those of ``other``, as by shorter steps of the integrator."""
        change = other.step(Options.null) - self.step(Options.null)
        return float(np.linalg.norm(self.columns @ change) / np.sqrt(self.variance))

    # Other columns.

    def among(self, kept: Sequence[int]) -> Linearised:
        """The problem of these coefficients alone, the others as they are."""
        factor = Triangle.of(self.triangle.factor[:, [*kept, -1]]).factor
        return Linearised(self.p[list(kept)], Triangle(factor, self.triangle.rows), self.variance)

    def combined(self, turn: np.ndarray) -> Linearised:
        """The problem of m combinations of coefficients, turn (n, m), from 0 on."""
        factor = np.column_stack([self.columns @ turn, self.residual])
        whole = Triangle(Triangle.of(factor).factor, self.triangle.rows)
        return Linearised(np.zeros(turn.shape[1]), whole, self.variance)

    def added(self, fitted: Sequence[int], omitted: Sequence[int]) -> Added:
        """Each of the ``omitted`` coefficients (m) alone beside those that are ``fitted``."""
        A, rest = self.columns, self.triangle.factor
        if len(fitted):
            Q = np.linalg.qr(A[:, list(fitted)])[0]
            rest = rest - Q @ (Q.T @ rest)
        new, residual = rest[:, list(omitted)], rest[:, -1]
        whole, size = (np.linalg.norm(c, axis=0) for c in (A[:, list(omitted)], new))
        along = np.divide(new.T @ residual, size, out=np.zeros(len(size)), where=size > 0)
        square = max(float(residual @ residual), 1e-300)
        return Added(
            np.divide(along, size, out=np.zeros_like(along), where=size > 0),
            size,
            np.divide(size, whole, out=np.zeros_like(size), where=whole > 0),
            float(np.sqrt(square)),
            np.sqrt(np.maximum(square - along**2, 0.0)),
        )

    def unimitated(self, k: int) -> float:
        """Share of what a coefficient changes that no combination of the others does: below some
        1e-4 it is not identifiable."""
        others, own = np.delete(self.columns, k, axis=1), self.columns[:, k]
        size = np.linalg.norm(own)
        left = own - others @ np.linalg.lstsq(others, own, rcond=None)[0]
        return float(np.linalg.norm(left) / size) if size > 0 else 0.0


def without_each(p: np.ndarray, parts: Sequence[Triangle]) -> list[np.ndarray]:
    """Coefficients (n,) of the fit to all of these parts of the rows but one, for each in turn, by
    one Gauss–Newton step from p. parts: triangles of [A r] at p."""
    empty = Triangle.empty(len(p))
    found = []
    for k in range(len(parts)):
        others = [part for i, part in enumerate(parts) if i != k]
        found.append(p + Linearised(p, reduce(Triangle.merge, others, empty)).step())
    return found
