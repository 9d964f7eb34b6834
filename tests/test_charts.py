"""Charts: every one symplectic, invertible and differentiable at random weights; exact oracles."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate
import scipy.optimize
from jax.flatten_util import ravel_pytree

from gfnn_jax.generating.charts import CHARTS, MIDPOINT, TYPE1, TYPE2, TYPE3, Chart
from gfnn_jax.maps.symplectic_map import Generated
from gfnn_jax.phase_space import symplecticity_defect

SKEW = Chart("skew 0.3", 0.3)
EVERY = pytest.mark.parametrize("chart", [*CHARTS.values(), SKEW], ids=lambda chart: chart.name)
NEAR_IDENTITY = pytest.mark.parametrize("chart", [TYPE2, TYPE3, MIDPOINT, SKEW], ids=str)
DT, DIM, BATCH = 0.3, 2, 16


def network(params, w):
    inner, bias, outer = params
    return outer @ jnp.tanh(inner @ w + bias)


def network_type1(params, w):
    """The network about free motion, whose type-1 function is |Q − q|²/2h."""
    q, q1 = jnp.split(w, 2)
    return 0.5 * jnp.sum((q1 - q) ** 2) / DT**2 + network(params, w)


def random_params(dim=DIM, width=12):
    rng = np.random.default_rng(0)
    shapes = (width, 2 * dim), (width,), (width,)
    inner, bias, outer = (jnp.asarray(rng.standard_normal(shape)) for shape in shapes)
    return inner, bias, outer / np.sqrt(width)


def generated(scalar, params, chart, dt, dim):
    """A map that starts its solve at the state itself."""
    size = 2 * dim
    return Generated(scalar, params, chart, dt, jnp.ones(size))


def random_piece(params, chart):
    return generated(
        network_type1 if chart is TYPE1 else network, params, chart, DT, params[0].shape[1] // 2
    )


STATES = jnp.asarray(0.7 * np.random.default_rng(1).standard_normal((BATCH, 2 * DIM)))


@functools.cache
def facts(chart):
    """Everything about one step at random weights, in one compilation."""

    def lane(z):
        piece = random_piece(random_params(), chart)
        w, gradient, info = piece.solve(z)
        image = chart.image(z, w, gradient, DT)
        return {
            "image": image,
            "status": info.status,
            "residual": info.residual,
            "back": piece.inverse()(image)[0],
            "executed": jax.jacfwd(lambda x: piece(x, executed=True)[0])(z),
            "implicit": jax.jacrev(lambda x: piece(x)[0])(z),
            "w": w,
            "gradient": gradient,
        }

    return jax.tree.map(np.asarray, jax.jit(jax.vmap(lane))(STATES))


@EVERY
def test_executed_step_is_symplectic_at_random_weights(chart):
    found = facts(chart)
    assert (found["status"] == 0).all()
    assert found["residual"].max() < 4e-15
    assert np.abs(found["image"] - STATES).max() > 0.1  # it is not the identity
    assert symplecticity_defect(jnp.asarray(found["executed"])).max() < 1e-12


@EVERY
def test_inverse_after_step_is_the_identity(chart):
    np.testing.assert_allclose(facts(chart)["back"], STATES, rtol=0, atol=1e-12)


@EVERY
def test_implicit_jacobian_is_that_of_the_iterations(chart):
    found = facts(chart)
    np.testing.assert_allclose(found["implicit"], found["executed"], rtol=0, atol=1e-11)


@EVERY
def test_pair_of_the_map_asks_for_its_own_gradient(chart):
    found = facts(chart)
    np.testing.assert_allclose(chart.point(STATES, found["image"]), found["w"], atol=1e-14)
    np.testing.assert_allclose(
        chart.wanted(STATES, found["image"], DT), found["gradient"], rtol=0, atol=1e-13
    )


@EVERY
def test_pair_read_from_the_inverse_asks_for_the_same_gradient(chart):
    found = facts(chart)
    back, dt = chart.reverse(DT)
    np.testing.assert_allclose(back.point(found["image"], STATES), found["w"], atol=1e-14)
    np.testing.assert_allclose(
        back.wanted(found["image"], STATES, dt), found["gradient"], rtol=0, atol=1e-13
    )


@EVERY
def test_derivatives_of_step_and_rollout_in_state_and_parameters(chart):
    """Forward = reverse = through the iterations = finite difference, along a random direction."""
    flat, unravel = ravel_pytree((random_params(dim=1), STATES[0, :2]))
    direction = jnp.asarray(np.random.default_rng(2).standard_normal(flat.size))
    weights = jnp.asarray([1.0, -2.0])

    def rollout(theta, *, executed=False):
        """A number after each of three steps."""
        params, start = unravel(theta)
        piece = random_piece(params, chart)

        def step(z, _):
            image = piece(z, executed=executed)[0]
            return image, weights @ image

        return jax.lax.scan(step, start, None, length=3)[1]

    @jax.jit
    def derivatives(theta):
        forward = jax.jvp(rollout, (theta,), (direction,))[1]
        through = jax.jvp(functools.partial(rollout, executed=True), (theta,), (direction,))[1]
        return forward, through, jax.jacrev(rollout)(theta) @ direction

    forward, through, backward = derivatives(flat)
    step, compiled = 1e-5, jax.jit(rollout)
    difference = compiled(flat + step * direction) - compiled(flat - step * direction)
    assert np.abs(forward).min() > 0.1
    np.testing.assert_allclose(through, forward, rtol=1e-11)
    np.testing.assert_allclose(backward, forward, rtol=1e-11)
    np.testing.assert_allclose(difference / (2 * step), forward, rtol=1e-7)


def test_second_derivative_through_the_step():
    piece = random_piece(random_params(dim=1), MIDPOINT)

    def position(z):
        return piece(z)[0][0]

    z, step = STATES[0, :2], 1e-5
    hessian = jax.jit(jax.hessian(position))(z)
    gradient = jax.jit(jax.vmap(jax.grad(position)))
    ends = gradient(z[None] + step * jnp.concatenate([jnp.eye(2), -jnp.eye(2)]))
    np.testing.assert_allclose(hessian, (ends[:2] - ends[2:]) / (2 * step), rtol=0, atol=1e-8)
    np.testing.assert_allclose(hessian, hessian.T, rtol=0, atol=1e-12)


@NEAR_IDENTITY
def test_reverse_is_minus_skew_and_minus_dt(chart):
    back, dt = chart.reverse(DT)
    assert (back.skew, dt) == (-chart.skew, -DT)
    assert back.reverse(dt) == (chart, DT)


# Oracles: S := H.


def pendulum(params, w):
    q, p = w
    return 0.5 * p**2 - params * jnp.cos(q)


def henon_heiles(params, w):
    x, y, px, py = w
    del params
    return 0.5 * (px**2 + py**2 + x**2 + y**2) + x**2 * y - y**3 / 3


def henon_heiles_field(z):
    x, y, px, py = z
    return np.array([px, py, -x - 2 * x * y, -y - x**2 + y**2])


def images(piece, z):
    out, info = jax.jit(jax.vmap(piece))(jnp.asarray(z))
    assert (info.status == 0).all()
    return np.asarray(out)


def test_midpoint_chart_of_the_hamiltonian_is_the_implicit_midpoint_rule():
    z = 0.3 * np.random.default_rng(3).standard_normal((5, 4))
    found = images(generated(henon_heiles, None, MIDPOINT, 0.5, 2), z)
    for start, image in zip(z, found, strict=True):

        def rule(end, start=start):
            return end - start - 0.5 * henon_heiles_field(0.5 * (start + end))

        expected = scipy.optimize.fsolve(rule, start, xtol=1e-13)
        np.testing.assert_allclose(image, expected, rtol=0, atol=1e-14)


def test_types_2_and_3_of_a_separable_hamiltonian_are_symplectic_euler():
    q, p = z = np.random.default_rng(4).uniform(-2, 2, (2, 50))
    second = images(generated(pendulum, jnp.float64(1.0), TYPE2, 0.4, 1), z.T)
    kicked = p - 0.4 * np.sin(q)
    np.testing.assert_allclose(second, np.stack([q + 0.4 * kicked, kicked], 1), atol=1e-15)
    third = images(generated(pendulum, jnp.float64(1.0), TYPE3, 0.4, 1), z.T)
    moved = q + 0.4 * p
    np.testing.assert_allclose(third, np.stack([moved, p - 0.4 * np.sin(moved)], 1), atol=1e-15)


@pytest.mark.parametrize(("chart", "order"), [(TYPE2, 1), (TYPE3, 1), (MIDPOINT, 2)], ids=str)
def test_order_of_convergence_when_s_is_the_hamiltonian(chart, order):
    start, time = np.array([0.1, -0.2, 0.3, 0.25]), 1.6
    reference = scipy.integrate.solve_ivp(
        lambda t, z: henon_heiles_field(z),
        (0, time),
        start,
        method="DOP853",
        rtol=1e-13,
        atol=1e-14,
    ).y[:, -1]
    counts = np.array([16, 32, 64])
    errors = []
    for count in counts:
        piece = generated(henon_heiles, None, chart, time / float(count), 2)
        end = jax.jit(lambda z, n=count, f=piece: jax.lax.fori_loop(0, n, lambda _, y: f(y)[0], z))
        errors.append(np.linalg.norm(end(jnp.asarray(start)) - reference))
    assert min(errors) > 1e-6  # far above roundoff
    slope = -np.polyfit(np.log(counts), np.log(errors), 1)[0]
    assert abs(slope - order) < 0.1


def test_standard_map_in_type_2():
    kick = 1.2

    def scalar(params, w):
        return 0.5 * w[1] ** 2 + params * jnp.cos(w[0])

    theta, p = z = np.random.default_rng(5).uniform(-np.pi, np.pi, (2, 200))
    found = images(generated(scalar, jnp.float64(kick), TYPE2, 1.0, 1), z.T)
    after = p + kick * np.sin(theta)
    expected = np.stack([theta + after, after], axis=1)
    np.testing.assert_allclose(found, expected, rtol=1e-15, atol=1e-15)


def rotated(z, angle):
    q, p = z.T
    return np.stack(
        [q * np.cos(angle) + p * np.sin(angle), p * np.cos(angle) - q * np.sin(angle)], axis=1
    )


def oscillator(chart, full, times, z):
    """Images, those of the inverse, and determinant of what F(t, w) generates; h = 1."""

    def near_identity(time, w):
        return full(time, w) - (0.0 if chart is TYPE1 else w[0] * w[1])

    def lane(time, z):
        piece = generated(near_identity, time, chart, 1.0, 1)
        return piece(z)[0], piece.inverse()(z)[0], piece.determinant(z)

    each = jax.vmap(jax.vmap(lane, (None, 0)), (0, None))
    found = jax.jit(each)(jnp.asarray(times), jnp.asarray(z))
    return zip(times, *map(np.asarray, found), strict=True)


def test_exact_type_2_function_of_the_oscillator():
    def full(time, w):
        q, p = w
        return q * p / jnp.cos(time) + 0.5 * (q**2 + p**2) * jnp.tan(time)

    z = np.random.default_rng(6).standard_normal((20, 2))
    for time, image, back, determinant in oscillator(TYPE2, full, [0.1, 0.8, 1.3, 2.6], z):
        np.testing.assert_allclose(image, rotated(z, time), rtol=0, atol=1e-14)
        np.testing.assert_allclose(back, rotated(z, -time), rtol=0, atol=1e-14)
        np.testing.assert_allclose(determinant, np.cos(time), rtol=1e-12)  # ∂P/∂p


def test_exact_type_1_function_of_the_oscillator():
    def full(time, w):
        q, q1 = w
        return ((q**2 + q1**2) * jnp.cos(time) - 2 * q * q1) / (2 * jnp.sin(time))

    z = np.random.default_rng(7).standard_normal((20, 2))
    for time, image, back, determinant in oscillator(TYPE1, full, [0.3, np.pi / 2, 2.5], z):
        np.testing.assert_allclose(image, rotated(z, time), rtol=0, atol=1e-14)
        np.testing.assert_allclose(back, rotated(z, -time), rtol=0, atol=1e-14)
        np.testing.assert_allclose(determinant, np.sin(time), rtol=1e-12)  # ∂Q/∂p


@EVERY
def test_linear_map_has_its_own_determinant(chart):
    turn = np.array([[np.cos(0.4), np.sin(0.4)], [-np.sin(0.4), np.cos(0.4)]])
    offset = np.array([0.2, -0.1])
    # ∇S is affine in w; three pairs determine it.
    z0 = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
    z1 = z0 @ turn.T + offset
    points = np.asarray(chart.point(jnp.asarray(z0), jnp.asarray(z1)))
    wanted = np.asarray(chart.wanted(jnp.asarray(z0), jnp.asarray(z1), 0.4))
    constant, *linear = np.linalg.solve(np.column_stack([np.ones(3), points]), wanted)
    linear, constant = jnp.asarray(np.array(linear)), jnp.asarray(constant)

    def scalar(_, w):
        return constant @ w + 0.5 * w @ linear @ w

    piece = Generated(scalar, None, chart, 0.4, jnp.ones(2))
    z = jnp.asarray([0.3, -0.8])
    image = jnp.asarray(turn) @ z + jnp.asarray(offset)
    for one, start, end in ((piece, z, image), (piece.inverse(), image, z)):
        w, gradient, info = jax.jit(one.solve)(start)
        np.testing.assert_allclose(one.chart.image(start, w, gradient, one.dt), end, atol=1e-14)
        assert info.residual < 1e-14
    expected = chart.determinant(jnp.asarray(turn))
    np.testing.assert_allclose(jax.jit(piece.determinant)(z), expected, rtol=1e-12)
    batch = chart.determinant(jnp.asarray(np.stack([turn, np.eye(2)])))
    np.testing.assert_allclose(batch, [expected, 0.0 if chart is TYPE1 else 1.0], rtol=1e-12)
