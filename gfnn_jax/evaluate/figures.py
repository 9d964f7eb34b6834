"""Figures in print quality: arrays in, Axes out.

Each function draws on ``ax`` where one is given, else on a new figure (`save(ax.figure, path)`).
Figures are matplotlib `Figure` objects; pyplot and its global state are never touched. The style is
that of `evaluate.figures_style`. Here are errors and orbits; those of what maps cost
(`evaluate.figures_of_cost`) have their names here too.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from gfnn_jax.evaluate.chaos import kl_divergence
from gfnn_jax.evaluate.errors import error_statistics
from gfnn_jax.evaluate.figures_of_cost import (
    digits_against_step_size,
    speed_against_error,
    training_curve,
    work_precision,
    work_precision_panels,
)
from gfnn_jax.evaluate.figures_style import (
    COLOURS,
    HEIGHT,
    LINES,
    MARKERS,
    REFERENCE,
    STYLE,
    WIDTH,
    axes_or_new,
    legend_above,
    look_of,
    save,
    style,
    without_minor_ticks,
)

__all__ = (
    "COLOURS",
    "HEIGHT",
    "LINES",
    "MARKERS",
    "REFERENCE",
    "STYLE",
    "WIDTH",
    "coordinates_against_time",
    "coordinates_in_two_panels",
    "digits_against_step_size",
    "element_errors",
    "energy_error",
    "error_growth",
    "marginal_panels",
    "marginals",
    "phase_portrait",
    "proportionality",
    "save",
    "sections",
    "speed_against_error",
    "style",
    "training_curve",
    "work_precision",
    "work_precision_panels",
)

# Errors against step number


@style()
def error_growth(errors: Mapping, ylabel="position error", ax=None, band=None) -> Axes:
    """Draw mean error over trajectories against step, log–log, with one standard deviation.

    errors: name -> (steps (L,), error (B, L)). The shaded band goes from mean / (1 + std/mean) to
    mean + std; the lower end is mean − std to first order, and always positive. Where a prediction
    is lost the mean ends, and the median continues as a thin line until half are lost; the legend
    counts the lost ones. The dotted line grows as the step, the paper's theorem for regular orbits.
    band: (steps (L,), two standard deviations of the posterior (B, L)), whose mean over
    trajectories is shaded from below.
    """
    ax = axes_or_new(ax)
    _error_curves(ax, errors, ylabel)
    _guide(ax, 1.0, r"$\propto n$")
    if band is not None:
        _shaded(ax, np.asarray(band[0]), np.mean(band[1], axis=0))
    without_minor_ticks(ax)
    legend_above(ax)
    return ax


@style()
def proportionality(points: Mapping, xlabel, ylabel, ax=None) -> Axes:
    """Draw a positive quantity against another, log–log, with a dotted line proportional to x.

    points: name -> (x (K,), y (K,)).
    """
    ax = axes_or_new(ax)
    for place, (name, (x, y)) in enumerate(points.items()):
        ax.plot(x, y, label=name, **look_of(place))
    ax.set(xscale="log", yscale="log", xlabel=xlabel, ylabel=ylabel)
    _guide(ax, 1.0, r"$\propto\varepsilon$")
    legend_above(ax)
    return ax


@style()
def element_errors(errors: Mapping, axes=None) -> tuple[Axes, Axes]:
    """Draw errors of semi-major axis and eccentricity against step (paper, Fig. 2, upper row).

    errors: name -> (steps (L,), error of a (B, L), error of e (B, L)). Bands: see `error_growth`.
    """
    if axes is None:
        axes = Figure(figsize=(2 * WIDTH, HEIGHT)).subplots(1, 2)
    labels = ("error of semi-major axis $a$", "error of eccentricity $e$")
    for i, (ax, label) in enumerate(zip(axes, labels, strict=True)):
        _error_curves(ax, {name: (v[0], v[1 + i]) for name, v in errors.items()}, label)
        legend_above(ax)
    without_minor_ticks(*axes)
    return tuple(axes)


@style()
def energy_error(errors: Mapping, ax=None) -> Axes:
    """Draw the root mean square over trajectories of the energy error against step, log–log.

    errors: name -> (steps (L,), energy error (B, L)). The dotted line grows as √step, as roundoff.
    """
    ax = axes_or_new(ax)
    for place, (name, (steps, error)) in enumerate(errors.items()):
        size = np.sqrt(np.mean(np.atleast_2d(np.asarray(error)) ** 2, axis=0))
        _log_curve(ax, place, name, np.asarray(steps), size)
    _log_log(ax, r"energy error $|H-H_0|\,/\,|H_0|$ (RMS)")
    _guide(ax, 0.5, r"$\propto \sqrt{n}$")
    without_minor_ticks(ax)
    legend_above(ax)
    return ax


def _shaded(ax, steps, upper):
    """Shade the region below ``upper`` (L,), without extending the axis downwards."""
    shown = (steps > 0) & np.isfinite(upper) & (upper > 0)
    if not shown.any():
        return
    ax.plot(steps[shown], upper[shown], color=REFERENCE, linewidth=0.8, alpha=0.5, label="_band")
    low = min(ax.get_ylim()[0], float(upper[shown].min()))
    ax.fill_between(
        steps[shown],
        low,
        upper[shown],
        color="0.5",
        alpha=0.15,
        linewidth=0,
        zorder=0,
        label=r"two $\sigma$ of the posterior",
    )
    ax.set_ylim(bottom=low)


def _error_curves(ax, errors, ylabel):
    for place, (name, (steps, error)) in enumerate(errors.items()):
        error = np.atleast_2d(np.asarray(error))
        statistics = error_statistics(error)
        mean, steps = statistics.mean, np.asarray(steps)
        if statistics.num_lost:
            num = len(error) - statistics.num_excluded
            name = f"{name} ({statistics.num_lost} of {num} lost)"
        shown = _log_curve(ax, place, name, steps, mean)
        if statistics.num_lost:
            rest = (steps > 0) & ~shown & np.isfinite(statistics.median) & (statistics.median > 0)
            look = look_of(place) | {"marker": "", "linewidth": 0.8}
            ax.plot(steps[rest], statistics.median[rest], label="_the median", **look)
        if len(error) > 1:
            factor = 1 + statistics.std[shown] / mean[shown]
            low, high = mean[shown] / factor, mean[shown] * factor
            colour = look_of(place)["color"]
            ax.fill_between(steps[shown], low, high, color=colour, alpha=0.18, linewidth=0)
    _log_log(ax, ylabel)


def _log_curve(ax, place, name, steps, values):
    """Draw a curve's positive points, log–log, with about eight markers; return their flags."""
    shown = (steps > 0) & np.isfinite(values) & (values > 0)
    x = np.log(steps[shown])
    marks = []
    if len(x):  # offset by method, so that markers of curves that coincide do not hide each other
        ticks = np.linspace(x[0], x[-1], 9)[:-1] + (x[-1] - x[0]) / 8 * (0.3 + 0.37 * place % 0.7)
        marks = np.unique(np.clip(np.searchsorted(x, ticks), 0, len(x) - 1)).tolist()
    ax.plot(steps[shown], values[shown], label=name, markevery=marks, **look_of(place))
    return shown


def _log_log(ax, ylabel):
    ax.set(xscale="log", yscale="log", xlabel="step $n$", ylabel=ylabel)


def _guide(ax, exponent, label):
    """Draw a dotted power law just below the lowest curve; only its slope has a meaning."""
    data = (np.array(line.get_data(), float) for line in ax.get_lines())
    known = (xy[:, np.isfinite(xy).all(axis=0)] for xy in data)
    curves = [xy for xy in known if xy.shape[1] > 1]
    if not curves:
        return
    x, y = min(curves, key=lambda xy: xy[1, -1])
    factor = np.min(y / x**exponent) / 2
    ax.plot(x, factor * x**exponent, color=REFERENCE, linestyle=":", linewidth=1, label=label)


# Orbits


@style()
def coordinates_against_time(
    times, reference, predictions: Mapping, ylabel, window=None, xlabel="time $t$", ax=None
) -> Axes:
    """Draw a coordinate against time: reference (L,) in black and predictions name -> (L,).

    window: (first, last) time shown, to show late times (paper, Fig. 2, lower row).
    """
    ax = axes_or_new(ax, WIDTH * 1.3)
    times = np.asarray(times)
    low, high = (times[0], times[-1]) if window is None else window
    shown = (times >= low) & (times <= high)
    every = max(1, int(shown.sum()) // 12)
    ax.plot(times[shown], np.asarray(reference)[shown], color=REFERENCE, lw=2.2, label="reference")
    for place, (name, values) in enumerate(predictions.items()):
        start = place * every // max(1, len(predictions))
        ax.plot(
            times[shown],
            np.asarray(values)[shown],
            label=name,
            markevery=(start, every),
            **look_of(place),
        )
    ax.set(xlabel=xlabel, ylabel=ylabel)
    legend_above(ax)
    return ax


@style()
def coordinates_in_two_panels(times, reference, predictions: Mapping, labels, window) -> Figure:
    """Draw two coordinates of an orbit in two panels, each as `coordinates_against_time` does.

    reference: two arrays (L,); predictions: name -> two arrays. One legend is above both panels.
    """
    figure = Figure(figsize=(WIDTH * 1.6, HEIGHT * 1.5))
    axes = figure.subplots(2, 1, sharex=True)
    for i, ax in enumerate(axes):
        both = {name: values[i] for name, values in predictions.items()}
        coordinates_against_time(times, reference[i], both, labels[i], window, ax=ax)
        low, high = np.nanmin(reference[i]), np.nanmax(reference[i])
        margin = 0.3 * (high - low)
        ax.set_ylim(low - margin, high + margin)  # what runs away leaves the frame
    axes[0].set_xlabel("")
    axes[1].get_legend().remove()
    return figure


@style()
def phase_portrait(orbits: Mapping, labels=("$q$", "$p$"), modulo=False, ax=None) -> Axes:
    """Draw orbits over each other: name -> (x (N,), y (N,)); the one named "reference" in black.

    modulo: True reduces both coordinates to [0, 2π), for the standard map.
    """
    ax = axes_or_new(ax, HEIGHT * 1.35, HEIGHT * 1.2)
    place = 0
    for name, (x, y) in orbits.items():
        if name == "reference":
            # Larger: it shows as a rim where the others cover it.
            _points(ax, x, y, modulo, 1.7, color=REFERENCE, marker="o", label=name, zorder=1.5)
        else:
            look = look_of(place)
            _points(ax, x, y, modulo, color=look["color"], marker=look["marker"], label=name)
            place += 1
    _plane(ax, labels, modulo)
    legend_above(ax, markerscale=3)
    return ax


@style()
def sections(points: Mapping, labels=("$q_2$", "$p_2$"), modulo=False, axes=None) -> list[Axes]:
    """Draw Poincaré sections, or chaotic phase portraits (``modulo`` 2π), three in a row.

    points: name -> (x (N,), y (N,)). All panels have the limits of the first, the reference. The
    title counts the points outside, which are not shown.
    """
    columns = min(3, len(points))
    if axes is None:
        rows = -(-len(points) // columns)
        figure = Figure(figsize=(HEIGHT * 0.85 * columns, HEIGHT * 0.92 * rows))
        grid = figure.subplots(rows, columns, squeeze=False).ravel()
        axes = grid[: len(points)]
        for ax in grid[len(points) :]:
            ax.remove()
    limits = None
    for i, (ax, (name, (x, y))) in enumerate(zip(axes, points.items(), strict=True)):
        x, y = _points(ax, x, y, modulo, color=REFERENCE, marker="o")
        below, left = i + columns >= len(points), i % columns == 0
        _plane(ax, (labels[0] if below else None, labels[1] if left else None), modulo)
        ax.tick_params(labelbottom=below, labelleft=left)
        if limits is None:
            limits = ax.get_xlim(), ax.get_ylim()
        ax.set(xlim=limits[0], ylim=limits[1])
        (x0, x1), (y0, y1) = limits
        outside = int(np.sum(~((x >= x0) & (x <= x1) & (y >= y0) & (y <= y1))))
        ax.set_title(f"{name} ({outside} of {x.size} outside)" if outside else name)
    return list(axes)


def _points(ax, x, y, modulo, larger=1.0, **look):
    x, y = np.ravel(np.asarray(x)), np.ravel(np.asarray(y))
    if modulo:
        x, y = x % (2 * np.pi), y % (2 * np.pi)
    size = float(np.clip(60 / np.sqrt(max(x.size, 1)), 0.5, 3))
    # Rasterised, as a PDF of 100,000 vector points takes a minute to show.
    ax.plot(x, y, ls="none", ms=larger * size, mew=0, rasterized=True, **look)
    return x, y


def _plane(ax, labels, modulo):
    ax.set(xlabel=labels[0], ylabel=labels[1])
    if modulo:
        ticks, names = [0, np.pi, 2 * np.pi], ["0", "π", "2π"]
        ax.set(xlim=(0, 2 * np.pi), ylim=(0, 2 * np.pi))
        ax.set_xticks(ticks, names)
        ax.set_yticks(ticks, names)
        ax.set_aspect("equal")


@style()
def marginals(reference, samples: Mapping, bins: int, range, label, ax=None) -> Axes:
    """Draw histograms of a coordinate of chaotic orbits, with KL divergences from the reference.

    reference: (M,) samples; samples: name -> (N,). The bins are those of `metrics.kl_divergence`.
    Densities are relative to all samples, also those outside the range.
    """
    ax = axes_or_new(ax)

    def densities(values):
        values = np.ravel(np.asarray(values, float))
        counts, edges = np.histogram(values[np.isfinite(values)], bins, range)
        return counts / (values.size * np.diff(edges)), edges

    ax.stairs(
        *densities(reference), fill=True, color=REFERENCE, alpha=0.18, label="reference", lw=0
    )
    for place, (name, values) in enumerate(samples.items()):
        look = look_of(place)
        divergence = kl_divergence(values, reference, bins, range)
        ax.stairs(
            *densities(values),
            color=look["color"],
            linestyle=look["linestyle"],
            linewidth=1.3,
            label=f"{name}, KL {divergence:.2g}",
        )
    ax.set(xlabel=label, ylabel=f"density ({bins} bins)", xlim=range)
    legend_above(ax, ncols=2)
    return ax


@style()
def marginal_panels(panels: Mapping, bins: int) -> Figure:
    """Draw `marginals` side by side: label -> (reference (M,), name -> samples (N,), range)."""
    figure = Figure(figsize=(WIDTH * len(panels), HEIGHT * 1.3))
    for ax, (label, (reference, samples, limits)) in zip(
        np.ravel(figure.subplots(1, len(panels))), panels.items(), strict=True
    ):
        marginals(reference, samples, bins, limits, label, ax=ax)
    return figure
