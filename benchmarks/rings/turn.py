"""One turn of a ring: maps of a few pairs, in one piece and in sectors, beside tracking."""

from __future__ import annotations

import warnings
from itertools import pairwise
from typing import Any

import numpy as np
from harness import SEED, Numbers, once
from rings.lattice import AMPLITUDE, ellipsoid, ring

import gfnn_jax as gfnn
from gfnn_jax.maps.symplectic_map import SymplecticMap

NUM_PAIRS, FRESH, BATCH = 5_000, 1_000, 1_000
TURNS, ORBITS = 300, 20  # compared with the tracking code
# Tolerances, and after how many quarters of the ring each piece ends.
ROWS = ((1e-4, (0, 4)), (1e-5, (0, 4)), (3e-7, (0, 4)), (1e-7, (0, 2, 4)))


def learned(
    sectors: list[np.ndarray],
    tolerance: float = 1e-9,
    count: int = NUM_PAIRS,
    delta=None,
    **options: str,
) -> tuple[SymplecticMap, list[gfnn.Fit]]:
    """The map of the sectors' maps in a row, from ``count`` states at their ends (K + 1, N, 4).

    delta: (N,), a parameter of the map.
    """
    fits = []
    given = None if delta is None else {"delta": delta[:count]}
    for before, after in pairwise(sectors):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", gfnn.FitWarning)
            pairs = gfnn.Pairs(before[:count], after[:count], 1 / (len(sectors) - 1), given)
            asked: Any = {"tolerance": tolerance, "max_seconds": None, "seed": SEED} | options
            fits.append(gfnn.fit(pairs, learn="map", **asked))
    map_ = fits[0].map
    for fit in fits[1:]:
        map_ = map_.then(fit.map)
    return map_, fits


def of_a_turn(map_: SymplecticMap, batch, turns: int, params=None) -> float:
    """CPU microseconds of a turn of one particle of a batch (B, 4)."""

    def run():
        return map_.rollout(batch, num_steps=turns, save_every=turns, params=params)

    run()
    return min(once(run).processor_seconds for _ in range(3)) / turns / len(batch) * 1e6


def polynomial(before, after, degree: int):
    """z -> Z by an explicit polynomial of this degree, fitted to the same pairs: as accurate as a
    truncated Taylor map and, like one, not symplectic."""
    from numpy.polynomial import chebyshev

    size = 1.05 * np.abs(before).max(axis=0)
    powers = np.array(list(np.ndindex(*[degree + 1] * 4)))
    powers = powers[powers.sum(axis=1) <= degree]

    def design(z):
        tables = [chebyshev.chebvander(z[:, i] / size[i], degree) for i in range(4)]
        return np.prod([t[:, powers[:, i]] for i, t in enumerate(tables)], axis=0)

    coefficients = np.linalg.lstsq(design(before), after, rcond=None)[0]
    return lambda z: design(z) @ coefficients


def turn(quick: bool) -> Numbers:
    """Measure one turn of the ring with errors, by one and by two generated pieces."""
    err = ring("err.mat")
    half = err.half_axes(AMPLITUDE, AMPLITUDE)
    count = 600 if quick else NUM_PAIRS + FRESH
    z, points = ellipsoid(half, count, 0), err.boundaries(4)
    ends = [z, *err.track(z, points)[0]]
    timed_ones = z[:20] if quick else z[:500]
    tracking = once(lambda: err.track(timed_ones)).processor_seconds / len(timed_ones)
    few = ellipsoid(half, 4 if quick else ORBITS, 1)
    turns = 20 if quick else TURNS
    orbits = err.track(few, turns=turns)[:, 0]
    spread, fresh = z.std(axis=0), slice(-FRESH // 10 if quick else -FRESH, None)

    def errors(step, rollout) -> Numbers:
        one = (step(z[fresh]) - ends[-1][fresh]) / spread
        far = (rollout(few) - orbits[-1]) / spread
        return {
            "one_turn": float(np.sqrt(np.mean(one**2))),
            "after_turns": float(np.sqrt(np.nanmedian(np.mean(far**2, axis=1)))),
            "lost": int(np.isnan(far).any(axis=1).sum()),
        }

    rows: list[Numbers] = []
    for tolerance, cuts in ROWS[1:2] if quick else ROWS:
        (map_, fits), _, seconds = once(
            lambda c=cuts, t=tolerance: learned([ends[i] for i in c], t)
        )
        batch = ellipsoid(half, BATCH, 2)
        found = errors(
            lambda x, m=map_: np.asarray(m.step(x)[0]),
            lambda x, m=map_: np.asarray(m.rollout(x, num_steps=turns, save_every=turns)[0])[:, -1],
        )
        rows.append(
            {
                "map": f"{len(fits)} generated",
                "label": fits[0].chosen.label,
                **found,
                "tolerance": tolerance,
                "fit_seconds": seconds,
                "microseconds_per_turn": of_a_turn(map_, batch, 30),
                "defect": float(np.max(np.asarray(map_.defect(few)))),
            }
        )
    degree = 3 if quick else 9  # as many digits of a Taylor series as S of degree 10
    explicit = polynomial(z[:NUM_PAIRS], ends[-1][:NUM_PAIRS], degree)

    def repeated(x):
        with np.errstate(all="ignore"):
            for _ in range(turns):
                x = explicit(x)
        return x

    rows.append(
        {"map": "explicit polynomial", "label": f"degree {degree}", **errors(explicit, repeated)}
    )
    return {
        "rows": rows,
        "num_pairs": min(count, NUM_PAIRS),
        "turns": turns,
        "tracking_microseconds_per_turn": tracking * 1e6,
        "num_elements": len(err.lattice),
        "spread": spread.tolist(),
    }
