"""A million steps of two bodies: a panel of the figure of docs/results.md (`long_time.py`).

    python benchmarks/kepler.py           measure, then the figure and its caption
    python benchmarks/kepler.py --quick   small sizes, into runs/kepler, no figure
    python benchmarks/kepler.py --tables  only the figure and its caption again

The learned map beside a learned vector field (VFNN: finite differences, a network, an adaptive
Runge–Kutta method) and beside an integrator that knows H (Yoshida's of order 4, ten substeps to a
step). The reference is Kepler's exact solution. The result is kepler-million-steps.json in
benchmarks/results.
"""

from __future__ import annotations

from collections.abc import Callable

# Sets float64, so it comes before all of JAX.
from harness import SEED, Numbers, main, timed
from long_time import INTEGRATOR, LEARNED, NETWORK, draw

# isort: split
import jax
import jax.numpy as jnp
import numpy as np

import gfnn_jax as gfnn
from gfnn_jax.baselines import METHODS, Budget, Sequences
from gfnn_jax.evaluate import metrics
from gfnn_jax.maps.rollout import rollout

NUM_PAIRS, NUM_NETWORK_PAIRS, TRAINING_SECONDS = 4_000, 100_000, 60.0
NUM_ORBITS, NUM_STEPS, NUM_NETWORK_STEPS, EARLY = 8, 1_000_000, 10_000, 1_000
SUBSTEPS = 10


def yoshida(dt: float) -> Callable:
    """``step(z)``: Yoshida's composition of three leapfrogs, SUBSTEPS times."""
    outer = 1 / (2 - 2 ** (1 / 3))
    parts = [dt / SUBSTEPS * c for c in (outer, 1 - 2 * outer, outer)]

    def step(z):
        q, p = z[:2], z[2:]
        for h in SUBSTEPS * parts:
            q = q + 0.5 * h * p
            p = p - h * q / jnp.sqrt(q @ q) ** 3
            q = q + 0.5 * h * p
        return jnp.concatenate([q, p])

    return step


def saved(roll: Callable, last: int) -> tuple[np.ndarray, np.ndarray]:
    """Steps and states (B, L, 4): each of the first 1,000 steps, then a thousand more."""
    every = last // EARLY
    early, late = np.asarray(roll(EARLY, 1)), np.asarray(roll(last, every))
    more = EARLY // every + 1
    steps = np.concatenate([np.arange(EARLY + 1), every * np.arange(more, late.shape[1])])
    return steps, np.concatenate([early, late[:, more:]], axis=1)


def measure(quick: bool) -> Numbers:
    """Curves of the mean position error, and what each method cost."""
    scene, key = gfnn.scenes.two_body(), jax.random.key(SEED)
    keys = jax.random.split(key, 4)
    pairs = gfnn.sample_pairs(scene, 600 if quick else NUM_PAIRS, keys[0])
    fit = gfnn.fit(pairs, scene, chart="midpoint", absolute_tolerance=1e-4 if quick else 1e-10)
    many = gfnn.sample_pairs(scene, 2_000 if quick else NUM_NETWORK_PAIRS, keys[1])
    sequences = Sequences(np.stack([many.z0, many.z1], axis=1), scene.dt)
    network = METHODS["vfnn"].learn(sequences, Budget(keys[2], 1.0 if quick else TRAINING_SECONDS))
    z0, exact = gfnn.sample_test_states(scene, NUM_ORBITS, keys[3]), yoshida(scene.dt)
    last = 2_000 if quick else NUM_STEPS
    rolls = {
        NETWORK: (
            lambda n, k: rollout(network.step, z0, n, save_every=k),
            min(last, NUM_NETWORK_STEPS),
        ),
        INTEGRATOR: (lambda n, k: rollout(exact, z0, n, save_every=k), last),
        LEARNED: (lambda n, k: fit.map.rollout(z0, n, save_every=k)[0], last),
    }
    methods = {}
    for name, (roll, steps_rolled) in rolls.items():
        steps, states = saved(roll, steps_rolled)
        early = timed(lambda: roll(EARLY, 1), 3)  # noqa: B023
        microseconds = 1e6 * early.seconds / (EARLY * NUM_ORBITS)
        _, reference = saved(
            lambda n, k: gfnn.reference_trajectories(scene, z0, n, save_every=k), steps_rolled
        )
        error = metrics.position_error(states, reference)
        axis = metrics.absolute_error(
            metrics.semi_major_axis(states), metrics.semi_major_axis(reference)
        )
        shown = np.unique(np.searchsorted(steps, np.geomspace(1, steps[-1], 60)))
        methods[name] = {
            "num_steps": steps_rolled,
            "microseconds_per_step": microseconds,
            "error_end": float(np.mean(error[:, -1])),
            "axis_end": float(np.mean(axis[:, -1])),
            "exponent": metrics.growth_exponent(steps, error).value,
            "curve": {
                "steps": steps[shown].tolist(),
                "error": [[float(f"{e:.3e}") for e in lane] for lane in error[:, shown]],
            },
        }
        print(
            f"{name}: {microseconds:.1f} µs, {methods[name]['error_end']:.1e} at the end",
            flush=True,
        )
    methods[LEARNED] |= {
        "pairs": len(pairs),
        "num_parameters": fit.chosen.num_parameters,
        "fit_seconds": fit.chosen.fit_seconds,
        "symplecticity_defect": fit.symplecticity_defect,
    }
    methods[NETWORK] |= {"pairs": len(many), "num_parameters": network.num_parameters}
    return {"num_orbits": NUM_ORBITS, "methods": methods}


PIECES = {"million-steps": measure}


if __name__ == "__main__":
    main(__doc__ or "", PIECES, "kepler", draw, None)
