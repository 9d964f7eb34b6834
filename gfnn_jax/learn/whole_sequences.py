"""H fitted to whole noisy sequences, where pairs are parts of them and a law was found."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from gfnn_jax.coordinates import CARTESIAN
from gfnn_jax.dataset.dataset import Dataset
from gfnn_jax.dataset.noise import robust
from gfnn_jax.dataset.runs import steps_between
from gfnn_jax.fitting.gauss_newton import FlowFit, Problem
from gfnn_jax.fitting.shooting import OPTIONS, Shooting, Shot, arcs_of, longest_arc
from gfnn_jax.fitting.significance import significant

_SHORTEST = 3  # steps of an arc that says more than its pairs do
_CERTAIN = 4.0  # standard errors below which a term is noise
_RISE = 1.01  # of the held-out arcs' noise, by chance
# Measured numbers for each term from which on a law that held-out sequences have borne out is
# fitted to these too: what judges it then is off by less than 1 / 200 of the noise's variance.
_ROWS_PER_TERM = 200
_STATES = 100  # from which the noise and its growth along an arc are measured
_STEP_ERROR = 0.01  # of a step's own error ÷ the noise


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
    check: Callable[[], Any],
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
    between = steps_between(data.pairs)
    longest = longest_arc(family, c, data.y0[some], data.dt, steps, rms)

    def along(rows) -> Shooting | None:
        rows, pairs = np.sort(rows), data.pairs
        # What was left out is bridged, what is held out is not.
        onward = np.where(np.diff(rows) == 1, between[rows[:-1]], 0)
        arcs = arcs_of(np.asarray(pairs.z0)[rows], np.asarray(pairs.z1)[rows], longest, onward)
        if arcs is None or np.median(arcs.measured.sum(axis=1)) <= _SHORTEST:
            return None
        return Shooting(
            arcs, data.dt, steps, problem.scale, coordinates.angles, resolved=resolved,
            check=check,
        )  # fmt: skip

    train, held = along(data.training), along(data.validation)
    if train is None or held is None:
        return None

    def left(terms, coefficients) -> float:
        """Residuals of the held-out arcs, each from the state that suits it."""
        found = held.fit(terms, coefficients, only_states=True)
        return np.inf if found is None else float(np.linalg.norm(found.noise / problem.scale))

    before, found = left(family, c), train.fit(family, c)
    if found is None or not left(family, found.coefficients) <= _RISE * before:
        return None
    kept = tuple(range(len(c)))
    few = significant(found.triangle, found.coefficients, _CERTAIN)[0]
    if 0 < len(few) < len(c):
        fewer = family.take(tuple(few.tolist()))
        again = train.fit(fewer, found.coefficients[few])
        if again is not None and left(fewer, again.coefficients) <= _RISE * before:
            kept, found, family = tuple(few.tolist()), again, fewer
    if _ROWS_PER_TERM * len(kept) <= found.triangle.rows:
        everyone = along(np.arange(len(data.y0)))
        again = everyone.fit(family, found.coefficients) if everyone is not None else None
        if everyone is not None and again is not None:
            train, found = everyone, again
    return Whole(
        kept, _as_fit(fit, found), found.root, found.noise, len(train.arcs.states),
        _messages(found, int(train.arcs.measured.sum())),
    )  # fmt: skip


def _as_fit(fit: FlowFit, found: Shot) -> FlowFit:
    return fit._replace(
        coefficients=found.coefficients, standard_errors=np.linalg.norm(found.root, axis=0)
    )


def _messages(found: Shot, measured: int) -> tuple[str, ...]:
    if not found.outlying:
        return ()
    return (
        f"{found.outlying} of {measured} measured states lie more than {OPTIONS.outlying:g} times "
        "the noise from the sequences of the law: outliers, they were given little weight",
    )
