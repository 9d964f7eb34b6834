"""Baselines whose step is an explicit map: SympNets, P-SympNet, SRNN's integrators."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gfnn_jax.baselines.srnn import leapfrog, tao
from gfnn_jax.baselines.sympnets import g_init, g_step, la_init, la_step, p_init, p_step
from gfnn_jax.phase_space import apply_j, split, symplecticity_defect
from gfnn_jax.scenes import henon_heiles, pcr3bp
from gfnn_jax.scenes.trajectories import reference_trajectories

DT = 0.1
STATES = np.random.default_rng(0).uniform(-1, 1, (20, 4))


def roughened(params, seed=1):
    """Float64 parameters far from the small ones that a training starts with."""
    rng = np.random.default_rng(seed)
    return jax.tree.map(lambda a: np.asarray(a, float) + 0.3 * rng.standard_normal(a.shape), params)


def jacobians(step, states):
    return np.asarray(jax.jit(jax.vmap(jax.jacfwd(step)))(states))


def largest_defect(step, states):
    return np.max(symplecticity_defect(jacobians(step, states)))


KEY = jax.random.key(0)
SYMPLECTIC = {
    "la": (la_step, lambda: la_init(KEY, 2, 6, 4)),
    "g": (g_step, lambda: g_init(KEY, 2, 7, 9)),
    "p": (lambda params, z: p_step(params, z, DT), lambda: p_init(KEY, 2, 7, 3)),
}


@pytest.mark.parametrize(
    "name", ["la", *(pytest.param(n, marks=pytest.mark.slow) for n in SYMPLECTIC if n != "la")]
)
def test_steps_are_symplectic_and_have_gradients_whatever_the_parameters(name):
    """Gradients that a training follows, along a direction, against finite differences."""
    step, init = SYMPLECTIC[name]
    params = roughened(jax.jit(init)())

    @jax.jit
    def all_of(params, z):
        images, back = jax.vjp(lambda params: jax.vmap(lambda z: step(params, z))(z), params)
        (gradient,) = back(jnp.ones_like(images))
        return images, jax.vmap(jax.jacfwd(lambda z: step(params, z)))(z), gradient

    images, found, gradient = all_of(params, STATES)
    assert np.abs(images - STATES).max() > 0.1  # not the identity
    assert np.max(symplecticity_defect(np.asarray(found))) < 1e-14 * np.abs(found).max() ** 2
    direction = roughened(jax.tree.map(np.zeros_like, params), seed=2)
    ends = [
        np.sum(all_of(jax.tree.map(lambda a, b, by=by: a + by * b, params, direction), STATES)[0])
        for by in (1e-6, -1e-6)
    ]
    slope = sum(map(np.vdot, jax.tree.leaves(gradient), jax.tree.leaves(direction)))
    assert (ends[0] - ends[1]) / 2e-6 == pytest.approx(slope, rel=1e-6)


@pytest.mark.slow
def test_la_module_by_module():
    """A state through the paper's shears one after another, written out (their eqs. of LA)."""
    params = roughened(la_init(KEY, 2, 3, 4))
    q, p = np.array(STATES[0, :2]), np.array(STATES[0, 2:])
    for i in range(3):
        for j, half in enumerate(np.asarray(params["half"][i])):
            if j % 2 == 0:
                p = p + (half + half.T) @ q
            else:
                q = q + (half + half.T) @ p
        q, p = q + params["shift"][i, :2], p + params["shift"][i, 2:]
        if i < 2:
            active = np.asarray(params["active"][i])
            if i % 2 == 0:
                p = p + active / (1 + np.exp(-q))
            else:
                q = q + active / (1 + np.exp(-p))
    np.testing.assert_allclose(la_step(params, STATES[0]), np.concatenate([q, p]), rtol=1e-12)


def test_a_gradient_module_is_a_shear_by_a_gradient():
    """Check that a module moves p by the gradient of Σ aᵢ softplus(kᵢ·q + bᵢ)."""
    params = roughened(g_init(KEY, 2, 1, 9))
    inner, bias, outer = (params[k][0] for k in ("inner", "bias", "outer"))
    for z in STATES[:3]:
        q, p = z[:2], z[2:]
        moved = p + (outer / (1 + np.exp(-inner @ q - bias))) @ inner
        np.testing.assert_allclose(jax.jit(g_step)(params, z), [*q, *moved], rtol=1e-12)


def test_a_ridge_is_the_exact_flow():
    """Compare a layer with the flow of H = f(w·z), by many small steps of its own field."""
    params = roughened(p_init(KEY, 2, 1, 4))
    direction, coefficients = params["direction"][0], params["coefficient"][0]
    potential = np.polynomial.Polynomial([0, 0, *coefficients])

    def field(z):
        return apply_j(potential.deriv()(direction @ z) * direction)

    flowed = z = STATES[0]
    for _ in range(100):
        flowed = flowed + DT / 100 * field(flowed + DT / 200 * field(flowed))
    np.testing.assert_allclose(jax.jit(p_step)(params, z, DT), flowed, rtol=1e-12, atol=1e-14)
    assert potential(direction @ flowed) == pytest.approx(potential(direction @ z), rel=1e-12)


def test_ridges_make_the_oscillator():
    """q²/2, p²/2, q²/2 in turn is leapfrog of the oscillator: a known map, to roundoff."""
    params = {
        "direction": np.array([[1.0, 0.0], [0.0, 1.0], [1.0, 0.0]]),
        "coefficient": np.array([[0.25], [0.5], [0.25]]),
    }
    z = np.array([0.3, -0.7])
    q, p = 0.3, -0.7 - DT / 2 * 0.3
    q = q + DT * p
    np.testing.assert_allclose(jax.jit(p_step)(params, z, DT), [q, p - DT / 2 * q], rtol=1e-14)


def hamiltonian_step(step_of, scene):
    """SRNN's step with the exact H in place of the network's."""
    gradient = jax.grad(scene.hamiltonian)
    if step_of is leapfrog:
        return lambda dt: leapfrog(
            lambda _, z: split(apply_j(gradient(z)))[0],
            lambda _, z: split(apply_j(gradient(z)))[1],
            dt,
        )
    return lambda dt: tao(lambda _, z: scene.hamiltonian(z), dt)


def states_near(scene):
    """Eight states around that where the scene's orbit begins."""
    return scene.sampling.start + 0.05 * np.random.default_rng(3).normal(size=(8, 4))


@pytest.mark.slow
@pytest.mark.parametrize(("step_of", "make"), [(leapfrog, henon_heiles), (tao, pcr3bp)])
def test_integrators_are_of_second_order(step_of, make):
    """Check with the exact H that the error of a step falls eightfold at half the dt."""
    scene = make()
    states = states_near(scene)
    later = reference_trajectories(make(dt=0.01), states, 2)
    errors = []
    for dt, exact in ((0.02, later[:, 2]), (0.01, later[:, 1])):
        step = hamiltonian_step(step_of, scene)(dt)
        errors.append(
            np.max(np.abs(jax.jit(jax.vmap(lambda z, s=step: s(None, z)))(states) - exact))
        )
    assert errors[0] < 1e-3
    assert errors[0] / errors[1] == pytest.approx(8, rel=0.1)


@pytest.mark.slow
def test_leapfrog_is_symplectic_and_reversible():
    step = hamiltonian_step(leapfrog, henon_heiles())(0.5)
    assert largest_defect(lambda z: step(None, z), 0.3 * STATES) < 1e-14
    back = hamiltonian_step(leapfrog, henon_heiles())(-0.5)
    z = 0.3 * STATES[:5]
    returned = jax.jit(jax.vmap(lambda z: back(None, step(None, z))))(z)
    np.testing.assert_allclose(returned, z, atol=1e-14)


@pytest.mark.slow
def test_taos_step_is_symplectic_in_the_doubled_phase_space_only():
    """Check that the defect of the plain state is of order dt³, the copies' distance."""
    scene = pcr3bp()
    states = states_near(scene)
    defects = []
    for dt in (0.02, 0.01):
        step = hamiltonian_step(tao, scene)(dt)
        defects.append(largest_defect(lambda z, s=step: s(None, z), states))
    assert 1e-8 < defects[0] < 1e-2
    assert defects[0] / defects[1] == pytest.approx(8, rel=0.6)
