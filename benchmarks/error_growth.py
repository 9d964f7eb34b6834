"""The paper's theorems as measurements: how the error of a prediction grows.

    python benchmarks/error_growth.py                          pieces without a result, then tables
    python benchmarks/error_growth.py --only vfnn --overwrite  one piece again
    python benchmarks/error_growth.py --quick                  small sizes, into runs/growth

A piece's result is one JSON file, growth-*.json in benchmarks/results; the section of
benchmarks/RESULTS.md and the figures are made from these files alone.

The knob on the one-step error ε is the s of S + s g: S a fitted polynomial, accurate to 1e-10 or
better, and g a random one of low degree, the same for all s. Each such map is symplectic and wrong
by as much as s says, as the theorems have it. ε is measured on fresh pairs.
"""

from __future__ import annotations

import dataclasses
import functools
import statistics
import warnings
from collections.abc import Callable
from typing import Any

# Sets float64, so it comes before all of JAX.
from harness import (
    FIGURES,
    SEED,
    TABLES,
    Numbers,
    angles_of,
    between_markers,
    drawn,
    main,
    number,
    one_step_rms,
    provenance,
    results,
)

# isort: split
import jax
import jax.numpy as jnp
import numpy as np

import gfnn_jax as gfnn
from gfnn_jax.baselines import METHODS, Budget, Sequences
from gfnn_jax.evaluate import figures, metrics
from gfnn_jax.generating.generated import Generated
from gfnn_jax.maps.rollout import rollout
from gfnn_jax.phase_space import hamiltonian_vector_field
from gfnn_jax.scenes.trajectories import flow_step

NUM_PAIRS, NUM_STEPS, LONGEST = 4_000, 1_000, 20_000
SIZES, LOW_DEGREE = tuple(10.0**-k for k in range(2, 10)), 4
SMALL = 1e-6
SATURATED = 0.1  # a position error of this size is no longer small against the orbit


@functools.cache
def perturbed(name: str, quick: bool):
    """The scene, and (ε, label, map) for each size of the perturbation of S."""
    scene = gfnn.scenes.make(name)
    pairs, fresh = drawn(scene, 1_000 if quick else NUM_PAIRS, quick)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", gfnn.FitWarning)
        fit = gfnn.fit(
            pairs,
            scene,
            absolute_tolerance=1e-7 if quick else 1e-10,
            chart="midpoint",
            family="polynomial",
            seed=SEED,
            on_progress=lambda line: print(f"  {line}"),
        )
    index = next(i for i, piece in enumerate(fit.map.pieces) if isinstance(piece, Generated))
    whole: Any = fit.map.pieces[index]
    first, second = whole.family.basis.halves
    low = first.orders[:, None] + second.orders[None, :] <= LOW_DEGREE
    exists = np.zeros(low.shape, bool)
    exists[tuple(whole.family.basis.terms.T)] = True
    g = np.random.default_rng(SEED).standard_normal(low.shape) * (low & exists)
    found = []
    for size in SIZES[::3] if quick else SIZES:
        off = dataclasses.replace(whole, params=whole.params + size * g)
        pieces = (*fit.map.pieces[:index], off, *fit.map.pieces[index + 1 :])
        map_ = dataclasses.replace(fit.map, pieces=pieces)
        found.append((one_step_rms(map_, fresh, angles_of(scene)), f"{size:.0e}", map_))
        print(f"  {name}: s = {size:.0e}, one step {found[-1][0]:.1e}", flush=True)
    return scene, found


def growth(name: str) -> Callable[[bool], Numbers]:
    """Position error against the step number at many ε, with the exponent of each."""

    def measure(quick: bool) -> Numbers:
        scene, maps = perturbed(name, quick)
        key = jax.random.fold_in(jax.random.key(SEED), 1)
        z0 = gfnn.sample_test_states(scene, 8 if quick else 50, key)
        reference = np.asarray(gfnn.reference_trajectories(scene, z0, NUM_STEPS))
        steps = np.arange(NUM_STEPS + 1)
        shown = np.unique(np.round(np.geomspace(1, NUM_STEPS, 30)).astype(int))
        rows = []
        for error, label, map_ in maps:
            states, _ = map_.rollout(z0, NUM_STEPS)
            position = metrics.position_error(np.asarray(states), reference, angles_of(scene))
            statistics = metrics.error_statistics(position)
            usable = statistics.mean < SATURATED
            last = int(steps[usable][-1]) if usable.all() else int(np.argmin(usable)) - 1
            exponent = metrics.growth_exponent(steps, position, last=max(last, 12))
            rows.append(
                {
                    "label": label,
                    "one_step_rms": error,
                    "last": last,
                    "exponent": exponent.value,
                    "interval": list(exponent.interval),
                    "error_end": float(statistics.mean[-1]),
                    "error_100": float(statistics.mean[100]),
                    "curve": {
                        "steps": shown.tolist(),
                        "mean": statistics.mean[shown].tolist(),
                        "std": statistics.std[shown].tolist(),
                    },
                }
            )
        return {"scene": name, "rows": rows, "proportionality": slope(rows, "error_100")}

    return measure


def slope(rows: list[Numbers], key: str) -> Numbers:
    """Exponent b of ``key`` ∝ εᵇ over all rows that are finite and not saturated, with its interval
    (Student's t), and the decades that ε spans."""
    from scipy.stats import linregress, t

    used = [r for r in rows if np.isfinite(r[key]) and 1e-12 < r[key] < SATURATED]
    x, y = (np.log10([r[k] for r in used]) for k in ("one_step_rms", key))
    if len(used) < 3:
        return {"exponent": None, "interval": None, "decades": None, "points": len(used)}
    fitted: Any = linregress(x, y)
    half = float(t.ppf(0.975, len(used) - 2)) * fitted.stderr
    return {
        "exponent": float(fitted.slope),
        "interval": [float(fitted.slope - half), float(fitted.slope + half)],
        "decades": float(np.ptp(x)),
        "points": len(used),
    }


def actions(quick: bool) -> Numbers:
    """Measure the action √a (Delaunay's L) of two bodies over 1/(ε dt) steps, at most LONGEST."""
    scene, maps = perturbed("two-body", quick)
    z0 = gfnn.sample_test_states(scene, 8, jax.random.fold_in(jax.random.key(SEED), 2))
    start = np.sqrt(np.asarray(metrics.semi_major_axis(z0)))
    rows = []
    for error, label, map_ in maps:
        most = 2_000 if quick else LONGEST
        num_steps = int(min(most, 1 / (error * scene.dt)))
        every = max(1, num_steps // 500)
        states, _ = map_.rollout(z0, num_steps, save_every=every)
        action = np.sqrt(np.asarray(metrics.semi_major_axis(states)))
        change = np.max(np.abs(action - start[:, None]), axis=0)
        tenth = len(change) // 10
        rows.append(
            {
                "label": label,
                "one_step_rms": error,
                "num_steps": num_steps,
                "whole_time": bool(num_steps < most),
                "largest": float(change.max()),
                "largest_in_first_tenth": float(change[:tenth].max()),
            }
        )
    return {"rows": rows, "proportionality": slope(rows, "largest")}


def vfnn(quick: bool) -> Numbers:
    """Measure a learned vector field of two bodies beside a map of about the same one-step error.

    A second comparison has errors so small that the orbit is not lost.
    """
    scene = gfnn.scenes.two_body()
    key = jax.random.key(SEED)
    num = 5_000 if quick else 100_000
    pairs = gfnn.sample_pairs(scene, num, key)
    fresh = gfnn.sample_pairs(scene, 1_000, jax.random.fold_in(key, 3))
    z = np.stack([np.asarray(pairs.z0), np.asarray(pairs.z1)], axis=1)
    learned = METHODS["vfnn"].learn(Sequences(z, scene.dt), Budget(key, 2.0 if quick else 20.0))
    z0 = gfnn.sample_test_states(scene, 8 if quick else 50, jax.random.fold_in(key, 1))
    steps = np.arange(NUM_STEPS + 1)
    reference = np.asarray(gfnn.reference_trajectories(scene, z0, NUM_STEPS))
    step_error = np.asarray(rollout(learned.step, jnp.asarray(fresh.z0), 1))[:, 1] - fresh.z1
    states = np.asarray(rollout(learned.step, z0, NUM_STEPS))
    vfnn_rms = float(np.sqrt(np.mean(np.asarray(step_error) ** 2)))
    _, maps = perturbed("two-body", quick)
    error, label, map_ = min(maps, key=lambda m: abs(np.log(m[0] / vfnn_rms)))
    label = f"generated, s = {label}"
    # What the two kinds of error do while they are small: a true field that is slightly off, as no
    # Hamiltonian field is, beside the map that is off by as much.
    off = SMALL * jax.random.normal(jax.random.fold_in(key, 4), (4, 4))
    assert scene.hamiltonian is not None
    exact = hamiltonian_vector_field(scene.hamiltonian)
    flow = flow_step(lambda z: exact(z) + off @ z, scene.dt, 1e-13)
    drifting = np.asarray(rollout(flow, z0, NUM_STEPS))
    _, _, small = min(maps, key=lambda m: abs(np.log(m[0] / (SMALL * scene.dt))))
    predictions = {
        "VFNN": states,
        label: np.asarray(map_.rollout(z0, NUM_STEPS)[0]),
        "true field, slightly off": drifting,
        "generated, slightly off": np.asarray(small.rollout(z0, NUM_STEPS)[0]),
    }
    curves = {}
    for name, predicted in predictions.items():
        position = metrics.position_error(predicted, reference)
        energy = metrics.absolute_error(
            metrics.semi_major_axis(predicted), metrics.semi_major_axis(reference)
        )
        shown = np.unique(np.round(np.geomspace(1, NUM_STEPS, 40)).astype(int))
        mean = metrics.error_statistics(position).mean
        last = int(np.argmax(mean > SATURATED)) or NUM_STEPS
        curves[name] = {
            "steps": shown.tolist(),
            "mean": mean[shown].tolist(),
            "axis": metrics.error_statistics(energy).mean[shown].tolist(),
            "last": last,
            "exponent": metrics.growth_exponent(steps, position, first=2, last=last)._asdict(),
            "axis_exponent": metrics.growth_exponent(steps, energy, first=2, last=last)._asdict(),
        }
    return {
        "vfnn_one_step_rms": vfnn_rms,
        "map_one_step_rms": error,
        "map": label,
        "curves": curves,
    }


def generic_bound(quick: bool) -> Numbers:
    """Theorem "genericPredictionErrorBound" on its own example: f(x) = x, learned as x + δ.

    From x₀ = 0 the error of Euler's steps is δ ((1 + h)ⁿ − 1), and the bound
    (exp(LT) − 1)/L · (δ + L h/2) with L = 1. As h → 0 their ratio goes to 1.
    """
    del quick
    delta, time_end = 1e-2, 5.0
    rows = []
    for h in (1e-1, 1e-2, 1e-3, 1e-4, 1e-5):
        n = round(time_end / h)

        def euler(x, h=h):
            return x + h * (x + delta)

        x = np.asarray(rollout(euler, jnp.zeros((1, 1)), n, save_every=max(1, n // 50)))[0, :, 0]
        times = np.linspace(0, time_end, len(x))
        bound = np.expm1(time_end) * (delta + h / 2)
        late = times > 2
        rate = np.polyfit(times[late], np.log(np.abs(x[late])), 1)[0]
        rows.append(
            {
                "h": h,
                "error": float(x[-1]),
                "bound": float(bound),
                "ratio": float(x[-1] / bound),
                "rate": float(rate),
            }
        )
    return {"delta": delta, "time": time_end, "rows": rows}


GROWTH = ("two-body", "henon-heiles-printed", "henon-heiles-regular")
# Why a regular scene need not be linear yet over these steps.
NEAR_RESONANCE = {
    "henon-heiles-printed": " (its two halves have nearly the same energy, so that the orbits are "
    "close to the 1:1 resonance, which the theorem's Diophantine condition keeps away from: "
    "actions then drift for as long as the beat of the two frequencies takes)"
}
PIECES: dict[str, Callable[[bool], Numbers]] = {
    **{name: growth(name) for name in GROWTH},
    "actions": actions,
    "vfnn": vfnn,
    "generic-bound": generic_bound,
}


def interval(row: Numbers, key: str = "exponent") -> str:
    """Value with its 95 % interval."""
    if row.get(key) is None:
        return "–"
    low, high = row["interval"]
    low, high = ("?" if v is None else f"{v:.2f}" for v in (low, high))
    return f"{row[key]:.2f} ({low} to {high})"


def verdicts(m: dict[str, Numbers]) -> list[str]:
    """The paper's claims, each with what was measured, in plain words."""
    said = []
    for name in GROWTH:
        if name not in m:
            continue
        row, p = m[name]["rows"][-1], m[name]["proportionality"]
        pace = "linear"
        if abs(row["exponent"] - 1.0) > 0.1:
            pace = f"{'faster' if row['exponent'] > 1.0 else 'slower'} than linear over these steps"
        said.append(
            f"{name}, *the error grows linearly, in proportion to ε*: "
            f"{pace}, α = {interval(row)} of the mean"
            + (NEAR_RESONANCE.get(name, "") if pace.startswith("faster") else "")
            + f"; proportional to ε over {p['decades']:.1f} decades, b = {interval(p)}."
        )
    if "actions" in m:
        rows = [r for r in m["actions"]["rows"] if r["largest"] is not None]
        quotients = [r["largest"] / r["one_step_rms"] for r in rows]
        said.append(
            "two-body, *actions stay within C ε over 1/(ε dt) steps*: the largest change is "
            f"{statistics.median(quotients):.1f} times ε in the median map, "
            f"{max(quotients):.1f} times in the worst, nearly all of it in the first "
            "tenth; the smaller ε were followed for a part of that time (table below). Where ε is "
            "so large that orbits leave what was learned, nothing holds (–)."
        )
    if "vfnn" in m:
        curves = m["vfnn"]["curves"]
        names = [n for n in curves if n.endswith("slightly off")]
        position, axis = (
            {n: curves[n][k]["value"] for n in names} for k in ("exponent", "axis_exponent")
        )
        said.append(
            "two-body, *a vector field without the structure errs exponentially*: an upper bound "
            "that these orbits do not attain. The semi-major axis of VFNN drifts at once, and the "
            f"orbit is lost by step {curves['VFNN']['last']}. Where errors stay small: "
            + "; ".join(
                f"{n}, position α = {position[n]:.2f}, axis α = {axis[n]:.2f}" for n in names
            )
            + ". The actions drift, and the position errs a power faster than the map's."
        )
    if "generic-bound" in m:
        said.append(
            "*The generic bound is attained by f(x) = x*: yes, error/bound = "
            f"{m['generic-bound']['rows'][-1]['ratio']:.4f} at the smallest step."
        )
    return said


def section(found: dict[str, Numbers]) -> str:
    """Markdown of all results."""
    m = {name: r["measured"] for name, r in found.items()}
    lines = ["**Claims of the paper, and what was measured:**", ""]
    lines += [*(f"- {claim}" for claim in verdicts(m)), ""]
    scenes = [m[name] for name in GROWTH if name in m]
    if scenes:
        lines += [
            "**Growth with the step number and proportionality to ε.** Every line one learned map; "
            "the exponent α of error ∝ nᵅ, from step 10 up to where the error is a tenth, with its "
            "95 % interval.",
            "",
            "| scene | s | ε, one step | error at step 100 | at 1,000 | α |",
            "|---" * 6 + "|",
        ]
        lines += [
            f"| {s['scene']} | {r['label']} | {number(r['one_step_rms'])} | "
            f"{number(r['error_100'])} | {number(r['error_end'])} | {interval(r)} |"
            for s in scenes
            for r in s["rows"]
        ]
        lines += ["", "Error at step 100 ∝ εᵇ, with b:", ""]
        for s in scenes:
            p = s["proportionality"]
            decades = "" if p["decades"] is None else f" over {p['decades']:.1f} decades of ε"
            lines.append(f"- {s['scene']}: b = {interval(p)}{decades}, {p['points']} maps")
        lines += [
            "",
            "![Error against ε](figures/growth_proportionality.png)",
            "![Growth on two bodies](figures/growth_two_body.png)",
            "",
        ]
    if "actions" in m:
        lines += [
            "**Actions.** Two bodies: the largest change of Delaunay's action √a over 1/(ε dt) "
            f"steps (at most {LONGEST:,}), 8 orbits.",
            "",
            "| s | ε | steps | all of 1/(ε dt) | largest change | in the first tenth | change/ε |",
            "|---" * 7 + "|",
        ]
        for r in m["actions"]["rows"]:
            quotient = None if r["largest"] is None else r["largest"] / r["one_step_rms"]
            lines.append(
                f"| {r['label']} | {number(r['one_step_rms'])} | {r['num_steps']:,} | "
                f"{'yes' if r['whole_time'] else 'no'} | {number(r['largest'])} | "
                f"{number(r['largest_in_first_tenth'])} | {number(quotient)} |"
            )
        p = m["actions"]["proportionality"]
        lines += ["", f"Largest change ∝ εᵇ with b = {interval(p)}.", ""]
    if "vfnn" in m:
        v = m["vfnn"]
        lines += [
            "**A learned vector field.** Two bodies, one-step error "
            f"{number(v['vfnn_one_step_rms'])} beside a map's {number(v['map_one_step_rms'])}; "
            "exponents until the mean position error is a tenth.",
            "",
            "| | until step | α of the position | α of the semi-major axis |",
            "|---" * 4 + "|",
        ]
        for name, c in v["curves"].items():
            e, a = (
                {"exponent": c[k]["value"], "interval": c[k]["interval"]}
                for k in ("exponent", "axis_exponent")
            )
            lines.append(f"| {name} | {c['last']} | {interval(e)} | {interval(a)} |")
        lines += ["", "![A learned vector field](figures/growth_vfnn.png)", ""]
    if "generic-bound" in m:
        g = m["generic-bound"]
        lines += [
            f"**The generic bound attained.** f(x) = x learned as x + δ, δ = {g['delta']}, Euler's "
            f"steps to T = {g['time']:g} from x = 0.",
            "",
            "| h | error | bound | error/bound | rate of growth (bound: L = 1) |",
            "|---" * 5 + "|",
        ]
        lines += [
            f"| {number(r['h'])} | {r['error']:.4g} | {r['bound']:.4g} | {r['ratio']:.3f} | "
            f"{r['rate']:.3f} |"
            for r in g["rows"]
        ]
    return "\n".join(lines).rstrip()


def draw(found: dict[str, Numbers]) -> None:
    """The figures, from the results."""
    m = {name: r["measured"] for name, r in found.items()}
    FIGURES.mkdir(exist_ok=True)

    def until_lost(curve: Numbers):
        """Steps and errors (1, L) before the first trajectory was lost."""
        whole = [v for v in curve["mean"] if v is not None]
        return np.array(curve["steps"][: len(whole)]), np.array([whole])

    def known(name: str, key: str):
        return np.array([np.nan if r[key] is None else r[key] for r in m[name]["rows"]])

    points = {
        name: (known(name, "one_step_rms"), known(name, "error_100"))
        for name in GROWTH
        if name in m
    }
    if points:
        about = (r"one-step error $\varepsilon$ (RMS)", "position error at step 100")
        ax: Any = figures.work_precision(points, xlabel=about[0], ylabel=about[1])
        ends = np.array(ax.get_xlim())
        ax.plot(ends, ends, ":", color="0.6", lw=1, scalex=False, scaley=False)
        figures.save(ax.figure, FIGURES / "growth_proportionality.png")
    if "two-body" in m:
        curves = {
            f"ε = {r['one_step_rms']:.0e}": until_lost(r["curve"]) for r in m["two-body"]["rows"]
        }
        ax = figures.error_growth(curves)
        figures.save(ax.figure, FIGURES / "growth_two_body.png")
    if "vfnn" in m:
        curves = {name: until_lost(c) for name, c in m["vfnn"]["curves"].items()}
        ax = figures.error_growth(curves)
        figures.save(ax.figure, FIGURES / "growth_vfnn.png")


def tables() -> None:
    found = results(PIECES, "growth")
    if found:
        draw(found)
        between_markers(TABLES, "growth", f"{section(found)}\n\n{provenance(found)}")


if __name__ == "__main__":
    main(__doc__ or "", PIECES, "growth", tables, None)
