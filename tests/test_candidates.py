"""Candidates: the error of one step, and which sizes exist."""

import itertools

import numpy as np
import pytest

from gfnn_jax.budget import Budget
from gfnn_jax.coordinates import Coordinates
from gfnn_jax.dataset.dataset import Dataset
from gfnn_jax.dataset.measured_error import Tolerance, measured_error, one_step_error
from gfnn_jax.dataset.runs import identified
from gfnn_jax.errors import OutOfTime
from gfnn_jax.families.inputs import box_inputs
from gfnn_jax.families.products import Products
from gfnn_jax.generating.charts import TYPE2
from gfnn_jax.models.generating_functions import sweeps
from gfnn_jax.phase_space import Pairs
from gfnn_jax.search.search import Search
from gfnn_jax.storage.checkpoints import KeptFactors


def test_a_relative_error_is_that_of_each_coordinate_in_its_own_spread():
    rng = np.random.default_rng(0)
    spread = np.array([1e3, 1e-5])
    error = 1e-4 * spread * rng.standard_normal((10_000, 2))
    found = one_step_error(error, spread, Tolerance(1.0))
    assert found.relative == pytest.approx(1e-4, rel=0.05)
    np.testing.assert_allclose(found.deviations, 1e-4 * spread, rtol=0.05)
    assert found.rms == pytest.approx(0.1 / np.sqrt(2), rel=0.05)
    assert found.relative < found.bound < 1.05 * found.relative
    absolute = one_step_error(error, spread, Tolerance(1.0, relative=False))
    assert absolute.rms < absolute.bound < 1.05 * absolute.rms
    assert (absolute.rms, absolute.relative) == (found.rms, found.relative)


def test_a_step_without_an_image_makes_the_error_infinite():
    error = np.zeros((5, 2))
    error[3, 1] = np.nan
    found = one_step_error(error, np.ones(2), Tolerance(1.0))
    assert np.isinf([found.rms, found.relative, found.bound, *found.deviations]).all()


def test_errors_of_angles_are_to_the_nearest_image():
    z0 = np.random.default_rng(2).uniform(-3, 3, (20, 2))
    pairs = Pairs(z0, z0 + np.array([2 * np.pi, 0.0]), 1.0)
    rows = np.arange(20)

    def rms(coordinates):
        data = Dataset.of(pairs, coordinates).validated_on(rows)
        return measured_error(data, Tolerance(1.0), z0).rms

    assert rms(Coordinates("angle", angles=(0,))) < 1e-15
    assert rms(Coordinates("plain")) > 4


# Sizes.


def test_a_size_too_large_to_count_is_never_looked_at():
    """Twelve variables: degree 5 has too many terms, degree 20 would fill a disk."""
    inputs = box_inputs(np.random.default_rng(0).uniform(-1, 1, (100, 12)))
    looked_at = []

    def family(degree):
        looked_at.append(degree)
        return Products(inputs, degree)

    groups = (map(family, group) for group in sweeps.Options.degrees)
    kept = list(itertools.chain(*sweeps._determined(groups, 10**6, sweeps.ROWS_PER_TERM)))
    assert [f.degree for f in kept] == [2, 3, 4]
    assert looked_at == [2, 3, 4, 5]


def kicked(num=2_000):
    """A kick by a quartic potential, whose S is a polynomial of degree 4 in type 2."""
    z = np.random.default_rng(0).uniform(-1, 1, (num, 2))
    q, p = z.T
    p = p - 0.3 * (q + q**3)
    return Pairs(z, np.stack([q + 0.3 * p, p], axis=1), 0.3)


def of_kicks(num=2_000, factors=None):
    """The sweep of polynomials in type 2, without any compilation."""
    pairs = kicked(num)
    data = Dataset.of(identified(pairs).pairs, Coordinates("plain")).divided(0)
    return sweeps.LinearSweep(data, Tolerance(1e-11), TYPE2, sweeps.Linear("polynomial"), factors)


def quiet(_):
    pass


def test_the_right_degree_is_found_without_compiling(compilations):
    with compilations() as found:
        sweep = of_kicks()
        result = Search([sweep], 1e-11, Budget(), quiet, quiet).to_its_end()
    assert found.count == 0
    best = result.ranking[0]
    assert best.candidate.label == "polynomial 4"
    assert best.candidate.validated
    assert best.candidate.validation_bound < 1e-12
    assert best.candidate.rank == best.candidate.num_parameters == 14
    worse = [e.candidate for e in result.entries if e is not best]
    assert all(c.validation_relative > 1e-4 for c in worse)


def test_the_estimate_is_of_the_size_of_the_error():
    """The held-out residual of the gradient is the step's error to first order."""
    sweep = of_kicks()
    for size in sweep.sizes[:2]:
        judged = sweep.estimate(size, Budget(), quiet)
        measured = sweep.validate(size, judged, Budget(), quiet)
        assert 0.5 < measured.validation_relative / judged.validation_relative < 2
        assert 0.5 < judged.train_rms / judged.validation_relative < 2


def test_more_pairs_never_take_a_candidate_away(monkeypatch):
    """Where a factorisation of all rows would take too long, it is of a sample of them."""
    monkeypatch.setattr(sweeps.Options, "most_operations", 300 * 27**2)
    found = Search([of_kicks()], 1e-11, Budget(), quiet, quiet).to_its_end()
    assert found.ranking[0].candidate.label == "polynomial 4"
    assert found.ranking[0].candidate.validation_bound < 1e-11


def test_a_factorisation_stops_when_the_time_is_spent():
    sweep = of_kicks()
    with pytest.raises(OutOfTime):
        sweep.estimate(sweep.sizes[0], Budget(max_seconds=1e-9), quiet)


def test_a_fit_that_goes_on_takes_the_factors_that_were_kept(monkeypatch, tmp_path):
    monkeypatch.setattr(sweeps.Options, "worth_keeping", 0.0)

    def again():
        swept = [of_kicks(factors=KeptFactors(tmp_path))]
        return Search(swept, 1e-11, Budget(), quiet, quiet).to_its_end()

    first = again()
    with monkeypatch.context() as without:
        without.setattr(sweeps.least_squares, "reduce", None)
        second = again()
    for one, other in zip(first.entries, second.entries, strict=True):
        assert one.candidate.validation_relative == other.candidate.validation_relative
    damaged = next((tmp_path / "factors").iterdir())
    damaged.write_bytes(damaged.read_bytes()[:100])
    assert again().ranking[0].candidate.label == "polynomial 4"
