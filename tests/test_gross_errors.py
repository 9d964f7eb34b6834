"""Pairs that a map misses by far: gross errors, and states at the rim that it cannot follow."""

import types

import numpy as np
import pytest

from gfnn_jax.dataset.runs import first_occurrences
from gfnn_jax.learn import gross_errors
from gfnn_jax.phase_space import Pairs


class Sweep:
    """Two sizes of S on (−1, 1): the larger one leaves a thousandth in the middle, and a tenth at
    the rim, of what the smaller one leaves there. Both leave the gross errors that they are given.
    """

    def __init__(self, x, wrong):
        misfit = 1e-3 * np.exp(6 * np.abs(x)[:, None] ** 8) * np.cos(40 * x)[:, None]
        rim = 1e-3 * 100 ** (np.clip(np.abs(x) - 0.9, 0, None) / 0.1)[:, None]
        self.sizes = ["small", "large"]
        self._left = {"small": misfit + wrong, "large": rim * misfit + wrong}

    def residuals(self, size):
        return self._left[size]


@pytest.mark.parametrize("at_rim", [True, False])
def test_states_at_the_rim_are_told_from_gross_errors(at_rim, monkeypatch):
    x = np.linspace(-1, 1, 801)
    wrong, inside = np.zeros((801, 1)), np.array([200, 333, 512])
    wrong[inside] = 0.02
    sweep = Sweep(x, wrong)
    monkeypatch.setattr(gross_errors, "_swept", lambda found: (sweep, "large"))
    found = types.SimpleNamespace(data=x, law=None)
    rows = np.array([0, 1, 799, 800]) if at_rim else inside
    assert gross_errors._at_the_rim(found, rows) is at_rim


def test_copies_are_found_whatever_the_sign_of_a_zero():
    rng = np.random.default_rng(0)
    z0, z1 = rng.normal(size=(2, 1_000, 4))
    assert len(first_occurrences(Pairs(z0, z1, 0.1))) == 1_000
    z0[[3, 700], 0] = [0.0, -0.0]
    z0[700, 1:], z1[700] = z0[3, 1:], z1[3]
    assert 700 not in first_occurrences(Pairs(z0, z1, 0.1))
    assert len(first_occurrences(Pairs(z0, z1, 0.1))) == 999
