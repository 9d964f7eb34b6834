"""Style of all figures, and what each of them needs: axes, looks by place, legends, files.

One style serves the colour-blind and grey print: each method has a colour, a marker and a line
style, by its place in the mapping. The reference is black and comes first.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import matplotlib
from cycler import cycler
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patheffects import withStroke
from matplotlib.ticker import NullLocator

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
HALO = [withStroke(linewidth=2, foreground="white")]  # keeps text legible on lines
WIDTH, HEIGHT = 4.8, 3.2  # inches, of one panel; a column of a paper is about 3.3 wide
DPI = 200  # dots per inch, of the files
_DECADES = 1e3  # highest ÷ lowest value, from which on an axis has no minor ticks


def style():
    """Style of the package as a context and as a decorator; matplotlib's settings are restored."""
    return matplotlib.rc_context(STYLE)


@style()
def save(figure: Figure, path) -> None:
    """Write a figure as ``.png`` (`DPI` dots per inch) or ``.pdf``, by the suffix of ``path``."""
    engine = figure.get_layout_engine()
    if engine is None:
        figure.savefig(Path(path), dpi=DPI, bbox_inches="tight")
        return
    # The engine leaves room for all labels. Matplotlib calls it by a drawing of its own before the
    # one that is saved; a call without that drawing takes a third less. With one canvas for both,
    # the labels are set once.
    canvas, dpi = figure.canvas, figure.dpi
    try:
        FigureCanvasAgg(figure).figure.dpi = DPI
        engine.execute(figure)
        figure.set_layout_engine("none")
        figure.savefig(Path(path), dpi=DPI)
    finally:
        figure.dpi = dpi
        figure.set_canvas(canvas)
        figure.set_layout_engine(engine)


def axes_or_new(ax, width=WIDTH, height=HEIGHT) -> Axes:
    return Figure(figsize=(width, height)).add_subplot() if ax is None else ax


def look_of(place: int) -> dict:
    return {
        "color": COLOURS[place % len(COLOURS)],
        "marker": MARKERS[place % len(MARKERS)],
        "linestyle": LINES[place % len(LINES)],
    }


def without_minor_ticks(*axes: Axes) -> None:
    """Leave out the minor ticks of logarithmic axes of many decades: they tell little there, and
    take half of the time of a figure."""
    for axis in (axis for ax in axes for axis in (ax.xaxis, ax.yaxis)):
        low, high = axis.get_view_interval()
        if axis.get_scale() == "log" and high >= _DECADES * low:
            axis.set_minor_locator(NullLocator())


def legend_above(ax, ncols=3, **options):
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
