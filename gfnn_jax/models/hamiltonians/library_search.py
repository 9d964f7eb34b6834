"""Search of libraries of terms of H, by rising size: the smallest that meets the tolerance.

Libraries are polynomials, terms that a user or a scene gives, those of a structure, with friction
or without, or with parameters; each is fitted from the one before. Where there are angles, one
library grows mode by mode.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np

from gfnn_jax.coordinates import to_user
from gfnn_jax.dataset.dataset import Dataset
from gfnn_jax.dataset.measured_error import FEW, OneStepError, Tolerance, measured_error
from gfnn_jax.dataset.structures import Bodies
from gfnn_jax.errors import FitError, OutOfTime
from gfnn_jax.families.modes import Modes
from gfnn_jax.families.terms import Terms
from gfnn_jax.fitting.growth import grow
from gfnn_jax.fitting.significance import ABOVE_NOISE
from gfnn_jax.models.hamiltonians.centrifugal import centrifugal_terms
from gfnn_jax.models.hamiltonians.fitted_law import FittedLaw
from gfnn_jax.models.hamiltonians.friction import (
    Forces,
    beside_friction,
    libraries_with,
)
from gfnn_jax.models.hamiltonians.libraries import (
    angles_and_others,
    libraries_of,
    own_terms,
    promising,
)
from gfnn_jax.models.hamiltonians.library_fit import fitted_library
from gfnn_jax.models.hamiltonians.options import LawOptions
from gfnn_jax.models.hamiltonians.steps_of_law import bound_of, validation_error
from gfnn_jax.models.hamiltonians.work import LawWork
from gfnn_jax.models.hamiltonians.worth import too_dear
from gfnn_jax.models.parameters import functions_of_parameters, state_libraries, walked

_HOPELESS = 10.0  # times the tolerance, of an error that is known before a library is fitted
# Libraries in a row that do not help end the search; with given terms; of a structure, whose
# libraries differ in kind.
_POOR, _POOR_GIVEN, _POOR_STRUCTURED = 2, 3, 5
_SMALL = 35  # terms of the libraries that are tried before laws of physics: 0.3 s of two bodies
_EXACT = 1e-13  # of the spread: a polynomial that errs by no more is no approximation
_AFFINE_ROWS = 50_000  # training pairs that the affine map is fitted to
_FIRST_ROUND = 5e8  # operations that the first round of growth is expected to take


def of_libraries(
    problem,
    work: LawWork,
    basis: Modes | None,
    data: Dataset,
    tolerance: Tolerance,
    scene,
    terms,
    options: LawOptions,
    on_progress,
    early: Sequence[FittedLaw],
) -> tuple[FittedLaw, LawOptions]:
    """The best library of terms of H, without friction or with it, and the options for fewer.

    early: the first libraries without friction, where these are fitted already.
    """

    def search(forces: Forces | None = None, data: Dataset = data) -> tuple[FittedLaw, LawOptions]:
        known = early if forces is None else ()
        return _searched(
            problem, work, data, tolerance, scene, terms, options, on_progress, forces, known
        )

    if data.args is not None:
        found = _walked(problem, work, data, tolerance, scene, terms, options, on_progress)
    elif basis is not None:
        found = _grown(problem, work, basis, data, tolerance, options, on_progress), options
    else:
        found = search()
        if not terms and data.structure is None:
            found = _beside_centrifugal(problem, work, found, data, tolerance, options, on_progress)
    return beside_friction(problem, work, found, data, tolerance, search)


def small_polynomials(
    problem, work: LawWork, data: Dataset, tolerance: Tolerance, options: LawOptions, on_progress
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
        on_progress(f"H: {family.num_parameters} terms")
        try:
            fitted.append(
                fitted_library(problem, work, family, data, tolerance, last, options, on_progress)
            )
        except OutOfTime:  # whatever follows finds no time either
            break
        if is_exact(fitted[-1], tolerance):
            break
    return fitted


def is_exact(found: FittedLaw, tolerance: Tolerance) -> bool:
    return found.error.bound <= tolerance.bound and found.error.relative <= _EXACT


def _searched(
    problem,
    work: LawWork,
    data,
    tolerance: Tolerance,
    scene,
    terms,
    options: LawOptions,
    on_progress,
    forces: Forces | None = None,
    early: Sequence[FittedLaw] = (),
) -> tuple[FittedLaw, LawOptions]:
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
                on_progress(
                    f"H: {family.num_parameters} terms skipped, costlier per step than the map"
                )
                continue
            if i < len(early):
                found = early[i]
            else:
                on_progress(f"H: {family.num_parameters} terms")
                last = tried[-1] if tried else None
                found = fitted_library(
                    problem, work, family, data, tolerance, last, options, on_progress
                )
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
    best = simplest_where_few_decide(tried, best, tolerance, options)
    found, options = _simplest_within_noise(tried, best, options)
    return (found._replace(stalled=True) if found.noisy else found), options


def simplest_where_few_decide(
    tried: Sequence[FittedLaw], best: FittedLaw, tolerance: Tolerance, options: LawOptions
) -> FittedLaw:
    """The first and simplest of the libraries whose error lies below the 95 % bound of the best's,
    where few held-out states make that, as in a close passage: chance decides there which is
    lowest. At most states the best must not have helped either. Elsewhere the best."""

    def measured(found: FittedLaw) -> float:
        return found.error.relative if tolerance.relative else found.error.rms

    def as_good(found: FittedLaw) -> bool:
        helped = best.error.typical < options.gained * found.error.typical
        return measured(found) <= best.error.bound and not helped

    if not FEW * best.error.typical < measured(best):
        return best
    return next(filter(as_good, tried), best)._replace(stalled=best.stalled)


def _simplest_within_noise(
    tried: Sequence[FittedLaw], best: FittedLaw, options: LawOptions
) -> tuple[FittedLaw, LawOptions]:
    """The first and simplest of the libraries that are as good as the best, and the options that
    drop what is noise, where there are several: they have met the pairs' noise, and the fewest
    terms leave no more of it. Else the best."""
    near = [f for f in tried if f.error.relative <= options.flat * best.error.relative]
    if len(near) < 2:
        return best, options
    noisy = near[0]._replace(noisy=True, larger=near[-1], stalled=best.stalled)
    return noisy, dataclasses.replace(options, thresholds=(ABOVE_NOISE,))


def _libraries(
    data: Dataset,
    tolerance: Tolerance,
    scene,
    terms,
    options: LawOptions,
    forces: Forces | None = None,
) -> tuple[list[Any], list[float]]:
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
    problem,
    work: LawWork,
    before: tuple[FittedLaw, LawOptions],
    data: Dataset,
    tolerance: Tolerance,
    options: LawOptions,
    on_progress,
) -> tuple[FittedLaw, LawOptions]:
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
        found = _searched(problem, work, data, tolerance, None, own, options, on_progress)
    except OutOfTime:
        work.budget.leave_out("libraries of H with centrifugal terms", work.ended)
        return before
    except FitError:
        return before
    return found if found[0].error.relative < best.error.relative else before


def _walked(
    problem,
    work: LawWork,
    data: Dataset,
    tolerance: Tolerance,
    scene,
    terms,
    options: LawOptions,
    on_progress,
) -> tuple[FittedLaw, LawOptions]:
    """The best of the libraries of states and parameters, which grow together; as `_searched`."""
    own = own_terms(data, terms) if terms else None
    angles, plain = angles_and_others(data)
    states = state_libraries(
        data.dim,
        data.parameters,
        angles=angles,
        cyclic=data.coordinates.cyclic,
        plain=plain,
        features=scene.features if scene is not None else None,
        reversor=scene.reversor if scene is not None else None,
        own=own,
    )
    _, args = data.given(data.training)
    functions = functions_of_parameters(
        data.dim, data.parameters, args, own is not None, data.period
    )
    most = len(data.training) * 2 * data.dim / options.rows_per_term
    best: FittedLaw | None = None
    tried: list[FittedLaw] = []

    def attempt(family: Terms) -> FittedLaw:
        on_progress(f"H: {family.num_parameters} terms")
        return fitted_library(problem, work, family, data, tolerance, best, options, on_progress)

    try:
        for found in walked(
            states,
            functions,
            attempt,
            lambda found: found.error.bound,
            bound=tolerance.bound,
            most=min(most, options.most_terms),
        ):
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
    return _simplest_within_noise(tried, best._replace(stalled=stalled), options)


def _grown(
    problem,
    work: LawWork,
    basis: Modes,
    data: Dataset,
    tolerance: Tolerance,
    options: LawOptions,
    on_progress,
) -> FittedLaw:
    """The library that has grown to the tolerance, or as far as the cap and the pairs allow."""
    goal = options.goal * bound_of(tolerance, problem.scale)
    most = int(len(data.training) * 2 * data.dim / options.rows_per_term)
    work.capped(options.growth_part * options.mode_operations)
    grown, ended, expected = None, "", _FIRST_ROUND
    rounds = grow(problem, basis, data.training, goal, min(most, options.most_modes))
    try:
        while True:
            before = work.made()
            with work.round("growth of H", expected):
                further = next(rounds, None)
            if further is None:
                break
            grown, ended, expected = further, further.ended, work.made() - before
            why = f": {ended}" if ended else ""
            on_progress(f"H grows: {len(grown.coefficients)} modes, error {grown.rms:.1e}{why}")
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
    count = int(np.ceil(options.rows_compared * len(grown.coefficients) / (2 * data.dim)))
    rows = data.training[: max(count, 500)]
    fit = problem.fit(grown.family, grown.coefficients, rows, rounds=False, on_progress=on_progress)
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
