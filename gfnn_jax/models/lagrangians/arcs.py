"""A law along the arcs of a recording: what Gauss–Newton asks of it."""

from __future__ import annotations

import dataclasses

import numpy as np

from gfnn_jax.flows.motion import Form
from gfnn_jax.maps.observation import Observation
from gfnn_jax.solve.latent_arcs import Defects, Observed

_SMALL = 0.01  # of a step, over which velocities are differenced


@dataclasses.dataclass(frozen=True, eq=False)
class LawOnArcs:
    """Steps h (A, L − 1) of a law with inputs u (A, L − 1, substeps, 6, k). What is seen are the
    channels of ``observation`` plus the ``zeros`` of angles; their coefficients come last, first
    the zeros', then the parameters of ``observation``. Coefficients that are not ``free`` (indices)
    stay as in ``given``. args (A, k): parameters of the system that each arc is of, where the
    coefficients depend on such."""

    form: Form
    observation: Observation
    zeros: tuple[int, ...]
    h: np.ndarray
    u: np.ndarray
    given: np.ndarray
    free: np.ndarray
    args: np.ndarray | None = None

    def full(self, p: np.ndarray) -> np.ndarray:
        """All coefficients, of the free ones."""
        whole = self.given.copy()
        whole[self.free] = p
        return whole

    def _of_arcs(self, whole: np.ndarray) -> tuple[Form, np.ndarray, np.ndarray | None]:
        """The form of one system, its coefficients, (n,) or (A, n), and their derivatives (A, n,
        count) in those of the form, None where they are the same."""
        coefficients = whole[: self.form.count]
        if self.args is None:
            return self.form, coefficients, None
        return self.form.in_systems(coefficients, self.args)

    def defects(self, p: np.ndarray, x: np.ndarray) -> Defects:
        arcs, length, m = x.shape
        whole, num = self.full(p), arcs * (length - 1)
        form, coefficients, turn = self._of_arcs(whole)
        if turn is not None:
            coefficients = np.repeat(coefficients, length - 1, axis=0)
        step = form.step(
            coefficients,
            x[:, :-1].reshape(num, m),
            self.h.reshape(num),
            self.u.reshape(num, *self.u.shape[2:]),
            order=2 if len(self.free) else 1,
        )
        of_step = step.by_coefficients
        if turn is not None and len(self.free):
            of_step = (of_step.reshape(arcs, -1, turn.shape[1]) @ turn).reshape(num, m, -1)
        by = np.zeros((num, m, len(whole)))
        by[..., : of_step.shape[-1]] = of_step
        shape = (arcs, length - 1, m)
        return Defects(
            step.states.reshape(shape) - x[:, 1:],
            step.by_state.reshape(*shape, m),
            by[..., self.free].reshape(*shape, len(self.free)),
        )

    def observe(self, p: np.ndarray, x: np.ndarray) -> Observed:
        whole, first = self.full(p), self.form.count
        last = first + len(self.zeros)
        shown, by_law = self._shown(x, whole, whole[last:])
        values, by = shown.values, np.zeros((*shown.values.shape, len(whole)))
        by[..., last:] = shown.by_coefficients
        by[..., :first] = by_law
        for k, i in enumerate(self.zeros, first):
            channel = self.observation.direct[i]
            values[..., channel] += whole[k]
            by[..., channel, k] = 1.0
        return Observed(values, shown.by_state, by[..., self.free])

    def _shown(
        self, x: np.ndarray, whole: np.ndarray, values: np.ndarray
    ) -> tuple[Observed, np.ndarray | float]:
        """Channels of states, and their derivatives in the coefficients of the law."""
        if not self.observation.accelerated:
            return self.observation(x, values), 0.0
        form, coefficients, turn = self._of_arcs(whole)
        u = np.concatenate([self.u[:, :, 0, 0], self.u[:, -1:, -1, -1]], axis=1)
        small = _SMALL * float(np.median(self.h[self.h > 0]))
        shown, by = self.observation.along(form, coefficients, x, u, small, values)
        return shown, by if turn is None else by @ turn[:, None]

    def take(self, arcs: np.ndarray) -> LawOnArcs:
        args = None if self.args is None else self.args[arcs]
        return dataclasses.replace(self, h=self.h[arcs], u=self.u[arcs], args=args)
