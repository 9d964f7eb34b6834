"""Covariance of a law's coefficients, from each row's own residual; and what its residuals are.

A law near the true one errs by a map that is symplectic too, residual = J∇K of some generator K;
noise is none. The part of the mean square that no K explains is noise, if K explains more than
noise would let it (an F test); what K explains is misfit.
"""

from collections.abc import Sequence

import numpy as np

from gfnn_jax.dataset.dataset import Dataset
from gfnn_jax.dataset.runs import looked_at
from gfnn_jax.families.family import at_time
from gfnn_jax.families.inputs import box_inputs
from gfnn_jax.families.products import Products
from gfnn_jax.families.sums import Sums
from gfnn_jax.families.terms import Terms, multiplied
from gfnn_jax.families.told import Constrained
from gfnn_jax.fitting import least_squares, uncertainty
from gfnn_jax.fitting.evidence import EVIDENCE
from gfnn_jax.fitting.gauss_newton import Problem
from gfnn_jax.fitting.significance import null_terms
from gfnn_jax.flows.collocation import Steps
from gfnn_jax.flows.flow import Flow
from gfnn_jax.flows.uniform import without_forces
from gfnn_jax.models.hamiltonians.fitted_law import FittedLaw
from gfnn_jax.models.hamiltonians.problem import OPTIONS
from gfnn_jax.models.parameters import states_and_functions
from gfnn_jax.phase_space import apply_j, symplectic_form


def covariance_root(law: FittedLaw, flows: Problem, data: Dataset, steps: Steps) -> np.ndarray:
    """(m, m): rootᵀ root is the covariance of the coefficients. What is noise, a generator of
    polynomials tells, which does not explain it, of sites the terms of a larger library; what they
    explain is misfit, of these steps too."""
    fit, count, structure = law.fit, law.family.num_parameters, data.structure
    width = data.y0.shape[1]
    most = max(OPTIONS.fewest_sampled, OPTIONS.sampled_rows * count // width)
    if structure is not None:
        most = max(structure.fewest(width), OPTIONS.fewest_sampled // width)
    places, goes_on = looked_at(data.pairs, fit.used, most)
    rows = fit.used[places]
    unit, scale = flows.unit(rows), flows.scale
    images = flows.images(law.family, fit.coefficients, rows, steps, derivatives=True)
    residual = images.states - data.y1[rows]
    if not np.isfinite(residual).all():  # of a flow that runs away from some of the states
        return np.full((count, count), np.nan)
    slopes = images.by_coefficient / unit[..., None]
    left, scores, noise = residual / unit, None, None
    family = without_forces(law.family)
    family = family.family if isinstance(family, Constrained) else family
    if isinstance(family, Terms):  # of many coordinates both would take too much
        states = None
        if goes_on.any():
            first = images.by_state * scale
            second = np.broadcast_to(-np.diag(scale), first.shape)
            scores = uncertainty.scores(
                slopes, left, first / unit[..., None], second / unit[..., None], goes_on
            )
            states = first, second, goes_on
        residuals = _Residuals(data, rows, residual, count)
        noise = residuals.unexplained(residuals.polynomials(_degree(family)), states)
    elif structure is not None and isinstance(family, Sums):
        known = np.concatenate([slopes, left[..., None]], axis=-1)
        noise = _unexplained_of_sites(law, flows, data, rows, steps, known)
    return uncertainty.root(
        fit.triangle,
        count,
        (slopes.reshape(-1, count), np.hypot(left, OPTIONS.near_roundoff).ravel()),
        noise=noise,
        scores=scores,
    )


def leaves_white(flow: Flow, data: Dataset) -> bool:
    """Return whether a law is right, as far as the pairs tell: no generator explains more than
    chance of what its flow leaves over. False also where that is not known."""
    return noise_left(flow, data) == 1.0


def noise_left(flow: Flow, data: Dataset) -> float | None:
    """The part of the mean square which the flow of a law leaves over that no generator explains.
    None where the pairs are too few for the test, for an H over sites, and for pairs of many dt."""
    family = without_forces(flow.family)
    plain = isinstance(family, Terms) and data.own_dt is None and data.structure is None
    if not plain:
        return None
    rows = np.sort(data.training)[: OPTIONS.white_pairs]
    residual = data.y1[rows] - flow.image(data.y0[rows], data.given(rows)[1])
    known = np.isfinite(residual).all(axis=1)
    residuals = _Residuals(data, rows[known], residual[known], flow.family.num_parameters)
    if data.args is None:
        generators = residuals.polynomials(_degree(family))
    else:
        states, functions = states_and_functions(data, rows)
        every = (multiplied(state, own) for own in functions[0] for state in states)
        generators = sorted(every, key=lambda family: family.num_parameters)
    return residuals.unexplained(generators)


def _degree(family: Terms) -> int:
    """The highest degree of the terms."""
    return int(np.max(np.sum(family.powers, axis=1), initial=0))


class _Residuals:
    """Residuals (n, 2d) of a law, which was given ``taken`` coefficients, on these rows."""

    def __init__(self, data: Dataset, rows: np.ndarray, residual: np.ndarray, taken: int):
        self.data, self.rows, self.residual, self.taken = data, rows, residual, taken
        self.images = data.y1[rows]

    def polynomials(self, degree: int) -> list[Products]:
        """Generators by rising size, up to beyond the law's own degree."""
        angles = tuple(a for a in self.data.coordinates.angles if a < self.data.dim)
        inputs = box_inputs(self.images, angles=angles, cyclic=self.data.coordinates.cyclic)
        degrees = sorted({*OPTIONS.generators, degree + OPTIONS.beyond})
        return [Products(inputs, n) for n in degrees]

    def unexplained(
        self, generators: Sequence[Products | Terms], states: tuple | None = None
    ) -> float | None:
        """Part of the mean square that no generator K explains, residual = J∇K at the images: K the
        largest that the rows tell. generators: by rising size. states: the residual's derivatives
        and which pairs go on, as `uncertainty.scores` takes them. None where the rows are too few.

        1 where K explains no more than it would of noise, by two standard errors: an F test.
        """
        data, z, width = self.data, self.images, self.residual.shape[1]
        most = min(len(self.rows) * width // OPTIONS.sampled_rows, OPTIONS.most_terms)
        known = [family for family in generators if family.num_parameters <= most]
        if not known:
            return None
        family, weight, given = known[-1], 1.0 / np.roll(data.scale, data.dim), ()
        if isinstance(family, Terms):  # functions of the args alone have no gradient
            later = at_time(family, data.given(self.rows)[1], data.dt)  # at the end of a pair
            family, given = family.take(null_terms(family, z, args=later)[0]), (later,)
        target = -apply_j(self.residual)
        reduced = least_squares.reduce(family, [(z, target, *given)], weight)
        count, freedom = family.num_parameters, None
        if states is not None:
            to_target = -weight[:, None] * symplectic_form(data.dim)
            slopes, (first, second, goes_on) = family.term_gradients(z) * weight[:, None], states
            scores = uncertainty.scores(
                slopes, weight * target, to_target @ first, to_target @ second, goes_on
            )
            freedom = uncertainty.degrees_of_freedom(slopes, weight * target, scores)
        left = reduced.norm**2 / max(reduced.rows - self.taken, 1)
        if left == 0:
            return 1.0
        part = float(uncertainty.variance(reduced, count, freedom) / left)
        return _certain(part, count, reduced.rows)


def _certain(part: float, count: int, rows: int) -> float:
    """The part of a mean square that ``count`` terms leave, 1 where that may be by chance."""
    by_chance = EVIDENCE.chance * np.sqrt(2 * count) / rows
    return part if part < 1 - by_chance else 1.0


def _unexplained_of_sites(
    law: FittedLaw, flows: Problem, data: Dataset, rows, steps: Steps, known: np.ndarray
) -> float | None:
    """The part of a mean square, of a structure, that the next library's terms, small beside the
    law's, do not explain. known (n, 2d, terms + 1): slopes and residuals of the law."""
    assert data.structure is not None
    family, count, left = law.family, law.family.num_parameters, known[..., -1].ravel()
    libraries = (f for f in data.structure.libraries(data.dim) if f.num_parameters > count)
    larger = next(libraries, None)
    if larger is None or OPTIONS.sampled_rows * (count + larger.num_parameters) > left.size:
        return None
    further = flows.images(
        family, law.fit.coefficients, rows, steps, derivatives=True, along=larger
    ).by_coefficient
    further = further / flows.unit(rows)[..., None]
    columns = np.concatenate([known[..., :-1], further], axis=-1).reshape(left.size, -1)
    size = np.linalg.norm(columns, axis=0)
    columns = columns / np.where(size > 0, size, 1.0)
    solved, _, rank, _ = np.linalg.lstsq(columns, left, rcond=1e-10)
    over = np.sum((left - columns @ solved) ** 2) / max(left.size - rank, 1)
    total = np.sum(left**2) / max(left.size - count, 1)
    return _certain(float(over / total) if total > 0 else 1.0, int(rank), left.size)
