"""The chart of a Lie algebra: a law's flow without a lift, and maps without a law."""

import jax
import numpy as np
import pytest
from analytic import moved

import gfnn_jax as gfnn
from gfnn_jax.coordinates import CARTESIAN
from gfnn_jax.families.terms import given_terms
from gfnn_jax.flows.flow import Flow
from gfnn_jax.flows.lie import LieFlow, law_flow, mean_of_arc
from gfnn_jax.maps.domain import covering
from gfnn_jax.models.brackets.lie_maps import fit_lie_map

RNG = np.random.default_rng(0)
TODA = np.zeros((5, 5, 5))  # a1, a2, b1, b2, b3: {a_i, b_i} = −a_i, {a_i, b_i+1} = a_i
for i in range(2):
    for k, value in ((2 + i, -1), (3 + i, 1)):
        TODA[i, k, i], TODA[k, i, i] = value, -value


def made(piece, z):
    n = z.shape[-1]
    domain = covering(np.zeros((1, n)), ignore=tuple(range(n)))
    bracket = piece.short.bracket if isinstance(piece, LieFlow) else piece.bracket
    return gfnn.SymplecticMap(
        (piece,), CARTESIAN, domain, np.ones(n), np.zeros(0), piece.dt, bracket=bracket
    )


def flow_of(bracket, gradient, z, dt):
    return moved(lambda _, y: bracket.apply(y.T, gradient(y.T)).T, z, dt, atol=1e-15)


@pytest.mark.slow
def test_mean_of_arc():
    """x = ∫ e^(sM) z ds, and its derivative, against a matrix exponential by JAX."""
    bracket, z, xi = gfnn.Bracket.se3(), RNG.normal(size=6), RNG.normal(size=6)

    def mean(xi):
        by = jax.numpy.einsum("ijk,j->ik", bracket.constants, xi)
        nodes, weights = np.polynomial.legendre.leggauss(16)
        rule = zip(nodes, weights, strict=True)
        return 0.5 * sum(w * jax.scipy.linalg.expm(0.5 * (s + 1) * by) @ z for s, w in rule)

    x, slope = mean_of_arc(bracket, z[None], xi[None], slopes=True)
    np.testing.assert_allclose(x[0], mean(xi), atol=1e-13)
    np.testing.assert_allclose(slope[0], jax.jacfwd(mean)(xi), atol=1e-12)


@pytest.mark.slow
def test_law_without_a_lift(tmp_path):
    """Toda in Flaschka's variables: accuracy, Poisson defect, Casimir, saving, another dt."""
    bracket = gfnn.Bracket.from_constants(TODA)
    family = given_terms(3, ("q1**2", "q2**2", "q3**2", "p1**2", "p2**2"))
    params = np.array([1, 1, 0.5, 0.5, 0.5])
    z = np.abs(RNG.normal(size=(4, 5)))
    piece = law_flow(family, params, bracket, 0.1, z)
    assert isinstance(piece, LieFlow)
    map_ = made(piece, z)
    after, _ = map_.step(z)
    reference = flow_of(bracket, lambda y: family.gradient(params, y), z, 0.1)
    np.testing.assert_allclose(after, reference, atol=1e-13)
    assert np.max(map_.defect(z)) < 1e-13
    np.testing.assert_allclose(map_.inverse(after)[0], z, atol=1e-14)
    states, _ = map_.rollout(z, 100)
    total = bracket.casimirs[0](np.asarray(states))
    np.testing.assert_allclose(total, total[:, :1] + 0 * total, rtol=1e-15)
    np.testing.assert_allclose(map_.hamiltonian(z), family.value(params, z), rtol=1e-14)
    np.testing.assert_allclose(map_.step(z, dt=0.05)[0], map_.over(0.05).step(z)[0])
    assert gfnn.export(map_, "stablehlo", tmp_path / "toda.zip").exists()
    map_.save(tmp_path / "model")
    np.testing.assert_array_equal(gfnn.load(tmp_path / "model").map.step(z)[0], after)


def test_substeps_follow_the_states():
    family, fast = given_terms(2, ("q1**2", "q2**2", "p1**2")), np.array([0.1, 3.0, 9.0])
    z = RNG.normal(size=(20, 3))
    piece = law_flow(family, fast, gfnn.Bracket.so3(), 0.3, z)
    assert isinstance(piece, Flow)
    assert piece.substeps > 1
    reference = flow_of(gfnn.Bracket.so3(), lambda y: family.gradient(fast, y), z, 0.3)
    np.testing.assert_allclose(piece.image(z), reference, atol=3e-12)


@pytest.mark.slow
def test_map_without_a_law():
    """Euler's top over 0.3 by S of degree 8, and a kicked top, which no law has."""
    spin, z = gfnn.Bracket.so3(), RNG.normal(size=(900, 3))
    z *= (RNG.uniform(0.5, 1.2, 900) / np.linalg.norm(z, axis=1))[:, None]
    inertia = np.linalg.inv([[1, 0.2, 0.1], [0.2, 1.7, 0.3], [0.1, 0.3, 2.5]])
    euler = fit_lie_map(z, flow_of(spin, lambda y: y @ inertia, z, 0.3), spin, 0.3)
    assert euler.error < 1e-12
    c, s = np.cos(0.5), np.sin(0.5)
    turned = z @ np.array([[c, 0, -s], [0, 1, 0], [s, 0, c]])
    angle = turned[:, 2]
    image = np.stack(
        [
            turned[:, 0] * np.cos(angle) - turned[:, 1] * np.sin(angle),
            turned[:, 0] * np.sin(angle) + turned[:, 1] * np.cos(angle),
            angle,
        ],
        axis=1,
    )
    kicked = fit_lie_map(z, image, spin, 1.0, degree=6)
    assert kicked.error < 3e-6
    map_ = made(kicked.piece, z)
    after, _ = map_.step(z[:50])
    assert np.sqrt(np.mean((after - image[:50]) ** 2)) < 3e-6
    assert np.max(map_.defect(z[:50])) < 1e-13
    states, _ = map_.rollout(z[:5], 1_000)
    lengths = np.linalg.norm(states, axis=-1)
    np.testing.assert_allclose(lengths, lengths[:, :1] + 0 * lengths, rtol=1e-15)


@pytest.mark.slow
def test_fit_of_a_map_without_a_law(tmp_path):
    """Lotka–Volterra by S alone, through gfnn.fit; without a bracket it says what to type."""
    bracket, z = gfnn.Bracket.log([[0, -1], [1, 0]]), RNG.uniform(0.6, 1.6, (400, 2))
    z1 = flow_of(bracket, lambda y: 1 - 1 / y, z, 0.2)
    pairs = gfnn.Pairs(z, z1, 0.2, structure="poisson", names=("prey", "predators"))
    fit = gfnn.fit(pairs, model=gfnn.GeneratingFunction(bracket=bracket), tolerance=1e-6)
    assert fit.law is None
    assert fit.verdict.startswith("map")
    np.testing.assert_allclose(fit.map.step(z)[0], z1, atol=1e-7)
    assert np.max(fit.map.defect(z[:20])) < 1e-13
    fit.save(tmp_path / "model")
    np.testing.assert_array_equal(gfnn.load(tmp_path / "model").map.step(z)[0], fit.map.step(z)[0])
    with pytest.raises(gfnn.FitError, match="needs its bracket"):
        gfnn.fit(pairs, learn="map")
