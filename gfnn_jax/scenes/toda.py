"""Toda's ring: exponential springs, as many invariants as sites (Toda 1967, Hénon 1974)."""

from __future__ import annotations

import jax.numpy as jnp

from gfnn_jax.phase_space import Scalar, State, split
from gfnn_jax.scenes.scene import DrawnFrom, NormalSites, Scene


def hamiltonian(z: State, t=0.0) -> Scalar:
    """Σ_i p_i²/2 + exp(q_i − q_{i+1}) on a ring."""
    q, p = split(z)
    return jnp.sum(p**2 / 2 + jnp.exp(q - jnp.roll(q, -1)))


def third(z: State) -> Scalar:
    """Hénon's third invariant: Σ_i p_i³/3 + (p_i + p_{i+1}) exp(q_i − q_{i+1})."""
    q, p = split(z)
    return jnp.sum(p**3 / 3 + (p + jnp.roll(p, -1)) * jnp.exp(q - jnp.roll(q, -1)))


def toda(dim: int = 32, dt: float = 0.05) -> Scene:
    """A ring of ``dim`` sites, q and p of standard deviation 0.3 at every site: integrable."""
    return Scene(
        name="toda",
        purpose="an integrable ring of sites with exponential springs: structure ring",
        dim=dim,
        dt=dt,
        sampling=DrawnFrom(NormalSites(dim, 0.3, 0.3)),
        hamiltonian=hamiltonian,
        invariants={"energy": hamiltonian, "third": third},
        structure="ring",
        num_pairs=200,
        tolerance=1e-12,
    )


SCENES = {"toda": toda}
