"""The chosen map of a fit, fitted anew to more pairs than fit into memory, of many processes.

Each process folds its own rows into one triangle (local QR); triangles are merged in pairs
up a tree, a TSQR (Demmel, Grigori, Hoemmen & Langou, SIAM J. Sci. Comput. 34, 2012), one tree for
S and one for each Gauss–Newton problem of H. The first process solves, and decides alone.
"""

from __future__ import annotations

import dataclasses
import time
import warnings
from collections.abc import Iterable, Sequence
from typing import Any

import jax
import numpy as np

from gfnn_jax.budget import FLOW, RATES, ROWS
from gfnn_jax.candidates.candidate import Candidate, with_error
from gfnn_jax.errors import FitWarning
from gfnn_jax.fitting.gauss_newton import FlowFit
from gfnn_jax.learn.choose import FEWEST_RUNS_TESTED
from gfnn_jax.learn.conclude import not_met
from gfnn_jax.learn.fitted import Fit
from gfnn_jax.learn.refit_rows import RowsOfRefit, fitted_piece
from gfnn_jax.maps.saved import packed, unpacked
from gfnn_jax.maps.symplectic_map import SymplecticMap
from gfnn_jax.models.hamiltonians.fitted_law import Term, formula
from gfnn_jax.models.hamiltonians.learned_law import LearnedHamiltonian
from gfnn_jax.phase_space import Pairs
from gfnn_jax.processes import Group
from gfnn_jax.scenes import Scene

# A pair is an outlier that is missed by so many deviations, which are no smaller than roundoff. A
# million pairs with one at this limit have no worse a fit for it.
_OUTLYING, _ROUNDOFF = 100.0, 1e-14
_OF_TASK = "task "  # before the names of a task, in what processes are told
_PASSES_OF_LAW = 3  # through all pairs: Gauss–Newton steps from coefficients of a sample
_NO_WORSE = 1.1  # a refit whose error is larger by this factor than that of its sample is not kept


def can_be_refitted(map_: SymplecticMap) -> bool:
    """Return whether `refit` knows what to do: S or H is linear in its coefficients. A network is
    not."""
    index = fitted_piece(map_.pieces)
    return index is not None and hasattr(map_.pieces[index].family, "term_gradients")


def why_not(map_: SymplecticMap) -> str:
    """Return why `refit` cannot be done of this map, as a message says it."""
    if fitted_piece(map_.pieces) is None:
        return "there was no time for a better model (a larger --max-seconds gives it)"
    return "a refit needs a family that is linear in its coefficients (polynomial, features, sines)"


def not_refitted(fitted: Fit, why: str) -> Fit:
    """The fit of a sample as it is, with a warning (FitWarning) that says so, and why."""
    message = (
        f"{fitted.chosen.label} is fitted to a sample of {fitted.num_pairs} pairs, not to all of "
        f"them: {why}"
    )
    warnings.warn(message, FitWarning, stacklevel=2)
    return fitted.replaced(messages=(*fitted.messages, message))


def work_of_refit(fitted: Fit, num_pairs: int, reading: float) -> float:
    """Seconds that `refit` takes, about: S goes through all pairs once, a law a few times.

    reading: seconds that reading the pairs once takes.
    """
    chosen, width = fitted.chosen, 2 * fitted.map.dim
    if chosen.learns == "map":
        return reading + 2.0 * num_pairs * width * (chosen.num_parameters + 1) ** 2 / RATES[ROWS]
    of_flow = num_pairs * width * chosen.operations / RATES[FLOW]
    return _PASSES_OF_LAW * (reading + of_flow)


def refit(
    fitted: Fit,
    chunks: Iterable[Pairs],
    held: Pairs,
    *,
    test: Pairs | None = None,
    scene: Scene | None = None,
    group: Group | None = None,
) -> Fit:
    """The chosen map of a fit, of a linear family, with its coefficients from all of these pairs.

    fitted: of a sample of them. chunks: all of the pairs, which need never be in memory together;
    of a law they are gone through once for each Gauss–Newton step. held: pairs that choose the
    ridge, and between the new map and the sample's. test: pairs that state the error; None: those
    held state it too. Both are left out of the fit, as are outliers, which the sample's map misses
    by far, and what the steps of a law do not resolve. Charts, domain and noise remain those that
    the sample gave, and so does the map where all pairs give a worse one. Warns (FitWarning) of
    both, and where the tolerance is missed.

    group: the processes that have the pairs. This one is the first, with chunks of its own; the
    others call `help_refit`. scene: as `maps.saved.save` takes it.
    """
    started = time.perf_counter()
    group = group or Group()
    tolerance = fitted.asked
    messages = [m for m in fitted.messages if m != not_met(fitted.chosen, tolerance, fitted.ended)]

    def warn(message: str) -> None:
        messages.append(message)
        warnings.warn(message, FitWarning, stacklevel=3)

    old, law, map_ = fitted.chosen, fitted.hamiltonian, fitted.map
    most = _OUTLYING * np.maximum(old.deviations, _ROUNDOFF * np.asarray(map_.scale))
    apart = [held] if test is None else [held, test]
    worker = RowsOfRefit(map_, {"most": most, "held": _states_of(apart)})
    apart = [pairs.take(np.flatnonzero(worker.close(pairs))) for pairs in apart]
    held, test = apart[0], apart[-1]
    chosen, better = None, None
    num_pairs, before, after = fitted.num_pairs, old.validation_rms, np.inf
    if len(held) and len(test):
        before = worker.error(map_, held, tolerance).rms
        worker.task["held"] = _states_of(apart)
        worker.task |= worker.resolving(held)
        bare = dataclasses.replace(map_, posterior=None)
        group.broadcast(
            {**packed(bare, scene), **{_OF_TASK + n: v for n, v in worker.task.items()}}
        )
        found = worker.solved(chunks, held, group)
        if found.outliers:
            warn(
                f"{found.outliers} of {found.count + found.outliers} pairs are outliers, with "
                f"residuals above {_OUTLYING:g} standard deviations: they are left out"
            )
        if found.other_dt:
            warn(
                f"{found.other_dt} of {found.count + found.outliers + found.other_dt} pairs are "
                f"not dt = {float(map_.dt):g} apart: they are left out"
            )
        if found.unresolved:
            warn(
                f"{found.unresolved} of {found.count} pairs, as of close passages, are not "
                "resolved by the steps of the law: they are left out"
            )
        if found.map is not None:
            after = worker.error(found.map, held, tolerance).rms
            # Test pairs of few runs did not state the sample's error either, which then stands.
            few = test.run is not None and len(np.unique(test.run)) < FEWEST_RUNS_TESTED
            candidate = old if few else with_error(old, worker.error(found.map, test, tolerance))
            chosen = dataclasses.replace(candidate, train_rms=found.train_rms)
            better = found.map
            num_pairs = found.count
    else:
        group.broadcast({})
    if chosen is None or not after <= _NO_WORSE * before:
        found_map = "no map" if chosen is None else f"a worse map (RMS error {after:.2e})"
        warn(
            f"the fit to all pairs gives {found_map}: that of the sample (RMS error {before:.2e} "
            "in the data's units) is kept"
        )
        chosen, num_pairs = old, fitted.num_pairs
    elif law is not None and found.law is not None and old.learns == "hamiltonian":
        law = _with_coefficients(law, found.law, chosen)
    if chosen.validation_bound > fitted.tolerance:
        warn(not_met(chosen, tolerance, fitted.ended))
    return fitted.replaced(
        map=map_ if chosen is old else better,
        candidates=tuple(chosen if c.chosen else c for c in fitted.candidates),
        num_pairs=num_pairs,
        seconds=fitted.seconds + time.perf_counter() - started,
        hamiltonian=law,
        messages=tuple(messages),
    )


def _states_of(parts: Sequence[Pairs]) -> np.ndarray:
    """The states z0 of all parts, one after the other."""
    return np.concatenate([np.asarray(pairs.z0) for pairs in parts])


def help_refit(
    opening: dict[str, Any], chunks: Iterable[Pairs], group: Group, *, scene: Scene | None = None
) -> int:
    """The part of another process than the first in `refit`: how many pairs it has given.

    opening: what `refit` broadcasts first; empty where there is nothing to be done. chunks: of the
    pairs that are this process's own.
    """
    if not opening:
        return 0
    task = {n.removeprefix(_OF_TASK): v for n, v in opening.items() if n.startswith(_OF_TASK)}
    rest = {n: v for n, v in opening.items() if not n.startswith(_OF_TASK)}
    worker = RowsOfRefit(jax.device_put(unpacked(rest, scene)), task)
    own = worker.answer(chunks, group.broadcast())
    while True:
        group.folded(own, worker.merged)
        wanted = group.broadcast()
        if not wanted:
            return int(own["count"])
        own = worker.answer(chunks, wanted)


def _with_coefficients(
    law: LearnedHamiltonian, fit: FlowFit, candidate: Candidate
) -> LearnedHamiltonian:
    """The law with the coefficients of this fit."""
    names = [term.term for term in law.terms]
    errors = fit.standard_errors.tolist()
    terms = tuple(
        Term(*entry) for entry in zip(names, fit.coefficients.tolist(), errors, strict=True)
    )
    flow = dataclasses.replace(law.flow, params=fit.coefficients)
    text = getattr(flow.family, "prefix", "") + formula(terms)
    return dataclasses.replace(law, flow=flow, terms=terms, shown=text, candidate=candidate)
