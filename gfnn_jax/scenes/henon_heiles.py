"""The Hénon–Heiles system: a star in a galaxy (paper, section 4.2)."""

from __future__ import annotations

import math
from functools import partial

from gfnn_jax.phase_space import Scalar, State, split
from gfnn_jax.scenes.scene import AroundOrbit, Scene

ESCAPE_ENERGY = 1 / 6


def hamiltonian(z: State, t=0.0) -> Scalar:
    """‖p‖²/2 + ‖q‖²/2 + q₁²q₂ − q₂³/3 (Hénon & Heiles, Astron. J. 69, 1964)."""
    q, p = split(z)
    return p @ p / 2 + q @ q / 2 + q[0] ** 2 * q[1] - q[1] ** 3 / 3


def printed_hamiltonian(z: State, t=0.0) -> Scalar:
    """‖p‖²/2 + ‖q‖²/2 + q₁²q₂ + q₂³/3, as the paper prints it: separable in q₁ ± q₂, integrable."""
    q, p = split(z)
    return p @ p / 2 + q @ q / 2 + q[0] ** 2 * q[1] + q[1] ** 3 / 3


def printed_part(z: State) -> Scalar:
    """The printed form's energy in u = q₁ + q₂: p_u² + u²/4 + u³/6 with p_u = ½(p₁ + p₂)."""
    q, p = split(z)
    u, p_u = q[0] + q[1], (p[0] + p[1]) / 2
    return p_u**2 + u**2 / 4 + u**3 / 6


def _start(energy, q2, printed):
    """The state of this energy on the section q₁ = 0 with this q₂, p₂ = 0 and p₁ > 0."""
    cubic = 1 / 3 if printed else -1 / 3
    return (0.0, q2, math.sqrt(2 * energy - q2**2 - 2 * cubic * q2**3), 0.0)


def henon_heiles(energy: float = 1 / 12, dt: float = 0.5, *, printed: bool = False) -> Scene:
    """States within σ = 0.01 (each coordinate) of one orbit of this energy, 0 < energy ≤ 1/6.

    The orbit starts on the section q₁ = 0 at p₂ = 0, p₁ > 0. Below E = 0.1 it does so at q₂ = ½√E,
    in the middle of the widest island, so that the perturbed states are regular too (E = 1/12:
    Lyapunov exponents over t = 2,000 at most 0.0035, falling as 1/t). From there on it starts at
    q₂ = −½√E, in the chaotic sea (E = 1/6 and just below: 0.12). 1/6 is the energy of escape, which
    perturbed states may exceed: chaotic rollouts start on an orbit itself, of energy at most
    1/6 − 0.001, inside the closed well.

    ``printed`` takes the paper's + q₂³/3: integrable, with the energy in q₁ + q₂ as its second
    invariant. Its orbits are bound up to E = 1/12 whichever way they share that energy.

    Raises ValueError where the energy is outside its range.
    """
    highest = 1 / 12 if printed else ESCAPE_ENERGY
    if not 0 < energy <= highest:
        raise ValueError(
            f"energy must be > 0 and at most {highest:.6g}, where orbits are bound, got {energy}"
        )
    kind = "printed" if printed else "regular" if energy < 0.1 else "chaotic"
    chaotic = kind == "chaotic"

    def orbit(energy, sigma):
        q2 = (-0.5 if chaotic else 0.5) * math.sqrt(energy)
        return AroundOrbit(_start(energy, q2, printed), num_steps=10_000, sigma=sigma)

    return Scene(
        name=f"henon-heiles-{kind}",
        purpose={
            "regular": "quasiperiodic, not integrable: errors over long times",
            "chaotic": "chaotic sea: Poincaré sections and statistics",
            "printed": "the paper's misprinted + sign: integrable, two exact invariants",
        }[kind],
        dim=2,
        dt=dt,
        sampling=orbit(energy, 0.01),
        test_states=orbit(min(energy, ESCAPE_ENERGY - 1e-3), 0.0) if chaotic else None,
        hamiltonian=printed_hamiltonian if printed else hamiltonian,
        invariants=(
            {"energy": printed_hamiltonian, "energy in q1+q2": printed_part}
            if printed
            else {"energy": hamiltonian}
        ),
        reversor=(1, 1, -1, -1),
        regular=not chaotic,
        num_pairs=8_000 if chaotic else 4_000,
        tolerance=3e-10 if chaotic else 5e-12,
    )


SCENES = {
    "henon-heiles-regular": henon_heiles,
    "henon-heiles-chaotic": partial(henon_heiles, energy=ESCAPE_ENERGY),
    "henon-heiles-printed": partial(henon_heiles, printed=True),
}
