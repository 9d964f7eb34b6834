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

from gfnn_jax.learn.candidates import Candidate
from gfnn_jax.learn.clock import Clock, OutOfTime
from gfnn_jax.learn.extrapolate import Course, course

# A size that gains less than this has stalled; so many in a row (a symmetric map gains nothing from
# the odd degrees), and larger families only fit noise.
_WORTHWHILE, _STALLED = 0.8, 3
# So often another sweep may be better before this one is left.
_BEATEN = 3
_FINALISTS = 3  # that are validated where none meets the tolerance
# The ratio of a step's error to its estimate hardly changes along a sweep: it is measured once an
# estimate is within the first factor of the tolerance, and from then on sizes are validated whose
# estimate times the ratio is within the second.
_CALIBRATED, _HOPEFUL = 1e3, 1.3
_NO_WORSE = 1.03  # an error larger by this factor is as good, if the map is cheaper
MET = "the tolerance is met"
# A sweep whose error is within this factor of the best one's has come as far.
AS_FAR = 1.25
_KEPT = 0.1  # of the last kept map's error: a map so much better is kept in its stead
_FAR = 10.0  # times the tolerance: a sweep that leads to no smaller error misses it


class Entry(NamedTuple):
    """A judged or validated candidate and where it came from."""

    candidate: Candidate
    sweep: Any
    size: Any


class Found(NamedTuple):
    """entries: every size that was judged. ranking: what may be chosen, the best first: those that
    meet the tolerance by rising operations, then the others by rising error. stalled: (chart,
    family) of sweeps in which larger sizes stopped helping. ended: why the search ended."""

    entries: list[Entry]
    ranking: list[Entry]
    stalled: set[tuple[str, str]]
    ended: str


def search(
    sweeps: Sequence[Any],
    bound: float,
    clock: Clock,
    say: Callable[[str], Any],
    tell: Callable[[Candidate], Any],
    on_validated: Callable[[Entry], Any] | None = None,
    dearest: float = np.inf,
) -> Found:
    """Climb the sweeps. A sweep has ``sizes`` with ``operations`` by rising order and an
    ``extent`` with which the logarithm of the error falls in proportion, ``judge(size, clock,
    say)`` and ``validate(size, judged, clock, say)``, which give candidates, ``short_of_pairs``:
    whether more pairs would allow larger sizes, and ``at(extent)``, which says what a size of this
    extent is and takes.

    bound: the tolerance on a candidate's ``validation_bound``. tell: called with every candidate.
    on_validated: called with every entry whose steps have been looked at. dearest: operations from
    which a size is of no use, because something else meets the tolerance with so many.
    """
    queue = sorted(
        ((size.operations, i, n) for i, s in enumerate(sweeps) for n, size in enumerate(s.sizes))
    )
    entries: list[Entry] = []
    best = [np.inf] * len(sweeps)
    ratio = [1.0 / _CALIBRATED] * len(sweeps)  # of a step's error to its estimate
    beaten, stalled = [0] * len(sweeps), [0] * len(sweeps)
    left: set[int] = set()
    seen: list[list[tuple[float, float]]] = [[] for _ in sweeps]  # (extent, bound) of the estimates
    cheapest, kept, ended = dearest, np.inf, ""
    try:
        for operations, i, n in queue:
            if i in left or operations >= cheapest:
                continue
            clock.check()
            sweep, size = sweeps[i], sweeps[i].sizes[n]
            judged = sweep.judge(size, clock, say)
            size = sweep.sizes[n]  # with what was trained
            candidate = judged
            # Something to keep should the search be interrupted is worth a few more looks.
            keep = on_validated is not None and judged.validation_relative < _KEPT * kept
            kept = min(kept, judged.validation_relative) if keep else kept
            if keep or ratio[i] * judged.validation_bound <= _HOPEFUL * bound:
                candidate = sweep.validate(size, judged, clock, say)
                if np.isfinite(candidate.validation_relative) and judged.validation_relative > 0:
                    ratio[i] = candidate.validation_relative / judged.validation_relative
            entries.append(Entry(candidate, sweep, size))
            tell(candidate)
            if candidate.validated and on_validated is not None:
                on_validated(entries[-1])
            if candidate.validated and candidate.validation_bound <= bound:
                cheapest = min(cheapest, operations)
                left.add(i)
            relative = judged.validation_relative
            stalled[i] = stalled[i] + 1 if relative > _WORTHWHILE * best[i] else 0
            best[i] = min(best[i], relative)
            beaten[i] += any(_beats(e.candidate, judged) for e in entries)
            if stalled[i] == _STALLED or beaten[i] == _BEATEN:
                left.add(i)
            seen[i].append((size.extent, judged.validation_bound))
            left |= _hopeless(sweeps, seen, [_known(r) for r in ratio], left, bound)
    except OutOfTime:
        ended = f"the budget of {clock.max_seconds:g} s is spent"
    if not np.isfinite(cheapest):
        entries = _finalists(entries, clock, say)
    entries = [_calibrated(e, ratio[sweeps.index(e.sweep)]) for e in entries]
    if np.isfinite(cheapest):
        ended = MET
    else:
        ended = ended or _why(sweeps, stalled, best)
        ended += _promised(sweeps, seen, [_known(r) for r in ratio], stalled, bound)
    return Found(entries, _ranking(entries, bound), _stalled_sweeps(entries), ended)


def _known(ratio: float) -> float:
    """The ratio of a step's error to its estimate, 1 until a step has been looked at."""
    return 1.0 if ratio == 1.0 / _CALIBRATED else ratio


def _courses(seen, ratio: list[float]) -> list[Course | None]:
    """Where the errors of each sweep lead."""
    return [course([(x, r * e) for x, e in sizes]) for sizes, r in zip(seen, ratio, strict=True)]


def _hopeless(
    sweeps: Sequence[Any], seen, ratio: list[float], left: set[int], bound: float
) -> set[int]:
    """The sweeps whose largest size would miss the bound by far, where another sweep has a smaller
    error already, or has come as far and leads to the bound."""
    ends = {
        i: found.error_at(sweeps[i].sizes[-1].extent)
        for i, found in enumerate(_courses(seen, ratio)) if found is not None
    }  # fmt: skip
    reached = _reached(seen, ratio)

    def better(j: int, i: int) -> bool:
        leads = j not in left and ends.get(j, np.inf) <= bound and reached[j] <= reached[i]
        return j != i and (leads or reached[j] < ends[i])

    far = [i for i, end in ends.items() if end > _FAR * bound]
    return {i for i in far if any(better(j, i) for j in range(len(sweeps)))}


def _reached(seen, ratio: list[float]) -> list[float]:
    """The smallest error of each sweep, infinite where none is judged."""
    return [r * min((e for _, e in s), default=np.inf) for s, r in zip(seen, ratio, strict=True)]


def _promised(
    sweeps: Sequence[Any], seen, ratio: list[float], stalled: Sequence[int], bound: float
) -> str:
    """What the most accurate sweep's errors, extrapolated, say of a size that would meet the bound;
    nothing where they stall, or are too few to say."""
    reached = _reached(seen, ratio)
    i = int(np.argmin(reached)) if reached else 0
    found = _courses(seen, ratio)[i] if reached else None
    if found is None or stalled[i] == _STALLED:
        return ""
    extent = found.extent_for(bound)
    if extent is None:
        return "; its error falls too slowly to tell which size would meet the tolerance"
    return f"; extrapolated, {sweeps[i].at(extent)} would meet the tolerance"


def _calibrated(entry: Entry, ratio: float) -> Entry:
    """The entry with its estimate multiplied by the ratio that its sweep has shown, if any."""
    candidate = entry.candidate
    if candidate.validated or ratio == 1.0 / _CALIBRATED:
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


def _finalists(entries: list[Entry], clock: Clock, say) -> list[Entry]:
    """The entries with the few best of them validated: one at least, whatever the time."""
    best = sorted(
        (e for e in entries if not e.candidate.validated),
        key=lambda e: (e.candidate.validation_relative, e.candidate.train_rms),
    )
    # Of those that are as good as the best, the cheapest comes second.
    as_good = [e for e in best[1:] if _as_good(e, best[0])]
    second = sorted(as_good, key=lambda e: e.candidate.operations)[:1]
    best = [*best[:1], *second, *(e for e in best[1:] if e not in second)]
    done: dict[int, Entry] = {}
    for entry in best[:_FINALISTS]:
        if done and clock.left <= 0:
            break
        free = Clock()  # a step of the held-out pairs is short
        candidate = entry.sweep.validate(entry.size, entry.candidate, free, say)
        done[id(entry)] = entry._replace(candidate=candidate)
    return [done.get(id(e), e) for e in entries]


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
    """Whether an entry's error is no larger than the best one's but for what is not worth while."""
    limit = _NO_WORSE * best.candidate.validation_relative
    return entry.candidate.validation_relative <= limit


def _beats(rival: Candidate, candidate: Candidate) -> bool:
    """Whether a size of another sweep is better for no more operations: at all for the same
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
        if len(errors) > 2 and min(errors[-2:]) > _WORTHWHILE * min(errors[:-2]):
            found.add(sweep)
    return found


def _why(sweeps: Sequence[Any], stalled: list[int], best: Sequence[float]) -> str:
    """Why a search that met nothing ended before its time. Sweeps far from the best one's error
    tell nothing."""
    good = [i for i, s in enumerate(sweeps) if s.sizes and best[i] <= AS_FAR * min(best)]
    if any(stalled[i] == _STALLED for i in good):
        return "larger models are no more accurate: noise, or a structure they cannot represent"
    if any(sweeps[i].short_of_pairs for i in good):
        return "the pairs determine no larger model: more pairs would help"
    if good:
        return "there is no larger model to try: a smaller dt or region of states would help"
    return "the pairs determine no model at all"
