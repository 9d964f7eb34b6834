"""A block on a spring that dry friction stops: its law from a record that rests, and forecasts
across stops.

    python benchmarks/stops.py            half a minute
    python benchmarks/stops.py --quick    one draw of the noise, into runs/

q̈ = −q − 0.1 sgn q̇ is known in closed form: half turns about ±0.1, until the block stops. Three runs
of 36 s, with noise of 1e-3 on positions in m, more than half of which it stands still, are learned
from. Two runs that no fit has seen are forecast to 36 s from their first 3, 6 and 9 s, before which
the block has not stopped: the largest distance from where it is, and the share of the measured
samples within two standard deviations.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence

import numpy as np
from harness import TABLES, Numbers, between_markers, main, markdown, number, once, provenance
from harness import results as results_of

import gfnn_jax as gfnn

HELD, NOISE, DT, END = 0.1, 1e-3, 0.05, 36.0  # 1/s², m, s
SEEN = ((1.0, 0.0), (0.7, 0.2), (-0.8, 0.5))  # m and m/s, where runs begin
AHEAD = ((0.9, -0.3), (-1.1, 0.1))
FROM = (3.0, 6.0, 9.0)  # s
DRAWS = 5


def block(q: float, v: float, t: np.ndarray) -> np.ndarray:
    """Positions at the times t, from a position and a velocity."""
    found, begun = np.full_like(t, np.nan), 0.0
    while side := np.sign(v) or -np.sign(q) * (abs(q) > HELD):
        about = -side * HELD
        size, angle = np.hypot(q - about, v), np.arctan2(-v, q - about)
        left = ((0.0 if side > 0 else np.pi) - angle) % (2 * np.pi)  # until it turns
        now = (t >= begun) & (t <= begun + left)
        found[now] = about + size * np.cos(angle + t[now] - begun)
        q, v, begun = about + size * np.cos(angle + left), 0.0, begun + left
    return np.where(np.isnan(found), q, found)


def recording(starts: Sequence[tuple[float, float]], seed: int) -> gfnn.Recording:
    """A run from each start, its positions with noise."""
    rng, t = np.random.default_rng(seed), np.arange(0, END, DT)
    tables = [
        {
            "run": np.full(len(t), str(k)),
            "t": t,
            "x": block(*start, t) + NOISE * rng.normal(size=len(t)),
        }
        for k, start in enumerate(starts)
    ]
    return gfnn.Recording(tables, positions=["x"])


def case(draw: int) -> Numbers:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", gfnn.FitWarning)  # of rests that are left out
        done = once(lambda: gfnn.fit(recording(SEEN, draw)))
    fit, new = done.out, recording(AHEAD, DRAWS + draw)
    dry, spring = fit.friction.terms[0], fit.lagrangian.terms[1]
    t, ahead = new.times("0"), {}
    for begin in FROM:
        later = t > begin
        found = fit.map.forecast(new.slice(stop=begin), t[later])
        seen = np.array([new.values("x", run)[later] for run in new.runs])
        exact = np.array([block(*start, t[later]) for start in AHEAD])
        ahead[f"{begin:g}"] = {
            "largest": float(np.abs(found.values["x"] - exact).max()),
            "within": float(np.mean(np.abs(found.values["x"] - seen) <= 2 * found.std["x"])),
        }
    rests = [message for message in fit.messages if "at rest" in message]
    return {
        "kinds": fit.which_friction.kinds,
        "friction": str(fit.friction),
        "rests": rests,
        "standard_errors": {
            "dry": abs(dry.coefficient - HELD) / dry.std,
            "spring": abs(spring.coefficient + 0.5) / spring.std,
        },
        "std": dry.std,
        "ahead": ahead,
        "processor_seconds": done.processor_seconds,
    }


def measured(quick: bool) -> Numbers:
    cases = [case(draw) for draw in range(1 if quick else DRAWS)]
    for c in cases:
        print(f"  {c['friction']}, {c['standard_errors']}; {c['ahead']}; {c['rests']}", flush=True)
    return {"cases": cases}


PIECES = {"block": measured}


def tables() -> None:
    """The table of RESULTS.md."""
    found = results_of(PIECES, "stops")
    if not found:
        return
    rows = []
    for k, c in enumerate(found["block"]["measured"]["cases"]):
        z = c["standard_errors"]
        rows.append(
            [
                str(k),
                c["friction"].replace("|", r"\|"),
                f"{z['dry']:.1f}, {z['spring']:.1f}",
                *(f"{1e3 * a['largest']:.2f}, {a['within']:.0%}" for a in c["ahead"].values()),
                number(c["processor_seconds"]),
            ]
        )
    heads = (
        "draw",
        "R found (0.1 put in)",
        "ρ and spring off, standard errors",
        *(f"from {begin:g} s: largest error, mm; within 2 σ" for begin in FROM),
        "fit, CPU s",
    )
    between_markers(TABLES, "stops", f"{markdown(heads, rows)}\n\n{provenance(found)}")


if __name__ == "__main__":
    main(__doc__ or "", PIECES, "stops", tables, None)
