"""Residuals of a law along arcs of its record: whether they are white, and whether inputs
are in them.

Of N white residuals the correlation with any other series, and that with themselves some samples
later, has a standard deviation of 1/√N. What exceeds that was not noise: a force that the law lacks
(correlation with itself), or the timing or gain of an input (correlation with it).
"""

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np


class Options:
    """Limits of the test (`benchmarks/as_a_user.py`).

    lags: nodes, up to which residuals are correlated. beyond: standard deviations of a correlation
    that is no accident, of the largest of many. brief: of a period, that correlations of smoothed
    readings take at most.
    """

    lags: int = 20
    beyond: float = 3.0
    brief: float = 0.125


@dataclasses.dataclass(frozen=True, eq=False)
class Trace:
    """One arc: its run, times t (n,) in s, channels as measured and as the law has them (n, k),
    residuals (n, k) in units of their scale, NaN where nothing was seen, inputs (n, m), energy (n,)
    of the law, and how much of it each friction has taken (n, F) and each input has brought (n, m)
    since the arc began."""

    run: str
    t: np.ndarray
    measured: np.ndarray
    fitted: np.ndarray
    residuals: np.ndarray
    inputs: np.ndarray
    energy: np.ndarray
    lost: np.ndarray
    supplied: np.ndarray


class OfInput(NamedTuple):
    """The largest correlation of residuals with an input, the time by which the residual is later
    (s), and whether it is beyond chance."""

    correlation: float
    lag: float
    significant: bool


class Whiteness(NamedTuple):
    """Autocorrelation of the residuals of one channel: lags (s) and the autocorrelation there, the
    size (three standard deviations) that white residuals stay below, whether these do, correlations
    with inputs by name, and the share of the channel's variation about its mean that the arcs
    follow, in %."""

    lags: np.ndarray
    autocorrelation: np.ndarray
    bound: float
    white: bool
    inputs: dict[str, OfInput]
    fit_percent: float

    def smoothed_over(self, period: float) -> float:
        """The time (s) over which the readings are smoothed, where the residuals are correlated for
        less than an eighth of a period: a force that is missing moves for longer. Else 0."""
        rho = self.autocorrelation[1:]
        chance = self.bound * np.sqrt(1 + 2 * np.sum(rho**2))
        beyond = np.flatnonzero(np.abs(rho) > chance)
        first = beyond[-1] + 2 if len(beyond) and beyond[-1] + 2 < len(self.lags) else 0
        return float(self.lags[first]) if self.lags[first] < Options.brief * period else 0.0

    @property
    def text(self) -> str:
        """A line for people."""
        rho = self.autocorrelation[1:]
        beyond = np.flatnonzero(rho > self.bound)
        upto = f", up to a lag of {self.lags[1 + beyond[-1]]:.3g} s" if len(beyond) else ""
        found = "white" if self.white else f"not white (ρ = {np.max(rho):.2f}{upto})"
        inputs = "".join(
            f"; {'correlated' if one.significant else 'not correlated'} with {name} (ρ = "
            f"{one.correlation:+.2f} at a lag of {one.lag:.3g} s)"
            for name, one in self.inputs.items()
        )
        return f"{found}{inputs}; {self.fit_percent:.2f} % of the variation followed"


def whiteness(
    traces: Sequence[Trace], channels: Sequence[str], inputs: Sequence[str]
) -> dict[str, Whiteness]:
    """Whiteness of each channel."""
    steps = np.concatenate([np.diff(trace.t) for trace in traces])
    step = float(np.median(steps[steps > 0]))
    found = {}
    for k, name in enumerate(channels):
        r = [np.clip(trace.residuals[:, k], -5, 5) for trace in traces]  # outliers count as five σ
        count = sum(int(np.isfinite(one).sum()) for one in r)
        rho = np.array([_correlation(r, r, lag) for lag in range(Options.lags + 1)])
        bound = Options.beyond / np.sqrt(max(count, 1))
        colour = 1 + 2 * float(np.sum(rho[1:].clip(min=0)))
        of_inputs = {}
        for j, u in enumerate(inputs):
            mean = np.mean(np.concatenate([trace.inputs[:, j] for trace in traces]))
            series = [trace.inputs[:, j] - mean for trace in traces]
            both = {
                lag: _correlation(series, r, lag)
                for lag in range(-Options.lags // 4, Options.lags + 1)
            }
            best = max(both, key=lambda lag: abs(both[lag]))
            significant = bool(abs(both[best]) > bound * np.sqrt(colour))
            of_inputs[u] = OfInput(both[best], best * step, significant)
        measured = np.concatenate([trace.measured[:, k] for trace in traces])
        left = measured - np.concatenate([trace.fitted[:, k] for trace in traces])
        spread = float(np.nanstd(measured)) or _mean_interval(traces, k)
        percent = 100 * (1 - np.sqrt(np.nanmean(left**2)) / max(spread, 1e-300))
        white = bool(np.all(np.abs(rho[1:]) < bound))
        found[name] = Whiteness(
            step * np.arange(Options.lags + 1), rho, bound, white, of_inputs, float(percent)
        )
    return found


def _mean_interval(traces: Sequence[Trace], k: int) -> float:
    """The mean time between readings of a channel of events."""
    times = [trace.t[np.isfinite(trace.measured[:, k])] for trace in traces]
    return float(np.mean(np.concatenate([np.diff(t) for t in times])))


def _correlation(a: Sequence[np.ndarray], b: Sequence[np.ndarray], lag: int) -> float:
    """Correlation of a with b ``lag`` samples later, within arcs, in units of all of both, so that
    few pairs of a long lag count for as little; NaN counts as nothing."""
    early, late = [], []
    for one, other in zip(a, b, strict=True):
        n = len(one)
        if n <= abs(lag):
            continue
        early.append(one[max(0, -lag) : n - max(0, lag)])
        late.append(other[max(0, lag) : n - max(0, -lag)])
    if not early:
        return 0.0
    x, y = np.concatenate(early), np.concatenate(late)
    known = np.isfinite(x) & np.isfinite(y)
    size = np.sqrt(np.prod([np.nansum(np.concatenate(every) ** 2) for every in (a, b)]))
    return float(np.sum(x[known] * y[known]) / size) if size > 0 else 0.0
