"""A law along the arcs of a recording: what Gauss–Newton asks of it."""

from __future__ import annotations

import dataclasses

import numpy as np

from gfnn_jax.flows import coulomb
from gfnn_jax.flows.motion import Form
from gfnn_jax.maps.observation import Observation
from gfnn_jax.solve.arc_models import Defects, Observed


@dataclasses.dataclass(frozen=True, eq=False)
class LawOnArcs:
    """Steps h (A, L − 1) of a law with inputs u (A, L − 1, substeps, 6, k). What is seen are the
    channels of ``observation`` plus the ``zeros`` of angles; their coefficients come last, first
    the zeros', then the parameters of ``observation``. Coefficients that are not ``free`` (indices)
    stay as in ``given``."""

    form: Form
    observation: Observation
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

    def defects(self, p: np.ndarray, x: np.ndarray) -> Defects:
        arcs, length, m = x.shape
        whole, num = self.full(p), arcs * (length - 1)
        step, _ = coulomb.step(
            self.form,
            whole[: self.form.count],
            x[:, :-1].reshape(num, m),
            self.h.reshape(num),
            self.u.reshape(num, *self.u.shape[2:]),
            order=2 if len(self.free) else 1,
        )
        by = np.zeros((num, m, len(whole)))
        by[..., : step.by_coefficients.shape[-1]] = step.by_coefficients
        shape = (arcs, length - 1, m)
        return Defects(
            step.states.reshape(shape) - x[:, 1:],
            step.by_state.reshape(*shape, m),
            by[..., self.free].reshape(*shape, len(self.free)),
        )

    def observe(self, p: np.ndarray, x: np.ndarray) -> Observed:
        whole, first = self.full(p), self.form.count
        last = first + len(self.zeros)
        shown = self.observation(x, whole[last:])
        values, by = shown.values, np.zeros((*shown.values.shape, len(whole)))
        by[..., last:] = shown.by_coefficients
        for k, i in enumerate(self.zeros, first):
            channel = self.observation.direct[i]
            values[..., channel] += whole[k]
            by[..., channel, k] = 1.0
        return Observed(values, shown.by_state, by[..., self.free])
