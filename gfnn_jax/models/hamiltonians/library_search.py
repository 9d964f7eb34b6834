"""Search of libraries of terms of H, by rising size: the smallest that meets the tolerance.

Libraries are polynomials, terms that a user or a scene gives, those of a structure, with friction
or without, or with parameters; each is fitted from the one before, from several starts.

Where there are angles, one library grows mode by mode (`grow`). Each round solves for the modes
that are there and looks at the candidates around those that matter. Of a candidate's derivative,
what the present modes explain is taken away first; then its correlation with the residual is its
weight in standard errors, were it fitted. The weightiest come in, those that have lost their weight
go.
"""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from itertools import islice
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

from gfnn_jax.budget import FLOW
from gfnn_jax.coordinates import to_user
from gfnn_jax.dataset.measured_error import FEW, OneStepError, measured_error
from gfnn_jax.dataset.structures import Bodies
from gfnn_jax.errors import FitError, OutOfTime
from gfnn_jax.families.modes import Mode, Modes
from gfnn_jax.families.sums import matrix_free
from gfnn_jax.families.terms import Terms
from gfnn_jax.families.told import anything_told
from gfnn_jax.fitting.gauss_newton import Problem
from gfnn_jax.fitting.linear_starts import forward_start, log_start, midpoint_start
from gfnn_jax.fitting.significance import (
    ABOVE_NOISE,
    beside,
    matched,
    null_terms,
    significant,
)
from gfnn_jax.fitting.triangle import Triangle
from gfnn_jax.flows.collocation import Steps, of_lanes
from gfnn_jax.flows.rates import rates
from gfnn_jax.models.hamiltonians.fitted_law import FittedLaw
from gfnn_jax.models.hamiltonians.friction import Forces, beside_friction, libraries_with
from gfnn_jax.models.hamiltonians.libraries import libraries_of, own_terms, promising
from gfnn_jax.models.hamiltonians.problem import LawProblem, operations_of
from gfnn_jax.models.parameters import states_and_functions, walked


@dataclasses.dataclass(frozen=True)
class GrowthOptions:
    """Tuned on the double pendulum at dt 0.05 and 0.2.

    boxes: (order, degree) of the first library, the largest that has at most ``box`` modes and for
    which there are rows enough.
    weighty: of the heaviest candidate's, below which one waits for the next round.
    pairs: that the rounds look at, and rows that each of its modes needs.
    null: of a column's size, below which the other modes explain a candidate.
    block: candidates whose columns are made at once. shortlist: of them, from which at_once modes
    at most are taken in a round.
    rounds: at most. idle: that may pass without a gain of a tenth.
    """

    boxes: tuple[tuple[int, int], ...] = ((2, 2), (1, 2), (1, 1))
    box: int = 250
    weighty: float = 0.2
    pairs: int = 600
    rows_per_mode: float = 4.0
    null: float = 1e-6
    block: int = 400
    shortlist: int = 200
    at_once: int = 16
    rounds: int = 60
    idle: int = 4
    box_pairs: int = 2_000  # that the first box is told by
    # of the residual: a gain, and what fewer modes may cost
    gained: float = 0.9
    worse: float = 1.2
    # of the residual, below which a step is taken before candidates are looked at
    settled: float = 0.1
    # of the residual: what a flow's own steps may err by, and what is left of it when they are
    # chosen again
    resolved: float = 1e-4
    again: float = 0.03
    fewest: float = 0.5  # of the pairs, whose flow must be computed


OPTIONS = GrowthOptions()


class Grown(NamedTuple):
    """The library of one round and its coefficients. rms: per component, as in FlowFit. ended: in
    the last round, why growth ends with it."""

    family: Terms
    coefficients: np.ndarray
    rms: float
    ended: str = ""


def grow(
    problem: Problem, basis: Modes, rows: np.ndarray, goal: float, most: int
) -> Iterator[Grown]:
    """The modes that these rows ask for, round by round, each better than the one before, until the
    residual is within ``goal`` or none gains.

    most: modes at most. Nothing is found where the rows are too few for the smallest library.
    """
    enough = rows[: OPTIONS.box_pairs]
    z0, z1 = problem.z0[enough], problem.z1[enough]
    modes = _box(basis, z0, len(rows))
    if not modes:
        return
    start = basis.terms(modes)
    c = midpoint_start(start, z0, z1, problem.given(enough)[0], problem.scale)
    present = dict(zip(modes, c.tolist(), strict=True))
    best, before, idle, ended = Grown(start, c, np.inf), present, 0, ""
    pace: list[tuple[int, float]] = []
    steps, resolved = None, 1.0
    for _ in range(OPTIONS.rounds):
        if idle == OPTIONS.idle:
            ended = "no further mode gains"
            break
        count = int(OPTIONS.rows_per_mode * len(present) / (2 * basis.dim))
        some = rows[: max(OPTIONS.pairs, count)]
        if steps is None or best.rms < OPTIONS.again * resolved:
            resolved = min(best.rms, 1.0)
            family, c = basis.terms(list(present)), np.array(list(present.values()))
            (steps,) = problem.fine_steps(family, c, some, (OPTIONS.resolved * resolved,))
        looked = _Linearised(problem, basis, present, steps, some)
        if not looked.rms <= OPTIONS.worse * best.rms:
            present = {
                m: 0.5 * (before.get(m, 0.0) + present.get(m, 0.0)) for m in before | present
            }
            idle += 1
            continue
        idle = 0 if looked.rms < OPTIONS.gained * best.rms else idle + 1
        if looked.rms < best.rms:
            best = Grown(*looked.without_new(), looked.rms)
            pace.append((len(best.coefficients), best.rms))
            yield best
        if looked.rms <= goal:
            ended = "the training pairs meet the tolerance"
            break
        before = present
        solved, rest, span = looked.solved(ABOVE_NOISE)
        room = most - len(solved)
        gain = np.linalg.norm(rest) / np.linalg.norm(looked.residual)
        # What a long step leaves over is curvature, which asks for any mode.
        tried = basis.around(solved) if gain > OPTIONS.settled else []
        found = looked.candidates(tried, rest, span, room)
        if not found and gain > OPTIONS.gained:
            ended = (
                "the pairs have no room for more modes" if room <= 0 else "no further mode gains"
            )
            break
        if _out_of_modes(pace[-4:], goal, most):
            ended = f"more than {most} modes are needed"
            break
        present = solved | dict.fromkeys(found, 0.0)
    yield best._replace(ended=ended or f"{OPTIONS.rounds} rounds are over")


def _out_of_modes(pace: list[tuple[int, float]], goal: float, most: int) -> bool:
    """Return whether the modes that are left, each gaining as much as those of the last four rounds
    did, would miss the goal."""
    if len(pace) < 4:
        return False
    (count, rms), added = pace[-1], pace[-1][0] - pace[0][0]
    gained = np.log(pace[0][1] / rms)
    return added > 0 and gained / added * (most - count) < np.log(rms / goal)


def _box(basis: Modes, z, pairs: int) -> list[Mode]:
    """The first library, without the modes that others explain."""
    most = min(pairs * 2 * basis.dim / OPTIONS.rows_per_mode, OPTIONS.box)
    boxes = (basis.box(*size) for size in OPTIONS.boxes)
    modes = next((modes for modes in boxes if len(modes) <= most), [])
    kept, _ = null_terms(basis.terms(modes), z[: max(200, len(modes))]) if modes else ([], [])
    return [modes[j] for j in kept]


class _Linearised:
    """The linearised problem of the present modes at their coefficients, on the pairs whose flow
    can be computed."""

    def __init__(
        self, problem: Problem, basis: Modes, present: dict[Mode, float], steps: Steps, rows
    ):
        self._problem, self._basis, self.modes = problem, basis, list(present)
        self.family = basis.terms(self.modes)
        self.coefficients = np.array(list(present.values()))
        self._steps = steps
        self._rows, self._good = rows, np.ones(len(rows), bool)
        found = self._images(self.family)
        residual = (found.states - problem.z1[rows]) / problem.scale
        good = np.isfinite(residual).all(axis=1) & np.isfinite(found.by_coefficient).all((1, 2))
        self._good = good
        self.residual = residual[good].ravel()
        self.matrix = self._columns(found.by_coefficient)
        enough = good.mean() >= OPTIONS.fewest
        self.rms = float(np.sqrt(np.mean(self.residual**2))) if enough else np.inf

    def _images(self, along: Terms):
        p = self._problem
        p.allowance.check()
        return p.images(
            self.family, self.coefficients, self._rows, self._steps, along=along, derivatives=True
        )

    def _columns(self, by_coefficient):
        slope = by_coefficient[self._good] / self._problem.scale[:, None]
        return slope.reshape(-1, slope.shape[-1])

    def without_new(self) -> tuple[Terms, np.ndarray]:
        """The library and its coefficients without the modes that have not been fitted yet."""
        new = self.coefficients == 0
        kept = np.flatnonzero(~new | new.all())
        return self.family.take(kept.tolist()), self.coefficients[kept]

    def solved(self, threshold: float) -> tuple[dict[Mode, float], np.ndarray, np.ndarray]:
        """The modes that weigh at least so many standard errors with their next coefficients, the
        residual (n,) that the linearised problem then leaves, and an orthonormal basis (n, modes)
        of what these modes explain."""
        rows = np.concatenate([self.matrix, self.residual[:, None]], axis=1)
        kept, c = significant(Triangle.of(rows), self.coefficients, threshold)
        rest = self.residual + self.matrix[:, kept] @ c - self.matrix @ self.coefficients
        span = np.linalg.qr(self.matrix[:, kept])[0]
        return {self.modes[j]: float(v) for j, v in zip(kept, c, strict=True)}, rest, span

    def candidates(self, tried: list[Mode], rest, span, room: int) -> list[Mode]:
        """Select among the modes that are tried those that the residual asks for: the heaviest,
        then the one that is heaviest beside it, and so on. rest, span: as `solved` gives them."""
        degrees = np.sqrt(max(len(rest) - span.shape[1], 0))
        columns, heaviest = np.zeros((len(rest), 0)), np.zeros(0, dtype=int)
        for first in range(0, len(tried), OPTIONS.block):
            part = np.arange(first, min(first + OPTIONS.block, len(tried)))
            found = self._beside(span, [tried[j] for j in part], OPTIONS.null)
            columns, heaviest = np.hstack([columns, found]), np.concatenate([heaviest, part])
            order = np.argsort(-np.abs(rest @ columns), kind="stable")[: OPTIONS.shortlist]
            columns, heaviest = columns[:, order], heaviest[order]
        chosen, least = [], 0.0
        ahead = matched(columns, rest, OPTIONS.null)
        for j, gain, left in islice(ahead, min(room, OPTIONS.at_once)):
            weight = gain * degrees / left
            least = least or max(ABOVE_NOISE, OPTIONS.weighty * weight)
            if not weight >= least:
                break
            chosen.append(tried[heaviest[j]])
        return chosen

    def _beside(self, span, modes: list[Mode], null: float) -> np.ndarray:
        """The derivatives in the coefficients of these modes without what ``span`` explains, each
        column of length 1, or 0 where nothing is left."""
        columns = self._columns(self._images(self._basis.terms(modes)).by_coefficient)
        size, columns = np.linalg.norm(columns, axis=0), beside(span, columns)
        left = np.linalg.norm(columns, axis=0)
        good = np.isfinite(left) & (left > null * size)
        return np.where(good, columns / np.where(good, left, 1.0), 0.0)


NONE: Mapping[int, FittedLaw] = MappingProxyType({})


def of_libraries(
    problem: LawProblem, basis: Modes | None, early: Mapping[int, FittedLaw]
) -> FittedLaw:
    """The best library of terms of H, without friction or with it; without, where something is told
    of coefficients.

    basis: of the library that grows, where one does. early: the first libraries without friction,
    where these are fitted already.
    """

    def search(forces: Forces | None = None, data=problem.data) -> FittedLaw:
        return _searched(problem.on(data), forces, early if forces is None else NONE)

    if anything_told(problem.terms):
        return search()
    if problem.data.args is not None:
        found = _walked(problem)
    elif basis is not None:
        found = _grown(problem, basis)
    else:
        found = search()
    return beside_friction(problem, found, search)


def small_polynomials(problem: LawProblem) -> dict[int, FittedLaw]:
    """The smallest polynomials that a search for H begins with, up to the first that is exact, by
    the number of their terms.

    They are soon fitted, at steps too long for the matching of atoms too, and the search goes on
    from them.
    """
    laws = _laws(problem, _libraries(problem)[0], most=problem.options.small)
    fitted: dict[int, FittedLaw] = {}
    with contextlib.suppress(OutOfTime):  # whatever follows finds no time either
        for count, _, law in laws:
            fitted[count] = law
            if is_exact(problem, law):
                break
    return fitted


def is_exact(problem: LawProblem, law: FittedLaw) -> bool:
    """Return whether the law is no approximation."""
    return problem.met_by(law) and law.error.relative <= problem.options.exact


def _laws(
    problem: LawProblem,
    libraries: Sequence[Any],
    early: Mapping[int, FittedLaw] = NONE,
    most: float = np.inf,
) -> Iterator[tuple[int, int, FittedLaw]]:
    """The laws of libraries of up to so many terms, each fitted from the one before, with the
    number of terms and how many libraries are left. early: of them, those that are fitted already.
    """
    last: FittedLaw | None = None
    for i, family in enumerate(libraries):
        count = family.num_parameters
        name = f"H: {count} terms"
        if count > most:
            return
        if last is not None and exceeds_cost(problem, family, last):
            problem.on_progress(f"{name} skipped, costlier per step than the map")
            continue
        if count in early:
            last = early[count]
        else:
            problem.on_progress(name)
            last = fitted_library(problem, family, last)
        yield count, len(libraries) - 1 - i, last


def _searched(
    problem: LawProblem, forces: Forces | None = None, early: Mapping[int, FittedLaw] = NONE
) -> FittedLaw:
    """The smallest library that meets the tolerance, else the best; no fewer of its terms are tried
    where the tolerance is out of reach. forces: friction, that libraries have too.
    early: the first libraries, where these are fitted already."""
    options, structured = problem.options, problem.data.structure is not None
    most_poor = options.poor_given if problem.terms else options.poor
    most_poor = options.poor_structured if structured else most_poor
    tried: list[FittedLaw] = []
    poor, no_law = 0, False
    libraries, errors = _libraries(problem, forces)
    try:
        for _, left, law in _laws(problem, libraries, early):
            before = min((t.error.relative for t in tried), default=np.inf)
            poor = 0 if not tried or law.error.relative < options.gained * before else poor + 1
            tried.append(law)
            errors.append(law.error.bound)
            if problem.met_by(_best(problem, tried)) or poor == most_poor:
                break
            no_law = not structured and options.only_within
            no_law = no_law and _out_of_reach(errors, left, problem.tolerance.bound)
            if no_law:
                break
    except OutOfTime:
        if not tried:
            raise
    best = _best(problem, tried)._replace(stalled=poor == most_poor)
    if no_law:  # nothing to read
        best = best._replace(thresholds=())
    if problem.met_by(best):
        return best
    best = simplest_where_few_decide(problem, tried, best)
    found = _simplest_within_noise(problem, tried, best)
    return found._replace(stalled=True) if found.noisy else found


def _best(problem: LawProblem, tried: Sequence[FittedLaw]) -> FittedLaw:
    """The first of the laws of the lowest error. Raises FitError where there is none."""
    if not tried:
        count = len(problem.data.y0)
        raise FitError(f"expected more pairs: {count} are too few for any library of terms")
    return min(tried, key=lambda law: law.error.relative)


def simplest_where_few_decide(
    problem: LawProblem, tried: Sequence[FittedLaw], best: FittedLaw
) -> FittedLaw:
    """The first and simplest of the libraries whose error lies below the 95 % bound of the best's,
    where few held-out states make that, as in a close passage: chance decides there which is
    lowest. At most states the best must not have helped either. Elsewhere the best."""

    def measured(found: FittedLaw) -> float:
        return found.error.relative if problem.tolerance.relative else found.error.rms

    def as_good(found: FittedLaw) -> bool:
        helped = best.error.typical < problem.options.gained * found.error.typical
        return measured(found) <= best.error.bound and not helped

    if not FEW * best.error.typical < measured(best):
        return best
    found = next(filter(as_good, tried), best)
    return found._replace(stalled=best.stalled, thresholds=best.thresholds)


def _simplest_within_noise(
    problem: LawProblem, tried: Sequence[FittedLaw], best: FittedLaw
) -> FittedLaw:
    """The first and simplest of the libraries that are as good as the best, of whose terms those
    are to go that are noise, where there are several: they have met the pairs' noise, and the
    fewest terms leave no more of it. Else the best."""
    near = [f for f in tried if f.error.relative <= problem.options.flat * best.error.relative]
    if len(near) < 2:
        return best
    return near[0]._replace(
        noisy=True, larger=near[-1], stalled=best.stalled, thresholds=(ABOVE_NOISE,)
    )


def _libraries(problem: LawProblem, forces: Forces | None = None) -> tuple[list[Any], list[float]]:
    """Libraries by rising size, and the errors of those before them that are known to be hopeless
    without a fit."""
    data = problem.data
    found = libraries_of(problem) if forces is None else libraries_with(forces, problem)
    libraries = list(found)
    if isinstance(data.structure, Bodies):
        return promising(libraries, data), []
    if len(libraries) > 1 and libraries[0].quadratic and not data.varied:
        affine = affine_error(problem).bound
        if affine > problem.options.hopeless * problem.tolerance.bound:
            return libraries[1:], [affine]
    return libraries, []


def _walked(problem: LawProblem) -> FittedLaw:
    """The best of the libraries of states and parameters, which grow together; as `_searched`."""
    scene, data = problem.scene, problem.data
    states, functions = states_and_functions(
        data,
        data.training,
        features=scene.features if scene is not None else None,
        reversor=scene.reversor if scene is not None else None,
        own=own_terms(problem),
    )
    tried: list[FittedLaw] = []

    def attempt(family) -> FittedLaw:
        problem.on_progress(f"H: {family.num_parameters} terms")
        return fitted_library(problem, family, _best(problem, tried) if tried else None)

    most, stalled = min(problem.most_terms, problem.options.most_terms), False
    laws = walked(
        states,
        functions,
        attempt,
        lambda law: law.error.bound,
        bound=problem.tolerance.bound,
        most=most,
    )
    try:
        for law in laws:
            tried.append(law)
        stalled = True
    except OutOfTime:
        if not tried:
            raise
    best = _best(problem, tried)
    if problem.met_by(best):
        return best
    return _simplest_within_noise(problem, tried, best._replace(stalled=stalled))


def _grown(problem: LawProblem, basis: Modes) -> FittedLaw:
    """The library that has grown to the tolerance, or as far as the cap and the pairs allow."""
    data, options, work, flows = problem.data, problem.options, problem.work, problem.flows
    most = min(int(problem.most_terms), options.most_modes)
    work.capped(options.growth_part * options.mode_operations)
    grown, ended, expected = None, "", options.first_round
    rounds = grow(flows, basis, data.training, options.goal * problem.bound, most)
    try:
        while True:
            before = work.made()
            with work.budget.unit("growth of H", FLOW, expected, made=work.made):
                further = next(rounds, None)
            if further is None:
                break
            grown, ended, expected = further, further.ended, work.made() - before
            why = f": {ended}" if ended else ""
            count = len(grown.coefficients)
            problem.on_progress(f"H grows: {count} modes, error {grown.rms:.1e}{why}")
    except OutOfTime:
        if grown is None:
            raise
        ended = ended or work.ended
    if grown is None or not np.isfinite(grown.rms):
        raise FitError(
            f"expected more pairs: {len(data.y0)} determine no H of Fourier modes. If they are of "
            "a map without a flow, use --learn map"
        )
    work.capped((1 - options.growth_part) * options.mode_operations)
    count = int(np.ceil(options.rows_compared * len(grown.coefficients) / (2 * data.dim)))
    rows = data.training[: max(count, 500)]
    law = problem.fitted(
        grown.family, grown.coefficients, rows, rounds=False, on_progress=problem.on_progress
    )
    return law._replace(ended=ended)


def affine_error(problem: LawProblem) -> OneStepError:
    """The held-out error of the affine map that is closest to the training pairs: that of a
    quadratic H, whose flow is affine, is hardly smaller."""
    data = problem.data

    def design(rows):
        z = data.y0[rows] / data.scale
        return np.column_stack([np.ones(len(z)), z])

    moved = data.y1 - data.y0
    rows = data.training[: problem.options.affine_rows]
    known = np.linalg.lstsq(design(rows), moved[rows], rcond=None)[0]
    found = data.y0[data.validation] + design(data.validation) @ known
    return measured_error(data, problem.tolerance, to_user(data.coordinates, found))


def _out_of_reach(errors: list[float], left: int, bound: float) -> bool:
    """Return whether the libraries that are left, each gaining as much as the best of the last two
    gains, would still miss the bound."""
    if len(errors) < 3 or not np.isfinite(errors[-3:]).all():
        return False
    gain = min(errors[-1] / errors[-2], errors[-2] / errors[-3], 1.0)
    return errors[-1] * gain**left > bound


def exceeds_cost(problem: LawProblem, family, last: FittedLaw) -> bool:
    """Return whether a step of no law of this library costs up to the ``dearest`` operations.

    One Gauss–Newton problem at the last law tells which terms the tolerance asks for: those whose
    absence would double the mean square that it allows. What the linear problem leaves unknown is
    of the order of the last law's error squared, and is allowed too.
    """
    if not np.isfinite(problem.dearest):
        return False
    data, fit, flows = problem.data, last.fit, problem.flows
    fastest = rates(last.family, fit.coefficients, data.y0[: problem.options.rated])

    def dear(family) -> bool:
        cost = operations_of(family, 2 * family.dim, fastest, flows.dt, fit.steps)
        return cost > problem.dearest

    if not dear(family):
        return False
    start = last.start_of(family)
    rows = data.training[: max(len(last.rows), 2 * family.num_parameters)]
    found = flows.linearised(family, start, fit.steps, rows)
    if not np.isfinite(found.norm) or found.rows <= family.num_parameters:
        return False
    allowed = max(problem.bound, last.error.relative**2)
    kept, _ = significant(found, start, np.sqrt(found.rows), allowed)
    return not kept.size or dear(family.take(tuple(kept.tolist())))


def fitted_library(problem: LawProblem, family, last: FittedLaw | None) -> FittedLaw:
    """The library fitted to as many training pairs as tell its terms, from the best start. last:
    the library before."""
    data, options, names = problem.data, problem.options, family.term_names
    z = data.y0[data.training]
    least, fewest = 200, 100
    if data.structure is not None:
        least = fewest = data.structure.fewest(z.shape[1])
    enough = z[: max(least, -(-4 * family.num_parameters // z.shape[1]))]
    args = data.given(data.training[: len(enough)])[1]
    kept, null = null_terms(family, enough, args=args)
    elsewhere = []
    if null:  # by states of all directions around these
        size = enough.std(axis=0)
        size = np.where(size > 0, size, np.maximum(np.abs(enough).max(axis=0), size.max()))
        moved = size * np.random.default_rng(0).normal(size=enough.shape)
        elsewhere = null_terms(family, enough + moved, args=args)[0]
    undetermined = tuple(names[j] for j in null if j in elsewhere)
    family = family.take(kept)
    count = int(np.ceil(options.rows_compared * family.num_parameters / z.shape[1]))
    rows = data.training[: max(count, fewest)]
    fitted: list[FittedLaw] = []
    # Nothing but H is learned of such pairs.
    first = last is None and (data.varied or data.structure is not None)
    name = f"H of {family.num_parameters} terms"
    with problem.work.library(name, family, len(rows), first=first):
        for start in _starts(problem, family, rows, last):
            law = problem.fitted(family, start, rows, on_progress=problem.on_progress)
            fitted.append(law)
            if law.error.relative <= options.on_branch:
                break
    return _best(problem, fitted)._replace(
        null=tuple(names[j] for j in null), undetermined=undetermined
    )


def _starts(problem: LawProblem, family, rows, last: FittedLaw | None) -> Iterator[np.ndarray]:
    """The start whose flow is nearest to the pairs; and the one that turns forwards what seems to
    turn backwards, before it where that is by more than a quarter."""
    flows, many = problem.flows, problem.data.training[: problem.options.turning]
    dt, args = flows.given(many)
    turned = None
    known = len(many) > flows.z0.shape[1] and not matrix_free(family)
    if args is None and np.ndim(dt) == 0 and known:
        turned = forward_start(family, flows.z0[many], flows.z1[many], dt, flows.scale)
    if turned is not None and turned[0] > problem.options.fast:
        yield turned[1]
    yield _start(problem, family, rows, last)
    if turned is not None and turned[0] <= problem.options.fast:
        yield turned[1]


def _start(problem: LawProblem, family, rows, last: FittedLaw | None) -> np.ndarray:
    """The start whose flow is nearest to the pairs: midpoint, of all of them or of those that move
    least, logarithm, or the last library's."""
    flows = problem.flows
    z0, z1 = flows.z0[rows], flows.z1[rows]
    dt, args = flows.given(rows)

    def midpoint(part):
        own = of_lanes(dt, part), flows.scale, of_lanes(args, part)
        return midpoint_start(family, z0[part], z1[part], *own)

    moved = np.linalg.norm((z1 - z0) / flows.scale, axis=1)
    quieter = moved <= np.median(moved)  # the midpoint says little of a step that goes far
    starts = [midpoint(slice(None)), midpoint(quieter)]
    # Pairs of one affine regression, more of them than it has unknowns.
    alike = args is None and np.ndim(dt) == 0 and len(z0) > z0.shape[1]
    logarithm = log_start(family, z0, z1, dt, flows.scale) if alike else None
    if logarithm is not None:
        starts.append(logarithm)
    if last is not None:
        starts.append(last.start_of(family))
    some = rows[:100]
    return min(starts, key=lambda c: flows.distance(family, c, some))
