"""The symplectic map: composition, inverse, defect, angles, lanes apart, users' transforms."""

import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
from analytic import folding, generated, map_of, pendulum

from gfnn_jax.coordinates import Coordinates, polar, to_user
from gfnn_jax.families import from_function
from gfnn_jax.generating import generated as generated_module
from gfnn_jax.generating.charts import MIDPOINT, TYPE2
from gfnn_jax.maps.piece import Affine
from gfnn_jax.phase_space import symplectic_form, symplecticity_defect
from gfnn_jax.solve.status import LEFT_DOMAIN, NON_FINITE, NOT_CONVERGED, OK

DATA = np.random.default_rng(0).uniform(-1, 1, (400, 2))
Z = DATA[:16]
PENDULUM = map_of(generated(pendulum, 1.0, MIDPOINT, 0.3), DATA)
ROTATING = map_of(
    generated(pendulum, 1.0, MIDPOINT, 0.3), DATA, coordinates=Coordinates("pendulum", angles=(0,))
)


@pytest.mark.slow
def test_one_state_and_a_batch_take_the_same_step():
    images, info = PENDULUM.step(Z)
    assert images.shape == (16, 2)
    assert info.status.shape == (16,)
    assert (info.status == OK).all()
    one, alone = PENDULUM.step(Z[3])
    assert one.shape == (2,)
    assert alone.status.shape == alone.residual.shape == ()
    np.testing.assert_allclose(one, images[3], rtol=1e-15)
    np.testing.assert_allclose(PENDULUM.inverse(images)[0], Z, rtol=0, atol=1e-14)
    np.testing.assert_array_equal(PENDULUM.reversed().step(images)[0], PENDULUM.inverse(images)[0])
    assert PENDULUM.defect(Z[3]).shape == ()
    assert PENDULUM.dim == 1


def test_one_map_after_another_is_a_map():
    other = with_numbers(PENDULUM, 2.0, 0.1)
    both = PENDULUM.then(other)
    first, _ = PENDULUM.step(Z)
    np.testing.assert_allclose(both.step(Z)[0], other.step(first)[0], rtol=0, atol=1e-15)
    assert float(both.dt) == pytest.approx(0.4)
    np.testing.assert_allclose(both.inverse(both.step(Z)[0])[0], Z, rtol=0, atol=1e-14)
    with pytest.raises(ValueError, match="the same coordinates"):
        PENDULUM.then(ROTATING)


def with_numbers(map_, strength, dt):
    """A map of the same kind, with another S and another time step."""
    (piece,) = map_.pieces
    other = dataclasses.replace(piece, dt=np.float64(dt), params=np.float64(strength))
    return dataclasses.replace(map_, pieces=(other,), dt=np.float64(dt))


def test_other_numbers_compile_nothing(compilations):
    first = PENDULUM.step(Z)[0]
    PENDULUM.rollout(Z, 4)
    other = with_numbers(PENDULUM, 2.0, 0.1)
    with compilations() as found:
        images, _ = other.step(Z + 0.1)
        other.rollout(Z + 0.1, 4)
    assert found.count == 0
    assert not np.allclose(images, first, atol=1e-3)


# The bad lane.

BAD_STATES = {
    "nan": (np.nan, 0.0),
    "inf": (0.0, np.inf),
    "huge": (1e300, -1e300),
    "outside": (5.0, 5.0),
}


@pytest.mark.parametrize("bad", BAD_STATES)
def test_a_bad_lane_has_its_own_status_and_changes_no_bit_of_the_others(bad):
    z = Z.copy()
    good = jax.tree.leaves(PENDULUM.step(z))
    z[5] = BAD_STATES[bad]
    images, info = PENDULUM.step(z)
    others = np.arange(16) != 5
    for one, other in zip(good, jax.tree.leaves((images, info)), strict=True):
        np.testing.assert_array_equal(np.asarray(one)[others], np.asarray(other)[others])
    assert (np.asarray(info.status)[others] == OK).all()
    expected = {"nan": [NON_FINITE], "inf": [NON_FINITE], "outside": [LEFT_DOMAIN]}
    assert info.status[5] in expected.get(bad, [NOT_CONVERGED, NON_FINITE, LEFT_DOMAIN])
    assert (info.status[5] == NON_FINITE) or np.isfinite(images[5]).all()


def test_step_that_has_no_solution_is_not_converged():
    """Type 2 with S = q³ P²: beyond the fold no real P exists."""
    learned = map_of(generated(folding, 1.0, TYPE2, 1.0), 10 * DATA)
    z = np.array([[0.1, 0.1], [3.0, -3.0], [0.2, -0.1]])  # P + 3 q² P² = p
    images, info = learned.step(z)
    np.testing.assert_array_equal(info.status, [OK, NOT_CONVERGED, OK])
    q, p = z[[0, 2]].T
    exact = (-1 + np.sqrt(1 + 12 * q**2 * p)) / (6 * q**2)
    np.testing.assert_allclose(np.asarray(images)[[0, 2], 1], exact, rtol=1e-13)


# The defect.


@from_function
def steep(strength, w):
    return pendulum(strength, w)


@pytest.mark.slow
def test_defect_is_roundoff_and_shows_an_unfinished_solve(monkeypatch):
    assert PENDULUM.defect(Z).max() < 1e-13
    # Another function than that of other tests, so that nothing compiled before is used.
    monkeypatch.setattr(generated_module, "MOST_UPDATES", 1)
    unfinished = map_of(generated(steep, 4.0, MIDPOINT, 0.3), DATA)
    assert (unfinished.step(Z)[1].status == NOT_CONVERGED).any()
    assert unfinished.defect(Z).max() > 1e-5


@from_function
def in_units(units, w):
    x = w / units
    return pendulum(1.0, x) + 0.1 * x[0] ** 3 * x[1]


@pytest.mark.slow
def test_defect_is_in_units_of_the_scale():
    """Compare the map with itself in units where q is 10⁶ times larger and p as much smaller."""
    units = np.array([1e6, 1e-6])
    piece = generated(in_units, units, MIDPOINT, 0.3)
    assert map_of(piece, DATA * units, scale=units).defect(Z * units).max() < 1e-12


# Composition and coordinates.


def turn(dim, angle, seed=0):
    """exp(A), A a random Hamiltonian matrix of about this size."""
    symmetric = np.random.default_rng(seed).standard_normal((2 * dim, 2 * dim))
    return scipy.linalg.expm(angle * symplectic_form(dim) @ (symmetric + symmetric.T) / 2)


def test_affine_piece_and_its_inverse():
    piece = Affine(turn(2, 0.7), np.arange(4.0), np.array([0.5, 0.0, -1.0, 2.0]))
    assert symplecticity_defect(piece.matrix) < 1e-13
    z = np.random.default_rng(1).standard_normal((5, 4))
    np.testing.assert_allclose(piece.image(piece.centre), piece.centre + piece.shift, rtol=1e-14)
    np.testing.assert_allclose(piece.inverse().image(piece.image(z)), z, rtol=0, atol=1e-13)
    image, info = jax.jit(lambda piece, z: piece.step(z))(piece, z)
    np.testing.assert_allclose(image, piece.image(z), rtol=0, atol=1e-13)
    assert (info.status == OK).all()


@pytest.mark.slow
def test_base_map_around_a_generated_piece():
    base = Affine(turn(1, 0.9), np.array([0.1, -0.2]), np.array([0.05, 0.0]))
    learned = map_of(PENDULUM.pieces[0], DATA, around=(base,))
    images, info = learned.step(Z)
    inner, expected = base.image(Z), PENDULUM.step(base.image(Z))
    np.testing.assert_allclose(images, base.image(np.asarray(expected[0])), rtol=0, atol=1e-14)
    assert (info.status == OK).all()
    assert learned.multiplier() == 1.0
    np.testing.assert_array_equal(info.iterations, expected[1].iterations)  # the worst piece's
    assert learned.defect(Z).max() < 1e-12
    np.testing.assert_allclose(learned.inverse(images)[0], Z, rtol=0, atol=1e-13)
    # The chart's determinant is that of the generated piece, where that piece acts.
    np.testing.assert_allclose(learned.determinant(Z), PENDULUM.determinant(inner), rtol=1e-12)


@partial(
    jax.tree_util.register_dataclass,
    data_fields=("matrix", "centre", "shift"),
    meta_fields=("known",),
)
@dataclasses.dataclass(frozen=True, eq=False)
class Scaling(Affine):
    """As an affine map whose matrix need not be symplectic, and a multiplier that it claims."""

    known: float | None = 1.0

    def multiplier(self, args=None):
        return self.known


@pytest.mark.slow
def test_the_defect_is_that_of_the_multiplier():
    """q and 0.9 p: of the form it keeps 0.9 times; twice, 0.81 times; of no known multiple, NaN."""

    def scaled(known):
        return Scaling(np.diag([1.0, 0.9]), np.zeros(2), np.zeros(2), known)

    def around(*pieces):
        return dataclasses.replace(PENDULUM, pieces=(*pieces, *PENDULUM.pieces))

    assert around(scaled(0.9)).multiplier() == 0.9
    twice = around(scaled(0.9), scaled(0.9))
    assert twice.multiplier() == 0.9 * 0.9
    assert twice.defect(Z).max() < 1e-14
    np.testing.assert_allclose(around(scaled(0.8)).defect(Z), 0.1, rtol=1e-12)
    assert around(scaled(None)).multiplier() is None
    assert np.isnan(around(scaled(None)).defect(Z)).all()


@from_function
def kepler_polar(strength, w):
    """H in polar coordinates, type 2: (r, φ, P_r, P_φ)."""
    r, _, p_r, p_phi = w
    return 0.5 * (p_r**2 + (p_phi / r) ** 2) - strength / r


@pytest.mark.slow
def test_polar_coordinates_are_inside_only():
    """Kepler: angular momentum is conserved to roundoff because φ does not enter S."""
    rng = np.random.default_rng(1)
    r, phi = rng.uniform(0.9, 1.1, 200), rng.uniform(-np.pi, np.pi, 200)
    inner = np.stack([r, phi, rng.uniform(-0.1, 0.1, 200), rng.uniform(0.9, 1.1, 200)], axis=1)
    around = polar(cyclic=True)
    learned = map_of(generated(kepler_polar, 1.0, TYPE2, 0.05, 2), inner, coordinates=around)
    z = to_user(around, inner)[:16]
    images, info = learned.step(z)
    images = np.asarray(images)
    assert (info.status == OK).all()
    before, after = (x[:, 0] * x[:, 3] - x[:, 1] * x[:, 2] for x in (z, images))
    np.testing.assert_allclose(after, before, rtol=0, atol=1e-15)
    assert learned.defect(z).max() < 1e-13
    np.testing.assert_allclose(learned.inverse(images)[0], z, rtol=0, atol=1e-14)
    # First order in dt against the flow: dq = p dt.
    np.testing.assert_allclose(images[:, :2] - z[:, :2], 0.05 * z[:, 2:], atol=0.05**2)


def test_angles_keep_their_turns_and_the_map_does_not_see_them():
    turns = np.resize([0, 1, -3, 1000], 16)[:, None] * [[2 * np.pi, 0.0]]
    images, info = ROTATING.step(Z + turns)
    images = np.asarray(images)
    expected = np.asarray(ROTATING.step(Z)[0]) + turns
    # n times float64's 2π is not n turns: 2.4e-16 n are missing.
    far = turns[:, 0] > 100
    np.testing.assert_allclose(images[~far], expected[~far], rtol=1e-15, atol=2e-15)
    np.testing.assert_allclose(images[far], expected[far], rtol=1e-15, atol=3e-13)
    assert (info.status == OK).all()
    back, _ = ROTATING.inverse(images)
    np.testing.assert_allclose(back, Z + turns, rtol=0, atol=1e-12)


@pytest.mark.parametrize("angle", [1e17, 1e300])
def test_angle_without_a_meaning_is_not_a_state(angle):
    """The domain ignores an angle, so that nothing but its own size can tell."""
    z = Z.copy()
    z[0, 0] = angle
    _, info = ROTATING.step(z)
    np.testing.assert_array_equal(info.status, [NON_FINITE, *[OK] * 15])


# A user's own transforms.


def test_map_passes_through_jit_and_vmap():
    expected = np.asarray(PENDULUM.step(Z)[0])
    one_by_one = jax.jit(jax.vmap(lambda z: PENDULUM.step(z)))(Z)
    np.testing.assert_allclose(one_by_one[0], expected, rtol=0, atol=1e-15)
    assert (one_by_one[1].status == OK).all()
    as_argument = jax.jit(lambda map_, z: map_.step(z)[0])
    np.testing.assert_array_equal(as_argument(PENDULUM, Z), expected)


@pytest.mark.slow
def test_gradients_in_the_state_the_parameters_and_the_map():
    def energy_after(map_, z):
        return pendulum(1.0, map_.step(z)[0])

    with_slopes = jax.jit(jax.value_and_grad(energy_after, argnums=(0, 1)))
    z, step = Z[0], 1e-6
    _, (by_map, by_state) = with_slopes(PENDULUM, z)
    above, below = (with_slopes(with_numbers(PENDULUM, 1 + h, 0.3), z)[0] for h in (step, -step))
    slope = by_map.pieces[0].params
    np.testing.assert_allclose(slope, (above - below) / (2 * step), rtol=1e-7)
    np.testing.assert_array_equal(by_map.pieces[0].scale, 0.0)  # no influence on the solution
    for i, move in enumerate(step * np.eye(2)):
        above, below = (with_slopes(PENDULUM, z + sign * move)[0] for sign in (1, -1))
        np.testing.assert_allclose(by_state[i], (above - below) / (2 * step), rtol=1e-6)
    forward = jax.jit(jax.jacfwd(energy_after, argnums=1))(PENDULUM, z)
    np.testing.assert_allclose(forward, by_state, rtol=1e-12)


@pytest.mark.slow
def test_float32_map_keeps_its_dtype():
    learned = jax.tree.map(lambda a: np.asarray(a, np.float32), ROTATING)
    images, info = learned.step(Z)
    assert images.dtype == info.residual.dtype == learned.defect(Z).dtype == jnp.float32
    assert (info.status == OK).all()
    np.testing.assert_allclose(images, ROTATING.step(Z)[0], rtol=0, atol=1e-6)
    assert learned.defect(Z).max() < 1e-5
    assert learned.determinant(Z).dtype == jnp.float32
    assert learned.rollout(Z, 3)[0].dtype == jnp.float32
