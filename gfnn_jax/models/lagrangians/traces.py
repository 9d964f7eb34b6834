"""Traces of a fit: its arcs in the file's units, with the energy that they keep, lose and gain."""

from __future__ import annotations

import numpy as np

from gfnn_jax.data.recording import Recording
from gfnn_jax.families.lagrangian import Lagrangian
from gfnn_jax.flows.dormand_prince import WEIGHTS
from gfnn_jax.models.lagrangians.fit import LawFit
from gfnn_jax.models.lagrangians.residuals import Trace


def traces_of(recording: Recording, fit: LawFit, law: Lagrangian) -> tuple[Trace, ...]:
    """The arcs of a fit, channels in the file's units. An input supplies the mean of its force over
    a step times the way, and what terms that have it rise by at its mean; friction takes the mean
    of its power at the ends."""
    arcs, found, d = fit.arcs, [], fit.form.dim
    nodes, channels = fit.problem.nodes, fit.problem.observation.channels
    factors = np.array([recording.factors[name] for name in channels])
    left = fit.fitted.residuals * fit.sigma * arcs.noise
    acting = np.tensordot(fit.problem.inputs(arcs), WEIGHTS, axes=(3, 0)).mean(
        axis=2
    )  # (A, L − 1, m)
    for k, (i, a, b) in enumerate(arcs.home):
        n, stretch = b - a, nodes[i].stretch
        t, y, x = arcs.t[k, :n], arcs.y[k, :n] + nodes[i].zero, fit.fitted.x[k, :n]
        q, v = x[:, :d] + fit.zeros, x[:, d:]
        own = law.at(stretch.args)
        rate = own.power(q, v)[0][:, : law.friction.count + (law.uniform != 0)]
        lost = 0.5 * np.diff(t)[:, None] * (rate[1:] + rate[:-1])
        u = acting[k, : n - 1]
        supplied = u * (np.diff(q, axis=0) @ law.gains)
        if law.terms.driven:
            before, after = (law.terms.potentials(x, 0, u).value for x in (q[:-1], q[1:]))
            raised = own.coefficients * (after - before)
            supplied += raised @ law.terms.first_inputs(law.num_inputs)
        found.append(
            Trace(
                stretch.run,
                t,
                y / factors,
                (y - left[k, :n]) / factors,
                fit.fitted.residuals[k, :n],
                stretch.u[nodes[i].at[a:b]],
                own.energy(q, v),
                _summed(lost),
                _summed(supplied),
            )
        )
    return tuple(found)


def _summed(steps: np.ndarray) -> np.ndarray:
    """Sums (n, ...) of steps (n − 1, ...) since the first."""
    return np.concatenate([np.zeros((1, *steps.shape[1:])), np.cumsum(steps, axis=0)])
