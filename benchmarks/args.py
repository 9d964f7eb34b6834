"""One law for pairs that differ in their time step, in parameters, in the time of a drive.

    python benchmarks/args.py            every row (about a minute on two cores)
    python benchmarks/args.py --quick    two of them

Each row learns H, or with -S in its name S, from pairs of a system whose H is known, and judges by
states, parameters and time steps that no fit has seen: the one-step error, the error at step 1,000
(driven: at step 1,600, after 100 periods) beside that of the reference itself, and the time of a
step in a batch of 1,000.
"""

from __future__ import annotations

import dataclasses
import warnings
from collections.abc import Sequence
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from harness import SEED, TABLES, Numbers, between_markers, main, markdown, number, results, timed

import gfnn_jax as gfnn
from gfnn_jax.coordinates import Coordinates
from gfnn_jax.scenes import DrawnFrom, Scene, driven_pendulum_phase, henon_heiles, pendulum_length
from gfnn_jax.scenes.draws import sample_params, sample_t0

STEPS, ORBITS, BATCH = 1_000, 100, 1_000


@dataclasses.dataclass(frozen=True)
class Ellipses:
    """``draw(key, num)``: bound orbits around a mass in (0.5, 2), a in (0.8, 1.2), e below 0.3."""

    def __call__(self, key, num):
        u = jax.random.uniform(key, (5, num), jnp.float64)
        mass, a, e = 0.5 + 1.5 * u[0], 0.8 + 0.4 * u[1], 0.3 * u[2]
        anomaly, turn = 2 * jnp.pi * u[3], 2 * jnp.pi * u[4]
        b, r = jnp.sqrt(1 - e**2), 1 - e * jnp.cos(anomaly)
        rate = jnp.sqrt(mass / a) / r
        q = jnp.stack([a * (jnp.cos(anomaly) - e), a * b * jnp.sin(anomaly)])
        p = jnp.stack([-rate * jnp.sin(anomaly), rate * b * jnp.cos(anomaly)])
        turned = jnp.array([[jnp.cos(turn), -jnp.sin(turn)], [jnp.sin(turn), jnp.cos(turn)]])
        q, p = (jnp.einsum("ijn,jn->in", turned, x) for x in (q, p))
        return jnp.concatenate([q, p, mass[None]]).T


def kepler_of_mass(z, t=0.0, args=(1.0,)):
    """‖p‖²/2 − m/r."""
    return z[2:] @ z[2:] / 2 - args[0] / jnp.sqrt(z[:2] @ z[:2])


def compound(z, t=0.0, args=(1.0,)):
    """A pendulum on a rod: a moment of inertia and a lever that are no powers of the length."""
    length = args[0]
    return z[1] ** 2 / (2 * (0.3 + length**2)) - 9.81 * (0.2 + length) * jnp.cos(z[0])


@dataclasses.dataclass(frozen=True)
class Swings:
    """``draw(key, num)``: swings by up to ``most`` radians."""

    most: float

    def __call__(self, key, num):
        area, turn = jax.random.uniform(key, (2, num), jnp.float64)
        half = jnp.sin(self.most / 2) * jnp.sqrt(area)
        q, p = jnp.cos(2 * jnp.pi * turn), jnp.sin(2 * jnp.pi * turn)
        return jnp.stack([2 * jnp.arcsin(half * q), 2 * half * p], axis=-1)


def pendulum(z, t=0.0, args=None):
    """p²/2 − cos q."""
    return z[1] ** 2 / 2 - jnp.cos(z[0])


KEPLER = Scene(
    "kepler-mass",
    "planets of stars of different masses",
    2,
    0.2,
    DrawnFrom(Ellipses()),
    hamiltonian=kepler_of_mass,
    parameters=("m",),
)

PENDULUM = Scene(
    "pendulum",
    "a pendulum of unit length, mass and gravity",
    1,
    0.25,
    DrawnFrom(Swings(2.6)),
    test_states=DrawnFrom(Swings(2.2)),
    hamiltonian=pendulum,
    coordinates=Coordinates("cartesian", angles=(0,)),
    reversor=(1, -1),
)


def learned(
    scene: Scene,
    num_pairs: int,
    quick: bool,
    *,
    dt_range=None,
    dt: float | None = None,
    lend: bool = False,
    **options,
) -> Numbers:
    """Figures of the law of these pairs. dt: at which it is judged. lend: the scene's coordinates
    and reversor are told."""
    key, fresh = jax.random.split(jax.random.key(SEED))
    pairs = gfnn.sample_pairs(scene, num_pairs, key, dt_range=dt_range)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", gfnn.FitWarning)
        fit = gfnn.fit(pairs, scene if lend else None, seed=SEED, **options)
    judged = scene if dt is None else dataclasses.replace(scene, dt=dt)
    new = gfnn.sample_pairs(judged, 1_000, fresh)
    args = None if new.args is None else np.stack([*new.args.values()], axis=-1)
    states, info = fit.map.step(new.z0, args, dt=judged.dt)
    one = gfnn.metrics.one_step_rms(np.asarray(states), new.z1, fit.map.coordinates.angles)
    key = jax.random.key(SEED + 2)
    z0 = gfnn.sample_test_states(scene, ORBITS, key)
    params = sample_params(scene, ORBITS, key, test=True)
    reference = gfnn.reference_trajectories(judged, z0, STEPS, save_every=STEPS, params=params)[
        :, -1:
    ]
    halved = dataclasses.replace(judged, dt=0.5 * judged.dt)
    again = gfnn.reference_trajectories(halved, z0, 2 * STEPS, save_every=2 * STEPS, params=params)[
        :, -1:
    ]
    predicted, ended = fit.map.rollout(z0, STEPS, params=params, dt=judged.dt, save_every=STEPS)
    angles = fit.map.coordinates.angles
    error = gfnn.metrics.position_error(np.asarray(predicted)[:, -1:], reference, angles)
    own = gfnn.metrics.position_error(again, reference, angles)
    begun, with_params = (
        None if a is None else np.resize(a, (BATCH, a.shape[1])) for a in (np.asarray(z0), params)
    )
    rolled = timed(
        lambda: fit.map.rollout(
            begun,
            10 if quick else 100,
            params=with_params,
            dt=judged.dt,
            save_every=10 if quick else 100,
        )
    )
    return {
        "pairs": num_pairs,
        "judged_at_dt": judged.dt,
        "num_terms": fit.chosen.num_parameters,
        "one_step_rms": one,
        "error_median": float(np.median(error)),
        "error_largest": float(np.max(error)),
        "reference_error": float(np.max(own)),
        "outside": int(np.sum(np.asarray(ended.status) > 0)),
        "fit_seconds": fit.chosen.fit_seconds,
        "microseconds_per_step": 1e6 * rolled.seconds / ((10 if quick else 100) * BATCH),
        "symplecticity_defect": fit.symplecticity_defect,
        "formula": fit.formula,
        "messages": list(fit.messages),
        "statuses": int(np.sum(np.asarray(info.status) > 0)),
    }


def irregular(quick: bool) -> Numbers:
    """Hénon–Heiles, dt uniform in (0.1, 1.2) per pair, predicted at 0.25."""
    return learned(henon_heiles(), 600, quick, dt_range=(0.1, 1.2), dt=0.25, tolerance=1e-12)


def of_step(quick: bool, scene: Scene, num_pairs: int, dt_range, dt: float) -> Numbers:
    """Learn S as a function of w and dt², with the scene's coordinates and reversor."""
    return learned(
        scene, num_pairs, quick, dt_range=dt_range, dt=dt, lend=True, learn="map", tolerance=1e-12
    )


def length(quick: bool, terms: Sequence[Any] = ()) -> Numbers:
    """A pendulum's length as a parameter."""
    return learned(pendulum_length(), 4_000, quick, lend=True, tolerance=1e-12, terms=terms)


def no_power(quick: bool) -> Numbers:
    """A dependence that no power of the parameter is: Chebyshev polynomials."""
    scene = dataclasses.replace(pendulum_length(), hamiltonian=compound)
    return learned(scene, 4_000, quick, lend=True, tolerance=1e-11)


def mass(quick: bool, terms: Sequence[Any]) -> Numbers:
    """Kepler's problem with the mass as a parameter, at irregular times."""
    return learned(KEPLER, 4_000, quick, dt_range=(0.05, 0.5), dt=0.2, tolerance=1e-12, terms=terms)


def kicked(z, strength):
    """The standard map."""
    p = z[:, 1] + strength * np.sin(z[:, 0])
    return np.stack([z[:, 0] + p, p], axis=1)


def standard_map(quick: bool) -> Numbers:
    """The strength of the kick as a parameter, in (0.5, 2): S, for there is no flow."""
    rng = np.random.default_rng(SEED)

    def sampled(count: int):
        return rng.uniform(0, 2 * np.pi, (count, 2)), rng.uniform(0.5, 2, count)

    z, strength = sampled(2_000)
    pairs = gfnn.Pairs(z, np.mod(kicked(z, strength), 2 * np.pi), 1.0, {"k": strength})
    fit = gfnn.fit(pairs, angles=(0, 1), tolerance=1e-12, seed=SEED)
    z, strength = sampled(1_000)
    states, info = fit.map.step(z, {"k": strength})
    one = gfnn.metrics.one_step_rms(np.asarray(states), kicked(z, strength), (0, 1))
    rolled = timed(lambda: fit.map.rollout(z, 100, params=strength, save_every=100))
    return {
        "pairs": len(pairs),
        "judged_at_dt": 1.0,
        "num_terms": fit.chosen.num_parameters,
        "one_step_rms": one,
        "error_median": None,
        "error_largest": None,
        "reference_error": None,
        "outside": int(np.sum(np.asarray(info.status) > 0)),
        "fit_seconds": fit.chosen.fit_seconds,
        "microseconds_per_step": 1e6 * rolled.seconds / (100 * BATCH),
        "symplecticity_defect": fit.symplecticity_defect,
        "terms": list(fit.map.pieces[0].family.term_names),
        "messages": list(fit.messages),
    }


def driven(quick: bool, num_pairs: int = 4_000, **options) -> Numbers:
    """A driven pendulum at any phase, 16 steps a period, over 100 periods."""
    scene, periods = driven_pendulum_phase(), 100
    steps = 16 * periods
    key, fresh, test = jax.random.split(jax.random.key(SEED), 3)
    pairs = gfnn.sample_pairs(scene, num_pairs, key)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", gfnn.FitWarning)
        fit = gfnn.fit(pairs, tolerance=1e-12, seed=SEED, **options)
    new = gfnn.sample_pairs(scene, 1_000, fresh)
    states, info = fit.map.step(new.z0, t0=new.t0)
    angles = fit.map.coordinates.angles
    one = gfnn.metrics.one_step_rms(np.asarray(states), new.z1, angles)
    z0, t0 = gfnn.sample_test_states(scene, ORBITS, test), sample_t0(scene, ORBITS, test)
    halved = dataclasses.replace(scene, dt=0.5 * scene.dt)
    reference, again = (
        gfnn.reference_trajectories(s, z0, n, save_every=n, t0=t0)[:, -1:]
        for s, n in ((scene, steps), (halved, 2 * steps))
    )
    predicted, ended = fit.map.rollout(z0, steps, t0=t0, save_every=steps)
    error = gfnn.metrics.position_error(np.asarray(predicted)[:, -1:], reference, angles)
    own = gfnn.metrics.position_error(again, reference, angles)
    begun, at = np.resize(z0, (BATCH, 2)), np.resize(np.asarray(t0), BATCH)
    timed_steps = 10 if quick else 100
    rolled = timed(lambda: fit.map.rollout(begun, timed_steps, t0=at, save_every=timed_steps))
    return {
        "pairs": num_pairs,
        "judged_at_dt": scene.dt,
        "num_terms": fit.chosen.num_parameters,
        "learns": fit.chosen.learns,
        "one_step_rms": one,
        "error_median": float(np.median(error)),
        "error_largest": float(np.max(error)),
        "reference_error": float(np.max(own)),
        "outside": int(np.sum(np.asarray(ended.status) > 0)),
        "fit_seconds": fit.chosen.fit_seconds,
        "microseconds_per_step": 1e6 * rolled.seconds / (timed_steps * BATCH),
        "symplecticity_defect": fit.symplecticity_defect,
        "formula": fit.formula,
        "messages": list(fit.messages),
        "statuses": int(np.sum(np.asarray(info.status) > 0)),
    }


PIECES = {
    "irregular-henon-heiles": irregular,
    "irregular-henon-heiles-S-600": partial(
        of_step, scene=henon_heiles(), num_pairs=600, dt_range=(0.1, 1.2), dt=0.25
    ),
    "irregular-henon-heiles-S-4000": partial(
        of_step, scene=henon_heiles(), num_pairs=4_000, dt_range=(0.1, 1.2), dt=0.25
    ),
    "irregular-pendulum-S": partial(
        of_step, scene=PENDULUM, num_pairs=2_000, dt_range=(0.1, 1.2), dt=0.25
    ),
    "pendulum-length": length,
    "pendulum-length-terms": partial(length, terms=("p**2/l**2", "l*cos(q)")),
    "compound-pendulum": no_power,
    "kepler-mass-terms": partial(mass, terms=("1/sqrt(q1**2 + q2**2)",)),
    "standard-map-strength": standard_map,
    "driven-pendulum": partial(driven, angles=(0,)),
    "driven-pendulum-polynomials": partial(driven, learn="hamiltonian"),
    "driven-pendulum-S": partial(driven, learn="map", chart="midpoint"),
}


def tables() -> None:
    """The table of RESULTS.md."""
    heads = (
        "system",
        "pairs",
        "terms",
        "one-step RMS",
        "in the end, median",
        "largest",
        "of the reference",
        "outside",
        "fit, s",
        "µs a step",
        "defect",
    )
    rows = []
    for name, result in results(PIECES, "args").items():
        m = result["measured"]
        rows.append(
            [
                name,
                *(
                    number(m[key])
                    for key in (
                        "pairs",
                        "num_terms",
                        "one_step_rms",
                        "error_median",
                        "error_largest",
                        "reference_error",
                        "outside",
                        "fit_seconds",
                        "microseconds_per_step",
                        "symplecticity_defect",
                    )
                ),
            ]
        )
    between_markers(TABLES, "args", markdown(heads, rows))


if __name__ == "__main__":
    quick = ("irregular-henon-heiles", "pendulum-length-terms", "driven-pendulum")
    main(__doc__ or "", PIECES, "args", tables, None, quick)
