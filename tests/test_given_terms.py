"""Laws whose terms are given: text in, exactly these terms out."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from test_law_fits import pendulum

import gfnn_jax as gfnn
from gfnn_jax.errors import InputError
from gfnn_jax.families.friction import DRY, LINEAR, PLACED, QUADRATIC, Friction
from gfnn_jax.families.lagrangian import Terms
from gfnn_jax.models.lagrangians.given_terms import given_terms

POSITIONS, SPEEDS = ("theta1", "theta2"), ("omega1", "omega2")
V1 = ((2, 0), (0, 0), (0, 0), 0.0)


def read(*texts):
    return given_terms(texts, POSITIONS, SPEEDS)


def test_terms_are_read_as_they_are_written():
    found = read(
        "0.5*omega1**2 - 3*omega1*omega2*cos(theta1 - theta2 + 0.1) + omega2²/4",
        "V: theta1**2*theta2*sin(2*theta2)",
        ["R: omega1**2", " abs(omega2 - omega1)**3"][0],
        "R: abs(omega2 - omega1)**3 + sqrt(omega2**2 + 0.04) + abs(omega1)",
        "R: theta2**2*omega2**2 + (omega1 - omega2)**2*(theta1 - theta2 + 0.4)**2/2",
    )
    assert found.terms == (
        V1,
        ((1, 1), (0, 0), (1, -1), 0.1),
        ((0, 2), (0, 0), (0, 0), 0.0),
        ((0, 0), (2, 1), (0, 2), -np.pi / 2),
    )
    assert found.friction == (
        ((1, 0), LINEAR, 0.0),
        ((-1, 1), QUADRATIC, 0.0),
        ((0, 1), DRY, 0.2),
        ((1, 0), DRY, 0.0),
        ((0, 1), PLACED, 0.0),
        ((1, -1), PLACED, -0.4),
    )
    texts = [text for text, _ in Friction.of(found.friction, 2).texts(SPEEDS, (), POSITIONS)]
    assert texts[-1] == "(theta1 - theta2 + 0.4)**2*(omega2 - omega1)**2"
    assert read(*(f"R: 2*{text}" for text in texts)).friction == found.friction


def test_shapes_are_what_is_no_power_and_no_wave():
    found = read(
        "omega1**2 + omega1*theta2 + omega1**2*exp(-theta2)/2",
        "cos(theta1)*theta2*log(1 + theta1**2)",
        "V: 3/sqrt(theta1**2 + theta2**2) + (theta1 - theta2)**2 + 1/theta1 + cos(theta1/2)",
        "V: theta1**10 + cos(theta1)*cos(theta2)",
    )
    none = (0, 0)
    assert found.terms[1:] == (
        ((1, 0), (0, 1), none, 0.0),
        ((2, 0), none, none, 0.0, "exp(-q2)"),
        (none, (0, 1), (1, 0), 0.0, "log(1 + q1**2)"),
        (none, none, none, 0.0, "1/sqrt(q1**2 + q2**2)"),
        (none, none, none, 0.0, "(q1 - q2)**2"),
        (none, none, none, 0.0, "1/q1"),
        (none, none, none, 0.0, "cos(0.5*q1)"),
        (none, none, none, 0.0, "q1**10"),
        (none, none, (1, 0), 0.0, "cos(q2)"),
    )
    texts = Terms.of(found.terms, 2).texts(POSITIONS, SPEEDS)
    assert texts[2:6:3] == ("omega1**2*exp(-theta2)", "(theta1 - theta2)**2")
    assert read(*(f"-2*{text}" for text in texts)).terms == found.terms


def test_masses_are_there_without_being_said():
    found = read("V: cos(theta1) + cos(theta2)")
    assert found.terms[:2] == (V1, ((0, 2), (0, 0), (0, 0), 0.0))
    assert found.friction is None
    assert read("V: cos(theta1)", "R: 0*omega1**2").friction == (((1, 0), LINEAR, 0.0),)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("exp(omega1)", "'exp\\(omega1\\)' is no term of a law"),
        ("theta3**2", "the name 'theta3'"),
        ("R: omega1**5", "is no term"),
        ("R: theta1**2*omega2**2", "is no term"),
        ("R: theta1**2*(omega1 + 1)**2", "is no term"),
    ],
)
def test_what_is_no_term_is_refused(text, message):
    with pytest.raises(InputError, match=message):
        read(text)


@pytest.mark.slow
def test_exactly_these_terms_are_fitted():
    t, theta = pendulum(end=20.0)
    recording = gfnn.Recording({"t": t, "theta": theta}, positions=["theta"], angles=["theta"])
    fit = gfnn.fit(recording, terms=["V: cos(theta) + cos(2*theta)", "R: omega**2"])
    assert [term.term for term in fit.friction.terms] == ["omega**2"]
    assert len(fit.lagrangian.terms) == 3
    first, second = fit.lagrangian.terms[1:]
    assert abs(first.coefficient - 2) < 4 * first.std < 0.02
    assert abs(second.coefficient) < 4 * second.std < 0.02  # it is not there
    again = gfnn.fit(recording, terms=[fit.formula, f"R: {fit.friction.formula}"])
    assert again.lagrangian.terms[1].coefficient == pytest.approx(first.coefficient, rel=1e-3)
    with pytest.raises(InputError, match="'exp\\(omega\\)' is no term"):
        gfnn.fit(recording, terms=["exp(omega)"])


@pytest.mark.slow
def test_a_law_with_a_distance():
    """An orbit around a centre, with drag; its law is read again, saved, forecast and exported."""
    t = 0.05 * np.arange(400)

    def field(_, z):
        pull = (z[0] ** 2 + z[1] ** 2) ** -1.5
        return [z[2], z[3], -pull * z[0] - 0.02 * z[2], -pull * z[1] - 0.02 * z[3]]

    options = {"t_eval": t, "rtol": 1e-10, "atol": 1e-10}
    orbit = solve_ivp(field, (0, t[-1]), [1.0, 0.0, 0.2, 1.1], **options).y[:2]
    seen = orbit + 1e-3 * np.random.default_rng(0).normal(size=orbit.shape)
    recording = gfnn.Recording({"t": t, "x": seen[0], "y": seen[1]}, positions=["x", "y"])
    fit = gfnn.fit(recording.slice(stop=15.0), terms=["V: 1/sqrt(x**2 + y**2)"], friction="linear")
    assert fit.verdict == "identified"
    _, _, pull = fit.lagrangian.terms
    assert pull.term == "1/sqrt(x**2 + y**2)"
    assert abs(pull.coefficient - 1) < 4 * pull.std < 1e-2
    assert "sqrt" in fit.lagrangian.latex()
    past, later = recording.slice(10.0, 15.0), t[301:320]
    ahead = fit.map.forecast(past, later).values
    assert abs(ahead["x"][0] - orbit[0, 301:320]).max() < 2e-3


@pytest.mark.parametrize(
    ("told", "low", "high"),
    [
        ("0 <= cos(theta1)", 0.0, np.inf),
        ("cos(theta1) <= 3", -np.inf, 3.0),
        ("-2 <= cos(theta1) <= 1e3", -2.0, 1e3),
        ("cos(theta1) = -7.5", -7.5, -7.5),
        ("0 <= V: cos(theta1) <= 2", -2.0, 0.0),
    ],
)
def test_what_is_told_of_a_coefficient(told, low, high):
    (one,) = read(told).told
    assert one[1:] == (low, high, None)
    assert one.row in read(told).terms


@pytest.mark.parametrize("told", ["3 <= cos(theta1) <= 2", "R: omega1**2 = 1"])
def test_what_cannot_be_told(told):
    with pytest.raises(InputError, match=r"terms: expected|a multiple of"):
        read(told)


@pytest.mark.slow
def test_bounds_values_and_ties_of_coefficients():
    """Of L = ½ω² + 20 cos θ − 2 cos 2θ the wrong bound is held; the tie is right."""
    t = np.arange(0, 8, 0.05)
    force = lambda _, z: [z[1], -20 * np.sin(z[0]) + 4 * np.sin(2 * z[0]) - 0.1 * z[1]]  # noqa: E731
    q = solve_ivp(force, (0, 8), [1.5, 0.0], t_eval=t, rtol=1e-9).y[0]
    swing = gfnn.Recording(
        {"t": t, "theta": q + 1e-4 * np.random.default_rng(0).normal(size=len(t))}
    )

    def fitted(single, double):
        terms = {"cos(theta)": single, "cos(2*theta)": double}
        return gfnn.fit(swing, model=gfnn.Lagrangian(terms=terms, friction="linear"))

    tied = fitted(single=gfnn.between(0, None), double="-0.1*cos(theta)")
    both = {term.term: term for term in tied.lagrangian.terms}
    (single,) = [one for name, one in both.items() if name.startswith("cos(theta")]
    (double,) = [one for name, one in both.items() if name.startswith("cos(2*theta")]
    assert single.coefficient == pytest.approx(20.0, rel=2e-3)
    assert double.coefficient == pytest.approx(-0.1 * single.coefficient, rel=1e-12)
    assert double.std == pytest.approx(0.1 * single.std, rel=1e-9)
    assert not any("bound" in message for message in tied.messages)
    with pytest.warns(gfnn.FitWarning, match="is held at its bound"):
        bound = fitted(single=None, double=gfnn.between(-1.5, 5))
    held = next(t for t in bound.lagrangian.terms if t.term.startswith("cos(2*theta"))
    assert (held.coefficient, held.std) == (-1.5, 0.0)
