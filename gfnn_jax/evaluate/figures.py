"""Figures in print quality: arrays in, Axes out.

Each function draws on ``ax`` where one is given, else on a new figure (`save(ax.figure, path)`).
Figures are matplotlib `Figure` objects; pyplot and its global state are never touched. One style
serves the colour-blind and grey print: each method has a colour, a marker and a line style, by its
place in the mapping. The reference is black and comes first.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.patheffects import withStroke
from matplotlib.ticker import LogLocator, NullFormatter, NullLocator

from gfnn_jax.coordinates import nearest_image
from gfnn_jax.evaluate.figures_style import COLOURS, HEIGHT, LINES, MARKERS, REFERENCE, WIDTH, style
from gfnn_jax.evaluate.figures_style import save as save
from gfnn_jax.evaluate.metrics import error_statistics, kl_divergence
from gfnn_jax.phase_space import split

_HALO = [withStroke(linewidth=2, foreground="white")]  # keeps text legible on lines
_LOG_LOG: dict[str, Any] = {"xscale": "log", "yscale": "log"}
_ALONE: dict[str, Any] = {"linestyle": "none"}  # points without a line


def _axes_or_new(ax, width=WIDTH, height=HEIGHT) -> Axes:
    return Figure(figsize=(width, height)).add_subplot() if ax is None else ax


def _look_of(place: int) -> dict[str, Any]:
    looks = {"color": COLOURS, "marker": MARKERS, "linestyle": LINES}
    return {name: every[place % len(every)] for name, every in looks.items()}


def _without_minor_ticks(*axes: Axes) -> None:
    """Leave out the minor ticks of logarithmic axes of three decades or more: they tell little
    there, and take half of the time of a figure."""
    for axis in (axis for ax in axes for axis in (ax.xaxis, ax.yaxis)):
        low, high = axis.get_view_interval()
        if axis.get_scale() == "log" and high >= 1e3 * low:
            axis.set_minor_locator(NullLocator())


# Of a legend, and the letters that a handle takes the place of.
_LETTERS_PER_INCH, _OF_HANDLE = 13, 8


def _legend_above(ax, ncols=3, **options) -> None:
    """Draw the legend above the axes, where it covers no data, in as many columns as there is room
    for."""
    longest = max(map(len, ax.get_legend_handles_labels()[1]), default=0)
    room = ax.get_position().width * ax.figure.get_figwidth() * _LETTERS_PER_INCH
    ncols = max(1, min(ncols, int(room // (longest + _OF_HANDLE))))
    options |= {"frameon": False, "borderaxespad": 0.2, "handlelength": 2.4, "columnspacing": 1.2}
    ax.legend(loc="lower left", bbox_to_anchor=(0, 1.0), ncols=ncols, **options)


def _legend_of_all(figure: Figure, ax: Axes, ncols: int) -> None:
    """Draw the legend of one of its axes above the figure."""
    names = ax.get_legend_handles_labels()
    figure.legend(*names, loc="outside upper center", ncols=ncols, frameon=False)


# Candidates of a fit


def candidates_figure(fit: Any) -> Figure | None:
    """Draw error against cost of the candidates of a fit of pairs (`gfnn.Fit`, `Choice`), the
    chosen one marked; None where its error is not known."""
    shown = [c for c in fit.candidates if np.isfinite(c.validation_relative)]
    if fit.chosen not in shown:
        return None
    costs, errors = [c.operations / 1e3 for c in shown], [c.validation_relative for c in shown]
    labels, chosen = [*map(_labelled, shown)], shown.index(fit.chosen)
    estimated = [i for i, c in enumerate(shown) if not c.validated]
    ax = speed_against_error(costs, errors, labels, chosen, fit.tolerance, estimated)
    return ax.figure  # pyright: ignore[reportReturnType]


def _labelled(candidate: Any) -> str:
    """Label of a candidate: chart, family and size, and the time of a step where measured."""
    microseconds = candidate.microseconds_per_step
    timed = f", {microseconds:.1f} µs" if microseconds is not None else ""
    return f"{candidate.chart} {candidate.label}{timed}"


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
    ax = _axes_or_new(ax)
    _error_curves(ax, errors, ylabel)
    _guide(ax, 1.0, r"$\propto n$")
    if band is not None:
        _shaded(ax, np.asarray(band[0]), np.mean(band[1], axis=0))
    _without_minor_ticks(ax)
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
    _without_minor_ticks(*axes)
    return tuple(axes)


@style()
def energy_error(errors: Mapping, ax=None) -> Axes:
    """Draw the root mean square over trajectories of the energy error against step, log–log.

    errors: name -> (steps (L,), energy error (B, L)). The dotted line grows as √step, as roundoff.
    """
    ax = _axes_or_new(ax)
    for place, (name, (steps, error)) in enumerate(errors.items()):
        size = np.sqrt(np.mean(np.atleast_2d(np.asarray(error)) ** 2, axis=0))
        _log_curve(ax, place, name, np.asarray(steps), size)
    label = r"energy error $|H-H_0|\,/\,|H_0|$ (RMS)"
    ax.set(xlabel="step $n$", ylabel=label, **_LOG_LOG)
    _guide(ax, 0.5, r"$\propto \sqrt{n}$")
    _without_minor_ticks(ax)
    _legend_above(ax)
    return ax


def _shaded(ax, steps, upper):
    """Shade the region below ``upper`` (L,), without extending the axis downwards."""
    shown = _drawable(steps, upper)
    if not shown.any():
        return
    x, y = steps[shown], upper[shown]
    ax.plot(x, y, color=REFERENCE, linewidth=0.8, alpha=0.5, label="_band")
    low = min(ax.get_ylim()[0], float(y.min()))
    look: dict[str, Any] = {"color": "0.5", "alpha": 0.15, "linewidth": 0, "zorder": 0}
    ax.fill_between(x, low, y, label=r"two $\sigma$ of the posterior", **look)
    ax.set_ylim(bottom=low)


def _error_curves(ax, errors, ylabel):
    for place, (name, (steps, error)) in enumerate(errors.items()):
        error, steps = np.atleast_2d(np.asarray(error)), np.asarray(steps)
        statistics = error_statistics(error)
        mean, median, lost = statistics.mean, statistics.median, statistics.num_lost
        if lost:
            name = f"{name} ({lost} of {len(error) - statistics.num_excluded} lost)"
        shown = _log_curve(ax, place, name, steps, mean)
        if lost:
            rest = ~shown & _drawable(steps, median)
            look = _look_of(place) | {"marker": "", "linewidth": 0.8}
            ax.plot(steps[rest], median[rest], label="_the median", **look)
        if len(error) > 1:
            factor = 1 + statistics.std[shown] / mean[shown]
            low, high = mean[shown] / factor, mean[shown] * factor
            colour = _look_of(place)["color"]
            ax.fill_between(steps[shown], low, high, color=colour, alpha=0.18, linewidth=0)
    ax.set(xlabel="step $n$", ylabel=ylabel, **_LOG_LOG)


def _drawable(steps, values):
    """Flags of the points that axes of logarithms can show."""
    return (steps > 0) & np.isfinite(values) & (values > 0)


def _log_curve(ax, place, name, steps, values):
    """Draw a curve's positive points, log–log, with about eight markers; return their flags."""
    shown = _drawable(steps, values)
    x = np.log(steps[shown])
    marks = []
    if len(x):  # offset by method, so that markers of curves that coincide do not hide each other
        ticks = np.linspace(x[0], x[-1], 9)[:-1] + (x[-1] - x[0]) / 8 * (0.3 + 0.37 * place % 0.7)
        marks = np.unique(np.clip(np.searchsorted(x, ticks), 0, len(x) - 1)).tolist()
    ax.plot(steps[shown], values[shown], label=name, markevery=marks, **_look_of(place))
    return shown


def _guide(ax, exponent, label):
    """Draw a dotted power law just below the lowest curve; only its slope has a meaning."""
    data = (np.array(line.get_data(), float) for line in ax.get_lines())
    known = (xy[:, np.isfinite(xy).all(axis=0)] for xy in data)
    curves = [xy for xy in known if xy.shape[1] > 1]
    if curves:
        x, y = min(curves, key=lambda xy: xy[1, -1])
        factor = np.min(y / x**exponent) / 2
        ax.plot(x, factor * x**exponent, color=REFERENCE, linestyle=":", linewidth=1, label=label)


# Orbits


@style()
def coordinates_against_time(
    times, reference, predictions: Mapping, ylabel, window=None, ax=None
) -> Axes:
    """Draw a coordinate against time: reference (L,) in black and predictions name -> (L,).

    window: (first, last) time shown, to show late times (paper, Fig. 2, lower row).
    """
    ax = _axes_or_new(ax, WIDTH * 1.3)
    times = np.asarray(times)
    low, high = (times[0], times[-1]) if window is None else window
    shown = (times >= low) & (times <= high)
    every = max(1, int(shown.sum()) // 12)
    ax.plot(times[shown], np.asarray(reference)[shown], color=REFERENCE, lw=2.2, label="reference")
    for place, (name, values) in enumerate(predictions.items()):
        marks = (place * every // max(1, len(predictions)), every)
        look: dict[str, Any] = _look_of(place) | {"markevery": marks}
        ax.plot(times[shown], np.asarray(values)[shown], label=name, **look)
    ax.set(xlabel="time $t$", ylabel=ylabel)
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
    ax = _axes_or_new(ax, HEIGHT * 1.35, HEIGHT * 1.2)
    places = iter(range(len(orbits)))
    for name, (x, y) in orbits.items():
        if name == "reference":
            # Larger: it shows as a rim where the others cover it.
            _points(ax, x, y, modulo, 1.7, color=REFERENCE, marker="o", label=name, zorder=1.5)
        else:
            look = _look_of(next(places))
            _points(ax, x, y, modulo, color=look["color"], marker=look["marker"], label=name)
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
    for i, (ax, (name, (x, y))) in enumerate(zip(axes, points.items(), strict=True)):
        x, y = _points(ax, x, y, modulo, color=REFERENCE, marker="o")
        below, left = i + columns >= len(points), i % columns == 0
        _plane(ax, (labels[0] if below else None, labels[1] if left else None), modulo)
        ax.tick_params(labelbottom=below, labelleft=left)
        (x0, x1), (y0, y1) = limits = axes[0].get_xlim(), axes[0].get_ylim()
        ax.set(xlim=limits[0], ylim=limits[1])
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
    ax = _axes_or_new(ax)

    def densities(values):
        values = np.ravel(np.asarray(values, float))
        counts, edges = np.histogram(values[np.isfinite(values)], bins, range)
        return counts / (values.size * np.diff(edges)), edges

    filled: dict[str, Any] = {"fill": True, "color": REFERENCE, "alpha": 0.18, "lw": 0}
    counts, edges = densities(reference)
    ax.stairs(counts, edges, label="reference", **filled)
    for place, (name, values) in enumerate(samples.items()):
        look: dict[str, Any] = _look_of(place) | {"linewidth": 1.3}
        del look["marker"]
        divergence = kl_divergence(values, reference, bins, range)
        ax.stairs(*densities(values), label=f"{name}, KL {divergence:.2g}", **look)
    ax.set(xlabel=label, ylabel=f"density ({bins} bins)", xlim=range)
    _legend_above(ax, ncols=2)
    return ax


@style()
def marginal_panels(panels: Mapping, bins: int) -> Figure:
    """Draw `marginals` side by side: label -> (reference (M,), name -> samples (N,), range)."""
    figure = Figure(figsize=(WIDTH * len(panels), HEIGHT * 1.3))
    axes = np.ravel(figure.subplots(1, len(panels)))
    for ax, (label, (reference, samples, limits)) in zip(axes, panels.items(), strict=True):
        marginals(reference, samples, bins, limits, label, ax=ax)
    return figure


# What maps cost, and how they were trained


@style()
def speed_against_error(
    kilo_operations, errors, labels: Sequence[str], chosen, tolerance=None, estimated=()
) -> Axes:
    """Draw the one-step error of candidates against operations of a predicted step, log–log.

    kilo_operations, errors: (K,). The points are numbered by rising cost and named on the right.
    The chosen one has a ring. The staircase joins the points that no other beats in both. The
    dotted line is the tolerance. estimated: indices of errors that no step has measured; their
    points are hollow.
    """
    ax = _axes_or_new(None, WIDTH * 1.6, HEIGHT * 1.15)
    cost, error = np.asarray(kilo_operations, float), np.asarray(errors, float)
    order = np.argsort(cost, kind="stable")
    front = unbeaten(cost, error)
    ax.step(*front, where="post", color=COLOURS[0], lw=1, label="best for its cost")
    about = np.isin(np.arange(len(cost)), estimated)
    dots = _ALONE | {"marker": "o", "color": COLOURS[0], "ms": 5}
    ax.plot(cost[~about], error[~about], **dots, label="candidate")
    if about.any():
        ax.plot(cost[about], error[about], **dots, mfc="white", label="candidate, estimated")
    ring = _ALONE | {"marker": "o", "ms": 11, "mfc": "none", "mec": COLOURS[1], "mew": 1.8}
    ax.plot(cost[chosen], error[chosen], label="chosen", **ring)
    if tolerance is not None:
        ax.axhline(tolerance, color=REFERENCE, ls=":", lw=1, label="tolerance")
    ax.set(xlabel="operations per step and trajectory (thousands)", **_LOG_LOG)
    ax.set(ylabel="one-step error ÷ spread")
    ax.margins(0.12)
    _costs_as_numbers(ax, cost)
    _without_minor_ticks(ax)
    _number_points(ax, cost, error, order)
    ax.legend(loc="upper left", bbox_to_anchor=(1.01, 1.0), frameon=False)
    named = (f"{labels[i]}{'  (chosen)' if i == chosen else ''}" for i in order)
    names = "\n".join(f"{number}  {name}" for number, name in enumerate(named, 1))
    look: dict[str, Any] = {"va": "top", "fontsize": 7.5, "linespacing": 1.35}
    ax.annotate(names, (1.03, 0.7), xycoords="axes fraction", annotation_clip=False, **look)
    return ax


def _costs_as_numbers(ax, cost):
    """Label the axis of costs by 1, 2, 5, 10, …; more labels would cover each other."""
    ax.xaxis.set_minor_locator(LogLocator(subs=(2, 5)))
    ax.xaxis.set_major_formatter("{x:g}")
    few = max(cost) < 1e3 * min(cost)
    ax.xaxis.set_minor_formatter("{x:g}" if few else NullFormatter())


def _number_points(ax, x, y, order):
    """Write 1, 2, … beside the points, each on the side where it covers least."""
    ax.autoscale_view()
    points = ax.transData.transform(np.column_stack([x, y])) * 72 / ax.figure.dpi
    taken = list(points)
    sides = np.array([(8, 8), (0, 10), (10, 0), (0, -10), (-10, 0), (-8, -8), (8, -8), (-8, 8)])
    look: dict[str, Any] = {"ha": "center", "va": "center", "fontsize": 8, "path_effects": _HALO}
    for number, i in enumerate(order, 1):
        places = points[i] + sides
        nearest = np.linalg.norm(places[:, None] - np.array(taken), axis=-1).min(axis=1)
        side = int(np.argmax(np.minimum(nearest, 10)))
        taken.append(places[side])
        ax.annotate(str(number), (x[i], y[i]), sides[side], textcoords="offset points", **look)


@style()
def work_precision(
    curves: Mapping, ylabel="position error", xlabel="time per step and trajectory (µs)", ax=None
) -> Axes:
    """Draw error against time: name -> (microseconds (K,), errors (K,)), compile time apart."""
    ax = _axes_or_new(ax)
    for place, (name, (x, y)) in enumerate(curves.items()):
        ax.plot(x, y, label=name, **_look_of(place))
    ax.set(xlabel=xlabel, ylabel=ylabel, **_LOG_LOG)
    _costs_as_numbers(ax, np.concatenate([np.ravel(cost) for cost, _ in curves.values()]))
    _legend_above(ax)
    return ax


def unbeaten(cost, error) -> tuple[np.ndarray, np.ndarray]:
    """Points, by rising cost, that no other beats in both cost and error."""
    order = np.lexsort((error, cost))
    best = np.minimum.accumulate(error[order])
    front = np.flatnonzero(np.append(True, best[1:] < best[:-1]))
    return cost[order][front], best[front]


# Many degrees of freedom, one trajectory: the reference has a panel of its own, so that nothing
# covers it, and the difference of the prediction has another.

_ROUNDOFF = 1e-16  # lower end of log axes


def mode_energies(z, ends: str = "ring") -> np.ndarray:
    """Energies (..., modes) of the normal modes of sites with unit springs, at states z (..., 2d).

    They are ½(|P_k|² + ω_k²|Q_k|²) (Fermi, Pasta & Ulam 1955). For a ring k goes from 1 to d/2, ω_k
    is 2 sin(πk/d), and the two modes of a wave number are summed. For a chain with free ends k goes
    from 1 to d − 1, and ω_k is 2 sin(πk/2d).
    """
    dim = z.shape[-1] // 2
    if ends == "ring":
        k = np.arange(1, dim // 2 + 1)
        omega, twice = 2 * np.sin(np.pi * k / dim), np.where(2 * k == dim, 1.0, 2.0)
        q, p = (np.fft.rfft(x, axis=-1)[..., k] / np.sqrt(dim) for x in split(z))
        return 0.5 * twice * (np.abs(p) ** 2 + omega**2 * np.abs(q) ** 2)
    k = np.arange(1, dim)
    waves = np.sqrt(2 / dim) * np.cos(np.pi * k * (np.arange(dim)[:, None] + 0.5) / dim)
    q, p = (x @ waves for x in split(z))
    return 0.5 * (p**2 + (2 * np.sin(np.pi * k / (2 * dim)) * q) ** 2)


@style()
def modes(times, reference, predicted, ends: str = "ring") -> Figure:
    """Draw the energies of the longest waves against time: reference, prediction, difference.

    reference, predicted: (L, 2d).
    """
    figure = Figure(figsize=(WIDTH, 2 * HEIGHT))
    above, middle, below = panels = figure.subplots(3, 1, sharex=True)
    first = 4
    exact, found = (mode_energies(np.asarray(z), ends)[:, :first] for z in (reference, predicted))
    drawn = exact, found, np.maximum(np.abs(found - exact), _ROUNDOFF)
    for k, colour in zip(range(exact.shape[1]), COLOURS, strict=False):
        for ax, energy in zip(panels, drawn, strict=True):
            ax.plot(times, energy[:, k], color=colour, label=f"k = {k + 1}")
    above.set(ylabel="mode energy, reference")
    middle.set(ylabel="mode energy, GFNN", ylim=above.get_ylim())
    below.set(ylabel="difference", xlabel="t", yscale="log")
    _legend_of_all(figure, above, first)
    return figure


@style()
def space_time(times, reference, predicted, angles: str = "") -> Figure:
    """Draw p of each site against time, of reference and prediction (L, 2d), and their difference.

    angles: the angles of a site, "", "q" or "qp", compared modulo 2π.
    """
    figure = Figure(figsize=(1.6 * WIDTH, 1.1 * HEIGHT))
    panels = figure.subplots(1, 3, sharex=True, sharey=True)
    reference, predicted = np.asarray(reference), np.asarray(predicted)
    dim = reference.shape[-1] // 2
    turned = tuple(i for i in range(2 * dim) if "qp"[i // dim] in angles)
    off = np.abs(nearest_image(predicted - reference, turned))
    off = off.reshape(len(off), 2, dim).max(axis=1)
    shown = [split(z)[1] for z in (reference, predicted)]
    if "p" in angles:
        shown = [np.remainder(p, 2 * np.pi) for p in shown]
        look: dict[str, Any] = {"vmin": 0.0, "vmax": 2 * np.pi, "cmap": "twilight"}
    else:
        high = float(np.nanmax(np.abs(shown[0])))
        look = {"vmin": -high, "vmax": high, "cmap": "RdBu_r"}
    box: dict[str, Any] = {"extent": (0.5, dim + 0.5, times[0], times[-1]), "origin": "lower"}
    box |= {"aspect": "auto", "interpolation": "nearest"}
    worst = max(float(np.nanmax(off)), 10 * _ROUNDOFF)
    looks = look, look, {"norm": LogNorm(_ROUNDOFF, worst), "cmap": "viridis"}
    images = *shown, np.maximum(off, _ROUNDOFF)
    titles = "reference", "GFNN", "difference"
    for ax, image, look, title in zip(panels, images, looks, titles, strict=True):
        drawn = ax.imshow(image, **look, **box)
        ax.set(title=title, xlabel="site")
        ax.grid(visible=False)
        if title == "GFNN":
            figure.colorbar(drawn, ax=panels[:2], label="$p_i$", location="bottom", shrink=0.6)
    figure.colorbar(drawn, ax=panels[2], label="difference", location="bottom")
    panels[0].set(ylabel="t")
    return figure


@style()
def orbits(times, reference, predicted, bodies: int) -> Figure:
    """Draw orbits of bodies in their first two coordinates, and the error of each against time.

    reference, predicted: (L, 2d), q body by body. The error is the distance between a body's two
    positions. Bodies on a line are drawn against time.
    """
    figure = Figure(figsize=(1.9 * WIDTH, 1.1 * HEIGHT))
    panels = figure.subplots(1, 3)
    both = [split(np.asarray(z))[0] for z in (reference, predicted)]
    exact, found = (q.reshape(len(q), bodies, -1) for q in both)
    off = np.linalg.norm(found - exact, axis=-1)
    on_a_line = exact.shape[-1] == 1
    for i in range(bodies):
        colour = COLOURS[i % len(COLOURS)]
        for ax, q in zip(panels, (exact, found), strict=False):
            x, y = (times, q[:, i, 0]) if on_a_line else (q[:, i, 0], q[:, i, 1])
            ax.plot(x, y, color=colour, linewidth=0.8)
            ax.plot(x[-1:], y[-1:], "o", color=colour, label=f"body {i + 1}")
        panels[2].plot(times, np.maximum(off[:, i], _ROUNDOFF), color=colour)
    for ax, title in zip(panels, ("reference", "GFNN"), strict=False):
        ax.set(title=title, xlabel="t" if on_a_line else "$q_x$")
        ax.set(xlim=panels[0].get_xlim(), ylim=panels[0].get_ylim())
        if not on_a_line:
            ax.set_aspect("equal", adjustable="box")
    panels[0].set(ylabel="$q$" if on_a_line else "$q_y$")
    panels[2].set(title="difference", xlabel="t", ylabel="distance", yscale="log")
    _legend_of_all(figure, panels[0], bodies)
    return figure
