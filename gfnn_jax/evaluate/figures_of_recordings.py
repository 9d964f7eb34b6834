"""Figures of recordings: what was measured, what a law makes of it, and its forecasts, in the
file's own names and units."""

from __future__ import annotations

import textwrap
from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.figure import Figure

from gfnn_jax.data.recording import Recording
from gfnn_jax.data.recording_summary import RecordingSummary
from gfnn_jax.errors import InputError
from gfnn_jax.evaluate.figures_style import COLOURS, style
from gfnn_jax.evaluate.forecasts import Forecasts
from gfnn_jax.families.text import in_letters
from gfnn_jax.maps.sensors import TUBE
from gfnn_jax.signals.steps import spectrum

if TYPE_CHECKING:
    from gfnn_jax.evaluate.physics import Swings
    from gfnn_jax.models.lagrangians.learned_law import LearnedLaw
    from gfnn_jax.models.lagrangians.residuals import Trace


class _Options:
    """Sizes of figures, and when a line is broken."""

    most_rows: int = 6  # columns of a recording that a figure shows
    gap: float = 5.0  # times the median step: a pause that no line crosses
    page: float = 9.2  # inches: the width of figures for a page
    points: int = 1_500  # of a series in a figure, whose panels are some 500 pixels wide


_BLUE, _RED, _GREEN, *_ = COLOURS
# Labels that are set as formulas take half of the time of a figure, and powers of ten are rare.
_style = style(axes__formatter__use_mathtext=False)


class _Sheet:
    """A figure of rows of panels about one recording, and what its panels have in common."""

    def __init__(self, recording: Recording, rows: int, columns: int, width=4.6, **options):
        self.recording = recording
        self.units: dict[str, str] = {}  # in place of the recording's
        self.figure = Figure(figsize=(width * columns, (1.0 + 0.35 * width) * rows))
        self.axes = self.figure.subplots(rows, columns, squeeze=False, **options)

    def unit(self, name: str) -> str:
        return self.units.get(name, self.recording.unit(name))

    def label(self, name: str) -> str:
        unit = self.unit(name)
        return f"{name} [{unit}]" if unit else name

    def speed(self, name: str) -> str:
        """Label of the derivative of a column."""
        unit = self.unit(name)
        return f"d{name}/dt [{unit}/s]" if unit and "?" not in unit else f"d{name}/dt"

    def in_file(self, name: str, run: str) -> np.ndarray:
        """The values of a column, angles unwrapped."""
        return self.recording.unwrapped(name, run) / self.recording.factors[name]


def _thinned(values: np.ndarray) -> np.ndarray:
    return values[:: max(len(values) // _Options.points, 1)]


def _broken(t: np.ndarray, *series: np.ndarray) -> tuple[np.ndarray, ...]:
    """Times and series for a line, thinned, with NaN where times pause."""
    t, *series = map(_thinned, (t, *series))  # pyright: ignore[reportAssignmentType]
    if len(t) < 3:
        return (t, *series)
    pauses = np.flatnonzero(np.diff(t) > _Options.gap * np.median(np.diff(t))) + 1
    return tuple(np.insert(np.asarray(x, float), pauses, np.nan) for x in (t, *series))


@_style
def recording_figure(recording: Recording, summary: RecordingSummary) -> Figure:
    """Draw time series with gaps shaded, phase portraits and spectra, a row for each position and
    input."""
    names = (*recording.positions, *recording.inputs) or recording.columns
    names = names[: _Options.most_rows]
    sheet = _Sheet(recording, len(names), 3)
    sheet.units = {column.name: column.unit for column in summary.columns}
    longest = max(recording.runs, key=lambda run: len(recording.times(run)))
    times = [recording.times(run) for run in recording.runs]
    for (series, portrait, power), name in zip(sheet.axes, names, strict=True):
        # The longest run, others behind it.
        for run in (*[r for r in recording.runs[:8] if r != longest], longest):
            t, x = _broken(recording.times(run), sheet.in_file(name, run))
            strong = {"lw": 0.9, "ms": 2} if run == longest else {"lw": 0.5, "ms": 0, "alpha": 0.3}
            series.plot(t, x, ".-", color=_BLUE, **strong)
        for run, begin, end in summary.gaps:
            if run == longest:
                series.axvspan(begin, end, color=_RED, alpha=0.25, lw=0)
        title = f"run {longest}" if len(recording.runs) > 1 else ""
        title += f"{' · ' * bool(title)}gaps shaded" * bool(summary.gaps)
        series.set(ylabel=sheet.label(name), title=title)
        if name in recording.positions:
            place = recording.positions.index(name)
            measured = recording.velocities[place : place + 1]
            for x, v in _phases(sheet, name, measured):
                portrait.plot(x, v, lw=0.5)
            speed = sheet.label(measured[0]) if measured else sheet.speed(name)
            portrait.set(xlabel=sheet.label(name), ylabel=speed)
        else:
            portrait.axis("off")
        values = np.concatenate([sheet.in_file(name, run) for run in recording.runs])
        frequencies, density = spectrum(times, values)
        shown = density > 0
        power.loglog(frequencies[shown][1:], density[shown][1:], lw=0.7)
        power.set(ylabel="power density")
    sheet.axes[-1, 0].set_xlabel("t [s]")
    sheet.axes[-1, 2].set_xlabel("frequency [Hz]")
    return sheet.figure


def _phases(sheet: _Sheet, name: str, measured) -> Iterator[tuple[np.ndarray, ...]]:
    """Positions and velocities, measured or by differences, of the first runs."""
    for run in sheet.recording.runs[:8]:
        t, x = sheet.recording.times(run), sheet.in_file(name, run)
        if measured:
            yield _broken(t, x, sheet.in_file(measured[0], run))[1:]
        elif len(x) > 2:
            yield _broken(t, x, np.gradient(x, t))[1:]


@_style
def law_figure(fit: LearnedLaw, recording: Recording) -> Figure:
    """Draw a law and the recording that it was learned from: what was measured against a forecast
    with its band, residuals, whether they are white, and the energy."""
    channels = list(fit.whiteness)[: _Options.most_rows]
    sheet = _Sheet(recording, len(channels) + 1, 3)
    run = max(recording.runs, key=lambda name: np.ptp(recording.times(name)))
    own, t = recording.slice(run=run), recording.times(run)
    first_third = own.slice(stop=t[0] + np.ptp(t) / 3)
    for place, name in enumerate(channels):
        forecast, residuals, whiteness = sheet.axes[place]
        draw_forecast(forecast, sheet, fit, first_third, own, name)
        for trace in fit.traces:
            missed = trace.measured[:, place] - trace.fitted[:, place]
            residuals.plot(trace.t, missed, ".", ms=2, color=_BLUE)
        _noise_lines(residuals, fit.noise[name])
        residuals.set(ylabel=f"measured − law, {sheet.label(name)}", xlabel="t [s]")
        of = fit.whiteness[name]
        whiteness.axhspan(-of.bound, of.bound, color="0.85", label="chance")
        whiteness.stem(of.lags[1:], of.autocorrelation[1:], basefmt=" ")
        for u, one in of.inputs.items():
            whiteness.plot(one.lag, one.correlation, "o", mfc="none", label=f"with {u}")
        whiteness.set(xlabel="lag [s]")
    first = f"forecast from one state, run {run}"
    titles = (first, "residuals of the fitted arcs", "correlation of residuals")
    for ax, title in zip(sheet.axes[0], titles, strict=True):
        ax.set_title(title)
        ax.legend()
    grid = sheet.axes[0, 0].get_gridspec()
    for ax in sheet.axes[-1]:
        ax.remove()
    _energy(sheet.figure.add_subplot(grid[-1, :2]), fit)
    return sheet.figure


def _noise_lines(ax, sigma: float) -> None:
    """Draw zero, and two standard deviations of the noise about it."""
    ax.axhline(0, color="0.5", lw=0.5)
    ax.axhline(2 * sigma, color="0.5", lw=0.7, ls="--", label="± 2 σ of the noise")
    ax.axhline(-2 * sigma, color="0.5", lw=0.7, ls="--")


@_style
def residuals_figure(fit: LearnedLaw, recording: Recording) -> Figure:
    """Draw the residuals of a law against time, the channel itself and its rate of change."""
    channels = list(fit.whiteness)[: _Options.most_rows]
    sheet = _Sheet(recording, len(channels), 3, _Options.page / 3, sharey="row")
    for place, (name, row) in enumerate(zip(channels, sheet.axes, strict=True)):
        columns = zip(*(_residual(trace, place) for trace in fit.traces), strict=True)
        t, x, rate, missed = (_thinned(np.concatenate(column)) for column in columns)
        for ax, against in zip(row, (t, x, rate), strict=True):
            ax.plot(against, missed, ".", ms=2, color=_BLUE, alpha=0.6)
            _noise_lines(ax, fit.noise[name])
        row[0].set(xlabel="t [s]", ylabel=f"measured − law, {sheet.label(name)}")
        row[1].set(xlabel=sheet.label(name))
        row[2].set(xlabel=sheet.speed(name))
    sheet.axes[0, 0].legend()
    return sheet.figure


def _residual(trace: Trace, place: int) -> tuple[np.ndarray, ...]:
    """(t, fitted, its rate of change, residual) of a channel along an arc."""
    fitted = trace.fitted[:, place]
    rate = np.gradient(fitted, trace.t) if len(fitted) > 1 else np.zeros(len(fitted))
    return trace.t, fitted, rate, trace.measured[:, place] - fitted


@_style
def swings_figure(swings: Swings, label: str) -> Figure:
    """Draw frequency and Q of free swings against their amplitude, with two standard errors."""
    figure = Figure(figsize=(_Options.page, 2.6))
    quality = swings.quality, swings.quality_std, "quality factor Q"
    shown = ((swings.frequency, swings.frequency_std, "frequency [Hz]"), quality)
    finite = [one for one in shown if np.isfinite(one[0]).any()]
    axes = figure.subplots(1, len(finite), squeeze=False)[0]
    for ax, (value, std, name) in zip(axes, finite, strict=True):
        ax.plot(swings.amplitude, value, color=_BLUE)
        ax.fill_between(swings.amplitude, value - 2 * std, value + 2 * std, alpha=0.25)
        ax.set(xlabel=f"amplitude of {label}", ylabel=name)
    return figure


def draw_forecast(
    ax, sheet: _Sheet, fit: LearnedLaw, seen: Recording, own: Recording, name: str
) -> None:
    """Draw a column of the one run ``own``, and its forecast from the state at the end of ``seen``
    on."""
    t, begin = own.times(own.runs[0]), seen.times(seen.runs[0])[-1]
    ahead = _thinned(t[t > begin])
    factor, angle = own.factors[name], name in own.angles
    readings = sheet.in_file(name, own.runs[0])
    ax.plot(*map(_thinned, (t, readings)), ".", ms=2, color="0.6", label="measured")
    low, high = np.nanmin(readings), np.nanmax(readings)
    ax.set_ylim(low - 0.3 * (high - low), high + 0.3 * (high - low))
    ax.set(ylabel=sheet.label(name), xlabel="t [s]")
    try:
        found = fit.map.forecast(seen, ahead, own if own.inputs else None, coverage=TUBE)
    except InputError:  # too few samples before
        return
    value, std = found.values[name][0], found.std[name][0]
    if angle:  # the turn that the lift of the measured angle has there
        known = np.isfinite(readings)
        begins = np.interp(begin, t[known], readings[known])
        turn = 2 * np.pi / factor
        value = value + turn * np.round((begins - value[0]) / turn)
    t, value, std = _broken(ahead, value, std)
    ax.plot(t, value, lw=1, color=_BLUE, label="forecast")
    ax.fill_between(t, value - 2 * std, value + 2 * std, alpha=0.25, label="± 2 σ")


def begin_of(own: Recording, begin: float | None) -> float:
    """The time (s) in the one run ``own`` at which a forecast begins: ``begin`` where it is inside
    the run, else after two thirds."""
    t = own.times(own.runs[0])
    if begin is not None and t[0] < begin < t[-1]:
        return float(begin)
    return float(t[0] + np.ptp(t) * 2 / 3)


def _energy(ax, fit: LearnedLaw) -> None:
    """Draw the ledger of the longest arc: what is stored, lost, supplied, and left unexplained."""
    trace = max(fit.traces, key=lambda one: np.ptp(one.t))
    stored = trace.energy - trace.energy[0]
    ax.plot(trace.t, stored, lw=2.6, color="0.6", label="stored")
    terms = (textwrap.fill(in_letters(term.term), 32) for term in fit.friction.terms)
    losses = {f"− lost by {term}": -1 for term in terms}
    gains = {f"supplied by {name}": 1 for name in fit.gains}
    for sums, names in ((trace.lost, losses), (trace.supplied, gains)):
        for column, (name, sign) in zip(sums.T, names.items(), strict=True):
            ax.plot(trace.t, sign * column, lw=0.9, label=name)
    closure = stored - trace.supplied.sum(axis=1) + trace.lost.sum(axis=1)
    ax.plot(trace.t, closure, lw=0.9, color="black", ls=":", label="unexplained")
    ax.set(ylabel="energy [unit of L]", xlabel="t [s]", title="energy since the longest arc began")
    beside = ax.legend(loc="upper left", bbox_to_anchor=(1.02, 1.0), frameon=False)
    beside.set_in_layout(False)  # the place beside is free


@_style
def coming_figure(fit: LearnedLaw, recording: Recording, begin: float | None = None) -> Figure:
    """Draw the longest run, and the forecast of what comes after ``begin`` (s) from the one state
    there; None: after two thirds."""
    channels = list(fit.whiteness)[: _Options.most_rows]
    run = max(recording.runs, key=lambda name: np.ptp(recording.times(name)))
    own = recording.slice(run=run)
    begin = begin_of(own, begin)
    sheet = _Sheet(recording, len(channels), 1, _Options.page, sharex=True)
    sheet.figure.set_size_inches(_Options.page, 2.6 * len(channels))
    for name, (ax,) in zip(channels, sheet.axes, strict=True):
        draw_forecast(ax, sheet, fit, own.slice(stop=begin), own, name)
        ax.axvline(begin, color="0.4", lw=0.8, ls="--")
        ax.legend(loc="upper left", ncols=3)
        ax.label_outer()
    return sheet.figure


@_style
def forecasts_figure(found: Forecasts, recording: Recording) -> Figure:
    """Draw three forecasts of what no fit has seen: measured and forecast above,
    what the forecast missed and its band below."""
    names = list(found.median)[: _Options.most_rows]
    shown = [found.each[k] for k in sorted({0, len(found.each) // 2, len(found.each) - 1})]
    sheet = _Sheet(recording, 2 * len(names), len(shown), _Options.page / len(shown), sharey="row")
    for column, one in zip(sheet.axes.T, shown, strict=True):
        for above, below, name in zip(column[::2], column[1::2], names, strict=True):
            above.plot(one.t, one.measured[name], ".", ms=3, color="0.5", label="measured")
            t, value, band = _broken(one.t, one.values[name], 2 * one.std[name])
            above.plot(t, value, lw=1, color=_BLUE, label="forecast")
            below.fill_between(t, -band, band, alpha=0.25, label="± 2 standard deviations")
            below.plot(one.t, one.values[name] - one.measured[name], ".", ms=3, color=_BLUE)
        column[-1].set_xlabel("t [s]")
    for name, above, below in zip(names, sheet.axes[::2, 0], sheet.axes[1::2, 0], strict=True):
        above.set_ylabel(sheet.label(name))
        below.set_ylabel(sheet.label(name).replace(name, "forecast − measured", 1))
    shown = [ax.get_legend_handles_labels() for ax in sheet.axes[:2, 0]]
    handles, labels = ([*above, *below] for above, below in zip(*shown, strict=True))
    sheet.figure.legend(handles, labels, loc="outside upper left", ncols=3, frameon=False)
    return sheet.figure
