"""Figures of what maps cost and how they were trained: errors against operations and time."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, MaxNLocator, NullFormatter

from gfnn_jax.evaluate.figures_style import (
    COLOURS,
    HALO,
    HEIGHT,
    REFERENCE,
    WIDTH,
    axes_or_new,
    legend_above,
    look_of,
    style,
    without_minor_ticks,
)


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
    ax = axes_or_new(ax, WIDTH * 1.6, HEIGHT * 1.15)
    cost, error = np.asarray(kilo_operations, float), np.asarray(errors, float)
    order = np.argsort(cost, kind="stable")
    ax.step(
        *_unbeaten(cost, error),
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
    _costs_as_numbers(ax, cost)
    without_minor_ticks(ax)
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
            path_effects=HALO,
        )


@style()
def work_precision(
    curves: Mapping,
    ylabel="position error",
    xlabel="time per step and trajectory (µs)",
    ax=None,
) -> Axes:
    """Draw error against time: name -> (microseconds (K,), errors (K,)), compile time apart."""
    ax = axes_or_new(ax)
    for place, (name, (cost, error)) in enumerate(curves.items()):
        ax.plot(cost, error, label=name, **look_of(place))
    ax.set(xscale="log", yscale="log", xlabel=xlabel, ylabel=ylabel)
    _costs_as_numbers(ax, np.concatenate([np.ravel(cost) for cost, _ in curves.values()]))
    legend_above(ax)
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
            look = look_of(place[name]) | {"linestyle": "none", "ms": 5.5}
            ax.plot(*points[:2], label=name, **look)
            for cost, error, size in zip(*points, strict=True):
                ax.annotate(
                    size,
                    (cost, error),
                    (5, 3),
                    textcoords="offset points",
                    fontsize=6,
                    color=look["color"],
                    path_effects=HALO,
                )
            if name in groups["float32"]:
                ax.plot(*groups["float32"][name][:2], mfc="white", **look)
        if groups["float32"]:
            ax.plot([], [], "o", mfc="white", color="#777777", label="hollow: in float32")
        for name, points in groups["known"].items():
            look = look_of(place[name]) | {"color": "#777777", "linewidth": 0.8, "ms": 3.5}
            ax.plot(*points[:2], label=f"{name} (given H)", **look)
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


def _unbeaten(cost, error) -> tuple[np.ndarray, np.ndarray]:
    """Points, by rising cost, that no other beats in both cost and error."""
    order = np.lexsort((error, cost))
    best = np.minimum.accumulate(error[order])
    front = np.flatnonzero(np.append(True, best[1:] < best[:-1]))
    return cost[order][front], best[front]


def _front(ax, curves):
    """Draw the staircase through the points that no other beats in both cost and error."""
    cost, error = (np.concatenate([np.ravel(c[i]) for c in curves]) for i in (0, 1))
    ax.step(
        *_unbeaten(cost, error),
        where="post",
        color=COLOURS[5],
        lw=4,
        alpha=0.45,
        label="best of our maps",
        zorder=1.5,
    )


@style()
def training_curve(train_rms, validation_rms, ax=None) -> Axes:
    """Draw the residual on training and validation pairs after each epoch, (E,) each."""
    ax = axes_or_new(ax)
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
            look = look_of(place)
            ax.plot(dt, digits, label=name, **look)
            lost = np.isnan(digits)
            # Crosses of charts that fail alike stand above each other.
            ax.plot(
                dt[lost],
                np.full(lost.sum(), -0.4 * place),
                ls="none",
                marker="x",
                color=look["color"],
            )
        ax.set(title=system, xlabel="time step $dt$")
    axes[0].set_ylabel("digits kept in one step")
    axes[0].plot([], [], ls="none", marker="x", color=REFERENCE, label="fit refused")
    axes[0].legend(loc="lower left")
    return axes
