"""The time a fit may take."""

from __future__ import annotations

import time

# Processor seconds that compiling a step takes, by its unknowns 2d: small eliminations are
# unrolled, and larger ones call the library (`solve.linear`). jax 0.10.2, two cores.
_COMPILING = {2: 3.0, 4: 5.0, 6: 9.0, 8: 18.0}
_COMPILING_MORE = 9.0
_MOST_RESERVED = 1 / 3  # of a budget
# So many times longer than its processor seconds a busy machine lets a compilation take at most.
_BUSIEST = 3.0


class OutOfTime(Exception):
    """The budget of a fit is spent; what was found so far stands."""


class Clock:
    """Seconds since its making, and the budget: ``check`` raises OutOfTime once it is spent.

    dim: of the map whose step is compiled when the search has ended: the time for that is
    reserved. None: nothing is.
    """

    def __init__(self, max_seconds: float | None = None, dim: int | None = None):
        self.max_seconds = max_seconds
        self._compiling = 0.0 if dim is None else _COMPILING.get(2 * dim, _COMPILING_MORE)
        self._started, self._worked = time.perf_counter(), time.process_time()

    @property
    def seconds(self) -> float:
        return time.perf_counter() - self._started

    @property
    def left(self) -> float:
        """Seconds of the budget that are left for the search, infinite without a budget."""
        if self.max_seconds is None:
            return float("inf")
        return self.max_seconds - self.seconds - self._reserved(self.max_seconds)

    @property
    def left_in_all(self) -> float:
        """Seconds of the budget that are left, those that are reserved included."""
        return float("inf") if self.max_seconds is None else self.max_seconds - self.seconds

    def _reserved(self, budget: float) -> float:
        """Longer where other work has slowed this process down since the clock was made."""
        worked = max(time.process_time() - self._worked, 1e-3)
        busy = min(max(self.seconds / worked, 1.0), _BUSIEST)
        return min(self._compiling * busy, _MOST_RESERVED * budget)

    def check(self) -> None:
        if self.left <= 0:
            raise OutOfTime
