"""Style of all figures, and how they are written."""

import io
import re
from pathlib import Path
from typing import Any

import matplotlib
from cycler import cycler
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

# Okabe & Ito's palette without its yellow, which does not show on white, and with grey; then wine,
# indigo, olive and sand of Tol's: all methods of a comparison differ.
GREY = "#777777"
COLOURS = (
    *("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", GREY),
    *("#882255", "#332288", "#999933", "#B8A24A"),
)
MARKERS = ("o", "s", "^", "D", "v", "P", "X", "<", ">", "p", "*")
LINES = ("-", "--", "-.", (0, (1, 1)), (0, (5, 1, 1, 1, 1, 1)))
REFERENCE = "black"
WIDTH, HEIGHT = 4.8, 3.2  # inches, of one panel; a column of a paper is about 3.3 wide
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


def style(**changes: Any):
    """Style of the package as a context and as a decorator; matplotlib's settings are restored.
    changes: settings, with __ in place of a dot."""
    settings: dict[Any, Any] = {**STYLE, **{n.replace("__", "."): v for n, v in changes.items()}}
    return matplotlib.rc_context(settings)


@style()
def save(figure: Figure, path, dpi: int = 200) -> None:
    """Write a figure as ``.png`` (``dpi`` dots per inch) or ``.pdf``, by the suffix of ``path``."""
    engine = figure.get_layout_engine()
    if engine is None:
        figure.savefig(Path(path), dpi=dpi, bbox_inches="tight")
        return
    # The engine leaves room for all labels. Matplotlib calls it by a drawing of its own before the
    # one that is saved; a call without that drawing takes a third less. With one canvas for both,
    # the labels are set once.
    canvas, before = figure.canvas, figure.dpi
    try:
        FigureCanvasAgg(figure).figure.dpi = dpi
        engine.execute(figure)
        figure.set_layout_engine("none")
        figure.savefig(Path(path), dpi=dpi)
    finally:
        figure.dpi = before
        figure.set_canvas(canvas)
        figure.set_layout_engine(engine)


@style()
def as_svg(figure: Figure, salt: str) -> str:
    """The figure as SVG for inside a page. salt: makes its names differ from those of others."""
    text = io.StringIO()
    with matplotlib.rc_context({"svg.fonttype": "none", "svg.hashsalt": salt}):
        figure.savefig(text, format="svg", metadata={"Date": None, "Creator": None})
    svg = text.getvalue()
    svg = re.sub(r"<metadata>.*?</metadata>", "", svg[svg.index("<svg") :], flags=re.DOTALL)
    svg = re.sub(r'<g id="[^"]*">', "<g>", svg)
    return re.sub(r'width="[\d.]+pt" height="[\d.]+pt" ', "", svg, count=1)
