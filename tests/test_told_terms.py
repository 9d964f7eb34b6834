"""H of terms of whose coefficients a value, bounds or a multiple is told."""

from functools import cache

import numpy as np
import pytest
from analytic import moved
from scipy.optimize import least_squares

import gfnn_jax as gfnn
from gfnn_jax.coordinates import CARTESIAN
from gfnn_jax.dataset.dataset import Dataset
from gfnn_jax.dataset.measured_error import Tolerance
from gfnn_jax.dataset.runs import identified
from gfnn_jax.errors import InputError
from gfnn_jax.families.told import Told, told_of
from gfnn_jax.models.hamiltonians.libraries import own_terms
from gfnn_jax.models.hamiltonians.problem import LawProblem
from gfnn_jax.models.hamiltonians.search import learn_hamiltonian

TERMS = ("p1**2", "q1**2", "q1*p1", "q1**4")
TRUE = np.array([0.5, 0.5, 0.05, 0.1])


@cache
def pairs(noise):
    """Of H = ½p² + ½q² + 0.05 qp + 0.1 q⁴, by another solver."""
    rng = np.random.default_rng(0)
    z0 = rng.uniform(-1, 1, (80, 2))

    def field(_, z):
        q, p = z
        return [p + 0.05 * q, -q - 0.05 * p - 0.4 * q**3]

    z1 = moved(field, z0, 0.2)
    return gfnn.Pairs(z0, z1 + noise * rng.normal(size=z0.shape), 0.2)


def problem_of(told, noise=1e-3):
    data = Dataset.of(identified(pairs(noise)).pairs, CARTESIAN).divided(0)
    terms = [told.get(term, term) for term in TERMS]
    return LawProblem(data, Tolerance(0.05), terms=terms)


def coefficients(law):
    return [next((t.coefficient for t in law.terms if t.term == n), 0.0) for n in TERMS]


@pytest.mark.parametrize("draw", [0, *(pytest.param(k, marks=pytest.mark.slow) for k in (1, 2, 3))])
def test_bounds_are_kept_as_a_constrained_least_squares_keeps_them(draw):
    """Intervals at random, most of which exclude the truth, against scipy's trust region."""
    rng = np.random.default_rng(draw)
    middle = TRUE + 0.02 * rng.normal(size=4)
    low, high = middle - 0.01, middle + 0.01
    told = {
        n: f"{a!r} <= {n} <= {b!r}"
        for n, a, b in zip(TERMS, low.tolist(), high.tolist(), strict=True)
    }
    del told["q1**4"]  # free, for what the bounds shift
    low[3], high[3] = -np.inf, np.inf
    problem = problem_of(told)
    law = learn_hamiltonian(problem)
    problem = problem.beginning(problem.data)
    steps = problem.fitted(own_terms(problem), TRUE, problem.data.training).fit.steps

    def residuals(c):
        rows = problem.data.training
        return problem.flows.residuals(own_terms(problem), c, steps, rows).ravel()

    start = np.clip(TRUE, low + 1e-3, high - 1e-3)
    best = least_squares(residuals, start, bounds=(low, high), xtol=1e-12, ftol=1e-12, gtol=1e-12)
    np.testing.assert_allclose(coefficients(law), best.x, rtol=0, atol=2e-6)
    held = [name for name, side in zip(TERMS, best.active_mask, strict=True) if side]
    assert held
    assert [m.split(" is held")[0] for m in law.messages if "is held at its bound" in m] == held
    assert [t.std == 0 for t in law.terms] == [t.term in held for t in law.terms]


def test_a_value_and_a_multiple_hold():
    """Against least squares over the two numbers that are left."""
    told = {"p1**2": "p1**2 = 0.49", "q1**4": "q1**4 = 0.3*q1**2"}
    problem = problem_of(told)
    law = learn_hamiltonian(problem)
    a, b, c, d = coefficients(law)
    assert (a, d) == (0.49, pytest.approx(0.3 * b, rel=1e-15))
    problem = problem.beginning(problem.data)
    full = problem.fitted(own_terms(problem), TRUE, problem.data.training).fit

    def residuals(x):
        rows, every = problem.data.training, np.array([0.49, x[0], x[1], 0.3 * x[0]])
        return problem.flows.residuals(own_terms(problem), every, full.steps, rows).ravel()

    best = least_squares(residuals, [0.5, 0.05], xtol=1e-12, ftol=1e-12, gtol=1e-12)
    np.testing.assert_allclose([b, c], best.x, rtol=0, atol=1e-7)
    errors = {t.term: t.std for t in law.terms}
    assert errors["p1**2"] == 0
    assert errors["q1**4"] == pytest.approx(0.3 * errors["q1**2"])
    root = law.root
    assert root is not None
    assert root.shape == (4, 4)
    deviations = np.sqrt(np.sum(root**2, axis=0))
    order = [t.term for t in law.terms]
    assert deviations[order.index("p1**2")] == 0
    of_tied, of_source = (deviations[order.index(name)] for name in ("q1**4", "q1**2"))
    assert of_tied == pytest.approx(0.3 * of_source, rel=1e-6)


def test_what_is_exact_comes_out_exact_and_a_term_that_is_missing_is_found():
    """q1 p1 is not given: it comes from the polynomials beside the terms, and p1² is not free in
    them."""
    model = gfnn.Hamiltonian(
        terms={"p1**2": 0.5, "q1**4": "0.2*q1**2", "q1**2": gfnn.between(0, None)}
    )
    fit = gfnn.fit(pairs(0.0), model=model, tolerance=1e-9)
    assert fit.verdict == "identified"
    found = {t.term: t.coefficient for t in fit.hamiltonian.terms}
    assert found.pop("p1**2") == 0.5
    assert found == pytest.approx({"q1**4": 0.1, "q1**2": 0.5, "q1 p1": 0.05}, abs=1e-10)


@pytest.mark.slow
def test_a_wrong_value_is_no_identified_law():
    """The stated error is that of the law that is given back, refits of parts of the pairs too."""
    known, model = pairs(0.0), gfnn.Hamiltonian(terms={"q1**4": 0.05, "q1**2": None})
    with pytest.warns(gfnn.FitWarning, match="meets the tolerance"):
        fit = gfnn.fit(known, model=model, tolerance=1e-7)
    assert not fit.verdict.startswith("identified")
    off = np.asarray(fit.map.step(known.z0)[0]) - known.z1
    assert fit.chosen.validation_rms > 0.2 * np.sqrt(np.mean(off**2))


@pytest.mark.slow
def test_a_term_that_would_be_dropped_stays_at_its_bound():
    assert coefficients(learn_hamiltonian(problem_of({}, noise=0.05)))[2] == 0
    law = learn_hamiltonian(problem_of({"q1*p1": "q1*p1 >= 0.2"}, noise=0.05))
    assert coefficients(law)[2] == 0.2


def test_what_is_told_is_read():
    assert told_of("q1**2 >= -1") == Told("q1**2", -1.0, np.inf)
    assert told_of("cos(q2) = 2*cos(q1)") == Told("cos(q2)", times=2.0, of="cos(q1)")
    assert told_of("q2 = q1**2") == Told("q2", of="q1**2")
    with pytest.raises(InputError, match="expected low <= term"):
        told_of("3 <= q1 <= 2")


@pytest.mark.parametrize(
    ("terms", "options", "message"),
    [
        ({"p1**2": 0.5}, {}, "a coefficient that is free"),
        ({"p1**2": "q1**2", "q1**2": "q1**4", "q1**4": None}, {}, "no multiple itself"),
    ],
)
def test_what_cannot_be_told_is_refused(terms, options, message):
    with pytest.raises(gfnn.FitError, match=message):
        gfnn.fit(pairs(0.0), model=gfnn.Hamiltonian(terms=terms, **options))
