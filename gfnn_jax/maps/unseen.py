"""Starts of a coordinate that no sensor shows as it is: from its velocity, from times of events, or
from a channel that oscillates with it, as an accelerometer does."""

import dataclasses
from collections.abc import Sequence
from itertools import product

import numpy as np

from gfnn_jax.errors import FitError
from gfnn_jax.signals.oscillations import Oscillations
from gfnn_jax.signals.splines import FEWEST, splines


class Options:
    """Limits of these starts (benchmarks/any_record.py, gyroscopes, accelerometers and gates).

    extreme: of the largest speed, that an extreme of the velocity has at least. same_period: of the
    squares of periods: a decay that leaves more is none. missed: of a period: a crossing lies
    between two of one gate that are farther apart.
    """

    extreme: float = 0.25
    same_period: float = 0.8
    missed: float = 0.95


@dataclasses.dataclass(frozen=True)
class Swing:
    """A coordinate that swings as one ``channel`` does, whose oscillation has the angular frequency
    ``omega``; or half as fast where it is ``even``, with the root of its size, since the channel
    then shows squares of the coordinate, those of its velocity if ``turned``.

    size: factor. angle: it swings as a pendulum does, θ = a cos φ − a³/192 cos 3φ and φ̇ = ω₀ (1 −
    a²/16). The sign of an even one is open.
    """

    channel: int
    omega: float
    even: bool
    turned: bool
    angle: bool
    size: float = 1.0

    @property
    def _oscillations(self) -> Oscillations:
        return Oscillations(self.omega * np.arange(3))  # a mean that changes, and a harmonic

    @property
    def seconds(self) -> float:
        """Length of the shortest record that tells a state."""
        return self._oscillations.seconds

    @property
    def own_omega(self) -> float:
        """Angular frequency of the coordinate."""
        return self.omega / (1 + self.even)

    def along(self, t: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Oscillation (n,), complex, at times t (n,) of channels y (n, k), of factor 1."""
        parts, rates = self._oscillations.parts(t, y[:, self.channel])
        z = parts[:, 1] - 1j * rates[:, 1] / self.omega
        if self.even:
            z = np.sqrt(np.abs(z)) * np.exp(0.5j * np.unwrap(np.angle(z)))
        return z * (1j if self.turned else 1)

    def states(self, z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """States (n, 2) and accelerations (n, 1) of an oscillation (n,)."""
        z = self.size * z
        square = self.angle * np.abs(z) ** 2
        omega = self.own_omega * (1 + (square.mean() - square) / 16)
        third = -self.angle / 192 * z**3
        by_rate = [(1j * omega) ** k * (z + 3**k * third) for k in range(3)]
        q, v, a = np.real(np.stack(by_rate))
        return np.stack([q, v], axis=1), a[:, None]


def between_extremes(t: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, float]:
    """The integral (n,) of a velocity v (n,), NaN where it was not read, less a straight line
    through its values at the extremes of v, and the slope of that line."""
    known = np.isfinite(v)
    if known.sum() < FEWEST:
        return np.full(len(t), np.nan), 0.0
    curve = splines([(t, v[:, None])]).curve(t, v)
    q = curve.antiderivative()(t)
    speed, rate = np.abs(curve(t)), curve(t, nu=1)
    at = np.flatnonzero((rate[1:] * rate[:-1] < 0) & (speed[1:] > Options.extreme * speed.max()))
    if len(at) < 3:
        return np.where(known, q - np.mean(q), np.nan), 0.0
    line = np.polyfit(t[at], q[at], 1)
    return np.where(known, q - np.polyval(line, t), np.nan), float(line[0])


def swung(t: np.ndarray, seen: np.ndarray, turns: bool) -> np.ndarray:
    """Swings (n,) that gates see cross their place at the times t (n,) where ``seen`` (n, k) is no
    NaN, positive at the first turn. They are as large as a pendulum's whose period T (1 + A²/16)
    dies down as these do. NaN before the first event and behind the last.

    Raises FitError where the periods of what ``turns`` are all the same, which any amplitude has.
    """
    at, count = _turns([t[np.isfinite(column)] for column in seen.T])
    if len(at) < FEWEST:
        return np.full(len(t), np.nan)
    period = (at[2:] - at[:-2]) / (count[2:] - count[:-2])
    best, size, square, life = np.inf, 1.0, np.exp, np.inf
    # By linear and by quadratic friction, of minus times in units of their lives.
    squares = np.exp, lambda time: 1 / (1 - time) ** 2
    for of, tried in product(squares, count[-1] * np.geomspace(0.03, 3.0, 30)):
        rows = np.stack([np.ones(len(period)), of(-count[1:-1] / tried)], axis=1)
        (least, more), *_ = np.linalg.lstsq(rows, period, rcond=None)
        left = np.sum((rows @ [least, more] - period) ** 2)
        if left < best and 0 < more < least / 2:
            best, size, square, life = left, np.sqrt(16 * more / least), of, tried
    if turns and not best < Options.same_period * np.sum((period - np.mean(period)) ** 2):
        raise FitError(
            "the times between events show no change of the period, so that they do not tell how "
            "large the swings are, nor the law: record swings that die down, or the angle too",
            verdict="no law: times of events without a change of the period tell no amplitude",
        )
    first, last = at[0] - period[0] / 2, at[-1] + period[-1] / 2
    place = np.interp(t, [first, *at, last], [-0.5, *count, count[-1] + 0.5])
    place[(t < first) | (t > last)] = np.nan
    return size * np.sqrt(square(-np.maximum(place, 0) / life)) * np.cos(np.pi * place)


def _turns(gates: Sequence[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Times at which a motion turns that crosses gates at these times, and the number of turns
    before each: two crossings of one gate, less than a period apart, have a turn in their middle.
    None where a gate sees too few."""
    periods = np.concatenate([g[2:] - g[:-2] for g in gates])
    if not len(periods):
        return np.zeros(0), np.zeros(0)
    period = float(np.median(periods))
    near = [g[:-1][np.diff(g) < Options.missed * period] for g in gates]
    far = [g[1:][np.diff(g) < Options.missed * period] for g in gates]
    middles = np.sort((np.concatenate(near) + np.concatenate(far)) / 2)
    count = np.cumsum(np.round(2 * np.diff(middles, prepend=middles[:1]) / period))
    numbers, which = np.unique(count, return_inverse=True)
    return np.bincount(which, middles) / np.bincount(which), numbers
