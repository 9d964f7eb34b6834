"""Inputs of a map: what acts on the system during a step, sampled once a step, and in between held,
linear, or band-limited.

A step sees each input as a polynomial in the time since it began (`flows.forces`). Whatever the
rule between samples, its coefficients are linear in the samples, so that a rollout can be
differentiated in its inputs.
"""

import dataclasses
from functools import cache
from typing import Any, NamedTuple

import numpy as np

from gfnn_jax.arrays import as_numbers, as_row, beside, namespace
from gfnn_jax.flows.schedules import HOLDS, TAPS, band_weights

_DEGREE = {"hold": 0, "linear": 1, "band": 9}


class Scheduled(NamedTuple):
    """Args of rollouts: the values of parameters, or None, and the inputs' coefficients
    of every step (N, K) or (B, N, K)."""

    params: Any
    coefficients: Any

    def at(self, params, steps):
        """The args (B, ·) of the steps of these numbers (B,), with these parameters (…, k)."""
        xp, found = namespace(steps, self.coefficients), self.coefficients
        n = xp.clip(steps, 0, found.shape[-2] - 1)
        own = found[n] if found.ndim == 2 else found[np.arange(len(found)), n]
        return own if params is None else beside(params, own)


@dataclasses.dataclass(frozen=True)
class Signals:
    """The inputs of a map by name, and the rule between their samples.

    hold: "hold", the value at a step's begin; "linear"; or "band", the band-limited interpolation
    of evenly sampled values, by a windowed sinc of 64 samples. delay: seconds by which an input
    acts later than its samples say.
    """

    names: tuple[str, ...]
    hold: str = "hold"
    delay: float = 0.0

    def __post_init__(self):
        if self.hold not in HOLDS:
            raise ValueError(f"expected hold among {', '.join(HOLDS)}; got {self.hold!r}")

    @property
    def degree(self) -> int:
        """Degree of the polynomials."""
        return _DEGREE[self.hold]

    def constant(self, args, inputs, shape: tuple, dtype):
        """The args of a step of states of this shape during which the inputs, (k,) or (B, k), do
        not change; None: none acts. Raises ValueError for another shape."""
        count = len(self.names)
        u = np.zeros(count, dtype) if inputs is None else as_numbers(inputs, dtype, "inputs")
        if u.shape not in ((count,), (*shape[:-1], count)):
            raise ValueError(f"expected inputs {self._named} of shape ({count},), got {u.shape}")
        u = u if u.ndim == 2 else u[None]
        rest = np.zeros((*u.shape[:-1], self.degree * count), dtype)
        own = namespace(u).concatenate([u, rest], axis=-1)
        return own if args is None else beside(args, own)

    def scheduled(self, args, inputs, shape: tuple, dtype, dt, num_steps: int | None) -> Scheduled:
        """The args of rollouts from states of this shape.

        inputs: (N, k) or (B, N, k), of each step's begin; a row more is that at the end of the
        last. None: none acts. Raises ValueError for another shape.
        """
        count = len(self.names)
        u = np.zeros((1, count), dtype) if inputs is None else as_numbers(inputs, dtype, "inputs")
        lanes = u.shape[:-2] in ((), shape[:-1])
        long = (
            num_steps is None
            or inputs is None
            or u.shape[-2:-1] in ((num_steps,), (num_steps + 1,))
        )
        if u.ndim < 2 or u.shape[-1] != count or not lanes or not long:
            steps = "N" if num_steps is None else str(num_steps)
            raise ValueError(
                f"expected inputs {self._named} of shape ({steps}, {count}), or that of each "
                f"rollout, got {u.shape}"
            )
        return Scheduled(args, self.coefficients(u, dt))

    def coefficients(self, u, dt):
        """Coefficients (..., N, K), from samples u (..., N, k) a time dt apart, of the polynomials
        in each step; beyond the ends the samples are those at the ends. NumPy or JAX. Where there
        is a delay, dt is a number that is known."""
        later = self.delay / float(dt) if self.delay else 0.0
        xp, (first, weights) = namespace(u, dt), _stencil(self.hold, later)
        count = u.shape[-2]
        places = np.arange(count)[:, None] + first + np.arange(weights.shape[1])
        near = u[..., np.clip(places, 0, count - 1), :]  # (..., N, samples, k)
        found = xp.einsum("js,...nsk->...njk", weights.astype(u.dtype), near)
        unit = xp.asarray(dt, u.dtype) ** np.arange(len(weights), dtype=u.dtype)
        return (found / as_row(unit[:, None], found)).reshape(*u.shape[:-1], -1)

    def stencil(self, dt: float) -> tuple[int, np.ndarray]:
        """(first, weights): where the samples begin that a step takes, counted from that of its
        begin, and the coefficients (degree + 1, samples) of its polynomial in time."""
        first, weights = _stencil(self.hold, self.delay / dt)
        used = np.flatnonzero(weights.any(axis=0))
        weights = weights[:, used[0] : used[-1] + 1]
        return first + int(used[0]), weights / dt ** np.arange(len(weights))[:, None]

    @property
    def _named(self) -> str:
        return ", ".join(self.names)


@cache
def _stencil(hold: str, delay: float) -> tuple[int, np.ndarray]:
    """(first, weights): where the samples begin that a step takes, counted from its own, and the
    coefficients (degree + 1, samples) of their polynomial in units of dt, ``delay`` with them.

    An input that is held or linear has a jump or a bend within a step where it is delayed by a part
    of it: the polynomial is then the nearest in the mean square, of the same momentum.
    """
    whole = int(np.floor(delay))
    reach = TAPS if hold == "band" else 1
    places = np.arange(1 - reach - (delay > whole), reach + 1) - whole
    count = _DEGREE[hold] + 1
    if hold == "band":
        at = 0.5 - 0.5 * np.cos(np.pi * (np.arange(count) + 0.5) / count)  # Chebyshev's
        weights = np.ones(count)
    else:
        at, weights = _on_either_side(delay - whole)
    values = _shares(hold, at - delay, places)
    root = np.sqrt(weights)[:, None]
    powers = np.vander(at, count, increasing=True)
    found = np.linalg.lstsq(root * powers, root * values, rcond=None)[0]
    return int(places[0]), np.where(np.abs(found) > 1e-15, found, 0.0)


def _on_either_side(part: float) -> tuple[np.ndarray, np.ndarray]:
    """Gauss's nodes and weights in a step before and after this part of it."""
    x, w = np.polynomial.legendre.leggauss(3)
    ends = [(0.0, part), (part, 1.0)] if part else [(0.0, 1.0)]
    nodes = [a + (b - a) * (x + 1) / 2 for a, b in ends]
    return np.concatenate(nodes), np.concatenate([(b - a) * w / 2 for a, b in ends])


def _shares(hold: str, at: np.ndarray, places: np.ndarray) -> np.ndarray:
    """Weights (n, k) of samples at the whole numbers ``places`` (k,) in values at times (n,)."""
    distance = at[:, None] - places
    if hold == "hold":
        return ((distance >= 0) & (distance < 1)).astype(float)
    if hold == "linear":
        return np.maximum(0.0, 1 - np.abs(distance))
    return band_weights(distance)
