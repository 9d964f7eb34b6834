"""Zeros of sensors that differ from run to run.

    y = g(x) + b_r + noise      in run r

An encoder is often set to zero where a run begins; where friction holds an arm it does not begin at
the same place. Residuals are linear in b_r, as they are in the coefficients of the law, so that one
evaluation of the arcs tells both. The zeros are taken off where arcs that neither was found from
are followed better with a b_r for each run than with one for all. Of a run that is yet to come the
zero is known as well as they scatter: the law keeps their mean only where that is significant.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence

import numpy as np

from gfnn_jax.dataset.stretches import Nodes, arcs_of, shifted, with_states
from gfnn_jax.models.lagrangians.arcs import LawOnArcs
from gfnn_jax.models.lagrangians.fit import FOLDS, LawFit, Workbench
from gfnn_jax.solve.latent_arcs import Defects, Observed, Readings
from gfnn_jax.solve.noise import Wander

_FEWEST = 3  # runs: two tell one difference, and no scatter
_GAIN = 0.05  # of the held-out cost, that zeros of runs have to bring, as terms have
_SIGNIFICANT = 4.0  # standard errors of the mean of the runs' zeros, as of a term
_RCOND = 1e-6  # a zero that moves residuals less than this, the motion follows


def with_zeros_of_runs(
    bench: Workbench, nodes: Sequence[Nodes], fit: LawFit, on_progress: Callable[[str], object]
) -> tuple[list[Nodes], LawFit]:
    """The nodes with the states of a fit, and the fit: with zeros of their runs taken off, and
    fitted anew, where they have some."""
    nodes = with_states(nodes, fit.arcs, fit.fitted.x)
    names = sorted({n.stretch.run for n in nodes})
    if len(names) < _FEWEST or not bench.observation.is_plain or not np.isfinite(fit.fitted.cost):
        return nodes, fit
    found = _found(bench, nodes, fit, names)
    if found is None:
        return nodes, fit
    before = {n.stretch.run: n.zero for n in nodes}
    zeros = found + np.array([before[name] for name in names]) + fit.zeros
    mean, size = zeros.mean(axis=0), np.std(zeros, axis=0, ddof=1)
    of_law = np.isin(range(len(mean)), fit.structure.zeros)
    of_law &= np.abs(mean) > _SIGNIFICANT * size / np.sqrt(len(names))
    mean = np.where(of_law, mean, 0.0)
    known = fit.values | {("zero", i): float(mean[i]) for i in fit.structure.zeros}
    further = {n: z - mean - before[n] for n, z in zip(names, zeros, strict=True)}
    nodes = shifted(nodes, further)
    arcs = arcs_of(nodes, fit.arcs.t.shape[1])
    fit = bench.fit(fit.structure, known, arcs, fit.sigma)
    sizes = ", ".join(f"{s:.3g}" for s in size)
    on_progress(f"zeros that differ from run to run by {sizes}")
    return with_states(nodes, fit.arcs, fit.fitted.x), fit


def wander_of_runs(nodes: Sequence[Nodes], noise: np.ndarray) -> Wander | None:
    """The scatter of the zeros of runs about that of the law, in units of the ``noise`` (k,) of
    their channels; None where they are the same."""
    zeros = np.array(list({n.stretch.run: n.zero for n in nodes}.values()))
    if not zeros.any():
        return None
    scatter = np.sum(zeros**2, axis=0) / (len(zeros) - 1)
    return Wander(float(np.sqrt(np.mean(scatter / noise**2))), np.inf)


def _found(
    bench: Workbench, nodes: Sequence[Nodes], fit: LawFit, names: Sequence[str]
) -> np.ndarray | None:
    """Zeros (runs, k) beside those of the nodes and of the law; None where held-out arcs do not
    gain by them."""
    arcs, p = fit.arcs, fit.p
    runs = np.array([names.index(nodes[i].stretch.run) for i, _, _ in arcs.home])
    k = arcs.y.shape[-1]
    model = _ByRun(bench.model(fit.structure, arcs, p, np.arange(len(p))), runs, len(names))
    start = np.concatenate([p, np.zeros(len(names) * k)])
    noise = fit.sigma * arcs.noise
    readings = Readings(model, arcs.y, noise, bench.observation.loss)
    rows = readings.rows(start, fit.fitted.x)
    rows = rows.reshape(len(rows), -1, rows.shape[-1])
    own, of_runs, left = np.split(rows, [len(p), len(start)], axis=-1)
    keys = fit.structure.keys()
    own = own[..., [key[0] != "zero" for key in keys]]
    own = own / np.maximum(np.linalg.norm(own, axis=(0, 1)), 1e-300)
    unit = np.linalg.norm(left)
    of_runs = of_runs / unit
    common = of_runs.reshape(*of_runs.shape[:2], len(names), k).sum(axis=2)
    together, apart = (np.concatenate([own, z], axis=-1) for z in (common, of_runs))
    if not _held_out(apart, left) < (1 - _GAIN) * _held_out(together, left):
        return None
    return _solved(apart, left)[own.shape[-1] :].reshape(len(names), k) / unit


def _held_out(columns: np.ndarray, left: np.ndarray) -> float:
    """The sum of squares of residuals (A, N, 1) of arcs, by columns (A, N, n) that are solved for
    from the others: neighbours are in different folds, so that each run is in all."""
    cost, fold = 0.0, np.arange(len(columns)) % FOLDS
    for k in range(FOLDS):
        held = fold == k
        found = _solved(columns[~held], left[~held])
        cost += float(np.sum((left[held] - columns[held] @ found) ** 2))
    return cost


def _solved(columns: np.ndarray, left: np.ndarray) -> np.ndarray:
    flat = columns.reshape(-1, columns.shape[-1])
    return np.linalg.lstsq(flat, left.reshape(-1, 1), rcond=_RCOND)[0]


@dataclasses.dataclass(frozen=True, eq=False)
class _ByRun:
    """A law on arcs of ``runs`` (A,) with further coefficients: zeros of the channels, run by
    run."""

    law: LawOnArcs
    runs: np.ndarray
    count: int

    def defects(self, p: np.ndarray, x: np.ndarray) -> Defects:
        steps = self.law.defects(p[: len(self.law.free)], x)
        more = np.zeros((*steps.closing.shape, len(p) - len(self.law.free)))
        by = np.concatenate([steps.by_coefficients, more], axis=-1)
        return steps._replace(by_coefficients=by)

    def observe(self, p: np.ndarray, x: np.ndarray) -> Observed:
        shown = self.law.observe(p[: len(self.law.free)], x)
        k = shown.values.shape[-1]
        of_runs = np.eye(self.count)[self.runs]  # (A, runs)
        more = of_runs[:, None, :, None] * np.eye(k)[:, None, :]  # (A, k, runs, k)
        more = np.broadcast_to(
            more.reshape(len(x), 1, k, -1), (*shown.values.shape, k * self.count)
        )
        return shown._replace(
            values=shown.values + more @ p[len(self.law.free) :],
            by_coefficients=np.concatenate([shown.by_coefficients, more], axis=-1),
        )

    def take(self, arcs: np.ndarray) -> _ByRun:
        return dataclasses.replace(self, law=self.law.take(arcs), runs=self.runs[arcs])
