"""Zeros of sensors that differ from run to run, or wander.

    y = g(x) + b_r + noise      in run r

An encoder is often set to zero where a run begins; where friction holds an arm it does not begin at
the same place. Residuals are linear in b_r, as they are in the coefficients of the law, so that one
evaluation of the arcs tells both. The zeros are taken off where arcs that neither was found from
are followed better with a b_r for each run than with one for all. Of a run that is yet to come the
zero is known as well as they scatter: the law keeps their mean only where that is significant.

Zeros that wander make residuals alike in time (`solve.noise`). Of rows X of all that was fitted,
states and coefficients, and residuals r with covariance σ² C, N of them less M fitted numbers,

    2 log likelihood = −(N − M) log rᵀ C⁻¹ r − log |C| − log |Xᵀ C⁻¹ X|

with σ at its best and r what C⁻¹ leaves (Harville, J. Am. Stat. Assoc. 72 (1977) 320). A law that
is wrong colours residuals too: what is found here is a candidate, and held-out forecasts judge it.
"""

import dataclasses
from collections.abc import Sequence
from functools import cache

import numpy as np

from gfnn_jax.dataset.stretches import Nodes, arcs_of, shifted
from gfnn_jax.fitting.evidence import Comparison
from gfnn_jax.fitting.triangle import Triangle
from gfnn_jax.models.lagrangians.fit import FOLDS, LawFit
from gfnn_jax.solve.noise import Wander


class Options:
    """Options of the search for zeros of channels (`benchmarks/measured.py`).

    fewest: runs, since two tell one difference and no scatter. rank: a zero that moves residuals
    less than this, to the most, the motion follows. factors: by which size and time of a wander are
    searched. sizes: in units of the noise. times: in periods of the fastest motion.
    """

    fewest: int = 3
    rank: float = 1e-6
    factors: tuple[float, ...] = (2.0, 1.4)
    sizes: tuple[float, float] = (0.1, 30.0)
    times: tuple[float, float] = (0.1, 10.0)


def with_zeros_of_runs(fit: LawFit) -> LawFit:
    """The fit, with zeros of its runs taken off, and fitted anew, where they have some."""
    problem, evidence = fit.problem, fit.problem.options.evidence
    names = sorted({n.stretch.run for n in problem.nodes})
    plain = problem.observation.is_plain
    if len(names) < Options.fewest or not plain or not fit.follows:
        return fit
    found = _zeros_of_runs(fit, names)
    if found is None:
        return fit
    before = {n.stretch.run: n.zero for n in problem.nodes}
    zeros = found + np.array([before[name] for name in names]) + fit.zeros
    mean, size = zeros.mean(axis=0), np.std(zeros, axis=0, ddof=1)
    of_law = np.isin(range(len(mean)), fit.structure.zeros)
    of_law &= np.abs(mean) > evidence.significant * size / np.sqrt(len(names))
    mean = np.where(of_law, mean, 0.0)
    known = fit.values | {("zero", i): float(mean[i]) for i in fit.structure.zeros}
    further = {n: z - mean - before[n] for n, z in zip(names, zeros, strict=True)}
    problem = dataclasses.replace(problem, nodes=shifted(problem.nodes, further))
    arcs = arcs_of(problem.nodes, fit.arcs.t.shape[1])
    sizes = ", ".join(f"{s:.3g}" for s in size)
    problem.on_progress(f"zeros that differ from run to run by {sizes}")
    return fit.again(known=known, arcs=arcs, problem=problem)


def wander_of_runs(nodes: Sequence[Nodes], noise: np.ndarray) -> Wander | None:
    """The scatter of the zeros of runs about that of the law, in units of the ``noise`` (k,) of
    their channels; None where they are the same."""
    zeros = np.array(list({n.stretch.run: n.zero for n in nodes}.values()))
    if not zeros.any():
        return None
    scatter = np.sum(zeros**2, axis=0) / (len(zeros) - 1)
    return Wander(float(np.sqrt(np.mean(scatter / noise**2))), np.inf)


def _zeros_of_runs(fit: LawFit, names: Sequence[str]) -> np.ndarray | None:
    """Zeros (runs, k) beside those of the nodes and of the law; None where held-out arcs do not
    gain by them. Neighbouring arcs are in different folds, so that each run is in all."""
    nodes, k = fit.problem.nodes, fit.arcs.y.shape[-1]
    runs = np.array([names.index(nodes[i].stretch.run) for i, _, _ in fit.arcs.home])
    rows, weights = _rows(fit)
    count, m, n = len(rows), fit.fitted.x.shape[-1], len(fit.p)
    common = (weights[..., None] * np.eye(k)).reshape(count, -1, k)
    apart = (np.eye(len(names))[runs][:, None, :, None] * common[:, :, None]).reshape(
        *common.shape[:2], -1
    )
    Q = np.linalg.qr(rows[..., :m])[0]
    rows, common, apart = (a - Q @ (Q.swapaxes(1, 2) @ a) for a in (rows[..., m:], common, apart))
    own, left = rows[..., :n], rows[..., n:]
    own = own[..., [key[0] != "zero" for key in fit.structure.keys()]]  # noqa: SIM118
    own = own / np.maximum(np.linalg.norm(own, axis=(0, 1)), 1e-300)
    unit = np.linalg.norm(left)
    together, alone = (np.concatenate([own, z / unit, left], axis=-1) for z in (common, apart))
    costs = map(_held_out, (alone, together))
    if not Comparison.of(*costs).is_lower(fit.problem.options.evidence.gain):
        return None
    return _solved(alone)[own.shape[-1] :].reshape(len(names), k) / unit


def _held_out(rows: np.ndarray) -> np.ndarray:
    """The sum of squares (A,) of residuals of arcs, by columns of rows (A, N, n + 1) that are
    solved for from other arcs."""
    costs, fold = np.zeros(len(rows)), np.arange(len(rows)) % FOLDS
    for k in range(FOLDS):
        missed = rows[fold == k] @ np.append(-_solved(rows[fold != k]), 1.0)
        costs[fold == k] = np.sum(missed**2, axis=1)
    return costs


def _solved(rows: np.ndarray) -> np.ndarray:
    flat = rows.reshape(-1, rows.shape[-1])  # in units of the rows: see `Options.rank`
    return np.linalg.lstsq(flat[:, :-1], flat[:, -1], rcond=Options.rank)[0]


def wander_of(fit: LawFit) -> Wander | None:
    """The wander of the channels' zeros that the residuals of a fit show; None where they are
    white."""
    arcs, m = fit.arcs, fit.fitted.x.shape[-1]
    rows, weights = _rows(fit)
    with np.errstate(divide="ignore"):
        noise = 1 / (weights * fit.sigma)
    free = int(np.isfinite(arcs.y).sum()) - len(rows) * m - len(fit.p)
    rows, period = rows.reshape(*arcs.y.shape, -1), fit.problem.scales.period

    @cache
    def likelihood(size: float, periods: float) -> float:
        mixed, logs = Wander(size, periods * period).whitened(arcs.t, noise, rows)
        return _likelihood(mixed, m, free) + logs

    here, best = (1.0, 1.0), likelihood(1.0, 1.0)
    for step in Options.factors:
        moved = True
        while moved:
            moved = False
            for factors in ((step, 1), (1 / step, 1), (1, step), (1, 1 / step)):
                size = float(np.clip(here[0] * factors[0], *Options.sizes))
                periods = float(np.clip(here[1] * factors[1], *Options.times))
                found = likelihood(size, periods)
                if found > best + 0.01:
                    here, best, moved = (size, periods), found, True
    if best < _likelihood(rows, m, free) + fit.problem.options.evidence.logarithm:
        return None
    return Wander(here[0], here[1] * period)


def _rows(fit: LawFit) -> tuple[np.ndarray, np.ndarray]:
    """Weighted rows (A, L k, m + n + 1) of states, coefficients and residuals, and what a change of
    one of a channel's values does to them (A, L, k): its weight over its noise."""
    problem, arcs = fit.problem, fit.arcs
    readings = problem.readings(problem.law(fit.structure, arcs, fit.p), arcs, fit.sigma)
    noise = fit.sigma * arcs.noise
    weights = problem.observation.loss.weights(fit.fitted.residuals * fit.fitted.sigma / noise)
    weights = np.where(np.isfinite(arcs.y), np.sqrt(weights) / noise, 0.0)
    return readings.linearised(fit.p, fit.fitted.x)[0], weights


def _likelihood(rows: np.ndarray, m: int, free: int) -> float:
    """The part of the likelihood that whitened rows (A, L, k, m + n + 1) tell."""
    R = np.asarray(np.linalg.qr(rows.reshape(len(rows), -1, rows.shape[-1]), mode="r"))
    rest = Triangle.of(R[:, m:, m:].reshape(-1, rows.shape[-1] - m)).factor
    left = _log_diagonal(R[:, :m, :m]) + _log_diagonal(rest[:-1, :-1])
    return float(-free * np.log(max(abs(rest[-1, -1]), 1e-300)) - left)


def _log_diagonal(matrices: np.ndarray) -> float:
    diagonal = np.abs(np.diagonal(matrices, axis1=-2, axis2=-1))
    return float(np.sum(np.log(np.maximum(diagonal, 1e-300))))
