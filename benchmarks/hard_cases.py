"""What happens on hard cases: how many digits are kept, what is flagged, what fails and how.

    python benchmarks/hard_cases.py                          pieces that have no result yet, tables
    python benchmarks/hard_cases.py --only chaos --overwrite one piece again
    python benchmarks/hard_cases.py --quick                  small sizes, into runs/hard

A piece's result is one JSON file, hard-*.json in benchmarks/results; the section of
benchmarks/RESULTS.md and the figures are made from these files alone. The long pieces are fastest
with one thread: XLA_FLAGS=--xla_cpu_multi_thread_eigen=false.
"""

from __future__ import annotations

import dataclasses
import functools
import json
import math
import os
import subprocess
import sys
from collections.abc import Callable, Sequence
from typing import Any

# Sets float64, so it comes before all of JAX.
from harness import (
    FIGURES,
    HERE,
    RESULTS,
    SEED,
    TABLES,
    Numbers,
    angles_of,
    between_markers,
    bounded_states,
    drawn,
    fitted,
    in_float32,
    markdown,
    number,
    provenance,
    results,
    timed,
)
from harness import main as run_pieces

# isort: split
import jax
import jax.numpy as jnp
import numpy as np

import gfnn_jax as gfnn
from gfnn_jax.coordinates import CARTESIAN, TWO_PI, Coordinates, nearest_image, polar
from gfnn_jax.evaluate import figures, metrics
from gfnn_jax.families.inputs import box_inputs
from gfnn_jax.families.mlp import Mlp
from gfnn_jax.generating.charts import MIDPOINT, TYPE2
from gfnn_jax.generating.generated import Generated
from gfnn_jax.maps.domain import covering
from gfnn_jax.maps.symplectic_map import SymplecticMap
from gfnn_jax.scenes import DrawnFrom, Scene, henon_heiles, pcr3bp, standard_map, two_body
from gfnn_jax.scenes.pcr3bp import MU
from gfnn_jax.solve.status import OK, STATUS_NAMES

# Long times: orbits and their steps, steps there and back, the single orbit's, the map's.
LANES, STEPS, BACK, SINGLE, MAP_STEPS = 64, 1_000_000, 100_000, 10_000_000, 100_000_000
# Brouwer's law gives ½.
MOST_EXPONENT = 0.6
# A case is silent where so many digits less than asked for are kept, and nothing was said.
_SHORT = 1.0
# The tolerance is for the RMS: at the rim of the data errors are so many times larger.
_RIM = 100.0


@dataclasses.dataclass(frozen=True)
class Case:
    """A line of a table.

    digits: −log₁₀ of what is wrong, relative to its size; None where there is no such number.
    asked: the digits that were asked for, None where the case only has to be flagged or refused.
    flagged: what was said while it went on; failed: how it was refused or stopped.
    wrong: how many things went wrong without a word, where they are counted one by one.
    """

    name: str
    digits: float | None = None
    asked: float | None = None
    flagged: str = ""
    failed: str = ""
    wrong: int = 0

    @property
    def silent(self) -> bool:
        kept = -math.inf if self.digits is None else self.digits
        short = self.asked is not None and kept < self.asked - _SHORT
        return self.wrong > 0 or (short and not self.flagged and not self.failed)


def digits_of(error: float) -> float | None:
    """Digits of a relative error."""
    return -math.log10(max(error, 1e-17)) if math.isfinite(error) else None


def counts(status) -> str:
    """Statuses but ok, in words: "12 left the domain"."""
    number_of = np.bincount(np.ravel(np.asarray(status)), minlength=len(STATUS_NAMES))
    return ", ".join(
        f"{n} {name}" for n, name in zip(number_of[1:], STATUS_NAMES[1:], strict=True) if n
    )


def tried(name: str, pairs, scene, fresh, *, tolerance: float = 1e-6, **options):
    """Fit to an absolute tolerance and judge on fresh pairs: (Case, the fit or None)."""
    spread = float(np.std(np.asarray(fresh.z1), axis=0).max())
    asked = digits_of(tolerance / spread)
    try:
        fit, measured = fitted(pairs, scene, fresh, absolute_tolerance=tolerance, **options)
    except gfnn.FitError as error:
        return Case(name, None, asked, failed=str(error)), None
    image, info = fit.map.step(fresh.z0)
    error = nearest_image(np.asarray(image) - np.asarray(fresh.z1), angles_of(scene))
    # Where the fit had nothing to say, every lane that is called ok must be about as good as asked.
    bad = np.abs(error).max(axis=1) > _RIM * tolerance
    wrong = 0 if fit.messages else int(np.sum(bad & (np.asarray(info.status) == OK)))
    said = "; ".join(brief(message) for message in fit.messages)
    flagged = "; ".join(part for part in (said, counts(info.status)) if part)
    kept = digits_of(measured["one_step_rms"] / spread)
    return Case(name, kept, asked, flagged, wrong=wrong), fit


def brief(message: str) -> str:
    """The first clause of a warning: what a table has room for."""
    return message.split(": ")[0] if len(message) > 60 else message


# Bad conditions for the solver


def rough_map(strength: float, chart, seed: int, dim: int = 2) -> SymplecticMap:
    """A map generated by a random network whose weights are ``strength`` times too large."""
    states = np.asarray(jax.random.normal(jax.random.key(seed), (400, 2 * dim), jnp.float64))
    family = Mlp(box_inputs(states), (16, 16), "tanh", 1.0)
    params = family.init(jax.random.key(seed + 1), jnp.float64)
    params = jax.tree.map(lambda a: strength * np.asarray(a), params)
    unit = np.ones(2 * dim)
    generated = Generated(family, params, chart, 0.1, unit)
    return SymplecticMap((generated,), CARTESIAN, covering(states), unit, np.zeros(0), 0.1)


def residuals(map_: SymplecticMap, z, image) -> np.ndarray:
    """What the step's equation leaves over, computed anew from the states alone; (B,)."""
    piece = map_.pieces[0]
    w = piece.chart.evaluation_point(z, image)
    gradient, hessian = piece.family.gradient_and_hessian(piece.params, w)
    target = piece.chart.target_gradient(z, image, float(map_.dt))
    error = float(map_.dt) * np.abs(np.asarray(gradient) - target).max(axis=1)
    # w from the rounded image differs from the solver's by roundoff, which S'' magnifies.
    bend = np.abs(np.asarray(hessian)).max(axis=(1, 2))
    size = 1 + np.abs(z).max(axis=1) + np.abs(image).max(axis=1)
    return error / (size * (1 + float(map_.dt) * bend))


def stepped(map_: SymplecticMap, z) -> tuple[np.ndarray, Any]:
    """One step of few states, padded to a few sizes, each of which is compiled once."""
    rows = np.resize(np.arange(len(z)), max(16, 1 << (len(z) - 1).bit_length()))
    image, info = jax.tree.map(np.asarray, map_.step(z[rows]))
    return image[: len(z)], jax.tree.map(lambda a: a[: len(z)], info)


def branch_changes(map_: SymplecticMap, num_lines: int, num_points: int) -> tuple[int, int]:
    """Along straight lines through the data: neighbouring states that are both ok and whose images
    lie far apart, which further bisection does not bring together; and the number of neighbours."""
    rng = np.random.default_rng(SEED)
    ends = rng.standard_normal((2, num_lines, 1, 2 * map_.dim))
    along = np.linspace(0, 1, num_points)[:, None]
    z = ends[0] + (ends[1] - ends[0]) * along
    image, info = map_.step(z.reshape(-1, z.shape[-1]))
    image, ok = np.asarray(image).reshape(z.shape), np.asarray(info.status).reshape(z.shape[:2])
    ok = ok <= 1
    apart = np.linalg.norm(np.diff(image, axis=1), axis=-1)
    step = np.linalg.norm(np.diff(z, axis=1), axis=-1)
    suspects = np.argwhere(ok[:, 1:] & ok[:, :-1] & (apart > 20 * step))
    low, high = (z[suspects[:, 0], suspects[:, 1] + i] for i in (0, 1))
    changed = 0
    if len(suspects):
        for _ in range(30):  # towards the half whose ends lie further apart
            middle = 0.5 * (low + high)
            (a, m, b), infos = zip(*(stepped(map_, x) for x in (low, middle, high)), strict=True)
            left = np.linalg.norm(np.asarray(m - a), axis=-1)
            right = np.linalg.norm(np.asarray(b - m), axis=-1)
            # A lane that is flagged in between says where the branch ends.
            flagged = np.asarray(infos[1].status) > 1
            first = (np.nan_to_num(left, nan=np.inf) >= np.nan_to_num(right, nan=0.0))[:, None]
            high, low = np.where(first, middle, high), np.where(first, low, middle)
            low, high = low[~flagged], high[~flagged]
            if not len(low):
                return 0, ok.size
        (a, b), infos = zip(*(stepped(map_, x) for x in (low, high)), strict=True)
        both = (np.asarray(infos[0].status) <= 1) & (np.asarray(infos[1].status) <= 1)
        changed = int(np.sum(both & (np.linalg.norm(np.asarray(b - a), axis=-1) > 1e-3)))
    return changed, ok.size


def solver(quick: bool) -> tuple[list[Case], Numbers]:
    cases, measured = [], {}
    z = np.random.default_rng(SEED).standard_normal((100 if quick else 500, 4))
    for chart in (TYPE2, MIDPOINT):
        for strength in (1.0, 3.0, 10.0, 100.0):
            map_ = rough_map(strength, chart, SEED)
            image, info = map_.step(z)
            ok = np.asarray(info.status) <= 1
            worst = residuals(map_, z[ok], np.asarray(image)[ok]).max(initial=0.0)
            name = f"random network, weights × {strength:g}, {chart.name}"
            cases.append(Case(f"{name}: equation of ok lanes", digits_of(worst), 12,
                              counts(info.status)))  # fmt: skip
            changed, looked = branch_changes(map_, *((4, 200) if quick else (10, 500)))
            flagged = "" if changed else "none, or flagged in between"
            cases.append(Case(f"{name}: branch between neighbours", None, None, flagged,
                              wrong=changed))  # fmt: skip
            measured[f"{chart.name} {strength:g}"] = {"changed": changed, "neighbours": looked}
    scene = gfnn.scenes.make("henon-heiles-regular")
    data, fresh = drawn(scene, 1_000, True)
    fit, _ = fitted(data, scene, fresh, absolute_tolerance=1e-4, family="polynomial")
    good = np.asarray(gfnn.sample_test_states(scene, 200, jax.random.key(SEED)))
    for factor in (3.0, 10.0, 1e3, 1e6, 1e150):
        _, info = fit.map.rollout(factor * good[:50], 20)
        cases.append(Case(f"start at {factor:g} × the data", None, None, counts(info.status),
                          wrong=int(np.sum(np.asarray(info.status) == OK))))  # fmt: skip
    mixed = np.concatenate([good, 1e3 * good[:2]])
    alone, together = (
        timed(lambda: fit.map.rollout(z, 200, save_every=200)[0], 5)  # noqa: B023
        for z in (good, mixed)
    )
    same = np.array_equal(alone.out, together.out[: len(good)])
    measured["seconds"] = {
        "good lanes alone": alone.seconds, "with 1 % far outside": together.seconds
    }  # fmt: skip
    said = f"time × {together.seconds / alone.seconds:.2g}"
    cases.append(Case("good lanes beside 1 % far outside: bits and updates the same", None, None,
                      said, wrong=int(not same)))  # fmt: skip
    return cases, measured


# Bad data


def pendulum(z, t=0.0):
    """H of a pendulum of unit frequency at rest."""
    return z[1] ** 2 / 2 - jnp.cos(z[0])


def disc(key, num, radius=1.0):
    """Uniform over a disc in the plane."""
    r, angle = jax.random.uniform(key, (2, num), jnp.float64)
    r, angle = radius * jnp.sqrt(r), TWO_PI * angle
    return jnp.stack([r * jnp.cos(angle), r * jnp.sin(angle)], axis=-1)


def pendulum_scene(dt: float, radius: float = 1.0) -> Scene:
    return Scene(
        name="pendulum", purpose="hard cases", dim=1, dt=dt, hamiltonian=pendulum,
        sampling=DrawnFrom(functools.partial(disc, radius=radius)), reversor=(1, -1),
    )  # fmt: skip


def bad_data(quick: bool) -> tuple[list[Case], Numbers]:
    scene = pendulum_scene(0.4)
    data, fresh = drawn(scene, 1_000, quick)
    z0, z1 = np.asarray(data.z0), np.asarray(data.z1)
    rng = np.random.default_rng(SEED)
    options = {"chart": "midpoint", "family": "polynomial"}
    cases, measured = [], {}

    def add(name, states, images, **more):
        pairs = gfnn.Pairs(states, images, scene.dt)
        case, fit = tried(name, pairs, None, fresh, **options, **more)
        cases.append(case)
        measured[name] = {"messages": list(fit.messages) if fit else [case.failed]}
        if fit is not None and fit.noise is not None:
            measured[name]["noise"] = np.asarray(fit.noise).tolist()

    wrong = z1.copy()
    rows = rng.permutation(len(z1))[:10]
    wrong[rows] = z1[np.roll(rows, 1)]
    add("1 % of the pairs wrong", z0, wrong)
    for sigma in (1e-2,) if quick else (1e-6, 1e-4, 1e-2, 1e-1):
        noise = sigma * rng.standard_normal((2, *z0.shape))
        add(f"noise, σ = {sigma:g}", z0 + noise[0], z1 + noise[1])
    add("50 pairs", z0[:50], z1[:50])
    add("float32 numbers, 1e-8 asked for", *(z.astype("f4").astype(float) for z in (z0, z1)),
        tolerance=1e-8)  # fmt: skip
    for rate in (0.1,) if quick else (1e-3, 0.1, 1.0):
        add(f"friction, rate {rate:g}", z0, z1 * [1, math.exp(-rate * scene.dt)])
    clusters = 0.05 * z0 + np.where(np.arange(len(z0)) % 2, 0.8, -0.8)[:, None] * [1, 0]
    images = gfnn.reference_trajectories(scene, jnp.asarray(clusters), 1)[:, 1]
    add("two clusters, judged all over the disc", clusters, np.asarray(images))
    return cases, measured


# Long times


def drift_of(map_, scene, z0, num_steps, save_every, window):
    """Energy error of rollouts from z0, averaged over blocks of ``window`` saved states: (exponent,
    info, steps since the first block, RMS over orbits of the difference from it)."""
    states, info = map_.rollout(z0, num_steps, save_every=save_every)
    energy = jax.vmap(jax.vmap(scene.invariants["energy"]))(states)
    error = metrics.energy_error(np.asarray(energy))
    steps = save_every * np.arange(error.shape[1])
    num_blocks = error.shape[1] // window
    blocks = error[:, : num_blocks * window].reshape(len(error), num_blocks, window).mean(axis=-1)
    centres = save_every * window * (np.arange(num_blocks) + 0.5)
    exponent = metrics.drift_exponent(steps, error, window) if len(error) > 1 else None
    rms = np.sqrt(np.mean((blocks - blocks[:, :1]) ** 2, axis=0))
    return exponent, info, centres - centres[0], rms


def long_times(quick: bool) -> tuple[list[Case], Numbers]:
    cases, measured = [], {}
    lanes, num_steps = (8, 20_000) if quick else (LANES, STEPS)
    back = 2_000 if quick else BACK
    for name, tolerance in (("henon-heiles-regular", 1e-12), ("two-body", 1e-10)):
        scene = gfnn.scenes.make(name)
        data, fresh = drawn(scene, 4_000, quick)
        fit, _ = fitted(data, scene, fresh, absolute_tolerance=tolerance)
        z0 = np.asarray(gfnn.sample_test_states(scene, lanes, jax.random.key(SEED)))
        print(f"  {name}: {lanes} × {num_steps:,} steps")
        exponent, info, elapsed, rms = drift_of(fit.map, scene, z0, num_steps, 20, 50)
        assert exponent is not None
        low, high = exponent.interval
        said = f"drift exponent {exponent.value:.2f} (95 %: {low:.2f} to {high:.2f})"
        cases.append(Case(f"{name}, {lanes} × {num_steps:,} steps: energy, {said}",
                          digits_of(rms[-1]), 10, counts(info.status),
                          wrong=int(low > MOST_EXPONENT)))  # fmt: skip
        measured[name] = {"exponent": exponent.value, "interval": [low, high],
                          "elapsed": elapsed[1:].tolist(), "rms": rms[1:].tolist()}  # fmt: skip
        forward, first = fit.map.rollout(z0, back, save_every=back)
        returned, second = fit.map.reversed().rollout(forward[:, -1], back, save_every=back)
        error = np.asarray(returned[:, -1]) - z0
        worst = float(np.abs(error / np.asarray(fit.map.scale)).max())
        cases.append(Case(f"{name}, {back:,} steps and back", digits_of(worst), 8,
                          counts([first.status, second.status])))  # fmt: skip
        single = in_float32(fit.map)
        few = min(num_steps, 100_000)
        exponent, info, elapsed, rms = drift_of(single, scene, z0[:16], few, 20, 50)
        cases.append(Case(f"{name} in float32, {few:,} steps: energy", digits_of(rms[-1]), 3,
                          counts(info.status)))  # fmt: skip
        measured[name]["float32"] = {"elapsed": elapsed[1:].tolist(), "rms": rms[1:].tolist(),
                                     "exponent": exponent.value if exponent else None}  # fmt: skip
        if not quick and name == "henon-heiles-regular":
            _, info, elapsed, rms = drift_of(fit.map, scene, z0[:1], SINGLE, 200, 50)
            cases.append(Case(f"{name}, 1 × {SINGLE:,} steps: energy", digits_of(rms[-1]), 10,
                              counts(info.status)))  # fmt: skip
            measured[name]["single"] = {"elapsed": elapsed[1:].tolist(), "rms": rms[1:].tolist()}
    case, curve = on_invariant_curve(200_000 if quick else MAP_STEPS)
    return [*cases, case], measured | {"standard map": curve}


def on_invariant_curve(num_steps: int) -> tuple[Case, Numbers]:
    """One orbit of the standard map, K = 0.6, on a curve that winds around the cylinder."""
    scene = standard_map(0.6)
    data, fresh = drawn(scene, 1_000, True)
    fit, _ = fitted(data, scene, fresh, absolute_tolerance=1e-12)
    curve = np.empty((5_000, 2))
    theta, p = 0.0, 4.0
    for i in range(len(curve)):
        curve[i] = theta, p
        p += 0.6 * math.sin(theta)
        theta = (theta + p) % TWO_PI
    # The reduced angle itself: beside millions of turns it would lose its last digits.
    lanes, num_blocks, reached = fit.map.start(curve[:1]), 200, []
    for _ in range(num_blocks):
        lanes, _ = fit.map.advance(lanes, 1, save_every=num_steps // num_blocks)
        reached.append(np.asarray(lanes.y)[0] % TWO_PI)
    away = metrics.curve_distance(np.array(reached), curve)
    case = Case(f"standard map, K = 0.6, 1 × {num_steps:,} steps: distance from its curve",
                digits_of(float(away[-20:].max())), 10, counts(lanes.status))  # fmt: skip
    steps = num_steps // num_blocks * np.arange(1, num_blocks + 1)
    return case, {"steps": steps.tolist(), "distance": away.tolist()}


# Large steps and chart singularities


def oscillator_scene(dt: float) -> Scene:
    def flow(z, t):
        c, s = jnp.cos(t), jnp.sin(t)
        return jnp.stack([c * z[0] + s * z[1], c * z[1] - s * z[0]])

    return Scene(
        name="oscillator", purpose="hard cases", dim=1, dt=dt, flow=flow,
        sampling=DrawnFrom(disc), reversor=(1, -1),
    )  # fmt: skip


def well(dt: float) -> Scene:
    """Hénon and Heiles' well below E = 1/8, all of it."""
    return dataclasses.replace(henon_heiles(1 / 12, dt), sampling=DrawnFrom(bounded_states))


SWEEPS: dict[str, tuple[Callable[[float], Scene], tuple[float, ...]]] = {
    "oscillator": (oscillator_scene, (0.5, 1.5, math.pi / 2, 2.0, 3.0, math.pi)),
    "pendulum": (pendulum_scene, (0.5, 1.5, 2.0, 2.6, 3.0, 4.0, 6.0)),
    "Hénon–Heiles": (well, (0.1, 0.5, 1.0, 1.3, 2.0, 3.0)),
    "two bodies": (two_body, (0.1, 0.4, 0.8, 1.2, math.pi / 2)),
}


def large_steps(quick: bool) -> tuple[list[Case], Numbers]:
    cases, measured = [], {}
    for system, (make, steps) in SWEEPS.items():
        if quick and system not in ("oscillator", "pendulum"):
            continue
        measured[system] = {"dt": list(steps)}
        jax.clear_caches()  # a process may hold so many compiled programs, and no more
        kept: dict[float, gfnn.Fit] = {}
        for chart in ("type2", "midpoint", "auto"):
            found = []
            for dt in steps[::2] if quick else steps:
                scene = make(dt)
                data, fresh = drawn(scene, 400 if scene.dim == 1 else 2_000, True)
                case, fit = tried(f"{system}, dt = {dt:.3g}, {chart}", data, scene, fresh,
                                  chart=chart, family="polynomial")  # fmt: skip
                if fit is not None:
                    if chart == "auto":
                        kept[dt] = fit
                    note = f"{fit.chosen.chart}{', base map' if fit.base_map else ''}"
                    flagged = "; ".join(part for part in (case.flagged, note) if part)
                    shown = flagged if chart == "auto" or fit.base_map else case.flagged
                    case = dataclasses.replace(case, flagged=shown)
                cases.append(case)
                found.append(case.digits)
                print(f"  {case}")
            measured[system][chart] = found
        cases += composed(system, make, steps, kept)
    return cases, measured


def composed(system, make, steps, kept) -> list[Case]:
    """The largest step that is a multiple of a shorter one, taken by the shorter map."""
    for dt in reversed(steps):
        for shorter in sorted(kept, reverse=True):
            times = round(dt / shorter)
            if times > 1 and abs(times * shorter - dt) < 1e-9:
                scene = make(dt)
                _, fresh = drawn(scene, 10, True)
                states, info = kept[shorter].map.rollout(fresh.z0, times)
                error = np.asarray(states)[:, -1] - np.asarray(fresh.z1)
                spread = float(np.std(np.asarray(fresh.z1), axis=0).max())
                rms = float(np.sqrt(np.mean(error**2))) / spread
                name = f"{system}, dt = {dt:.3g} as {times} steps of {shorter:.3g}"
                return [Case(name, digits_of(rms), 5, counts(info.status))]
    return []


# Chaos


def chaos(quick: bool) -> tuple[list[Case], Numbers]:
    cases, measured = [], {}
    for k in (0.9716, 2.0, 5.0):
        scene = standard_map(k)
        data, fresh = drawn(scene, 1_000, quick)
        case, fit = tried(f"standard map, K = {k:g}", data, scene, fresh, tolerance=1e-12)
        cases.append(case)
        assert fit is not None
        assert scene.step is not None
        num, length = (200, 100) if quick else (4_000, 500)
        rng = np.random.default_rng(SEED)
        z0 = TWO_PI * rng.uniform(size=(num, 2))
        predicted, info = fit.map.rollout(z0, length)
        exact = gfnn.reference_trajectories(scene, jnp.asarray(z0), length)
        ours, theirs = (metrics.diffusion_coefficient(np.asarray(z)[:, :, 1])
                        for z in (predicted, exact))  # fmt: skip
        both = math.hypot(ours.standard_error, theirs.standard_error)
        differ = abs(ours.value - theirs.value) / both
        said = f"D = {ours.value:.4g}, exact map {theirs.value:.4g}, {differ:.1f} σ apart"
        cases.append(Case(f"standard map, K = {k:g}: diffusion", None, None,
                          "; ".join(p for p in (said, counts(info.status)) if p),
                          wrong=int(differ > 4)))  # fmt: skip
        few, long = (10, 500) if quick else (50, 20_000)
        ours, theirs = (lyapunov(step, z0[:few], long) for step in (fit.map.step, scene.step))
        scatter = math.hypot(*(np.std(x) / math.sqrt(few) for x in (ours, theirs)))
        differ = abs(ours.mean() - theirs.mean()) / scatter
        said = f"λ = {ours.mean():.4f}, exact map {theirs.mean():.4f}, {differ:.1f} σ apart"
        cases.append(Case(f"standard map, K = {k:g}: Lyapunov exponent", None, None, said,
                          wrong=int(differ > 4)))  # fmt: skip
    more, found = near_escape(quick)
    return cases + more, measured | found


def lyapunov(step, z0, num_steps: int) -> np.ndarray:
    """Largest exponent per step from each of z0 (B, 2d); a map's (state, info) or a state."""

    def plain(z):
        out = step(z)
        return out[0] if isinstance(out, tuple) else out

    def exponent(z):
        return metrics.lyapunov_exponent(plain, z, num_steps)

    return np.asarray(jax.jit(jax.vmap(exponent))(jnp.asarray(z0)))


def near_escape(quick: bool) -> tuple[list[Case], Numbers]:
    """Hénon–Heiles just below the energy of escape: chaotic sea, islands, statistics."""
    scene = gfnn.scenes.make("henon-heiles-chaotic")
    data, fresh = drawn(scene, 2_000 if quick else 8_000, quick)
    case, fit = tried("Hénon–Heiles, E = 1/6 − 0.001", data, scene, fresh, tolerance=1e-10)
    assert fit is not None
    lanes, steps = (8, 2_000) if quick else (64, 22_000)
    z0 = gfnn.sample_test_states(scene, lanes, jax.random.key(SEED))
    predicted, info = fit.map.rollout(z0, steps)
    exact = np.asarray(gfnn.reference_trajectories(scene, z0, steps))
    sections = [
        np.concatenate([metrics.section_crossings(lane, 0)[:, [1, 3]] for lane in np.asarray(z)])
        for z in (predicted, exact)
    ]
    ours, theirs = sections
    num_bins = 20 if quick else 60
    edges = [np.linspace(-0.6, 1.1, num_bins + 1), np.linspace(-0.65, 0.65, num_bins + 1)]
    (mine, *_), (seen, *_) = (np.histogram2d(*x.T, bins=edges) for x in sections)
    # Deep inside an island: neither the cell nor a neighbour was ever entered by the reference.
    padded = np.pad(seen, 1) > 0
    near = np.max([np.roll(padded, (i, j), (0, 1)) for i in (-1, 0, 1) for j in (-1, 0, 1)], axis=0)
    inside = int(mine[~near[1:-1, 1:-1]].sum())
    divergence = metrics.kl_divergence(ours[:, 0], theirs[:, 0], 50, (-0.6, 1.1))
    half = len(theirs) // 2
    floor = metrics.kl_divergence(theirs[:half, 0], theirs[half:, 0], 50, (-0.6, 1.1))
    name = f"Hénon–Heiles, E = 1/6 − 0.001, {len(ours):,} crossings"
    cases = [
        case,
        Case(f"{name}: in islands that the reference's {len(theirs):,} never enter", None, None,
             f"{inside} crossings; {counts(info.status)}", wrong=inside),
        Case(f"{name}: law of q₂", None, None,
             f"divergence {divergence:.1e} (halves of the reference: {floor:.1e})",
             wrong=int(divergence > 3 * floor)),
    ]  # fmt: skip
    few, long = (4, 500) if quick else (32, 10_000)
    mine = lyapunov(fit.map.step, z0[:few], long) / scene.dt
    theirs_rate = lyapunov_by_shadow(scene, z0[:few], long) / scene.dt
    scatter = math.hypot(*(np.std(x) / math.sqrt(few) for x in (mine, theirs_rate)))
    differ = abs(mine.mean() - theirs_rate.mean()) / scatter
    said = f"λ = {mine.mean():.4f}, reference {theirs_rate.mean():.4f}, {differ:.1f} σ apart"
    cases.append(Case("Hénon–Heiles, E = 1/6 − 0.001: Lyapunov exponent", None, None, said,
                      wrong=int(differ > 4)))  # fmt: skip
    return cases, {"crossings": len(ours), "inside": inside, "divergence": divergence}


def lyapunov_by_shadow(scene, z0, num_steps) -> np.ndarray:
    """Largest exponent per step of the reference flow, from a neighbour that is drawn near again
    every ten steps; (B,)."""
    near, every, total = 1e-8, 10, 0.0
    z = jnp.asarray(z0)
    shadow = z.at[:, 0].add(near)
    for _ in range(num_steps // every):
        both = gfnn.reference_trajectories(
            scene, jnp.concatenate([z, shadow]), every, save_every=every
        )[:, -1]
        z, shadow = both[: len(z)], both[len(z) :]
        apart = jnp.linalg.norm(shadow - z, axis=-1, keepdims=True)
        total = total + np.log(np.asarray(apart[:, 0]) / near)
        shadow = z + (shadow - z) * (near / apart)
    return np.asarray(total) / num_steps


# Singular


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
        "polar around the smaller body", angles=(1,),
        forward=lambda z: inner.forward(z - shift), inverse=lambda y: inner.inverse(y) + shift,
    )  # fmt: skip


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
            case, fit = tried(f"Kepler, e in ({low:g}, {high:g}), dt = 0.1, {label}", data, scene,
                              fresh, tolerance=1e-8, family="polynomial")  # fmt: skip
            cases.append(case)
            if fit is not None:
                cases.append(rolled(case, fit, scene))
            print(f"  {cases[-1]}")
    for dt in (0.02,) if quick else (0.02, 0.05, 0.1):
        close = dataclasses.replace(
            pcr3bp(dt), sampling=DrawnFrom(moon_states), coordinates=moon_polar(), features=None,
            reversor=None,
        )  # fmt: skip
        plain = dataclasses.replace(pcr3bp(dt), sampling=DrawnFrom(moon_states))
        for label, scene in {"features 1/r₁, 1/r₂": plain, "polar around it": close}.items():
            data, fresh = drawn(scene, 1_000 if quick else 8_000, quick)
            case, fit = tried(f"three bodies, around the smaller one, dt = {dt:g}, {label}", data,
                              scene, fresh, tolerance=1e-7)  # fmt: skip
            cases.append(case)
            if fit is not None:
                cases.append(rolled(case, fit, scene))
            print(f"  {cases[-1]}")
    return cases, {}


# Precision and platforms


def fingerprint(quick: bool) -> Numbers:
    """What two versions of JAX must agree on: a fit's step, and a rollout of a hundred steps."""
    scene = gfnn.scenes.make("henon-heiles-regular")
    data, fresh = drawn(scene, 1_000, True)
    fit, _ = fitted(
        data, scene, fresh, absolute_tolerance=1e-7, chart="midpoint", family="polynomial"
    )
    z0 = np.asarray(fresh.z0)[:8]
    states, _ = fit.map.rollout(z0, 100)
    return {
        "image": np.asarray(states)[:, 1].tolist(),
        "after 100 steps": np.asarray(states)[:, -1].tolist(),
        "label": fit.chosen.label,
    }


def precision(quick: bool) -> tuple[list[Case], Numbers]:
    cases = []
    for name, tolerance in (("henon-heiles-regular", 1e-7), ("standard-map-regular", 1e-7)):
        scene = gfnn.scenes.make(name)
        data, fresh = drawn(scene, 1_000, True)
        case, fit = tried(f"{name}, map in float64", data, scene, fresh, tolerance=tolerance)
        assert fit is not None
        cases.append(case)
        single = in_float32(fit.map)
        image, info = single.step(np.asarray(fresh.z0))
        assert image.dtype == jnp.float32
        error = np.asarray(image, float) - np.asarray(fit.map.step(fresh.z0)[0])
        spread = float(np.std(np.asarray(fresh.z1), axis=0).max())
        error = nearest_image(error, angles_of(scene))
        rms = float(np.sqrt(np.mean(error**2))) / spread
        cases.append(Case(f"{name}, the same map in float32", digits_of(rms), 6,
                          counts(info.status)))  # fmt: skip
        many, info = single.rollout(np.asarray(fresh.z0)[:50], 1_000, save_every=1_000)
        same, _ = fit.map.rollout(np.asarray(fresh.z0)[:50], 1_000, save_every=1_000)
        error = metrics.position_error(np.asarray(many, float), np.asarray(same), angles_of(scene))
        cases.append(Case(f"{name}, in float32, 1,000 steps", digits_of(np.median(error[:, -1])),
                          3, counts(info.status)))  # fmt: skip
    code = ("import gfnn_jax as g, numpy as n; z = n.random.rand(100, 2); "
            "g.fit(g.Pairs(z, z, 1.0))")  # fmt: skip
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False,
                          env=x64_off())  # fmt: skip
    line = done.stderr.strip().splitlines()[-1] if done.stderr else ""
    cases.append(Case("float64 switched off", None, None, failed=line,
                      wrong=int(done.returncode == 0 or "float64" not in line)))  # fmt: skip
    mine, version = fingerprint(quick), jax.__version__
    before = RESULTS / "hard-precision.json"
    others = json.loads(before.read_text("utf-8"))["measured"] if before.exists() else {}
    others.pop("cases", None)
    for other, theirs in others.items():
        if other == version:
            continue
        for what, asked in (("image", 13), ("after 100 steps", 10)):
            error = float(np.abs(np.array(mine[what]) - np.array(theirs[what])).max())
            label = f"jax {version} against {other}, {what}"
            cases.append(Case(label, digits_of(error), asked))
    return cases, others | {version: mine}


def x64_off() -> dict[str, str]:
    return {k: v for k, v in os.environ.items() if k != "JAX_ENABLE_X64"} | {
        "PYTHONPATH": str(HERE.parent)
    }


# One table each: ``measure(quick)`` -> its cases, and numbers for figures and text.
TABLE_OF: dict[str, tuple[str, Callable[[bool], tuple[list[Case], Numbers]]]] = {
    "solver": ("Bad conditions for the solver", solver),
    "bad-data": ("Bad data", bad_data),
    "long-times": ("Long times", long_times),
    "large-steps": ("Large steps and chart singularities", large_steps),
    "chaos": ("Chaos", chaos),
    "singular": ("Singular", singular),
    "precision": ("Precision and platforms", precision),
}


def measure(quick: bool, name: str) -> Numbers:
    cases, numbers = TABLE_OF[name][1](quick)
    silent = [case.name for case in cases if case.silent]
    print(f"  {len(cases)} cases, silent: {silent or 'none'}")
    lines = [dataclasses.asdict(case) | {"silent": case.silent} for case in cases]
    return {"cases": lines, **numbers}


PIECES = {name: functools.partial(measure, name=name) for name in TABLE_OF}


# Tables, figures


def table(result: Numbers) -> str:
    """Markdown: a line per case."""
    heads = ["case", "digits kept", "asked for", "flagged", "failed", "silent"]
    rows = []
    for case in result["measured"]["cases"]:
        silent = "no" if not case["silent"] else f"**{case['wrong'] or 'yes'}**"
        cells = [case["name"], *(number(case[k]) if case[k] is None else f"{case[k]:.1f}"
                                 for k in ("digits", "asked")),
                 case["flagged"] or "–", case["failed"] or "–", silent]  # fmt: skip
        rows.append([cell.replace("|", "/") for cell in cells])
    return markdown(heads, rows)


def tables() -> None:
    """The section of RESULTS.md and the figures, from the results."""
    found = results(PIECES, "hard")
    if not found:
        return
    parts = []
    for name, result in found.items():
        small = " (small sizes)" if result["quick"] else ""
        parts.append(f"### {TABLE_OF[name][0]}{small}\n\n{table(result)}")
    total = sum(len(r["measured"]["cases"]) for r in found.values())
    silent = sum(case["silent"] for r in found.values() for case in r["measured"]["cases"])
    head = f"{total} cases, {silent} of them silent."
    missing = [title for name, (title, _) in TABLE_OF.items() if name not in found]
    if missing:
        parts.append(f"Not measured yet: {'; '.join(missing)}.")
    parts.append(provenance(found))
    between_markers(TABLES, "hard-cases", "\n\n".join([head, *parts]))
    draw(found)


def draw(found: dict[str, Numbers]) -> None:
    """Drift of energy, and digits against the time step by chart."""
    FIGURES.mkdir(exist_ok=True)
    if "long-times" in found:
        curves = {}
        for name, m in found["long-times"]["measured"].items():
            if name != "cases" and "rms" in m:
                curves[name] = (np.array(m["elapsed"]), np.array(m["rms"])[None])
                low = m["float32"]
                curves[f"{name}, float32"] = (np.array(low["elapsed"]), np.array(low["rms"])[None])
        axes: Any = figures.energy_error(curves)
        figures.save(axes.figure, FIGURES / "hard_energy_drift.png")
    if "large-steps" in found:
        swept = {n: m for n, m in found["large-steps"]["measured"].items() if n in SWEEPS}
        axes = figures.digits_against_step_size(swept)
        figures.save(axes[0].figure, FIGURES / "hard_large_steps.png")


def main(argv: Sequence[str] | None = None) -> None:
    run_pieces(__doc__ or "", PIECES, "hard", tables, argv)


if __name__ == "__main__":
    main()
