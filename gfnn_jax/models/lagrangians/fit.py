"""One structure of a law fitted to arcs: coefficients, latent states, noise, errors, held-out
cost."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from gfnn_jax.dataset.stretches import Arcs, Nodes, arcs_of, with_states
from gfnn_jax.fitting.linearised import Linearised, without_each
from gfnn_jax.fitting.triangle import Triangle
from gfnn_jax.flows.motion import Form
from gfnn_jax.maps.observation import Observation
from gfnn_jax.models.lagrangians.arcs import LawOnArcs
from gfnn_jax.models.lagrangians.structure import Key, Structure
from gfnn_jax.solve.latent_arcs import Fitted, Readings
from gfnn_jax.solve.noise import Wander

_SETTLED = 1.15  # a noise scale that changed by less needs no second fit
_LEAST_LEFT = 1e-4  # of the squares of residuals, that one more term may leave over
_IMITATED = 0.03  # of what a term changes, that no coefficient of the fit does
FOLDS = 3


@dataclasses.dataclass(frozen=True, eq=False)
class LawFit:
    """A structure fitted to arcs, in the gauge of ``form``; σ (k,) is the scale of the residuals of
    each channel, τ their correlation time in nodes."""

    structure: Structure
    form: Form
    arcs: Arcs
    fitted: Fitted
    sigma: np.ndarray
    correlation: float

    @property
    def p(self) -> np.ndarray:
        return self.fitted.p

    @property
    def zeros(self) -> np.ndarray:
        """Zeros (d,) of the coordinates, 0 where none was fitted."""
        zeros, where = np.zeros(self.form.dim), list(self.structure.zeros)
        zeros[where] = self.p[self.form.count : self.form.count + len(where)]
        return zeros

    @property
    def sensors(self) -> np.ndarray:
        """Values of the sensors' parameters, which are behind the law's and its zeros."""
        return self.p[self.form.count + len(self.structure.zeros) :]

    @property
    def values(self) -> dict[Key, float]:
        """The coefficients, and those that the gauge gives of parts which nothing couples with the
        first coordinate."""
        structure, form = self.structure, self.form
        values = dict(zip(structure.keys(), map(float, self.p), strict=True))
        if structure.given[1:]:
            theta = form.lagrangian(self.p[: form.count]).coefficients
            values |= {("term", structure.terms[k]): float(theta[k]) for k in structure.given[1:]}
        return values

    @functools.cached_property
    def linearised(self) -> Linearised:
        """The problem close to p, in which correlated residuals count once."""
        return Linearised.of_arcs(self.fitted, self.correlation)

    def degenerate(self) -> dict[Key, float]:
        """The combination of coefficients that moves nothing, where there is one: as any two
        springs without friction follow from Lagrangians of a whole family."""
        if not np.isfinite(self.fitted.cost):
            return {}
        keys, step = self.structure.keys(), self.linearised.null_direction()
        return {keys[k]: float(step[k]) for k in np.flatnonzero(step)}

    def rms(self) -> np.ndarray:
        """Root mean square residual (k,), in units of the channels."""
        left = self.fitted.residuals * self.arcs.noise
        return np.sqrt(np.nanmean(left**2, axis=(0, 1))) * self.sigma


class Systems(NamedTuple):
    """Parameters of the systems that a recording is of: their names, and values (n, k) of the
    stretch of each of the nodes, and (m, k) of the positions of the gauge."""

    names: tuple[str, ...]
    of_nodes: np.ndarray
    of_gauge: np.ndarray

    @classmethod
    def of(cls, names: tuple[str, ...], nodes: Sequence[Nodes]) -> Systems | None:
        """Make those of the runs that the nodes are of; None where there are no such ``names``."""
        if not names:
            return None
        values = np.stack([n.stretch.args for n in nodes])
        return cls(names, values, np.repeat(values, [len(n.t) for n in nodes], axis=0))

    @property
    def which(self) -> np.ndarray:
        """The number (n,) of the system that each of the nodes is of."""
        return np.unique(self.of_nodes, axis=0, return_inverse=True)[1].ravel()

    @property
    def few(self) -> bool:
        """Return whether a third of the systems is needed to tell how they differ."""
        return bool(self.which.max() < 2 * FOLDS)

    def __call__(self, arcs: Arcs) -> np.ndarray:
        """(A, k) of arcs."""
        return self.of_nodes[[i for i, _, _ in arcs.home]]


class Without(NamedTuple):
    """A fit without a third of the record, and the run and the time at which a part of that third
    begins."""

    fit: LawFit
    run: str
    begins: float


@dataclasses.dataclass(frozen=True, eq=False)
class Workbench:
    """Basis that all fits of one recording share: positions of the gauge, the inputs of arcs, the
    fastest frequency ω, how states are seen, how zeros of channels wander, if they do, and the
    parameters of the systems, if these differ."""

    gauge: np.ndarray
    inputs: Any  # ArcInputs, or a function of arcs in their place where only fits are asked for
    omega: float
    observation: Observation
    wander: Wander | None = None
    systems: Systems | None = None

    def whitening(self, arcs: Arcs) -> np.ndarray | None:
        """Whitening (A, k, L, L) of the residuals of arcs; None where they are white."""
        if self.wander is None:
            return None
        return self.wander.whitening(arcs.t, np.where(np.isfinite(arcs.y), arcs.noise, np.inf))

    def model(self, structure: Structure, arcs: Arcs, given: np.ndarray, free: np.ndarray):
        u = self.inputs(arcs)
        h = np.diff(arcs.t, axis=1)
        if self.systems is None:
            form, args = structure.form(self.gauge), None
        else:
            form, args = structure.form(self.gauge, self.systems.of_gauge), self.systems(arcs)
        args = None if form.powers is None else args
        return LawOnArcs(form, self.observation, structure.zeros, h, u, given, free, args)

    def state_scale(self, sigma: np.ndarray) -> np.ndarray:
        """The defect (2d,) that counts as one standard deviation of the channels."""
        own = self.observation.state_sigma(self._states, sigma)
        return np.concatenate([own, own * self.omega])

    @property
    def _states(self) -> np.ndarray:
        return np.concatenate([self.gauge, 0 * self.gauge], axis=1)

    def fit(
        self,
        structure: Structure,
        known: Mapping[Key, float],
        arcs: Arcs,
        sigma: np.ndarray,
        rescale: bool = True,
    ) -> LawFit:
        """Fit coefficients from those ``known``; σ is made that of the residuals if ``rescale``."""
        p = structure.start(structure.in_gauge(known, self.gauge))
        x = arcs.x
        model = self.model(structure, arcs, p, np.arange(len(p)))
        whitening = self.whitening(arcs)
        for _ in range(3 if rescale else 1):
            noise, scale = sigma * arcs.noise, self.state_scale(sigma)
            readings = Readings(model, arcs.y, noise, self.observation.loss, whitening)
            found = readings.fit(p, x, scale, tolerance=1e-4 if rescale else 1e-3)
            p, x = found.p, found.x
            change = np.nanmedian(np.abs(found.whitened), axis=(0, 1)) / 0.6745
            change = np.maximum(change, 1e-3)
            if not rescale or np.max(np.abs(np.log(change))) < np.log(_SETTLED):
                break
            sigma = sigma * change
        return LawFit(structure, model.form, arcs, found, sigma, correlation_time(found.whitened))

    def held_out(self, fit: LawFit, arcs: Arcs) -> np.ndarray:
        """The cost (A,) of arcs that the fit has not seen, with their own states; of one that no
        orbit of the law follows, with the defects that are left. Infinite, of all, where one has
        states that the law has no steps from: nothing was fitted then."""
        model = self.model(fit.structure, arcs, fit.p, np.arange(0))
        noise, scale = fit.sigma * arcs.noise, self.state_scale(fit.sigma)
        loss = self.observation.loss
        readings = Readings(model, arcs.y, noise, loss, self.whitening(arcs))
        found = readings.fit(np.zeros(0), arcs.x, scale, max_iterations=15, tolerance=1e-3)
        lost = np.isfinite(arcs.y) & ~np.isfinite(found.residuals)
        if lost.any() or not np.isfinite(found.open).all():
            return np.full(len(arcs.home), np.inf)
        return np.nansum(loss.of(found.residuals), axis=(1, 2)) + found.open

    def cross_validate(
        self, nodes: Sequence[Nodes], fit: LawFit, structure: Structure, known: Mapping[Key, float]
    ) -> np.ndarray:
        """Held-out cost (A,) of each arc: of three blocks of arcs, each left out of a fit. All in
        the noise scale of ``fit``; infinite where a fit fails."""
        arcs, third = in_thirds(nodes, fit, self.systems)
        costs = np.full(len(arcs.home), np.inf)
        for k in range(FOLDS):
            some = self.fit(structure, known, arcs.take(third != k), fit.sigma, rescale=False)
            costs[third == k] = self.held_out(some, arcs.take(third == k))
        return costs

    def without_thirds(self, nodes: Sequence[Nodes], fit: LawFit) -> list[Without]:
        """The fit without each third of the record, by one Gauss–Newton step from that to all of
        it: close to a fit its residuals are linear in the coefficients; where the parts of each
        third begin."""
        arcs, third = in_thirds(nodes, fit, self.systems)
        noise, scale, loss = (
            fit.sigma * arcs.noise,
            self.state_scale(fit.sigma),
            self.observation.loss,
        )
        known = self.model(fit.structure, arcs, fit.p, np.arange(0))
        whitening = self.whitening(arcs)
        readings = Readings(known, arcs.y, noise, loss, whitening)
        own = readings.fit(np.zeros(0), arcs.x, scale, max_iterations=15)
        rows = self.rows(fit.structure, fit, dataclasses.replace(arcs, x=own.x))
        numbers = np.unique(third).tolist()
        parts = [Triangle.of(rows[third == k].reshape(-1, rows.shape[-1])) for k in numbers]
        fits = {}
        for k, p in zip(numbers, without_each(fit.p, parts), strict=True):
            fitted = dataclasses.replace(fit.fitted, p=p)
            fits[k] = dataclasses.replace(fit, fitted=fitted)
        begun = np.flatnonzero(np.diff(third, prepend=-1)).tolist()
        homes = [(int(third[j]), *arcs.home[j][:2]) for j in begun]
        return [Without(fits[k], nodes[i].stretch.run, float(nodes[i].t[a])) for k, i, a in homes]

    def scores(self, fit: LawFit, candidates: Structure) -> dict[Key, float]:
        """Distance from zero, in standard errors, of each coefficient of ``candidates`` that the
        fit lacks, were it alone added, by the scatter of what it would leave over; 0 for those that
        the others imitate."""
        known = fit.values
        new = [k for k in candidates.keys() if k not in known]  # noqa: SIM118
        larger = fit.structure.plus(new)
        added = self.linearised(larger, fit).added(*places(larger, fit.structure, new))
        scores = added.scores(fit.correlation, _IMITATED, _LEAST_LEFT)
        return dict(zip(new, scores.tolist(), strict=True))

    def linearised(self, structure: Structure, fit: LawFit, arcs: Arcs | None = None) -> Linearised:
        """The problem of a structure close to a fit of it, or of a part of it, the states of arcs
        eliminated; ``arcs``: others than those of the fit, with their states."""
        readings, p, x = self._close_to(structure, fit, arcs)
        return Linearised(p, Triangle.of(readings.eliminated_rows(p, x)), fit.correlation)

    def rows(self, structure: Structure, fit: LawFit, arcs: Arcs | None = None) -> np.ndarray:
        """The rows (A, L, k, n + 1) of the same problem."""
        readings, p, x = self._close_to(structure, fit, arcs)
        return readings.rows(p, x)

    def _close_to(
        self, structure: Structure, fit: LawFit, arcs: Arcs | None
    ) -> tuple[Readings, np.ndarray, np.ndarray]:
        arcs = dataclasses.replace(fit.arcs, x=fit.fitted.x) if arcs is None else arcs
        p = structure.start(fit.values)
        model = self.model(structure, arcs, p, np.arange(len(p)))
        noise, white = fit.sigma * arcs.noise, self.whitening(arcs)
        return Readings(model, arcs.y, noise, self.observation.loss, white), p, arcs.x


def places(
    larger: Structure, fitted: Structure, omitted: Sequence[Key]
) -> tuple[list[int], list[int]]:
    """Places among the coefficients of a ``larger`` structure of those that are fitted, and of
    those that are omitted."""
    keys = larger.keys()
    return [keys.index(k) for k in fitted.keys()], [keys.index(k) for k in omitted]  # noqa: SIM118


def describe(fit: LawFit) -> str:
    """A line for people; residuals in units of their channels' standard deviations."""
    share = 100 * fit.rms() / np.nanstd(fit.arcs.y, axis=(0, 1))
    rms = ", ".join(f"{r:.2g}" for r in share)
    return (
        f"{len(fit.p)} coefficients, RMS residual {rms} % of the spread, correlated over "
        f"{fit.correlation:.1f} samples, {fit.fitted.iterations} iterations"
        + ("" if fit.fitted.converged else ", not converged")
    )


def in_thirds(
    nodes: Sequence[Nodes], fit: LawFit, systems: Systems | None = None
) -> tuple[Arcs, np.ndarray]:
    """Arcs of the nodes, and the third of the record (A,) that each lies in. They are as long as
    those of the fit, or as long as three of them can be."""
    length = min(fit.arcs.t.shape[1], a_third(nodes, systems))
    arcs = arcs_of(with_states(nodes, fit.arcs, fit.fitted.x), length)
    return arcs, thirds_of(arcs, systems)


def a_third(nodes: Sequence[Nodes], systems: Systems | None) -> int:
    """The length of which three arcs can be: of all nodes, of a few systems of those of each."""
    lengths = np.array([len(n.t) for n in nodes])
    if systems is None or not systems.few:
        return int(lengths.sum()) // FOLDS
    return int(np.bincount(systems.which, lengths).min()) // FOLDS


def thirds_of(arcs: Arcs, systems: Systems | None) -> np.ndarray:
    """The third of the record (A,) that each arc lies in: of a few systems a third of the runs of
    each, for without one of them hardly anything tells how a law depends on their parameters."""
    count = len(arcs.home)
    place = np.arange(count)
    if systems is not None and systems.few:
        own = systems.which[[i for i, _, _ in arcs.home]]
        earlier = np.array([np.sum(own[:k] == own[k]) for k in place])
        share = (earlier + 0.5) / np.bincount(own)[own]
        place = np.argsort(np.argsort(share, kind="stable"))
    return place * FOLDS // count


def correlation_time(residuals: np.ndarray) -> float:
    """1 + 2 Σ ρ_k of residuals (A, L, d) along arcs, until ρ_k falls below 0.05; at least 1."""
    r = np.where(np.isfinite(residuals), residuals, 0.0)
    finite = np.isfinite(residuals).astype(float)
    power = np.sum(r * r) / max(np.sum(finite), 1.0)
    total = 1.0
    for k in range(1, r.shape[1]):
        pairs = np.sum(finite[:, k:] * finite[:, :-k])
        rho = np.sum(r[:, k:] * r[:, :-k]) / max(pairs, 1.0) / max(power, 1e-300)
        if rho < 0.05:
            break
        total += 2 * rho
    return total
