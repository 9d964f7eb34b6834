"""States, the form J, the symplecticity defect, pairs."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gfnn_jax.phase_space import (
    Pairs,
    apply_j,
    hamiltonian_vector_field,
    require_x64,
    split,
    symplectic_form,
    symplecticity_defect,
)


def random_symplectic(rng, dim):
    """A product of two shears, far from the identity and not normal."""
    upper, lower = (m + m.T for m in rng.standard_normal((2, dim, dim)))
    eye, zero = np.eye(dim), np.zeros((dim, dim))
    return np.block([[eye, upper], [zero, eye]]) @ np.block([[eye, zero], [lower, eye]])


def test_split_and_apply_j_agree_with_the_matrix():
    z = np.random.default_rng(0).standard_normal((3, 5, 6))
    q, p = split(z)
    np.testing.assert_array_equal(np.concatenate([q, p], axis=-1), z)
    form = np.asarray(symplectic_form(3))
    np.testing.assert_array_equal(form, np.kron([[0, 1], [-1, 0]], np.eye(3)))
    np.testing.assert_array_equal(apply_j(jnp.asarray(z)), z @ form.T)


@pytest.mark.parametrize("dim", [1, 2, pytest.param(4, marks=pytest.mark.slow)])
def test_defect_of_symplectic_matrices_is_roundoff_and_of_others_is_not(dim):
    rng = np.random.default_rng(dim)
    batch = np.stack([random_symplectic(rng, dim) for _ in range(4)])
    assert symplecticity_defect(jnp.asarray(batch)).shape == (4,)
    assert symplecticity_defect(jnp.asarray(batch)).max() < 1e-12
    # (1 + a) I has MᵀJM − J = (2a + a²) J.
    stretched = 1.001 * np.eye(2 * dim)
    assert float(symplecticity_defect(jnp.asarray(stretched))) == pytest.approx(0.002001)
    assert symplecticity_defect(stretched, multiplier=1.001**2) < 1e-15
    each = symplecticity_defect(np.stack([stretched, batch[0]]), multiplier=np.array([1.001**2, 1]))
    assert each.max() < 1e-12
    swapped = np.eye(2 * dim)[::-1]  # q and p exchanged without the sign
    assert float(symplecticity_defect(jnp.asarray(swapped.copy()))) == pytest.approx(2.0)


def test_defect_does_not_depend_on_the_units_when_scaled():
    """Check with y = z/s, s equal for all pairs (q_i, p_i), that the defect is that in y."""
    matrix = random_symplectic(np.random.default_rng(1), 2) + 1e-3
    scale = np.array([1e6, 2e6, 3e-3, 1.5e-3])
    in_units = matrix * scale[:, None] / scale[None, :]
    expected = symplecticity_defect(jnp.asarray(matrix))
    found = symplecticity_defect(jnp.asarray(in_units), jnp.asarray(scale))
    assert float(found) == pytest.approx(float(expected), rel=1e-9)
    both = symplecticity_defect(jnp.asarray(np.stack([in_units] * 2)), jnp.asarray(scale))
    np.testing.assert_allclose(both, [found, found], rtol=1e-12)


def test_vector_field_of_an_oscillator():
    field = hamiltonian_vector_field(lambda z, t: 0.5 * (9 * z[0] ** 2 + z[1] ** 2) + t * z[0])
    np.testing.assert_allclose(field(jnp.asarray([2.0, 5.0])), [5.0, -18.0])
    np.testing.assert_allclose(field(jnp.asarray([2.0, 5.0]), 1.0), [5.0, -19.0])


def test_pairs_know_their_size_and_pass_through_jit():
    pairs = Pairs(np.zeros((7, 4)), np.ones((7, 4)), 0.1)
    assert (len(pairs), pairs.dim) == (7, 2)
    some = pairs.take(np.array([0, 3]))
    assert (len(some), some.dt) == (2, 0.1)
    moved = jax.jit(lambda pairs: jax.tree.map(lambda a: a + 1.0, pairs))(pairs)
    assert (moved.dt, float(moved.z1[0, 0])) == (0.1, 2.0)


def test_float64_is_required_by_name():
    require_x64("this")
    with jax.enable_x64(False), pytest.raises(RuntimeError, match="this needs float64"):
        require_x64("this")
