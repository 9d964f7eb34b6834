"""A frequency map and Poincaré sections of one cell, by map and by tracking."""

from __future__ import annotations

import numpy as np
from harness import Numbers
from rings.lattice import ellipsoid, ring
from rings.tunes import tunes_of
from rings.turn import NUM_PAIRS, learned

# Metres: x and y of the frequency map, inside the aperture of the cell.
REGION = (8e-3, 4e-3)


def frequencies(quick: bool) -> Numbers:
    """Compare frequency maps and sections of one cell, by map and by tracking code.

    A frequency map is the change of the tunes from the first half of an orbit to the second, over
    the plane of amplitudes. The sections are of orbits in the mid-plane.
    """
    cell = ring("hmba.mat")
    half = cell.half_axes(1.2 * REGION[0], 1.2 * REGION[1])
    z = ellipsoid(half, 800 if quick else NUM_PAIRS, 0)
    map_, (fit,) = learned([z, cell.track(z)[0, 0]], 1e-3 if quick else 1e-6)
    side, turns = (3, 64) if quick else (24, 512)
    x, y = np.meshgrid(*(np.linspace(0.04, 1, side) * size for size in REGION))
    start = np.zeros((side * side, 4))
    start[:, 0], start[:, 1] = x.ravel(), y.ravel()
    orbits = np.linspace(0.1, 0.95, 3 if quick else 8) * REGION[0]
    start = np.concatenate([start, np.stack([orbits, *3 * [0 * orbits]], axis=1)])

    def diffusion(states) -> np.ndarray:
        kept = np.flatnonzero(np.isfinite(states).all(axis=(0, 2)))
        kept = kept[kept < side * side]
        parts = states[:turns, kept], states[turns : 2 * turns, kept]
        first, second = (tunes_of(cell, part) for part in parts)
        found = np.full(side * side, np.nan)
        found[kept] = np.log10(np.linalg.norm(first - second, axis=1) + 1e-16)
        return found

    tracked = np.concatenate([start[None], cell.track(start, turns=2 * turns)[:, 0]])
    states, _ = map_.rollout(start, num_steps=2 * turns)
    states = np.asarray(states).transpose(1, 0, 2)
    theirs, ours = diffusion(tracked), diffusion(states)
    both = np.isfinite(theirs) & np.isfinite(ours)
    sections = {
        name: np.round(1e6 * found[: 20 if quick else 300, side * side :][..., [0, 2]], 2)
        for name, found in (("tracking", tracked), ("map", states))
    }
    return {
        "label": fit.chosen.label,
        "one_turn": fit.chosen.validation_relative,
        "side": side,
        "turns": turns,
        "tracking": _listed(theirs),
        "map": _listed(ours),
        "median_difference": float(np.median(np.abs(theirs - ours)[both])),
        "kept_by_one_only": int(np.sum(np.isfinite(theirs) != np.isfinite(ours))),
        "sections_micro": {name: found.tolist() for name, found in sections.items()},
    }


def _listed(found: np.ndarray) -> list[float | None]:
    return [None if np.isnan(value) else round(float(value), 3) for value in found]
