"""Parts of the work-precision benchmark: integrators, front, float32 rows."""

import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from analytic import moved

import gfnn_jax as gfnn
from gfnn_jax.phase_space import hamiltonian_vector_field

sys.path.insert(0, str(Path(__file__).parent.parent / "benchmarks"))

import integrators
import work_precision


@pytest.mark.parametrize(
    "name",
    [
        "henon-heiles-regular",
        *(pytest.param(n, marks=pytest.mark.slow) for n in ("two-body", "pcr3bp")),
    ],
)
def test_the_fields_are_those_of_the_scenes(name):
    scene = gfnn.scenes.make(name)
    z = np.array([1, 0, 0, 1]) + 0.1 * np.random.default_rng(0).normal(size=(5, 4))
    expected = jax.vmap(hamiltonian_vector_field(scene.hamiltonian))(z)
    field = np.stack(integrators.field_of(scene)(*z.T), axis=1)
    np.testing.assert_allclose(field, expected, rtol=1e-13, atol=1e-14)


@pytest.mark.parametrize(
    ("name", "order"),
    [("leapfrog", 2), ("Yoshida 4", 4), pytest.param("Kahan–Li 8", 8, marks=pytest.mark.slow)],
)
def test_a_composition_has_its_order(name, order):
    scene = gfnn.scenes.make("henon-heiles-regular")
    z0 = jnp.array([[0.1, -0.2, 0.3, 0.1]])
    runner = dict(integrators.runners(scene, True))[name]
    stages = 2 * len(integrators.COMPOSITIONS[name]) - 1
    field = integrators.field_of(scene)
    exact = moved(lambda _, z: np.stack(field(*z)), np.asarray(z0), 4 * scene.dt)
    errors = [np.linalg.norm(runner.run(z0, 4 * scene.dt, n * stages) - exact) for n in (1.0, 2.0)]
    assert np.log2(errors[0] / errors[1]) == pytest.approx(order, abs=0.5)


@pytest.mark.slow
def test_integrators_reach_the_reference_or_say_why_not():
    scene = gfnn.scenes.make("pcr3bp")
    z0 = gfnn.sample_test_states(scene, 3, jax.random.key(0))
    exact = gfnn.reference_trajectories(scene, z0, 5)[:, -1]
    found = dict(integrators.runners(scene, False))
    assert found["leapfrog"] == "H is not T(p) + V(q)"
    for name in ("SciPy DOP853", "heyoka"):
        runner = found[name]
        if isinstance(runner, str):
            assert runner == "not installed"
            continue
        for states in (z0, z0[:1]):
            reached = runner.run(states, 5 * scene.dt, 1e-12)
            np.testing.assert_allclose(reached, exact[: len(states)], rtol=0, atol=1e-9)
    maps = dict(integrators.runners(gfnn.scenes.make("standard-map-regular"), True))
    assert set(maps.values()) == {"a map without a flow"}


def test_the_front_is_what_no_other_beats():
    cost, error = [3.0, 1.0, 2.0, 1.0, 5.0], [1e-3, 1e-1, 1e-1, 1e-2, 1e-6]
    assert work_precision.front_of(cost, error) == [3, 0, 4]
    assert work_precision.thinned([0, 1, 2, 3, 4], 3) == [0, 2, 4]


def test_a_lost_lane_counts_as_infinitely_far():
    bench = work_precision.Bench(gfnn.scenes.make("standard-map-regular"), 3, 50, quick=True)
    exact = bench.judged(bench.reference)
    assert exact["error_median"] == 0
    assert exact["num_lost"] == 0
    most = np.arange(len(bench.z0)) < 0.6 * len(bench.z0)
    lost = bench.judged(bench.reference, lost=most)
    assert lost["error_median"] == np.inf
    assert lost["num_lost"] == most.sum()
    assert lost["error_mean"] is None
