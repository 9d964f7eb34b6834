"""Runge–Kutta steps between nodes, so short that what they are wrong by moves no coefficient.

The first are by the noise alone (`Scales.substeps`). Of a law that was fitted, one evaluation of
its arcs with steps half as long tells by how much these would move its coefficients: by the
Gauss–Newton step that they ask for, of which a part may be left from the fit itself. Where dry
friction acts or inputs jump, a step is wrong by more than its order says.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np

from gfnn_jax.models.lagrangians.fit import LawFit, Workbench
from gfnn_jax.solve.latent_arcs import sensitivities

_MOVED = 1 / 3  # of a standard error: what steps may move a combination of coefficients by
_MOST = 3  # halvings


def with_fine_steps(
    bench: Workbench, fit: LawFit, on_progress: Callable[[str], object]
) -> tuple[Workbench, LawFit]:
    """The fit, and the workbench, with steps of which half as long ones move no coefficient."""
    for _ in range(_MOST):
        finer = dataclasses.replace(bench, inputs=bench.inputs.finer())
        moved = _moved(finer, fit)
        if not moved > _MOVED:
            break
        on_progress(
            f"{finer.inputs.substeps} steps between nodes: fewer move coefficients by {moved:.2g} "
            "standard errors"
        )
        arcs = dataclasses.replace(fit.arcs, x=fit.fitted.x)
        other = finer.fit(fit.structure, fit.values, arcs, fit.sigma)
        if not np.isfinite(other.fitted.cost):
            break
        bench, fit = finer, other
    return bench, fit


def _moved(finer: Workbench, fit: LawFit) -> float:
    """The most by which any combination of coefficients moves, in its standard errors; 0 of a fit
    that tells none."""
    if not (len(fit.p) and np.isfinite(fit.fitted.cost)):
        return 0.0
    n, before = len(fit.p), fit.fitted.factor
    model = finer.model(fit.structure, fit.arcs, fit.p, np.arange(n))
    noise, white = fit.sigma * fit.arcs.noise, finer.whitening(fit.arcs)
    after = sensitivities(
        model, fit.p, fit.fitted.x, fit.arcs.y, noise, finer.observation.loss, white
    )
    if not np.isfinite(after).all():
        return 0.0
    own = (np.linalg.lstsq(R[:n, :n], R[:n, n])[0] for R in (before, after))
    first, second = own
    return float(np.linalg.norm(before[:n, :n] @ (second - first)) / np.sqrt(fit.correlation))
