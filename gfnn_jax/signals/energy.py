"""Loss of energy, by a balance over stretches of the motion.

What is stored, E = Σ θ_j e_j(q, v), falls by what friction takes and rises by what inputs u give:

    E(t₂) − E(t₁) = −Σ ρ_i ∫ |v_i|^n dt + Σ g_ik ∫ v_i u_k dt,     n = 1 dry, 2 linear, 3 quadratic.

Over many stretches [t₁, t₂] this is linear in θ, ρ and g; the coefficient of ½v₁² is one. The
functions e_j are those of small mechanical systems: v_i v_j times 1 and modes of angles, modes of
angles, their sums and differences, or polynomials of lengths. No acceleration is needed, and no law
has been fitted: θ is a means to the loss.
"""

import dataclasses
import itertools
from collections.abc import Sequence

import numpy as np

from gfnn_jax.signals.local_polynomials import LocalFits

POWERS = {"dry": 1, "linear": 2, "quadratic": 3}


class _Options:
    """Limits, chosen on motions of test systems with known friction (tests of signals)."""

    stretches: tuple[float, ...] = (0.25, 0.6, 1.0, 2.0)  # lengths in periods
    blocks: int = 12  # of stretches, whose scatter tells errors
    clearly: float = 3.0  # standard errors, by which one kind of friction leaves less than others
    balanced: float = 0.9  # of the changes of ½v₁², that the balance explains
    ridge: float = 1e-9
    significant: tuple[float, float] = (3.0, 1e-4)  # standard errors of a loss, and its least size


@dataclasses.dataclass(frozen=True)
class Loss:
    """per_period: part of the energy, twice the mean kinetic one, that is lost in one period, with
    its standard error; negative where it grows. kind: "linear", "dry" or "quadratic" friction, or
    None where these leave equally much."""

    per_period: float
    error: float
    kind: str | None

    @property
    def significant(self) -> bool:
        """Return whether there is a loss, or a gain: more than three standard errors, and than
        1e-4."""
        errors, least = _Options.significant
        return abs(self.per_period) > max(errors * self.error, least)


def mean_period(fits: LocalFits, runs: int) -> float | None:
    """2π √(⟨v²⟩ / ⟨v̇²⟩) in s, the mean over the columns' squares in units of their spread; None
    where it is longer than the median duration of the runs, which do not show it then."""
    v, a = fits.slopes, fits.curvatures
    scale = np.nanmean(v**2, axis=1, keepdims=True)
    squares = np.nanmean(a**2 / np.where(scale > 0, scale, 1))
    spans = [np.ptp(fits.centres[fits.run == r]) for r in range(runs) if np.any(fits.run == r)]
    period = 2 * np.pi / np.sqrt(squares) if squares > 0 else np.inf
    return float(period) if period <= np.median(spans) else None


def loss(fits: LocalFits, angles: Sequence[bool], inputs: np.ndarray, period: float) -> Loss | None:
    """The loss of a motion, given by local fits of its positions; None where no balance holds.

    angles: of each position whether it has period 2π. inputs: (k, W) at the fits' centres.
    """
    stored = _stored(fits, angles)
    speeds = np.abs(fits.slopes)
    supplied = [v * u for v in fits.slopes for u in inputs]
    rates = np.stack([*speeds, *speeds**2, *speeds**3, *supplied])
    changes, taken = _over_stretches(fits, stored, rates, period)
    dim = len(speeds)
    if len(changes) < 4 * (stored.shape[0] + dim + len(supplied)) or np.ptp(changes[:, 0]) == 0:
        return None
    found = {}
    for place, kind in enumerate(POWERS):
        of_kind = slice(place * dim, (place + 1) * dim)
        table = np.concatenate([changes[:, 1:], taken[:, of_kind], taken[:, 3 * dim :]], axis=1)
        found[kind] = _Balance(table, -changes[:, 0])
    linear = found["linear"]
    if linear.explained < _Options.balanced:
        return None
    power = np.nanmean(speeds**2, axis=1)
    both = sum(angles[i] and angles[j] for i, j in itertools.combinations(range(dim), 2))
    kinetic = np.nanmean(stored[: dim + dim * (dim - 1) // 2 + 5 * both], axis=1)

    def per_period(c: np.ndarray) -> float:
        friction = c[len(stored) - 1 : len(stored) - 1 + dim]
        twice_kinetic = 2 * (kinetic[0] + c[: len(kinetic) - 1] @ kinetic[1:])
        return float(friction @ power * period / twice_kinetic)

    value, error = linear.with_error(per_period)
    return Loss(value, error, _kind(found))


class _Balance:
    """A linear regression whose parts are kept by blocks of rows."""

    def __init__(self, table: np.ndarray, target: np.ndarray):
        scale = np.linalg.norm(table, axis=0)
        self.scale = np.where(scale > 0, scale, 1.0)
        blocks = np.array_split(np.arange(len(target)), _Options.blocks)
        parts = [(table[rows] / self.scale, target[rows]) for rows in blocks]
        self.normals = np.stack([a.T @ a for a, _ in parts])
        self.sides = np.stack([a.T @ b for a, b in parts])
        c = self._solved(self.normals.sum(0), self.sides.sum(0)) * self.scale
        self.squares = np.array([np.sum((b - a @ c) ** 2) for a, b in parts])
        self.explained = 1 - self.squares.sum() / np.sum(target**2)

    def _solved(self, normal: np.ndarray, side: np.ndarray) -> np.ndarray:
        ridge = _Options.ridge * np.eye(len(normal))
        return np.linalg.lstsq(normal + ridge, side, rcond=None)[0] / self.scale

    def with_error(self, quantity) -> tuple[float, float]:
        """A function of the coefficients, and its standard error by leaving blocks out."""
        normal, side = self.normals.sum(0), self.sides.sum(0)
        left = [(normal - n, side - s) for n, s in zip(self.normals, self.sides, strict=True)]
        without = np.array([quantity(self._solved(*one)) for one in left])
        spread = np.sum((without - without.mean()) ** 2)
        error = float(np.sqrt((_Options.blocks - 1) / _Options.blocks * spread))
        return quantity(self._solved(normal, side)), error


def _kind(found: dict[str, _Balance]) -> str | None:
    """The friction that leaves less than each other one, block by block."""
    best = min(found, key=lambda kind: found[kind].squares.sum())
    for kind, balance in found.items():
        more = np.log(np.maximum(balance.squares, 1e-300) / np.maximum(found[best].squares, 1e-300))
        if kind != best and more.mean() < _Options.clearly * more.std() / np.sqrt(len(more)):
            return None
    return best


def _stored(fits: LocalFits, angles: Sequence[bool]) -> np.ndarray:
    """The functions e_j at the centres (J, W), those that hold speeds first, first v₁²/2."""
    v = fits.slopes
    middle = np.nanmean(fits.values, axis=1, keepdims=True)
    spread = np.nanstd(fits.values, axis=1, keepdims=True)
    q = np.where(np.array(angles)[:, None], fits.values, (fits.values - middle) / spread)
    kinetic, potential = [0.5 * x**2 for x in v], []
    dim = len(v)
    for i in range(dim):
        if angles[i]:
            modes = (1, 2) if dim == 1 else (1,)
            potential += [f(m * q[i]) for m in modes for f in (np.cos, np.sin)]
        else:
            potential += [q[i] ** n for n in (1, 2, 3, 4)]
    for i, j in itertools.combinations(range(dim), 2):
        kinetic.append(v[i] * v[j])
        if angles[i] and angles[j]:
            kinetic += [v[i] * v[j] * np.cos(x) for x in (q[i] - q[j], q[i], q[j])]
            kinetic += [v[i] ** 2 * np.cos(q[j]), v[j] ** 2 * np.cos(q[i])]
            potential += [f(x) for x in (q[i] - q[j], q[i] + q[j]) for f in (np.cos, np.sin)]
        else:
            potential.append(q[i] * q[j])
    return np.stack([*kinetic, *potential])


def _over_stretches(
    fits: LocalFits, stored: np.ndarray, rates: np.ndarray, period: float
) -> tuple[np.ndarray, np.ndarray]:
    """(changes (M, J) of what is stored, integrals (M, K) of rates) over stretches of the runs, in
    order of time, those of n periods divided by √n."""
    changes, integrals, order = [], [], []
    for run in np.unique(fits.run):
        rows = np.flatnonzero(fits.run == run)
        t = fits.centres[rows]
        middle = 0.5 * (rates[:, rows[1:]] + rates[:, rows[:-1]]) * np.diff(t)
        total = np.concatenate([np.zeros((len(rates), 1)), np.cumsum(middle, axis=1)], axis=1)
        for part in _Options.stretches:
            end = np.searchsorted(t, t + part * period)
            begin = np.flatnonzero(end < len(t))
            end = end[begin]
            weight = 1 / np.sqrt(part)
            changes.append(weight * (stored[:, rows[end]] - stored[:, rows[begin]]).T)
            integrals.append(weight * (total[:, end] - total[:, begin]).T)
            order.append(rows[begin])
    change, integral = np.concatenate(changes), np.concatenate(integrals)
    known = np.isfinite(change).all(axis=1) & np.isfinite(integral).all(axis=1)
    placed = np.argsort(np.concatenate(order)[known], kind="stable")
    return change[known][placed], integral[known][placed]
