"""Mistakes that users of the Python API make: each is refused before any work, in one line
that says what was expected. Those of the command line are in tests/test_cli.py, those of files in
tests/test_files.py; what only a fit can see (degrees, friction), benchmarks/as_a_user.py has."""

import dataclasses

import jax
import numpy as np
import pytest

import gfnn_jax as gfnn
from gfnn_jax.coordinates import Coordinates
from gfnn_jax.errors import FitError, InputError
from gfnn_jax.learn.request import unnamed_angles

DT = 0.1
RNG = np.random.default_rng(0)
Z0 = RNG.uniform(-1, 1, (200, 2))
TURN = np.array([[np.cos(DT), np.sin(DT)], [-np.sin(DT), np.cos(DT)]])
Z1 = Z0 @ TURN.T
PAIRS = gfnn.Pairs(Z0, Z1, DT)
SCENE = gfnn.scenes.make("two-body")
KEY = jax.random.key(0)
OF_NUMPY = dataclasses.replace(
    SCENE, flow=None, step=None, section=None, hamiltonian=lambda z, t=0.0: np.sum(np.cos(z))
)
FLOW_OF_NUMPY = dataclasses.replace(OF_NUMPY, flow=OF_NUMPY.hamiltonian)
LENGTH = RNG.uniform(0.5, 2, 200)


def fit(*arrays, **options):
    """A fit to other arrays than those that are right."""
    given = dict(zip(("z0", "z1", "dt", "args"), arrays, strict=False))
    return gfnn.fit(gfnn.Pairs(**{"z0": Z0, "z1": Z1, "dt": DT, **given}), **options)


MISTAKES = {
    # The pairs.
    "a list of lists": lambda: fit(Z0.tolist()),
    "q without p": lambda: fit(Z0[:, :1], Z1[:, :1]),
    "sequences as pairs": lambda: fit(Z0.reshape(10, 20, 2), Z1),
    "transposed": lambda: fit(Z0.T, Z1.T),
    "the same state all over": lambda: fit(0 * Z0, 0 * Z1),
    "complex numbers": lambda: fit(Z0 + 0j),
    "the array instead of pairs": lambda: gfnn.fit(Z0),
    "a file that is not there": lambda: gfnn.fit("nowhere.npz"),
    # The time step, parameters, the drive.
    "dt as text": lambda: fit(Z0, Z1, "0.1"),
    "times instead of dt": lambda: fit(Z0, Z1, np.arange(3.0)),
    # What is asked for.
    "a budget of nothing": lambda: fit(max_seconds=0),
    "the scene's name": lambda: fit(scene="two-body"),
    "an angle that is no index": lambda: fit(angles=("q1",)),
    "an unknown name in a term": lambda: fit(terms=["x1**2"]),
    # Drawing from scenes, loading.
    "a name to draw from": lambda: gfnn.sample_pairs("two-body", 10, KEY),
    "a Hamiltonian of NumPy": lambda: gfnn.sample_pairs(OF_NUMPY, 10, KEY),
    "a flow of NumPy": lambda: gfnn.sample_pairs(FLOW_OF_NUMPY, 9, KEY),
    "a number as key": lambda: gfnn.sample_pairs(SCENE, 10, 0),
    "a folder that is not there": lambda: gfnn.load("nowhere"),
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_a_mistake_is_refused_in_one_line(mistake, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    with pytest.raises((FitError, InputError, ValueError)) as refused:
        MISTAKES[mistake]()
    assert 20 < len(str(refused.value)) < 400
    assert "\n" not in str(refused.value)
    assert not list(tmp_path.iterdir())


@pytest.fixture(scope="module")
def learned():
    return gfnn.fit(PAIRS, tolerance=1e-8).map


WITH_A_MAP = {
    "states of another d": lambda m: m.rollout(np.ones((3, 4)), 9),
    "transposed states": lambda m: m.rollout(Z0[:5].T, 9),
    "steps that are no whole number": lambda m: m.rollout(Z0[:3], 1e3),
    "the inverse of no state": lambda m: m.inverse(),
    "nothing saved": lambda m: m.rollout(Z0[:3], 9, save_every=0),
    "dt < 0": lambda m: m.rollout(Z0[:3], 9, dt=-DT),
    "parameters that it has not": lambda m: m.rollout(Z0[:3], 9, params={"l": 1.0}),
    "the time of no drive": lambda m: m.rollout(Z0[:3], 9, t0=np.zeros(3)),
    "no samples": lambda m: m.sample(KEY, 0),
    "more devices than there are": lambda m: m.sharded(99),
}


@pytest.mark.parametrize("mistake", WITH_A_MAP)
def test_a_mistake_with_a_map_is_refused_in_one_line(mistake, learned):
    with pytest.raises(ValueError) as refused:  # noqa: PT011, whatever its words
        WITH_A_MAP[mistake](learned)
    assert "\n" not in str(refused.value)


@pytest.mark.slow
def test_a_negative_number_of_steps_goes_back(learned):
    ahead, _ = learned.rollout(Z0[:3], 100)
    back, info = learned.rollout(np.asarray(ahead[:, -1]), -100, save_every=20)
    assert not info.status.any()
    np.testing.assert_allclose(back, ahead[:, ::-20], rtol=0, atol=1e-13)


def test_an_angle_that_is_wrapped_is_named():
    """Rotors pass ±π or 0; swings within half a turn, and jumps by more than a kick's, are none."""
    rng = np.random.default_rng(1)
    q, p, cartesian = rng.uniform(-9, 9, 300), rng.uniform(-3, 3, 300), Coordinates("cartesian")
    for centre in (0.0, np.pi):
        ends = [
            np.c_[p, centre + np.remainder(x - centre + np.pi, 2 * np.pi) - np.pi]
            for x in (q, q + 0.2 * p)
        ]
        (said,) = unnamed_angles(gfnn.Pairs(*ends, 0.2), cartesian)
        assert "coordinate 1 of z: jumps of 2π in" in said
        assert "name it: --angles 1" in said
        assert unnamed_angles(gfnn.Pairs(*ends, 0.2), Coordinates("cartesian", angles=(1,))) == []
    assert unnamed_angles(PAIRS, cartesian) == []
    kicked = gfnn.Pairs(Z0, rng.uniform(-3, 3, Z0.shape), 1.0)
    assert unnamed_angles(kicked, cartesian) == []
