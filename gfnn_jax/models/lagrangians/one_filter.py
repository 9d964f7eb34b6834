"""One filter that all columns of a driven record went through, as those of a logger do.

A linear law holds behind such a filter as it does before it. One that is not linear does not: waves
that a force makes of others are shifted against them. A delay of all columns is not seen, and of a
smooth phase the next part turns the frequency ω by phase·ω³ (`signals.filters`). Its size is found
by fits of a law to columns as they were before filters of several phases; what they leave has a low
there, which is narrow.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from scipy.optimize import minimize_scalar

from gfnn_jax.dataset.stretches import MOST_STEPS, arcs_of
from gfnn_jax.fitting.evidence import EVIDENCE, criterion
from gfnn_jax.models.lagrangians.fit import ArcProblem, LawFit


class Options:
    """Options of the search for a filter (`benchmarks/public.py`, and records drawn at random).

    tried: phases, in radians at the frequency of the fastest motion. settled: of their spacing;
    apart: of it, over which what is left is differenced. longer: times the steps of a fit, of which
    a phase close by is found, for what the law lacks moves it. coloured: samples over which
    residuals are correlated, and loud: times the noise, either of which a law leaves that lacks
    something.
    """

    tried: tuple[float, ...] = tuple(k / 40 for k in range(-4, 17))
    settled: float = 0.02
    apart: float = 0.1
    longer: int = 4
    coloured: float = 1.2
    loud: float = 1.0


class Found(NamedTuple):
    """A phase (s³) at ω³, its standard error, and the logarithm of what a law leaves beside it."""

    phase: float
    error: float
    left: float


def phase_of(fit: LawFit, before: Callable[..., ArcProblem]) -> float | None:
    """The phase beside which a law of these terms leaves least; None where that is not clearly
    less than without a filter, and where its residuals are white.

    ``before`` makes the problem of the columns before a filter of a phase (s³), of the steps of a
    fit or of ``most``."""
    if fit.correlation < Options.coloured and fit.loudest < Options.loud:
        return None
    unit, count = fit.problem.scales.omega**-3, fit.independent
    least = 2 * EVIDENCE.logarithm + np.log(count)
    left = np.array([_left(fit, before(unit * one)) for one in Options.tried])
    best = int(np.argmin(left[1:-1])) + 1
    plain = left[Options.tried.index(0.0)]
    if not count * (plain - _lowest_of(left[best - 1 : best + 2])) > least:
        return None
    found = lowest(fit, before, unit * Options.tried[best])
    plain = _left(fit, before(0.0, Options.longer * MOST_STEPS))
    return found.phase if count * (plain - found.left) > least else None


def _lowest_of(three: np.ndarray) -> float:
    """The lowest value of a parabola through three at even steps, the middle one the least."""
    low, least, high = three
    bend = low - 2 * least + high
    return float(least - (high - low) ** 2 / (8 * bend)) if 0 < bend < np.inf else float(least)


def lowest(fit: LawFit, before: Callable[..., ArcProblem], about: float) -> Found:
    """The phase close to one ``about`` beside which a law of these terms leaves least."""
    spacing = float(np.ptp(Options.tried[:2])) / fit.problem.scales.omega**3

    def left(phase: float) -> float:
        return _left(fit, before(phase, Options.longer * MOST_STEPS))

    around, settled = (about - spacing, about + spacing), {"xatol": Options.settled * spacing}
    low: Any = minimize_scalar(left, bounds=around, method="bounded", options=settled)
    phase, least, apart = float(low.x), float(low.fun), Options.apart * spacing
    bend = (left(phase - apart) + left(phase + apart) - 2 * least) / apart**2
    error = float(np.sqrt(2 / (fit.independent * bend))) if bend > 0 else np.inf
    return Found(phase, error, least)


def is_likelier(other: LawFit, fit: LawFit) -> bool:
    """Return whether a law of columns before a filter is clearly likelier than one without it."""
    count, own = fit.independent, criterion(_size(fit, fit), fit.independent, len(fit.p))
    unlikely = criterion(_size(other, fit), count, len(other.p) + 1)
    return bool(other.follows and unlikely < own - 2 * EVIDENCE.logarithm)


def _left(fit: LawFit, other: ArcProblem) -> float:
    """The logarithm of what a law of these terms leaves of other columns."""
    problem = other.by_rule(fit.problem.inputs.hold)
    arcs = arcs_of(problem.nodes, fit.arcs.t.shape[1])
    again = problem.fit(fit.structure, fit.values, arcs, fit.sigma)
    return float(np.log(_size(again, fit))) if again.follows else np.inf


def _size(other: LawFit, fit: LawFit) -> float:
    """The mean square of another fit's residuals, in units of the noise of one."""
    return float(np.mean((other.rms() / fit.problem.scales.sigma) ** 2))
