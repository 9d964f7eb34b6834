"""Terms that noisy rows tell from noise."""

from itertools import combinations

import numpy as np
import pytest

from gfnn_jax.fitting.significance import terms_above_noise
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
