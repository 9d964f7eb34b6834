"""The figure of a law: what was measured against a forecast with its band, what the law leaves, its
energy, and whether the residuals are white."""

from __future__ import annotations

from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

from gfnn_jax.data.recording import Recording
from gfnn_jax.errors import InputError
from gfnn_jax.evaluate.forecasts import Forecasts
from gfnn_jax.learn.fitted import Fit

_AHEAD = 2 / 3  # of the longest run that a forecast is shown for
_MOST_TIMES = 600
_MOST_CHANNELS = 6


def law_figure(fit: Fit, recording: Recording, path: Path) -> Path:
    """Write the figure of a law and the recording that it was learned from, in the file's units."""
    channels = list(fit.whiteness)[:_MOST_CHANNELS]
    figure, axes = plt.subplots(
        len(channels) + 1,
        3,
        figsize=(14, 2.6 * (len(channels) + 1)),
        squeeze=False,
        layout="constrained",
    )
    run = max(recording.runs, key=lambda name: np.ptp(recording.times(name)))
    for row, name in zip(axes, channels, strict=False):
        _forecast(row[0], fit, recording, run, name)
        _residuals(row[1], fit, name)
        _whiteness(row[2], fit, name)
    axes[0, 0].set_title(f"forecast from one state, run {run}", fontsize=9)
    axes[0, 1].set_title("residuals of the fitted arcs", fontsize=9)
    axes[0, 2].set_title("correlation of residuals, and what chance allows", fontsize=9)
    _energy(axes[-1, 0], fit)
    for empty in axes[-1, 1:]:
        empty.axis("off")
    law = axes[-1, 1].text(0, 1, f"L = {fit.lagrangian}\nR = {fit.friction}", va="top", wrap=True)
    law.set_in_layout(False)  # a long law makes no panel narrower
    figure.savefig(path, dpi=110)
    plt.close(figure)
    return path


def forecasts_figure(found: Forecasts, recording: Recording, path: Path) -> Path:
    """Write the figure of three forecasts of what no fit has seen: measured and forecast above,
    what the forecast missed and its band below, in the file's units."""
    names = list(found.median)[:_MOST_CHANNELS]
    shown = [found.each[k] for k in sorted({0, len(found.each) // 2, len(found.each) - 1})]
    figure, axes = plt.subplots(
        2 * len(names),
        len(shown),
        figsize=(3.6 * len(shown), 3.6 * len(names)),
        squeeze=False,
        sharey="row",
        layout="constrained",
    )
    for column, one in zip(axes.T, shown, strict=True):
        for above, below, name in zip(column[::2], column[1::2], names, strict=True):
            missed = one.values[name] - one.measured[name]
            above.plot(one.t, one.measured[name], ".", ms=3, color="0.5", label="measured")
            above.plot(one.t, one.values[name], lw=1, color="C0", label="forecast")
            band = 2 * one.std[name]
            below.fill_between(one.t, -band, band, alpha=0.25, label="± 2 standard deviations")
            below.plot(one.t, missed, ".", ms=3, color="C0")
        column[-1].set_xlabel("t [s]")
    for name, above, below in zip(names, axes[::2, 0], axes[1::2, 0], strict=True):
        unit = f" [{recording.unit(name)}]" if recording.unit(name) else ""
        above.set_ylabel(f"{name}{unit}")
        below.set_ylabel(f"forecast − measured{unit}")
    axes[0, 0].legend(fontsize=8)
    axes[1, 0].legend(fontsize=8)
    figure.savefig(path, dpi=110)
    plt.close(figure)
    return path


def _forecast(axes, fit: Fit, recording: Recording, run: str, name: str) -> None:
    t = recording.times(run)
    begin = t[0] + (1 - _AHEAD) * np.ptp(t)
    ahead = t[t > begin][:: max(1, int(np.sum(t > begin)) // _MOST_TIMES)]
    factor, angle = recording.factors[name], name in recording.angles
    readings = recording.unwrapped(name, run) if angle else recording.values(name, run)
    axes.plot(t, readings / factor, ".", ms=2, color="0.6", label="measured")
    own = recording.slice(run=run)
    try:
        found = fit.map.forecast(own.slice(stop=begin), ahead, own if recording.inputs else None)
    except InputError:  # too few samples before
        return
    value, std = found.values[name][0], found.std[name][0]
    if angle:  # the turn that the lift of the measured angle has there
        begins = np.interp(begin, t[np.isfinite(readings)], readings[np.isfinite(readings)])
        value = value + 2 * np.pi * np.round((begins - value[0]) / (2 * np.pi))
    axes.plot(ahead, value / factor, lw=1, color="C0", label="forecast")
    axes.fill_between(ahead, (value - 2 * std) / factor, (value + 2 * std) / factor, alpha=0.25)
    low, high = np.nanmin(readings) / factor, np.nanmax(readings) / factor
    axes.set_ylim(low - 0.3 * (high - low), high + 0.3 * (high - low))
    unit = recording.unit(name)
    axes.set_ylabel(f"{name} [{unit}]" if unit else name)
    axes.set_xlabel("t [s]")


def _residuals(axes, fit: Fit, name: str) -> None:
    k = list(fit.whiteness).index(name)
    for trace in fit.traces:
        axes.plot(trace.t, trace.measured[:, k] - trace.fitted[:, k], ".", ms=2, color="C0")
    axes.axhline(0, color="0.5", lw=0.5)
    for sign in (-2, 2):
        axes.axhline(sign * fit.noise[name], color="0.5", lw=0.7, ls="--")
    axes.set_ylabel(f"measured − law, {name}")
    axes.set_xlabel("t [s]")


def _whiteness(axes, fit: Fit, name: str) -> None:
    of = fit.whiteness[name]
    axes.axhspan(-of.bound, of.bound, color="0.85")
    axes.stem(of.lags[1:], of.autocorrelation[1:], basefmt=" ")
    for u, one in of.inputs.items():
        axes.plot(one.lag, one.correlation, "o", mfc="none", label=f"with {u}")
    if of.inputs:
        axes.legend(fontsize=8)
    axes.set_xlabel("lag [s]")


def _energy(axes, fit: Fit) -> None:
    """Draw the ledger of the longest arc: what is stored, lost, supplied, and left unexplained."""
    trace = max(fit.traces, key=lambda one: np.ptp(one.t))
    stored = trace.energy - trace.energy[0]
    axes.plot(trace.t, stored, lw=1.2, color="C2", label="stored")
    for sign, sums, names in (
        (-1, trace.lost, ["− lost by " + term.term for term in fit.friction.terms]),
        (1, trace.supplied, ["supplied by " + name for name in fit.gains]),
    ):
        for column, name in zip(sums.T, names, strict=True):
            axes.plot(trace.t, sign * column, lw=0.8, label=name)
    closure = stored - trace.supplied.sum(axis=1) + trace.lost.sum(axis=1)
    axes.plot(trace.t, closure, lw=0.8, color="black", ls=":", label="unexplained")
    axes.set_ylabel("energy since the arc began")
    axes.set_xlabel("t [s]")
    axes.legend(fontsize=7)
