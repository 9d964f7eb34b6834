"""Networks trained together: as by themselves, their mean the map, their spread its bands."""

import signal

import jax
import numpy as np
import pytest
from analytic import turning

import gfnn_jax as gfnn
from gfnn_jax.families.inputs import box_inputs
from gfnn_jax.families.mlp import Mlp
from gfnn_jax.fitting.levenberg_marquardt import GradientFit, Limits, LMState
from gfnn_jax.jobs.output import Output, search
from gfnn_jax.jobs.predict import Steps, predict
from gfnn_jax.jobs.progress import Progress
from gfnn_jax.learn.options import FitOptions
from gfnn_jax.models.generating_functions import networks

DT = 0.5


def states(num, seed):
    return np.random.default_rng(seed).uniform(-1, 1, (num, 2))


def pairs_of(num, seed, noise=0.0):
    z0, rng = states(num, seed), np.random.default_rng(seed + 1)
    z1 = turning(z0, DT)
    return gfnn.Pairs(*(z + noise * rng.normal(size=z.shape) for z in (z0, z1)), DT)


OPTIONS = {"family": "mlp", "chart": "midpoint", "max_iterations": 15, "max_seconds": None}


@pytest.fixture(scope="module")
def fit():
    with pytest.warns(gfnn.FitWarning):
        return gfnn.fit(pairs_of(150, 0), ensemble=4, **OPTIONS)


def gradients(num, seed):
    w = states(num, seed)
    return w, np.stack([w[:, 0] + np.cos(2 * w[:, 0]), w[:, 1] ** 3], axis=1)


@pytest.mark.slow
def test_members_are_trained_as_they_are_alone():
    """With equal shares, as long as every step lowers the loss."""
    (w, target), held = gradients(90, 0), gradients(30, 1)
    family = Mlp(box_inputs(w), (5,), "tanh")
    starts = [family.init(jax.random.key(i), np.float64) for i in range(3)]
    theta = np.stack([np.concatenate([np.ravel(a) for a in jax.tree.leaves(p)]) for p in starts])

    def begun(theta, damping):
        return LMState(theta, theta, damping, 0, np.nan, np.inf, np.inf, np.inf, 0, 0.0)

    options, together = {"validation": held, "chunk": 40}, []
    GradientFit(
        w,
        target,
        limits=Limits(3, reports=(together.append,)),
        resume=begun(theta, np.full(3, 1e3)),
        **options,
    ).train_together(family, starts, np.ones((3, 90)))
    for i, start in enumerate(starts):
        alone = []
        GradientFit(
            w,
            target,
            limits=Limits(3, reports=(alone.append,)),
            resume=begun(theta[i], 1e3),
            **options,
        ).train(family, start)
        for ours, its in zip(together, alone, strict=True):
            np.testing.assert_allclose(ours.theta[i], its.theta, rtol=1e-6, atol=1e-9)
            assert ours.damping[i] == pytest.approx(its.damping)


@pytest.mark.slow
def test_shares_are_the_weights_of_the_pairs():
    """A pair of share 2 counts as one that is there twice; of share 0, as none."""
    (w, target), held = gradients(60, 0), gradients(30, 1)
    family = Mlp(box_inputs(w), (4,), "tanh")
    start = family.init(jax.random.key(0), np.float64)
    shares = np.repeat([[2.0, 0.0, 1.0]], 20, axis=1)
    options = {"validation": held, "limits": Limits(4)}
    found = GradientFit(w, target, **options).train_together(family, [start], shares)
    rows = np.repeat(np.arange(60), shares[0].astype(int))
    other = GradientFit(w[rows], target[rows], **options).train_together(
        family, [start], np.ones((1, len(rows)))
    )
    jax.tree.map(
        lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-6), found.params, other.params
    )
    assert found.validation_rms == pytest.approx(other.validation_rms, rel=1e-6)


@pytest.mark.slow
def test_the_map_is_the_mean(fit):
    piece, z = fit.map.pieces[0], states(5, 3)
    one = [
        piece.family.network.gradient(jax.tree.map(lambda a, i=i: a[i], piece.family.members), z)
        for i in range(4)
    ]
    np.testing.assert_allclose(
        piece.family.gradient(np.asarray(piece.params), z), np.mean(one, 0), rtol=1e-12
    )
    samples = fit.sample(jax.random.key(0), 3)
    assert samples.params.shape == (3, 4)
    np.testing.assert_allclose(np.sum(samples.params, axis=1), 1.0, rtol=1e-12)


@pytest.mark.slow
def test_samples_are_symplectic(fit):
    samples, z = fit.sample(jax.random.key(0), 3), states(5, 3)
    assert float(np.max(np.asarray(samples[1].defect(z)))) < 1e-13
    energy = np.sum(np.asarray(samples.rollout(z, 50)[0]) ** 2, axis=-1)
    assert np.max(np.abs(energy[..., -1] - energy[..., 0])) < 0.02


@pytest.mark.slow
@pytest.mark.parametrize("noise", [0.0, 1e-2])
def test_bands_hold_the_true_error(fit, noise):
    if noise:
        with pytest.warns(gfnn.FitWarning):
            fit = gfnn.fit(pairs_of(150, 0, noise), ensemble=4, **OPTIONS)
    z = states(200, 9) * 0.9
    found, info = fit.map.rollout(z, 1, samples=40, key=jax.random.key(0))
    error = np.abs(np.asarray(found)[:, 1] - turning(z, DT))
    band = 2 * info.bands.std[:, 1]
    assert np.mean(error <= band) > 0.8
    assert np.median(band) < 4 * np.sqrt(np.mean(error**2))
    if noise:
        assert np.sqrt(np.mean(error**2)) < noise


@pytest.mark.slow
def test_a_saved_ensemble_keeps_its_members_and_predicts_bands(fit, tmp_path):
    fit.map.save(tmp_path / "m")
    again, z, key = gfnn.load(tmp_path / "m").map, states(5, 5), jax.random.key(2)
    for ours, theirs in zip(
        fit.sample(key, 3).rollout(z, 50), again.sample(key, 3).rollout(z, 50), strict=True
    ):
        jax.tree.map(np.testing.assert_array_equal, ours, theirs)
    np.save(tmp_path / "z0.npy", z)
    output = Output(tmp_path / "p.npz")
    predict(tmp_path / "m", tmp_path / "z0.npy", output, Steps(3, samples=3))
    with np.load(tmp_path / "p.npz") as file:
        assert (file["std"][:, 1:] > 0).all()


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::gfnn_jax.FitWarning")
def test_an_interrupted_ensemble_goes_on_to_the_same_members(tmp_path, monkeypatch):
    options = FitOptions(
        family="mlp", chart="midpoint", max_iterations=6, ensemble=4, max_seconds=None
    )

    class Stopping(Progress):
        def __init__(self, at):
            self.at = at

        def status(self, message):
            if f"iteration {self.at}," in message:
                signal.raise_signal(signal.SIGINT)

        def line(self, line):
            pass

    def run(folder, at):
        return search(pairs_of(150, 0), None, options, progress=Stopping(at), kept=(folder, {}))

    monkeypatch.setattr(networks, "_CHECKPOINT_SECONDS", 0.0)
    whole = run(tmp_path / "whole", 99)
    with pytest.raises(KeyboardInterrupt):
        run(tmp_path / "part", 3)
    assert list((tmp_path / "part").glob("step_*"))
    resumed = run(tmp_path / "part", 99)
    for one, other in zip(
        *(jax.tree.leaves(f.map.pieces[0].family) for f in (whole, resumed)), strict=True
    ):
        np.testing.assert_array_equal(one, other)
    np.testing.assert_array_equal(whole.map.posterior.root, resumed.map.posterior.root)
