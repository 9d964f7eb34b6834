"""The equation of motion in weak form: linear in the coefficients, and free of accelerations.

    ∫ (−φ̇ ∂ℓ_j/∂v − φ ∂ℓ_j/∂q) dt        for a term of L,
    ∫ φ ∂r_k/∂v dt                         for a friction,      −∫ φ u dt   for a gain

with bumps φ = (s(1 − s))³ along windows of the record, in which the term d/dt was integrated by
parts.
"""

from __future__ import annotations

import numpy as np

from gfnn_jax.families.lagrangian import functions_of
from gfnn_jax.flows.motion import Form

_SPACING = 0.25  # of a window's length, from one window to the next


def weak_rows(
    form: Form,
    t: np.ndarray,
    q: np.ndarray,
    v: np.ndarray,
    u: np.ndarray,
    length: float,
    args: np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Rows (windows, d, count) of the coefficients, and what the fixed part of the law gives
    (windows, d); their sum with the coefficients is zero for the law. Along one stretch: t (n,),
    q and v (n, d), u (n, inputs); ``length`` of the windows in units of t; args (k,) the parameters
    of the system, where the law has such."""
    terms, d = form.terms, form.dim
    weights = np.ones(terms.count + form.friction.count)
    if form.powers is not None:
        weights = functions_of(form.powers, args)[: len(weights)]
    f, df, _ = terms.potentials(q, order=1)
    g, dg = terms.motion(v)
    momentum = (dg * f[..., None]).swapaxes(1, 2)  # (n, d, P)
    force = (df * g[..., None]).swapaxes(1, 2)
    lost = form.friction.residuals(v).swapaxes(1, 2)
    starts = np.arange(t[0], t[-1] - length, _SPACING * length)
    columns, targets = [], []
    for start in starts:
        i, j = np.searchsorted(t, (start, start + length))
        if j - i < 7:
            continue
        s = (t[i:j] - start) / length
        weight = np.gradient(t[i:j])
        bump = s * (1 - s)
        phi, slope = bump**3 * weight, 3 * bump**2 * (1 - 2 * s) / length * weight
        norm = np.sqrt(np.sum(slope**2))  # of the noise that v brings
        phi, slope = phi / norm, slope / norm
        of_terms = -np.tensordot(slope, momentum[i:j], 1) - np.tensordot(phi, force[i:j], 1)
        of_terms = of_terms * weights[: terms.count]
        row = [of_terms @ form.basis, np.tensordot(phi, lost[i:j], 1) * weights[terms.count :]]
        if form.num_inputs:
            push = -np.tensordot(phi, u[i:j], 1)
            row.append((push[None, None, :] * np.eye(d)[:, :, None]).reshape(d, -1))
        columns.append(np.concatenate(row, axis=1))
        targets.append(of_terms @ form.fixed)
    if not columns:
        return np.zeros((0, d, form.count)), np.zeros((0, d))
    return np.array(columns), np.array(targets)
