"""The implicit solve: roundoff, honest statuses on rough equations, derivatives of every kind."""

import functools

import hypothesis
import hypothesis.strategies as st
import jax
import jax.numpy as jnp
import numpy as np
import optimistix
import pytest

from gfnn_jax.generating.charts import MIDPOINT, TYPE2
from gfnn_jax.solve.newton import NON_FINITE, NOT_CONVERGED, OK, iterate, root, small_solve
from gfnn_jax.maps.symplectic_map import Generated

EPS = np.finfo(np.float64).eps


@pytest.mark.parametrize("n", [1, 2, 4, 7, 9])
def test_small_solve_agrees_with_numpy(n):
    rng = np.random.default_rng(n)
    matrix, rhs = rng.standard_normal((20, n, n)), rng.standard_normal((20, n))
    matrix[:, 0, 0] = 0.0 if n > 1 else 1.0  # needs pivoting
    expected = np.linalg.solve(matrix, rhs[..., None])[..., 0]
    found = jax.jit(jax.vmap(small_solve))(jnp.asarray(matrix), jnp.asarray(rhs))
    backward = np.abs(matrix @ np.asarray(found)[..., None] - rhs[..., None]).max()
    np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-9)
    assert backward < 1e-11


def test_small_solve_transposes_and_differentiates():
    rng = np.random.default_rng(0)
    matrix, rhs = jnp.asarray(rng.standard_normal((4, 4))), jnp.asarray(rng.standard_normal(4))
    transposed = jax.jit(jax.grad(lambda b: rhs @ small_solve(matrix, b)))(rhs)
    np.testing.assert_allclose(transposed, np.linalg.solve(matrix.T, rhs), rtol=1e-12)


def equation(residual):
    """``evaluate`` for a residual(theta, x) made of terms of unit size; aux is the sum of x."""

    def evaluate(theta, x):
        value = residual(theta, x)
        return value, jnp.ones_like(value), jnp.sum(x)

    return evaluate


@functools.partial(jax.jit, static_argnums=(0, 3))
def solved(evaluate, theta, guess, most=40):
    """A batch of solves: theta (B, ...), guess (B, n)."""
    return jax.vmap(lambda t, x: root(evaluate, t, x, most))(theta, guess)


@equation
def square(theta, x):
    return x * x - theta


def test_roots_to_roundoff_from_far_away():
    theta = jnp.asarray([[2.0], [1e-8], [1e4], [4.0]])
    x, aux, info = solved(square, theta, jnp.asarray([[1.0], [1.0], [1.0], [2.0]]))
    np.testing.assert_allclose(x, np.sqrt(theta), rtol=1e-14, atol=1e-11)
    np.testing.assert_array_equal(aux, x[:, 0])
    assert (info.status == OK).all()
    assert info.iterations[3] == 1  # one update is always made
    assert (info.iterations[:3] > 3).all()
    assert info.residual[3] == 0


@equation
def saturating(theta, x):
    """Full Newton diverges from |x − θ| > 1.39."""
    return jnp.arctan(x - theta)


def test_damping_finds_what_full_newton_loses():
    x, _, info = solved(saturating, jnp.zeros((4, 1)), jnp.asarray([[1.0], [1.5], [5.0], [300.0]]))
    np.testing.assert_allclose(x, 0, atol=1e-15)
    assert (info.status == OK).all()


def test_no_root_is_not_converged_and_no_number_is_non_finite():
    theta = jnp.asarray([[1.0], [-1.0], [np.nan], [np.inf], [1.0]])
    guess = jnp.asarray([[2.0], [2.0], [2.0], [2.0], [np.nan]])
    _, _, info = solved(square, theta, guess)
    expected = [OK, NOT_CONVERGED, NON_FINITE, NON_FINITE, NON_FINITE]
    np.testing.assert_array_equal(info.status, expected)
    assert info.residual[1] > 0.1
    assert info.iterations.max() <= 40


def test_singular_start_is_reported_not_looped():
    _, _, info = solved(square, jnp.asarray([[2.0]]), jnp.asarray([[0.0]]))
    np.testing.assert_array_equal(info.status, [NOT_CONVERGED])
    assert info.iterations[0] < 10


def test_a_bad_lane_changes_no_bit_of_the_others():
    theta = 1.0 + jnp.arange(16.0)[:, None]
    guess = jnp.ones((16, 1))
    good = solved(square, theta, guess)
    for bad in (np.nan, -1.0, 1e300):
        mixed = solved(square, theta.at[5].set(bad), guess)
        others = np.arange(16) != 5
        for a, b in zip(jax.tree.leaves(good), jax.tree.leaves(mixed), strict=True):
            np.testing.assert_array_equal(np.asarray(a)[others], np.asarray(b)[others])


def test_residual_above_the_floor_by_roundoff_ends_ok_at_once():
    """Noise of ten floors (as of a rough S) is the end, not a reason to iterate on."""

    def noisy(theta, x):
        noise = 40 * EPS * jnp.sign(jnp.sin(1e18 * x))  # never smaller, whatever x
        return x - theta + noise, jnp.ones_like(x), x

    _, _, info = solved(noisy, jnp.linspace(0.1, 0.9, 64)[:, None], jnp.zeros((64, 1)))
    assert (info.status == OK).all()
    assert info.residual.max() > 4 * EPS  # above the floor, and yet
    assert info.iterations.max() <= 6


def test_iterations_never_exceed_their_limit():
    for most in (1, 3, 4):
        _, _, info = solved(square, jnp.full((1, 1), 1e4), jnp.ones((1, 1)), most)
        assert info.iterations[0] == most
        assert info.status[0] == NOT_CONVERGED


@equation
def coupled(theta, x):
    a, b = theta
    return jnp.stack([x[0] + 0.3 * jnp.sin(x[1]) - a, x[1] - 0.2 * x[0] ** 2 - b])


def solution(theta, guess=None):
    x, aux, _ = root(coupled, theta, jnp.zeros(2), 40)
    return jnp.stack([x[0], aux])


def unrolled(theta):
    x, aux, _ = iterate(coupled, theta, jnp.zeros(2), most=40)
    return jnp.stack([x[0], aux])


THETA = jnp.asarray([0.4, 0.7])


def test_solution_is_that_of_another_solver():
    found = optimistix.root_find(
        lambda x, theta: coupled(theta, x)[0],
        optimistix.Newton(rtol=1e-14, atol=1e-14),
        jnp.zeros(2),
        THETA,
    ).value
    np.testing.assert_allclose(solution(THETA), [found[0], found.sum()], rtol=0, atol=1e-15)


def test_first_and_second_derivatives():
    forward, backward = jax.jit(jax.jacfwd(solution)), jax.jit(jax.jacrev(solution))
    np.testing.assert_allclose(forward(THETA), jax.jacfwd(unrolled)(THETA), rtol=0, atol=1e-13)
    np.testing.assert_allclose(backward(THETA), forward(THETA), rtol=0, atol=1e-15)
    second = jax.jit(jax.hessian(solution))(THETA)
    step = 1e-5
    for i in range(2):
        move = jnp.zeros(2).at[i].set(step)
        column = (forward(THETA + move) - forward(THETA - move)) / (2 * step)
        np.testing.assert_allclose(second[:, :, i], column, rtol=0, atol=1e-9)


def test_derivatives_of_batches_pass_the_integers_of_info():
    """Status and counts have no tangent; vmap, jit, grad and their orders must not mind."""

    def total(theta):
        x, _, info = root(coupled, theta, jnp.zeros(2), 40)
        return jnp.sum(x) + jnp.where(info.status == OK, 0.0, 1.0) * x[0], info

    thetas = jnp.stack([THETA, 2 * THETA, -THETA])
    one, info = jax.vmap(jax.grad(total, has_aux=True))(thetas)
    two, _ = jax.jit(jax.vmap(jax.grad(total, has_aux=True)))(thetas)
    three = jax.grad(lambda t: jnp.sum(jax.vmap(total)(t)[0]))(thetas)
    assert info.status.shape == (3,)
    np.testing.assert_allclose(one, two, rtol=1e-14)
    np.testing.assert_allclose(one, three, rtol=1e-14)


def test_executed_derivative_of_an_unfinished_solve_is_wrong_and_the_implicit_one_cannot_tell():
    """Why the symplecticity defect must go through the iterations."""

    def stopped(theta):
        return iterate(coupled, theta, jnp.zeros(2), most=1)[0]

    def implicit(theta):
        return root(coupled, theta, jnp.zeros(2), 1)[0]

    step = 1e-6
    move = jnp.asarray([step, 0.0])
    difference = (stopped(THETA + move) - stopped(THETA - move)) / (2 * step)
    np.testing.assert_allclose(jax.jacfwd(stopped)(THETA)[:, 0], difference, atol=1e-8)
    assert np.abs(jax.jacfwd(implicit)(THETA)[:, 0] - difference).max() > 1e-3


@pytest.mark.parametrize("dtype", [jnp.float64, jnp.float32])
@pytest.mark.parametrize("bend", [0.0, 8.0])
def test_executed_derivative_of_a_damped_solve_is_finite(bend, dtype):
    """Also where a step is exactly straight (bend 0), or a part of it leads to a straight one."""

    @equation
    def bent(theta, x):
        return x + bend * jnp.sin(x) - theta

    def solve(theta):
        x, _, info = iterate(bent, theta, 1.3 * theta + 0.1, most=40)
        return x, info.status

    theta = jnp.linspace(-4, 4, 2_001, dtype=dtype)[:, None]
    slope, status = jax.jit(jax.vmap(jax.jacfwd(solve, has_aux=True)))(theta)
    ok = np.asarray(status) == OK
    assert ok.mean() > 0.9
    assert np.isfinite(np.asarray(slope)[ok]).all()


def test_a_large_component_at_its_floor_does_not_stop_the_others():
    """The residual of the first is roundoff from the start on, and larger than the second's."""

    def evaluate(theta, x):
        large = 1e3 * (x[0] - 0.1) + 1e3 * 0.1 - 1e3 * 0.1
        small = 1e-13 * (x[1] + 0.6 * jnp.sin(x[1]) - theta[0])
        return jnp.stack([large, small]), jnp.array([1e3, 1e-13]), x[0]

    theta = jnp.linspace(1, 4, 500)[:, None]
    guess = jnp.stack([jnp.full(500, 0.1 + 1e-16), jnp.zeros(500)], axis=1)
    x, _, info = solved(evaluate, theta, guess)
    assert (info.status == OK).all()
    np.testing.assert_allclose(x[:, 1] + 0.6 * jnp.sin(x[:, 1]), theta[:, 0], rtol=1e-11)


def test_the_one_update_that_is_allowed_is_kept():
    x, _, info = solved(square, jnp.array([[2.0]]), jnp.array([[1.5]]), 1)
    np.testing.assert_allclose(x, [[1.5 - 0.25 / 3]], rtol=1e-15)
    assert info.iterations[0] == 1
    assert info.status[0] == NOT_CONVERGED


@equation
def folded(theta, x):
    return x + 8.0 * jnp.sin(x) - theta


def hard_and_easy(count, seed=0):
    """A few lanes far from their roots or without any way to one, among many at theirs."""
    rng = np.random.default_rng(seed)
    x = rng.uniform(-20, 20, (count, 1))
    guess = x + np.where(rng.uniform(size=(count, 1)) < 0.3, rng.uniform(-3, 3, (count, 1)), 1e-9)
    theta = x + 8.0 * np.sin(x)
    theta[::50] = np.nan
    return jnp.asarray(theta), jnp.asarray(guess)


@pytest.mark.parametrize("count", [1, 32, 33, 500, 3_000])
def test_lanes_that_are_taken_out_of_a_batch_end_as_they_do_alone(count):
    """Of a batch only those visit the loop that need to, some at a time: none is forgotten, mixed
    up, or led elsewhere. The oracle is the loop in which all wait for the last."""
    theta, guess = hard_and_easy(count)
    waiting = jax.jit(jax.vmap(lambda t, x: iterate(folded, t, x, most=40)))(theta, guess)
    found = solved(folded, theta, guess)
    jax.tree.map(np.testing.assert_array_equal, found, waiting)
    status = np.asarray(found[2].status)
    assert status[0] == NON_FINITE
    if count > 100:
        assert {OK, NOT_CONVERGED, NON_FINITE} == set(status.tolist())


@pytest.mark.parametrize("dtype", [jnp.float64, jnp.float32])
def test_only_a_few_lanes_of_a_batch_are_in_the_loop(dtype):
    """Seen in what is to be compiled: a sine of 32 lanes in a loop, and none of 500 in any."""
    theta, guess = (a.astype(dtype) for a in hard_and_easy(500))

    def widths(jaxpr, in_loop=False):
        for equation in jaxpr.eqns:
            if in_loop and equation.primitive.name == "sin":
                yield equation.outvars[0].aval.shape[0]
            inside = in_loop or equation.primitive.name == "while"
            for part in equation.params.values():
                inner = getattr(part, "jaxpr", part)
                if hasattr(inner, "eqns"):
                    yield from widths(inner, inside)

    together = jax.vmap(lambda t, x: root(folded, t, x, 40))
    waiting = jax.vmap(lambda t, x: iterate(folded, t, x, most=40))
    assert set(widths(jax.make_jaxpr(together)(theta, guess).jaxpr)) == {32}
    assert set(widths(jax.make_jaxpr(waiting)(theta, guess).jaxpr)) == {500}
    x, _, info = solved(folded, theta, guess)
    good = np.asarray(info.status) == OK
    assert good.mean() > 0.7
    residual = np.abs(x + 8 * jnp.sin(x) - theta)[good]
    assert residual.max() < 200 * np.finfo(dtype).eps


def test_batches_of_batches_and_their_derivatives():
    """Lanes with their own θ or a common one, in two axes, in reverse and in forward mode."""
    theta, guess = hard_and_easy(300)
    theta = jnp.where(jnp.isnan(theta), 0.0, theta)

    def root_of(scale, t, x):
        x, _, info = root(stretched, (scale, t), x, 40)
        return jnp.where(info.status == OK, x[0], 0.0)

    @equation
    def stretched(theta, x):
        scale, t = theta
        return scale * x + 8.0 * jnp.sin(x) - t

    scales = jnp.array([0.9, 1.0, 1.1])
    both = jax.vmap(jax.vmap(root_of, (None, 0, 0)), (0, None, None))
    single = jnp.stack([jax.vmap(root_of, (None, 0, 0))(s, theta, guess) for s in scales])
    np.testing.assert_allclose(jax.jit(both)(scales, theta, guess), single, rtol=1e-14)
    total = lambda s: jnp.sum(both(s, theta, guess))  # noqa: E731
    slope = jax.jit(jax.grad(total))(scales)
    expected = -single / (scales[:, None] + 8.0 * jnp.cos(single))
    np.testing.assert_allclose(slope, expected.sum(axis=1), rtol=1e-9)
    np.testing.assert_allclose(jax.jit(jax.jacfwd(total))(scales), slope, rtol=1e-12)


# Rough generating functions: whatever S and the state are, "ok" means solved.


def rough(params, w):
    """Two quartics and one of a mixed argument: folds, several branches, steep walls."""
    q, p = w
    return (
        jnp.polyval(params[0], q)
        + jnp.polyval(params[1], p)
        + jnp.polyval(params[2], q * p - 0.3)
        + jnp.polyval(params[3], jnp.sin(3 * q) + p)
    )


DT, LANES = 0.1, 64


@functools.partial(jax.jit, static_argnums=0)
def rough_steps(chart, params, z):
    def lane(z):
        piece = Generated(rough, params, chart, DT, jnp.ones(2))
        image, info = piece(z)
        w = chart.point(z, image)
        hessian = jax.hessian(rough, argnums=1)(params, w)
        wanted = chart.wanted(z, image, DT)
        error = DT * jnp.max(jnp.abs(jax.grad(rough, argnums=1)(params, w) - wanted))
        size = 1.0 + jnp.max(jnp.abs(z)) + jnp.max(jnp.abs(image))
        # w from the rounded image differs from the solver's by roundoff, which S'' magnifies.
        return image, info, error / (size * (1.0 + DT * jnp.max(jnp.abs(hessian))))

    return jax.vmap(lane)(z)


@pytest.mark.parametrize("chart", [TYPE2, MIDPOINT], ids=str)
@hypothesis.settings(max_examples=60, deadline=None, derandomize=True, database=None)
@hypothesis.given(
    seed=st.integers(0, 2**32 - 1),
    strength=st.sampled_from([1.0, 10.0, 100.0, 1e4, 1e150]),
    spread=st.sampled_from([1e-3, 1.0, 10.0, 1e4, 1e150, 1e300]),
)
def test_no_lane_is_ok_with_a_residual_that_is_not_small(chart, seed, strength, spread):
    rng = np.random.default_rng(seed)
    params = strength * rng.standard_normal((4, 5))
    z = spread * rng.standard_normal((LANES, 2))
    z[0], z[1, 0], z[2] = np.nan, np.inf, 1e300
    image, info, error = rough_steps(chart, jnp.asarray(params), jnp.asarray(z))
    ok = np.asarray(info.status == OK)
    assert np.isin(info.status, [OK, NOT_CONVERGED, NON_FINITE]).all()
    assert not ok[:2].any()
    assert (info.status[:2] == NON_FINITE).all()
    assert np.isfinite(image)[ok].all()
    assert not np.any(np.asarray(error)[ok] > 1e-11)
    assert not np.any(np.asarray(info.residual)[ok] > 1e-11)


def test_rough_steps_that_converge_are_common_enough_to_be_a_test():
    rng = np.random.default_rng(0)
    _, info, _ = rough_steps(
        TYPE2,
        jnp.asarray(10 * rng.standard_normal((4, 5))),
        jnp.asarray(rng.standard_normal((64, 2))),
    )
    counts = np.bincount(info.status, minlength=5)
    assert counts[OK] > 16
    assert counts[NOT_CONVERGED] > 4


def test_float32_solves_in_float32():
    piece = Generated(
        rough, jnp.full((4, 5), 0.1, jnp.float32), TYPE2, DT,
        jnp.ones(2, jnp.float32),
    )  # fmt: skip
    image, info = jax.jit(piece)(jnp.asarray([0.3, 0.4], jnp.float32))
    assert image.dtype == info.residual.dtype == jnp.float32
    assert info.status == OK
    assert info.residual < 1e-6
    assert info.iterations < 6


@pytest.mark.parametrize("strength", [0.5, 1.5, 7.21, 8.0, 9.99, 11.76, 13.84, 50.0])
def test_neighbours_are_not_led_to_different_branches(strength):
    """P − A sin(q + P) = p has folds from A = 1 on. A solve that may jump over a fold makes 285 of
    20,000 neighbours at A = 8 end on different branches without a word; one that looks at the
    residual alone, 4; one that tries the whole step first, a few wherever that leads a period on
    (7.21 to 13.84)."""
    piece = Generated(lambda a, w: a * jnp.cos(w[0] + w[1]), strength, TYPE2, 1.0, jnp.ones(2))
    p = np.linspace(-np.pi, np.pi, 20_001)
    image, info = jax.jit(jax.vmap(piece))(jnp.asarray(np.stack([0 * p, p], axis=1)))
    ok = np.asarray(info.status) == OK
    jumps = ok[1:] & ok[:-1] & (np.abs(np.diff(np.asarray(image)[:, 1])) > 0.1)
    assert not jumps.any()
    assert ok.mean() > 0.8
    assert ok.all() or strength > 1  # without folds nothing is given up
