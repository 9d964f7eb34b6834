"""A training step of the paper's network, beside plain products of its sizes and PyTorch."""

from __future__ import annotations

import dataclasses
import time
from itertools import pairwise

# Sets float64, so it comes before all of JAX.
from harness import SEED, Numbers, cores, drawn, timed

# isort: split
import jax
import jax.numpy as jnp
import numpy as np

from gfnn_jax.families.inputs import box_inputs
from gfnn_jax.families.mlp import PAPER_HIDDEN, Mlp
from gfnn_jax.fitting.adam import PAPER, Training, gradient_loss
from gfnn_jax.generating.charts import TYPE2
from gfnn_jax.scenes import henon_heiles


def training(quick: bool) -> Numbers:
    """The paper's network, batches of 200, float32: its rate against that of its own products."""
    scene = henon_heiles()
    pairs, _ = drawn(scene, 2_000 if quick else 20_000, quick=True)
    z0, z1 = np.asarray(pairs.z0), np.asarray(pairs.z1)
    w, target = TYPE2.evaluation_point(z0, z1), TYPE2.target_gradient(z0, z1, scene.dt)
    family = Mlp(box_inputs(w), PAPER_HIDDEN, "tanh")
    runs, length = (3, 20) if quick else (10, 100)
    recipe = dataclasses.replace(PAPER, epochs=runs + 1, epoch_length=length)
    ends = []
    key = jax.random.key(SEED)
    Training(recipe, key, on_epoch=lambda *_: ends.append(time.perf_counter())).of_loss(
        gradient_loss(family, scene.dt),
        family.init(key, jnp.float32),
        (w, target),
        (w[:10], target[:10]),
        4,
    )
    seconds = float(np.diff(ends).min()) / length
    weights = [jnp.ones(shape, jnp.float32) for shape in pairwise((4, *PAPER_HIDDEN, 1))]
    # Two products make ∇S, one each way; its slope in the weights takes each of them twice more.
    flop = 6 * 2 * 200 * sum(m.size for m in weights)
    layers = [(jnp.ones((200, m.shape[0]), jnp.float32), m) for m in weights]

    def products(_, carry):
        """Multiply the matrices of every layer: forward, transposed, and for the weights' slope."""
        out = carry
        for x, matrix in layers:
            x = x + out
            y = jnp.dot(x, matrix, precision="highest")
            back = jnp.dot(y, matrix.T, precision="highest")
            slope = jnp.dot(x.T, y, precision="highest")
            out = out + 1e-30 * (back[0, 0] + slope[0, 0])
        return out

    repeats = 20 if quick else 200
    loop = jax.jit(lambda c: jax.lax.fori_loop(0, repeats, products, c))
    plain = timed(lambda: loop(jnp.float32(0.0)), 7).seconds / repeats
    product_flop = 6 * 200 * sum(m.size for m in weights)
    return {
        "microseconds": 1e6 * seconds,
        "mflop": flop / 1e6,
        "gflops": flop / seconds / 1e9,
        "gflops_of_products": product_flop / plain / 1e9,
        "training_rate": (flop / seconds) / (product_flop / plain),
        "torch": in_torch(w, target, scene.dt, runs, length),
        "models_per_second": models_per_second(family, w, target, scene.dt, quick),
    }


def in_torch(w, target, dt: float, runs: int, length: int) -> Numbers | None:
    """Time the same training step in PyTorch, on as many threads; None where not installed."""
    try:
        import torch_loops
    except ImportError:
        return None
    threads = cores() or 1
    widths = (w.shape[1], *PAPER_HIDDEN, 1)
    return torch_loops.measure(w, target, widths, dt, PAPER.batch_size, runs, length, threads)


def models_per_second(family, w, target, dt: float, quick: bool) -> Numbers:
    """Steps of several networks trained at once, by vmap: number -> steps of one model a second.

    Plain descent instead of Adam, whose own work is small beside that of the network.
    """
    w, target = (np.asarray(a[: PAPER.batch_size], np.float32) for a in (w, target))

    def loss(params):
        error = dt * (family.gradient(params, jnp.asarray(w)) - target)
        return jnp.mean(jnp.sum(error**2, axis=-1))

    def descend(_, params):
        return jax.tree.map(lambda a, slope: a - 1e-3 * slope, params, jax.grad(loss)(params))

    steps, found = 10 if quick else 100, {}
    for models in (1, 2) if quick else (1, 4, 16):
        keys = jax.random.split(jax.random.key(SEED), models)
        params = jax.vmap(lambda key: family.init(key, jnp.float32))(keys)
        train = jax.jit(jax.vmap(lambda p: jax.lax.fori_loop(0, steps, descend, p)))
        seconds = timed(lambda: train(params), 3).seconds  # noqa: B023
        found[str(models)] = models * steps / seconds
    return found
