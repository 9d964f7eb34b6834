"""One-turn maps of storage rings, learned from a tracking code (PyAT) and compared with it.

    python -m pip install '.[accelerator]'
    python benchmarks/storage_ring.py            every piece that has no result yet (half an hour)
    python benchmarks/storage_ring.py --quick    a small one

The lattices are those that PyAT ships: `err.mat`, a whole ring with errors, and `hmba.mat`, a cell
of ESRF-EBS. States are (x, y, p_x, p_y) about the closed orbit, in metres and radians, four
dimensional: the energy deviation δ of a particle does not change; it is 0, or a parameter of the
map. Pairs are drawn from an ellipsoid whose half axes are amplitudes of 2 mm in x and in y at the
point where a turn begins.
"""

from __future__ import annotations

import contextlib
import io
import logging
import warnings
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from harness import (
    SEED,
    TABLES,
    Numbers,
    between_markers,
    main,
    markdown,
    number,
    once,
    provenance,
    results,
    timed,
)  # fmt: skip
from scipy.optimize import minimize_scalar

import gfnn_jax as gfnn
from gfnn_jax.maps.symplectic_map import SymplecticMap

AMPLITUDE = 2e-3  # metres, in x and in y
NUM_PAIRS, FRESH, BATCH = 5_000, 1_000, 1_000
TURNS, ORBITS = 300, 20  # compared with the tracking code
TUNE_TURNS = 1_024
DEVIATION, DELTA_PAIRS, DELTA_FRESH = 0.01, 20_000, 2_000  # δ is drawn from ± this
# Tolerances, and after how many quarters of the ring each piece ends.
ROWS = ((1e-4, (0, 4)), (1e-5, (0, 4)), (3e-7, (0, 4)), (1e-7, (0, 2, 4)))
# Metres: x and y of the frequency map, inside the aperture of the cell.
REGION = (8e-3, 4e-3)
# (x, p_x, y, p_y) of PyAT as (x, y, p_x, p_y), which is its own inverse.
ORDER = [0, 2, 1, 3]


class Ring(NamedTuple):
    """A lattice without cavities and radiation; optics where a turn begins, beta and alpha (2,).
    orbits: closed orbit (4,) in PyAT's order at the element of that number."""

    lattice: Any
    beta: np.ndarray
    alpha: np.ndarray
    orbits: dict[int, np.ndarray]

    def track(
        self, z, points: tuple[int, ...] = (), turns: int = 1, delta: float | np.ndarray = 0.0
    ) -> np.ndarray:
        """States (turns, points, N, 4) after these elements of each turn; the last one unless
        told. delta: energy deviation, a number or (N,). NaN where a particle is lost."""
        points = points or (len(self.lattice),)
        start = np.zeros((6, len(z)), order="F")
        start[:4], start[4] = (np.asarray(z)[:, ORDER] + self.orbit(0)).T, delta
        out, *_ = self.lattice.track(start, nturns=turns, refpts=list(points))
        orbits = np.stack([self.orbit(i) for i in points])
        return (out[:4].transpose(3, 2, 1, 0) - orbits[:, None])[..., ORDER]

    def orbit(self, element: int) -> np.ndarray:
        if element not in self.orbits:
            _, found = self.lattice.find_orbit4(refpts=[element])
            self.orbits[element] = found[0, :4]
        return self.orbits[element]

    def half_axes(self, x: float, y: float) -> np.ndarray:
        """(4,) of the ellipsoid of these amplitudes."""
        return np.array([x, y, x / self.beta[0], y / self.beta[1]])

    def normalised(self, z) -> np.ndarray:
        """Complex √(2J) exp(−iφ) of both planes (..., 2): Courant and Snyder's coordinates."""
        q, p = z[..., :2], z[..., 2:]
        return (q - 1j * (self.alpha * q + self.beta * p)) / np.sqrt(self.beta)

    def boundaries(self, count: int) -> tuple[int, ...]:
        """The elements after which the cells lie that cut the ring into so many equal parts."""
        s = self.lattice.get_s_pos(range(len(self.lattice) + 1))
        inner = (int(np.argmin(np.abs(s - s[-1] * k / count))) for k in range(1, count))
        return (*inner, len(self.lattice))


@cache
def ring(name: str) -> Ring:
    """A lattice of PyAT's machine_data."""
    try:
        import machine_data
        from at import load_lattice
    except ImportError as error:
        raise SystemExit("expected PyAT: python -m pip install '.[accelerator]'") from error
    folder = Path(next(iter(machine_data.__path__)))
    logging.disable(logging.WARNING)
    # Thousands of warnings of old element classes.
    with warnings.catch_warnings(), contextlib.redirect_stdout(io.StringIO()):
        warnings.simplefilter("ignore")
        lattice: Any = load_lattice(folder / name).disable_6d(copy=True)
        optics, _, _ = lattice.get_optics()
    return Ring(lattice, optics.beta, optics.alpha, {})


def ellipsoid(half_axes, count: int, seed: int) -> np.ndarray:
    """States (count, 4), uniform within it."""
    rng = np.random.default_rng([SEED, seed])
    u = rng.normal(size=(count, 4))
    u *= rng.uniform(size=(count, 1)) ** 0.25 / np.linalg.norm(u, axis=1, keepdims=True)
    return u * half_axes


def of_a_turn(map_: SymplecticMap, batch, turns: int, params=None) -> float:
    """CPU microseconds of a turn of one particle of a batch (B, 4)."""

    def run():
        return map_.rollout(batch, num_steps=turns, save_every=turns, params=params)

    run()
    return min(once(run).processor_seconds for _ in range(3)) / turns / len(batch) * 1e6


# One turn


def learned(
    sectors: list[np.ndarray], tolerance: float = 1e-9
) -> tuple[SymplecticMap, list[gfnn.Fit]]:
    """The map of the sectors' maps in a row, from states at their ends (K + 1, N, 4)."""
    fits = []
    for before, after in pairwise(sectors):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", gfnn.FitWarning)
            pairs = gfnn.Pairs(before[:NUM_PAIRS], after[:NUM_PAIRS], 1 / (len(sectors) - 1))
            fits.append(
                gfnn.fit(pairs, learn="map", tolerance=tolerance, max_seconds=None, seed=SEED)
            )
    map_ = fits[0].map
    for fit in fits[1:]:
        map_ = map_.then(fit.map)
    return map_, fits


def polynomial(before, after, degree: int):
    """z -> Z by an explicit polynomial of this degree, fitted to the same pairs: as accurate as a
    truncated Taylor map and, like one, not symplectic."""
    from numpy.polynomial import chebyshev

    size = 1.05 * np.abs(before).max(axis=0)
    powers = np.array(list(np.ndindex(*[degree + 1] * 4)))
    powers = powers[powers.sum(axis=1) <= degree]

    def design(z):
        tables = [chebyshev.chebvander(z[:, i] / size[i], degree) for i in range(4)]
        return np.prod([t[:, powers[:, i]] for i, t in enumerate(tables)], axis=0)

    coefficients = np.linalg.lstsq(design(before), after, rcond=None)[0]
    return lambda z: design(z) @ coefficients


def turn(quick: bool) -> Numbers:
    """Measure one turn of the ring with errors, by one and by two generated pieces."""
    err = ring("err.mat")
    half = err.half_axes(AMPLITUDE, AMPLITUDE)
    count = 600 if quick else NUM_PAIRS + FRESH
    z, points = ellipsoid(half, count, 0), err.boundaries(4)
    ends = [z, *err.track(z, points)[0]]
    timed_ones = z[:20] if quick else z[:500]
    tracking = once(lambda: err.track(timed_ones)).processor_seconds / len(timed_ones)
    few = ellipsoid(half, 4 if quick else ORBITS, 1)
    turns = 20 if quick else TURNS
    orbits = err.track(few, turns=turns)[:, 0]
    spread, fresh = z.std(axis=0), slice(-FRESH // 10 if quick else -FRESH, None)

    def errors(step, rollout) -> Numbers:
        one = (step(z[fresh]) - ends[-1][fresh]) / spread
        far = (rollout(few) - orbits[-1]) / spread
        return {"one_turn": float(np.sqrt(np.mean(one**2))),
                "after_turns": float(np.sqrt(np.nanmedian(np.mean(far**2, axis=1)))),
                "lost": int(np.isnan(far).any(axis=1).sum())}  # fmt: skip

    rows: list[Numbers] = []
    for tolerance, cuts in ROWS[1:2] if quick else ROWS:
        (map_, fits), _, seconds = once(
            lambda c=cuts, t=tolerance: learned([ends[i] for i in c], t)
        )
        batch = ellipsoid(half, BATCH, 2)
        found = errors(
            lambda x, m=map_: np.asarray(m.step(x)[0]),
            lambda x, m=map_: np.asarray(m.rollout(x, num_steps=turns, save_every=turns)[0])[:, -1],
        )
        rows.append({
            "map": f"{len(fits)} generated", "label": fits[0].chosen.label, **found,
            "tolerance": tolerance,
            "fit_seconds": seconds, "microseconds_per_turn": of_a_turn(map_, batch, 30),
            "defect": float(np.max(np.asarray(map_.defect(few)))),
        })  # fmt: skip
    degree = 3 if quick else 9  # as many digits of a Taylor series as S of degree 10
    explicit = polynomial(z[:NUM_PAIRS], ends[-1][:NUM_PAIRS], degree)

    def repeated(x):
        with np.errstate(all="ignore"):
            for _ in range(turns):
                x = explicit(x)
        return x

    rows.append({"map": "explicit polynomial", "label": f"degree {degree}",
                 **errors(explicit, repeated)})  # fmt: skip
    return {
        "rows": rows, "num_pairs": min(count, NUM_PAIRS), "turns": turns,
        "tracking_microseconds_per_turn": tracking * 1e6,
        "num_elements": len(err.lattice), "spread": spread.tolist(),
    }  # fmt: skip


# Tunes


def tune(signal, near: float | None = None) -> float:
    """The frequency, in cycles per turn, of the largest line of a signal (N,): Laskar's frequency
    analysis with a Hann window. near: a frequency, from which the line is at most 0.02 away: the
    line of its own plane, where that of the other one may be larger."""
    n = np.arange(len(signal))
    window = np.hanning(len(signal)) * signal

    def power(frequency):
        return -abs(window @ np.exp(-2j * np.pi * frequency * n))

    lines, frequencies_ = np.abs(np.fft.fft(window)), np.arange(len(signal)) / len(signal)
    if near is not None:
        lines[np.abs(frequencies_ - near) > 0.02] = 0.0
    coarse = frequencies_[np.argmax(lines)]
    width = 1 / len(signal)
    found = minimize_scalar(
        power, bounds=(coarse - width, coarse + width), method="bounded", options={"xatol": 1e-12}
    )
    return float(found.x % 1.0)


def followed(signals, linear) -> np.ndarray:
    """Tunes (N, 2) of orbits (turns, N, 2) of rising amplitude, each by the line of its own plane:
    the one next to where the tunes before lead, from the ``linear`` ones on."""
    found = np.empty(signals.shape[1:])
    for k, first in enumerate(linear):
        near = first
        for i in range(len(found)):
            found[i, k] = tune(signals[:, i, k], near)
            near = 2 * found[i, k] - found[i - 1, k] if i else found[i, k]
    return found


def tunes(quick: bool) -> Numbers:
    """Tunes against amplitude, of the map in one piece and of the tracking code."""
    err = ring("err.mat")
    half = err.half_axes(AMPLITUDE, AMPLITUDE)
    z, points = ellipsoid(half, 600 if quick else NUM_PAIRS, 0), err.boundaries(4)
    ends = [z, *err.track(z, points)[0]]
    amplitudes = np.linspace(0.1, 0.9, 2 if quick else 9) * AMPLITUDE
    small = 0.05 * AMPLITUDE
    start = np.zeros((2 * len(amplitudes), 4))
    start[: len(amplitudes), 0], start[: len(amplitudes), 1] = amplitudes, small
    start[len(amplitudes) :, 1], start[len(amplitudes) :, 0] = amplitudes, small
    turns = 128 if quick else TUNE_TURNS
    orbits = np.concatenate([start[None], err.track(start, turns=turns)[:, 0]])

    def found(states) -> np.ndarray:
        signals = err.normalised(states)  # (turns + 1, N, 2)
        along_x, along_y = np.split(signals, 2, axis=1)
        linear = tune(along_x[:, 0, 0]), tune(along_y[:, 0, 1])
        return np.concatenate([followed(part, linear) for part in (along_x, along_y)])

    theirs, rows = found(orbits), {}
    for cuts in ((0, 4),) if quick else ((0, 4), (0, 2, 4)):
        map_, fits = learned([ends[i] for i in cuts], 1e-6 if quick else 1e-9)
        states = np.asarray(map_.rollout(start, num_steps=turns)[0]).transpose(1, 0, 2)
        rows[f"{len(fits)} generated"] = found(states)
    return {
        "amplitudes": amplitudes.tolist(), "tracked": theirs.tolist(), "turns": turns,
        "learned": {name: ours.tolist() for name, ours in rows.items()},
        "largest_difference": {
            name: float(np.abs(ours - theirs).max()) for name, ours in rows.items()
        },
    }  # fmt: skip


# The energy deviation


def deviation(quick: bool) -> Numbers:
    """Measure one turn of the ring with errors, δ a parameter; the tunes against δ."""
    return of_region(AMPLITUDE, quick)


def small_deviation(quick: bool) -> Numbers:
    """Measure one turn with δ as a parameter, within half the amplitude."""
    return of_region(AMPLITUDE / 2, quick)


def of_region(amplitude: float, quick: bool) -> Numbers:
    err = ring("err.mat")
    count, turns = (300, 5) if quick else (DELTA_PAIRS, TURNS)
    half = err.half_axes(amplitude, amplitude)
    z = ellipsoid(half, count + DELTA_FRESH, 10)
    delta = np.random.default_rng(5).uniform(-DEVIATION, DEVIATION, len(z))
    image = err.track(z, delta=delta)[0, 0]
    few = ellipsoid(0.9 * half, 3 if quick else ORBITS, 5)
    own = {"delta": delta[: len(few)]}
    orbits = err.track(few, turns=turns, delta=own["delta"])[-1, 0]
    pairs = gfnn.Pairs(z[:count], image[:count], 1.0, {"delta": delta[:count]})
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", gfnn.FitWarning)
        fit, _, seconds = once(lambda: gfnn.fit(
            pairs, learn="map", family="polynomial", tolerance=1e-2 if quick else 3e-6,
            max_seconds=None, seed=SEED,
        ))  # fmt: skip
    map_, spread, first = fit.map, z.std(axis=0), slice(0, min(BATCH, count))
    ours, info = map_.step(z[count:], {"delta": delta[count:]})
    one = (np.asarray(ours) - image[count:]) / spread
    last, _ = map_.rollout(few, num_steps=turns, save_every=turns, params=own)
    far = (np.asarray(last)[:, -1] - orbits) / spread
    row = {
        "amplitude": amplitude, "label": fit.chosen.label, "terms": fit.chosen.num_parameters,
        "one_turn": float(np.sqrt(np.mean(one**2))),
        "one_turn_median": float(np.median(np.sqrt(np.mean(one**2, axis=1)))),
        "after_turns": float(np.sqrt(np.nanmedian(np.mean(far**2, axis=1)))),
        "lost": int(np.isnan(far).any(axis=1).sum()),
        "failed": int(np.sum(np.asarray(info.status) > 1)),
        "defect": float(np.max(np.asarray(map_.defect(few, own)))), "fit_seconds": seconds,
        "microseconds_per_turn": of_a_turn(map_, z[first], 20, {"delta": delta[first]}),
    }  # fmt: skip
    grid = np.linspace(-DEVIATION, DEVIATION, 3 if quick else 9)
    start, turns = np.zeros((len(grid), 4)), 64 if quick else 512
    start[:, :2] = 1e-4
    tracked = np.concatenate([start[None], err.track(start, turns=turns, delta=grid)[:, 0]])
    states, _ = map_.rollout(start, num_steps=turns, params={"delta": grid})
    theirs, ours = (
        tunes_of(err, a) for a in (tracked, np.asarray(states).transpose(1, 0, 2))
    )  # fmt: skip
    return {
        "rows": [row], "num_pairs": count, "turns": TURNS, "delta": grid.tolist(),
        "tracked": theirs.tolist(), "learned": ours.tolist(),
        "largest_tune_difference": float(np.abs(ours - theirs).max()),
    }  # fmt: skip


def tunes_of(machine: Ring, states) -> np.ndarray:
    """(N, 2) of orbits (turns, N, 4), about their own means: δ moves the closed orbit."""
    signals = machine.normalised(states - states.mean(axis=0))
    return np.array([[tune(signals[:, i, k]) for k in (0, 1)] for i in range(states.shape[1])])


# A frequency map, and Poincaré sections


def frequencies(quick: bool) -> Numbers:
    """Compare frequency maps and sections of one cell, by map and by tracking code.

    A frequency map is the change of the tunes from the first half of an orbit to the second, over
    the plane of amplitudes. The sections are of orbits in the mid-plane.
    """
    cell = ring("hmba.mat")
    half = cell.half_axes(1.2 * REGION[0], 1.2 * REGION[1])
    z = ellipsoid(half, 800 if quick else NUM_PAIRS, 0)
    map_, (fit,) = learned([z, cell.track(z)[0, 0]], 1e-3 if quick else 1e-6)
    side, turns = (3, 64) if quick else (24, 512)
    x, y = np.meshgrid(*(np.linspace(0.04, 1, side) * size for size in REGION))
    start = np.zeros((side * side, 4))
    start[:, 0], start[:, 1] = x.ravel(), y.ravel()
    orbits = np.linspace(0.1, 0.95, 3 if quick else 8) * REGION[0]
    start = np.concatenate([start, np.stack([orbits, *3 * [0 * orbits]], axis=1)])

    def diffusion(states) -> np.ndarray:
        kept = np.flatnonzero(np.isfinite(states).all(axis=(0, 2)))
        kept = kept[kept < side * side]
        parts = states[:turns, kept], states[turns : 2 * turns, kept]
        first, second = (tunes_of(cell, part) for part in parts)
        found = np.full(side * side, np.nan)
        found[kept] = np.log10(np.linalg.norm(first - second, axis=1) + 1e-16)
        return found

    tracked = np.concatenate([start[None], cell.track(start, turns=2 * turns)[:, 0]])
    states, _ = map_.rollout(start, num_steps=2 * turns)
    states = np.asarray(states).transpose(1, 0, 2)
    theirs, ours = diffusion(tracked), diffusion(states)
    both = np.isfinite(theirs) & np.isfinite(ours)
    sections = {
        name: np.round(1e6 * found[: 20 if quick else 300, side * side :][..., [0, 2]], 2)
        for name, found in (("tracking", tracked), ("map", states))
    }  # fmt: skip
    return {
        "label": fit.chosen.label, "one_turn": fit.chosen.validation_relative, "side": side,
        "turns": turns, "tracking": _listed(theirs), "map": _listed(ours),
        "median_difference": float(np.median(np.abs(theirs - ours)[both])),
        "kept_by_one_only": int(np.sum(np.isfinite(theirs) != np.isfinite(ours))),
        "sections_micro": {name: found.tolist() for name, found in sections.items()},
    }  # fmt: skip


def _listed(found: np.ndarray) -> list[float | None]:
    return [None if np.isnan(value) else round(float(value), 3) for value in found]


# A million turns


def long(quick: bool) -> Numbers:
    """Fifty particles over a million turns: what becomes of their action."""
    err = ring("err.mat")
    half = err.half_axes(AMPLITUDE, AMPLITUDE)
    z = ellipsoid(half, 600 if quick else NUM_PAIRS, 0)
    map_, _ = learned([z, err.track(z)[0, 0]], 1e-5)
    turns, every, particles = (1_000, 10, 5) if quick else (1_000_000, 97, 50)
    start = ellipsoid(0.6 * half, particles, 3)
    (states, info), seconds, _ = once(
        lambda: map_.rollout(start, num_steps=turns, save_every=every)
    )
    states = np.asarray(states)
    action = np.sum(np.abs(err.normalised(states)) ** 2, axis=-1) / 2  # (B, saved)
    block = 5 if quick else 50
    count = action.shape[1] // block
    means = action[:, : block * count].reshape(len(action), count, block).mean(axis=2)
    change = np.abs(means / means[:, :1] - 1)[:, 1:]
    size, step = np.median(change, axis=0), every * block * np.arange(1, count)
    exponent = float(np.polyfit(np.log(step), np.log(size), 1)[0])
    return {
        "turns": turns, "particles": particles, "seconds": seconds,
        "status": np.bincount(np.asarray(info.status), minlength=5).tolist(),
        "drift_exponent": exponent, "change_at_the_end": float(size[-count // 10 :].mean()),
        "oscillation": float(np.median(action.std(axis=1) / action.mean(axis=1))),
    }  # fmt: skip


# The dynamic aperture


def aperture(quick: bool) -> Numbers:
    """Compare the dynamic aperture of one cell, by map and by tracking code.

    It is the amplitude at which orbits get lost within 1,000 passages, along nine rays, by a scan
    in steps of 0.1 mm.
    """
    cell = ring("hmba.mat")
    half, turns = cell.half_axes(14e-3, 9e-3), 100 if quick else 1_000
    z = ellipsoid(half, 800 if quick else NUM_PAIRS, 0)
    map_, (fit,) = learned([z, cell.track(z)[0, 0]], 1e-5)
    angles = np.linspace(0, np.pi, 3 if quick else 9)
    radii = np.arange(4e-3, 14e-3, 1e-3 if quick else 1e-4)
    start = np.zeros((len(angles), len(radii), 4))
    start[..., 0] = radii * np.cos(angles)[:, None]
    start[..., 1] = radii * np.sin(angles)[:, None]
    flat = start.reshape(-1, 4)
    tracked, theirs, _ = once(lambda: cell.track(flat, turns=turns)[-1, 0])

    def run():
        return map_.rollout(flat, num_steps=turns, save_every=turns)[1]

    info = timed(run, 1)
    # A particle is lost where the domain of the data ends: the map knows nothing beyond.
    lost = np.asarray(info.out.left_at) >= 0
    lost |= np.asarray(info.out.status) > 1

    def border(gone) -> np.ndarray:
        gone = gone.reshape(start.shape[:2])
        return np.where(gone.any(axis=1), radii[np.argmax(gone, axis=1)], np.nan)

    of_map, of_tracking = border(lost), border(np.isnan(tracked).any(axis=1))
    return {
        "angles": angles.tolist(), "map": of_map.tolist(), "tracking": of_tracking.tolist(),
        "turns": turns,
        "largest_difference": float(np.max(np.abs(of_map / of_tracking - 1))),
        "label": fit.chosen.label, "one_turn": fit.chosen.validation_relative,
        "seconds": info.seconds, "tracking_seconds": theirs,
    }  # fmt: skip


PIECES = {
    "turn": turn, "tunes": tunes, "long": long, "aperture": aperture, "deviation": deviation,
    "small-deviation": small_deviation, "frequencies": frequencies,
}  # fmt: skip


def tables() -> None:
    """The tables of RESULTS.md and the figures."""
    from ring_figures import maps_of_frequencies, tunes_and_aperture

    found = results(PIECES, "ring")
    text = []
    if "turn" in found:
        m = found["turn"]["measured"]
        tracking = m["tracking_microseconds_per_turn"]
        rows = [
            [
                row["map"], row["label"], number(row["one_turn"]), number(row["after_turns"]),
                str(row["lost"]), number(row.get("defect")), number(row.get("fit_seconds")),
                number(row.get("microseconds_per_turn")),
                number(tracking / row["microseconds_per_turn"])
                if "microseconds_per_turn" in row else "–",
            ]
            for row in m["rows"]
        ]  # fmt: skip
        heads = (
            "`err.mat`, one turn", "largest", "one turn ÷ spread", f"after {m['turns']} turns",
            "lost", "defect", "fit, all in, CPU s", "CPU µs a turn", "times faster than tracking",
        )  # fmt: skip
        text.append(markdown(heads, rows))
    if "deviation" in found:
        m = found["deviation"]["measured"]
        rows = [
            [
                f"{1e3 * row['amplitude']:g} mm", row["label"], f"{row['terms']:,}",
                number(row["one_turn"]), number(row["one_turn_median"]),
                number(row["after_turns"]), str(row["lost"]), number(row["defect"]),
                number(row["fit_seconds"]), number(row["microseconds_per_turn"]),
            ]
            for name in ("deviation", "small-deviation") if name in found
            for row in found[name]["measured"]["rows"]
        ]  # fmt: skip
        heads = (
            f"`err.mat`, δ in ±1 %, {m['num_pairs']:,} pairs, within", "one piece", "terms",
            "one turn ÷ spread", "median", f"after {m['turns']} turns", "lost", "defect",
            "fit, all in, CPU s", "CPU µs a turn",
        )  # fmt: skip
        text.append(markdown(heads, rows))
    heads, rows = ("what", "measured", "asked"), []
    if "tunes" in found:
        difference = found["tunes"]["measured"]["largest_difference"]
        told = ", ".join(f"{name} {number(value)}" for name, value in difference.items())
        rows.append(["tunes of 18 orbits up to 1.8 mm, largest difference", told, "1e-6"])
    if "deviation" in found:
        difference = found["deviation"]["measured"]["largest_tune_difference"]
        rows.append(["tunes against δ in ±1 %, largest difference", number(difference), "1e-6"])
    if "frequencies" in found:
        m = found["frequencies"]["measured"]
        rows.append([
            f"frequency map of `hmba.mat`, {m['side']}² orbits of {2 * m['turns']:,} passages "
            f"({m['label']}, one turn {number(m['one_turn'])}): median difference of log₁₀ of the "
            "tunes' change", f"{number(m['median_difference'])} ({m['kept_by_one_only']} orbits "
            "lost by one of the two only)", "–",
        ])  # fmt: skip
    if "long" in found:
        m = found["long"]["measured"]
        rows.append([
            f"{m['particles']} particles, {m['turns']:,} turns: drift exponent of the mean action",
            f"{number(m['drift_exponent'])} (change {number(m['change_at_the_end'])} of itself; "
            f"{m['status'][0]} stayed in the domain; {number(m['seconds'])} s)", "0.6",
        ])  # fmt: skip
    if "aperture" in found:
        m = found["aperture"]["measured"]
        rows.append([
            f"dynamic aperture of `hmba.mat`, {m['turns']:,} passages, nine rays: largest "
            "difference",
            f"{100 * m['largest_difference']:.1f} % ({number(m['seconds'])} s; tracking "
            f"{number(m['tracking_seconds'])} s)", "5 %",
        ])  # fmt: skip
    if rows:
        text.append(markdown(heads, rows))
    if text:
        between_markers(TABLES, "ring", "\n\n".join([*text, provenance(found)]))
    if {"tunes", "aperture"} <= set(found):
        tunes_and_aperture(found["tunes"]["measured"], found["aperture"]["measured"])
    if {"deviation", "frequencies"} <= set(found):
        maps_of_frequencies(
            found["deviation"]["measured"], found["frequencies"]["measured"], REGION
        )


if __name__ == "__main__":
    main(__doc__ or "", PIECES, "ring", tables, None, ("aperture",))
