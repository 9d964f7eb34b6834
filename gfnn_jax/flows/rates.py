"""Fastest rates of a Hamiltonian's linearised flow, and the substeps that they ask for."""

import numpy as np

from gfnn_jax.families.family import form_of
from gfnn_jax.families.sums import matrix_free
from gfnn_jax.phase_space import apply_j

REACH = 1.0  # h‖H''‖ of one substep: Hénon–Heiles at dt 0.5 to 3, three bodies at dt 0.1 and 0.5
# States and iterations by which the fastest rate of a large system is estimated.
_RATED, _POWERS = 4, 30


# A flow that needs more is dearer than any map, and its linear start is seldom right.
MOST_SUBSTEPS = 64


def substeps_for(family, coefficients, z, dt, reach: float = REACH, *, args=None) -> int:
    """Substeps so that h‖H''‖ is within reach for nearly all of the states z (N, 2d), at the
    longest dt."""
    found = rates(family, coefficients, z, args)
    finite = found[np.isfinite(found)]
    if not len(finite):
        return 1
    return int(np.clip(np.ceil(np.max(dt) * np.quantile(finite, 0.95) / reach), 1, MOST_SUBSTEPS))


def rates(family, coefficients, z, args=None) -> np.ndarray:
    """The largest |eigenvalue| of JH'' (N,) at states z (N, 2d): the fastest rate of the linearised
    flow; not finite where H'' is not. Without matrices its estimate by power iteration, from below.
    """
    if not matrix_free(family):
        _, hessian = family.gradient_and_hessian(coefficients, z, args)
        finite = np.isfinite(hessian).all(axis=(1, 2))
        turned = form_of(family, z.shape[1]) @ hessian[finite]
        found = np.full(len(z), np.nan)
        found[finite] = np.abs(np.linalg.eigvals(turned)).max(axis=-1, initial=0.0)
        return found
    z = z[:: -(-len(z) // _RATED)]
    bends = family.curvatures(coefficients, z, args)
    v = np.random.default_rng(0).normal(size=z.shape)
    for _ in range(_POWERS):  # twice at a time: eigenvalues come in pairs ±λ
        v = v / np.linalg.norm(v, axis=1, keepdims=True)
        for _ in range(2):
            v = apply_j(family.hessian_product(bends, v))
    return np.sqrt(np.linalg.norm(v, axis=1))
