"""Brackets: Jacobi's identity, Casimirs, text, refusals."""

import jax
import numpy as np
import pytest

import gfnn_jax as gfnn
from gfnn_jax.brackets import jacobi_failure

RNG = np.random.default_rng(0)
BASIS = RNG.normal(size=(6, 6))
TODA = np.zeros((3, 3, 3))  # a, b1, b2 of two particles: {a, b1} = −a, {a, b2} = a
TODA[0, 1, 0], TODA[1, 0, 0], TODA[0, 2, 0], TODA[2, 0, 0] = -1, 1, 1, -1
BRACKETS = {
    "so3": gfnn.Bracket.so3(2, basis=BASIS),
    "se3": gfnn.Bracket.se3(basis=BASIS),
    "centre": gfnn.Bracket.lie(("so3", "centre")),
    "solvable": gfnn.Bracket.from_constants(TODA),
    "constant": gfnn.Bracket.constant(np.triu(np.ones((5, 5)), 1) - np.tril(np.ones((5, 5)), -1)),
    "log": gfnn.Bracket.log([[0, 1, -2], [-1, 0, 1], [2, -1, 0]]),
    "magnetic": gfnn.Bracket.magnetic(
        [[[0, 1], [-1, 0]], [[0, 0.4], [-0.4, 0]]], [[0, 0], [1, 2]], mass=[[2, 0.3], [0.3, 1]]
    ),
}


@pytest.mark.parametrize("name", BRACKETS)
def test_jacobi_and_casimirs(name):
    """B antisymmetric, Jacobi's identity by exact derivatives of B, B ∇C = 0."""
    bracket = BRACKETS[name]
    z = RNG.uniform(0.5, 1.5, bracket.size)
    b = bracket.matrix(z)
    np.testing.assert_allclose(b, -b.T, atol=1e-14)
    np.testing.assert_array_equal(b, bracket.matrix(z.tolist()))

    @jax.jit
    def derivatives(z):
        return jax.jacfwd(bracket.matrix)(z), [jax.grad(c)(z) for c in bracket.casimirs]

    slope, gradients = derivatives(z)
    slope = np.asarray(slope)  # ∂_l B_ij
    cycle = np.einsum("il,jkl->ijk", b, slope)
    total = cycle + cycle.transpose(1, 2, 0) + cycle.transpose(2, 0, 1)
    assert np.abs(total).max() < 1e-12 * max(1, np.abs(cycle).max())
    for casimir, expected in zip(bracket.casimirs, gradients, strict=True):
        gradient = casimir.gradient(z)
        np.testing.assert_allclose(gradient, expected, rtol=1e-12)
        assert np.abs(bracket.apply(z, gradient)).max() < 1e-12 * np.abs(gradient).max()
    corank = bracket.size - np.linalg.matrix_rank(b, tol=1e-9)
    assert len(bracket.casimirs) == (1 if name == "solvable" else corank)


def test_text():
    spin = gfnn.Bracket.so3(names=("w1", "w2", "w3"))
    assert str(spin) == "{w1,w2} = w3; {w1,w3} = -w2; {w2,w3} = w1: so(3)"
    assert [c.formula for c in spin.casimirs] == ["w1**2 + w2**2 + w3**2"]
    assert gfnn.Bracket.so3(4).name == "so(3)⁴"
    assert BRACKETS["log"].casimirs[0].formula == "0.5*log(z1) + log(z2) + 0.5*log(z3)"
    assert BRACKETS["magnetic"].relations()[-1].startswith("{z3,z4} = 0.52356 + 0.209424 z1 z2^2")


@pytest.mark.parametrize(
    ("make", "what"),
    [
        (lambda: gfnn.Bracket.constant([[0, 1], [1, 0]]), "antisymmetric"),
        (lambda: BRACKETS["log"].require_inside([[1, 1, 1], [1, 0, 1]]), "rows 1"),
        (lambda: gfnn.Bracket.magnetic([[[0, 1, 0], [-1, 0, 0], [0, 0, 0]]], [[0, 0, 1]]), "curl"),
    ],
)
def test_refusals(make, what):
    with pytest.raises(gfnn.FitError, match=what):
        make()


def test_jacobi_is_asked_of_constants():
    wrong = gfnn.Bracket.so3(2).constants.copy()
    wrong[0, 1, 3], wrong[1, 0, 3] = 1, -1
    assert jacobi_failure(wrong) == 1
    with pytest.raises(gfnn.FitError, match="Jacobi"):
        gfnn.Bracket.from_constants(wrong)
