"""What a fit may take: time, or operations."""

from __future__ import annotations

import time

# Seconds that compiling a step takes, by 2d: small eliminations are unrolled, and larger ones call
# the library (`solve.linear`). Processor time of polynomials, jax 0.10.2; other work on the machine
# makes them longer.
_COMPILING = {2: 3.0, 4: 5.0, 6: 9.0, 8: 10.0}
_COMPILING_MORE = 9.0
_MOST_RESERVED = 1 / 5  # of a budget


class OutOfTime(Exception):
    """The budget of a fit is spent; what was found so far stands."""


class Counted:
    """A budget of counted operations: what else the machine does neither shortens nor lengthens it.
    ``spend`` raises OutOfTime once it is spent."""

    def __init__(self, most: float):
        self.most, self.spent = most, 0.0

    def spend(self, operations: float) -> None:
        if self.spent > self.most:
            raise OutOfTime
        self.spent += operations


class Clock:
    """Seconds since its making, and the budget: ``check`` raises OutOfTime once it is spent.

    dim: of the map whose step is compiled when the search has ended: the time for that is
    reserved. None: nothing is.
    """

    def __init__(self, max_seconds: float | None = None, dim: int | None = None):
        self.max_seconds = max_seconds
        self._compiling = 0.0 if dim is None else _COMPILING.get(2 * dim, _COMPILING_MORE)
        self._started = time.perf_counter()

    @property
    def seconds(self) -> float:
        return time.perf_counter() - self._started

    @property
    def left(self) -> float:
        """Seconds of the budget that are left for the search, infinite without a budget."""
        if self.max_seconds is None:
            return float("inf")
        reserved = min(self._compiling, _MOST_RESERVED * self.max_seconds)
        return self.max_seconds - self.seconds - reserved

    @property
    def left_in_all(self) -> float:
        """Seconds of the budget that are left, those that are reserved included."""
        return float("inf") if self.max_seconds is None else self.max_seconds - self.seconds

    def check(self) -> None:
        if self.left <= 0:
            raise OutOfTime
