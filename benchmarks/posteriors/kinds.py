"""Bands by kind of data: uneven times, one record, single pairs, an angle, parameters, a drive,
equal sites. Noise of 1e-3 on every number; the truth by SciPy's DOP853.

Test states are such that their orbits stay among the data, but for ``beyond``: there a fifth to a
half of them swing out of the box that the pairs are from.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

# Sets float64, so it comes before all of JAX.
from harness import Numbers

# isort: split
import jax
import numpy as np
from posteriors.calibration import SAMPLES, quietly
from users.case import Field, box, flow, in_sequence, sequences
from users.systems import fput, pendulum

import gfnn_jax as gfnn
from gfnn_jax.coordinates import nearest_image

NOISE, STEPS, FITS, FIRST, STATES = 1e-3, (1, 10, 100), 10, 21, 40
# The two or three coefficients of a law make all errors of its fit: twice as many data sets.
FITS_OF_LAWS = {"angle": 20, "drive": 20}


class Kind(NamedTuple):
    """pairs: to learn from, with noise. field: the law, of states (2d, N). z0: (B, 2d) test states,
    clean. options: of `gfnn.fit`. ahead: of a rollout."""

    pairs: gfnn.Pairs
    field: Field
    z0: np.ndarray
    dt: float = 0.2
    options: dict[str, Any] = {}  # noqa: RUF012
    ahead: dict[str, Any] = {}  # noqa: RUF012


def with_noise(states, rng) -> np.ndarray:
    return states + NOISE * rng.normal(size=np.shape(states))


def staying(seed: int, stiffness: Any = 1.0) -> np.ndarray:
    """States (STATES, 2) of pendulums whose orbits stay in the box of half width 1, a tenth of the
    height of their energy below its rim. stiffness: g / length, a number or (STATES,)."""
    draws = box([1.0, 1.0])(50 * STATES, 1_000 + seed).reshape(STATES, 50, 2)
    q, p = np.moveaxis(draws, -1, 0)
    k = np.reshape(stiffness, (-1, 1))
    rim = np.minimum(k * (1 - np.cos(1.0)), 0.5)
    inside = 0.5 * p**2 + k * (1 - np.cos(q)) <= 0.9 * rim
    return draws[np.arange(STATES), np.argmax(inside, axis=1)]


def recorded(seed: int, num: int, num_steps: int, **options) -> Kind:
    """Sequences of a pendulum."""
    rng, draw = np.random.default_rng(seed), box([1.0, 1.0])
    states = with_noise(sequences(pendulum, draw(num, seed), 0.2, num_steps), rng)
    return Kind(in_sequence(states, 0.2), pendulum, draw(STATES, 1_000 + seed), options=options)


def uneven(seed: int) -> Kind:
    """Thirty sequences, every step of another length."""
    rng, draw = np.random.default_rng(seed), box([1.0, 1.0])
    states, dt = [draw(30, seed)], rng.uniform(0.1, 0.4, (30, 30))
    for step in dt:
        states.append(flow(partial(_scaled, step), states[-1], 1.0))
    z = with_noise(np.stack(states, axis=1), rng)
    pairs = gfnn.Pairs(z[:, :-1].reshape(-1, 2), z[:, 1:].reshape(-1, 2), dt.T.ravel())
    return Kind(pairs, pendulum, draw(STATES, 1_000 + seed), ahead={"dt": 0.2})


def _scaled(dt: np.ndarray, z: np.ndarray) -> np.ndarray:
    return dt * pendulum(z)


def one_record(seed: int) -> Kind:
    """600 states of one orbit, which is where the map is known."""
    start = np.array([[0.6 + 0.1 * np.random.default_rng(seed).random(), 0.3]])
    states = sequences(pendulum, start, 0.2, 600)
    between = flow(pendulum, states[0, :: 600 // STATES][:STATES], 0.1)
    return Kind(
        in_sequence(with_noise(states, np.random.default_rng(seed)), 0.2), pendulum, between
    )


def single_pairs(seed: int, beyond: bool = False) -> Kind:
    """A thousand pairs that stand alone."""
    rng, draw = np.random.default_rng(seed), box([1.0, 1.0])
    z = draw(1_000, seed)
    z0, z1 = (with_noise(x, rng) for x in (z, flow(pendulum, z, 0.2)))
    ahead = draw(STATES, 1_000 + seed) if beyond else staying(seed)
    return Kind(gfnn.Pairs(z0, z1, 0.2), pendulum, ahead)


def parameter(seed: int) -> Kind:
    """A thousand pairs of pendulums of lengths that are told."""
    rng, draw = np.random.default_rng(seed), box([1.0, 1.0])
    z, k, ahead = draw(1_000, seed), rng.uniform(0.5, 2.0, 1_000), rng.uniform(0.6, 1.9, STATES)
    z0, z1 = (with_noise(x, rng) for x in (z, flow(partial(pendulum, stiffness=k), z, 0.2)))
    return Kind(
        gfnn.Pairs(z0, z1, 0.2, args={"k": k}),
        partial(pendulum, stiffness=ahead),
        staying(seed, ahead),
        options={"angles": (0,)},
        ahead={"params": ahead[:, None]},
    )


def drive(seed: int) -> Kind:
    """A thousand pairs of a driven pendulum, at any time of the drive."""
    rng, draw = np.random.default_rng(seed), box([1.0, 1.0])
    z, t0, begin = draw(1_000, seed), rng.uniform(0, 2 * np.pi, 1_000), np.zeros(STATES)
    z0, z1 = (with_noise(x, rng) for x in (z, _driven(z, t0, 0.2)))
    pairs = gfnn.Pairs(z0, z1, 0.2, args={"t": t0}, period=2 * np.pi)
    return Kind(
        pairs, _with_time, 0.8 * staying(seed), options={"angles": (0,)}, ahead={"t0": begin}
    )


def _driven(z: np.ndarray, t0: np.ndarray, dt: float) -> np.ndarray:
    """Images of states (N, 2) at the times t0 (N,): the time is a third coordinate."""
    return flow(_with_time, np.column_stack([z, t0]), dt)[:, :2]


def _with_time(z: np.ndarray) -> np.ndarray:
    if len(z) == 2:  # a test state, which begins at time 0: flow() carries no clock
        raise ValueError("expected states with their time")
    q, p, t = z
    return np.stack([p, -np.sin(q) * (1 + 0.15 * np.cos(t)), 1 + 0 * t])


def sites(seed: int) -> Kind:
    """A hundred pairs of a chain of eight."""
    rng, draw = np.random.default_rng(seed), box([0.5] * 16)
    z = draw(100, seed)
    z0, z1 = (with_noise(x, rng) for x in (z, flow(fput, z, 0.2)))
    return Kind(
        gfnn.Pairs(z0, z1, 0.2), fput, draw(STATES, 1_000 + seed), options={"structure": "chain"}
    )


KINDS: dict[str, Callable[[int], Kind]] = {
    "uneven": uneven,
    "one-record": one_record,
    "single-pairs": single_pairs,
    "beyond": partial(single_pairs, beyond=True),
    "sequences": partial(recorded, num=40, num_steps=50),
    "angle": partial(recorded, num=40, num_steps=50, angles=(0,)),
    "parameter": parameter,
    "drive": drive,
    "sites": sites,
}


def reference(kind: Kind) -> np.ndarray:
    """The true states (B, 1 + last step, 2d)."""
    if kind.field is not _with_time:
        return sequences(kind.field, kind.z0, kind.dt, STEPS[-1])
    z = np.column_stack([kind.z0, kind.ahead["t0"]])
    return sequences(_with_time, z, kind.dt, STEPS[-1])[..., :2]


def of_kind(name: str, quick: bool) -> Numbers:
    """Every fit of a kind by itself, and all pooled.

    coverage: the part of the errors inside two standard deviations. width: the RMS of two standard
    deviations ÷ that of the errors.
    """
    inside, widths, errors, labels = [], [], [], Counter()
    for seed in range(FIRST, FIRST + (1 if quick else FITS_OF_LAWS.get(name, FITS))):
        kind = KINDS[name](seed)
        fit = quietly(kind.pairs, seed=seed, **kind.options)
        labels[f"{fit.chosen.chart} {fit.chosen.label}"] += 1
        if fit.map.posterior is None:
            continue
        info: Any
        states, info = fit.map.rollout(
            kind.z0, STEPS[-1], samples=SAMPLES, key=jax.random.key(seed), **kind.ahead
        )
        off = np.asarray(states) - reference(kind)
        off = nearest_image(off.reshape(-1, off.shape[-1]), fit.map.angles_of_z).reshape(off.shape)
        error, band = (np.abs(x)[:, STEPS] for x in (off, 2 * np.asarray(info.bands.std)))
        inside.append(np.mean(error <= band, axis=(0, 2)))
        widths.append(np.sqrt(np.nanmean(band**2, axis=(0, 2))))
        errors.append(np.sqrt(np.nanmean(error**2, axis=(0, 2))))
        print(
            f"  {name} {seed}: {fit.chosen.label}, inside {inside[-1].round(2)}, width "
            f"{(widths[-1] / errors[-1]).round(2)}, rms {errors[-1]}",
            flush=True,
        )
    found = np.stack(inside)
    rms, width = (np.sqrt(np.mean(np.square(each), axis=0)) for each in (errors, widths))
    chance = np.std(found, axis=0, ddof=1) / np.sqrt(len(found)) if len(found) > 1 else None
    return {
        "kind": name,
        "steps": STEPS,
        "labels": dict(labels.most_common()),
        "data_sets": len(found),
        "coverage": found.mean(axis=0).tolist(),
        "coverage_error": None if chance is None else chance.tolist(),
        "width": (width / rms).tolist(),
        "rms": rms.tolist(),
    }
