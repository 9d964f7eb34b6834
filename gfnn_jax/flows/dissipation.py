"""Friction of Rayleigh's function R = Σ ρ_k r_k(c_k·v) at many states at once, the states last."""

from __future__ import annotations

import dataclasses

import numpy as np

from gfnn_jax.families.lagrangian import DRY, LINEAR, QUADRATIC, UNIFORM, Friction


@dataclasses.dataclass(frozen=True, eq=False)
class Dissipation:
    """Rows of ``friction`` that are not uniform: their directions (F, d), the outer products of
    these (d², F), which rows (indices) are linear, quadratic, or dry and smoothed, the widths (n,
    1) of those, and which are dry without a width. even: of all rows, which are uniform."""

    friction: Friction
    directions: np.ndarray
    outer: np.ndarray
    linear: np.ndarray
    quadratic: np.ndarray
    smoothed: np.ndarray
    widths: np.ndarray
    coulomb: np.ndarray
    even: np.ndarray

    @classmethod
    def of(cls, friction: Friction) -> Dissipation:
        even = friction.kinds == UNIFORM
        own = friction.take(~even)
        c, coulomb = own.directions.astype(float), coulomb_rows(own)
        outer = (c[:, :, None] * c[:, None]).reshape(len(c), c.shape[1] ** 2).T
        smoothed = np.flatnonzero((own.kinds == DRY) & ~coulomb)
        linear, quadratic = (np.flatnonzero(own.kinds == kind) for kind in (LINEAR, QUADRATIC))
        widths = own.widths[smoothed][:, None]
        return cls(
            friction, c, outer, linear, quadratic, smoothed, widths, np.flatnonzero(coulomb), even
        )

    def derivatives(self, v: np.ndarray, order: int) -> tuple[np.ndarray, np.ndarray]:
        """dr/ds and d²r/ds² (F, N) of the terms r of R, at velocities v (d, N); with ``order`` 0
        the second ones are not all computed. As `Friction.tables`, row by row."""
        s = self.directions @ v
        first, second = np.sign(s), np.zeros_like(s)
        first[self.linear] = s[self.linear]
        first[self.quadratic] *= s[self.quadratic] ** 2
        if len(self.smoothed):
            root = np.hypot(s[self.smoothed], self.widths)
            first[self.smoothed] = s[self.smoothed] / root
            second[self.smoothed] = (self.widths / root) ** 2 / root  # ε²/root³ underflows
        if order:
            second[self.linear] = 1.0
            second[self.quadratic] = 2 * np.abs(s[self.quadratic])
        return first, second


def coulomb_rows(friction: Friction) -> np.ndarray:
    """The dry friction (F,) that has no width: its force jumps where its speed turns."""
    return (friction.kinds == DRY) & (friction.widths == 0)
