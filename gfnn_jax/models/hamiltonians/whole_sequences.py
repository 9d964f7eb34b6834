"""H fitted to whole noisy sequences, where pairs are parts of them and a law was found."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from gfnn_jax.budget import Allowance
from gfnn_jax.coordinates import CARTESIAN
from gfnn_jax.dataset.dataset import Dataset
from gfnn_jax.dataset.runs import Arcs, arcs_of_pairs, onward
from gfnn_jax.fitting.gauss_newton import FlowFit, Problem
from gfnn_jax.fitting.significance import ABOVE_NOISE, terms_above_noise
from gfnn_jax.fitting.triangle import Triangle
from gfnn_jax.flows.collocation import Steps
from gfnn_jax.models.hamiltonians.flow_arcs import BIWEIGHT, FlowOnArcs, fit_flow, longest_arc
from gfnn_jax.solve.latent_arcs import OUTLYING, Fitted
from gfnn_jax.solve.noise import robust

_SHORTEST = 3  # steps of an arc that says more than its pairs do
_RISE = 1.01  # of the held-out arcs' noise, by chance
# Measured numbers for each term from which on a law that held-out sequences have borne out is
# fitted to these too: what judges it then is off by less than 1 / 200 of the noise's variance.
_ROWS_PER_TERM = 200
_STATES = 100  # from which the noise and its growth along an arc are measured
_STEP_ERROR = 0.01  # of a step's own error ÷ the noise
_IN_A_ROW = 2.5  # times the noise: neighbours of a state that stands alone stay below
# Misfit is certain beyond so many standard errors of the arcs' variation, and so much of that of
# noise, which alone varies by a quarter.
_BY_CHANCE, _CLEAR = 2.0, 0.5


class SequenceFit(NamedTuple):
    """kept: places of the family's terms that are left. fit: theirs. root: (k, k), rootᵀ root is
    the coefficients' covariance. noise: (2d,) standard deviation of each coordinate's noise. arcs:
    into which the sequences were cut. messages: about gross errors. misfit: as `lacks_terms`."""

    kept: tuple[int, ...]
    fit: FlowFit
    root: np.ndarray
    noise: np.ndarray
    arcs: int
    messages: tuple[str, ...]
    misfit: bool = False


class Measured(NamedTuple):
    """Arcs of measured states, and the noise of each value in parts of the usual one, (A, L, 2d) or
    1."""

    arcs: Arcs
    relative: np.ndarray | float


@dataclasses.dataclass(frozen=True)
class Sequences:
    """The sequences of a data set, cut into arcs of at most ``longest`` steps, along which noise
    stays linear. steps: of a flow, whose own error is far below the noise. least: (2d,) of what is
    left over, what is no noise. allowance: checked before each block of lanes."""

    data: Dataset
    steps: Steps
    longest: int
    least: np.ndarray
    allowance: Allowance

    @classmethod
    def along(
        cls,
        problem: Problem,
        family,
        c: np.ndarray,
        how: Steps,
        data: Dataset,
        allowance: Allowance,
    ) -> Sequences | None:
        """Cut them as long as a law with coefficients c that are close allows, by steps that
        resolve it. None where there are none of one dt in plain coordinates."""
        plain = data.coordinates.forward is CARTESIAN.forward and data.structure is None
        if not plain or data.varied:
            return None
        some = data.training[:_STATES]
        rms = float(robust(problem.residuals(family, c, how, some)))
        if not 0 < rms < np.inf:
            return None
        resolved = _STEP_ERROR * rms
        steps = problem.fine_steps(family, c, data.training, (resolved,))[0]
        longest = longest_arc(family, c, data.y0[some], data.dt, steps, rms)
        least = max(resolved, float(np.finfo(float).eps)) * problem.scale
        return cls(data, steps, longest, least, allowance)

    def arcs(self, rows: np.ndarray) -> Measured | None:
        """Arcs of these rows; None where they say no more than their pairs do."""
        rows, pairs, weight = np.sort(rows), self.data.pairs, self.data.weight
        onto = self.longest, onward(pairs, rows)
        arcs = arcs_of_pairs(np.asarray(pairs.z0)[rows], np.asarray(pairs.z1)[rows], *onto)
        if arcs is None or np.median(arcs.measured.sum(axis=1)) <= _SHORTEST:
            return None
        if weight is None:
            return Measured(arcs, 1.0)
        each = 1.0 / weight[rows]
        of_values = arcs_of_pairs(each, each, *onto)
        assert of_values is not None
        return Measured(arcs, np.nan_to_num(of_values.states, nan=1.0))

    def fitted(
        self, of: Measured, law: Callable[..., FlowOnArcs], p: np.ndarray, **options: Any
    ) -> Fitted | None:
        """The law with its numbers near p; law: makes the model of dt, steps, moves and allowance.
        options: of `flow_arcs.fit_flow`."""
        arcs, angles = of.arcs, self.data.coordinates.angles
        model = law(dt=self.data.dt, how=self.steps, moves=arcs.moves, allowance=self.allowance)
        return fit_flow(model, p, arcs, self.least, angles, relative=of.relative, **options)


def fitted_to_sequences(
    problem: Problem,
    family,
    fit: FlowFit,
    data: Dataset,
    allowance: Allowance,
) -> SequenceFit | None:
    """The law of these pairs' fit, fitted to their sequences. None where they are none of one dt in
    plain coordinates, where noise soon grows beyond the linear, or where held-out sequences do not
    bear the law out."""
    sequences = Sequences.along(problem, family, fit.coefficients, fit.steps, data, allowance)
    if sequences is None:
        return None
    train, held = sequences.arcs(data.training), sequences.arcs(data.validation)
    if train is None or held is None:
        return None

    def fitted(of: Measured, terms, coefficients) -> Fitted | None:
        return sequences.fitted(of, partial(FlowOnArcs, terms), coefficients)

    def left(terms, coefficients) -> float:
        """Noise of the held-out arcs, each from the state that suits it."""
        found = sequences.fitted(held, partial(FlowOnArcs, terms), coefficients, only_states=True)
        return np.inf if found is None else float(np.linalg.norm(noise_of(found) / problem.scale))

    c = fit.coefficients
    before, found = left(family, c), fitted(train, family, c)
    if found is None or not left(family, found.p) <= _RISE * before:
        return None
    kept, widened = tuple(range(len(c))), 1.0
    few = terms_above_noise(triangle_of(found), found.p, ABOVE_NOISE)[0]
    if 0 < len(few) < len(c):
        fewer = family.take(tuple(few.tolist()))
        again = fitted(train, fewer, found.p[few])
        if again is not None and left(fewer, again.p) <= _RISE * before:
            widened = _of_selection(triangle_of(found), found.p, few)
            kept, found, family = tuple(few.tolist()), again, fewer
    if has_rows_to_spare(found, len(kept)):
        everyone = sequences.arcs(np.arange(len(data.y0)))
        again = fitted(everyone, family, found.p) if everyone is not None else None
        if again is not None:
            found = again
    root = widened * covariance_root_of(found)
    return SequenceFit(
        kept,
        fit._replace(coefficients=found.p, standard_errors=np.linalg.norm(root, axis=0)),
        root,
        noise_of(found),
        len(found.x),
        about_outliers(found.residuals),
        lacks_terms(found),
    )


def has_rows_to_spare(found: Fitted, numbers: int) -> bool:
    """Return whether the arcs are so many for so many numbers of a law that it may be fitted to
    the held-out sequences too."""
    return _ROWS_PER_TERM * numbers <= triangle_of(found).rows


def noise_of(found: Fitted) -> np.ndarray:
    """(2d,): of noise of each value the root of the mean square over what was measured."""
    if found.sigma.ndim == 1:
        return found.sigma
    return np.sqrt(
        np.nanmean(np.where(np.isfinite(found.residuals), found.sigma, np.nan) ** 2, axis=(0, 1))
    )


def triangle_of(found: Fitted) -> Triangle:
    """Triangle of [∂r/∂c, r] without the latent states, r predicted less measured, for the numbers
    that have weight."""
    factor = found.factor.copy()
    factor[:, -1] *= -1
    return Triangle(factor, int((np.abs(found.residuals) < BIWEIGHT.k).sum()))


def _of_selection(triangle: Triangle, c: np.ndarray, few: np.ndarray) -> float:
    """Factor of the standard errors of these terms that stands for the others, which were dropped.

    Terms that are no more than noise each may be more together: without them the sum of squares
    rises by Δ, of mean n for n terms that are truly zero, with variance 2 n. What it exceeds n by,
    and a standard deviation more, is a bias beside the k squares of the k coefficients' own error.
    """
    dropped = len(c) - len(few)
    squares = triangle.rebased(c).pruned(few).spectrum().residual_norm ** 2
    rise = squares - triangle.residual_norm(len(c)) ** 2
    bias = max(rise - dropped, 0.0) + np.sqrt(2 * dropped)
    return float(np.sqrt(1 + bias / len(few)))


def covariance_root_of(found: Fitted) -> np.ndarray:
    """(m, m), rootᵀ root the covariance: that of independent noise, and of the misfit by which the
    arcs' own gradients vary by more than noise makes them.

    Misfit is alike along an arc, and stays however many arcs there are. Where it is certain, only
    as many arcs count as there are coefficients, as in `fitting.uncertainty`: bands then hold what
    the terms cannot represent.
    """
    root, (arcs, count) = triangle_of(found).spectrum().root().T, found.scores.shape
    misfit, certain = _misfit(found.scores @ root.T)
    return root * np.sqrt(1.0 + misfit * (max(arcs / count, 1.0) if certain else 1.0))


def lacks_terms(found: Fitted) -> bool:
    """Return whether the arcs are certain that the law misses more than noise."""
    return _misfit(found.scores @ triangle_of(found).spectrum().root())[1]


def _misfit(scores: np.ndarray) -> tuple[float, bool]:
    """Variation of the arcs' gradients (arcs, count) beyond that of noise, in whose units they are,
    and whether that is certain."""
    arcs, count = scores.shape
    each = np.sum(scores**2, axis=1) / count
    misfit = max(float(each.sum()) / max(1 - count / arcs, 1 / arcs) - 1.0, 0.0)
    return misfit, misfit > max(_CLEAR, _BY_CHANCE * float(np.sqrt(arcs) * each.std()))


def about_outliers(residuals: np.ndarray) -> tuple[str, ...]:
    """Message about measured states that the law misses by far: gross errors stand alone.

    residuals: (arcs, L, 2d) in units of the noise.
    """
    measured = np.isfinite(residuals).all(axis=-1)
    outlying = np.any(np.abs(residuals) > OUTLYING, axis=-1)
    if not outlying.any():
        return ()
    beside = np.any(np.abs(residuals) > _IN_A_ROW, axis=-1)
    beside = np.pad(beside, ((0, 0), (1, 1)))
    alone = outlying & ~(beside[:, :-2] | beside[:, 2:])
    if 2 * alone.sum() < outlying.sum():
        return (
            f"the law misses {outlying.sum()} of {measured.sum()} measured states by more than "
            f"{OUTLYING:g} times the noise, most of them in a row: it is less accurate there, and "
            "they were given little weight",
        )
    return (
        f"{outlying.sum()} of {measured.sum()} measured states lie more than {OUTLYING:g} times "
        "the noise from the sequences of the law: outliers, they were given little weight",
    )
