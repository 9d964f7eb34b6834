"""Pairs that a map misses by far: gross errors, and states at the rim that it cannot follow."""

import dataclasses
import types

import numpy as np
import pytest

import gfnn_jax as gfnn
from gfnn_jax.budget import FLOW, RATES, Budget
from gfnn_jax.dataset.runs import first_occurrences
from gfnn_jax.flows.flow import Flow
from gfnn_jax.learn import fit, gross_errors
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


# Gross errors are looked for within the budget.


class Caught(Exception):
    """What a fit hands to `without_gross_errors`."""


@pytest.fixture(scope="module")
def spoilt():
    """(request, search) of an oscillator with noise, three of whose images are then
    moved: before the search neighbours would tell them."""
    rng = np.random.default_rng(0)
    z0 = rng.uniform(-1, 1, (300, 2))
    turn = np.array([[np.cos(0.5), np.sin(0.5)], [-np.sin(0.5), np.cos(0.5)]])
    z1 = z0 @ turn.T + 1e-4 * rng.normal(size=z0.shape)

    def caught(*given):
        raise Caught(*given)

    pairs = Pairs(z0, z1, 0.5)
    options = {"learn": "hamiltonian", "terms": ["q1**2", "p1**2"], "tolerance": 1e-6}
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(fit, "without_gross_errors", caught)
        with pytest.raises(Caught) as known:
            gfnn.fit(pairs, max_seconds=None, **options)
    request, found = known.value.args
    z1 = found.data.y1.copy()
    z1[[20, 150, 222]] += 0.03
    data = dataclasses.replace(found.data, y1=z1, pairs=dataclasses.replace(pairs, z1=z1))
    return request, found._replace(data=data)


@pytest.fixture
def looked_for(spoilt, monkeypatch):
    """Budget -> (number of pairs that are left, the states whose image was asked for)."""
    asked, image = [], Flow.image
    request, found = spoilt

    def counted(self, z, *args):
        asked.append(len(z))
        return image(self, z, *args)

    def looked(budget):
        asked.clear()
        given = dataclasses.replace(request, budget=budget)
        monkeypatch.setattr(Flow, "image", counted)
        return len(gross_errors.without_gross_errors(given, found)[0].data), sum(asked)

    return looked


@pytest.mark.slow
@pytest.mark.parametrize("part", [0.9, 1.1])
def test_where_the_budget_has_no_room_for_all_pairs_none_is_looked_at(part, spoilt, looked_for):
    """At a part of the operations, and of the seconds, that the residuals alone take; with a
    little more there is no room for the neighbours."""
    work = 300 * spoilt[1].law.candidate.operations
    clock = Budget(max_seconds=part * work / RATES[FLOW], clock=lambda: 0.0)
    for budget in (clock, Budget(max_operations=int(part * work))):
        assert looked_for(budget) == (300, 300 * (part > 1))
        (told,) = budget.left_out
        assert "left out: the search for pairs that the map misses by far (" in told
        assert budget.operations <= part * work
    again = Budget(max_operations=clock.operations)
    assert looked_for(again) == (300, 300 * (part > 1))
    assert again.operations == clock.operations
