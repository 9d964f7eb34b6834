"""Search of libraries of terms of H, by rising size: the smallest that meets the tolerance.

Libraries are polynomials, modes of angles, terms that a user or a scene gives, those of a
structure, with friction or without, or with parameters; each is fitted from the one before, from
several starts.
"""

import contextlib
from collections.abc import Iterator, Mapping, Sequence
from types import MappingProxyType
from typing import Any

import numpy as np

from gfnn_jax.dataset.measured_error import FEW
from gfnn_jax.dataset.structures import Bodies
from gfnn_jax.errors import FitError, OutOfTime
from gfnn_jax.families.sums import matrix_free
from gfnn_jax.families.told import anything_told
from gfnn_jax.fitting.linear_starts import forward_start, log_start, midpoint_start
from gfnn_jax.fitting.significance import ABOVE_NOISE, null_terms, significant
from gfnn_jax.flows.collocation import of_lanes
from gfnn_jax.flows.rates import rates
from gfnn_jax.models.hamiltonians.fitted_law import FittedLaw
from gfnn_jax.models.hamiltonians.friction import Forces, beside_friction
from gfnn_jax.models.hamiltonians.libraries import libraries_of, own_terms, promising
from gfnn_jax.models.hamiltonians.problem import LawProblem, operations_of
from gfnn_jax.models.parameters import states_and_functions, walked

NONE: Mapping[int, FittedLaw] = MappingProxyType({})


def of_libraries(problem: LawProblem, early: Mapping[int, FittedLaw]) -> FittedLaw:
    """The best library of terms of H, without friction or with it; without, where something is told
    of coefficients. early: the first libraries without friction, where these are fitted already."""

    def search(forces: Forces | None = None, data=problem.data) -> FittedLaw:
        return _searched(problem.on(data), forces, early if forces is None else NONE)

    if anything_told(problem.terms):
        return search()
    found = search() if problem.data.args is None else _walked(problem)
    return beside_friction(problem, found, search)


def small_libraries(problem: LawProblem) -> dict[int, FittedLaw]:
    """The smallest libraries that a search for H begins with, up to the first that is exact, by how
    many are left after each.

    They are soon fitted, at steps too long for the matching of atoms too, and the search goes on
    from them.
    """
    laws = _laws(problem, _libraries(problem), most=problem.options.small)
    fitted: dict[int, FittedLaw] = {}
    with contextlib.suppress(OutOfTime):  # whatever follows finds no time either
        for left, law in laws:
            fitted[left] = law
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
) -> Iterator[tuple[int, FittedLaw]]:
    """The laws of libraries of up to so many terms, each fitted from the one before, with how many
    libraries are left. early: of them, those that are fitted already."""
    last: FittedLaw | None = None
    for left, family in zip(reversed(range(len(libraries))), libraries, strict=True):
        count = family.num_parameters
        name = f"H: {count} terms"
        if count > most:
            return
        if last is not None and exceeds_cost(problem, family, last):
            problem.on_progress(f"{name} skipped, costlier per step than the map")
            continue
        if left in early:
            last = early[left]
        else:
            problem.on_progress(name)
            last = fitted_library(problem, family, last)
        yield left, last


def _searched(
    problem: LawProblem, forces: Forces | None = None, early: Mapping[int, FittedLaw] = NONE
) -> FittedLaw:
    """The smallest library that meets the tolerance, else the best; no fewer of its terms are tried
    where libraries ended while each was better than the one before. forces: friction, that
    libraries have too. early: the first libraries, where these are fitted already."""
    options = problem.options
    in_kind = problem.data.structure is not None or problem.of_modes  # libraries differ
    most_poor = options.poor_given if problem.terms else options.poor
    most_poor = options.poor_in_kind if in_kind and forces is None else most_poor
    tried: list[FittedLaw] = []
    poor = 0
    try:
        for _, law in _laws(problem, _libraries(problem, forces), early):
            before = min((t.error.relative for t in tried), default=np.inf)
            poor = 0 if not tried or law.error.relative < options.gained * before else poor + 1
            tried.append(law)
            if problem.met_by(_best(problem, tried)) or poor == most_poor:
                break
    except OutOfTime:
        if not tried:
            raise
    best = _best(problem, tried)._replace(stalled=poor == most_poor)
    if problem.met_by(best):
        return best
    if options.only_within and not in_kind and not best.stalled and len(tried) > 2:
        best = best._replace(thresholds=())  # a series that goes on: nothing to read
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


def _libraries(problem: LawProblem, forces: Forces | None = None) -> list[Any]:
    """Libraries by rising size."""
    libraries = [f if forces is None else forces(f) for f in libraries_of(problem)]
    of_bodies = isinstance(problem.data.structure, Bodies)
    return promising(libraries, problem.data) if of_bodies else libraries


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
