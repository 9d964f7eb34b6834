"""Near singularities: eccentric Kepler orbits, and orbits around the smaller of two bodies."""

from __future__ import annotations

import dataclasses
import functools
import math

# Sets float64, so it comes before all of JAX.
from harness import SEED, Numbers, angles_of, drawn

# isort: split
import jax
import jax.numpy as jnp
import numpy as np
from hard.cases import Case, counts, digits_of, tried

import gfnn_jax as gfnn
from gfnn_jax.coordinates import TWO_PI, Coordinates, polar
from gfnn_jax.evaluate import metrics
from gfnn_jax.scenes import DrawnFrom, pcr3bp, two_body
from gfnn_jax.scenes.systems import MU


def delaunay() -> Coordinates:
    """(l, g, L, G) of plane bound Kepler motion with e > 0: L = √a, G the angular momentum; all but
    l stand still, and the mean anomaly l moves at the rate L⁻³. Both angles are cyclic."""

    def forward(z):
        q, p = z[:2], z[2:]
        r = jnp.sqrt(q @ q)
        a = 1 / (2 / r - p @ p)
        e_cos, e_sin = 1 - r / a, (q @ p) / jnp.sqrt(a)
        anomaly = jnp.arctan2(e_sin, e_cos)
        momentum = q[0] * p[1] - q[1] * p[0]
        e = jnp.sqrt(e_cos**2 + e_sin**2)
        true = jnp.arctan2(jnp.sqrt(1 - e**2) * jnp.sin(anomaly), jnp.cos(anomaly) - e)
        return jnp.stack([anomaly - e_sin, jnp.arctan2(q[1], q[0]) - true, jnp.sqrt(a), momentum])

    def inverse(y):
        mean, g, root_a, momentum = y
        e = jnp.sqrt(1 - (momentum / root_a) ** 2)
        mean = mean - TWO_PI * jnp.round(mean / TWO_PI)

        def newton(_, x):
            return x - (x - e * jnp.sin(x) - mean) / (1 - e * jnp.cos(x))

        # From π towards the root Newton's iterates never turn back.
        x = jax.lax.fori_loop(0, 30, newton, jnp.where(mean < 0, -jnp.pi, jnp.pi))
        a, b = root_a**2, root_a * momentum
        c, s = jnp.cos(x), jnp.sin(x)
        rate = 1 / (root_a * (1 - e * c))
        plane = jnp.stack([a * (c - e), b * s]), rate * jnp.stack([-s, momentum / root_a * c])
        turn = jnp.array([[jnp.cos(g), -jnp.sin(g)], [jnp.sin(g), jnp.cos(g)]])
        return jnp.concatenate([turn @ plane[0], turn @ plane[1]])

    return Coordinates("delaunay", angles=(0, 1), cyclic=(0, 1), forward=forward, inverse=inverse)


def ellipses(key, num, low: float, high: float):
    """States on Kepler ellipses, a in (0.8, 1.2), e in (low, high), everywhere in time."""
    u = jax.random.uniform(key, (4, num), jnp.float64)
    root_a = jnp.sqrt(0.8 + 0.4 * u[0])
    e = low + (high - low) * u[1]
    y = jnp.stack([TWO_PI * u[2], TWO_PI * u[3], root_a, root_a * jnp.sqrt(1 - e**2)], axis=-1)
    return jax.vmap(delaunay().inverse)(y)


def moon_states(key, num):
    """States on ellipses around the smaller body, r₂ about 0.03 to 0.09, both ways round."""
    z = ellipses(key, num, 0.05, 0.4)
    length = 0.06  # a of about 0.05 to 0.07: well inside the smaller body's sphere
    speed = math.sqrt(MU / length)
    q, p = length * z[:, :2], speed * z[:, 2:]
    # From the frame that moves with the body to the rotating one: p is the inertial velocity.
    return jnp.concatenate([q + jnp.array([1 - MU, 0.0]), p + jnp.array([0.0, 1 - MU])], axis=1)


def moon_polar() -> Coordinates:
    """Polar coordinates around the smaller body, in its own frame; φ is an angle."""
    inner = polar(cyclic=False)
    shift = np.array([1 - MU, 0.0, 0.0, 1 - MU])
    return Coordinates(
        "polar around the smaller body",
        angles=(1,),
        forward=lambda z: inner.forward(z - shift),
        inverse=lambda y: inner.inverse(y) + shift,
    )


def rolled(case: Case, fit, scene, num_steps: int = 100) -> Case:
    """The case after a hundred steps, from fresh states: digits of the median position error."""
    z0 = gfnn.sample_test_states(scene, 50, jax.random.key(SEED + 1))
    reference = np.asarray(gfnn.reference_trajectories(scene, z0, num_steps))
    states, info = fit.map.rollout(z0, num_steps)
    error = metrics.position_error(np.asarray(states), reference, angles_of(scene))
    size = float(np.nanstd(reference[:, :, : scene.dim]))
    median = float(metrics.error_statistics(error).median[-1]) / size
    flagged = "; ".join(part for part in (case.flagged, counts(info.status)) if part)
    return Case(f"{case.name}: {num_steps} steps", digits_of(median), 3, flagged)


def singular(quick: bool) -> tuple[list[Case], Numbers]:
    cases = []
    kepler = two_body()
    ranges = ((0.8, 0.9),) if quick else ((0.0, 0.3), (0.3, 0.6), (0.8, 0.9))
    for low, high in ranges:
        law = DrawnFrom(functools.partial(ellipses, low=low, high=high))
        named = {"polar": kepler.coordinates, "Delaunay": delaunay()}
        for label, coordinates in named.items():
            if label == "Delaunay" and low == 0:
                continue  # no periapsis, no Delaunay variables
            reversor = None if label == "Delaunay" else kepler.reversor
            scene = dataclasses.replace(
                kepler, sampling=law, coordinates=coordinates, reversor=reversor
            )
            data, fresh = drawn(scene, 1_000 if quick else 8_000, quick)
            case, fit = tried(
                f"Kepler, e in ({low:g}, {high:g}), dt = 0.1, {label}",
                data,
                scene,
                fresh,
                tolerance=1e-8,
                family="polynomial",
            )
            cases.append(case)
            if fit is not None:
                cases.append(rolled(case, fit, scene))
            print(f"  {cases[-1]}")
    for dt in (0.02,) if quick else (0.02, 0.05, 0.1):
        close = dataclasses.replace(
            pcr3bp(dt),
            sampling=DrawnFrom(moon_states),
            coordinates=moon_polar(),
            features=None,
            reversor=None,
        )
        plain = dataclasses.replace(pcr3bp(dt), sampling=DrawnFrom(moon_states))
        for label, scene in {"features 1/r₁, 1/r₂": plain, "polar around it": close}.items():
            data, fresh = drawn(scene, 1_000 if quick else 8_000, quick)
            case, fit = tried(
                f"three bodies, around the smaller one, dt = {dt:g}, {label}",
                data,
                scene,
                fresh,
                tolerance=1e-7,
            )
            cases.append(case)
            if fit is not None:
                cases.append(rolled(case, fit, scene))
            print(f"  {cases[-1]}")
    return cases, {}
