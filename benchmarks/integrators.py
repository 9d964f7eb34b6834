"""Integrators of a scene whose H is known, the limit that learned maps are compared with.

Each integrator is a `Runner`. Its precision is an argument of the run, so that a sweep over
precisions compiles once.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
from scipy.integrate import solve_ivp

from gfnn_jax.phase_space import hamiltonian_vector_field
from gfnn_jax.scenes import Scene
from gfnn_jax.scenes.systems import MU

# γ₁, …, γ_s of the symmetric compositions Φ(γ_s h) ∘ … ∘ Φ(γ₁ h) of leapfrogs Φ; the second half
# mirrors the first. Yoshida, Phys. Lett. A 150 (1990); Kahan & Li, Math. Comp. 66 (1997).
_YOSHIDA = 1 / (2 - 2 ** (1 / 3))
COMPOSITIONS = {
    "leapfrog": (1.0,),
    "Yoshida 4": (_YOSHIDA, 1 - 2 * _YOSHIDA),
    "Kahan–Li 8": (
        0.13020248308889008087881763,
        0.56116298177510838456196441,
        -0.38947496264484728640807860,
        0.15884190655515560089621075,
        -0.39590389413323757733623154,
        0.18453964097831570709183254,
        0.25837438768632204729397911,
        0.29501172360931029887096624,
        -0.60550853383003451169892108,
    ),
}
ORDERS = {"leapfrog": 2, "Yoshida 4": 4, "Kahan–Li 8": 8}
DIFFRAX = {"Tsit5": diffrax.Tsit5, "Dopri5": diffrax.Dopri5, "Dopri8": diffrax.Dopri8}
TOLERANCES = (1e-3, 1e-5, 1e-7, 1e-9, 1e-11, 1e-13)
# Sizes of the compositions: a leapfrog costs a force.
FORCES_PER_DT = (1, 2, 4, 8, 16, 32, 64, 128)
MOST_STEPS = 1_000_000


@dataclasses.dataclass(frozen=True)
class Runner:
    """An integrator of a scene.

    run: ``run(z0, time, precision)`` -> the states (B, 2d) that z0 (B, 2d) reach; NaN where it
    fails. precisions: what to hand it, labelled. arrangement: what a batch is to it.
    """

    name: str
    run: Callable
    precisions: dict[str, float]
    arrangement: str


# The scenes' equations of motion, written as a user of NumPy or heyoka would


def field_of(scene: Scene) -> Callable:
    """``field(q1, q2, p1, p2)`` -> the four derivatives, of arrays, numbers or expressions."""
    return {"two-body": _two_body, "pcr3bp": _pcr3bp}.get(scene.name, _henon_heiles)


def _two_body(x, y, px, py):
    cubed = (x * x + y * y) ** -1.5
    return px, py, -x * cubed, -y * cubed


def _henon_heiles(x, y, px, py):
    return px, py, -x - 2 * x * y, -y - x * x + y * y


def _pcr3bp(x, y, px, py):
    larger = (1 - MU) * ((x + MU) * (x + MU) + y * y) ** -1.5
    smaller = MU * ((x + MU - 1) * (x + MU - 1) + y * y) ** -1.5
    return (
        px + y,
        py - x,
        py - (x + MU) * larger - (x + MU - 1) * smaller,
        -px - y * (larger + smaller),
    )


# Runge–Kutta


def _runge_kutta(scene: Scene, name: str) -> Runner:
    assert scene.hamiltonian is not None
    field = hamiltonian_vector_field(scene.hamiltonian)
    term = diffrax.ODETerm(lambda t, z, _: field(z, t))

    def lane(z, time, tolerance):
        solution = diffrax.diffeqsolve(
            term,
            DIFFRAX[name](),
            0.0,
            time,
            None,
            z,
            stepsize_controller=diffrax.PIDController(rtol=tolerance, atol=tolerance),
            adjoint=diffrax.ForwardMode(),
            max_steps=MOST_STEPS,
            throw=False,
        )
        assert solution.ys is not None
        return jnp.where(solution.result == diffrax.RESULTS.successful, solution.ys[-1], jnp.nan)

    run = jax.jit(jax.vmap(lane, in_axes=(0, None, None)))
    return Runner(f"diffrax {name}", run, _labelled(TOLERANCES), "lanes of a vmap, own steps")


def _dop853(scene: Scene) -> Runner:
    field = field_of(scene)

    def run(z0, time, tolerance):
        shape = z0.shape[::-1]

        def rate(_, z):
            return np.concatenate([np.ravel(r) for r in field(*z.reshape(shape))])

        def scalar_rate(_, z):
            return field(*z)

        solved = solve_ivp(
            scalar_rate if len(z0) == 1 else rate,
            (0, time),
            np.asarray(z0).T.ravel(),
            method="DOP853",
            rtol=tolerance,
            atol=tolerance,
            t_eval=[time],
        )
        if not solved.success:
            return np.full(z0.shape, np.nan)
        return solved.y[:, -1].reshape(shape).T

    return Runner("SciPy DOP853", run, _labelled(TOLERANCES), "one system, a common step")


# Taylor series


def _taylor(scene: Scene) -> Runner:
    import heyoka as hy

    variables = hy.make_vars("x", "y", "px", "py")
    equations = list(zip(variables, field_of(scene)(*variables), strict=True))
    width = hy.recommended_simd_size()

    @functools.cache
    def single(tolerance):
        return hy.taylor_adaptive(equations, np.ones(4), tol=tolerance)

    @functools.cache
    def batch(tolerance):
        return hy.taylor_adaptive_batch(equations, np.ones((4, width)), tol=tolerance)

    def run(z0, time, tolerance):
        z0 = np.asarray(z0)
        states = np.empty_like(z0)
        if len(z0) == 1:
            integrator = single(tolerance)
            integrator.time = 0.0
            integrator.state[:] = z0[0]
            ok = integrator.propagate_until(time)[0] == hy.taylor_outcome.time_limit
            states[0] = integrator.state if ok else np.nan
            return states
        integrator = batch(tolerance)
        for first in range(0, len(z0), width):
            group = z0[first : first + width]
            integrator.set_time(0.0)
            integrator.state[:] = group[np.arange(width) % len(group)].T
            integrator.propagate_until(time)
            ok = [r[0] == hy.taylor_outcome.time_limit for r in integrator.propagate_res]
            reached = np.where(ok, integrator.state, np.nan).T
            states[first : first + width] = reached[: len(group)]
        return states

    tolerances = (*TOLERANCES, 1e-15)
    return Runner("heyoka", run, _labelled(tolerances), f"{width} at once, one thread")


# Symplectic, of H = T(p) + V(q)


def _composition(scene: Scene, name: str) -> Runner:
    half = COMPOSITIONS[name]
    kicks = np.array([*half, *half[-2::-1]])
    drifts = 0.5 * (np.append(kicks, 0) + np.append(0, kicks))
    assert scene.hamiltonian is not None
    slope, dim = jax.grad(scene.hamiltonian), scene.dim

    def step(z, h):
        q, p = z[:dim], z[dim:]
        for drift, kick in zip(drifts, [*kicks, 0.0], strict=True):
            q = q + drift * h * slope(jnp.concatenate([q, p]))[dim:]
            if kick:
                p = p - kick * h * slope(jnp.concatenate([q, p]))[:dim]
        return jnp.concatenate([q, p])

    @jax.jit
    def steps(z0, time, number):
        h = time / number
        return jax.vmap(lambda z: jax.lax.fori_loop(0, number, lambda _, y: step(y, h), z))(z0)

    def run(z0, time, forces_per_dt):
        number = max(1, round(time / scene.dt * forces_per_dt / len(kicks)))
        return steps(z0, time, number)

    forces = {f"{n} forces per dt": float(n) for n in FORCES_PER_DT}
    return Runner(name, run, forces, "lanes of a vmap")


def _labelled(tolerances: Sequence[float]) -> dict[str, float]:
    return {f"tolerance {t:.0e}": t for t in tolerances}


def runners(scene: Scene, separable: bool) -> Iterator[tuple[str, Runner | str]]:
    """(name, Runner or why there is none) of every integrator."""
    names: dict[str, Callable[[], Any]] = {
        f"diffrax {n}": lambda n=n: _runge_kutta(scene, n) for n in DIFFRAX
    }
    names |= {"SciPy DOP853": lambda: _dop853(scene), "heyoka": lambda: _taylor(scene)}
    names |= {n: lambda n=n: _composition(scene, n) for n in COMPOSITIONS}
    for name, make in names.items():
        if scene.hamiltonian is None:
            yield name, "a map without a flow"
        elif name in COMPOSITIONS and not separable:
            yield name, "H is not T(p) + V(q)"
        else:
            try:
                yield name, make()
            except ImportError:
                yield name, "not installed"
