"""Chaos: diffusion, Lyapunov exponents and sections of learned maps beside those of the exact."""

from __future__ import annotations

import math

# Sets float64, so it comes before all of JAX.
from harness import SEED, Numbers, drawn

# isort: split
import jax
import jax.numpy as jnp
import numpy as np
from hard.cases import Case, counts, tried

import gfnn_jax as gfnn
from gfnn_jax.coordinates import TWO_PI
from gfnn_jax.evaluate import metrics
from gfnn_jax.scenes import standard_map


def chaos(quick: bool) -> tuple[list[Case], Numbers]:
    cases, measured = [], {}
    for k in (0.9716, 2.0, 5.0):
        scene = standard_map(k)
        data, fresh = drawn(scene, 1_000, quick)
        case, fit = tried(f"standard map, K = {k:g}", data, scene, fresh, tolerance=1e-12)
        cases.append(case)
        assert fit is not None
        assert scene.step is not None
        num, length = (200, 100) if quick else (4_000, 500)
        rng = np.random.default_rng(SEED)
        z0 = TWO_PI * rng.uniform(size=(num, 2))
        predicted, info = fit.map.rollout(z0, length)
        exact = gfnn.reference_trajectories(scene, jnp.asarray(z0), length)
        ours, theirs = (
            metrics.diffusion_coefficient(np.asarray(z)[:, :, 1]) for z in (predicted, exact)
        )
        both = math.hypot(ours.standard_error, theirs.standard_error)
        differ = abs(ours.value - theirs.value) / both
        said = f"D = {ours.value:.4g}, exact map {theirs.value:.4g}, {differ:.1f} σ apart"
        cases.append(
            Case(
                f"standard map, K = {k:g}: diffusion",
                None,
                None,
                "; ".join(p for p in (said, counts(info.status)) if p),
                wrong=int(differ > 4),
            )
        )
        few, long = (10, 500) if quick else (50, 20_000)
        ours, theirs = (lyapunov(step, z0[:few], long) for step in (fit.map.step, scene.step))
        scatter = math.hypot(*(np.std(x) / math.sqrt(few) for x in (ours, theirs)))
        differ = abs(ours.mean() - theirs.mean()) / scatter
        said = f"λ = {ours.mean():.4f}, exact map {theirs.mean():.4f}, {differ:.1f} σ apart"
        cases.append(
            Case(
                f"standard map, K = {k:g}: Lyapunov exponent",
                None,
                None,
                said,
                wrong=int(differ > 4),
            )
        )
    more, found = near_escape(quick)
    return cases + more, measured | found


def lyapunov(step, z0, num_steps: int) -> np.ndarray:
    """Largest exponent per step from each of z0 (B, 2d); a map's (state, info) or a state."""

    def plain(z):
        out = step(z)
        return out[0] if isinstance(out, tuple) else out

    def exponent(z):
        return metrics.lyapunov_exponent(plain, z, num_steps)

    return np.asarray(jax.jit(jax.vmap(exponent))(jnp.asarray(z0)))


def near_escape(quick: bool) -> tuple[list[Case], Numbers]:
    """Hénon–Heiles just below the energy of escape: chaotic sea, islands, statistics."""
    scene = gfnn.scenes.make("henon-heiles-chaotic")
    data, fresh = drawn(scene, 2_000 if quick else 8_000, quick)
    case, fit = tried("Hénon–Heiles, E = 1/6 − 0.001", data, scene, fresh, tolerance=1e-10)
    assert fit is not None
    lanes, steps = (8, 2_000) if quick else (64, 22_000)
    z0 = gfnn.sample_test_states(scene, lanes, jax.random.key(SEED))
    predicted, info = fit.map.rollout(z0, steps)
    exact = np.asarray(gfnn.reference_trajectories(scene, z0, steps))
    sections = [
        np.concatenate([metrics.section_crossings(lane, 0)[:, [1, 3]] for lane in np.asarray(z)])
        for z in (predicted, exact)
    ]
    ours, theirs = sections
    num_bins = 20 if quick else 60
    edges = [np.linspace(-0.6, 1.1, num_bins + 1), np.linspace(-0.65, 0.65, num_bins + 1)]
    (mine, *_), (seen, *_) = (np.histogram2d(*x.T, bins=edges) for x in sections)
    # Deep inside an island: neither the cell nor a neighbour was ever entered by the reference.
    padded = np.pad(seen, 1) > 0
    near = np.max([np.roll(padded, (i, j), (0, 1)) for i in (-1, 0, 1) for j in (-1, 0, 1)], axis=0)
    inside = int(mine[~near[1:-1, 1:-1]].sum())
    divergence = metrics.kl_divergence(ours[:, 0], theirs[:, 0], 50, (-0.6, 1.1))
    half = len(theirs) // 2
    floor = metrics.kl_divergence(theirs[:half, 0], theirs[half:, 0], 50, (-0.6, 1.1))
    name = f"Hénon–Heiles, E = 1/6 − 0.001, {len(ours):,} crossings"
    cases = [
        case,
        Case(
            f"{name}: in islands that the reference's {len(theirs):,} never enter",
            None,
            None,
            f"{inside} crossings; {counts(info.status)}",
            wrong=inside,
        ),
        Case(
            f"{name}: law of q₂",
            None,
            None,
            f"divergence {divergence:.1e} (halves of the reference: {floor:.1e})",
            wrong=int(divergence > 3 * floor),
        ),
    ]
    few, long = (4, 500) if quick else (32, 10_000)
    mine = lyapunov(fit.map.step, z0[:few], long) / scene.dt
    theirs_rate = lyapunov_by_shadow(scene, z0[:few], long) / scene.dt
    scatter = math.hypot(*(np.std(x) / math.sqrt(few) for x in (mine, theirs_rate)))
    differ = abs(mine.mean() - theirs_rate.mean()) / scatter
    said = f"λ = {mine.mean():.4f}, reference {theirs_rate.mean():.4f}, {differ:.1f} σ apart"
    cases.append(
        Case(
            "Hénon–Heiles, E = 1/6 − 0.001: Lyapunov exponent",
            None,
            None,
            said,
            wrong=int(differ > 4),
        )
    )
    return cases, {"crossings": len(ours), "inside": inside, "divergence": divergence}


def lyapunov_by_shadow(scene, z0, num_steps) -> np.ndarray:
    """Largest exponent per step of the reference flow, from a neighbour that is drawn near again
    every ten steps; (B,)."""
    near, every, total = 1e-8, 10, 0.0
    z = jnp.asarray(z0)
    shadow = z.at[:, 0].add(near)
    for _ in range(num_steps // every):
        both = gfnn.reference_trajectories(
            scene, jnp.concatenate([z, shadow]), every, save_every=every
        )[:, -1]
        z, shadow = both[: len(z)], both[len(z) :]
        apart = jnp.linalg.norm(shadow - z, axis=-1, keepdims=True)
        total = total + np.log(np.asarray(apart[:, 0]) / near)
        shadow = z + (shadow - z) * (near / apart)
    return np.asarray(total) / num_steps
