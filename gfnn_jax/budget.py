"""Budget of a fit: operations, counted in units of work. A clock only says how many fit.

A unit is a size of a sweep, a library of H, a block of a network's iterations. Its operations are
predicted before it starts, its time from those of its kind that this process has done. The first
unit that does not fit ends the search, and nothing smaller is tried in its stead: the number of
operations that were done then says which units they were, and gives the same model again whatever
the clock. Without a budget nothing looks at the clock.
"""

import contextlib
import dataclasses
import math
import time
from collections.abc import Callable, Iterator
from typing import Any, Literal, TypeVar

from gfnn_jax.errors import OutOfTime

T = TypeVar("T")
Made = Callable[[], float] | None

MAX_SECONDS = 120.0  # of a fit that is told of no budget

# Operations a second of a quiet core by kind of work, until units of a kind have been measured:
# rows folded into a factor, singular values, flows and their derivatives in NumPy, atoms of laws
# matched to gradients, iterations of a network. Compiling and reading are counted in seconds.
ROWS, SOLVE, FLOW, NETWORK, COMPILE = "rows", "solve", "flow", "network", "compile"
MATCHING, READING = "matching", "reading"
RATES = {ROWS: 1e10, SOLVE: 2e10, FLOW: 5e8, MATCHING: 1e8, NETWORK: 5e9, COMPILE: 1, READING: 1}


class _Options:
    """Shares of a budget, and what compiling takes."""

    # Seconds, at these rates, of a unit that tells its kind's own: of shorter ones most is
    # overhead.
    telling: float = 0.1
    compiling_more: float = 9.0  # seconds, of more dimensions than the table below has
    most_reserved: float = 1 / 5  # of a budget


# Seconds that compiling a step takes, by 2d: small eliminations are unrolled, and larger ones call
# the library (`solve.linear`). Processor time of polynomials, jax 0.10.2; other work on the machine
# makes them longer.
_COMPILING = {2: 3.0, 4: 5.0, 6: 9.0, 8: 10.0}


def seconds_allowed(
    max_seconds: float | Literal["auto"] | None, max_operations: int | None
) -> float | None:
    """The seconds that "auto" stands for, or what else was asked for: where operations are bounded
    the clock decides nothing, so that they give the same map again."""
    if max_seconds != "auto":
        return max_seconds
    return MAX_SECONDS if max_operations is None else None


class Counted:
    """A cap on the operations of one search, counted as they are made: what else the machine does
    neither shortens nor lengthens it. ``spend`` raises OutOfTime once it is spent."""

    def __init__(self, most: float):
        self.most, self.spent = most, 0.0

    def spend(self, operations: float) -> None:
        if self.spent > self.most:
            raise OutOfTime
        self.spent += operations


_NO_TIME, _NO_OPERATIONS = "there was no time for", "there were no operations for"


class Budget:
    """The units that a fit has done, and whether the next one fits.

    max_seconds: since its making, with those ``spent`` before it, as on reading files; None: the
    clock decides nothing. max_operations: of all units, as predicted; None: no bound. clock: gives
    seconds. dim: of the map whose step is compiled in the end: the time for that is reserved. None:
    nothing is.

    compiling: seconds that compiling the step takes, about.
    ended: why a unit did not fit, "" as long as all do. operations: of the units that were done.
    left_out: what was not done, or not kept, each with its reason.
    """

    def __init__(
        self,
        max_seconds: float | None = None,
        max_operations: int | None = None,
        clock: Callable[[], float] = time.perf_counter,
        dim: int | None = None,
        spent: float = 0.0,
    ):
        self.max_seconds, self.max_operations = max_seconds, max_operations
        self.ended, self.operations, self.left_out = "", 0, list[str]()
        self._clock, self._started = clock, clock() - spent
        self._most = math.inf if max_operations is None else max_operations
        self._done, self._last, self._closed = 0, "", False
        self._measured: dict[str, tuple[float, float]] = {}  # kind -> operations, seconds
        self._reserved: dict[str, float] = {}  # kind -> operations that follow the search
        self.compiling = 0.0 if dim is None else _COMPILING.get(2 * dim, _Options.compiling_more)

    @property
    def compilation(self) -> str:
        """The time that compiling the step takes, as progress shows it."""
        return _about(self.compiling)

    def about(self, kind: str, operations: float) -> str:
        """The time that so many operations take, as progress shows it."""
        return _about(self._foretold(kind, operations))

    @property
    def seconds(self) -> float:
        """Since its making, with those spent before it."""
        return self._clock() - self._started

    @property
    def over(self) -> bool:
        """Return whether a unit did not fit, so that no further one is begun."""
        return bool(self.ended)

    def pays_for(self, operations: float) -> bool:
        """Return whether the fit can rest on so many operations, which then count as done.

        No clock is looked at: the seconds allowed are those of a quiet core. Where they are too
        few the search ends before it has made as many, so that its own number of operations, given
        as ``max_operations``, does not pay for them either.
        """
        count = int(operations)
        allowed = math.inf if self.max_seconds is None else self.max_seconds * RATES[ROWS]
        paid = count <= min(allowed, self._most)
        if paid:
            self.operations += count
        else:
            self._most = min(self._most, count - 1)
        return paid

    @contextlib.contextmanager
    def unit(
        self,
        name: str,
        kind: str,
        operations: float,
        *,
        then: tuple[str, float] | None = None,
        made: Made = None,
    ) -> Iterator[None]:
        """One unit of work of the search. Raises OutOfTime where it does not fit.

        operations: that it is predicted to take. then: kind and operations of what must follow
        should this be the last unit; the time for it is reserved. made: gives the operations that
        were made so far, where a unit may make other than predicted: its time is theirs.
        """
        count = max(1, int(operations))
        if self.over:
            raise OutOfTime
        if then is not None:
            self._reserved[then[0]] = max(self._reserved.get(then[0], 0.0), then[1])
        if self.operations + count > self._most:
            left = max(self._most - self.operations, 0)
            needed = f"{name} needs {count:,}, and {left:,} of {self._most:,} are left"
            option = "--max-seconds" if self.max_operations is None else "--max-operations"
            self._end(_NO_OPERATIONS, f"{needed} ({option})")
        if self.max_seconds is not None:
            seconds, now = self._foretold(kind, count) + self._set_apart, self.seconds
            if now + seconds > self.max_seconds:
                left = max(self.max_seconds - now, 0.0)
                needed = f"{name} needs about {seconds:.2g} s with what must follow it"
                remaining = f"{left:.2g} of {self.max_seconds:g} s are left"
                self._end(_NO_TIME, f"{needed}, and {remaining} (--max-seconds)")
        with self._timed(kind, count, made):
            yield
        self.operations += count
        self._done, self._last = self._done + 1, name

    @contextlib.contextmanager
    def last(
        self, name: str, kind: str, operations: float, *, decides: bool = False, made: Made = None
    ) -> Iterator[None]:
        """A unit after the search, which the search's end is no reason to leave out. Raises
        OutOfTime where there is no time for it, and then for those after it too.

        decides: whether the choice depends on it. It counts as one operation then: none of the
        search's units could be done in its stead. made: as of ``unit``.
        """
        if self.max_seconds is not None:
            late = self.seconds + self._foretold(kind, operations) > self.max_seconds
            self._closed = self._closed or late
        spent = decides and self.operations >= self._most
        if self._closed or spent:
            self.leave_out(name, _NO_TIME if self._closed else _NO_OPERATIONS)
            raise OutOfTime
        with self._timed(kind, operations, made):
            yield
        self.operations += decides

    def free(
        self, kind: str, operations: float, made: Made = None
    ) -> contextlib.AbstractContextManager[None]:
        """Work that is done in any case, and counts as no operation; its time is measured. made: as
        of ``unit``."""
        return self._timed(kind, operations, made)

    def leave_out(self, what: str, why: str) -> None:
        """Have it told in the end; what the budget ended is told at length once, in ``ended``."""
        for at_length, short in ((_NO_TIME, "no time"), (_NO_OPERATIONS, "no operations")):
            why = short if why.startswith(at_length) else why
        message = f"left out: {what} ({why})"
        if message not in self.left_out:
            self.left_out.append(message)

    def check(self) -> None:
        """Check between the parts of a unit: raises OutOfTime where it takes longer than foretold
        and the time is over. The unit is then as though it had never begun."""
        if self.over:
            raise OutOfTime
        if self.max_seconds is not None and self.seconds + self._set_apart > self.max_seconds:
            over = f"{self.max_seconds:g} s are over (--max-seconds)"
            self.ended = f"{_NO_TIME}{self._after}: {over}"
            raise OutOfTime

    def _end(self, spent: str, needed: str) -> None:
        self.ended = f"{spent}{self._after}: {needed}"
        raise OutOfTime

    @property
    def _after(self) -> str:
        if not self._done:
            return " a first model"
        return f" more after step {self._done} of the search ({self._last})"

    @property
    def _set_apart(self) -> float:
        """Seconds for what follows the search."""
        assert self.max_seconds is not None
        compiling = min(self.compiling, _Options.most_reserved * self.max_seconds)
        return compiling + sum(self._foretold(*each) for each in self._reserved.items())

    def _foretold(self, kind: str, operations: float) -> float:
        """Seconds of so many operations."""
        done, seconds = self._measured.get(kind, (RATES[kind], 1.0))
        return operations * seconds / done

    @contextlib.contextmanager
    def _timed(self, kind: str, operations: float, made: Made) -> Iterator[None]:
        started, before = self._clock(), 0.0 if made is None else made()
        yield
        operations = operations if made is None else made() - before
        if operations >= _Options.telling * RATES[kind]:
            done, seconds = self._measured.get(kind, (0.0, 0.0))
            self._measured[kind] = done + operations, seconds + self._clock() - started


@dataclasses.dataclass(frozen=True)
class Allowance:
    """Bounds of the parts of a unit of work: the time of its budget, and a cap on what
    its search may make. None: no bound."""

    budget: Budget | None = None
    cap: Counted | None = None

    def check(self) -> None:
        """Check the time: `Budget.check`."""
        if self.budget is not None:
            self.budget.check()

    def spend(self, operations: float) -> None:
        """Count operations before they are made: `Counted.spend`."""
        if self.cap is not None:
            self.cap.spend(operations)


UNBOUNDED = Allowance()


def _about(seconds: float) -> str:
    return f" (about {seconds:.0f} s)" if seconds >= 1 else ""


def within(unit: contextlib.AbstractContextManager[Any], make: Callable[[], T]) -> T | None:
    """Make something inside a unit of a budget; None where the unit does not fit, or the time is
    over before its end. The one place where a search's end is caught, but for loops that keep what
    they have found."""
    try:
        with unit:
            return make()
    except OutOfTime:
        return None
