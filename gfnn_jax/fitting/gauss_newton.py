"""Fit of a Hamiltonian through its flow: minimise ‖Φ_h(z₀; c) − z₁‖² over H = Σ c_j φ_j.

Φ_h is Gauss collocation in NumPy, its derivative in c exact, so that a fit needs neither derivative
data nor small steps. Gauss–Newton steps with a trust region (Levenberg–Marquardt) from the better
of two linear starts; pairs that the present H already explains come first, the others follow.

The rows [∂r/∂c, r] of a Gauss–Newton problem are folded, block by block, into one triangle
(`fitting.triangle`): of its singular values come every damping at once, the condition number and
the standard errors. The loop is that of `solve.levenberg_marquardt`.

Coefficients without some of the rows (`without_each`): close to the optimum of all rows one
Gauss–Newton step leads to that of most of them, and its problem is the sum of those of the parts
that are kept: each part is linearised once, whichever is left out (approximate cross-validation:
Rad & Maleki, J. R. Stat. Soc. B 82, 2020). Each step is checked by the residuals where it leads.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Sequence
from functools import cached_property, reduce
from typing import Any, NamedTuple

import numpy as np

from gfnn_jax.budget import UNBOUNDED, Allowance
from gfnn_jax.families.sums import matrix_free
from gfnn_jax.fitting import row_blocks
from gfnn_jax.fitting.triangle import Spectrum, Triangle
from gfnn_jax.flows.collocation import Steps, images, of_lanes, operations, truncation
from gfnn_jax.flows.rates import MOST_SUBSTEPS, substeps_for
from gfnn_jax.solve.levenberg_marquardt import Factors, Tried
from gfnn_jax.solve.levenberg_marquardt import descended as descended_by

ROUNDOFF = 2e-16  # of the coordinates' sizes: the residual's floor


class Descent:
    """Options of a descent, tuned on Hénon–Heiles at dt 0.5 to 3 and on three bodies.

    damping: in units of the largest singular value. gained: a step that lowers the residual by less
    has settled. promised: a step that was to lower it by no more than this, and does not, has met
    the floor of rounding or truncation.
    """

    damping = Factors(first=1e-7, grown_by=10.0, shrunk_by=1e-2, least=5e-8, trials=9)
    gained: float = 1e-2
    promised: float = 0.1


def descended(
    linearised: Callable[[np.ndarray], Triangle], c, most: int
) -> tuple[np.ndarray, Triangle, int]:
    """Gauss–Newton steps from c until nothing is gained, at most so many: (coefficients, their
    triangle, steps taken). ``linearised(c)``: the problem at c, of rows wherever they are."""
    here = linearised(c)
    floor = ROUNDOFF * np.sqrt(here.rows)
    if not floor < here.norm < np.inf:
        return c, here, 0
    start = _AtCoefficients(c, here, linearised, floor)
    found = descended_by(start, Descent.damping, most)
    return found.problem.c, found.problem.triangle, found.steps


@dataclasses.dataclass(frozen=True)
class _AtCoefficients:
    """The problem at c; its cost is the norm of the residual. floor: of rounding, of that norm."""

    c: np.ndarray
    triangle: Triangle
    linearised: Callable[[np.ndarray], Triangle]
    floor: float

    @cached_property
    def _spectrum(self) -> Spectrum:
        return self.triangle.spectrum()

    def tried(self, damping: float, failures: int) -> Tried:
        """The step of this damping, and the triangle where it leads."""
        c, norm = self.c - step(self._spectrum, damping), self.triangle.norm
        there = self.linearised(c)
        promised = norm - self._spectrum.residual_norm
        hopeless = promised < Descent.promised * norm and there.norm < 2 * norm
        return Tried((c, there), norm - there.norm, damping, promised, hopeless)

    def moved(self, there, damping: float) -> tuple[_AtCoefficients, bool]:
        """The problem at the coefficients of a step; settled where it gained little."""
        c, triangle = there
        gained = 1 - triangle.norm / self.triangle.norm
        settled = gained < Descent.gained or triangle.norm <= self.floor
        return dataclasses.replace(self, c=c, triangle=triangle), settled


def step(spectrum: Spectrum, damping: float) -> np.ndarray:
    """δ that minimises ‖R δ − r‖² + (damping s₀)² ‖D δ‖² among the directions that are known."""
    s = np.where(spectrum.known, spectrum.s, 0.0)
    square = np.where(spectrum.known, s**2 + (damping * spectrum.s[0]) ** 2, 1.0)
    return spectrum.solution(s / square)


@dataclasses.dataclass(frozen=True)
class GaussNewtonOptions:
    """Tuned on Hénon–Heiles at dt 0.5 to 3 and on three bodies at dt 0.1 and 0.5.

    fractions: of the pairs, those that the present H explains best, in the rounds of a fit.
    early, most: Gauss–Newton steps of the early rounds and of the last.
    rows_per_term: rows that a round has for each term, at least.
    foretold: how well the linearised problem must tell the next residual for a start to be close.
    block_bytes: of the arrays that a block of pairs takes. part_bytes: of a block that one of
    several devices takes; part_rows: rows of its part per term, at least.
    coarse_stages: of the early rounds.
    early_rows: rows per term that the early rounds look at; fewest: pairs at least.
    error_pairs: at which a step's own error is measured; error_pairs_free: of a family that does
    without matrices, every pair of which has many coordinates.
    misfits, errors: a pair is resolved whose own error is below so many times what is left over in
    the median, or the median of these errors. selections: of resolved pairs in the end, at most.
    """

    fractions: tuple[float, ...] = (0.1, 0.3, 0.6, 0.9, 1.0)
    early: int = 3
    most: int = 40
    rows_per_term: float = 1.5
    foretold: float = 0.1
    block_bytes: int = 32 * 2**20
    part_bytes: int = 4 * 2**20
    part_rows: float = 4.0
    coarse_stages: int = 4
    early_rows: float = 6.0
    fewest: int = 60
    error_pairs: int = 48
    error_pairs_free: int = 2
    misfits: float = 10.0
    errors: float = 100.0
    selections: int = 4
    # A step's own error, of the coordinates' sizes, that is roundoff; at dt of long arcs too.
    fine: float = 5e-16
    rounded: float = 1e-13
    # Of the residual that the linearised problem foretells, by which that of the step may differ.
    foretold_left_out: float = 0.01


OPTIONS = GaussNewtonOptions()


class FlowFit(NamedTuple):
    """Coefficients (terms,) and how well the pairs determine them.

    rms: per component of (Φ(z₀) − z₁) ÷ scale on the pairs that were used. standard_errors:
    (terms,), and the condition of the scaled columns, from ``triangle``, that of [∂r/∂c, r] at the
    coefficients. used: (N,) the pairs in the loss.
    iterations: Gauss–Newton steps taken. steps: how the flow was computed in the end.
    """

    coefficients: np.ndarray
    rms: float
    standard_errors: np.ndarray
    triangle: Triangle
    condition: float
    used: np.ndarray
    iterations: int
    steps: Steps


@dataclasses.dataclass(eq=False)
class Problem:
    """Pairs z0 -> z1 (N, 2d) a time dt apart, and how the flow between them is computed.

    dt: a number, or one of each pair (N,). args: of each pair (N, k), or None.
    scale: (2d,) sizes of the coordinates, by which residuals are divided. weight: (N, 2d) that they
    are multiplied by, where values differ in their noise; None: 1.
    allowance: the time and the operations that an evaluation of the flow may take: checked between
    its blocks, spent before it is made.
    """

    z0: Any
    z1: Any
    dt: Any
    scale: Any
    args: Any = None
    weight: Any = None
    options: GaussNewtonOptions = OPTIONS
    allowance: Allowance = UNBOUNDED

    def unit(self, rows) -> np.ndarray:
        """Divisors of the residuals of these rows: (2d,), or (n, 2d) of weighted ones."""
        return self.scale if self.weight is None else self.scale / self.weight[rows]

    def given(self, rows) -> tuple[Any, Any]:
        """(dt, args) of these rows."""
        return of_lanes(self.dt, rows), of_lanes(self.args, rows)

    def images(self, family, coefficients, rows, steps: Steps, **options):
        """`flows.collocation.images` of the states z0 of these rows, each after its own dt."""
        dt, args = self.given(rows)
        along = (options.get("along") or family) if options.get("derivatives") else None
        self.allowance.spend(len(rows) * operations(family, self.z0.shape[1], steps, along))
        options |= {"args": args, "scale": self.scale, "on_substep": self.allowance.check}
        return images(family, coefficients, self.z0[rows], dt, steps, **options)

    def residuals(self, family, coefficients, steps: Steps, rows) -> np.ndarray:
        """(Φ(z₀) − z₁) ÷ scale of these rows (n, 2d); not finite where the flow fails."""

        def of(problem: Problem, block) -> np.ndarray:
            states = problem.images(family, coefficients, block, steps).states
            return (states - self.z1[block]) / self.unit(block)

        blocks = self._blocks(rows, 0, matrix_free(family))
        if row_blocks.devices():
            own = self._unpaid()
            paid = (self._paid(block, family, steps) for block in blocks)
            parts = row_blocks.each(lambda block, device: of(own, block), paid)
        else:
            parts = [of(self, block) for block in blocks]
        return np.concatenate(parts) if parts else np.zeros((0, self.z0.shape[1]))

    def linearised(self, family, coefficients, steps: Steps, rows) -> Triangle:
        """The triangle of [∂r/∂c, r] of these rows; its norm is infinite where a flow fails."""
        if not np.isfinite(coefficients).all():
            return Triangle.empty(family.num_parameters).spoilt()
        columns = family.num_parameters * steps.stages
        blocks = self._blocks(rows, columns, matrix_free(family))
        if not row_blocks.devices():
            return self._folded(family, coefficients, steps, blocks)
        own = self._unpaid()
        found = row_blocks.tree(
            lambda part, device: own._folded(family, coefficients, steps, part),
            self._parts(blocks, family, steps),
            lambda one, other, device: one.merge(other),
        )
        return Triangle.empty(family.num_parameters) if found is None else found

    def _folded(self, family, coefficients, steps: Steps, blocks) -> Triangle:
        """The triangle of the rows of these blocks."""
        triangle = Triangle.empty(family.num_parameters)
        for block in blocks:
            found = self.images(family, coefficients, block, steps, derivatives=True)
            unit = self.unit(block)
            residual = (found.states - self.z1[block]) / unit
            slope = found.by_coefficient / unit[..., None]
            rows = np.concatenate([slope, residual[..., None]], axis=-1)
            if not np.isfinite(rows).all():
                return triangle.spoilt()
            triangle = triangle.stacked(rows.reshape(-1, rows.shape[-1]))
        return triangle

    # Operations are spent where devices are told what to do, in one order, whoever is the first
    # to be done.

    def _unpaid(self) -> Problem:
        """The problem whose operations are spent already."""
        allowance = dataclasses.replace(self.allowance, cap=None)
        return dataclasses.replace(self, allowance=allowance)

    def _paid(self, block, family, steps: Steps, along=None):
        self.allowance.spend(len(block) * operations(family, self.z0.shape[1], steps, along))
        return block

    def _parts(self, blocks, family, steps: Steps):
        """The blocks, spent, in lists of as many rows as make the merging of two lists cheap."""
        least, part, gathered = self.options.part_rows * (family.num_parameters + 1), [], 0
        for block in blocks:
            part.append(self._paid(block, family, steps, family))
            gathered += len(block) * self.z0.shape[1]
            if gathered >= least:
                yield part
                part, gathered = [], 0
        if part:
            yield part

    def _blocks(self, rows, columns: int, free: bool):
        width = self.z0.shape[1]
        pair = 8 * width * (columns + 40 * (1 if free else width))
        most = self.options.part_bytes if row_blocks.devices() else self.options.block_bytes
        size = max(1 if free else 16, most // pair)
        for first in range(0, len(rows), size):
            self.allowance.check()
            yield rows[first : first + size]

    def fit(
        self,
        family,
        start,
        rows=None,
        *,
        rounds: bool = True,
        steps: Steps | None = None,
        on_progress: Callable[[str], Any] = lambda message: None,
    ) -> FlowFit:
        """Levenberg–Marquardt from ``start`` (terms,) over these rows.

        rounds: quiet pairs first, with coarse steps; else all at once, from a start that is known
        to be close. steps: of the flow in the end, which are to resolve these rows; None: the
        cheapest whose error is roundoff, and without the rows that they do not resolve.
        """
        options = self.options
        rows = np.arange(len(self.z0)) if rows is None else np.asarray(rows)
        c, iterations = np.array(start, dtype=float), 0
        least = int(np.ceil(options.rows_per_term * family.num_parameters / self.z0.shape[1]))
        most = max(options.fewest, int(options.early_rows * least / options.rows_per_term))
        sample = rows[:: -(-len(rows) // most)] if len(rows) > most else rows
        if rounds:
            near = self._near(family, c, sample)
            c, iterations = (c, 0) if near is None else (near, 1)
        for fraction in options.fractions if rounds and near is None else ():
            count = int(np.ceil(fraction * len(sample)))
            if fraction < 1 and count < least:
                continue
            coarse = self._coarse(family, c, sample)
            quiet = self._quietest(family, c, coarse, sample, count)
            if len(quiet) < min(least, len(sample)):
                break
            c, _, made = self._descend(family, c, coarse, quiet, options.early)
            iterations += made
            on_progress(f"H of {family.num_parameters} terms: {len(quiet)} of {len(rows)} pairs")
        if rounds:
            coarse = self._coarse(family, c, sample)
            quiet = self._resolved(family, c, coarse, sample)
            c, _, made = self._descend(family, c, coarse, quiet, options.most)
            iterations += made
        if steps is not None:
            used = self._quietest(family, c, steps, rows, len(rows))
            c, triangle, made = self._descend(family, c, steps, used, options.most)
            return summarised(c, triangle, used, iterations + made, steps)
        steps = self.fine_steps(family, c, rows)[0]
        used = self._resolved(family, c, steps, rows)
        for _ in range(options.selections):
            c, triangle, made = self._descend(family, c, steps, used, options.most)
            iterations += made
            summary = summarised(c, triangle, used, iterations, steps)
            still = self._resolved(family, c, steps, used)
            if len(still) == len(used):
                break
            used = still
        return summary

    def _near(self, family, c, rows) -> np.ndarray | None:
        """c after one Gauss–Newton step over all of these rows, where the linearised problem
        foretells the residual that is left: then the start is close. Else None."""
        coarse = self._coarse(family, c, rows)
        rows = self._resolved(family, c, coarse, rows)
        here = self.linearised(family, c, coarse, rows)
        if not np.isfinite(here.norm) or here.rows < family.num_parameters:
            return None
        spectrum = here.spectrum()
        tried = c - step(spectrum, 0.0)
        size = self.residuals(family, tried, coarse, rows)
        off = abs(float(np.linalg.norm(size)) - spectrum.residual_norm)
        return tried if off <= self.options.foretold * here.norm else None

    def _quietest(self, family, c, steps: Steps, rows, count: int):
        """The ``count`` of these rows that c explains best, without those whose flow fails."""
        size = np.linalg.norm(self.residuals(family, c, steps, rows), axis=1)
        order = np.argsort(np.where(np.isfinite(size), size, np.inf), kind="stable")[:count]
        return rows[order[np.isfinite(size[order])]]

    def _resolved(self, family, c, steps: Steps, rows):
        """Keep the rows that the steps resolve: whose own error is not most of their residual. One
        unresolved passage would outweigh all pairs that tell the coefficients."""
        known, off, limit = self.resolution(family, c, steps, rows)
        return rows[known & (off <= limit)]

    def resolution(self, family, c, steps: Steps, rows) -> tuple[np.ndarray, np.ndarray, float]:
        """Resolution of these rows: whether the flow is known (n,), the steps' own error (n,) ÷
        scale, and the error up to which a row counts as resolved among them."""
        size = np.abs(self.residuals(family, c, steps, rows)).max(axis=1, initial=0.0)

        def truncation_error(block) -> np.ndarray:
            (dt, args), scale, check = self.given(block), self.scale, self.allowance.check
            states = self.z0[block]
            return truncation(
                family, c, states, dt, steps, args=args, scale=scale, on_substep=check
            )

        if row_blocks.devices() and len(rows):
            blocks = self._blocks(rows, 0, matrix_free(family))
            found = row_blocks.each(lambda block, device: truncation_error(block), blocks)
            off = np.concatenate(found)
        else:
            off = truncation_error(rows)
        off = np.abs(off / self.scale).max(axis=1, initial=0.0)
        known = np.isfinite(size) & np.isfinite(off)
        if not known.any():
            return known, off, OPTIONS.rounded
        o = self.options
        limit = max(
            o.misfits * np.median(size[known]), o.errors * np.median(off[known]), OPTIONS.rounded
        )
        return known, off, float(limit)

    def distance(self, family, c, rows) -> float:
        """Median of ‖r‖ over these rows, by coarse steps: what starts are compared by."""
        size = np.linalg.norm(
            self.residuals(family, c, self._coarse(family, c, rows), rows), axis=1
        )
        return float(np.median(np.where(np.isfinite(size), size, np.inf)))

    def _coarse(self, family, c, rows) -> Steps:
        substeps = self.substeps_for(family, c, rows)
        return Steps(self.options.coarse_stages, substeps, newton=False)

    def substeps_for(self, family, c, rows) -> int:
        """Substeps that these rows need, by the function of this name."""
        dt, args = self.given(rows)
        return substeps_for(family, c, self.z0[rows], dt, args=args)

    def fine_steps(
        self, family, c, rows, tolerances: Sequence[float | None] = (None,)
    ) -> tuple[Steps, ...]:
        """Find for each tolerance the cheapest steps whose own error, ÷ scale, is within it at
        nearly all of these rows; None: at roundoff."""
        options = self.options
        error_pairs = options.error_pairs_free if matrix_free(family) else options.error_pairs
        sample = rows[:: -(-len(rows) // error_pairs)]
        substeps = self.substeps_for(family, c, sample)
        reference = self.images(family, c, sample, Steps(12, 4 * substeps)).states

        @functools.cache
        def error(steps: Steps) -> float:
            states = self.images(family, c, sample, steps).states
            off = np.abs((states - reference) / self.scale).max(axis=1)
            off = np.sort(np.where(np.isfinite(off), off, np.inf))
            return float(off[int(0.95 * (len(off) - 1))])

        return tuple(
            _cheapest(error, substeps, OPTIONS.fine if tolerance is None else tolerance)
            for tolerance in tolerances
        )

    def _descend(self, family, c, steps: Steps, rows, most: int):
        """Descend over these rows, by the function `descended`."""
        return descended(lambda c: self.linearised(family, c, steps, rows), c, most)


def _cheapest(error: Callable[[Steps], float], substeps: int, tolerance: float) -> Steps:
    """The cheapest steps within the tolerance, else those from which on rounding leaves nothing to
    gain, else within a few times of the best there are."""
    counts = (3, 4, 5, 6, 8, 10, 12)
    errors: dict[Steps, float] = {}
    steps = Steps(counts[-1], substeps)
    for more in (1, 2, 4):
        if more > 1 and more * substeps > MOST_SUBSTEPS:
            break
        last = None
        for stages in counts:
            steps = Steps(stages, more * substeps)
            errors[steps] = error(steps)
            if errors[steps] <= tolerance:
                return steps
            if last and errors[last] <= min(OPTIONS.rounded, 2 * errors[steps]):
                return last
            last = steps
    best = min(errors.values())
    if not np.isfinite(best):  # a flow that runs away from the data
        return steps
    return next(s for s, e in errors.items() if e <= 3 * best)


def summarised(c, triangle: Triangle, used, iterations: int, steps: Steps) -> FlowFit:
    """The fit that ends at c, with the triangle that was found there."""
    spectrum, rows = triangle.spectrum(), triangle.rows
    rms = triangle.norm / np.sqrt(max(rows, 1))
    noise = max(triangle.norm / np.sqrt(max(rows - len(c), 1)), ROUNDOFF)
    errors = noise * spectrum.deviations()
    return FlowFit(c, rms, errors, triangle, spectrum.condition, used, iterations, steps)


def without_each(
    problem: Problem, family, c: np.ndarray, steps: Steps, parts: Sequence[np.ndarray]
) -> list[np.ndarray]:
    """Coefficients (terms,) of the fits to all of these parts but one, for each in turn.

    c: (terms,) of a fit to the rows of the parts, or to most of them. parts: rows, none in two.
    Where one step from c does not reach the optimum, the fit is made.
    """
    if len(parts) > 1 and _is_rounding(problem, family, c, steps, parts):
        return [c] * len(parts)
    triangles = [problem.linearised(family, c, steps, part) for part in parts]
    found = []
    for i in range(len(parts)):
        kept = [j for j in range(len(parts)) if j != i]
        rows = np.sort(np.concatenate([np.zeros(0, int), *(parts[j] for j in kept)]))
        empty = Triangle.empty(family.num_parameters)
        here = reduce(Triangle.merge, (triangles[j] for j in kept), empty)
        there = _one_step(problem, family, c, steps, rows, here)
        if there is None:
            there = problem.fit(family, c, rows, rounds=False, steps=steps).coefficients
        found.append(there)
    return found


def _is_rounding(problem: Problem, family, c, steps: Steps, parts: Sequence[np.ndarray]) -> bool:
    """Return whether the residual at c is rounding, which no fit to most of the rows lowers."""
    largest = max(len(part) for part in parts)
    rows = np.sort(np.concatenate(parts))
    norm = np.linalg.norm(problem.residuals(family, c, steps, rows))
    return bool(norm <= ROUNDOFF * np.sqrt((len(rows) - largest) * problem.z0.shape[1]))


def _one_step(
    problem: Problem, family, c: np.ndarray, steps: Steps, rows: np.ndarray, here: Triangle
) -> np.ndarray | None:
    """c after a Gauss–Newton step over these rows, of which ``here`` is the triangle at c; c itself
    where rounding leaves nothing to gain; None where the step is not what was foretold."""
    if not np.isfinite(here.norm) or here.rows < family.num_parameters:
        return None
    spectrum = here.spectrum()
    tried, foretold = c - step(spectrum, 0.0), spectrum.residual_norm
    norm = float(np.linalg.norm(problem.residuals(family, tried, steps, rows)))
    if here.norm <= norm < 2 * here.norm and foretold > (1 - Descent.promised) * here.norm:
        return c  # the descent ends here too: the residual is rounding, or truncation
    return tried if abs(norm - foretold) <= OPTIONS.foretold_left_out * foretold else None
