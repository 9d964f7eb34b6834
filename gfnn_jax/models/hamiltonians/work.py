"""The units of work of a search for H, and its cap in counted operations."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator

from gfnn_jax.budget import FLOW, Allowance, Budget, Counted
from gfnn_jax.fitting.gauss_newton import Problem
from gfnn_jax.flows.collocation import Steps, operations

# Evaluations of the flow, with its derivatives, that a fit of a library is expected to take; of
# terms that are known to be close to their optimum.
_EVALUATIONS, _CLOSE = 20, 6
_STEPS = Steps(6, 1)


class LawWork:
    """Work that a search for H may still do.

    A library takes as many times the operations of one evaluation as the library before it did. The
    search has a cap of its own, on the operations that it makes: without a budget that is what ends
    it, at the same library on any machine.

    dearest: operations of a step above which H is not taken, for a map at hand meets the tolerance
    with fewer; infinite where none does.
    """

    def __init__(
        self, problem: Problem, budget: Budget, most: float, dearest: float = float("inf")
    ):
        self._problem, self.budget, self._cap = problem, budget, Counted(most)
        self.dearest = dearest
        self._evaluations = float(_EVALUATIONS)
        problem.allowance = Allowance(budget, self._cap)

    @property
    def ended(self) -> str:
        """Reason that cut the search short; "" where nothing has."""
        capped = f"the search for H reached its own limit of {self._cap.most:.2g} operations"
        return self.budget.ended or (capped if self._cap.spent > self._cap.most else "")

    def made(self) -> float:
        """Operations so far."""
        return self._cap.spent

    def capped(self, most: float) -> None:
        """Cap the search anew, beside what it has made."""
        self._cap.most = self._cap.spent + most

    def uncapped(self) -> None:
        """Lift the cap: what follows a search is soon done."""
        self._cap.most = float("inf")

    @contextlib.contextmanager
    def library(self, name: str, family, rows: int, *, first: bool = False) -> Iterator[None]:
        """The fit of a library to so many pairs. first: it is fitted whatever the budget, where
        nothing else would be left."""
        one = self._one(family, rows)
        before, allowance = self._cap.spent, self._problem.allowance
        if first:
            self._problem.allowance = Allowance(cap=self._cap)
            unit = self.budget.free(FLOW, self._evaluations * one, self.made)
        else:
            unit = self.budget.unit(name, FLOW, self._evaluations * one, made=self.made)
        try:
            with unit:
                yield
        finally:
            self._problem.allowance = allowance
        self._evaluations = (self._cap.spent - before) / one

    @contextlib.contextmanager
    def again(self, name: str, family, rows: int) -> Iterator[None]:
        """A unit in which terms that are close to their optimum are fitted to so many pairs. It
        makes a law of a library, so that the end of the search is no reason to leave it out."""
        work = _CLOSE * self._one(family, rows)
        if not self.budget.over:
            with self.budget.unit(name, FLOW, work, made=self.made):
                yield
            return
        allowance = self._problem.allowance
        self._problem.allowance = Allowance(cap=self._cap)
        try:
            with self.budget.last(name, FLOW, work, decides=True, made=self.made):
                yield
        finally:
            self._problem.allowance = allowance

    def round(self, name: str, expected: float):
        """A unit of so many operations."""
        return self.budget.unit(name, FLOW, expected, made=self.made)

    def _one(self, family, rows: int) -> float:
        """Operations of an evaluation."""
        return rows * operations(family, self._problem.z0.shape[1], _STEPS, family)


def work_of_refit(family, rows: int, dim: int, steps: Steps) -> float:
    """Operations of a fit of terms that are close to their optimum to so many pairs."""
    return _CLOSE * rows * operations(family, 2 * dim, steps, family)
