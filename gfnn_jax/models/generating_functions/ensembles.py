"""Networks trained together: their mean is the map, their spread its posterior.

Every member starts from its own parameters and sees the pairs in its own shares, drawn from an
exponential distribution (Rubin, Ann. Statist. 9 (1981) 130), so that noise moves the members as it
would move the fit. What no member represents does not show in their spread: held-out residuals
say how much wider the posterior is.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import numpy as np

from gfnn_jax.dataset.rows import rows_of
from gfnn_jax.families.ensemble import Ensemble
from gfnn_jax.fitting.together import levenberg_marquardt_together
from gfnn_jax.fitting.training import LMResult, LMState
from gfnn_jax.models.generating_functions.network_sweep import NetworkSweep
from gfnn_jax.models.generating_functions.size import Size
from gfnn_jax.models.generating_functions.sweeps import trial_residual

# Variance of a misfit beside that of residuals which differ by chance, as in `fitting.uncertainty`:
# it is alike along an orbit. Hénon–Heiles, 500 pairs without noise, three seeds: with 1, bands of
# two deviations held 86 % of the true errors at step 10 and 63 % at step 100; with 4, of a fourth
# seed, all of them, and were 3.8 RMS errors wide.
_ALIKE = 2.0


class EnsembleSweep(NetworkSweep):
    """The one size of an ensemble of ``count`` networks."""

    def __init__(self, *arguments: Any, count: int):
        super().__init__(*arguments)
        self._network = self.sizes[0].family
        self._starts = [
            self._network.init(key, np.float64)
            for key in jax.random.split(jax.random.key(self._seed), count)
        ]
        self._take(jax.tree.map(lambda *a: np.stack(a), *self._starts))
        self._params = np.full(count, 1.0 / count)

    @property
    def _work_of_iteration(self) -> float:
        w, parameters = self._train[0], self._network.num_parameters
        return 2.0 * len(self._starts) * w.size * parameters**2

    def _take(self, members) -> None:
        family = Ensemble(self._network, jax.tree.map(np.asarray, members))
        self.sizes = [Size(family, family, 0.0)]

    def _like(self) -> LMState:
        one = super()._like()
        theta = np.zeros((len(self._starts), self._network.num_parameters))
        return one._replace(theta=theta, best_theta=theta, damping=theta[:, 0])

    def _trained(self, **options: Any) -> LMResult:
        count, pairs = len(self._starts), len(self._train[0])
        shares = np.random.default_rng(self._seed).exponential(size=(count, pairs))
        result = levenberg_marquardt_together(
            self._network, self._starts, *self._train, shares=shares, **options
        )
        self._take(result.params)
        return result

    def posterior(self, size: Size) -> Callable[[], np.ndarray]:
        """Function that makes the covariance root of the members' weights."""
        return partial(self.root, size)

    def root(self, size: Size) -> np.ndarray:
        """(E, E): rootᵀ root is the covariance of the weights, the members' own times a factor.

        Where the held-out residuals of ∇S are larger than the members' spread, that part of them is
        noise which polynomials leave too; the spread has it already. All else is misfit.
        """
        (w, target), weight = rows_of(self.data, self.chart, self.data.validation)
        each = np.stack([size.family.gradient(only, w) for only in np.eye(len(self._params))])
        spread = weight * each.std(axis=0, ddof=1)
        left = weight * (each.mean(axis=0) - target)
        ratio, noise = float(np.mean((left / spread) ** 2)), 0.0
        if ratio > 1:
            noise = min(1.0, trial_residual(self.data) ** 2 / float(np.mean(left**2)))
        factor = np.sqrt(noise + (1 - noise) * _ALIKE * ratio)
        count = len(self._params)
        return factor / np.sqrt(count - 1) * (np.eye(count) - 1 / count)
