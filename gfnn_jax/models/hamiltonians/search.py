"""Learn H: the Hamiltonian whose flow over dt maps z₀ to z₁, as a formula of few terms.

H = Σ c_j φ_j(z), and c minimises the mean of ‖Φ_h(z₀; c) − z₁‖² over the pairs, Φ_h the flow of
ż = J ∇H over h = dt by Gauss collocation (`fitting.gauss_newton`, from linear starts).

Libraries of terms are tried by rising size, each from the one before, until one meets the
tolerance; where there are angles, one library grows mode by mode. Terms that are nothing but noise
go while the held-out error does not rise.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np

from gfnn_jax.budget import UNBOUNDED, Budget
from gfnn_jax.dataset.dataset import Dataset
from gfnn_jax.dataset.measured_error import Tolerance
from gfnn_jax.dataset.split import outermost
from gfnn_jax.errors import FitError, OutOfTime
from gfnn_jax.families.terms import Terms
from gfnn_jax.fitting.gauss_newton import Problem
from gfnn_jax.flows.rates import MOST_SUBSTEPS
from gfnn_jax.models.hamiltonians.arcs import arcs_of
from gfnn_jax.models.hamiltonians.centrifugal import centrifugal_terms
from gfnn_jax.models.hamiltonians.covariance import covariance_root
from gfnn_jax.models.hamiltonians.fewer_terms import (
    ROUNDOFF,
    of_whole_sequences,
    refitted,
    sparse,
    without_noise,
)
from gfnn_jax.models.hamiltonians.fitted_law import FittedLaw
from gfnn_jax.models.hamiltonians.formula import OnPartial
from gfnn_jax.models.hamiltonians.friction import mechanical
from gfnn_jax.models.hamiltonians.friction_kinds import is_smooth, without_turns
from gfnn_jax.models.hamiltonians.law_candidate import learned_from
from gfnn_jax.models.hamiltonians.learned_law import LearnedHamiltonian
from gfnn_jax.models.hamiltonians.libraries import (
    check_finite,
    modes_of,
    own_terms,
)
from gfnn_jax.models.hamiltonians.library_search import is_exact, of_libraries, small_polynomials
from gfnn_jax.models.hamiltonians.noisy_textbook import law_of_sequences
from gfnn_jax.models.hamiltonians.options import OPTIONS, LawOptions
from gfnn_jax.models.hamiltonians.steps_of_law import validation_error
from gfnn_jax.models.hamiltonians.symmetries import imposed
from gfnn_jax.models.hamiltonians.textbook import law_of_physics
from gfnn_jax.models.hamiltonians.work import LawWork


def learn_hamiltonian(
    data: Dataset,
    tolerance: Tolerance,
    scene: Any = None,
    *,
    terms: Sequence[str | Callable] = (),
    budget: Budget | None = None,
    on_progress: Callable[[str], Any] = lambda message: None,
    options: LawOptions = OPTIONS,
    dearest: float = np.inf,
    partly: OnPartial = lambda law: None,
) -> LearnedHamiltonian:
    """The Hamiltonian of these pairs: the smallest library that meets the tolerance, else the best.

    data: without a base map. scene: lends its features and reversor. terms: a user's own.
    dearest: as of `LawWork`. partly: called with laws of physics that explain a part, where none
    explains all.

    Raises FitError where no library can be tried, OutOfTime where the budget ends before the first.
    """
    basis = modes_of(data, scene, terms)
    if basis is not None and not terms:
        own = centrifugal_terms(data, data.training, basis.terms(basis.box()))
        basis = modes_of(data, scene, own)
    budget = budget or Budget()
    if data.before or data.after:
        raise FitError("expected pairs without a base map: it is no part of a flow")
    started = time.perf_counter()
    if terms and data.structure is None:
        check_finite(own_terms(data, terms), data, data.training)
    most = options.max_operations if basis is None else options.mode_operations
    if not terms and scene is None:
        problem = Problem(
            data.y0, data.y1, data.each_dt, data.scale, args=data.args, weight=data.weight
        )
        own = LawWork(problem, budget, most, dearest)
        whole = law_of_sequences(problem, own, data, tolerance, on_progress, partly)
        if whole is not None:
            seconds = time.perf_counter() - started
            problem.allowance = UNBOUNDED
            found = learned_from(whole, problem, data, tolerance, seconds, options, None)
            for note in found.notes:
                on_progress(note)
            return found
    of_steps, arcs = data, arcs_of(data)
    if arcs is not None:
        on_progress(f"H: fitting arcs of {arcs.length} steps, for single steps are too noisy")
        data = arcs.data
    problem = Problem(
        data.y0, data.y1, data.each_dt, data.scale, args=data.args, weight=data.weight
    )
    work = LawWork(problem, budget, most, dearest)
    everywhere, free = data, (*data.coordinates.cyclic, *data.whole)
    if data.structure is None:
        outer = outermost(data.y0[data.training], free)
    else:  # a state of many sites is in the middle and far out at once
        outer = np.zeros(len(data.training), bool)
    data = everywhere.trained_on(everywhere.training[~outer])
    best, options = _best_law(
        problem, work, basis, data, tolerance, scene, terms, options, on_progress, partly
    )
    _check_resolved(problem, best, data)
    far = everywhere.training[outer]
    best, outside = _simplified(
        problem, work, best, data, everywhere, far, tolerance, options, on_progress
    )
    problem.allowance, of_arcs = UNBOUNDED, None
    if arcs is not None:
        of_arcs = partial(covariance_root, best, problem, everywhere, best.fit.steps)
        everywhere = of_steps
        problem = Problem(
            of_steps.y0, of_steps.y1, of_steps.dt, of_steps.scale, weight=of_steps.weight
        )
        best = best._replace(error=validation_error(best.family, best.fit, of_steps, tolerance))
    if best.noisy or arcs is not None:
        best = _along_sequences(problem, work, best, everywhere, tolerance, on_progress)
    best = _with_symmetries(best, everywhere)
    seconds = time.perf_counter() - started
    learned = learned_from(best, problem, everywhere, tolerance, seconds, options, of_arcs)
    candidate = dataclasses.replace(learned.candidate, outside=outside)
    return dataclasses.replace(learned, candidate=candidate, ended=work.ended)


def _best_law(
    problem,
    work: LawWork,
    basis,
    data: Dataset,
    tolerance: Tolerance,
    scene,
    terms,
    options: LawOptions,
    on_progress,
    partly: OnPartial,
) -> tuple[FittedLaw, LawOptions]:
    """The law of the smallest polynomials, of physics, of a mechanical system or of the libraries,
    the first within the tolerance, else the best; and the options for fewer terms."""
    with_masses, best, early = None, None, list[FittedLaw]()
    if not terms and scene is None:
        if basis is None and data.args is None and data.structure is None:
            early = small_polynomials(problem, work, data, tolerance, options, on_progress)
            best = early[-1] if early and is_exact(early[-1], tolerance) else None
        if best is None:
            best = law_of_physics(problem, work, data, tolerance, on_progress, partly)
        if best is None:
            best = with_masses = mechanical(problem, work, data, tolerance)
    if best is None or not best.error.bound <= tolerance.bound:
        try:
            best, options = of_libraries(
                problem, work, basis, data, tolerance, scene, terms, options, on_progress, early
            )
        except (OutOfTime, FitError):
            if best is None:
                raise
        if with_masses is not None and with_masses.error.relative <= best.error.relative:
            best = with_masses._replace(noisy=True)
    return best, options


def _check_resolved(problem, best: FittedLaw, data: Dataset) -> None:
    """Raise FitError where one dt of this law takes more substeps than a flow may have."""
    everyone = np.arange(len(data)) if is_smooth(best.family) else best.rows
    if problem.substeps_for(best.family, best.fit.coefficients, everyone) >= MOST_SUBSTEPS:
        raise FitError(
            f"the H found is too fast: one dt needs {MOST_SUBSTEPS} substeps or more. Use a "
            "smaller dt; if the pairs are of a map without a flow, use --learn map (learn='map')"
        )


def _simplified(
    problem,
    work: LawWork,
    best: FittedLaw,
    data: Dataset,
    whole: Dataset,
    far: np.ndarray,
    tolerance: Tolerance,
    options: LawOptions,
    on_progress,
) -> tuple[FittedLaw, float | None]:
    """The law without the terms that are noise or not asked for, fitted to all training pairs, as
    far as the budget goes; and its error at the outermost states, of a fit without them.

    data: without the outermost states ``far``. whole: with them.
    """
    outside, what, law = None, "", (best.family, best.fit.coefficients)
    data, everywhere, there = (
        without_turns(rows, *law) for rows in (data, whole, whole.validated_on(far))
    )
    try:
        if best.noisy:
            what = "dropping the terms of H that are noise"
            work.uncapped()  # what is pruned is soon fitted
            with work.again(what, (best.larger or best).family, len(data.training)):
                best = without_noise(problem, best, data.training, data, tolerance, options)
        what = "dropping the terms of H that the pairs do not ask for"
        with work.again(what, best.family, len(best.fit.used)):
            best = sparse(problem, best, data, tolerance, options, on_progress)
        if len(there.validation) and len(far):
            outside = validation_error(best.family, best.fit, there, tolerance).relative
        misses = best.error.bound > tolerance.bound and np.isfinite(work.dearest)
        few = len(best.fit.used) < len(everywhere.training)
        if best.error.relative > ROUNDOFF and few and not misses:
            what = "the fit of H to all pairs"
            with work.again(what, best.family, len(everywhere.training)):
                best = refitted(problem, best, everywhere.training, data, tolerance)
    except OutOfTime:  # what was found stands
        work.budget.leave_out(what, work.ended)
    return best, outside


def _along_sequences(
    problem, work: LawWork, best: FittedLaw, data: Dataset, tolerance: Tolerance, on_progress
) -> FittedLaw:
    """The law fitted to whole sequences, where it misses the tolerance and is smooth: |v|v and
    sign v are not where sequences turn."""
    if not (is_smooth(best.family) and best.error.bound > tolerance.bound):
        return best
    what, budget = "the fit of H to whole sequences", work.budget
    on_progress("H: fitting whole sequences")
    try:
        with work.again(what, best.family, len(data.training)):
            return of_whole_sequences(problem, best, data, tolerance, budget)
    except OutOfTime:
        budget.leave_out(what, budget.ended)
    except np.linalg.LinAlgError as error:
        budget.leave_out(what, f"its linear algebra failed: {error}")
    return best


def _with_symmetries(best: FittedLaw, data: Dataset) -> FittedLaw:
    """The law with the symmetries that it has to roundoff imposed to the last bit."""
    if isinstance(best.family, Terms) and data.args is None and best.error.relative <= ROUNDOFF:
        c, deviations = best.fit.coefficients, best.fit.standard_errors
        z = data.y0[data.validation]
        c = imposed(best.family, c, deviations, z, data.coordinates.angles)
        best = best._replace(fit=best.fit._replace(coefficients=c))
    return best
