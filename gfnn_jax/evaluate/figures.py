"""Figures in print quality: arrays in, Axes out.

Each function draws on ``ax`` where one is given, else on a new figure (`save(ax.figure, path)`).
Figures are matplotlib `Figure` objects; pyplot and its global state are never touched. One style
serves the colour-blind and grey print: each method has a colour, a marker and a line style, by its
place in the mapping. The reference is black and comes first.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from cycler import cycler
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patheffects import withStroke
from matplotlib.ticker import LogLocator, MaxNLocator, NullFormatter

from gfnn_jax.evaluate.chaos import kl_divergence
from gfnn_jax.evaluate.errors import error_statistics

# Okabe & Ito's palette without its yellow, which does not show on white, and with grey.
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#777777")
MARKERS = ("o", "s", "^", "D", "v", "P", "X", "<", ">")
LINES = ("-", "--", "-.", (0, (1, 1)), (0, (5, 1, 1, 1, 1, 1)))
REFERENCE = "black"

STYLE: dict[Any, Any] = {
    "figure.constrained_layout.use": True,
    "figure.dpi": 100,
    "font.size": 9,
    "axes.labelsize": 9,
    "axes.titlesize": 9,
    "legend.fontsize": 8,
    "legend.framealpha": 0.85,
    "xtick.labelsize": 8,
    "ytick.labelsize": 8,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.color": "#DDDDDD",
    "grid.linewidth": 0.5,
    "axes.axisbelow": True,
    "axes.formatter.use_mathtext": True,
    "lines.linewidth": 1.3,
    "lines.markersize": 4,
    "pdf.fonttype": 42,
    "axes.prop_cycle": cycler(color=COLOURS),
}
_HALO = [withStroke(linewidth=2, foreground="white")]  # keeps text legible on lines
WIDTH, HEIGHT = 4.8, 3.2  # inches, of one panel; a column of a paper is about 3.3 wide


def style():
    """Style of the package as a context and as a decorator; matplotlib's settings are restored."""
    return matplotlib.rc_context(STYLE)


@style()
def save(figure: Figure, path) -> None:
    """Write a figure as ``.png`` (200 dots per inch) or ``.pdf``, by the suffix of ``path``."""
    # A layout engine leaves room for all labels; "tight" would draw everything a second time.
    whole = figure.get_layout_engine() is not None
    figure.savefig(Path(path), dpi=200, bbox_inches=None if whole else "tight")


def _axes(ax, width=WIDTH, height=HEIGHT) -> Axes:
    return Figure(figsize=(width, height)).add_subplot() if ax is None else ax


def _look(place: int) -> dict:
    return {
        "color": COLOURS[place % len(COLOURS)],
        "marker": MARKERS[place % len(MARKERS)],
        "linestyle": LINES[place % len(LINES)],
    }


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
    ax = _axes(ax)
    _error_curves(ax, errors, ylabel)
    _guide(ax, 1.0, r"$\propto n$")
    if band is not None:
        _shaded(ax, np.asarray(band[0]), np.mean(band[1], axis=0))
    _legend_above(ax)
    return ax


@style()
def proportionality(points: Mapping, xlabel, ylabel, ax=None) -> Axes:
    """Draw a positive quantity against another, log–log, with a dotted line proportional to x.

    points: name -> (x (K,), y (K,)).
    """
    ax = _axes(ax)
    for place, (name, (x, y)) in enumerate(points.items()):
        ax.plot(x, y, label=name, **_look(place))
    ax.set(xscale="log", yscale="log", xlabel=xlabel, ylabel=ylabel)
    _guide(ax, 1.0, r"$\propto\varepsilon$")
    _legend_above(ax)
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
        _legend_above(ax)
    return tuple(axes)


@style()
def energy_error(errors: Mapping, ax=None) -> Axes:
    """Draw the root mean square over trajectories of the energy error against step, log–log.

    errors: name -> (steps (L,), energy error (B, L)). The dotted line grows as √step, as roundoff.
    """
    ax = _axes(ax)
    for place, (name, (steps, error)) in enumerate(errors.items()):
        size = np.sqrt(np.mean(np.atleast_2d(np.asarray(error)) ** 2, axis=0))
        _log_curve(ax, place, name, np.asarray(steps), size)
    _log_log(ax, r"energy error $|H-H_0|\,/\,|H_0|$ (RMS)")
    _guide(ax, 0.5, r"$\propto \sqrt{n}$")
    _legend_above(ax)
    return ax


def _shaded(ax, steps, upper):
    """Shade the region below ``upper`` (L,), without extending the axis downwards."""
    shown = (steps > 0) & np.isfinite(upper) & (upper > 0)
    if not shown.any():
        return
    ax.plot(steps[shown], upper[shown], color=REFERENCE, linewidth=0.8, alpha=0.5, label="_band")
    low = min(ax.get_ylim()[0], float(upper[shown].min()))
    ax.fill_between(
        steps[shown], low, upper[shown], color="0.5", alpha=0.15, linewidth=0, zorder=0,
        label=r"two $\sigma$ of the posterior",
    )  # fmt: skip
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
            look = _look(place) | {"marker": "", "linewidth": 0.8}
            ax.plot(steps[rest], statistics.median[rest], label="_the median", **look)
        if len(error) > 1:
            factor = 1 + statistics.std[shown] / mean[shown]
            low, high = mean[shown] / factor, mean[shown] * factor
            colour = _look(place)["color"]
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
    ax.plot(steps[shown], values[shown], label=name, markevery=marks, **_look(place))
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
    ax = _axes(ax, WIDTH * 1.3)
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
            **_look(place),
        )
    ax.set(xlabel=xlabel, ylabel=ylabel)
    _legend_above(ax)
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
    ax = _axes(ax, HEIGHT * 1.35, HEIGHT * 1.2)
    place = 0
    for name, (x, y) in orbits.items():
        if name == "reference":
            # Larger: it shows as a rim where the others cover it.
            _points(ax, x, y, modulo, 1.7, color=REFERENCE, marker="o", label=name, zorder=1.5)
        else:
            look = _look(place)
            _points(ax, x, y, modulo, color=look["color"], marker=look["marker"], label=name)
            place += 1
    _plane(ax, labels, modulo)
    _legend_above(ax, markerscale=3)
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
    ax = _axes(ax)

    def densities(values):
        values = np.ravel(np.asarray(values, float))
        counts, edges = np.histogram(values[np.isfinite(values)], bins, range)
        return counts / (values.size * np.diff(edges)), edges

    ax.stairs(
        *densities(reference), fill=True, color=REFERENCE, alpha=0.18, label="reference", lw=0
    )
    for place, (name, values) in enumerate(samples.items()):
        look = _look(place)
        divergence = kl_divergence(values, reference, bins, range)
        ax.stairs(
            *densities(values),
            color=look["color"],
            linestyle=look["linestyle"],
            linewidth=1.3,
            label=f"{name}, KL {divergence:.2g}",
        )
    ax.set(xlabel=label, ylabel=f"density ({bins} bins)", xlim=range)
    _legend_above(ax, ncols=2)
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


# Cost and training


@style()
def speed_against_error(
    kilo_operations, errors, labels: Sequence[str], chosen, tolerance=None, ax=None, estimated=()
) -> Axes:
    """Draw the one-step error of candidates against operations of a predicted step, log–log.

    kilo_operations, errors: (K,). The points are numbered by rising cost and named on the right.
    The chosen one has a ring. The staircase joins the points that no other beats in both. The
    dotted line is the tolerance. estimated: indices of errors that no step has measured; their
    points are hollow.
    """
    ax = _axes(ax, WIDTH * 1.6, HEIGHT * 1.15)
    cost, error = np.asarray(kilo_operations, float), np.asarray(errors, float)
    order = np.argsort(cost, kind="stable")
    best = np.minimum.accumulate(error[order])
    front = np.flatnonzero(np.append(True, best[1:] < best[:-1]))
    ax.step(
        cost[order][front],
        best[front],
        where="post",
        color=COLOURS[0],
        lw=1,
        label="best for its cost",
    )
    about = np.isin(np.arange(len(cost)), estimated)
    dots = {"ls": "none", "marker": "o", "color": COLOURS[0], "ms": 5}
    ax.plot(cost[~about], error[~about], **dots, label="candidate")
    if about.any():
        ax.plot(cost[about], error[about], **dots, mfc="white", label="candidate, estimated")
    ax.plot(
        cost[chosen],
        error[chosen],
        ls="none",
        marker="o",
        ms=11,
        mfc="none",
        mec=COLOURS[1],
        mew=1.8,
        label="chosen",
    )
    if tolerance is not None:
        ax.axhline(tolerance, color=REFERENCE, ls=":", lw=1, label="tolerance")
    ax.set(
        xscale="log",
        yscale="log",
        xlabel="operations per step and trajectory (thousands)",
        ylabel="one-step error ÷ spread",
    )
    ax.margins(0.12)
    ax.xaxis.set_minor_locator(LogLocator(subs=(2, 5)))  # more labels would cover each other
    ax.xaxis.set_major_formatter("{x:g}")
    few = max(cost) < 1e3 * min(cost)
    ax.xaxis.set_minor_formatter("{x:g}" if few else NullFormatter())
    _number_points(ax, cost, error, order)
    ax.legend(loc="upper left", bbox_to_anchor=(1.01, 1.0), frameon=False)
    names = [
        f"{number + 1}  {labels[i]}{'  (chosen)' if i == chosen else ''}"
        for number, i in enumerate(order)
    ]
    ax.annotate(
        "\n".join(names),
        (1.03, 0.7),
        xycoords="axes fraction",
        va="top",
        fontsize=7.5,
        linespacing=1.35,
        annotation_clip=False,
    )
    return ax


def _number_points(ax, x, y, order):
    """Write 1, 2, … beside the points, each on the side where it covers least."""
    ax.autoscale_view()
    points = ax.transData.transform(np.column_stack([x, y])) * 72 / ax.figure.dpi
    taken = list(points)
    sides = np.array([(8, 8), (0, 10), (10, 0), (0, -10), (-10, 0), (-8, -8), (8, -8), (-8, 8)])
    for number, i in enumerate(order):
        places = points[i] + sides
        others = np.array(taken)
        nearest = np.min(np.linalg.norm(places[:, None] - others, axis=-1), axis=1)
        side = int(np.argmax(np.minimum(nearest, 10)))
        taken.append(places[side])
        ax.annotate(
            str(number + 1),
            (x[i], y[i]),
            sides[side],
            textcoords="offset points",
            ha="center",
            va="center",
            fontsize=8,
            path_effects=_HALO,
        )


@style()
def work_precision(
    curves: Mapping,
    ylabel="position error",
    xlabel="time per step and trajectory (µs)",
    ax=None,
) -> Axes:
    """Draw error against time: name -> (microseconds (K,), errors (K,)), compile time apart."""
    ax = _axes(ax)
    for place, (name, (cost, error)) in enumerate(curves.items()):
        ax.plot(cost, error, label=name, **_look(place))
    ax.set(xscale="log", yscale="log", xlabel=xlabel, ylabel=ylabel)
    _legend_above(ax)
    return ax


@style()
def work_precision_panels(panels: Mapping, ylabel) -> Figure:
    """Draw error against time, log–log, of learned maps and other methods, in panels side by side.

    panels: title -> {"ours", "float32", "known", "others"}, each a mapping of name -> (cost (K,),
    error (K,), size (K,) as text). Ours have a colour and a filled marker each, with the size
    beside it; the same names in float32 are hollow. The thick line joins those of ours that no
    other of ours beats. Methods that know H are grey. Numbered crosses are single results of other
    methods.
    """
    figure = Figure(figsize=(WIDTH * 0.85 * len(panels) + 1.6, HEIGHT * 1.25))
    axes = np.ravel(figure.subplots(1, len(panels), sharey=True))
    # A name looks alike in all panels, also where one of them lacks another.
    named = [n for group in ("ours", "known") for p in panels.values() for n in p[group]]
    place = {name: i for i, name in enumerate(dict.fromkeys(named))}
    for ax, (title, groups) in zip(axes, panels.items(), strict=True):
        _front(ax, [*groups["ours"].values(), *groups["float32"].values()])
        for name, points in groups["ours"].items():
            look = _look(place[name]) | {"linestyle": "none", "ms": 5.5}
            ax.plot(*points[:2], label=name, **look)
            for cost, error, size in zip(*points, strict=True):
                ax.annotate(size, (cost, error), (5, 3), textcoords="offset points", fontsize=6,
                            color=look["color"], path_effects=_HALO)  # fmt: skip
            if name in groups["float32"]:
                ax.plot(*groups["float32"][name][:2], mfc="white", **look)
        if groups["float32"]:
            ax.plot([], [], "o", mfc="white", color="#777777", label="hollow: in float32")
        for name, points in groups["known"].items():
            look = _look(place[name]) | {"color": "#777777", "linewidth": 0.8, "ms": 3.5}
            ax.plot(*points[:2], label=f"{name} (told H)", **look)
        costs, errors = (
            np.array([np.ravel(v[i])[0] for v in groups["others"].values()]) for i in (0, 1)
        )
        if len(costs):
            ax.plot(costs, errors, "x", color=REFERENCE, ms=4)
        ax.set(xscale="log", yscale="log", title=title)
        ax.set_xlabel("time per trajectory and unit time (µs)")
        ax.xaxis.set_minor_formatter(NullFormatter())  # they would cover each other
        if len(costs):
            _number_points(ax, costs, errors, np.arange(len(costs)))
            for number, name in enumerate(groups["others"]):
                ax.plot([], [], "x", color=REFERENCE, ms=4, label=f"{number + 1}  {name}")
    axes[0].set_ylabel(ylabel)
    handles = {}
    for ax in axes:
        for handle, name in zip(*ax.get_legend_handles_labels(), strict=True):
            handles.setdefault(name, handle)
    figure.legend(handles.values(), handles, loc="outside right center", frameon=False)
    return figure


def _front(ax, curves):
    """Draw the staircase through the points that no other beats in both cost and error."""
    cost, error = (np.concatenate([np.ravel(c[i]) for c in curves]) for i in (0, 1))
    order = np.lexsort((error, cost))
    best = np.minimum.accumulate(error[order])
    front = np.flatnonzero(np.append(True, best[1:] < best[:-1]))
    ax.step(
        cost[order][front], best[front], where="post", color=COLOURS[5], lw=4, alpha=0.45,
        label="best of our maps", zorder=1.5,
    )  # fmt: skip


@style()
def training_curve(train_rms, validation_rms, ax=None) -> Axes:
    """Draw the residual on training and validation pairs after each epoch, (E,) each."""
    ax = _axes(ax)
    epochs = 1 + np.arange(len(train_rms))
    best = int(np.nanargmin(validation_rms))
    ax.plot(epochs, train_rms, color=COLOURS[0], label="training pairs")
    ax.plot(epochs, validation_rms, color=COLOURS[1], ls="--", label="held-out pairs")
    ax.plot(
        epochs[best],
        validation_rms[best],
        ls="none",
        marker="*",
        ms=10,
        color=COLOURS[1],
        label=f"kept: epoch {best + 1}",
    )
    ax.set(yscale="log", xlabel="epoch", ylabel="residual (RMS)")
    ax.xaxis.set_major_locator(MaxNLocator(integer=True))
    ax.legend()
    return ax


def _legend_above(ax, ncols=3, **options):
    """Draw the legend above the axes, where it covers no data."""
    ax.legend(
        loc="lower left",
        bbox_to_anchor=(0, 1.0),
        ncols=ncols,
        frameon=False,
        borderaxespad=0.2,
        handlelength=2.4,
        columnspacing=1.2,
        **options,
    )


@style()
def digits_against_step_size(sweeps: Mapping, axes=None) -> list[Axes]:
    """Draw digits kept against the time step, a panel for each system, a curve for each chart.

    sweeps: system -> {"dt": (K,), chart: digits (K,), ...}. A fit that was refused is None or NaN,
    and is drawn as a cross on the axis.
    """
    if axes is None:
        figure = Figure(figsize=(WIDTH * 0.62 * len(sweeps), HEIGHT))
        axes = list(np.atleast_1d(figure.subplots(1, len(sweeps), sharey=True)))
    for ax, (system, curves) in zip(axes, sweeps.items(), strict=True):
        dt = np.asarray(curves["dt"], float)
        named = [(name, values) for name, values in curves.items() if name != "dt"]
        for place, (name, values) in enumerate(named):
            digits = np.array(values, dtype=float)  # None becomes NaN
            look = _look(place)
            ax.plot(dt, digits, label=name, **look)
            lost = np.isnan(digits)
            # Crosses of charts that fail alike stand above each other.
            ax.plot(dt[lost], np.full(lost.sum(), -0.4 * place), ls="none", marker="x",
                    color=look["color"])  # fmt: skip
        ax.set(title=system, xlabel="time step $dt$")
    axes[0].set_ylabel("digits kept in one step")
    axes[0].plot([], [], ls="none", marker="x", color=REFERENCE, label="fit refused")
    axes[0].legend(loc="lower left")
    return axes
