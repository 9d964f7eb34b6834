"""Number of XLA programs of an answer, which take most of the time to a first answer."""

import jax
import numpy as np
import pytest

import gfnn_jax as gfnn

# What a fit, a rollout after it, a second fit and a second rollout of the same shapes compile.
# A change that raises one of these makes the first answer slower for everyone.
MOST = (1, 1, 0, 0)


def pairs(seed):
    z = np.random.default_rng(seed).uniform(-1, 1, (200, 2))
    p = z[:, 1] + 0.3 * np.sin(z[:, 0])
    return gfnn.Pairs(z, np.stack([z[:, 0] + 0.3 * p, p], axis=1), 0.3)


@pytest.mark.slow
@pytest.mark.usefixtures("as_a_user")
def test_a_fit_compiles_one_step_and_a_second_fit_nothing(compilations):
    jax.clear_caches()  # what a process begins with
    found, labels, z0 = [], [], np.zeros((10, 2)) + 0.1
    for seed in (0, 1):
        with compilations() as of_fit:
            fit = gfnn.fit(pairs(seed), tolerance=1e-4)
        with compilations() as of_rollout:
            fit.map.rollout(z0 + 0.1 * seed, 100)
        found += [of_fit.count, of_rollout.count]
        labels.append(fit.chosen.label)
    assert labels[0] == labels[1]
    assert all(n <= most for n, most in zip(found, MOST, strict=True)), found
