"""The error that a fit states: that of the chosen map, on pairs that chose nothing.

The test pairs are looked at here for the first time, after everything is chosen, and once. Where
the pairs were too few to keep some apart, the chosen model is fitted anew without each fifth
of the blocks in turn, and errs on that fifth.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import numpy as np

from gfnn_jax.coordinates import to_user
from gfnn_jax.dataset.measured_error import measured_error
from gfnn_jax.fitting.gauss_newton import Problem
from gfnn_jax.flows.collocation import Steps
from gfnn_jax.learn.assemble import stepped
from gfnn_jax.learn.candidates import Candidate, with_error
from gfnn_jax.learn.choose import Chosen
from gfnn_jax.learn.network_sweep import NetworkSweep
from gfnn_jax.learn.search import Entry
from gfnn_jax.learn.searches import Searched

_FOLDS = 5

# rows that are left out -> images (n, 2d) of them in the user's coordinates, NaN where a step fails
Predicts = Callable[[np.ndarray], np.ndarray]


class Stated(NamedTuple):
    """The candidate with the error that is stated. by: "test", pairs that chose nothing;
    "cross-validation"; or "validation", pairs that chose too, where the model is neither a linear
    S nor an H. pairs, blocks: how many it is measured by."""

    candidate: Candidate
    by: str
    pairs: int
    blocks: int

    @property
    def words(self) -> str:
        """What the error was measured by, as text."""
        count = f"{self.pairs:,} pairs"
        if self.blocks < self.pairs:
            count += f" of {self.blocks:,} independent stretches"
        if self.by == "test":
            return f"{count} that took no part in the fit or its choices"
        if self.by == "cross-validation":
            return f"{count}, each predicted by a fit without its fifth (cross-validation)"
        return f"{count} that also chose the model"


def stated(chosen: Chosen, found: Searched) -> Stated:
    """The chosen candidate with its error on the test pairs, or by cross-validation."""
    data, candidate = found.data, chosen.candidate
    block = data.split.stretch
    if len(data.test):
        rows, by = data.test, "test"
        images = _images_of(chosen, found, rows)
    else:
        by, predicts = "cross-validation", _predictor(chosen, found)
        rows = np.concatenate([data.training, data.validation])
        if predicts is None:
            held = data.validation
            return Stated(candidate, "validation", len(held), _count(block, held))
        folds = np.array_split(np.unique(block[rows]), min(_FOLDS, _count(block, rows)))
        out = [rows[np.isin(block[rows], fold)] for fold in folds]
        rows, images = np.concatenate(out), np.concatenate([predicts(part) for part in out])
    error = measured_error(data, found.tolerance, images, rows)
    return Stated(with_error(candidate, error), by, len(rows), _count(block, rows))


def _count(block: np.ndarray, rows: np.ndarray) -> int:
    return len(np.unique(block[rows]))


def _images_of(chosen: Chosen, found: Searched, rows: np.ndarray) -> np.ndarray:
    """By the steps that users run; in NumPy where the budget had no room for compiling them."""
    candidate, data, entry = chosen.candidate, chosen.data, chosen.entry
    pairs = found.data.pairs.take(rows)
    if candidate.microseconds_per_step is None and found.linear is not None:
        images = data.y0[rows]
        for piece in jax.tree.map(np.asarray, candidate.map.pieces):
            images = piece.image(images)
        return to_user(data.coordinates, images)
    sweep = None if entry is None else entry.sweep
    own = sweep is not None and sweep.data.pairs is found.data.pairs
    if candidate.microseconds_per_step is None and entry is not None and own:
        images, solved = entry.sweep.images(entry.size, rows)
        images = data.whole_image(np.where(solved[:, None], images, np.nan))
        return to_user(data.coordinates, images)
    steps = stepped(candidate.map, np.asarray(pairs.z0), pairs.dt, pairs.args, timed=False)
    return np.where(steps.failed[:, None], np.nan, steps.images)


def _predictor(chosen: Chosen, found: Searched) -> Predicts | None:
    """Fits the chosen model to all pairs but some, and predicts these; None where that is not
    known how."""
    entry, law = chosen.entry, found.law
    if entry is not None:
        return _of_entry(entry) if entry.sweep.data.pairs is found.data.pairs else None
    flow = law is not None and chosen.candidate.learns == "hamiltonian" and law.terms
    return _of_law(found) if flow else None


def _of_entry(entry: Entry) -> Predicts | None:
    sweep = entry.sweep
    if isinstance(sweep, NetworkSweep):  # each would be trained as long as the first
        return None
    everyone = np.concatenate([sweep.data.training, sweep.data.validation])
    return lambda rows: sweep.predicted(entry.size, np.setdiff1d(everyone, rows), rows)


def _of_law(found: Searched) -> Predicts:
    data, law = found.data, found.law
    assert law is not None
    flow = law.flow
    problem = Problem(data.y0, data.y1, data.each_dt, data.scale, args=data.args)
    steps = Steps(flow.stages, flow.over(np.max(data.each_dt)).substeps)
    coefficients = np.asarray(flow.params)

    def predicts(rows: np.ndarray) -> np.ndarray:
        others = np.setdiff1d(np.arange(len(data)), rows)
        fit = problem.fit(flow.family, coefficients, others, rounds=False, steps=steps)
        images = problem.images(flow.family, fit.coefficients, rows, steps)
        return to_user(data.coordinates, images.states)

    return predicts
