"""How sure: whether bands hold the true error, what samples cost, and fits to noisy sequences.

    python benchmarks/bands.py                       pieces that have no result yet, tables, figure
    python benchmarks/bands.py --only cost --overwrite
    python benchmarks/bands.py --quick               small sizes, into runs/bands

Bands are twice the standard deviation of rollouts of maps drawn from the posterior, about that of
the fitted map; the true error is that map's own, against the reference, from clean states that no
fit has seen. σ is the noise on every number of both states of a pair, ÷ the coordinate's spread.
"""

from __future__ import annotations

import dataclasses
import warnings
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from harness import (
    FIGURES,
    TABLES,
    Numbers,
    angles_of,
    between_markers,
    main,
    markdown,
    number,
    results,
    timed,
)

import gfnn_jax as gfnn
from gfnn_jax.coordinates import nearest_image
from gfnn_jax.scenes import DrawnFrom, Scene, froeschle, henon_heiles, two_body

SIGMAS, SIZES, STEPS = (0.0, 1e-6, 1e-4, 1e-2), (100, 1_000, 10_000), (1, 10, 100)
STATES, SAMPLES = 40, 50
# None of the seeds that the posterior was tuned on, 0 to 4.
SEED, FITS_OF_SEQUENCES = 11, 3
# Samples, states and steps whose time is measured: a law's step is ten times as dear.
COSTS = {"map": (5, 1_000, 1_000), "hamiltonian": (5, 1_000, 50)}
# Networks of 16-16-16 units.
NETWORKS = {"family": "mlp", "chart": "midpoint", "ensemble": 8, "max_iterations": 30}
# Coverage that a band of two standard deviations is to have, and its width over the RMS error.
COVERED, WIDEST = (0.90, 0.995), 3.0
WIDTHS = (0.1, 0.3, 1.0, 3.0, 10.0)  # of the figure


@dataclasses.dataclass(frozen=True)
class Librations:
    """``draw(key, num)``: a disc of radius 2 around a pendulum's rest."""

    def __call__(self, key, num):
        u = jax.random.uniform(key, (2, num), jnp.float64)
        r, turn = 2.0 * jnp.sqrt(u[0]), 2 * jnp.pi * u[1]
        return jnp.stack([r * jnp.cos(turn), r * jnp.sin(turn)]).T


def swinging(z, t=0.0, args=()):
    """A pendulum."""
    return z[1] ** 2 / 2 - jnp.cos(z[0])


def pendulum() -> Scene:
    """Librations, learned without being told of the angle."""
    return Scene("pendulum", "librations", 1, 0.2, DrawnFrom(Librations()), hamiltonian=swinging)


def quietly(*args, **options):
    """`gfnn.fit` without its warnings, which the fit keeps."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", gfnn.FitWarning)
        return gfnn.fit(*args, max_seconds=None, **options)


def noisy(pairs, sigma: float, seed: int):
    """The pairs with noise on both states."""
    rng, spread = np.random.default_rng(seed), np.std(pairs.z0, axis=0)
    z0, z1 = (
        np.asarray(z) + sigma * spread * rng.normal(size=z.shape) for z in (pairs.z0, pairs.z1)
    )
    return gfnn.Pairs(z0, z1, pairs.dt)


def errors_and_bands(fit, z0, reference, seed: int, angles) -> tuple[np.ndarray, np.ndarray]:
    """The error and half the band (B, steps, 2d) at STEPS."""
    mean = np.asarray(fit.map.rollout(z0, STEPS[-1])[0])[:, STEPS]
    drawn = fit.sample(jax.random.key(seed), SAMPLES).rollout(z0, STEPS[-1])[0]
    drawn = np.asarray(drawn)[:, :, STEPS]

    def between(a, b):
        difference = a - b
        return nearest_image(
            difference.reshape(-1, difference.shape[-1]), angles
        ).reshape(difference.shape)  # fmt: skip

    spread = np.sqrt(np.nanmean(between(drawn, mean) ** 2, axis=0))
    return between(mean, reference[:, STEPS]), 2 * spread


def calibrated(make, quick: bool, *, lend: bool, sizes=SIZES, sigmas=SIGMAS, **options) -> Numbers:
    """Coverage and width for every σ and number of pairs, of one fit each."""
    scene = make()
    angles = angles_of(scene)
    z0 = np.asarray(gfnn.sample_test_states(scene, STATES, jax.random.key(100 + SEED)))
    reference = np.asarray(gfnn.reference_trajectories(scene, z0, STEPS[-1]))
    rows = []
    for sigma in SIGMAS[2:] if quick else sigmas:
        for size in SIZES[1:2] if quick else sizes:
            pairs = gfnn.sample_pairs(scene, size, jax.random.key(SEED))
            fit = quietly(noisy(pairs, sigma, SEED), scene if lend else None, seed=SEED, **options)
            label = f"{fit.chosen.chart} {fit.chosen.label}"
            known = fit.map.posterior is not None
            judged = _judged(*errors_and_bands(fit, z0, reference, SEED, angles)) if known else {}
            rows.append({"sigma": sigma, "pairs": size, "label": label, **judged})
            print(f"  {sigma:g} {size}: {rows[-1]}", flush=True)
    return {"seed": SEED, "rows": rows}


def _judged(error, band) -> Numbers:
    """At each of STEPS, all test states together."""
    rms = np.sqrt(np.nanmean(error**2, axis=(0, 2)))
    return {
        "coverage": np.mean(np.abs(error) <= band, axis=(0, 2)).tolist(),
        "width": (np.nanmedian(band, axis=(0, 2)) / rms).tolist(),
        "rms": rms.tolist(),
    }


def sequences(dt: float, quick: bool) -> Numbers:
    """Forty sequences of fifty states of Hénon–Heiles with noise of 1e-3 on every number."""
    scene = dataclasses.replace(henon_heiles(), dt=dt)
    test = np.asarray(gfnn.sample_test_states(scene, 100, jax.random.key(100 + SEED)))
    reference = np.asarray(gfnn.reference_trajectories(scene, test, 100))
    runs = []
    for seed in range(SEED, SEED + (1 if quick else FITS_OF_SEQUENCES)):
        z0 = np.asarray(gfnn.sample_test_states(scene, 40, jax.random.key(seed)))
        states = np.asarray(gfnn.reference_trajectories(scene, z0, 49))
        states = states + 1e-3 * np.random.default_rng(seed).normal(size=states.shape)
        pairs = gfnn.Pairs(states[:, :-1].reshape(-1, 4), states[:, 1:].reshape(-1, 4), dt)
        fit = quietly(pairs, learn="hamiltonian", seed=seed)
        error = np.asarray(fit.map.rollout(test, 100)[0]) - reference
        rms = np.sqrt(np.mean(error**2, axis=(0, 2)))
        runs.append({
            "terms": fit.chosen.num_parameters, "formula": fit.formula,
            "noise": None if fit.noise is None else fit.noise.tolist(),
            "rms_of_all": rms[list(STEPS)].tolist(),
            **_judged(*errors_and_bands(fit, test[:STATES], reference[:STATES], seed, ())),
        })  # fmt: skip
    return {"dt": dt, "runs": runs}


def cost(quick: bool) -> Numbers:
    """Samples of a thousand states beside as many lanes of one map."""
    scene = henon_heiles()
    pairs = gfnn.sample_pairs(scene, 3_000, jax.random.key(SEED))
    found: dict[str, Any] = {}
    for learn, (samples, lanes, steps) in COSTS.items():
        if quick:
            samples, lanes, steps = 10, 100, 10
        z0 = np.asarray(gfnn.sample_test_states(scene, lanes, jax.random.key(1)))
        fit = quietly(pairs, scene, learn=learn, tolerance=1e-8)
        drawn, all_lanes = fit.sample(jax.random.key(2), samples), np.tile(z0, (samples, 1))
        one = timed(lambda m=fit.map, z=all_lanes, n=steps: m.rollout(z, n, save_every=n), 1)
        many = timed(lambda s=drawn, z=z0, n=steps: s.rollout(z, n, save_every=n), 1)
        found[learn] = {
            "label": f"{fit.chosen.chart} {fit.chosen.label}",
            "samples": samples, "lanes": lanes, "steps": steps,
            "lanes_seconds": one.seconds, "samples_seconds": many.seconds,
            "ratio": many.seconds / one.seconds,
        }  # fmt: skip
    return found


def together(quick: bool) -> Numbers:
    """Networks trained together beside one network, the same number of iterations."""
    pairs = gfnn.sample_pairs(henon_heiles(), 500, jax.random.key(SEED))
    options = {**NETWORKS, "max_iterations": 3 if quick else 15}
    found = {
        str(count): quietly(pairs, **{**options, "ensemble": count}).chosen.fit_seconds
        for count in (1, NETWORKS["ensemble"])
    }
    per_second = {count: int(count) / seconds for count, seconds in found.items()}
    return {"pairs": 500, "iterations": options["max_iterations"], "seconds": found,
            "models_per_second": per_second}  # fmt: skip


PIECES = {
    "henon-heiles-map": partial(
        calibrated,
        henon_heiles,
        lend=False,
        sizes=SIZES[1:],
        learn="map",
        family="polynomial",
        chart="midpoint",
    ),
    "henon-heiles": partial(calibrated, henon_heiles, lend=False, learn="hamiltonian"),
    "two-body": partial(calibrated, two_body, lend=True, sizes=(1_000,), learn="map"),
    "pendulum": partial(calibrated, pendulum, lend=False, learn="map"),
    "ring-32": partial(calibrated, partial(froeschle, 32), lend=True, sizes=SIZES[:2], learn="map"),
    "noise-dt-0.5": partial(sequences, 0.5),
    "noise-dt-0.05": partial(sequences, 0.05),
    "cost": cost,
    "ensemble": partial(
        calibrated, henon_heiles, lend=False, sizes=(500,), sigmas=(0.0, 1e-4, 1e-2), **NETWORKS
    ),
    "together": together,
}
CALIBRATED = (*tuple(PIECES)[:5], "ensemble")


def _calibration_table(found: dict[str, Numbers]) -> str:
    head = ["case", "σ ÷ spread", "pairs", "chosen"]
    head += [f"step {k}: covered, width ÷ RMS, RMS" for k in STEPS]
    rows = []
    for name in CALIBRATED:
        for row in found[name]["measured"]["rows"] if name in found else ():
            cells = [
                f"{_marked(100 * c, 100 * COVERED[0], 100 * COVERED[1], '.0f')} %, "
                f"{_marked(w, 0.0, WIDEST, '.2g')}, {r:.0e}"
                for c, w, r in zip(row["coverage"], row["width"], row["rms"], strict=True)
            ] if "coverage" in row else ["–"] * len(STEPS)  # fmt: skip
            rows.append([name, f"{row['sigma']:g}", f"{row['pairs']:,}", row["label"], *cells])
    return markdown(head, rows)


def _marked(value: float, low: float, high: float, form: str) -> str:
    """In bold where it misses its target."""
    text = format(value, form)
    return text if low <= value <= high else f"**{text}**"


def _noise_table(found: dict[str, Numbers]) -> str:
    head = ["dt", "terms of H", "noise measured ÷ true", "RMS at step 1", "10", "100",
            "covered at 1, 10, 100, %", "width ÷ RMS"]  # fmt: skip
    rows = []
    for name in ("noise-dt-0.5", "noise-dt-0.05"):
        for run in found[name]["measured"]["runs"] if name in found else ():
            noise = ", ".join(f"{1e3 * s:.2f}" for s in run["noise"] or ()) or "–"
            rows.append([str(found[name]["measured"]["dt"]), str(run["terms"]), noise,
                         *(f"{r:.1e}" for r in run["rms_of_all"]),
                         ", ".join(f"{100 * c:.0f}" for c in run["coverage"]),
                         ", ".join(f"{w:.2g}" for w in run["width"])])  # fmt: skip
    return markdown(head, rows)


def _cost_table(found: dict[str, Numbers]) -> str:
    m = found["cost"]["measured"] if "cost" in found else {}
    head = ["map", "samples × states × steps", "as samples, s", "as lanes of one map, s", "ratio"]
    rows = [
        [m[k]["label"], f"{m[k]['samples']} × {m[k]['lanes']:,} × {m[k]['steps']:,}",
         *(number(m[k][c]) for c in ("samples_seconds", "lanes_seconds", "ratio"))]
        for k in COSTS if k in m
    ]  # fmt: skip
    return markdown(head, rows)


def _together_table(found: dict[str, Numbers]) -> str:
    head = ["networks trained together", "pairs", "iterations", "s", "models per second"]
    m = found["together"]["measured"] if "together" in found else {"seconds": {}}
    rows = [
        [count, str(m["pairs"]), str(m["iterations"]), number(seconds),
         number(m["models_per_second"][count])]
        for count, seconds in m["seconds"].items()
    ]  # fmt: skip
    return markdown(head, rows)


def tables() -> None:
    """The section of RESULTS.md, and the figure."""
    found = results(PIECES, "bands")
    parts = (_calibration_table, _noise_table, _cost_table, _together_table)
    text = "\n\n".join(part(found) for part in parts)
    between_markers(TABLES, "bands", text)
    figure(found)


def figure(found: dict[str, Numbers]) -> None:
    """Coverage against width, a panel for each step; what lies beyond WIDTHS at their ends."""
    from matplotlib import pyplot

    drawn, panels = pyplot.subplots(1, len(STEPS), figsize=(10, 3.4), sharex=True, sharey=True)
    for k, (panel, step) in enumerate(zip(panels, STEPS, strict=True)):
        panel.axhspan(100 * COVERED[0], 100 * COVERED[1], color="0.92")
        for name, marker in zip(CALIBRATED, "osD^vP", strict=True):
            rows = found[name]["measured"]["rows"] if name in found else []
            rows = [r for r in rows if "coverage" in r]
            if rows:
                width = np.clip([r["width"][k] for r in rows], WIDTHS[0], WIDTHS[-1])
                covered = [100 * r["coverage"][k] for r in rows]
                panel.plot(width, covered, marker, label=name, alpha=0.7, clip_on=False)
        panel.axvline(WIDEST, color="0.7", linewidth=1)
        panel.set(xscale="log", title=f"step {step}", xlabel="median 2σ band ÷ RMS error")
        panel.set_xticks(WIDTHS, [f"{w:g}" for w in WIDTHS])
        panel.set_xticks([], minor=True)
    panels[0].set(ylabel="true errors inside, %", ylim=(0, 102))
    panels[0].legend(fontsize=7)
    drawn.tight_layout()
    drawn.savefig(FIGURES / "bands.png", dpi=110)
    pyplot.close(drawn)


if __name__ == "__main__":
    main(__doc__ or "", PIECES, "bands", tables, None)
