"""Seconds and memory against pairs, terms, degrees of freedom, trajectories and steps."""

from __future__ import annotations

import subprocess
import sys

# Sets float64, so it comes before all of JAX.
from harness import SEED, Numbers, timed

# isort: split
import jax
import jax.numpy as jnp
import numpy as np

import gfnn_jax as gfnn
from gfnn_jax.families.inputs import box_inputs
from gfnn_jax.families.products import Products
from gfnn_jax.fitting import least_squares
from gfnn_jax.generating.charts import MIDPOINT
from gfnn_jax.generating.generated import Generated
from gfnn_jax.threads import one_thread


def scaling(quick: bool) -> Numbers:
    """Seconds against pairs, terms, degrees of freedom, trajectories and steps, memory against
    pairs, with fitted slopes."""
    rng = np.random.default_rng(SEED)

    def polynomial(dim, degree):
        w = rng.uniform(-1, 1, (64, 2 * dim))
        family = Products(box_inputs(w), degree)
        return family, family.unflatten(1e-3 * rng.standard_normal(family.num_parameters))

    def timed_fit(num_pairs, degree):
        family, _ = polynomial(2, degree)
        w = rng.uniform(-1, 1, (num_pairs, 4))

        def fitted():
            some = (w, w), (w[:100], w[:100])
            triangles = [least_squares.reduce(family, [rows], np.ones(4)) for rows in some]
            return least_squares.solve(triangles[0], triangles[1], family.num_parameters)

        with one_thread():  # as in `gfnn.fit`
            taken = timed(fitted, 1)
        return taken.seconds, family.num_parameters

    def step_seconds(dim, lanes, num_steps=100):
        family, params = polynomial(dim, 4)
        piece = Generated(family, params, MIDPOINT, 0.1, np.ones(2 * dim))
        z = jnp.asarray(rng.uniform(-0.5, 0.5, (lanes, 2 * dim)))

        @jax.jit
        def run(piece, z):
            return jax.lax.fori_loop(0, num_steps, lambda _, y: piece.step(y)[0], z)

        return timed(lambda: run(piece, z), 3).seconds / num_steps

    scene = gfnn.scenes.make("henon-heiles-regular")

    def selection_seconds(num_pairs):
        pairs = gfnn.sample_pairs(scene, num_pairs, jax.random.key(SEED))
        gfnn.fit(pairs, scene, learn="map", absolute_tolerance=1e-6)  # compiles
        return gfnn.fit(pairs, scene, learn="map", absolute_tolerance=1e-6)

    def rollout_seconds(map_, z0, num_steps):
        return timed(lambda: map_.rollout(z0, num_steps, save_every=num_steps)[0], 2).seconds

    sizes = (1_000, 10_000) if quick else (1_000, 10_000, 100_000, 1_000_000)
    degrees = (3, 5) if quick else (3, 4, 5, 6, 7, 8)
    lanes = (1, 100, 1_000) if quick else (1, 10, 100, 1_000, 10_000, 100_000)
    dims = (1, 2) if quick else (1, 2, 4)
    pairs_rows = [(n, timed_fit(n, 4)[0]) for n in sizes]
    terms_rows = [(terms, s) for s, terms in (timed_fit(4_000, d) for d in degrees)]
    lane_rows = [(n, step_seconds(2, n)) for n in lanes]
    dim_rows = [(d, step_seconds(d, 1_000)) for d in dims]
    fits = [(n, selection_seconds(n)) for n in sizes[:3]]
    z0 = gfnn.sample_test_states(scene, 100, jax.random.key(SEED))
    lengths = (100, 1_000) if quick else (100, 1_000, 10_000, 100_000)
    length_rows = [(n, rollout_seconds(fits[0][1].map, z0, n)) for n in lengths]
    return {
        "fit seconds against pairs": described(pairs_rows),
        "fit seconds against terms": described(terms_rows),
        "step seconds against trajectories": described(lane_rows),
        "step seconds of 1,000 trajectories against d": described(dim_rows),
        "selection seconds against pairs": described([(n, f.seconds) for n, f in fits]),
        "rollout seconds of 100 trajectories against steps": described(length_rows),
        "peak GB of a fit of 69 terms against pairs": described([(n, peak(n)) for n in sizes]),
    }


def peak(num_pairs: int) -> float:
    """Peak memory of a process that fits a polynomial of degree 4 to so many pairs, in GB."""
    script = f"""
import jax, numpy as np
jax.config.update("jax_enable_x64", True)
from gfnn_jax.fitting import least_squares
from gfnn_jax.families.inputs import box_inputs
from gfnn_jax.families.products import Products
w = np.random.default_rng(0).uniform(-1, 1, ({num_pairs}, 4))
family, some = Products(box_inputs(w[:64]), 4), ((w, w), (w[:100], w[:100]))
triangles = [least_squares.reduce(family, [rows], np.ones(4)) for rows in some]
least_squares.solve(*triangles, family.num_parameters)
print(next(line for line in open("/proc/self/status") if line.startswith("VmHWM")).split()[1])
"""
    out = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    return int(out.stdout) / 2**20


def described(rows: list[tuple[int, float]]) -> Numbers:
    size, measured = np.array(rows).T
    slope = float(np.polyfit(np.log(size[-3:]), np.log(measured[-3:]), 1)[0])
    return {"size": size.tolist(), "measured": measured.tolist(), "slope_of_largest": slope}
