"""Descent of a law by its triangle, as every fit of a law in NumPy has it.

A problem is known by the triangle of its rows [∂r/∂c, r] at c (`fitting.triangle`), wherever the
rows are: of its singular values come the steps of every damping at once. The loop is that of
`solve.levenberg_marquardt`.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from functools import cached_property

import numpy as np

from gfnn_jax.fitting.triangle import Spectrum, Triangle
from gfnn_jax.solve.levenberg_marquardt import Factors, Tried
from gfnn_jax.solve.levenberg_marquardt import descended as descended_by

_DAMPING = Factors(first=1e-7, grown_by=10.0, shrunk_by=1e-2, least=5e-8, trials=9)
ROUNDOFF = 2e-16  # of the coordinates' sizes: the residual's floor


@dataclasses.dataclass(frozen=True)
class Descent:
    """Options of a descent, tuned on Hénon–Heiles at dt 0.5 to 3 and on three bodies.

    damping: in units of the largest singular value. gained: a step that lowers the residual by less
    has settled. promised: a step that was to lower it by no more than this, and does not, has met
    the floor of rounding or truncation.
    """

    damping: Factors = _DAMPING
    gained: float = 1e-2
    promised: float = 0.1


DESCENT = Descent()


def descended(
    linearised: Callable[[np.ndarray], Triangle], c, most: int, options: Descent = DESCENT
) -> tuple[np.ndarray, Triangle, int]:
    """Gauss–Newton steps from c until nothing is gained, at most so many: (coefficients, their
    triangle, steps taken). ``linearised(c)``: the problem at c, of rows wherever they are."""
    here = linearised(c)
    floor = ROUNDOFF * np.sqrt(here.rows)
    if not floor < here.norm < np.inf:
        return c, here, 0
    start = _AtCoefficients(c, here, linearised, floor, options)
    found = descended_by(start, options.damping, most)
    return found.problem.c, found.problem.triangle, found.steps


@dataclasses.dataclass(frozen=True)
class _AtCoefficients:
    """The problem at c; its cost is the norm of the residual. floor: of rounding, of that norm."""

    c: np.ndarray
    triangle: Triangle
    linearised: Callable[[np.ndarray], Triangle]
    floor: float
    options: Descent

    @cached_property
    def _spectrum(self) -> Spectrum:
        return self.triangle.spectrum()

    def tried(self, damping: float, failures: int) -> Tried:
        """The step of this damping, and the triangle where it leads."""
        c, norm = self.c - step(self._spectrum, damping), self.triangle.norm
        there = self.linearised(c)
        promised = norm - self._spectrum.residual_norm
        hopeless = promised < self.options.promised * norm and there.norm < 2 * norm
        return Tried((c, there), norm - there.norm, damping, promised, hopeless)

    def moved(self, there, damping: float) -> tuple[_AtCoefficients, bool]:
        """The problem at the coefficients of a step; settled where it gained little."""
        c, triangle = there
        gained = 1 - triangle.norm / self.triangle.norm
        settled = gained < self.options.gained or triangle.norm <= self.floor
        return dataclasses.replace(self, c=c, triangle=triangle), settled


def step(spectrum: Spectrum, damping: float) -> np.ndarray:
    """δ that minimises ‖R δ − r‖² + (damping s₀)² ‖D δ‖² among the directions that are known."""
    s = np.where(spectrum.known, spectrum.s, 0.0)
    square = np.where(spectrum.known, s**2 + (damping * spectrum.s[0]) ** 2, 1.0)
    return spectrum.solution(s / square)
