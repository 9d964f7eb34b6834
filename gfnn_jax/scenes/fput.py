"""The ring of Fermi, Pasta, Ulam and Tsingou: equal masses, springs that are not quite linear."""

from __future__ import annotations

import dataclasses

import jax.numpy as jnp

from gfnn_jax.phase_space import Scalar, State, split
from gfnn_jax.scenes.scene import DrawnFrom, NormalSites, Scene


@dataclasses.dataclass(frozen=True)
class Springs:
    """``energy(z)``: Σ_i p_i²/2 + r_i²/2 + α r_i³/3 + β r_i⁴/4, r_i = q_{i+1} − q_i on a ring."""

    alpha: float
    beta: float

    def __call__(self, z: State, t=0.0) -> Scalar:
        q, p = split(z)
        r = jnp.roll(q, -1) - q
        bonds = r**2 / 2 + self.alpha * r**3 / 3 + self.beta * r**4 / 4
        return jnp.sum(p**2 / 2 + bonds)


def momentum(z: State) -> Scalar:
    """Σ p_i."""
    return jnp.sum(split(z)[1])


def fput(dim: int = 32, alpha: float = 0.0, beta: float = 1.0, dt: float = 0.1) -> Scene:
    """Scene of the β ring of ``dim`` sites (Fermi, Pasta, Ulam & Tsingou 1955); with ``alpha`` of
    the α + β ring.

    q and p have standard deviations 0.2 and 0.28 at every site, which is about equipartition. The
    orbits are weakly chaotic.
    """
    energy = Springs(alpha, beta)
    return Scene(
        name="fput",
        purpose="a ring of sites, learned as a sum over them: structure ring",
        dim=dim,
        dt=dt,
        sampling=DrawnFrom(NormalSites(dim, 0.2, 0.28)),
        hamiltonian=energy,
        invariants={"energy": energy, "momentum": momentum},
        structure="ring",
        num_pairs=40,
        tolerance=1e-12,
    )


SCENES = {"fput": fput}
