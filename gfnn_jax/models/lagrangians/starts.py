"""Starts of a search for a law: libraries in turn, the weak form of each, and a fit to short arcs.

The textbook's library of the coordinates comes first, and a larger one beside it. Where none of
these follows the arcs, others are tried: zeros of angles that are far off, as of an encoder that
was switched on anywhere; coordinates that nothing couples, for the weak form makes the equation of
such a one as small as it likes; bodies in a potential of lengths.
"""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Sequence

import numpy as np

from gfnn_jax.dataset.stretches import Scales
from gfnn_jax.errors import FitError
from gfnn_jax.families.lagrangian import LINEAR
from gfnn_jax.models.lagrangians import libraries
from gfnn_jax.models.lagrangians.fit import ArcProblem, LawFit
from gfnn_jax.models.lagrangians.input_rules import choose_rule
from gfnn_jax.models.lagrangians.structure import Row, Structure
from gfnn_jax.models.lagrangians.weak_form import weak_start, zeros_of_angles


@dataclasses.dataclass(frozen=True)
class StartOptions:
    """Limits at which other starts are tried (`benchmarks/random_recordings.py`).

    followed, share: residual of a start, times the noise or of the variation, above which others
    are tried. far: zero of an angle, in radians, that a fit from 0 may not reach. few: samples a
    period, below which more of them are the remedy. plain: times the residual of the larger
    library, that the textbook's may have.
    """

    followed: float = 10.0
    share: float = 0.2
    far: float = 0.3
    few: float = 8.0
    plain: float = 1.5


OPTIONS = StartOptions()


def no_law(scales: Scales) -> FitError:
    """Error where no law follows a recording of these scales."""
    few = (
        f"; sample more often: it has about {scales.samples:.1f} samples in a period"
        if scales.samples < OPTIONS.few
        else ""
    )
    return FitError(
        "no law of the terms tried follows this recording. Check units and roles (gfnn look); name "
        "a missing input or position (--inputs, --positions); cut off rest and collisions (--from, "
        f"--to); or give terms that you know (--terms){few}",
        verdict="no law: none of the terms tried follows this recording",
    )


def best_start(problem: ArcProblem) -> LawFit:
    """The start that leaves least of short arcs, or of those that leave about as much the plainest,
    by the best of the rules by which inputs act.

    Raises FitError where there is none.
    """
    d, angles, some = problem.dim, problem.angles, _Starts(problem)
    plain = [some.add(libraries.textbook(d, angles))]
    if d > 1 and len(angles) == d:
        plain.append(some.add(libraries.relative(d, angles)))
    some.add(libraries.first(d, angles))
    if not some.followed and (zero := some.far_zeros()).any():
        plain.append(some.add(libraries.textbook(d, angles), zero=zero))
        some.add(libraries.first(d, angles), zero=zero)
    if d > 1 and not some.followed:
        plain.append(some.add(libraries.uncoupled(d, angles), apart=True))
        some.add(libraries.bodies(d, angles), apart=True)
    if not some.fits:
        raise no_law(problem.scales)
    most = OPTIONS.plain * min(map(some.misfit, some.fits))
    simple = [f for f in some.fits if f.structure.terms in plain and some.misfit(f) <= most]
    return min(simple or some.fits, key=some.misfit)


class _Starts:
    """The starts so far, and the problem: after the first of the rule by which inputs act."""

    def __init__(self, problem: ArcProblem):
        self.problem, self.fits = problem, []
        self.linear = libraries.losses(problem.dim, (LINEAR,), 0.0)

    def add(
        self, rows: Sequence[Row], zero: np.ndarray | None = None, apart: bool = False
    ) -> tuple[Row, ...] | None:
        """Start from the terms of this library that the weak form shows, and return them; None
        where it does not determine them. zero: (d,) of angles, from which the fit begins. apart:
        without friction between coordinates."""
        problem, d = self.problem, self.problem.dim
        friction = tuple(self.linear[:d] if apart else self.linear)
        terms, seen = libraries.without_forces(rows, problem.observation.shifts()), problem
        if zero is not None:
            about = np.concatenate([zero, np.zeros(d)])
            moved = [dataclasses.replace(n, x=n.x - about) for n in problem.nodes]
            seen = dataclasses.replace(problem, nodes=moved)
        library = Structure(d, terms, friction, (), problem.num_inputs, problem.sensors)
        try:
            structure, known = weak_start(library, seen)
        except FitError:
            return None
        zeros = tuple(i for i in problem.turned if any(row[2][i] for row in structure.terms))
        structure = structure.plus(
            [("loss", row) for row in self.linear[:d]] + [("zero", i) for i in zeros]
        )
        if zero is not None:
            known = known | {("zero", i): float(zero[i]) for i in zeros}
        elif any(structure.terms == other.structure.terms for other in self.fits):
            return structure.terms
        periods = problem.options.periods[0]
        rule = choose_rule(problem, structure, known, problem.arcs(periods), problem.scales.sigma)
        # Inputs act so in the other libraries too.
        inputs = rule.fit.problem.inputs
        self.problem = dataclasses.replace(problem, inputs=inputs, rules=(rule.hold,))
        self.fits.append(rule.fit)
        problem.on_progress(f"{periods:g} periods: {rule.fit}")
        return structure.terms

    def misfit(self, fit: LawFit) -> float:
        """The largest residual of a channel, in units of its noise."""
        return float(np.max(fit.rms() / self.problem.scales.sigma)) if fit.follows else np.inf

    @property
    def followed(self) -> bool:
        """Return whether some start follows its arcs."""
        y = np.concatenate([n.y - n.zero for n in self.problem.nodes])
        most = OPTIONS.share * np.nanstd(y, axis=0)
        return any(
            self.misfit(fit) < OPTIONS.followed and np.all(fit.rms() < most) for fit in self.fits
        )

    def far_zeros(self) -> np.ndarray:
        """Zeros (d,) of angles, by the weak form; 0 where none is far off, or none determined."""
        problem, zero = self.problem, np.zeros(self.problem.dim)
        rows = libraries.first(problem.dim, problem.angles)
        terms = libraries.without_forces(rows, problem.observation.shifts())
        with contextlib.suppress(FitError):
            found, turned = zeros_of_angles(terms, self.linear, problem), list(problem.turned)
            zero[turned] = found[turned]
        return zero if np.max(np.abs(zero)) > OPTIONS.far else 0 * zero
