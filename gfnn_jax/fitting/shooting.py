"""H from whole sequences: coefficients, and the true first state of every arc, by shooting.

Both states of a noisy pair are measured, so that noise stands among the regressors too, and a drift
of the coefficients that a pair hides beneath its noise grows along a sequence. Here an arc of
measured states z₀ … z_L is that of one latent state x,

    minimise Σ_arcs Σ_k ρ((Φ_h^k(x; c) − z_k) ÷ σ)   over c and one x for each arc,

the maximum of the likelihood where noise is normal (Bock, Springer Ser. Chem. Phys. 18 (1981) 102,
without his matching conditions: an arc ends where noise would have grown beyond the linear). ρ is
Tukey's biweight, quadratic for most residuals and constant for gross errors of measurement.

The Gauss–Newton equations are an arrow: x of an arc meets c and no other x. It is eliminated from
the arc's own rows; those that are left, of c alone, are folded into one triangle
(`fitting.triangle`): the cost is linear in the number of arcs.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from gfnn_jax.coordinates import nearest_image
from gfnn_jax.dataset.noise import of_residuals
from gfnn_jax.fitting.triangle import Spectrum, Triangle, eliminated
from gfnn_jax.flows.collocation import Steps, images


@dataclasses.dataclass(frozen=True)
class Options:
    """Tuned on Hénon–Heiles at dt 0.5 and 0.05 with noise of 1e-3 to 1e-2 (benchmarks/bands.py).

    longest: steps of an arc. grown: noise ÷ spread at its end, if that of its first state goes on
    along it. biweight: deviations from which on a state does not count. outlying: beyond which it
    is named an outlier. rounds: Gauss–Newton steps. gained: part of the cost from which a step
    counts. halvings: of a step that gains nothing. first: states of an arc from which it may start.
    alike: times their median that the arcs' distances from their starts may be. block_bytes: of the
    derivatives along the arcs of a block.
    """

    longest: int = 100
    grown: float = 0.1
    biweight: float = 7.0
    outlying: float = 5.0
    rounds: int = 12
    gained: float = 1e-5
    halvings: int = 4
    first: int = 4
    alike: float = 5.0
    block_bytes: int = 64 * 2**20


OPTIONS = Options()


class Arcs(NamedTuple):
    """states: (B, L + 1, 2d), measured; of those that are not, within an arc or beyond its end, the
    one before stands again. measured: which of them are, (B, L + 1)."""

    states: np.ndarray
    measured: np.ndarray


class Shot(NamedTuple):
    """coefficients (m,). root: (m, m), rootᵀ root is their covariance. noise: (2d,) standard
    deviation of each coordinate's noise. triangle: of [∂r/∂c, r] without the latent states, r in
    units of the noise, for the rows that have weight. outlying: measured states that are gross
    errors. cost: the mean of ρ at the end."""

    coefficients: np.ndarray
    root: np.ndarray
    noise: np.ndarray
    triangle: Triangle
    outlying: int
    cost: float


def arcs_of(z0, z1, longest: int, steps=None) -> Arcs | None:
    """Arcs of at most ``longest`` steps of pairs z0 -> z1 (N, 2d) in their order. None where there
    is no pair.

    steps: (N − 1,) from the state of a pair to that of the next, 0 where that is of another arc.
    None: 1 where the image of the one is the state of the other.
    """
    if not len(z0):
        return None
    if steps is None:
        steps = np.all(z1[:-1] == z0[1:], axis=1).astype(int)
    time = np.concatenate([[0], np.cumsum(steps)])
    starts = np.concatenate([[True], np.asarray(steps) == 0])
    time -= time[starts][np.cumsum(starts) - 1]  # from the start of the sequence
    begins = starts.copy()
    begins[1:] |= time[1:] // longest != time[:-1] // longest
    arc = np.cumsum(begins) - 1
    time -= time[begins][arc]
    shape = arc[-1] + 1, int(time.max()) + 2
    measured, last = np.zeros(shape, bool), np.zeros(shape, int)
    for later in (0, 1):
        measured[arc, time + later] = True
    last[arc, time + 1] = np.arange(len(z0)) + 1  # the pair, from 1, whose image it is
    last = np.maximum.accumulate(last, axis=1)
    first = np.flatnonzero(begins)
    states = np.where(last[..., None] > 0, z1[last - 1], z0[first][:, None])
    states[arc, time] = z0
    return Arcs(states, measured)


class Shooting:
    """Arcs that are dt apart from state to state, and how the flow along them is computed.

    angles: coordinates that are compared modulo 2π. resolved: error of the steps ÷ scale, below
    which no coordinate's noise is told. check: called at every step along the arcs; it may raise to
    stop.
    """

    def __init__(
        self, arcs: Arcs, dt: float, steps: Steps, scale, angles: tuple[int, ...] = (), *,
        resolved: float = 0.0, check: Callable[[], Any] = lambda: None, options: Options = OPTIONS,
    ):  # fmt: skip
        self.arcs, self.dt, self.steps, self.scale = arcs, dt, steps, scale
        self.angles, self.check, self.options = angles, check, options
        self.least = max(resolved, float(np.finfo(float).eps)) * scale

    def fit(self, family, coefficients, *, only_states: bool = False) -> Shot | None:
        """Fit from coefficients that are close, or with these as they are (``only_states``);
        every arc starts from one of its own states. None where the flow fails."""
        c, x = np.array(coefficients, float), self._starts(family, coefficients)
        residual = self.residuals(family, c, x)
        noise = self._deviations(residual)
        if not np.isfinite(noise).all():
            return None
        for _ in range(self.options.rounds):
            problem = self._linearised(family, c, x, noise)
            cost = self._cost(residual, noise)
            move = np.zeros_like(c) if only_states else -_solved(problem.triangle.spectrum())
            shift = problem.shift(move)
            found = None
            for n in range(self.options.halvings):
                tried = c + 0.5**n * move, x + 0.5**n * shift
                there = self.residuals(family, *tried)
                if self._cost(there, noise) < cost:
                    found = *tried, there
                    break
            if found is None:
                break
            c, x, residual = found
            gained = cost - self._cost(residual, noise)
            sharper = self._deviations(residual)
            settled = gained <= self.options.gained * cost
            if settled and np.allclose(sharper, noise, rtol=self.options.gained**0.5):
                break
            noise = sharper
        problem = self._linearised(family, c, x, noise)
        weighty = int((self._weights(residual, noise) > 0).sum())
        triangle = dataclasses.replace(problem.triangle, rows=weighty)
        far = np.abs(residual) > self.options.outlying * noise
        outlying = np.any(far & self.arcs.measured[..., None], axis=2)
        return Shot(
            c, _root(triangle.spectrum(), problem.scores), noise, triangle, int(outlying.sum()),
            self._cost(residual, noise),
        )  # fmt: skip

    def residuals(self, family, c, x) -> np.ndarray:
        """(B, L + 1, 2d) of the arcs from the states x (B, 2d); 0 where nothing was measured, not
        finite where a flow fails."""
        along = [x]
        for _ in range(self.arcs.states.shape[1] - 1):
            self.check()
            along.append(images(family, c, along[-1], self.dt, self.steps).states)
        return self._off(np.stack(along, axis=1), slice(None))

    def _off(self, predicted, block) -> np.ndarray:
        states, measured = self.arcs.states[block], self.arcs.measured[block]
        width = states.shape[-1]
        off = nearest_image((predicted - states).reshape(-1, width), self.angles)
        return np.where(measured[..., None], off.reshape(states.shape), 0.0)

    def _starts(self, family, c) -> np.ndarray:
        """(B, 2d): of the arcs' first few measured states, taken back, the one that the others of
        the arc bear out: one may be a gross error."""
        found, nearest = self.arcs.states[:, 0], np.full(len(self.arcs.states), np.inf)
        for k in range(min(self.options.first, self.arcs.states.shape[1])):
            x = self.arcs.states[:, k]
            for _ in range(k):
                x = images(family, c, x, -self.dt, self.steps).states
            off = np.abs(self.residuals(family, c, x) / self.scale).max(axis=2)
            off = np.where(np.isfinite(off), off, np.inf)
            distance = np.nanmedian(np.where(self.arcs.measured, off, np.nan), axis=1)
            better = (distance < nearest) & self.arcs.measured[:, k]
            found = np.where(better[:, None], x, found)
            nearest = np.where(better, distance, nearest)
            if np.all(nearest < self.options.alike * np.median(nearest)):
                break
        return found

    def _deviations(self, residual) -> np.ndarray:
        """(2d,) of the noise, from the residuals that are no gross errors."""
        known = residual[self.arcs.measured]
        free = max(1.0 - residual[:, 0].size / known.size, 0.5 / known.shape[1])
        return np.hypot(of_residuals(known, free, self.options.outlying), self.least)

    def _weights(self, residual, noise, block=slice(None)) -> np.ndarray:
        size = np.minimum(np.abs(residual) / (self.options.biweight * noise), 1.0)
        return np.where(self.arcs.measured[block][..., None], (1 - size**2) ** 2, 0.0)

    def _cost(self, residual, noise) -> float:
        """The mean of Tukey's ρ, in which small residuals count by their squares."""
        if not np.isfinite(residual).all():
            return np.inf
        limit = self.options.biweight
        size = np.minimum(np.abs(residual[self.arcs.measured]) / (limit * noise), 1.0)
        return float(np.mean(limit**2 / 3 * (1 - (1 - size**2) ** 3)))

    def _linearised(self, family, c, x, noise) -> _Arrow:
        count, width, length = len(c), x.shape[1], self.arcs.states.shape[1]
        size = max(1, self.options.block_bytes // (8 * length * width * (count + width)))
        triangle, parts = Triangle.empty(count), []
        for first in range(0, len(x), size):
            block = slice(first, first + size)
            by_state, by_c, residual = self._along(family, c, x[block], block)
            weight = np.sqrt(self._weights(residual, noise, block)) / noise
            rows = np.concatenate([by_state, by_c, residual[..., None]], axis=-1)
            rows = (weight[..., None] * rows).reshape(len(residual), length * width, -1)
            own, inside, rest = eliminated(rows, width)
            triangle = triangle.append(rest.reshape(-1, count + 1))
            parts.append((own, inside, rest[..., :-1].swapaxes(1, 2) @ rest[..., -1:]))
        own, inside, scores = (np.concatenate(part) for part in zip(*parts, strict=True))
        return _Arrow(triangle, own, inside, scores[..., 0])

    def _along(self, family, c, x, block) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """∂z_k/∂x, ∂z_k/∂c and the residuals along the arcs from x (b, 2d)."""
        lanes, width = x.shape
        by_state = [np.broadcast_to(np.eye(width), (lanes, width, width))]
        by_c, z, along = [np.zeros((lanes, width, len(c)))], x, [x]
        for _ in range(self.arcs.states.shape[1] - 1):
            self.check()
            step = images(family, c, z, self.dt, self.steps, derivatives=True)
            by_c.append(step.by_state @ by_c[-1] + step.by_coefficient)
            by_state.append(step.by_state @ by_state[-1])
            z = step.states
            along.append(z)
        residual = self._off(np.stack(along, axis=1), block)
        return np.stack(by_state, axis=1), np.stack(by_c, axis=1), residual


class _Arrow(NamedTuple):
    """triangle: of the rows of c that the arcs' own states do not explain. own: (B, 2d, 2d) each
    arc's triangle, inside: (B, 2d, m + 1) what it has of [∂r/∂c, r]. scores: (B, m) each arc's part
    of the gradient in c."""

    triangle: Triangle
    own: np.ndarray
    inside: np.ndarray
    scores: np.ndarray

    def shift(self, move) -> np.ndarray:
        """(B, 2d): of the latent states, where the coefficients make this move."""
        left = self.inside[..., :-1] @ move + self.inside[..., -1]
        try:
            return -np.linalg.solve(self.own, left[..., None])[..., 0]
        except np.linalg.LinAlgError:
            return -(np.linalg.pinv(self.own) @ left[..., None])[..., 0]


def _solved(spectrum: Spectrum) -> np.ndarray:
    return spectrum.solution(spectrum.inverse)


def _root(spectrum: Spectrum, scores) -> np.ndarray:
    """(m, m), rootᵀ root the covariance: that of independent noise, widened where the arcs' own
    gradients vary by more than noise makes them: misfit is alike along an arc."""
    root, (arcs, count) = spectrum.root().T, scores.shape
    vary = np.sum((scores @ root.T) ** 2) / count / max(1 - count / arcs, 1 / arcs)
    return root * np.sqrt(max(vary, 1.0))


def longest_arc(family, c, z, dt: float, steps: Steps, noise, options: Options = OPTIONS) -> int:
    """Steps of an arc: as many as it takes noise (÷ spread) to grow to ``grown`` from nearly all of
    the states z (n, 2d), and no more than ``longest``."""
    width = z.shape[1]
    carried = np.broadcast_to(np.eye(width), (len(z), width, width))
    size = z.std(axis=0)
    unit = size[None, :] / size[:, None]
    for k in range(1, options.longest + 1):
        step = images(family, c, z, dt, steps, derivatives=True)
        z, carried = step.states, step.by_state @ carried
        grown = np.linalg.norm(carried * unit, axis=(1, 2))
        if (
            not np.quantile(np.where(np.isfinite(grown), grown, np.inf), 0.9) * noise
            < options.grown
        ):
            return max(k - 1, 1)
    return options.longest
