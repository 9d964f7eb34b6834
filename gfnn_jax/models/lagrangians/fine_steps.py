"""Runge–Kutta steps between nodes, so short that what they are wrong by moves no coefficient.

One evaluation of the arcs with steps half as long tells by how much these would move the
coefficients of a fit: by the Gauss–Newton step that they ask for, less that which the fit's own
steps do. Of a step of order 5 the error falls with the fifth power of its length. Where dry
friction acts or inputs jump it falls more slowly, so that it is measured again.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np

from gfnn_jax.models.lagrangians.fit import LawFit, Workbench

_MOVED = 1 / 3  # of a standard error: what steps may move a combination of coefficients by
_ORDER = 5
_TIMES = 6  # that steps are shortened
_GAINS = 0.5  # times what longer steps moved: shortening that leaves more does not help
_SHORTEST = 0.02  # radians of the fastest motion in a step


def with_fine_steps(
    bench: Workbench, fit: LawFit, on_progress: Callable[[str], object]
) -> tuple[Workbench, LawFit]:
    """The fit, and the workbench, with steps between nodes of which shorter ones move nothing; a
    line says where the shortest still do."""
    if not (len(fit.p) and np.isfinite(fit.fitted.cost)):
        return bench, fit
    most = int(np.ceil(bench.omega * np.median(np.diff(fit.arcs.t, axis=1)) / _SHORTEST))
    before = np.inf
    for _ in range(_TIMES):
        now, within = bench.inputs.substeps, bench.inputs.within_samples
        half = within(2 * now) if within(now) == now else 2 * now
        moved = _moved(bench, _with_steps(bench, half), fit)
        if not moved > _MOVED:
            return bench, fit
        count = int(max(np.ceil(now * (moved / _MOVED) ** (1 / _ORDER)), now + 1))
        if moved > _GAINS * before:
            count = within(now)
        if now >= most or count == now:
            break
        finer = _with_steps(bench, min(count, most))
        arcs = dataclasses.replace(fit.arcs, x=fit.fitted.x)
        other = finer.fit(fit.structure, fit.values, arcs, fit.sigma)
        if not np.isfinite(other.fitted.cost):
            break
        on_progress(
            f"{finer.inputs.substeps} steps between nodes: {now} move coefficients by {moved:.2g} "
            "standard errors"
        )
        bench, fit, before = finer, other, moved
    on_progress(f"{bench.inputs.substeps} steps between nodes, which are too few for this noise")
    return bench, fit


def _with_steps(bench: Workbench, count: int) -> Workbench:
    return dataclasses.replace(bench, inputs=bench.inputs.of_steps(count))


def _moved(bench: Workbench, finer: Workbench, fit: LawFit) -> float:
    """The most by which any combination of coefficients moves, in its standard errors; 0 where no
    orbit follows the arcs by the finer steps."""
    here, there = (one.linearised(fit.structure, fit) for one in (bench, finer))
    if not (here.triangle.finite and there.triangle.finite):
        return 0.0
    return here.moved_by(there)
