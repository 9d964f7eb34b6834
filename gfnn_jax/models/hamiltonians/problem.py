"""Problem of a search for H: its pairs, what is asked of the law, and the work that is left."""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from gfnn_jax.budget import FLOW, Allowance, Budget, Counted
from gfnn_jax.coordinates import to_user
from gfnn_jax.dataset.dataset import Dataset
from gfnn_jax.dataset.measured_error import OneStepError, Tolerance, measured_error
from gfnn_jax.errors import OutOfTime
from gfnn_jax.families.sums import matrix_free
from gfnn_jax.fitting.gauss_newton import FlowFit, Problem
from gfnn_jax.flows.collocation import Steps, images, operations, truncation
from gfnn_jax.flows.flow import Flow
from gfnn_jax.flows.gauss import gauss
from gfnn_jax.flows.rates import MOST_SUBSTEPS, rates
from gfnn_jax.models.hamiltonians.fitted_law import FittedLaw, OnPartial
from gfnn_jax.models.parameters import angles_and_others
from gfnn_jax.phase_space import symplectic_form


@dataclasses.dataclass(frozen=True)
class LawOptions:
    """Tuned on Hénon–Heiles at dt 0.5 to 3, on three bodies and on the double pendulum.

    degrees: of the products of coordinates; boxes: (order, degree) of modes, where there are
    angles; feature_degrees: of a scene's features; given_degrees, given_boxes: of what stands
    beside a user's own terms. most_terms: of a library; most_modes: of one of modes. rows_per_term:
    that a library needs; rows_per_lagrangian_term: pairs times degrees of freedom that one of L
    needs.
    rows_compared: per term, on which libraries are compared; all pairs only count in the last fit.
    thresholds: standard errors below which terms go, tried in turn.
    flat: libraries one after the other whose errors differ by less have met the pairs' noise.
    gained: a library that lowers the error by less has not helped; gained_alone: where noise hides
    what it brings. poor: such libraries in a row that end the search; poor_given: of a user's
    terms; poor_in_kind: of a structure or of modes, whose libraries differ in kind. small: terms
    of the libraries that are tried before laws of physics, 0.3 s of two bodies; exact: of the
    spread, what a polynomial errs by that is no approximation. on_branch: of the spread, an error
    below which is that of the right branch of the turns, which turning pairs tell. unlike: of the
    mean square by which two moves differ, that of nearest neighbours which tell nothing; alike: of
    it, that of those which do. truncation: a flow's own error, as a part of the tolerance.
    generators: degrees of those that look for misfit,
    beside the one that is so far ``beyond`` the law's own: an even H lacks no odd terms;
    sampled_rows: per term, where what is left over is looked at, fewest_sampled: pairs at least, of
    many sites numbers; white_pairs: whose residuals say whether a law leaves anything but noise.
    max_operations: of the flows that are evaluated on the way, counted: what a quiet core makes in
    half a minute, at 5e8 a second (two bodies, three bodies, pendulums), within which all laws of
    the benchmarks are found that are found at all; mode_operations: the same where there are
    angles, a minute at 7e8 a second, for a double pendulum's L.
    evaluations: of the flow and its derivatives, that a fit of a library is expected to take;
    close: of terms that are known to be close to their optimum. only_within: whether a law that
    misses the tolerance is of no use.
    roundoff: of the spread, above it the pairs carry noise, and every one of them counts;
    near_roundoff: of a flow's own error.
    fast: of ωh, from here on other laws are not far from the same pairs. contracting: a fixed
    point's factor up to which it is preferred to Newton's method. rated: states by which
    frequencies are known. telling: pairs, from which on the midpoints of a sample tell libraries
    apart, and worse: times what another one leaves of their gradients, too far from them (three
    bodies). rounds: of holding coefficients at their bounds and fitting, at most.
    shortest, potential: of L, Σ|m_i| of the modes of angles and the degree of the powers of lengths
    in a mass, and the degree in a potential (benchmarks/double_pendulum.py). shares: of p and ṗ,
    the terms that make more in the middle of pairs are fitted first: a law of few terms is then
    found for a tenth of the operations; the middle is off by O(dt²), some per cent.
    named: terms in a message. no_force: of the forces' sum, a total that is roundoff.
    """

    degrees: tuple[int, ...] = (2, 3, 4, 5, 6, 8)
    feature_degrees: tuple[int, ...] = (2, 3)
    given_degrees: tuple[int, ...] = (2, 3, 4)
    boxes: tuple[tuple[int, int], ...] = ((1, 1), (1, 2), (2, 2), (1, 4), (3, 2), (12, 2))
    given_boxes: tuple[tuple[int, int], ...] = ((1, 2), (2, 2), (3, 2), (4, 4))
    most_terms: int = 350
    most_modes: int = 500
    rows_per_term: float = 1.6
    rows_per_lagrangian_term: float = 2.0
    rows_compared: float = 12.0
    thresholds: tuple[float, ...] = (1e4, 1e3, 100.0, 30.0, 10.0, 5.0, 3.0)
    flat: float = 1.2
    gained: float = 0.5
    gained_alone: float = 0.8
    poor: int = 2
    poor_given: int = 3
    poor_in_kind: int = 5
    small: int = 35
    exact: float = 1e-13
    on_branch: float = 0.05
    turning: int = 2_000
    unlike: float = 0.5
    alike: float = 0.1
    truncation: float = 0.1
    generators: tuple[int, ...] = (2, 3, 4, 5, 6)
    beyond: int = 2
    named: int = 5
    no_force: float = 1e-9
    sampled_rows: int = 6
    fewest_sampled: int = 2_000
    white_pairs: int = 2_000
    max_operations: float = 1.5e10
    mode_operations: float = 4.2e10
    evaluations: float = 20.0
    close: float = 6.0
    only_within: bool = True
    roundoff: float = 1e-12
    near_roundoff: float = 3e-15
    fast: float = np.pi / 2
    contracting: float = 0.8
    rated: int = 500
    telling: int = 60
    worse: float = 3.0
    rounds: int = 10
    shortest: int = 2
    potential: int = 4
    shares: tuple[float, ...] = (0.05, 0.01)


OPTIONS = LawOptions()


def contraction_of(fastest, dt: float, steps: Steps) -> float:
    """The factor by which the stages' fixed point contracts in the end, where it is largest."""
    radius = np.abs(np.linalg.eigvals(gauss(steps.stages).matrix)).max()
    return float(dt / steps.substeps * fastest.max() * radius)


def operations_of(family, width: int, fastest, dt: float, steps: Steps) -> float:
    """Floating-point operations per step of states (2d,), width 2d: as many iterations as roundoff
    takes at this factor."""
    gradient, with_hessian = family.operations
    s = steps.stages
    factor = contraction_of(fastest, dt, steps)
    if factor > OPTIONS.contracting and not matrix_free(family):
        one = s * with_hessian + (s * width) ** 3 * 2 / 3
        return float(steps.substeps * 4 * one)
    iterations = 2 + np.log(1e-16) / np.log(np.clip(factor, 1e-3, OPTIONS.contracting))
    return float(steps.substeps * iterations * s * (gradient + 2 * width * s))


def flow_operations(flow: Flow, data: Dataset) -> float:
    """Floating-point operations per step of the flow."""
    fastest = rates(flow.family, flow.params, data.y0[: OPTIONS.rated])
    steps = Steps(flow.stages, flow.substeps)
    return operations_of(flow.family, len(data.scale), fastest, float(flow.dt), steps)


def omega_h_of(family, coefficients, data: Dataset, fastest) -> float:
    """The fastest oscillation of the linearised flow, radians per step, its median over states."""
    if not matrix_free(family):
        some = slice(OPTIONS.rated)
        z, args = data.y0[some], data.given(some)[1]
        _, hessian = family.gradient_and_hessian(coefficients, z, args)
        turned = symplectic_form(data.dim) @ hessian
        fastest = np.abs(np.linalg.eigvals(turned).imag).max(axis=-1)
    return float(data.dt * np.median(fastest))


class LawWork:
    """Work that a search for H may still do.

    A library takes as many times the operations of one evaluation as the library before it did. The
    search has a cap of its own, on the operations that it makes: without a budget that is what ends
    it, at the same library on any machine.
    """

    def __init__(self, flows: Problem, budget: Budget, most: float):
        self.flows, self.budget, self._cap = flows, budget, Counted(most)
        self._evaluations = OPTIONS.evaluations
        flows.allowance = Allowance(budget, self._cap)

    @property
    def ended(self) -> str:
        """Reason that cut the search short; "" where nothing has."""
        capped = f"the search for H reached its own limit of {self._cap.most:.2g} operations"
        return self.budget.ended or (capped if self._cap.spent > self._cap.most else "")

    def made(self) -> float:
        """Operations so far."""
        return self._cap.spent

    def capped(self, most: float) -> None:
        """Cap the search anew, beside what it has made; infinity lifts the cap."""
        self._cap.most = self._cap.spent + most

    @contextlib.contextmanager
    def library(self, name: str, family, rows: int, *, first: bool = False) -> Iterator[None]:
        """The fit of a library to so many pairs. first: it is fitted whatever the budget, where
        nothing else would be left."""
        one, before = self._one(family, rows), self._cap.spent
        expected = self._evaluations * one
        unit = (
            self.budget.free(FLOW, expected, self.made)
            if first
            else self.budget.unit(name, FLOW, expected, made=self.made)
        )
        with self._without_clock(first), unit:
            yield
        self._evaluations = (self._cap.spent - before) / one

    @contextlib.contextmanager
    def again(self, name: str, family, rows: int) -> Iterator[None]:
        """A unit in which terms that are close to their optimum are fitted to so many pairs. It
        makes a law of a library, so that the end of the search is no reason to leave it out."""
        given, over = (name, FLOW, OPTIONS.close * self._one(family, rows)), self.budget.over
        unit = (
            self.budget.last(*given, decides=True, made=self.made)
            if over
            else self.budget.unit(*given, made=self.made)
        )
        with self._without_clock(over), unit:
            yield

    @contextlib.contextmanager
    def optional(self, what: str) -> Iterator[None]:
        """A part that the search can do without: it is left out, and told, where the time is over
        within, or where its linear algebra fails."""
        try:
            yield
        except OutOfTime:
            self.budget.leave_out(what, self.ended)
        except np.linalg.LinAlgError as error:
            self.budget.leave_out(what, f"its linear algebra failed: {error}")

    @contextlib.contextmanager
    def _without_clock(self, bare: bool) -> Iterator[None]:
        """Flows that, where ``bare``, look at the cap alone."""
        allowance = self.flows.allowance
        if bare:
            self.flows.allowance = Allowance(cap=self._cap)
        try:
            yield
        finally:
            self.flows.allowance = allowance

    def _one(self, family, rows: int) -> float:
        """Operations of an evaluation."""
        return rows * operations(family, self.flows.z0.shape[1], Steps(6, 1), family)


def work_of_refit(family, rows: int, dim: int, steps: Steps) -> float:
    """Operations of a fit of terms that are close to their optimum to so many pairs."""
    return OPTIONS.close * rows * operations(family, 2 * dim, steps, family)


@dataclasses.dataclass(frozen=True, eq=False)
class LawProblem:
    """A search for H behind pairs.

    data: without a base map; its training pairs are fitted, its validation pairs judge. scene:
    lends its features and reversor. terms: a user's own, text or functions. dearest: operations of
    a step above which H is not taken, for a map at hand meets the tolerance with fewer; infinite
    where none does.
    on_progress: is told what is tried. partly: called with laws of physics that explain a part,
    where none explains all. begun: its work, once the search has begun.

    Errors are those of steps, Z_predicted − Z, in the user's coordinates; the steps' own
    (truncation) is held to a tenth of the tolerance.
    """

    data: Dataset
    tolerance: Tolerance
    budget: Budget = dataclasses.field(default_factory=Budget)
    scene: Any = None
    terms: Any = ()  # of a sequence, or a mapping of text to what is known of its coefficient
    options: LawOptions = OPTIONS
    dearest: float = np.inf
    on_progress: Callable[[str], Any] = lambda message: None
    partly: OnPartial = lambda law: None
    begun: LawWork | None = None

    def beginning(self, data: Dataset, most: float = np.inf) -> LawProblem:
        """The search as it begins, of these pairs, capped at so many operations."""
        work = LawWork(flows_of(data, data.each_dt), self.budget, most)
        return dataclasses.replace(self, data=data, begun=work)

    def on(self, data: Dataset) -> LawProblem:
        """The same search with other training and validation rows."""
        return dataclasses.replace(self, data=data)

    @property
    def work(self) -> LawWork:
        """The work that is left of a search that has begun."""
        assert self.begun is not None
        return self.begun

    @property
    def flows(self) -> Problem:
        """Fits through the flow of these pairs."""
        return self.work.flows

    @property
    def simple(self) -> bool:
        """Return whether the pairs depend on nothing but their states, and have no structure."""
        return self.data.args is None and self.data.structure is None

    @property
    def of_modes(self) -> bool:
        """Return whether libraries are of modes: of an angle that enters H by itself."""
        features = self.scene is not None and self.scene.features is not None
        return bool(angles_and_others(self.data)[0]) and self.data.args is None and not features

    @property
    def most_terms(self) -> float:
        """Terms that the training rows tell apart."""
        return len(self.data.training) * 2 * self.data.dim / self.options.rows_per_term

    @property
    def bound(self) -> float:
        """The tolerance as a part of the coordinates' scale."""
        asked = self.tolerance
        return asked.bound if asked.relative else asked.bound / float(self.data.scale.max())

    def met_by(self, law: FittedLaw) -> bool:
        """Return whether the law's held-out error is within the tolerance, at 95 %."""
        return law.error.bound <= self.tolerance.bound

    def fitted(self, family, start, rows, **options: Any) -> FittedLaw:
        """The terms fitted to these rows from ``start``; options: of `gauss_newton.Problem.fit`."""
        fit = self.flows.fit(family, start, rows, **options)
        return FittedLaw(family, fit, rows, self.error_of(family, fit))

    def refitted(self, law: FittedLaw, rows) -> FittedLaw:
        """Fitted to these rows, from where it is: each of them averages the noise."""
        return law.with_fit(self.fitted(law.family, law.fit.coefficients, rows, rounds=False))

    def error_of(self, family, fit: FlowFit) -> OneStepError:
        """Error by steps that resolve the held-out pairs: an unresolved passage says nothing of the
        law."""
        steps = self.resolving(family, fit.coefficients, fit.steps)
        return self.error_of_steps(family, fit.coefficients, steps)

    def error_of_steps(self, family, coefficients, steps: Steps) -> OneStepError:
        """Error of these steps over the held-out pairs."""
        data, rows = self.data, self.data.validation
        dt, args = data.given(rows)
        found = images(family, coefficients, data.y0[rows], dt, steps, args=args, scale=data.scale)
        return measured_error(data, self.tolerance, to_user(data.coordinates, found.states))

    def resolving(self, family, coefficients, steps: Steps) -> Steps:
        """Keep these steps, or, where the law misses the tolerance by them, take finer ones: halved
        until they resolve the held-out pairs, or there are as many as a flow may have."""
        if self.error_of_steps(family, coefficients, steps).bound <= self.tolerance.bound:
            return steps
        rows, scale = self.data.validation, self.data.scale
        states, (dt, args) = self.data.y0[rows], self.data.given(rows)
        while 2 * steps.substeps <= MOST_SUBSTEPS:
            off = truncation(family, coefficients, states, dt, steps, args=args, scale=scale)
            if np.sqrt(np.mean((off / scale) ** 2)) <= OPTIONS.truncation * self.bound:
                break
            steps = dataclasses.replace(steps, substeps=2 * steps.substeps)
        return steps

    def cheapest(self, family, fit: FlowFit, fastest, rows) -> Steps:
        """Steps whose own error on these rows is a tenth of the tolerance; near roundoff, or at it,
        where that is not twice as dear. All rows have the data's own dt."""

        def cost(steps: Steps) -> float:
            return operations_of(family, 2 * family.dim, fastest, self.data.dt, steps)

        bound = max(self.options.truncation * self.bound, 0.3 * fit.rms)
        tolerances = (bound, min(bound, OPTIONS.near_roundoff), None)
        flows = self.flows if self.data.own_dt is None else flows_of(self.data, self.data.dt)
        found = flows.fine_steps(family, fit.coefficients, rows, tolerances)
        return next(s for s in reversed(found) if s == found[0] or cost(s) < 2 * cost(found[0]))


def flows_of(data: Dataset, dt) -> Problem:
    """Fits through the flow over dt of these pairs."""
    return Problem(data.y0, data.y1, dt, data.scale, args=data.args, weight=data.weight)
