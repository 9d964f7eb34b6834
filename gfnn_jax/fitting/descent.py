"""Levenberg–Marquardt on triangles: the descent that every fit of a law in NumPy shares.

A problem is known by the triangle of its rows [∂r/∂c, r] at c (`fitting.triangle`), wherever the
rows are: of its singular values come the steps of every damping at once. Networks, whose normal
equations are made in one compiled program, have a descent of their own
(`fitting.levenberg_marquardt`).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np

from gfnn_jax.fitting.triangle import Spectrum, Triangle

ROUNDOFF = 2e-16  # of the coordinates' sizes: the residual's floor


@dataclasses.dataclass(frozen=True)
class Descent:
    """Options of a descent, tuned on Hénon–Heiles at dt 0.5 to 3 and on three bodies.

    dampings: tried in turn, in units of the largest singular value. gained: a step that lowers the
    residual by less has converged. promised: a step that was to lower it by no more than this, and
    does not, has met the floor of rounding or truncation.
    """

    dampings: tuple[float, ...] = (0.0, 1e-8, 1e-6, 1e-5, 1e-4, 1e-3, 1e-2, 1e-1, 1.0)
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
    first_damping, made = 0, 0
    while made < most and floor < here.norm < np.inf:
        found, spectrum = None, here.spectrum()
        promised = 1 - spectrum.residual_norm / here.norm
        for n in range(first_damping, len(options.dampings)):
            tried = c - step(spectrum, options.dampings[n])
            there = linearised(tried)
            if there.norm < here.norm:
                found = n
                break
            if promised < options.promised and there.norm < 2 * here.norm:
                break
        if found is None:
            break
        made += 1
        gained = 1 - there.norm / here.norm
        c, here = tried, there
        first_damping = max(0, found - 2)
        if gained < options.gained:
            break
    return c, here, made


def step(spectrum: Spectrum, damping: float) -> np.ndarray:
    """δ that minimises ‖R δ − r‖² + (damping s₀)² ‖D δ‖² among the directions that are known."""
    s = np.where(spectrum.known, spectrum.s, 0.0)
    square = np.where(spectrum.known, s**2 + (damping * spectrum.s[0]) ** 2, 1.0)
    return spectrum.solution(s / square)
