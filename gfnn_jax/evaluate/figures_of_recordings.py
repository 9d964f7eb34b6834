"""Figures of recordings: what was measured, what a law makes of it, and its forecasts, in the
file's own names and units."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.figure import Figure

from gfnn_jax.data.recording import Recording
from gfnn_jax.data.recording_summary import RecordingSummary
from gfnn_jax.errors import InputError
from gfnn_jax.evaluate.figures import COLOURS, save, style
from gfnn_jax.evaluate.forecasts import Forecasts
from gfnn_jax.signals.steps import spectrum

if TYPE_CHECKING:
    from gfnn_jax.models.lagrangians.learned_law import LearnedLaw

_MOST_ROWS = 6  # columns of a recording that a figure shows
_BLUE, _RED, _GREEN, *_ = COLOURS


class _Sheet:
    """A figure of rows of panels about one recording, and what its panels have in common."""

    def __init__(self, recording: Recording, rows: int, columns: int, **options):
        self.recording = recording
        self.figure = Figure(figsize=(4.6 * columns, 2.6 * rows))
        self.axes = self.figure.subplots(rows, columns, squeeze=False, **options)

    def write(self, path: Path) -> Path:
        save(self.figure, path, dpi=110)
        return path

    def label(self, name: str) -> str:
        unit = self.recording.unit(name)
        return f"{name} [{unit}]" if unit else name

    def in_file(self, name: str, run: str) -> np.ndarray:
        """The values of a column, angles unwrapped."""
        return self.recording.unwrapped(name, run) / self.recording.factors[name]


def _thinned(values: np.ndarray) -> np.ndarray:
    return values[:: max(len(values) // 4_000, 1)]


@style()
def recording_figure(recording: Recording, summary: RecordingSummary, path: Path) -> Path:
    """Write time series with gaps marked, phase portraits and spectra, a row for each position and
    input."""
    names = (*recording.positions, *recording.inputs)[:_MOST_ROWS] or recording.columns[:_MOST_ROWS]
    sheet = _Sheet(recording, len(names), 3)
    longest = max(recording.runs, key=lambda run: len(recording.times(run)))
    times = [recording.times(run) for run in recording.runs]
    for (series, portrait, power), name in zip(sheet.axes, names, strict=True):
        # The longest run, others behind it.
        for run in (*[r for r in recording.runs[:8] if r != longest], longest):
            t, x = _thinned(recording.times(run)), _thinned(sheet.in_file(name, run))
            strong = {"lw": 0.9, "ms": 2} if run == longest else {"lw": 0.5, "ms": 0, "alpha": 0.3}
            series.plot(t, x, ".-", color=_BLUE, **strong)
        for run, begin, end in summary.gaps:
            if run == longest:
                series.axvspan(begin, end, color=_RED, alpha=0.25, lw=0)
        title = f"run {longest}" if len(recording.runs) > 1 else ""
        series.set(ylabel=sheet.label(name), title=title)
        if name in recording.positions:
            place = recording.positions.index(name)
            measured = recording.velocities[place : place + 1]
            for x, v in _phases(sheet, name, measured):
                portrait.plot(_thinned(x), _thinned(v), lw=0.5)
            portrait.set(xlabel=name, ylabel=measured[0] if measured else f"d{name}/dt")
        else:
            portrait.axis("off")
        values = np.concatenate([sheet.in_file(name, run) for run in recording.runs])
        frequencies, density = spectrum(times, values)
        shown = density > 0
        power.loglog(frequencies[shown][1:], density[shown][1:], lw=0.7)
        power.set(ylabel="power density")
    sheet.axes[-1, 0].set_xlabel("t [s]")
    sheet.axes[-1, 2].set_xlabel("frequency [Hz]")
    return sheet.write(path)


def _phases(sheet: _Sheet, name: str, measured) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Positions and velocities, measured or by differences, of the first runs."""
    for run in sheet.recording.runs[:8]:
        x = sheet.in_file(name, run)
        if measured:
            yield x, sheet.in_file(measured[0], run)
        elif len(x) > 2:
            yield x, np.gradient(x, sheet.recording.times(run))


@style()
def law_figure(fit: LearnedLaw, recording: Recording, path: Path) -> Path:
    """Write the figure of a law and the recording that it was learned from: what was measured
    against a forecast with its band, residuals, whether they are white, and the energy."""
    channels = list(fit.whiteness)[:_MOST_ROWS]
    sheet = _Sheet(recording, len(channels) + 1, 3)
    run = max(recording.runs, key=lambda name: np.ptp(recording.times(name)))
    for place, name in enumerate(channels):
        forecast, residuals, whiteness = sheet.axes[place]
        _forecast(forecast, sheet, fit, run, name)
        for trace in fit.traces:
            missed = trace.measured[:, place] - trace.fitted[:, place]
            residuals.plot(trace.t, missed, ".", ms=2, color=_BLUE)
        residuals.axhline(0, color="0.5", lw=0.5)
        for sign in (-2, 2):
            residuals.axhline(sign * fit.noise[name], color="0.5", lw=0.7, ls="--")
        residuals.set(ylabel=f"measured − law, {name}", xlabel="t [s]")
        of = fit.whiteness[name]
        whiteness.axhspan(-of.bound, of.bound, color="0.85")
        whiteness.stem(of.lags[1:], of.autocorrelation[1:], basefmt=" ")
        for u, one in of.inputs.items():
            whiteness.plot(one.lag, one.correlation, "o", mfc="none", label=f"with {u}")
        if of.inputs:
            whiteness.legend()
        whiteness.set(xlabel="lag [s]")
    titles = (
        f"forecast from one state, run {run}",
        "residuals of the fitted arcs",
        "correlation of residuals, and what chance allows",
    )
    for ax, title in zip(sheet.axes[0], titles, strict=True):
        ax.set_title(title)
    energy, words, empty = sheet.axes[-1]
    _energy(energy, fit)
    words.axis("off")
    empty.axis("off")
    law = words.text(0, 1, f"L = {fit.lagrangian}\nR = {fit.friction}", va="top", wrap=True)
    law.set_in_layout(False)  # a long law makes no panel narrower
    return sheet.write(path)


def _forecast(ax, sheet: _Sheet, fit: LearnedLaw, run: str, name: str) -> None:
    """Two thirds of a run, forecast from the state that the first third tells."""
    recording, most = sheet.recording, 600
    t = recording.times(run)
    begin = t[0] + np.ptp(t) / 3
    ahead = t[t > begin][:: max(1, int(np.sum(t > begin)) // most)]
    factor, angle = recording.factors[name], name in recording.angles
    readings = recording.unwrapped(name, run) if angle else recording.values(name, run)
    readings = readings / factor
    ax.plot(t, readings, ".", ms=2, color="0.6", label="measured")
    own = recording.slice(run=run)
    try:
        found = fit.map.forecast(own.slice(stop=begin), ahead, own if recording.inputs else None)
    except InputError:  # too few samples before
        return
    value, std = found.values[name][0], found.std[name][0]
    if angle:  # the turn that the lift of the measured angle has there
        begins = np.interp(begin, t[np.isfinite(readings)], readings[np.isfinite(readings)])
        turn = 2 * np.pi / factor
        value = value + turn * np.round((begins - value[0]) / turn)
    ax.plot(ahead, value, lw=1, color=_BLUE, label="forecast")
    ax.fill_between(ahead, value - 2 * std, value + 2 * std, alpha=0.25)
    low, high = np.nanmin(readings), np.nanmax(readings)
    ax.set_ylim(low - 0.3 * (high - low), high + 0.3 * (high - low))
    ax.set(ylabel=sheet.label(name), xlabel="t [s]")


def _energy(ax, fit: LearnedLaw) -> None:
    """Draw the ledger of the longest arc: what is stored, lost, supplied, and left unexplained."""
    trace = max(fit.traces, key=lambda one: np.ptp(one.t))
    stored = trace.energy - trace.energy[0]
    ax.plot(trace.t, stored, lw=1.2, color=_GREEN, label="stored")
    losses = {f"− lost by {term.term}": -1 for term in fit.friction.terms}
    gains = {f"supplied by {name}": 1 for name in fit.gains}
    for sums, names in ((trace.lost, losses), (trace.supplied, gains)):
        for column, (name, sign) in zip(sums.T, names.items(), strict=True):
            ax.plot(trace.t, sign * column, lw=0.8, label=name)
    closure = stored - trace.supplied.sum(axis=1) + trace.lost.sum(axis=1)
    ax.plot(trace.t, closure, lw=0.8, color="black", ls=":", label="unexplained")
    ax.set(ylabel="energy since the arc began", xlabel="t [s]")
    ax.legend()


@style()
def forecasts_figure(found: Forecasts, recording: Recording, path: Path) -> Path:
    """Write the figure of three forecasts of what no fit has seen: measured and forecast above,
    what the forecast missed and its band below."""
    names = list(found.median)[:_MOST_ROWS]
    shown = [found.each[k] for k in sorted({0, len(found.each) // 2, len(found.each) - 1})]
    sheet = _Sheet(recording, 2 * len(names), len(shown), sharey="row")
    for column, one in zip(sheet.axes.T, shown, strict=True):
        for above, below, name in zip(column[::2], column[1::2], names, strict=True):
            above.plot(one.t, one.measured[name], ".", ms=3, color="0.5", label="measured")
            above.plot(one.t, one.values[name], lw=1, color=_BLUE, label="forecast")
            band = 2 * one.std[name]
            below.fill_between(one.t, -band, band, alpha=0.25, label="± 2 standard deviations")
            below.plot(one.t, one.values[name] - one.measured[name], ".", ms=3, color=_BLUE)
        column[-1].set_xlabel("t [s]")
    for name, above, below in zip(names, sheet.axes[::2, 0], sheet.axes[1::2, 0], strict=True):
        above.set_ylabel(sheet.label(name))
        below.set_ylabel(sheet.label(name).replace(name, "forecast − measured", 1))
    sheet.axes[0, 0].legend()
    sheet.axes[1, 0].legend()
    return sheet.write(path)
