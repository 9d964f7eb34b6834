"""The time a fit may take."""

from __future__ import annotations

import time


class OutOfTime(Exception):
    """The budget of a fit is spent; what was found so far stands."""


class Clock:
    """Seconds since its making, and the budget: ``check`` raises OutOfTime once it is spent."""

    def __init__(self, max_seconds: float | None = None):
        self.max_seconds = max_seconds
        self._started = time.perf_counter()

    @property
    def seconds(self) -> float:
        return time.perf_counter() - self._started

    @property
    def left(self) -> float:
        """Seconds of the budget that are left, infinite without a budget."""
        return float("inf") if self.max_seconds is None else self.max_seconds - self.seconds

    def check(self) -> None:
        if self.left <= 0:
            raise OutOfTime
