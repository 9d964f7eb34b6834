"""Laws whose terms are given: text in, exactly these terms out."""

import numpy as np
import pytest
from test_law_fits import pendulum

import gfnn_jax as gfnn
from gfnn_jax.errors import InputError
from gfnn_jax.families.lagrangian import DRY, LINEAR, QUADRATIC
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
    )


def test_masses_are_there_without_being_said():
    found = read("V: cos(theta1) + cos(theta2)")
    assert found.terms[:2] == (V1, ((0, 2), (0, 0), (0, 0), 0.0))
    assert found.friction is None
    assert read("V: cos(theta1)", "R: 0*omega1**2").friction == (((1, 0), LINEAR, 0.0),)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("exp(theta1)", "'exp\\(theta1\\)' is no term of a law"),
        ("cos(0.5*theta1)", "is no term"),
        ("omega1**2*omega2", "is no term"),
        ("theta3**2", "is no term"),
        ("omega2**2", "add a kinetic one, omega1\\*\\*2"),
        ("V: omega1**2", "has a velocity"),
        ("R: omega1**4", "is no term"),
        ("R: theta1**2", "is no term"),
        ("T: omega1**2", "expected L:, V: or R:"),
        ("omega1 +* 2", "cannot be read"),
    ],
)
def test_what_is_no_term_is_refused(text, message):
    with pytest.raises(InputError, match=message):
        read(text)


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
    with pytest.raises(InputError, match="'exp\\(theta\\)' is no term"):
        gfnn.fit(recording, terms=["exp(theta)"])
