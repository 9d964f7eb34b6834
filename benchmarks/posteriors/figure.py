"""Coverage against width: a panel for each step."""

from __future__ import annotations

from typing import Any

# Sets float64, so it comes before all of JAX.
from harness import FIGURES

# isort: split
import numpy as np
from posteriors.calibration import COVERED, SIGMAS, STEPS, WIDEST, Cell, cells

WIDTHS = (0.1, 0.3, 1.0, 3.0, 10.0)  # what lies beyond is drawn at the ends
LEAST = 50.0  # of the axis of coverage, as well
MARKERS = "o^sDvPX*"
COLORS = dict(zip(SIGMAS.values(), ("#333333", "#2a78b5", "#e08214", "#c0392b"), strict=True))


def figure(rows: dict[str, list[dict[str, Any]]]) -> None:
    """rows: of each case. A case has a marker, σ a colour; laws are filled, maps are not."""
    from matplotlib import pyplot
    from matplotlib.lines import Line2D

    drawn, panels = pyplot.subplots(2, 2, figsize=(10, 8), sharex=True, sharey=True)
    for k, (panel, step) in enumerate(zip(panels.ravel(), STEPS, strict=True)):
        panel.axhspan(100 * COVERED[0], 100 * COVERED[1], color="0.92", zorder=0)
        panel.axvline(WIDEST, color="0.6", linewidth=1, linestyle="--")
        for (name, of_case), marker in zip(rows.items(), MARKERS, strict=False):
            for row in of_case:
                cell = cells(row)[k]
                if isinstance(cell, Cell):
                    color = COLORS[row["sigma"]]
                    panel.errorbar(
                        np.clip(cell.width, WIDTHS[0], WIDTHS[-1]),
                        max(100 * cell.coverage, LEAST),
                        100 * (cell.coverage_error or 0.0),
                        marker=marker,
                        color=color,
                        ms=7,
                        mfc=color if "law" in name else "white",
                        elinewidth=0.7,
                        linestyle="none",
                        clip_on=False,
                        alpha=0.85,
                    )
        panel.set(xscale="log", xlim=(WIDTHS[0], WIDTHS[-1]), ylim=(LEAST, 101))
        panel.set_title(f"step {step:,}")
        panel.set_xticks(WIDTHS, [f"{w:g}" for w in WIDTHS])
        panel.set_xticks([], minor=True)
    for panel in panels[1]:
        panel.set_xlabel("median 2σ band ÷ RMS error")
    for panel in panels[:, 0]:
        panel.set_ylabel("true errors inside, %")
    cases = [
        Line2D(
            [],
            [],
            marker=marker,
            color="0.3",
            linestyle="none",
            label=name,
            mfc="0.3" if "law" in name else "white",
        )
        for name, marker in zip(rows, MARKERS, strict=False)
    ]
    noise = [
        Line2D([], [], marker="s", color=COLORS[sigma], linestyle="none", label=f"noise {name}")
        for name, sigma in SIGMAS.items()
    ]
    drawn.legend(handles=[*cases, *noise], loc="outside lower center", ncols=6, fontsize=8)
    drawn.tight_layout(rect=(0, 0.07, 1, 1))
    drawn.savefig(FIGURES / "bands.png", dpi=110)
    pyplot.close(drawn)
