"""``gfnn.fit`` of positions alone: the map behind them, by an S(q, Q) that is learned from triples.

triples → sizes of S by rising degree, symmetric first → the smallest that meets the tolerance, else
the best → where larger ones leave as much, and so the readings have noise, S with latent positions
→ its map, measured by its own steps from positions that were held out.
"""

import dataclasses
import time
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np

from gfnn_jax.budget import ROWS, Budget, within
from gfnn_jax.candidates.assemble import Candidate, block_of, stepped, with_error
from gfnn_jax.coordinates import Coordinates, nearest_image
from gfnn_jax.data.recording import Recording
from gfnn_jax.data.traits import without_wrong_values
from gfnn_jax.dataset.measured_error import OneStepError, Tolerance, one_step_error
from gfnn_jax.dataset.runs import identified
from gfnn_jax.dataset.split import Split, split_rows
from gfnn_jax.dataset.structures import Sites, structure_of
from gfnn_jax.errors import FitError
from gfnn_jax.families.displacements import OfDisplacement
from gfnn_jax.families.inputs import box_inputs, variable_signs
from gfnn_jax.families.products import Products
from gfnn_jax.generating.charts import TYPE1
from gfnn_jax.generating.generated import Generated
from gfnn_jax.learn.fitted import STATES_MEASURED, Choice, Fit, OfPositions
from gfnn_jax.learn.options import FitOptions, Watch
from gfnn_jax.maps.sensors import Sensors
from gfnn_jax.models.positions import discrete_lagrangian, latent_positions
from gfnn_jax.phase_space import Pairs, sizes
from gfnn_jax.search.search import MET


class Options:
    """Sizes of S(q, Q) that are tried, and when a larger one is of no use (study: positions)."""

    degrees: tuple[int, ...] = (2, 3, 4, 5, 6, 7, 8, 9, 10, 12, 14, 16, 20)
    # of one solve: a few seconds on one core
    rows_per_term: int = 3
    most_operations: float = 2e10
    fewest: int = 20  # triples
    # of the residual: sizes in a row that leave more end a sweep
    better: float = 0.9
    worse: int = 3
    gain: float = 0.5  # of the residual: what an S without symmetry must lower it to
    roundoff: float = 1e-15  # of the spread
    exact: float = 1e-10  # of the spread: readings whose S leaves less have no noise worth the name
    # of the residual, that a larger S leaves at least where readings have noise
    stalled: float = 0.5
    window: int = 40  # steps, from whose readings a state is estimated


def learn_positions(recording: Recording, options: FitOptions, watch: Watch) -> Fit:
    """Learn the map behind positions alone, at even times or by turns: S(q, Q) of chart type 1.

    recording: its positions, of one run or many; an angle's values that range over more than one
    turn are a lift and trusted, others known modulo 2π. options: of which the tolerance, a
    structure of equal sites ("ring", "chain"), the seed and the budget apply. The rest as of
    `gfnn.fit`; errors are those of the next position.

    The map acts on z = (q, p), p = −h ∂S/∂q: ``map.from_positions`` and
    ``map.rollout(positions=(q, Q), …)`` start it. Positions of one place tell p but for a factor
    and a gauge, which `models.positions.discrete_lagrangian` fixes: frequencies, positions and
    stability do not depend on them, the size of p, energies and areas do.
    Raises FitError where the recording has no positions at even times, too few triples of them for
    the smallest S, or no S explains them.
    """
    tolerance, structure = Tolerance.of(options), options.structure
    recording, left_out = without_wrong_values(recording)
    budget = options.budget(watch, len(recording.positions) or None)
    triples = discrete_lagrangian.triples_of(recording, sites=structure is not None)
    sites = structure_of(structure, triples.dim, Coordinates("positions", triples.angles))
    if sites is not None and not isinstance(sites, Sites):
        raise FitError(f"expected a ring or a chain of positions, got {structure!r}")
    if len(triples) < Options.fewest:
        raise FitError(f"expected at least {Options.fewest} triples, got {len(triples)}")
    none, window = np.zeros(triples.dim), Options.window * triples.dt
    read = recording.positions, (), recording.angles, none, 0.0, window
    sensors = Sensors(*read, "hold", 0.0, np.array([triples.dt]), none[None])
    sweep = _Sweep(triples, sites, _split(triples, options.seed), tolerance, budget, watch, sensors)
    best = sweep.best(symmetric=True)
    if best is None or not tolerance.met_by(best.candidate):
        other = sweep.best(symmetric=False)
        least = np.inf if best is None else Options.gain * best.candidate.validation_bound
        if other is not None and (best is None or other.candidate.validation_bound < least):
            best = other
    if best is None:
        raise FitError(
            f"{len(triples)} triples of positions gave no S(q, Q) whose step can be solved. Add "
            "positions, or raise --max-seconds"
        )
    return sweep.learned(sweep.without_noise(best), left_out, options.seed)


class _Found(NamedTuple):
    """A piece, its error, what its S is like, a root (k, m) of the covariance of its coefficients,
    and the noise (d,) of readings."""

    piece: Generated
    candidate: Candidate
    about: OfPositions
    root: np.ndarray
    noise: np.ndarray


@dataclasses.dataclass
class _Sweep:
    """The triples, which of them train, choose and test, and every size that was tried."""

    triples: discrete_lagrangian.Triples
    sites: Sites | None
    split: Split
    tolerance: Tolerance
    budget: Budget
    watch: Watch
    sensors: Sensors
    tried: list[Candidate] = dataclasses.field(default_factory=list)

    @property
    def spread(self) -> np.ndarray:
        """(d,) of the positions; of an angle at most that of its circle."""
        size = sizes(self.triples.middle)
        angles = list(self.triples.angles)
        size[angles] = np.minimum(size[angles], np.pi / np.sqrt(3))
        return size

    def best(self, *, symmetric: bool) -> _Found | None:
        """The smallest S whose steps meet the tolerance, else the most accurate; None where the
        triples are too few for any, or no S has a step."""
        found: _Found | None = None
        worse = 0
        for family in self._families(symmetric):
            new = self._within_budget(family, symmetric)
            if new is None:
                break
            least = np.inf if found is None else Options.better * found.candidate.validation_bound
            if found is None or not new.candidate.validation_bound >= least:
                found, worse = new, 0
            else:
                worse += 1
            met = found.candidate.validation_bound <= max(self.tolerance.bound, Options.roundoff)
            if met or worse == Options.worse:
                break
        if found is None or not np.isfinite(found.candidate.validation_bound):
            return None
        return found

    def _families(self, symmetric: bool) -> Iterator[OfDisplacement]:
        """Families by rising size, as many as the training triples determine."""
        triples, rows = self.triples, len(self.split.training) * self.triples.dim
        # An angle stays as it is: the middle of two would be known by half a turn only.
        part, moves = 0.0 if triples.angles else 0.5, _centres_of_moves(triples)
        for k, inner in enumerate(self._inner(symmetric, part)):
            both = symmetric and getattr(inner, "signs", None) is None
            family = OfDisplacement(inner, part, both, moves)
            terms = family.num_parameters
            many = k and rows * terms**2 > Options.most_operations
            if many or Options.rows_per_term * terms > rows:
                return
            yield family

    def _inner(self, symmetric: bool, part: float) -> Iterator[Any]:
        """The F of S, of a position and a displacement."""
        dim = self.triples.dim
        if self.sites is not None:
            yield from self.sites.libraries(dim)
            return
        q, other = np.split(self.triples.ends, 2, axis=1)
        x = np.concatenate([q + part * (other - q), other - q], axis=1)
        if part:
            turned = (1,) * dim + (-1,) * dim
            inputs = box_inputs(x, reversor=turned)
            signs = variable_signs(inputs, turned, x) if symmetric else None
            yield from (Products(inputs, degree, signs) for degree in Options.degrees)
            return
        if symmetric:
            x = np.concatenate([x, np.concatenate([other, q - other], axis=1)])
        inputs = box_inputs(x, angles=self.triples.angles)
        yield from (Products(inputs, degree) for degree in Options.degrees)

    def without_noise(self, best: _Found) -> _Found:
        """S with latent positions where the readings have noise, by which least squares is biased;
        else the best as it is."""
        if not self._stalls(best):
            return best
        self.watch.on_progress("larger S are no more accurate: fitting the readings' noise too")
        symmetric, split = best.about.symmetric, self.split
        both = np.sort(split.training), np.sort(split.validation)
        training, held_out = map(self.triples.take, both)
        families = self._families(symmetric)
        found = latent_positions.without_noise(
            families, training, held_out, self.budget, self.watch.on_progress
        )
        if found is None:
            return best
        started = time.perf_counter()
        noise = tuple(map(float, found.fit.sigma))
        about = dataclasses.replace(
            best.about,
            num_parameters=found.family.num_parameters,
            rank=found.solved.rank,
            condition=found.solved.condition,
            noise=noise,
        )
        own = found.fit.coefficients, found.fit.root, found.fit.sigma
        return self._found(found.family, about, *own, started)

    def _stalls(self, best: _Found) -> bool:
        """Return whether the next larger S leaves as much as the best one does."""
        error, terms = best.candidate.validation_relative, best.candidate.num_parameters
        families = self._families(best.about.symmetric)
        larger = next((f for f in families if f.num_parameters > terms), None)
        if error <= Options.exact or larger is None:
            return False
        known = next((c for c in self.tried if c.num_parameters == larger.num_parameters), None)
        if known is None:
            new = self._within_budget(larger, best.about.symmetric)
            if new is None:
                return False
            known = new.candidate
        return known.validation_relative > Options.stalled * error

    def _within_budget(self, family: OfDisplacement, symmetric: bool) -> _Found | None:
        """S of this family; None where the budget has no room for it."""
        work = float(len(self.split.training) * self.triples.dim * family.num_parameters**2)
        unit = self.budget.unit(f"S of {family.label}", ROWS, work)
        return within(unit, lambda: self._fitted(family, symmetric))

    def _fitted(self, family: OfDisplacement, symmetric: bool) -> _Found:
        self.watch.on_progress(f"S of {family.label}, {family.num_parameters} terms")
        started, training = time.perf_counter(), self.triples.take(self.split.training)
        solved = discrete_lagrangian.solve(family, training)
        about = OfPositions(
            symmetric, family.num_parameters, solved.rank, solved.condition, len(self.triples)
        )
        left = discrete_lagrangian.residuals(
            family, family.unflatten(solved.coefficients), training
        )
        deviation = np.sqrt(np.mean((left / discrete_lagrangian.displacement(training)) ** 2))
        noise = latent_positions.starting_noise(family, solved.coefficients, training)
        root = deviation * solved.root
        return self._found(family, about, solved.coefficients, root, noise, started)

    def _found(
        self,
        family: OfDisplacement,
        about: OfPositions,
        coefficients: np.ndarray,
        root: np.ndarray,
        noise: np.ndarray,
        started: float,
    ) -> _Found:
        """A candidate, with the error of its steps from positions that were held out."""
        triples = self.triples
        training, held = (triples.take(r) for r in (self.split.training, self.split.validation))
        params = family.unflatten(coefficients)
        states = latent_positions.states_of(family, params, triples)
        piece = Generated(family, params, TYPE1, triples.dt, sizes(states[0]))
        left = discrete_lagrangian.residuals(family, params, training) / self.spread
        error = self.error_of(latent_positions.images_of(piece, held), self.split.validation)
        gradient, with_hessian = family.operations
        candidate = Candidate.of(
            error,
            label=family.label,
            family=family.name,
            chart=TYPE1.name,
            num_parameters=family.num_parameters,
            operations=float(gradient + with_hessian),
            train_rms=float(np.sqrt(np.mean(left**2))),
            validated=True,
            fit_seconds=time.perf_counter() - started,
            condition=about.condition,
            rank=about.rank,
        )
        self.tried.append(candidate)
        self.watch.on_candidate(candidate)
        return _Found(piece, candidate, about, root, noise)

    def error_of(self, positions: np.ndarray, rows: np.ndarray) -> OneStepError:
        """Error of the last positions (n, d) of these rows, as predicted."""
        error = nearest_image(positions - self.triples.after[rows], self.triples.angles)
        return one_step_error(error, self.spread, self.tolerance, self.split.stretch[rows])

    def learned(self, best: _Found, left_out: Sequence[str], seed: int) -> Fit:
        """The map of the best S, its error that of the steps that users run, on triples that chose
        nothing where there are enough. left_out: lines about readings that were."""
        self.watch.on_progress(f"compiling the step of {best.candidate.label}")
        sensors = dataclasses.replace(self.sensors, sigma=best.noise)
        map_, states = latent_positions.map_of(
            best.piece, best.root, sensors, self.triples, self.sites
        )
        test = self.split.test if len(self.split.test) else self.split.validation
        steps = stepped(map_, states.z1[test])
        images = np.where(steps.failed[:, None], np.nan, steps.images)[:, : self.triples.dim]
        chosen = dataclasses.replace(
            with_error(best.candidate, self.error_of(images, test)),
            chosen=True,
            newton_iterations_max=int(steps.iterations.max()),
            microseconds_per_step=steps.microseconds_per_step,
        )
        others = [c for c in self.tried if c is not best.candidate]
        met, messages = self.tolerance.met_by(chosen), list(left_out)
        ended = MET if met else self.budget.ended or "larger S are no more accurate"
        messages += [] if met else [self.tolerance.missed_by(chosen, ended)]
        self.watch.on_progress(str(best.about))
        part = "took no part in the fit or its choices" if test is self.split.test else "also chose"
        tested = states.take(test[: min(STATES_MEASURED, block_of(2 * map_.dim))])
        determinant = np.asarray(map_.determinant(tested.z0))
        choice = Choice.of(
            self.budget,
            tested,
            candidates=tuple(sorted([*others, chosen], key=lambda c: c.operations)),
            asked=self.tolerance,
            num_pairs=best.about.num_triples,
            messages=tuple(messages),
            ended=ended,
            compile_seconds=steps.compile_seconds,
            model_determinant_min=float(determinant[np.argmin(np.abs(determinant))]),
            pairs=states,
            positions=best.about,
            stated_by=f"{len(test):,} triples that {part}",
            validation_pairs=states.take(self.split.validation),
            seed=seed,
        )
        return Fit(map_, choice)


def _split(triples: discrete_lagrangian.Triples, seed: int) -> Split:
    """Split by runs, or of few runs by blocks of time, as pairs of states (q, Q − q) are split."""
    coming, going = np.split(triples.moves, 2)
    z0 = np.concatenate([triples.middle, coming], axis=1)
    z1 = np.concatenate([triples.after, going], axis=1)
    pairs = Pairs(z0, z1, triples.dt, run=triples.run, place=triples.place)
    return split_rows(identified(pairs).pairs, seed)


def _centres_of_moves(triples: discrete_lagrangian.Triples) -> np.ndarray | None:
    """Centres as `OfDisplacement` has them."""
    if not triples.wrapped:
        return None
    centres = np.full(triples.dim, np.nan)
    for i in triples.angles:
        centres[i] = 0.5 * (triples.moves[:, i].min() + triples.moves[:, i].max())
    return centres
