"""The paper's scenes with ``learn="auto"``, beside ``learn="map"``.

    python benchmarks/auto.py            every scene (about ten minutes on two cores)
    python benchmarks/auto.py --quick    two of them

Each scene is learned as `gfnn run` learns it, with its own pairs and tolerance, in both ways: what
was chosen and why, the one-step error of fresh pairs, the position error of fresh orbits at the
paper's horizon of 1,000 steps, the time of a step in a batch of 1,000.
"""

from __future__ import annotations

import warnings
from functools import partial
from typing import Any

import jax
import numpy as np
from harness import (
    SEED,
    TABLES,
    Numbers,
    angles_of,
    between_markers,
    drawn,
    main,
    markdown,
    number,
    one_step_rms,
    provenance,
    results,
    timed,
)

import gfnn_jax as gfnn
from gfnn_jax.models.hamiltonians.search import MAX_COST_RATIO

STEPS, ORBITS, BATCH = 1_000, 100, 1_000
SCENES = (
    "two-body",
    "henon-heiles-regular",
    "henon-heiles-chaotic",
    "pcr3bp",
    "standard-map-regular",
    "standard-map-chaotic",
)


def both(name: str, quick: bool) -> Numbers:
    """The figures of both ways."""
    scene = gfnn.scenes.make(name)
    pairs, fresh = drawn(scene, 1_000 if quick else scene.num_pairs, quick)
    z0 = np.asarray(gfnn.sample_test_states(scene, ORBITS, jax.random.key(SEED + 2)))
    reference = np.asarray(gfnn.reference_trajectories(scene, z0, STEPS, save_every=STEPS))
    found: Numbers = {"pairs": len(pairs), "tolerance": scene.tolerance}
    for learn in ("auto", "map"):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", gfnn.FitWarning)
            fit = gfnn.fit(pairs, scene, tolerance=scene.tolerance, learn=learn, seed=SEED)
        states, info = fit.map.rollout(z0, STEPS, save_every=STEPS)
        error = gfnn.metrics.position_error(np.asarray(states), reference, angles_of(scene))[:, -1]
        known = np.isfinite(error)
        z = np.resize(np.asarray(fresh.z0), (BATCH, fresh.z0.shape[1]))
        rolled = timed(lambda m=fit.map, z=z: m.rollout(z, 100, save_every=100)[0], 3)
        found[learn] = {
            "learns": fit.chosen.learns,
            "label": f"{fit.chosen.chart} {fit.chosen.label}",
            "why": why(fit),
            "met": fit.met,
            "one_step_rms": one_step_rms(fit.map, fresh, angles_of(scene)),
            "error_median": float(np.median(np.where(known, error, np.inf))),
            "error_mean": float(np.mean(error[known])),
            "lost": int((~known).sum()),
            "left_domain": int(np.sum(np.asarray(info.status) > 0)),
            "microseconds_per_step": 1e6 * rolled.seconds / (100 * BATCH),
            "fit_seconds": fit.seconds,
            "formula": fit.formula,
            "ended": fit.ended,
            "messages": list(fit.messages),
        }
    return found


def why(fit: Any) -> str:
    """The rule by which the candidate was taken, with its numbers."""
    maps = [c for c in fit.candidates if c.learns == "map" and c.validated]
    meeting = [c for c in maps if c.validation_bound <= fit.tolerance]
    law = fit.hamiltonian and fit.hamiltonian.candidate
    if law is None:
        return "no H was found"
    if not law.validation_bound <= fit.tolerance:
        return f"H misses the tolerance ({law.validation_relative:.1e} of the spread)"
    if not meeting:
        return "H meets the tolerance, and no cheaper S does"
    ratio = law.operations / min(c.operations for c in meeting)
    most = f"up to {MAX_COST_RATIO:g} times is preferred"
    return f"H meets it at {ratio:.2g} times the cost of S; {most}"


PIECES = {name: partial(both, name) for name in SCENES}


def tables() -> None:
    """The table of RESULTS.md."""
    heads = (
        "scene",
        "learn",
        "chosen",
        "one-step RMS",
        "median at step 1,000",
        "lost",
        "µs a step",
        "fit, s",
        "why",
    )
    found, rows = results(PIECES, "auto"), []
    for name, result in found.items():
        for learn in ("auto", "map"):
            m = result["measured"][learn]
            rows.append(
                [
                    name if learn == "auto" else "",
                    learn,
                    m["label"],
                    *(
                        number(m[key])
                        for key in (
                            "one_step_rms",
                            "error_median",
                            "lost",
                            "microseconds_per_step",
                            "fit_seconds",
                        )
                    ),
                    m["why"] if learn == "auto" else "",
                ]
            )
    between_markers(TABLES, "auto", f"{markdown(heads, rows)}\n\n{provenance(found)}")


if __name__ == "__main__":
    main(__doc__ or "", PIECES, "auto", tables, None, ("henon-heiles-regular", "two-body"))
