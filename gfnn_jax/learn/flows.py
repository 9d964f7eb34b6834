"""Learn H: the Hamiltonian whose flow over dt maps z₀ to z₁, as a formula of few terms.

Libraries of terms are tried by rising size, each from the one before, until one meets the
tolerance; where there are angles, one library grows mode by mode. Terms that are nothing but noise
go while the held-out error does not rise.
"""

from __future__ import annotations

import contextlib
import dataclasses
import time
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np

from gfnn_jax.coordinates import to_user
from gfnn_jax.errors import FitError
from gfnn_jax.families.expressions import coordinate_names
from gfnn_jax.families.inputs import box_inputs
from gfnn_jax.families.modes import Modes
from gfnn_jax.families.products import Products
from gfnn_jax.families.sums import Sums, matrix_free
from gfnn_jax.families.terms import Terms, given_terms, joined, multiplied, polynomial_terms
from gfnn_jax.fitting import least_squares, shared_noise, uncertainty
from gfnn_jax.fitting.gauss_newton import (
    MOST_SUBSTEPS,
    FlowFit,
    Problem,
    forward_start,
    log_start,
    midpoint_start,
    null_terms,
    rates,
    significant,
    significant_terms,
)
from gfnn_jax.fitting.growth import grow
from gfnn_jax.fitting.least_squares import Reduced
from gfnn_jax.flows.collocation import Steps, images, of_lanes, truncation
from gfnn_jax.flows.flow import Flow
from gfnn_jax.learn.arcs import arcs_of
from gfnn_jax.learn.assemble import Assembled, composed, stepped
from gfnn_jax.learn.candidates import Candidate, Judges, OneStepError, with_error
from gfnn_jax.learn.clock import Clock, Counted, OutOfTime
from gfnn_jax.learn.cost_of_flow import (
    CONTRACTING,
    FREQUENCY_STATES,
    contraction_of,
    omega_h_of,
    operations_of,
)
from gfnn_jax.learn.formula import Term, formula
from gfnn_jax.learn.held_out import looked_at, outermost
from gfnn_jax.learn.parameters import functions_of_parameters, state_libraries, walked
from gfnn_jax.learn.prepare import Prepared
from gfnn_jax.learn.whole_sequences import Whole, fitted_to_sequences
from gfnn_jax.phase_space import Pairs, apply_j, symplectic_form


@dataclasses.dataclass(frozen=True)
class Options:
    """Tuned on Hénon–Heiles at dt 0.5 to 3, on three bodies and on the double pendulum.

    degrees: of the products of coordinates; feature_degrees: of a scene's features; given_degrees:
    of the products that stand beside a user's own terms (0: his alone), given_products: by which
    his terms are multiplied too.
    most_terms: of a library; most_modes: of one that grows. rows_per_term: that a library needs.
    judged_rows: per term, from which a library is judged; all pairs only count in the last fit.
    thresholds: standard errors below which terms go, tried in turn.
    rise: of the held-out error that dropping terms may cost; rounding: below which it is roundoff.
    flat: libraries one after the other whose errors differ by less have met the pairs' noise;
    certain: standard errors below which a term is then noise (one in 16,000 by chance).
    explained: standard errors of the part of a residual that is noise, within which all of it is.
    gained: a library that lowers the error by less has not helped; twice in a row ends the search.
    truncation: a flow's own error, as a part of the tolerance. goal: residual that modes grow to,
    as a part of the tolerance. generators: degrees of those that look for misfit; sampled_rows: per
    term, where what is left over is looked at. max_seconds: of the search; mode_seconds: where
    modes grow, growth_part: the part of them in which they may. max_operations, mode_operations: of
    the flows that are evaluated on the way, counted.
    """

    degrees: tuple[int, ...] = (2, 3, 4, 5, 6, 8)
    feature_degrees: tuple[int, ...] = (2, 3)
    given_degrees: tuple[int, ...] = (0, 2, 3, 4)
    given_products: tuple[int, ...] = (2,)
    most_terms: int = 350
    most_modes: int = 500
    rows_per_term: float = 1.6
    judged_rows: float = 12.0
    thresholds: tuple[float, ...] = (1e4, 1e3, 100.0, 30.0, 10.0, 5.0, 3.0)
    rise: float = 1.1
    rounding: float = 1e-15
    flat: float = 1.2
    certain: float = 4.0
    explained: float = 2.0
    gained: float = 0.5
    truncation: float = 0.1
    goal: float = 0.3
    generators: tuple[int, ...] = (2, 3, 4, 5, 6)
    sampled_rows: int = 6
    max_seconds: float = 30.0
    mode_seconds: float = 60.0
    max_operations: float = np.inf
    mode_operations: float = np.inf
    growth_part: float = 0.7


OPTIONS = Options()
_ROUNDOFF = 1e-12  # of the spread: above it the pairs carry noise, and every one of them counts
_NEAR_ROUNDOFF = 3e-15  # of the spread
_HOPELESS = 10.0  # times the tolerance, of an error that is known before a library is fitted
_NO_FORCE = 1e-9  # of the forces' sum: a total that is roundoff
_FEWEST_SAMPLED = 2_000  # pairs that tell noise from misfit
_NAMED = 5  # terms in a message
# Libraries in a row that do not help end the search; with given terms; of a structure, whose
# libraries differ in kind.
_POOR, _POOR_GIVEN, _POOR_STRUCTURED = 2, 3, 5
_TURNING = 2_000  # pairs that tell how far a step turns the states
_EXPLAINED = 0.05  # of the spread: an error below it is that of the right branch of the turns
_FAST = np.pi / 2  # of ωh: from here on other laws are not far from the same pairs


@dataclasses.dataclass(frozen=True)
class LearnedHamiltonian:
    """H as learned, in the inner coordinates.

    candidate: as the others of a fit, its error measured by steps in NumPy. flow: the piece.
    terms, formula: what H is; () and None of a network. truncation: largest error of the flow's
    own steps on the held-out states, ÷ scale. omega_h: the fastest oscillation of the linearised
    flow, times dt, in the median over the data; beyond π pairs of one dt may not tell H.
    contraction: the fixed point's factor where it is largest. condition: of the terms' columns.
    null_terms: that the data do not tell from the others. left_out: pairs that the flow does not
    resolve. stalled: whether larger libraries were no more accurate. root: (m, m), rootᵀ root is
    the coefficients' covariance; None of a network. unmet: that the tolerance is missed, and what
    that may be from; "" where it is met.
    """

    candidate: Candidate
    flow: Flow
    terms: tuple[Term, ...]
    formula: str | None
    truncation: float
    omega_h: float
    contraction: float
    condition: float
    null_terms: tuple[str, ...]
    left_out: int
    messages: tuple[str, ...]
    stalled: bool
    root: np.ndarray | None
    noise: np.ndarray | None = None
    arcs: int = 0
    unmet: str = ""

    @property
    def fast(self) -> bool:
        """Whether H oscillates so fast that other laws are not far from the same pairs."""
        return self.omega_h > _FAST


class _Fitted(NamedTuple):
    """rows: that the fit was given; it has left out those that the flow does not resolve.
    undetermined: of the null terms, those that other states would tell from the rest. ended: why a
    library that grew did so no longer. stalled: whether larger libraries were no better. noisy:
    whether their errors were the same, which is that of the pairs. whole: what whole sequences
    tell, where they were fitted."""

    family: Terms | Sums
    fit: FlowFit
    rows: np.ndarray
    error: OneStepError
    null: tuple[str, ...]
    undetermined: tuple[str, ...] = ()
    ended: str = ""
    stalled: bool = False
    noisy: bool = False
    whole: Whole | None = None


def learn_hamiltonian(
    prepared: Prepared,
    judges: Judges,
    scene: Any = None,
    *,
    terms: Sequence[str | Callable] = (),
    clock: Clock | None = None,
    say: Callable[[str], Any] = lambda message: None,
    options: Options = OPTIONS,
) -> LearnedHamiltonian:
    """The Hamiltonian of these pairs: the smallest library that meets the tolerance, else the best.

    prepared: without a base map. scene: lends its features and reversor. terms: a user's own.

    Raises FitError where no library can be tried, OutOfTime where the budget ends before the first.
    """
    basis = _modes(prepared, scene, terms)
    most = options.max_seconds if basis is None else options.mode_seconds
    clock = clock or Clock()
    searching = Clock(min(most, clock.left))
    if prepared.before or prepared.after:
        raise FitError("expected pairs without a base map: it is no part of a flow")
    started = time.perf_counter()
    if terms and prepared.structure is None:
        _check_finite(_own_terms(prepared, terms), prepared, judges.training)
    steps_of, judges_of_steps = prepared, judges
    arcs = arcs_of(prepared, judges)
    if arcs is not None:
        say(f"H: arcs of {arcs.length} steps, in which the states move far against their noise")
        prepared, judges = arcs.prepared, arcs.judges
    problem = Problem(
        prepared.y0, prepared.y1, prepared.each_dt, prepared.scale, args=prepared.args,
        check=searching.check,
        spend=Counted(options.max_operations if basis is None else options.mode_operations).spend,
    )  # fmt: skip
    everywhere, free = judges, (*prepared.coordinates.cyclic, *prepared.whole)
    if prepared.structure is None:
        outer = outermost(prepared.y0[judges.training], free)
    else:  # a state of many sites is in the middle and far out at once
        outer = np.zeros(len(judges.training), bool)
    judges = dataclasses.replace(everywhere, training=everywhere.training[~outer])
    if prepared.args is not None:
        best = _walked(problem, prepared, judges, scene, terms, options, say)
    elif basis is not None:
        best = _grown(problem, basis, prepared, judges, searching, options, say)
    else:
        best, options = _searched(problem, prepared, judges, scene, terms, options, say)
    everyone = np.arange(len(prepared.y0))
    if problem.substeps_for(best.family, best.fit.coefficients, everyone) >= MOST_SUBSTEPS:
        raise FitError("expected pairs of a flow: that of the H that was found varies too fast")
    outside = None
    try:
        if best.noisy:
            # What is pruned is soon fitted: the search is over.
            problem.check, problem.spend = clock.check, Counted(np.inf).spend
            best = _pruned(problem, best, judges.training, prepared, judges, options)
        best = _sparse(problem, best, prepared, judges, options, say)
        there = dataclasses.replace(everywhere, held_out=everywhere.training[outer])
        if outer.any():
            outside = _held_out_error(best.family, best.fit, prepared, there).relative
        if best.error.relative > _ROUNDOFF and len(best.fit.used) < len(everywhere.training):
            best = _refitted(problem, best, everywhere.training, prepared, judges)
    except OutOfTime:
        pass  # what was found stands
    problem.check, problem.spend = lambda: None, Counted(np.inf).spend
    root = None
    if arcs is not None:
        root = _root(best, problem, prepared, best.fit.steps, everywhere.pairs)
        prepared, everywhere = steps_of, judges_of_steps
        problem = Problem(prepared.y0, prepared.y1, prepared.dt, prepared.scale)
        best = best._replace(error=_held_out_error(best.family, best.fit, prepared, everywhere))
    noisy = best.noisy or arcs is not None
    if noisy and best.error.bound > everywhere.tolerance.bound:
        say("H: whole sequences")
        with contextlib.suppress(OutOfTime, np.linalg.LinAlgError):
            best = _of_sequences(problem, best, prepared, everywhere, clock)
    seconds = time.perf_counter() - started
    learned = _learned(best, problem, prepared, everywhere, seconds, options, root)
    candidate = dataclasses.replace(learned.candidate, outside=outside)
    return dataclasses.replace(learned, candidate=candidate)


def _searched(
    problem, prepared, judges: Judges, scene, terms, options: Options, say
) -> tuple[_Fitted, Options]:
    """The smallest library that meets the tolerance, else the best; and the options, which try no
    fewer terms where the tolerance is out of reach."""
    bound = judges.tolerance.bound
    best: _Fitted | None = None
    structured = prepared.structure is not None
    most_poor = _POOR_STRUCTURED if structured else _POOR_GIVEN if terms else _POOR
    tried: list[_Fitted] = []
    poor, errors = 0, []
    libraries = list(_libraries(prepared, judges, scene, terms, options))
    if len(libraries) > 1 and libraries[0].quadratic and not prepared.varied:
        affine = _affine_error(prepared, judges).bound
        if affine > _HOPELESS * bound:
            errors.append(affine)
            del libraries[0]
    try:
        for family in libraries:
            say(f"H: {family.num_parameters} terms")
            found = _fitted(
                problem, family, prepared, judges, tried[-1] if tried else None, options, say
            )
            better = best is None or found.error.relative < options.gained * best.error.relative
            poor = 0 if better else poor + 1
            if best is None or found.error.relative < best.error.relative:
                best = found
            tried.append(found)
            errors.append(found.error.bound)
            if best.error.bound <= bound or poor == most_poor:
                break
            if not structured and _out_of_reach(
                errors, len(libraries) - 1 - libraries.index(family), bound
            ):
                options = dataclasses.replace(options, thresholds=())  # no law: nothing to read
                break
    except OutOfTime:
        if best is None:
            raise
    if best is None:
        raise FitError(
            f"expected more pairs: {len(prepared.y0)} are too few for any library of terms"
        )
    stalled = poor == most_poor
    near = [f for f in tried if f.error.relative <= options.flat * best.error.relative]
    if len(near) > 1 and best.error.bound > bound:  # noise: the fewest terms leave no more of it
        best = near[0]._replace(noisy=True)
        stalled, options = True, dataclasses.replace(options, thresholds=(options.certain,))
    return best._replace(stalled=stalled), options


def _walked(
    problem, prepared: Prepared, judges: Judges, scene, terms, options: Options, say
) -> _Fitted:
    """The best of the libraries of states and parameters, which grow together."""
    own = _own_terms(prepared, terms) if terms else None
    angles, plain = _angles_and_others(prepared)
    states = state_libraries(
        prepared.dim, prepared.parameters, angles=angles, cyclic=prepared.coordinates.cyclic,
        plain=plain, features=scene.features if scene is not None else None,
        reversor=scene.reversor if scene is not None else None, own=own,
    )  # fmt: skip
    _, args = prepared.given(judges.training)
    functions = functions_of_parameters(
        prepared.dim, prepared.parameters, args, own is not None, prepared.period
    )
    most = len(judges.training) * 2 * prepared.dim / options.rows_per_term
    best: _Fitted | None = None

    def attempt(family: Terms) -> _Fitted:
        say(f"H: {family.num_parameters} terms")
        return _fitted(problem, family, prepared, judges, best, options, say)

    try:
        for found in walked(
            states, functions, attempt, lambda found: found.error.bound,
            bound=judges.tolerance.bound, most=min(most, options.most_terms),
        ):  # fmt: skip
            if best is None or found.error.relative < best.error.relative:
                best = found
        stalled = best is not None and best.error.bound > judges.tolerance.bound
    except OutOfTime:
        if best is None:
            raise
        stalled = False
    if best is None:
        raise FitError(
            f"expected more pairs: {len(prepared.y0)} are too few for any library of terms"
        )
    return best._replace(stalled=stalled)


def _angles_and_others(prepared: Prepared) -> tuple[tuple[int, ...], tuple[str, ...]]:
    """The angles that enter H by themselves, and the names of the coordinates that are none."""
    dim, coordinates = prepared.dim, prepared.coordinates
    angles = tuple(i for i in coordinates.angles if i < dim and i not in coordinates.cyclic)
    plain = tuple(
        name
        for i, name in enumerate(coordinate_names(dim))
        if i not in angles and i not in coordinates.cyclic
    )
    return angles, plain


def _modes(prepared: Prepared, scene, terms) -> Modes | None:
    """The basis that grows, where an angle enters H by itself; else None."""
    if prepared.args is not None or (scene is not None and scene.features is not None):
        return None
    dim = prepared.dim
    angles, plain = _angles_and_others(prepared)
    if not angles:
        return None
    own = given_terms(dim, terms).variables if terms else ()
    own = tuple(text for text in own if text not in plain)
    return Modes(dim, angles, (*plain, *own), len(own))


def _grown(
    problem, basis: Modes, prepared, judges: Judges, clock: Clock, options: Options, say
) -> _Fitted:
    """The library that has grown to the tolerance, or as far as the time and the pairs allow."""
    goal = options.goal * _bound(judges, problem.scale)
    most = int(len(judges.training) * 2 * prepared.dim / options.rows_per_term)
    problem.check = Clock(options.growth_part * clock.left).check
    problem.spend = Counted(options.growth_part * options.mode_operations).spend
    grown, ended = None, "the time is over"
    try:
        for grown in grow(problem, basis, judges.training, goal, min(most, options.most_modes)):
            ended = grown.ended
            why = f": {ended}" if ended else ""
            say(f"H grows: {len(grown.coefficients)} modes, error {grown.rms:.1e}{why}")
    except OutOfTime:
        if grown is None:
            raise
        ended = ended or "the time is over"
    if grown is None or not np.isfinite(grown.rms):
        raise FitError(
            f"expected more pairs, or pairs of a flow: {len(prepared.y0)} tell no library of modes"
        )
    problem.check = clock.check
    problem.spend = Counted((1 - options.growth_part) * options.mode_operations).spend
    count = int(np.ceil(options.judged_rows * len(grown.coefficients) / (2 * prepared.dim)))
    rows = judges.training[: max(count, 500)]
    fit = problem.fit(grown.family, grown.coefficients, rows, rounds=False, say=say)
    error = _held_out_error(grown.family, fit, prepared, judges)
    return _Fitted(grown.family, fit, rows, error, (), ended=ended)


def _own_terms(prepared: Prepared, terms) -> Terms:
    return given_terms(prepared.dim, terms, prepared.parameters)


def _check_finite(given: Terms, prepared: Prepared, rows) -> None:
    """Raises FitError for a user's term that has no value or no slope at some of the states."""
    z = prepared.y0[rows]
    slopes = given.term_gradients(z, prepared.given(rows)[1])
    for j, name in enumerate(given.term_names):
        bad = ~np.isfinite(slopes[:, :, j]).all(axis=1)
        if bad.any():
            raise FitError(
                f"expected terms that are finite at all states, got '{name}', which is not at "
                f"{int(bad.sum())} of {len(z)}"
            )


def _affine_error(prepared, judges) -> OneStepError:
    """The held-out error of the affine map that is closest to the training pairs: that of a
    quadratic H, whose flow is affine, is hardly smaller."""

    def design(rows):
        z = prepared.y0[rows] / prepared.scale
        return np.column_stack([np.ones(len(z)), z])

    moved = prepared.y1 - prepared.y0
    known = np.linalg.lstsq(design(judges.training), moved[judges.training], rcond=None)[0]
    found = prepared.y0[judges.held_out] + design(judges.held_out) @ known
    return judges.error_of(to_user(prepared.coordinates, found), prepared.coordinates)


def _out_of_reach(errors: list[float], left: int, bound: float) -> bool:
    """Whether the libraries that are left, each gaining as much as the best of the last two gains,
    would still miss the bound."""
    if len(errors) < 3 or not np.isfinite(errors[-3:]).all():
        return False
    gain = min(errors[-1] / errors[-2], errors[-2] / errors[-3], 1.0)
    return errors[-1] * gain**left > bound


def _libraries(prepared, judges, scene, terms, options: Options) -> Iterator[Terms | Sums]:
    """Families by rising size, of as many terms as the training rows tell apart."""
    dim, coordinates = prepared.dim, prepared.coordinates
    if prepared.structure is not None:
        libraries = prepared.structure.libraries(dim, terms)
        most = len(judges.training) * 2 * dim / options.rows_per_term
        yield from (library for library in libraries if library.num_parameters <= most)
        return
    reversor = scene.reversor if scene is not None else None
    features = scene.features if scene is not None else None
    most = len(judges.training) * 2 * dim / options.rows_per_term
    most = min(most, options.most_terms)
    own = _own_terms(prepared, terms) if terms else None
    if own is not None:
        degrees = options.given_degrees
    else:
        degrees = options.degrees if features is None else options.feature_degrees
    for degree in degrees:
        if degree == 0:
            assert own is not None
            yield own
            continue
        family = polynomial_terms(
            dim, degree, cyclic=coordinates.cyclic, features=features, reversor=reversor
        )
        tried = [family] if own is None else [joined(own, family)]
        if own is not None and degree in options.given_products:
            tried.append(joined(tried[0], multiplied(own, family)))
        for library in tried:
            if library.num_parameters > most:
                return
            yield library


def _fitted(problem, family, prepared, judges, last: _Fitted | None, options, say) -> _Fitted:
    """The library fitted to as many training pairs as tell its terms, from the best start."""
    names = family.term_names
    z = prepared.y0[judges.training]
    least, fewest = 200, 100
    if prepared.structure is not None:
        least = fewest = prepared.structure.fewest(z.shape[1])
    enough = z[: max(least, -(-4 * family.num_parameters // z.shape[1]))]
    args = prepared.given(judges.training[: len(enough)])[1]
    kept, null = null_terms(family, enough, args=args)
    elsewhere = null_terms(family, _scattered(enough), args=args)[0] if null else []
    undetermined = tuple(names[j] for j in null if j in elsewhere)
    family = family.take(kept)
    count = int(np.ceil(options.judged_rows * family.num_parameters / z.shape[1]))
    rows = judges.training[: max(count, fewest)]
    null_names, best = tuple(names[j] for j in null), None
    for start in _starts(problem, family, rows, judges.training[:_TURNING], last):
        fit = problem.fit(family, start, rows, say=say)
        error = _held_out_error(family, fit, prepared, judges)
        if best is None or error.relative < best.error.relative:
            best = _Fitted(family, fit, rows, error, null_names, undetermined)
        if error.relative <= _EXPLAINED:
            break
    assert best is not None
    return best


def _scattered(z) -> np.ndarray:
    """States of all directions around the states z."""
    size = z.std(axis=0)
    size = np.where(size > 0, size, np.maximum(np.abs(z).max(axis=0), size.max()))
    return z + size * np.random.default_rng(0).normal(size=z.shape)


def _starts(problem, family, rows, many, last: _Fitted | None) -> Iterator[np.ndarray]:
    """The start whose flow is nearest to the pairs; and the one that turns forwards what seems to
    turn backwards, before it where that is by more than a quarter. many: rows that tell turns."""
    dt, args = problem.given(many)
    turned = None
    known = len(many) > problem.z0.shape[1] and not matrix_free(family)
    if args is None and np.ndim(dt) == 0 and known:
        turned = forward_start(family, problem.z0[many], problem.z1[many], dt, problem.scale)
    if turned is not None and turned[0] > _FAST:
        yield turned[1]
    yield _start(problem, family, rows, last)
    if turned is not None and turned[0] <= _FAST:
        yield turned[1]


def _start(problem, family, rows, last: _Fitted | None) -> np.ndarray:
    """The start whose flow is nearest to the pairs: midpoint, of all of them or of those that move
    least, logarithm, or the last library's."""
    z0, z1 = problem.z0[rows], problem.z1[rows]
    dt, args = problem.given(rows)

    def midpoint(part):
        own = of_lanes(dt, part), problem.scale, of_lanes(args, part)
        return midpoint_start(family, z0[part], z1[part], *own)

    moved = np.linalg.norm((z1 - z0) / problem.scale, axis=1)
    quieter = moved <= np.median(moved)  # the midpoint says little of a step that goes far
    starts = [midpoint(slice(None)), midpoint(quieter)]
    # Pairs of one affine regression, more of them than it has unknowns.
    alike = args is None and np.ndim(dt) == 0 and len(z0) > z0.shape[1]
    logarithm = log_start(family, z0, z1, dt, problem.scale) if alike else None
    if logarithm is not None:
        starts.append(logarithm)
    if last is not None:
        known = dict(zip(last.family.term_names, last.fit.coefficients, strict=True))
        starts.append(np.array([known.get(name, 0.0) for name in family.term_names]))
    some = rows[:100]
    return min(starts, key=lambda c: problem.distance(family, c, some))


def _held_out_error(family, fit: FlowFit, prepared, judges: Judges) -> OneStepError:
    """By steps that resolve the held-out pairs: an unresolved passage says nothing of the law."""
    steps = _resolving(family, fit.coefficients, fit.steps, prepared, judges)
    return _error_of(family, fit.coefficients, steps, prepared, judges)


def _resolving(family, coefficients, steps: Steps, prepared, judges: Judges) -> Steps:
    """These steps, or, where the law misses the tolerance by them, finer ones: halved until they
    resolve the held-out pairs, or there are as many as a flow may have."""
    bound, states = _bound(judges, prepared.scale), prepared.y0[judges.held_out]
    if _error_of(family, coefficients, steps, prepared, judges).bound <= judges.tolerance.bound:
        return steps
    dt, args = prepared.given(judges.held_out)
    while 2 * steps.substeps <= MOST_SUBSTEPS:
        off = truncation(family, coefficients, states, dt, steps, args=args) / prepared.scale
        if np.sqrt(np.mean(off**2)) <= OPTIONS.truncation * bound:
            break
        steps = dataclasses.replace(steps, substeps=2 * steps.substeps)
    return steps


def _bound(judges: Judges, scale) -> float:
    """The tolerance as a part of the coordinates' scale."""
    bound = judges.tolerance.bound
    return bound if judges.tolerance.relative else bound / float(scale.max())


def _error_of(family, coefficients, steps: Steps, prepared, judges: Judges) -> OneStepError:
    states, (dt, args) = prepared.y0[judges.held_out], prepared.given(judges.held_out)
    found = images(family, coefficients, states, dt, steps, args=args).states
    return judges.error_of(to_user(prepared.coordinates, found), prepared.coordinates)


def _pruned(problem, full: _Fitted, rows, prepared, judges, options: Options) -> _Fitted:
    """The terms that all of these pairs tell from noise, fitted to them: one Gauss–Newton problem
    of all terms says which, so that only a few are fitted to many pairs."""
    resolved = np.setdiff1d(rows, np.setdiff1d(full.rows, full.fit.used))
    found = problem.factor(full.family, full.fit.coefficients, full.fit.steps, resolved)
    if np.isfinite(found.cost):
        kept, start = significant(
            found.matrix, full.fit.coefficients, found.rows, options.certain
        )  # fmt: skip
        few = full._replace(
            family=full.family.take(tuple(kept.tolist())), fit=full.fit._replace(coefficients=start)
        )
        if len(kept):
            few = _refitted(problem, few, rows, prepared, judges)
            if few.error.relative <= options.rise * full.error.relative:
                return few
    return _refitted(problem, full, rows, prepared, judges)


def _sparse(problem, full: _Fitted, prepared, judges, options: Options, say) -> _Fitted:
    """Without the terms that the pairs do not ask for, as far as the held-out error allows."""
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
        error = _held_out_error(family, fit, prepared, judges)
        if error.relative <= max(options.rise * full.error.relative, options.rounding):
            return full._replace(family=family, fit=fit, error=error)
    return full


def _refitted(problem, found: _Fitted, rows, prepared, judges) -> _Fitted:
    """Fitted to all training pairs: each of them averages the noise."""
    fit = problem.fit(found.family, found.fit.coefficients, rows, rounds=False)
    error = _held_out_error(found.family, fit, prepared, judges)
    return found._replace(fit=fit, rows=rows, error=error)


def _of_sequences(problem, found: _Fitted, prepared, judges, clock: Clock) -> _Fitted:
    """Fitted to whole sequences, where there are such and held-out steps bear it out."""
    if found.error.relative <= _ROUNDOFF:
        return found
    whole = fitted_to_sequences(problem, found.family, found.fit, prepared, judges, clock.check)
    if whole is None:
        return found
    family = found.family.take(whole.kept)
    error = _held_out_error(family, whole.fit, prepared, judges)
    if not error.relative <= OPTIONS.rise * found.error.relative:
        return found
    return found._replace(family=family, fit=whole.fit, error=error, whole=whole)


def _learned(
    found: _Fitted, problem, prepared: Prepared, judges: Judges, seconds: float, options: Options,
    root: np.ndarray | None,
) -> LearnedHamiltonian:  # fmt: skip
    """root: of the covariance, where the fit was not to these pairs but to arcs of them."""
    family, fit, whole = found.family, found.fit, found.whole
    rows = judges.held_out
    z, args = prepared.y0[rows], prepared.given(rows)[1]
    some = slice(FREQUENCY_STATES)
    fastest = rates(family, fit.coefficients, prepared.y0[some], prepared.given(some)[1])
    if prepared.own_dt is not None:  # the map's own dt, from which others follow
        problem = Problem(prepared.y0, prepared.y1, prepared.dt, prepared.scale, args=prepared.args)
    steps = _cheapest(problem, family, fit, fastest, judges, options)
    steps = _resolving(family, fit.coefficients, steps, prepared, judges)
    contraction = contraction_of(fastest, prepared.dt, steps)
    by_newton = contraction > CONTRACTING and not matrix_free(family)
    off = truncation(family, fit.coefficients, z, prepared.dt, steps, args=args) / prepared.scale
    flow = Flow(
        family, fit.coefficients, prepared.dt, prepared.scale, steps.stages, steps.substeps,
        by_newton,
    )  # fmt: skip
    longest = flow.over(np.max(prepared.each_dt)).substeps
    of_all = dataclasses.replace(steps, substeps=longest)
    error = _error_of(family, fit.coefficients, of_all, prepared, judges)
    candidate = Candidate(
        label=f"H, {family.num_parameters} terms", family=family.name, chart="flow",
        num_parameters=family.num_parameters,
        operations=operations_of(family, 2 * family.dim, fastest, prepared.dt, steps),
        validation_rms=error.rms, validation_relative=error.relative,
        validation_bound=error.bound, deviations=error.deviations, train_rms=fit.rms,
        fit_seconds=seconds, condition=fit.condition, rank=family.num_parameters,
        learns="hamiltonian",
    )  # fmt: skip
    terms = tuple(
        Term(*entry)
        for entry in zip(
            family.term_names, fit.coefficients.tolist(), fit.standard_errors.tolist(), strict=True
        )
    )
    omega_h = omega_h_of(family, fit.coefficients, prepared, fastest)
    left_out = len(np.setdiff1d(found.rows, fit.used))
    resolved = np.abs(off).max(axis=1) <= _bound(judges, prepared.scale)
    if whole is not None:
        root = whole.root
    elif root is None:
        root = _root(found, problem, prepared, steps, judges.pairs)
    return LearnedHamiltonian(
        with_error(candidate, error), flow, terms, getattr(family, "prefix", "") + formula(terms),
        float(np.abs(off).max()),
        omega_h, contraction, fit.condition, found.null, left_out,
        tuple(_messages(error, omega_h, prepared, judges, found, left_out, int((~resolved).sum()))),
        stalled=found.stalled,
        root=root, noise=None if whole is None else whole.noise,
        arcs=0 if whole is None else whole.arcs,
        unmet=_unmet(error, omega_h, prepared, judges, found),
    )  # fmt: skip


def _root(
    found: _Fitted, problem: Problem, prepared: Prepared, steps: Steps, pairs: Pairs
) -> np.ndarray:
    """(m, m): rootᵀ root is the covariance of the coefficients. What is noise, a generator of
    polynomials tells, which does not explain it; what it explains is misfit, of these steps too."""
    fit, count = found.fit, found.family.num_parameters
    most = max(_FEWEST_SAMPLED, OPTIONS.sampled_rows * count // prepared.y0.shape[1])
    structure = prepared.structure
    if structure is not None:
        most = structure.fewest(prepared.y0.shape[1])
    places, goes_on = looked_at(pairs, fit.used, most)
    rows, scale = fit.used[places], problem.scale
    images = problem.images(found.family, fit.coefficients, rows, steps, derivatives=True)
    residual = images.states - prepared.y1[rows]
    if not np.isfinite(residual).all():  # of a flow that runs away from some of the states
        return np.full((count, count), np.nan)
    slopes = images.by_coefficient / scale[:, None]
    left, scores, states, noise = residual / scale, None, None, None
    if structure is None:  # of many coordinates both would take too much
        if goes_on.any():
            first = images.by_state * scale
            second = np.broadcast_to(-np.diag(scale), first.shape)
            scores = shared_noise.scores(
                slopes, left, first / scale[:, None], second / scale[:, None], goes_on
            )
            states = first, second, goes_on
        noise = unexplained(prepared, rows, residual, count, states)
    train = Reduced(np.asfortranarray(fit.factor), fit.rows)
    return uncertainty.root(
        train, count, slopes.reshape(-1, count), np.hypot(left, _NEAR_ROUNDOFF).ravel(),
        noise=noise, scores=scores,
    )  # fmt: skip


def unexplained(prepared: Prepared, rows, residual, taken: int, states) -> float | None:
    """Of the mean square of what a map leaves over (n, 2d) on these rows, the part that no
    generator K explains, residual = J∇K at the images: K of as high a degree as the rows tell.
    taken: coefficients that the map itself was given. states: the residual's derivatives and which
    pairs go on, as `shared_noise.scores` takes them, or None. None where the rows are too few.

    1 where K explains no more than it would of noise, by ``explained`` standard errors: an F test.
    """
    z, coordinates, width = prepared.y1[rows], prepared.coordinates, residual.shape[1]
    inputs = box_inputs(
        z, angles=tuple(a for a in coordinates.angles if a < prepared.dim),
        cyclic=coordinates.cyclic,
    )  # fmt: skip
    sizes = [Products(inputs, degree) for degree in OPTIONS.generators]
    most = min(len(rows) * width // OPTIONS.sampled_rows, OPTIONS.most_terms)
    known = [family for family in sizes if family.num_parameters <= most]
    if not known:
        return None
    family, weight = known[-1], 1.0 / np.roll(prepared.scale, prepared.dim)
    target = -apply_j(residual)
    reduced = least_squares.reduce(family, [(z, target)], weight)
    count, freedom = family.num_parameters, None
    if states is not None:
        to_target = -weight[:, None] * symplectic_form(prepared.dim)
        slopes, (first, second, goes_on) = family.term_gradients(z) * weight[:, None], states
        scores = shared_noise.scores(
            slopes, weight * target, to_target @ first, to_target @ second, goes_on
        )
        freedom = shared_noise.freedom(slopes, weight * target, scores)
    left = np.sum(reduced.factor[:, -1] ** 2) / max(reduced.rows - taken, 1)
    if left == 0:
        return 1.0
    part = float(uncertainty.variance(reduced, count, freedom) / left)
    by_chance = OPTIONS.explained * np.sqrt(2 * count) / reduced.rows
    return part if part < 1 - by_chance else 1.0


def _cheapest(problem, family, fit: FlowFit, fastest, judges: Judges, options: Options) -> Steps:
    """Steps whose own error is a tenth of the tolerance; near roundoff, or at it, where that is not
    twice as dear."""

    def cost(steps: Steps) -> float:
        return operations_of(family, 2 * family.dim, fastest, problem.dt, steps)

    bound = max(options.truncation * _bound(judges, problem.scale), 0.3 * fit.rms)
    tolerances = (bound, min(bound, _NEAR_ROUNDOFF), None)
    found = problem.fine_steps(family, fit.coefficients, judges.training, tolerances)
    return next(s for s in reversed(found) if s == found[0] or cost(s) < 2 * cost(found[0]))


def _unmet(error: OneStepError, omega_h: float, prepared, judges, found: _Fitted) -> str:
    if error.bound <= judges.tolerance.bound:
        return ""
    return (
        f"no H of the terms tried meets the tolerance (best {error.relative:.2e} of the spread, "
        f"its fastest oscillation {omega_h:.2g} in a step): the pairs carry noise, other terms are "
        f"needed, the map has no flow, or ωh > π at dt = {prepared.dt:g}, and then only a shorter "
        "dt tells H" + (f"; modes were added until {found.ended}" if found.ended else "")
    )


def _messages(
    error: OneStepError, omega_h: float, prepared, judges, found: _Fitted, left_out: int,
    unresolved: int,
) -> Iterator[str]:  # fmt: skip
    if error.bound <= judges.tolerance.bound and omega_h > _FAST:
        yield (
            f"H oscillates by {omega_h:.2g} radians in a step (ωh, its median over the states"
            f"{', beyond π' if omega_h > np.pi else ''}): an H whose frequencies differ by 2π per "
            "step gives the same pairs, or nearly; this is the "
            + (
                "simplest; a smaller dt, or several, would settle it"
                if omega_h > np.pi
                else "slowest"
            )
        )
    if found.whole is not None:
        yield from found.whole.messages
    if found.undetermined:
        names = found.undetermined
        some = ", ".join(names[:_NAMED]) + (", …" if len(names) > _NAMED else "")
        yield (
            f"the pairs do not determine {len(names)} terms of H ({some}): they are left "
            "out, and H is known only where the pairs are"
        )
    if left_out:
        yield (
            f"{left_out} of {len(found.rows)} pairs, as of close passages, are not resolved by the "
            "steps of the fit: they are left out of it"
        )
    if unresolved:
        yield (
            f"{unresolved} of {len(judges.held_out)} held-out pairs are not resolved to the "
            "tolerance by the flow's own steps: there the map is in error, and not the law"
        )


def assembled(learned: LearnedHamiltonian, prepared: Prepared, judges: Judges) -> Assembled:
    """The candidate's map, its error and its time per step measured by the steps that users run."""
    prepared = _in_relative_domain(learned.flow, prepared)
    map_ = composed(learned.flow, prepared, judges)
    held = judges.pairs.take(judges.held_out)
    steps = stepped(map_, np.asarray(held.z0), held.dt, held.args)
    states = np.where(steps.failed[:, None], np.nan, steps.images)
    error = judges.error_of(states, prepared.coordinates)
    candidate = dataclasses.replace(
        with_error(learned.candidate, error), map=map_,
        newton_iterations_max=int(steps.iterations.max()),
        microseconds_per_step=steps.microseconds_per_step,
    )  # fmt: skip
    return Assembled(candidate, steps.compile_seconds)


def _in_relative_domain(flow: Flow, prepared: Prepared) -> Prepared:
    """With a domain that leaves out where the whole is, if no force depends on that."""
    if prepared.structure is None:
        return prepared
    force = flow.family.gradient(flow.params, prepared.y0)[:, : prepared.dim]
    moves = np.abs(force.sum(axis=1)).max() > _NO_FORCE * np.abs(force).sum(axis=1).max()
    return dataclasses.replace(
        prepared, domain=prepared.structure.domain(prepared.y0, uses_positions=bool(moves))
    )
