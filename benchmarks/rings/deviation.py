"""One turn of a ring for particles of any energy: δ, their deviation from its own, a parameter."""

from __future__ import annotations

import numpy as np
from harness import Numbers, once
from rings.lattice import AMPLITUDE, ellipsoid, ring
from rings.tunes import tunes_of
from rings.turn import BATCH, ORBITS, TURNS, learned, of_a_turn

DEVIATION, DELTA_PAIRS, DELTA_FRESH = 0.01, 20_000, 2_000  # δ is drawn from ± this
SECTOR_PAIRS, ASKED = 6_000, 1e-5


def deviation(quick: bool) -> Numbers:
    """Measure one turn of the ring with errors, δ a parameter; the tunes against δ."""
    return of_region(AMPLITUDE, quick)


def small_deviation(quick: bool) -> Numbers:
    """Measure one turn with δ as a parameter, within half the amplitude."""
    return of_region(AMPLITUDE / 2, quick)


def sectors(quick: bool) -> Numbers:
    """Measure one turn with δ as a parameter, by the sixteen equal parts of the ring in a row."""
    return of_region(AMPLITUDE, quick, 2 if quick else 16, SECTOR_PAIRS, ASKED)


def of_region(
    amplitude: float,
    quick: bool,
    pieces: int = 1,
    num_pairs: int = DELTA_PAIRS,
    tolerance: float = 3e-6,
) -> Numbers:
    """Measure one turn within an amplitude, by so many pieces whose errors add up in the mean
    square to the tolerance, from so many pairs."""
    err = ring("err.mat")
    count, turns = (300, 5) if quick else (num_pairs, TURNS)
    half = err.half_axes(amplitude, amplitude)
    z = ellipsoid(half, count + DELTA_FRESH, 10)
    delta = np.random.default_rng(5).uniform(-DEVIATION, DEVIATION, len(z))
    ends = [z, *err.track(z, err.boundaries(pieces), delta=delta)[0]]
    few = ellipsoid(0.9 * half, 3 if quick else ORBITS, 5)
    own = {"delta": delta[: len(few)]}
    orbits = err.track(few, turns=turns, delta=own["delta"])[-1, 0]
    (map_, fits), _, seconds = once(
        lambda: learned(
            ends, 1e-2 if quick else tolerance / np.sqrt(pieces), count, delta, family="polynomial"
        )
    )
    spread, first = z.std(axis=0), slice(0, min(BATCH, count))
    ours, info = map_.step(z[count:], {"delta": delta[count:]})
    one = (np.asarray(ours) - ends[-1][count:]) / spread
    last, _ = map_.rollout(few, num_steps=turns, save_every=turns, params=own)
    far = (np.asarray(last)[:, -1] - orbits) / spread
    largest = max(fits, key=lambda fit: fit.chosen.num_parameters).chosen
    row = {
        "amplitude": amplitude,
        "pieces": pieces,
        "label": largest.label,
        "terms": largest.num_parameters,
        "one_turn": float(np.sqrt(np.mean(one**2))),
        "one_turn_median": float(np.median(np.sqrt(np.mean(one**2, axis=1)))),
        "after_turns": float(np.sqrt(np.nanmedian(np.mean(far**2, axis=1)))),
        "lost": int(np.isnan(far).any(axis=1).sum()),
        "failed": int(np.sum(np.asarray(info.status) > 1)),
        "defect": float(np.max(np.asarray(map_.defect(few, own)))),
        "fit_seconds": seconds,
        "microseconds_per_turn": of_a_turn(map_, z[first], 20, {"delta": delta[first]}),
    }
    grid = np.linspace(-DEVIATION, DEVIATION, 3 if quick else 9)
    start, turns = np.zeros((len(grid), 4)), 64 if quick else 512
    start[:, :2] = 1e-4
    tracked = np.concatenate([start[None], err.track(start, turns=turns, delta=grid)[:, 0]])
    states, _ = map_.rollout(start, num_steps=turns, params={"delta": grid})
    theirs, ours = (tunes_of(err, a) for a in (tracked, np.asarray(states).transpose(1, 0, 2)))
    return {
        "rows": [row],
        "num_pairs": count,
        "turns": TURNS,
        "delta": grid.tolist(),
        "tracked": theirs.tolist(),
        "learned": ours.tolist(),
        "largest_tune_difference": float(np.abs(ours - theirs).max()),
    }
