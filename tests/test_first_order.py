"""Records of which positions tell the velocities: of first order, or one orbit of a law."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import gfnn_jax as gfnn
from gfnn_jax.models.lagrangians.first_order import plain_field
from gfnn_jax.models.lagrangians.recordings import samples_of


def recorded(rates, start, seconds, dt, columns=2, noise=1e-3):
    t = np.arange(0, seconds, dt)
    x = solve_ivp(rates, (0, seconds), start, t_eval=t, rtol=1e-9, atol=1e-11).y.T[:, :columns]
    x = x + noise * x.std(axis=0) * np.random.default_rng(1).normal(size=x.shape)
    names = [f"x{i + 1}" for i in range(columns)]
    table = {"t": t, **dict(zip(names, x.T, strict=True))}
    return gfnn.Recording(table, positions=names, angles=[])


def membrane(_, z):
    return [z[0] - z[0] ** 3 / 3 - z[1] + 0.5, 0.08 * (z[0] + 0.7 - 0.8 * z[1])]


def planet(_, z):
    pull = -1.5 / np.hypot(z[0], z[1]) ** 3
    return [z[2], z[3], pull * z[0], pull * z[1]]


def test_the_equations_of_a_membrane_are_found():
    """FitzHugh and Nagumo's: every orbit of first order is one of a mechanical law too."""
    record = recorded(membrane, [-1.0, 1.0], 150, 0.3)
    field = plain_field(samples_of(record).problem, ("x1", "x2"))
    first, second = field.split(", ")
    assert [first.count(x) for x in ("x1", "x2", "x1**3")] == [3, 1, 1]  # x1_dot and x1**3 too
    assert float(second.split()[-1].rpartition("*")[0]) == pytest.approx(0.064, abs=1e-3)


@pytest.mark.slow
def test_an_orbit_of_equal_springs_may_be_of_first_order():
    """q̇ = A q with six numbers, and springs with six: the same ellipse."""
    start = [1.0, 0.0, 0.3, 0.6]
    record = recorded(lambda _, z: [z[2], z[3], -z[0], -z[1]], start, 30, 0.1)
    fit = gfnn.fit(record)
    verdict = str(fit.verdict)
    assert verdict.startswith("one of several: first order or mechanical")
    assert "x1_dot = " in verdict


@pytest.mark.slow
def test_an_ellipse_about_a_sun_is_a_law_of_one_force():
    """A field of first order needs a dozen terms of it, and two would not do."""
    fit = gfnn.fit(recorded(planet, [0.6, 0.0, 0.0, 1.95], 40, 0.1))
    assert fit.verdict == "identified"
    assert "1/sqrt(x1**2 + x2**2)" in str(fit.formula)


@pytest.mark.slow
def test_a_membrane_is_not_mechanical():
    with pytest.raises(gfnn.FitError) as refused:
        gfnn.fit(recorded(membrane, [-1.0, 1.0], 150, 0.3))
    assert refused.value.verdict.startswith("not mechanical: first order")
    assert "x1**3" in refused.value.verdict
