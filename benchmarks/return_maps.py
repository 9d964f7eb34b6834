"""Return maps and stroboscopic maps: one learned step against a whole integration.

    python benchmarks/return_maps.py                 pieces without a result, then the tables
    python benchmarks/return_maps.py --only pendulum-4 --overwrite
    python benchmarks/return_maps.py --quick         small sizes, into runs/return-maps, no tables

A piece's result is one JSON file, return-maps-*.json in benchmarks/results; the figures and the
section of benchmarks/RESULTS.md are made from these files alone. The process is kept on one core
before JAX starts its threads, so that everything runs on one thread. Times are per iteration and
trajectory, the best of several, compilation apart; finding the crossing is part of an iteration.
heyoka is in the extra ``benchmarks``; without it its rows say so.
"""

from __future__ import annotations

import dataclasses
import functools
import math
import os
import time
from collections.abc import Callable, Sequence
from typing import Any

# Sets float64, so it comes before all of JAX.
from harness import (
    FIGURES,
    SEED,
    TABLES,
    Numbers,
    between_markers,
    drawn,
    fitted,
    markdown,
    number,
    one_step_rms,
    provenance,
    results,
    timed,
)
from harness import main as run_pieces

# isort: split
import diffrax
import jax
import jax.numpy as jnp
import numpy as np
from scipy.integrate import solve_ivp

import gfnn_jax as gfnn
from gfnn_jax.evaluate import figures, metrics, report
from gfnn_jax.scenes import Scene, driven_pendulum, henon_heiles_section
from gfnn_jax.scenes.henon_heiles_section import FIXED_POINT

PERIODS = (1, 2, 4, 8, 16)
TOLERANCES = (1e-4, 1e-7, 1e-10)
ITERATIONS = 100  # after which the error is taken again
ASKED = 10.0  # times as fast as SciPy and diffrax
SOLVERS = {"Tsit5": diffrax.Tsit5, "Dopri8": diffrax.Dopri8}
PRECISIONS = (1e-4, 1e-6, 1e-8, 1e-10, 1e-12)
AMPLITUDE = 0.15


@dataclasses.dataclass(frozen=True)
class Sizes:
    """How much is measured: pairs of a fit, lanes of a batch, states whose error is taken, the few
    of them that SciPy is given, steps of a timed rollout, calls of which the best counts."""

    pairs: int
    lanes: int
    judged: int
    few: int
    steps: int
    repeats: int
    precisions: tuple[float, ...]


FULL = Sizes(3_000, 1_000, 50, 2, 200, 7, PRECISIONS)
QUICK = Sizes(300, 64, 8, 2, 50, 1, (1e-4, 1e-8))


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
                rate, (0, 20), lifted(z[lane]), method="DOP853", events=crossing, rtol=tolerance,
                atol=tolerance,
            )  # fmt: skip
            z[lane] = solved.y_events[0][-1][[1, 3]]
    return z, len(z) * iterations


def pendulum_by_scipy(z0, iterations, precision):
    """One state as plain numbers; several as one system, whose step is common to all."""
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
            rate if len(z0) == 1 else stacked_rate, (0, end), z, method="DOP853", rtol=tolerance,
            atol=tolerance, t_eval=[end],
        ).y[:, -1]  # fmt: skip
    return z.reshape(2, -1).T, len(z0) * iterations


def _diffeqsolve(solver, field, start, end, z, tolerance, until=None):
    solution = diffrax.diffeqsolve(
        diffrax.ODETerm(lambda t, z, _: field(t, z)), solver, start, end, None, z,
        stepsize_controller=diffrax.PIDController(rtol=tolerance, atol=tolerance),
        event=None if until is None else diffrax.Event(lambda t, y, args, **_: until(t, y)),
        max_steps=100_000, throw=False,
    )  # fmt: skip
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
    """To the first step beyond the section, and back onto it with x as the independent variable
    (Hénon's trick), which is as accurate as the steps are."""

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
    """Through all periods without a stop."""
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


# Measuring


def distance(states, reference) -> float:
    """RMS over the states (B, 2) of the Euclidean error."""
    return float(np.sqrt(np.mean(np.sum((np.asarray(states) - reference) ** 2, axis=1))))


def seconds(iterate, z0, iterations, precision, repeats) -> float:
    """Per iteration and trajectory: the best of several, after one that compiles."""
    taken = timed(lambda: iterate(z0, iterations, precision), repeats)
    return taken.seconds / taken.out[1]


def curve(name: str, tool: Tool, z0, reference, end: float, sizes: Sizes) -> list[Numbers]:
    """Error and time of an integrator for every precision; reference: after 1 and ITERATIONS."""
    points = []
    slow = name.startswith("SciPy")
    for tolerance in tool.precisions:
        precision, states = (tolerance, end), z0[: tool.judged]
        started = time.perf_counter()
        iterate = tool.batch if tool.batch is not None and not slow else tool.single
        errors = {}
        for i, iterations in enumerate((1, ITERATIONS)):
            if iterate is tool.single:
                ended = np.concatenate(
                    [iterate(z[None], iterations, precision)[0] for z in states]
                )  # fmt: skip
            else:
                ended = iterate(states, iterations, precision)[0]
            errors[f"error_{iterations}"] = distance(ended, reference[: len(ended), i])
        single = seconds(tool.single, z0[:1], 5 if slow else ITERATIONS, precision, sizes.repeats)
        batch = None
        if tool.batch is not None:
            batch = seconds(tool.batch, z0, 1 if slow else 4, precision, sizes.repeats)
        points.append({"tolerance": tolerance, **errors, "single": 1e6 * single,
                       "batch": None if batch is None else 1e6 * batch})  # fmt: skip
        print(f"  {name} {tolerance:.0e}: {time.perf_counter() - started:.0f} s")
    return points


def maps(scene: Scene, z0, reference, sizes: Sizes, times: int = 1) -> Numbers:
    """Our maps of this scene, one for each tolerance. An iteration is so many steps of them."""
    pairs, fresh = drawn(scene, sizes.pairs, sizes is QUICK)
    found: list[Numbers] = []
    fits = []
    for tolerance in TOLERANCES:
        fit, about = fitted(pairs, scene, fresh, absolute_tolerance=tolerance)
        fits.append(fit)
        if found and found[-1]["label"] == about["label"]:
            continue  # the most accurate one has been measured
        map_ = fit.map
        states, info = map_.rollout(z0, times * ITERATIONS, save_every=times)
        states = np.asarray(states)
        errors = {
            f"error_{n}": distance(states[: len(reference), n], reference[:, i])
            for i, n in enumerate((1, ITERATIONS))
        }

        def taking(lanes, num_steps, map_=map_):
            seconds = timed(
                lambda: map_.advance(lanes, 1, save_every=num_steps)[1], sizes.repeats
            ).seconds
            return 1e6 * times * seconds / num_steps / len(lanes.status)

        found.append({
            "tolerance": tolerance, "met": fit.met,
            "chart": about["chart"], "label": about["label"], "base_map": fit.base_map,
            "times": times,
            "num_parameters": about["num_parameters"],
            "one_step_rms": one_step_rms(map_, fresh),
            **errors,
            "defect": float(np.max(map_.defect(fresh.z0[:200]))),
            "status_counts": report.status_counts(info.status),
            "single": taking(map_.start(z0[:1]), 10 * sizes.steps),
            "batch": taking(map_.start(z0), sizes.steps),
        })  # fmt: skip
        print(f"  {about['label']}: {found[-1]['single']:.1f}, {found[-1]['batch']:.1f} µs")
    return {"pairs": len(pairs), "fit_seconds": sum(fit.seconds for fit in fits), "maps": found,
            "determinants": {n: j.low for n, j in fits[0].judgements.items()}}  # fmt: skip


def compared(
    scene: Scene,
    found: dict[str, Tool],
    sizes: Sizes,
    shorter: Callable[[int], Scene] | None = None,
) -> Numbers:
    """Our maps and all integrators on one scene; where no chart covers it, the maps of the longest
    part of it that one does, ``shorter(times)``, taken so many times."""
    z0 = gfnn.sample_test_states(scene, sizes.lanes, jax.random.key(SEED))
    orbits = gfnn.reference_trajectories(scene, z0[: sizes.judged], ITERATIONS)
    reference = np.asarray(orbits)[:, [1, ITERATIONS]]
    part, times, refused = scene, 1, None
    while True:
        try:
            ours = maps(part, z0, reference, sizes, times)
            break
        except gfnn.FitError as error:
            if shorter is None:
                raise
            times, refused = 2 * times, refused or str(error)
            part = shorter(times)
    curves = {
        name: curve(name, tool, np.asarray(z0), reference, scene.dt, sizes)
        for name, tool in found.items()
    }
    return {**ours, "refused": refused, "lanes": len(z0), "judged": len(reference),
            "curves": curves}  # fmt: skip


def section(quick: bool) -> Numbers:
    sizes = QUICK if quick else FULL
    return compared(henon_heiles_section(), tools("section", sizes), sizes)


def pendulum(quick: bool, periods: int) -> Numbers:
    sizes = QUICK if quick else FULL
    scene, found = driven_pendulum(periods), tools("pendulum", sizes)
    return compared(scene, found, sizes, lambda times: driven_pendulum(periods // times))


# Many iterations


def iterations(quick: bool) -> Numbers:
    """The most accurate map of either scene, iterated 10⁵ times from 1,000 states, and the
    reference as far as is worth waiting for: points of both for a picture."""
    num, lanes, most, seen = (1_000, 50, 200, 10) if quick else (100_000, 1_000, 1_000, 30)
    return {
        scene.name: iterated(scene, num, lanes, most, seen, quick)
        for scene in (henon_heiles_section(), driven_pendulum())
    }


def iterated(scene: Scene, num: int, lanes: int, most: int, seen: int, quick: bool) -> Numbers:
    pairs, fresh = drawn(scene, (QUICK if quick else FULL).pairs, quick)
    fit, about = fitted(pairs, scene, fresh, absolute_tolerance=TOLERANCES[-1])
    z0 = gfnn.sample_test_states(scene, lanes, jax.random.key(SEED))
    points = 100
    started = time.perf_counter()
    states, info = jax.block_until_ready(fit.map.rollout(z0, num, save_every=num // points))
    ours = time.perf_counter() - started
    started = time.perf_counter()
    exact = jax.block_until_ready(gfnn.reference_trajectories(scene, z0[:seen], most))
    theirs = time.perf_counter() - started
    print(f"  {scene.name}: {ours:.0f} s and {theirs:.0f} s")
    states, exact = np.asarray(states[:seen, 1:]), np.asarray(exact)
    curves = metrics_of_curves(states, exact) if scene.section is not None else None
    shown = exact[:, 1 :: most // points]
    return {
        "label": about["label"], "chart": about["chart"], "one_step_rms": about["one_step_rms"],
        "iterations": num, "lanes": lanes, "seconds": ours,
        "status_counts": report.status_counts(info.status),
        "reference_iterations": most, "reference_lanes": seen, "reference_seconds": theirs,
        "distance_from_curves": curves,
        "points": {"map": rounded(states), "reference": rounded(shown)},
    }  # fmt: skip


def metrics_of_curves(states, exact) -> float:
    """Largest distance of our points from the reference's closed curves around the fixed point, in
    the plane (angle, radius) of (y, 1.8 p_y), where these curves are nearly circles."""

    def polar(z):
        x = (z - np.array(FIXED_POINT)) * np.array([1.0, 1.8])
        return np.stack([np.arctan2(x[..., 1], x[..., 0]), np.hypot(x[..., 0], x[..., 1])], axis=-1)

    return float(max(
        metrics.curve_distance(polar(a), polar(b), 32).max()
        for a, b in zip(states, exact, strict=True)
    ))  # fmt: skip


def rounded(states) -> list:
    """x and y of all points to four decimals, enough for a picture."""
    return [[round(float(v), 4) for v in states[..., i].ravel()] for i in (0, 1)]


PIECES = {
    "section": section,
    **{f"pendulum-{n}": functools.partial(pendulum, periods=n) for n in PERIODS},
    "iterations": iterations,
}


# Tables and figures


def time_at(points: Sequence[Numbers], error: float, key: str, arrangement: str) -> float | None:
    """Time at which an integrator has this error, between its precisions by powers; None where its
    most precise one is not as accurate. Where all are more accurate, the cheapest one's."""
    rows = sorted(
        (p[key], p[arrangement]) for p in points
        if p[arrangement] is not None and p[key] is not None and p[key] > 0
    )  # fmt: skip
    front: list[tuple[float, float]] = []  # by rising error, falling time
    for row in rows:
        if not front or row[1] < front[-1][1]:
            front.append(row)
    if not front or error < front[0][0]:
        return None
    errors, times = np.log(np.array(front)).T
    return float(np.exp(np.interp(np.log(error), errors, times)))


GROUPS = {"DOP853": ("SciPy DOP853",), "diffrax": tuple(f"diffrax {s}" for s in SOLVERS),
          "heyoka": ("heyoka",)}  # fmt: skip


def ratios(measured: Numbers, ours: Numbers, key: str, arrangement: str) -> dict[str, float | None]:
    """How many times as fast our map is as each integrator, at our map's error."""
    found = {}
    for group, members in GROUPS.items():
        times = [
            time_at(measured["curves"][m], ours[key], key, arrangement)
            for m in members if m in measured["curves"]
        ]  # fmt: skip
        times = [t for t in times if t is not None]
        found[group] = min(times) / ours[arrangement] if times else None
    return found


HEADS = ["asked for", "map", "one-step RMS", "error after 1", "after 100", "µs, one lane",
         "µs, 1,000 lanes", "DOP853", "diffrax", "heyoka", "diffrax, lanes",
         "heyoka, lanes"]  # fmt: skip


def row(measured: Numbers, ours: Numbers, key: str) -> list[str]:
    """A map's cells, with its ratios to the integrators at equal error."""
    single, batch = (ratios(measured, ours, key, a) for a in ("single", "batch"))
    asked = number(ours["tolerance"]) + ("" if ours["met"] else " (not met)")
    return [
        asked,
        f"{ours['chart']} {ours['label']}" + (", base map" if ours["base_map"] else "")
        + (f", {ours['times']} steps" if ours["times"] > 1 else ""),
        number(ours["one_step_rms"]), number(ours["error_1"]), number(ours[f"error_{ITERATIONS}"]),
        number(ours["single"]), number(ours["batch"]),
        *(number(single[g]) for g in GROUPS), number(batch["diffrax"]), number(batch["heyoka"]),
    ]  # fmt: skip


def fastest(measured: Numbers, ours: Numbers, arrangement: str) -> float | None:
    """The ratio to the fastest integrator."""
    known = [r for r in ratios(measured, ours, "error_1", arrangement).values() if r is not None]
    return min(known) if known else None


def passes(found: dict[int, Numbers], arrangement: str) -> str:
    """For each tolerance the smallest number of periods at which the ratio is 10."""
    said = []
    for tolerance in TOLERANCES:
        reached = []
        for n, measured in found.items():
            ours = [m for m in measured["maps"] if m["tolerance"] == tolerance and m["met"]]
            ratio = fastest(measured, ours[0], arrangement) if ours else None
            reached.append((n, ratio))
        known = [(n, r) for n, r in reached if r is not None]
        first = next((n for n, r in known if r >= ASKED), None)
        shown = ", ".join(f"{number(r)} at {n}" for n, r in known)
        verdict = f"from {first} periods on" if first else "not reached"
        said.append(f"{number(tolerance)}: {verdict} ({shown or 'no map'})")
    return "; ".join(said)


def section_text(measured: Numbers) -> str:
    rows = [row(measured, ours, "error_1") for ours in measured["maps"]]
    verdicts = []
    for arrangement, named in (("single", "one lane"), ("batch", f"{measured['lanes']:,} lanes")):
        found = [ratios(measured, m, "error_1", arrangement) for m in measured["maps"]]
        least = min(v for r in found for g in ("DOP853", "diffrax") if (v := r[g]) is not None)
        met = "met" if least >= ASKED else "**not met**"
        verdicts.append(f"{named}, the smallest ratio is {number(least)}, {met}")
    return (
        "### Hénon–Heiles, return map at E = 0.1\n\n"
        f"{measured['pairs']:,} pairs, {number(measured['fit_seconds'])} s for the fits at "
        f"three tolerances. The columns from DOP853 on: times as fast at equal one-step error.\n\n"
        f"{markdown(HEADS, rows)}\n\n"
        f"Target, one thread, at least {ASKED:g} times as fast as DOP853 and as diffrax: "
        f"{'; '.join(verdicts)} (DOP853 has no lanes).\n\n"
        "![Error against time](figures/return_maps_section.png)"
    )


def counted(periods: int) -> str:
    return f"{periods} period" + "s" * (periods > 1)


def pendulum_text(found: dict[int, Numbers]) -> str:
    rows = [
        [str(n), *row(measured, ours, "error_1")] for n, measured in found.items()
        for ours in measured["maps"]
    ]  # fmt: skip
    first = next(iter(found.values()))
    refused = [
        f"{counted(n)}: {m['refused']}. There the maps of a part are taken several times.\n\n"
        for n, m in found.items() if m["refused"]
    ]  # fmt: skip
    return (
        "### Driven pendulum, stroboscopic map\n\n"
        f"{first['pairs']:,} pairs each; ratios at equal error after one iteration; the one-step "
        f"RMS is that of the map's own step.\n\n{''.join(refused)}"
        f"{markdown(['periods', *HEADS], rows)}\n\n"
        f"Where the ratio to the fastest integrator passes {ASKED:g}, one lane: "
        f"{passes(found, 'single')}. Lanes: {passes(found, 'batch')}.\n\n"
        + "\n".join(
            f"![Error against time, {counted(n)}](figures/return_maps_pendulum_{n}.png)"
            for n in found
        )
    )


def iterations_text(found: Numbers) -> str:
    said = []
    for name, m in found.items():
        counts = ", ".join(f"{count:,} {status}" for status, count in m["status_counts"].items())
        reference = m["reference_seconds"] / m["reference_iterations"] / m["reference_lanes"]
        line = (
            f"- {name}, {m['chart']} {m['label']} (one-step RMS {number(m['one_step_rms'])}): "
            f"{m['iterations']:,} iterations of {m['lanes']:,} states in {number(m['seconds'])} s "
            f"({counts}); the reference, {1e6 * reference:.0f} µs an iteration, would take "
            f"{number(reference * m['iterations'] * m['lanes'] / 3600)} hours."
        )
        if m["distance_from_curves"] is not None:
            line += (
                f" Points of the map lie within {number(m['distance_from_curves'])} of the "
                f"reference's curves ({m['reference_lanes']} states)."
            )
        said.append(line)
    pictures = "\n".join(f"![{name}: sections](figures/return_maps_{name}.png)" for name in found)
    return "### A hundred thousand iterations\n\n" + "\n".join(said) + "\n\n" + pictures


def draw_curves(measured: Numbers, key: str, arrangement: str, name: str) -> None:
    curves = {
        tool: ([p[arrangement] for p in points], [p[key] for p in points])
        for tool, points in measured["curves"].items() if points[0][arrangement] is not None
    }  # fmt: skip
    ours = measured["maps"]
    curves = {"learned maps": ([m[arrangement] for m in ours], [m[key] for m in ours]), **curves}
    axes: Any = figures.work_precision(
        curves, "error after one iteration", "time per iteration of one trajectory (µs)"
    )
    figures.save(axes.figure, FIGURES / f"return_maps_{name}.png")


def tables() -> None:
    found = {n: r["measured"] for n, r in results(PIECES, "return-maps").items()}
    parts = []
    if "section" in found:
        draw_curves(found["section"], "error_1", "single", "section")
        parts.append(section_text(found["section"]))
    pendulums = {n: found[f"pendulum-{n}"] for n in PERIODS if f"pendulum-{n}" in found}
    if pendulums:
        for n, measured in pendulums.items():
            draw_curves(measured, "error_1", "single", f"pendulum_{n}")
        parts.append(pendulum_text(pendulums))
    if "iterations" in found:
        for name, m in found["iterations"].items():
            points = {}
            for title, key, most in (("reference", "reference", "reference_iterations"),
                                     ("learned map", "map", "iterations")):  # fmt: skip
                shown = m["points"][key]
                every = m[most] * m["reference_lanes"] // len(shown[0])
                points[f"{title}, every {every:,}th of {m[most]:,}"] = shown
            labels = ("$y$", "$p_y$") if "section" in name else ("$q$", "$p$")
            panels = {n: (np.array(x), np.array(y)) for n, (x, y) in points.items()}
            axes: Any = figures.sections(panels, labels)
            figures.save(axes[0].figure, FIGURES / f"return_maps_{name}.png")
        parts.append(iterations_text(found["iterations"]))
    if parts:
        parts.append(provenance(results(PIECES, "return-maps")))
        between_markers(TABLES, "return-maps", "\n\n".join(parts))


def main(argv: Sequence[str] | None = None) -> None:
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})
    run_pieces(__doc__ or "", PIECES, "return-maps", tables, argv)


if __name__ == "__main__":
    main()
