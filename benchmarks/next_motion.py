"""Next motion: samples that a proposed motion saves, beside motions at random in the same limits.

    python benchmarks/next_motion.py           both twins, some two minutes
    python benchmarks/next_motion.py --quick   one draw of each, into runs/

The twins are a double pendulum that is let go, and a drive axis like EMPS, with viscous and dry
friction, whose force is an input. A first record is a motion at random: a small swing, or a
multisine of random phases. Then one more motion is recorded, as `Fit.next_motions` proposes it
first, or at random: from rest within the angles that proposals may use, or by another multisine of
the same largest force. The fit of both records has the terms that made them. It forecasts held-out
motions at random, a second from true states, and its error is the median of their rms over the
spread. Counted are the samples of the second motion that give the same error.
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
from gfnn_jax.models.lagrangians.next_motion import OPTIONS

SEED, DRAWS = 16_180, 2
COUNTS = (32, 64, 128, 256)  # samples of the second motion
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


def at_random(plant: Plant, rng: np.random.Generator, count: int, reach: float) -> Any:
    """A start at rest within a reach, and a multisine (n, k) of random phases."""
    d = len(plant.names)
    if plant.reach:
        return rng.uniform(-reach, reach, d), np.zeros((count, 0))
    push = multisine(0.2, 2.5, 12, (1.0,))(rng, plant.dt * np.arange(count))
    return np.zeros(d), AXIS[0] * push / np.max(np.abs(push))


def proposed(plant: Plant, fit: Any, count: int) -> Any:
    """The start and the input of the motion that is proposed first."""
    best = fit.next_motions[0]
    start = np.array([best.start[name] for name in plant.names])
    if best.drive is None:
        return start, np.zeros((count, 0 if plant.reach else 1))
    _, first, second, period = best.drive
    turned = (plant.dt * np.arange(count) / period + 0.25) % 1.0
    return start, np.where(turned < 0.5, first, second)[:, None]


def recording(plant: Plant, made: list, rng: np.random.Generator) -> gfnn.Recording:
    """What sensors show of motions (states, inputs)."""
    tables = []
    for run, (states, u) in enumerate(made):
        q = states[:, : len(plant.names)]
        q = q + NOISE * made[0][0][:, : q.shape[1]].std(axis=0) * rng.normal(size=q.shape)
        columns = dict(zip((*plant.names, "u"), (*q.T, *u.T), strict=False))
        t = plant.dt * np.arange(len(q))
        tables.append({"run": np.full(len(t), str(run)), "t": t, **columns})
    angles = plant.names if plant.reach else ()
    inputs = () if plant.reach else ("u",)
    return gfnn.Recording(tables, positions=plant.names, angles=angles, inputs=inputs)


def fitted(plant: Plant, made: list, rng: np.random.Generator) -> Any:
    """The fit of motions, None where it is refused."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", gfnn.FitWarning)
        try:
            return gfnn.fit(recording(plant, made, rng), terms=list(plant.terms))
        except FitError:
            return None


def error(plant: Plant, fit: Any, held_out: list) -> float:
    """Median rms error of forecasts of motions (states, inputs) over the spread of all."""
    if fit is None:
        return np.inf
    law, d = fit.map.law_in_use, len(plant.names)
    states, u = (np.array(part) for part in zip(*held_out, strict=True))
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
        start, u = at_random(plant, rng, plant.first, plant.reach)
        base = plant.motion(start, u, plant.dt), u
        fit = fitted(plant, [base], rng)
        if fit is None:
            continue
        off = np.abs(base[0][:, : len(plant.names)] - np.median(base[0][:, : len(plant.names)]))
        reach = min(max(OPTIONS.further) * float(off.max()), OPTIONS.highest)
        held_out = []
        for _ in range(HELD_OUT):
            start, u = at_random(plant, rng, 3 * ahead, reach)
            states = plant.motion(start, u, plant.dt)
            k = int(rng.integers(ahead))
            held_out.append((states[k : k + ahead], u[k : k + ahead]))

        def after(start: np.ndarray, u: np.ndarray, rng=rng, base=base, held_out=held_out):
            whole = plant.motion(start, u, plant.dt)
            fits = (fitted(plant, [base, (whole[:n], u[:n])], rng) for n in COUNTS)
            return np.array([error(plant, one, held_out) for one in fits])

        chosen = after(*proposed(plant, fit, COUNTS[-1]))
        others = [after(*at_random(plant, rng, COUNTS[-1], reach)) for _ in range(AT_RANDOM)]
        usual = np.median(others, axis=0)
        asked = max(chosen.min(), usual.min())
        c: Numbers = {
            "draw": draw,
            "before": error(plant, fit, held_out),
            "motion": str(fit.next_motions[0]),
            "proposed": chosen.tolist(),
            "at random": [row.tolist() for row in others],
            "asked": float(asked),
            "samples": [needed(chosen, asked), needed(usual, asked)],
        }
        cases.append(c)
        print(f"  {draw}: {c['motion'][:150]}\n   ", chosen, usual, c["samples"], flush=True)
    return {"cases": cases}


PIECES: dict[str, Callable[[bool], Numbers]] = {
    name.lower().replace(" ", "-"): partial(measured, name) for name in PLANTS
}


def tables() -> None:
    """The table of RESULTS.md."""
    found = results_of(PIECES, "next_motion")
    rows = []
    for name, piece in zip(PLANTS, PIECES, strict=True):
        for c in found[piece]["measured"]["cases"] if piece in found else []:
            chosen, usual = c["samples"]
            rows.append(
                [
                    name,
                    number(c["before"]),
                    number(c["asked"]),
                    number(chosen),
                    number(usual),
                    number(chosen / usual),
                ]
            )
    heads = (
        "twin",
        "error before",
        "error reached",
        "samples, as proposed",
        "samples, at random",
        "ratio",
    )
    between_markers(TABLES, "next-motion", f"{markdown(heads, rows)}\n\n{provenance(found)}")


if __name__ == "__main__":
    main(__doc__ or "", PIECES, "next_motion", tables, None)
