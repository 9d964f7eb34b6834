"""Figures of many degrees of freedom: modes and space-time of lattices, orbits of bodies.

Each function takes arrays of one trajectory and returns a Figure. The reference has a panel of its
own, so that nothing covers it, and the difference of the prediction has another.
"""

from __future__ import annotations

import numpy as np
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure

from gfnn_jax.evaluate.figures_style import COLOURS, HEIGHT, WIDTH, style
from gfnn_jax.phase_space import split

MODES = 4  # number of modes that are drawn, those of the longest waves
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
    above, middle, below = figure.subplots(3, 1, sharex=True)
    exact, found = (mode_energies(np.asarray(z), ends)[:, :MODES] for z in (reference, predicted))
    for k, colour in zip(range(exact.shape[1]), COLOURS, strict=False):
        for ax, energy in (
            (above, exact),
            (middle, found),
            (below, np.maximum(np.abs(found - exact), _ROUNDOFF)),
        ):
            ax.plot(times, energy[:, k], color=colour, label=f"k = {k + 1}")
    above.set(ylabel="mode energy, reference")
    middle.set(ylabel="mode energy, GFNN", ylim=above.get_ylim())
    below.set(ylabel="difference", xlabel="t", yscale="log")
    figure.legend(
        *above.get_legend_handles_labels(), loc="outside upper center", ncols=MODES, frameon=False
    )
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
    off = predicted - reference
    turned = np.repeat([x in angles for x in "qp"], dim)
    off = np.where(turned, np.remainder(off + np.pi, 2 * np.pi) - np.pi, off)
    off = np.abs(off).reshape(len(off), 2, dim).max(axis=1)
    shown = [split(z)[1] for z in (reference, predicted)]
    if "p" in angles:
        shown = [np.remainder(p, 2 * np.pi) for p in shown]
        low, high, colours = 0.0, 2 * np.pi, "twilight"
    else:
        high = float(np.nanmax(np.abs(shown[0])))
        low, colours = -high, "RdBu_r"
    box = {"extent": (0.5, dim + 0.5, times[0], times[-1]), "origin": "lower", "aspect": "auto"}
    for ax, p, title in zip(panels, shown, ("reference", "GFNN"), strict=False):
        drawn = ax.imshow(p, vmin=low, vmax=high, cmap=colours, interpolation="nearest", **box)
        ax.set(title=title, xlabel="site")
    figure.colorbar(drawn, ax=panels[:2], label="$p_i$", location="bottom", shrink=0.6)
    worst = max(float(np.nanmax(off)), 10 * _ROUNDOFF)
    drawn = panels[2].imshow(
        np.maximum(off, _ROUNDOFF),
        norm=LogNorm(_ROUNDOFF, worst),
        cmap="viridis",
        interpolation="nearest",
        **box,
    )
    figure.colorbar(drawn, ax=panels[2], label="difference", location="bottom")
    panels[2].set(title="difference", xlabel="site")
    panels[0].set(ylabel="t")
    for ax in panels:
        ax.grid(visible=False)
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
    figure.legend(
        *panels[0].get_legend_handles_labels(),
        loc="outside upper center",
        ncols=bodies,
        frameon=False,
    )
    return figure
