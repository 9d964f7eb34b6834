"""Starts of the implicit solve: close on the data, harmless far from them, for both directions."""

from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gfnn_jax.generating.charts import CHARTS, MIDPOINT, TYPE2
from gfnn_jax.coordinates import CARTESIAN, Coordinates
from gfnn_jax.maps.symplectic_map import Generated
from gfnn_jax.families.inputs import box_inputs
from gfnn_jax.families.products import Products
from gfnn_jax.generating.predictor import CLOSE, Starts, affordable, fit_starts

DT = 0.4
STATES = np.random.default_rng(0).uniform(-1, 1, (600, 2))


def prepared(y0, y1, coordinates=CARTESIAN):
    return SimpleNamespace(y0=y0, y1=y1, dt=DT, coordinates=coordinates)


def unknowns(chart, z0, z1):
    free = np.array(chart.free(z0.shape[1] // 2))
    return np.asarray(chart.point(z0, z1) - jax.vmap(chart.start)(jnp.asarray(z0)))[:, free]


@pytest.mark.parametrize("chart", CHARTS.values(), ids=lambda chart: chart.name)
def test_of_an_affine_map_is_its_solution_either_way(chart):
    turn = np.array([[np.cos(0.4), np.sin(0.4)], [-np.sin(0.4), np.cos(0.4)]])
    z0, z1 = STATES, STATES @ turn.T + np.array([0.2, -0.1])
    (there, back, _), *more = fit_starts(chart, prepared(z0, z1))
    assert not more  # degree 1 is close enough
    np.testing.assert_allclose(jax.vmap(there)(z0), unknowns(chart, z0, z1), atol=1e-13)
    behind = chart.reverse(DT)[0]
    np.testing.assert_allclose(jax.vmap(back)(z1), unknowns(behind, z1, z0), atol=1e-13)


def kicked(z):
    """Half a kick, a drift, half a kick, of a pendulum."""
    q, p = z.T
    p = p - 0.5 * DT * np.sin(q)
    q = q + DT * p
    return np.stack([q, p - 0.5 * DT * np.sin(q)], axis=1)


def test_rise_until_close_and_the_affordable_is_taken():
    starts = fit_starts(MIDPOINT, prepared(STATES, kicked(STATES)))
    wanted = unknowns(MIDPOINT, STATES, kicked(STATES))
    errors = [np.abs(jax.vmap(there)(STATES) - wanted).max() for there, *_ in starts]
    assert (np.diff(errors) < 0).all()
    assert errors[-1] < 1e-7
    assert errors[0] > 1e-3
    for degree in (4, 8, 20):
        family = Products(box_inputs(STATES), degree)
        there, *_ = affordable(starts, family)
        gradient, with_jacobian = family.operations
        assert there.operations <= 0.5 * gradient
        dear, _, error = affordable(starts, family, spares=True)
        assert error > CLOSE or dear.operations <= 5 * with_jacobian
        assert dear.family.degree >= there.family.degree
    assert there.family.degree == starts[-1].there.family.degree


class Costing:
    """A start, or a family, of which only the operations count."""

    def __init__(self, operations):
        self.operations = operations


def test_the_closest_start_that_is_affordable_is_taken_though_a_dearer_one_is_closer():
    known = ((1e-3, 40), (1e-6, 600), (4e-8, 1_800), (5e-9, 2_600))
    starts = [Starts(Costing(cost), Costing(cost), error) for error, cost in known]
    family = Costing((100, 400))
    assert affordable(starts, family, spares=True).error == 4e-8
    assert affordable(starts, family).error == 1e-3
    assert affordable(starts, Costing((100, 600)), spares=True).error == 5e-9


def test_noise_and_few_pairs_end_the_rise():
    rng = np.random.default_rng(1)
    noisy = kicked(STATES) + 1e-2 * rng.standard_normal(STATES.shape)
    assert len(fit_starts(TYPE2, prepared(STATES, noisy))) <= 3
    few = fit_starts(TYPE2, prepared(STATES[:12], kicked(STATES[:12])))
    assert few[-1].there.family.num_parameters <= 4


def test_angles_go_round_and_the_rest_stays_small_far_away():
    angular = Coordinates("angle", angles=(0,))
    z0 = STATES * [np.pi, 1.0]
    there, back, _ = fit_starts(TYPE2, prepared(z0, kicked(z0), angular))[-1]
    turned = there(jnp.asarray([0.3 - 2 * np.pi, 0.2]))
    np.testing.assert_allclose(there(jnp.asarray([0.3, 0.2])), turned, atol=1e-12)
    far = jax.vmap(there)(jnp.asarray([[0.3, 1e3], [0.3, -1e300]]))
    near = jax.vmap(there)(jnp.asarray(z0))
    assert np.abs(far).max() < 3 * np.abs(near).max()
    assert len(back.matrices) == len(there.matrices) == 1


def test_a_close_start_saves_updates_and_changes_only_roundoff():
    def pendulum(_, w):
        return 0.5 * w[1] ** 2 - jnp.cos(w[0])

    plain = Generated(pendulum, None, MIDPOINT, DT, jnp.ones(2))
    image, info = jax.jit(jax.vmap(plain))(jnp.asarray(STATES))
    there, back, _ = fit_starts(MIDPOINT, prepared(STATES, np.asarray(image)))[-1]
    started = Generated(pendulum, None, MIDPOINT, DT, jnp.ones(2), there, back)
    same, fewer = jax.jit(jax.vmap(started))(jnp.asarray(STATES))
    np.testing.assert_allclose(same, image, atol=2e-15, rtol=0)
    assert info.iterations.min() > 1
    assert fewer.iterations.max() == 1
    backward, there_and_back = jax.jit(jax.vmap(started.inverse()))(image)
    np.testing.assert_allclose(backward, STATES, atol=1e-15, rtol=0)
    assert there_and_back.iterations.max() == 1
