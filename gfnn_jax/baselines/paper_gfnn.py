"""Recipe of the paper for GFNN: its network as S, type 2, trained by Adam.

Chen & Tao, ICML 2021, "Experimental Details": hidden layers 200-100-50-20 and batches of 200 from a
rate of 0.01; for the standard map 500-500-200-20 and batches of 1,000 from 0.001; 20 passes through
the pairs. The step is solved to roundoff, as everywhere in this package.
"""

from __future__ import annotations

import dataclasses
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from gfnn_jax.baselines.learned import Budget, Sequences, held, in_float64, q_angles
from gfnn_jax.coordinates import Coordinates
from gfnn_jax.families.inputs import box_inputs
from gfnn_jax.families.mlp import PAPER_HIDDEN, PAPER_HIDDEN_STANDARD_MAP, Mlp, amplitude_of
from gfnn_jax.fitting.adam import PAPER, PAPER_STANDARD_MAP, AdamFit, Training
from gfnn_jax.generating.charts import TYPE2
from gfnn_jax.generating.generated import Generated
from gfnn_jax.maps.domain import covering
from gfnn_jax.maps.symplectic_map import SymplecticMap
from gfnn_jax.phase_space import sizes


class PaperGfnn(NamedTuple):
    """Result of the paper's recipe: map in the user's coordinates, network, training of ∇S."""

    map: SymplecticMap
    family: Mlp
    training: AdamFit


def paper_gfnn(pairs: Sequences, budget: Budget) -> PaperGfnn:
    """Learn S(q, P) from pairs; where coordinates are periodic, by the standard map's recipe."""
    hidden, recipe = PAPER_HIDDEN, PAPER
    if pairs.angles:
        hidden, recipe = PAPER_HIDDEN_STANDARD_MAP, PAPER_STANDARD_MAP
    z0, z1 = pairs.z[:, 0], pairs.z[:, 1]
    w, target = TYPE2.evaluation_point(z0, z1), TYPE2.target_gradient(z0, z1, pairs.dt)
    inputs = box_inputs(w, angles=q_angles(pairs))
    family = Mlp(inputs, hidden, "tanh", amplitude_of(w, target))
    first = held(len(w))
    part = 50  # iterations between two readings of the clock
    iterations = recipe.epochs * (len(w) // recipe.batch_size)
    recipe = dataclasses.replace(recipe, epochs=max(1, iterations // part), epoch_length=part)
    training = Training(
        recipe,
        budget.key,
        cap=budget.cap,
        on_epoch=lambda epoch, _, rms: budget.on_progress(
            f"{epoch * part} iterations: error {rms:.1e}"
        ),
    ).of_gradients(
        family,
        family.init(budget.key, jnp.float32),
        (w[first:], target[first:]),
        (w[:first], target[:first]),
        pairs.dt * np.ones(2 * pairs.dim),
    )
    scale = sizes(z0)
    generated = Generated(family, in_float64(training.params), TYPE2, pairs.dt, scale)
    coordinates = Coordinates("cartesian", angles=pairs.angles)
    centre = np.full(len(pairs.angles), np.pi)  # z0 is in [0, 2π)
    domain = covering(z0[:20_000], ignore=pairs.angles)
    map_ = SymplecticMap((generated,), coordinates, domain, scale, centre, pairs.dt)
    return PaperGfnn(map_, family, training)
