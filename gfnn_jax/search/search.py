"""The search: which sizes of which sweeps are tried, in what order, and which one is chosen.

All sweeps are climbed together by rising operations per step, until the next size costs more than
one that is accurate enough. A sweep is left that no longer gains, that another keeps beating, or
whose errors do not lead to the tolerance where another's do, or whose largest size promises no more
than another has reached.
Only sizes that may be accurate enough, and the few best where none is, are validated by steps.

A sweep is a protocol: who searches, chooses, states the error and draws the conclusions asks it for
these members, and never which model it is of.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, Protocol, runtime_checkable

import numpy as np

from gfnn_jax.budget import ROWS, SOLVE, Budget
from gfnn_jax.candidates.assemble import Candidate, composed
from gfnn_jax.dataset.dataset import Dataset
from gfnn_jax.errors import OutOfTime
from gfnn_jax.maps.symplectic_map import SymplecticMap


class Options:
    """Rules of when a sweep is left, and which of its sizes are validated (study: constants)."""

    # A size that gains less than this has stalled; so many in a row (a symmetric map gains nothing
    # from the odd degrees), and larger families only fit noise.
    stalled: int = 3
    # So often another sweep may be better before this one is left.
    beaten: int = 3
    finalists: int = 3  # that are validated where none meets the tolerance
    # The ratio of a step's error to its estimate hardly changes along a sweep: it is measured once
    # an estimate is within the first factor of the tolerance, and from then on sizes are validated
    # whose estimate times the ratio is within the second.
    calibrated: float = 1e3
    within_reach: float = 1.3
    no_worse: float = 1.03  # an error larger by this factor is as good, if the map is cheaper
    kept: float = 0.1  # of the last kept map's error: a map so much better is kept in its stead
    far: float = 10.0  # times the tolerance: a sweep that leads to no smaller error misses it
    # Sizes of a smaller range foretell nothing: an even S gains nothing from every other degree.
    range: float = 2.0
    # Extrapolated over more than so many times the orders that were seen, a decay means nothing.
    farthest: float = 3.0


MET = "the tolerance is met"
# A size whose error ÷ the least before it is more than this has gained nothing; a sweep whose least
# error, times this, is no larger than the best one's has come as far.
GAINED = 0.8
OnProgress = Callable[[str], Any]


@runtime_checkable
class Climbed(Protocol):
    """Sizes of one model as a search climbs them.

    sizes: by rising ``operations`` of a step, each with an ``order`` with which the logarithm of
    the error falls in proportion. short_of_pairs: whether more pairs would allow larger sizes.
    """

    sizes: Sequence[Any]
    short_of_pairs: bool

    def named(self, size: Any) -> str:
        """Name of the unit of work that estimates the size."""
        ...

    def at(self, order: float) -> str:
        """Name of a size of this order, and what it would take."""
        ...

    def work(self, size: Any) -> float:
        """Operations that estimating its error takes."""
        ...

    def work_of_steps(self, size: Any) -> float:
        """Operations that validating it takes."""
        ...

    def estimate(self, size: Any, budget: Budget, on_progress: OnProgress) -> Candidate:
        """The size fitted, with its estimated error."""
        ...

    def validate(
        self, size: Any, estimated: Candidate, budget: Budget, on_progress: OnProgress
    ) -> Candidate:
        """The estimated candidate with the error of its own steps."""
        ...


@runtime_checkable
class Sweep(Climbed, Protocol):
    """Sizes of one model on one data set, with what a fit goes on to ask of one of them.

    data: the pairs that it is fitted to. linear: whether a size is a linear least-squares problem,
    whose residuals, solutions from other rows and noise of the coefficients are at hand.
    """

    data: Dataset
    linear: bool

    def work_of_refit(self, size: Any) -> float:
        """Operations that fitting it to other rows takes, infinite where it is not fitted anew."""
        ...

    def piece(self, size: Any) -> Any:
        """The piece of a map (`maps.piece.Piece`) that the fitted size makes."""
        ...

    def images(self, size: Any, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Images of these rows (n, 2d), inner ones, and which steps were solved (n,)."""
        ...

    def predicted(self, size: Any, others: np.ndarray, rows: np.ndarray) -> np.ndarray:
        """Images (n, 2d) of these rows, in the user's coordinates, by a fit to other rows."""
        ...

    def posterior(self, size: Any) -> Callable[[], np.ndarray] | None:
        """Function that makes the covariance root (k, m) of the params of the size's piece; None
        where the model has none."""
        ...


class Entry(NamedTuple):
    """A candidate, estimated or validated, of a size of a sweep (`Sweep`)."""

    candidate: Candidate
    sweep: Any
    size: Any

    @property
    def map(self) -> SymplecticMap:
        """The map of this size."""
        return composed(self.sweep.piece(self.size), self.sweep.data)


class Found(NamedTuple):
    """entries: every size that was estimated. ranking: what may be chosen, the best first: those
    that meet the tolerance by rising operations, then the others by rising error. stalled: (chart,
    family) of sweeps in which larger sizes stopped helping. ended: why the search ended."""

    entries: list[Entry]
    ranking: list[Entry]
    stalled: set[tuple[str, str]]
    ended: str


@dataclasses.dataclass(eq=False)
class _Climb:
    """A sweep as far as it was climbed. best: of its estimates. ratio: of a step's error to its
    estimate; None until a step has been looked at. stalled: sizes in a row without a gain. beaten:
    how often another sweep was better. left: whether no larger size is tried. errors: (order,
    bound) of the estimates."""

    sweep: Climbed
    best: float = np.inf
    ratio: float | None = None
    stalled: int = 0
    beaten: int = 0
    left: bool = False
    errors: list[tuple[float, float]] = dataclasses.field(default_factory=list)

    @property
    def _calibration(self) -> float:
        return 1.0 if self.ratio is None else self.ratio

    @property
    def reached(self) -> float:
        """The smallest error, infinite where none is estimated."""
        return self._calibration * min((e for _, e in self.errors), default=np.inf)

    @property
    def decay(self) -> Decay | None:
        """The errors, extrapolated."""
        return decay_of([(x, self._calibration * e) for x, e in self.errors])

    @property
    def end(self) -> float:
        """The extrapolated error of the largest size; infinite where it is not known."""
        decay = self.decay
        return np.inf if decay is None else decay.error_at(self.sweep.sizes[-1].order)


class Search:
    """A climb of sweeps (`Climbed`), which may be made in parts.

    bound: the tolerance on a candidate's ``validation_bound``. on_candidate: called with every
    candidate. on_validated: called with every entry whose steps have been looked at.
    """

    def __init__(
        self,
        sweeps: Sequence[Climbed],
        bound: float,
        budget: Budget,
        on_progress: Callable[[str], Any],
        on_candidate: Callable[[Candidate], Any],
        on_validated: Callable[[Entry], Any] | None = None,
    ):
        self.sweeps, self._bound, self._budget = sweeps, bound, budget
        self._on_progress, self._on_candidate = on_progress, on_candidate
        self._on_validated = on_validated
        self._climbs = [_Climb(sweep) for sweep in sweeps]
        every = ((i, n, size) for i, s in enumerate(sweeps) for n, size in enumerate(s.sizes))
        self._queue = sorted((size.operations, i, n) for i, n, size in every)
        self._entries: list[Entry] = []
        self._cheapest, self._kept, self._unfinished = np.inf, np.inf, False

    def climb(self, dearest: float = np.inf, most: float = np.inf) -> None:
        """Estimate size after size, one at least, up to the first that takes more than ``most``
        operations to estimate, or as far as the budget goes. dearest: operations of a step from
        which a size is of no use, because something else meets the tolerance with so many."""
        self._cheapest = min(self._cheapest, dearest)
        try:
            while self._queue:
                operations, i, n = self._queue[0]
                climb = self._climbs[i]
                if not climb.left and operations < self._cheapest:
                    work = climb.sweep.work(climb.sweep.sizes[n])
                    if work > most and self._entries:
                        return
                    self._look_at(climb, n)
                self._queue.pop(0)
        except OutOfTime:
            self._unfinished = True

    def to_its_end(self, dearest: float = np.inf) -> Found:
        """Climb as far as the budget goes; what was found."""
        self.climb(dearest)
        return self.found()

    def _look_at(self, climb: _Climb, n: int) -> None:
        """One size: estimated, and validated by steps where it may be accurate enough."""
        sweep, size = climb.sweep, climb.sweep.sizes[n]
        follows = SOLVE, sweep.work_of_steps(size)
        with self._budget.unit(sweep.named(size), ROWS, sweep.work(size), then=follows):
            estimated = sweep.estimate(size, self._budget, self._on_progress)
        size = sweep.sizes[n]  # with what was trained
        entry = Entry(estimated, sweep, size)
        self._entries.append(entry)
        relative = estimated.validation_relative
        # Something to keep should the search be interrupted is worth a few more looks.
        keep = self._on_validated is not None and relative < Options.kept * self._kept
        self._kept = min(self._kept, relative) if keep else self._kept
        ratio = 1.0 / Options.calibrated if climb.ratio is None else climb.ratio
        if keep or ratio * estimated.validation_bound <= Options.within_reach * self._bound:
            entry = self._validated(entry, self._budget)
            error = entry.candidate.validation_relative
            if np.isfinite(error) and relative > 0:
                climb.ratio = error / relative
        candidate = entry.candidate
        self._on_candidate(candidate)
        if candidate.validated and self._on_validated is not None:
            self._on_validated(entry)
        if candidate.validated and candidate.validation_bound <= self._bound:
            self._cheapest = min(self._cheapest, size.operations)
            climb.left = True
        climb.stalled = climb.stalled + 1 if relative > GAINED * climb.best else 0
        climb.best = min(climb.best, relative)
        climb.beaten += any(_beats(e.candidate, estimated) for e in self._entries)
        climb.left |= climb.stalled == Options.stalled or climb.beaten == Options.beaten
        climb.errors.append((size.order, estimated.validation_bound))
        for hopeless in [c for c in self._climbs if self._is_hopeless(c)]:
            hopeless.left = True

    def _is_hopeless(self, climb: _Climb) -> bool:
        """Return whether the sweep's largest size would miss the bound by far, where another sweep
        has a smaller error already, or has come as far and leads to the bound."""
        end = climb.end
        if not (Options.far * self._bound < end < np.inf):
            return False
        return any(
            other.reached < end
            or (not other.left and other.end <= self._bound and other.reached <= climb.reached)
            for other in self._climbs
            if other is not climb
        )

    def _validated(self, entry: Entry, budget: Budget) -> Entry:
        """The entry with its error measured by steps, in its place among the others."""
        sweep, size = entry.sweep, entry.size
        unit = budget.unit(f"steps of {sweep.named(size)}", SOLVE, sweep.work_of_steps(size))
        with unit:
            candidate = sweep.validate(size, entry.candidate, budget, self._on_progress)
        place = next(k for k, e in enumerate(self._entries) if e is entry)
        self._entries[place] = entry._replace(candidate=candidate)
        return self._entries[place]

    @property
    def cheapest(self) -> float:
        """Operations of a step of the cheapest size that meets the tolerance; infinite where none
        does."""
        return self._cheapest

    def found(self) -> Found:
        """Gather what there is; where nothing meets the tolerance, with the few best validated."""
        met = bool(np.isfinite(self._cheapest))
        if not met:
            self._validate_the_best()
        ratios = {id(climb.sweep): climb.ratio for climb in self._climbs}
        entries = [_calibrated(e, ratios[id(e.sweep)]) for e in self._entries]
        ended = MET
        if not met:
            ended = self._budget.ended if self._unfinished else _why(self._climbs)
            ended += _promised(self._climbs, self._bound)
        return Found(entries, _ranking(entries, self._bound), _stalled_sweeps(entries), ended)

    def _validate_the_best(self) -> None:
        """The few best of the entries, validated: one at least, whatever the budget."""
        best = _finalists([e for e in self._entries if not e.candidate.validated])
        for place, entry in enumerate(best):
            if place == 0:
                with self._budget.free(SOLVE, entry.sweep.work_of_steps(entry.size)):
                    self._validated(entry, Budget())
                continue
            try:
                self._validated(entry, self._budget)
            except OutOfTime:
                return


def _promised(climbs: Sequence[_Climb], bound: float) -> str:
    """Extrapolation of the most accurate sweep's errors to a size that would meet the bound;
    nothing where they stall, or are too few to say."""
    best = min(climbs, key=lambda climb: climb.reached, default=None)
    decay = None if best is None or best.stalled == Options.stalled else best.decay
    if best is None or decay is None:
        return ""
    order = decay.order_for(bound)
    if order is None:
        return "; its error falls too slowly to predict which size would meet the tolerance"
    return f"; extrapolated, {best.sweep.at(order)} would meet the tolerance"


def _calibrated(entry: Entry, ratio: float | None) -> Entry:
    """The entry with its estimate multiplied by the ratio that its sweep has shown, if any."""
    candidate = entry.candidate
    if candidate.validated or ratio is None:
        return entry
    errors = ("validation_rms", "validation_relative", "validation_bound", "deviations")
    scaled = {name: ratio * getattr(candidate, name) for name in errors}
    return entry._replace(candidate=dataclasses.replace(candidate, **scaled))


def _finalists(entries: list[Entry]) -> list[Entry]:
    """The few best of these entries."""
    best = sorted(entries, key=lambda e: (e.candidate.validation_relative, e.candidate.train_rms))
    # Of those that are as good as the best, the cheapest comes second.
    as_good = [e for e in best[1:] if _as_good(e, best[0])]
    second = sorted(as_good, key=lambda e: e.candidate.operations)[:1]
    best = [*best[:1], *second, *(e for e in best[1:] if e not in second)]
    return best[: Options.finalists]


def _ranking(entries: list[Entry], bound: float) -> list[Entry]:
    validated = [e for e in entries if e.candidate.validated]
    meeting = [e for e in validated if e.candidate.validation_bound <= bound]
    others = sorted(
        (e for e in validated if e.candidate.validation_bound > bound),
        key=lambda e: (e.candidate.validation_relative, e.candidate.train_rms),
    )
    as_good = [e for e in others if _as_good(e, others[0])]
    return [
        *sorted(meeting, key=lambda e: e.candidate.operations),
        *sorted(as_good, key=lambda e: e.candidate.operations),
        *(e for e in others if not _as_good(e, others[0])),
    ]


def _as_good(entry: Entry, best: Entry) -> bool:
    """Return whether an entry's error is no larger than the best one's but for what is not worth
    while."""
    limit = Options.no_worse * best.candidate.validation_relative
    return entry.candidate.validation_relative <= limit


def _beats(rival: Candidate, candidate: Candidate) -> bool:
    """Return whether a size of another sweep is better for no more operations: at all for the same
    functions in another chart, by far for other functions, which may gain faster later."""
    if (rival.chart, rival.family) == (candidate.chart, candidate.family):
        return False
    margin = 1.0 if rival.family == candidate.family else 10.0
    cheaper = rival.operations <= 1.1 * candidate.operations
    return cheaper and margin * rival.validation_relative < candidate.validation_relative


def _stalled_sweeps(entries: list[Entry]) -> set[tuple[str, str]]:
    """(chart, family) of the sweeps whose last two sizes gained nothing worth while."""
    found, of_sweep = set(), {}
    for e in entries:
        of_sweep.setdefault((e.candidate.chart, e.candidate.family), []).append(
            e.candidate.validation_relative
        )
    for sweep, errors in of_sweep.items():
        if len(errors) > 2 and min(errors[-2:]) > GAINED * min(errors[:-2]):
            found.add(sweep)
    return found


def _why(climbs: Sequence[_Climb]) -> str:
    """Reason why a search that met nothing ended before its time. Sweeps far from the best one's
    error tell nothing."""
    least = min((climb.best for climb in climbs), default=np.inf)
    good = [c for c in climbs if c.sweep.sizes and GAINED * c.best <= least]
    if any(climb.stalled == Options.stalled for climb in good):
        return "larger models are no more accurate"
    if any(climb.sweep.short_of_pairs for climb in good):
        return "the pairs determine no larger model: more pairs would help"
    if good:
        return "there is no larger model to try: a smaller dt or region of states would help"
    return "the pairs determine no model at all"


class Decay(NamedTuple):
    """The logarithm of a sweep's error falls by ``rate`` per unit of order, from ``error`` at
    ``order``, at orders that are ``spacing`` apart. first: the order of the first size."""

    first: float
    order: float
    error: float
    rate: float
    spacing: float

    def error_at(self, order: float) -> float:
        """The error of the size of this order."""
        steps = math.floor(max(order - self.order, 0.0) / self.spacing + 1e-9)
        return self.error * math.exp(-self.rate * self.spacing * steps)

    def order_for(self, bound: float) -> float | None:
        """The smallest order whose error is within the bound; None where it is too far to tell."""
        if self.rate <= 0:
            return None
        fall = max(math.log(self.error / bound), 0.0)
        found = self.order + self.spacing * math.ceil(fall / (self.rate * self.spacing) - 1e-9)
        far = found - self.first > Options.farthest * max(self.order - self.first, self.spacing)
        return None if far else found


def decay_of(sizes: Sequence[tuple[float, float]]) -> Decay | None:
    """The decay of sizes (order, error), by rising order; None where they are too few.

    Only sizes count that gain: an even S gains from every other degree. The rate is the better one
    of the last two, each over two gains, so that a sweep is rather thought to be good.
    """
    finite = [(x, e) for x, e in sizes if 0 < e < math.inf]
    if not finite or finite[-1][0] - finite[0][0] < Options.range:
        return None
    gains = finite[:1]
    for order, error in finite[1:]:
        if error < GAINED * gains[-1][1]:
            gains.append((order, error))
    (first, _), (order, error) = gains[0], gains[-1]
    if len(gains) == 1:
        return Decay(first, order, error, 0.0, 1.0)
    ends = [j for j in range(1, len(gains)) if j >= len(gains) - 2 and (j > 1 or len(gains) == 2)]
    pairs = ((gains[max(j - 2, 0)], gains[j]) for j in ends)
    rates = (math.log(a[1] / b[1]) / (b[0] - a[0]) for a, b in pairs)
    return Decay(first, order, error, max(rates), order - gains[-2][0])
