"""Charts: every one symplectic, invertible and differentiable at random weights; exact oracles."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate
import scipy.optimize
from analytic import generated, rotated
from jax.flatten_util import ravel_pytree

from gfnn_jax.families import from_function
from gfnn_jax.families.inputs import box_inputs
from gfnn_jax.families.products import Products
from gfnn_jax.generating.charts import CHARTS, MIDPOINT, TYPE1, TYPE2, TYPE3, Chart
from gfnn_jax.generating.generated import Generated
from gfnn_jax.phase_space import symplecticity_defect

SKEW = Chart("skew 0.3", 0.3)
NAMED = {"ids": lambda chart: chart.name}
EVERY = pytest.mark.parametrize("chart", [*CHARTS.values(), SKEW], **NAMED)
# A step of each chart takes seconds to compile: quick tests look at these two.
COMPILED = pytest.mark.parametrize(
    "chart",
    [TYPE2, MIDPOINT, *(pytest.param(c, marks=pytest.mark.slow) for c in (TYPE1, TYPE3, SKEW))],
    **NAMED,
)
DT, BATCH = 0.3, 16


@from_function
def network(params, w):
    """A network; for type 1 about free motion, whose type-1 function is |Q − q|²/2h."""
    inner, bias, outer, free = params
    q, q1 = jnp.split(w, 2)
    return outer @ jnp.tanh(inner @ w + bias) + free * 0.5 * jnp.sum((q1 - q) ** 2)


def random_params(chart, dim=1, width=12):
    rng = np.random.default_rng(0)
    shapes = (width, 2 * dim), (width,), (width,)
    inner, bias, outer = (rng.standard_normal(shape) for shape in shapes)
    return inner, bias, outer / np.sqrt(width), np.float64(chart is TYPE1) / DT**2


def random_piece(params, chart):
    return Generated(network, params, chart, DT, np.ones(params[0].shape[1]))


STATES = 0.7 * np.random.default_rng(1).standard_normal((BATCH, 4))


def states_of(chart):
    """States with d = 2 for types 1 and 2, where two entries of w are free, else with d = 1."""
    return STATES if chart in (TYPE1, TYPE2) else STATES[:, :2]


@functools.partial(jax.jit, static_argnums=0)
def all_about(chart, params, z):
    piece = random_piece(params, chart)

    def step(z):
        w, gradient, info = piece.solve(z, unrolled=True)
        image = chart.image(z, w, gradient, DT)
        return image, {"w": w, "gradient": gradient, "status": info.status, "image": image}

    def along(unit):
        return jax.jvp(step, (z,), (jnp.broadcast_to(unit, z.shape),), has_aux=True)[1:]

    jacobian, found = jax.vmap(along, out_axes=(-1, None))(jnp.eye(z.shape[1]))
    determinant = piece.determinant(z, found["image"])
    return {"jacobian": jacobian, "determinant": determinant, **found}


@functools.cache
def facts(chart):
    """Everything about one step at random weights, in one compilation."""
    z = states_of(chart)
    return jax.tree.map(np.asarray, all_about(chart, random_params(chart, z.shape[1] // 2), z))


@COMPILED
def test_unrolled_step_is_symplectic_at_random_weights(chart):
    found, z = facts(chart), states_of(chart)
    assert (found["status"] == 0).all()
    assert np.abs(found["image"] - z).max() > 0.1  # it is not the identity
    assert symplecticity_defect(found["jacobian"]).max() < 1e-12
    expected = chart.determinant(found["jacobian"])
    np.testing.assert_allclose(found["determinant"], expected, rtol=1e-10)


@COMPILED
def test_pair_asks_for_its_own_gradient_from_either_side(chart):
    image, w, gradient = (facts(chart)[name] for name in ("image", "w", "gradient"))
    z = states_of(chart)
    back, dt = chart.reverse(DT)
    for one, step, pair in ((chart, DT, (z, image)), (back, dt, (image, z))):
        np.testing.assert_allclose(one.evaluation_point(*pair), w, atol=1e-14)
        np.testing.assert_allclose(one.target_gradient(*pair, step), gradient, rtol=0, atol=1e-13)


@pytest.mark.slow
@COMPILED
def test_inverse_after_step_is_the_identity(chart):
    z = states_of(chart)
    piece = random_piece(random_params(chart, z.shape[1] // 2), chart)
    back, _ = jax.jit(piece.inverse().step)(facts(chart)["image"])
    np.testing.assert_allclose(back, z, rtol=0, atol=1e-12)


@EVERY
def test_jacobian_of_the_residual_and_determinant_are_those_of_the_formulas(chart):
    """Compare with finite differences, in NumPy, for two degrees of freedom."""
    family = Products(box_inputs(STATES), 3)
    c = np.random.default_rng(8).standard_normal(family.num_parameters)
    params, free = family.unflatten(c), chart.free(2)
    z, w = STATES[:3], STATES[3:6]
    w = chart.complete(chart.first_guess(z), w[:, free])

    def residual(w):
        return chart.residual(z, w, family.gradient(params, w), DT)

    moves = 1e-6 * np.eye(4)[free]
    columns = [(residual(w + move) - residual(w - move)) / 2e-6 for move in moves]
    _, hessian = family.gradient_and_hessian(params, w)
    found = chart.residual_jacobian(hessian, DT)
    np.testing.assert_allclose(found, np.stack(columns, axis=-1), rtol=0, atol=1e-6)
    product = chart.determinant_of(hessian, DT) * np.linalg.det(found)
    np.testing.assert_allclose(np.abs(product), 1.0, rtol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("chart", [TYPE1, MIDPOINT], **NAMED)
def test_derivatives_of_step_and_rollout_in_state_and_parameters(chart):
    """Forward = reverse = through the iterations = finite difference, along a random direction."""
    flat, unravel = ravel_pytree((random_params(chart), STATES[0, :2]))
    direction, weights = np.random.default_rng(2).standard_normal(flat.size), np.array([1, 0.7, -2])

    def rollout(theta, *, unrolled=False):
        """A number after each of three steps."""
        params, start = unravel(theta)
        piece = random_piece(params, chart)

        def step(z, _):
            image = piece.step(z, unrolled=unrolled)[0]
            return image, image[0, 0] - 2 * image[0, 1]

        return jax.lax.scan(step, start[None], None, length=3)[1]

    @jax.jit
    def derivatives(theta):
        value, along = jax.linearize(rollout, theta)
        through = jax.jvp(functools.partial(rollout, unrolled=True), (theta,), (direction,))[1]
        (backward,) = jax.linear_transpose(along, theta)(weights)
        return value, along(direction), through, backward @ direction

    _, forward, through, backward = derivatives(flat)
    step = 1e-5
    above, below = (derivatives(flat + sign * step * direction)[0] for sign in (1, -1))
    assert np.abs(forward).min() > 0.05
    np.testing.assert_allclose(through, forward, rtol=1e-10)
    np.testing.assert_allclose(backward, weights @ forward, rtol=1e-10)
    np.testing.assert_allclose((above - below) / (2 * step), forward, rtol=1e-6)


# Oracles: S := H.


@from_function
def separable(strength, w):
    q, p = w
    return 0.5 * p**2 - strength * jnp.cos(q)


@from_function
def henon_heiles(_, w):
    x, y, px, py = w
    return 0.5 * (px**2 + py**2 + x**2 + y**2) + x**2 * y - y**3 / 3


def henon_heiles_field(z):
    x, y, px, py = z
    return np.array([px, py, -x - 2 * x * y, -y - x**2 + y**2])


@jax.jit
def stepped(piece, z):
    return piece.step(z)


def images(piece, z):
    out, info = stepped(piece, z)
    assert (info.status == 0).all()
    return np.asarray(out)


@pytest.mark.slow
def test_midpoint_chart_of_the_hamiltonian_is_the_implicit_midpoint_rule():
    z = 0.3 * np.random.default_rng(3).standard_normal((5, 4))
    found = images(generated(henon_heiles, None, MIDPOINT, 0.5, 2), z)
    for start, image in zip(z, found, strict=True):

        def rule(end, start=start):
            return end - start - 0.5 * henon_heiles_field(0.5 * (start + end))

        expected = scipy.optimize.fsolve(rule, start, xtol=1e-13)
        np.testing.assert_allclose(image, expected, rtol=0, atol=1e-14)


@pytest.mark.slow
def test_types_2_and_3_of_a_separable_hamiltonian_are_symplectic_euler():
    q, p = z = np.random.default_rng(4).uniform(-2, 2, (2, 50))
    second = images(generated(separable, 1.0, TYPE2, 0.4), z.T)
    kicked = p - 0.4 * np.sin(q)
    np.testing.assert_allclose(second, np.stack([q + 0.4 * kicked, kicked], 1), atol=1e-15)
    third = images(generated(separable, 1.0, TYPE3, 0.4), z.T)
    moved = q + 0.4 * p
    np.testing.assert_allclose(third, np.stack([moved, p - 0.4 * np.sin(moved)], 1), atol=1e-15)


@from_function
def exact_type_2(time, w):
    """Exact S of the oscillator in type 2 at h = 1, without q P, which the chart has."""
    q, p = w
    return q * p * (1 / jnp.cos(time) - 1) + 0.5 * (q**2 + p**2) * jnp.tan(time)


@from_function
def exact_type_1(time, w):
    q, q1 = w
    return ((q**2 + q1**2) * jnp.cos(time) - 2 * q * q1) / (2 * jnp.sin(time))


@jax.jit
def there_and_back(piece, z):
    image = piece.step(z)[0]
    return image, piece.inverse().step(z)[0], piece.determinant(z, image)


@pytest.mark.parametrize(
    ("chart", "family", "times", "expected"),
    [
        (TYPE2, exact_type_2, (0.1, 0.8, 1.3, 2.6), np.cos),  # ∂P/∂p
        pytest.param(  # ∂Q/∂p
            *(TYPE1, exact_type_1, (0.3, np.pi / 2, 2.5), np.sin), marks=pytest.mark.slow
        ),
    ],
    ids=["type 2", "type 1"],
)
def test_exact_functions_of_the_oscillator(chart, family, times, expected):
    """Compare S with the exact one, also far beyond the fold at a quarter turn."""
    z = np.random.default_rng(6).standard_normal((20, 2))
    for time in times:
        image, back, determinant = there_and_back(generated(family, time, chart, 1.0), z)
        np.testing.assert_allclose(image, rotated(z, time), rtol=0, atol=1e-14)
        np.testing.assert_allclose(back, rotated(z, -time), rtol=0, atol=1e-14)
        np.testing.assert_allclose(determinant, expected(time), rtol=1e-12)


@EVERY
def test_linear_map_is_generated_from_three_pairs(chart):
    turn = np.array([[np.cos(0.4), np.sin(0.4)], [-np.sin(0.4), np.cos(0.4)]])
    offset = np.array([0.2, -0.1])
    z0 = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
    z1 = z0 @ turn.T + offset
    points, target = chart.evaluation_point(z0, z1), chart.target_gradient(z0, z1, 0.4)
    family = Products(box_inputs(points), 2)  # ∇S is affine in w
    terms = family.term_gradients(points).reshape(6, -1)
    params = family.unflatten(np.linalg.lstsq(terms, target.ravel(), rcond=None)[0])
    piece = Generated(family, params, chart, 0.4, np.ones(2))
    z = np.array([[0.3, -0.8]])
    image = z @ turn.T + offset
    w = chart.evaluation_point(z, image)
    np.testing.assert_allclose(piece.refined_step(z, w + 0.1)[0], image, atol=1e-14)
    np.testing.assert_allclose(piece.inverse().refined_step(image, w + 0.1)[0], z, atol=1e-14)
    expected = chart.determinant(turn)
    np.testing.assert_allclose(piece.determinant(z, image), [expected], rtol=1e-12)
    batch = chart.determinant(np.stack([turn, np.eye(2)]))
    np.testing.assert_allclose(batch, [expected, 0.0 if chart is TYPE1 else 1.0], rtol=1e-12)


# In NumPy, for fits.


def test_refined_step_is_the_step_without_compilation(compilations):
    z = STATES[:, :2]
    family = Products(box_inputs(z), 3)
    c = 0.05 * np.random.default_rng(7).standard_normal(family.num_parameters)
    piece = Generated(family, family.unflatten(c), MIDPOINT, DT, np.ones(2))
    expected = images(piece, z)
    guess = MIDPOINT.evaluation_point(z, expected) + 1e-4
    guess[3] = np.nan
    with compilations() as found:
        image, error = piece.refined_step(z, guess)
    assert found.count == 0
    assert isinstance(image, np.ndarray)
    others = np.arange(BATCH) != 3
    np.testing.assert_allclose(image[others], expected[others], rtol=0, atol=1e-14)
    assert (error[others] < 1e-14).all()
    assert not np.isfinite(error[3])
