"""Libraries of terms for H: polynomials, features, modes of angles, a user's own terms."""

from collections.abc import Iterable, Iterator
from typing import Any

import numpy as np
from scipy.optimize import lsq_linear

from gfnn_jax.coordinates import TWO_PI
from gfnn_jax.dataset.dataset import Dataset
from gfnn_jax.diagnosis.residuals import misfit
from gfnn_jax.errors import FitError
from gfnn_jax.families.expressions import parse, to_text
from gfnn_jax.families.modes import modes
from gfnn_jax.families.sums import Sums
from gfnn_jax.families.terms import Terms, given_terms, joined, multiplied, polynomial_terms
from gfnn_jax.families.told import Constrained, Told, told_of, untold
from gfnn_jax.fitting.significance import null_terms
from gfnn_jax.generating.charts import MIDPOINT
from gfnn_jax.models.hamiltonians.fitted_law import FittedLaw
from gfnn_jax.models.hamiltonians.problem import OPTIONS, LawProblem
from gfnn_jax.models.parameters import angles_and_others


def own_terms(problem: LawProblem) -> Terms | None:
    """The user's own terms, None where there are none."""
    given, data = problem.terms, problem.data
    return given_terms(data.dim, untold(given), data.parameters) if given else None


def check_finite(given: Terms, data: Dataset, rows) -> None:
    """Raises FitError for a user's term that has no value or no slope at some of the states."""
    z = data.y0[rows]
    slopes = given.term_gradients(z, data.given(rows)[1])
    for j, name in enumerate(given.term_names):
        bad = ~np.isfinite(slopes[:, :, j]).all(axis=1)
        if bad.any():
            raise FitError(
                f"expected terms that are finite at all states, got '{name}', which is not at "
                f"{int(bad.sum())} of {len(z)}"
            )


def libraries_of(problem: LawProblem) -> Iterator[Terms | Sums | Constrained]:
    """Families by rising size, of as many terms as the training rows tell apart."""
    data, scene, options = problem.data, problem.scene, problem.options
    if data.structure is not None:
        libraries = data.structure.libraries(data.dim, problem.terms)
        yield from (f for f in libraries if f.num_parameters <= problem.most_terms)
        return
    most, own = options.most_terms, own_terms(problem)
    if problem.of_modes:
        most, of_data = options.most_modes, (data.dim, *angles_and_others(data))
        boxes = options.boxes if own is None else options.given_boxes
        if own is None and has_another_period(data):
            boxes = boxes[:2]
        families = (modes(*of_data, *box) for box in boxes)
    else:
        features, reversor = (None, None) if scene is None else (scene.features, scene.reversor)
        degrees = options.degrees if features is None else options.feature_degrees
        degrees = degrees if own is None else options.given_degrees
        given = {"cyclic": data.coordinates.cyclic, "features": features, "reversor": reversor}
        families = (polynomial_terms(data.dim, degree, **given) for degree in degrees)
    if own is not None:
        families = _beside(own, families)
    for library in families:
        if library.num_parameters > min(problem.most_terms, most):
            return
        yield library if own is None else constrained(problem, library)


def has_another_period(data: Dataset) -> bool:
    """Return whether something named as an angle has not the period 2π, as an angle in degrees: it
    runs over turns, and moves are alike of states that are near each other as numbers, but not of
    those that are near each other as angles."""
    rows = data.training[: OPTIONS.turning]
    z = np.asarray(data.pairs.z0)[rows]
    angles = [i for i in angles_and_others(data)[0] if np.ptp(z[:, i]) > 2 * TWO_PI]
    if not (angles and data.coordinates.plain):
        return False
    x, turns = z / data.scale, z[:, angles]
    x[:, angles] = turns / turns.std(axis=0)  # their scale is that of one turn
    turned = np.hstack([np.delete(x, angles, axis=1), np.cos(turns), np.sin(turns)])
    moves = np.asarray(data.pairs.z1)[rows] - z
    as_numbers, as_angles = (_differ(states, moves) for states in (x, turned))
    return as_angles > OPTIONS.unlike and as_numbers < OPTIONS.alike * as_angles


def _differ(x: np.ndarray, moves: np.ndarray) -> float:
    """The mean square by which moves (N, n) differ between states x (N, k) and their nearest
    neighbours, over that of any two, at most over the columns."""
    from scipy.spatial import cKDTree  # pyright: ignore[reportAttributeAccessIssue]

    moves = moves[:, np.ptp(moves, axis=0) > 0]
    near = cKDTree(x).query(x, k=2)[1][:, 1]
    return float(np.max(np.mean((moves[near] - moves) ** 2, axis=0) / (2 * moves.var(axis=0))))


def _beside(own: Terms, families: Iterator[Terms]) -> Iterator[Terms]:
    """A user's terms alone, beside each family, and times those of the first one too."""
    yield own
    for n, family in enumerate(families):
        yield joined(own, family)
        if n == 0:
            yield joined(joined(own, family), multiplied(own, family))


def promising(libraries: list[Any], data: Dataset) -> list[Any]:
    """The libraries but those that leave far more of the midpoints' gradients over than another
    does, as that of equal bodies does of unequal ones: the fit of such a one takes longest."""
    if data.varied or len(data.training) < OPTIONS.telling:
        return libraries
    left = [misfit(family, data, MIDPOINT) for family in libraries]
    most = OPTIONS.worse * min(left, default=np.inf)
    return [f for f, part in zip(libraries, left, strict=True) if part <= most]


def told_terms(dim: int, terms: Iterable[Any]) -> tuple[Told, ...]:
    """Everything that is told of coefficients, by the terms' names as families have them.

    Raises InputError for text that cannot be read.
    """

    def named(text: str) -> str:
        return to_text(parse(text, dim), dim)

    told = [one for one in map(told_of, (t for t in terms if isinstance(t, str))) if one.says]
    return tuple(
        one._replace(term=named(one.term), of=None if one.of is None else named(one.of))
        for one in told
    )


def constrained(problem: LawProblem, library: Terms) -> Terms | Constrained:
    """The library with what is told. Its terms are taken apart first: one that is the same function
    as a bound one would make it free."""
    told, data = told_terms(problem.data.dim, problem.terms), problem.data
    if not told:
        return library
    rows = data.training[: max(200, 4 * library.num_parameters)]
    return Constrained.of(library.take(null_terms(library, data.y0[rows])[0]), told)


def within_bounds(problem: LawProblem, law: FittedLaw) -> FittedLaw:
    """The law whose coefficients are within the bounds that are told, fitted to the rows of its
    fit. Raises FitError where every coefficient is held."""
    bounds = {one.term: (one.low, one.high) for one in _bounds(problem)}
    if not bounds:
        return law
    family, c = _with_bounded(problem, law)
    ends = np.array([bounds.get(name, (-np.inf, np.inf)) for name in family.term_names])
    held: dict[int, float] = {}
    fit = law.fit
    rows = np.setdiff1d(problem.data.training, np.setdiff1d(law.rows, fit.used))
    for _ in range(problem.options.rounds):
        found = problem.flows.linearised(family, c, fit.steps, rows).rebased(c)
        columns, target = found.factor[:, :-1], found.factor[:, -1]
        size = np.linalg.norm(columns, axis=0)
        best = lsq_linear(columns / size, target, (ends * size[:, None]).T, method="bvls")
        sides = dict(enumerate(best.active_mask))
        binding = {j: float(ends[j, int(side > 0)]) for j, side in sides.items() if side}
        if binding == held and (held or family is law.family):
            break
        if len(binding) == len(c):
            raise FitError("terms: every coefficient would be held at its bound: widen the bounds")
        start = np.delete(best.x / size, list(binding))
        law = law.with_fit(problem.fitted(family.held(binding), start, rows, rounds=False))
        fit, rows, held = law.fit, law.fit.used, binding
        c = family.params_of(law.family, fit.coefficients)
        if not held:
            break
    return law


def breaks_bounds(problem: LawProblem, law: FittedLaw) -> bool:
    """Return whether a coefficient is outside the bounds that are told."""
    known = unbound(law).values
    return not all(one.low <= known.get(one.term, 0.0) <= one.high for one in _bounds(problem))


def held_at_bounds(problem: LawProblem, law: FittedLaw) -> list[str]:
    """Messages about the coefficients of an unbound law that are held at a bound."""
    return [
        f"{one.term} is held at its bound: the pairs alone would put its coefficient beyond"
        for one in _bounds(problem)
        if law.values.get(one.term, 0.0) in (one.low, one.high)
    ]


def unbound(law: FittedLaw) -> FittedLaw:
    """The law with a coefficient and an error of every term, those that are held included."""
    family = law.family
    if not isinstance(family, Constrained):
        return law
    fit, whole = law.fit, law.whole
    if whole is not None:
        whole = whole._replace(root=root_of_all(family, whole.root))
    fit = fit._replace(
        coefficients=family.coefficients(fit.coefficients),
        standard_errors=np.abs(family.basis) @ fit.standard_errors,
    )
    return law._replace(family=family.family, fit=fit, whole=whole)


def root_of_all(family: Constrained, root: np.ndarray) -> np.ndarray:
    """(N, N): the root of the covariance of all coefficients from that of the free ones (m, m)."""
    square = np.zeros((len(family.fixed), len(family.fixed)))
    square[: len(root)] = root @ family.basis.T
    return square


def _bounds(problem: LawProblem) -> list[Told]:
    told = told_terms(problem.data.dim, problem.terms)
    return [one for one in told if one.of is None and one.low < one.high]


def _with_bounded(problem: LawProblem, law: FittedLaw) -> tuple[Constrained, np.ndarray]:
    """The family and its params, with terms that were dropped though 0 is outside their bounds."""
    family, c = law.family, law.fit.coefficients
    names = family.family.term_names
    gone = [o for o in _bounds(problem) if o.term not in names and not o.low <= 0 <= o.high]
    if not gone:
        return family, c
    given = given_terms(problem.data.dim, untold(problem.terms))
    more = given.take([given.term_names.index(one.term) for one in gone])
    both, count = joined(family.family, more), len(gone)
    basis = np.zeros((len(family.fixed) + count, len(c) + count))
    basis[:-count, :-count], basis[-count:, -count:] = family.basis, np.eye(count)
    free = (*family.free, *range(len(family.fixed), len(family.fixed) + count))
    return (
        Constrained(both, np.append(family.fixed, np.zeros(count)), basis, free),
        np.append(c, np.zeros(count)),
    )
