"""Next motion: samples that a proposed motion saves, beside motions at random in the same limits.

    python benchmarks/next_motion.py           both twins, some two minutes
    python benchmarks/next_motion.py --quick   one draw of each, into runs/

The twins are a double pendulum that is let go, and a drive axis like EMPS, with viscous and dry
friction, whose force is an input. A first record is a motion at random: a small swing, or a
multisine of random phases. Then one more motion is recorded, as `Fit.next_motions` proposes it
first, or at random: from rest within the angles that proposals may use, or by another multisine of
the same largest force. The fit of both records has the terms that made them. It forecasts held-out
motions at random, a second from true states, and its error is the median of their rms over the
spread. Counted are the samples of the second motion that give the same error: of the proposed one,
of motions at random at the interval of the first record, and at the interval that is proposed,
which tells what the interval saves and what the motion. One fit's error is that of one draw of
noise; the last row of a twin has the geometric means over its draws.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from harness import TABLES, Numbers, between_markers, main, markdown, number, provenance
from harness import results as results_of
from twins import TWINS, multisine

import gfnn_jax as gfnn
from gfnn_jax.errors import FitError
from gfnn_jax.models.lagrangians.next_motion import Options

SEED, DRAWS = 27_182, 4
COUNTS = (16, 32, 64, 128, 256)  # samples of the second motion
WAYS = ("proposed", "at random", "at random, as far apart")
AT_RANDOM = 2  # motions for each draw of the first record
HELD_OUT, AHEAD, NOISE = 24, 1.0, 1e-3  # motions, s, of the spread
AXIS = np.array([100.0, 203.5, 20.39]) / 95.11  # force, viscous and dry friction by the mass


class Plant(NamedTuple):
    """A twin: motion(start, u, dt) -> states (n, 2d) from rest by an input (n, k) that is held,
    names, terms, step in seconds, and samples of the first record; reach: the largest angle of its
    first start, 0 where an input drives it."""

    motion: Callable[[np.ndarray, np.ndarray, float], np.ndarray]
    names: tuple[str, ...]
    terms: tuple[str, ...]
    dt: float
    first: int
    reach: float = 0.0


def swung(start: np.ndarray, u: np.ndarray, dt: float) -> np.ndarray:
    """The double pendulum, let go."""
    x = np.concatenate([start, np.zeros(2)])
    return PENDULUM.body.follow(x, dt * np.arange(len(u)), rtol=1e-9, atol=1e-9)


def pushed(start: np.ndarray, u: np.ndarray, dt: float) -> np.ndarray:
    """The axis, exactly: its speed goes to that at which friction is as strong as the force, or
    comes to zero before, and stays there where the force is less than dry friction."""
    _, viscous, dry = AXIS
    x, v, states = float(start[0]), 0.0, []
    for force in u[:, 0]:
        states.append((x, v))
        left = dt
        while left > 0:
            side = np.sign(v) or (np.sign(force) if abs(force) > dry else 0.0)
            if side == 0:
                break
            last = (force - side * dry) / viscous
            stops = np.log1p(-v / last) / viscous if v * last < 0 else np.inf
            step = min(left, stops)
            faded = np.exp(-viscous * step)
            x += last * step + (v - last) * (1 - faded) / viscous
            v = last + (v - last) * faded if step < stops else 0.0
            left -= step
    return np.array(states)


PENDULUM = TWINS["double_pendulum"]
PLANTS = {
    "double pendulum": Plant(
        swung,
        PENDULUM.names,
        (*PENDULUM.lagrangian, *(f"R: {term}" for term in PENDULUM.friction)),
        PENDULUM.dt,
        100,
        0.4,
    ),
    "EMPS": Plant(
        pushed,
        ("x",),
        ("v**2", "R: v**2", "R: abs(v)"),
        0.01,
        200,
    ),
}


class Made(NamedTuple):
    """A motion: states (n, 2d), inputs (n, k), and the interval between them."""

    states: np.ndarray
    u: np.ndarray
    dt: float

    def first(self, count: int) -> Made:
        return Made(self.states[:count], self.u[:count], self.dt)


def at_random(plant: Plant, rng: np.random.Generator, count: int, reach: float, dt: float) -> Made:
    """A motion from rest within a reach, under a multisine of random phases."""
    d = len(plant.names)
    if plant.reach:
        start, u = rng.uniform(-reach, reach, d), np.zeros((count, 0))
    else:
        push = multisine(0.2, 2.5, 12, (1.0,))(rng, dt * np.arange(count))
        start, u = np.zeros(d), AXIS[0] * push / np.max(np.abs(push))
    return Made(plant.motion(start, u, dt), u, dt)


def proposed(plant: Plant, fit: Any, count: int) -> Made:
    """The motion that is proposed first."""
    best = fit.next_motions[0]
    start, dt = np.array([best.start[name] for name in plant.names]), best.interval
    u = np.zeros((count, 0 if plant.reach else 1))
    if best.drive is not None:
        _, first, second, period = best.drive
        turned = (dt * np.arange(count) / period + 0.25) % 1.0
        u = np.where(turned < 0.5, first, second)[:, None]
    return Made(plant.motion(start, u, dt), u, dt)


def recording(plant: Plant, made: list[Made], rng: np.random.Generator) -> gfnn.Recording:
    """What sensors show of motions."""
    tables = []
    for run, (states, u, dt) in enumerate(made):
        q = states[:, : len(plant.names)]
        q = q + NOISE * made[0].states[:, : q.shape[1]].std(axis=0) * rng.normal(size=q.shape)
        columns = dict(zip((*plant.names, "u"), (*q.T, *u.T), strict=False))
        t = dt * np.arange(len(q))
        tables.append({"run": np.full(len(t), str(run)), "t": t, **columns})
    angles = plant.names if plant.reach else ()
    inputs = () if plant.reach else ("u",)
    return gfnn.Recording(tables, positions=plant.names, angles=angles, inputs=inputs)


def fitted(plant: Plant, made: list[Made], rng: np.random.Generator) -> Any:
    """The fit of motions, None where it is refused."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", gfnn.FitWarning)
        try:
            return gfnn.fit(recording(plant, made, rng), terms=list(plant.terms))
        except FitError:
            return None


def error(plant: Plant, fit: Any, held_out: list[Made]) -> float:
    """Median rms error of forecasts of motions over the spread of all."""
    if fit is None:
        return np.inf
    law, d = fit.map.law_in_use, len(plant.names)
    states, u = (np.array(part) for part in [*zip(*held_out, strict=True)][:2])
    u = np.broadcast_to(u[:, :-1, None, None], (*u[:, :-1].shape[:2], 4, 6, u.shape[2]))
    h = np.full(u.shape[:2], plant.dt)
    found = law.form.follow(law.p, states[:, 0], h, u, order=0).states[..., :d]
    off = (found - states[:, 1:, :d]) / states[..., :d].std(axis=(0, 1))
    return float(np.median(np.sqrt(np.mean(off**2, axis=(1, 2)))))


def needed(errors: np.ndarray, asked: float) -> float:
    """Samples at which errors (counts,) come down to what is asked, between counts by their
    logarithms; those of the fewest, or infinitely many, beyond the ends."""
    least = np.minimum.accumulate(errors)
    if least[-1] > asked:
        return np.inf
    return float(np.exp(np.interp(-np.log(asked), -np.log(least), np.log(COUNTS))))


def measured(name: str, quick: bool) -> Numbers:
    plant, cases = PLANTS[name], []
    ahead = int(AHEAD / plant.dt)
    for draw in range(1 if quick else DRAWS):
        rng = np.random.default_rng([SEED, list(PLANTS).index(name), draw])
        base = at_random(plant, rng, plant.first, plant.reach, plant.dt)
        fit = fitted(plant, [base], rng)
        if fit is None:
            continue
        q = base.states[:, : len(plant.names)]
        far = float(np.max(np.abs(q - np.median(q))))
        reach = min(max(Options.further) * far, Options.highest)
        held_out = []
        for _ in range(HELD_OUT):
            states, u, _ = at_random(plant, rng, 3 * ahead, reach, plant.dt)
            k = int(rng.integers(ahead))
            held_out.append(Made(states[k : k + ahead], u[k : k + ahead], plant.dt))

        def after(whole: Made, rng=rng, base=base, held_out=held_out):
            fits = (fitted(plant, [base, whole.first(n)], rng) for n in COUNTS)
            return [error(plant, one, held_out) for one in fits]

        chosen = proposed(plant, fit, COUNTS[-1])
        c: Numbers = {
            "draw": draw,
            "before": error(plant, fit, held_out),
            "motion": str(fit.next_motions[0]),
            "interval": [plant.dt, chosen.dt],
            "proposed": after(chosen),
        }
        for way, dt in zip(WAYS[1:], (plant.dt, chosen.dt), strict=True):
            c[way] = [after(at_random(plant, rng, COUNTS[-1], reach, dt)) for _ in range(AT_RANDOM)]
        cases.append(c)
        print(f"  {draw}: {c}", flush=True)
    return {"cases": cases}


PIECES: dict[str, Callable[[bool], Numbers]] = {
    name.lower().replace(" ", "-"): partial(measured, name) for name in PLANTS
}


def judged(cases: list[Numbers]) -> tuple[float, float, list[float]]:
    """Of cases the error before, that which all ways reach, and the samples that each needs. The
    error of a fit that was refused, null in JSON, is infinite."""

    def of(errors: list[Any]) -> np.ndarray:
        table = np.atleast_2d(np.array(errors, float))
        return np.median(np.where(np.isnan(table), np.inf, table), axis=0)

    errors = [np.exp(np.mean([np.log(of(c[way])) for c in cases], axis=0)) for way in WAYS]
    asked = max(float(one.min()) for one in errors)
    before = float(np.exp(np.mean([np.log(c["before"]) for c in cases])))
    return before, asked, [needed(one, asked) for one in errors]


def tables() -> None:
    """The table of RESULTS.md."""
    found = results_of(PIECES, "next_motion")
    rows = []
    for name, piece in zip(PLANTS, PIECES, strict=True):
        cases = found[piece]["measured"]["cases"] if piece in found else []
        for draw, some in [*((str(c["draw"]), [c]) for c in cases), ("all", cases)]:
            if some:
                before, asked, (chosen, usual, sparse) = judged(some)
                apart = "; ".join(f"{c['interval'][1] / c['interval'][0]:g}" for c in some)
                ratios = number(chosen / usual), number(chosen / sparse)
                counts = map(number, (before, asked, chosen, usual, sparse))
                rows.append([name, draw, apart, *counts, *ratios])
    heads = (
        "twin",
        "draw",
        "interval, times that of the first record",
        "error before",
        "error reached",
        "samples, as proposed",
        "samples, at random",
        "at random, as far apart",
        "ratio to random",
        "ratio to random, as far apart",
    )
    between_markers(TABLES, "next-motion", f"{markdown(heads, rows)}\n\n{provenance(found)}")


if __name__ == "__main__":
    main(__doc__ or "", PIECES, "next_motion", tables, None)
