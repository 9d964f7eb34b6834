"""A sensor of which one reading shows several coordinates: the others are hidden."""

from __future__ import annotations

import dataclasses
from functools import cached_property

import numpy as np

from gfnn_jax.signals.oscillations import Oscillations


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
