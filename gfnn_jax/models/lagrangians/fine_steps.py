"""Runge–Kutta steps between nodes, so short that what they are wrong by moves no coefficient.

One evaluation of the arcs with steps half as long tells by how much these would move the
coefficients of a fit: by the Gauss–Newton step that they ask for, less what is left of the fit's
own. Of a step of order 5 the error falls with the fifth power of its length; where dry friction
acts or inputs jump it falls more slowly, and what the shorter steps are wrong by is measured again.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np

from gfnn_jax.models.lagrangians.fit import LawFit, Workbench
from gfnn_jax.solve.latent_arcs import sensitivities

_MOVED = 1 / 3  # of a standard error: what steps may move a combination of coefficients by
_ORDER = 5
_MOST, _SHORTEST = 6, 1 / 32  # times that steps are shortened, and to which part of the first


def with_fine_steps(
    bench: Workbench, fit: LawFit, on_progress: Callable[[str], object]
) -> tuple[Workbench, LawFit]:
    """The fit, and the workbench, with steps between nodes of which shorter ones move nothing."""
    first = bench.inputs.substeps
    for _ in range(_MOST):
        now = bench.inputs.substeps
        moved = _moved(_with_steps(bench, 2 * now), fit)
        if not moved > _MOVED or now >= first / _SHORTEST:
            break
        more = np.ceil(now * (moved / _MOVED) ** (1 / _ORDER))
        finer = _with_steps(bench, int(np.clip(more, now + 1, first / _SHORTEST)))
        on_progress(
            f"{finer.inputs.substeps} steps between nodes: {now} move coefficients by {moved:.2g} "
            "standard errors"
        )
        arcs = dataclasses.replace(fit.arcs, x=fit.fitted.x)
        other = finer.fit(fit.structure, fit.values, arcs, fit.sigma)
        if not np.isfinite(other.fitted.cost):
            break
        bench, fit = finer, other
    return bench, fit


def _with_steps(bench: Workbench, count: int) -> Workbench:
    return dataclasses.replace(bench, inputs=bench.inputs.of_steps(count))


def _moved(finer: Workbench, fit: LawFit) -> float:
    """The most by which any combination of coefficients moves, in its standard errors; 0 of a fit
    that tells none."""
    n, before = len(fit.p), fit.fitted.factor
    if not (n and np.isfinite(fit.fitted.cost)):
        return 0.0
    model = finer.model(fit.structure, fit.arcs, fit.p, np.arange(n))
    noise, whitening = fit.sigma * fit.arcs.noise, finer.whitening(fit.arcs)
    after = sensitivities(
        model, fit.p, fit.fitted.x, fit.arcs.y, noise, finer.observation.loss, whitening
    )
    if not np.isfinite(after).all():
        return 0.0
    left, asked = (np.linalg.lstsq(R[:n, :n], R[:n, n])[0] for R in (before, after))
    return float(np.linalg.norm(before[:n, :n] @ (asked - left)) / np.sqrt(fit.correlation))
