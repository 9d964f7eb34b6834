"""A law along the arcs of a recording: what Gauss–Newton asks of it."""

from __future__ import annotations

import dataclasses

import numpy as np

from gfnn_jax.flows.motion import Form
from gfnn_jax.solve.latent_arcs import Observed, Steps


@dataclasses.dataclass(frozen=True, eq=False)
class LawOnArcs:
    """Steps h (A, L − 1) of a law with inputs u (A, L − 1, substeps, 6, k). What is seen is the
    position plus the angle's ``zeros``, the last coefficients. Coefficients that are not ``free``
    (indices) stay as in ``given``."""

    form: Form
    zeros: tuple[int, ...]
    h: np.ndarray
    u: np.ndarray
    given: np.ndarray
    free: np.ndarray

    def full(self, p: np.ndarray) -> np.ndarray:
        """All coefficients, of the free ones."""
        whole = self.given.copy()
        whole[self.free] = p
        return whole

    def steps(self, p: np.ndarray, x: np.ndarray) -> Steps:
        arcs, length, m = x.shape
        whole, num = self.full(p), arcs * (length - 1)
        step = self.form.step(
            whole[: self.form.count],
            x[:, :-1].reshape(num, m),
            self.h.reshape(num),
            self.u.reshape(num, *self.u.shape[2:]),
            sensitive=len(self.free) > 0,
        )
        by = np.zeros((num, m, len(whole)))
        by[..., : step.by_coefficients.shape[-1]] = step.by_coefficients
        shape = (arcs, length - 1, m)
        return Steps(
            step.states.reshape(shape) - x[:, 1:],
            step.by_state.reshape(*shape, m),
            by[..., self.free].reshape(*shape, len(self.free)),
        )

    def observe(self, p: np.ndarray, x: np.ndarray) -> Observed:
        d, whole = self.form.dim, self.full(p)
        values = x[..., :d].copy()
        by_state = np.zeros((*values.shape, 2 * d))
        by_state[..., range(d), range(d)] = 1.0
        by = np.zeros((*values.shape, len(whole)))
        for k, i in enumerate(self.zeros, self.form.count):
            values[..., i] += whole[k]
            by[..., i, k] = 1.0
        return Observed(values, by_state, by[..., self.free])
