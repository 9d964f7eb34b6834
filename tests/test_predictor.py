"""Predictors: close on the data, harmless far from them, for both directions."""

import dataclasses
from functools import partial

import jax
import numpy as np
import pytest
from analytic import generated, leapfrog, pendulum

from gfnn_jax.families.inputs import box_inputs
from gfnn_jax.families.products import Products
from gfnn_jax.generating.charts import CHARTS, MIDPOINT, TYPE2
from gfnn_jax.generating.predictor import (
    CLOSE,
    Fitted,
    PolynomialModel,
    Predictor,
    affordable,
    fit_predictors,
)

DT = 0.4
STATES = np.random.default_rng(0).uniform(-1, 1, (600, 2))


def unknowns(chart, z0, z1):
    free = chart.free(z0.shape[1] // 2)
    return (chart.evaluation_point(z0, z1) - chart.first_guess(z0))[:, free]


@pytest.mark.parametrize("chart", CHARTS.values(), ids=lambda chart: chart.name)
def test_of_an_affine_map_is_its_solution_either_way(chart):
    turn = np.array([[np.cos(0.4), np.sin(0.4)], [-np.sin(0.4), np.cos(0.4)]])
    z0, z1 = STATES, STATES @ turn.T + np.array([0.2, -0.1])
    found, *more = fit_predictors(chart, z0, z1, DT)
    assert not more  # degree 1 is close enough
    assert found.error < 1e-12
    forward, backward = found.predictor.forward, found.predictor.reverse().forward
    np.testing.assert_allclose(forward(z0), unknowns(chart, z0, z1), atol=1e-13)
    behind = chart.reverse(DT)[0]
    np.testing.assert_allclose(backward(z1), unknowns(behind, z1, z0), atol=1e-13)


@pytest.fixture(scope="module")
def rising():
    return fit_predictors(MIDPOINT, STATES, leapfrog(STATES, DT), DT)


def test_the_degree_rises_until_the_model_is_close(rising):
    target = unknowns(MIDPOINT, STATES, leapfrog(STATES, DT))
    errors = [np.abs(f.predictor.forward(STATES) - target).max() for f in rising]
    assert (np.diff(errors) < 0).all()
    assert errors[-1] < 1e-7
    assert errors[0] > 1e-3
    assert (np.diff([f.predictor.forward.operations for f in rising]) > 0).all()


def test_numpy_and_jax_agree(rising):
    model = rising[-1].predictor.forward
    found = jax.jit(lambda model, z: model(z))(model, STATES)
    np.testing.assert_allclose(found, model(STATES), rtol=0, atol=1e-14)
    np.testing.assert_allclose(model(STATES[0]), model(STATES)[0], rtol=0, atol=1e-15)


def test_what_a_family_affords_rises_with_its_cost(rising):
    degrees = []
    for degree in (2, 4, 8, 20):
        family = Products(box_inputs(STATES), degree)
        gradient, with_hessian = family.operations
        chosen = affordable(rising, family)
        model = chosen.predictor.forward
        assert (
            model.operations <= 0.5 * gradient
            or model.family.degree == 1
            or (chosen.error <= CLOSE and model.operations <= 5 * with_hessian)
        )
        degrees.append(model.family.degree)
    assert degrees == sorted(degrees)
    assert degrees[-1] == rising[-1].predictor.forward.family.degree


class Costing(PolynomialModel):
    """A model, or a family, of which only the operations count."""

    operations = None

    def __init__(self, operations):
        object.__setattr__(self, "operations", operations)


def test_a_dear_model_is_taken_where_it_spares_updates():
    """Check the choice: the closest predictor that costs no more than it saves."""
    known = ((1e-3, 40), (1e-6, 600), (4e-8, 1_800), (5e-9, 2_600))
    fitted = [Fitted(Predictor(Costing(n), Costing(n)), error) for error, n in known]
    assert affordable(fitted, Costing((100, 400))).error == 4e-8
    assert affordable(fitted, Costing((100, 600))).error == 5e-9
    assert affordable(fitted, Costing((100, 200))).error == 1e-3
    assert affordable(fitted, Costing((10_000, 20_000))).error == 5e-9


def test_noise_and_few_pairs_end_the_rise():
    rng = np.random.default_rng(1)
    noisy = leapfrog(STATES, DT) + 1e-2 * rng.standard_normal(STATES.shape)
    assert len(fit_predictors(TYPE2, STATES, noisy, DT)) <= 3
    few = fit_predictors(TYPE2, STATES[:12], leapfrog(STATES[:12], DT), DT)
    assert few[-1].predictor.forward.family.num_parameters <= 4


def test_a_coordinate_at_rest_has_no_part_in_it():
    """Check a coordinate at rest, whose products vanish, and a constant one that is not zero."""
    rest = np.zeros((600, 1))
    z0, z1 = (
        np.concatenate([z[:, :1], rest, z[:, 1:], rest + 0.1], axis=1)
        for z in (STATES, leapfrog(STATES, DT))
    )
    model = fit_predictors(MIDPOINT, z0, z1, DT)[-1].predictor.forward
    np.testing.assert_allclose(model(z0), unknowns(MIDPOINT, z0, z1), rtol=0, atol=1e-5)


def test_angles_go_round_and_the_rest_stays_small_far_away():
    z0 = STATES * [np.pi, 1.0]
    model = fit_predictors(TYPE2, z0, leapfrog(z0, DT), DT, partial(box_inputs, angles=(0,)))[
        -1
    ].predictor.forward
    turned = model(np.array([0.3 - 2 * np.pi, 0.2]))
    np.testing.assert_allclose(model(np.array([0.3, 0.2])), turned, atol=1e-12)
    far = model(np.array([[0.3, 1e3], [0.3, -1e300]]))
    assert np.abs(far).max() < 3 * np.abs(model(z0)).max()
    assert len(model.matrices) == 1  # one unknown: P


@jax.jit
def there_and_back(piece, z):
    image, info = piece.step(z)
    return image, info, *piece.inverse().step(image)


@pytest.mark.slow
def test_a_close_start_saves_updates_and_changes_only_roundoff():
    plain = generated(pendulum, 1.0, MIDPOINT, DT)
    image, info, _, _ = there_and_back(plain, STATES)
    fitted = fit_predictors(MIDPOINT, STATES, np.asarray(image), DT)[-1]
    started = dataclasses.replace(plain, predictor=fitted.predictor)
    same, fewer, back, fewer_back = there_and_back(started, STATES)
    np.testing.assert_allclose(same, image, atol=2e-15, rtol=0)
    np.testing.assert_allclose(back, STATES, atol=2e-15, rtol=0)
    assert info.iterations.min() > 1
    assert fewer.iterations.max() == fewer_back.iterations.max() == 1
