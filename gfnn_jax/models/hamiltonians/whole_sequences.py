"""H fitted to whole noisy sequences, where pairs are parts of them and a law was found."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from gfnn_jax.budget import Allowance
from gfnn_jax.coordinates import CARTESIAN
from gfnn_jax.dataset.arcs import Arcs, arcs_of_pairs, onward
from gfnn_jax.dataset.dataset import Dataset
from gfnn_jax.fitting.gauss_newton import FlowFit, Problem
from gfnn_jax.fitting.significance import significant
from gfnn_jax.fitting.triangle import Triangle
from gfnn_jax.models.hamiltonians.flow_arcs import BIWEIGHT, FlowOnArcs, fit_flow, longest_arc
from gfnn_jax.solve.latent_arcs import OUTLYING, Fitted
from gfnn_jax.solve.robust import robust

_SHORTEST = 3  # steps of an arc that says more than its pairs do
_CERTAIN = 4.0  # standard errors below which a term is noise
_RISE = 1.01  # of the held-out arcs' noise, by chance
# Measured numbers for each term from which on a law that held-out sequences have borne out is
# fitted to these too: what judges it then is off by less than 1 / 200 of the noise's variance.
_ROWS_PER_TERM = 200
_STATES = 100  # from which the noise and its growth along an arc are measured
_STEP_ERROR = 0.01  # of a step's own error ÷ the noise
_IN_A_ROW = 2.5  # times the noise: neighbours of a state that stands alone stay below


class Whole(NamedTuple):
    """kept: places of the family's terms that are left. fit: theirs. root: (k, k), rootᵀ root is
    the coefficients' covariance. noise: (2d,) standard deviation of each coordinate's noise. arcs:
    into which the sequences were cut. messages: about gross errors."""

    kept: tuple[int, ...]
    fit: FlowFit
    root: np.ndarray
    noise: np.ndarray
    arcs: int
    messages: tuple[str, ...]


def fitted_to_sequences(
    problem: Problem, family, fit: FlowFit, data: Dataset,
    allowance: Allowance,
) -> Whole | None:  # fmt: skip
    """The law of these pairs' fit, fitted to their sequences. None where they are none of one dt in
    plain coordinates, where noise soon grows beyond the linear, or where held-out sequences do not
    bear the law out."""
    coordinates = data.coordinates
    plain = coordinates.forward is CARTESIAN.forward and data.structure is None
    if not plain or data.varied:
        return None
    c = fit.coefficients
    some = data.training[:_STATES]
    rms = float(robust(problem.residuals(family, c, fit.steps, some)))
    if not 0 < rms < np.inf:
        return None
    resolved = _STEP_ERROR * rms
    steps = problem.fine_steps(family, c, data.training, (resolved,))[0]
    longest = longest_arc(family, c, data.y0[some], data.dt, steps, rms)

    def along(rows) -> Arcs | None:
        rows, pairs = np.sort(rows), data.pairs
        z0, z1 = np.asarray(pairs.z0)[rows], np.asarray(pairs.z1)[rows]
        arcs = arcs_of_pairs(z0, z1, longest, onward(pairs, rows))
        if arcs is None or np.median(arcs.measured.sum(axis=1)) <= _SHORTEST:
            return None
        return arcs

    train, held = along(data.training), along(data.validation)
    if train is None or held is None:
        return None
    least = max(resolved, float(np.finfo(float).eps)) * problem.scale

    def fitted(arcs: Arcs, terms, coefficients, **options) -> Fitted | None:
        model = FlowOnArcs(terms, data.dt, steps, arcs.moves, allowance)
        return fit_flow(model, coefficients, arcs, least, coordinates.angles, **options)

    def left(terms, coefficients) -> float:
        """Noise of the held-out arcs, each from the state that suits it."""
        found = fitted(held, terms, coefficients, only_states=True)
        return np.inf if found is None else float(np.linalg.norm(found.sigma / problem.scale))

    before, found = left(family, c), fitted(train, family, c)
    if found is None or not left(family, found.p) <= _RISE * before:
        return None
    kept = tuple(range(len(c)))
    few = significant(_triangle(found), found.p, _CERTAIN)[0]
    if 0 < len(few) < len(c):
        fewer = family.take(tuple(few.tolist()))
        again = fitted(train, fewer, found.p[few])
        if again is not None and left(fewer, again.p) <= _RISE * before:
            kept, found, family = tuple(few.tolist()), again, fewer
    if _ROWS_PER_TERM * len(kept) <= _triangle(found).rows:
        everyone = along(np.arange(len(data.y0)))
        again = fitted(everyone, family, found.p) if everyone is not None else None
        if again is not None:
            found = again
    root = _root(found)
    return Whole(
        kept,
        fit._replace(coefficients=found.p, standard_errors=np.linalg.norm(root, axis=0)),
        root, found.sigma, len(found.x), _messages(found),
    )  # fmt: skip


def _triangle(found: Fitted) -> Triangle:
    """Triangle of [∂r/∂c, r] without the latent states, r predicted less measured, for the numbers
    that have weight."""
    factor = found.factor.copy()
    factor[:, -1] *= -1
    return Triangle(factor, int((np.abs(found.residuals) < BIWEIGHT.k).sum()))


def _root(found: Fitted) -> np.ndarray:
    """(m, m), rootᵀ root the covariance: that of independent noise, widened where the arcs' own
    gradients vary by more than noise makes them: misfit is alike along an arc."""
    root, (arcs, count) = _triangle(found).spectrum().root().T, found.scores.shape
    vary = np.sum((found.scores @ root.T) ** 2) / count / max(1 - count / arcs, 1 / arcs)
    return root * np.sqrt(max(vary, 1.0))


def _messages(found: Fitted) -> tuple[str, ...]:
    measured = np.isfinite(found.residuals).all(axis=-1)
    outlying = np.any(np.abs(found.residuals) > OUTLYING, axis=-1)
    if not outlying.any():
        return ()
    beside = np.any(np.abs(found.residuals) > _IN_A_ROW, axis=-1)
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
