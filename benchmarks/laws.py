"""Learning H: formulas out of raw pairs, and what their flows are worth beside maps.

    python benchmarks/laws.py            every row (about ten minutes on two cores)
    python benchmarks/laws.py --quick    two of them

Each row learns from pairs of a system whose H is known, and judges by states that no fit has seen:
the one-step error, the error at step 1,000 beside that of the reference itself, the coefficients,
the time of a step in a batch of 1,000, and the defect of the executed step.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from harness import (
    SEED,
    TABLES,
    Numbers,
    between_markers,
    finite,
    main,
    markdown,
    number,
    once,
    provenance,
    results,
    timed,
)
from scipy.integrate import solve_ivp

import gfnn_jax as gfnn
from gfnn_jax.baselines import METHODS, Budget, Sequences
from gfnn_jax.families.terms import given_terms, joined, polynomial_terms
from gfnn_jax.flows.flow import Flow
from gfnn_jax.jobs.compare import CAP, RATE
from gfnn_jax.maps.rollout import rollout
from gfnn_jax.phase_space import apply_j
from gfnn_jax.scenes.trajectories import reference_error

STEPS, ORBITS, BATCH = 1_000, 100, 1_000
DRIFT_STEPS, DRIFT_ORBITS, RESAMPLED = 1_000_000, 128, 300
# Of the double pendulum: the angles' difference in the denominator.
RATIONAL = ("1/(1 + sin(q1 - q2)**2)",)


HENON_HEILES = {"q1²": 0.5, "q2²": 0.5, "p1²": 0.5, "p2²": 0.5, "q1² q2": 1.0, "q2³": -1 / 3}
# Published methods, their training bounded as that of a comparison.
OTHERS = ("hnn", "srnn-2")


# Fits and what is measured of them


def learned(pairs: gfnn.Pairs, fresh: gfnn.Pairs, scene=None, **options) -> tuple[Any, Numbers]:
    """(fit, figures) of the law of these pairs."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", gfnn.FitWarning)
        fit = gfnn.fit(pairs, scene, seed=SEED, **{"learn": "auto", **options})
    error = np.asarray(fit.map.step(fresh.z0)[0]) - np.asarray(fresh.z1)
    law = fit.hamiltonian
    z = np.resize(np.asarray(fresh.z0), (BATCH, fresh.z0.shape[1]))
    rolled = timed(lambda: fit.map.rollout(z, 100, save_every=100)[0], 3)
    return fit, {
        "pairs": len(pairs),
        "chosen": fit.chosen.learns,
        "label": fit.chosen.label,
        "one_step_rms": float(np.sqrt(np.mean(error**2))),
        "fit_seconds": fit.seconds - fit.compile_seconds,
        "compile_seconds": fit.compile_seconds,
        "microseconds_per_step": 1e6 * rolled.seconds / (100 * BATCH),
        "symplecticity_defect": fit.symplecticity_defect,
        "formula": fit.formula,
        "num_terms": None if law is None else len(law.terms),
        "messages": list(fit.messages),
    }


def coefficient_error(fit, expected: dict[str, float]) -> float | None:
    """The largest error of a coefficient; None where other terms were found."""
    if fit.formula is None or {t.term for t in fit.hamiltonian.terms} != set(expected):
        return None
    return max(abs(t.coefficient - expected[t.term]) for t in fit.hamiltonian.terms)


def orbits(scene, num_orbits: int) -> np.ndarray:
    """Initial states of the orbits of `rolled_out`."""
    return np.asarray(gfnn.sample_test_states(scene, num_orbits, jax.random.key(SEED + 2)))


def rolled_out(fit, scene, num_orbits: int, exact_error: bool = True) -> Numbers:
    """Position errors of fresh orbits at the last step, and the reference's own."""
    z0 = orbits(scene, num_orbits)
    reference = np.asarray(gfnn.reference_trajectories(scene, z0, STEPS))
    states, info = fit.map.rollout(z0, STEPS)
    error = gfnn.metrics.position_error(np.asarray(states), reference)[:, -1]
    known = np.isfinite(error)
    status = np.bincount(np.asarray(info.status), minlength=5)
    return {
        "error_median": float(np.median(np.where(known, error, np.inf))),
        "error_worst": float(np.max(np.where(known, error, np.inf))),
        "lost": int((~known).sum()),
        "lost_orbits": np.flatnonzero(~known).tolist(),
        "not_converged": int(status[3]),
        "reference_error": float(reference_error(scene, z0[:5], STEPS)) if exact_error else None,
    }


def pairs_of(scene, num_pairs: int) -> tuple[gfnn.Pairs, gfnn.Pairs]:
    """Pairs to learn from, and fresh ones."""
    key, fresh = jax.random.split(jax.random.key(SEED))
    return finite(gfnn.sample_pairs(scene, num_pairs, key)), finite(
        gfnn.sample_pairs(scene, 1_000, fresh)
    )


def pairs_by_flow(hamiltonian: Callable, draw: Callable, num_pairs: int, dt: float, substeps=20):
    """Pairs and fresh ones of a system that is no scene: twelve Gauss stages in many substeps."""
    z = draw(np.random.default_rng(SEED), num_pairs + 1_000)
    width = z.shape[1]
    flow = Flow(hamiltonian, np.zeros(()), dt, np.ones(width), stages=10, substeps=substeps)
    image, info = jax.jit(lambda z: flow.step(z))(jnp.asarray(z))
    good = np.asarray(info.status) == 0
    z, image = z[good], np.asarray(image)[good]
    whole = gfnn.Pairs(z, image, dt)
    return whole.take(slice(1_000, None)), whole.take(slice(1_000))


# The rows


def henon_heiles(name: str, quick: bool) -> Numbers:
    """Hénon–Heiles from 100 pairs, told nothing."""
    scene = gfnn.scenes.make(name)
    pairs, fresh = pairs_of(scene, 100)
    fit, found = learned(pairs, fresh, tolerance=1e-13)
    regular = scene.regular and not quick
    return {
        **found,
        "coefficient_error": coefficient_error(fit, HENON_HEILES),
        **(rolled_out(fit, scene, 20) if regular else {}),
    }


def drift(fit, scene) -> Numbers:
    """Growth of the energy error of 128 orbits over a million steps.

    The exponents are those of its mean size and of its deviation between orbits, ½ for a random
    walk, with standard errors by the bootstrap over orbits. The mean error at the end has its sign,
    and is left by a bias of the rounding.
    """
    z0 = np.asarray(gfnn.sample_test_states(scene, DRIFT_ORBITS, jax.random.key(SEED + 3)))
    saved = 200
    states, _ = fit.map.rollout(z0, DRIFT_STEPS, save_every=DRIFT_STEPS // saved)
    energy = np.asarray(jax.vmap(jax.vmap(scene.invariants["energy"]))(states))
    error = (energy - energy[:, :1])[:, 1:]
    steps = DRIFT_STEPS // saved * np.arange(1, saved + 1)

    def exponents(error) -> np.ndarray:
        sizes = np.stack([np.abs(error).mean(axis=0), error.std(axis=0)], axis=-1)
        return np.polyfit(np.log(steps), np.log(sizes), 1)[0]

    rng = np.random.default_rng(SEED)
    again = [exponents(error[rng.integers(0, len(error), len(error))]) for _ in range(RESAMPLED)]
    (of_size, of_walk), deviations = exponents(error).tolist(), np.std(again, axis=0).tolist()
    end = error[:, -1]
    return {
        "drift_orbits": len(error),
        "drift_exponent": of_size,
        "drift_exponent_deviation": deviations[0],
        "walk_exponent": of_walk,
        "walk_exponent_deviation": deviations[1],
        "energy_error_end": float(np.abs(end).mean()),
        "energy_bias_end": float(end.mean()),
        "energy_bias_deviation": float(end.std() / np.sqrt(len(end))),
    }


def drift_of_law(quick: bool) -> Numbers:
    """Growth of the energy error of the law of Hénon–Heiles."""
    scene = gfnn.scenes.make("henon-heiles-regular")
    pairs, fresh = pairs_of(scene, 100)
    fit, found = learned(pairs, fresh, tolerance=1e-13)
    return found if quick else {**found, **drift(fit, scene)}


def long_step(dt: float, quick: bool) -> Numbers:
    """Hénon–Heiles at a long step, 400 pairs, by ``auto``."""
    scene = gfnn.scenes.henon_heiles(1 / 12, dt)
    pairs, fresh = pairs_of(scene, 400)
    return learned(pairs, fresh, tolerance=1e-12)[1]


def three_bodies(quick: bool) -> Numbers:
    """Planar restricted three bodies, the scene's features."""
    scene = gfnn.scenes.make("pcr3bp")
    pairs, fresh = pairs_of(scene, 1_000)
    fit, found = learned(pairs, fresh, scene, tolerance=1e-12)
    rolled = rolled_out(fit, scene, ORBITS, exact_error=False)
    closest, lost = closest_approaches(scene, orbits(scene, ORBITS)), rolled["lost_orbits"]
    kept = np.delete(closest, lost)
    return {
        **found,
        **rolled,
        "closest_of_lost": closest[lost].tolist(),
        "closest_of_kept": float(kept.min()),
    }


def closest_approaches(scene, z0) -> np.ndarray:
    """Smallest distance (N,) of each orbit from either body within its 1,000 steps.

    It is taken over the points where scipy's DOP853 evaluates the field, which are dense where the
    orbit is near a body.
    """
    dim, near = scene.dim, np.full(len(z0), np.inf)

    @jax.jit
    def field(z):
        closeness = jnp.max(scene.features(z)[2 * dim :])
        return apply_j(jax.grad(scene.hamiltonian)(z)), 1 / closeness

    for i, z in enumerate(z0):

        def noted(_, z, i=i):
            velocity, distance = field(z)
            near[i] = min(near[i], distance)
            return np.asarray(velocity)

        solve_ivp(noted, (0, STEPS * scene.dt), z, method="DOP853", rtol=1e-12, atol=1e-12)
    return near


def two_body_pairs(most: float = 0.6) -> tuple[gfnn.Pairs, gfnn.Pairs]:
    """Pairs of two bodies in Cartesian coordinates, e up to ``most``: 500, and fresh ones."""

    def draw(rng, num):
        """Draw states of orbits of semi-major axis 1, of any phase, orientation and sense."""
        e, angle, phase = rng.uniform(0, most, num), *rng.uniform(0, 2 * np.pi, (2, num))
        # The eccentric anomaly, so that all of the orbit is seen.
        r = 1 - e * np.cos(phase)
        b = np.sqrt(1 - e**2)
        x = np.stack([np.cos(phase) - e, b * np.sin(phase)])
        v = np.stack([-np.sin(phase) / r, b * np.cos(phase) / r])
        turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        return np.concatenate([np.einsum("ijn,jn->in", turn, y) for y in (x, v)]).T

    def hamiltonian(_, z):
        return 0.5 * (z[2] ** 2 + z[3] ** 2) - 1 / jnp.sqrt(z[0] ** 2 + z[1] ** 2)

    return pairs_by_flow(hamiltonian, draw, 500, 0.1)


def cartesian_two_body(quick: bool) -> Numbers:
    """Learn two bodies in Cartesian coordinates, 1/r among thirty terms, e up to 0.6."""
    pairs, fresh = two_body_pairs()
    fit, found = learned(pairs, fresh, tolerance=1e-13, terms=["1/sqrt(q1**2 + q2**2)"])
    exact = {"1/sqrt(q1**2 + q2**2)": -1.0, "p1²": 0.5, "p2²": 0.5}
    return {**found, "coefficient_error": coefficient_error(fit, exact)}


def double_pendulum(dt: float, terms: Sequence[str], quick: bool) -> Numbers:
    """Learn the double pendulum of equal rods and masses; the angles cover their circles."""

    def hamiltonian(_, z):
        q1, q2, p1, p2 = z[0], z[1], z[2], z[3]
        c = jnp.cos(q1 - q2)
        kinetic = (p1**2 + 2 * p2**2 - 2 * p1 * p2 * c) / (2 * (1 + jnp.sin(q1 - q2) ** 2))
        return kinetic - 2 * jnp.cos(q1) - jnp.cos(q2)

    def draw(rng, num):
        angles, momenta = rng.uniform(-np.pi, np.pi, (num, 2)), rng.uniform(-1, 1, (num, 2))
        return np.concatenate([angles, momenta], axis=1)

    pairs, fresh = pairs_by_flow(hamiltonian, draw, 5_000, dt)
    learn = {"learn": "hamiltonian", "terms": terms} if terms else {"learn": "auto"}
    return learned(pairs, fresh, angles=(0, 1), tolerance=1e-12 if terms else 1e-6, **learn)[1]


def kicked_pendulum(quick: bool) -> Numbers:
    """A pendulum kicked after every step, a map that no H has: the flow of what H explains with S
    for the rest, beside either alone, and with the pendulum's own H known."""

    def hamiltonian(_, z):
        return 0.5 * z[1] ** 2 - jnp.cos(z[0])

    def draw(rng, num):
        return np.stack([rng.uniform(-np.pi, np.pi, num), rng.uniform(-1.5, 1.5, num)], axis=1)

    def kicked(pairs):
        z1 = np.asarray(pairs.z1)
        return gfnn.Pairs(
            pairs.z0, z1 + np.stack([0 * z1[:, 0], 0.2 * np.sin(3 * z1[:, 0])], 1), pairs.dt
        )

    pairs, fresh = (kicked(p) for p in pairs_by_flow(hamiltonian, draw, 2_000, 0.5))
    options = {"angles": (0,), "tolerance": 1e-12}
    _, found = learned(pairs, fresh, **options)
    alone = {
        f"one_step_rms_{learn}": learned(pairs, fresh, learn=learn, **options)[1]["one_step_rms"]
        for learn in ("map", "hamiltonian")
    }
    _, known = learned(pairs, fresh, base="0.5*p**2 - cos(q)", **options)
    return {**found, **alone, "one_step_rms_base": known["one_step_rms"]}


def network_pendulum(quick: bool) -> Numbers:
    """A pendulum of any angle whose H is a network, told nothing but the angle."""

    def hamiltonian(_, z):
        return 0.5 * z[1] ** 2 - jnp.cos(z[0])

    def draw(rng, num):
        return rng.uniform([-np.pi, -1.5], [np.pi, 1.5], (num, 2))

    pairs, fresh = pairs_by_flow(hamiltonian, draw, 500, 0.3)
    options = {"learn": "hamiltonian", "family": "mlp", "angles": (0,), "tolerance": 1e-6}
    fit, found = learned(pairs, fresh, **options)
    return {**found, "chosen": "network H", "num_terms": fit.chosen.num_parameters}


def accelerated(name: str, quick: bool) -> Numbers:
    """A law from few pairs, and a generated map from the law; both stepped in a batch of 1,000."""
    scene = gfnn.scenes.make(name)
    few, tolerance, terms = {
        "henon-heiles-regular": (100, 1e-12, ()),
        "two-body": (200, 1e-10, ("1/q1", "p2**2/q1**2", "p1**2")),
    }[name]
    pairs, fresh = pairs_of(scene, few)
    fit, found = learned(
        pairs, fresh, scene, learn="hamiltonian", terms=terms, tolerance=0.1 * tolerance
    )
    fast, seconds, _ = once(lambda: fit.accelerate(tolerance=tolerance))
    error = np.asarray(fast.map.step(fresh.z0)[0]) - np.asarray(fresh.z1)
    begun = np.resize(np.asarray(fresh.z0), (BATCH, fresh.z0.shape[1]))
    rolled = timed(lambda: fast.map.rollout(begun, 100, save_every=100)[0], 3)
    return {
        **found,
        "label": fast.chosen.label,
        "chosen": "map of the law",
        "law_one_step_rms": found["one_step_rms"],
        "law_microseconds": found["microseconds_per_step"],
        "num_terms": fast.chosen.num_parameters,
        "fit_seconds": seconds,
        "one_step_rms": float(np.sqrt(np.mean(error**2))),
        "microseconds_per_step": 1e6 * rolled.seconds / (100 * BATCH),
        "symplecticity_defect": fast.symplecticity_defect,
    }


def derivative_matching(task: str, quick: bool) -> Numbers:
    """H from finite differences of the same pairs: J∇H(½(z₀ + z₁)) = (z₁ − z₀)/dt, least squares
    over the 34 products up to degree 3, and 1/r for two bodies. Its flow is judged as the others
    are."""
    pairs, fresh, scene = same_pairs(task)
    family = polynomial_terms(2, 3)
    if scene is None:
        family = joined(given_terms(2, ["1/sqrt(q1**2 + q2**2)"]), family)
        exact = {"1/sqrt(q1**2 + q2**2)": -1.0, "p1²": 0.5, "p2²": 0.5}
    else:
        exact = HENON_HEILES
    z0, z1 = np.asarray(pairs.z0), np.asarray(pairs.z1)
    gradients = family.term_gradients(0.5 * (z0 + z1))
    target = -apply_j(z1 - z0) / pairs.dt
    design = gradients.reshape(-1, family.num_parameters)
    c = np.linalg.lstsq(design, target.ravel(), rcond=None)[0]
    flow = Flow(family, c, pairs.dt, np.ones(4), stages=8)
    error = np.asarray(flow.step(jnp.asarray(fresh.z0))[0]) - np.asarray(fresh.z1)
    exact = dict.fromkeys(family.term_names, 0.0) | exact
    off = [abs(v - exact[n]) for n, v in zip(family.term_names, c, strict=True)]
    return {
        "pairs": len(pairs),
        "chosen": "derivative matching",
        "num_terms": len(c),
        "one_step_rms": float(np.sqrt(np.mean(error**2))),
        "coefficient_error": max(off),
    }


# Hard cases: what is kept and what is said


def hard(quick: bool) -> Numbers:
    """Hard cases: the error at states that no fit has seen, beside all that the fit says."""
    cases = [(name, *make()) for name, make in HARD.items()]
    return {"cases": [hard_case(*case) for case in (cases[:2] if quick else cases)]}


def hard_case(name: str, pairs: gfnn.Pairs, fresh: gfnn.Pairs, options: Numbers) -> Numbers:
    try:
        fit, found = learned(pairs, fresh, **options)
    except gfnn.FitError as error:
        return {"case": name, "pairs": len(pairs), "chosen": "refused", "messages": [str(error)]}
    kept = ("pairs", "chosen", "label", "one_step_rms", "fit_seconds", "formula", "messages")
    return {"case": name, **{key: found[key] for key in kept}, "met": fit.met}


def far_too_long_a_step():
    scene = gfnn.scenes.henon_heiles(1 / 12, 10.0)
    return *pairs_of(scene, 400), {"tolerance": 1e-8}


def close_passages():
    """Data of two bodies, e up to 0.98 at the semi-major axis 1: passages at 0.02."""
    pairs, fresh = two_body_pairs(most=0.98)
    return pairs, fresh, {"tolerance": 1e-8, "terms": ["1/sqrt(q1**2 + q2**2)"]}


def rational_well():
    """½p² − 1/(1 + 4q²), told nothing: no polynomial of few terms."""

    def hamiltonian(_, z):
        return 0.5 * z[1] ** 2 - 1 / (1 + 4 * z[0] ** 2)

    pairs = pairs_by_flow(hamiltonian, lambda rng, num: rng.uniform(-1.5, 1.5, (num, 2)), 500, 0.2)
    return *pairs, {"tolerance": 1e-8, "learn": "hamiltonian"}


def collinear_terms():
    pairs, fresh = pairs_of(gfnn.scenes.make("henon-heiles-regular"), 200)
    terms = ["q1**2 + q2**2", "q1**2 - q2**2", "p1**2 + p2**2 + q1**2"]
    return pairs, fresh, {"tolerance": 1e-12, "terms": terms}


def friction():
    """Momenta lose a hundredth of themselves in every step."""

    def damped(pairs):
        return gfnn.Pairs(pairs.z0, pairs.z1 * np.array([1, 1, 0.99, 0.99]), pairs.dt)

    pairs, fresh = pairs_of(gfnn.scenes.make("henon-heiles-regular"), 1_000)
    return damped(pairs), damped(fresh), {"tolerance": 1e-8}


def few_pairs(num_pairs: int):
    pairs, fresh = pairs_of(gfnn.scenes.make("henon-heiles-regular"), num_pairs)
    return pairs, fresh, {"tolerance": 1e-8}


def noise():
    pairs, fresh = pairs_of(gfnn.scenes.make("henon-heiles-regular"), 1_000)
    rng = np.random.default_rng(SEED)
    off = [1e-3 * rng.normal(size=pairs.z0.shape) for _ in range(2)]
    noisy = gfnn.Pairs(np.asarray(pairs.z0) + off[0], np.asarray(pairs.z1) + off[1], pairs.dt)
    return noisy, fresh, {"tolerance": 1e-8}


HARD = {
    "a step far too long: Hénon–Heiles, ωh = 10": far_too_long_a_step,
    "close passages: two bodies, e up to 0.98, dt 0.1": close_passages,
    "no polynomial of few terms: a rational well": rational_well,
    "collinear terms": collinear_terms,
    "friction: a hundredth of p a step": friction,
    "20 pairs of Hénon–Heiles": partial(few_pairs, 20),
    "10 pairs of Hénon–Heiles": partial(few_pairs, 10),
    "noise of 1e-3 on every number": noise,
}


def same_pairs(task: str) -> tuple[gfnn.Pairs, gfnn.Pairs, Any]:
    """The pairs of a task, fresh ones, and its scene where it has one."""
    if task == "two-body-cartesian":
        return *two_body_pairs(), None
    scene = gfnn.scenes.make(task)
    return *pairs_of(scene, 100), scene


def of_others(task: str, method: str, quick: bool) -> Numbers:
    """A published method on the same pairs, by its public code's recipe; the operations of its
    training are bounded."""
    pairs, fresh, scene = same_pairs(task)
    z = np.stack([np.asarray(pairs.z0), np.asarray(pairs.z1)], axis=1)
    budget = Budget(jax.random.key(SEED + 4), RATE * (5.0 if quick else CAP))
    found = METHODS[method].learn(Sequences(z, float(np.ravel(pairs.dt)[0])), budget)
    step, training = found.step, found.training
    error = np.asarray(jax.jit(jax.vmap(step))(fresh.z0)) - np.asarray(fresh.z1)
    begun = np.resize(np.asarray(fresh.z0), (BATCH, fresh.z0.shape[1]))
    rolled = timed(lambda: rollout(step, begun, 10, save_every=10), 1)
    median = None
    if scene is not None:
        z0 = np.asarray(gfnn.sample_test_states(scene, 20, jax.random.key(SEED + 2)))
        reference = np.asarray(gfnn.reference_trajectories(scene, z0, STEPS))
        last = gfnn.metrics.position_error(np.asarray(rollout(step, z0, STEPS)), reference)[:, -1]
        median = float(np.median(np.where(np.isfinite(last), last, np.inf)))
    return {
        "pairs": len(pairs),
        "chosen": METHODS[method].title,
        "label": found.label,
        "num_terms": found.num_parameters,
        "one_step_rms": float(np.sqrt(np.mean(error**2))),
        "error_median": median,
        "fit_seconds": training.seconds,
        "compile_seconds": training.compile_seconds,
        "stopped_because": training.stopped_because,
        "microseconds_per_step": 1e6 * rolled.seconds / (10 * BATCH),
    }


PIECES = {
    "henon-heiles-regular": partial(henon_heiles, "henon-heiles-regular"),
    "henon-heiles-chaotic": partial(henon_heiles, "henon-heiles-chaotic"),
    "henon-heiles-derivatives": partial(derivative_matching, "henon-heiles-regular"),
    **{f"henon-heiles-{m}": partial(of_others, "henon-heiles-regular", m) for m in OTHERS},
    **{f"henon-heiles-dt-{dt:g}": partial(long_step, dt) for dt in (1.0, 2.0, 3.0, 4.0)},
    "henon-heiles-drift": drift_of_law,
    "three-bodies": three_bodies,
    "two-body-cartesian": cartesian_two_body,
    "two-body-derivatives": partial(derivative_matching, "two-body-cartesian"),
    **{f"two-body-{m}": partial(of_others, "two-body-cartesian", m) for m in OTHERS},
    "kicked-pendulum": kicked_pendulum,
    "network-pendulum": network_pendulum,
    **{
        f"map-of-law-{name}": partial(accelerated, name)
        for name in ("henon-heiles-regular", "two-body")
    },
    **{
        f"double-pendulum-{dt:g}{'-term' if terms else ''}": partial(double_pendulum, dt, terms)
        for dt in (0.05, 0.2)
        for terms in ((), RATIONAL)
    },
    "hard": hard,
}


def tables() -> None:
    """The table of RESULTS.md."""
    heads = (
        "system",
        "pairs",
        "chosen",
        "terms",
        "one-step RMS",
        "coefficients",
        "step 1,000",
        "lost",
        "fit, s",
        "µs a step",
        "defect",
    )
    rows = []
    found = results(PIECES, "laws")
    hard_ones = found.pop("hard", None)
    for name, result in found.items():
        m = result["measured"]
        rows.append(
            [
                name,
                number(m["pairs"]),
                m["chosen"],
                number(m.get("num_terms")),
                *(
                    number(m.get(key))
                    for key in ("one_step_rms", "coefficient_error", "error_median")
                ),
                lost(m),
                *(
                    number(m.get(key))
                    for key in ("fit_seconds", "microseconds_per_step", "symplecticity_defect")
                ),
            ]
        )
    text = f"{markdown(heads, rows)}\n\n{provenance(found)}"
    between_markers(TABLES, "laws", text)
    if hard_ones is not None:
        between_markers(TABLES, "laws-hard", hard_table(hard_ones["measured"]["cases"]))


def lost(m: Numbers) -> str:
    """Number of lost orbits as text, with their distance from a body where it is known."""
    if not m.get("closest_of_lost"):
        return number(m.get("lost"))
    within = max(m["closest_of_lost"])
    return (
        f"{m['lost']}, which pass a body within {number(within)}; all others stay "
        f"{number(m['closest_of_kept'])} away"
    )


def hard_table(cases: list[Numbers]) -> str:
    """Table of a row per case: the model, its accuracy, the messages."""
    rows = [
        [
            c["case"],
            number(c["pairs"]),
            c["chosen"] + (f": {c['label']}" if "label" in c else ""),
            number(c.get("one_step_rms")),
            "yes" if c.get("met") else "no",
            "<br>".join(c["messages"]).replace("|", "\\|") or "–",
        ]
        for c in cases
    ]
    heads = ("case", "pairs", "chosen", "one-step RMS", "tolerance met", "said")
    return markdown(heads, rows)


if __name__ == "__main__":
    quick = ("henon-heiles-regular", "henon-heiles-dt-1")
    main(__doc__ or "", PIECES, "laws", tables, None, quick)
