"""S of noisy pairs: its size, chart and coefficients without the bias of noisy evaluation points.

A search compares sizes by residuals that are nearly all noise, and fits at measured points. Where
that is what stopped it, the sweeps that came as far as the best are fitted again to the states that
the pairs most likely had (`models.generating_functions.map_arcs`). In these rows the residual is a
distance from the map's graph in units of the noise, whatever the chart, and the expected error of
every size on fresh pairs follows from one factor, as Mallows' C_p does (Technometrics 15 (1973)
661).
"""

import contextlib
import dataclasses
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from gfnn_jax.budget import ROWS, Budget
from gfnn_jax.candidates.assemble import Candidate, validated
from gfnn_jax.dataset.dataset import Dataset
from gfnn_jax.dataset.measured_error import Tolerance
from gfnn_jax.dataset.runs import arcs_of_pairs, onward
from gfnn_jax.errors import OutOfTime
from gfnn_jax.families.products import Products
from gfnn_jax.fitting import uncertainty
from gfnn_jax.fitting.triangle import Triangle
from gfnn_jax.generating.arcs import GeneratedOnArcs
from gfnn_jax.learn.conclude import only_noise
from gfnn_jax.learn.request import Request
from gfnn_jax.learn.searches import Searched
from gfnn_jax.models.generating_functions.map_arcs import LONGEST, NearestArcs
from gfnn_jax.models.generating_functions.sweeps import (
    FREE,
    SAMPLE_ROWS,
    Factors,
    LinearSweep,
    Size,
    part_of_noise,
    quiet,
)
from gfnn_jax.models.hamiltonians.search import preferred
from gfnn_jax.search.search import GAINED, Entry

_MOST_SWEEPS = 3
_WHAT = "the fit of S to the states that noisy pairs most likely had"
_NO_WORSE = 1.2  # of the expected squared error: a map that is cheaper is as good


def without_bias(found: Searched, request: Request) -> Searched:
    """The search with S fitted to the states that the pairs most likely had, where noise is what
    stopped it; else as it is.

    Left as they are: maps with parameters, of several dt, of many degrees of freedom by a
    structure, of sines, and behind a law's flow.
    """
    ranking, law = found.found.ranking, found.law
    if not ranking or request.structure is not None or found.of_terms is not None:
        return found
    best = ranking[0]
    met = found.tolerance.met_by(best.candidate)
    if met or (law is not None and preferred(law.candidate, best.candidate, Tolerance(np.inf))):
        return found
    rivals = _as_far(found)
    if not rivals or request.budget.over:
        return found
    work = sum(3 * e.sweep.work_of_factor(e.sweep.largest_known) for e in rivals)
    try:
        with request.budget.unit(_WHAT, ROWS, work):
            if not only_noise(best, found):
                return found
            request.watch.on_progress("fitting S to the states that noisy pairs most likely had")
            entry = _corrected(rivals, request)
    except OutOfTime:
        request.budget.leave_out(_WHAT, request.budget.ended)
        return found
    except np.linalg.LinAlgError:  # a chart that is singular at some pair
        request.budget.leave_out(_WHAT, "the chart is singular at some of the pairs")
        return found
    if not GAINED * entry.candidate.validation_relative <= best.candidate.validation_relative:
        return found
    request.watch.on_candidate(entry.candidate)
    others = [e for e in found.found.entries if e.size is not entry.size]
    again = found.found._replace(entries=[*others, entry], ranking=[entry, *ranking])
    return found._replace(found=again)


def _as_far(found: Searched) -> list[Entry]:
    """The best entry of every sweep that has come as far as the best one and can be corrected.

    All by their residuals: a search validates few by steps, whose errors are no measure of those
    that were estimated where noise is nothing like the spread, as of a radial momentum."""
    best: dict[int, tuple[float, Entry]] = {}
    limit = _estimated(found.found.ranking[0]) / GAINED
    for entry in found.found.entries:
        error = _estimated(entry)
        known = best.get(id(entry.sweep))
        if error <= limit and (known is None or error < known[0]):
            best[id(entry.sweep)] = error, entry
    able = [(error, e) for error, e in best.values() if e.sweep.linear and e.sweep.moved_by_states]
    able = [one for one in able if isinstance(one[1].size.family, Products)]
    able = [one for one in able if not one[1].sweep.data.varied]
    return [e for _, e in sorted(able, key=lambda known: known[0])[:_MOST_SWEEPS]]


def _estimated(entry: Entry) -> float:
    """The error that the held-out residuals of ∇S tell; of a network the validated one."""
    if not entry.sweep.linear:
        return entry.candidate.validation_relative
    return entry.sweep.estimate(entry.size, FREE, quiet).validation_relative


class Expected(NamedTuple):
    """A size of a sweep: its squared error on fresh pairs, their noise in it, misfit weighed as in
    the posterior; what noise of its coefficients alone makes of that; and the variance of the
    noise. In units of its rows."""

    size: Size
    error: float
    own: float
    noise: float


def best_size(sweep: LinearSweep, near: Size, most: Size, budget: Budget, on_progress) -> Expected:
    """The size of the smallest expected error, among those up to ``most``, and those beyond as long
    as the last one is the best.

    The largest size tells the noise. Misfit is alike along an orbit, and weighs as much as in the
    posterior: of two sizes with one error at step 1, that with less misfit is better at step 100.
    near: whose residuals tell how noise is shared.
    """
    while True:
        train = sweep.factors(most.group, budget, on_progress).train
        place = sweep.sizes.index(most)
        sizes = sweep.sizes[: place + 1]
        counts = [size.family.num_parameters for size in sizes]
        left = [train.residual_norm(count) ** 2 for count in counts]
        taken = np.array(sweep.degrees_of_freedom(near, most, counts))
        noise = left[-1] / (train.rows - taken[-1])
        # What each size leaves out of the next, beyond what that one makes of noise.
        added = np.maximum(-np.diff(left) - noise * np.diff(taken), 0.0)
        misfit = np.append(np.cumsum(added[::-1])[::-1], 0.0)
        own = noise * taken / train.rows
        errors = noise + own + sweep.alike * misfit / train.rows
        best = int(np.argmin(errors))
        if best < place or place + 1 == len(sweep.sizes):
            return Expected(sizes[best], float(errors[best]), float(own[best]), noise)
        group = sweep.sizes[place + 1].group  # of sizes that are estimated from one factor
        most = [size for size in sweep.sizes if size.group is group][-1]


def _corrected(rivals: list[Entry], request: Request) -> Entry:
    """The entry of smallest expected error, or the cheapest that is as good."""
    given = request.budget, request.watch.on_progress
    estimated: list[tuple[NoisySweep, Expected, Size]] = []
    deviations = None
    for entry in rivals:
        start, most = entry.size, entry.sweep.largest_known
        # The same for all, so that their distances have one unit.
        unit = entry.sweep.state_deviations(start) if deviations is None else deviations
        with contextlib.suppress(np.linalg.LinAlgError):
            sweep = NoisySweep(entry.sweep, entry.sweep, start, unit)
            estimated.append((sweep, best_size(sweep, start, most, *given), most))
            deviations = unit
    if deviations is None:
        raise np.linalg.LinAlgError("expected a chart that is regular at all pairs")
    floor = min(expected.noise for _, expected, _ in estimated)
    risks = [max(expected.error - floor, expected.own) for _, expected, _ in estimated]
    low = _NO_WORSE * min(risks)
    good = (j for j, risk in zip(estimated, risks, strict=True) if risk <= low)
    sweep, expected, most = min(good, key=lambda j: j[1].size.operations)
    size = expected.size
    # Once more, by states that a corrected S has found: where an S of too many terms reaches beyond
    # the states, one pass is not enough.
    with contextlib.suppress(np.linalg.LinAlgError):
        again = NoisySweep(sweep.plain, sweep, size, deviations)
        sweep, size = again, best_size(again, size, most, *given).size
    free = Budget(), request.watch.on_progress
    # Noise puts measured states beyond all true ones, where the step of a large S may have no root.
    place = sweep.sizes.index(size)
    for size in sweep.sizes[place::-1]:
        candidate = sweep.validate(size, sweep.estimate(size, *free), *free)
        if np.isfinite(candidate.validation_relative):
            break
    return Entry(candidate, sweep, size)


class NoisySweep(LinearSweep):
    """The sizes of a sweep, in rows of the states that its arcs most likely had.

    plain: the sweep. near: one whose solution of ``size`` says where those states are. deviations:
    (2d,) of the noise of each of the user's coordinates.
    """

    def __init__(self, plain: LinearSweep, near: LinearSweep, size: Size, deviations: np.ndarray):
        self.__dict__.update(plain.__dict__)
        self.plain, self._kept, self._factors, self._solved = plain, None, {}, {}
        data, coefficients = self.data, near.solve(size)[0].coefficients

        def nearest(rows) -> NearestArcs:
            rows = np.sort(rows)
            z0, z1, longest, steps = _chained(data, rows)
            arcs = arcs_of_pairs(z0, z1, longest, steps)
            assert arcs is not None
            sigma = deviations
            if data.weight is not None:
                own = sigma / data.weight[rows]
                along = arcs_of_pairs(own, own, longest, steps)
                assert along is not None
                sigma = np.where(np.isfinite(along.states), along.states, sigma)
            ends = data.before, data.after
            model = GeneratedOnArcs(
                size.family, self.chart, data.dt, arcs.moves, ends, coordinates=data.coordinates
            )
            return NearestArcs.of(model, coefficients, arcs, sigma)

        self._along = nearest
        self._nearest, self._nearest_held = map(nearest, (data.training, data.validation))

    def _computed(self, group, budget: Budget, on_progress) -> Factors:
        pairs, width = self._rows_of(group)
        train = self._part(pairs * width).triangle(group, budget.check)
        held = self._nearest_held.triangle(group, budget.check)
        return Factors(train, held, train, Triangle.empty(group.num_parameters))

    def _part(self, numbers: int) -> NearestArcs:
        """Arcs that stand for about so many numbers, drawn at random."""
        arcs = len(self._nearest.x)
        share = numbers / (len(self.data.training) * self._width)
        if share >= 1:
            return self._nearest
        drawn = np.random.default_rng(0).permutation(arcs)[: max(1, int(np.ceil(share * arcs)))]
        return self._nearest.take(np.sort(drawn))

    @property
    def alike(self) -> float:
        """Misfit's weight: along arcs of several steps it adds up in the rows themselves."""
        return uncertainty.ALIKE if self._nearest.x.shape[1] == 2 else 1.0

    def degrees_of_freedom(self, near: Size, most: Size, counts: Sequence[int]) -> list[float]:
        """Count the terms: the rows of an arc are independent."""
        return [float(count) for count in counts]

    def estimate(self, size: Size, budget: Budget, on_progress) -> Candidate:
        """Judge as the sweep that was corrected does, by the measured points."""
        return self.plain.estimate(size, budget, on_progress)

    def validate(self, size: Size, estimated: Candidate, budget: Budget, on_progress) -> Candidate:
        """The estimated size solved in these rows, and its error measured by steps."""
        plain = self.plain.validate(size, estimated, budget, on_progress)
        solved, params = self.solve(size, budget, on_progress)
        candidate = dataclasses.replace(plain, condition=solved.condition, rank=solved.rank)
        return validated(candidate, self.data, self.tolerance, self.chart, size.family, params)

    def predicted(self, size: Size, others: np.ndarray, rows: np.ndarray) -> np.ndarray:
        """Predict by a fit to the states that other rows most likely had."""
        of = size.family
        fitted_to, held = self._along(others).triangle(of), self._nearest_held.triangle(of)
        return self._predicted(size, fitted_to, held, rows)

    def work_of_test_rows(self, size: Size) -> float:
        """Zero: noise falls with the root of the rows, by a twentieth."""
        return 0.0

    def error_by_noise(self, size: Size) -> float:
        """Error by noise of the measured points."""
        return self.plain.error_by_noise(size)

    def root(self, size: Size) -> np.ndarray:
        """Root of the covariance, as the sweep's own, of rows that are independent."""
        train, count = self.factors(size.group).train, size.family.num_parameters
        solved, larger = self.solve(size)[0], self._larger(size)
        most = size.family if larger is None else larger.family
        blocks = list(self._part(SAMPLE_ROWS * most.num_parameters).rows(most))
        rows, numbers = np.concatenate([rows for rows, _ in blocks]), sum(n for _, n in blocks)
        of_sample = Triangle.of(rows)

        def left(of: Size) -> tuple[float, float, int]:
            terms, known = of.family.num_parameters, larger and larger.group in self._factors
            triangle = self._factors[of.group].train if known else of_sample
            rows = triangle.rows if known else numbers
            return triangle.residual_norm(terms) ** 2 / rows, float(terms), rows

        noise = None if larger is None else part_of_noise(size, larger, left(size), left(larger))
        slopes = rows[:, :count]
        parts = (slopes, slopes @ solved.coefficients - rows[:, -1])
        return uncertainty.root(train, count, parts, noise=noise, ridge=solved.ridge)


def _chained(data: Dataset, rows) -> tuple[np.ndarray, np.ndarray, int, Any]:
    """Arguments of `arcs_of_pairs` for these rows: the user's states, angles lifted along an arc. A
    p of period 2π is none to S: its pairs are arcs of their own."""
    steps, angles = onward(data.pairs, rows), list(data.user_angles)
    if not data.coordinates.plain:
        return data.pairs.z0[rows], data.pairs.z1[rows], LONGEST, steps
    z0, z1 = data.y0[rows], data.whole_image(data.y1[rows], rows)
    for piece in reversed(data.before):
        z0 = piece.inverse().image(z0)
    if angles:
        steps = np.where(max(angles) < data.dim, steps == 1, False).astype(int)
        turns = np.round((z1[:-1] - z0[1:])[:, angles] / (2 * np.pi)) * steps[:, None]
        lifted = 2 * np.pi * np.concatenate([np.zeros((1, len(angles))), np.cumsum(turns, axis=0)])
        z0, z1 = z0.copy(), z1.copy()
        z0[:, angles] += lifted
        z1[:, angles] += lifted
    return z0, z1, LONGEST, steps
