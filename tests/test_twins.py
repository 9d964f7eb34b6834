"""Laws of simulated records come out exactly (benchmarks/twins.py holds more of them)."""

import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent.parent / "benchmarks"))

import twins


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "noise"), [("pendulum", 1e-6), ("two_carts", 1e-3), ("arm1", 1e-6)]
)
def test_the_terms_of_a_twin_come_out_with_true_errors(name, noise):
    """Of positions far less noisy than local cubics can tell; of a law that is one of a family,
    all of which move two springs alike; with dry friction that is not smooth."""
    found = twins.case(name, noise, 0)
    assert found["same"] == {"lagrangian": True, "friction": True}
    assert max(found["standard_errors"].values()) < 4


def test_terms_lose_zeros():
    assert twins.plain("omega1*omega2*cos(theta1 - theta2 + 0.0065)") == (
        "omega1*omega2*cos(theta1 - theta2)"
    )
    assert twins.plain("cos(theta - 7.1699e-05)") == "cos(theta)"
