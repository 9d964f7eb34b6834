"""Newton's method: roundoff, honest statuses on rough equations, derivatives of every kind."""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import hypothesis
import hypothesis.strategies as st
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize

from gfnn_jax.families import from_function
from gfnn_jax.generating.charts import MIDPOINT, TYPE2
from gfnn_jax.generating.generated import Generated
from gfnn_jax.solve import newton
from gfnn_jax.solve.newton import Evaluation, iterate, root
from gfnn_jax.solve.status import NON_FINITE, NOT_CONVERGED, OK

EPS = np.finfo(np.float64).eps


@dataclasses.dataclass(frozen=True)
class PerLane:
    """An equation from a residual(shared, lane, x) of one lane, made of terms of unit size, or of
    the size that it tells too; aux is the sum of x."""

    residual: Callable
    tells_size: bool = False

    def evaluate(self, shared, lanes, x):
        value: Any = jax.vmap(self.residual, (None, 0, 0))(shared, lanes, x)
        value, size = value if self.tells_size else (value, jnp.ones_like(x))
        return Evaluation(value, size, jnp.sum(x, axis=-1))

    def linearise(self, shared, lanes, x):
        def one(s, c, y):
            found = self.residual(s, c, y)
            return found[0] if self.tells_size else found

        matrix = jax.vmap(jax.jacfwd(one, argnums=2), (None, 0, 0))(shared, lanes, x)
        return self.evaluate(shared, lanes, x), matrix


@functools.partial(jax.jit, static_argnums=(0, 3))
def solved(equation, lanes, guess, most=40, shared=None):
    """(x, aux, Info) of lanes (B, ...) from guess (B, n)."""
    return root(equation, shared, lanes, guess, most)


@functools.partial(jax.jit, static_argnums=0)
def waited(equation, lanes, guess):
    """Iterate without gathering: every lane waits for the last."""
    return iterate(equation, None, lanes, guess, most=40, gather=False)


SQUARE = PerLane(lambda _, theta, x: x * x - theta)


def test_roots_to_roundoff_from_far_away():
    theta = np.array([[2.0], [1e-8], [1e4], [4.0]])
    x, aux, info = solved(SQUARE, theta, np.array([[1.0], [1.0], [1.0], [2.0]]))
    np.testing.assert_allclose(x, np.sqrt(theta), rtol=1e-14, atol=1e-11)
    np.testing.assert_array_equal(aux, x[:, 0])
    assert (info.status == OK).all()
    assert info.iterations[3] == 1  # one update is always made
    assert (info.iterations[:3] > 3).all()
    assert info.residual[3] == 0


def test_damping_finds_what_full_newton_loses():
    """Full Newton diverges from |x| > 1.39."""
    saturating = PerLane(lambda _, theta, x: jnp.arctan(x - theta))
    guess = np.array([[1.0], [1.5], [5.0], [300.0]])
    x, _, info = solved(saturating, np.zeros((4, 1)), guess)
    np.testing.assert_allclose(x, 0, atol=1e-15)
    assert (info.status == OK).all()


def test_no_root_is_not_converged_and_no_number_is_non_finite():
    theta = np.array([[1.0], [-1.0], [np.nan], [np.inf], [1.0], [2.0]])
    guess = np.array([[2.0], [2.0], [2.0], [2.0], [np.nan], [0.0]])  # the last one is singular
    _, _, info = solved(SQUARE, theta, guess)
    expected = [OK, NOT_CONVERGED, NON_FINITE, NON_FINITE, NON_FINITE, NOT_CONVERGED]
    np.testing.assert_array_equal(info.status, expected)
    assert info.residual[1] > 0.1
    assert info.iterations.max() <= 40
    assert info.iterations[5] < 10


def test_a_bad_lane_changes_no_bit_of_the_others():
    theta, guess = 1.0 + np.arange(16.0)[:, None], np.ones((16, 1))
    good = solved(SQUARE, theta, guess)
    others = np.arange(16) != 5
    for bad in (np.nan, -1.0, 1e300):
        mixed = theta.copy()
        mixed[5] = bad
        found = solved(SQUARE, mixed, guess)
        for a, b in zip(jax.tree.leaves(good), jax.tree.leaves(found), strict=True):
            np.testing.assert_array_equal(np.asarray(a)[others], np.asarray(b)[others])


def test_residual_above_the_floor_by_roundoff_ends_ok_at_once():
    """Noise of ten floors (as of a rough S) is the end, not a reason to iterate on."""

    def noisy(_, theta, x):
        return x - theta + 40 * EPS * jnp.sign(jnp.sin(1e18 * x))  # never smaller, whatever x

    _, _, info = solved(PerLane(noisy), np.linspace(0.1, 0.9, 64)[:, None], np.zeros((64, 1)))
    assert (info.status == OK).all()
    assert info.residual.max() > 4 * EPS  # above the floor, and yet
    assert info.iterations.max() <= 6


def test_a_lane_stops_where_the_determinant_would_change_sign():
    """det = (1 + 0.1 x)(x − ½) is zero between guess and root, where the residual shows no slope:
    only its sign tells that the root is on another branch."""

    def beyond(_, theta, x):
        return jnp.stack([x[0] + 0.05 * x[0] ** 2 - theta, x[1] * (x[0] - 0.5)])

    guess = np.array([[0.0, 0.0], [0.6, 0.0]])
    x, _, info = solved(PerLane(beyond), np.ones(2), guess)
    assert info.status.tolist() == [NOT_CONVERGED, OK]
    assert x[0, 0] < 0.5
    np.testing.assert_allclose(x[1], [10 * (np.sqrt(1.2) - 1), 0.0], rtol=0, atol=1e-15)


@pytest.mark.parametrize("most", [1, 3])
def test_iterations_never_exceed_their_limit(most):
    x, _, info = solved(SQUARE, np.array([[1e4], [2.0]]), np.array([[1.0], [1.5]]), most)
    assert info.iterations[0] == most
    assert info.status[0] == NOT_CONVERGED
    if most == 1:  # the one update that is allowed is kept
        np.testing.assert_allclose(x[1], 1.5 - 0.25 / 3, rtol=1e-15)


def test_a_large_component_at_its_floor_does_not_stop_the_others():
    """The residual of the first is roundoff from the start on, and larger than the second's."""

    def uneven(_, theta, x):
        large = 1e3 * (x[0] - 0.1) + 1e3 * 0.1 - 1e3 * 0.1
        small = 1e-13 * (x[1] + 0.6 * jnp.sin(x[1]) - theta[0])
        return jnp.stack([large, small]), jnp.array([1e3, 1e-13])

    theta = np.linspace(1, 4, 500)[:, None]
    guess = np.stack([np.full(500, 0.1 + 1e-16), np.zeros(500)], axis=1)
    x, _, info = solved(PerLane(uneven, tells_size=True), theta, guess)
    assert (info.status == OK).all()
    np.testing.assert_allclose(x[:, 1] + 0.6 * np.sin(x[:, 1]), theta[:, 0], rtol=1e-11)


# Lanes that are taken out of the batch.

FOLDED = PerLane(lambda _, theta, x: x + 8.0 * jnp.sin(x) - theta)


def hard_and_easy(count, seed=0):
    """A few lanes far from their roots or without any way to one, among many at theirs."""
    rng = np.random.default_rng(seed)
    x = rng.uniform(-20, 20, (count, 1))
    guess = x + np.where(rng.uniform(size=(count, 1)) < 0.3, rng.uniform(-3, 3, (count, 1)), 1e-9)
    theta = x + 8.0 * np.sin(x)
    theta[::50] = np.nan
    return theta, guess


@pytest.mark.parametrize(
    "count", [*(pytest.param(n, marks=pytest.mark.slow) for n in (1, 33)), 3_000]
)
def test_lanes_that_are_taken_out_of_a_batch_end_as_they_do_alone(count):
    """Compare gathered lanes with the loop in which all wait for the last: no lane is forgotten,
    mixed up, or led elsewhere."""
    theta, guess = hard_and_easy(count)
    found = solved(FOLDED, theta, guess)
    jax.tree.map(np.testing.assert_array_equal, found, waited(FOLDED, theta, guess))
    status = np.asarray(found[2].status)
    assert status[0] == NON_FINITE
    if count > 100:
        assert {OK, NOT_CONVERGED, NON_FINITE} == set(status.tolist())


def test_only_a_few_lanes_of_a_batch_are_in_the_loop():
    """Seen in what is to be compiled: a sine of 32 lanes in a loop, and none of 500 in any."""
    theta, guess = hard_and_easy(500)

    def widths(jaxpr, in_loop=False):
        for equation in jaxpr.eqns:
            if in_loop and equation.primitive.name == "sin":
                yield equation.outvars[0].aval.shape[0]
            inside = in_loop or equation.primitive.name == "while"
            for part in equation.params.values():
                inner = getattr(part, "jaxpr", part)
                if hasattr(inner, "eqns"):
                    yield from widths(inner, inside)

    together = jax.make_jaxpr(lambda t, x: root(FOLDED, None, t, x, 40))(theta, guess)
    assert set(widths(together.jaxpr)) == {32}


LINEARISED = []


def counting(_, theta, x):
    jax.debug.callback(lambda: LINEARISED.append(1))
    return x * x - theta


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_a_lane_that_has_stopped_takes_no_updates(bad):
    """A rollout keeps NaN in the place of a state that it has given up: no later step waits for
    it. Evaluations of one lane: the linearisation at the guess and the residual after an update."""
    theta, guess = 1.0 + 1e-3 * np.arange(40.0)[:, None], np.ones((40, 1))

    def evaluations(theta, guess):
        LINEARISED.clear()
        jax.block_until_ready(solved(PerLane(counting), theta, guess))
        jax.effects_barrier()
        return len(LINEARISED)

    guess = np.sqrt(theta)
    good = evaluations(theta, guess)
    theta[5] = guess[5] = bad
    assert evaluations(theta, guess) == good


# Derivatives.


def coupled(_, theta, x):
    a, b = theta
    return jnp.stack([x[0] + 0.3 * jnp.sin(x[1]) - a, x[1] - 0.2 * x[0] ** 2 - b])


COUPLED = PerLane(coupled)
THETA = np.array([0.4, 0.7])


def implicit(theta, most=40):
    x, aux, _ = root(COUPLED, None, theta[None], jnp.zeros((1, 2)), most)
    return jnp.stack([x[0, 0], aux[0]])


def unrolled(theta, most=40):
    x, aux, _ = iterate(COUPLED, None, theta[None], jnp.zeros((1, 2)), most=most)
    return jnp.stack([x[0, 0], aux[0]])


def test_first_derivatives():
    """Forward = reverse = through the iterations = finite differences; and scipy's solution."""

    @jax.jit
    def derivatives(theta):
        first = jax.jacfwd(implicit)(theta), jax.jacrev(implicit)(theta)
        return implicit(theta), *first, jax.jacfwd(unrolled)(theta)

    found, forward, backward, through = derivatives(THETA)
    exact = scipy.optimize.fsolve(lambda x: coupled(None, THETA, x), np.zeros(2), xtol=1e-14)
    np.testing.assert_allclose(found, [exact[0], exact.sum()], rtol=0, atol=1e-14)
    np.testing.assert_allclose(forward, through, rtol=0, atol=1e-13)
    np.testing.assert_allclose(backward, forward, rtol=0, atol=1e-15)
    step = 1e-5
    for i, move in enumerate(step * np.eye(2)):
        above, below = derivatives(THETA + move), derivatives(THETA - move)
        slope = (above[0] - below[0]) / (2 * step)
        np.testing.assert_allclose(forward[:, i], slope, rtol=0, atol=1e-9)


@pytest.mark.slow
def test_second_derivatives():
    first, second = (jax.jit(of(implicit)) for of in (jax.jacfwd, jax.hessian))
    step, found = 1e-5, second(THETA)
    for i, move in enumerate(step * np.eye(2)):
        curvature = (first(THETA + move) - first(THETA - move)) / (2 * step)
        np.testing.assert_allclose(found[:, :, i], curvature, rtol=0, atol=1e-9)


@pytest.mark.slow
def test_unrolled_derivative_of_an_unfinished_solve_is_wrong_and_the_implicit_one_cannot_tell():
    """Show why the symplecticity defect must go through the iterations."""

    @jax.jit
    def stopped(theta):
        return unrolled(theta, 1), jax.jacfwd(unrolled)(theta, 1), jax.jacfwd(implicit)(theta, 1)

    move = np.array([1e-6, 0.0])
    difference = (stopped(THETA + move)[0] - stopped(THETA - move)[0]) / 2e-6
    _, through, by_theorem = stopped(THETA)
    np.testing.assert_allclose(through[:, 0], difference, atol=1e-8)
    assert np.abs(by_theorem[:, 0] - difference).max() > 1e-3


BENT = PerLane(lambda b, theta, x: x + b * jnp.sin(x) - theta)


@jax.jit
def slopes_of_bent(bend, theta):
    def solve(theta):
        guess = 1.3 * theta + 0.1
        x, _, info = iterate(BENT, bend, theta, guess, most=40, gather=False)
        return x, info.status

    _, slope, status = jax.jvp(solve, (theta,), (jnp.ones_like(theta),), has_aux=True)
    return slope, status


@pytest.mark.parametrize(
    ("bend", "dtype"),
    [(0.0, "float64"), (8.0, "float64"), pytest.param(8.0, "float32", marks=pytest.mark.slow)],
)
def test_unrolled_derivative_of_a_damped_solve_is_finite(bend, dtype):
    """Check also where a step is exactly straight (bend 0), or leads to a straight one."""
    theta = np.linspace(-4, 4, 2_001, dtype=dtype)[:, None]
    slope, status = slopes_of_bent(theta.dtype.type(bend), theta)
    ok = np.asarray(status) == OK
    assert ok.mean() > 0.9
    assert np.isfinite(np.asarray(slope)[ok]).all()


@pytest.mark.slow
def test_batches_of_batches_and_their_derivatives():
    """Lanes with their own θ and a common number, under vmap, in reverse and in forward mode."""
    stretched = PerLane(lambda scale, theta, x: scale * x + 8.0 * jnp.sin(x) - theta)
    theta, guess = hard_and_easy(100)
    theta = np.where(np.isnan(theta), 0.0, theta)

    def roots(scale):
        x, _, info = root(stretched, scale, theta, guess, 40)
        return jnp.where(info.status == OK, x[:, 0], 0.0)

    def total(scales):
        found = jax.vmap(roots)(scales)
        return jnp.sum(found), found

    scales = np.array([0.9, 1.0, 1.1])
    slope, found = jax.jit(jax.grad(total, has_aux=True))(scales)
    forward = jax.jit(jax.jacfwd(lambda s: total(s)[0]))(scales)
    single = np.stack([jax.jit(roots)(s) for s in scales])
    np.testing.assert_allclose(found, single, rtol=1e-14)
    expected = -single / (scales[:, None] + 8.0 * np.cos(single))
    np.testing.assert_allclose(slope, expected.sum(axis=1), rtol=1e-9)
    np.testing.assert_allclose(forward, slope, rtol=1e-12)


# Rough generating functions: whatever S and the state are, "ok" means solved.


@from_function
def rough(params, w):
    """Sum of polynomials of q, of p and of two mixed arguments: folds, branches, steep walls."""
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
    image, info = Generated(rough, params, chart, DT, np.ones(2)).step(z)
    gradient, hessian = rough.gradient_and_hessian(params, chart.evaluation_point(z, image))
    largest = functools.partial(jnp.max, axis=-1)
    error = DT * largest(jnp.abs(gradient - chart.target_gradient(z, image, DT)))
    size = 1.0 + largest(jnp.abs(z)) + largest(jnp.abs(image))
    # w from the rounded image differs from the solver's by roundoff, which S'' magnifies.
    return image, info, error / (size * (1.0 + DT * largest(largest(jnp.abs(hessian)))))


@pytest.mark.parametrize(
    "chart", [pytest.param(TYPE2, marks=pytest.mark.slow), MIDPOINT], ids=lambda chart: chart.name
)
@hypothesis.settings(max_examples=30, deadline=None, derandomize=True, database=None)
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
    image, info, error = rough_steps(chart, params, z)
    ok = np.asarray(info.status == OK)
    assert np.isin(info.status, [OK, NOT_CONVERGED, NON_FINITE]).all()
    assert (np.asarray(info.status)[:2] == NON_FINITE).all()
    assert np.isfinite(image)[ok].all()
    assert not np.any(np.asarray(error)[ok] > 1e-11)
    assert not np.any(np.asarray(info.residual)[ok] > 1e-11)


def test_rough_steps_that_converge_are_common_enough_to_be_a_test():
    rng = np.random.default_rng(0)
    params, z = 10 * rng.standard_normal((4, 5)), rng.standard_normal((LANES, 2))
    counts = np.bincount(rough_steps(MIDPOINT, params, z)[1].status, minlength=5)
    assert counts[OK] > 16
    assert counts[NOT_CONVERGED] > 4


@from_function
def kicks(strength, w):
    return strength * jnp.cos(w[0] + w[1])


@jax.jit
def kicked(strength, z):
    return Generated(kicks, strength, TYPE2, 1.0, np.ones(2)).step(z)


@pytest.mark.parametrize(
    "strength",
    [
        *(0.5, 8.0, 13.84),
        *(pytest.param(a, marks=pytest.mark.slow) for a in (1.5, 7.21, 9.99, 11.76, 50.0)),
    ],
)
def test_neighbours_are_not_led_to_different_branches(strength):
    """P − A sin(q + P) = p has folds from A = 1 on. A solve that may jump over a fold makes 285 of
    20,000 neighbours at A = 8 end on different branches without a word; one that looks at the
    residual alone, 4; one that tries the whole step first, a few wherever that leads a period on
    (7.21 to 13.84)."""
    p = np.linspace(-np.pi, np.pi, 20_001)
    image, info = kicked(strength, np.stack([0 * p, p], axis=1))
    ok = np.asarray(info.status) == OK
    jumps = ok[1:] & ok[:-1] & (np.abs(np.diff(np.asarray(image)[:, 1])) > 0.1)
    assert not jumps.any()
    assert ok.mean() > 0.8
    assert ok.all() or strength > 1  # without folds nothing is given up


# In NumPy, for fits.


class InNumPy:
    """x² = θ, whose methods take NumPy arrays."""

    def evaluate(self, shared, lanes, x):
        return Evaluation(x * x - lanes, np.ones_like(x), x)

    def linearise(self, shared, lanes, x):
        return self.evaluate(shared, lanes, x), 2 * x[..., None]


def test_refining_is_newtons_method_without_compilation(compilations):
    theta = np.array([[2.0], [3.0], [np.nan], [-1.0], [4.0]])
    guess = np.array([[1.4], [1.7], [1.0], [1.0], [2.0]])
    with compilations() as found:
        x, _, error = newton.refine(InNumPy(), None, theta, guess)
    assert found.count == 0
    np.testing.assert_allclose(x[[0, 1, 4], 0], np.sqrt([2.0, 3.0, 4.0]), rtol=1e-15)
    assert (error[[0, 1, 4]] < 1e-14).all()
    assert not (error[[2, 3]] < 1e-3).any()
