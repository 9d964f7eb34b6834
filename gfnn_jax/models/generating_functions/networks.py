"""Networks as S: a sweep of one size, trained by Levenberg–Marquardt, and ensembles of them.

The weights θ of a network minimise the same loss as the coefficients of a linear family, the mean
of ‖h ∇S(θ, w) + J (Z − z)‖² (paper, eq. (3)), which is not quadratic in θ.

Of networks that are trained together the mean is the map, and the spread its posterior. Every
member starts from its own parameters and sees the pairs in its own shares, drawn from an
exponential distribution (Rubin, Ann. Statist. 9 (1981) 130), so that noise moves the members as it
would move the fit. What no member represents does not show in their spread: held-out residuals say
how much wider the posterior is.
"""

import time
from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import numpy as np
from scipy.special import ndtr, stdtrit

from gfnn_jax.budget import NETWORK, Budget
from gfnn_jax.candidates.assemble import Candidate, validated
from gfnn_jax.dataset.dataset import Dataset
from gfnn_jax.dataset.measured_error import Tolerance, estimated_error
from gfnn_jax.dataset.rows import inputs_of, rows_of
from gfnn_jax.families.mlp import Ensemble, Mlp, amplitude_of
from gfnn_jax.fitting.levenberg_marquardt import (
    GradientFit,
    Limits,
    LMResult,
    LMState,
)
from gfnn_jax.models.generating_functions.sweeps import (
    FREE,
    OF_STEPS,
    Generates,
    Size,
    quiet,
    trial_residual,
)

# The network of the second-order fit: three small layers beat one wide, gelu beats tanh.
_MLP_HIDDEN, _MLP_ACTIVATION, _MLP_PAIRS = (16, 16, 16), "gelu", 4_000
_CHECKPOINT_SECONDS = 10.0


class NetworkSweep(Generates):
    """The one size of a network, trained by Levenberg–Marquardt."""

    kind = "mlp"
    short_of_pairs = False  # its one size is trained on any number of pairs
    linear = False

    def __init__(
        self, data: Dataset, tolerance: Tolerance, chart, max_iterations, seed, checkpoints
    ):
        self.data, self.tolerance, self.chart = data, tolerance, chart
        self._max_iterations, self._seed, self._checkpoints = max_iterations, seed, checkpoints
        (w, target), self._weight = rows_of(data, chart, data.training[:_MLP_PAIRS])
        inputs = inputs_of(data, w)
        family = Mlp(inputs, _MLP_HIDDEN, _MLP_ACTIVATION, amplitude_of(w, target))
        self._train, self.sizes = (w, target), [Size(family, family, 0.0)]
        self._params: Any = None

    def named(self, size: Size) -> str:
        """Name of the unit that estimates the size."""
        return f"{self.chart.name} {size.family.label}"

    def work(self, size: Size) -> float:
        """The training's own units are counted block by block."""
        return 1.0

    def work_of_steps(self, size: Size) -> float:
        """Operations that validating the estimated size takes."""
        return OF_STEPS * len(self.data.validation) * size.operations

    def work_of_refit(self, size: Size) -> float:
        """Infinite: a network is not trained anew."""
        return np.inf

    def posterior(self, size: Size) -> Callable[[], np.ndarray] | None:
        """Return None: one network does not tell how well it is determined."""
        return None

    @property
    def _work_of_iteration(self) -> float:
        """Operations of an iteration of the training."""
        w, parameters = self._train[0], self.sizes[0].family.num_parameters
        return 2.0 * w.size * parameters**2

    def estimate(self, size: Size, budget: Budget, on_progress: Callable[[str], Any]) -> Candidate:
        """Train the network."""
        family = size.family
        held, _ = rows_of(self.data, self.chart, self.data.validation)

        def report(state: LMState) -> None:
            on_progress(
                f"{self.chart.name} {family.label}: iteration {state.iteration}, "
                f"validation {state.validation_rms:.2e} of the data's spread"
            )

        resume = self._checkpoints.latest() if self._checkpoints else None
        reports: list[Callable[[LMState], None]] = [report]
        if self._checkpoints is not None:
            reports.append(_every_few_seconds(self._checkpoints))
        limits = Limits(
            self._max_iterations,
            block=lambda count: budget.unit(
                f"{count} iterations of {family.label}", NETWORK, count * self._work_of_iteration
            ),
            target_rms=0.5 * self.tolerance.bound,
            reports=tuple(reports),
        )
        result = self._trained(
            validation=held,
            weight=self._weight,
            limits=limits,
            resume=LMState(**resume[1]) if resume else None,
        )
        error = estimated_error(self.data, self.tolerance, result.validation_rms)
        return Candidate.of(
            error,
            label=family.label,
            family=self.kind,
            chart=self.chart.name,
            num_parameters=family.num_parameters,
            operations=size.operations,
            train_rms=result.train_rms,
            fit_seconds=result.seconds,
        )

    def _trained(self, **options: Any) -> LMResult:
        """The training; its params are then those of the sweep."""
        family = self.sizes[0].family
        start = family.init(jax.random.key(self._seed), np.float64)
        result = GradientFit(*self._train, **options).train(family, start)
        self._params = jax.tree.map(np.asarray, result.params)
        return result

    def validate(self, size: Size, estimated: Candidate, budget: Budget, on_progress) -> Candidate:
        """The trained network with its error measured by steps."""
        return validated(
            estimated, self.data, self.tolerance, self.chart, size.family, self._params
        )

    def solve(self, size: Size, budget: Budget = FREE, on_progress=quiet) -> tuple[Any, Any]:
        """The params of the trained network."""
        return None, self._params


def _every_few_seconds(checkpoints) -> Callable[[LMState], None]:
    """A report that saves the state when ten seconds have passed since it last did."""
    last = time.monotonic()

    def save(state: LMState) -> None:
        nonlocal last
        if time.monotonic() - last > _CHECKPOINT_SECONDS:
            checkpoints.save(state.iteration, state._asdict())
            last = time.monotonic()

    return save


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

    def _trained(self, **options: Any) -> LMResult:
        count, pairs = len(self._starts), len(self._train[0])
        shares = np.random.default_rng(self._seed).exponential(size=(count, pairs))
        result = GradientFit(*self._train, **options).train_together(
            self._network, self._starts, shares
        )
        self._take(result.params)
        return result

    def posterior(self, size: Size) -> Callable[[], np.ndarray]:
        """Function that makes the covariance root of the members' weights."""
        return partial(self.root, size)

    def root(self, size: Size) -> np.ndarray:
        """(E, E): rootᵀ root is the covariance of the weights, the members' own times a factor.

        Where the held-out residuals of ∇S are larger than the members' spread, that part of them is
        noise which polynomials leave too; the spread has it already, as well as few members tell
        it: two deviations are to hold what as many of Student's distribution do. All else is
        misfit, whose size the residuals tell.
        """
        (w, target), weight = rows_of(self.data, self.chart, self.data.validation)
        each = np.stack([size.family.gradient(only, w) for only in np.eye(len(self._params))])
        spread = weight * each.std(axis=0, ddof=1)
        left = weight * (each.mean(axis=0) - target)
        ratio, noise = float(np.mean((left / spread) ** 2)), 0.0
        if ratio > 1:
            noise = min(1.0, trial_residual(self.data) ** 2 / float(np.mean(left**2)))
        count = len(self._params)
        of_few = float(stdtrit(count - 1, ndtr(2.0))) / 2.0
        factor = np.sqrt(noise * of_few**2 + (1 - noise) * _ALIKE * ratio)
        return factor / np.sqrt(count - 1) * (np.eye(count) - 1 / count)
