"""Arcs of several steps, and the counted budget of a search for H."""

import dataclasses

import numpy as np
import pytest

import gfnn_jax as gfnn
from gfnn_jax.budget import Allowance, Counted
from gfnn_jax.coordinates import CARTESIAN, Coordinates
from gfnn_jax.dataset.dataset import Dataset
from gfnn_jax.dataset.runs import identified
from gfnn_jax.errors import OutOfTime
from gfnn_jax.families.terms import given_terms
from gfnn_jax.fitting.gauss_newton import Problem
from gfnn_jax.flows.collocation import Steps, images
from gfnn_jax.models.hamiltonians import search as flows
from gfnn_jax.models.hamiltonians.sequences import arcs_of

LAW, TRUE = given_terms(1, ["p**2", "q**2", "q**4"]), np.array([0.5, 0.5, 0.25])
QUIETLY = pytest.mark.filterwarnings("ignore::gfnn_jax.errors.FitWarning")


def sequences(dt, noise=1e-3, count=20, length=60, seed=0):
    """Pairs of sequences of an anharmonic oscillator with this noise on every number."""
    rng = np.random.default_rng(seed)
    states = [rng.uniform(-1, 1, (count, 2))]
    for _ in range(length - 1):
        states.append(images(LAW, TRUE, states[-1], dt, Steps(6, 2)).states)
    states = np.stack(states, axis=1)
    states += noise * rng.normal(size=states.shape)
    return gfnn.Pairs(states[:, :-1].reshape(-1, 2), states[:, 1:].reshape(-1, 2), dt)


def arcs(pairs, coordinates=CARTESIAN):
    data = Dataset.of(identified(pairs).pairs, coordinates).divided(0)
    return arcs_of(data), data


@pytest.mark.parametrize(
    ("dt", "noise", "lengths"),
    [
        (0.02, 1e-3, range(8, 30)),  # a step is a thirtieth of the spread, or less
        (0.02, 1e-5, range(0, 1)),  # which this noise leaves plain
        pytest.param(0.02, 0.0, range(0, 1), marks=pytest.mark.slow),
        pytest.param(0.5, 1e-3, range(0, 1), marks=pytest.mark.slow),
        (0.001, 1e-3, range(29, 30)),  # half a sequence
    ],
)
def test_an_arc_is_as_long_as_the_noise_asks(dt, noise, lengths):
    found, _ = arcs(sequences(dt, noise))
    assert (0 if found is None else found[1]) in lengths


def test_arcs_are_chains_within_their_sequences_and_their_set():
    pairs = sequences(0.02)
    found, data = arcs(pairs)
    own, k = found
    of = own.pairs
    assert own.dt == of.dt == k * 0.02
    every = {row.tobytes(): i for i, row in enumerate(np.column_stack([pairs.z0, pairs.z1]))}
    place = {row.tobytes(): i for i, row in enumerate(pairs.z0)}
    first = np.array([place[row.tobytes()] for row in of.z0])
    assert len(every) == len(pairs)
    np.testing.assert_array_equal(pairs.z1[first + k - 1], of.z1)
    assert (first // 59 == (first + k - 1) // 59).all()  # 59 pairs of a sequence
    for rows, of_pairs in ((own.training, data.training), (own.validation, data.validation)):
        assert np.isin(first[rows][:, None] + np.arange(k), of_pairs).all()
    goes_on = np.all(of.z1[:-1] == of.z0[1:], axis=1)
    assert goes_on.mean() > 0.3  # the noise that neighbours share is known


def test_angles_go_on_over_their_turns():
    t, p = 0.02 * np.arange(60), np.linspace(2, 4, 20)[:, None]
    states = np.stack([np.mod(p * t + p**2, 2 * np.pi), p + 0 * t], axis=-1)
    states[..., 1] += 1e-2 * np.random.default_rng(0).normal(size=(20, 60))
    pairs = gfnn.Pairs(states[:, :-1].reshape(-1, 2), states[:, 1:].reshape(-1, 2), 0.02)
    (found, length), _ = arcs(pairs, Coordinates("cartesian", angles=(0,)))
    moved = found.y1[:, 0] - found.y0[:, 0]
    turned = np.repeat(p[:, 0], 60 - length) * 0.02 * length
    np.testing.assert_allclose(moved, turned, atol=1e-12)


@pytest.mark.slow
@QUIETLY
def test_arcs_tell_the_law_better_than_steps(monkeypatch):
    def error(fit):
        found = {t.term: t.coefficient for t in fit.hamiltonian.terms}
        return np.sqrt(np.mean((np.array([found[n] for n in LAW.term_names]) - TRUE) ** 2))

    pairs, given = sequences(0.005, length=100), {"terms": ["p**2", "q**2", "q**4"]}
    by_arcs = gfnn.fit(pairs, learn="hamiltonian", tolerance=0.1, **given)
    monkeypatch.setattr(flows, "arcs_of", lambda *_: None)
    by_steps = gfnn.fit(pairs, learn="hamiltonian", tolerance=0.1, **given)
    assert float(by_arcs.map.dt) == 0.005
    assert error(by_arcs) < 0.5 * error(by_steps)
    root = by_arcs.hamiltonian.root
    deviation = np.sqrt(np.mean(np.diag(root.T @ root)))
    assert 1 / 3 < error(by_arcs) / deviation < 3


# A budget of operations.


@pytest.mark.slow
def test_a_counted_budget_ends_where_it_is_spent():
    pairs = sequences(0.3, 0.0)
    counted = Counted(np.inf)
    problem = Problem(pairs.z0, pairs.z1, 0.3, np.ones(2), allowance=Allowance(cap=counted))
    first = problem.fit(LAW, TRUE + 0.1)
    spent = counted.spent
    assert spent > 0
    problem.allowance = Allowance(cap=(again := Counted(0.5 * spent)))
    with pytest.raises(OutOfTime):
        problem.fit(LAW, TRUE + 0.1)
    assert 0.5 * spent < again.spent < spent
    np.testing.assert_allclose(first.coefficients, TRUE, atol=1e-12)


@pytest.mark.slow
@QUIETLY
def test_a_search_for_h_ends_at_its_cap(monkeypatch):
    pairs = sequences(0.3, 0.0)
    few = dataclasses.replace(flows._BESIDE, max_operations=1.0)
    monkeypatch.setattr(flows, "_BESIDE", few)
    found = gfnn.fit(pairs, tolerance=1e-9, max_seconds=None)
    assert found.hamiltonian is None
    assert any("left out: H (" in message for message in found.messages)
