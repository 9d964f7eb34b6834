"""Many degrees of freedom: sums over sites, flows without matrices, fits of rings and chains."""

import json
from itertools import combinations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import gfnn_jax as gfnn
from gfnn_jax import cli, scenes
from gfnn_jax.coordinates import CARTESIAN
from gfnn_jax.dataset.dataset import Dataset
from gfnn_jax.dataset.structures import Bodies
from gfnn_jax.evaluate import figures
from gfnn_jax.families.sums import Part, Sums, Windows, body_terms, matrix_free, site_terms
from gfnn_jax.families.terms import Terms, given_terms
from gfnn_jax.flows.collocation import Steps, images
from gfnn_jax.flows.flow import Flow
from gfnn_jax.flows.rates import rates
from gfnn_jax.generating.charts import CHARTS
from gfnn_jax.generating.generated import Generated
from gfnn_jax.learn.request import proposed
from gfnn_jax.models.hamiltonians.libraries import promising
from gfnn_jax.phase_space import apply_j, defect_of_pairs
from gfnn_jax.solve import krylov
from gfnn_jax.solve.status import NON_FINITE

RNG = np.random.default_rng(0)


def springs(dim, ends="ring"):
    """½ Σ p² + ½ Σ r² + ¼ Σ r⁴ and its coefficients."""
    kinetic = Part(Terms(1, ("p1",), ((2,),)), Windows(ends, 0))
    bonds = Part(Terms(2, ("q2 - q1",), ((2,), (4,))), Windows(ends, 1))
    return Sums(dim, (kinetic, bonds)), np.array([0.5, 0.5, 0.25])


def drawn(dim, num, family, params, dt):
    z0 = 0.3 * RNG.normal(size=(num, 2 * dim))
    return gfnn.Pairs(z0, images(family, params, z0, dt, Steps(8, 2)).states, dt)


@pytest.mark.slow
@pytest.mark.parametrize("ends", ["ring", "free", "fixed"])
def test_a_sum_is_what_is_written_out(ends):
    dim, w = 6, RNG.normal(size=(2, 12))
    family = Sums(
        dim,
        (
            Part(Terms(1, ("q1", "p1"), ((1, 2),)), Windows(ends, 0)),
            Part(Terms(3, ("q3 - q1", "p2"), ((3, 1),)), Windows(ends, 2)),
        ),
    )

    def written(z):
        q, p = z[:dim], z[dim:]
        at = range(dim)
        sites = sum(q[i] * p[i] ** 2 for i in at)
        if ends == "fixed":
            q, p = (jnp.concatenate([jnp.zeros(1), x, jnp.zeros(1)]) for x in (q, p))
            at = range(dim + 2)
        if ends != "ring":
            at = range(len(at) - 2)
        size = len(q)
        rows = sum((q[(i + 2) % size] - q[i]) ** 3 * p[(i + 1) % size] for i in at)
        return 0.5 * sites - 2.0 * rows

    params = np.array([0.5, -2.0])
    gradient, hessian = family.gradient_and_hessian(params, w)
    np.testing.assert_allclose(family.value(params, w), jax.vmap(written)(w), rtol=1e-13)
    np.testing.assert_allclose(gradient, jax.vmap(jax.grad(written))(w), atol=1e-13)
    np.testing.assert_allclose(hessian, jax.vmap(jax.hessian(written))(w), atol=1e-13)
    np.testing.assert_allclose(family.term_gradients(w) @ params, gradient, atol=1e-13)
    by_jax = family.gradient(jnp.asarray(params), jnp.asarray(w))
    np.testing.assert_allclose(by_jax, gradient, atol=1e-13)
    rows = {"ring": dim, "free": dim - 2, "fixed": dim}[ends]
    assert [part.over.count(dim) for part in family.parts] == [dim, rows]


def test_terms_stand_in_the_shortest_window():
    family = site_terms(8, "ring", 1, 2, ("exp(q1 - q3)",))
    assert "; ".join(family.term_names) == (
        "q_i; p_i; q_i²; p_i²; q_i p_i; q_{i+1} - q_i; (q_{i+1} - q_i)²; q_i (q_{i+1} - q_i); "
        "p_i (q_{i+1} - q_i); exp(q_i - q_{i+2})"
    )
    assert family.take([3, 9]).term_names == ("p_i²", "exp(q_i - q_{i+2})")


@pytest.mark.slow
def test_without_matrices_as_with_them():
    """Coefficients' derivatives, rates and tangents of 20 sites; matrices serve up to 16."""
    family, params = springs(20)
    assert matrix_free(family)
    assert not matrix_free(springs(16)[0])
    z, steps = 0.3 * RNG.normal(size=(2, 40)), Steps(4, 2)
    found = images(family, params, z, 0.2, steps, derivatives=True).by_coefficient
    for j, small in enumerate(1e-6 * np.eye(3)):
        ahead = images(family, params + small, z, 0.2, steps).states
        behind = images(family, params - small, z, 0.2, steps).states
        np.testing.assert_allclose(found[..., j], (ahead - behind) / 2e-6, atol=1e-8)
    _, hessian = family.gradient_and_hessian(params, z)
    form = np.block([[np.zeros((20, 20)), np.eye(20)], [-np.eye(20), np.zeros((20, 20))]])
    exact = np.abs(np.linalg.eigvals(form @ hessian)).max(axis=1)
    np.testing.assert_allclose(rates(family, params, z), exact, rtol=0.05)

    flow, v = Flow(family, params, 0.2, np.ones(40), 4), RNG.normal(size=z.shape)

    def step(z):
        return flow.step(z)[0]

    moved, along = jax.jvp(step, (z,), (v,))
    _, unrolled = jax.jvp(lambda z: flow.step(z, unrolled=True)[0], (z,), (v,))
    np.testing.assert_allclose(
        moved, images(family, params, z, 0.2, Steps(4, 1)).states, atol=1e-14
    )
    np.testing.assert_allclose(along, unrolled, atol=1e-13)
    back = jax.vjp(step, z)[1](jnp.asarray(v))[0]
    np.testing.assert_allclose(np.sum(back * v), np.sum(along * v), rtol=1e-12)


def test_pairs_of_tangents_see_what_is_not_symplectic():
    scale = np.repeat([0.1, 3.0], 50)
    u = RNG.choice([-1.0, 1.0], (8, 100)) / 10 * scale
    shear = u.copy()
    shear[:, :50] += 0.3 * u[:, 50:]
    assert defect_of_pairs(u, shear, scale) < 1e-15
    shear[:, 50:] *= 1.001
    assert defect_of_pairs(u, shear, scale) > 1e-4


@pytest.mark.slow
@pytest.mark.parametrize("dim", [8, 18])
def test_a_ring_of_many_sites(dim, tmp_path):
    """The formula, roundoff, a defect, the domain, and the same bits from a saved model, with
    matrices and without."""
    family, params = springs(dim)
    pairs = drawn(dim, 20, family, params, 0.1)
    fit = gfnn.fit(pairs.take(slice(12)), structure="ring", tolerance=1e-12)
    assert str(fit.hamiltonian) == "Σ_i 0.5 p_i² + 0.5 (q_{i+1} - q_i)² + 0.25 (q_{i+1} - q_i)⁴"
    bond = f"(q(Mod(i, {dim}) + 1) - q(i))"
    springs_of = f"0.5*{bond}**2 + 0.25*{bond}**4"
    assert fit.formula == f"Sum(0.5*p(i)**2, (i, 1, {dim})) + Sum({springs_of}, (i, 1, {dim}))"
    assert fit.met
    assert fit.symplecticity_defect < 1e-14
    z = pairs.z0[12:]
    np.testing.assert_allclose(fit.map.step(z)[0], pairs.z1[12:], atol=1e-13)
    energy = fit.map.hamiltonian(z)
    fit.map.save(tmp_path / "model")
    loaded, state = gfnn.load(tmp_path / "model").map, z
    for _ in range(50):
        state = loaded.step(state)[0]
    np.testing.assert_allclose(fit.map.hamiltonian(state), energy, rtol=1e-13)
    np.testing.assert_array_equal(loaded.step(z)[0], fit.map.step(z)[0])
    # Where the ring is as a whole matters to no force: it is no part of the domain.
    moved = z + np.repeat([100.0, 0.0], dim)
    status = np.asarray(fit.map.step(z)[1].status)
    assert np.mean(status == 0) > 0.8
    np.testing.assert_array_equal(fit.map.step(moved)[1].status, status)
    far = z.copy()
    far[:, 5] += 5.0
    assert (np.asarray(fit.map.step(far)[1].status) == 1).all()


@pytest.mark.slow
@pytest.mark.parametrize("ends", ["free", "fixed"])
def test_the_ends_of_a_chain_and_a_term_that_a_user_knows(ends):
    pinned = Part(Terms(1, ("p1", "1/(1 + q1**2)"), ((2, 0), (0, 1))), Windows(ends, 0))
    family = Sums(20, (pinned, Part(Terms(2, ("q2 - q1",), ((2,), (4,))), Windows(ends, 1))))
    pairs = drawn(20, 12, family, np.array([0.5, -1.0, 0.1, 0.2]), 0.2)
    fit = gfnn.fit(pairs, structure="chain", terms=["1/(1 + q1**2)"], tolerance=1e-12)
    assert fit.met
    found = {"1/(1 + q_i**2)", "p_i²", "(q_{i+1} - q_i)²", "(q_{i+1} - q_i)⁴"}
    assert {term for term, *_ in fit.hamiltonian.terms} == found
    (bonds,) = (p.over for p in fit.map.pieces[0].family.parts if p.over.reach)
    assert bonds.ends == ends


@pytest.mark.slow
@pytest.mark.parametrize("structure", ["ring:2", "chain:2"])
def test_two_fields_at_every_site(tmp_path, structure):
    """A chain of springs, each site with an oscillator on it: as written out, learned and saved."""
    dim, kind = 20, structure[:-2]
    ends = "ring" if kind == "ring" else "fixed"
    site = Terms(
        2, ("p1", "p2", "q2", "q1"), ((2, 0, 0, 0), (0, 2, 0, 0), (0, 0, 2, 0), (0, 0, 2, 1))
    )
    bonds = Terms(4, ("q3 - q1", "q4 - q2"), ((2, 0), (0, 2)))
    family = Sums(dim, (Part(site, Windows(ends, 0, 2)), Part(bonds, Windows(ends, 1, 2))))
    exact = np.array([0.5, 0.25, 0.3, 0.2, 0.5, 0.1])
    z0 = 0.3 * RNG.normal(size=(16, 2 * dim))

    def written(z):
        (q, s), (p, r) = (x.reshape(-1, 2).T for x in (z[:dim], z[dim:]))
        around = [jnp.append(x, x[0]) if kind == "ring" else jnp.pad(x, 1) for x in (q, s)]
        bond, other = (x[1:] - x[:-1] for x in around)
        own = 0.5 * p**2 + 0.25 * r**2 + 0.3 * s**2 + 0.2 * s**2 * q
        return jnp.sum(own) + jnp.sum(0.5 * bond**2 + 0.1 * other**2)

    gradient = jax.jit(jax.vmap(jax.grad(written)))(z0)
    np.testing.assert_allclose(family.gradient(exact, z0), gradient, atol=1e-13)
    z1 = images(family, exact, z0, 0.1, Steps(8, 1)).states
    fit = gfnn.fit(
        gfnn.Pairs(z0[:12], z1[:12], 0.1), structure=structure, terms=["q1*q2**2"], tolerance=1e-12
    )
    assert {term: round(c, 9) for term, c, _ in fit.hamiltonian.terms} == {
        "p1_i²": 0.5,
        "p2_i²": 0.25,
        "q2_i²": 0.3,
        "q1_i*q2_i**2": 0.2,
        "(q1_{i+1} - q1_i)²": 0.5,
        "(q2_{i+1} - q2_i)²": 0.1,
    }
    fit.map.save(tmp_path / "model")
    found, _ = gfnn.load(tmp_path / "model").map.step(z0[12:])
    np.testing.assert_allclose(found, z1[12:], atol=1e-13)


@pytest.mark.slow
def test_bodies_in_space():
    """Unequal masses: every coefficient; momentum and angular momentum to roundoff."""
    scene = scenes.n_body()
    pairs = gfnn.sample_pairs(scene, 300, jax.random.key(0))
    fit = gfnn.fit(pairs, scene, tolerance=1e-12)
    found = {term: coefficient for term, coefficient, _ in fit.hamiltonian.terms}
    masses = (1.0, 0.01, 0.02, 0.005)
    exact = {f"|p_{i + 1}|²": 0.5 / m for i, m in enumerate(masses)}
    for i, j in combinations(range(4), 2):
        exact[f"1/|q_{i + 1} - q_{j + 1}|"] = -masses[i] * masses[j]
    assert found == pytest.approx(exact, rel=1e-10)
    assert "- 0.01/|q_1 - q_2|" in str(fit.hamiltonian)
    states, _ = fit.map.rollout(gfnn.sample_test_states(scene, 5, jax.random.key(1)), 100)
    for name, invariant in scene.invariants.items():
        values = np.asarray(jax.vmap(jax.vmap(invariant))(np.asarray(states)))
        np.testing.assert_allclose(values, values[:, :1] * np.ones(101), atol=1e-15, err_msg=name)


def test_bodies_that_are_not_alike_are_told_by_the_midpoints_of_their_pairs():
    """Libraries of equal bodies are left out where their masses differ, and only there."""
    corners = 2 * np.pi / 3 * np.arange(3)
    around = np.stack([np.cos(corners), np.sin(corners)], axis=1).ravel()
    z0 = np.concatenate([around, np.zeros(6)]) + 0.1 * RNG.normal(size=(150, 12))
    family = body_terms(3, 2, (-1,), alike=False)
    equal, unequal = np.array([0.5] * 3 + [-1.0] * 3), np.array([0.5, 1, 2, -0.5, -0.25, -0.125])
    left = []
    for params in (equal, unequal):
        z1 = images(family, params, z0, 0.2, Steps(8, 2)).states
        data = Dataset.of(gfnn.Pairs(z0, z1, 0.2), CARTESIAN, Bodies(3, 2)).divided(0)
        libraries = list(data.structure.libraries(6))
        left.append([f.num_parameters for f in promising(libraries, data)])
    assert left[0] == [f.num_parameters for f in libraries]
    assert left[1] == [18, 33]


@pytest.mark.slow
def test_bodies_of_unequal_masses_told_nothing():
    masses = (1.0, 0.7, 0.4)
    family = body_terms(3, 2, (-1,), alike=False)
    pulls = [-masses[i] * masses[j] for i, j in combinations(range(3), 2)]
    exact = np.array([*(0.5 / m for m in masses), *pulls])
    corners = 2 * np.pi / 3 * np.arange(3)
    around = np.stack([np.cos(corners), np.sin(corners)], axis=1).ravel()
    z0 = np.concatenate([around, np.zeros(6)]) + 0.15 * RNG.normal(size=(300, 12))
    z1 = images(family, exact, z0, 0.1, Steps(8, 2)).states
    fit = gfnn.fit(gfnn.Pairs(z0, z1, 0.1), tolerance=1e-8, max_seconds=None)
    assert fit.chosen.label == "H, 6 terms"
    found = [coefficient for _, coefficient, _ in fit.hamiltonian.terms]
    np.testing.assert_allclose(found, exact, rtol=1e-9)


@pytest.mark.slow
def test_bodies_of_a_species_share_their_coefficients(tmp_path):
    """Two light and two heavy ones: a coefficient for each species and each pair of species, as it
    is written out; from the command line, and from a saved model."""
    corners = 3.0 * np.array([1, 0, -1, 0, 0, 1, 0, -1])
    z0 = np.concatenate([corners, np.zeros(8)]) + 0.3 * RNG.normal(size=(260, 16))
    family = body_terms(4, 2, (-1,), species="abba")
    exact = np.array([0.5, 0.25, -2.0, -1.0, -4.0])

    def written(z):
        q, p = z[:8].reshape(4, 2), z[8:].reshape(4, 2)
        kinetic = sum(c * p[i] @ p[i] for i, c in enumerate((0.5, 0.25, 0.25, 0.5)))
        pulls = {(0, 1): -2, (0, 2): -2, (1, 3): -2, (2, 3): -2, (0, 3): -1, (1, 2): -4}
        return kinetic + sum(c / jnp.linalg.norm(q[i] - q[j]) for (i, j), c in pulls.items())

    gradient = jax.vmap(jax.grad(written))(z0[:3])
    np.testing.assert_allclose(family.gradient(exact, z0[:3]), gradient, atol=1e-13)
    z1 = images(family, exact, z0, 0.2, Steps(8, 1)).states
    data, model = tmp_path / "data.npz", tmp_path / "model"
    np.savez(data, z0=z0, z1=z1, dt=0.2)
    given = ["fit", str(data), "--out", str(model), "--tolerance", "1e-12"]
    assert cli.main([*given, "--structure", "bodies:4:abb"]) == 2
    assert cli.main([*given, "--structure", "bodies:4:abba"]) == 0
    report = json.loads((model / "report.json").read_text(encoding="utf-8"))
    found = {term["term"]: term["coefficient"] for term in report["hamiltonian"]["terms"]}
    assert found == pytest.approx(
        {
            "Σ_{i∈a} |p_i|²": 0.5,
            "Σ_{i∈b} |p_i|²": 0.25,
            "Σ_{i∈a,j∈b} 1/|q_i - q_j|": -2.0,
            "1/|q_1 - q_4|": -1.0,
            "1/|q_2 - q_3|": -4.0,
        }
    )
    np.testing.assert_allclose(gfnn.load(model).map.step(z0[:5])[0], z1[:5], atol=1e-13)


@pytest.mark.slow
def test_a_generated_step_without_matrices():
    """Images, derivatives and the inverse as Newton's method with matrices has them."""
    family, params = springs(20)
    scale, z, v = np.ones(40), *(0.4 * jnp.asarray(RNG.normal(size=(2, 3, 40))))
    piece, dense = (
        Generated(f, params, CHARTS["midpoint"], 0.3, scale)
        for f in (family, gfnn.from_function(lambda c, w: family.value(c, w)))
    )

    @jax.jit
    def own(piece, z):
        def step(z, unrolled=False):
            return piece.step(z, unrolled=unrolled)[0]

        image, along = jax.jvp(step, (z,), (v,))
        _, unrolled = jax.jvp(lambda z: step(z, True), (z,), (v,))
        return image, along, unrolled, jax.vjp(step, z)[1](v)[0], piece.inverse().step(image)[0]

    image, along, unrolled, across, back = own(piece, z)
    # ∂Z/∂z of every lane: its products with v are both kinds of derivative.
    exact, jacobian = jax.jit(
        lambda piece, z: jax.vmap(
            lambda unit: jax.jvp(lambda z: piece.step(z)[0], (z,), (jnp.tile(unit, (3, 1)),)),
            out_axes=(None, -1),
        )(jnp.eye(40))
    )(dense, z)
    np.testing.assert_allclose(image, exact, atol=1e-13)
    np.testing.assert_allclose(along, np.einsum("nij,nj->ni", jacobian, v), atol=1e-13)
    np.testing.assert_allclose(unrolled, along, atol=1e-13)
    np.testing.assert_allclose(across, np.einsum("nij,ni->nj", jacobian, v), atol=1e-13)
    np.testing.assert_allclose(back, z, atol=1e-14)
    refined, error = piece.refined_step(np.asarray(z), np.asarray(z))
    np.testing.assert_allclose(refined, image, atol=1e-14)
    assert (error < 1e-14).all()


@pytest.mark.slow
def test_where_the_fixed_point_diverges():
    """S of 1,000 sites at a long dt: its equation to roundoff, the inverse, NumPy's own solve; a
    lane that is not finite says so; no array of (2d)² numbers."""
    dim, dt = 1_000, 3.0
    family, params = springs(dim)
    z = 0.3 * RNG.normal(size=(3, 2 * dim))
    z[2, 7] = np.nan

    def moved(w):
        return dt * apply_j(family.gradient(params, w))

    w = z[:2]
    with np.errstate(all="ignore"):
        for _ in range(20):
            w = z[:2] + 0.5 * moved(w)
    assert not (np.abs(w) < 1e3).all()
    piece = Generated(family, params, CHARTS["midpoint"], dt, np.ones(2 * dim))
    step = jax.jit(lambda piece, z: piece.step(z)).lower(piece, z).compile()
    image, info = step(piece, z)
    np.testing.assert_array_equal(info.status, [0, 0, NON_FINITE])
    z, image = z[:2], np.asarray(image)[:2]
    np.testing.assert_allclose(image - z, moved(0.5 * (z + image)), atol=1e-13)
    refined, error = piece.refined_step(z, 0.5 * (z + image) + 1e-4 * RNG.normal(size=z.shape))
    np.testing.assert_allclose(refined, image, atol=1e-12)
    assert (error < 1e-13).all()
    back = jax.jit(lambda piece, z: piece.inverse().step(z)[0])(piece, image)
    np.testing.assert_allclose(back, z, atol=1e-13)
    memory = step.memory_analysis()
    assert memory is None or memory.temp_size_in_bytes < 8 * (2 * dim) ** 2


@pytest.mark.slow
def test_a_flow_whose_fixed_point_diverges():
    """Compare Newton–Krylov with Newton's method by matrices, states and tangents."""
    family, params = springs(20)
    scale, (z, v) = np.ones(40), 0.4 * jnp.asarray(RNG.normal(size=(2, 2, 40)))
    free = Flow(family, params, 2.0, scale, 3)
    plain = gfnn.from_function(lambda c, w: family.value(c, w))
    dense = Flow(plain, params, 2.0, scale, 3, newton=True)

    @jax.jit
    def both(flow):
        image, along = jax.jvp(lambda z: flow.step(z)[0], (z,), (v,))
        return image, along, flow.step(z)[1].status

    assert not images(family, params, np.asarray(z), 2.0, Steps(3, 1)).solved.any()
    (image, along, status), (exact, tangent, _) = both(free), both(dense)
    np.testing.assert_array_equal(status, 0)
    np.testing.assert_allclose(image, exact, atol=1e-13)
    np.testing.assert_allclose(along, tangent, atol=1e-12)
    _, unrolled = jax.jit(lambda z: jax.jvp(lambda z: free.step(z, unrolled=True)[0], (z,), (v,)))(
        z
    )
    np.testing.assert_allclose(unrolled, along, atol=1e-12)


def test_gmres_takes_any_matrix():
    """Each lane as NumPy's dense solve has it; skew ones too, on which a plain residual method
    breaks down."""
    matrices = RNG.normal(size=(3, 12, 12))
    matrices[1] -= matrices[1].T
    rhs = RNG.normal(size=(3, 12))
    rhs[2] = 0.0

    def product(v):
        return (matrices @ v[..., None])[..., 0]

    exact = np.linalg.solve(matrices, rhs[..., None])[..., 0]
    np.testing.assert_allclose(krylov.solve(product, rhs, 1e-14), exact, rtol=1e-9, atol=1e-12)
    found = jax.jit(lambda rhs: krylov.solve_to_roundoff(product, rhs))(rhs)
    np.testing.assert_allclose(found, exact, rtol=1e-9, atol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("reduced", [False, True])
def test_coupled_standard_maps(tmp_path, reduced):
    """No flow: S of every site, whichever turns the images of the angles are given with."""
    scene = scenes.froeschle(dim=24)
    pairs = gfnn.sample_pairs(scene, 60, jax.random.key(0))
    z0, exact = np.asarray(pairs.z0), np.asarray(pairs.z1)
    z1 = np.mod(exact, 2 * np.pi) if reduced else exact
    fit = gfnn.fit(gfnn.Pairs(z0[:50], z1[:50], 1.0), scene, tolerance=1e-12)
    assert (fit.met, fit.chosen.chart, fit.chosen.num_parameters) == (True, "type2", 3)
    assert fit.symplecticity_defect < 1e-14
    for _ in range(9):
        exact = np.asarray(jax.vmap(scene.step)(exact))
    states, info = fit.map.rollout(z0[50:], 10)
    assert (np.asarray(info.status) == 0).all()
    off = np.remainder(states[:, -1] - exact[50:] + np.pi, 2 * np.pi) - np.pi
    np.testing.assert_allclose(off, 0, atol=1e-11)
    back, _ = fit.map.inverse(states[:, 1])
    off = np.remainder(back - z0[50:] + np.pi, 2 * np.pi) - np.pi
    np.testing.assert_allclose(off, 0, atol=1e-13)
    fit.map.save(tmp_path / "model")
    again, _ = gfnn.load(tmp_path / "model").map.rollout(z0[50:], 10)
    np.testing.assert_array_equal(again, states)


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"structure": "torus"}, "expected a structure among"),
        ({"structure": "ring:3"}, "expected 3 q of every site; got 20"),
        ({"structure": "ring", "chart": "type1"}, "another chart"),
        ({"structure": "ring"}, "at least 8 pairs, got 3"),
        ({"structure": "bodies:10:ab"}, "a letter for each of 10 bodies, as bodies:10:abbbbbbbbb"),
    ],
)
def test_what_goes_with_no_structure_is_refused(options, said):
    rows = 3 if "got 3" in said else 12
    pairs = gfnn.Pairs(*(RNG.normal(size=(2, rows, 40))), 0.1)
    with pytest.raises(gfnn.FitError, match=said):
        gfnn.fit(pairs, **options)


@pytest.mark.slow
def test_a_structure_is_proposed_and_not_used():
    def best_of(family, params, dt=0.1):
        pairs = drawn(6, 60, family, params, dt)
        return " ".join(proposed(Dataset.of(pairs, CARTESIAN)))

    assert "the structure ring explains" in best_of(*springs(6))
    assert "the structure chain explains" in best_of(*springs(6, "free"))
    apart = body_terms(3, 2, (2, -1), alike=True)  # distances at random: near collisions apart
    assert "the structure bodies:3 explains" in best_of(apart, np.array([0.5, 0.3, 1e-3]), 0.02)
    bent = given_terms(6, [*(f"p{i}**2" for i in range(1, 7)), "q1*q3*q6", "q2**4*q5", "q1**2"])
    assert best_of(bent, np.array([0.5] * 6 + [3.0, 5.0, 1.0])) == ""
    pairs = drawn(6, 60, *springs(6), 0.1)
    with pytest.warns(gfnn.FitWarning, match="ring"):
        fit = gfnn.fit(pairs, learn="map", chart="type2", tolerance=1e-12, max_seconds=10)
    assert not fit.met


@pytest.mark.parametrize("kind", ["ring", "chain"])
def test_mode_energies_add_up(kind):
    """Check the sum: the energy of unit springs without the mean motion; one wave is one mode."""
    family, params = springs(8, "ring" if kind == "ring" else "free")
    harmonic, z = family.take([0, 1]), RNG.normal(size=(3, 16))
    z -= np.repeat(z.reshape(3, 2, 8).mean(axis=2), 8, axis=1)
    energies = figures.mode_energies(z, kind)
    np.testing.assert_allclose(energies.sum(axis=1), harmonic.value(params[:2], z), rtol=1e-13)
    site = np.arange(8) if kind == "ring" else np.arange(8) + 0.5
    wave = np.cos((2 if kind == "ring" else 1) * np.pi * 3 * site / 8)
    (energy,) = figures.mode_energies(np.concatenate([wave, wave])[None], kind)
    assert energy[2] > 1.0
    np.testing.assert_allclose(np.delete(energy, 2), 0, atol=1e-14)


@pytest.mark.slow
def test_the_posterior_of_sites_tells_noise_from_misfit():
    """A larger library leaves the noise too: standard errors are those of independent noise."""
    family, params = springs(8)
    clean = drawn(8, 60, family, params, 0.2)
    noisy = (np.asarray(z) + 1e-3 * RNG.normal(size=z.shape) for z in (clean.z0, clean.z1))
    with pytest.warns(gfnn.FitWarning):
        fit = gfnn.fit(gfnn.Pairs(*noisy, 0.2), structure="ring", learn="hamiltonian")
    alike = np.array([term.std for term in fit.hamiltonian.terms])
    ratio = np.linalg.norm(fit.hamiltonian.root, axis=0) / alike
    assert np.all((ratio > 0.5) & (ratio < 2))
