"""The problem that all fits of one recording share, what Gauss–Newton asks of a law along its arcs,
and a structure of a law fitted to them."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Mapping, Sequence
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np

from gfnn_jax.budget import UNBOUNDED, Allowance
from gfnn_jax.dataset.stretches import Arcs, Nodes, Scales, arcs_of, with_noise, with_states
from gfnn_jax.families.friction import PLACED, STRIBECK
from gfnn_jax.families.lagrangian import INPUTS
from gfnn_jax.fitting.evidence import EVIDENCE, Evidence, correlation_time, criterion
from gfnn_jax.fitting.linearised import Linearised, without_each
from gfnn_jax.fitting.triangle import Triangle
from gfnn_jax.flows.motion import Form, Step
from gfnn_jax.maps.observation import Observation
from gfnn_jax.models.lagrangians.arc_inputs import ArcInputs
from gfnn_jax.models.lagrangians.libraries import FRICTIONS, kind_named
from gfnn_jax.models.lagrangians.structure import Key, Structure, is_constant
from gfnn_jax.models.lagrangians.text import Names, word_of
from gfnn_jax.models.lagrangians.windows import Windows
from gfnn_jax.solve.latent_arcs import Defects, Fitted, Observed, Readings
from gfnn_jax.solve.noise import Wander

_SMALL = 0.01  # of a step, or of a speed, over which is differenced


@dataclasses.dataclass(frozen=True, eq=False)
class LawOnArcs:
    """Steps h (A, L − 1) of a law with inputs u (A, L − 1, substeps, 6, k). What is seen are the
    channels of ``observation`` plus the ``zeros`` of angles; their coefficients come last, first
    the zeros', then the parameters of ``observation``. Coefficients that are not ``free`` (indices)
    stay as in ``given``. args (A, k): parameters of the system that each arc is of, where the
    coefficients depend on such. allowance: spends the numbers that steps and their derivatives
    are."""

    form: Form
    observation: Observation
    zeros: tuple[int, ...]
    h: np.ndarray
    u: np.ndarray
    given: np.ndarray
    free: np.ndarray
    args: np.ndarray | None = None
    allowance: Allowance = UNBOUNDED

    def full(self, p: np.ndarray) -> np.ndarray:
        """All coefficients, of the free ones."""
        whole = self.given.copy()
        whole[self.free] = p
        return whole

    def _of_arcs(self, whole: np.ndarray) -> tuple[Form, np.ndarray, np.ndarray | None]:
        """The form of one system, its coefficients, (n,) or (A, n), and their derivatives (A, n,
        count) in those of the form, None where they are the same."""
        coefficients = whole[: self.form.count]
        if self.args is None:
            return self.form, coefficients, None
        return self.form.in_systems(coefficients, self.args)

    def _stepped(self, whole: np.ndarray, x: np.ndarray, order: int) -> tuple[Step, Any]:
        """Steps from all states x (A, L, m) but the last of each arc, with derivatives as of
        `Form.step`, and those of the form's coefficients as of `_of_arcs`."""
        arcs, length, m = x.shape
        num = arcs * (length - 1)
        columns = (0, m, m + len(self.free))[order]
        self.allowance.spend(num * self.u.shape[2] * m * (1 + columns))
        form, coefficients, turn = self._of_arcs(whole)
        if turn is not None:
            coefficients = np.repeat(coefficients, length - 1, axis=0)
        before, h = x[:, :-1].reshape(num, m), self.h.reshape(num)
        u = self.u.reshape(num, *self.u.shape[2:])
        return form.step(coefficients, before, h, u, order), turn

    def closing(self, p: np.ndarray, x: np.ndarray) -> np.ndarray:
        """The defects (A, L − 1, m) without derivatives."""
        return self._stepped(self.full(p), x, 0)[0].states.reshape(x[:, 1:].shape) - x[:, 1:]

    def defects(self, p: np.ndarray, x: np.ndarray) -> Defects:
        arcs, length, m = x.shape
        whole, num = self.full(p), arcs * (length - 1)
        step, turn = self._stepped(whole, x, 2 if len(self.free) else 1)
        of_step = step.by_coefficients
        if turn is not None and len(self.free):
            of_step = (of_step.reshape(arcs, -1, turn.shape[1]) @ turn).reshape(num, m, -1)
        by = np.zeros((num, m, len(whole)))
        by[..., : of_step.shape[-1]] = of_step
        shape = (arcs, length - 1, m)
        return Defects(
            step.states.reshape(shape) - x[:, 1:],
            step.by_state.reshape(*shape, m),
            by[..., self.free].reshape(*shape, len(self.free)),
        )

    def followed(self, p: np.ndarray, x: np.ndarray) -> np.ndarray:
        """The orbits (A, L, 2d) of the law from the first states of x (A, L, 2d)."""
        form, coefficients, _ = self._of_arcs(self.full(p))
        states = form.follow(coefficients, x[:, 0], self.h, self.u, order=0).states
        return np.concatenate([x[:, :1], states], axis=1)

    def observe(self, p: np.ndarray, x: np.ndarray) -> Observed:
        whole, first = self.full(p), self.form.count
        last = first + len(self.zeros)
        shown, by_law = self._shown(x, whole, whole[last:])
        values, by = shown.values, np.zeros((*shown.values.shape, len(whole)))
        by[..., last:] = shown.by_coefficients
        by[..., :first] = by_law
        for k, i in enumerate(self.zeros, first):
            channel = self.observation.direct[i]
            values[..., channel] += whole[k]
            by[..., channel, k] = 1.0
        return Observed(values, shown.by_state, by[..., self.free])

    def _shown(
        self, x: np.ndarray, whole: np.ndarray, values: np.ndarray
    ) -> tuple[Observed, np.ndarray | float]:
        """Channels of states, and their derivatives in the coefficients of the law."""
        if not self.observation.accelerated:
            return self.observation(x, values), 0.0
        form, coefficients, turn = self._of_arcs(whole)
        u = np.concatenate([self.u[:, :, 0, 0], self.u[:, -1:, -1, -1]], axis=1)
        small = _SMALL * float(np.median(self.h[self.h > 0]))
        shown, by = self.observation.along(form, coefficients, x, u, small, values)
        return shown, by if turn is None else by @ turn[:, None]

    def take(self, arcs: np.ndarray) -> LawOnArcs:
        args = None if self.args is None else self.args[arcs]
        return dataclasses.replace(self, h=self.h[arcs], u=self.u[arcs], args=args)


FOLDS = 3


@dataclasses.dataclass(frozen=True)
class SearchOptions:
    """Constants of fits and of the search, the same for all recordings (chosen on
    `benchmarks/measured.py` and `random_recordings.py`).

    periods: lengths of arcs, in periods of the fastest motion. fewest: nodes of the shortest arc.
    evidence: what a change of the law needs. tries: terms tried in a row. choices: of the friction,
    each close to the fit before. sharper: times smaller standard errors, at which shorter arcs are
    tried. as_well: times the cost, with which a law follows the record as well. settled: ratio of
    noise scales that needs no second fit. least_left: of the squares of residuals, that an added
    term may leave. imitated: share of what a term changes, below which the fitted ones imitate it.
    least: noise of a channel, of its spread; rounding, truncation and printed digits are below it.
    singular: eigenvalue of M, its diagonal 1, of motion with no inertia to speak of.
    beside: ratio of the speeds of two coordinates, from which on their difference is that of one.
    lengths: units, by their size in that of the first.
    frictions: kinds that are tried; choose_friction: by held-out arcs, else all of these. partly:
    laws with hidden coordinates may leave more than noise.
    """

    periods: tuple[float, ...] = (0.5, 1.0, 2.0, 4.0)
    fewest: int = 6
    evidence: Evidence = EVIDENCE
    tries: int = 3
    choices: int = 3
    sharper: float = 1.5
    as_well: float = 1.01
    settled: float = 1.15
    least_left: float = 1e-4
    imitated: float = 0.03
    least: float = 1e-7
    singular: float = 1e-5
    beside: float = 100.0
    lengths: tuple[tuple[str, int], ...] = (("mm", 1), ("cm", 10), ("m", 1_000), ("km", 1_000_000))
    frictions: tuple[str, ...] = FRICTIONS
    choose_friction: bool = True
    partly: bool = True


class Systems(NamedTuple):
    """Parameters of the systems that a recording is of: their names, and values (n, k) of the
    segment of each of the nodes."""

    names: tuple[str, ...]
    of_nodes: np.ndarray

    @classmethod
    def of(cls, names: tuple[str, ...], nodes: Sequence[Nodes]) -> Systems:
        """Make those of the runs that the nodes are of; none where there are no ``names``."""
        return cls(names, np.array([n.stretch.args if names else () for n in nodes]))

    @property
    def which(self) -> np.ndarray:
        """The number (n,) of the system that each of the nodes is of."""
        if not self.names:
            return np.zeros(len(self.of_nodes), int)
        return np.unique(self.of_nodes, axis=0, return_inverse=True)[1].ravel()

    @property
    def few(self) -> bool:
        """Return whether a third of the systems is needed to identify how they differ."""
        return bool(self.names) and bool(self.which.max() < 2 * FOLDS)

    def a_third(self, nodes: Sequence[Nodes]) -> int:
        """The length of which three arcs can be: of all nodes; of few systems, of those of each."""
        lengths = np.array([len(n.t) for n in nodes])
        which = self.which if self.few else 0 * lengths
        return int(np.bincount(which, lengths).min()) // FOLDS

    def thirds(self, arcs: Arcs) -> np.ndarray:
        """The third of the record (A,) that each arc lies in: of a few systems a third of the runs
        of each, for without one of them hardly anything shows how a law depends on them."""
        order, sizes = np.arange(len(arcs.home)), np.array([b - a for _, a, b in arcs.home])
        if self.few:
            own = self.which[[i for i, _, _ in arcs.home]]
            earlier = np.array([np.sum(own[:k] == own[k]) for k in order])
            order = np.argsort((earlier + 0.5) / np.bincount(own)[own], kind="stable")
        third = np.empty(len(order), int)
        third[order] = even_thirds(sizes[order])
        return third


def even_thirds(sizes: np.ndarray) -> np.ndarray:
    """The third (n,) of each of n parts of these sizes (n,), in a row: the least sum of squares of
    the thirds' sizes, for one that holds hardly anything decides nothing; of several the one whose
    first thirds are larger."""
    count = len(sizes)
    if count <= FOLDS:
        return np.arange(count)
    ends = np.concatenate([[0.0], np.cumsum(sizes)])
    a = np.repeat(np.arange(1, count - 1), 2)
    halved = np.searchsorted(ends, (ends[a] + ends[-1]) / 2)
    b = np.clip(halved - np.arange(len(a)) % 2, a + 1, count - 1)
    uneven = ends[a] ** 2 + (ends[b] - ends[a]) ** 2 + (ends[-1] - ends[b]) ** 2
    best = max(np.flatnonzero(uneven == uneven.min()), key=lambda k: (a[k], b[k]))
    return np.repeat(np.arange(FOLDS), np.diff([0, a[best], b[best], count]))


@dataclasses.dataclass(frozen=True, eq=False)
class ArcProblem:
    """Basis that all fits of one recording share.

    nodes: with the states of the last fit. scales: from the samples. observation: how states are
    seen. angles: coordinates that are. rules: of the inputs between samples, that may be tried.
    parameters: names of those in which the systems of the runs differ. wander: of the zeros of
    channels, where they do. gauge: (n, d) positions over which the mean inertia is 1; those of the
    nodes unless given. inputs: `ArcInputs`, by the first of the rules unless given, or a function
    of arcs in their place where nothing else is asked of them. forces: names of the inputs.
    allowance: what fits may take, in numbers of `LawOnArcs`. units: of the coordinates, "" of those
    that are not known.
    """

    nodes: Sequence[Nodes]
    scales: Scales
    observation: Observation
    angles: tuple[int, ...] = ()
    rules: tuple[str, ...] = ("hold",)
    parameters: tuple[str, ...] = ()
    options: SearchOptions = SearchOptions()
    on_progress: Callable[[str], object] = lambda line: None
    wander: Wander | None = None
    gauge: np.ndarray = None  # pyright: ignore[reportAssignmentType]
    inputs: Any = None
    forces: tuple[str, ...] = INPUTS
    allowance: Allowance = UNBOUNDED
    units: tuple[str, ...] = ()

    def __post_init__(self):
        if self.gauge is None:
            object.__setattr__(self, "gauge", self.states[:, : self.dim])
        if self.inputs is None:
            inputs = ArcInputs(self.nodes, self.scales.substeps, self.rules[0])
            object.__setattr__(self, "inputs", inputs)

    @property
    def dim(self) -> int:
        return self.observation.dim

    @property
    def num_inputs(self) -> int:
        return self.nodes[0].stretch.u.shape[1]

    @functools.cached_property
    def systems(self) -> Systems:
        return Systems.of(self.parameters, self.nodes)

    @functools.cached_property
    def windows(self) -> Windows:
        """The windows of weak forms."""
        return Windows.of_record(self.nodes, self.scales)

    @property
    def states(self) -> np.ndarray:
        """The states (n, 2d) of all nodes."""
        return np.concatenate([n.x for n in self.nodes])

    @property
    def args(self) -> np.ndarray:
        """Parameters (n, k) of the system of each of these states."""
        return np.concatenate([np.tile(n.stretch.args, (len(n.t), 1)) for n in self.nodes])

    @property
    def sensors(self) -> tuple[tuple[str, float], ...]:
        """The sensors' parameters, with where they start."""
        names, values = self.observation.parameters, self.observation.values
        return tuple(zip(names, map(float, values), strict=True))

    @property
    def turned(self) -> tuple[int, ...]:
        """Angles whose zero is unknown: those that a channel shows as they are."""
        shown = set(self.observation.direct) - set(self.observation.shifts())
        return tuple(i for i in self.angles if i in shown)

    @property
    def lengths(self) -> tuple[int, ...]:
        """The coordinates that are no angles."""
        return tuple(i for i in range(self.dim) if i not in self.angles)

    @property
    def joints(self) -> list[tuple[int, ...]]:
        """The directions of the relative speeds of neighbours, lengths in the unit of the shorter.
        None of an angle and a length, of other units that differ, or of a coordinate that is so
        much faster that it alone would make the difference."""
        speed, found = np.sqrt(np.mean(self.states[:, self.dim :] ** 2, axis=0)), []
        units = ["rad" if i in self.angles else u for i, u in enumerate(self.units)]
        sizes = dict(self.options.lengths)
        for i, (a, b) in enumerate(pairwise(units or [""] * self.dim)):
            both = sizes.get(a, 1), sizes.get(b, 1)
            alike = a == b or (a in sizes and b in sizes) or ("rad" not in (a, b) and not (a and b))
            both = both if a in sizes and b in sizes else (1, 1)
            c = np.zeros(self.dim, int)
            c[i : i + 2] = np.array([-1, 1]) * both // np.gcd(*both)
            least, most = sorted(np.abs(c * speed)[i : i + 2])
            if alike and most < self.options.beside * least:
                found.append(tuple(c.tolist()))
        return found

    @property
    def squares(self) -> bool:
        """Return whether squares of the inputs are no constants together, as of two waves."""
        u = np.concatenate([n.stretch.u for n in self.nodes])[:, -2:]
        return bool(np.ptp(np.sum(u**2, axis=1)) > 1e-6 * np.sum(u**2, axis=1).max(initial=0.0))

    @property
    def within_a_turn(self) -> tuple[int, ...]:
        """Angles that stay within a turn in each run, of which a law may have powers."""
        ranges = [np.ptp(n.x[:, : self.dim], axis=0) for n in self.nodes]
        return tuple(i for i in self.angles if max(r[i] for r in ranges) < 2 * np.pi)

    def by_rule(self, rule: str) -> ArcProblem:
        """The problem with the inputs of one rule between samples, without a delay; as it is where
        that is its only rule."""
        if self.rules == (rule,):
            return self
        return dataclasses.replace(self, inputs=self.inputs.by_rule(rule), rules=(rule,))

    def length(self, periods: float) -> int:
        """Nodes of an arc of so many periods."""
        return max(self.options.fewest, round(periods * self.scales.per_period))

    def arcs(self, periods: float) -> Arcs:
        """The nodes in arcs of so many periods."""
        return arcs_of(self.nodes, self.length(periods))

    def word(self, key: Key) -> str:
        """A coefficient by the names of columns."""
        seen = self.observation
        names = Names(seen.coordinates, seen.speeds, self.parameters, self.forces)
        return word_of(key, names.symbols)

    def law(self, structure: Structure, arcs: Arcs, p: np.ndarray, free: bool = True) -> LawOnArcs:
        """The law of coefficients p on arcs, all of them free or none."""
        form = structure.form(self.gauge, self.args if self.parameters else None)
        args = None
        if form.powers is not None:
            args = self.systems.of_nodes[[i for i, _, _ in arcs.home]]
        h, u = np.diff(arcs.t, axis=1), self.inputs(arcs)
        places = np.arange(len(p) if free else 0)
        seen, allowance = self.observation, self.allowance
        return LawOnArcs(form, seen, structure.zeros, h, u, p, places, args, allowance)

    def whitening(self, arcs: Arcs) -> np.ndarray | None:
        """Whitening (A, k, L, L) of the residuals of arcs; None where they are white."""
        if self.wander is None:
            return None
        return self.wander.whitening(arcs.t, np.where(np.isfinite(arcs.y), arcs.noise, np.inf))

    def readings(self, law: LawOnArcs, arcs: Arcs, sigma: np.ndarray) -> Readings:
        """The readings of arcs, beside a law on them."""
        noise, loss = sigma * arcs.noise, self.observation.loss
        return Readings(law, arcs.y, noise, loss, self.whitening(arcs))

    def state_scale(self, sigma: np.ndarray) -> np.ndarray:
        """The defect (2d,) that counts as one standard deviation of the channels."""
        states = np.concatenate([self.gauge, 0 * self.gauge], axis=1)
        own = self.observation.state_sigma(states, sigma, self.scales.omega)
        return np.concatenate([own, own * self.scales.omega])

    def fit(
        self,
        structure: Structure,
        known: Mapping[Key, float],
        arcs: Arcs,
        sigma: np.ndarray,
        rescale: bool = True,
    ) -> LawFit:
        """Fit coefficients from those ``known``; σ is made that of the residuals if ``rescale``.

        Residuals of recordings without noise are rounding and truncation, and coloured: a channel
        that leaves less than the least noise is given what is missing.
        """
        p = structure.start(structure.in_gauge(known, self.gauge))
        law, x = self.law(structure, arcs, p), arcs.x
        readings = self.readings(law, arcs, sigma)
        tolerance = 1e-4 if rescale else 1e-3
        for _ in range(3 if rescale else 1):
            readings = dataclasses.replace(readings, sigma=sigma * arcs.noise)
            found = readings.fit(p, x, self.state_scale(sigma), tolerance=tolerance)
            p, x = found.p, found.x
            change = np.nanmedian(np.abs(found.whitened), axis=(0, 1)) / 0.6745
            change = np.maximum(change, 1e-3)
            if not rescale or np.max(np.abs(np.log(change))) < np.log(self.options.settled):
                break
            sigma = sigma * change
        followed = dataclasses.replace(self, nodes=with_states(self.nodes, arcs, found.x))
        time = correlation_time(found.whitened)
        fit = LawFit(followed, structure, law.form, arcs, found, sigma, time)
        least, left = self.options.least * fit.spread, fit.rms()
        missing = np.sqrt(np.where(left < 0.9 * least, least**2 - left**2, 0.0))
        if not (rescale and missing.any()):
            return fit
        nodes, arcs = with_noise(followed.nodes, fit.followed, missing)
        noisy = dataclasses.replace(self, nodes=nodes)
        return noisy.fit(structure, fit.values, arcs, np.hypot(sigma, missing), False)

    def linearised(self, structure: Structure, fit: LawFit, arcs: Arcs | None = None) -> Linearised:
        """The problem of a structure close to a fit of it, or of a part of it, the states of arcs
        eliminated; ``arcs``: others than those of the fit, with their states."""
        rows = self.rows(structure, fit, arcs)
        triangle = Triangle.of(rows.reshape(-1, rows.shape[-1]))
        return Linearised(structure.start(fit.values), triangle, fit.correlation)

    def rows(self, structure: Structure, fit: LawFit, arcs: Arcs | None = None) -> np.ndarray:
        """The rows (A, L, k, n + 1) of the same problem."""
        arcs, p = arcs or fit.followed, structure.start(fit.values)
        law = self.law(structure, arcs, p)
        return self.readings(law, arcs, fit.sigma).rows(p, arcs.x)


@dataclasses.dataclass(frozen=True, eq=False)
class LawFit:
    """A structure fitted to arcs, in the gauge of ``form``; σ (k,) is the scale of the residuals of
    each channel, τ their correlation time in nodes. problem: with the states of this fit."""

    problem: ArcProblem
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
    def follows(self) -> bool:
        """Return whether orbits of the law follow all arcs."""
        return bool(np.isfinite(self.fitted.cost))

    @property
    def independent(self) -> float:
        """The number of residuals that are independent."""
        return np.count_nonzero(np.isfinite(self.arcs.y)) / self.correlation

    def criterion(self, independent: float | None = None) -> float:
        """Schwarz's criterion of its coefficients, by so many independent residuals; None: its
        own."""
        return criterion(self.fitted.cost, independent or self.independent, len(self.p))

    @functools.cached_property
    def is_definite(self) -> bool:
        """Return whether M is positive definite at all states, and not nearly singular: else there
        is no least energy, or motion with no inertia, which terms that are told only together
        make."""
        law, d = self.form.lagrangian(self.p[: self.form.count]), self.form.dim
        if not np.all(np.isfinite(self.p)):
            return False
        masses = law.at(self.problem.args).masses(self.problem.states[:, :d])
        leads = np.isin(np.arange(d), self.structure.leaders)
        masses = np.where(leads[:, None] == leads, masses, 0.0)
        own = np.sqrt(np.diagonal(masses, axis1=-2, axis2=-1).clip(1e-300))
        scaled = masses / (own[..., :, None] * own[..., None, :])
        return bool(np.linalg.eigvalsh(scaled).min() > self.problem.options.singular)

    @property
    def least_share(self) -> float:
        """The least share of the kinetic energy that a coordinate has by its own motion."""
        q, v = np.split(self.problem.states, 2, axis=1)
        law = self.form.lagrangian(self.p[: self.form.count]).at(self.problem.args)
        masses = np.diagonal(law.masses(q), axis1=-2, axis2=-1)
        energies = np.mean(masses * v**2, axis=0)
        return float(energies.min() / energies.max())

    @property
    def followed(self) -> Arcs:
        """The arcs with the states of the fit."""
        return dataclasses.replace(self.arcs, x=self.fitted.x)

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
        """The coefficients, those that are held, and those that the gauge gives, but for the
        constant mass of the first coordinate."""
        structure, form = self.structure, self.form
        values = dict(zip(structure.keys(), map(float, self.p), strict=True))
        begin = int(is_constant(structure.terms[0]))
        if structure.given[begin:] or structure.held:
            theta = form.lagrangian(self.p[: form.count]).coefficients.tolist()
            own = zip(structure.terms[begin:], theta[begin:], strict=True)
            values |= {("term", row): value for row, value in own}
        return values

    @functools.cached_property
    def linearised(self) -> Linearised:
        """The problem close to p, in which correlated residuals count once; the speeds over which
        friction of kinds that were tried fades, and its centres, are at their best for each p, as
        they were fitted."""
        tried = {STRIBECK, PLACED} & {*map(kind_named, self.problem.options.frictions)}
        fading = [row for row in self.structure.friction if row[1] in tried and row[2]]
        if not (fading and self.follows):
            return Linearised.of_arcs(self.fitted, self.correlation)
        ends = [("loss", (*r[:2], r[2] * by)) for r in fading for by in (1 + _SMALL, 1 - _SMALL)]
        larger = self.structure.plus(ends)
        own, others = places(larger, self.structure, ends)
        turn = np.zeros((len(larger.keys()), len(fading) + len(own)))
        for k, row in enumerate(fading):
            turn[others[2 * k : 2 * k + 2], k] = self.values["loss", row] * np.array([1, -1])
        turn[own, len(fading) + np.arange(len(own))] = 1.0
        whole = self.problem.linearised(larger, self).combined(turn).triangle
        triangle = Triangle(whole.factor[len(fading) :, len(fading) :], whole.rows)
        return Linearised(self.p, triangle, self.correlation)

    @property
    def significance(self) -> dict[Key, float]:
        """Coefficients in units of their standard errors; friction that drives is below 0."""
        keys, z = self.structure.keys(), self.linearised.significance
        drives = [k[0] == "loss" and p < 0 for k, p in zip(keys, self.p, strict=True)]
        return dict(zip(keys, np.where(drives, -z, z).tolist(), strict=True))

    def degenerate(self) -> dict[Key, float]:
        """The combination of coefficients that moves nothing, where there is one: as any two
        springs without friction follow from Lagrangians of a whole family."""
        if not self.follows:
            return {}
        keys, step = self.structure.keys(), self.linearised.null_direction()
        return {keys[k]: float(step[k]) for k in np.flatnonzero(step)}

    @functools.cached_property
    def undetermined(self) -> set[Key]:
        """Coefficients that some combination which moves nothing is of."""
        if not self.follows:
            return set()
        parts = np.atleast_1d(np.any(self.linearised.null_space() != 0, axis=0)).tolist()
        keys = self.structure.keys()
        return {key for key, part in zip(keys, parts, strict=True) if part}

    def rms(self) -> np.ndarray:
        """Root mean square residual (k,), in units of the channels."""
        left = self.fitted.residuals * self.arcs.noise
        return np.sqrt(np.nanmean(left**2, axis=(0, 1))) * self.sigma

    @property
    def loudest(self) -> float:
        """The largest residual of a channel, in units of its noise."""
        return float(np.max(self.rms() / self.problem.scales.sigma))

    @property
    def spread(self) -> np.ndarray:
        """Standard deviation (k,) of the channels; of times of events the period."""
        spread = np.nanstd(self.arcs.y, axis=(0, 1))
        spread[list(self.problem.observation.events)] = self.problem.scales.period
        return spread

    def __str__(self) -> str:
        """A line for people; residuals in units of their channels' standard deviations."""
        share = 100 * self.rms() / self.spread
        rms = ", ".join(f"{r:.2g}" for r in share)
        return (
            f"{len(self.p)} coefficients, RMS residual {rms} % of the spread, correlated over "
            f"{self.correlation:.1f} samples, {self.fitted.iterations} iterations"
            + ("" if self.fitted.converged else ", not converged")
        )

    # Other fits from this one.

    def again(
        self,
        structure: Structure | None = None,
        known: Mapping[Key, float] | None = None,
        arcs: Arcs | None = None,
        problem: ArcProblem | None = None,
        rescale: bool = True,
    ) -> LawFit:
        """Fit from here, what is not given as it is here."""
        structure = structure or self.structure
        return (problem or self.problem).fit(
            structure,
            self.values_within(structure) if known is None else known,
            arcs or self.followed,
            self.sigma,
            rescale,
        )

    def values_within(self, structure: Structure) -> dict[Key, float]:
        """The coefficients, close to the fit by least squares, where those that a structure lacks
        are zero: along a straight orbit a spring that goes leaves its force to others. A mass that
        the gauge gives is free where the structure couples more."""
        keys, p = self.structure.keys(), self.p
        freed = [key for key in structure.keys() if key not in keys and key in self.values]  # noqa: SIM118
        of, kept = self.linearised.covariance, set(structure.keys())
        gone = [k for k, key in enumerate(keys) if key not in kept and 0 < of[k, k] < np.inf]
        if gone:
            size = np.sqrt(np.diag(of)[gone])
            together = of[np.ix_(gone, gone)] / np.outer(size, size)
            p = p - of[:, gone] / size @ np.linalg.lstsq(together, p[gone] / size)[0]
        own = {key: self.values[key] for key in freed}
        return own | dict(zip(keys, p.tolist(), strict=True))

    def in_thirds(self) -> tuple[Arcs, np.ndarray]:
        """Arcs of the nodes, and the third of the record (A,) that each lies in. They are as long
        as those of the fit, or as long as three of them can be."""
        nodes, systems = self.problem.nodes, self.problem.systems
        arcs = arcs_of(nodes, min(self.arcs.t.shape[1], systems.a_third(nodes)))
        return arcs, systems.thirds(arcs)

    def held_out(self, arcs: Arcs) -> np.ndarray:
        """The cost (A,) of arcs that the fit has not seen, with their own states; of one that no
        orbit of the law follows, with the defects that remain. Infinite, of all, where one has
        states that the law has no steps from: nothing was fitted then."""
        found = self._states_of(arcs, tolerance=1e-3)
        lost = np.isfinite(arcs.y) & ~np.isfinite(found.residuals)
        if lost.any() or not np.isfinite(found.open).all():
            return np.full(len(arcs.home), np.inf)
        loss = self.problem.observation.loss
        return np.nansum(loss.of(found.residuals), axis=(1, 2)) + found.open

    def _states_of(self, arcs: Arcs, tolerance: float) -> Fitted:
        """The states of arcs, with the coefficients as they are."""
        problem = self.problem
        law = problem.law(self.structure, arcs, self.p, free=False)
        readings, scale = problem.readings(law, arcs, self.sigma), problem.state_scale(self.sigma)
        return readings.fit(np.zeros(0), arcs.x, scale, max_iterations=15, tolerance=tolerance)

    @functools.cached_property
    def along_periods(self) -> LawFit:
        """The law along arcs of two periods, where those of the fit are shorter and its orbits
        follow them: shorter ones have so many states that their residuals look like noise."""
        arcs = self.problem.arcs(2.0)
        if arcs.t.shape[1] <= self.arcs.t.shape[1]:
            return self
        found = dataclasses.replace(self._states_of(arcs, tolerance=1e-4), p=self.p)
        longer = dataclasses.replace(self, arcs=arcs, fitted=found)
        return longer if longer.follows else self

    def cross_validate(
        self, structure: Structure | None = None, known: Mapping[Key, float] | None = None
    ) -> np.ndarray:
        """Held-out cost (A,) of each arc, of this structure or another: of three blocks of arcs,
        each left out of a fit. All in the noise scale of this fit; infinite where a fit fails. A
        structure without ``known`` is not fitted again: one search after another asks for it."""
        structure = structure or self.structure
        if known is None and structure in self._validated:
            return self._validated[structure]
        arcs, third = self.in_thirds()
        costs = np.full(len(arcs.home), np.inf)
        for k in range(FOLDS):
            some = self.again(structure, known, arcs.take(third != k), rescale=False)
            costs[third == k] = some.held_out(arcs.take(third == k))
        if known is None:
            self._validated[structure] = costs
        return costs

    @functools.cached_property
    def _validated(self) -> dict[Structure, np.ndarray]:
        """Held-out costs (A,) by structures that started from the coefficients of this fit."""
        return {}

    @property
    def costs(self) -> np.ndarray:
        """Held-out cost (A,) of each arc."""
        return self.cross_validate()

    def in_arcs(self, length: int) -> LawFit:
        """The structure fitted from here to arcs of this length (nodes), once for each."""
        if length not in self._in_arcs:
            self._in_arcs[length] = self.again(arcs=arcs_of(self.problem.nodes, length))
        return self._in_arcs[length]

    @functools.cached_property
    def _in_arcs(self) -> dict[int, LawFit]:
        """Fits to arcs of other lengths."""
        return {}

    def without_thirds(self) -> list[FoldFit]:
        """The fit without each third of the record, by one Gauss–Newton step from that to all of
        it: close to a fit its residuals are linear in the coefficients; where the parts of each
        third begin."""
        arcs, third = self.in_thirds()
        arcs = dataclasses.replace(arcs, x=self._states_of(arcs, tolerance=1e-4).x)
        rows = self.problem.rows(self.structure, self, arcs)
        numbers = np.unique(third).tolist()
        parts = [Triangle.of(rows[third == k].reshape(-1, rows.shape[-1])) for k in numbers]
        fits = {
            k: dataclasses.replace(self, fitted=dataclasses.replace(self.fitted, p=p))
            for k, p in zip(numbers, without_each(self.p, parts), strict=True)
        }
        begun = np.flatnonzero(np.diff(third, prepend=-1)).tolist()
        places = [(fits[int(third[j])], *arcs.home[j][:2]) for j in begun]
        nodes = self.problem.nodes
        return [FoldFit(f, nodes[i].stretch.run, float(nodes[i].t[a])) for f, i, a in places]

    def scores(self, candidates: Structure) -> dict[Key, float]:
        """Distance from zero, in standard errors, of each coefficient of ``candidates`` that the
        fit lacks, were it alone added, by the scatter of what it would leave; 0 for those that the
        others imitate."""
        new, options = [k for k in candidates.keys() if k not in self.values], self.problem.options  # noqa: SIM118
        larger = self.structure.plus(new)
        added = self.problem.linearised(larger, self).added(*places(larger, self.structure, new))
        scores = added.scores(self.correlation, options.imitated, options.least_left)
        return dict(zip(new, scores.tolist(), strict=True))

    def along(
        self,
        changes: Mapping[Key, float],
        larger: Structure,
        problem: ArcProblem | None = None,
        least: float | None = None,
    ) -> tuple[float, float]:
        """The number whose change moves further coefficients (of a ``larger`` structure) by these
        ``changes`` that fits best, to first order, and its standard error; 0 and NaN where the
        fitted ones imitate it up to the share ``least``."""
        whole = self.beside(changes, larger, problem)
        found = whole.added(range(len(whole.p) - 1), [len(whole.p) - 1])
        if not found.share[0] > (least or self.problem.options.imitated):
            return 0.0, np.nan
        return float(found.value[0]), float(np.sqrt(self.correlation) / found.size[0])

    def beside(
        self, changes: Mapping[Key, float], larger: Structure, problem: ArcProblem | None = None
    ) -> Linearised:
        """The problem of the fit and, the last coefficient, of the number that `along` is of."""
        own, others = places(larger, self.structure, list(changes))
        turn = np.zeros((len(larger.keys()), len(own) + 1))
        turn[own, range(len(own))] = 1.0
        turn[others, -1] = list(changes.values())
        return (problem or self.problem).linearised(larger, self).combined(turn)


class FoldFit(NamedTuple):
    """A fit without a third of the record, and the run and the time at which a part of that third
    begins."""

    fit: LawFit
    run: str
    begins: float


def places(
    larger: Structure, fitted: Structure, omitted: Sequence[Key]
) -> tuple[list[int], list[int]]:
    """Places among the coefficients of a ``larger`` structure of those that are fitted, and of
    those that are omitted."""
    keys = larger.keys()
    return [keys.index(k) for k in fitted.keys()], [keys.index(k) for k in omitted]  # noqa: SIM118
