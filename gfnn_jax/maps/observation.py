"""Observation of a state by sensors: channels g(q, v; c) with unknown parameters c.

    theta  =  theta + zero              an angle whose zero is unknown
    omega  =  k*omega                   a gyroscope of unknown scale
    px     =  x0 + R*sin(theta + tilt)  a camera with its pivot and its tilt
    gyro   =  omega + b                 a gyroscope alone: theta is seen by no sensor
    acc    =  l*theta_ddot + g*sin(theta)
    gate   =  crossing(theta)           a photogate: times at which theta is zero

A coordinate that no channel shows by positions alone is *unseen*: it starts as the integral of its
velocity, zero on a line through the extremes of that, where no force acts. The slope of the line is
what the sensor shows of a body at rest. Where no channel shows the velocity alone, it starts as the
swing, in step with the channel that oscillates most clearly, that all channels suit best.

A channel is text in the names of the coordinates, their velocities (omega of theta, v of x, or with
_dot), their accelerations (with _ddot) and parameters, or a function
whose arguments have these names: both become the same tree, which is saved as text. Or it is a
`Sensor` of a user's own module.
"""

from __future__ import annotations

import dataclasses
import inspect
import re
from collections.abc import Callable, Mapping, Sequence
from functools import cached_property
from itertools import combinations, product
from typing import Any, Protocol, runtime_checkable

import numpy as np

from gfnn_jax.data.roles import symbols
from gfnn_jax.errors import InputError
from gfnn_jax.families.expressions import (
    Expression,
    depends_on,
    names_in,
    parse_named,
    to_named_text,
)
from gfnn_jax.families.jets import jets
from gfnn_jax.families.traced import traced
from gfnn_jax.flows.motion import Form, Rates
from gfnn_jax.maps.unseen import Swing, between_extremes, swung
from gfnn_jax.signals.oscillations import Oscillations
from gfnn_jax.signals.splines import splines
from gfnn_jax.signals.steps import dominant_frequencies
from gfnn_jax.solve.latent_arcs import SOFT_L1, Observed
from gfnn_jax.solve.noise import Loss


@dataclasses.dataclass(frozen=True, eq=False)
class Hidden:
    """Sensor y = w·q + rest of coordinates that no other column shows, as x = x_1 + x_2 + x_rest.

    weights: w (d,). omega: (d,) angular frequencies of small swings. shapes: (d, d) coordinates of
    each of these, by which a state starts. start: of the rest, a parameter.
    """

    names: tuple[str, ...]
    weights: tuple[float, ...]
    omega: tuple[float, ...]
    shapes: tuple[tuple[float, ...], ...]
    rest: str
    start: float

    @property
    def parameters(self) -> dict[str, float]:
        """The rest, with where it starts."""
        return {self.rest: self.start}

    @cached_property
    def oscillations(self) -> Oscillations:
        """Oscillations that states start from."""
        return Oscillations(np.array(self.omega))

    def __call__(self, q: np.ndarray, v: np.ndarray, c: np.ndarray) -> tuple[np.ndarray, ...]:
        """y (...) and its derivatives in q, v (..., d) and the rest."""
        by_q = np.broadcast_to(self.weights, q.shape)
        return q @ np.array(self.weights) + c[..., 0], by_q, 0 * q, np.ones((*q.shape[:-1], 1))

    @property
    def gauge(self) -> str:
        """Meaning of the coordinates that no column shows, of which there is no one choice."""
        names = ", ".join(self.names)
        if all(self.weights):
            return f"{names} are the modes of small swings, of which the column shows the sum"
        return f"{self.names[1]} is a pendulum on {self.names[0]}, in its own unit"

    @property
    def rivals(self) -> str:
        """Reason why other laws follow the column alike; "" of a pendulum on an angle, whose law
        has its own form. Powers of modes have none: some that couple them imitate others."""
        if not all(self.weights):
            return ""
        return f"{self.gauge}, and other powers of them may couple them"

    def states(
        self, t: np.ndarray, y: np.ndarray, rest: float | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Positions and velocities (n, d) to start from, at times t (n,) of readings y (n,)."""
        parts = self.oscillations.parts(t, y - (self.start if rest is None else rest))
        return parts[0] @ np.array(self.shapes), parts[1] @ np.array(self.shapes)

    def __str__(self) -> str:
        return " + ".join(n for n, w in zip(self.names, self.weights, strict=True) if w) + (
            f" + {self.rest}"
        )


class Options:
    """Options of what sensors tell of a state (benchmarks/random_recordings.py)."""

    same: float = 1e-6  # sine of the angle between changes that are the same
    tried: int = 12  # places of an angle from which a state is looked for
    # of an angle, or of the channel's size over the squared frequency: largest swings at the start
    sizes: tuple[float, ...] = tuple(np.geomspace(0.1, 2.5, 15))
    clean: float = 1e-3  # of a channel's size: more weight has no channel at the start
    few: float = 0.25  # of the samples: where fewer show positions alone, other channels do too
    # of a swing by its period, that gates aside of zero may show
    factors: tuple[float, ...] = tuple(np.outer((1, -1), 1.1 ** np.arange(-25.0, 26.0)).ravel())
    between: int = 16  # places between two events, at which a state stands
    iterations: int = 30


@runtime_checkable
class Sensor(Protocol):
    """A user's own sensor g(q, v; c): a dataclass that ``gfnn.register`` makes known to saved maps.

    parameters: names of c, with where they start.
    """

    @property
    def parameters(self) -> Mapping[str, float]: ...

    def __call__(self, q: np.ndarray, v: np.ndarray, c: np.ndarray) -> tuple[np.ndarray, ...]:
        """g (...), ∂g/∂q (..., d), ∂g/∂v (..., d) and ∂g/∂c (..., m) at q, v (..., d) and c (m,)
        or (..., m). NumPy."""
        ...


EVENTS = re.compile(r"\s*crossing\((.*)\)\s*")


@dataclasses.dataclass(frozen=True)
class Crossing:
    """Events: times at which h(q; c) = 0 is crossed, the `Sensor` that reads zero there of the time
    by which the crossing of a state is later, δt = h/ḣ, so that its noise is that of the times.

    text: h in ``names`` of coordinates and in ``open`` parameters, which start at 0.
    """

    text: str
    names: tuple[str, ...]
    open: tuple[str, ...] = ()

    @classmethod
    def of(cls, text: str, names: Sequence[str]) -> Crossing:
        """Read h of the coordinates of these names."""
        open_ = tuple(dict.fromkeys(n for n in names_in(text) if n not in names))
        return cls(text, tuple(names), open_)

    @property
    def parameters(self) -> dict[str, float]:
        """Names of c, with where they start."""
        return dict.fromkeys(self.open, 0.0)

    @cached_property
    def _tree(self) -> Expression:
        return parse_named(self.text, (*self.names, *self.open))

    def __call__(self, q: np.ndarray, v: np.ndarray, c: np.ndarray) -> tuple[np.ndarray, ...]:
        """δt (...) and its derivatives in q, v (..., d) and c; 0 where h does not change."""
        d, shape = q.shape[-1], q.shape[:-1]
        w = np.concatenate([q, np.broadcast_to(c, (*shape, len(self.open)))], axis=-1)
        (jet,) = jets([self._tree], w, 2)
        slope, turn = np.zeros(w.shape), np.zeros((*w.shape, d))
        for i, one in jet.slope.items():
            slope[..., i] = one
        for (i, j), one in jet.curvature.items():
            for a, b in {(i, j), (j, i)}:
                if b < d:
                    turn[..., a, b] = one
        rate = np.sum(slope[..., :d] * v, axis=-1)
        over = np.divide(1.0, rate, out=np.zeros(shape), where=rate != 0)
        late = jet.value * over
        by_rate = (late * over)[..., None]
        by = slope * over[..., None] - by_rate * np.sum(turn * v[..., None, :], axis=-1)
        return late, by[..., :d], -by_rate * slope[..., :d], by[..., d:]

    def __str__(self) -> str:
        return f"crossing({self.text})"


@dataclasses.dataclass(frozen=True, eq=False)
class Observation:
    """Channels of a state, the columns of a recording.

    channels: names of columns. formulas: of each, in the `symbols` of ``coordinates`` and
    ``speeds`` and in ``parameters``, or a `Sensor`. values: (m,) of the parameters, those to start
    from or those that were fitted. loss: of what is left of a channel in units of its noise.
    swing: where the one coordinate starts of which no channel shows position or velocity alone.
    """

    channels: tuple[str, ...]
    formulas: tuple[Any, ...]
    coordinates: tuple[str, ...]
    speeds: tuple[str, ...]
    parameters: tuple[str, ...]
    values: Any
    loss: Loss = SOFT_L1
    swing: Swing | None = None

    @staticmethod
    def plain(names: Sequence[str], speeds: Sequence[str] | None = None) -> Observation:
        """Coordinates that are seen as they are."""
        names = tuple(names)
        speeds = tuple(f"{name}_dot" for name in names) if speeds is None else tuple(speeds)
        return Observation(names, names, names, speeds, (), np.zeros(0))

    @property
    def dim(self) -> int:
        return len(self.coordinates)

    @property
    def is_plain(self) -> bool:
        """Return whether every channel is the coordinate of its name, and none is missing,
        whatever its noise."""
        return self.channels == self.formulas == self.coordinates

    @cached_property
    def _trees(self) -> tuple[Any, ...]:
        """Syntax trees of the channels, or their sensors; None where one is the coordinate of its
        name."""
        own = symbols((*self.coordinates, *self.speeds))
        twice = (f"{name}_ddot" for name in own[: self.dim])
        names = (*own, *twice, *self.parameters)

        def tree(channel: str, formula: Any) -> Any:
            if isinstance(formula, str):
                same = channel == formula and channel in self.coordinates
                return None if same else parse_named(formula, names)
            return formula

        return tuple(map(tree, self.channels, self.formulas))

    @cached_property
    def _used(self) -> tuple[set[int], ...]:
        """Indices of (q, v, a), positions, velocities, accelerations, that each channel depends
        on."""
        x, d = np.random.default_rng(0).normal(size=(8, 2 * self.dim)), self.dim
        found = []
        for name, tree in zip(self.channels, self._trees, strict=True):
            if tree is None:
                found.append({self.coordinates.index(name)})
            elif isinstance(tree, Expression):
                found.append({*depends_on(tree)} & {*range(3 * self.dim)})
            else:
                start = np.array([*tree.parameters.values()], float)
                _, by_q, by_v, _ = tree(x[:, :d], x[:, d:], start)
                moved = np.any(np.concatenate([by_q, by_v], axis=1) != 0, axis=0)
                found.append(set(np.flatnonzero(moved).tolist()))
        return tuple(found)

    @property
    def direct(self) -> dict[int, int]:
        """Coordinate -> the channel that shows it as it is, where no other channel shows it."""
        pairs = [*zip(self._trees, self._used, strict=True)]
        indirect = set().union(*(used for tree, used in pairs if tree is not None))
        direct = {min(used): k for k, (tree, used) in enumerate(pairs) if tree is None}
        return {i: k for i, k in direct.items() if i not in indirect}

    @cached_property
    def accelerated(self) -> bool:
        """Return whether a channel depends on accelerations."""
        return any(max(used, default=0) >= 2 * self.dim for used in self._used)

    def along(
        self, form: Form, p: np.ndarray, x: np.ndarray, u: np.ndarray, h: float, values: np.ndarray
    ) -> tuple[Observed, np.ndarray]:
        """`__call__` at states x (N, L, 2d) of a law of coefficients p (n,) or (N, n), under inputs
        u (N, L, inputs), and the derivative (N, L, k, n) in p; h: a small time."""
        N, L, width = x.shape
        each = np.repeat(p, L, axis=0) if p.ndim > 1 else p
        rates = form.rates(each, x.reshape(N * L, width), u.reshape(N * L, -1), h)
        rates = Rates(*(part.reshape(N, L, *part.shape[1:]) for part in rates))
        g, by = self._shown(x, values, rates.values)
        by_state, by_rates, by_values = np.split(by, [2 * self.dim, 3 * self.dim], axis=-1)
        shown = Observed(g, by_state + by_rates @ rates.by_state, by_values)
        return shown, by_rates @ rates.by_coefficients

    def __call__(
        self, x: np.ndarray, values: np.ndarray | None = None, a: np.ndarray | None = None
    ) -> Observed:
        """g (..., k) at states x (..., 2d) and accelerations a (..., d), 0 unless given, and its
        derivatives in x and the parameters."""
        g, by = self._shown(x, self.values if values is None else values, a)
        return Observed(g, by[..., : 2 * self.dim], by[..., 3 * self.dim :])

    def _shown(
        self, x: np.ndarray, c: np.ndarray, a: np.ndarray | None
    ) -> tuple[np.ndarray, np.ndarray]:
        """g (..., k) and its derivatives (..., k, 3d + m) in (q, v, a) and the parameters."""
        d, m, count = self.dim, len(self.parameters), len(self.channels)
        shape = x.shape[:-1]
        g, by = np.zeros((*shape, count)), np.zeros((*shape, count, 3 * d + m))
        a = np.zeros((*shape, d)) if a is None else a
        w = np.concatenate([x, a, np.broadcast_to(c, (*shape, m))], axis=-1)
        for k, tree in enumerate(self._trees):
            if tree is None:
                i = self.coordinates.index(self.channels[k])
                g[..., k], by[..., k, i] = x[..., i], 1.0
                continue
            if not isinstance(tree, Expression):
                own = [self.parameters.index(name) for name in tree.parameters]
                found = tree(x[..., :d], x[..., d:], np.asarray(c)[..., own])
                g[..., k], by[..., k, :d], by[..., k, d : 2 * d] = found[:3]
                by[..., k, [3 * d + i for i in own]] = found[3]
                continue
            (jet,) = jets([tree], w, 1)
            g[..., k] = jet.value
            for i, slope in jet.slope.items():
                by[..., k, i] = slope
        return g, by

    @cached_property
    def hidden(self) -> Hidden | None:
        """The one channel where it shows coordinates that no other does; else None."""
        return next((one for one in self.formulas if isinstance(one, Hidden)), None)

    @property
    def shortest(self) -> float:
        """Seconds of readings, below which they tell no state."""
        own = self.swing if self.hidden is None else self.hidden.oscillations
        return 0.0 if own is None else own.seconds

    @cached_property
    def unseen(self) -> tuple[int, ...]:
        """Coordinates that no channel shows by positions alone."""
        if self.hidden is not None:
            return ()
        still = {*range(self.dim)}
        seen = set().union(*(used for used in self._used if used <= still))
        return tuple(i for i in range(self.dim) if i not in seen)

    def coordinates_of(
        self, y: np.ndarray, angles: Sequence[int], t: np.ndarray | None = None
    ) -> np.ndarray:
        """The coordinates (n, d) that channels y (n, k) show at ``values``, each sample for itself,
        NaN where they do not; ``angles`` that no column shows directly in (−π, π]. Unseen ones are
        integrals over times t (n,).

        Raises InputError where the channels leave a coordinate open.
        """
        if len(self.direct) == self.dim:
            return y[:, [self.direct[i] for i in range(self.dim)]]
        if self.hidden is not None and t is not None:
            return self.hidden.states(t, y[:, 0], float(self.values[0]))[0]
        if self.unseen:
            return self._integrated(t, y, angles)
        d = self.dim
        still = [k for k, name in enumerate(self.channels) if name in self.needed]
        if np.mean(np.isfinite(y[:, still]).any(axis=1)) < Options.few:  # others, as at rest
            still = [k for k, used in enumerate(self._used) if min(used, default=d) < d]
        scale = np.nanstd(y[:, still], axis=0) + 1e-300
        turns = np.arange(Options.tried) * 2 * np.pi / Options.tried
        own = [self.channels.index(n) if n in self.channels else None for n in self.coordinates]
        choices = [turns if i in angles and own[i] is None else np.zeros(1) for i in range(d)]
        starts = np.array(list(product(*choices)))
        x = np.zeros((len(starts), len(y), 2 * d))
        for i in range(d):
            x[..., i] = starts[:, [i]] if own[i] is None else np.nan_to_num(y[:, own[i]])
        each = np.broadcast_to(y, (len(starts), *y.shape)).reshape(-1, y.shape[1])
        found, left = self._followed(x.reshape(-1, 2 * d), each, still, scale)
        left = left.reshape(len(starts), -1)
        best, samples = np.argmin(left, axis=0), np.arange(len(y))
        q = found.reshape(x.shape)[best, samples, :d]
        told = np.isfinite(left[best, samples])
        if not told.any():
            raise InputError(
                f"observe: {', '.join(self.channels)} do not determine "
                f"{', '.join(self.coordinates)}: each needs a channel that shows it"
            )
        q[~told] = np.nan
        for i in angles:
            if own[i] is None:
                q[:, i] = np.pi - (np.pi - q[:, i]) % (2 * np.pi)
        return q

    def _integrated(
        self, t: np.ndarray | None, y: np.ndarray, angles: Sequence[int] = ()
    ) -> np.ndarray:
        """Coordinates of which the unseen ones are integrals of their velocities, or swings between
        events."""
        seen = [i for i in range(self.dim) if i not in self.unseen]
        if t is None or any(i not in self.direct for i in seen):
            names = ", ".join(self.coordinates[i] for i in self.unseen)
            raise InputError(
                f"observe: {names}: no column shows it. Where only velocities are shown of one "
                "coordinate, columns have to show the others as they are"
            )
        if self.swing is not None:
            return self._swinging(t, y)[:, None]
        q = np.full((len(y), self.dim), np.nan)
        q[:, seen] = y[:, [self.direct[i] for i in seen]]
        for i in self.unseen:
            if i in self.crossed:
                q[:, i] = self._between_gates(i, t, y, i in angles)
            else:
                q[:, i] = between_extremes(t, self._velocity(i, y))[0]
        return q

    @cached_property
    def events(self) -> tuple[int, ...]:
        """Channels that are times of events."""
        return tuple(k for k, one in enumerate(self.formulas) if isinstance(one, Crossing))

    @property
    def crossed(self) -> dict[int, list[int]]:
        """Unseen coordinates -> the channels whose events they alone make."""
        alone = {k: {i for i in self._used[k] if i < self.dim} for k in self.events}
        own = {i: [k for k, used in alone.items() if used == {i}] for i in self.unseen}
        return {i: gates for i, gates in own.items() if gates}

    @property
    def between(self) -> int:
        """Places between two events at which states stand; 0 where sensors show positions too."""
        return Options.between if self.crossed else 0

    def _between_gates(self, i: int, t: np.ndarray, y: np.ndarray, turns: bool) -> np.ndarray:
        """An unseen coordinate (n,) by the events that it alone makes: its swing, of the sign and
        size that suit the gates best which are known to stand elsewhere than at zero."""
        gates = self.crossed[i]
        x = np.zeros((1, 2 * self.dim))
        x[:, self.dim + i] = 1.0
        aside = [k for k in gates if self(x).values[0, k] != 0]
        z = swung(t, y[:, gates], turns and not aside)
        if not aside:
            return z
        x = np.zeros((len(Options.factors), len(t), 2 * self.dim))
        x[..., i], x[..., self.dim + i] = np.outer(Options.factors, z), 1.0
        left = np.where(np.isfinite(y[:, aside]), self(x).values[..., aside], np.nan)
        best = int(np.argmin(np.nansum(left**2, axis=(1, 2))))
        return Options.factors[best] * z

    def _velocity(self, i: int, y: np.ndarray) -> np.ndarray:
        """The velocity (n,) of a coordinate by the channel that shows it alone, at ``values``."""
        place = self.dim + i
        own = [k for k, used in enumerate(self._used) if used == {place}]
        states = np.eye(2 * self.dim)[[place, place]] * [[0.0], [1.0]]
        zero, one = self(states).values[:, own[0]] if own else (0.0, 0.0)
        if not zero != one:
            raise InputError(
                f"observe: no column shows {self.coordinates[i]}, nor its velocity alone, as "
                f"{self.speeds[i]} + b"
            )
        return (y[:, own[0]] - zero) / (one - zero)

    def _states(self, t: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """States (n, 2d) and accelerations (n, d) at times t (n,), of the unseen coordinates as
        integrals."""
        q = self._integrated(t, y)
        if len(self.events) == len(self.channels):  # too few places for a curve
            small = 1e-3 * float(np.median(np.diff(t)))
            beside = (t[:, None] + small * np.arange(-1, 2)).ravel()
            read = np.full((len(t), 3, y.shape[1]), np.nan)
            read[:, 1] = y
            near = self._integrated(beside, read.reshape(len(beside), -1)).reshape(len(t), 3, -1)
            return np.concatenate([q, (near[:, 2] - near[:, 0]) / (2 * small)], axis=1), 0 * q
        found = splines([(t, q)]).smooth(t, q, t)
        return np.concatenate(found[:2], axis=1), found.a

    def balanced(
        self, runs: Sequence[tuple[np.ndarray, np.ndarray]], angles: Sequence[int] = ()
    ) -> Observation:
        """The observation whose parameters let unseen coordinates come back, as far as they can, in
        runs of times t (n,) and channels y (n, k), and suit all channels best."""
        found = self
        if self.dim == 1 and not self.crossed and not any(used == {1} for used in self._used):
            return self._with_a_swing(runs, angles)
        for i in set(self.unseen) - {*self.crossed}:
            slopes = [(np.ptp(t), between_extremes(t, found._velocity(i, y))[1]) for t, y in runs]
            weights, by = np.array(slopes).T
            back = np.zeros(2 * self.dim)
            back[self.dim + i] = -np.average(by, weights=weights**3)
            x = np.random.default_rng(0).normal(size=(40, 2 * self.dim))
            shown = found(x)
            moved = -(shown.by_state @ back).ravel()
            by_values = shown.by_coefficients.reshape(len(moved), -1)
            change = np.linalg.lstsq(by_values, moved, rcond=None)[0]
            found = dataclasses.replace(found, values=found.values + change)
        if len(self.channels) == self.dim and not (self.crossed and len(self.parameters)):
            return found
        states = [found._states(t, y) for t, y in runs]
        x, a = (np.concatenate(of) for of in zip(*states, strict=True))
        return found._suited(x, a, np.concatenate([y for _, y in runs]))[0]

    def _suited(self, x: np.ndarray, a: np.ndarray, y: np.ndarray) -> tuple[Observation, float]:
        """The observation whose parameters suit channels y (n, k) of states x (n, 2d) and
        accelerations a (n, d) best, and the mean square that it leaves, of that of y."""
        values, scale, cost = self.values, np.ones(len(self.channels)), np.inf
        sampled = ~np.isin(range(len(scale)), self.events)
        scale[sampled] = _roughness(y[:, sampled])
        for _ in range(Options.iterations):
            shown = self(x, values, a)
            by_time = np.linalg.norm(shown.by_state[..., : self.dim], axis=-1)  # of an event: 1/ḣ
            each = np.where(sampled, scale, by_time)
            left = ((y - shown.values) / each).ravel()
            rows = (shown.by_coefficients / each[..., None]).reshape(len(left), -1)
            told = np.isfinite(left) & np.isfinite(rows).all(1)
            cost = float(np.mean(left[told] ** 2))
            change = np.linalg.lstsq(rows[told], left[told], rcond=1e-9)[0]
            values = values + change
            if np.max(np.abs(change), initial=0.0) <= 1e-9 * np.max(np.abs(values), initial=0.0):
                break
        return dataclasses.replace(self, values=values), cost

    def _with_a_swing(
        self, runs: Sequence[tuple[np.ndarray, np.ndarray]], angles: Sequence[int]
    ) -> Observation:
        """The observation with the swing, and the parameters, that suit the channels best."""
        t, y = max(runs, key=lambda run: np.ptp(run[0]))
        found = []
        for k, even, turned in product(range(len(self.channels)), (False, True), (False, True)):
            own = np.isfinite(y[:, k])
            for line in dominant_frequencies([t[own]], y[own, k], 1):
                one = Swing(k, 2 * np.pi * line, even, turned, bool(angles))
                z = one.along(t, y)
                unit = 1.0 if angles else np.nanstd(y[:, k]) / one.own_omega**2
                for size in np.outer(Options.sizes, (1, -1)).ravel() * unit / np.max(np.abs(z)):
                    swing = dataclasses.replace(one, size=float(size))
                    suited, cost = self._suited(*swing.states(z), y)
                    found.append((cost, dataclasses.replace(suited, swing=swing)))
        if not found:
            raise InputError(f"observe: none of {', '.join(self.channels)} oscillates")
        return min(found, key=lambda one: one[0])[1]

    def _swinging(self, t: np.ndarray, y: np.ndarray) -> np.ndarray:
        """The swing (n,) with the sign that suits channels y (n, k) better."""
        assert self.swing is not None
        x, a = self.swing.states(self.swing.along(t, y))
        left = [
            np.nansum(((y - self(s * x, a=s * a).values) / _roughness(y)) ** 2) for s in (1, -1)
        ]
        return (1 - 2 * (self.swing.even and left[1] < left[0])) * x[:, 0]

    def _followed(
        self, x: np.ndarray, y: np.ndarray, still: list[int], scale: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Gauss–Newton of each sample from x (n, 2d): states, and what they leave of y, squared;
        infinite where a coordinate moves no channel."""
        d, x, sizes = self.dim, x.copy(), np.full(len(x), np.inf)
        J, moving = np.zeros((len(x), len(still), d)), np.arange(len(x))
        for _ in range(Options.iterations):
            shown = self(x[moving])
            r = (y[moving][:, still] - shown.values[:, still]) / scale
            known, r = np.isfinite(r), np.nan_to_num(r)
            sizes[moving] = np.sum(r**2, axis=1)
            J[moving] = shown.by_state[:, still, :d] / scale[:, None] * known[..., None]
            step = (np.linalg.pinv(J[moving], rcond=1e-8) @ r[..., None])[..., 0]
            x[moving, :d] += np.clip(step, -1e3, 1e3)
            moving = moving[np.abs(step).max(axis=1, initial=0.0) >= 1e-10]
            if not len(moving):
                break
        rank = np.linalg.matrix_rank(J, tol=1e-8)
        return x, np.where((rank == d) & np.isfinite(sizes), sizes, np.inf)

    def beside(self, velocities: Mapping[str, int]) -> Observation:
        """Add columns that show the velocities of these coordinates as they are."""
        code = symbols((*self.coordinates, *self.speeds))[self.dim :]
        return dataclasses.replace(
            self,
            channels=(*self.channels, *velocities),
            formulas=(*self.formulas, *(code[i] for i in velocities.values())),
        )

    @property
    def rated(self) -> dict[int, tuple[int, int]]:
        """Coordinate -> the channels that show it and its velocity as they are."""
        code = symbols((*self.coordinates, *self.speeds))[self.dim :]
        pairs = {i: (k, code[i]) for i, k in self.direct.items() if code[i] in self.formulas}
        return {i: (k, self.formulas.index(name)) for i, (k, name) in pairs.items()}

    @property
    def needed(self) -> tuple[str, ...]:
        """Channels without which the coordinates are not told: those that show no velocity."""
        if self.unseen:
            return self.channels
        moving = set(range(self.dim, 3 * self.dim))
        pairs = zip(self.channels, self._used, strict=True)
        return tuple(name for name, used in pairs if not used & moving)

    def state_sigma(self, x: np.ndarray, sigma: np.ndarray, omega: float) -> np.ndarray:
        """σ (d,) of the coordinates, of that of the channels (k,), at states x (n, 2d); of unseen
        ones that of their velocities over the frequency ω."""
        if self.hidden is not None:
            return np.full(self.dim, sigma[0])
        d, unseen = self.dim, list(self.unseen)
        by = self._shown(x, self.values, None)[1][..., : 3 * d].reshape(*x.shape[:1], -1, 3, d)
        J = by[..., 0, :].copy()
        by_rates = np.linalg.norm(by * omega ** np.arange(3)[:, None], axis=-2)
        J[..., unseen] = by_rates[..., unseen]
        for i, gates in self.crossed.items():  # by its speed, a time is a distance
            J[:, gates, i] = 1 / (omega * max(float(np.std(x[:, i])), 1e-300))
        J /= sigma[:, None]
        return 1 / np.sqrt(np.mean(np.sum(J**2, axis=1), axis=0))

    def shifts(self) -> tuple[int, ...]:
        """Coordinates that the parameters can shift, or that are unseen: their zero is then where
        the law has it."""
        by_state, by_values = self._anywhere()
        return tuple(i for i in range(self.dim) if _spans(by_values, by_state[:, [i]]))

    def shifted(self, by: np.ndarray) -> Observation:
        """Change the parameters so that coordinates which are lower by these amounts (d,) show as
        before, where they can: g(q, v; c) = g(q − by, v; c′), to first order."""
        by_state, by_values = self._anywhere()
        change = np.linalg.lstsq(by_values, by_state @ by, rcond=None)[0]
        return dataclasses.replace(self, values=self.values + change)

    def undetermined(self, lengths: Sequence[int]) -> tuple[str, ...]:
        """Parameters that scale ``lengths``, which a law of other coefficients does as well."""
        if not len(self.parameters) or not len(lengths):
            return ()
        by_state, by_values = self._anywhere(scaled=True)
        stretch = by_state[:, list(lengths)]
        u, v = (np.linalg.svd(a, full_matrices=False) for a in (by_values, stretch))
        both = u[0][:, u[1] > Options.same].T @ v[0][:, v[1] > Options.same]
        left, overlap, _ = np.linalg.svd(both)
        if not len(overlap) or overlap[0] < 1 - Options.same:
            return ()
        along = u[2][u[1] > Options.same].T @ (left[:, 0] / u[1][u[1] > Options.same])
        return tuple(
            n for n, a in zip(self.parameters, along, strict=True) if abs(a) > Options.same
        )

    def hidden_places(self) -> list[int]:
        """Places of the coordinates of which no channel shows anything, nor of their rates."""
        rng, d = np.random.default_rng(0), self.dim
        x, c, a = rng.normal(size=(40, 2 * d)), np.ones(len(self.parameters)), np.ones((40, d))
        by = np.abs(self._shown(x, c, a)[1][..., : 3 * d]).max(axis=(0, 1)).reshape(3, d)
        return np.flatnonzero(~by.any(axis=0)).tolist()

    def alike(self) -> tuple[list[str], list[str]]:
        """Parameters that no motion tells apart through the channels, whatever its law, and the
        products and ratios of two of these that it tells, as A*l and A*g of A*(l*a + g*sin(q))."""
        rng, names, d = np.random.default_rng(0), self.parameters, self.dim
        c = rng.uniform(0.5, 1.5, len(names))
        by = self._shown(rng.normal(size=(40, 2 * d)), c, rng.normal(size=(40, d)))[1]
        rows = by[..., 3 * d :] * c
        _, sizes, turns = np.linalg.svd(np.tensordot(rows, rows, ((0, 1), (0, 1))))
        open_ = turns[np.sqrt(sizes) <= Options.same * np.sqrt(sizes.max(initial=0.0))]
        own = [i for i in range(len(c)) if np.abs(open_[:, i]).max(initial=0.0) > Options.same]
        told = [
            f"{names[i]}{sign}{names[j]}"
            for i, j in combinations(own, 2)
            for sign, both in (("*", open_[:, i] + open_[:, j]), ("/", open_[:, i] - open_[:, j]))
            if np.abs(both).max() < Options.same
        ]
        return [names[i] for i in own], told

    def _anywhere(self, scaled: bool = False) -> tuple[np.ndarray, np.ndarray]:
        """Derivatives of all channels at some states, in what shifts each coordinate (or scales it
        with its velocity) and in the parameters: (n, d) and (n, m)."""
        d = self.dim
        x = np.random.default_rng(0).normal(size=(40, 2 * d))
        shown = self(x)
        by = shown.by_state[..., :d]
        if scaled:
            by = by * x[:, None, :d] + shown.by_state[..., d:] * x[:, None, d:]
        rows = by.shape[0] * by.shape[1]
        return by.reshape(rows, d), shown.by_coefficients.reshape(rows, len(self.parameters))


def observed(
    observe: Mapping[str, Any],
    coordinates: Sequence[str],
    speeds: Sequence[str],
    guess: Mapping[str, float],
    *,
    offsets: Sequence[str] = (),
    scales: Sequence[str] = (),
    columns: Sequence[str],
) -> Observation:
    """The observation of a recording with these columns.

    observe: column -> text, a `Sensor`, or a function whose arguments are coordinates, speeds and
    parameters by name, the parameters' defaults where they start. offsets, scales: columns that are
    shown with an offset, or a scale, of their own. guess: where other parameters start; without it
    those of a channel that shows a coordinate start where it shows it as it is.
    Raises InputError, one line, for what cannot be read or has no start.
    """
    state = (*coordinates, *speeds)
    same = {f"{q}_dot": v for q, v in zip(coordinates, speeds, strict=True) if q.isidentifier()}
    same |= {f"{v}_dot": f"{q}_ddot" for q, v in zip(coordinates, speeds, strict=True)}
    code = dict(zip(state, symbols(state), strict=True))
    starts = dict(guess)
    formulas: dict[str, Any] = {name: name for name in coordinates if name in columns}
    for name in dict.fromkeys((*offsets, *scales)):
        if name in observe:
            raise InputError(f"observe: {name} has a formula already: write its offset there")
        if name not in state:
            raise InputError(
                f"expected an offset or a scale of {', '.join(state)}, got one of {name}"
            )
        own = code[name]
        scale = f"scale_{own}*" if name in scales else ""
        formulas[name] = f"{scale}{own}" + (f" + offset_{own}" if name in offsets else "")
    for name, given in observe.items():
        if name not in columns:
            raise InputError(f"observe: no column {name} among {', '.join(columns)}")
        known = isinstance(given, (str, Sensor))
        formulas[name] = given if known else _text_of(given, starts)
        if isinstance(given, str):
            formulas[name] = re.sub(r"\b\w+_dot\b", lambda m: same.get(m[0], m[0]), given)
            if event := EVENTS.fullmatch(given):
                formulas[name] = Crossing.of(event[1], symbols(coordinates))
        if isinstance(formulas[name], Sensor):
            starts = {**formulas[name].parameters, **starts}
    parameters = [
        n
        for column, f in formulas.items()
        if f != column or column not in coordinates
        for n in (names_in(f) if isinstance(f, str) else f.parameters)
        if n not in (*code.values(), *(f"{code[q]}_ddot" for q in coordinates))
    ]
    parameters = list(dict.fromkeys(parameters))
    unknown = [name for name in guess if name not in parameters]
    if unknown:
        raise InputError(
            f"guess: no parameter {', '.join(unknown)} among {', '.join(parameters) or 'none'}"
        )
    values = np.array([starts.get(name, np.nan) for name in parameters])
    named = tuple(coordinates), tuple(speeds), tuple(parameters)
    found = Observation(tuple(formulas), tuple(formulas.values()), *named, values)
    return dataclasses.replace(found, values=_started(found))


def _text_of(function: Callable, starts: dict[str, float]) -> str:
    """The formula of a function of named arguments, whose defaults become ``starts``."""
    try:
        arguments = inspect.signature(function).parameters
        for name, argument in arguments.items():
            if argument.default is not argument.empty:
                starts.setdefault(name, float(argument.default))
    except (TypeError, ValueError) as error:
        raise InputError(
            f"observe: expected text or a function of named arguments ({error})"
        ) from None
    names, size = tuple(arguments), len(arguments)
    try:
        trees = traced(lambda z: function(*(z[i] for i in range(size))), -(-size // 2))
    except TypeError as error:
        raise InputError(
            f"observe: expected a function of JAX's operations, as jnp.sin ({str(error)[:60]})"
        ) from None
    if len(trees) != 1:
        raise InputError(f"observe: expected a function with one value, got {len(trees)}")
    return to_named_text(trees[0], names)


def _started(g: Observation) -> np.ndarray:
    """The values of the parameters; where none were given, those with which a channel shows the
    coordinate or velocity of its name, or of one that is unseen, as nearly as it can."""
    values, state = g.values.copy(), (*g.coordinates, *g.speeds)
    open_ = np.flatnonzero(np.isnan(values))
    own = [(k, state.index(name)) for k, name in enumerate(g.channels) if name in state]
    unseen = {g.dim + i for i in g.unseen}  # whose velocity starts as it is shown
    own += [(k, *used) for k, used in enumerate(g._used) if len(used) == 1 and used <= unseen]
    x = np.random.default_rng(0).normal(size=(40, 2 * g.dim))
    values[open_] = 1.0
    determined = np.zeros(len(values), bool)
    for _ in range(Options.iterations if len(open_) else 0):
        shown = g(x, values)
        rows = [shown.by_coefficients[:, k][:, open_] for k, _ in own]
        left = [x[:, i] - shown.values[:, k] for k, i in own]
        if not rows:
            break
        J = np.concatenate(rows)
        determined[open_] = np.any(J, axis=0)
        values[open_] += np.linalg.pinv(J, rcond=1e-8) @ np.concatenate(left)
    missing = [g.parameters[i] for i in open_ if not determined[i] or not np.isfinite(values[i])]
    if missing and not g.unseen:  # else what is integrated tells them
        raise InputError(
            f"--observe: {', '.join(missing)}: expected a first guess, --guess {missing[0]}=…"
        )
    return np.where(np.abs(values) < 1e-12, 0.0, values)


def _roughness(y: np.ndarray) -> np.ndarray:
    """About the noise (k,) of channels y (n, k), by their second differences."""
    rough = np.nanstd(np.diff(y, 2, axis=0), axis=0) / np.sqrt(6)
    return np.fmax(rough, Options.clean * np.nanstd(y, axis=0))


def _spans(table: np.ndarray, column: np.ndarray) -> bool:
    """Return whether a column is a combination of those of a table."""
    size = np.linalg.norm(column)
    if size == 0 or not table.shape[1]:
        return bool(size == 0)
    left = column - table @ np.linalg.lstsq(table, column, rcond=None)[0]
    return bool(np.linalg.norm(left) < Options.same * size)
