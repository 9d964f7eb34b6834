"""Learn H: the Hamiltonian whose flow over dt maps z₀ to z₁, as a formula of few terms.

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

from gfnn_jax.budget import UNBOUNDED, Allowance, Budget
from gfnn_jax.coordinates import to_user
from gfnn_jax.dataset.dataset import Dataset
from gfnn_jax.dataset.measured_error import OneStepError, Tolerance, measured_error
from gfnn_jax.dataset.split import outermost
from gfnn_jax.dataset.structures import Bodies
from gfnn_jax.errors import FitError, OutOfTime
from gfnn_jax.families.modes import Modes
from gfnn_jax.families.terms import Terms
from gfnn_jax.fitting.gauss_newton import Problem
from gfnn_jax.fitting.growth import grow
from gfnn_jax.fitting.significance import null_terms, significant_terms, told_from_noise
from gfnn_jax.flows.rates import MOST_SUBSTEPS
from gfnn_jax.models.hamiltonians.arcs import arcs_of
from gfnn_jax.models.hamiltonians.centrifugal import centrifugal_terms
from gfnn_jax.models.hamiltonians.covariance import covariance_root
from gfnn_jax.models.hamiltonians.fitted_law import Dropped, FittedLaw
from gfnn_jax.models.hamiltonians.formula import OnPartial
from gfnn_jax.models.hamiltonians.friction import (
    Forces,
    beside_friction,
    libraries_with,
    mechanical,
)
from gfnn_jax.models.hamiltonians.friction_kinds import is_smooth, without_turns
from gfnn_jax.models.hamiltonians.law_candidate import learned_from
from gfnn_jax.models.hamiltonians.learned_law import LearnedHamiltonian
from gfnn_jax.models.hamiltonians.libraries import (
    angles_and_others,
    check_finite,
    libraries_of,
    modes_of,
    own_terms,
    promising,
)
from gfnn_jax.models.hamiltonians.noisy_textbook import law_of_sequences
from gfnn_jax.models.hamiltonians.options import OPTIONS, Options
from gfnn_jax.models.hamiltonians.starts import starts
from gfnn_jax.models.hamiltonians.steps_of_law import bound_of, validation_error
from gfnn_jax.models.hamiltonians.symmetries import imposed
from gfnn_jax.models.hamiltonians.textbook import law_of_physics
from gfnn_jax.models.hamiltonians.whole_sequences import fitted_to_sequences
from gfnn_jax.models.hamiltonians.work import LawWork
from gfnn_jax.models.hamiltonians.worth import too_dear
from gfnn_jax.models.parameters import functions_of_parameters, state_libraries, walked

_ROUNDOFF = 1e-12  # of the spread: above it the pairs carry noise, and every one of them counts
_HOPELESS = 10.0  # times the tolerance, of an error that is known before a library is fitted
# Libraries in a row that do not help end the search; with given terms; of a structure, whose
# libraries differ in kind.
_POOR, _POOR_GIVEN, _POOR_STRUCTURED = 2, 3, 5
_SMALL = 35  # terms of the libraries that are tried before laws of physics: 0.3 s of two bodies
_EXACT = 1e-13  # of the spread: a polynomial that errs by no more is no approximation
_TURNING = 2_000  # pairs that tell how far a step turns the states
_AFFINE_ROWS = 50_000  # training pairs that the affine map is fitted to
_FIRST_ROUND = 5e8  # operations that the first round of growth is expected to take
_EXPLAINED = 0.05  # of the spread: an error below it is that of the right branch of the turns


def learn_hamiltonian(
    data: Dataset,
    tolerance: Tolerance,
    scene: Any = None,
    *,
    terms: Sequence[str | Callable] = (),
    budget: Budget | None = None,
    say: Callable[[str], Any] = lambda message: None,
    options: Options = OPTIONS,
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
        whole = law_of_sequences(problem, own, data, tolerance, say, partly)
        if whole is not None:
            seconds = time.perf_counter() - started
            problem.allowance = UNBOUNDED
            found = learned_from(whole, problem, data, tolerance, seconds, options, None)
            for note in found.notes:
                say(note)
            return found
    of_steps, arcs = data, arcs_of(data)
    if arcs is not None:
        say(f"H: fitting arcs of {arcs.length} steps, for single steps are too noisy")
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
    with_masses, best, early = None, None, list[FittedLaw]()
    if not terms and scene is None:
        if basis is None and data.args is None and data.structure is None:
            early = _small_polynomials(problem, work, data, tolerance, options, say)
            best = early[-1] if early and _is_exact(early[-1], tolerance) else None
        if best is None:
            best = law_of_physics(problem, work, data, tolerance, say, partly)
        if best is None:
            best = with_masses = mechanical(problem, work, data, tolerance)
    if best is None or not best.error.bound <= tolerance.bound:
        try:
            best, options = _of_libraries(
                problem, work, basis, data, tolerance, scene, terms, options, say, early
            )
        except (OutOfTime, FitError):
            if best is None:
                raise
        if with_masses is not None and with_masses.error.relative <= best.error.relative:
            best = with_masses._replace(noisy=True)
    everyone = np.arange(len(data)) if is_smooth(best.family) else best.rows
    if problem.substeps_for(best.family, best.fit.coefficients, everyone) >= MOST_SUBSTEPS:
        raise FitError(
            f"the H found is too fast: one dt needs {MOST_SUBSTEPS} substeps or more. Use a "
            "smaller dt; if the pairs are of a map without a flow, use --learn map (learn='map')"
        )
    outside, what, far = None, "", everywhere.training[outer]
    whole, law = everywhere, (best.family, best.fit.coefficients)
    data, everywhere, there = (
        without_turns(rows, *law) for rows in (data, whole, whole.validated_on(far))
    )
    try:
        if best.noisy:
            what = "dropping the terms of H that are noise"
            work.uncapped()  # what is pruned is soon fitted
            with work.again(what, (best.larger or best).family, len(data.training)):
                best = _told_from_noise(problem, best, data.training, data, tolerance, options)
        what = "dropping the terms of H that the pairs do not ask for"
        with work.again(what, best.family, len(best.fit.used)):
            best = _sparse(problem, best, data, tolerance, options, say)
        if len(there.validation) and outer.any():
            outside = validation_error(best.family, best.fit, there, tolerance).relative
        misses = best.error.bound > tolerance.bound and np.isfinite(dearest)
        few = len(best.fit.used) < len(everywhere.training)
        if best.error.relative > _ROUNDOFF and few and not misses:
            what = "the fit of H to all pairs"
            with work.again(what, best.family, len(everywhere.training)):
                best = _refitted(problem, best, everywhere.training, data, tolerance)
    except OutOfTime:  # what was found stands
        budget.leave_out(what, work.ended)
    problem.allowance, everywhere = UNBOUNDED, whole
    of_arcs = None
    if arcs is not None:
        of_arcs = partial(covariance_root, best, problem, everywhere, best.fit.steps)
        everywhere = of_steps
        problem = Problem(
            of_steps.y0, of_steps.y1, of_steps.dt, of_steps.scale, weight=of_steps.weight
        )
        best = best._replace(error=validation_error(best.family, best.fit, of_steps, tolerance))
    noisy = best.noisy or arcs is not None
    smooth = is_smooth(best.family)  # |v|v and sign v, whole sequences turn in
    if noisy and smooth and best.error.bound > tolerance.bound:
        what = "the fit of H to whole sequences"
        say("H: fitting whole sequences")
        try:
            with work.again(what, best.family, len(everywhere.training)):
                best = _of_sequences(problem, best, everywhere, tolerance, budget)
        except OutOfTime:
            budget.leave_out(what, budget.ended)
        except np.linalg.LinAlgError as error:
            budget.leave_out(what, f"its linear algebra failed: {error}")
    if isinstance(best.family, Terms) and data.args is None and best.error.relative <= _ROUNDOFF:
        c, deviations = best.fit.coefficients, best.fit.standard_errors
        z = everywhere.y0[everywhere.validation]
        c = imposed(best.family, c, deviations, z, data.coordinates.angles)
        best = best._replace(fit=best.fit._replace(coefficients=c))
    seconds = time.perf_counter() - started
    learned = learned_from(best, problem, everywhere, tolerance, seconds, options, of_arcs)
    candidate = dataclasses.replace(learned.candidate, outside=outside)
    return dataclasses.replace(learned, candidate=candidate, ended=work.ended)


def _small_polynomials(
    problem, work: LawWork, data: Dataset, tolerance: Tolerance, options: Options, say
) -> list[FittedLaw]:
    """The smallest polynomials that a search for H begins with, up to the first that is exact.

    They are soon fitted, at steps too long for the matching of atoms too, and the search goes on
    from them.
    """
    fitted: list[FittedLaw] = []
    libraries, _ = _libraries(data, tolerance, None, (), options)
    for family in libraries:
        if family.num_parameters > _SMALL:
            break
        last = fitted[-1] if fitted else None
        if last is not None and too_dear(problem, family, last, data, tolerance, work.dearest):
            break
        say(f"H: {family.num_parameters} terms")
        try:
            fitted.append(_fitted(problem, work, family, data, tolerance, last, options, say))
        except OutOfTime:  # whatever follows finds no time either
            break
        if _is_exact(fitted[-1], tolerance):
            break
    return fitted


def _is_exact(found: FittedLaw, tolerance: Tolerance) -> bool:
    return found.error.bound <= tolerance.bound and found.error.relative <= _EXACT


def _of_libraries(
    problem, work: LawWork, basis: Modes | None, data: Dataset, tolerance: Tolerance, scene, terms,
    options: Options, say, early: Sequence[FittedLaw],
) -> tuple[FittedLaw, Options]:  # fmt: skip
    """The best library of terms of H, without friction or with it, and the options for fewer.

    early: the first libraries without friction, where these are fitted already.
    """

    def search(
        forces: Forces | None = None, data: Dataset = data
    ) -> tuple[FittedLaw, Options]:  # fmt: skip
        known = early if forces is None else ()
        return _searched(problem, work, data, tolerance, scene, terms, options, say, forces, known)

    if data.args is not None:
        found = _walked(problem, work, data, tolerance, scene, terms, options, say)
    elif basis is not None:
        found = _grown(problem, work, basis, data, tolerance, options, say), options
    else:
        found = search()
        if not terms and data.structure is None:
            found = _beside_centrifugal(problem, work, found, data, tolerance, options, say)
    return beside_friction(problem, work, found, data, tolerance, search)


def _searched(
    problem,
    work: LawWork,
    data,
    tolerance: Tolerance,
    scene,
    terms,
    options: Options,
    say,
    forces: Forces | None = None,
    early: Sequence[FittedLaw] = (),
) -> tuple[FittedLaw, Options]:
    """The smallest library that meets the tolerance, else the best; and the options, which try no
    fewer terms where the tolerance is out of reach. forces: friction, that libraries have too.
    early: the first libraries, where these are fitted already."""
    bound = tolerance.bound
    best: FittedLaw | None = None
    structured = data.structure is not None
    most_poor = _POOR_STRUCTURED if structured else _POOR_GIVEN if terms else _POOR
    tried: list[FittedLaw] = []
    poor = 0
    libraries, errors = _libraries(data, tolerance, scene, terms, options, forces)
    try:
        for i, family in enumerate(libraries):
            if tried and too_dear(problem, family, tried[-1], data, tolerance, work.dearest):
                say(f"H: {family.num_parameters} terms skipped, dearer per step than the map found")
                continue
            if i < len(early):
                found = early[i]
            else:
                say(f"H: {family.num_parameters} terms")
                last = tried[-1] if tried else None
                found = _fitted(problem, work, family, data, tolerance, last, options, say)
            better = best is None or found.error.relative < options.gained * best.error.relative
            poor = 0 if better else poor + 1
            if best is None or found.error.relative < best.error.relative:
                best = found
            tried.append(found)
            errors.append(found.error.bound)
            if best.error.bound <= bound or poor == most_poor:
                break
            left = len(libraries) - 1 - i
            if not structured and options.only_within and _out_of_reach(errors, left, bound):
                options = dataclasses.replace(options, thresholds=())  # no law: nothing to read
                break
    except OutOfTime:
        if best is None:
            raise
    if best is None:
        raise FitError(f"expected more pairs: {len(data.y0)} are too few for any library of terms")
    best = best._replace(stalled=poor == most_poor)
    if best.error.bound <= bound:
        return best, options
    found, options = _as_noise_tells(tried, best, options)
    return (found._replace(stalled=True) if found.noisy else found), options


def _as_noise_tells(
    tried: Sequence[FittedLaw], best: FittedLaw, options: Options
) -> tuple[FittedLaw, Options]:
    """The first and simplest of the libraries that are as good as the best, and the options that
    drop what is noise, where there are several: they have met the pairs' noise, and the fewest
    terms leave no more of it. Else the best."""
    near = [f for f in tried if f.error.relative <= options.flat * best.error.relative]
    if len(near) < 2:
        return best, options
    noisy = near[0]._replace(noisy=True, larger=near[-1], stalled=best.stalled)
    return noisy, dataclasses.replace(options, thresholds=(options.certain,))


def _libraries(
    data: Dataset, tolerance: Tolerance, scene, terms, options: Options,
    forces: Forces | None = None,
) -> tuple[list[Any], list[float]]:  # fmt: skip
    """Libraries by rising size, and the errors of those before them that are known to be hopeless
    without a fit."""
    known = libraries_of if forces is None else partial(libraries_with, forces)
    libraries = list(known(data, scene, terms, options))
    if isinstance(data.structure, Bodies):
        return promising(libraries, data), []
    if len(libraries) > 1 and libraries[0].quadratic and not data.varied:
        affine = affine_error(data, tolerance).bound
        if affine > _HOPELESS * tolerance.bound:
            return libraries[1:], [affine]
    return libraries, []


def _beside_centrifugal(
    problem, work: LawWork, before: tuple[FittedLaw, Options], data: Dataset, tolerance: Tolerance,
    options: Options, say,
) -> tuple[FittedLaw, Options]:  # fmt: skip
    """The best of libraries with centrifugal terms and their options, where ``before`` misses the
    tolerance, the pairs ask for such terms and these libraries are better; else ``before``."""
    best, _ = before
    if best.error.bound <= tolerance.bound:
        return before
    own = centrifugal_terms(data, data.training, best.family)
    if not own:
        return before
    options = dataclasses.replace(options, given_degrees=options.given_degrees[1:])
    try:
        found = _searched(problem, work, data, tolerance, None, own, options, say)
    except OutOfTime:
        work.budget.leave_out("libraries of H with centrifugal terms", work.ended)
        return before
    except FitError:
        return before
    return found if found[0].error.relative < best.error.relative else before


def _walked(
    problem, work: LawWork, data: Dataset, tolerance: Tolerance, scene, terms, options: Options, say
) -> tuple[FittedLaw, Options]:
    """The best of the libraries of states and parameters, which grow together; as `_searched`."""
    own = own_terms(data, terms) if terms else None
    angles, plain = angles_and_others(data)
    states = state_libraries(
        data.dim, data.parameters, angles=angles, cyclic=data.coordinates.cyclic,
        plain=plain, features=scene.features if scene is not None else None,
        reversor=scene.reversor if scene is not None else None, own=own,
    )  # fmt: skip
    _, args = data.given(data.training)
    functions = functions_of_parameters(
        data.dim, data.parameters, args, own is not None, data.period
    )
    most = len(data.training) * 2 * data.dim / options.rows_per_term
    best: FittedLaw | None = None
    tried: list[FittedLaw] = []

    def attempt(family: Terms) -> FittedLaw:
        say(f"H: {family.num_parameters} terms")
        return _fitted(problem, work, family, data, tolerance, best, options, say)

    try:
        for found in walked(
            states, functions, attempt, lambda found: found.error.bound,
            bound=tolerance.bound, most=min(most, options.most_terms),
        ):  # fmt: skip
            tried.append(found)
            if best is None or found.error.relative < best.error.relative:
                best = found
        stalled = True
    except OutOfTime:
        if best is None:
            raise
        stalled = False
    if best is None:
        raise FitError(f"expected more pairs: {len(data.y0)} are too few for any library of terms")
    if best.error.bound <= tolerance.bound:
        return best, options
    return _as_noise_tells(tried, best._replace(stalled=stalled), options)


def _grown(
    problem, work: LawWork, basis: Modes, data: Dataset, tolerance: Tolerance, options: Options, say
) -> FittedLaw:
    """The library that has grown to the tolerance, or as far as the cap and the pairs allow."""
    goal = options.goal * bound_of(tolerance, problem.scale)
    most = int(len(data.training) * 2 * data.dim / options.rows_per_term)
    work.capped(options.growth_part * options.mode_operations)
    grown, ended, expected = None, "", _FIRST_ROUND
    rounds = grow(problem, basis, data.training, goal, min(most, options.most_modes))
    try:
        while True:
            before = work.made
            with work.round("growth of H", expected):
                further = next(rounds, None)
            if further is None:
                break
            grown, ended, expected = further, further.ended, work.made - before
            why = f": {ended}" if ended else ""
            say(f"H grows: {len(grown.coefficients)} modes, error {grown.rms:.1e}{why}")
    except OutOfTime:
        if grown is None:
            raise
        ended = ended or work.ended
    if grown is None or not np.isfinite(grown.rms):
        raise FitError(
            f"expected more pairs: {len(data.y0)} determine no H of Fourier modes. If they are of "
            "a map without a flow, use --learn map (learn='map')"
        )
    work.capped((1 - options.growth_part) * options.mode_operations)
    count = int(np.ceil(options.judged_rows * len(grown.coefficients) / (2 * data.dim)))
    rows = data.training[: max(count, 500)]
    fit = problem.fit(grown.family, grown.coefficients, rows, rounds=False, say=say)
    error = validation_error(grown.family, fit, data, tolerance)
    return FittedLaw(grown.family, fit, rows, error, (), ended=ended)


def affine_error(data: Dataset, tolerance: Tolerance) -> OneStepError:
    """The held-out error of the affine map that is closest to the training pairs: that of a
    quadratic H, whose flow is affine, is hardly smaller."""

    def design(rows):
        z = data.y0[rows] / data.scale
        return np.column_stack([np.ones(len(z)), z])

    moved = data.y1 - data.y0
    rows = data.training[:_AFFINE_ROWS]
    known = np.linalg.lstsq(design(rows), moved[rows], rcond=None)[0]
    found = data.y0[data.validation] + design(data.validation) @ known
    return measured_error(data, tolerance, to_user(data.coordinates, found))


def _out_of_reach(errors: list[float], left: int, bound: float) -> bool:
    """Return whether the libraries that are left, each gaining as much as the best of the last two
    gains, would still miss the bound."""
    if len(errors) < 3 or not np.isfinite(errors[-3:]).all():
        return False
    gain = min(errors[-1] / errors[-2], errors[-2] / errors[-3], 1.0)
    return errors[-1] * gain**left > bound


def _fitted(
    problem, work: LawWork, family, data, tolerance, last: FittedLaw | None, options, say
) -> FittedLaw:
    """The library fitted to as many training pairs as tell its terms, from the best start."""
    names = family.term_names
    z = data.y0[data.training]
    least, fewest = 200, 100
    if data.structure is not None:
        least = fewest = data.structure.fewest(z.shape[1])
    enough = z[: max(least, -(-4 * family.num_parameters // z.shape[1]))]
    args = data.given(data.training[: len(enough)])[1]
    kept, null = null_terms(family, enough, args=args)
    elsewhere = null_terms(family, _scattered(enough), args=args)[0] if null else []
    undetermined = tuple(names[j] for j in null if j in elsewhere)
    family = family.take(kept)
    count = int(np.ceil(options.judged_rows * family.num_parameters / z.shape[1]))
    rows = data.training[: max(count, fewest)]
    null_names, best = tuple(names[j] for j in null), None
    # Nothing but H is learned of such pairs.
    first = last is None and (data.varied or data.structure is not None)
    with work.library(f"H of {family.num_parameters} terms", family, len(rows), first=first):
        for start in starts(problem, family, rows, data.training[:_TURNING], last):
            fit = problem.fit(family, start, rows, say=say)
            error = validation_error(family, fit, data, tolerance)
            if best is None or error.relative < best.error.relative:
                best = FittedLaw(family, fit, rows, error, null_names, undetermined)
            if error.relative <= _EXPLAINED:
                break
    assert best is not None
    return best


def _scattered(z) -> np.ndarray:
    """States of all directions around the states z."""
    size = z.std(axis=0)
    size = np.where(size > 0, size, np.maximum(np.abs(z).max(axis=0), size.max()))
    return z + size * np.random.default_rng(0).normal(size=z.shape)


def _told_from_noise(
    problem, smallest: FittedLaw, rows, data, tolerance, options: Options
) -> FittedLaw:
    """The terms that these pairs tell from noise: of the smallest library whose error is that of
    the noise, and those of the largest that they tell beside them. An error that is noise for the
    most part hides terms which 10,000 pairs tell."""
    found = _pruned(problem, smallest, rows, data, tolerance, options)
    if smallest.larger is None:
        return found
    few = _significant(problem, smallest.larger, rows, options)
    more = 0 if few is None else few.family.num_parameters - found.family.num_parameters
    if few is None or more <= 0:
        return found
    few = _refitted(problem, few, rows, data, tolerance)
    # Twice the logarithm of the likelihood's ratio.
    gained = 2 * few.fit.triangle.rows * np.log(found.fit.rms / few.fit.rms)
    if gained > options.certain**2 * more and few.error.relative <= found.error.relative:
        return few._replace(noisy=True)
    return found


def _pruned(problem, full: FittedLaw, rows, data, tolerance, options: Options) -> FittedLaw:
    """The terms that all of these pairs tell from noise, fitted to them."""
    few = _significant(problem, full, rows, options)
    if few is not None:
        few = _refitted(problem, few, rows, data, tolerance)
        if few.error.relative <= options.rise * full.error.relative:
            return few
    return _refitted(problem, full, rows, data, tolerance)


def _significant(problem, full: FittedLaw, rows, options: Options) -> FittedLaw | None:
    """The terms that these pairs tell from noise, which one Gauss–Newton problem of all terms says,
    so that only a few are fitted to many pairs; None where it tells none."""
    resolved = np.setdiff1d(rows, np.setdiff1d(full.rows, full.fit.used))
    found = problem.linearised(full.family, full.fit.coefficients, full.fit.steps, resolved)
    if not np.isfinite(found.norm):
        return None
    kept, start = told_from_noise(found, full.fit.coefficients, options.certain)
    if not len(kept):
        return None
    return full._replace(
        family=full.family.take(tuple(kept.tolist())), fit=full.fit._replace(coefficients=start)
    )


def _sparse(problem, full: FittedLaw, data, tolerance, options: Options, say) -> FittedLaw:
    """Drop the terms that the pairs do not ask for, as far as the held-out error allows."""
    seen: set[tuple[int, ...]] = set()
    for threshold in options.thresholds:
        kept = tuple(significant_terms(full.fit, threshold).tolist())
        if len(kept) == full.family.num_parameters:
            break
        if not kept or kept in seen:
            continue
        seen.add(kept)
        family = full.family.take(kept)
        say(f"H: {len(kept)} of {full.family.num_parameters} terms")
        start = full.fit.coefficients[list(kept)]
        fit = problem.fit(family, start, full.fit.used, rounds=False, steps=full.fit.steps)
        error = validation_error(family, fit, data, tolerance)
        before = full.error.relative
        if error.relative <= max(options.rise * before, options.rounding):
            dropped = Dropped(full.family.num_parameters - len(kept), before, error.relative)
            told = f"error {error.relative:.2e}, before {before:.2e}"
            say(f"H without {dropped.terms} terms: {told}")
            return full._replace(family=family, fit=fit, error=error, dropped=dropped)
    return full


def _refitted(problem, found: FittedLaw, rows, data, tolerance) -> FittedLaw:
    """Fitted to all training pairs: each of them averages the noise."""
    fit = problem.fit(found.family, found.fit.coefficients, rows, rounds=False)
    error = validation_error(found.family, fit, data, tolerance)
    return found._replace(fit=fit, rows=rows, error=error)


def _of_sequences(problem, found: FittedLaw, data, tolerance, budget: Budget) -> FittedLaw:
    """Fitted to whole sequences, where there are such and held-out steps bear it out."""
    if found.error.relative <= _ROUNDOFF:
        return found
    whole = fitted_to_sequences(problem, found.family, found.fit, data, Allowance(budget))
    if whole is None:
        return found
    family = found.family.take(whole.kept)
    error = validation_error(family, whole.fit, data, tolerance)
    if not error.relative <= OPTIONS.rise * found.error.relative:
        return found
    return found._replace(family=family, fit=whole.fit, error=error, whole=whole)
