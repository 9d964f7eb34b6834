"""The error that a fit states, beside the error on 100,000 fresh pairs.

    python benchmarks/stated_errors.py            every row, into results/ and RESULTS.md
    python benchmarks/stated_errors.py --quick    two fits a row, into runs/

A fit ends with an upper 95 % bound of its one-step error, from pairs that took no part in it, or by
cross-validation. Each row pools fits of independent data sets of one size with noise on both states
of a pair; the bound is right where it is above the error of fresh pairs with the same noise, which
it should be nineteen times in twenty, and sharp where it is not far above.
"""

from __future__ import annotations

import functools
import warnings
from collections.abc import Sequence

# Sets float64, so it comes before all of JAX.
from harness import TABLES, Numbers, between_markers, main, markdown, number, provenance, results

# isort: split
import jax
import numpy as np
from posteriors.calibration import pendulum

import gfnn_jax as gfnn
from gfnn_jax.scenes import Scene
from gfnn_jax.scenes.draws import sample_sequences

SIGMA, FRESH, FITS = 1e-3, 100_000, 22  # noise ÷ spread; fresh pairs; data sets a row
SYSTEMS = {"henon-heiles": lambda: gfnn.scenes.make("henon-heiles-regular"), "pendulum": pendulum}
SIZES = (50, 200, 1_000)
LENGTH = 20  # pairs of each sequence, in the rows of sequences
SEED = 1_000  # the first of a row's; nothing was tuned on these


@functools.cache
def fresh(system: str) -> gfnn.Pairs:
    """Fresh pairs without noise."""
    return gfnn.sample_pairs(SYSTEMS[system](), FRESH, jax.random.key(SEED))


def noise_of(system: str) -> np.ndarray:
    """Standard deviation (2d,) of the noise: that of the sensor, whatever the data set."""
    return SIGMA * np.std(np.asarray(fresh(system).z0), axis=0)


def noisy(pairs: gfnn.Pairs, noise: np.ndarray, seed: int) -> gfnn.Pairs:
    """The pairs with noise on both states."""
    rng = np.random.default_rng(seed)
    z0, z1 = (np.asarray(z) + noise * rng.normal(size=z.shape) for z in (pairs.z0, pairs.z1))
    return gfnn.Pairs(z0, z1, pairs.dt)


def learned_from(system: str, scene: Scene, size: int, in_sequences: bool, seed: int) -> gfnn.Pairs:
    """Noisy pairs, single ones or those of sequences, whose states have one noise each."""
    key, noise = jax.random.key(seed), noise_of(system)
    if not in_sequences:
        return noisy(gfnn.sample_pairs(scene, size, key), noise, seed)
    states = sample_sequences(scene, size // LENGTH, LENGTH + 1, key)
    rng, width = np.random.default_rng(seed), states.shape[-1]
    states = np.asarray(states) + noise * rng.normal(size=states.shape)
    run = np.repeat(np.arange(len(states)), LENGTH)
    z0, z1 = states[:, :-1].reshape(-1, width), states[:, 1:].reshape(-1, width)
    return gfnn.Pairs(z0, z1, scene.dt, run=run)


def row(system: str, size: int, in_sequences: bool, quick: bool) -> Numbers:
    """Bounds and true errors of fits to independent data sets."""
    scene, found = SYSTEMS[system](), []
    for seed in range(SEED + size, SEED + size + (2 if quick else FITS)):
        pairs = learned_from(system, scene, size, in_sequences, seed)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", gfnn.FitWarning)  # kept in fit.messages
            # The angle is not named: its states stay within half a turn.
            fit = gfnn.fit(pairs, tolerance=1e-2, max_seconds=None, seed=seed)
        judged = noisy(fresh(system), noise_of(system), seed + 1)
        error = np.asarray(fit.map.step(judged.z0)[0]) - np.asarray(judged.z1)
        truth = float(np.sqrt(np.mean((error / np.std(pairs.z0, axis=0)) ** 2)))
        found.append(
            {
                "seed": seed,
                "bound": fit.chosen.validation_bound,
                "error": fit.chosen.validation_relative,
                "truth": truth,
                "by": fit.stated_by,
                "label": f"{fit.chosen.chart} {fit.chosen.label}",
            }
        )
    bounds, truths = (np.array([f[name] for f in found]) for name in ("bound", "truth"))
    return {
        "fits": found,
        "covered": float(np.mean(bounds >= truths)),
        "ratio": float(np.median(bounds / truths)),
    }


PIECES = {
    f"{system}-{'sequences-' * in_sequences}{size}": functools.partial(
        row, system, size, in_sequences
    )
    for system in SYSTEMS
    for size in SIZES
    for in_sequences in (False, True)
    if not (in_sequences and size < 200)
}


def tables() -> None:
    found = results(PIECES, "stated")
    if not found:
        return
    rows, held, ratios = [], [], []
    for name, result in found.items():
        measured = result["measured"]
        bounds = np.array([f["bound"] for f in measured["fits"]])
        truths = np.array([f["truth"] for f in measured["fits"]])
        held.extend(bounds >= truths)
        ratios.extend(bounds / truths)
        rows.append(
            [
                name,
                str(len(bounds)),
                f"{100 * measured['covered']:.0f} %",
                number(measured["ratio"]),
                measured["fits"][0]["by"],
            ]
        )
    rows.append(
        [
            "all",
            str(len(held)),
            f"{100 * np.mean(held):.1f} %",
            number(float(np.median(ratios))),
            "asked: 91.5 to 98.5 %, 2 at most",
        ]
    )
    heads = ("data", "fits", "bound holds", "bound ÷ truth, median", "stated by (first fit)")
    text = f"{markdown(heads, rows)}\n\n{provenance(found)}"
    between_markers(TABLES, "stated", text)


def run(argv: Sequence[str] | None = None) -> None:
    quick = ("henon-heiles-50", "pendulum-sequences-200")
    main(str(__doc__), PIECES, "stated", tables, argv, quick)


if __name__ == "__main__":
    run()
