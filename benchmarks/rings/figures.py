"""Figures of a storage ring by its map and by a tracking code, of what `storage_ring` measured."""

from __future__ import annotations

import matplotlib.pyplot as plt
import numpy as np
from harness import FIGURES, Numbers


def tunes_and_aperture(tunes_: Numbers, aperture_: Numbers) -> None:
    """Tunes against amplitude, and the dynamic aperture, of map and tracking."""
    drawn, (left, right) = plt.subplots(1, 2, figsize=(9, 3.6), layout="constrained")
    amplitudes = 1e3 * np.asarray(tunes_["amplitudes"])
    theirs = np.asarray(tunes_["tracked"])
    ours = np.asarray(next(iter(tunes_["learned"].values())))
    for plane, (name, colour) in enumerate((("x", "C0"), ("y", "C1"))):
        rows = slice(plane * len(amplitudes), (plane + 1) * len(amplitudes))
        for k, style in enumerate(("-", "--")):
            label = f"$\\nu_{'xy'[k]}$ against {name}"
            shift = theirs[rows, k] - theirs[rows, k][0]
            left.plot(amplitudes, 1e3 * shift, style, color=colour, label=label)
            left.plot(amplitudes, 1e3 * (ours[rows, k] - theirs[rows, k][0]), ".", color=colour)
    left.set(xlabel="amplitude [mm]", ylabel="tune shift × 1,000", title="tracking, and map (dots)")
    left.legend(fontsize=8)
    angles = np.asarray(aperture_["angles"])
    for name, style in (("tracking", "-"), ("map", "o")):
        radii = 1e3 * np.asarray(aperture_[name], float)
        right.plot(radii * np.cos(angles), radii * np.sin(angles), style, label=name)
    right.set(xlabel="x [mm]", ylabel="y [mm]", title="dynamic aperture of a cell")
    right.legend(fontsize=8)
    drawn.savefig(FIGURES / "storage-ring.png", dpi=150)


def maps_of_frequencies(
    deviation_: Numbers, frequencies_: Numbers, region: tuple[float, float]
) -> None:
    """Frequency maps of map and tracking, sections, and the tunes against δ."""
    drawn, axes = plt.subplots(2, 2, figsize=(9, 6.6), layout="constrained")
    side = frequencies_["side"]
    x, y = (1e3 * np.linspace(0.04, 1, side) * size for size in region)
    for axis, name in zip(axes[0], ("tracking", "map"), strict=True):
        values = np.array(frequencies_[name], float).reshape(side, side)
        shown = axis.pcolormesh(x, y, values, vmin=-10, vmax=-2, cmap="viridis", rasterized=True)
        axis.set(xlabel="x [mm]", ylabel="y [mm]", title=f"frequency map of a cell, {name}")
    drawn.colorbar(shown, ax=axes[0], label="log₁₀ of the tunes' change")
    section, of_delta = axes[1]
    for name, colour, size in (("tracking", "k", 3.0), ("map", "C1", 0.8)):  # the map on top
        points = 1e-3 * np.array(frequencies_["sections_micro"][name])  # (turns, orbits, 2)
        x, y = points[..., 0].ravel(), points[..., 1].ravel()
        section.plot(x, y, f"{colour}o", markersize=size, markeredgewidth=0)
        section.plot([], [], f"{colour}o", markersize=3, label=name)
    section.set(xlabel="x [mm]", ylabel="$p_x$ [10⁻³]", title="section of a cell, y = 0")
    section.legend(fontsize=8, loc="upper right")
    delta = 100 * np.asarray(deviation_["delta"])
    for k, colour in enumerate(("C0", "C1")):
        theirs, ours = (np.asarray(deviation_[name])[:, k] for name in ("tracked", "learned"))
        of_delta.plot(delta, theirs, colour, label=f"$\\nu_{'xy'[k]}$")
        of_delta.plot(delta, ours, f"{colour}o", markersize=4)
    of_delta.set(xlabel="δ [%]", ylabel="tune", title="a ring with errors: tracking, map (dots)")
    of_delta.legend(fontsize=8)
    drawn.savefig(FIGURES / "storage-ring-frequencies.png", dpi=150)
