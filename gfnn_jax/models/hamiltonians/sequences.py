"""H fitted to whole noisy sequences: coefficients, latent states and noise together.

Both states of a noisy pair are measured, so that noise stands among the regressors too, and a drift
of the coefficients that a pair hides beneath its noise grows along a sequence. An arc of measured
states is that of latent ones, each the image of the one before: the maximum of the likelihood where
noise is normal (`solve.latent_arcs`). An arc ends where noise would have grown beyond the linear.

A pair that is noise for the most part says little: over k steps the states move k times as far, and
the noise is the same. Terms of H are then looked for in the pairs (z_i, z_{i+k}), k dt apart.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from gfnn_jax.budget import UNBOUNDED, Allowance
from gfnn_jax.coordinates import CARTESIAN
from gfnn_jax.dataset.dataset import Dataset
from gfnn_jax.dataset.rows import of_differences
from gfnn_jax.dataset.runs import Arcs, arcs_of_pairs, onward, steps_between
from gfnn_jax.dataset.split import Split
from gfnn_jax.errors import InputError
from gfnn_jax.fitting.evidence import EVIDENCE
from gfnn_jax.fitting.significance import ABOVE_NOISE, terms_above_noise
from gfnn_jax.fitting.triangle import Triangle
from gfnn_jax.flows.collocation import Images, Steps, images
from gfnn_jax.models.hamiltonians.fitted_law import FittedLaw, SequenceFit
from gfnn_jax.models.hamiltonians.problem import LawProblem
from gfnn_jax.phase_space import Pairs
from gfnn_jax.solve.latent_arcs import (
    OUTLYING,
    Defects,
    Fitted,
    Known,
    Observed,
    Readings,
    observed_whole,
)
from gfnn_jax.solve.noise import Biweight, robust


@dataclasses.dataclass(frozen=True)
class SequenceOptions:
    """Tuned on Hénon–Heiles at dt 0.005 to 0.5 with noise of 1e-3 to 1e-2 (benchmarks/bands.py).

    Of pairs several steps apart: quiet: displacements, in units of their noise, of a step that
    needs none, and of those that are made. part: of a sequence, that one may be as long as. short:
    displacement of a step, in units of the coordinates' sizes, up to which the noise is told by the
    sequences' differences, of this order; alike: a factor within which those of the order before
    tell the same noise. fewest: of them for each set of pairs.

    longest: steps of an arc; shortest: of one that says more than its pairs do. grown: noise ÷
    spread at its end, if that of its first state goes on along it. states: from which the noise and
    its growth along an arc are measured. step_error: of a step's own error ÷ the noise.
    contradicted: robust deviations of both steps at a state, from which on it is not
    where the arc starts from. gained: part of the cost from which an iteration counts. block: lanes
    whose derivatives are computed at once. difference: of a constant, a forward difference, whose
    error is as large a part of it.
    rise: of the held-out arcs' noise, by chance. rows_per_term: measured numbers for each term from
    which on a law that held-out sequences have borne out is fitted to these too: what judges it
    then is off by less than 1 / 200 of the noise's variance. in_a_row: times the noise, below which
    neighbours of a state that stands alone stay. Misfit is certain beyond two standard
    errors of the arcs' variation, and ``clear`` of that of noise, which alone varies by a quarter.
    """

    quiet: float = 100.0
    part: float = 0.5
    short: float = 0.2
    order: int = 6
    alike: float = 1.5
    fewest: int = 50
    longest: int = 100
    shortest: int = 3
    grown: float = 0.1
    states: int = 100
    step_error: float = 0.01
    contradicted: float = 8.0
    gained: float = 1e-5
    block: int = 4_096
    difference: float = 1e-6
    rise: float = 1.01
    rows_per_term: float = 200.0
    in_a_row: float = 2.5
    clear: float = 0.5


OPTIONS, BIWEIGHT = SequenceOptions(), Biweight()


def arcs_of(data: Dataset) -> tuple[Dataset, int] | None:
    """The arcs that H is to be learned from, in chains whose images are the states of the next, and
    their length in steps; None where the pairs themselves serve: where no sequences are, where a
    step is long against its noise, and for pairs of many dt or parameters, or of a structure."""
    if data.varied or data.structure is not None:
        return None
    starts, lengths = _runs(data.pairs)
    usual = int(np.median(np.repeat(lengths, lengths)))  # that a pair stands in
    if usual <= OPTIONS.order:
        return None
    moved = (data.y1 - data.y0) / data.scale
    displacement = float(np.sqrt(np.mean(moved**2)))
    runs = [moved[first : first + count] for first, count in zip(starts, lengths, strict=True)]
    noise = of_differences(runs, OPTIONS.order, OPTIONS.alike)
    if noise is None or displacement > OPTIONS.short:
        return None
    wanted = int(np.ceil(OPTIONS.quiet * np.sqrt(2) * noise / displacement))
    length = min(wanted, int(OPTIONS.part * usual))
    if length < 2:
        return None
    return _strided(data, starts, lengths, length)


def _runs(pairs: Pairs) -> tuple[np.ndarray, np.ndarray]:
    """First row and number of rows of each stretch of a run without a gap."""
    starts = np.flatnonzero(np.append(True, steps_between(pairs) != 1))
    return starts, np.diff(np.append(starts, len(pairs)))


def _strided(data: Dataset, starts, lengths, length: int) -> tuple[Dataset, int] | None:
    """The arcs of so many steps that are wholly in the training pairs, or in those held out."""
    first = np.concatenate(
        [
            np.arange(begin + offset, begin + count - length + 1, length)
            for begin, count in zip(starts, lengths, strict=True)
            for offset in range(length)
        ]
    )
    along = first[:, None] + np.arange(length)
    pairs, moved = data.pairs, data.y1 - data.y0
    last = first + length - 1
    # In chains of arcs that follow one another, one for each offset in a run.
    begin = np.repeat(starts, lengths)[first]
    strided = Pairs(
        np.asarray(pairs.z0)[first],
        np.asarray(pairs.z1)[last],
        length * data.dt,
        run=begin + (first - begin) % length,
        place=(first - begin) // length,
    )
    angles = np.isin(np.arange(moved.shape[1]), data.coordinates.angles)
    # Angles go on over turns; what is no angle is as measured, without a sum's rounding.
    y0 = data.y0[first]
    y1 = np.where(angles, y0 + moved[along].sum(axis=1), data.y1[last])
    rows = []
    for own in (data.training, data.validation):
        inside = np.zeros(len(moved), bool)
        inside[own] = True
        rows.append(np.random.default_rng(0).permutation(np.flatnonzero(inside[along].all(axis=1))))
    if min(map(len, rows)) < OPTIONS.fewest:
        return None
    split = Split(rows[0], rows[1], np.zeros(0, int), np.arange(len(first)))
    arcs = dataclasses.replace(data, pairs=strided, row=data.row[first], y0=y0, y1=y1, split=split)
    return arcs, length


@dataclasses.dataclass(frozen=True, eq=False)
class FlowOnArcs:
    """The flow over dt of H = Σ c_j φ_j(z) on arcs in which these steps ``moves`` (A, L − 1); what
    comes after an arc's end stays as it is. allowance: checked before each block of lanes.

    terms: of H = Σ c_j φ_j(z; θ), p = (c, θ), so many; family: θ (k,) -> the terms. Raises nothing
    for θ without terms: the steps are then not finite. None: family is that of the terms, p = c.
    """

    family: Any
    dt: float
    how: Steps
    moves: np.ndarray
    allowance: Allowance = UNBOUNDED
    terms: int | None = None

    def defects(self, p: np.ndarray, x: np.ndarray) -> Defects:
        width, lanes = x.shape[-1], np.flatnonzero(self.moves)
        found = np.zeros((*self.moves.shape, width, 1 + width + len(p)))
        found[..., 0], found[..., 1 : 1 + width] = x[:, :-1] - x[:, 1:], np.eye(width)
        try:
            for first in range(0, len(lanes), OPTIONS.block):
                some = np.unravel_index(lanes[first : first + OPTIONS.block], self.moves.shape)
                found[some] = self._linearised(p, x[:, :-1][some], x[:, 1:][some])
        except InputError:
            found[:] = np.nan
        return Defects(found[..., 0], found[..., 1 : 1 + width], found[..., 1 + width :])

    def observe(self, p: np.ndarray, x: np.ndarray) -> Observed:
        return observed_whole(x, len(p))

    def take(self, arcs: np.ndarray) -> FlowOnArcs:
        return dataclasses.replace(self, moves=self.moves[arcs])

    def images(self, p: np.ndarray, z: np.ndarray, direction: int = 1) -> np.ndarray:
        """Images of states z (n, 2d), a step ahead or back."""
        return self._step(p, z, direction * self.dt).states

    def _step(self, p: np.ndarray, z: np.ndarray, dt: float, **options: Any) -> Images:
        """`flows.collocation.images` with these numbers. Raises InputError for constants without
        terms."""
        self.allowance.check()
        family = self.family if self.terms is None else self.family(p[self.terms :])
        return images(family, p[: self.terms], z, dt, self.how, **options)

    def _linearised(self, p: np.ndarray, y0: np.ndarray, y1: np.ndarray) -> np.ndarray:
        """[c, Φ, Γ] (n, 2d, 1 + 2d + numbers) of steps from y0 to y1 (n, 2d)."""
        found = self._step(p, y0, self.dt, derivatives=True)
        columns = [(found.states - y1)[..., None], found.by_state, found.by_coefficient]
        for k in range(len(p) if self.terms is None else self.terms, len(p)):
            moved, change = p.copy(), OPTIONS.difference * abs(p[k])
            moved[k] += change
            columns.append(((self.images(moved, y0) - found.states) / change)[..., None])
        return np.concatenate(columns, axis=-1)


@dataclasses.dataclass(frozen=True, eq=False)
class Measured:
    """Arcs of measured states. least: (2d,) of what is left over, what is no noise. angles:
    coordinates that are measured modulo 2π. relative: (A, L, 2d) the noise of each value, in parts
    of the usual one."""

    arcs: Arcs
    least: np.ndarray
    angles: tuple[int, ...] = ()
    relative: np.ndarray | float = 1.0

    def fit(
        self,
        model: FlowOnArcs,
        p,
        *,
        fix_coefficients: bool = False,
        gained: float = OPTIONS.gained,
        iterations: int = 30,
    ) -> Fitted | None:
        """The model's numbers, states and noise, from numbers p that are close, or with these as
        they are (``fix_coefficients``). None where the flow fails. gained: as of the options;
        iterations: at most."""
        p = np.array(p, float)
        lifted = dataclasses.replace(self, arcs=self.arcs._replace(states=self._lifted(model, p)))
        x, noise = lifted._starts(model, p)
        noise = np.hypot(noise, self.least)
        if not (np.isfinite(x).all() and np.isfinite(noise).all()):
            return None
        given, free = (Known(model, p), p[:0]) if fix_coefficients else (model, p)
        readings = Readings(given, lifted.arcs.states, noise * self.relative, BIWEIGHT)
        found = readings.fit(
            free, x, noise, max_iterations=iterations, tolerance=gained, least=self.least
        )
        if not np.isfinite(found.cost):
            return None
        return dataclasses.replace(found, p=p) if fix_coefficients else found

    def _lifted(self, model: FlowOnArcs, p) -> np.ndarray:
        """The measured states with angles that go on over turns, as the flow leads from each to the
        next."""
        y = self.arcs.states.copy()
        if self.angles:
            off = self._off(model, p)[..., list(self.angles)]
            turns = np.round(np.where(np.isfinite(off), off, 0.0) / (2 * np.pi))
            y[:, 1:, list(self.angles)] += 2 * np.pi * np.cumsum(turns, axis=1)
        return y

    def _starts(self, model: FlowOnArcs, p) -> tuple[np.ndarray, np.ndarray]:
        """States (A, L, 2d) to start from, and a first guess of the noise (2d,).

        A measured state stands for itself, unless all steps to and from it miss: it may be a gross
        error. That one, and one that was not measured, is led to from its neighbours in the arc.
        """
        x, off = np.nan_to_num(self.arcs.states), self._off(model, p)
        size = robust(off[np.isfinite(off).all(axis=-1)], axis=0)
        with np.errstate(divide="ignore", invalid="ignore"):
            near = (np.abs(off) <= OPTIONS.contradicted * size).all(axis=-1)
        good = np.zeros(x.shape[:2], bool)
        good[:, :-1] |= near
        good[:, 1:] |= near
        good &= self.arcs.measured
        good[:, 0] |= ~good.any(axis=1)  # nothing tells which state of a single pair is wrong
        first = np.argmax(good, axis=1)
        for n in range(1, x.shape[1]):
            lost = np.flatnonzero(~good[:, n] & (n > first))
            moved = model.moves[lost, n - 1]
            x[lost, n] = x[lost, n - 1]
            if moved.any():
                x[lost[moved], n] = model.images(p, x[lost[moved], n - 1])
        for n in range(x.shape[1] - 2, -1, -1):
            lost = np.flatnonzero(n < first)
            if len(lost):
                x[lost, n] = model.images(p, x[lost, n + 1], -1)
        return x, size / np.sqrt(2)

    def _off(self, model: FlowOnArcs, p) -> np.ndarray:
        """Defects between measured states and the next (A, L − 1, 2d); NaN where one is missing."""
        arcs = self.arcs
        off = np.full(arcs.states[:, 1:].shape, np.nan)
        both = arcs.measured[:, :-1] & arcs.measured[:, 1:] & model.moves
        off[both] = model.images(p, arcs.states[:, :-1][both]) - arcs.states[:, 1:][both]
        return off


def longest_arc(family, c, z, dt: float, how: Steps, noise) -> int:
    """Steps of an arc: as many as it takes noise (÷ spread) to grow to ``grown`` from nearly all of
    the states z (n, 2d), and no more than ``longest``."""
    width = z.shape[1]
    carried = np.broadcast_to(np.eye(width), (len(z), width, width))
    size = z.std(axis=0)
    unit = size[None, :] / size[:, None]
    for k in range(1, OPTIONS.longest + 1):
        step = images(family, c, z, dt, how, derivatives=True)
        z, carried = step.states, step.by_state @ carried
        grown = np.linalg.norm(carried * unit, axis=(1, 2))
        size_at_end = np.quantile(np.where(np.isfinite(grown), grown, np.inf), 0.9) * noise
        if not size_at_end < OPTIONS.grown:
            return max(k - 1, 1)
    return OPTIONS.longest


@dataclasses.dataclass(frozen=True)
class Sequences:
    """The sequences of a data set, cut into arcs of at most ``longest`` steps, along which noise
    stays linear. steps: of a flow, whose own error is far below the noise. least: (2d,) of what is
    left over, what is no noise. allowance: checked before each block of lanes."""

    data: Dataset
    steps: Steps
    longest: int
    least: np.ndarray
    allowance: Allowance

    @classmethod
    def along(cls, problem: LawProblem, family, c: np.ndarray, how: Steps) -> Sequences | None:
        """Cut them as long as a law with coefficients c that are close allows, by steps that
        resolve it. None where there are none of one dt in plain coordinates."""
        data, flows = problem.data, problem.flows
        plain = data.coordinates.forward is CARTESIAN.forward and data.structure is None
        if not plain or data.varied:
            return None
        some = data.training[: OPTIONS.states]
        rms = float(robust(flows.residuals(family, c, how, some)))
        if not 0 < rms < np.inf:
            return None
        resolved = OPTIONS.step_error * rms
        steps = flows.fine_steps(family, c, data.training, (resolved,))[0]
        longest = longest_arc(family, c, data.y0[some], data.dt, steps, rms)
        least = max(resolved, float(np.finfo(float).eps)) * flows.scale
        return cls(data, steps, longest, least, Allowance(problem.budget))

    def arcs(self, rows: np.ndarray, *, alone: bool = False) -> Measured | None:
        """Arcs of these rows; None where they say no more than their pairs do, unless these are to
        stand ``alone``."""
        rows, pairs, weight = np.sort(rows), self.data.pairs, self.data.weight
        onto = self.longest, onward(pairs, rows)
        arcs = arcs_of_pairs(np.asarray(pairs.z0)[rows], np.asarray(pairs.z1)[rows], *onto)
        short = arcs is None or np.median(arcs.measured.sum(axis=1)) <= OPTIONS.shortest
        if arcs is None or (short and not alone):
            return None
        found = Measured(arcs, self.least, self.data.coordinates.angles)
        if weight is None:
            return found
        each = 1.0 / weight[rows]
        of_values = arcs_of_pairs(each, each, *onto)
        assert of_values is not None
        return dataclasses.replace(found, relative=np.nan_to_num(of_values.states, nan=1.0))

    def fitted(
        self, of: Measured, family, p: np.ndarray, terms: int | None = None, **options: Any
    ) -> Fitted | None:
        """The law with its numbers near p. family, terms: as of `FlowOnArcs`; options: of
        `Measured.fit`."""
        dt, moves = self.data.dt, of.arcs.moves
        model = FlowOnArcs(family, dt, self.steps, moves, self.allowance, terms)
        return of.fit(model, p, **options)

    def refitted(self, found: Fitted, family, terms: int | None = None) -> Fitted:
        """The law fitted to the held-out sequences too, where the arcs are so many for so many
        numbers that these need not judge it."""
        if OPTIONS.rows_per_term * len(found.p) > triangle_of(found).rows:
            return found
        everyone = self.arcs(np.arange(len(self.data.y0)))
        again = None if everyone is None else self.fitted(everyone, family, found.p, terms)
        return found if again is None else again


def fitted_to_sequences(problem: LawProblem, law: FittedLaw) -> FittedLaw | None:
    """The law of these pairs' fit, fitted to their sequences, and its held-out error of a step.
    None where they are none of one dt in plain coordinates, where noise soon grows beyond the
    linear, or where held-out sequences do not bear the law out."""
    family, fit, c = law.family, law.fit, law.fit.coefficients
    sequences = Sequences.along(problem, family, c, fit.steps)
    if sequences is None:
        return None
    train, held = sequences.arcs(problem.data.training), sequences.arcs(problem.data.validation)
    if train is None or held is None:
        return None

    def left(terms, coefficients) -> float:
        """Noise of the held-out arcs, each from the state that suits it."""
        found = sequences.fitted(held, terms, coefficients, fix_coefficients=True)
        scale = problem.data.scale
        return np.inf if found is None else float(np.linalg.norm(noise_of(found) / scale))

    before, found, widened = left(family, c), sequences.fitted(train, family, c), 1.0
    if found is None or not left(family, found.p) <= OPTIONS.rise * before:
        return None
    few = terms_above_noise(triangle_of(found), found.p, ABOVE_NOISE)[0]
    if 0 < len(few) < len(c):
        fewer = family.take(tuple(few.tolist()))
        again = sequences.fitted(train, fewer, found.p[few])
        if again is not None and left(fewer, again.p) <= OPTIONS.rise * before:
            widened = _of_selection(triangle_of(found), found.p, few)
            found, family = again, fewer
    found = sequences.refitted(found, family)
    root = widened * covariance_root_of(found)
    fit = fit._replace(coefficients=found.p, standard_errors=np.linalg.norm(root, axis=0))
    error = problem.error_of(family, fit)
    return law._replace(family=family, fit=fit, error=error, whole=summary_of(found, root))


def summary_of(found: Fitted, root: np.ndarray) -> SequenceFit:
    """Summary of a fit to sequences, with the root of its covariance."""
    noise, outliers = noise_of(found), about_outliers(found.residuals)
    return SequenceFit(root, noise, len(found.x), outliers, lacks_terms(found))


def noise_of(found: Fitted) -> np.ndarray:
    """(2d,): of noise of each value the root of the mean square over what was measured."""
    if found.sigma.ndim == 1:
        return found.sigma
    return np.sqrt(
        np.nanmean(np.where(np.isfinite(found.residuals), found.sigma, np.nan) ** 2, axis=(0, 1))
    )


def triangle_of(found: Fitted) -> Triangle:
    """Triangle of [∂r/∂c, r] without the latent states, r predicted less measured, of as many rows
    as the numbers that have weight are more than the latent ones: of a pair half."""
    factor = found.factor.copy()
    factor[:, -1] *= -1
    weighty = np.sum(np.abs(found.residuals) < BIWEIGHT.k, axis=(1, 2))
    return Triangle(factor, int(np.maximum(weighty - found.x.shape[-1], 0).sum()))


def _of_selection(triangle: Triangle, c: np.ndarray, few: np.ndarray) -> float:
    """Factor of the standard errors of these terms that stands for the others, which were dropped.

    Terms that are no more than noise each may be more together: without them the sum of squares
    rises by Δ, of mean n for n terms that are truly zero, with variance 2 n. What it exceeds n by,
    and a standard deviation more, is a bias beside the k squares of the k coefficients' own error.
    """
    dropped = len(c) - len(few)
    squares = triangle.rebased(c).pruned(few).spectrum().residual_norm ** 2
    rise = squares - triangle.residual_norm(len(c)) ** 2
    bias = max(rise - dropped, 0.0) + np.sqrt(2 * dropped)
    return float(np.sqrt(1 + bias / len(few)))


def covariance_root_of(found: Fitted) -> np.ndarray:
    """(m, m), rootᵀ root the covariance: that of independent noise, and of the misfit by which the
    arcs' own gradients vary by more than noise makes them.

    Misfit is alike along an arc, and stays however many arcs there are. Where it is certain, only
    as many arcs count as there are coefficients, as in `fitting.uncertainty`: bands then hold what
    the terms cannot represent.
    """
    root, (arcs, count) = triangle_of(found).spectrum().root().T, found.scores.shape
    misfit, certain = _misfit(found.scores @ root.T)
    return root * np.sqrt(1.0 + misfit * (max(arcs / count, 1.0) if certain else 1.0))


def lacks_terms(found: Fitted) -> bool:
    """Return whether the arcs are certain that the law misses more than noise."""
    return _misfit(found.scores @ triangle_of(found).spectrum().root())[1]


def _misfit(scores: np.ndarray) -> tuple[float, bool]:
    """Variation of the arcs' gradients (arcs, count) beyond that of noise, in whose units they are,
    and whether that is certain."""
    arcs, count = scores.shape
    each = np.sum(scores**2, axis=1) / count
    misfit = max(float(each.sum()) / max(1 - count / arcs, 1 / arcs) - 1.0, 0.0)
    by_chance = EVIDENCE.chance * float(np.sqrt(arcs) * each.std())
    return misfit, misfit > max(OPTIONS.clear, by_chance)


def about_outliers(residuals: np.ndarray) -> tuple[str, ...]:
    """Message about measured states that the law misses by far: gross errors stand alone.

    residuals: (arcs, L, 2d) in units of the noise.
    """
    measured = np.isfinite(residuals).all(axis=-1)
    outlying = np.any(np.abs(residuals) > OUTLYING, axis=-1)
    if not outlying.any():
        return ()
    beside = np.any(np.abs(residuals) > OPTIONS.in_a_row, axis=-1)
    beside = np.pad(beside, ((0, 0), (1, 1)))
    alone = outlying & ~(beside[:, :-2] | beside[:, 2:])
    if 2 * alone.sum() < outlying.sum():
        return (
            f"the law misses {outlying.sum()} of {measured.sum()} measured states by more than "
            f"{OUTLYING:g} times the noise, most of them in a row: it is less accurate there, and "
            "they were given little weight",
        )
    return (
        f"{outlying.sum()} of {measured.sum()} measured states lie more than {OUTLYING:g} times "
        "the noise from the sequences of the law: outliers, they were given little weight",
    )
