"""The symplectic map: composition, inverse, defect, angles, lanes apart, users' transforms."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg

from gfnn_jax.maps import symplectic_map as maps
from gfnn_jax.generating.charts import MIDPOINT, TYPE2
from gfnn_jax.coordinates import CARTESIAN, Coordinates, polar
from gfnn_jax.maps.symplectic_map.domain import covering
from gfnn_jax.solve.newton import LEFT_DOMAIN, NON_FINITE, NOT_CONVERGED, OK
from gfnn_jax.maps.symplectic_map import Affine, Generated, SymplecticMap
from gfnn_jax.phase_space import symplectic_form, symplecticity_defect

PENDULUM = Coordinates("pendulum", angles=(0,))


def pendulum(params, w):
    return 0.5 * w[1] ** 2 - params * jnp.cos(w[0])


def kepler_polar(params, w):
    """H in polar coordinates, type 2: (r, φ, P_r, P_φ)."""
    r, _, p_r, p_phi = w
    return 0.5 * (p_r**2 + (p_phi / r) ** 2) - params / r


def make_map(scalar, params, chart, dt, data, *, coordinates=CARTESIAN, before=(), scale=None):
    """A map with one generated piece whose domain is that of the data, in inner coordinates."""
    size = data.shape[1]
    one = jnp.ones(size)
    piece = Generated(scalar, params, chart, dt, one)
    domain = covering(data, ignore=coordinates.angles)
    cut = jnp.zeros(len(coordinates.angles))
    scale = one if scale is None else jnp.asarray(scale)
    return SymplecticMap((*before, piece, *before), coordinates, domain, scale, cut, dt)


DATA = np.random.default_rng(0).uniform(-1, 1, (400, 2))
Z = DATA[:16]


def pendulum_map(chart=MIDPOINT, strength=1.0, **options):
    return make_map(pendulum, jnp.float64(strength), chart, 0.3, DATA, **options)


def test_one_state_and_a_batch_take_the_same_step():
    learned = pendulum_map()
    images, info = learned.step(Z)
    assert images.shape == (16, 2)
    assert info.status.shape == (16,)
    assert (info.status == OK).all()
    one, alone = learned.step(Z[3])
    assert one.shape == (2,)
    assert alone.status.shape == alone.residual.shape == ()
    np.testing.assert_allclose(one, images[3], rtol=1e-15)
    np.testing.assert_allclose(learned.apply(jnp.asarray(Z[3]))[0], images[3], rtol=1e-15)
    np.testing.assert_allclose(learned.inverse(images)[0], Z, rtol=0, atol=1e-14)
    assert learned.defect(Z[3]).shape == ()


def test_other_numbers_compile_nothing():
    """A map of the same kind, with another time step and another S, uses the compiled step."""
    learned = pendulum_map()
    learned.step(Z)
    compiled = maps._step._cache_size()
    (piece,) = learned.pieces
    other = dataclasses.replace(piece, dt=jnp.float64(0.1), params=jnp.float64(2.0))
    images, _ = dataclasses.replace(learned, pieces=(other,), dt=jnp.float64(0.1)).step(Z)
    assert maps._step._cache_size() == compiled
    assert not np.allclose(images, learned.step(Z)[0], atol=1e-3)


@pytest.mark.parametrize("bad", [np.zeros(3), np.zeros((2, 4)), np.zeros((1, 1, 2)), np.float64(1)])
def test_states_of_another_shape_are_refused(bad):
    with pytest.raises(ValueError, match=r"expected states of shape \(2,\) or \(B, 2\)"):
        pendulum_map().step(bad)


# The bad lane.

BAD_STATES = {
    "nan": (np.nan, 0.0),
    "inf": (0.0, np.inf),
    "huge": (1e300, -1e300),
    "outside": (5.0, 5.0),
}


@pytest.mark.parametrize("bad", BAD_STATES)
def test_a_bad_lane_has_its_own_status_and_changes_no_bit_of_the_others(bad):
    learned = pendulum_map()
    z = Z.copy()
    good = jax.tree.leaves(learned.step(z))
    z[5] = BAD_STATES[bad]
    images, info = learned.step(z)
    others = np.arange(16) != 5
    for one, other in zip(good, jax.tree.leaves((images, info)), strict=True):
        np.testing.assert_array_equal(np.asarray(one)[others], np.asarray(other)[others])
    assert (info.status[others] == OK).all()
    expected = {"nan": [NON_FINITE], "inf": [NON_FINITE], "outside": [LEFT_DOMAIN]}
    assert info.status[5] in expected.get(bad, [NOT_CONVERGED, NON_FINITE, LEFT_DOMAIN])
    assert (info.status[5] == NON_FINITE) or np.isfinite(images[5]).all()


def test_step_that_has_no_solution_is_not_converged():
    """Type 2 with S = q³ P²: beyond the fold no real P exists."""
    learned = make_map(lambda _, w: w[0] ** 3 * w[1] ** 2, None, TYPE2, 1.0, 10 * DATA)
    z = np.array([[0.1, 0.1], [3.0, -3.0], [0.2, -0.1]])  # P + 3 q² P² = p
    images, info = learned.step(z)
    np.testing.assert_array_equal(info.status, [OK, NOT_CONVERGED, OK])
    q, p = z[[0, 2]].T
    exact = (-1 + np.sqrt(1 + 12 * q**2 * p)) / (6 * q**2)
    np.testing.assert_allclose(images[[0, 2], 1], exact, rtol=1e-13)


# The defect.


def test_defect_is_roundoff_and_shows_an_unfinished_solve(monkeypatch):
    assert pendulum_map(MIDPOINT).defect(Z).max() < 1e-13

    def coarse(params, w):  # another function, so that nothing compiled before is used
        return pendulum(params, w)

    monkeypatch.setattr(maps, "_MOST_NEWTON", 1)
    unfinished = make_map(coarse, jnp.float64(4.0), MIDPOINT, 0.3, DATA)
    assert (unfinished.step(Z)[1].status == NOT_CONVERGED).any()
    assert unfinished.defect(Z).max() > 1e-5


def test_defect_is_in_units_of_the_scale():
    """The same map in units where q is a million times larger and p as much smaller."""
    units = np.array([1e6, 1e-6])

    def scalar(params, w):
        return pendulum(params, w / jnp.asarray(units)) + 0.1 * (w[0] / 1e6) ** 3 * w[1] * 1e6

    learned = make_map(scalar, jnp.float64(1.0), MIDPOINT, 0.3, DATA * units, scale=units)
    assert learned.defect(Z * units).max() < 1e-12


# Composition and coordinates.


def turn(dim, angle, seed=0):
    """exp(A), A a random Hamiltonian matrix of about this size."""
    symmetric = np.random.default_rng(seed).standard_normal((2 * dim, 2 * dim))
    symmetric = symmetric + symmetric.T
    return jnp.asarray(scipy.linalg.expm(angle * np.asarray(symplectic_form(dim)) @ symmetric / 2))


def test_affine_piece_and_its_inverse():
    piece = Affine(turn(2, 0.7), jnp.arange(4.0), jnp.asarray([0.5, 0.0, -1.0, 2.0]))
    assert symplecticity_defect(piece.matrix) < 1e-13
    z = jnp.asarray([1.0, -2.0, 3.0, 0.3])
    np.testing.assert_allclose(piece(piece.centre)[0], piece.centre + piece.shift, rtol=1e-14)
    np.testing.assert_allclose(piece.inverse()(piece(z)[0])[0], z, rtol=0, atol=1e-13)
    np.testing.assert_allclose(piece(piece.inverse()(z)[0])[0], z, rtol=0, atol=1e-13)


def test_base_map_around_a_generated_piece():
    base = Affine(turn(1, 0.9), jnp.asarray([0.1, -0.2]), jnp.asarray([0.05, 0.0]))
    learned = pendulum_map(before=(base,))
    plain = pendulum_map()
    images, info = learned.step(Z)
    halfway = jax.vmap(lambda z: base(z)[0])
    np.testing.assert_allclose(
        images, halfway(plain.step(halfway(jnp.asarray(Z)))[0]), rtol=0, atol=1e-14
    )
    assert (info.status == OK).all()
    assert info.iterations.min() >= 1  # the worst of the pieces', not the last one's
    assert learned.defect(Z).max() < 1e-12
    np.testing.assert_allclose(learned.inverse(images)[0], Z, rtol=0, atol=1e-13)
    # The chart's determinant is that of the generated piece, where that piece acts.
    np.testing.assert_allclose(
        learned.determinant(Z), plain.determinant(halfway(jnp.asarray(Z))), rtol=1e-12
    )


def test_polar_coordinates_are_inside_only():
    """Kepler: angular momentum is conserved to roundoff because φ does not enter S."""
    rng = np.random.default_rng(1)
    r, phi = rng.uniform(0.9, 1.1, 200), rng.uniform(-np.pi, np.pi, 200)
    inner = np.stack([r, phi, rng.uniform(-0.1, 0.1, 200), rng.uniform(0.9, 1.1, 200)], axis=1)
    around = polar(cyclic=True)
    learned = make_map(kepler_polar, jnp.float64(1.0), TYPE2, 0.05, inner, coordinates=around)
    z = np.asarray(jax.vmap(around.inverse)(jnp.asarray(inner)))[:16]
    images, info = learned.step(z)
    assert (info.status == OK).all()
    momentum = np.asarray(z[:, 0] * z[:, 3] - z[:, 1] * z[:, 2])
    np.testing.assert_allclose(
        images[:, 0] * images[:, 3] - images[:, 1] * images[:, 2], momentum, rtol=0, atol=1e-15
    )
    assert learned.defect(z).max() < 1e-13
    np.testing.assert_allclose(learned.inverse(images)[0], z, rtol=0, atol=1e-14)
    # First order in dt against the flow: dq = p dt.
    np.testing.assert_allclose(images[:, :2] - z[:, :2], 0.05 * z[:, 2:], atol=0.05**2)


def test_angles_keep_their_turns_and_the_map_does_not_see_them():
    learned = pendulum_map(coordinates=PENDULUM)
    turns = np.array([0, 1, -3, 1000])[:, None] * [[2 * np.pi, 0.0]]
    images, info = learned.step(Z[:4] + turns)
    plain, _ = learned.step(Z[:4])
    # n times float64's 2π is not n turns: 2.4e-16 n are missing.
    np.testing.assert_allclose(images[:3], (plain + turns)[:3], rtol=1e-15, atol=2e-15)
    np.testing.assert_allclose(images[3], (plain + turns)[3], rtol=1e-15, atol=3e-13)
    assert (info.status == OK).all()
    back, _ = learned.inverse(images)
    np.testing.assert_allclose(back, Z[:4] + turns, rtol=0, atol=1e-12)


@pytest.mark.parametrize("angle", [1e17, 1e300])
def test_angle_without_a_meaning_is_not_a_state(angle):
    """The domain ignores an angle, so that nothing but its own size can tell."""
    _, info = pendulum_map(coordinates=PENDULUM).step(np.array([[angle, 0.1], [0.1, 0.1]]))
    np.testing.assert_array_equal(info.status, [NON_FINITE, OK])


# A user's own transforms.


def test_map_passes_through_jit_vmap_and_grad():
    learned = pendulum_map()
    z = jnp.asarray(Z)
    expected = learned.step(Z)[0]
    np.testing.assert_array_equal(jax.jit(jax.vmap(learned.apply))(z)[0], expected)
    as_argument = jax.jit(lambda map_, z: map_.step(z)[0])
    np.testing.assert_array_equal(as_argument(learned, z), expected)
    assert jax.jit(learned.apply)(z[0])[1].status == OK

    def energy_after(z, strength):
        piece = dataclasses.replace(learned.pieces[0], params=strength)
        return pendulum(1.0, dataclasses.replace(learned, pieces=(piece,)).apply(z)[0])

    gradient = jax.jit(jax.grad(energy_after, argnums=(0, 1)))(z[0], jnp.float64(1.0))
    step = 1e-6
    difference = energy_after(z[0], 1.0 + step) - energy_after(z[0], 1.0 - step)
    np.testing.assert_allclose(gradient[1], difference / (2 * step), rtol=1e-7)
    by_map = jax.grad(lambda m: pendulum(1.0, m.apply(z[0])[0]))(learned)
    np.testing.assert_allclose(by_map.pieces[0].params, gradient[1], rtol=1e-12)
    scale = by_map.pieces[0].scale
    np.testing.assert_array_equal(scale, jnp.zeros_like(scale))  # no influence on the solution


def test_second_call_compiles_nothing():
    traces = []

    def counted(params, w):
        traces.append(1)
        return pendulum(params, w)

    first = make_map(counted, jnp.float64(1.0), MIDPOINT, 0.3, DATA)
    first.step(Z)
    first.rollout(Z, 4)
    count = len(traces)
    second = make_map(counted, jnp.float64(2.0), MIDPOINT, 0.3, 2 * DATA)
    for map_ in (first, second):
        map_.step(Z + 0.1)
        map_.rollout(Z + 0.1, 4)
    assert len(traces) == count
    assert np.abs(first.step(Z)[0] - second.step(Z)[0]).max() > 1e-3


def single(learned):
    return jax.tree.map(lambda a: a.astype(jnp.float32), learned)


def test_float32_map_keeps_its_dtype():
    around = pendulum_map(coordinates=PENDULUM)
    learned = single(around)
    images, info = learned.step(Z)
    assert images.dtype == info.residual.dtype == learned.defect(Z).dtype == jnp.float32
    assert (info.status == OK).all()
    np.testing.assert_allclose(images, around.step(Z)[0], rtol=0, atol=1e-6)
    assert learned.defect(Z).max() < 1e-5
    assert learned.determinant(Z).dtype == jnp.float32
    states, _ = learned.rollout(Z, 3)
    assert states.dtype == jnp.float32


def test_float64_map_refuses_to_run_in_float32():
    learned = pendulum_map()
    with jax.enable_x64(False), pytest.raises(RuntimeError, match="float64"):
        learned.step(Z)
