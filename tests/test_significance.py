"""Terms that noisy rows tell from noise."""

from itertools import combinations

import numpy as np
import pytest

from gfnn_jax.budget import Counted
from gfnn_jax.fitting.evidence import improved
from gfnn_jax.fitting.significance import matched, of_two, terms_above_noise
from gfnn_jax.fitting.triangle import Triangle

RNG = np.random.default_rng(0)
ROWS, CERTAIN = 400, 4.0


def collinear():
    """Powers of a parameter from −2 to 2, which is always near 1, times a constant and a wave."""
    k, q = RNG.uniform(0.8, 1.25, ROWS), RNG.uniform(-3, 3, ROWS)
    return np.stack([k**n * f for f in (np.ones(ROWS), np.sin(q)) for n in range(-2, 3)], axis=1)


def cost(a, b, kept, sigma):
    left = b - a[:, kept] @ np.linalg.lstsq(a[:, kept], b, rcond=None)[0]
    return left @ left + len(kept) * (CERTAIN * sigma) ** 2


@pytest.mark.parametrize("true", [(2, 8), (0, 3), (5,)])
def test_the_fewest_terms_that_explain_the_rows(true):
    a = collinear()
    c = np.zeros(a.shape[1])
    c[list(true)] = 1.0
    b = a @ c + 1e-2 * RNG.normal(size=ROWS)
    start = RNG.normal(size=len(c))
    found, values = terms_above_noise(
        Triangle.of(np.column_stack([a, a @ start - b])), start, CERTAIN
    )
    left = b - a @ np.linalg.lstsq(a, b, rcond=None)[0]
    sigma = np.sqrt(left @ left / (ROWS - len(c)))
    every = [s for n in (1, 2, 3) for s in combinations(range(len(c)), n)]
    best = min(every, key=lambda kept: cost(a, b, kept, sigma))
    assert tuple(found) == best
    np.testing.assert_allclose(values, np.linalg.lstsq(a[:, best], b, rcond=None)[0], rtol=1e-8)


def test_nothing_is_told_where_all_is_noise():
    a = collinear()
    kept, values = terms_above_noise(
        Triangle.of(np.column_stack([a, RNG.normal(size=ROWS)])), np.zeros(a.shape[1]), CERTAIN
    )
    assert len(kept) == len(values) == 0


def test_columns_one_after_another_and_in_pairs_explain_what_their_span_does():
    a = RNG.normal(size=(50, 6))
    a /= np.linalg.norm(a, axis=0)
    b = RNG.normal(size=50)

    def left(places):
        basis = np.linalg.qr(a[:, list(places)])[0]
        return np.linalg.norm(b - basis @ (basis.T @ b))

    both = of_two(a.T @ b, a.T @ a, 1e-7)
    for i, j in combinations(range(6), 2):
        np.testing.assert_allclose(both[i, j], b @ b - left([i, j]) ** 2)
    assert not np.diag(both).any()
    kept, rest = [], np.linalg.norm(b)
    for place, gain, before in matched(a, b):
        np.testing.assert_allclose(before, rest)
        others = set(range(6)) - set(kept)
        assert left([*kept, place]) <= min(left([*kept, k]) for k in others) + 1e-12
        kept.append(place)
        rest = left(kept)
        np.testing.assert_allclose(before**2 - gain**2, rest**2, atol=1e-12)
    assert sorted(kept) == list(range(6))


def test_changes_are_made_one_after_another_as_long_as_one_is_better():
    """A model is a set of numbers; it is better without one that is negative."""
    asked = []

    def changed(model, gone):
        asked.append(gone)
        return model - {gone} if gone < 0 else None

    found = improved(frozenset({3, -1, 2, -4}), sorted, changed)
    assert found == {2, 3}
    assert asked == [-4, -1, 2, 3]  # what was refused is not asked about again
    assert improved(frozenset({3, -1, 2, -4}), sorted, changed, 1) == {3, -1, 2}


def test_what_a_search_has_when_its_work_is_spent_stands():
    cap = Counted(1)

    def changed(model, gone):
        cap.spend(1)
        return model - {gone} if gone < 0 else None

    assert improved(frozenset({3, -1, -2, -4}), sorted, changed) == {3, -1}
