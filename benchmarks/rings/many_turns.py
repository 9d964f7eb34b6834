"""Particles over many turns: what becomes of their action, and where they are lost."""

from __future__ import annotations

import numpy as np
from harness import Numbers, once, timed
from rings.lattice import AMPLITUDE, ellipsoid, ring
from rings.turn import NUM_PAIRS, learned


def long(quick: bool) -> Numbers:
    """Fifty particles over a million turns: what becomes of their action."""
    err = ring("err.mat")
    half = err.half_axes(AMPLITUDE, AMPLITUDE)
    z = ellipsoid(half, 600 if quick else NUM_PAIRS, 0)
    map_, _ = learned([z, err.track(z)[0, 0]], 1e-5)
    turns, every, particles = (1_000, 10, 5) if quick else (1_000_000, 97, 50)
    start = ellipsoid(0.6 * half, particles, 3)
    (states, info), seconds, _ = once(
        lambda: map_.rollout(start, num_steps=turns, save_every=every)
    )
    states = np.asarray(states)
    action = np.sum(np.abs(err.normalised(states)) ** 2, axis=-1) / 2  # (B, saved)
    block = 5 if quick else 50
    count = action.shape[1] // block
    means = action[:, : block * count].reshape(len(action), count, block).mean(axis=2)
    change = np.abs(means / means[:, :1] - 1)[:, 1:]
    size, step = np.median(change, axis=0), every * block * np.arange(1, count)
    exponent = float(np.polyfit(np.log(step), np.log(size), 1)[0])
    return {
        "turns": turns,
        "particles": particles,
        "seconds": seconds,
        "status": np.bincount(np.asarray(info.status), minlength=5).tolist(),
        "drift_exponent": exponent,
        "change_at_the_end": float(size[-count // 10 :].mean()),
        "oscillation": float(np.median(action.std(axis=1) / action.mean(axis=1))),
        "curve": {"turns": step.tolist(), "change": size.tolist()},
    }


def aperture(quick: bool) -> Numbers:
    """Compare the dynamic aperture of one cell, by map and by tracking code.

    It is the amplitude at which orbits get lost within 1,000 passages, along nine rays, by a scan
    in steps of 0.1 mm.
    """
    cell = ring("hmba.mat")
    half, turns = cell.half_axes(14e-3, 9e-3), 100 if quick else 1_000
    z = ellipsoid(half, 800 if quick else NUM_PAIRS, 0)
    map_, (fit,) = learned([z, cell.track(z)[0, 0]], 1e-5)
    angles = np.linspace(0, np.pi, 3 if quick else 9)
    radii = np.arange(4e-3, 14e-3, 1e-3 if quick else 1e-4)
    start = np.zeros((len(angles), len(radii), 4))
    start[..., 0] = radii * np.cos(angles)[:, None]
    start[..., 1] = radii * np.sin(angles)[:, None]
    flat = start.reshape(-1, 4)
    tracked, theirs, _ = once(lambda: cell.track(flat, turns=turns)[-1, 0])

    def run():
        return map_.rollout(flat, num_steps=turns, save_every=turns)[1]

    info = timed(run, 1)
    # A particle is lost where the domain of the data ends: the map knows nothing beyond.
    lost = np.asarray(info.out.left_at) >= 0
    lost |= np.asarray(info.out.status) > 1

    def border(gone) -> np.ndarray:
        gone = gone.reshape(start.shape[:2])
        return np.where(gone.any(axis=1), radii[np.argmax(gone, axis=1)], np.nan)

    of_map, of_tracking = border(lost), border(np.isnan(tracked).any(axis=1))
    return {
        "angles": angles.tolist(),
        "map": of_map.tolist(),
        "tracking": of_tracking.tolist(),
        "turns": turns,
        "largest_difference": float(np.max(np.abs(of_map / of_tracking - 1))),
        "label": fit.chosen.label,
        "one_turn": fit.chosen.validation_relative,
        "seconds": info.seconds,
        "tracking_seconds": theirs,
    }
