"""The search: which sizes of which sweeps are tried, in what order, and which one is chosen.

All sweeps are climbed together by rising operations per step, until the next size costs more than
one that is accurate enough. A sweep is left that no longer gains, that another keeps beating, or
whose errors do not lead to the tolerance where another's do, or whose largest size promises no more
than another has reached.
Only sizes that may be accurate enough, and the few best where none is, are validated by steps.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from gfnn_jax.budget import ROWS, SOLVE, Budget, OutOfTime
from gfnn_jax.candidates.candidate import Candidate
from gfnn_jax.search.extrapolate import GAINED, Decay, decay_of
from gfnn_jax.search.sweep import Climbed

# A size that gains less than this has stalled; so many in a row (a symmetric map gains nothing from
# the odd degrees), and larger families only fit noise.
_STALLED = 3
# So often another sweep may be better before this one is left.
_BEATEN = 3
_FINALISTS = 3  # that are validated where none meets the tolerance
# The ratio of a step's error to its estimate hardly changes along a sweep: it is measured once an
# estimate is within the first factor of the tolerance, and from then on sizes are validated whose
# estimate times the ratio is within the second.
_CALIBRATED, _WITHIN_REACH = 1e3, 1.3
_NO_WORSE = 1.03  # an error larger by this factor is as good, if the map is cheaper
MET = "the tolerance is met"
_KEPT = 0.1  # of the last kept map's error: a map so much better is kept in its stead
_FAR = 10.0  # times the tolerance: a sweep that leads to no smaller error misses it


class Entry(NamedTuple):
    """A candidate, estimated or validated, of a size of a sweep (`search.sweep.Sweep`)."""

    candidate: Candidate
    sweep: Any
    size: Any


class Found(NamedTuple):
    """entries: every size that was estimated. ranking: what may be chosen, the best first: those
    that meet the tolerance by rising operations, then the others by rising error. stalled: (chart,
    family) of sweeps in which larger sizes stopped helping. ended: why the search ended."""

    entries: list[Entry]
    ranking: list[Entry]
    stalled: set[tuple[str, str]]
    ended: str


class Search:
    """A climb of sweeps (`search.sweep.Climbed`), which may be made in parts.

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
        self._queue = sorted(
            (size.operations, i, n) for i, s in enumerate(sweeps) for n, size in enumerate(s.sizes)
        )
        self._entries: list[Entry] = []
        self._best = [np.inf] * len(sweeps)
        # Of a step's error to its estimate, by sweep; None until a step has been looked at.
        self._ratio: list[float | None] = [None] * len(sweeps)
        self._beaten, self._stalled = [0] * len(sweeps), [0] * len(sweeps)
        self._left: set[int] = set()
        # (order, bound) of the estimates
        self._errors: list[list[tuple[float, float]]] = [[] for _ in sweeps]
        self._cheapest, self._kept, self._unfinished = np.inf, np.inf, False

    def climb(self, dearest: float = np.inf, most: float = np.inf) -> None:
        """Estimate size after size, one at least, up to the first that takes more than ``most``
        operations to estimate, or as far as the budget goes. dearest: operations of a step from
        which a size is of no use, because something else meets the tolerance with so many."""
        self._cheapest = min(self._cheapest, dearest)
        try:
            while self._queue:
                operations, i, n = self._queue[0]
                if i not in self._left and operations < self._cheapest:
                    work = self.sweeps[i].work(self.sweeps[i].sizes[n])
                    if work > most and self._entries:
                        return
                    self._look_at(i, n)
                self._queue.pop(0)
        except OutOfTime:
            self._unfinished = True

    def to_its_end(self, dearest: float = np.inf) -> Found:
        """Climb as far as the budget goes; what was found."""
        self.climb(dearest)
        return self.found()

    def _look_at(self, i: int, n: int) -> None:
        """One size: estimated, and validated by steps where it may be accurate enough."""
        sweep, size = self.sweeps[i], self.sweeps[i].sizes[n]
        follows = SOLVE, sweep.work_of_steps(size)
        with self._budget.unit(sweep.named(size), ROWS, sweep.work(size), then=follows):
            estimated = sweep.estimate(size, self._budget, self._on_progress)
        size = sweep.sizes[n]  # with what was trained
        entry = Entry(estimated, sweep, size)
        self._entries.append(entry)
        relative = estimated.validation_relative
        # Something to keep should the search be interrupted is worth a few more looks.
        keep = self._on_validated is not None and relative < _KEPT * self._kept
        self._kept = min(self._kept, relative) if keep else self._kept
        known = self._ratio[i]
        ratio = 1.0 / _CALIBRATED if known is None else known
        if keep or ratio * estimated.validation_bound <= _WITHIN_REACH * self._bound:
            entry = self._validated(entry)
            error = entry.candidate.validation_relative
            if np.isfinite(error) and relative > 0:
                self._ratio[i] = error / relative
        candidate = entry.candidate
        self._on_candidate(candidate)
        if candidate.validated and self._on_validated is not None:
            self._on_validated(entry)
        if candidate.validated and candidate.validation_bound <= self._bound:
            self._cheapest = min(self._cheapest, size.operations)
            self._left.add(i)
        self._stalled[i] = self._stalled[i] + 1 if relative > GAINED * self._best[i] else 0
        self._best[i] = min(self._best[i], relative)
        self._beaten[i] += any(_beats(e.candidate, estimated) for e in self._entries)
        if self._stalled[i] == _STALLED or self._beaten[i] == _BEATEN:
            self._left.add(i)
        self._errors[i].append((size.order, estimated.validation_bound))
        self._left |= _hopeless(self.sweeps, self._errors, self._ratios, self._left, self._bound)

    def _validated(self, entry: Entry) -> Entry:
        """The entry with its error measured by steps, in its place among the others."""
        sweep, size = entry.sweep, entry.size
        name = f"steps of {sweep.named(size)}"
        with self._budget.unit(name, SOLVE, sweep.work_of_steps(size)):
            candidate = sweep.validate(size, entry.candidate, self._budget, self._on_progress)
        return self._replaced(entry, candidate)

    def _replaced(self, entry: Entry, candidate: Candidate) -> Entry:
        place = next(k for k, e in enumerate(self._entries) if e is entry)
        self._entries[place] = entry._replace(candidate=candidate)
        return self._entries[place]

    @property
    def cheapest(self) -> float:
        """Operations of a step of the cheapest size that meets the tolerance; infinite where none
        does."""
        return self._cheapest

    @property
    def _ratios(self) -> list[float]:
        return [1.0 if r is None else r for r in self._ratio]

    def found(self) -> Found:
        """Gather what there is; where nothing meets the tolerance, with the few best validated."""
        met = bool(np.isfinite(self._cheapest))
        if not met:
            self._validate_the_best()
        sweeps, stalled = self.sweeps, self._stalled
        entries = [_calibrated(e, self._ratio[sweeps.index(e.sweep)]) for e in self._entries]
        ended = MET
        if not met:
            ended = self._budget.ended if self._unfinished else _why(sweeps, stalled, self._best)
            ended += _promised(sweeps, self._errors, self._ratios, stalled, self._bound)
        return Found(entries, _ranking(entries, self._bound), _stalled_sweeps(entries), ended)

    def _validate_the_best(self) -> None:
        """The few best of the entries, validated: one at least, whatever the budget."""
        best = _finalists([e for e in self._entries if not e.candidate.validated])
        for place, entry in enumerate(best):
            if place == 0:
                work = entry.sweep.work_of_steps(entry.size)
                with self._budget.free(SOLVE, work):
                    free = Budget()
                    estimated = entry.sweep.validate(
                        entry.size, entry.candidate, free, self._on_progress
                    )
                self._replaced(entry, estimated)
                continue
            try:
                self._validated(entry)
            except OutOfTime:
                return


def _decays(errors, ratio: list[float]) -> list[Decay | None]:
    """Extrapolate the errors of each sweep."""
    return [
        decay_of([(x, r * e) for x, e in sizes]) for sizes, r in zip(errors, ratio, strict=True)
    ]


def _hopeless(
    sweeps: Sequence[Any], errors, ratio: list[float], left: set[int], bound: float
) -> set[int]:
    """The sweeps whose largest size would miss the bound by far, where another sweep has a smaller
    error already, or has come as far and leads to the bound."""
    ends = {
        i: found.error_at(sweeps[i].sizes[-1].order)
        for i, found in enumerate(_decays(errors, ratio))
        if found is not None
    }
    reached = _reached(errors, ratio)

    def better(j: int, i: int) -> bool:
        leads = j not in left and ends.get(j, np.inf) <= bound and reached[j] <= reached[i]
        return j != i and (leads or reached[j] < ends[i])

    far = [i for i, end in ends.items() if end > _FAR * bound]
    return {i for i in far if any(better(j, i) for j in range(len(sweeps)))}


def _reached(errors, ratio: list[float]) -> list[float]:
    """The smallest error of each sweep, infinite where none is estimated."""
    return [r * min((e for _, e in s), default=np.inf) for s, r in zip(errors, ratio, strict=True)]


def _promised(
    sweeps: Sequence[Any], errors, ratio: list[float], stalled: Sequence[int], bound: float
) -> str:
    """Extrapolation of the most accurate sweep's errors to a size that would meet the bound;
    nothing where they stall, or are too few to say."""
    reached = _reached(errors, ratio)
    i = int(np.argmin(reached)) if reached else 0
    found = _decays(errors, ratio)[i] if reached else None
    if found is None or stalled[i] == _STALLED:
        return ""
    order = found.order_for(bound)
    if order is None:
        return "; its error falls too slowly to predict which size would meet the tolerance"
    return f"; extrapolated, {sweeps[i].at(order)} would meet the tolerance"


def _calibrated(entry: Entry, ratio: float | None) -> Entry:
    """The entry with its estimate multiplied by the ratio that its sweep has shown, if any."""
    candidate = entry.candidate
    if candidate.validated or ratio is None:
        return entry
    return entry._replace(
        candidate=dataclasses.replace(
            candidate,
            validation_rms=ratio * candidate.validation_rms,
            validation_relative=ratio * candidate.validation_relative,
            validation_bound=ratio * candidate.validation_bound,
            deviations=ratio * candidate.deviations,
        )
    )


def _finalists(entries: list[Entry]) -> list[Entry]:
    """The few best of these entries."""
    best = sorted(entries, key=lambda e: (e.candidate.validation_relative, e.candidate.train_rms))
    # Of those that are as good as the best, the cheapest comes second.
    as_good = [e for e in best[1:] if _as_good(e, best[0])]
    second = sorted(as_good, key=lambda e: e.candidate.operations)[:1]
    best = [*best[:1], *second, *(e for e in best[1:] if e not in second)]
    return best[:_FINALISTS]


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
    limit = _NO_WORSE * best.candidate.validation_relative
    return entry.candidate.validation_relative <= limit


def _beats(rival: Candidate, candidate: Candidate) -> bool:
    """Return whether a size of another sweep is better for no more operations: at all for the same
    functions in another chart, by far for other functions, which may gain faster later."""
    if (rival.chart, rival.family) == (candidate.chart, candidate.family):
        return False
    margin = 1.0 if rival.family == candidate.family else 10.0
    return (
        rival.operations <= 1.1 * candidate.operations
        and margin * rival.validation_relative < candidate.validation_relative
    )


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


def _why(sweeps: Sequence[Any], stalled: list[int], best: Sequence[float]) -> str:
    """Reason why a search that met nothing ended before its time. Sweeps far from the best one's
    error tell nothing."""
    good = [i for i, s in enumerate(sweeps) if s.sizes and GAINED * best[i] <= min(best)]
    if any(stalled[i] == _STALLED for i in good):
        return "larger models are no more accurate"
    if any(sweeps[i].short_of_pairs for i in good):
        return "the pairs determine no larger model: more pairs would help"
    if good:
        return "there is no larger model to try: a smaller dt or region of states would help"
    return "the pairs determine no model at all"
