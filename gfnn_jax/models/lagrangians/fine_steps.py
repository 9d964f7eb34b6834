"""Runge–Kutta steps between nodes, so short that what they are wrong by moves no coefficient.

One evaluation of the arcs with steps half as long tells by how much these would move the
coefficients of a fit: by the Gauss–Newton step that they ask for, less that which the fit's own
steps do. Of a step of order 5 the error falls with the fifth power of its length. Where dry
friction acts or inputs jump it falls more slowly, so that it is measured again.
"""

import dataclasses

import numpy as np

from gfnn_jax.models.lagrangians.fit import ArcProblem, LawFit

_MOVED = 1 / 3  # of a standard error: what steps may move a combination of coefficients by
_ORDER = 5
_TIMES = 6  # that steps are shortened
_GAINS = 0.5  # times what longer steps moved: shortening that leaves more does not help
_SHORTEST = 0.02  # radians of the fastest motion in a step


def with_fine_steps(fit: LawFit) -> LawFit:
    """The fit, with steps between nodes of which shorter ones move nothing; a line says where the
    shortest still do."""
    if not (len(fit.p) and fit.follows):
        return fit
    problem, before = fit.problem, np.inf
    step = problem.scales.omega * np.median(np.diff(fit.arcs.t, axis=1))
    most = int(np.ceil(step / _SHORTEST))
    for _ in range(_TIMES):
        inputs = fit.problem.inputs
        now, within = inputs.substeps, inputs.within_samples
        half = within(2 * now) if within(now) == now else 2 * now
        moved = _moved(_with_steps(fit, half), fit)
        if not moved > _MOVED:
            return fit
        count = int(max(np.ceil(now * (moved / _MOVED) ** (1 / _ORDER)), now + 1))
        size = moved * float(np.mean(fit.sigma / fit.spread))  # errors of steps are in σ too
        if size > _GAINS * before:
            count = within(now)
        if now >= most or count == now:
            break
        finer = _with_steps(fit, min(count, most))
        other = fit.again(problem=finer)
        if not other.follows:
            break
        problem.on_progress(
            f"{finer.inputs.substeps} steps between nodes: {now} move coefficients by {moved:.2g} "
            "standard errors"
        )
        fit, before = other, size
    count = fit.problem.inputs.substeps
    problem.on_progress(f"{count} steps between nodes, which are too few for this noise")
    return fit


def _with_steps(fit: LawFit, count: int) -> ArcProblem:
    return dataclasses.replace(fit.problem, inputs=fit.problem.inputs.of_steps(count))


def _moved(finer: ArcProblem, fit: LawFit) -> float:
    """The most by which any combination of coefficients moves, in its standard errors; 0 where no
    orbit follows the arcs by the finer steps."""
    here, there = (one.linearised(fit.structure, fit) for one in (fit.problem, finer))
    if not (here.triangle.finite and there.triangle.finite):
        return 0.0
    return here.moved_by(there)
