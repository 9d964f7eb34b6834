"""Laws that are one exchange of terms away, against the systems that made the records."""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest
from analytic import motion

import gfnn_jax as gfnn
from gfnn_jax.models.lagrangians.exchange import Exchanged, _explains


def record(rate, start, end, dt, noise, seed=0):
    """Positions of q'' = rate(q, v) from rest, with noise, a share of the spread of the first."""
    d, t = len(start), np.arange(0, end, dt)
    q = motion(rate, [*start, *np.zeros(d)], t, max_step=dt)
    q = q + noise * q[0].std() * np.random.default_rng(seed).normal(size=q.shape)
    names = [f"x{i + 1}" for i in range(d)]
    return gfnn.Recording({"t": t, **dict(zip(names, q, strict=True))}, positions=names)


def words(formula):
    return {term.term for term in formula.terms}


@pytest.mark.parametrize(
    ("other", "above", "taken"),
    [(3, -5.0, True), (3, 1.0, False), (6, -5.0, False), (None, -5.0, False)],
)
def test_where_residuals_are_correlated_a_likelier_law_of_as_many_terms_is_plainer(
    other, above, taken
):
    """x³ in place of x⁵, not x⁶, and not fewer terms, which leave out what friction takes."""

    def fit(*powers):
        terms = [((0,), (power,)) for power in powers]
        structure = SimpleNamespace(terms=terms, friction=())
        fitted = SimpleNamespace(cost=100.0)
        return SimpleNamespace(p=powers, correlation=3.0, structure=structure, fitted=fitted)

    one = Exchanged(fit(2, *[other] * (other is not None)), above)
    assert _explains(one, fit(2, 5)) == taken


@pytest.mark.slow
@pytest.mark.parametrize(
    ("hardening", "end", "noise"), [(0.1, 50.0, 3e-2), (0.3, 100.0, 3e-2), (0.3, 100.0, 1e-4)]
)
def test_a_law_beside_which_noise_leaves_others_is_one_of_several(hardening, end, noise, tmp_path):
    made = record(lambda q, v: -q - hardening * q**3 - 0.02 * v, [1.0], end, 0.6, noise)
    fit = gfnn.fit(made)
    law = fit.law
    assert words(law.lagrangian) == {"v1**2", "x1**2", "x1**4"}
    assert any(rival.leaves_open for rival in law.rivals) == (law.verdict != "identified")
    if noise < 1e-3:
        assert (law.rivals, law.verdict) == ((), "identified")
    elif hardening > 0.2:  # others have terms more that may be chance
        assert (len(law.rivals) > 0, law.verdict) == (True, "identified")
    else:
        assert law.verdict.startswith("one of several")
        assert law.rivals[0].terms in law.verdict
        assert all(rival.odds < 20 for rival in law.rivals)
        assert law.next_motions[0].start["x1"] > 1.5  # farther out than the record
        assert law.next_motions[0].apart > 3
        ahead, sensors = end + 0.6 * np.arange(1, 40), law.map.sensors
        alone = dataclasses.replace(law.map, sensors=dataclasses.replace(sensors, rivals=()))
        found, plain = law.map.forecast(made, ahead, coverage=0.95), law.map.forecast(made, ahead)
        narrow = alone.forecast(made, ahead, coverage=0.95)
        np.testing.assert_array_equal(plain.std["x1"], narrow.std["x1"])
        np.testing.assert_array_equal(found.values["x1"], narrow.values["x1"])
        assert np.all(found.std["x1"] > narrow.std["x1"])
        assert 0 < sum(share for _, share in sensors.rivals) < 1
        fit.map.save(tmp_path / "model")
        again = gfnn.load(tmp_path / "model").map.forecast(made, ahead, coverage=0.95)
        np.testing.assert_array_equal(again.std["x1"], found.std["x1"])


@pytest.mark.slow
def test_dry_friction_of_two_carts_is_not_that_of_their_relative_speed():
    """Masses, springs and friction of both carts are nearly collinear: no single term may go."""

    def rate(q, v):
        force = np.array([-1.7 * q[0] + 0.9 * q[1], 0.9 * q[0] - 1.7 * q[1]])
        return (force - 0.004 * np.tanh(v / 1e-4)) / [1.0, 1.2]

    made = record(rate, [1.0, -0.4], 80.0, 0.3, 1e-4)
    law = gfnn.fit(made).law
    assert words(law.lagrangian) == {"v1**2", "v2**2", "x1**2", "x1*x2", "x2**2"}
    assert words(law.friction) == {"abs(v1)", "abs(v2)"}


@pytest.mark.slow
def test_friction_that_is_stronger_one_way_is_no_constant_force():
    """By a tenth. Residuals without it are correlated by what they lack, and count all the same."""
    made = record(lambda q, v: -q - 0.04 * v + 0.004 * abs(v), [1.5], 60.0, 0.25, 1e-3, 1)
    law = gfnn.fit(made).law
    assert words(law.lagrangian) == {"v1**2", "x1**2"}
    ways = [(term.coefficient, term.std) for term in law.friction.terms]
    for (found, error), true in zip(sorted(ways, reverse=True), (0.0055, 0.0045), strict=True):
        assert found == pytest.approx(true, abs=4 * error)
        assert error < 2e-4
