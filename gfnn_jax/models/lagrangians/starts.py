"""Starts of a search for a law: libraries in turn, the weak form of each, and a fit to short arcs.

The textbook's library of the coordinates comes first, and a larger one beside it. Where none of
these follows the arcs, others are tried: zeros of angles that are far off, as of an encoder that
was switched on anywhere; coordinates that nothing couples, for the weak form makes the equation of
such a one as small as it likes; bodies in a potential of lengths.
"""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Callable, Mapping, Sequence

import numpy as np

from gfnn_jax.dataset.stretches import Nodes, Scales, arcs_of
from gfnn_jax.errors import FitError
from gfnn_jax.families.lagrangian import LINEAR
from gfnn_jax.maps.observation import Observation
from gfnn_jax.models.lagrangians import libraries
from gfnn_jax.models.lagrangians.fit import LawFit, Workbench, describe
from gfnn_jax.models.lagrangians.input_rules import choose_rule
from gfnn_jax.models.lagrangians.structure import Loss, Row, Structure
from gfnn_jax.models.lagrangians.weak_start import weak_start, zeros_of_angles

# What a start leaves over, above which others are tried: times the noise, or of the variation.
_FOLLOWED, _SHARE = 10.0, 0.2
_FAR = 0.3  # radians: a zero of an angle that a fit from 0 may not reach
_FEW = 8.0  # samples a period, below which more of them are the remedy
_PLAIN_IS_ENOUGH = 1.5  # times the residual of the larger library, the textbook's may have


def no_law(scales: Scales) -> FitError:
    """Error where no law follows a recording of these scales."""
    few = (
        f"; sample more often: it has about {scales.samples:.1f} samples in a period"
        if scales.samples < _FEW
        else ""
    )
    return FitError(
        "no law of the terms tried follows this recording. Check units and roles (gfnn look); name "
        "a missing input or position (--inputs, --positions); cut off rest and collisions (--from, "
        f"--to); or give terms that you know (--terms){few}",
        verdict="no law: none of the terms tried follows this recording",
    )


def best_start(
    nodes: Sequence[Nodes],
    scales: Scales,
    angles: tuple[int, ...],
    num_inputs: int,
    benches: Mapping[str, Workbench],
    observation: Observation,
    periods: float,
    on_progress: Callable[[str], object],
) -> tuple[Workbench, LawFit]:
    """The start that leaves least of arcs of so many ``periods``, or of those that leave about as
    much the plainest; on the bench (hold -> it) of the rule by which inputs act.

    Raises FitError where there is none.
    """
    d, some = (
        observation.dim,
        _Starts(nodes, scales, angles, num_inputs, benches, observation, periods, on_progress),
    )
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
        raise no_law(scales)
    best = min(map(some.misfit, some.fits))
    simple = [
        fit
        for fit in some.fits
        if fit.structure.terms in plain and some.misfit(fit) <= _PLAIN_IS_ENOUGH * best
    ]
    (bench,) = some.benches.values()
    return bench, min(simple or some.fits, key=some.misfit)


class _Starts:
    """The starts so far, and the bench of each rule by which inputs may act, after the first of the
    one that was chosen."""

    def __init__(
        self,
        nodes: Sequence[Nodes],
        scales: Scales,
        angles: tuple[int, ...],
        num_inputs: int,
        benches: Mapping[str, Workbench],
        observation: Observation,
        periods: float,
        on_progress: Callable[[str], object],
    ):
        self.nodes, self.scales, self.benches, self.fits = nodes, scales, benches, []
        self.num_inputs, self.periods, self.on_progress = num_inputs, periods, on_progress
        self.dim, self.shifted = observation.dim, observation.shifts()
        self.sensors = tuple(
            zip(observation.parameters, map(float, observation.values), strict=True)
        )
        with_zero = (i in observation.direct and i not in self.shifted for i in angles)
        self.turned = tuple(i for i, has in zip(angles, with_zero, strict=True) if has)
        self.angles, self.linear = angles, libraries.losses(self.dim, (LINEAR,), 0.0)

    def add(
        self, rows: Sequence[Row], zero: np.ndarray | None = None, apart: bool = False
    ) -> tuple[Row, ...] | None:
        """Start from the terms of this library that the weak form shows, and return them; None
        where it does not determine them. zero: (d,) of angles, from which the fit begins. apart:
        without friction between coordinates."""
        d = self.dim
        friction: list[Loss] = self.linear[:d] if apart else self.linear
        terms, seen = libraries.without_forces(rows, self.shifted), self.nodes
        if zero is not None:
            about = np.concatenate([zero, np.zeros(d)])
            seen = [dataclasses.replace(n, x=n.x - about) for n in seen]
        library = Structure(d, terms, tuple(friction), (), self.num_inputs, self.sensors)
        try:
            structure, known = weak_start(library, seen, self.scales)
        except FitError:
            return None
        zeros = tuple(i for i in self.turned if any(row[2][i] for row in structure.terms))
        structure = structure.plus(
            [("loss", row) for row in self.linear[:d]] + [("zero", i) for i in zeros]
        )
        if zero is not None:
            known = known | {("zero", i): float(zero[i]) for i in zeros}
        elif any(structure.terms == other.structure.terms for other in self.fits):
            return structure.terms
        length = max(6, round(self.periods * self.scales.per_period))
        rule = choose_rule(
            self.benches,
            self.nodes,
            structure,
            known,
            arcs_of(self.nodes, length),
            self.scales.sigma,
            self.scales.dt,
        )
        self.benches = {rule.hold: rule.bench}  # inputs act so in the other libraries too
        self.fits.append(rule.fit)
        self.on_progress(f"{self.periods:g} periods: {describe(rule.fit)}")
        return structure.terms

    def misfit(self, fit: LawFit) -> float:
        """The largest residual of a channel, in units of its noise."""
        finite = np.isfinite(fit.fitted.cost)
        return float(np.max(fit.rms() / self.scales.sigma)) if finite else np.inf

    @property
    def followed(self) -> bool:
        """Return whether some start follows its arcs."""
        variation = np.nanstd(np.concatenate([n.y - n.zero for n in self.nodes]), axis=0)
        return any(
            self.misfit(fit) < _FOLLOWED and np.all(fit.rms() < _SHARE * variation)
            for fit in self.fits
        )

    def far_zeros(self) -> np.ndarray:
        """Zeros (d,) of angles, by the weak form; 0 where none is far off, or none determined."""
        terms = libraries.without_forces(libraries.first(self.dim, self.angles), self.shifted)
        zero = np.zeros(self.dim)
        with contextlib.suppress(FitError):
            found = zeros_of_angles(terms, self.linear, self.num_inputs, self.nodes, self.scales)
            zero[list(self.turned)] = found[list(self.turned)]
        return zero if np.max(np.abs(zero)) > _FAR else 0 * zero
