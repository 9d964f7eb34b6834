"""Zeros of channels that wander, found in the residuals of arcs by restricted maximum likelihood.

Of rows X of all that was fitted, states and coefficients, and residuals r with covariance σ² C
(`solve.noise`), N of them less M fitted numbers,

    2 log likelihood = −(N − M) log rᵀ C⁻¹ r − log |C| − log |Xᵀ C⁻¹ X|

with σ at its best and r what C⁻¹ leaves (Harville, J. Am. Stat. Assoc. 72 (1977) 320). A law that
is wrong colours residuals too: what is found here is a candidate, and held-out forecasts judge it.
"""

from __future__ import annotations

import numpy as np

from gfnn_jax.models.lagrangians.fit import LawFit, Workbench
from gfnn_jax.solve.latent_arcs import Readings
from gfnn_jax.solve.noise import Wander

_EVIDENCE = 10.0  # logarithm of the likelihood's ratio, below which residuals are white
_STEPS = (2.0, 1.4)  # factors by which size and time are searched
_SIZES = (0.1, 30.0)  # in units of the noise
_TIMES = (0.1, 10.0)  # in periods of the fastest motion


def wander_of(bench: Workbench, fit: LawFit) -> Wander | None:
    """The wander of the channels' zeros that the residuals of a fit show; None where they are
    white."""
    arcs, loss, m = fit.arcs, bench.observation.loss, fit.fitted.x.shape[-1]
    model = bench.model(fit.structure, arcs, fit.p, np.arange(len(fit.p)))
    readings = Readings(model, arcs.y, fit.sigma * arcs.noise, loss)
    rows, _ = readings.linearised(fit.p, fit.fitted.x)
    finite = np.isfinite(arcs.y)
    weights = np.where(finite, loss.weights(fit.fitted.residuals), np.nan)
    noise = np.where(finite, arcs.noise / np.sqrt(weights), np.inf)
    free = int(finite.sum()) - len(rows) * m - len(fit.p)
    rows = rows.reshape(*arcs.y.shape, -1)
    period = 2 * np.pi / bench.omega

    def likelihood(size: float, periods: float) -> float:
        white = Wander(size, periods * period).whitening(arcs.t, noise)
        mixed = np.einsum("akij,ajkw->aikw", white, rows, optimize=True)
        return _likelihood(mixed, m, free) + _log_diagonal(white)

    here, best = (1.0, 1.0), likelihood(1.0, 1.0)
    for step in _STEPS:
        moved = True
        while moved:
            moved = False
            for factors in ((step, 1), (1 / step, 1), (1, step), (1, 1 / step)):
                size = float(np.clip(here[0] * factors[0], *_SIZES))
                periods = float(np.clip(here[1] * factors[1], *_TIMES))
                found = likelihood(size, periods)
                if found > best + 0.01:
                    here, best, moved = (size, periods), found, True
    if best < _likelihood(rows, m, free) + _EVIDENCE:
        return None
    return Wander(here[0], here[1] * period)


def _likelihood(rows: np.ndarray, m: int, free: int) -> float:
    """The part of the likelihood that whitened rows (A, L, k, m + n + 1) tell."""
    R = np.asarray(np.linalg.qr(rows.reshape(len(rows), -1, rows.shape[-1]), mode="r"))
    rest = np.asarray(np.linalg.qr(R[:, m:, m:].reshape(-1, rows.shape[-1] - m), mode="r"))
    left = _log_diagonal(R[:, :m, :m]) + _log_diagonal(rest[:-1, :-1])
    return float(-free * np.log(max(abs(rest[-1, -1]), 1e-300)) - left)


def _log_diagonal(matrices: np.ndarray) -> float:
    diagonal = np.abs(np.diagonal(matrices, axis1=-2, axis2=-1))
    return float(np.sum(np.log(np.maximum(diagonal, 1e-300))))
