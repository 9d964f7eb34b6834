"""Generated maps that a law helps to: of pairs of its flow, or of what its flow leaves over."""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from gfnn_jax.budget import FLOW
from gfnn_jax.candidates.assemble import Candidate
from gfnn_jax.coordinates import Coordinates, to_inner, to_user
from gfnn_jax.dataset.dataset import Dataset
from gfnn_jax.diagnosis.damping import Diagnosis, diagnosed
from gfnn_jax.diagnosis.local_jacobians import Charts
from gfnn_jax.errors import FitError, InputError, OutOfTime
from gfnn_jax.families.terms import Terms
from gfnn_jax.fitting.gauss_newton import Problem
from gfnn_jax.flows.collocation import images
from gfnn_jax.flows.flow import Flow
from gfnn_jax.flows.legendre import Legendre
from gfnn_jax.flows.rates import rates
from gfnn_jax.models.generating_functions.sweeps import sweeps_for, trial_residual
from gfnn_jax.models.hamiltonians.learned_law import LearnedHamiltonian
from gfnn_jax.models.hamiltonians.problem import OPTIONS as OF_H
from gfnn_jax.models.hamiltonians.problem import LawProblem, contraction_of, flow_operations
from gfnn_jax.phase_space import Pairs
from gfnn_jax.search.search import Entry, Found, Search

# Pairs and terms of the simplest laws that are factored out, pairs by which it is found out where,
# and the error, of the spread, above which a law explains too little (benchmarks/auto.py).
_FITTED, _MOST_STRONG, TRIAL_PAIRS, _EXPLAINED = 200, 4, 1_000, 0.3
_THERE_AND_BACK = 8.0  # steps of a law's flow, at each of the states


class LawMaps(NamedTuple):
    """The maps that were found, and the charts in which they were looked for."""

    found: Found
    charts: Charts

    @property
    def bound(self) -> float:
        """The error of the best; infinite where there is none."""
        ranking = self.found.ranking
        return ranking[0].candidate.validation_bound if ranking else np.inf


@dataclasses.dataclass(frozen=True)
class LawMapSearch:
    """The search for S with the help of a law.

    problem: behind whose pairs the law was found. on_candidate, better: as of `search.Search`.
    """

    law: LearnedHamiltonian
    problem: LawProblem
    on_candidate: Callable[[Candidate], Any]
    better: Callable[[Entry], Any] | None
    seed: int

    def improved(self, maps: LawMaps, sweeps, dearest: float) -> LawMaps:
        """The maps that the law helps to, where these are better, else those at hand. sweeps: that
        were searched. dearest: operations of a step of a map that is chosen beside the law."""
        problem, law, bound = self.problem, self.law, self.problem.tolerance.bound
        if problem.tolerance.met_by(law.candidate):
            larger = (s for s in sweeps if s.short_of_pairs and s.sizes)
            if maps.bound > bound and any(s.sizes[-1].operations < dearest for s in larger):
                problem.on_progress("drawing pairs from the flow of H")
                return self.of_law(dearest) or maps
            return maps
        # What stalls in noise would stall without most of the motion too.
        ended = problem.budget.over or not maps.found.ranking or maps.found.stalled
        explains = law.candidate.validation_relative < _EXPLAINED
        if problem.data.args is None and not ended and maps.bound > bound and explains:
            problem.on_progress(f"learning the residual of the flow of {law.candidate.label}")
            around = self.around()
            least = min(maps.bound, law.candidate.validation_bound)
            return around if around is not None and around.bound < least else maps
        return maps

    def of_law(self, dearest: float) -> LawMaps | None:
        """Maps fitted to pairs that are drawn from the law's flow, and judged by the user's
        validation rows; None where none of them meets the tolerance, or no chart covers the drawn
        pairs."""
        data, law = self.problem.data, self.law
        try:
            name = "pairs drawn from the flow of H"
            with self.problem.budget.unit(name, FLOW, self._work(NUM_PAIRS)):
                z = data.pairs.z0
                more = drawn(law.flow, data.coordinates, z, data.dt, Drawing(seed=self.seed))
        except OutOfTime:
            return None
        try:
            diagnosis = self._diagnosed(data.validating(more))
        except FitError:  # drawn ones go further than the user's; the law itself is left
            return None
        found = self._searched(diagnosis, None).to_its_end(dearest)
        maps = LawMaps(
            found._replace(ended="the tolerance is met, by a map of pairs drawn from H's flow"),
            diagnosis.charts,
        )
        return maps if maps.bound <= self.problem.tolerance.bound else None

    def around(self) -> LawMaps | None:
        """Maps of a law's flow Φ and of S, which learns what Φ leaves over: of the whole law, then
        of its strongest terms, which leave more over but smoother. None where Φ has no image of
        some of the states, or no chart covers what is left."""
        data, law = self.problem.data, self.law
        best: LawMaps | None = None
        for laws in ([(law.flow.family, np.asarray(law.flow.params))], strongest(law, data)):
            if not laws:
                break
            try:
                name = "the residual of the flow of H"
                with self.problem.budget.unit(name, FLOW, self._work(len(data))):
                    flows = [flow_of(family, c, data) for family, c in laws]
                    flow, rest = factored_out(flows, data, self.seed)
                    diagnosis = self._diagnosed(rest)
            except OutOfTime:
                break
            except FitError:
                continue
            found = self._around(flow, diagnosis)
            if best is None or found.bound < best.bound:
                best = found if found.found.ranking else best
            if best and best.bound <= self.problem.tolerance.bound:
                break
        return best

    def _around(self, flow: Flow, diagnosis: Diagnosis) -> LawMaps:
        """The search for S around one flow, whose operations are added to every candidate's."""
        more = flow_operations(flow, self.problem.data)
        found = self._searched(diagnosis, self.better).to_its_end()

        def dearer(entry: Entry) -> Entry:
            candidate = dataclasses.replace(
                entry.candidate,
                operations=entry.candidate.operations + more,
                label=f"{entry.candidate.label} around H",
            )
            return entry._replace(candidate=candidate)

        entries, ranking = ([dearer(e) for e in part] for part in (found.entries, found.ranking))
        return LawMaps(found._replace(entries=entries, ranking=ranking), diagnosis.charts)

    def _diagnosed(self, data: Dataset) -> Diagnosis:
        scene = self.problem.scene
        return diagnosed(data, "auto", scene.reversor if scene else None, self.seed)

    def _searched(self, diagnosis: Diagnosis, better) -> Search:
        problem, charts = self.problem, diagnosis.charts.charts
        sweeps = sweeps_for("auto", charts, diagnosis.data, problem.tolerance, problem.scene)
        given = problem.tolerance.bound, problem.budget, problem.on_progress
        return Search(list(sweeps), *given, self.on_candidate, better)

    def _work(self, states: int) -> float:
        """Operations of the law's flow, there and back, at so many states."""
        return _THERE_AND_BACK * states * self.law.candidate.operations


def factored_out(flows: Sequence[Flow], data: Dataset, seed: int) -> tuple[Flow, Dataset]:
    """The pairs without one of these flows: before, after, or half on either side of what is
    learned, whichever leaves the map that a small S comes closest to."""

    def misfit(rest: Dataset) -> float:
        rows = np.random.default_rng(seed).permutation(len(rest))[:TRIAL_PAIRS]
        return trial_residual(rest.take(rows))

    tried = [(flow, data.without(*pieces)) for flow in flows for pieces in around(flow)]
    errors = [misfit(rest) for _, rest in tried]
    return tried[0] if errors[0] <= 2 * min(errors) else tried[int(np.argmin(errors))]


def flow_of(family: Terms, params, data: Dataset) -> Flow:
    """The flow of a law over dt, to roundoff: to be factored out.

    data: without a base map. Raises FitError where it has no image of some of the states.
    """
    y0, y1, dt, scale = data.y0, data.y1, data.dt, data.scale
    problem = Problem(y0, y1, dt, scale)
    (steps,) = problem.fine_steps(family, params, np.arange(len(y0)))
    fastest = rates(family, params, y0[: OF_H.rated])
    by_newton = not contraction_of(fastest, dt, steps) <= OF_H.contracting
    flow = Flow(family, params, dt, scale, steps.stages, steps.substeps, by_newton)
    failed = ~np.isfinite(np.concatenate([flow.image(y0), flow.inverse().image(y1)])).all(axis=1)
    if failed.any():
        raise FitError(
            f"base: the flow of the given H fails for {int(failed.sum())} of {len(y0) + len(y1)} "
            "states within one step. Check its formula and units, or leave these states out"
        )
    return flow


def around(flow: Flow) -> list[tuple[Flow | None, Flow | None]]:
    """Pieces (before, after) around what is learned: half of the flow on either side, which
    keeps the symmetry in time, or all of it on one, which suits a kick."""
    half = dataclasses.replace(flow, dt=0.5 * flow.dt)
    return [(half, half), (flow, None), (None, flow)]


def strongest(law: LearnedHamiltonian, data: Dataset) -> list[tuple[Terms, np.ndarray]]:
    """The law's one, two … strongest terms, with coefficients fitted anew, as far as their flow
    explains most of the motion."""
    family, c = law.flow.family, np.asarray(law.flow.params)
    if isinstance(family, Legendre):  # its terms are those of L
        return []
    rows = data.training[:TRIAL_PAIRS]
    slopes = family.term_gradients(data.y0[rows]) * data.scale[:, None]
    strength = np.abs(c) * np.sqrt(np.mean(np.sum(slopes**2, axis=1), axis=0))
    order = np.argsort(-strength)
    problem = Problem(data.y0, data.y1, data.dt, data.scale)
    laws = []
    for count in range(1, min(len(c), _MOST_STRONG + 1)):
        kept = np.sort(order[:count])
        part = family.take(kept.tolist())
        found = problem.fit(part, c[kept], rows[:_FITTED], rounds=False)
        if found.rms < _EXPLAINED:
            laws.append((part, found.coefficients))
    return laws


NUM_PAIRS = 4_000


@dataclasses.dataclass(frozen=True)
class Drawing:
    """Draw of pairs; tuned on benchmarks/auto.py.

    region: (2, 2d), lowest and highest values of the user's coordinates, in which states are drawn
    uniformly; None: around given states. longest: steps of the law's own rollouts. beyond: of the
    data's extent, on either side, as far as what is drawn may go. jitter: of the spread of what
    they visit: orbits are thin, a map has to hold between them.
    """

    num_pairs: int = NUM_PAIRS
    seed: int = 0
    region: Any = None
    longest: int = 30
    beyond: float = 0.1
    jitter: float = 0.05


def drawn(
    flow: Flow, coordinates: Coordinates, states, dt: float, how: Drawing = Drawing()
) -> Pairs:
    """Pairs a time ``dt`` apart, in the user's coordinates.

    flow: the law, in the inner ``coordinates``. states: (N, 2d) of the user, around which pairs are
    drawn, where no region is given: each is taken a few steps along first.

    Raises FitError where the law gives most of these states no image.
    """
    rng, num_pairs = np.random.default_rng(how.seed), how.num_pairs
    scale = np.asarray(flow.scale)
    if how.region is None:
        y = to_inner(coordinates, np.asarray(states, np.float64))
        inside, start = _near(y, coordinates, how), y[rng.integers(0, len(y), num_pairs)]
        y = _visited(flow, start, inside, rng.integers(0, how.longest + 1, num_pairs))
        moved = y + how.jitter * np.nanstd(y, axis=0) * rng.standard_normal(y.shape)
        y = np.unique(np.where(inside(moved)[:, None], moved, y), axis=0)
    else:
        low, high = checked_region(how.region, flow.family.dim)
        y = to_inner(coordinates, rng.uniform(low, high, (num_pairs, len(low))))
    y = y[np.isfinite(y).all(axis=1)]
    problem = Problem(y, y, dt, scale)
    family, params = flow.family, np.asarray(flow.params)
    (steps,) = problem.fine_steps(family, params, np.arange(len(y)))
    z0 = to_user(coordinates, y)
    z1 = to_user(coordinates, images(family, params, y, dt, steps).states)
    good = np.isfinite(z0 + z1).all(axis=1)
    if good.sum() < 0.5 * num_pairs:
        raise FitError(
            f"accelerate: the flow of H over dt = {dt:g} fails for {num_pairs - int(good.sum())} "
            f"of {num_pairs} states of the region. Choose a smaller region= or dt="
        )
    return Pairs(z0[good], z1[good], dt)


def checked_region(region, dim: int) -> tuple[np.ndarray, np.ndarray]:
    """(lowest, highest) values (2d,). Raises InputError where they are not that."""
    try:
        box = np.asarray(region, np.float64)
    except (TypeError, ValueError):
        box = np.zeros(0)
    if box.shape != (2, 2 * dim) or not (np.isfinite(box).all() and (box[0] < box[1]).all()):
        raise InputError(
            f"expected a region of shape (2, {2 * dim}), lowest values below highest, got "
            f"{np.array2string(box, precision=3, threshold=12) if box.size else repr(region)}"
        )
    return box[0], box[1]


def _near(
    y: np.ndarray, coordinates: Coordinates, how: Drawing
) -> Callable[[np.ndarray], np.ndarray]:
    """Mark the states (N, 2d) that are in the box of the data, or not far beyond it: orbits that
    escape would be most of what is drawn."""
    low, high = np.nanmin(y, axis=0), np.nanmax(y, axis=0)
    beyond = how.beyond * (high - low)
    free = [*coordinates.angles, *coordinates.cyclic]
    beyond[free] = np.inf
    return lambda y: ((y >= low - beyond) & (y <= high + beyond)).all(axis=1)


def _visited(flow: Flow, y: np.ndarray, inside, left: np.ndarray) -> np.ndarray:
    """Each state taken along by so many of the law's own steps, or to where it leaves."""
    family, params, dt = flow.family, np.asarray(flow.params), float(np.asarray(flow.dt))
    problem = Problem(y, y, dt, np.asarray(flow.scale))
    (steps,) = problem.fine_steps(family, params, np.arange(len(y)), (1e-6,))
    going = np.flatnonzero(left)
    while going.size:
        moved = images(family, params, y[going], dt, steps).states
        good = inside(moved)
        y[going[good]] = moved[good]
        left[going] -= 1
        going = going[good & (left[going] > 0)]
    return y
