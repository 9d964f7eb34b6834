"""Levenberg–Marquardt: the loop of every descent of a sum of squares.

Where a descent stands its residual is linearised, r(x + δ) ≈ r + A δ. Steps

    δ(μ) = argmin ‖A δ + r‖² + μ ‖D δ‖²

are tried under growing damping μ until one lowers the cost (Levenberg, Quart. Appl. Math. 2 (1944)
164; Marquardt, SIAM J. Appl. Math. 11 (1963) 431); then the damping shrinks. What a `Problem`
brings is the linear algebra: the singular values of a triangle (`fitting.gauss_newton`), normal
equations in one compiled program (`fitting.levenberg_marquardt`), arcs whose own states are
eliminated (`solve.latent_arcs`), coefficients that are projected out (`models.textbook.matching`).
Outside jit: NumPy alone.
"""

from __future__ import annotations

import dataclasses
from typing import Any, NamedTuple, Protocol, runtime_checkable

import numpy as np


class Tried(NamedTuple):
    """A step that was tried: the two numbers of the ratio test, and where it leads.

    decrease: of the cost; not above 0, or NaN, where the step fails. promised: the decrease that
    the linear problem foretells. damping: μ of the step. All three are numbers, or (E,) of E
    problems side by side. hopeless: no more damping would help, as at the floor of rounding.
    """

    there: Any
    decrease: Any
    damping: Any
    promised: Any = np.nan
    hopeless: bool = False


@runtime_checkable
class Problem(Protocol):
    """A sum of squares, linearised where a descent stands."""

    def tried(self, damping: Any, failures: int) -> Tried:
        """The step of this damping, after so many from here that failed."""
        ...

    def moved(self, there: Any, damping: Any) -> tuple[Problem, bool]:
        """The problem at the end of a step, and whether the descent has settled there. damping: of
        the next step."""
        ...


@dataclasses.dataclass(frozen=True)
class Factors:
    """Damping that grows and shrinks by fixed factors, as Marquardt's.

    start: of the first step. first: what no damping grows to. grown_by, shrunk_by: the factors.
    least: damping below it is none. trials: of steps from one place, at most. keeps: a step that
    needed more damping keeps it.
    """

    start: float = 0.0
    first: float = 0.0
    grown_by: float = 10.0
    shrunk_by: float = 0.1
    least: float = 0.0
    trials: int = 10
    keeps: bool = False

    def grown(self, damping: float, failures: int) -> float:
        """The damping after a step that failed, and so many before it."""
        return max(self.grown_by * damping, self.first)

    def shrunk(self, step: Tried, failures: int) -> float:
        """The damping after a step that lowered the cost, and so many that did not."""
        if self.keeps and failures:
            return step.damping
        smaller = self.shrunk_by * step.damping
        return smaller if smaller >= self.least else 0.0


@dataclasses.dataclass(frozen=True)
class Nielsen:
    """Damping by the ratio ρ of the decrease to the promised one (Nielsen, IMM-REP-1999-05).

    A step that lowered the cost leaves μ max(⅓, 1 − (2ρ − 1)³); n steps that failed leave
    μ growthⁿ 2^(n(n−1)/2). trials: of steps from one place, at most. start: NaN, where the problem
    sets the first one.
    """

    growth: float = 2.0
    trials: int = 11
    start: float = np.nan

    def grown(self, damping: Any, failures: int) -> Any:
        return damping * (self.growth * 2.0**failures)

    def shrunk(self, step: Tried, failures: int) -> Any:
        with np.errstate(all="ignore"):  # of a step that failed nothing is taken
            ratio = step.decrease / step.promised
            return step.damping * np.maximum(1 / 3, 1 - (2 * ratio - 1) ** 3)


Rule = Factors | Nielsen


class Descended(NamedTuple):
    """The problem where a descent ended, the damping of a next step, the steps that were made, and
    why there is no further one: it settled, it is stuck (no step lowers the cost), or neither."""

    problem: Any
    damping: Any
    steps: int
    settled: bool
    stuck: bool


def descended(problem: Problem, rule: Rule, most: int, damping: Any = None) -> Descended:
    """Descend from this problem until it settles or is stuck, ``most`` steps at most. damping: of
    the first step; None: the rule's."""
    damping = rule.start if damping is None else damping
    for made in range(most):
        step, after = _lowered(problem, rule, damping)
        if step is None:
            return Descended(problem, damping, made, settled=False, stuck=True)
        damping = after
        problem, settled = problem.moved(step.there, damping)
        if settled:
            return Descended(problem, damping, made + 1, settled=True, stuck=False)
    return Descended(problem, damping, most, settled=False, stuck=False)


def _lowered(problem: Problem, rule: Rule, damping: Any) -> tuple[Tried | None, Any]:
    """The first step that lowers the cost, and the damping after it. Problems side by side (E,)
    step at once: one whose step fails stays where it is and waits with more damping."""
    for failures in range(rule.trials):
        step = problem.tried(damping, failures)
        lower = step.decrease > 0
        if np.ndim(lower):
            more = rule.grown(step.damping, failures)
            return step, np.where(lower, rule.shrunk(step, failures), more)
        if lower:
            return step, rule.shrunk(step, failures)
        if step.hopeless:
            break
        damping = rule.grown(step.damping, failures)
    return None, damping
