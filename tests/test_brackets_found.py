"""Laws ż = B(z)∇H(z) of pairs, with the bracket found: classes, H, the error of the field, and what
has no bracket."""

import numpy as np
import pytest
from analytic import moved

import gfnn_jax as gfnn
from gfnn_jax.brackets import Bracket
from gfnn_jax.errors import FitError
from gfnn_jax.models.brackets.algebra import analysed, changed
from gfnn_jax.models.brackets.find import sparse_rows
from gfnn_jax.models.brackets.search import Data, law_of
from gfnn_jax.phase_space import sizes

INERTIA = np.array([[2.0, 0.1, 0.05], [0.1, 1.5, 0.15], [0.05, 0.15, 1.0]])


# Rates of one state z (d,), or of many in columns (d, N).


def cross(a, b):
    return np.stack([a[i] * b[j] - a[j] * b[i] for i, j in ((1, 2), (2, 0), (0, 1))])


def top(w):
    return np.linalg.solve(INERTIA, cross(INERTIA @ w, w))


def heavy(z, slope=lambda x: 0.9):
    m, g = z[:3], z[3:]
    w = 0.5 * m[0], 0.6 * m[1], m[2]
    return np.concatenate([cross(m, w) + cross(g, (0.1, 0.2, slope(g[2]))), cross(g, w)])


def populations(z):
    a = np.array([[0, 1, 0, -0.9], [-1, 0, 0.7, 0], [0, -0.7, 0, 1.3], [0.9, 0, -1.3, 0]])
    return z * (a @ (z - 1.0))


def flaschka(z):
    a, b = z[:2], z[2:]
    squares = np.concatenate([0 * a[:1], a**2, 0 * a[:1]])
    return np.concatenate([a * np.diff(b, axis=0), 2 * np.diff(squares, axis=0)])


def charged(z):
    b = 1 + 0.4 * z[0]
    return np.array([z[2], z[3], b * z[3] - z[0], -b * z[2] - 0.7 * z[1]])


def lorenz(z):
    x, y, w = z
    return 0.2 * np.array([10 * (y - x), x * (28 - w) - y, x * y - 8 / 3 * w])


def runs_of(field, starts, dt, steps, noise=0.0):
    """All runs are integrated at once, each step from the state before: between an integrator's own
    steps it interpolates, to 4e-13 of the spread. field takes states in columns (d, N)."""
    rng, parts, states = np.random.default_rng(1), [], [starts]
    for _ in range(steps):
        states.append(moved(lambda _, z: field(z), states[-1], dt, rtol=3e-14, atol=1e-15))
    for run, z in enumerate(np.stack(states, axis=1)):
        z = z + noise * rng.normal(size=z.shape)
        parts.append((z[:-1], z[1:], np.full(steps, run), np.arange(steps)))
    z0, z1, run, place = map(np.concatenate, zip(*parts, strict=True))
    return Data(z0, z1, dt, run, place, sizes(z0))


def learned(field, starts, dt=0.2, steps=20, noise=0.0):
    data = runs_of(field, starts, dt, steps, noise)
    held = data.run >= len(starts) - max(1, len(starts) // 5)
    names = tuple(f"z{i + 1}" for i in range(data.z0.shape[1]))
    return law_of(data.take(~held), data.take(held), names), starts


def field_error(law, field, states):
    reference = field(states.T).T
    off = law.field.rate(law.fit.c, states) - reference
    return np.abs(off).max() / np.abs(reference).max()


CASES = {
    "so(3)": (top, lambda rng: rng.normal(size=(16, 3))),
    "se(3)": (heavy, lambda rng: rng.normal(size=(30, 6))),
    "log-canonical": (populations, lambda rng: rng.uniform(0.5, 1.5, (30, 4))),
    "aff(1)^2 + R": (flaschka, lambda rng: rng.uniform(0.3, 1.0, (30, 5))),
    "canonical after p = v + A(x)": (charged, lambda rng: 0.7 * rng.normal(size=(30, 4))),
}


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=pytest.mark.slow if name in ("so(3)", "aff(1)^2 + R") else ())
        for name in CASES
    ],
)
def test_brackets_of_clean_pairs(name):
    field, draw = CASES[name]
    rng = np.random.default_rng(0)
    law, _ = learned(field, draw(rng))
    assert law.name == name
    assert field_error(law, field, draw(rng)) < 5e-14
    assert law.error < 1e-12


@pytest.mark.slow
@pytest.mark.parametrize(
    ("term", "slope"),
    [("1/(1.5 + z6)", lambda x: -1 / (1.5 + x) ** 2), ("cos(2*z6)", lambda x: -2 * np.sin(2 * x))],
)
def test_h_that_is_no_polynomial(term, slope):
    def field(z):
        return heavy(z, slope)

    rng = np.random.default_rng(0)
    starts = rng.normal(size=(24, 6))
    starts[:, 3:] /= np.linalg.norm(starts[:, 3:], axis=1)[:, None]
    starts[:, 3:] *= rng.uniform(0.7, 1.2, (24, 1))
    law, _ = learned(field, starts)
    assert law.name == "se(3)"
    assert field_error(law, field, starts) < 1e-11
    assert term in law.field.library.term_names


@pytest.mark.slow
def test_noisy_sequences():
    rng = np.random.default_rng(0)
    law, _ = learned(top, rng.normal(size=(6, 3)), dt=0.05, steps=300, noise=1e-3)
    assert law.name == "so(3)"
    assert law.sigma == pytest.approx(np.full(3, 1e-3), rel=0.15)
    assert field_error(law, top, rng.normal(size=(50, 3))) < 3e-3


def test_no_bracket_is_claimed_where_there_is_none():
    starts = 8 * np.random.default_rng(0).normal(size=(30, 3)) + [0, 0, 20]
    with pytest.raises(FitError, match="nearest singular value") as raised:
        learned(lorenz, starts, dt=0.1)
    assert raised.value.verdict.startswith("no law: no bracket, nearest singular value 0.0")


def damped_top(w):
    return top(w) - 0.05 * w


def damped_heavy(z):
    return heavy(z) - 0.05 * np.append(z[:3], 0 * z[3:], axis=0)


@pytest.mark.slow
@pytest.mark.parametrize(("field", "width"), [(damped_top, 3), (damped_heavy, 6)])
def test_uniform_friction(field, width, tmp_path):
    """The rate and the motion to roundoff; the bracket is multiplied by e^(−λ dt); saved."""
    data = runs_of(field, np.random.default_rng(0).normal(size=(8 * width - 8, width)), 0.2, 20)
    given = {"run": data.run, "place": data.place, "structure": "poisson"}
    fit = gfnn.fit(gfnn.Pairs(data.z0, data.z1, 0.2, **given), max_seconds=None)
    assert np.log(fit.map.multiplier()) == pytest.approx(-0.05 * 0.2, rel=1e-8)
    assert fit.verdict == "identified"
    assert fit.symplecticity_defect < 1e-13
    assert "multiplies the bracket by exp(−0.05 t)" in " ".join(fit.messages)
    images, _ = fit.map.step(data.z0)
    np.testing.assert_allclose(images, data.z1, atol=1e-13)
    np.testing.assert_allclose(fit.map.inverse(images)[0], data.z0, atol=1e-13)
    fit.map.save(tmp_path / "model")
    again = gfnn.load(tmp_path / "model").map
    np.testing.assert_array_equal(again.step(data.z0)[0], images)


@pytest.mark.slow
def test_uniform_friction_of_noisy_sequences():
    def field(w):
        return top(w) - 0.08 * w

    rng = np.random.default_rng(0)
    law, _ = learned(field, rng.normal(size=(6, 3)), dt=0.1, steps=150, noise=1e-3)
    assert (law.name, law.field.friction.rates) == ("so(3)", 1.0)
    std = np.linalg.norm(law.fit.root[:, -1])
    assert abs(law.fit.c[-1] - 0.08) < 4 * std < 2e-3
    assert field_error(law, field, rng.normal(size=(50, 3))) < 4e-3


def test_null_vectors_that_are_zero_at_some_places_are_made_sparse():
    rows = sparse_rows(np.array([[1.0, 1.0, 0.0], [1.0, -1.0, 0.0]]) / np.sqrt(2))
    np.testing.assert_allclose(np.sort(rows, axis=0), [[0, 0, 0], [1, 1, 0]], atol=1e-12)


@pytest.mark.parametrize("blocks", [("so3",), ("so3", "so3"), ("se3",), ("aff", "aff", "centre")])
def test_algebras_are_brought_to_standard_constants(blocks):
    standard = Bracket.lie(blocks).constants
    matrix = np.eye(len(standard)) + 0.3 * np.random.default_rng(3).normal(size=standard.shape[:2])
    found = analysed(changed(standard, matrix))
    assert found.blocks == blocks
    assert changed(changed(standard, matrix), found.lifted) == pytest.approx(standard, abs=1e-12)
