"""Nature of a record whose law was not found, where it is certain; else what was found of it.

Each is a property of the record and of no library of terms, and is named where the nearest other
one is ruled out:

- *Steps*: most neighbouring samples are equal: the column is held, or rounded.
- *Chance*: mean squares of differences over a time τ grow as τ² where there is a velocity, as τ in
  a random walk, as τ^(2/3) in turbulence, and not at all in white noise.
- *First order*: the velocities are functions of the positions.
- *Impacts*: peaks of second differences as narrow as a few samples hold most of their squares.
- *Self-excited*: polynomials of positions and velocities explain the accelerations, neither memory
  nor a state that was not recorded does more, forces that the same motion backwards would have
  leave much more, and friction is negative at rest in the middle.
- *Memory*: forces that yield before they slip (Dahl, Trans. ASME 90 (1968) 158) leave much less of
  the accelerations than these polynomials with dry friction, and than the same with as many of the
  past positions, as of a hidden coordinate.
- *Unrecorded*: states that nearly coincide have accelerations that differ. What the nearest states
  differ by is extrapolated to none between them (Stefánsson, Končar & Jones, Neural Comput. Appl. 5
  (1997) 131).

Shares are of squares that a polynomial explains in quarters of the record it was not fitted to.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from gfnn_jax.arrays import products
from gfnn_jax.dataset.stretches import Scales, Stretch
from gfnn_jax.signals.local_polynomials import smooth
from gfnn_jax.signals.splines import Splines
from gfnn_jax.solve.linear import non_negative


class Options:
    """Limits (`benchmarks/any_record.py`, outside).

    still: share of equal neighbours, of steps. rough: power of time by which differences grow,
    below which there is no velocity. early: of the variance, up to which they are looked at. lags:
    samples, at most. first: share of the velocities that positions explain. mostly: share of the
    accelerations, of a law that may be one in part. real: share of their squares that is no noise.
    most: share of the squares of second differences in narrow peaks, which fall to a quarter within
    ``width`` samples. closed: squares of the accelerations that are left, in those of noise; bias:
    the share that these are at least, by the curves' own bias; told: of what is no noise, that is
    explained then.
    excited: negative friction, in ω. turns: passages through the mean of what oscillates; lasts:
    ratio of its spreads, later and before, of what sustains itself. memory: share that it
    explains; gains, beats: of what polynomials and past positions leave, that they leave;
    backwards: of what forces leave that are the same backwards, that self-excited motion does.
    near: rms distance of states, in standard deviations, from which that to none is extrapolated;
    differ: share that they determine, below which more acts. degree: of polynomials. samples: that
    are looked at. slips: ways, in amplitudes, and as many past positions within a period. blocks:
    of ``parts`` of the record.
    """

    still: float = 0.5
    rough: float = 1.5
    early: float = 0.3
    lags: int = 40
    first: float = 0.95
    mostly: float = 0.9
    real: float = 0.5
    most: float = 0.7
    width: int = 5
    closed: float = 5.0
    told: float = 0.5
    bias: float = 1e-4
    excited: float = 0.1
    turns: int = 4
    lasts: float = 0.8
    memory: float = 0.9
    gains: float = 0.5
    beats: float = 0.75
    backwards: float = 0.2
    near: float = 0.2
    differ: float = 0.95
    degree: int = 3
    samples: int = 4_000
    slips: tuple[float, ...] = (0.03, 0.06, 0.1, 0.15, 0.22, 0.3, 0.45, 0.6)
    blocks: int = 4
    parts: int = 32


NO_COLUMN = "a coordinate that no column shows"


class Nature(NamedTuple):
    """Nature of a record: kind of the verdict, and the reason; whether a law of the terms tried may
    follow part of it all the same; and whether what was recorded tells most of the accelerations,
    but not all."""

    kind: str
    reason: str
    partly: bool = True
    mostly: bool = False

    @property
    def verdict(self) -> str:
        return f"{self.kind}: {self.reason}"


def nature(
    found: Sequence[Stretch],
    scales: Scales,
    angles: Sequence[int],
    runs: Sequence[np.ndarray] = (),
    field: str = "",
) -> Nature:
    """Tell what the record of these stretches is, whose law was not found. runs: channels (n, k) of
    whole runs, also where a body would be at rest; by default those of the stretches. field:
    equations of first order that follow it to its noise, "" where none were found."""
    still = np.mean(np.concatenate([np.diff(s.y, axis=0) == 0 for s in found]), axis=0).min()
    if still > Options.still:
        return Nature(
            "no law",
            f"steps: {100 * still:.0f} % of the samples are equal to the one before, as of a "
            "column that is held or rounded, and show no velocity. Record it finer",
            partly=False,
        )
    runs = runs or [s.y for s in found]
    exponent = max(_power([y[:, k] for y in runs]) for k in range(runs[0].shape[1]))
    if exponent < Options.rough:
        grows = f"as time to the power of {exponent:.2g}" if exponent > 0 else "by no more"
        return Nature(
            "not mechanical",
            f"chance: differences of neighbouring samples grow {grows}, so that there is no "
            "velocity; noise or a random walk",
            partly=False,
        )
    q, v, a, u, block = _states(found, scales)
    real = _reliability(a, scales)
    if real < Options.real:
        return Nature("no law", "noise hides what its accelerations depend on")
    first = _best(_variables(q, angles), v, block)
    state = np.concatenate([_variables(q, angles), v / v.std(axis=0), u], axis=1)
    plain, alone = _best(state, a, block), q.shape[1] == 1  # one would not come back
    if field or (not alone and first > max(Options.first, plain)):
        return Nature(
            "not mechanical",
            f"first order, or one orbit: positions determine {100 * first:.1f} % of the "
            "velocities, as of populations or concentrations"
            + (f": {field} to the noise" if field else ""),
            partly=False,
        )
    jumps, when = _jumps(found)
    if jumps > Options.most:
        return Nature(
            "no law",
            f"impacts: {100 * jumps:.0f} % of the squares of the accelerations are in peaks of a "
            f"few samples, velocities jump, as at {when:.4g} s. Cut them off (--from, --to), or "
            "record them finer where they are close passages",
        )
    rate = _rate_at_rest(state, a / v.std(axis=0), state.shape[1] - v.shape[1] - u.shape[1])
    excited = plain > Options.mostly and rate > Options.excited * scales.omega and _lasts(found)
    slow, fast = np.quantile(v, (Options.early, 1 - Options.early), axis=0)
    excited &= bool(np.all((slow < 0) & (fast > 0)))  # else what it does at rest is not known
    if excited:
        places = np.concatenate([_variables(q, angles), u], axis=1)
        excited = 1 - plain < Options.backwards * (1 - _reversible(places, v, a, block))
    self_excited = Nature(
        "not mechanical",
        "self-excited: friction is negative where motion is slow, or small, "
        f"{rate:.2g} 1/s, and feeds the energy that faster or larger motion loses",
    )
    closed = 1 - plain < Options.closed * max(1 - real, Options.bias)
    if closed and plain > Options.told * real:  # of much noise any share would be close to it
        if excited:
            return self_excited
        return Nature(
            "no law",
            f"positions and velocities explain the accelerations to the noise, {100 * plain:.2f} "
            "%, by a force that the terms tried lack: give terms that you know (--terms)",
        )
    period = scales.period * len(q) / sum(float(np.ptp(s.t)) for s in found)
    dry = np.concatenate([np.sign(v), *(_shifted(u, k) for k in (-2, -1, 1, 2))], axis=1)
    rubbed = max(plain, _best(state, a, block, dry))
    memory, past = (
        max(rubbed, *(_best(state, a, block, np.hstack([dry, own[:, ::k]])) for k in (1, 2, 4, 8)))
        for own in (_slips(q), _past(q, period))
    )
    rivals = Options.gains * (1 - rubbed), Options.beats * (1 - past)
    if memory > Options.memory and 1 - memory < min(rivals):
        return Nature(
            "no law",
            "memory (hysteresis, or friction that yields before it slips), which no term has: "
            f"positions and velocities explain {100 * rubbed:.4g} % of the accelerations, with "
            f"past positions {100 * past:.4g} %, and with as many forces that slip "
            f"{100 * memory:.4g} %",
        )
    near, mostly = _of_near_states(state, a, period), plain > Options.mostly
    shares = (
        f"positions and velocities explain {100 * plain:.3g} % of the accelerations, with past "
        f"positions {100 * past:.3g} %"
    )
    if near < Options.differ:
        return Nature(
            "no law",
            f"unrecorded: states that nearly coincide have other accelerations: {shares}. An input "
            f"is missing (--inputs), or {NO_COLUMN}",
            mostly=mostly,
        )
    if excited:
        return self_excited
    return Nature(
        "no law",
        f"no certain cause: {shares}, and no states come so close that they tell more. A force of "
        f"another shape (--terms), an input (--inputs) or {NO_COLUMN} may be missing",
        mostly=mostly,
    )


def told_by_positions(q: np.ndarray, v: np.ndarray, angles: Sequence[int]) -> bool:
    """Return whether positions q (n, d) in the order of time tell the velocities v (n, d), as of
    first order or along one orbit; of one coordinate they do not where it comes back."""
    return q.shape[1] > 1 and _best(_variables(q, angles), v, _blocks(len(q))) > Options.first


def _power(columns: Sequence[np.ndarray]) -> float:
    """The power of time by which mean squares of differences of a column grow beyond the noise; 2
    where samples are too far apart to tell it."""
    longest = min(Options.lags, max(map(len, columns)) // 4)
    if longest < 4:
        return 2.0
    apart = [np.concatenate([c[n:] - c[:-n] for c in columns]) for n in range(1, longest + 1)]
    told = [n for n, one in enumerate(apart) if np.isfinite(one).any()]
    if len(told) < 4:
        return 2.0
    squares = np.array([np.nanmean(apart[n] ** 2) for n in told])
    whole = 2 * float(np.nanvar(np.concatenate(columns)))
    count = sum(len(column) for column in columns)
    if np.all(np.abs(1 - squares / whole) < 5 / np.sqrt(count)):
        return 0.0  # white
    early = squares < Options.early * whole
    last = len(told) if early.all() else int(np.argmin(early))
    if last < 4:
        return 2.0
    lags, squares = 1.0 + np.array(told[:last]), squares[:last]
    powers, left = np.arange(0.1, 2.05, 0.05), []
    for power in powers:
        rows = np.stack([np.ones(last), lags**power], axis=1) / squares[:, None]
        left.append(np.sum((rows @ non_negative(rows, np.ones(last)) - 1) ** 2))
    return float(powers[int(np.argmin(left))])


def _states(
    found: Sequence[Stretch], scales: Scales
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """q, v, a, u (n, ·) at even samples of the stretches, and the block (n,) that each lies in."""
    every = max(1, sum(len(s.t) for s in found) // Options.samples)
    parts = []
    for s in found:
        at = np.arange(1, len(s.t) - 1, every)
        if isinstance(scales.half, Splines):
            q, v, a = scales.half.smooth(s.t, s.q, s.t[at])
        else:
            q, v, a = smooth(s.t, s.q, scales.of(s)[1], at)[0]
        known = np.isfinite(q).all(axis=1)
        parts.append((q[known], v[known], a[known], s.u[at][known]))
    q, v, a, u = (np.concatenate(part) for part in zip(*parts, strict=True))
    spread = u.std(axis=0)
    u = (u - u.mean(axis=0)) / np.where(spread > 0, spread, 1.0)
    return q, v, a, u, _blocks(len(q))


def _blocks(count: int) -> np.ndarray:
    """The block (count,) that each of samples in the order of time lies in."""
    return np.arange(count) * Options.parts // count % Options.blocks


def _reliability(a: np.ndarray, scales: Scales) -> float:
    """The share of the squares of accelerations (n, d) by local cubics that is no noise."""
    if isinstance(scales.half, Splines) or len(scales.sigma) != a.shape[1]:
        return 1.0
    noise = np.zeros(a.shape[1])
    for step, half in zip(scales.steps, scales.half, strict=True):
        x = np.linspace(-1.0, 1.0, 2 * half + 1)[:, None] ** np.arange(4)
        own = 4 * scales.sigma**2 * np.linalg.inv(x.T @ x)[2, 2] / (half * step) ** 4
        noise = np.maximum(noise, own)
    return float(np.min(1 - np.minimum(noise / np.var(a, axis=0), 1.0)))


def _variables(q: np.ndarray, angles: Sequence[int]) -> np.ndarray:
    """Positions of unit size; of angles sines and cosines."""
    lengths = [i for i in range(q.shape[1]) if i not in angles]
    turning = q[:, list(angles)]
    plain = (q[:, lengths] - q[:, lengths].mean(axis=0)) / q[:, lengths].std(axis=0)
    return np.concatenate([plain, np.sin(turning), np.cos(turning)], axis=1)


def _products(x: np.ndarray, degree: int) -> np.ndarray:
    """Products of columns x (n, k) up to a degree, of two for many columns."""
    return products(x, degree if x.shape[1] <= 6 else min(degree, 2))


def _best(
    x: np.ndarray, target: np.ndarray, block: np.ndarray, beside: np.ndarray | None = None
) -> float:
    """The largest share that polynomials of some degree in columns x (n, k) explain."""
    more = x[:, :0] if beside is None else beside
    shares = [
        _explained(np.concatenate([_products(x, degree), more], axis=1), target, block)
        for degree in range(1, Options.degree + 1)
    ]
    return max(0.0, *shares)


def _reversible(x: np.ndarray, v: np.ndarray, target: np.ndarray, block: np.ndarray) -> float:
    """The largest share that forces explain which are the same where motion goes backwards:
    polynomials in columns x (n, k), of twice the degree, times none or two of the speeds v
    (n, d)."""
    even = np.delete(_products(v / v.std(axis=0), 2), range(1, v.shape[1] + 1), axis=1)
    shares = [0.0]
    for degree in range(1, 2 * Options.degree + 1):
        rows = (_products(x, degree)[:, :, None] * even[:, None]).reshape(len(x), -1)
        if rows.shape[1] > len(x) / Options.blocks:
            break  # which would explain chance
        shares.append(_explained(rows, target, block))
    return max(shares)


def _explained(rows: np.ndarray, target: np.ndarray, block: np.ndarray) -> float:
    """The share of the squares of each target (n, d) that rows explain in blocks that they were not
    fitted to; of the target that they explain least."""
    left = np.zeros(target.shape[1])
    for k in np.unique(block):
        own = block == k
        c = np.linalg.lstsq(rows[~own], target[~own], rcond=1e-8)[0]
        left += np.sum((target[own] - rows[own] @ c) ** 2, axis=0)
    whole = np.sum((target - target.mean(axis=0)) ** 2, axis=0)
    return float(np.min(1 - left / np.maximum(whole, 1e-300)))


def _rate_at_rest(state: np.ndarray, a: np.ndarray, first: int) -> float:
    """The largest ∂a/∂v (1/s) of a coordinate at rest in the middle of the positions, of states
    whose speeds stand from place ``first`` on, in units of which a (n, d) is."""
    rows = _products(state, Options.degree)
    c = np.linalg.lstsq(rows, a, rcond=1e-8)[0]
    middle, rates = np.mean(state, axis=0), []
    for i in range(a.shape[1]):
        ends = np.tile(middle, (2, 1))
        ends[:, first : first + a.shape[1]] = 0.0
        ends[:, first + i] = [-0.05, 0.05]
        low, high = _products(ends, Options.degree) @ c[:, i]
        rates.append((high - low) / 0.1)
    return float(max(rates))


def _lasts(found: Sequence[Stretch]) -> bool:
    """Return whether a position oscillates in some stretch, later about as widely as before."""
    for s in found:
        x = s.q - np.nanmean(s.q, axis=0)
        early, late = np.array_split(x, 2)
        turns = np.sum(np.diff(np.sign(x), axis=0) != 0, axis=0) >= Options.turns
        if np.any(turns & (np.nanstd(late, axis=0) > Options.lasts * np.nanstd(early, axis=0))):
            return True
    return False


def _jumps(found: Sequence[Stretch]) -> tuple[float, float]:
    """The share of the squares of accelerations in narrow peaks, and when the largest is; of the
    column that has the largest share. Those of readings that are close count for less: their
    noise does."""
    best, width = (0.0, 0.0), Options.width
    for k in range(found[0].q.shape[1]):
        whole, times, peaks = 0.0, [], []
        read = [(s.t[seen], s.q[seen, k]) for s in found if sum(seen := np.isfinite(s.q[:, k])) > 2]
        usual = np.median(np.concatenate([np.diff(t) for t, _ in read])) if read else 0.0
        for t, q in read:
            steps = np.diff(t)
            near = np.minimum(np.minimum(steps[1:], steps[:-1]), usual)
            size = np.abs(np.diff(np.diff(q) / steps)) * near**2 / (steps[1:] + steps[:-1])
            beside = np.pad(size, width)
            beside = np.maximum(beside[: -2 * width], beside[2 * width :])
            whole += float(np.sum(size**2))
            peaks.append(np.where(beside < size / 4, size, 0.0) ** 2)
            times.append(t[1:-1])
        square = np.concatenate([[0.0], *peaks])
        share = float(np.sum(square)) / max(whole, 1e-300)
        best = max(best, (share, float(np.concatenate([[0.0], *times])[np.argmax(square)])))
    return best


def _of_near_states(x: np.ndarray, target: np.ndarray, period: float) -> float:
    """The share of the targets (n, d) that states x (n, k) determine, by their nearest neighbours
    at other times than within half a ``period`` of samples; 1 where none are near."""
    from scipy.spatial import cKDTree  # pyright: ignore[reportAttributeAccessIssue]

    x, place, order = x / x.std(axis=0), np.arange(len(x)), range(8)
    others = cKDTree(x).query(x, k=min(len(x), 60))[1]
    apart = np.abs(others - place[:, None]) > period / 2
    known = apart.sum(axis=1) >= len(order)
    nearest = np.argsort(~apart[known], axis=1, kind="stable")[:, : len(order)]
    others = np.take_along_axis(others[known], nearest, axis=1)
    if known.mean() < 0.5:
        return 1.0
    distance = np.sum((x[others] - x[known][:, None]) ** 2, axis=2).mean(axis=0)
    differ = 0.5 * np.mean((target[others] - target[known][:, None]) ** 2, axis=0)
    if distance[0] > Options.near**2:
        return 1.0
    rows = np.stack([np.ones(len(order)), distance], axis=1)
    at_none = np.linalg.lstsq(rows, differ, rcond=None)[0][0]
    return float(np.min(1 - np.maximum(at_none, 0.0) / target.var(axis=0)))


def _shifted(x: np.ndarray, by: int) -> np.ndarray:
    """Columns x (n, k), some samples later: accelerations are means over a few."""
    return x[np.clip(np.arange(len(x)) + by, 0, len(x) - 1)]


def _past(q: np.ndarray, period: float) -> np.ndarray:
    """Past positions (n, d w), as many within a ``period`` of samples as there are slips."""
    size, n = (q - q.mean(axis=0)) / q.std(axis=0), len(Options.slips)
    back = np.arange(len(q))[:, None] - np.round(np.arange(1, n + 1) * period / n).astype(int)
    return size[np.maximum(back, 0)].transpose(0, 2, 1).reshape(len(q), -1)


def _slips(q: np.ndarray) -> np.ndarray:
    """Forces (n, d w) of unit size that yield over some ways before they slip."""
    columns = []
    for x in ((q - q.mean(axis=0)) / np.abs(q - q.mean(axis=0)).max(axis=0)).T:
        steps = np.diff(x, prepend=x[0])
        for way in Options.slips:
            force, last = np.empty_like(x), 0.0
            kept, sides = np.exp(-np.abs(steps) / way).tolist(), np.sign(steps).tolist()
            for k, (keep, side) in enumerate(zip(kept, sides, strict=True)):
                force[k] = last = side + (last - side) * keep
            columns.append(force)
    return np.stack(columns, axis=1)
