"""Integrators that make return maps and stroboscopic maps: SciPy, diffrax, heyoka."""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Callable
from typing import Any

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
from scipy.integrate import solve_ivp

SOLVERS = {"Tsit5": diffrax.Tsit5, "Dopri8": diffrax.Dopri8}
PRECISIONS = (1e-4, 1e-6, 1e-8, 1e-10, 1e-12)
AMPLITUDE = 0.15
ITERATIONS = 100  # after which the error is taken again


@dataclasses.dataclass(frozen=True)
class Sizes:
    """Sizes of a measurement.

    pairs: of a fit. lanes: of a batch. judged: states whose error is taken. few: those of them that
    SciPy is given. steps: of a timed rollout. repeats: calls of which the best counts.
    """

    pairs: int
    lanes: int
    judged: int
    few: int
    steps: int
    repeats: int
    precisions: tuple[float, ...]


# The two systems, written as a user of NumPy, JAX or heyoka would


def henon_heiles_rate(x, y, px, py):
    return px, py, -x - 2 * x * y, -y - x * x + y * y


def pendulum_rate(q, p, sin_q, cos_t):
    return p, -sin_q * (1 + AMPLITUDE * cos_t)


def lifted(z) -> list[float]:
    """(x, y, p_x, p_y) on the section, of (y, p_y), at E = 0.1."""
    y, py = map(float, z)
    return [0.0, y, math.sqrt(0.2 - py * py - y * y + 2 / 3 * y**3), py]


# The integrators. Each is ``iterate(z0, iterations, precision)`` -> the states (B, 2) after them,
# and how many iterations that were. ``precision`` is (tolerance, time of the pendulum's step).


def section_by_scipy(z0, iterations, precision):
    """The event starts on the section and is found there first: it stops at its second."""
    tolerance, _ = precision

    def rate(_, x):
        return henon_heiles_rate(*x.tolist())

    def crossing(_, x):
        return x[0]

    crossing.terminal, crossing.direction = 2, 1.0  # type: ignore[attr-defined]
    z = np.array(z0)
    for lane in range(len(z)):
        for _ in range(iterations):
            solved = solve_ivp(
                rate,
                (0, 20),
                lifted(z[lane]),
                method="DOP853",
                events=crossing,
                rtol=tolerance,
                atol=tolerance,
            )
            z[lane] = solved.y_events[0][-1][[1, 3]]
    return z, len(z) * iterations


def pendulum_by_scipy(z0, iterations, precision):
    """Integrate by SciPy: one state as plain numbers, several as one system with a common step."""
    tolerance, end = precision

    def rate(t, z):
        q, p = z.tolist()
        return pendulum_rate(q, p, math.sin(q), math.cos(t))

    def stacked_rate(t, z):
        q, p = z.reshape(2, -1)
        return np.concatenate(pendulum_rate(q, p, np.sin(q), math.cos(t)))

    z = np.array(z0).T.ravel()
    for _ in range(iterations):
        z = solve_ivp(
            rate if len(z0) == 1 else stacked_rate,
            (0, end),
            z,
            method="DOP853",
            rtol=tolerance,
            atol=tolerance,
            t_eval=[end],
        ).y[:, -1]
    return z.reshape(2, -1).T, len(z0) * iterations


def _diffeqsolve(solver, field, start, end, z, tolerance, until=None):
    solution = diffrax.diffeqsolve(
        diffrax.ODETerm(lambda t, z, _: field(t, z)),
        solver,
        start,
        end,
        None,
        z,
        stepsize_controller=diffrax.PIDController(rtol=tolerance, atol=tolerance),
        event=None if until is None else diffrax.Event(lambda t, y, args, **_: until(t, y)),
        max_steps=100_000,
        throw=False,
    )
    assert solution.ys is not None
    return solution.ys[-1]


def _iterated(step):
    """``iterate`` by ``step(z, precision)``, compiled once for each number of lanes."""

    @jax.jit
    def iterated(z0, iterations, precision):
        def lane(z):
            return jax.lax.fori_loop(0, iterations, lambda _, z: step(z, precision), z)

        return jax.vmap(lane)(z0)

    def iterate(z0, iterations, precision):
        return np.asarray(iterated(z0, iterations, precision)), len(z0) * iterations

    return iterate


def section_by_diffrax(solver):
    """Integrate to the first step beyond the section, and back onto it with x as the variable.

    This is Hénon's trick; it is as accurate as the steps.
    """

    def field(_, x):
        return jnp.stack(henon_heiles_rate(*x))

    def by_x(_, x):
        rate = field(0.0, x)
        return rate / rate[0]

    def step(z, precision):
        tolerance, (y, py) = precision[0], z
        px = jnp.sqrt(0.2 - py**2 - y**2 + 2 / 3 * y**3)
        x = jnp.stack([jnp.zeros_like(y), y, px, py])
        # A return takes 6.0 to 6.5; for the first half of it x is positive too.
        x = _diffeqsolve(solver, field, 0.0, 20.0, x, tolerance, lambda t, x: (t > 4) & (x[0] > 0))
        return _diffeqsolve(solver, by_x, x[0], 0.0, x, tolerance)[jnp.array([1, 3])]

    return _iterated(step)


def pendulum_by_diffrax(solver):
    def field(t, z):
        return jnp.stack(pendulum_rate(z[0], z[1], jnp.sin(z[0]), jnp.cos(t)))

    def step(z, precision):
        tolerance, end = precision
        return _diffeqsolve(solver, field, 0.0, end, z, tolerance)

    return _iterated(step)


def section_by_heyoka(hy, width):
    """``width`` trajectories at once: one, or as many as fit the processor's vectors."""
    x, y, px, py = hy.make_vars("x", "y", "px", "py")
    equations = list(zip((x, y, px, py), henon_heiles_rate(x, y, px, py), strict=True))
    found: list[list[Any]] = [[] for _ in range(width)]

    def crossed(ta, t, _, lane=0):
        if t > 1.0:  # not the start
            ta.update_d_output(t if width == 1 else np.full(width, t))
            found[lane].append(np.reshape(ta.d_output, (4, width))[1::2, lane].copy())

    upwards = hy.event_direction.positive

    @functools.cache
    def integrator(tolerance):
        if width == 1:
            event = hy.nt_event(x, crossed, direction=upwards)
            return hy.taylor_adaptive(equations, np.ones(4), tol=tolerance, nt_events=[event])
        event = hy.nt_event_batch(x, crossed, direction=upwards)
        start = np.ones((4, width))
        return hy.taylor_adaptive_batch(equations, start, tol=tolerance, nt_events=[event])

    def iterate(z0, iterations, precision):
        """A return takes 6.0 to 6.5: all make as many as were asked for, some a few more."""
        states, made = np.empty(np.shape(z0)), 0
        for first in range(0, len(z0), width):
            group = z0[first : first + width]
            for crossings in found:
                crossings.clear()
            starts = np.array([lifted(group[i % len(group)]) for i in range(width)]).T
            _propagated(integrator(precision[0]), starts, 6.5 * iterations + 1.0)
            made += sum(map(len, found))
            states[first : first + width] = [c[iterations - 1] for c in found[: len(group)]]
        return states, made

    return iterate


def pendulum_by_heyoka(hy, width):
    """Integrate by heyoka through all periods without a stop."""
    q, p = hy.make_vars("q", "p")
    equations = list(zip((q, p), pendulum_rate(q, p, hy.sin(q), hy.cos(hy.time)), strict=True))

    @functools.cache
    def integrator(tolerance):
        if width == 1:
            return hy.taylor_adaptive(equations, np.ones(2), tol=tolerance)
        return hy.taylor_adaptive_batch(equations, np.ones((2, width)), tol=tolerance)

    def iterate(z0, iterations, precision):
        tolerance, end = precision
        states = np.empty(np.shape(z0))
        for first in range(0, len(z0), width):
            group = np.asarray(z0[first : first + width])
            starts = group[np.arange(width) % len(group)].T
            reached = _propagated(integrator(tolerance), starts, iterations * end)
            states[first : first + width] = reached.T[: len(group)]
        return states, len(z0) * iterations

    return iterate


def _propagated(integrator, starts, end):
    """The states (n, width) at time ``end``, from ``starts`` (n, width) at time 0."""
    if starts.shape[1] == 1:
        integrator.time, integrator.state[:] = 0.0, starts[:, 0]
    else:
        integrator.set_time(0.0)
        integrator.state[:] = starts
    integrator.propagate_until(end)
    return np.reshape(integrator.state, starts.shape)


@dataclasses.dataclass(frozen=True)
class Tool:
    """An integrator: how it iterates one trajectory, and many at once (None where it cannot)."""

    single: Callable
    batch: Callable | None
    precisions: tuple[float, ...]
    judged: int  # states whose error is taken


def tools(name: str, sizes: Sizes) -> dict[str, Tool]:
    """The integrators of "section" or "pendulum"."""
    section = name == "section"
    by_diffrax = section_by_diffrax if section else pendulum_by_diffrax
    by_heyoka = section_by_heyoka if section else pendulum_by_heyoka
    few = Tool(section_by_scipy, None, sizes.precisions, sizes.few)
    if not section:
        few = Tool(pendulum_by_scipy, pendulum_by_scipy, sizes.precisions, sizes.few)
    found = {"SciPy DOP853": few}
    for solver, make in SOLVERS.items():
        iterate = by_diffrax(make())
        found[f"diffrax {solver}"] = Tool(iterate, iterate, sizes.precisions, sizes.judged)
    try:
        import heyoka as hy
    except ImportError:
        print("  heyoka is not installed")
        return found
    single, batch = by_heyoka(hy, 1), by_heyoka(hy, hy.recommended_simd_size())
    found["heyoka"] = Tool(single, batch, (*sizes.precisions, 1e-15), sizes.judged)
    return found
