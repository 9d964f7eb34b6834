"""Data of a comparison, from which all methods learn and by which all are measured.

They are those of the paper ("Experimental Details"): pairs D₂, and sequences of five states D₅, a
quarter as many (for two bodies as many).
"""

from __future__ import annotations

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np

from gfnn_jax.baselines import Sequences
from gfnn_jax.jobs.measure import NUM_STEPS, NUM_TRAJECTORIES, angles_of_z
from gfnn_jax.phase_space import Pairs
from gfnn_jax.scenes import Scene
from gfnn_jax.scenes.draws import sample_pairs, sample_sequences, sample_test_states
from gfnn_jax.scenes.trajectories import reference_trajectories

_NUM_FRESH = 2_000
_QUICK_PAIRS, _QUICK_TRAJECTORIES = 10_000, 10
_EXACT_TRAJECTORIES = 1_000  # where the reference costs nothing; the paper's number for two bodies


@functools.partial(jax.jit, static_argnums=0)
def _largest_mixed(hamiltonian, z):
    """Largest entry of ∂²H/∂q∂p in magnitude at z (B, 2d)."""
    dim = z.shape[1] // 2
    return jnp.max(jnp.abs(jax.vmap(jax.hessian(hamiltonian))(z)[:, :dim, dim:]))


def separable(scene: Scene) -> bool:
    """Return whether H = T(p) + V(q), by its mixed second derivatives; True for a map without H."""
    if scene.hamiltonian is None:
        return True
    z = sample_test_states(scene, 5, jax.random.key(0))
    return float(_largest_mixed(scene.hamiltonian, z)) == 0


@jax.jit
def _key(seed, use):
    return jax.random.fold_in(jax.random.key(seed), use)


@dataclasses.dataclass(frozen=True, eq=False)
class SharedData:
    """Data of a comparison, NumPy; each part is drawn when it is first used."""

    scene: Scene
    seed: int
    quick: bool

    @property
    def num_steps(self) -> int:
        return NUM_STEPS

    @property
    def num_pairs(self) -> int:
        """Number of pairs of D₂: a hundred thousand, for the standard map a million."""
        if self.quick:
            return _QUICK_PAIRS
        return 100_000 if self.scene.step is None else 1_000_000

    def key(self, use: int):
        """Make a key for one use of randomness; the data use 0 to 5."""
        return _key(self.seed, use)

    @functools.cache  # noqa: B019, lives as long as a comparison
    def sequences(self, length: int) -> Sequences:
        """Draw D₂ (length 2) or D₅ (length 5)."""
        few = length > 2 and self.scene.name != "two-body"
        num = self.num_pairs // 4 if few else self.num_pairs
        z = np.asarray(sample_sequences(self.scene, num, length, self.key(length)))
        z = z[np.isfinite(z).all(axis=(1, 2))]  # a state that collides has no image
        return Sequences(z, self.scene.dt, angles_of_z(self.scene), separable(self.scene))

    @functools.cached_property
    def fresh(self) -> Pairs:
        """Pairs that no method learns from."""
        pairs = sample_pairs(self.scene, _NUM_FRESH, self.key(0))
        z0, z1 = np.asarray(pairs.z0), np.asarray(pairs.z1)
        known = np.isfinite(z1).all(axis=1)
        return Pairs(z0[known], z1[known], pairs.dt)

    @functools.cached_property
    def z0(self) -> np.ndarray:
        """Initial states of the rollouts, (B, 2d)."""
        many = NUM_TRAJECTORIES if self.scene.flow is None else _EXACT_TRAJECTORIES
        num = _QUICK_TRAJECTORIES if self.quick else many
        return np.asarray(sample_test_states(self.scene, num, self.key(1)))

    @functools.cached_property
    def reference(self) -> np.ndarray:
        """Reference trajectories from z0, (B, 1 + num_steps, 2d)."""
        return np.asarray(reference_trajectories(self.scene, self.z0, self.num_steps))
